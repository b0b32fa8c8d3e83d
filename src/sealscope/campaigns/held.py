"""Plan a locked hold: the smallest piston leak that is found while valves shut the cylinder off from its pump.

The cylinder is pressed against a stop and its valves are shut. A leak past the piston then equalises the pressures,

    d(p_A - p_B)/dt = -G (1/V_A + 1/V_B) K (p_A - p_B),

with the leak's conductance G, the chambers' volumes V_A and V_B, and the bulk modulus K of the oil. Such holds are
simulated with the noise of the rig's sensors and judged like the holds of a recording (`HeldChambers`, `held_rise`), by
comparison with `N_HEALTHY` leak-free holds. A hold tells a piston leak from a leak of the pump, which is shut off, and
from a leak of a rod seal, which lowers one pressure only.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.circuit.holds.chambers import HeldChambers
from sealscope.diagnosis.inference.circuit.holds.hold import MAX_RATE, find_locked_holds
from sealscope.diagnosis.inference.circuit.holds.oil import CylinderSides
from sealscope.diagnosis.inference.comparison.levels import held_rise
from sealscope.diagnosis.inference.comparison.recording_sums import RecordingSums
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.units import LITRE_PER_MINUTE, P_ATM

_FALSE_ALARM: float = DECISION.false_alarm.probability
#: Durations that are tried [s], and the duration that is planned if no leak to detect is stated.
HOLD_DURATIONS, DEFAULT_DURATION = (3.0, 10.0, 30.0, 60.0, 120.0), 30.0
#: Number of healthy days, with a hold each, with which a hold is compared.
N_HEALTHY = 5
#: Length of the recording before the valves shut [s].
BEFORE = 1.0
#: Number of simulated holds with a leak, and of bisections of the leak's conductance.
_N_DRAWS, _N_BISECTIONS = 5, 8
#: Smallest and largest leak that are tried, given as the natural logarithm of the factor by which p_A - p_B falls in
#: the hold. It is the leak's conductance times `_decay_rate_per_conductance` times the duration.
_TRIED_DECAYS = (1e-4, 10.0)


def leak_flow_lpm(conductance: float, pressure: float) -> float | None:
    """Convert a leak's conductance [m^3/(s Pa)] to its flow [L/min] at a pressure difference [Pa]; None for inf."""
    return conductance * pressure / LITRE_PER_MINUTE if np.isfinite(conductance) else None


class PlannedHold(NamedTuple):
    """A locked hold, in which valves shut the cylinder off from its pump, and the smallest piston leak that it finds.

    `duration` [s]: time with shut valves; `pressure_A`, `pressure_B` [Pa]: absolute pressures when the valves shut;
    `conductance` [m^3/(s Pa)]: that of the smallest leak, inf if no leak is found.
    """

    duration: float
    pressure_A: float
    pressure_B: float
    conductance: float = np.inf

    @property
    def difference(self) -> float:
        """Pressure difference across the piston at the beginning of the hold [Pa]."""
        return self.pressure_A - self.pressure_B

    def as_dict(self) -> dict[str, Any]:
        """Convert the hold to plain JSON values; the smallest leak is a flow [L/min] at the initial p_A - p_B."""
        return {
            "duration_s": self.duration,
            "pressure_A_Pa": self.pressure_A,
            "pressure_B_Pa": self.pressure_B,
            "smallest_leak_lpm": leak_flow_lpm(self.conductance, self.difference),
            "separates": "piston from pump and rod seals",
            "healthy_days": N_HEALTHY,
        }

    def text(self, stated_pressure: float) -> str:
        """Format the planned hold as text, with the smallest leak's flow at the difference `stated_pressure` [Pa]."""
        flow = leak_flow_lpm(self.conductance, stated_pressure)
        found = "no leak, however large" if flow is None else f"{flow:.2g} L/min"
        high, low = self.pressure_A / 1e6, self.pressure_B / 1e6
        return (
            "  or a locked hold: press the piston against a stop, shut the valves, stop the motor; "
            f"{self.duration:g} s from {high:.2g} and {low:.2g} MPa\n"
            f"    finds {found}, limited by the sensors' noise, against {N_HEALTHY} healthy days; it "
            "separates piston from pump and rod seals"
        )


def has_shut_off(rig: Rig) -> bool:
    """Return True if a rig has shut-off valves between cylinder and pump, whose openings are stated, not assumed."""
    sources = [rig.entry(name).source for name in ("line.open_A", "line.open_B")]
    return rig.line.orifices == "present" and not any(source.startswith(("absent", "assumed")) for source in sources)


def plan_hold(
    rig: Rig,
    load: float,
    flow: float,
    find: float | None = None,
    *,
    false_alarm: float = _FALSE_ALARM,
    detection: float = 0.9,
) -> PlannedHold:
    """Find the shortest locked hold under a load [N] that detects a leak of the conductance `find` [m^3/(s Pa)].

    If no duration in `HOLD_DURATIONS` suffices, the longest is planned. If `find` is None, the hold lasts
    `DEFAULT_DURATION`. `flow` [m^3/s]: mean flow of the pump under the usual duty, to which the assumed scatter of a
    healthy machine's leakage is proportional; `false_alarm`, `detection`: probability of the verdict `leak` without and
    with a leak. Raises InputError if the load is not > 0.
    """
    if not load > 0.0:
        raise InputError(f"a locked hold must be under a load > 0 N, got {load:g} N")
    holds = [_HoldDraws(rig, load, flow, seconds, false_alarm, detection) for seconds in HOLD_DURATIONS]
    if find is None:
        return holds[HOLD_DURATIONS.index(DEFAULT_DURATION)].with_smallest_leak()
    return next((hold for hold in holds[:-1] if hold.detects(find)), holds[-1]).with_smallest_leak()


class _HoldDraws:
    """Simulated locked holds of one duration, which show the smallest leak that such holds detect."""

    def __init__(
        self, rig: Rig, load: float, flow: float, duration: float, false_alarm: float, detection: float
    ) -> None:
        """Prepare holds that begin with chamber B at the charge pressure, and chamber A higher by load / A_A.

        The arguments are those of `plan_hold`; `duration` [s]: time with shut valves.
        """
        self._rig, self._flow = rig, flow
        pressure_B = rig.fluid.p_charge + P_ATM  # absolute
        pressure_A = pressure_B + load / rig.cylinder.A_A
        self._hold = PlannedHold(duration, pressure_A, pressure_B)
        # the fraction `within` of the probability is reserved for the test for a step within a recording
        self._max_false_alarm = false_alarm * (1.0 - DECISION.questions.within)
        self._max_missed = _N_DRAWS - detection * _N_DRAWS

    @cached_property
    def _healthy(self) -> list[RecordingSums]:
        """Summaries of `N_HEALTHY` simulated holds without a leak, to compare leaky holds with."""
        return [draw_hold(self._rig, self._hold, conductance=0.0, flow=self._flow, seed=k) for k in range(N_HEALTHY)]

    def detects(self, conductance: float) -> bool:
        """Return True if at least the fraction `detection` of `_N_DRAWS` simulated holds detects a leak.

        A hold detects it if a leak-free hold would leak as much with less than the allowed false-alarm probability, as
        estimated from the healthy holds. `conductance` [m^3/(s Pa)]: that of the leak.
        """
        n_missed = 0
        for seed in range(N_HEALTHY, N_HEALTHY + _N_DRAWS):  # the healthy holds have the seeds before
            rise = held_rise(draw_hold(self._rig, self._hold, conductance, self._flow, seed), self._healthy)
            n_missed += rise is None or not rise.chance < self._max_false_alarm  # `not <`: a chance of NaN is a miss
            if n_missed > self._max_missed:  # further draws cannot change the answer
                return False
        return True

    def with_smallest_leak(self) -> PlannedHold:
        """Find by bisection the smallest leak that the hold detects; return the hold with the leak's conductance.

        The conductance is inf if even the largest leak that is tried (`_TRIED_DECAYS`) is not detected.
        """
        decay_per_conductance = _decay_rate_per_conductance(self._rig) * self._hold.duration
        low, high = np.log(np.array(_TRIED_DECAYS) / decay_per_conductance)  # logarithms of conductances
        if not self.detects(float(np.exp(high))):
            return self._hold
        for _ in range(_N_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.detects(float(np.exp(middle))) else (middle, high)
        return self._hold._replace(conductance=float(np.exp(high)))


def _decay_rate_per_conductance(rig: Rig) -> float:
    """Compute the decay rate of p_A - p_B [1/s] per unit of leak conductance, in Pa/m^3, for a piston at mid-stroke.

    It is K (1/V_A + 1/V_B), with the oil's usual bulk modulus K and the chambers' volumes V, dead volume included.
    """
    oil, cylinder = INFERENCE.held_oil, rig.cylinder
    length = cylinder.L * (0.5 + oil.dead)  # half the stroke, and the length of a chamber's dead volume
    return float((1.0 / cylinder.A_A + 1.0 / cylinder.A_B) / (length * oil.compressibility))


def draw_hold(rig: Rig, hold: PlannedHold, conductance: float, flow: float, seed: int) -> RecordingSums:
    """Simulate a locked hold with a leak past the piston and with sensor noise, and estimate the leak from it.

    `hold`: duration and initial pressures; `conductance` [m^3/(s Pa)]: that of the leak; `flow` [m^3/s]: mean flow of
    the pump under the usual duty. Returns the summary of a recording with this hold.
    """
    random = np.random.default_rng(seed)
    cylinder, sensors = rig.cylinder, rig.sensors
    t = np.arange(round((BEFORE + hold.duration) * MAX_RATE)) / MAX_RATE
    # p_A - p_B falls exponentially once the valves are shut, at the time `BEFORE`; expm1: exp - 1
    decay_rate = conductance * _decay_rate_per_conductance(rig)
    loss = hold.difference * -np.expm1(-decay_rate * np.maximum(t - BEFORE, 0.0))
    # pressure changes are inverse to the volumes, which at mid-stroke are proportional to the areas
    fraction_A = cylinder.A_B / (cylinder.A_A + cylinder.A_B)
    p_A, p_B = (
        pressure + np.hypot(sensor.noise, sensors.common_noise) * random.standard_normal(t.size)
        for pressure, sensor in (
            (hold.pressure_A - fraction_A * loss, sensors.p_A),
            (hold.pressure_B + (1.0 - fraction_A) * loss, sensors.p_B),
        )
    )
    x = sensors.x.noise * random.standard_normal(t.size)
    sides = CylinderSides(cylinder.A_A, cylinder.A_B, low=-0.5 * cylinder.L, high=0.5 * cylinder.L)
    locked_holds = find_locked_holds((t, p_A, p_B, x), rests=t[1:] >= BEFORE, rate=MAX_RATE)  # intervals at rest
    chambers = HeldChambers(locked_holds, sides, begin=float(t[0]), end=float(t[-1]), charge=hold.pressure_B)
    held = np.array(chambers.leaks)
    # no Gram matrix of the volume balance: the piston does not move
    return RecordingSums(sums=np.zeros((1, 1, 1)), flow=flow, pressure=hold.difference, held=held)
