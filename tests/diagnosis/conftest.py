"""Simulated records for the checks of this room: each trajectory is integrated once, its noise is drawn anew a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import record
from sealscope.simulation.integrate import oversampling, run_with_sized_leaks

THROTTLED = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
Records = Callable[..., Recording]


@pytest.fixture(scope="session")
def records() -> Records:
    """One record of a case; equal cases share their trajectory and differ in the noise of `seed` alone.

    Equal records are one object, with which what is computed of it is kept.
    """

    @lru_cache(maxsize=4)
    def case(command: str, leak: str | None, duration: float, throttled: bool):  # type: ignore[no-untyped-def]
        experiment = Experiment.of(command=command, leak=leak, duration=duration, set=THROTTLED if throttled else None)
        _, path = run_with_sized_leaks(experiment)
        return experiment, path, experiment.command.volts(experiment.sample_times()), oversampling(experiment)

    @lru_cache(maxsize=16)
    def make(
        seed: int,
        *,
        command: str = "3 sin(4t)",
        leak: str | None = None,
        duration: float = 180.0,
        throttled: bool = False,
    ) -> Recording:
        experiment, path, volts, factor = case(command, leak, duration, throttled)
        return record(replace(experiment, seed=seed), path, volts, factor)

    return make


@pytest.fixture(scope="session")
def leaky(records: Records) -> Recording:
    """120 s with a leak of 0.0042 L/min from second 60, throttles half closed."""
    return records(1, leak="0.0042 L/min from 60 s", duration=120.0, throttled=True)


@pytest.fixture(scope="session")
def healthy(records: Records) -> Recording:
    """120 s without a leak, throttles half closed."""
    return records(2, duration=120.0, throttled=True)


@pytest.fixture(scope="session")
def noise_record() -> Callable[..., Recording]:
    """White noise in both chambers, nothing else."""

    def make(seed: int, n: int = 30000, rate: float = 500.0) -> Recording:
        random = np.random.default_rng(seed)
        channels = {name: random.standard_normal(n) for name in ("p_A", "p_B")}
        return Recording(np.arange(n) / rate, channels, {"p_A": "Pa", "p_B": "Pa"}, rate)

    return make
