"""A campaign's plan: what is simulated, how often, and which detectors judge it; read from TOML, checked whole."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from sealscope.campaigns.plan_table import Table
from sealscope.errors import InputError
from sealscope.parameters.toml_file import read_toml

if TYPE_CHECKING:
    from sealscope.campaigns.held_out_plan import HeldOutPlan
    from sealscope.campaigns.recorded import RecordedPlan
    from sealscope.parameters import Rig

AnyPlan: TypeAlias = "Plan | HeldOutPlan | RecordedPlan"
Use = Literal["calibrate", "judge"]
Promise = Literal["average", "bound"]

_PACKAGED = Path(__file__).parent / "plans"
#: Most records a campaign may have: a slip of the keyboard shall not plan a year of work.
MOST_RECORDS = 1_000_000


@dataclass(frozen=True)
class Records:
    """`count` records spread evenly over the cells of the factors.

    `use`: `calibrate` sets thresholds (leak-free), `judge` is judged by them, on seeds of its own; `leak_lpm`: mean
    flow [L/min] of a leak of that `law` from the plan's onset on, 0 for none; `fault`: another fault in words.
    """

    use: Use
    count: int
    leak_lpm: float = 0.0
    law: Literal["laminar", "orifice"] = "laminar"
    fault: str = ""


@dataclass(frozen=True)
class Plan:
    """A simulated campaign.

    `profile`: the bench whose nuisances each record draws, "" for the rig as it stands; `factors`: name -> levels,
    every combination is a cell; `command` and `closed` are the duty, other names parameters of the rig; `seed`: the
    base of every case's seed; `views`: sets of channels that detectors see (`entries`); `assumed`: what detectors may
    assume of the machine, None for the plan's rig.
    """

    name: str
    title: str
    rig: Rig
    profile: str
    duration_s: float
    onset_s: float
    false_alarm: float
    promise: Promise
    confidence: float
    seed: int
    detectors: tuple[str, ...]
    keep_recordings: bool
    records: tuple[Records, ...]
    factors: Mapping[str, tuple[str | float, ...]] = field(default_factory=dict)
    place: str = ""
    unit: str = "L/min"
    note: str = ""
    views: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    assumed: Rig | None = None

    @property
    def size(self) -> int:
        """Number of records."""
        return sum(one.count for one in self.records)


def plan_names() -> tuple[str, ...]:
    """Names of the packaged plans."""
    return tuple(sorted(path.stem for path in _PACKAGED.glob("*.toml")))


def load_plan(name_or_path: str | os.PathLike[str]) -> AnyPlan:
    """The plan of that name, or in a TOML file; raises InputError, in one line with the place, for whatever breaks a
    rule."""
    text = os.fspath(name_or_path)
    if text in plan_names():
        return read_plan(read_toml(_PACKAGED / f"{text}.toml", "a plan", f"plans/{text}.toml"), f"plans/{text}.toml")
    if not (text.endswith(".toml") or Path(text).is_file()):
        raise InputError(f"{text!r} is no packaged plan ({', '.join(plan_names())}) and no .toml file")
    return read_plan(read_toml(Path(text), "a plan", text), text)


def read_plan(tree: Mapping[str, Any], place: str = "plan") -> AnyPlan:
    """The plan in a TOML file's tables."""
    if "recordings" in tree:
        from sealscope.campaigns.recorded import read_recorded

        return read_recorded(tree, place)
    if "held_out" in tree:
        from sealscope.campaigns.held_out_plan import read_held_out

        return read_held_out(tree, place)
    return _Reader(place).plan(tree)


class _Reader:
    """Reads a simulated plan."""

    def __init__(self, place: str) -> None:
        self.place = place

    def plan(self, tree: Mapping[str, Any]) -> Plan:
        for key in tree:
            if key not in ("campaign", "factors", "records", "views"):
                raise InputError(
                    f"[{key}] is not known; a plan has [campaign], [factors], [views] and [[records]] ({self.place})"
                )
        head = Table(tree.get("campaign", {}), "campaign", self.place)
        name = head.text("name")
        if not all(c.isalnum() or c in "-_." for c in name) or name.startswith("."):
            raise head.fail(f"name must be of letters, digits, '-', '_' and '.', got {name!r}")
        duration = head.number("duration", unit="s")
        onset = head.number("onset", duration / 2, unit="s")
        if not 0.0 < onset < duration:
            raise head.fail(f"onset must be within the duration, 0 s to {duration:g} s, got {onset:g}")
        rig = self._rig(head)
        factors = self._factors(tree.get("factors", {}), rig)
        views = head.views(tree.get("views", {}))
        plan = Plan(
            name=name,
            title=head.text("title", name),
            rig=rig,
            profile=self._profile(head),
            duration_s=duration,
            onset_s=onset,
            false_alarm=head.share("false_alarm", 0.01),
            promise=head.choice("promise", get_args(Promise), "average"),  # type: ignore[arg-type]
            confidence=head.share("confidence", 0.95),
            seed=head.whole("seed", 0),
            detectors=head.detectors(views),
            keep_recordings=self._keep(head),
            records=self._records(tree.get("records", ()), onset),
            factors=factors,
            place=self.place,
            note=head.text("note", ""),
            views=views,
            assumed=head.assumed(rig),
        )
        head.end()
        if plan.size > MOST_RECORDS:
            raise InputError(f"a campaign must have at most {MOST_RECORDS} records, got {plan.size} ({self.place})")
        self._whole(plan)
        return plan

    def _said(self, what: str, made: Callable[[], Any]) -> Any:
        try:
            return made()
        except InputError as error:
            raise InputError(f"{what}: {error} ({self.place})") from None

    def _rig(self, head: Table) -> Rig:
        from sealscope.parameters import load_rig

        name = head.text("rig", "thesis")
        rig = self._said("campaign.rig", lambda: load_rig(self._beside(name)))
        settings: dict[str, float | str] = {}
        if "rate" in head.left:
            settings["daq.sample_rate"] = head.number("rate", unit="Hz")
        given = head.take("set", {})
        if not isinstance(given, Mapping):
            raise head.fail(f"set must be a table of parameters, got {given!r}")
        settings |= given
        if not settings:
            return rig  # type: ignore[no-any-return]
        return self._said("campaign.set", lambda: rig.with_values(settings, source="set by the plan"))  # type: ignore[no-any-return]

    def _beside(self, name: str) -> str:
        """A file named in a plan lies beside the plan."""
        return os.fspath(Path(self.place).parent / name) if name.endswith(".toml") else name

    def _profile(self, head: Table) -> str:
        name = head.text("profile", "none")
        if name == "none":
            return ""
        from sealscope.simulation.bench.profile import load_profile

        name = self._beside(name)
        self._said("campaign.profile", lambda: load_profile(name))
        return name

    @staticmethod
    def _keep(head: Table) -> bool:
        value = head.left.pop("keep_recordings", False)
        if not isinstance(value, bool):
            raise head.fail(f"keep_recordings must be true or false, got {value!r}")
        return value

    def _factors(self, given: Any, rig: Rig) -> dict[str, tuple[str | float, ...]]:
        table = Table(given, "factors", self.place)
        found: dict[str, tuple[str | float, ...]] = {}
        for name, levels in list(table.left.items()):
            if not isinstance(levels, list) or not levels:
                raise table.fail(f"{name} must be a list of levels, got {levels!r}")
            if len({repr(one) for one in levels}) < len(levels):
                raise table.fail(f"{name} must hold each level once")
            for level in levels:
                if isinstance(level, bool) or not isinstance(level, (str, int, float)):
                    raise table.fail(f"{name} must be texts or numbers, got {level!r}")
                self._said(f"factors.{name}", partial(self._level, name, level, rig))
            found[name] = tuple(levels)
        return found

    @staticmethod
    def _level(name: str, level: str | float, rig: Rig) -> None:
        from sealscope.campaigns.machines import closing_values
        from sealscope.simulation.commands import parse_command

        if name == "command":
            if not isinstance(level, str):
                raise InputError(f"a command must be a text such as '3 sin(4t)', got {level!r}")
            parse_command(level)
        else:
            rig.with_values(closing_values(level) if name == "closed" else {name: level})

    def _records(self, given: Any, onset: float) -> tuple[Records, ...]:
        if not isinstance(given, list) or not given:
            raise InputError(f"a plan must have [[records]], got none ({self.place})")
        found: list[Records] = []
        for number, one in enumerate(given, 1):
            table = Table(one, f"records[{number}]", self.place)
            use = table.choice("use", get_args(Use), "judge")
            count = table.whole("count", least=1)
            leak = table.number("leak", 0.0, unit="L/min") if "leak" in table.left else 0.0
            law = table.choice("law", ("laminar", "orifice"), "laminar")
            fault = table.text("fault", "")
            table.end()
            if leak < 0:
                raise table.fail(f"leak must be >= 0 L/min, got {leak:g}")
            if use == "calibrate" and (leak or fault):
                raise table.fail("use = 'calibrate' must be leak-free and without a fault")
            if fault:
                from sealscope.campaigns.machines import fault_of

                self._said(f"records[{number}].fault", partial(fault_of, fault, onset))
            made = Records(use, count, leak, law, fault)  # type: ignore[arg-type]
            if any(
                (made.use, made.leak_lpm, made.law, made.fault) == (o.use, o.leak_lpm, o.law, o.fault) for o in found
            ):
                raise table.fail("records must differ from the others in use, leak, law or fault")
            found.append(made)
        return tuple(found)

    def _whole(self, plan: Plan) -> None:
        """What only the plan as a whole can break."""
        from sealscope.campaigns.entries import entry
        from sealscope.evaluation.thresholds import records_needed

        if not any(one.use == "judge" for one in plan.records):
            raise InputError(f"a plan must have records to judge, got none ({self.place})")
        if not any(entry(name).needs_calibration for name in plan.detectors):
            return
        known = sum(one.count for one in plan.records if one.use == "calibrate")
        needed = records_needed(plan.false_alarm, plan.confidence if plan.promise == "bound" else None)
        commands = len(plan.factors.get("command", ("one",)))  # each an operating point, with thresholds of its own
        if known < needed * commands:
            each = f" ({needed} for each of {commands} commands)" if commands > 1 else ""
            raise InputError(
                f"records to calibrate must be at least {needed * commands}{each} for false_alarm = "
                f"{plan.false_alarm:g}, got {known} ({self.place})"
            )
