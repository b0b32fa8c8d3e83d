"""Unwrap the motor angle of a stream, which begins anew after a turn or a whole number of turns.

A step of more than half a turn and more than half the angle's range so far is a wrap, if the angle stays within whole
turns and these explain the step. Over missing samples the step counts beside that of the speed before them. The
rule looks at earlier samples alone, so that the result does not depend on how samples are divided into messages; files
are unwrapped by `recordings.formats.wrapped_angle`, which sees the whole angle first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sealscope.recordings.channels import Array
from sealscope.storage.plain_state import SavedAttributes

_TURN = 2.0 * math.pi  # [rad]
#: Largest part of a wrap's step that remains without whole turns.
_MAX_REMAINDER = 0.25
#: Largest step or range [rad] of a wrapped angle: 2^32 counts of 4096 a turn.
_MAX_ANGLE = _TURN * 2.0**20
#: Largest excess of the angle's range over its period, by rounding, relative.
_TOLERANCE = 1e-3


@dataclass
class AngleUnwrapper(SavedAttributes):
    """Remove the wraps of an angle [rad] that arrives in pieces."""

    SAVED: ClassVar = ("low", "high", "last", "missing", "step", "turns")

    low: float = math.inf  # range of the recorded angle so far [rad]
    high: float = -math.inf
    last: float = math.nan  # last recorded angle [rad]
    missing: int = 0  # number of missing samples since
    step: float = 0.0  # last step from sample to sample, without wraps [rad]
    turns: int = 0  # sum of the wraps so far

    def interrupt(self) -> None:
        """Forget the last angle, as after a gap in time over which the shaft may have turned by any angle."""
        self.last, self.missing, self.step = math.nan, 0, 0.0

    def unwrap(self, values: Array) -> tuple[Array, int]:
        """Return the next angles (n,) [rad] without wraps, and the number of wraps; missing values (NaN) stay so."""
        rows = np.flatnonzero(np.isfinite(values))
        if not rows.size:
            self.missing += values.size
            return values, 0
        known = values[rows]
        first = known[0] if math.isnan(self.last) else self.last
        steps = np.diff(known, prepend=first)
        counts = np.diff(rows, prepend=-1 - self.missing)  # intervals from one to the next
        low = np.minimum(np.minimum.accumulate(known), self.low)
        high = np.maximum(np.maximum.accumulate(known), self.high)
        self.missing = values.size - 1 - int(rows[-1])
        self.last, self.low, self.high = float(known[-1]), float(low[-1]), float(high[-1])
        span = high - low
        turns = np.zeros(known.size, dtype=np.int64)
        for row in np.flatnonzero((np.abs(steps) > np.maximum(0.5 * _TURN, 0.5 * span)) | (counts > 1)).tolist():
            before = self.step if row == 0 else (steps[row - 1] + _TURN * turns[row - 1]) / counts[row - 1]
            predicted = counts[row] * before if counts[row] > 1 else 0.0
            turns[row] = _find_wrap(float(steps[row]), float(predicted), float(span[row]))
        self.step = float((steps[-1] + _TURN * turns[-1]) / counts[-1])
        if turns.any() or self.turns:
            total = self.turns + np.cumsum(turns)
            values = values.copy()
            values[rows] = known + _TURN * total
            self.turns = int(total[-1])
        return values, int(np.count_nonzero(turns))


def _find_wrap(step: float, predicted: float, span: float) -> int:
    """Find the number of turns to add to a `step` [rad] that a wrap has changed; 0 without a wrap.

    `predicted`: step over missing samples at the speed before it [rad], else 0; `span`: range of the recorded angle,
    which fills the period at most. In a range of one turn the shaft may turn by half a turn from sample to sample.
    """
    excess = step - predicted
    if not max(abs(excess), span) < _MAX_ANGLE:  # True for NaN, too
        return 0
    turns = max(1, round(span / _TURN), round(abs(excess) / _TURN))
    period = _TURN * turns
    is_far = abs(excess) > 0.5 * _TURN and abs(excess) > 0.5 * span and span <= (1.0 + _TOLERANCE) * period
    is_explained = turns == 1 or abs(abs(excess) - period) <= _MAX_REMAINDER * abs(excess)
    return (-turns if excess > 0.0 else turns) if is_far and is_explained else 0
