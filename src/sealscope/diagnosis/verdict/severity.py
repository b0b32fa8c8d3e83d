"""Severity of a leak, over a repair limit and beside the pump's flow, and the state of the machine by NAMUR NE 107.

The tables of states are in `states.toml`: the states, the conditions that lead to them, the causes, and what is to be
done. They hold for a recording and for a watched actuator.

Source: NAMUR NE 107 (2017); its states in OPC UA: OPC 10000-100, DeviceHealthEnumeration, used by OPC 10000-110.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sealscope.diagnosis.priors.verdict import VERDICT
from sealscope.diagnosis.verdict.evidence import LEAK, Evidence, RelativeLeak
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE, ML_PER_MINUTE, MM_PER_MINUTE, parse_quantity

if TYPE_CHECKING:
    from sealscope.diagnosis.verdict.machine_sizes import AssumedMachine

#: Urgency of a repair: the leak is surely over the limit ("repair"), surely far below it ("monitor"), else "plan".
Level = Literal["repair", "plan", "monitor"]
#: A figure with its 95 % interval, (value, low, high); None if the figure is not known.
_Figure = tuple[float, float, float] | None
#: Letter before the power of ten in a number such as 5e-6, which must not be taken for a unit.
_EXPONENT = re.compile(r"(?<=[\d.])[eE](?=[+-]?\d)")


@dataclass(frozen=True)
class RepairLimit:
    """Leak at which a machine must be repaired.

    Attributes
    ----------
    value : float
        A flow [m^3/s], or the speed at which the piston creeps with its lines shut [m/s].
    kind : {"flow", "creep"}
        Whether `value` is a flow or a creep speed.
    stated : bool
        True if the caller gave the limit, False for the default creep speed of `priors.toml`.
    """

    value: float
    kind: Literal["flow", "creep"]
    stated: bool

    @classmethod
    def parse(cls, text: str | None) -> RepairLimit:
        """Parse a repair limit such as "5 mL/min" or "8 mm/min"; None gives the default of `priors.toml`.

        Raises InputError unless the text is a flow or a speed above 0 with its unit.
        """
        if text is None:
            return cls(VERDICT.repair.creep * MM_PER_MINUTE, "creep", stated=False)
        # `parse_quantity` takes a number without a unit as SI, which is refused here; the e of 5e-6 is not a unit
        without_exponent = _EXPONENT.sub("", text) if isinstance(text, str) else ""
        has_unit = any(character.isalpha() for character in without_exponent)
        for kind, unit in (("flow", "m^3/s"), ("creep", "m/s")):
            try:
                value = parse_quantity(text, unit, name="limit")
            except InputError:  # the text has another dimension, or is not a quantity
                continue
            if has_unit and value > 0:
                return cls(value, kind, stated=True)  # type: ignore[arg-type]
        raise InputError(f"limit must be a flow or a speed > 0 with its unit, such as 5 mL/min or 8 mm/min, got {text}")

    def __str__(self) -> str:
        if self.kind == "flow":
            return f"{self.value / ML_PER_MINUTE:.3g} mL/min"
        return f"{self.value / MM_PER_MINUTE:.3g} mm/min of creep"

    def flow_lpm(self, area: float | None) -> float | None:
        """Convert the limit to a flow [L/min]; None for a creep speed if the piston's `area` [m^2] is None."""
        if self.kind == "flow":
            return self.value / LITRE_PER_MINUTE
        return None if area is None else self.value * area / LITRE_PER_MINUTE

    def as_dict(self) -> dict[str, Any]:
        """Return the limit as plain values for JSON, either as a flow or a creep speed; the other one is None."""
        return {
            "mL_per_min": self.value / ML_PER_MINUTE if self.kind == "flow" else None,
            "creep_mm_per_min": self.value / MM_PER_MINUTE if self.kind == "creep" else None,
            "stated": self.stated,
        }


@dataclass(frozen=True)
class Severity:
    """Severity of a leak, as far as it is known.

    Attributes
    ----------
    mL_per_min : tuple of float, or None
        Mean flow while the leak is open [mL/min].
    pump_share : tuple of float, or None
        This flow as a fraction of the pump's mean flow.
    creep_mm_per_min : tuple of float, or None
        Speed at which the piston would creep with its lines shut under the same pressure difference [mm/min].
    of_limit : tuple of float, or None
        The leak divided by the repair limit.

    Each figure is a tuple of value and 95 % interval (value, low, high), or None if it is not known.
    """

    mL_per_min: _Figure
    pump_share: _Figure
    creep_mm_per_min: _Figure
    of_limit: _Figure

    @property
    def level(self) -> Level | None:
        """Urgency of the repair, from the 95 % interval of the leak divided by the repair limit; None if not known.

        "repair": the interval is above 1; "monitor": it is below `repair.watch` of `priors.toml`; else "plan".
        """
        if self.of_limit is None:
            return None
        _, low, high = self.of_limit
        if low > 1.0:
            return "repair"
        return "monitor" if high < VERDICT.repair.watch else "plan"

    def as_dict(self) -> dict[str, Any]:
        """Return the level, each figure and its interval (such as `of_limit_interval`) for JSON; None if unknown."""
        plain: dict[str, Any] = {"level": self.level}
        for name in ("mL_per_min", "pump_share", "creep_mm_per_min", "of_limit"):
            figure = getattr(self, name)
            plain[name] = None if figure is None else figure[0]
            plain[f"{name}_interval"] = None if figure is None else list(figure[1:])
        return plain


def severity(evidence: Evidence, limit: RepairLimit) -> Severity | None:
    """Compute the severity of a leak relative to a repair limit; None without a leak, or if its size is unknown."""
    if evidence.verdict != LEAK or (evidence.leak_lpm is None and evidence.relative is None):
        return None
    relative = evidence.relative or RelativeLeak()
    flow_lpm = evidence.leak_lpm, evidence.leak_interval_lpm  # value and 95 % interval [L/min]
    creep = relative.creep, relative.creep_interval  # value and 95 % interval [m/s]
    if limit.kind == "flow":
        of_limit = _convert_figure(*flow_lpm, factor=LITRE_PER_MINUTE / limit.value)
    else:
        of_limit = _convert_figure(*creep, factor=1.0 / limit.value)
    return Severity(
        mL_per_min=_convert_figure(*flow_lpm, factor=LITRE_PER_MINUTE / ML_PER_MINUTE),
        pump_share=_convert_figure(relative.pump_share, relative.pump_share_interval),
        creep_mm_per_min=_convert_figure(*creep, factor=1.0 / MM_PER_MINUTE),
        of_limit=of_limit,
    )


def relative_leak(evidence: Evidence, recording: Recording, machine: AssumedMachine) -> RelativeLeak | None:
    """Convert a leak in L/min to a fraction of the pump's mean flow and to a creep speed of the piston.

    The flow of the pump follows from its mean speed in the `recording` and the displacement of the `machine`. Returns
    None if the `evidence` states no leak in L/min. The fraction alone is None if the pump stands still, or if neither
    its speed nor its angle is recorded in SI units.
    """
    if evidence.leak_lpm is None or evidence.leak_interval_lpm is None:
        return None
    flows = LITRE_PER_MINUTE * np.array([evidence.leak_lpm, *evidence.leak_interval_lpm])
    creep, *creep_ends = (flows / machine.area).tolist()
    relative = RelativeLeak(creep=creep, creep_interval=tuple(creep_ends))
    pump_flow = _mean_speed(recording) / (2.0 * math.pi) * machine.displacement
    if not pump_flow > 0.0:
        return relative
    share, *share_ends = (flows / pump_flow).tolist()
    return replace(relative, pump_share=share, pump_share_interval=tuple(share_ends))


def _mean_speed(recording: Recording) -> float:
    """Compute the pump's mean absolute speed [rad/s]; 0 if neither speed nor angle is recorded in SI units."""
    if "omega" in recording and recording.units["omega"] == "rad/s":
        return float(np.nanmean(np.abs(recording["omega"])))
    if "theta" in recording and recording.units["theta"] == "rad" and len(recording) > 1:
        return float(np.nanmean(np.abs(np.diff(recording["theta"])))) * recording.rate
    return 0.0


def _convert_figure(value: float | None, interval: tuple[float, float] | None, factor: float = 1.0) -> _Figure:
    """Return `factor` times (value, low, high); None if one of these is unknown or not finite."""
    if value is None or interval is None or not all(math.isfinite(number) for number in (value, *interval)):
        return None
    return factor * value, factor * interval[0], factor * interval[1]


#: Conditions of a machine that leaks past piston or pump. Their state is the same for all causes of the leak.
LEAK_OVER_LIMIT = "leak over the limit"
LEAKING = LEAK, LEAK_OVER_LIMIT


@dataclass(frozen=True, kw_only=True)
class MachineState:
    """State of a machine by NAMUR NE 107, from `states.toml`.

    - `name`, `symbol`: the state, such as "maintenance required", and the letter that NE 107 gives it, such as "M".
    - `health`: number of the state in OPC UA's DeviceHealthEnumeration.
    - `severity`: severity of an OPC UA event for the state, 1 to 1000; 0 for good.
    - `condition`: condition that led to the state, such as "leak" or "no data".
    - `since_s`: time at which the state began, on the clock of the samples [s]; None if unknown.
    - `cause`, `action`: cause of the change, None if no cause is known, and the action to take.
    """

    name: str
    symbol: str
    health: int
    severity: int
    condition: str
    since_s: float | None
    cause: str | None
    action: str

    def as_dict(self) -> dict[str, Any]:
        """Return the fields of the state by name, as plain values for JSON."""
        return {**vars(self)}


@cache
def _tables() -> Mapping[str, Mapping[str, Any]]:
    """Read the tables of `states.toml`, by their names; the result is cached."""
    return tomllib.loads((files("sealscope.diagnosis.verdict") / "states.toml").read_text("utf-8"))


@lru_cache(maxsize=1024)
def state_of(
    condition: str, cause: str | None = None, *, since_s: float | None = None, action: str | None = None
) -> MachineState:
    """Return the state of a machine for a condition of `states.toml`; raise KeyError for an unknown condition.

    State and action are those of the condition or, if `states.toml` lists the `cause` of the change, those of the
    cause; with a leak past piston or pump (`LEAKING`) only the condition gives the state. `since_s`: time at which the
    state began [s]; `action`: replaces that of `states.toml`.
    """
    tables = _tables()
    name = tables["conditions"][condition]["state"]
    if condition not in LEAKING:
        name = tables["causes"].get(cause or "", {}).get("state", name)
    action = action or action_of(condition, cause)
    return MachineState(
        name=name, **tables["states"][name], condition=condition, since_s=since_s, cause=cause, action=action
    )


def find_separation(cause: str) -> str | None:
    """Return the text of `states.toml` that tells how to distinguish a cause from a leak; None if there is no text."""
    text: str | None = _tables()["causes"].get(cause, {}).get("separates")
    return text


@cache
def joint_causes() -> Mapping[str, tuple[str, ...]]:
    """Return groups of causes that some data cannot separate, by the joint name of each group in `states.toml`.

    For example, "external leak or sensor fault" is the joint name of "external leak" and "sensor fault".
    """
    return {name: tuple(row["joins"]) for name, row in _tables()["causes"].items() if "joins" in row}


def action_of(condition: str, cause: str | None = None, parts: Sequence[str] = ()) -> str:
    """Return the action of `states.toml` for the cause of a change; without a listed cause, that for the condition.

    For a leak past piston or pump, the text begins with the checks of `parts`, components whose leakage may be mistaken
    for that of a worn seal, such as "bypass". Raises KeyError for an unknown condition or, with such a leak, part.
    """
    tables = _tables()
    row = tables["causes"].get(cause or "", tables["conditions"][condition])
    action: str = row["action"]
    part_checks = [str(tables["parts"][part]) for part in parts] if condition in LEAKING else []
    return " ".join([*part_checks, action])
