"""The context in which an item of the reproduction is made: simulated runs, data sheet, other items' products."""

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
from sealscope.storage.folders import lock_file
from sealscope.thesis.engine.products import Claim, Product, ThesisTable
from sealscope.thesis.sheet import DataSheet

Products = tuple[Product | Claim, ...]


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """The result of one simulated run, which may have failed: `recording` is then None, and `t`, `outputs` are empty.

    `t` [s], `outputs`: noise-free outputs at the samples; `mean_leak_lpm`: mean leak while open [L/min], 0 if the run
    failed; `resolved`: True if it changed little when the solver's step was halved, False if not or if it failed, None
    if this was not tested; `step_changes`: changes of states, pressures and details by this halving [SI], by name;
    `diverged`: one-line reason of a failed run, "" for none.
    """

    recording: Recording | None
    t: Array
    outputs: Mapping[str, Array]
    mean_leak_lpm: float
    resolved: bool | None
    step_changes: Mapping[str, float] = field(default_factory=dict)
    diverged: str = ""

    @property
    def recorded(self) -> Recording:
        """The recording of the run; raises SimulationFailed if the run failed."""
        if self.recording is None:
            raise SimulationFailed(self.diverged)
        return self.recording


def simulate_run(experiment: Experiment, prove: bool) -> SimulatedRun:
    """Simulate an experiment, and return a failed run as a result instead of raising an error.

    `prove`: True to repeat the run with half the solver's step; a large change does not count as a failure.
    """
    try:
        simulated = simulate_experiment(replace(experiment, allow_unresolved=True), prove=prove)
    except SimulationFailed as error:
        resolved = False if prove else None
        return SimulatedRun(None, np.empty(0), {}, mean_leak_lpm=0.0, resolved=resolved, diverged=str(error))
    truth, proof = simulated.truth, simulated.proof
    differences = {} if proof is None else {change.name: change.difference for change in proof.differences}
    resolved = None if proof is None else proof.resolved
    return SimulatedRun(simulated.recording, truth.t, truth.outputs, truth.mean_leak_lpm, resolved, differences)


@dataclass(frozen=True)
class Context:
    """The inputs of the function that makes an item: simulated runs, the data sheet, products of other items.

    `name`: id of the item; `needs`: ids of the items it needs; `products`: products of these items by id, without
    failed items; `quick`: True to simulate less; `sheet`: measured data sheet, None if not given or not used by the
    item; `runs`: folder of simulated runs, shared by the processes of one reproduction.
    """

    name: str
    needs: tuple[str, ...]
    quick: bool
    sheet: DataSheet | None
    products: Mapping[str, Products]
    runs: Path

    def run(self, experiment: Experiment, *, prove: bool = True) -> SimulatedRun:
        """Simulate an experiment, or load its run if another item of this reproduction has simulated it.

        `prove`: True to repeat the run with half the solver's step. Other processes that ask for the same run wait.
        """
        path = self.runs / f"{experiment.key()}{'-proved' if prove else ''}.run"
        with lock_file(path.with_suffix(".lock"), busy=None):  # None: waits without a limit
            if not path.exists():
                with atomic_write(path) as temporary:
                    temporary.write_bytes(pickle.dumps(simulate_run(experiment, prove)))
            run: SimulatedRun = pickle.loads(path.read_bytes())
        return run

    def product(self, name: str) -> Products:
        """Return the products of the needed item `name`; () if it was left out.

        Raises InputError if the needed item failed, or if the item to be made does not name it in its `needs`.
        """
        if name not in self.needs:
            raise InputError(f"{self.name} must list {name} in `needs` to use the products of {name}")
        if name not in self.products:
            raise InputError(f"needs {name}, which failed")
        return self.products[name]


def first_table(context: Context, item: str) -> ThesisTable:
    """Return the first table of the needed item `item`; raise InputError if that failed, was left out or made none."""
    table = next((product for product in context.product(item) if isinstance(product, ThesisTable)), None)
    if table is None:
        raise InputError(f"{item} must make a table, which another item needs, got none")
    return table
