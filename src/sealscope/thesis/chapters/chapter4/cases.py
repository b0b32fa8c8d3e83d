"""The twelve cases of Tables 4.2 and 4.3, the readings of the equations, and the numbers by which claims are judged.

A case is simulated with the thesis's method and step ("as_published"), and with a step that converges. A reading is one
way to understand equations that the thesis states inconsistently.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from sealscope.parameters import load_rig
from sealscope.recordings.channels import PRESSURES
from sealscope.recordings.recording import Array
from sealscope.simulation.experiment import Experiment
from sealscope.thesis.engine.context import Context, SimulatedRun

Solver = Literal["converged", "as_published"]
SOLVERS: tuple[Solver, ...] = ("converged", "as_published")
#: Labels of the solvers in tables and figures, in the order of drawing.
LABELS: dict[Solver, str] = {"as_published": "RK4 1e-4 s", "converged": "converged"}
#: The runs of one case by solver.
Runs = dict[Solver, SimulatedRun]
#: Step [s] of the thesis's Runge-Kutta method (section 4.1.1).
THESIS_STEP = 1e-4
#: Duration [s] of a run, and the interval in it from which numbers are computed: whole periods of all commands.
DURATION = 6.5
STEADY = (math.pi, 2.0 * math.pi)
WINDOW = "from pi to 2 pi s of a run from standstill"
#: Sampling rate [Hz]: one sample per three steps of 1e-4 s. Samples an odd number of steps apart show a solution that
#: alternates from step to step; samples an even number of steps apart would hide the oscillation.
SAMPLE_RATE = 1.0 / (3.0 * THESIS_STEP)
#: Pressure difference [Pa] below which a throttle is laminar. Eqs. (4.9)-(4.12) have no such limit, and their infinite
#: slope at zero cannot be integrated; 1 Pa is far below every drop.
DP_0 = 1.0
COMMANDS = ("3 sin(4t)", "5 sin(2t)", "7 sin(4t)")
CLOSINGS = (25.0, 50.0, 75.0)
#: Command of section 4.3, and its period [s].
COMMAND, PERIOD = "5 sin(2t)", math.pi
#: Length [s] and sampling rate [Hz] of the runs for the drift of the piston.
_DRIFT_DURATION, _DRIFT_RATE = 60.0, 100.0
#: The rows of Tables 4.2 and 4.3: command, and closing of both throttles [%], None if there are no throttles.
CASES: dict[str, tuple[str, float | None]] = {
    **{f"4.2-{letter}": (command, None) for letter, command in zip("abc", COMMANDS, strict=True)},
    **{
        f"4.3-{letter}": (command, closed)
        for letter, (closed, command) in zip("abcdefghi", product(CLOSINGS, COMMANDS), strict=True)
    },
}


@dataclass(frozen=True)
class Reading:
    """One interpretation of the throttles' equations, which the thesis states inconsistently or incompletely.

    `metering`: "meter-out" (the text: the return flow is throttled on both sides) or "literal" (eqs. 4.11, 4.12 as
    printed); `closed_means`: a throttle is closed by a fraction of its "area" (eq. 4.8) or of its "diameter" (the
    text's 3.75 mm of 5 mm); `d_line_mm`: diameter of the lines, 7 (Table 4.1) or 5 (the text); `V_line_cm3`: volume V_1
    = V_2 of each line, which the thesis does not give.
    """

    metering: Literal["meter-out", "literal"] = "meter-out"
    closed_means: Literal["area", "diameter"] = "area"
    d_line_mm: float = 7.0
    V_line_cm3: float = 44.0

    @property
    def title(self) -> str:
        """Short description of this interpretation of the equations, such as "meter-out, closed by area, 7 mm"."""
        metering = "as printed" if self.metering == "literal" else "meter-out"
        text = f"{metering}, closed by {self.closed_means}, {self.d_line_mm:g} mm"
        return text if self.V_line_cm3 == Reading.V_line_cm3 else f"{text}, V_1 = {self.V_line_cm3:g} cm3"

    def values(self, closed_pct: float | None) -> dict[str, str | float]:
        """Return the rig's parameters by name, for throttles closed by `closed_pct` [%], None for no throttles."""
        if closed_pct is None:
            return {}
        # these two do not matter to open throttles: readings that differ in them only share a run by equal parameters
        reading = replace(self, metering="meter-out", closed_means="area") if closed_pct == 0 else self
        return {
            "line.orifices": "present",
            "line.closed_A": closed_pct / 100.0,
            "line.closed_B": closed_pct / 100.0,
            "line.metering": reading.metering,
            "line.closed_means": reading.closed_means,
            "line.d_line": self.d_line_mm * 1e-3,
            "line.V_1": self.V_line_cm3 * 1e-6,
            "line.V_2": self.V_line_cm3 * 1e-6,
            "line.dp_0": DP_0,
        }


DEFAULT_READING = Reading()
#: The reading that follows eqs. (4.11), (4.12) and the text's "3.75 mm of 5 mm" literally.
AS_PRINTED = Reading(metering="literal", closed_means="diameter", d_line_mm=5.0)
READINGS = (DEFAULT_READING, AS_PRINTED)


def make_experiment(
    command: str,
    closed_pct: float | None,
    reading: Reading = DEFAULT_READING,
    solver: Solver = "converged",
    duration: float = DURATION,
    **overrides: str | float,
) -> Experiment:
    """Build the experiment of a `command` with throttles closed by `closed_pct` [%], None for no throttles.

    `reading`: interpretation of the thesis's equations, which sets the rig's parameters; `solver`: "as_published" for
    the thesis's method and step (RK4, 1e-4 s), "converged" for a step chosen by its error; `duration` [s];
    `overrides`: parameters that replace those of the reading, by dotted name.
    """
    values = {"daq.sample_rate": SAMPLE_RATE, **reading.values(closed_pct), **overrides}
    experiment = Experiment.of(command=command, duration=duration, set=values)
    return replace(experiment, method="rk4", step=THESIS_STEP) if solver == "as_published" else experiment


def make_drift_experiment(
    reading: Reading, closed_pct: float | None, solver: Solver, **overrides: str | float
) -> Experiment:
    """Build the experiment of 60 s in which the piston's drift is measured, by arguments of `make_experiment`."""
    overrides = {"daq.sample_rate": _DRIFT_RATE, **overrides}
    return make_experiment(COMMAND, closed_pct, reading, solver, _DRIFT_DURATION, **overrides)


def run_both_solvers(
    context: Context, command: str, closed_pct: float | None, reading: Reading = DEFAULT_READING
) -> Runs:
    """Simulate a command by both solvers; the arguments are those of `make_experiment`."""
    return {solver: context.run(make_experiment(command, closed_pct, reading, solver)) for solver in LABELS}


def all_resolved(runs: Runs) -> bool:
    """Return True if all runs of a case changed by no more than the tolerance when the solver's step was halved."""
    return all(run.resolved for run in runs.values())


def completed_runs(runs: Runs) -> list[tuple[Solver, str, SimulatedRun]]:
    """List the runs that did not diverge, as (solver, the solver's label, run)."""
    return [(solver, LABELS[solver], run) for solver, run in runs.items() if not run.diverged]


def steady_mask(run: SimulatedRun) -> np.ndarray:
    """Find the samples (n,) of a run within its steady part, from pi to 2 pi seconds (`STEADY`)."""
    return np.asarray((run.t >= STEADY[0]) & (run.t < STEADY[1]))


def steady_output(run: SimulatedRun, name: str) -> Array:
    """Return an output in the steady part of a run, from pi to 2 pi seconds; a single nan if the run diverged."""
    return np.array([math.nan]) if run.diverged else np.asarray(run.outputs[name][steady_mask(run)])


def steady_range(run: SimulatedRun, name: str) -> float:
    """Compute the maximum minus the minimum of an output from pi to 2 pi seconds; nan if the run diverged."""
    return float(np.ptp(steady_output(run, name)))


def mean_difference(run: SimulatedRun, first: str, second: str) -> float:
    """Compute the mean of output `first` minus `second` from pi to 2 pi seconds of a run; nan if it diverged."""
    return float(np.mean(steady_output(run, first) - steady_output(run, second)))


def summarise_run(run: SimulatedRun) -> dict[str, float]:
    """Compute the numbers by which runs are compared from pi to 2 pi s (`STEADY`), nan if the run diverged.

    Pressures are in Pa; the drops are those at the orifices; "flow difference" is rms(Q_A - Q_B) / rms(Q_A).
    """
    outputs = {name: steady_output(run, name) for name in (*PRESSURES, "Q_A", "Q_B")}
    drops = {"p_1 - p_A": outputs["p_1"] - outputs["p_A"], "p_2 - p_B": outputs["p_2"] - outputs["p_B"]}
    return {
        **{f"range of {name}": float(np.ptp(outputs[name])) for name in PRESSURES},
        **{f"peak of {name}": float(outputs[name].max()) for name in PRESSURES},
        "lowest pressure": min(float(outputs[name].min()) for name in PRESSURES),
        **{f"mean of {name}": float(np.mean(drop)) for name, drop in drops.items()},
        "largest drop": max(float(np.abs(drop).max()) for drop in drops.values()),
        "flow difference": float(
            np.sqrt(np.mean((outputs["Q_A"] - outputs["Q_B"]) ** 2) / np.mean(outputs["Q_A"] ** 2))
        ),
    }


def piston_drift(run: SimulatedRun) -> float:
    """Compute the drift [m] of the piston's mean from the first to the last whole period; nan if the run diverged."""
    if run.diverged:
        return math.nan
    t, x = run.t, run.outputs["x"]
    end = t[-1] + t[1] - t[0]  # one sampling interval after the last sample
    last_period = int(end // PERIOD) - 1  # number of the last whole period, from 0
    means = [float(x[(t >= k * PERIOD) & (t < (k + 1) * PERIOD)].mean()) for k in (0, last_period)]
    return means[1] - means[0]


def visible_pressure() -> float:
    """Compute the standard deviation [Pa] of a transducer's noise, above which a pressure change counts as visible."""
    sensors = load_rig("thesis").sensors
    return math.hypot(sensors.p_A.noise, sensors.common_noise)
