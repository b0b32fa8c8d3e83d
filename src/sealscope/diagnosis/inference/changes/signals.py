"""Observables that no volume balance contains and that a leak does not change.

They are the amplitudes of command and motion (duty), noise, hum, sign and levels of the pressures. Called for each
recording, whichever detector measures the leak.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from sealscope.diagnosis.inference.changes.features import BLOCKS, NOISE, ORDER, duty_tests, sensor_tests
from sealscope.diagnosis.inference.changes.levels import LevelChange, level_tests
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.onset import Estimate, StepTest
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.recording import Recording, compute_once

SIGNALS = "signals"


def observe_signals(recording: Recording) -> Observed:
    """Test command, sensors and mean pressures of a recording for sudden lasting changes that no leak causes."""
    return compute_once(recording, (SIGNALS,), _test_signals)


@np.errstate(all="ignore")
def _test_signals(recording: Recording) -> Observed:
    """Test a recording's signals for changes (`observe_signals`); report only a reason if it is too short."""
    shortest = CHANGES.features.shortest  # length of a block [s]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):  # differences of `ORDER` need samples
        return Observed(SIGNALS, lack="too short to test its signals for changes")
    observables = run_tests(
        lambda: duty_observables(duty_tests(recording)),
        lambda: sensor_observables(sensor_tests(recording)),
        lambda: level_observables(level_tests(recording)),
    )
    return Observed(SIGNALS, observables)


def run_tests(*tests: Callable[[], Iterator[Observable]]) -> tuple[Observable, ...]:
    """Collect what all `tests` yield; a test in which numbers overflow or a matrix is singular ends early."""
    observables: list[Observable] = []
    for test in tests:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            observables += test()
    return tuple(observables)


#: Minimum ratio of the smaller to the larger of two steps: half way, as an angle, between a single step and equal ones.
_MIN_STEP_RATIO = math.tan(math.pi / 8.0)


def duty_observables(tests: Sequence[StepTest]) -> Iterator[Observable]:
    """Yield an observable if the machine's duty (commanded motion) changes suddenly, else nothing.

    `tests`: step tests of the log amplitudes of command and motion (`duty_tests`). Both must rise, or both fall, by
    similar amounts (`_MIN_STEP_RATIO`), since a leak changes only one amplitude. Score, onset and size are those of the
    test with the lower score. The p-value is twice the higher one, since a step may be up or down.
    """
    steps = np.abs([test.fitted.value for test in tests])
    has_one_sign = len({test.sign for test in tests}) == 1
    if has_one_sign and steps.min() > _MIN_STEP_RATIO * steps.max():
        weakest = min(tests, key=lambda test: test.score)
        least_certain = max(tests, key=lambda test: test.chance)
        yield Observable(
            name="size of the duty",
            data="duty",
            score=weakest.score,
            chance=min(1.0, 2.0 * least_certain.chance),
            onset=weakest.onset(),
            size=weakest.sign * weakest.fitted.value,
        )


def sensor_observables(tests: Iterable[tuple[str, StepTest]]) -> Iterator[Observable]:
    """Convert step tests of sensor features, such as noise and hum, to observables.

    `tests`: pairs of a feature's name, whose first word is the kind of data, and its test. The p-value is doubled, as
    each test is the better of two, for a step up and a step down.
    """
    for name, test in tests:
        scale = None
        if name == NOISE:  # log variance of p_A + that of p_B: a scale k of both adds 2 log(k) to each
            scale = Estimate(0.25 * test.sign * test.fitted.value, 0.25 * test.fitted.deviation)
        yield Observable.from_test(name, name.split()[0], test, n_tests=2.0, pressure_scale=scale)


def level_observables(changes: Sequence[LevelChange]) -> Iterator[Observable]:
    """Convert tests for steps of the pressure levels to observables.

    `changes`: a test for each pattern, the combination of levels that a cause changes, with the highest rank first. The
    rank (`LevelChange`) becomes the score. The first is the best of n patterns, so that its p-value is n chance_1
    (Bonferroni). That of change k is min(1, n chance_1 exp(rank_1 - rank_k)). The Bayes factor of change 1 over
    change k (Schwarz's approximation) counts twice, once as evidence and once as a prior, because a pattern that
    explains only part of the change needs a second cause.
    """
    for change in changes:
        deficit = min(changes[0].rank - change.rank, 700.0)  # the largest exponent whose exponential is finite
        chance = min(1.0, len(changes) * changes[0].chance * float(np.exp(deficit)))
        yield Observable(
            name=change.name,
            data="levels",
            score=change.rank,
            chance=chance,
            onset=change.onset,
            pressure_scale=change.pressure_scale,
        )
