"""Read a plan from TOML, and check all of it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from sealscope.campaigns.plans.detectors import DIAGNOSE, WATCH, check_detector, plan_detector
from sealscope.campaigns.plans.duty import (
    COMMAND,
    CONTROLLER,
    LOAD,
    check_duty,
    closing_values,
    fault_of,
    voltage_in,
)
from sealscope.campaigns.plans.model import AnyPlan, RecordedPlan, SimulatedPlan
from sealscope.diagnosis.diagnose import check_probability
from sealscope.errors import InputError
from sealscope.evaluation.thresholds import records_needed
from sealscope.parameters import load_rig
from sealscope.simulation.bench.profile import load_profile
from sealscope.storage.opening import names_a_file
from sealscope.storage.toml_file import read_model, read_toml

_T = TypeVar("_T")
_PACKAGED = Path(__file__).parent / "packaged"
#: Most records of a campaign: a mistyped count shall not plan a year of work. Most combinations of levels.
MOST_RECORDS, MOST_CELLS = 1_000_000, 100_000
#: What holds the records of a plan -> its kind, the tables that it has, and the entries of the last of them.
_KINDS: Mapping[str, tuple[type[AnyPlan], tuple[str, ...], tuple[str, ...]]] = {
    "recordings": (RecordedPlan, ("campaign", "views", "recordings"), ("map", "rate", "unit", "sets")),
    "records": (SimulatedPlan, ("campaign", "factors", "views", "records"), ()),
}


def plan_names() -> tuple[str, ...]:
    """List the names of the packaged plans."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


def load_plan(name_or_path: str | os.PathLike[str]) -> AnyPlan:
    """Load the packaged plan of that name, or the plan in a TOML file; InputError names the rule and the place."""
    text = os.fspath(name_or_path)
    if text in plan_names():
        return read_plan(read_toml(_PACKAGED / f"{text}.toml", "a plan", f"plans/{text}.toml"), f"plans/{text}.toml")
    if not (text.endswith(".toml") or names_a_file(text)):
        raise InputError(f"{text!r} is no packaged plan ({', '.join(plan_names())}) and no .toml file")
    return read_plan(read_toml(Path(text), "a plan", text), text)


def read_plan(tree: Mapping[str, Any], place: str = "plan") -> AnyPlan:
    """Read the plan in a TOML file's tables; its kind follows from the tables present."""
    plan = _entries(tree, place)
    plan = replace(plan, title=plan.title or plan.name)
    without_view = {} if plan.channels is None else {"": plan.channels}
    plan = replace(plan, views={**plan.views, **without_view}, assume=plan.assume and _path_beside(plan.assume, place))
    if isinstance(plan, SimulatedPlan):
        plan = _simulated(plan)
    elif not any(recordings.use == "judge" for recordings in plan.sets):
        raise InputError(f"recordings.sets must have one to judge, got none ({place})")
    _in("campaign.assume", place, lambda: plan.assumed)
    for name in plan.detectors:
        _in("campaign.detectors", place, partial(check_detector, name, plan.views))
    if {DIAGNOSE, WATCH} & {plan_detector(name).base for name in plan.detectors}:
        _in("campaign.false_alarm", place, partial(check_probability, plan.false_alarm))
    if len(set(plan.detectors)) < len(plan.detectors):
        raise InputError(f"campaign.detectors must be named once each ({place})")
    return plan


def _entries(tree: Mapping[str, Any], place: str) -> AnyPlan:
    """Read the entries of all tables as a plan, each checked alone; an error names the table of its entry."""
    source = next((name for name in _KINDS if name in tree), "records")
    kind, tables, entries_of_source = _KINDS[source]
    for key in tree:
        if key not in tables:
            table_names = ", ".join(f"[{name}]" for name in tables)
            raise InputError(f"[{key}] is not known; a plan with [{source}] has {table_names} ({place})")
    entries, names = {**tree, "place": place}, {name: name for name in tables}
    for table in ("campaign", source) if entries_of_source else ("campaign",):
        values = entries.pop(table, {})
        if not isinstance(values, Mapping):
            raise InputError(f"{table} must be a table, got {values!r} ({place})")
        for entry in values:
            if (entry in entries_of_source) != (table == source) or entry in ("place", *tables):
                raise InputError(f"{table}.{entry} is not known ({place})")
            names[entry] = f"{table}.{entry}"
        entries |= values
    return read_model(entries, kind, place, lambda entry: names.get(entry, f"campaign.{entry}"))


def _in(entry: str, place: str, read: Callable[[], _T]) -> _T:
    """Call `read`; name the entry and the plan's place in its InputError."""
    try:
        return read()
    except InputError as error:
        raise InputError(f"{entry}: {error} ({place})") from None


def _path_beside(name: str, place: str) -> str:
    """Build the path of a file in the plan's folder; another name is returned unchanged."""
    return os.fspath(Path(place).parent / name) if name.endswith(".toml") else name


def _simulated(plan: SimulatedPlan) -> SimulatedPlan:
    """Complete and check a simulated plan: the paths of its files, and its onset."""
    place = plan.place
    profile = "" if plan.profile == "none" else _path_beside(plan.profile, place)
    onset = plan.duration_s / 2 if math.isnan(plan.onset_s) else plan.onset_s
    plan = replace(plan, rig_name=_path_beside(plan.rig_name, place), profile=profile, onset_s=onset)
    _in("campaign.rig", place, lambda: load_rig(plan.rig_name))
    _in("campaign.set", place, lambda: plan.rig)
    if profile:
        _in("campaign.profile", place, partial(load_profile, profile))
    if not 0.0 < onset < plan.duration_s:
        rule = f"must be within the duration, 0 s to {plan.duration_s:g} s"
        raise InputError(f"campaign.onset {rule}, got {onset:g} ({place})")
    if plan.size > MOST_RECORDS:
        raise InputError(f"a campaign must have at most {MOST_RECORDS} records, got {plan.size} ({place})")
    _check_factors(plan)
    _check_records(plan)
    return plan


def _check_factors(plan: SimulatedPlan) -> None:
    """Raise InputError for a level that no run can have, and for too many of them."""
    for name, levels in plan.factors.items():
        if len({repr(level) for level in levels}) < len(levels):
            raise InputError(f"factors.{name} must hold each level once ({plan.place})")
        for level in levels:
            _in(f"factors.{name}", plan.place, partial(_check_level, plan, name, level))
    cells = math.prod(map(len, plan.factors.values()))
    if cells > MOST_CELLS:
        raise InputError(f"factors: their levels must make at most {MOST_CELLS} cells, got {cells} ({plan.place})")
    if CONTROLLER in plan.factors and (command := voltage_in(_commands(plan))) is not None:
        rule = f"must have targets to follow ('position 50 mm sin(2t)'), got {command!r}"
        raise InputError(f"factors.{CONTROLLER} {rule} ({plan.place})")


def _commands(plan: SimulatedPlan) -> tuple[str | float, ...]:
    """Return the commands of a plan: its factor's, or else those of its profile, or of its families there."""
    if COMMAND in plan.factors or not plan.profile:
        return plan.factors.get(COMMAND, ("3 sin(4t)",))
    profile = load_profile(plan.profile)
    kinds = [profile.of_family(str(family)) for family in plan.factors.get("family", ())] or [profile]
    return tuple(command for kind in kinds for command in kind.duty.commands)


def _check_level(plan: SimulatedPlan, name: str, level: str | float) -> None:
    if name == "family":
        if not plan.profile:
            raise InputError(f"a family must be of the plan's profile, got {level!r} and no profile")
        load_profile(plan.profile).family(str(level))
    elif name in (COMMAND, CONTROLLER, LOAD):
        check_duty(name, level, plan.rig, plan.duration_s)
    else:
        plan.rig.with_overrides(closing_values(level) if name == "closed" else {name: level})


def _check_records(plan: SimulatedPlan) -> None:
    """Refuse duplicate records, an unknown fault, and too few records to judge or to calibrate."""
    kinds = [(group.use, group.leak_lpm, group.law, group.fault) for group in plan.records]
    for number, (kind, group) in enumerate(zip(kinds, plan.records, strict=True), 1):
        if group.fault:
            _in(f"records[{number}].fault", plan.place, partial(fault_of, group.fault, plan.onset_s))
        if kind in kinds[: number - 1]:
            rule = "records must differ from the others in use, leak, law or fault"
            raise InputError(f"records[{number}].{rule} ({plan.place})")
    if not any(group.use == "judge" for group in plan.records):
        raise InputError(f"a plan must have records to judge, got none ({plan.place})")
    if not any(plan_detector(name).needs_threshold for name in plan.detectors):
        return
    count = sum(group.count for group in plan.records if group.use == "calibrate")
    needed = records_needed(plan.false_alarm, plan.confidence if plan.promise == "bound" else None)
    commands = len(plan.factors.get("command", ("",)))  # each an operating point, with thresholds of its own
    if count < needed * commands:
        per_command = f" ({needed} for each of {commands} commands)" if commands > 1 else ""
        raise InputError(
            f"records to calibrate must be at least {needed * commands}{per_command} for false_alarm = "
            f"{plan.false_alarm:g}, got {count} ({plan.place})"
        )
