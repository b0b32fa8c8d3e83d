"""Simulate an experiment: size its leaks, integrate, record as the instruments would, and keep the truth apart."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call, with_arguments_of
from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.recordings.recording import CHANNEL_UNITS, Array, Recording
from sealscope.simulation.arguments import Arguments
from sealscope.simulation.changes import ParameterDrift
from sealscope.simulation.experiment import PRESSURE_TOLERANCE, Experiment
from sealscope.simulation.faults import Fault
from sealscope.simulation.instruments import decimate, record
from sealscope.simulation.integrate import DETAIL_TOLERANCE, Trajectory, oversampling, sized_run, trajectory
from sealscope.simulation.leaks import Leak
from sealscope.simulation.sizing import leak_flow, mean_while_open
from sealscope.storage.atomic import atomic_write
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Called with what is being done and how far it is, 0..1.
Progress = Callable[[str, float], None]
#: What the truth of a run holds at each sample, beside the powers (`powers`).
TRUE_OUTPUTS = (
    *("omega", "theta", "x", "v", "p_A", "p_B", "p_1", "p_2", "Q_1", "Q_A", "Q_B", "q_leak", "q_ext", "q_up"),
    *("x_s", "i", "V"),
)
#: States that a proof compares, and the unit of each.
_STATES = {"omega": "rad/s", "theta": "rad", "x": "m", "v": "m/s"}


@dataclass(frozen=True)
class Truth:
    """The truth of a run, which no rig would tell: leaks, faults, drifts, and states without noise at the samples.

    `onset_s` and the mean are those of the leaks across the piston.
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
    """The change of one quantity: `difference` and `tolerance` (None: reported only) in `unit`."""

    name: str
    difference: float
    unit: str
    tolerance: float | None

    @property
    def resolved(self) -> bool:
        """True if the difference is within its tolerance."""
        return self.tolerance is None or self.difference <= self.tolerance


@dataclass(frozen=True)
class Proof:
    """The halving test of one experiment: the two steps [s] and every difference."""

    method: str
    step: float
    halved: float
    differences: tuple[Difference, ...]

    @property
    def resolved(self) -> bool:
        """True if every difference is within its tolerance."""
        return all(difference.resolved for difference in self.differences)

    def text(self) -> str:
        """Format the proof as lines of text: each change and its limit."""
        lines = [f"halving the step ({self.method}, {self.step:.3g} s to {self.halved:.3g} s) moves"]
        for row in self.differences:
            limit = "" if row.tolerance is None else f" (at most {row.tolerance:.3g})"
            lines.append(
                f"  {row.name:<18} {row.difference:10.3g} {row.unit}{limit}{'' if row.resolved else '  NOT RESOLVED'}"
            )
        return "\n".join(lines)

    def worst(self) -> Difference:
        """Find the difference furthest beyond, or nearest to, its tolerance."""
        limited = [row for row in self.differences if row.tolerance]
        return max(limited, key=lambda row: row.difference / (row.tolerance or math.inf))


@dataclass(frozen=True)
class Run:
    """A simulated experiment: the recording, its truth, and the proof where one was asked for."""

    recording: Recording
    truth: Truth
    proof: Proof | None = None

    def lines(self) -> list[str]:
        """Describe the run in lines: its solver and step, leaks, other faults, and mean flows."""
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
    """Simulate an experiment, and keep its truth apart from the recording.

    Parameters
    ----------
    experiment : Experiment
        What is simulated, as `Experiment.of` makes it.
    progress : callable, optional
        Called with what is being done (str) and how far it is (0 to 1).
    prove : bool, optional
        Integrate again at half the step, and compare (`Proof`).

    Returns
    -------
    Run
        `recording`; `truth`: leaks with their coefficients, onset, mean leak and every state without noise; `proof`,
        None unless `prove`.

    Raises
    ------
    InputError
        The experiment is impossible, such as a leak larger than the pump's flow.
    SimulationFailed
        The run diverged, fell below vacuum, or is not resolved by its step; with `prove`, also where halving the step
        moves more than it may, unless the experiment allows it.
    """
    if not isinstance(experiment, Experiment):
        raise InputError(f"experiment must be an Experiment (Experiment.of(...) makes one), got {experiment!r}")

    def report(what: str) -> Callable[[float], None]:
        def tell(reached: float) -> None:
            if progress is not None:
                progress(what, min(1.0, reached / experiment.duration))

        return tell

    leaks, path = sized_run(experiment, progress, report("simulating"))
    proof = None
    if prove:
        fine = trajectory(experiment, leaks, step=path.step / 2, progress=report("proving: half the step"))
        proof = Proof(path.method, path.step, fine.step, compare(experiment, path, fine))
        if not (proof.resolved or experiment.allow_unresolved):
            worst = proof.worst()
            raise SimulationFailed(
                f"the run is under-resolved: halving the step of {path.step:.3g} s ({path.method}) moves {worst.name} "
                f"by {worst.difference:.4g} {worst.unit}, which must be <= {worst.tolerance:.4g} {worst.unit}; take a "
                "smaller step"
            )
    n, factor = round(experiment.duration * experiment.rate), oversampling(experiment)
    times = experiment.sample_times()
    volts = experiment.commanded.volts(times) if path.volts is None else path.volts[: n * factor : factor]
    recorded = record(experiment.rig, path, volts, factor, experiment.seed, experiment.readings())
    solver = {"method": path.method, "step_s": path.step, "allow_unresolved": experiment.allow_unresolved}
    if experiment.step is None:
        solver["error_pa"] = experiment.error_allowed
    provenance: dict[str, Any] = {
        "origin": "simulation",
        "experiment": experiment.describe(),
        "experiment_key": experiment.key(),
        "solver": solver | {"error_found_pa": path.error},
    }
    history = (f"simulated with {path.method}, h = {path.step:.4g} s; sampled at {experiment.rate:g} Hz",)
    channels = dict(recorded.channels)
    if path.compensated is not None:
        channels["q_comp"] = path.compensated[: n * factor : factor]
    units = {name: CHANNEL_UNITS[name] for name in channels}
    recording = replace(recorded, channels=channels, units=units, provenance=provenance, history=history)
    outputs = {name: path[name][: n * factor : factor] for name in TRUE_OUTPUTS}
    if experiment.rig.line.k_clog_A > 0 or experiment.rig.line.k_clog_B > 0:
        outputs |= {
            f"passed_{side}": path[place][: n * factor : factor] for side, place in (("A", "x_s"), ("B", "v_s"))
        }
        outputs["x_s"] = np.zeros(n)
    outputs |= powers(outputs, experiment.rig)
    dp, dp_0 = path["p_A"] - path["p_B"], experiment.rig.line.dp_0
    flows = (leak_flow(leak, path.t, dp, dp_0) for leak in experiment.flowing(leaks))
    mean = sum(mean_while_open(leak, path.t, flow) for leak, flow in zip(leaks, flows, strict=True)) / LITRE_PER_MINUTE
    truth = Truth(leaks, experiment.onset(), mean, times, outputs, experiment.faults, experiment.drifts)
    return Run(recording, truth, proof)


def powers(outputs: Mapping[str, Array], rig: Rig) -> dict[str, Array]:
    """Compute the powers [W] of a run: into the motor, from the pump into the oil, from the pressures to the piston.

    A servo valve's pump feeds the supply: its power is that of the supply.
    """
    from sealscope.physics.cylinder import mechanical_power
    from sealscope.physics.motor import electric_power
    from sealscope.physics.pump import hydraulic_power

    o, c = outputs, rig.cylinder
    return {
        "P_electric": np.asarray(electric_power(o["V"], o["i"])),
        "P_hydraulic": np.asarray(hydraulic_power(o["Q_1"], o["p_1"] - o["p_2"])),
        "P_mechanical": np.asarray(mechanical_power(o["p_A"], o["p_B"], o["v"], c.A_A, c.A_B)),
    }


def compare(experiment: Experiment, coarse: Trajectory, fine: Trajectory) -> tuple[Difference, ...]:
    """Compare two trajectories: rms of each channel, and change of each detail's RMS."""
    from sealscope.signals.details import QUANTITIES, details, mean_squares
    from sealscope.signals.windows import rms

    n, factor = round(experiment.duration * experiment.rate), oversampling(experiment)
    units = _STATES | dict.fromkeys(PRESSURES, "Pa")
    differences = [
        Difference(
            name,
            rms(coarse[name][: n * factor] - fine[name][: n * factor]),
            unit,
            PRESSURE_TOLERANCE if unit == "Pa" else None,
        )
        for name, unit in units.items()
    ]
    for name in CHAMBERS:
        noise = getattr(experiment.rig.sensors, name).noise ** 2 + experiment.rig.sensors.common_noise**2
        transformed = [details(decimate(run[name], factor, n)) for run in (coarse, fine)]
        inside = transformed[0].inside()
        ours, theirs = (np.sqrt(mean_squares(levels, [inside.start, inside.stop])[0] + noise) for levels in transformed)
        for quantity, a, b in zip(QUANTITIES[:4], ours, theirs, strict=False):
            differences.append(
                Difference(f"RMS of {quantity} of {name}", float(abs(a - b)), "Pa", float(DETAIL_TOLERANCE * b))
            )
    return tuple(differences)


@checked_call
def prove(experiment: Experiment, progress: Progress | None = None) -> Proof:
    """Integrate an experiment at its step and at half of it, and compare.

    Parameters
    ----------
    experiment : Experiment
        What is simulated.
    progress : callable, optional
        Called with what is being done (str) and how far it is (0 to 1).

    Returns
    -------
    Proof
        How far each channel and each detail's RMS moved, and how far it may.

    Raises
    ------
    SimulationFailed
        The run is under-resolved, which the message explains with the worst difference, unless the experiment allows
        it.

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
    """Write the truth of a run as JSON.

    Leaks with their coefficients, onset [s], mean leak while open [L/min], other faults with their onsets [s], and what
    drifted from the start to the end, in per cent (or in the SI unit).
    """
    tree: dict[str, Any] = {
        "onset_s": truth.onset_s,
        "mean_leak_lpm": truth.mean_leak_lpm,
        "leaks": [
            {"law": leak.law, "coefficient": leak.coefficient, "opening": str(leak.opening)} for leak in truth.leaks
        ],
    }
    if truth.faults:
        tree["faults"] = [
            {
                "kind": fault.kind,
                "words": str(fault),
                "onset_s": onset if math.isfinite(onset := fault.onset()) else None,
            }
            for fault in truth.faults
        ]
    if truth.drifts:
        tree["drifts"] = [_drift_of(drift, truth.t) for drift in truth.drifts]
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")


def _drift_of(drift: ParameterDrift, t: Array) -> dict[str, Any]:
    change = drift.shape.value_at(t)
    span, end = float(np.ptp(change)), float(change[-1] - change[0])
    if drift.absolute:
        return {"parameter": drift.parameter, "span": span, "start_to_end": end}
    return {"parameter": drift.parameter, "span_pct": 100.0 * span, "start_to_end_pct": 100.0 * end}


@with_arguments_of(Arguments)
def simulate(arguments: Arguments) -> Recording:
    """Simulate a rig under a command and record it as its instruments would.

    A quantity is a number in the SI unit stated below, or a text with a unit of its own ("3 min", "20[Pa]"), as on the
    command line.

    Returns
    -------
    Recording
        What the instruments recorded. `simulate_with_truth` returns the truth, too.

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


@with_arguments_of(Arguments)
def simulate_with_truth(arguments: Arguments) -> Run:
    """Simulate a rig as `simulate` does, and return its truth with the recording.

    Returns
    -------
    Run
        `recording`; `truth`: leaks with their coefficients, onset, mean leak and every state without noise.

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
