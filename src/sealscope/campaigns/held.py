"""Plan a locked hold: how small a piston leak shows while valves shut the cylinder from its pump.

A cylinder is pressed against a stop and shut in; a leak past its piston brings the pressures together,

    d(p_A - p_B)/dt = -G (1/V_A + 1/V_B) K (p_A - p_B),

with the volumes V of oil of bulk modulus K. Such holds are drawn with the noise of the rig's sensors and judged as
those of a recording (`HeldChambers`), against as many tight ones as a machine is usually commissioned with
(`held_rise`). The smallest leak is the one that is detected in the wanted fraction of the holds.

A hold separates the piston from the pump, which is shut off, and from a rod seal, which lowers one pressure alone.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.circuit.locked_holds import (
    MAX_RATE,
    CylinderSides,
    HeldChambers,
    find_locked_holds,
)
from sealscope.diagnosis.inference.scatter import RecordingSums, held_rise
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.errors import InputError
from sealscope.parameters import Rig
from sealscope.units import LITRE_PER_MINUTE, P_ATM

#: Durations that are tried [s], and the one that is planned if no leak to detect is stated.
HOLD_DURATIONS, DEFAULT_DURATION = (3.0, 10.0, 30.0, 60.0, 120.0), 30.0
#: Number of healthy days that a hold is compared with.
N_HEALTHY = 5
#: Length of the recording before the valves shut [s].
BEFORE = 1.0
#: Number of drawn holds with a leak, and bisections of its conductance.
_N_DRAWS, _N_BISECTIONS = 5, 8
#: Smallest and largest conductance that are tried, by the fraction of p_A - p_B that is gone by the end of the hold.
_TRIED_LOSSES = (1e-4, 10.0)


class PlannedHold(NamedTuple):
    """A locked hold and the smallest leak past the piston that it finds.

    `duration` [s]; absolute pressures of both sides, `pressure_A` and `pressure_B` [Pa]; `conductance` of the smallest
    leak [m^3/(s Pa)].
    """

    duration: float
    pressure_A: float
    pressure_B: float
    conductance: float

    @property
    def difference(self) -> float:
        """Pressure difference across the piston [Pa]."""
        return self.pressure_A - self.pressure_B

    def as_dict(self) -> dict[str, Any]:
        """Convert the hold to plain JSON values, with the leak as a flow [L/min] at the pressures of the hold."""
        return {
            "duration_s": self.duration,
            "pressure_A_Pa": self.pressure_A,
            "pressure_B_Pa": self.pressure_B,
            "smallest_leak_lpm": self.conductance * self.difference / LITRE_PER_MINUTE,
            "separates": "piston from pump and rod seals",
            "healthy_days": N_HEALTHY,
        }

    def text(self, stated_pressure: float) -> str:
        """Format the hold as lines of text, with flows at the pressure difference `stated_pressure` [Pa]."""
        flow = self.conductance * stated_pressure / LITRE_PER_MINUTE
        high, low = self.pressure_A / 1e6, self.pressure_B / 1e6
        return (
            "  or a locked hold: press it against a stop, shut the valves, stop the motor; "
            f"{self.duration:g} s from {high:.2g} and {low:.2g} MPa\n"
            f"    finds {flow:.2g} L/min by the noise of its sensors, against {N_HEALTHY} healthy days; it "
            "separates piston from pump and rod seals"
        )


def has_shut_off(rig: Rig) -> bool:
    """Return True if a rig states valves that shut the cylinder from its pump."""
    sources = [rig.entry(name).source for name in ("line.open_A", "line.open_B")]
    return rig.line.orifices == "present" and not any(source.startswith(("absent", "assumed")) for source in sources)


def plan_hold(
    rig: Rig, load: float, flow: float, find: float | None = None, *, false_alarm: float = 0.01, detection: float = 0.9
) -> PlannedHold:
    """Find the shortest locked hold under a load [N] that detects a leak of the conductance `find` [m^3/(s Pa)].

    Plans the longest of `HOLD_DURATIONS` if none detects it, and a hold of `DEFAULT_DURATION` if `find` is None.
    `flow`: mean flow of the pump under the usual duty [m^3/s]; `false_alarm`, `detection`: probabilities of the verdict
    `leak` without a leak, and with it. Raises InputError unless the load is > 0.
    """
    if not load > 0.0:
        raise InputError(f"a locked hold must be under a load > 0 N, got {load:g} N")
    holds = [_HoldDraws(rig, load, flow, seconds, false_alarm, detection) for seconds in HOLD_DURATIONS]
    if find is None:
        return holds[HOLD_DURATIONS.index(DEFAULT_DURATION)].with_smallest_leak()
    return next((hold for hold in holds[:-1] if hold.detects(find)), holds[-1]).with_smallest_leak()


class _HoldDraws:
    """Simulations of holds of one `duration` [s], to find their smallest detectable leak.

    Other arguments as for `plan_hold`.
    """

    def __init__(
        self, rig: Rig, load: float, flow: float, duration: float, false_alarm: float, detection: float
    ) -> None:
        """Plan the hold, and set the limits on false alarms and missed leaks.

        Side B is at the charge pressure, side A above it by the load.
        """
        pressure_B = rig.fluid.p_charge + P_ATM
        self._rig, self._flow = rig, flow
        self._hold = PlannedHold(duration, pressure_B + load / rig.cylinder.A_A, pressure_B, np.inf)
        # the rest of the probability is reserved for a step within a recording
        self._max_false_alarm = false_alarm * (1.0 - DECISION.questions.within)
        self._max_missed = _N_DRAWS - detection * _N_DRAWS

    @cached_property
    def _healthy(self) -> list[RecordingSums]:
        """The sums of `N_HEALTHY` holds without a leak."""
        return [draw_hold(self._rig, self._hold, 0.0, self._flow, seed) for seed in range(N_HEALTHY)]

    def detects(self, conductance: float) -> bool:
        """Return True if a leak of this conductance [m^3/(s Pa)] is found in the wanted fraction of simulated holds."""
        n_missed = 0
        for seed in range(N_HEALTHY, N_HEALTHY + _N_DRAWS):
            rise = held_rise(draw_hold(self._rig, self._hold, conductance, self._flow, seed), self._healthy)
            n_missed += rise is None or not rise.chance < self._max_false_alarm
            if n_missed > self._max_missed:  # further draws cannot change the answer
                return False
        return True

    def with_smallest_leak(self) -> PlannedHold:
        """Bisect for the smallest conductance that the hold detects; return the hold with it, or with inf for none."""
        loss_per_conductance = _decay_per_conductance(self._rig) * self._hold.duration
        low, high = np.log(np.array(_TRIED_LOSSES) / loss_per_conductance)  # logarithms of conductances
        if not self.detects(float(np.exp(high))):
            return self._hold
        for _ in range(_N_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.detects(float(np.exp(middle))) else (middle, high)
        return self._hold._replace(conductance=float(np.exp(high)))


def _decay_per_conductance(rig: Rig) -> float:
    """Compute the rate at which p_A - p_B decays per unit of conductance [Pa/m^3], for a cylinder at mid-stroke."""
    oil, cylinder = INFERENCE.held_oil, rig.cylinder
    length = cylinder.L * (0.5 + oil.dead)
    return float((1.0 / cylinder.A_A + 1.0 / cylinder.A_B) / (length * oil.compressibility))


def draw_hold(rig: Rig, hold: PlannedHold, conductance: float, flow: float, seed: int) -> RecordingSums:
    """Simulate a hold with a leak past the piston and sensor noise; return its sums as those of a recording.

    `conductance` [m^3/(s Pa)]; `flow`: mean flow of the pump under the usual duty [m^3/s].
    """
    random, cylinder, sensors = np.random.default_rng(seed), rig.cylinder, rig.sensors
    t = np.arange(round((BEFORE + hold.duration) * MAX_RATE)) / MAX_RATE
    loss = hold.difference * -np.expm1(-conductance * _decay_per_conductance(rig) * np.maximum(t - BEFORE, 0.0))
    fraction_A = cylinder.A_B / (cylinder.A_A + cylinder.A_B)  # of the loss, inversely to the volumes
    p_A, p_B = (
        pressure + np.hypot(sensor.noise, sensors.common_noise) * random.standard_normal(t.size)
        for pressure, sensor in (
            (hold.pressure_A - fraction_A * loss, sensors.p_A),
            (hold.pressure_B + (1.0 - fraction_A) * loss, sensors.p_B),
        )
    )
    x = sensors.x.noise * random.standard_normal(t.size)
    sides = CylinderSides(cylinder.A_A, cylinder.A_B, -0.5 * cylinder.L, 0.5 * cylinder.L)
    locked_holds = find_locked_holds((t, p_A, p_B, x), t[1:] >= BEFORE, MAX_RATE)
    chambers = HeldChambers(locked_holds, sides, float(t[0]), float(t[-1]), hold.pressure_B)
    return RecordingSums(np.zeros((1, 1, 1)), flow, hold.difference, held=np.array(chambers.leaks))
