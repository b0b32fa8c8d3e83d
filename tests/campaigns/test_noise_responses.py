"""Responses under instrument noise: the change is the scorers' own, error and scatter those of records."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sealscope.campaigns.prediction.detection import ChangeDetector, Responses, smallest_leaks
from sealscope.campaigns.prediction.responses import halves, instrument_noise, noise_responses
from sealscope.diagnosis.calibration.scorers import Look
from sealscope.parameters import load_rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.commands import parse_command
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.faults import From, Leak
from sealscope.simulation.sensitivity import clean_channels
from sealscope.units import LITRE_PER_MINUTE

DETECTORS = (
    ChangeDetector("d3", "p_A", "fell"),
    ChangeDetector("d4", "p_B", "changed"),
    ChangeDetector("d3d4", "p_A", "fell"),
)
SIZES = (0.004, 0.016)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    values = {"omega_per_volt": 26.7, "orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
    return Experiment(rig=load_rig("thesis").with_overrides(values), command=parse_command("7 sin(4t)"), duration=20.0)


@pytest.fixture(scope="module")
def noise(experiment: Experiment) -> Array:
    return instrument_noise(experiment, 24, 3)


@pytest.fixture(scope="module")
def found(experiment: Experiment, noise: Array) -> Responses:
    return noise_responses(experiment, SIZES, DETECTORS, noise)[0]


def look(clean: Array, noise: Array, rate: float) -> Look:
    channels = dict(zip(CHAMBERS, clean + noise, strict=True))
    return Look(Recording(np.arange(clean.shape[1]) / rate, channels, dict.fromkeys(CHAMBERS, "Pa"), rate))


def test_the_mean_is_that_of_the_scorers_own_changes(experiment: Experiment, noise: Array, found: Responses) -> None:
    """Every record made whole and scored; blocks differ by a sample in length, which moves a change by 1e-4."""
    runs = [clean_channels(experiment)]
    dp = float(np.mean(np.abs(runs[0][0, 5000:] - runs[0][1, 5000:])))
    for size in SIZES:
        leak = Leak("laminar", coefficient=size * LITRE_PER_MINUTE / dp, opening=From(10.0))
        runs.append(clean_channels(experiment, (leak,)))
    table = np.array(
        [
            [[one.change(seen) for one in DETECTORS] for record in noise for seen in (look(run, record, 500.0),)]
            for run in runs
        ]
    )
    assert found.mean == pytest.approx(table.mean(axis=1), abs=3e-4)
    shifts = (table - table[0]).std(axis=1, ddof=1) / math.sqrt(len(noise))
    assert found.error is not None
    assert found.error == pytest.approx(shifts, rel=0.1, abs=1e-5)
    ratio = table.std(axis=1, ddof=1) / found.scatter
    assert np.all((ratio > 0.6) & (ratio < 1.5))


def test_a_shift_has_no_error_without_a_leak_and_less_than_the_scatter_with_one(found: Responses) -> None:
    assert found.error is not None
    assert np.all(found.error[0] == 0.0)
    assert np.all(found.error[1:] > 0.0)
    assert np.all(found.error[1:] < found.scatter[1:] / math.sqrt(24))  # the noise is common to both, and cancels


def test_a_leak_that_damps_the_ringing_leaves_more_noise_in_it(found: Responses) -> None:
    assert found.mean[2, 0] < found.mean[1, 0] < found.mean[0, 0]
    assert found.scatter[2, 0] > found.scatter[1, 0] > found.scatter[0, 0]


def test_blocks_cover_what_the_scorers_compare() -> None:
    first, second = halves(10_000, 500.0)
    assert first[0] == 250  # a twentieth of the first half is left out, as the machine starts
    assert first[-1] < 5000 < second[0]
    assert second[-1] < 10_000
    assert halves(100_000, 500.0)[0][0] == 1000  # ... but no more than 2 s


def test_the_interval_holds_the_answer_of_more_records(experiment: Experiment) -> None:
    """Nine predictions from 12 records each: their 90 % intervals hold the figure of all 108 in six or more."""
    noise = instrument_noise(experiment, 108, 8)
    (whole,) = smallest_leaks(noise_responses(experiment, SIZES, DETECTORS[:1], noise)[0], DETECTORS[:1], 0.05)
    assert whole.smallest is not None
    held = 0
    for part in np.split(noise, 9):
        (one,) = smallest_leaks(noise_responses(experiment, SIZES, DETECTORS[:1], part)[0], DETECTORS[:1], 0.05)
        held += one.low is not None and one.low <= whole.smallest <= (one.high or math.inf)
    assert held >= 6


def test_an_error_of_the_mean_widens_the_interval(found: Responses) -> None:
    def width(error: float) -> float:
        table = np.array([[0.0], [-0.02], [-0.2]])
        made = Responses(np.array([0.001, 0.01]), table, np.full((3, 1), 0.01), 400, 4000, error=error * np.abs(table))
        (one,) = smallest_leaks(made, DETECTORS[:1], 0.01)
        assert one.low is not None and one.high is not None
        return math.log(one.high / one.low)

    assert width(0.2) > 3 * width(0.0)
