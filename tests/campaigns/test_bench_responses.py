"""Predictions from machines of a bench: what is drawn, what the caller's values keep, what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from sealscope.campaigns.prediction import responses as room
from sealscope.campaigns.prediction.detection import ChangeDetector, Responses
from sealscope.campaigns.prediction.predict import experiment_for
from sealscope.campaigns.prediction.responses import bench_responses, fixed_levels, instrument_noise, noise_responses
from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import Rig, load_rig
from sealscope.simulation.bench.machines import BenchMachine
from sealscope.simulation.commands import Sine
from sealscope.simulation.experiment import Experiment

DETECTORS = (ChangeDetector("d3", "p_A", "fell"), ChangeDetector("d4", "p_B", "changed"))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A bench of machines that differ in viscous friction and would have noisy sensors; the seeds it was asked for."""
    asked: list[int] = []

    def draw(profile: str, seed: int, *, rig: Rig, duration: float, family: str) -> BenchMachine:
        assert family == ""
        asked.append(seed)
        share = np.random.default_rng(seed).uniform(0.9, 1.1)
        values = {"friction.F_v": 300.0 * share, "sensors.p_A.noise": 9e4}
        return BenchMachine(profile, seed, rig, duration, values, (), Sine(8.0, 1.0), 0.0)

    monkeypatch.setattr("sealscope.simulation.bench.machines.draw", draw)
    monkeypatch.setattr(room, "in_parallel", lambda jobs, label, progress: [job() for job in jobs])
    return asked


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    settings = {"omega_per_volt": 26.7, "G_pump": 2.4e-13, "sensors.p_A.noise": 3e3}
    rig = load_rig("thesis").with_overrides(settings, source="set by --set")
    return experiment_for(rig, "7 sin(4t)", 20.0)


def responses_of(experiment: Experiment, draws: int, seed: int = 0) -> Responses:
    return bench_responses(experiment, "bench", draws, seed, 0.01, DETECTORS, sizes=(0.01,))


def test_the_callers_values_and_command_stand_against_the_draw(experiment: Experiment) -> None:
    kept = fixed_levels(experiment)
    assert kept["command"] == "7 sin(4t)"
    assert kept["sensors.p_A.noise"] == 3e3
    assert kept["line.orifices"] == "absent"
    assert "friction.F_v" not in kept


def test_each_machine_is_run_with_every_size(
    experiment: Experiment, bench: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[Experiment] = []
    changes = room._changes

    def watched(one: Experiment, detectors: Sequence[ChangeDetector]) -> Any:
        runs.append(one)
        return changes(one, detectors)

    monkeypatch.setattr(room, "_changes", watched)
    found = responses_of(experiment, 8)
    assert found.records == 8
    assert found.mean.shape == found.scatter.shape == (2, 2)
    assert len(runs) == 16
    pairs = list(zip(runs[::2], runs[1::2], strict=True))
    assert all(free.rig == leaky.rig and free.seed == leaky.seed for free, leaky in pairs)
    assert all(not free.leaks and leaky.leaks[0].opening.onset() == 10.0 for free, leaky in pairs)
    assert len({free.rig.friction.F_v for free, _ in pairs}) == 8
    assert all(free.rig.sensors.p_A.noise == 3e3 and str(free.command) == "7 sin(4t)" for free, _ in pairs)
    assert found.sizes[0] == pytest.approx(0.01, rel=0.1)
    assert found.mean[1, 0] < found.mean[0, 0]


def test_seeds_make_the_machines(experiment: Experiment, bench: list[int]) -> None:
    one, same, other = (responses_of(experiment, 8, seed) for seed in (3, 3, 4))
    assert np.array_equal(one.mean, same.mean)
    assert not np.array_equal(one.mean, other.mean)


def test_too_few_machines_and_machines_that_cannot_run_are_refused(
    experiment: Experiment, bench: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="draws must be 8 to 100000 machines, got 4"):
        responses_of(experiment, 4)

    def failing(one: Experiment, detectors: object) -> Any:
        raise SimulationFailed("p_A must stay above vacuum")

    monkeypatch.setattr(room, "_changes", failing)
    with pytest.raises(SimulationFailed, match="8 of 8 machines of the bench could not be run: p_A must"):
        responses_of(experiment, 8)


def test_the_packaged_bench_adds_drift_to_the_scatter(experiment: Experiment) -> None:
    """Same rig, same command: the changes of machines that drift within the record scatter more than noise alone."""
    alone = noise_responses(experiment, (0.01,), DETECTORS, instrument_noise(experiment, 8, 0))[0].scatter[0]
    found = bench_responses(experiment, "bench", 10, 0, 0.01, DETECTORS, sizes=(0.01,))
    assert found.records == 10
    assert np.all(np.isfinite(found.mean))
    assert found.scatter[0, 0] > alone[0]
    assert found.sizes[0] == pytest.approx(0.01, rel=0.15)
