"""The twelve cases of Tables 4.2 and 4.3, the readings of the equations, and the numbers behind the claims.

A case is run with the thesis's own method and step ("literal") and converged; the equations are the same in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import Literal

import numpy as np

from sealscope.parameters import load_rig
from sealscope.recordings.chambers import PRESSURES
from sealscope.recordings.recording import Array
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.engine.context import Context, SimulatedRun

Solver = Literal["converged", "literal"]
SOLVERS: tuple[Solver, ...] = ("converged", "literal")
SOLVER_TEXT: dict[Solver, str] = {"converged": "converged", "literal": "RK4 1e-4 s"}
#: The solvers in the legend of a figure, in the order of drawing.
LABELS: dict[Solver, str] = {"literal": "RK4, 1e-4 s", "converged": "converged"}
#: The runs of one case by solver.
Runs = dict[Solver, SimulatedRun]
#: Step [s] of the thesis's own Runge-Kutta method (section 4.1.1).
THESIS_STEP = 1e-4
#: Duration [s] of a run, and the whole periods of both commands in it that numbers are taken from.
DURATION = 6.5
STEADY = (math.pi, 2.0 * math.pi)
WINDOW = "from pi to 2 pi s of a run from standstill"
#: Every third step of 1e-4 s: a solution that alternates from step to step is met at both its values, which
#: sampling every 2nd, 4th or 20th step would hide.
SAMPLE_RATE = 1.0 / (3.0 * THESIS_STEP)
#: Pressure difference [Pa] below which a throttle is taken as laminar. Eqs. (4.9)-(4.12) have no such limit; 1 Pa is
#: far below every drop, and above zero, so that the equations can be solved at all.
DP_0 = 1.0
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)")
CLOSINGS = (25.0, 50.0, 75.0)
#: Command of section 4.3, and its period [s].
COMMAND, PERIOD = "5 sin(2t)", math.pi
#: Length [s] and sampling rate [Hz] of the runs that show drift of the piston.
_DRIFT_DURATION, _DRIFT_RATE = 60.0, 100.0


#: The rows of Tables 4.2 and 4.3: command, and how far both throttles are closed [%], None without them.
CASES: dict[str, tuple[str, float | None]] = {
    **{f"4.2-{letter}": (command, None) for letter, command in zip("abc", COMMANDS, strict=True)},
    **{
        f"4.3-{letter}": (command, closed)
        for letter, (closed, command) in zip("abcdefghi", product(CLOSINGS, COMMANDS), strict=True)
    },
}


@dataclass(frozen=True)
class Reading:
    """A reading of the throttles' equations where the thesis contradicts itself or is silent.

    `metering` "meter-out" (the text: throttled return on both sides) or "literal" (eqs. 4.11, 4.12 as printed);
    `closed_means` "area" (eq. 4.8) or "diameter" (the text's 3.75 mm of 5 mm); `d_line_mm` 7 (Table 4.1) or 5 (the
    text); `V_line_cm3` V_1 = V_2, not given.
    """

    metering: Literal["meter-out", "literal"] = "meter-out"
    closed_means: Literal["area", "diameter"] = "area"
    d_line_mm: float = 7.0
    V_line_cm3: float = 44.0

    @property
    def title(self) -> str:
        """The reading in a few words."""
        metering = "as printed" if self.metering == "literal" else "meter-out"
        text = f"{metering}, closed by {self.closed_means}, {self.d_line_mm:g} mm"
        return text if self.V_line_cm3 == Reading.V_line_cm3 else f"{text}, V_1 = {self.V_line_cm3:g} cm3"

    def values(self, closed_pct: float | None) -> tuple[tuple[str, str | float], ...]:
        """Build the rig's parameters by name for throttles closed by `closed_pct` [%] (0: open; None: absent)."""
        sampling: tuple[tuple[str, str | float], ...] = (("daq.sample_rate", SAMPLE_RATE),)
        if closed_pct is None:
            return sampling
        # open throttles are the same under every reading
        opened = replace(self, metering="meter-out", closed_means="area") if closed_pct == 0 else self
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
READINGS = (OURS, AS_PRINTED)


def spec(
    command: str,
    closed_pct: float | None,
    reading: Reading = OURS,
    solver: Solver = "converged",
    duration: float = DURATION,
    changed: Mapping[str, str | float] = MappingProxyType({}),
) -> Experiment:
    """Build the run of a command with throttles closed by `closed_pct` [%] (None: absent); `changed` parameters."""
    values = {**dict(reading.values(closed_pct)), **changed}
    run = Experiment.of(command=command, duration=duration, set=values)
    return replace(run, method="rk4", step=THESIS_STEP) if solver == "literal" else run


def drift_spec(reading: Reading, closed_pct: float | None, solver: Solver, **changed: str | float) -> Experiment:
    """Build a long run of section 4.3's command for the drift of the piston."""
    return spec(COMMAND, closed_pct, reading, solver, _DRIFT_DURATION, {"daq.sample_rate": _DRIFT_RATE, **changed})


def both_runs(context: Context, command: str, closed_pct: float | None, reading: Reading = OURS) -> Runs:
    """Run a command as the thesis ran it, and converged."""
    return {solver: context.run(spec(command, closed_pct, reading, solver)) for solver in LABELS}


def resolved(runs: Runs) -> bool:
    """Return True if all of the runs passed the halving test."""
    return all(run.resolved for run in runs.values())


def finished_runs(runs: Runs) -> list[tuple[Solver, str, SimulatedRun]]:
    """List solver, label and run of those that did not diverge."""
    return [(solver, LABELS[solver], run) for solver, run in runs.items() if not run.diverged]


def steady(run: SimulatedRun) -> np.ndarray:
    """Select the samples in the whole periods that numbers are taken from, (n,) truth values."""
    return np.asarray((run.t >= STEADY[0]) & (run.t < STEADY[1]))


def steady_output(run: SimulatedRun, name: str) -> Array:
    """Return the output `name` over those whole periods; a single nan where the run diverged."""
    return np.array([math.nan]) if run.diverged else np.asarray(run.outputs[name][steady(run)])


def span(run: SimulatedRun, name: str) -> float:
    """Compute the range (greatest less least) of an output over the whole periods."""
    return float(np.ptp(steady_output(run, name)))


def mean_difference(run: SimulatedRun, first: str, second: str) -> float:
    """Compute the mean of one output less another over the whole periods."""
    return float(np.mean(steady_output(run, first) - steady_output(run, second)))


def numbers_of(run: SimulatedRun) -> dict[str, float]:
    """Compute ranges, peaks and least value of the pressures, mean and largest drop at the orifices [Pa], by name.

    `flows differ`: rms of Q_A - Q_B over that of Q_A. All nan where the run diverged.
    """
    outputs = {name: steady_output(run, name) for name in (*PRESSURES, "Q_A", "Q_B")}
    drops = {"p_1 - p_A": outputs["p_1"] - outputs["p_A"], "p_2 - p_B": outputs["p_2"] - outputs["p_B"]}
    return {
        **{f"range of {name}": float(np.ptp(outputs[name])) for name in PRESSURES},
        **{f"peak of {name}": float(outputs[name].max()) for name in PRESSURES},
        "least pressure": min(float(outputs[name].min()) for name in PRESSURES),
        **{f"mean of {name}": float(np.mean(drop)) for name, drop in drops.items()},
        "largest drop": max(float(np.abs(drop).max()) for drop in drops.values()),
        "flows differ": float(np.sqrt(np.mean((outputs["Q_A"] - outputs["Q_B"]) ** 2) / np.mean(outputs["Q_A"] ** 2))),
    }


def piston_drift(run: SimulatedRun) -> float:
    """Compute the shift [m] of a period's mean position from the first to the last whole one; nan if it diverged."""
    if run.diverged:
        return math.nan
    t, x = run.t, run.outputs["x"]
    last = int((t[-1] + t[1] - t[0]) // PERIOD) - 1
    means = [float(x[(t >= k * PERIOD) & (t < (k + 1) * PERIOD)].mean()) for k in (0, last)]
    return means[1] - means[0]


def visible_pressure() -> float:
    """Compute the least pressure difference [Pa] that a transducer of the rig shows: its noise (standard deviation)."""
    sensors = load_rig("thesis").sensors
    return math.hypot(sensors.p_A.noise, sensors.common_noise)
