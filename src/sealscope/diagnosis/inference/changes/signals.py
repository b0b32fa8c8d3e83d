"""Observables that no volume balance contains: duty (motion and load), noise, hum, sense and levels of the pressures.

A leak changes none of them. Called for each recording, whichever provider measures the leak.
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

    The duty is how the machine is moved and loaded. The report is computed only once for a recording.
    """
    return compute_once(recording, (SIGNALS,), _test_signals)


@np.errstate(all="ignore")
def _test_signals(recording: Recording) -> Observed:
    """Test commanded motion, sensors and pressure levels for steps; the report is empty for too short a recording."""
    shortest = CHANGES.features.shortest
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):
        return Observed(SIGNALS, lack="too short for changes of its signals")
    observables = run_tests(
        lambda: duty_observables(duty_tests(recording)),
        lambda: sensor_observables(sensor_tests(recording)),
        lambda: level_observables(level_tests(recording)),
    )
    return Observed(SIGNALS, observables)


def run_tests(*tests: Callable[[], Iterator[Observable]]) -> tuple[Observable, ...]:
    """Run all tests and collect the observables that they yield.

    If numbers overflow or a matrix is singular, the test ends there; what it has yielded before is kept.
    """
    observables: list[Observable] = []
    for test in tests:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            observables += test()
    return tuple(observables)


#: Minimum ratio of the smaller step to the larger one: 22.5 degrees, half way between one step alone and equal steps.
_MIN_STEP_RATIO = math.tan(math.pi / 8.0)


def duty_observables(tests: Sequence[StepTest]) -> Iterator[Observable]:
    """Yield an observable of the step of the duty (motion and load) if command and motion change by similar ratios.

    The smaller step of the two log amplitudes must be at least `_MIN_STEP_RATIO` of the larger one. Otherwise nothing
    is yielded: a leak changes only one of them. `tests`: step tests of the log amplitudes of command and motion
    (`duty_tests`).
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

    `tests`: pairs of a feature's name and its test (`sensor_tests`). Each test is the better of a rise and a fall, so
    its p-value is doubled.
    """
    for name, test in tests:
        data = name.split()[0]
        yield Observable.from_test(name, data if data in ("noise", "hum") else "sense", test, n_tests=2.0)


#: Maximum argument of an exponential, whose value fits into a float.
_MAX_EXPONENT = 700.0


def level_observables(changes: Sequence[LevelChange]) -> Iterator[Observable]:
    """Convert tests for steps of the pressure levels to observables.

    `changes`: one test for each pattern, the highest rank first. The rank is twice the log likelihood ratio, less
    log(blocks) for each coefficient after the first. The p-value of change k is chance_k = min(1, chance_1 exp(rank_1 -
    rank_k)). Half of the exponent is the log Bayes factor of the first over change k (Schwarz's approximation); the
    other half is a prior against descriptions that need further coefficients.
    """
    for change in changes:
        onset = Interval(change.onset, change.onset - change.block, change.onset + change.block)
        deficit = min(changes[0].rank - change.rank, _MAX_EXPONENT)
        chance = min(1.0, changes[0].chance * float(np.exp(deficit)))
        yield Observable(name=change.name, data="levels", score=change.rank, chance=chance, onset=onset)
