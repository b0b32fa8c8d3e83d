"""The decision rules of the thesis as scorers: they compute a score of a record, which is high if there is a leak.

The score is computed from the RMS of the pressures' wavelet details d1 to d4 and d3d4, the product of d3 and d4. Its
threshold is set from a plan's leak-free records, or 0 for sign rules.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np

from sealscope.recordings.channels import CHAMBERS
from sealscope.recordings.recording import Array, Recording
from sealscope.signals.details import QUANTITIES, IntArray, details, mean_squares, reach

#: The machine's start is left out of the first part: this many seconds, but at most this fraction of the part.
START_SECONDS, START_FRACTION = 2.0, 0.05
#: By the direction that ends a rule's name: statistic of the log RMS, and its sign in the score (0: absolute value).
_DIRECTIONS = {
    "fell": ("change", -1.0),
    "rose": ("change", 1.0),
    "changed": ("change", 0.0),
    "low": ("level", -1.0),
    "high": ("level", 1.0),
}
#: By chamber, "p_A" or "p_B", natural logarithms (3, 5) of the RMS of wavelet details. Rows: before the split of a
#: record, after it, over both parts; columns: d1 to d4 (RMS in Pa), and d3d4, the product of d3 and d4 (RMS in Pa^2).
LogRms = Mapping[str, Array]
_BOTH = "d3d4 of both chambers as the thesis says"


def split_bounds(n: int, rate: float, split: int) -> IntArray:
    """Compute the usable samples of the two parts into which a record of `n` samples is split at sample `split`.

    Returns (2, 2): [begin, end) of each part, without samples whose wavelet details depend on the other part or on
    padding, and without the machine's start: `START_SECONDS` at the sampling rate `rate` [Hz], but at most
    `START_FRACTION` of the first part. A part without usable samples has end <= begin.
    """
    # samples before and after a sample on which its wavelet details depend: the last level has the longest filter
    before, after = (int(samples) for samples in reach()[-1])
    begin = max(before, int(min(START_SECONDS * rate, START_FRACTION * split)))
    return np.array([[begin, split - after], [split + before, n - after]])


def split_log_rms(recording: Recording, split_s: float) -> LogRms:
    """Compute the log RMS of the pressures' wavelet details before and after the time `split_s` [s].

    The recording must be uniformly sampled without missing samples. A chamber whose pressure was not recorded is left
    out. If the part before or after `split_s` is too short, both chambers are left out.
    """
    rate = recording.rate
    bounds = split_bounds(len(recording), rate, round((split_s - float(recording.t[0])) * rate))
    if np.diff(bounds).min() < 1:
        return {}
    # of the three segments between the bounds, 1 is the gap between the parts
    squares = {
        chamber: mean_squares(details(recording[chamber]), bounds.ravel())[[0, 2]]
        for chamber in CHAMBERS
        if chamber in recording
    }
    return log_rms_of_squares(squares, bounds)


def log_rms_of_squares(squares: Mapping[str, Array], bounds: IntArray) -> LogRms:
    """Compute the log RMS of the pressures' wavelet details from their mean squares in both parts of a record.

    `squares`: by chamber, mean squares (2, 5) of d1 to d4 and d3d4, before and after the split; `bounds` (2, 2): first
    sample and end of each part, by which the mean over both is weighted.
    """
    n_samples = np.diff(bounds)[:, 0]
    with np.errstate(divide="ignore"):  # the details of a constant pressure are 0
        return {
            chamber: 0.5 * np.log([*parts, np.average(parts, axis=0, weights=n_samples)])
            for chamber, parts in squares.items()
        }


@dataclass(frozen=True)
class Scorer:
    """A decision rule of the thesis that computes a score of a record, to be compared with a threshold.

    `conditions`: each a wavelet detail, a chamber and a direction, such as ("d3", "p_A", "fell"); `threshold`: fixed
    threshold, None if it is set from leak-free records. The rule's score is the smallest of its conditions' scores. The
    score of a condition depends on its direction: it is the change of the detail's log RMS from the first to the second
    part of the record ("rose"), its negative ("fell"), its magnitude ("changed"), the log RMS over both parts ("high"),
    or its negative ("low").
    """

    name: str
    conditions: tuple[tuple[str, str, str], ...]
    threshold: float | None = None

    @property
    def compares_parts(self) -> bool:
        """True if the rule compares the two parts of a split record, False if it rates the record as a whole."""
        statistics = [_DIRECTIONS[direction][0] for _, _, direction in self.conditions]
        return all(statistic == "change" for statistic in statistics)

    @property
    def description(self) -> str:
        """Description of the score in words, such as "the RMS of d3 of p_A low over the record, as its logarithm"."""
        text = " and ".join(
            f"the RMS of {quantity} of {chamber} {direction}" for quantity, chamber, direction in self.conditions
        )
        ending = " over the record, as its logarithm"
        if self.compares_parts:
            ending = ", as change of its logarithm from the first to the second part"
        # a fixed threshold is that of a sign rule, 0
        return text + ending + ("; any change at all" if self.threshold is not None else "")

    def score(self, log_rms: LogRms, channels: Collection[str]) -> float | None:
        """Compute the score of a record from the log RMS of those chambers whose pressures are among `channels`.

        Returns None if the record is too short, lacks a chamber's pressure, or has a constant pressure.
        """
        scores: list[float] = []
        for quantity, chamber, direction in self.conditions:
            if chamber not in log_rms or chamber not in channels:
                return None
            before, after, overall = log_rms[chamber][:, QUANTITIES.index(quantity)].tolist()
            statistic, sign = _DIRECTIONS[direction]
            value = after - before if statistic == "change" else overall
            if not math.isfinite(value):
                return None
            scores.append(sign * value if sign else abs(value))  # sign 0: the magnitude
        return min(scores)  # every condition must be met


def _iter_scorers() -> Iterator[Scorer]:
    """Yield all scorers: rules on one wavelet detail of one chamber, and the thesis's rule on both chambers.

    Rules on a fall or a rise, and the thesis's rule, also occur as sign rules, whose threshold is 0.
    """
    for chamber, quantity, direction in product(CHAMBERS, QUANTITIES, _DIRECTIONS):
        rule = Scorer(f"{quantity} of {chamber} {direction}", ((quantity, chamber, direction),))
        yield rule
        if direction in ("fell", "rose"):
            yield Scorer(f"sign rule: {rule.name}", rule.conditions, threshold=0.0)
    conditions = (("d3d4", "p_A", "fell"), ("d3d4", "p_B", "rose"))  # d3d4: product of the details of levels 3 and 4
    yield Scorer(_BOTH, conditions)
    yield Scorer(f"sign rule: {_BOTH}", conditions, threshold=0.0)


SCORERS: Mapping[str, Scorer] = MappingProxyType({scorer.name: scorer for scorer in _iter_scorers()})
