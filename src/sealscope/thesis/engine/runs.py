"""Simulate the run that a RunSpec describes."""

from __future__ import annotations

import numpy as np

from sealscope.errors import SimulationFailed
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.thesis.engine.context import RunSpec, SimulatedRun


def experiment_of(spec: RunSpec) -> Experiment:
    """Make the experiment that a spec describes; raise InputError for one that cannot be."""
    return Experiment.of(
        rig=spec.rig,
        command=spec.command,
        leak=spec.leaks,
        set=dict(spec.values),
        duration=spec.duration,
        seed=spec.seed,
        x_0=spec.x_0,
        method=spec.method,
        step=spec.step,
        allow_unresolved=True,
    )


def simulated_run(spec: RunSpec, experiment: Experiment) -> SimulatedRun:
    """Simulate the run of a spec, with its halving test where the spec asks for it."""
    try:
        simulated = simulate_with_truth(experiment, prove=spec.prove)
    except SimulationFailed as error:
        return SimulatedRun(None, np.empty(0), {}, 0.0, False if spec.prove else None, diverged=str(error))
    proof = simulated.proof
    moved = {} if proof is None else {change.name: change.difference for change in proof.differences}
    resolved = None if proof is None else proof.resolved
    return SimulatedRun(
        simulated.recording, simulated.truth.t, simulated.truth.outputs, simulated.truth.mean_leak_lpm, resolved, moved
    )
