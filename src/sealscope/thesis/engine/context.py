"""Inputs of a maker of figures and tables: simulated runs, the measured sheet, other items, a quick version."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment
from sealscope.storage.atomic import atomic_write
from sealscope.storage.folders import locked
from sealscope.thesis.engine.products import Claim, Product, ThesisTable
from sealscope.thesis.sheet import DataSheet

Products = tuple[Product | Claim, ...]


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """The result of a run.

    The recording, the true outputs at its samples (`simulation.simulate.TRUE_OUTPUTS`), the mean leak, and whether
    halving the step moved no channel too far (None: not tested), by how much each moved (`proof`). `diverged` holds the
    one-line reason of a run that failed; recording and outputs are then empty.
    """

    recording: Recording | None
    t: Array
    outputs: Mapping[str, Array]
    mean_leak_lpm: float
    resolved: bool | None
    proof: Mapping[str, float] = field(default_factory=dict)
    diverged: str = ""

    @property
    def recorded(self) -> Recording:
        """The recording; raises SimulationFailed with the reason where there is none."""
        if self.recording is None:
            raise SimulationFailed(self.diverged)
        return self.recording


def simulated_run(experiment: Experiment, prove: bool) -> SimulatedRun:
    """Simulate a run, and `prove` it at half the step; a diverged or unresolved run is marked so."""
    try:
        simulated = simulate_experiment(replace(experiment, allow_unresolved=True), prove=prove)
    except SimulationFailed as error:
        return SimulatedRun(None, np.empty(0), {}, 0.0, False if prove else None, diverged=str(error))
    truth, proof = simulated.truth, simulated.proof
    differences = {} if proof is None else {change.name: change.difference for change in proof.differences}
    resolved = None if proof is None else proof.resolved
    return SimulatedRun(simulated.recording, truth.t, truth.outputs, truth.mean_leak_lpm, resolved, differences)


@dataclass(frozen=True)
class Context:
    """The inputs handed to an item's maker.

    `sheet`: the measured sheet, None where it was not given or the item does not use it; `products`: those of the items
    that it needs, by id, without those that failed; `runs`: folder of this call's runs, which its processes share.
    """

    name: str
    needs: tuple[str, ...]
    quick: bool
    sheet: DataSheet | None
    products: Mapping[str, Products]
    runs: Path

    def run(self, experiment: Experiment, *, prove: bool = True) -> SimulatedRun:
        """Return the run of an experiment, simulated once while other processes that need it wait."""
        path = self.runs / f"{experiment.key()}{'-proved' if prove else ''}.run"
        with locked(path.with_suffix(".lock"), None):
            if not path.exists():
                with atomic_write(path) as temporary:
                    temporary.write_bytes(pickle.dumps(simulated_run(experiment, prove)))
            run: SimulatedRun = pickle.loads(path.read_bytes())
        return run

    def product(self, name: str) -> Products:
        """Return the products of a needed item, () where it is left out."""
        if name not in self.needs:
            raise InputError(f"{self.name} must name {name} among its needs to ask for its products")
        if name not in self.products:
            raise InputError(f"needs {name}, which failed")
        return self.products[name]


def first_table(context: Context, item: str) -> ThesisTable:
    """Return the first table among the products of an item."""
    return next(product for product in context.product(item) if isinstance(product, ThesisTable))
