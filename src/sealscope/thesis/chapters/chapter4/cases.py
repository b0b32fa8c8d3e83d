"""The twelve cases of Tables 4.2 and 4.3, the readings of the equations, and each case run as the thesis ran it and
converged."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sealscope.recordings.recording import Array
from sealscope.thesis.engine.context import Context, RunSpec, SimulatedRun

#: Step [s] of the thesis's own Runge-Kutta method (section 4.1.1).
THESIS_STEP = 1e-4
#: Duration [s] of a run, and the whole periods of both commands in it that numbers are taken from.
DURATION = 6.5
STEADY = (math.pi, 2.0 * math.pi)
WINDOW = "from pi to 2 pi s of a run from rest"
#: Every third step of 1e-4 s: a solution that alternates from step to step is met at both its values, which
#: sampling every 2nd, 4th or 20th step would hide.
SAMPLE_RATE = 1.0 / (3.0 * THESIS_STEP)
#: Pressure difference [Pa] below which a throttle is taken as laminar. Eqs. (4.9)-(4.12) have no such limit; 1 Pa is
#: far below every drop, and above zero, so that the equations can be solved at all.
DP_0 = 1.0


@dataclass(frozen=True)
class Case:
    """A row of Table 4.2 or 4.3: `name` such as "4.3-f", `closed_pct` [%] of both throttles, None without them."""

    name: str
    command: str
    closed_pct: float | None

    @property
    def title(self) -> str:
        """Command and throttles in words."""
        return f"{self.command}, " + ("no orifice" if self.closed_pct is None else f"{self.closed_pct:g} % closed")


COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)")
CLOSINGS = (25.0, 50.0, 75.0)
CASES: dict[str, Case] = {
    case.name: case
    for case in (
        *(Case(f"4.2-{letter}", command, None) for letter, command in zip("abc", COMMANDS, strict=True)),
        *(
            Case(f"4.3-{letter}", command, closed)
            for letter, (closed, command) in zip(
                "abcdefghi", ((closed, command) for closed in CLOSINGS for command in COMMANDS), strict=True
            )
        ),
    )
}


Metering = Literal["meter-out", "literal"]
Meaning = Literal["area", "diameter"]
METERINGS: tuple[Metering, ...] = ("meter-out", "literal")
MEANINGS: tuple[Meaning, ...] = ("area", "diameter")


@dataclass(frozen=True)
class Reading:
    """How the throttles' equations are read where the thesis contradicts itself or is silent.

    `metering` "meter-out" (the text: throttled return on both sides) or "literal" (eqs. 4.11, 4.12 as printed);
    `closed_means` "area" (eq. 4.8) or "diameter" (the text's 3.75 mm of 5 mm); `d_line_mm` 7 (Table 4.1) or 5 (the
    text); `V_line_cm3` V_1 = V_2, not given.
    """

    metering: Metering = "meter-out"
    closed_means: Meaning = "area"
    d_line_mm: float = 7.0
    V_line_cm3: float = 44.0

    @property
    def title(self) -> str:
        """The reading in a few words."""
        metering = "as printed" if self.metering == "literal" else "meter-out"
        text = f"{metering}, closed by {self.closed_means}, {self.d_line_mm:g} mm"
        return text if self.V_line_cm3 == Reading.V_line_cm3 else f"{text}, V_1 = {self.V_line_cm3:g} cm3"

    def values(self, closed_pct: float | None) -> tuple[tuple[str, str | float], ...]:
        """The rig's parameters by name for throttles closed by `closed_pct` [%] (0: open in the line; None: absent)."""
        sampling: tuple[tuple[str, str | float], ...] = (("daq.sample_rate", SAMPLE_RATE),)
        if closed_pct is None:
            return sampling
        opened = replace(self, metering="meter-out", closed_means="area") if closed_pct == 0 else self  # all the same
        return (
            *sampling,
            ("line.orifices", "present"),
            ("line.closed_A", closed_pct / 100.0),
            ("line.closed_B", closed_pct / 100.0),
            ("line.metering", opened.metering),
            ("line.closed_means", opened.closed_means),
            ("line.d_line", self.d_line_mm * 1e-3),
            ("line.V_1", self.V_line_cm3 * 1e-6),
            ("line.V_2", self.V_line_cm3 * 1e-6),
            ("line.dp_0", DP_0),
        )


OURS = Reading()
#: The reading that takes eqs. (4.11), (4.12) and the text's "3.75 mm of 5 mm" at their word.
AS_PRINTED = Reading(metering="literal", closed_means="diameter", d_line_mm=5.0)
#: Both readings of "closed", both areas of eqs. (4.11), (4.12), both line diameters.
READINGS: tuple[Reading, ...] = tuple(
    Reading(metering, closed_means, d_line)
    for metering in METERINGS
    for closed_means in MEANINGS
    for d_line in (7.0, 5.0)
)


@dataclass(frozen=True, eq=False)
class Pair:
    """One case run twice: with the thesis's method and step, and converged. The equations are the same in both."""

    literal: SimulatedRun
    converged: SimulatedRun

    @property
    def resolved(self) -> bool:
        """Whether both passed the halving test."""
        return bool(self.literal.resolved and self.converged.resolved)

    def runs(self) -> tuple[tuple[Literal["literal", "converged"], str, SimulatedRun], ...]:
        """Role, label and run of those that did not diverge."""
        both: tuple[tuple[Literal["literal", "converged"], str, SimulatedRun], ...] = (
            ("literal", "RK4, 1e-4 s", self.literal),
            ("converged", "converged", self.converged),
        )
        return tuple(one for one in both if not one[2].diverged)


def spec(command: str, closed_pct: float | None, reading: Reading = OURS) -> RunSpec:
    """The converged run of a command with throttles closed by `closed_pct` [%] (None: absent)."""
    return RunSpec(command=command, duration=DURATION, values=reading.values(closed_pct), prove=True)


def literal(converged: RunSpec) -> RunSpec:
    """The same run with the thesis's method and step."""
    return replace(converged, method="rk4", step=THESIS_STEP)


def pair(context: Context, case: Case, reading: Reading = OURS) -> Pair:
    """A case as the thesis ran it, and converged."""
    converged = spec(case.command, case.closed_pct, reading)
    return Pair(context.run(literal(converged)), context.run(converged))


def steady(run: SimulatedRun) -> np.ndarray:
    """Which samples lie in the whole periods that numbers are taken from, (n,) truth values."""
    return np.asarray((run.t >= STEADY[0]) & (run.t < STEADY[1]))


def settled(run: SimulatedRun, name: str) -> Array:
    """The output `name` over those whole periods."""
    return np.asarray(run.outputs[name][steady(run)])


def span(run: SimulatedRun, name: str) -> float:
    """Range (greatest less least) of an output over the whole periods; nan where the run diverged."""
    return math.nan if run.diverged else float(np.ptp(settled(run, name)))


def mean_difference(run: SimulatedRun, one: str, other: str) -> float:
    """Mean of one output less another over the whole periods; nan where the run diverged."""
    return math.nan if run.diverged else float(np.mean(settled(run, one) - settled(run, other)))


def visible_pressure() -> float:
    """The least difference of pressures [Pa] that a transducer of the rig shows: its noise (standard deviation)."""
    from sealscope.parameters import load_rig

    sensors = load_rig("thesis").sensors
    return math.hypot(sensors.p_A.noise, sensors.common_noise)
