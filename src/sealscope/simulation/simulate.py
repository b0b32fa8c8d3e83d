"""Simulate an experiment: size its leaks, integrate, record with the instruments, and return the truth separately."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call, take_fields_of
from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.channels import CHAMBERS, PRESSURES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.simulation.arguments import Arguments
from sealscope.simulation.changes import ParameterDrift
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import Fault
from sealscope.simulation.instruments import decimate, record
from sealscope.simulation.integrate import (
    DETAIL_TOLERANCE,
    Progress,
    Trajectory,
    integrate_run,
    oversampling,
    run_with_sized_leaks,
)
from sealscope.simulation.leaks import Leak
from sealscope.simulation.sizing import leak_flow, mean_while_open
from sealscope.storage.atomic import atomic_write
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Outputs in the truth of a run at each sample, in addition to the powers (`powers`).
TRUE_OUTPUTS = (
    *("omega", "theta", "x", "v", "p_A", "p_B", "p_1", "p_2", "Q_1", "Q_A", "Q_B", "q_leak", "q_ext", "q_up"),
    *("x_s", "i", "V"),
)
#: States that a proof compares in addition to the pressures, with their units.
_STATES = {"omega": "rad/s", "theta": "rad", "x": "m", "v": "m/s"}


@dataclass(frozen=True)
class Truth:
    """The true leaks, faults, drifts and noise-free outputs of a run, which its recording does not contain.

    `leaks`: leaks across the piston with their coefficients; `onset_s`: time [s] at which the first of them opens, None
    if none does; `mean_leak_lpm`: sum of the leaks' mean flows while open [L/min]; `outputs`: noise-free outputs by
    name, at the recording's sample times `t` [s].
    """

    leaks: tuple[Leak, ...]
    onset_s: float | None
    mean_leak_lpm: float
    t: Array
    outputs: dict[str, Array]
    faults: tuple[Fault, ...] = ()
    drifts: tuple[ParameterDrift, ...] = ()


@dataclass(frozen=True)
class Difference:
    """The change of a quantity `name`, in `unit`, when the step is halved; `tolerance`: its limit, None for none."""

    name: str
    difference: float
    unit: str
    tolerance: float | None

    @property
    def resolved(self) -> bool:
        """True if the difference is within its tolerance, or has no tolerance."""
        return self.tolerance is None or self.difference <= self.tolerance


@dataclass(frozen=True)
class Proof:
    """Comparison of a run at `step` [s] with one at the step `halved` [s], by `method` (rk4 or imex)."""

    method: str
    step: float
    halved: float
    differences: tuple[Difference, ...]

    @property
    def resolved(self) -> bool:
        """True if every difference between the two runs is within its tolerance."""
        return all(difference.resolved for difference in self.differences)

    def text(self) -> str:
        """Format the proof as text, with a line for each difference."""
        lines = [f"halving the step ({self.method}, {self.step:.3g} s to {self.halved:.3g} s) moves"]
        for row in self.differences:
            limit = "" if row.tolerance is None else f" (at most {row.tolerance:.3g})"
            mark = "" if row.resolved else "  NOT RESOLVED"
            lines.append(f"  {row.name:<18} {row.difference:10.3g} {row.unit}{limit}{mark}")
        return "\n".join(lines)

    def worst(self) -> Difference:
        """Find the quantity with the largest difference relative to its tolerance, among those with a tolerance."""
        limited = [row for row in self.differences if row.tolerance is not None]
        return max(limited, key=lambda row: row.difference / (row.tolerance or sys.float_info.min))  # `or`: it may be 0


@dataclass(frozen=True)
class Run:
    """A simulated experiment: the recording, the truth about it, and, if requested, the proof of its step."""

    recording: Recording
    truth: Truth
    proof: Proof | None = None

    def lines(self) -> list[str]:
        """Describe the run in lines: solver, leaks, faults, and the flow that a controller compensates at the end."""
        solver = self.recording.provenance["solver"]
        lines = [f"{solver['method']}, h = {solver['step_s']:.3g} s"]
        lines += [f"leak: {leak}" for leak in self.truth.leaks] + [f"fault: {fault}" for fault in self.truth.faults]
        if self.truth.leaks:
            lines.append(f"mean leak while open: {self.truth.mean_leak_lpm:.5g} L/min")
        if "q_comp" in self.recording:
            last_second = self.recording["q_comp"][-max(1, round(self.recording.rate)) :]
            flow = float(last_second.mean()) / LITRE_PER_MINUTE
            lines.append(f"the controller compensates: {flow:.4g} L/min at the end (channel q_comp)")
        return lines


def simulate_experiment(experiment: Experiment, progress: Progress | None = None, *, prove: bool = False) -> Run:
    """Simulate an experiment; return its recording, and separately its truth.

    Parameters
    ----------
    experiment : Experiment
        The experiment, as `Experiment.of` makes it.
    progress : callable, optional
        Called with the name of the current task (str) and its completed fraction (0 to 1).
    prove : bool, optional
        Also integrate at half the step, and compare (`Proof`).

    Returns
    -------
    Run
        `recording`; `truth`: leaks with their coefficients, onset, mean leak and outputs without noise; `proof`: None
        unless `prove`.

    Raises
    ------
    InputError
        The experiment is impossible, such as a leak larger than the pump's flow.
    SimulationFailed
        The run diverged, fell below vacuum, or is not resolved by its step; with `prove`, also if halving the step
        changes more than the tolerance, unless the experiment allows it.
    """
    if not isinstance(experiment, Experiment):
        raise InputError(f"experiment must be an Experiment (Experiment.of(...) makes one), got {experiment!r}")
    leaks, run = run_with_sized_leaks(experiment, progress)
    proof = None
    if prove:
        fine = integrate_run(experiment, leaks, step=run.step / 2, progress=progress, task="proving: half the step")
        proof = Proof(run.method, run.step, fine.step, compare_trajectories(experiment, run, fine))
        if not (proof.resolved or experiment.allow_unresolved):
            worst = proof.worst()
            raise SimulationFailed(
                f"the run is under-resolved: halving the step of {run.step:.3g} s ({run.method}) moves {worst.name} "
                f"by {worst.difference:.4g} {worst.unit}, which must be <= {worst.tolerance:.4g} {worst.unit}; take a "
                "smaller step"
            )
    return Run(_record_run(experiment, run), _collect_truth(experiment, leaks, run), proof)


def _sample_outputs(experiment: Experiment) -> slice:
    """Build the slice of the solver's outputs at the recording's samples: one in `oversampling` outputs."""
    factor = oversampling(experiment)
    return slice(0, round(experiment.duration * experiment.rate) * factor, factor)


def _record_run(experiment: Experiment, run: Trajectory) -> Recording:
    """Record an integrated run with the rig's instruments, and state its origin in the recording's provenance."""
    at_samples = _sample_outputs(experiment)
    times = experiment.sample_times()
    command = experiment.voltage_command.volts(times) if run.volts is None else run.volts[at_samples]
    readings = record(experiment, run, command, at_samples.step)
    solver = {"method": run.method, "step_s": run.step, "allow_unresolved": experiment.allow_unresolved}
    if experiment.step is None:
        solver["error_pa"] = experiment.error_allowed
    provenance: dict[str, Any] = {
        "origin": "simulation",
        "experiment": experiment.describe(),
        "experiment_key": experiment.key(),
        "solver": solver | {"error_found_pa": run.error},
    }
    history = (f"simulated with {run.method}, h = {run.step:.4g} s; sampled at {experiment.rate:g} Hz",)
    channels = dict(readings.channels)
    if run.compensated is not None:
        channels["q_comp"] = run.compensated[at_samples]
    units = {name: CHANNEL_UNITS[name] for name in channels}
    return replace(readings, channels=channels, units=units, provenance=provenance, history=history)


def _collect_truth(experiment: Experiment, leaks: tuple[Leak, ...], run: Trajectory) -> Truth:
    """Collect the truth about a simulated run; `leaks`: those of the experiment, all with coefficients."""
    at_samples, times = _sample_outputs(experiment), experiment.sample_times()
    outputs = {name: run[name][at_samples] for name in TRUE_OUTPUTS}
    if experiment.rig.line.k_clog_A > 0 or experiment.rig.line.k_clog_B > 0:
        # a rig with clogging filters has no servo valve: its two states stand for the oil that passed the filters
        outputs |= {"passed_A": run["x_s"][at_samples], "passed_B": run["v_s"][at_samples], "x_s": np.zeros(times.size)}
    outputs |= powers(outputs, experiment.rig)
    dp, dp_0 = run["p_A"] - run["p_B"], experiment.rig.line.dp_0
    mean_leak = 0.0
    for leak, thinned in zip(leaks, experiment.scale_with_viscosity(leaks), strict=True):
        # the mean is weighted by the opening 0..1 of `leak`, without the viscosity
        mean_leak += mean_while_open(leak, run.t, leak_flow(thinned, run.t, dp, dp_0))
    mean_leak_lpm = mean_leak / LITRE_PER_MINUTE
    return Truth(leaks, experiment.onset(), mean_leak_lpm, times, outputs, experiment.faults, experiment.drifts)


def powers(outputs: Mapping[str, Array], rig: Rig) -> dict[str, Array]:
    """Compute the powers [W] of a run: electrical into the motor, hydraulic from the pump, mechanical on the piston.

    `outputs`: outputs of the run by name (`TRUE_OUTPUTS`). In a rig with a servo valve, the first two powers belong to
    the motor and pump of the supply.
    """
    from sealscope.physics.cylinder import mechanical_power
    from sealscope.physics.motor import electric_power
    from sealscope.physics.pump import hydraulic_power

    A_A, A_B = rig.cylinder.A_A, rig.cylinder.A_B
    return {
        "P_electric": np.asarray(electric_power(outputs["V"], outputs["i"])),
        "P_hydraulic": np.asarray(hydraulic_power(outputs["Q_1"], outputs["p_1"] - outputs["p_2"])),
        "P_mechanical": np.asarray(mechanical_power(outputs["p_A"], outputs["p_B"], outputs["v"], A_A, A_B)),
    }


def compare_trajectories(experiment: Experiment, coarse: Trajectory, fine: Trajectory) -> tuple[Difference, ...]:
    """Compare two runs of an experiment, `coarse` at a solver step and `fine` at a shorter one.

    Both must have `oversampling` outputs per sample, as by `integrate_run` without a `rate`.

    Returns the differences, within the duration of the recording, of

    - speed, angle, position and velocity, by their rms difference, without a tolerance;
    - the four pressures, by their rms difference, which is to be at most the experiment's `error_allowed`;
    - the wavelet details d1 to d4 of p_A and p_B, by the change of their RMS, which includes the sensors' noise and is
      to be at most `DETAIL_TOLERANCE` times the RMS.
    """
    from sealscope.signals.details import QUANTITIES, details, mean_squares
    from sealscope.signals.windows import rms

    n, factor = round(experiment.duration * experiment.rate), oversampling(experiment)
    units = _STATES | dict.fromkeys(PRESSURES, "Pa")
    differences = []
    for name, unit in units.items():
        difference = rms(coarse[name][: n * factor] - fine[name][: n * factor])
        differences.append(Difference(name, difference, unit, experiment.error_allowed if unit == "Pa" else None))
    for name in CHAMBERS:
        noise_variance = getattr(experiment.rig.sensors, name).noise ** 2 + experiment.rig.sensors.common_noise**2
        coarse_details, fine_details = (details(decimate(run[name], factor, n)) for run in (coarse, fine))
        inside = coarse_details.inside()
        limits = [inside.start, inside.stop]  # one segment: `mean_squares` returns one row, [0]
        coarse_rms = np.sqrt(mean_squares(coarse_details, limits)[0] + noise_variance)
        fine_rms = np.sqrt(mean_squares(fine_details, limits)[0] + noise_variance)
        for level, quantity in enumerate(QUANTITIES[:4]):  # d1 to d4, not d3d4
            change = float(abs(coarse_rms[level] - fine_rms[level]))
            tolerance = float(DETAIL_TOLERANCE * fine_rms[level])
            differences.append(Difference(f"RMS of {quantity} of {name}", change, "Pa", tolerance))
    return tuple(differences)


@checked_call
def prove(experiment: Experiment, progress: Progress | None = None) -> Proof:
    """Check the solver's step: integrate an experiment at its step and at half of it, and compare.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    progress : callable, optional
        Called with the name of the current task (str) and its completed fraction (0 to 1).

    Returns
    -------
    Proof
        The change of each compared quantity with its tolerance: states, pressures, and RMS of wavelet details.

    Raises
    ------
    SimulationFailed
        The run diverged, or it is under-resolved or falls below vacuum and the experiment does not allow it.

    Examples
    --------
    >>> import sealscope as ss
    >>> ss.prove(ss.Experiment.of(duration="6 s")).resolved
    True
    """
    proof = simulate_experiment(experiment, progress, prove=True).proof
    assert proof is not None
    return proof


def write_truth(truth: Truth, path: str | os.PathLike[str]) -> None:
    """Write the truth about a run as JSON: leaks, onset [s], mean leak [L/min], faults and drifts, but no outputs."""
    tree: dict[str, Any] = {
        "onset_s": truth.onset_s,
        "mean_leak_lpm": truth.mean_leak_lpm,
        "leaks": [
            {"law": leak.law, "coefficient": leak.coefficient, "opening": str(leak.opening)} for leak in truth.leaks
        ],
    }
    if truth.faults:
        tree["faults"] = [
            {"kind": fault.kind, "words": str(fault), "onset_s": onset if math.isfinite(onset) else None}
            for fault, onset in [(fault, fault.onset()) for fault in truth.faults]
        ]
    if truth.drifts:
        tree["drifts"] = [_describe_drift(drift, truth.t) for drift in truth.drifts]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")


def _describe_drift(drift: ParameterDrift, t: Array) -> dict[str, Any]:
    """Describe a drift for JSON: its range (maximum minus minimum) over the times t [s], and its change over all of t.

    Both are in per cent of the parameter for a relative drift, else in the parameter's SI unit.
    """
    change = drift.shape.value_at(t)
    span, net_change = float(np.ptp(change)), float(change[-1] - change[0])
    if drift.absolute:
        return {"parameter": drift.parameter, "span": span, "start_to_end": net_change}
    return {"parameter": drift.parameter, "span_pct": 100.0 * span, "start_to_end_pct": 100.0 * net_change}


@take_fields_of(Arguments)
def simulate(arguments: Arguments) -> Recording:
    """Simulate a rig under a command, and record it with its instruments.

    A quantity is a number in the SI unit that the argument states, or a text with a unit ("3 min", "20[Pa]"), as on the
    command line.

    Returns
    -------
    Recording
        The readings of the instruments. `simulate_with_truth` returns the truth, too.

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
    return simulate_experiment(Experiment.of(**vars(arguments))).recording


@take_fields_of(Arguments)
def simulate_with_truth(arguments: Arguments) -> Run:
    """Simulate a rig as `simulate` does; return the recording and the truth.

    Returns
    -------
    Run
        `recording`; `truth`: leaks with their coefficients, onset, mean leak and outputs without noise.

    Raises
    ------
    InputError
        An argument breaks a rule, or is not known.
    SimulationFailed
        The run diverged, fell below vacuum, or is not resolved by its step.

    Examples
    --------
    >>> import sealscope as ss
    >>> run = ss.simulate_with_truth(leak="0.05 L/min from 1 s", duration=2.0)
    >>> run.truth.onset_s, round(run.truth.mean_leak_lpm, 3)
    (1.0, 0.05)
    """
    return simulate_experiment(Experiment.of(**vars(arguments)))
