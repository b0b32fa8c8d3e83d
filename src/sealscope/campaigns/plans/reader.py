"""Read a campaign's plan from a TOML file, and check all of it before anything is run."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from sealscope.campaigns.plans.detectors import DIAGNOSE, WATCH, check_detector, parse_detector_name
from sealscope.campaigns.plans.duty import COMMAND, CONTROLLER, FAMILY, check_level, parse_plan_fault
from sealscope.campaigns.plans.model import AnyPlan, RecordedPlan, SimulatedPlan
from sealscope.diagnosis.diagnose import check_probability
from sealscope.errors import InputError
from sealscope.evaluation.thresholds import records_needed
from sealscope.parameters import load_rig
from sealscope.simulation.commands import DEFAULT_COMMAND
from sealscope.simulation.targets_and_loads import parse_position
from sealscope.storage.opening import is_file_path
from sealscope.storage.toml_file import read_model, read_toml

_PACKAGED = Path(__file__).parent / "packaged"
#: Limits of records and of combinations of levels, so that a mistyped count does not plan a year of computing.
MAX_RECORDS, MAX_CELLS = 1_000_000, 100_000
#: By the name of the table that lists a plan's records: the class of the plan, the names of all its tables, and the
#: entries of the table that lists the records. [[records]] is an array of tables, which has no entries of its own.
_KINDS: Mapping[str, tuple[type[AnyPlan], tuple[str, ...], tuple[str, ...]]] = {
    "recordings": (RecordedPlan, ("campaign", "views", "recordings"), ("map", "rate", "unit", "sets")),
    "records": (SimulatedPlan, ("campaign", "factors", "views", "records"), ()),
}


def plan_names() -> tuple[str, ...]:
    """List the names of the packaged plans."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


def load_plan(name_or_path: str | os.PathLike[str]) -> AnyPlan:
    """Load a packaged plan by its name, or a plan from a TOML file by its path.

    Raises InputError, which names the broken rule and the file, if the plan is invalid.
    """
    text = os.fspath(name_or_path)
    if text in plan_names():
        return read_plan(read_toml(_PACKAGED / f"{text}.toml", "a plan", f"plans/{text}.toml"), f"plans/{text}.toml")
    if not (text.endswith(".toml") or is_file_path(text)):
        raise InputError(f"{text!r} is neither a packaged plan ({', '.join(plan_names())}) nor a .toml file")
    return read_plan(read_toml(Path(text), "a plan", text), text)


def read_plan(tree: Mapping[str, Any], place: str = "plan") -> AnyPlan:
    """Build a plan from the parsed tables of a TOML file, and check it; raise InputError if it is invalid.

    A file with the table [recordings] gives a plan of recordings, any other a plan of simulated records. `place`: path
    of the file; files that the plan names are relative to its folder.
    """
    plan = _parse_tables(tree, place)
    default_view = {} if plan.channels is None else {"": plan.channels}  # for detectors without "@"
    plan = replace(
        plan,
        title=plan.title or plan.name,
        views={**plan.views, **default_view},
        assume=plan.assume and _path_in_plan_folder(plan.assume, place),
    )
    if isinstance(plan, SimulatedPlan):
        plan = _complete_simulated_plan(plan)
    elif not any(recording_set.use == "judge" for recording_set in plan.sets):
        raise InputError(f"recordings.sets must have one to judge, got none ({place})")
    _check_entry("campaign.assume", place, lambda: plan.assumed)
    for name in plan.detectors:
        _check_entry("campaign.detectors", place, partial(check_detector, name, plan.views))
    if {DIAGNOSE, WATCH} & {parse_detector_name(name).base for name in plan.detectors}:  # these accept a smaller range
        _check_entry("campaign.false_alarm", place, partial(check_probability, plan.false_alarm))
    if len(set(plan.detectors)) < len(plan.detectors):
        raise InputError(f"campaign.detectors must be named once each ({place})")
    return plan


def _parse_tables(tree: Mapping[str, Any], place: str) -> AnyPlan:
    """Build a plan from the parsed tables `tree` of its file `place`; raise InputError for an unknown or wrong entry.

    Each entry of [campaign] and [recordings] becomes a field of the plan; each other table becomes one field. Factors,
    and files that the plan names, are not checked here.
    """
    source = next((name for name in _KINDS if name in tree), "records")  # name of the table that lists the records
    plan_class, tables, source_entries = _KINDS[source]
    for key in tree:
        if key not in tables:
            table_names = ", ".join(f"[{name}]" for name in tables)
            raise InputError(f"[{key}] is not known; a plan with [{source}] has {table_names} ({place})")
    entries = {**tree, "place": place}
    # names in messages, by entry
    full_names = {name: name for name in tables} | {entry: f"{source}.{entry}" for entry in source_entries}
    merged_tables = ("campaign", source) if source_entries else ("campaign",)  # [[records]] stays as it is
    for table in merged_tables:
        values = entries.pop(table, {})
        if not isinstance(values, Mapping):
            raise InputError(f"{table} must be a table, got {values!r} ({place})")
        for entry in values:
            is_misplaced = (entry in source_entries) != (table == source)  # of the other table, or of none
            if is_misplaced or entry in ("place", *tables):  # these would replace other fields of the plan
                raise InputError(f"{table}.{entry} is not known ({place})")
            full_names[entry] = f"{table}.{entry}"
        entries |= values
    # an entry without a full name is one of [campaign] that is missing
    return read_model(entries, plan_class, place, lambda entry: full_names.get(entry, f"campaign.{entry}"))


def _check_entry(entry: str, place: str, check: Callable[[], object]) -> None:
    """Call `check`; to its InputError, add the plan's `entry`, such as "campaign.rig", and file."""
    try:
        check()
    except InputError as error:
        raise InputError(f"{entry}: {error} ({place})") from None


def _path_in_plan_folder(name: str, place: str) -> str:
    """Join the path of a TOML file to the folder of the plan `place`; return the name of a packaged file unchanged."""
    return os.fspath(Path(place).parent / name) if name.endswith(".toml") else name


def _complete_simulated_plan(plan: SimulatedPlan) -> SimulatedPlan:
    """Resolve the paths of a simulated plan, fill in its default onset, and check it; raise InputError if invalid."""
    place = plan.place
    # "none" and "" mean no profile
    profile = "" if plan.profile == "none" else _path_in_plan_folder(plan.profile, place)
    onset = plan.duration_s / 2 if math.isnan(plan.onset_s) else plan.onset_s
    plan = replace(plan, rig_name=_path_in_plan_folder(plan.rig_name, place), profile=profile, onset_s=onset)
    _check_entry("campaign.rig", place, lambda: load_rig(plan.rig_name))
    _check_entry("campaign.set", place, lambda: plan.rig)
    _check_entry("campaign.profile", place, lambda: plan.machine_profile)
    if not 0.0 < onset < plan.duration_s:
        rule = f"must be within the duration, 0 s to {plan.duration_s:g} s"
        raise InputError(f"campaign.onset {rule}, got {onset:g} ({place})")
    if plan.size > MAX_RECORDS:
        raise InputError(f"a campaign must have at most {MAX_RECORDS} records, got {plan.size} ({place})")
    _check_factors(plan)
    _check_records(plan)
    return plan


def _check_factors(plan: SimulatedPlan) -> None:
    """Check the factors of a plan and their levels (values); raise InputError if one of them is invalid.

    With a factor `controller`, all commands must be targets of the piston's position, not voltages.
    """
    for name, levels in plan.factors.items():
        if len({repr(level) for level in levels}) < len(levels):  # `repr` tells the number 1 from the text "1"
            raise InputError(f"factors.{name} must hold each level once ({plan.place})")
        for level in levels:
            _check_entry(f"factors.{name}", plan.place, partial(check_level, plan, name, level))
    cells = math.prod(map(len, plan.factors.values()))
    if cells > MAX_CELLS:
        raise InputError(f"factors: their levels must make at most {MAX_CELLS} cells, got {cells} ({plan.place})")
    for command in map(str, _commands(plan) if CONTROLLER in plan.factors else ()):
        if parse_position(command) is None:  # a voltage
            rule = f"must have targets to follow ('position 50 mm sin(2t)'), got {command!r}"
            raise InputError(f"factors.{CONTROLLER} {rule} ({plan.place})")


def _commands(plan: SimulatedPlan) -> tuple[str | float, ...]:
    """List the commands of a plan's records: the levels of the factor `command`, or else the profile's commands.

    With a factor `family`, only the commands of the families that it lists count. Without factor `command` and profile,
    the only command is `DEFAULT_COMMAND`.
    """
    profile = plan.machine_profile
    if COMMAND in plan.factors or profile is None:
        return plan.factors.get(COMMAND, (str(DEFAULT_COMMAND),))
    profiles = [profile.of_family(str(family)) for family in plan.factors.get(FAMILY, ())] or [profile]
    return tuple(command for family_profile in profiles for command in family_profile.duty.commands)


def _check_records(plan: SimulatedPlan) -> None:
    """Check the groups of records of a plan; raise InputError if a group is invalid.

    The groups must differ in use, leak, law or fault, since the ids of records follow from these (`list_cases`), and at
    least one must be judged. If a detector needs a threshold, there must be enough leak-free records (`records_needed`)
    for each command, as each gets its own threshold.
    """
    contents = [(group.use, group.leak_lpm, group.law, group.fault) for group in plan.records]
    for number, (content, group) in enumerate(zip(contents, plan.records, strict=True), 1):
        if group.fault:
            parse_group_fault = partial(parse_plan_fault, group.fault, plan.onset_s)
            _check_entry(f"records[{number}].fault", plan.place, parse_group_fault)
        if content in contents[: number - 1]:
            rule = "records must differ from the others in use, leak, law or fault"
            raise InputError(f"records[{number}].{rule} ({plan.place})")
    if not any(group.use == "judge" for group in plan.records):
        raise InputError(f"a plan must have records to judge, got none ({plan.place})")
    if not any(parse_detector_name(name).needs_threshold for name in plan.detectors):
        return
    count = sum(group.count for group in plan.records if group.use == "calibrate")
    needed = records_needed(plan.false_alarm, plan.confidence, plan.promise)
    n_commands = len(plan.factors.get(COMMAND, ("",)))  # 1 without this factor
    if count < needed * n_commands:
        per_command = f" ({needed} for each of {n_commands} commands)" if n_commands > 1 else ""
        raise InputError(
            f"records to calibrate must be at least {needed * n_commands}{per_command} for false_alarm = "
            f"{plan.false_alarm:g}, got {count} ({plan.place})"
        )
