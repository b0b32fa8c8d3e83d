"""Simulate an experiment: size its leaks, integrate the rig, record it as the instruments would, keep the truth
apart."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sealscope.recordings.atomic import atomic_write
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.changes.drifts import Drift
from sealscope.simulation.experiment import Experiment, make_experiment
from sealscope.simulation.faults.faults import Fault, Leak
from sealscope.simulation.inputs import RunInputs
from sealscope.simulation.instruments import FILTER_REACH, record
from sealscope.simulation.integrate import DEFAULT_STEP, Trajectory, choose_method, integrate
from sealscope.simulation.sizing import leak_flow, mean_while_open, sized
from sealscope.units import LITRE_PER_MINUTE

#: Told what is being done and how far it is, 0..1.
Progress = Callable[[str, float], None]
#: What the truth of a run holds at each sample.
TRUE_OUTPUTS = ("omega", "theta", "x", "v", "p_A", "p_B", "p_1", "p_2", "Q_1", "Q_A", "Q_B", "q_leak", "q_ext", "q_up")
_OVERSAMPLING = 4


@dataclass(frozen=True)
class Truth:
    """What a real rig would not tell: the leaks, faults and drifts that were put in, and every state without noise at
    the recording's samples. `onset_s` and the mean are those of the leaks across the piston."""

    leaks: tuple[Leak, ...]
    onset_s: float | None
    mean_leak_lpm: float
    t: Array
    outputs: dict[str, Array]
    faults: tuple[Fault, ...] = ()
    drifts: tuple[Drift, ...] = ()


@dataclass(frozen=True)
class Run:
    """A simulated experiment: the recording, and, apart from it, the truth."""

    recording: Recording
    truth: Truth


def oversampling(experiment: Experiment) -> int:
    """Outputs per sample: enough for the anti-alias filter, no more than the solver has steps."""
    longest = experiment.step or DEFAULT_STEP[choose_method(experiment.rig, experiment.method)]
    return oversampling_of(experiment.rate, longest)


def oversampling_of(rate: float, step: float) -> int:
    """Outputs per sample of a recording at `rate` [Hz] where the solver has a step about every `step` [s]."""
    return max(1, min(_OVERSAMPLING, math.ceil(1.0 / (rate * step) * (1.0 - 1e-9))))


def trajectory(
    experiment: Experiment,
    leaks: tuple[Leak, ...],
    *,
    step: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Trajectory:
    """The states and flows over the experiment, sampled for the instruments; `leaks` have their coefficients."""
    factor = oversampling(experiment)
    return integrate(
        experiment.rig,
        RunInputs(experiment, leaks),
        (round(experiment.duration * experiment.rate) + FILTER_REACH) / experiment.rate,
        experiment.rate * factor,
        x_0=experiment.x_0,
        method=experiment.method,
        step=step or experiment.step,
        error=experiment.error_allowed,
        allow_unresolved=experiment.allow_unresolved,
        progress=progress,
        effects=experiment.effects(),
    )


def sized_leaks(experiment: Experiment, progress: Progress | None = None) -> tuple[Leak, ...]:
    """The experiment's leaks with the coefficients that give their means at the rig's own operating point."""
    if not any(leak.mean for leak in experiment.leaks):
        return tuple(
            leak if leak.mean is None else Leak(leak.law, 0.0, None, leak.opening) for leak in experiment.leaks
        )
    runs = 0

    def one_run(leaks: tuple[Leak, ...]) -> Trajectory:
        nonlocal runs
        if progress is not None:
            progress("sizing the leak", 1.0 - 0.5**runs)
        runs += 1
        return trajectory(experiment, leaks)

    found = sized(experiment.leaks, one_run, experiment.rig.line.dp_0)
    if progress is not None:
        progress("sizing the leak", 1.0)
    return found


def run(experiment: Experiment, progress: Progress | None = None) -> Run:
    """Simulate the experiment.

    Raises InputError for an experiment that cannot be (a leak larger than the pump's flow), SimulationFailed for a
    run that diverged or cannot be resolved.
    """
    leaks = sized_leaks(experiment, progress)
    n = round(experiment.duration * experiment.rate)
    factor = oversampling(experiment)

    def told(reached: float) -> None:
        if progress is not None:
            progress("simulating", min(1.0, reached / experiment.duration))

    path = trajectory(experiment, leaks, progress=told)
    times = experiment.sample_times()
    volts = experiment.commanded.volts(times)
    made = record(experiment.rig, path, volts, factor, experiment.seed, experiment.readings())
    provenance: dict[str, Any] = {
        "origin": "simulation",
        "experiment": experiment.describe(),
        "experiment_key": experiment.key(),
        "solver": _solver(path, experiment),
    }
    history = (f"simulated with {path.method}, h = {path.step:.4g} s; sampled at {experiment.rate:g} Hz",)
    recording = replace(made, provenance=provenance, history=history)
    instants = slice(0, n * factor, factor)
    outputs = {name: path[name][instants] for name in TRUE_OUTPUTS}
    mean = _mean_leak(leaks, path, experiment)
    truth = Truth(leaks, experiment.onset(), mean, times, outputs, experiment.faults, experiment.drifts)
    return Run(recording, truth)


def _solver(path: Trajectory, experiment: Experiment) -> dict[str, Any]:
    """How the run was integrated, for its provenance; where the step was chosen by error, `error_pa` is what was asked
    for and `error_found_pa` what was found in the windows that were checked."""
    told: dict[str, Any] = {"method": path.method, "step_s": path.step, "allow_unresolved": experiment.allow_unresolved}
    if experiment.step is None:
        told |= {"error_pa": experiment.error_allowed, "error_found_pa": path.error}
    return told


def _mean_leak(leaks: tuple[Leak, ...], path: Trajectory, experiment: Experiment) -> float:
    """Mean of the leaks' flows while open [L/min], as the run really had it."""
    dp = path["p_A"] - path["p_B"]
    flows = [mean_while_open(leak, path.t, leak_flow(leak, path.t, dp, experiment.rig.line.dp_0)) for leak in leaks]
    return sum(flows) / LITRE_PER_MINUTE


def write_truth(truth: Truth, path: str | os.PathLike[str]) -> None:
    """Write what was put in as JSON: leaks with their coefficients, onset [s], mean leak while open [L/min], other
    faults with their onsets [s], and what drifted from the start to the end, in per cent (or in the SI unit)."""
    told: dict[str, Any] = {
        "onset_s": truth.onset_s,
        "mean_leak_lpm": truth.mean_leak_lpm,
        "leaks": [
            {"law": leak.law, "coefficient": leak.coefficient, "opening": str(leak.opening)} for leak in truth.leaks
        ],
    }
    if truth.faults:
        told["faults"] = [
            {"kind": one.kind, "words": str(one), "onset_s": onset if math.isfinite(onset := one.onset()) else None}
            for one in truth.faults
        ]
    if truth.drifts:
        told["drifts"] = [_told_drift(drift, truth.t) for drift in truth.drifts]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


def _told_drift(drift: Drift, t: Array) -> dict[str, Any]:
    change = drift.shape.at(t)
    span, end = float(np.ptp(change)), float(change[-1] - change[0])
    if drift.absolute:
        return {"parameter": drift.parameter, "span": span, "start_to_end": end}
    return {"parameter": drift.parameter, "span_pct": 100.0 * span, "start_to_end_pct": 100.0 * end}


def simulate(**experiment: Any) -> Recording:
    """Simulate from words and return the Recording: `simulate(command="3 sin(4t)", leak="0.0042 L/min from 90 s",
    duration=180, seed=1)`.

    Keywords are those of `make_experiment`; `run` gives the truth beside the recording.
    """
    return run(make_experiment(**experiment)).recording
