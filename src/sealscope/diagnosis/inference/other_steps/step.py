"""What else than a leak stepped, by what a leak does not move: the duty, a sensor's noise, and the pressures' levels.

The duty is asked for first: it is the operator's, and whatever else moved may have moved with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.onset import StepTest
from sealscope.diagnosis.inference.other_steps.features import BLOCKS, ORDER, duty_tests, sensor_tests
from sealscope.diagnosis.inference.other_steps.levels import level_tests
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Recording, remembered


class OtherStep(NamedTuple):
    """What stepped: the cause, the text, twice the logarithm of the likelihood ratio, the onset and its doubt [s]."""

    cause: Cause
    text: str
    score: float
    onset: float
    doubt: float

    @classmethod
    def of(cls, cause: Cause, name: str, test: StepTest) -> OtherStep:
        """Return the step of a number a block."""
        onset = test.onset()
        return cls(cause, f"near {onset.value:.0f} s the {name} steps", test.score, onset.value, onset.high - onset.low)


def other_step(recording: Recording, chance: float) -> OtherStep | None:
    """Return what stepped beside a leak; None where nothing does that is as rare as `chance`."""
    steps = remembered(recording, ("other steps",), _other_steps)
    return next((step for step, own in steps if own < chance), None)


@np.errstate(all="ignore")
def _other_steps(recording: Recording) -> list[tuple[OtherStep, float]]:
    """Return what may have stepped, in the order in which it is asked for, with its chance."""
    shortest = priors("inference.other_steps")["features"]["shortest"]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):
        return []
    steps: list[tuple[OtherStep, float]] = []
    for asked in (_duty, _sensors, _levels):
        # numbers that cannot be computed with are no machine's
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            steps += asked(recording)
    return steps


def _duty(recording: Recording) -> Iterator[tuple[OtherStep, float]]:
    """Yield a step of command and motion nearer to (1, 1) than to (1, 0) and (0, 1): not the answer to a leak."""
    sizes = duty_tests(recording)
    steps = np.abs([test.fitted[0] for test in sizes])
    if sizes and steps.min() > np.tan(np.pi / 8.0) * steps.max():
        least = min(sizes, key=lambda test: test.score)
        yield OtherStep.of("changed duty", "size of the duty", least), max(2.0 * test.chance for test in sizes)


def _sensors(recording: Recording) -> Iterator[tuple[OtherStep, float]]:
    tests = sensor_tests(recording)
    for name, test in tests:
        yield OtherStep.of("sensor fault", name, test), 2.0 * len(tests) * test.chance


def _levels(recording: Recording) -> Iterator[tuple[OtherStep, float]]:
    patterns = level_tests(recording)
    if patterns and (best := patterns[0]).cause is not None:
        text = f"near {best.onset:.0f} s the pressures step as of {best.name}"
        yield OtherStep(best.cause, text, best.score, best.onset, 2.0 * best.block), len(patterns) * best.chance
