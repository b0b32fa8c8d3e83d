"""Chapter 4 under every reading of its equations: the numbers that its claims are judged by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sealscope.recordings.chambers import PRESSURES
from sealscope.thesis.chapters.chapter4.cases import (
    AS_PRINTED,
    CLOSINGS,
    OURS,
    READINGS,
    Reading,
    literal,
    mean_difference,
    settled,
    span,
    spec,
)
from sealscope.thesis.engine.context import Context, RunSpec, SimulatedRun

Solver = Literal["converged", "literal"]
SOLVERS: tuple[Solver, ...] = ("converged", "literal")
SOLVER_TEXT: dict[Solver, str] = {"converged": "converged", "literal": "RK4 1e-4 s"}
#: Command of section 4.3, and its period [s].
COMMAND, PERIOD = "5 sin(2t)", math.pi
#: Length [s] and sampling rate [Hz] of the runs that show drift of the piston.
_DRIFT_DURATION, _DRIFT_RATE = 60.0, 100.0


@dataclass(frozen=True)
class Throttled:
    """One command under one reading, closing [%] and solver: range, peak and least value [Pa] of each pressure, mean
    differences across both orifices [Pa], largest drop [Pa], and how unlike the two flows are."""

    span: dict[str, float]
    peak: dict[str, float]
    least: dict[str, float]
    p_1_less_p_A: float
    p_2_less_p_B: float
    largest_drop: float
    flows_differ: float
    resolved: bool | None


def throttled(run: SimulatedRun) -> Throttled:
    """The numbers of one run; nan throughout where it diverged."""
    if run.diverged:
        nothing = dict.fromkeys(PRESSURES, math.nan)
        return Throttled(nothing, nothing, nothing, *(math.nan,) * 4, False)
    Q_A, Q_B = settled(run, "Q_A"), settled(run, "Q_B")
    drops = [np.abs(settled(run, one) - settled(run, other)).max() for one, other in (("p_1", "p_A"), ("p_2", "p_B"))]
    return Throttled(
        {name: span(run, name) for name in PRESSURES},
        {name: float(settled(run, name).max()) for name in PRESSURES},
        {name: float(settled(run, name).min()) for name in PRESSURES},
        mean_difference(run, "p_1", "p_A"),
        mean_difference(run, "p_2", "p_B"),
        float(max(drops)),
        float(np.sqrt(np.mean((Q_A - Q_B) ** 2) / np.mean(Q_A**2))),
        run.resolved,
    )


def readings(quick: bool) -> tuple[Reading, ...]:
    """The readings that are tried: all eight, or, where it must be quick, ours and the printed one."""
    return (OURS, AS_PRINTED) if quick else READINGS


def one(
    context: Context, reading: Reading, closed_pct: float | None, solver: Solver, command: str = COMMAND
) -> Throttled:
    """The numbers of a command under a reading, with throttles closed by `closed_pct` [%] (None: absent)."""
    converged = spec(command, closed_pct, reading)
    return throttled(context.run(converged if solver == "converged" else literal(converged)))


def over_closings(context: Context, reading: Reading, solver: Solver) -> dict[float, Throttled]:
    """The numbers at 0, 25, 50 and 75 % closed under the command of section 4.3."""
    return {closed: one(context, reading, closed, solver) for closed in (0.0, *CLOSINGS)}


def drift_spec(reading: Reading, closed_pct: float | None, solver: Solver, **changed: str | float) -> RunSpec:
    """A long run of the command of section 4.3 for the drift of the piston; `changed` parameters by bare name."""
    values = {**dict(reading.values(closed_pct)), "daq.sample_rate": _DRIFT_RATE, **changed}
    long = RunSpec(command=COMMAND, duration=_DRIFT_DURATION, values=tuple(values.items()), prove=True)
    return long if solver == "converged" else literal(long)


def drift(run: SimulatedRun) -> float:
    """How far [m] the mean position of a period moves from the first whole period to the last; nan if it diverged."""
    if run.diverged:
        return math.nan
    t, x = run.t, run.outputs["x"]
    last = int((t[-1] + t[1] - t[0]) // PERIOD) - 1
    means = [float(x[(t >= k * PERIOD) & (t < (k + 1) * PERIOD)].mean()) for k in (0, last)]
    return means[1] - means[0]
