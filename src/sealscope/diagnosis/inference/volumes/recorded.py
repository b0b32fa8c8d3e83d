"""A recording's balance with all that is asked of it, and what sizes its flows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.balance import still_rate
from sealscope.diagnosis.inference.blocks import Blocks, Columns, information, mean_of, solve, zero_of
from sealscope.diagnosis.inference.changes.volumes import volume_observables
from sealscope.diagnosis.inference.circuit.locked_holds import CylinderSides, HeldChambers, find_locked_holds
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.onset import WITHIN_95, Course, Information, Interval, StepTest, course, step_test
from sealscope.diagnosis.inference.scatter import RecordingSums
from sealscope.diagnosis.inference.terms import LAG, LEAST_ABSOLUTE, PUMP, Equation, Signals, find_rests
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import RAREST
from sealscope.diagnosis.verdict.machine import measures_flow
from sealscope.recordings.channels import COUNTS, flow_source
from sealscope.recordings.joining import start_seconds
from sealscope.recordings.oil import oil_temperature
from sealscope.recordings.recording import Array, Recording
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Share of samples below which a pressure is that of the charge, and beyond which a position is an end of the stroke.
CHARGED = 0.02


class Size(NamedTuple):
    """Scale from a flow by the assumed displacement to that of the machine.

    `scale`, its relative `deviation`; `stated`: whether L/min can be stated at all; `ratio`: displacement over area as
    measured, over the assumed one, with its interval, None where the position has no unit; `area` of the piston by the
    assumed displacement [m^2].
    """

    scale: float
    deviation: float
    stated: bool
    ratio: Interval | None
    area: float | None
    disagrees: bool = False


@dataclass(frozen=True, eq=False)
class RecordedBalance:
    """A recording's blocks with all that is asked of them.

    `lost`: tests of a step of what leaves the circuit by the accumulator's own balance, by the term's name; `plain`:
    the blocks with the zero of p_A - p_B as recorded, where they are others; `shut`: a valve cuts the pump off at rest,
    so that the leak's coefficient is the piston's alone (`regimes`).
    """

    blocks: Blocks
    equations: tuple[Equation, ...]
    columns: tuple[Columns, ...]
    rig: Rig
    recording: Recording
    lost: Mapping[str, StepTest] = field(default_factory=dict)
    plain: Blocks | None = None
    shut: bool = False

    @property
    def units(self) -> frozenset[tuple[str, str]]:
        """Channels with their units."""
        return frozenset(self.recording.units.items())

    @cached_property
    def leak(self) -> Information:
        """Likelihood of the leak's coefficient in the blocks."""
        return information(self.blocks, self.columns, self.columns[0].leak)

    @cached_property
    def test(self) -> StepTest | None:
        """Test of a step of the leak's coefficient."""
        return step_test(self.leak)

    @cached_property
    def observables(self) -> tuple[Observable, ...]:
        """Steps of all terms' coefficients, the most likely first."""
        return volume_observables(self.blocks, self.plain or self.blocks, self.equations, self.columns, self.lost)

    @cached_property
    def recording_sums(self) -> RecordingSums:
        """Sums of the recording, for comparison with other recordings."""
        dated, oil = start_seconds(self.recording), oil_temperature(self.recording)
        sums = RecordingSums.from_blocks(self.blocks, self.columns, dated, oil)
        return sums if self.chambers is None else sums._replace(held=np.array(self.chambers.leaks))

    @cached_property
    def chambers(self) -> HeldChambers | None:
        """The chambers while valves shut them from a resting pump; None where they do not, or too little is held."""
        sides = self._sides() if self.shut and self.recording.units["p_A"] != COUNTS else None
        if sides is None:
            return None
        recording, balance = self.recording, self.equations[0]
        pressures = {name: recording[name] for name in ("p_A", "p_B")}
        left = balance.left(Signals(dict(recording.channels), recording.rate, {}))
        rests = find_rests(left, recording.rate, still_rate(left, recording.rate))
        lowest = np.minimum(pressures["p_A"], pressures["p_B"])
        least = float(np.nanquantile(lowest, CHARGED))
        to_absolute = max(P_ATM, LEAST_ABSOLUTE - float(np.nanmin(lowest)))
        channels = (recording.t, *(values + to_absolute for values in pressures.values()), recording["x"])
        holds = find_locked_holds(channels, rests, recording.rate)
        ends = float(recording.t[0]), float(recording.t[-1])
        return HeldChambers(holds, sides, *ends, least + to_absolute) if holds else None

    def _sides(self) -> CylinderSides | None:
        """Return the areas of both sides, with the sign of x, and the recorded stroke; None where motion shows none."""
        column, total = self.columns[0], self.blocks.gram[:, 0].sum(axis=0)
        chosen = list(column.nuisance)
        found = dict(zip(chosen, solve(total[np.ix_(chosen, chosen)], total[chosen, column.left]), strict=True))
        areas, energies = [], []
        for side in "AB":
            motion = [k for k in column.motion if column.names[k].endswith(f"{side} carries")]
            energy = np.diag(total)[motion]
            energies.append(float(energy.sum()))
            areas.append(float(energy @ [found[k] for k in motion]) / max(energies[-1], np.finfo(float).tiny))
        main = int(np.argmax(energies))
        if self.rig.states("cylinder.A_A", "cylinder.A_B") and self.size.stated:
            sign = np.sign(areas[main])
            areas = [sign * area / self.size.scale for area in (self.rig.cylinder.A_A, self.rig.cylinder.A_B)]
        if areas[0] * areas[1] <= 0.0:  # the other side never carries
            areas[1 - main] = areas[main]
        x = self.recording["x"][np.isfinite(self.recording["x"])]
        low, high = (float(end) for end in np.quantile(x, (CHARGED, 1.0 - CHARGED))) if x.size else (0.0, 0.0)
        unlike: float = priors("inference")["held_oil"]["unlike"]
        if not (areas[main] and high > low and 1.0 / unlike < areas[0] / areas[1] < unlike):
            return None
        return CylinderSides(areas[0], areas[1], low, high)

    @cached_property
    def zero(self) -> float:
        """Zero of p_A - p_B [Pa], as a change of the leak shows it."""
        return zero_of(self.blocks, self.columns)

    @cached_property
    def delay(self) -> tuple[float, float] | None:
        """Delay of x behind the flow [s], by the share of its lag in the motion, with its deviation."""
        column = self.columns[0]
        motion = [k for k in column.motion if column.names[k].startswith("motion")]
        if LAG not in column.names or not motion:
            return None
        area = _area(self, motion).measured
        value, deviation = mean_of(self.blocks, column, {column.names.index(LAG): 1.0})
        return (value / area, deviation / area) if area > 0.0 else None

    def mean_pressure(self, since: float = -np.inf) -> float:
        """Return the mean size of p_A - p_B about its zero [Pa], over the blocks whose middle is `since` or later."""
        return self.mean_of_blocks(self.blocks.driving(self.zero), since)

    @cached_property
    def mean_flow(self) -> float:
        """Mean size of the pump's flow [m^3/s]."""
        return self.mean_of_blocks(self.blocks.flow)

    def mean_of_blocks(self, values: Array, since: float = -np.inf) -> float:
        """Return the mean of a value of each block (K,), over the blocks whose middle is `since` or later."""
        chosen = self.blocks.time >= since
        if not chosen.any():
            chosen[-1] = True
        return float(np.average(values[chosen], weights=np.maximum(self.blocks.rows[chosen], 1e-9)))

    @cached_property
    def moving(self) -> float:
        """Mean flow while it flows [m^3/s]: the mean weighted by itself, so that standstills do not count."""
        flow = self.blocks.flow
        return float(flow @ flow / max(float(flow.sum()), np.finfo(float).tiny))

    @cached_property
    def size(self) -> Size:
        """Scale from a flow by the assumed displacement to that of the machine."""
        return _size(self)

    @cached_property
    def level(self) -> Interval:
        """Total leakage of pump and piston over the recording, as a conductance with its interval.

        The pressures at the pump's ports hardly differ from those of the chambers: the sum is known, its parts are not.
        """
        weights = np.maximum(self.blocks.rows, 0.0)
        return self.total_course.over(weights / weights.sum())

    @cached_property
    def total_course(self) -> Course:
        """Total leakage of pump and piston over the blocks, as a conductance."""
        column = self.columns[0]
        pump = column.names.index(PUMP) if PUMP in column.names else None
        both = information(self.blocks, self.columns, column.leak, pump)
        test = step_test(both)
        return course(both, test, step=test is not None and test.chance < RAREST)

    def course(self, step: bool) -> Course:
        """Return the leak's coefficient over the blocks."""
        return course(self.leak, self.test, step)


def _size(balance: RecordedBalance) -> Size:
    """Weigh what is stated of displacement and area against each other.

    A flow meter sizes flows by itself. Else the balance measures their ratio: a stated displacement sizes every flow
    directly, a stated area by that ratio; where both are stated and disagree the flow lies between what either says.
    """
    column, rig, meter = balance.columns[0], balance.rig, measures_flow(balance.recording.units)
    believed = priors("inference")["size"]
    source = flow_source(balance.recording.channels)  # a meter's unit follows from the area
    with_unit = source == "q_pump" or (source, "count") not in balance.units
    pressures = not {("p_A", "count"), ("p_B", "count")} & balance.units
    states_displacement = rig.states("pump.q_b") and with_unit
    if len(balance.columns) > 1:  # behind a valve the area sizes the flow
        return Size(1.0, believed["area"], rig.states("cylinder.A_A", "cylinder.A_B") and pressures, None, None)
    motion = [k for k in column.motion if column.names[k].startswith("motion")]
    area = _area(balance, motion) if motion and ("x", "m") in balance.units else None
    if area is None or not area.measured > 0.0 or not with_unit:
        known = believed["meter" if meter else "displacement"]
        return Size(1.0, known, (meter or states_displacement) and pressures, None, None)
    if meter:
        return Size(1.0, believed["meter"], pressures, None, area.measured)
    ratio = Interval(*(area.assumed / end for end in (area.measured, area.high, max(area.low, 1e-12))))
    disagreement = abs(1.0 / ratio.value - 1.0)
    known = float(np.hypot(believed["displacement"], believed["area"]))
    if states_displacement:
        disagrees = rig.states("cylinder.A_A", "cylinder.A_B") and disagreement > WITHIN_95 * known
        deviation = disagreement if disagrees else believed["displacement"]
        return Size(1.0, deviation, pressures, ratio, area.measured, disagrees)
    if rig.states("cylinder.A_A", "cylinder.A_B"):
        return Size(ratio.value, believed["area"], pressures, ratio, area.measured)
    return Size(1.0, known, False, ratio, area.measured)


class _Area(NamedTuple):
    """The area of the side that carries [m^2]: `measured` by the assumed displacement, with its interval; `assumed`."""

    measured: float
    low: float
    high: float
    assumed: float


def _area(balance: RecordedBalance, motion: list[int]) -> _Area:
    """Return the area of the side that carries, the mean of both ways and sides in the proportion that they occur."""
    column, cylinder = balance.columns[0], balance.rig.cylinder
    energy = np.einsum("kii->i", balance.blocks.gram[:, 0])[motion]
    shares = energy / max(float(energy.sum()), np.finfo(float).tiny)
    value, deviation = mean_of(balance.blocks, column, dict(zip(motion, shares, strict=True)))
    value, half = abs(value), WITHIN_95 * deviation
    stated = [cylinder.A_A if column.names[k].endswith("A carries") else cylinder.A_B for k in motion]
    return _Area(value, value - half, value + half, float(shares @ stated))
