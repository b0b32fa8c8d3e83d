"""Changes that no balance shows, as observables: duty, noise, hum, sense and levels of the pressures.

A leak moves none of them. Called for each recording, whichever provider measures the leak.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from sealscope.diagnosis.inference.changes.features import BLOCKS, ORDER, duty_tests, sensor_tests
from sealscope.diagnosis.inference.changes.levels import level_tests
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.onset import Interval
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Recording, remembered

SIGNALS = "signals"


def observe_signals(recording: Recording) -> Observed:
    """Test what no balance shows for a step within the recording."""
    return remembered(recording, (SIGNALS,), _observe)


@np.errstate(all="ignore")
def _observe(recording: Recording) -> Observed:
    shortest = priors("inference.changes")["features"]["shortest"]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):
        return Observed(SIGNALS, lack="too short for changes of its signals")
    observables: list[Observable] = []
    for test in (_duty, _sensors, _levels):
        # numbers that cannot be computed with are no machine's
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            observables += test(recording)
    return Observed(SIGNALS, tuple(observables))


def _duty(recording: Recording) -> Iterator[Observable]:
    """Yield the step of command and motion alike; a leak changes one of them alone."""
    tests = duty_tests(recording)
    steps = np.abs([test.fitted[0] for test in tests])
    if tests and steps.min() > np.tan(np.pi / 8.0) * steps.max():
        least = min(tests, key=lambda test: test.score)
        rarest = max(tests, key=lambda test: test.chance)
        yield Observable(
            name="size of the duty",
            data="duty",
            score=least.score,
            chance=min(1.0, 2.0 * rarest.chance),
            onset=least.onset(),
            size=least.fitted[0],
        )


def _sensors(recording: Recording) -> Iterator[Observable]:
    for name, test in sensor_tests(recording):
        data = name.split()[0]
        yield Observable.of_test(name, data if data in ("noise", "hum") else "sense", test, looks=2.0)


def _levels(recording: Recording) -> Iterator[Observable]:
    """Yield the patterns of the levels; rivals of the likeliest one are rarer by twice what their rank lacks.

    Ranks hold half the price of a coefficient more, how rare it is to be needed the other half.
    """
    levels = level_tests(recording)
    for level in levels:
        reach = Interval(level.onset, level.onset - level.block, level.onset + level.block)
        chance = min(1.0, levels[0].chance * float(np.exp(min(levels[0].rank - level.rank, 700.0))))
        yield Observable(name=level.name, data="levels", score=level.rank, chance=chance, onset=reach)
