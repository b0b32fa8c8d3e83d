"""What else than a leak stepped, by what a leak does not move: the duty, a sensor's noise, and the pressures' levels.

The duty is asked for first: it is the operator's, and whatever else moved may have moved with it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.onset import StepTest
from sealscope.diagnosis.inference.other_steps.features import BLOCKS, ORDER, duty_tests, sensor_tests
from sealscope.diagnosis.inference.other_steps.levels import level_tests
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
    """Return what stepped beside a leak, computed once; None where nothing does that is as rare as `chance`."""
    return remembered(recording, ("other step", chance), lambda own: _other_step(own, chance))


@np.errstate(all="ignore")
def _other_step(recording: Recording, chance: float) -> OtherStep | None:
    shortest = beliefs("inference.other_steps")["features"]["shortest"]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):
        return None
    try:
        return _duty(recording, chance) or _sensor(recording, chance) or _level(recording, chance)
    except (ArithmeticError, np.linalg.LinAlgError):  # numbers that cannot be computed with are no machine's
        return None


def _duty(recording: Recording, chance: float) -> OtherStep | None:
    """Return a step of command and motion nearer to (1, 1) than to (1, 0) and (0, 1): not the answer to a leak."""
    sizes = duty_tests(recording)
    steps = np.abs([test.fitted[0] for test in sizes])
    rare = bool(sizes) and max(2.0 * test.chance for test in sizes) < chance
    if not rare or not steps.min() > np.tan(np.pi / 8.0) * steps.max():
        return None
    return OtherStep.of("changed duty", "size of the duty", min(sizes, key=lambda test: test.score))


def _sensor(recording: Recording, chance: float) -> OtherStep | None:
    tests = sensor_tests(recording)
    rare = ((name, test) for name, test in tests if 2.0 * len(tests) * test.chance < chance)
    return next((OtherStep.of("sensor fault", name, test) for name, test in rare), None)


def _level(recording: Recording, chance: float) -> OtherStep | None:
    patterns = level_tests(recording)
    best = patterns[0] if patterns else None
    if best is None or best.cause is None or len(patterns) * best.chance >= chance:
        return None
    text = f"near {best.onset:.0f} s the pressures step as of {best.name}"
    return OtherStep(best.cause, text, best.score, best.onset, 2.0 * best.block)
