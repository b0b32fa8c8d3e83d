"""The thesis's rules as scorers: one number a record from the RMS of its details, high for a leak.

A threshold comes from a plan's leak-free records; a bare sign rule has one of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, details, edge_samples, mean_squares
from sealscope.signals.filters import IntArray

#: What is left out at the beginning of a recording: this long, but no more than this share of the first part, so that
#: the machine's start does not stand against its running.
START_SECONDS, START_SHARE = 2.0, 0.05
#: Word of a rule -> what of the log RMS it scores (its change over the split, or its level), and the sign.
_WORDS = {
    "fell": ("change", -1.0),
    "rose": ("change", 1.0),
    "changed": ("change", 0.0),
    "low": ("level", -1.0),
    "high": ("level", 1.0),
}
_BOTH = "d3d4 of both chambers as the thesis says"


def side_bounds(n: int, rate: float, split: int) -> IntArray:
    """Compute first and last (exclusive) sample (2, 2) of each side of the sample `split` of `n` at `rate` [Hz].

    Without the start (`START_SECONDS`), and without details that saw the other side or the recording's ends. A side
    that has no sample left ends before it begins.
    """
    before, after = (int(samples) for samples in edge_samples()[-1])
    begin = max(before, int(min(START_SECONDS * rate, START_SHARE * split)))
    return np.array([[begin, split - after], [split + before, n - after]])


@dataclass(frozen=True)
class Sides:
    """Chamber -> log RMS of d1..d4 and d3d4, (5,) each: before the split, after it, over both."""

    log_rms: Mapping[str, tuple[Array, Array, Array]]

    @classmethod
    def from_recording(cls, recording: Recording, split_s: float) -> Sides:
        """Compute both sides of the time `split_s` [s], for each chamber whose two sides have details.

        The recording is uniformly sampled without missing samples.
        """
        rate = recording.rate
        bounds = side_bounds(len(recording), rate, round((split_s - float(recording.t[0])) * rate))
        squares = {}
        for chamber in CHAMBERS if np.diff(bounds).min() > 0 else ():
            if chamber in recording:
                squares[chamber] = mean_squares(details(recording[chamber]), bounds.ravel())[::2]
        return cls.from_squares(squares, bounds)

    @classmethod
    def from_squares(cls, squares: Mapping[str, Array], bounds: IntArray) -> Sides:
        """Build the sides from mean squares (2, 5) of each chamber's details over samples `bounds` (2, 2)."""
        log_rms = {}
        with np.errstate(divide="ignore"):
            for chamber, parts in squares.items():
                both = np.average(parts, axis=0, weights=np.diff(bounds)[:, 0])
                log_rms[chamber] = (0.5 * np.log(parts[0]), 0.5 * np.log(parts[1]), 0.5 * np.log(both))
        return cls(log_rms)

    def through(self, channels: Iterable[str]) -> Sides:
        """Select some of the chambers."""
        visible = set(channels)
        return Sides({chamber: values for chamber, values in self.log_rms.items() if chamber in visible})

    def value(self, chamber: str, quantity: str, what: str) -> float | None:
        """Return the `change` of a quantity's log RMS over the split, or its `level`; None where it has none."""
        if chamber not in self.log_rms:
            return None
        before, after, both = (float(log_rms[QUANTITIES.index(quantity)]) for log_rms in self.log_rms[chamber])
        value = after - before if what == "change" else both
        return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Scorer:
    """A rule of the thesis.

    `parts`: quantity, chamber and word of what it scores; of several the smallest score counts. `threshold`: its own,
    None where leak-free records set it.
    """

    name: str
    parts: tuple[tuple[str, str, str], ...]
    threshold: float | None = None

    @property
    def split(self) -> bool:
        """True if the rule compares the two sides of the split."""
        return all(_WORDS[word][0] == "change" for _, _, word in self.parts)

    @property
    def description(self) -> str:
        """The score in words."""
        text = " and ".join(f"the RMS of {quantity} of {chamber} {word}" for quantity, chamber, word in self.parts)
        ending = " over the split, as change of its logarithm" if self.split else " over the record, as its logarithm"
        return text + ending + ("; any change at all" if self.threshold is not None else "")

    def score(self, sides: Sides) -> float | None:
        """Compute the score; None for a recording that is too short, or a reading that does not move."""
        scores = []
        for quantity, chamber, word in self.parts:
            what, sign = _WORDS[word]
            value = sides.value(chamber, quantity, what)
            if value is None:
                return None
            scores.append(sign * value if sign else abs(value))
        return min(scores)


def _iter_scorers() -> Iterator[Scorer]:
    for chamber, quantity, word in product(CHAMBERS, QUANTITIES, _WORDS):
        rule = Scorer(f"{quantity} of {chamber} {word}", ((quantity, chamber, word),))
        yield rule
        if word in ("fell", "rose"):
            yield Scorer(f"sign rule: {rule.name}", rule.parts, 0.0)
    both = (("d3d4", "p_A", "fell"), ("d3d4", "p_B", "rose"))
    yield Scorer(_BOTH, both)
    yield Scorer(f"sign rule: {_BOTH}", both, 0.0)


#: Every scorer by name.
SCORERS: Mapping[str, Scorer] = MappingProxyType({scorer.name: scorer for scorer in _iter_scorers()})
