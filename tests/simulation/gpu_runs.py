"""Batches for the GPU's tests, run as a program too: `python gpu_runs.py DEVICE FILE` keeps what they give.

As a program because numba's simulator of a GPU is chosen before numba is imported.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from sealscope.simulation.batch.batch import Batch, simulate_batch
from sealscope.simulation.experiment import Experiment


def free() -> list[Experiment]:
    """Three runs without throttles that differ in rig, command, leak and seed; hum, a walk, one late channel."""
    leaks = (None, "G = 6e-13 from 0.3 s", "C = 2e-10 growing from 0.2 s to 0.5 s")
    values = {"sensors.p_A.hum": 2e3, "sensors.p_A.drift": 50.0, "sensors.p_B.gain_error": 0.01}
    late = ({}, {"sensors.p_B.delay": "0.7 [ms]"}, {})
    return [
        Experiment.of(
            set={**values, **late[k], "friction.F_v": 280.0 + 20.0 * k},
            command=f"{2 + 0.2 * k} sin(4t) + 0.05", leak=leak, duration=0.7, seed=k, step=1e-3,
        )
        for k, leak in enumerate(leaks)
    ]  # fmt: skip


def throttled() -> list[Experiment]:
    """Two runs with throttles, position-dependent volumes; in one the friction jumps."""
    values = {
        "line.orifices": "present",
        "cylinder.volumes": "position",
        "fluid.air": 0.005,
        "fluid.p_charge": "1 [MPa]",
    }
    return [
        Experiment.of(set=values, command="3 sin(4t)", fault=fault, duration=0.6, seed=k, step=1e-3)
        for k, fault in enumerate([None, "friction x1.5 from 0.305 s"])
    ]


def sized() -> list[Experiment]:
    """A leak that is found from its mean flow."""
    return [Experiment.of(command="3 sin(4t)", leak="0.05 L/min from 0.1 s", duration=0.3, step=1e-3)]


def batches(device: str) -> Iterator[tuple[str, Batch]]:
    """What the runs give on a device."""
    yield "free", simulate_batch(free(), bounds=[0.0, 0.3, 0.7], device=device)
    yield "throttled", simulate_batch(throttled(), bounds=[0.0, 0.6], device=device)
    yield "sized", simulate_batch(sized(), device=device)


if __name__ == "__main__":
    found = {}
    for name, batch in batches(sys.argv[1]):
        found |= {f"{name} rms": batch.rms, f"{name} flow": batch.mean_leak_lpm, f"{name} size": batch.coefficients}
    np.savez(sys.argv[2], **found)
