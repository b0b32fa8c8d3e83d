"""Simulate an experiment: size its leaks, integrate the rig, record it as the instruments would, keep the truth
apart."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.errors import InputError
from sealscope.recordings.atomic import atomic_write
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.changes.drifts import Drift
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults.faults import Fault, Leak
from sealscope.simulation.inputs import RunInputs
from sealscope.simulation.instruments import FILTER_REACH, record
from sealscope.simulation.integrate import DEFAULT_STEP, Method, Trajectory, choose_method, integrate
from sealscope.simulation.sizing import leak_flow, mean_while_open, sized
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.simulation.commands import Command

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


@checked_call
def simulate_with_truth(experiment: Experiment, progress: Progress | None = None) -> Run:
    """Simulate an experiment and keep its truth beside the recording.

    Parameters
    ----------
    experiment : Experiment
        What is simulated, as `Experiment.of` makes it.
    progress : callable, optional
        Called with what is being done (str) and how far it is (0 to 1).

    Returns
    -------
    Run
        `recording`, and `truth`: leaks with their coefficients, onset, mean leak and every state without noise.

    Raises
    ------
    InputError
        The experiment is impossible, such as a leak larger than the pump's flow.
    SimulationFailed
        The run diverged, fell below vacuum, or is not resolved by its step.

    Examples
    --------
    >>> import sealscope as ss
    >>> run = ss.simulate_with_truth(ss.Experiment.of(leak="0.05 L/min from 1 s", duration=2.0))
    >>> run.truth.onset_s, round(run.truth.mean_leak_lpm, 3)
    (1.0, 0.05)
    """
    if not isinstance(experiment, Experiment):
        raise InputError(f"experiment must be an Experiment (Experiment.of(...) makes one), got {experiment!r}")
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


@checked_call
def simulate(
    *,
    rig: Rig | str | os.PathLike[str] = "thesis",
    command: Command | str = "3 sin(4t)",
    leak: Leak | str | Iterable[Leak | str] | None = None,
    fault: Fault | str | Iterable[Fault | str] | None = None,
    drifts: Iterable[Drift] = (),
    set: Mapping[str, float | str] | None = None,
    duration: float | str = 180.0,
    rate: float | str | None = None,
    x_0: float | str = 0.0,
    seed: int = 0,
    method: Method = "auto",
    step: float | str | None = None,
    error: float | str | None = None,
    allow_unresolved: bool = False,
) -> Recording:
    """Simulate a rig under a command and record it as its instruments would.

    A quantity is a number in the SI unit stated below, or a text with a unit of its own (``"3 min"``, ``"20[Pa]"``),
    as on the command line.

    Parameters
    ----------
    rig : Rig, str or path-like, optional
        A rig, the name of a packaged one, or the path of a TOML file.
    command : str or Command, optional
        Voltage sent to the servo drive: ``"3 sin(4t)"``, ``"step 5 at 1 s"``, ``"ramp 5 from 1 s to 3 s"``, ``"chirp 3
        from 0.1 Hz to 5 Hz over 60 s"``, ``"prbs 2 every 0.5 s seed 1"``, or ``"file LOG"`` (channel u of a recording).
    leak : str, Leak or several of them, optional
        Leakage across the piston: ``"0.0042 L/min from 90 s"`` (mean flow while open), ``"0.01[L/min] orifice growing
        from 1 min to 2 min"``, ``"G = 6.1e-13 from 90 s"``, ``"C = 2e-10"``, ``"table LEAK.csv"`` or ``"none"``.
    fault : str, Fault or several of them, optional
        Other faults: ``"pump leak x3 from 90 s"``, ``"rod seal A 0.01 L/min"``, ``"friction +20 %"``, ``"air 1 %"``,
        ``"sensor p_A offset 2 psi"``, ``"sensor p_A gain -1 %"``, ``"sensor p_A stuck from 90 s to 100 s"``, ``"duty
        amplitude x1.5"``.
    drifts : iterable of Drift, optional
        Parameters of the rig and of its instruments that change slowly within the run.
    set : mapping of str to float or str, optional
        Overrides of the rig's parameters: ``{"V_1": "50[cm^3]"}``.
    duration : float or str, optional
        Length of the recording [s].
    rate : float or str, optional
        Sampling rate [Hz]; the rig's own (``daq.sample_rate``) by default.
    x_0 : float or str, optional
        Position of the piston at the start, from mid-stroke [m].
    seed : int, optional
        Seed of the instruments' noise.
    method : {"auto", "rk4", "imex"}, optional
        Integration method; "auto" takes the implicit-explicit one for a rig with throttles.
    step : float or str, optional
        Largest step of the solver [s], instead of one chosen by `error`.
    error : float or str, optional
        Error that a pressure may have [Pa rms], 100 Pa by default; the step is chosen by it.
    allow_unresolved : bool, optional
        Let an unstable or under-resolved run through, marked in the provenance.

    Returns
    -------
    Recording
        What the instruments recorded. `simulate_with_truth` returns the truth beside it.

    Raises
    ------
    InputError
        An argument breaks a rule, or is not known.
    SimulationFailed
        The run diverged, fell below vacuum, or is not resolved by its step.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", leak="0.05 L/min from 1 s", duration="2 s", seed=1)
    >>> recording.rate, len(recording)
    (500.0, 1000)
    """
    experiment = Experiment.of(
        rig=rig, command=command, leak=leak, fault=fault, drifts=drifts, set=set, duration=duration, rate=rate, x_0=x_0,
        seed=seed, method=method, step=step, error=error, allow_unresolved=allow_unresolved,
    )  # fmt: skip
    return simulate_with_truth(experiment).recording
