"""Read a plan from TOML, and check it whole."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from sealscope.campaigns.plans.detectors import plan_detector
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
    Classifier,
    DataSet,
    HeldOutPlan,
    LeakLaw,
    LeaveOut,
    LogisticClassifier,
    Promise,
    RecordedPlan,
    RecordGroup,
    RecordingSet,
    SimulatedPlan,
    Use,
)
from sealscope.campaigns.plans.table import PlanTable
from sealscope.errors import InputError
from sealscope.storage.opening import names_a_file
from sealscope.storage.toml_file import read_toml

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_T = TypeVar("_T")
_PACKAGED = Path(__file__).parent / "packaged"
#: Most records of a campaign: a mistyped count shall not plan a year of work.
MOST_RECORDS = 1_000_000
_LONGEST_NAME = 80
#: Most combinations of the factors' levels.
MOST_CELLS = 100_000
#: Most swaps of labels by which chance is estimated.
MOST_PERMUTATIONS = 100_000
#: Most groups of features to choose from: more have too many unions to try them all.
MOST_GROUPS = 8


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
    if "recordings" in tree:
        _known(tree, ("campaign", "views", "recordings"), "a plan over recordings", place)
        return _recorded(tree, place)
    if "held_out" in tree:
        _known(tree, ("campaign", "held_out"), "a plan over measured data", place)
        return _held_out(tree, place)
    _known(tree, ("campaign", "factors", "views", "[records]"), "a plan", place)
    return _simulated(tree, place)


def _known(tree: Mapping[str, Any], tables: tuple[str, ...], kind: str, place: str) -> None:
    names = [name.strip("[]") for name in tables]
    for key in tree:
        if key not in names:
            known = ", ".join(f"[{name}]" for name in tables[:-1])
            raise InputError(f"[{key}] is not known; {kind} has {known} and [{tables[-1]}] ({place})")


def _judged(head: PlanTable, tree: Mapping[str, Any], rig: Rig | None) -> dict[str, Any]:
    """Read what plans over recordings, simulated or not, have in common."""
    views = head.views(tree.get("views", {}))
    return {
        "false_alarm": head.share("false_alarm", 0.01),
        "promise": head.choice("promise", get_args(Promise), "average"),
        "confidence": head.share("confidence", 0.95),
        "detectors": head.detectors(views),
        "note": head.text("note", ""),
        "views": views,
        "assumed": head.assumed(rig),
        "place": head.place,
    }


def _in(entry: str, place: str, read: Callable[[], _T]) -> _T:
    """Return `read()`; an InputError of it gets the entry and the place of the plan."""
    try:
        return read()
    except InputError as error:
        raise InputError(f"{entry}: {error} ({place})") from None


def _simulated(tree: Mapping[str, Any], place: str) -> SimulatedPlan:
    head = PlanTable(tree.get("campaign", {}), "campaign", place)
    name = _name(head)
    duration = head.number("duration", unit="s")
    onset = head.number("onset", duration / 2, unit="s")
    if not 0.0 < onset < duration:
        raise head.fail(f"onset must be within the duration, 0 s to {duration:g} s, got {onset:g}")
    rig, profile = _rig(head), _profile(head)
    plan = SimulatedPlan(
        name=name,
        title=head.text("title", name),
        rig=rig,
        profile=profile,
        duration_s=duration,
        onset_s=onset,
        seed=head.whole("seed", 0),
        keep_recordings=head.flag("keep_recordings"),
        factors=_factors(tree.get("factors", {}), rig, profile, duration, place),
        part=head.text("part", ""),
        records=_records(tree.get("records", ()), onset, head.flag("bound"), place),
        **_judged(head, tree, rig),
    )
    head.end()
    if plan.size > MOST_RECORDS:
        raise InputError(f"a campaign must have at most {MOST_RECORDS} records, got {plan.size} ({place})")
    _enough_records(plan)
    return plan


def _name(head: PlanTable) -> str:
    """Return the campaign's name, which is that of its folder as well."""
    name = head.text("name")
    if not all(c.isalnum() or c in "-_." for c in name) or name.startswith(".") or len(name) > _LONGEST_NAME:
        most = f"{_LONGEST_NAME} letters, digits, '-', '_' and '.'"
        raise head.fail(f"name must be of at most {most}, got {name[:99]!r}")
    return name


def _rig(head: PlanTable) -> Rig:
    from sealscope.parameters import load_rig

    name = head.text("rig", "thesis")
    rig = _in("campaign.rig", head.place, lambda: load_rig(head.beside(name)))
    values: dict[str, float | str] = {}
    if "rate" in head.left:
        values["daq.sample_rate"] = head.number("rate", unit="Hz")
    given = head.take("set", {})
    if not isinstance(given, Mapping):
        raise head.fail(f"set must be a table of parameters, got {given!r}")
    values |= given
    if not values:
        return rig
    return _in("campaign.set", head.place, lambda: rig.with_overrides(values, source="set by the plan"))


def _profile(head: PlanTable) -> str:
    name = head.text("profile", "none")
    if name == "none":
        return ""
    from sealscope.simulation.bench.profile import load_profile

    name = head.beside(name)
    _in("campaign.profile", head.place, lambda: load_profile(name))
    return name


def _factors(given: Any, rig: Rig, profile: str, duration: float, place: str) -> dict[str, tuple[str | float, ...]]:
    table = PlanTable(given, "factors", place)
    factors: dict[str, tuple[str | float, ...]] = {}
    for name, levels in table.left.items():
        if not isinstance(levels, list) or not levels:
            raise table.fail(f"{name} must be a list of levels, got {levels!r}")
        if len({repr(level) for level in levels}) < len(levels):
            raise table.fail(f"{name} must hold each level once")
        for level in levels:
            if isinstance(level, bool) or not isinstance(level, (str, int, float)):
                raise table.fail(f"{name} must be texts or numbers, got {level!r}")
            _in(f"factors.{name}", place, partial(_check_level, name, level, rig, profile, duration))
        factors[name] = tuple(levels)
        cells = math.prod(map(len, factors.values()))
        if cells > MOST_CELLS:
            raise table.fail(f"their levels must make at most {MOST_CELLS} cells, got {cells} or more")
    if CONTROLLER in factors and (command := voltage_in(_commands(factors, profile))) is not None:
        raise table.fail(f"{CONTROLLER} must have targets to follow ('position 50 mm sin(2t)'), got {command!r}")
    return factors


def _commands(factors: Mapping[str, tuple[str | float, ...]], profile: str) -> tuple[str | float, ...]:
    """Return the commands of a plan: its factor's, or else those of its profile, or of its families there."""
    from sealscope.simulation.bench.profile import load_profile

    if COMMAND in factors or not profile:
        return factors.get(COMMAND, ("3 sin(4t)",))
    drawn = load_profile(profile)
    kinds = [drawn.of_family(str(family)) for family in factors.get("family", ())] or [drawn]
    return tuple(command for kind in kinds for command in kind.duty.commands)


def _check_level(name: str, level: str | float, rig: Rig, profile: str, duration: float) -> None:
    from sealscope.simulation.bench.profile import load_profile

    if name == "family":
        if not profile:
            raise InputError(f"a family must be of the plan's profile, got {level!r} and no profile")
        load_profile(profile).family(str(level))
    elif name in (COMMAND, CONTROLLER, LOAD):
        check_duty(name, level, rig, duration)
    else:
        rig.with_overrides(closing_values(level) if name == "closed" else {name: level})


def _records(given: Any, onset: float, bound: bool, place: str) -> tuple[RecordGroup, ...]:
    if not isinstance(given, list) or not given:
        raise InputError(f"a plan must have [[records]], got none ({place})")
    groups: dict[tuple[str, float, str, str], RecordGroup] = {}
    for number, entries in enumerate(given, 1):
        table = PlanTable(entries, f"records[{number}]", place)
        group = RecordGroup(
            use=table.choice("use", get_args(Use), "judge"),
            count=table.whole("count", least=1),
            leak_lpm=table.number("leak", 0.0, unit="L/min") if "leak" in table.left else 0.0,
            law=table.choice("law", get_args(LeakLaw), "laminar"),
            fault=table.text("fault", ""),
            bound=table.flag("bound") or bound,
        )
        table.end()
        if group.leak_lpm < 0:
            raise table.fail(f"leak must be >= 0 L/min, got {group.leak_lpm:g}")
        if group.use == "calibrate" and (group.leak_lpm or group.fault):
            raise table.fail("use = 'calibrate' must be leak-free and without a fault")
        if group.fault:
            _in(f"records[{number}].fault", place, partial(fault_of, group.fault, onset))
        kind = (group.use, group.leak_lpm, group.law, group.fault)
        if kind in groups:
            raise table.fail("records must differ from the others in use, leak, law or fault")
        groups[kind] = group
    return tuple(groups.values())


def _enough_records(plan: SimulatedPlan) -> None:
    """Refuse a plan without records to judge, or with too few for the scorers' thresholds."""
    from sealscope.evaluation.thresholds import records_needed

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
    head = PlanTable(tree.get("campaign", {}), "campaign", place)
    part = PlanTable(tree["recordings"], "recordings", place)
    channel_map = part.take("map", {})
    if not isinstance(channel_map, dict) or not all(isinstance(column, str) for column in channel_map.values()):
        raise part.fail(f"map must be a table of channel = column, got {channel_map!r}")
    name = _name(head)
    plan = RecordedPlan(
        name=name,
        title=head.text("title", name),
        channel_map=channel_map,
        rate_hz=part.number("rate", unit="Hz") if "rate" in part.left else None,
        sets=tuple(_recording_set(table) for table in part.tables("sets")),
        unit=part.text("unit", "L/min"),
        **_judged(head, tree, None),
    )
    head.end()
    part.end()
    if not any(recordings.use == "judge" for recordings in plan.sets):
        raise part.fail("sets must have one to judge, got none")
    return plan


def _recording_set(table: PlanTable) -> RecordingSet:
    recordings = RecordingSet(
        files=table.text("files"),
        use=table.choice("use", get_args(Use), "judge"),
        size=table.number("size", 0.0),
        first=table.whole("first", 1, least=1),
        end=table.whole("end", 10**9, least=2),
        label=table.text("label", ""),
    )
    table.end()
    if recordings.size < 0 or (recordings.use == "calibrate" and recordings.size > 0):
        raise table.fail(f"size must be >= 0, and 0 to calibrate, got {recordings.size:g}")
    if Path(recordings.files).is_absolute() or ".." in Path(recordings.files).parts:
        raise table.fail(f"files must be a pattern within the folder, got {recordings.files!r}")
    if "\0" in recordings.files or any("**" in part and part != "**" for part in Path(recordings.files).parts):
        raise table.fail(f"files must be a pattern of names, got {recordings.files!r}")
    if recordings.files.count("**") > 1:
        raise table.fail(f"files must have ** once at most, got {recordings.files!r}")
    return recordings


def _held_out(tree: Mapping[str, Any], place: str) -> HeldOutPlan:
    head = PlanTable(tree.get("campaign", {}), "campaign", place)
    part = PlanTable(tree["held_out"], "held_out", place)
    name, data = _name(head), part.choice("data", get_args(DataSet))
    plan = HeldOutPlan(
        name=name,
        title=head.text("title", name),
        data=data,
        leave_out=part.choice("leave_out", get_args(LeaveOut), "test"),
        detectors=tuple(_classifier(table) for table in part.tables("detectors")),
        confidence=head.share("confidence", 0.95),
        place=place,
        unit="grade" if data == "hydraulic" else "L/min",
        note=head.text("note", ""),
        permutations=part.whole("permutations", 0, most=MOST_PERMUTATIONS),
        seed=part.whole("seed", 0),
    )
    head.end()
    part.end()
    if len({classifier.name for classifier in plan.detectors}) < len(plan.detectors):
        raise part.fail("detectors must have names of their own")
    return plan


def _classifier(table: PlanTable) -> Classifier:
    name = table.text("name")
    if "choose" not in table.left:
        features, ridge = table.texts("features"), table.number("ridge", 1.0)
        if not ridge > 0:
            raise table.fail(f"ridge must be > 0, got {ridge:g}")
        table.end()
        return LogisticClassifier(name, features, ridge)
    given, rule = table.take("choose"), "choose must be a list of lists of names"
    if not isinstance(given, list) or not given:
        raise table.fail(f"{rule}, got {given!r}")
    groups = tuple(table.checked_texts(group, rule) for group in given)
    if len(groups) > MOST_GROUPS:
        raise table.fail(f"choose must have at most {MOST_GROUPS} groups, got {len(groups)}")
    ridges = table.take("ridges")
    if not isinstance(ridges, list) or not ridges or not all(_is_number(ridge) and ridge > 0 for ridge in ridges):
        raise table.fail(f"ridges must be a list of numbers > 0, got {ridges!r}")
    table.end()
    return ChosenClassifier(name, groups, tuple(float(ridge) for ridge in ridges))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
