"""Observables that no volume balance contains and that a leak does not change.

They are the amplitudes of command and motion (duty), noise, hum, sign and levels of the pressures. Called for each
recording, whichever detector measures the leak.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from sealscope.diagnosis.inference.changes.features import BLOCKS, ORDER, duty_tests, sensor_tests
from sealscope.diagnosis.inference.changes.levels import LevelChange, level_tests
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.onset import Interval, StepTest
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.recording import Recording, compute_once

SIGNALS = "signals"


def observe_signals(recording: Recording) -> Observed:
    """Test duty, sensors and mean pressures of a recording for sudden lasting changes that a leak does not cause.

    The duty is how far the machine is commanded to move. The report is computed only once for a recording.
    """
    return compute_once(recording, (SIGNALS,), _test_signals)


@np.errstate(all="ignore")
def _test_signals(recording: Recording) -> Observed:
    """Test duty, sensors and pressure levels for steps; if the recording is too short, report only this reason."""
    shortest = CHANGES.features.shortest  # length of a block [s]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):  # differences of `ORDER` need samples
        return Observed(SIGNALS, lack="too short for changes of its signals")
    observables = run_tests(
        lambda: duty_observables(duty_tests(recording)),
        lambda: sensor_observables(sensor_tests(recording)),
        lambda: level_observables(level_tests(recording)),
    )
    return Observed(SIGNALS, observables)


def run_tests(*tests: Callable[[], Iterator[Observable]]) -> tuple[Observable, ...]:
    """Run all tests and collect the observables that they yield.

    If numbers overflow or a matrix is singular in a test, this test ends early, and its observables so far are kept.
    """
    observables: list[Observable] = []
    for test in tests:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            observables += test()
    return tuple(observables)


#: Minimum ratio of the smaller to the larger of two steps (a, b). As an angle of the vector (a, b) it is half way
#: between a single step, 0 degrees, and equal steps, 45 degrees.
_MIN_STEP_RATIO = math.tan(math.pi / 8.0)


def duty_observables(tests: Sequence[StepTest]) -> Iterator[Observable]:
    """Yield an observable of a step of the duty if the amplitudes of command and motion change by similar ratios.

    `tests`: step tests of the log amplitudes of command and motion (`duty_tests`). The smaller step must exceed
    `_MIN_STEP_RATIO` times the larger one. Otherwise nothing is yielded, since a leak changes only one of the
    amplitudes. Score, onset and size are those of the test with the lower score. The p-value is twice the higher
    p-value of the tests, since each test covers a rise and a fall.
    """
    steps = np.abs([test.fitted.size for test in tests])
    if tests and steps.min() > _MIN_STEP_RATIO * steps.max():
        weakest = min(tests, key=lambda test: test.score)
        least_certain = max(tests, key=lambda test: test.chance)
        yield Observable(
            name="size of the duty",
            data="duty",
            score=weakest.score,
            chance=min(1.0, 2.0 * least_certain.chance),
            onset=weakest.onset(),
            size=weakest.fitted.size,
        )


def sensor_observables(tests: Iterable[tuple[str, StepTest]]) -> Iterator[Observable]:
    """Convert step tests of sensor features, such as noise and hum, to observables.

    `tests`: pairs of a feature's name and its test (`sensor_tests`). The first word of the name is the kind of data.
    Each test is the better of a rise and a fall, so its p-value is doubled.
    """
    for name, test in tests:
        yield Observable.from_test(name, name.split()[0], test, n_tests=2.0)


#: Largest exponent whose exponential fits into a float.
_MAX_EXPONENT = 700.0


def level_observables(changes: Sequence[LevelChange]) -> Iterator[Observable]:
    """Convert tests for steps of the pressure levels to observables.

    `changes`: one test for each pattern of levels, the highest rank first. The rank (`LevelChange`) becomes the score.
    The p-value of change k is chance_k = min(1, chance_1 exp(rank_1 - rank_k)). Half of the exponent rank_1 - rank_k is
    the log Bayes factor of change 1 over change k (Schwarz's approximation), the other half a prior against patterns
    that need further coefficients. The interval of an onset is one block to either side.
    """
    for change in changes:
        onset = Interval(change.onset, change.onset - change.block, change.onset + change.block)
        deficit = min(changes[0].rank - change.rank, _MAX_EXPONENT)
        chance = min(1.0, changes[0].chance * float(np.exp(deficit)))
        yield Observable(name=change.name, data="levels", score=change.rank, chance=chance, onset=onset)
