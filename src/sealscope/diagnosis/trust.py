"""Whether a chamber pressure is a reading at all: one that stands still, or goes along a straight line, is none."""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.rms_change.blocks import BLOCK_SAMPLES, BLOCK_SECONDS
from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.recording import Recording

#: A pressure that bends by no more than this share of its largest value is no reading.
_STRAIGHT = 1e-9


def does_not_move(recording: Recording) -> str | None:
    """Which chamber pressure of a recording without missing samples does not move, and when, in words; None where all
    do.

    A transducer's noise never rests: a value that stays the same to the last digit for as long as a block of the
    analysis (1.5 s, 64 samples or more) is a rail, a held value or a dead channel, and what lies about it cannot be its
    own baseline.
    """
    longest = max(round(BLOCK_SECONDS * recording.rate), BLOCK_SAMPLES)
    for name in chambers_of(recording):
        values = recording[name]
        if len(values) <= longest or np.ptp(values) == 0:  # too short to tell; a constant one is told as such elsewhere
            continue
        moves = np.concatenate([[-1], np.flatnonzero(np.diff(values)), [len(values) - 1]])
        rests = np.diff(moves)
        first = int(np.argmax(rests))
        if rests[first] > longest:
            start, stop = (float(recording.t[k]) for k in (moves[first] + 1, moves[first + 1]))
            return f"the pressures cannot be trusted: {name} does not move from {start:.4g} s to {stop:.4g} s"
        if np.abs(np.diff(values, 2)).max() <= _STRAIGHT * np.abs(values).max():
            return f"the pressures cannot be trusted: {name} does not move but along a straight line"
    return None
