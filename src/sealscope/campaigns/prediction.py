"""From how a detector's score moves and scatters to the smallest leak it finds.

The score of the thesis's detectors is the change of the log RMS of a detail over the split of a record. Without a leak
it is taken as normal with mean m_0 and scatter s_0, with a leak `a` as normal with m(a), s(a), linear between the
sizes that were simulated. At a false-alarm probability alpha

    POD(a) = Phi((y(a) - z s_0) / s(a)),   z = Phi^-1(1 - alpha),   y = -(m - m_0) for "fell", m - m_0 for "rose",

and for "changed" both tails with alpha/2 each. (Berens, NDE reliability data analysis, ASM Handbook 17 (1989): the
signal-response model, with the scatter at its own value at each size.)
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sealscope.diagnosis.scorers import SCORERS, Look
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

Side = Literal["fell", "rose", "changed"]
#: The confidence of a prediction's interval, which comes from the scatter's own uncertainty.
CONFIDENCE = 0.9
_FINE = 400


@dataclass(frozen=True)
class ChangeDetector:
    """A scorer of `sealscope.diagnosis.scorers` that judges the change of one quantity over the split."""

    quantity: str
    chamber: str
    side: Side

    @property
    def name(self) -> str:
        """Its name among the scorers: `d3 of p_A fell`."""
        return f"{self.quantity} of {self.chamber} {self.side}"

    def change(self, look: Look) -> float:
        """The signed change of the log RMS; NaN where it cannot be computed."""
        found = look.of(self.chamber, self.quantity, "change")
        return math.nan if found is None else found


def change_detector(name: str) -> ChangeDetector:
    """The detector of that name; raises InputError, naming the form, where it is no scorer of a change."""
    found = re.fullmatch(r"(\w+) of (\w+) (fell|rose|changed)", name.strip())
    if not found or name.strip() not in SCORERS:
        raise InputError(
            f"a detector to plan for must be like 'd3 of p_A fell', 'd3d4 of p_B rose' or 'd2 of p_A changed', "
            f"got {name!r}"
        )
    side: Side = found[3]  # type: ignore[assignment]
    return ChangeDetector(found[1], found[2], side)


#: The thesis's detectors: d3, d4 and d3d4, which fall in p_A and rise in p_B; for p_B also without a side, for in a
#: simulated rig they fall there too.
THESIS_DETECTORS = tuple(
    ChangeDetector(quantity, chamber, side)  # type: ignore[arg-type]
    for chamber, side in (("p_A", "fell"), ("p_B", "rose"), ("p_B", "changed"))
    for quantity in ("d3", "d4", "d3d4")
)


@dataclass(frozen=True, eq=False)
class Responses:
    """How the changes answer to leaks: `sizes` (m,) rising [L/min]; `mean` and `scatter` (m + 1, d) over the
    detectors, row 0 without a leak; `records`: how many leak-free records the scatter comes from."""

    sizes: Array
    mean: Array
    scatter: Array
    records: int

    def __post_init__(self) -> None:
        if self.sizes.size == 0 or np.any(np.diff(self.sizes) <= 0) or not self.sizes[0] > 0:
            raise InputError("the sizes of leaks must be one or more, rise and be > 0")
        if self.mean.shape != self.scatter.shape or len(self.mean) != self.sizes.size + 1:
            raise InputError("mean and scatter must have a row for no leak and one for each size")
        if self.records < 2:
            raise InputError(f"a scatter needs 2 leak-free records or more, got {self.records}")


@dataclass(frozen=True)
class Prediction:
    """What one detector finds.

    `smallest` [L/min]: the smallest leak found with the probability asked for, None where none of the sizes is;
    `low`, `high`: its interval, `CONFIDENCE` of it, from the scatter's own uncertainty (None: beyond the sizes);
    `lost_above` [L/min]: where a larger leak escapes again; `scatter`: of the leak-free change of the log RMS;
    `threshold`: the change beyond which it fires; `rate`: the largest probability of detection over the sizes.
    """

    detector: str
    smallest: float | None
    low: float | None
    high: float | None
    lost_above: float | None
    scatter: float
    threshold: float
    rate: float


def probability(
    shift: Array, scatter: Array, leak_free_scatter: float, side: Side, false_alarm: float
) -> tuple[Array, float]:
    """POD for shifts of the mean (m,) with scatters (m,), and the distance of the threshold from the leak-free mean.

    Scatters are > 0 and the false-alarm probability is within 0..1.
    """
    from scipy.special import ndtr, ndtri

    tails = 2.0 if side == "changed" else 1.0
    limit = float(ndtri(1.0 - false_alarm / tails)) * leak_free_scatter
    towards = -shift if side == "fell" else shift
    found = ndtr((towards - limit) / scatter)
    if side == "changed":
        found = found + ndtr((-towards - limit) / scatter)
    return np.asarray(found, dtype=np.float64), limit


def _crossing(sizes: Array, rates: Array, detection: float) -> tuple[float | None, float | None]:
    """The first size whose rate reaches `detection`, and the next one where it falls below again."""
    enough = rates >= detection
    if not enough.any():
        return None, None
    first = int(np.argmax(enough))
    lost = np.flatnonzero(~enough[first:])
    return float(sizes[first]), float(sizes[first + lost[0]]) if lost.size else None


def predict(
    responses: Responses, detectors: Sequence[ChangeDetector], false_alarm: float, detection: float = 0.9
) -> tuple[Prediction, ...]:
    """The smallest leak that each detector finds with probability `detection`; its columns are those of `responses`.

    A size below the smallest simulated one is read off the line to zero, where the change is proportional to the leak.
    Raises InputError for probabilities outside 0..1.
    """
    from scipy.stats import chi2

    for name, value in (("the false-alarm rate", false_alarm), ("the probability of detection", detection)):
        if not 0.0 < value < 1.0:
            raise InputError(f"{name} must be between 0 and 1, got {value}")
    knots = np.concatenate([[0.0], responses.sizes])
    fine = np.geomspace(responses.sizes[0] / 100.0, responses.sizes[-1], _FINE)
    freedom = responses.records - 1
    tail = (1.0 - CONFIDENCE) / 2.0
    wide, narrow = (math.sqrt(freedom / float(chi2.ppf(share, freedom))) for share in (tail, 1.0 - tail))
    found = []
    for k, detector in enumerate(detectors):
        mean, scatter = responses.mean[:, k], responses.scatter[:, k]
        if not (np.all(np.isfinite(mean)) and np.all(scatter > 0.0)):
            found.append(Prediction(detector.name, None, None, None, None, math.nan, math.nan, math.nan))
            continue
        shift = np.interp(fine, knots, mean - mean[0])
        spread = np.interp(fine, knots, scatter)
        rates, limit = probability(shift, spread, float(scatter[0]), detector.side, false_alarm)
        smallest, lost = _crossing(fine, rates, detection)
        low, high = (
            _crossing(fine, probability(shift, f * spread, f * float(scatter[0]), detector.side, false_alarm)[0], detection)[0]
            for f in (narrow, wide)
        )
        found.append(
            Prediction(detector.name, smallest, low, high, lost, float(scatter[0]), limit, float(rates.max()))
        )
    return tuple(found)
