"""What else than a leak stepped, by what a leak does not move: the duty, a sensor's noise, and the pressures' levels.

The duty is asked for first: it is the operator's, and whatever else moved may have moved with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.onset import StepTest, two_sided
from sealscope.diagnosis.inference.other_steps.features import BLOCKS, DUTY, ORDER, features
from sealscope.diagnosis.inference.other_steps.levels import level_tests
from sealscope.diagnosis.verdict.evidence import RAREST, Cause
from sealscope.recordings.recording import Recording, remembered

#: Fewest samples, a noise in each block, and least length of a block [s]: within a stroke all of them move.
FEWEST_SAMPLES, SHORTEST = BLOCKS * (ORDER + 2), 0.5


class OtherStep(NamedTuple):
    """What stepped: the cause, the text, twice the logarithm of the likelihood ratio, the onset and its doubt [s]."""

    cause: Cause
    text: str
    score: float
    onset: float
    doubt: float


def other_step(recording: Recording) -> OtherStep | None:
    """Return what stepped beside a leak, computed once; None where nothing does that is as rare as `RAREST`."""
    return remembered(recording, ("other step",), _other_step)


@np.errstate(all="ignore")
def _other_step(recording: Recording) -> OtherStep | None:
    if len(recording) < max(FEWEST_SAMPLES, BLOCKS * SHORTEST * recording.rate):
        return None
    try:
        return _duty(recording) or _feature(recording) or _level(recording)
    except (ArithmeticError, np.linalg.LinAlgError):  # numbers that cannot be computed with are no machine's
        return None


def _duty(recording: Recording) -> OtherStep | None:
    sizes = [test for _, own in features(recording, DUTY) if (test := two_sided(own)) is not None]
    if sizes and max(2.0 * test.chance for test in sizes) < RAREST and _alike(sizes):
        return _of_test("changed duty", "size of the duty", min(sizes, key=lambda test: test.score))
    return None


def _feature(recording: Recording) -> OtherStep | None:
    tests = [(feature, test) for feature, own in features(recording) if (test := two_sided(own)) is not None]
    for feature, test in tests:
        if 2.0 * len(tests) * test.chance < RAREST:
            return _of_test(feature.cause, feature.name, test)
    return None


def _level(recording: Recording) -> OtherStep | None:
    patterns = level_tests(recording)
    best = patterns[0] if patterns else None
    if best is None or best.cause is None or len(patterns) * best.chance >= RAREST:
        return None
    text = f"near {best.onset:.0f} s the pressures step as of {best.name}"
    return OtherStep(best.cause, text, best.score, best.onset, 2.0 * best.block)


def _of_test(cause: Cause, name: str, test: StepTest) -> OtherStep:
    onset = test.onset()
    return OtherStep(
        cause, f"near {onset.value:.0f} s the {name} steps", test.score, onset.value, onset.high - onset.low
    )


def _alike(sizes: Sequence[StepTest]) -> bool:
    """Whether steps of command and motion are nearer to (1, 1) than to (1, 0) and (0, 1): not the answer to a leak."""
    steps = np.abs([test.fitted[0] for test in sizes])
    return bool(steps.min() > np.tan(np.pi / 8.0) * steps.max())
