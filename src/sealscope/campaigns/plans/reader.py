"""Read a plan from TOML, and check it whole."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from sealscope.campaigns.plans.detectors import check_detector, plan_detector
from sealscope.campaigns.plans.duty import (
    COMMAND,
    CONTROLLER,
    LOAD,
    check_duty,
    closing_values,
    fault_of,
    voltage_in,
)
from sealscope.campaigns.plans.model import (
    AnyPlan,
    ChosenClassifier,
    HeldOutPlan,
    LogisticClassifier,
    RecordedPlan,
    RecordGroup,
    RecordingSet,
    SimulatedPlan,
)
from sealscope.errors import InputError
from sealscope.evaluation.thresholds import records_needed
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import CHANNEL_UNITS
from sealscope.simulation.bench.profile import load_profile
from sealscope.storage.opening import names_a_file
from sealscope.storage.plain_values import as_type
from sealscope.storage.toml_file import read_toml

_T = TypeVar("_T")
_PACKAGED = Path(__file__).parent / "packaged"
#: Most records of a campaign: a mistyped count shall not plan a year of work. Most combinations of levels.
MOST_RECORDS, MOST_CELLS = 1_000_000, 100_000
#: Entries of a plan that the model calls otherwise.
_FIELDS = {
    "leak": "leak_lpm", "duration": "duration_s", "onset": "onset_s", "rate": "rate_hz", "map": "channel_map",
    "choose": "groups",
}  # fmt: skip
_ENTRIES = {field: entry for entry, field in _FIELDS.items()}
#: Fields of the model that no entry sets.
_NO_ENTRIES = {*_ENTRIES, "assumed", "place", "views"}
#: What holds the records of a plan -> the tables that it has.
_TABLES = {
    "recordings": ("campaign", "views", "recordings"),
    "held_out": ("campaign", "held_out"),
    "records": ("campaign", "factors", "views", "records"),
}


def plan_names() -> tuple[str, ...]:
    """Return the names of the packaged plans."""
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
    """Read the plan in a TOML file's tables; its kind follows from the tables that are there."""
    kind = next((name for name in _TABLES if name in tree), "records")
    for key in tree:
        if key not in _TABLES[kind]:
            known = ", ".join(f"[{name}]" for name in _TABLES[kind])
            raise InputError(f"[{key}] is not known; a plan with [{kind}] has {known} ({place})")
    if kind == "recordings":
        return _recorded(tree, place)
    return _held_out(tree, place) if kind == "held_out" else _simulated(tree, place)


def _in(entry: str, place: str, read: Callable[[], _T]) -> _T:
    """Return `read()`; an InputError of it gets the entry and the place of the plan."""
    try:
        return read()
    except InputError as error:
        raise InputError(f"{entry}: {error} ({place})") from None


def _table(
    given: Any, name: str, place: str, unknown: Collection[str] = (), known: Collection[str] = ()
) -> dict[str, Any]:
    """Return a table's entries; InputError for one that is `unknown`, or none of the `known` where these are named."""
    if not isinstance(given, Mapping):
        raise InputError(f"[{name}] must be a table, got {given!r} ({place})")
    for entry in given:
        if entry in unknown or (known and entry not in known):
            raise InputError(f"{name}.{entry} is not known ({place})")
    return dict(given)


def _tables(given: Any, name: str, place: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the tables of a list of one or more, each with its name."""
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise InputError(f"a plan must have a list of [[{name}]], got {given or 'none'!r} ({place})")
    return [(f"{name}[{k}]", _table(entries, f"{name}[{k}]", place, _ENTRIES)) for k, entries in enumerate(given, 1)]


def _part(
    kind: type[_T], entries: Mapping[str, Any], name: str, place: str, second: tuple[str, Collection[str]] = ("", ())
) -> _T:
    """Return the entries of a table as the part `kind` of a plan; InputError names the entry that breaks a rule.

    `second`: another table, and which of the entries stand there.
    """

    def named(field: str) -> str:
        entry = _ENTRIES.get(field, field)
        return f"{second[0] if entry in second[1] else name}.{entry}" if entry else name

    try:
        return as_type(kind, {_FIELDS.get(entry, entry): value for entry, value in entries.items()}, named)
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None


def _beside(name: Any, place: str) -> Any:
    """Return the path of a file named in a plan, which lies beside the plan; another name as it is."""
    return os.fspath(Path(place).parent / name) if isinstance(name, str) and name.endswith(".toml") else name


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise InputError(f"must be a text, got {value!r}")
    return value


def _changed(rig: Rig, values: Any, source: str) -> Rig:
    if not isinstance(values, Mapping):
        raise InputError(f"must be a table of parameters, got {values!r}")
    return rig.with_overrides(values, source=source) if values else rig


def _rig(head: dict[str, Any], place: str) -> Rig:
    """Take the rig of a plan from its first table, with the values that it sets."""
    rig = _in("campaign.rig", place, lambda: load_rig(_text(_beside(head.pop("rig", "thesis"), place))))
    values = head.pop("set", {})
    if "rate" in head:
        values = {"daq.sample_rate": head.pop("rate"), **_table(values, "campaign.set", place)}
    return _in("campaign.set", place, lambda: _changed(rig, values, "set by the plan"))


def _assumed(head: dict[str, Any], rig: Rig | None, place: str) -> Rig | None:
    """Take the rig that detectors may assume: `assume`, a rig's name or file, and `assume_set`, values of it."""

    def read() -> Rig | None:
        assumed = load_rig(_text(_beside(head.pop("assume"), place))) if "assume" in head else rig
        if "assume_set" in head:
            return _changed(assumed or load_rig("thesis"), head.pop("assume_set"), "assumed by the plan")
        return assumed

    return _in("campaign.assume", place, read)


def _views(given: Any, head: dict[str, Any], place: str) -> dict[str, tuple[str, ...]]:
    """Read the table [views], name -> channels, and under "" the entry `channels` where there is one."""
    views = {name: (f"views.{name}", channels) for name, channels in _table(given, "views", place).items()}
    for name, (entry, _) in views.items():
        if not name.strip() or name != name.strip() or "@" in name:
            raise InputError(f"{entry} must be a plain name without '@' ({place})")
    if "channels" in head:
        views[""] = ("campaign.channels", head.pop("channels"))
    for entry, channels in views.values():
        known = isinstance(channels, list) and channels and all(name in list(CHANNEL_UNITS) for name in channels)
        if not known or len(set(channels)) < len(channels):
            raise InputError(f"{entry} must be a list of channels, each once, got {channels!r} ({place})")
        if "q_leak" in channels:
            raise InputError(f"{entry} must not hold q_leak: it measures what detectors are to find ({place})")
    return {name: tuple(channels) for name, (_, channels) in views.items()}


def _judged(
    kind: type[_T], entries: dict[str, Any], tree: Mapping[str, Any], rig: Rig | None, place: str, **more: Any
) -> _T:
    """Return a plan over recordings, simulated or not, its detectors checked."""
    views = _views(tree.get("views", {}), entries, place)
    entries |= {"views": views, "assumed": _assumed(entries, rig, place), "place": place}
    plan = _part(kind, entries, "campaign", place, **more)
    names: tuple[str, ...] = plan.detectors  # type: ignore[attr-defined]
    for name in names:
        _in("campaign.detectors", place, partial(check_detector, name, views))
    if len(set(names)) < len(names):
        raise InputError(f"campaign.detectors must be named once each ({place})")
    return plan


def _simulated(tree: Mapping[str, Any], place: str) -> SimulatedPlan:
    head = _table(tree.get("campaign", {}), "campaign", place, {*_NO_ENTRIES, "factors", "records"})
    rig, profile = _rig(head, place), _beside(head.pop("profile", "none"), place)
    if profile != "none":
        _in("campaign.profile", place, lambda: load_profile(_text(profile)))
    bound = head.pop("bound", False)
    groups = _tables(tree.get("records"), "records", place)
    head |= {
        "rig": rig,
        "profile": "" if profile == "none" else profile,
        "onset": head.get("onset", 0.0),
        "factors": _table(tree.get("factors", {}), "factors", place),
        "records": tuple(_part(RecordGroup, {"bound": bound, **of}, name, place) for name, of in groups),
    }
    plan = _judged(SimulatedPlan, head, tree, rig, place)
    onset = plan.onset_s if "onset" in tree["campaign"] else plan.duration_s / 2
    if not 0.0 < onset < plan.duration_s:
        rule = f"must be within the duration, 0 s to {plan.duration_s:g} s"
        raise InputError(f"campaign.onset {rule}, got {onset:g} ({place})")
    if plan.size > MOST_RECORDS:
        raise InputError(f"a campaign must have at most {MOST_RECORDS} records, got {plan.size} ({place})")
    plan = replace(plan, title=plan.title or plan.name, onset_s=onset)
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
    drawn = load_profile(plan.profile)
    kinds = [drawn.of_family(str(family)) for family in plan.factors.get("family", ())] or [drawn]
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
    """Refuse records that say the same twice, a fault that is none, and too few records to judge or to calibrate."""
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
        each = f" ({needed} for each of {commands} commands)" if commands > 1 else ""
        raise InputError(
            f"records to calibrate must be at least {needed * commands}{each} for false_alarm = "
            f"{plan.false_alarm:g}, got {count} ({plan.place})"
        )


def _recorded(tree: Mapping[str, Any], place: str) -> RecordedPlan:
    own = ("map", "rate", "unit", "sets")
    head = _table(tree.get("campaign", {}), "campaign", place, {*_NO_ENTRIES, *own})
    part = _table(tree["recordings"], "recordings", place, known=own)
    sets = _tables(part.pop("sets", ()), "recordings.sets", place)
    part["sets"] = tuple(_part(RecordingSet, of, name, place) for name, of in sets)
    plan = _judged(RecordedPlan, {**head, **part}, tree, None, place, second=("recordings", part))
    if not any(recordings.use == "judge" for recordings in plan.sets):
        raise InputError(f"recordings.sets must have one to judge, got none ({place})")
    return replace(plan, title=plan.title or plan.name)


def _held_out(tree: Mapping[str, Any], place: str) -> HeldOutPlan:
    own = ("data", "leave_out", "permutations", "seed", "detectors")
    head = _table(tree.get("campaign", {}), "campaign", place, {*_NO_ENTRIES, *own})
    part = _table(tree["held_out"], "held_out", place, known=own)
    part["detectors"] = tuple(
        _part(ChosenClassifier if "choose" in of else LogisticClassifier, of, name, place)
        for name, of in _tables(part.pop("detectors", ()), "held_out.detectors", place)
    )
    more = {"unit": "grade" if part.get("data") == "hydraulic" else "L/min", "place": place}
    plan = _part(HeldOutPlan, {**head, **part, **more}, "campaign", place, ("held_out", part))
    if len({classifier.name for classifier in plan.detectors}) < len(plan.detectors):
        raise InputError(f"held_out.detectors must have names of their own ({place})")
    return replace(plan, title=plan.title or plan.name)
