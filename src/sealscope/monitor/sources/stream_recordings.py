"""Cut the samples of a running actuator into recordings, to be judged like the files of a folder.

Holds (standstill under load), the law of a leak, and the comparison with healthy recordings show in minutes, not in
single blocks of some seconds. So the monitor also judges the last minutes of a commissioned machine's stream, and those
of any stream without a position, whose blocks show nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import blake2b
from typing import ClassVar

import numpy as np

from sealscope.diagnosis.priors.live import LIVE
from sealscope.monitor.sources.source_block import count_bytes
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import SavedAttributes

_PRIORS = LIVE.recording
_MIN_DURATION_S, _ = _PRIORS.lengths
#: Largest recording [bytes]: 180 s of eight channels at 2.5 kHz.
_MAX_BYTES = 32_000_000


@dataclass
class StreamRecorder(SavedAttributes):
    """Collect the blocks of one actuator's stream, and cut them into recordings of `duration_s` [s].

    A recording also ends at `_MAX_BYTES`, and before a gap, a clock set back, or a change of channels, units or rate.
    Recordings shorter than the first of `recording.lengths` (`priors.toml`) are dropped. The first recording of all,
    and the first after a gap, such a clock, such a change or `clear`, is shorter than `duration_s` by up to a half.
    This fraction depends on the `actuator`'s name, so that the recordings of many actuators do not end at the same
    moment.
    """

    SAVED: ClassVar = ("first", "follows")  # the blocks are stored elsewhere
    actuator: str
    duration_s: float
    first: int = 0  # running number of the first collected block, 0 if none is collected
    follows: bool = False  # True if they follow a recording that ended at its full length or at `_MAX_BYTES`
    blocks: list[Recording] = field(default_factory=list)

    def take(self, number: int, samples: Recording) -> Recording | None:
        """Collect the block of samples with the running `number`; return the recording that ends, if it is long enough.

        A recording that reaches its full length or `_MAX_BYTES` contains `samples`; one that ends for another reason
        does not.
        """
        if not len(samples):
            return None
        ended = None
        if self.blocks and not _continues(self.blocks[-1], samples):
            ended = self._end(follows=False)
        self.first = self.first or number
        self.blocks.append(samples)
        if ended is not None:  # one recording a call: the next block tells if the new one is full, too
            return ended
        is_full = sum(map(count_bytes, self.blocks)) >= _MAX_BYTES
        return self._end(follows=True) if is_full or self._duration() >= self._full_duration() else None

    def _end(self, *, follows: bool) -> Recording | None:
        """Join the collected blocks to a recording, and forget them; return None if it is too short.

        `follows`: True if the next block continues the stream.
        """
        blocks, duration = self.blocks, self._duration()
        self.clear()
        self.follows = follows
        if duration < _MIN_DURATION_S:
            return None
        first = blocks[0]
        channels = {name: np.concatenate([block[name] for block in blocks]) for name in first.channels}
        return Recording(np.concatenate([block.t for block in blocks]), channels, first.units, first.rate)

    def _duration(self) -> float:
        """Compute the time from the first to the last collected sample [s], 0 without samples."""
        return float(np.nanmax(self.blocks[-1].t) - np.nanmin(self.blocks[0].t)) if self.blocks else 0.0

    def _full_duration(self) -> float:
        """Compute the length at which the present recording ends [s]."""
        digest = blake2b(self.actuator.encode(), digest_size=4).digest()
        fraction = 1.0 if self.follows else 0.5 + 0.5 * int.from_bytes(digest) / 2**32
        return max(_MIN_DURATION_S, fraction * self.duration_s)

    def clear(self) -> None:
        """Forget the collected blocks, as after a repair."""
        self.first, self.follows, self.blocks = 0, False, []

    def refill(self, number: int, samples: Recording) -> None:
        """Collect a stored block again after a restart, if by its running `number` it is of the present recording."""
        if 0 < self.first <= number and len(samples):
            self.blocks.append(samples)


def _continues(earlier: Recording, samples: Recording) -> bool:
    """Return True if `samples` continue the block `earlier`: the same channels, units and rate, after a short time."""
    has_same_format = (samples.units, samples.rate) == (earlier.units, earlier.rate)
    gap = float(samples.t[0] - earlier.t[-1])
    return has_same_format and 0.0 < gap <= _PRIORS.gap
