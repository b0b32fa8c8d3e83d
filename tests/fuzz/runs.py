"""Many hostile inputs of one kind, counted: what was taken, what refused, and how long the slowest took."""

from __future__ import annotations

import random
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from .messages import MESSAGES
from .recordings import RECORDINGS
from .targets import TARGETS

#: What can be attacked: kind -> what makes, in a folder, the use of an input.
KINDS = TARGETS | RECORDINGS | MESSAGES
#: Longest time that an input may take [s of this process], and most memory [bytes] that all of them may add.
LONGEST, MOST_MEMORY = 2.0, 1e9


def peak_memory() -> float:
    """Return the largest resident memory [bytes] of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


@dataclass
class Count:
    """Inputs taken and refused, the slowest [s], and what escaped: seed -> error."""

    taken: int = 0
    refused: int = 0
    slowest: float = 0.0
    escaped: dict[int, BaseException] | None = None


def attack(kind: str, folder: Path, seeds: range, until: float = float("inf"), *, stop: bool = True) -> Count:
    """Use an input of each seed, until a time [s of `perf_counter`]; raise what escapes, or note it unless `stop`.

    What takes longer than `LONGEST` escapes where it is noted: a test asks no clock.
    """
    use, count = KINDS[kind](folder), Count(escaped={})
    for seed in seeds:
        if time.perf_counter() > until:
            break
        begin = time.process_time()
        try:
            if use(random.Random(seed)):
                count.taken += 1
            else:
                count.refused += 1
            seconds = time.process_time() - begin
            count.slowest = max(count.slowest, seconds)
            assert stop or seconds < LONGEST, f"{seconds:.1f} s"
        except Exception as error:
            if stop:
                error.add_note(f"seed {seed} of {kind}")
                raise
            assert count.escaped is not None
            count.escaped[seed] = error
    return count
