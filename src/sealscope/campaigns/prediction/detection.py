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
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sealscope.diagnosis.calibration.scorers import SCORERS, Look
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

Side = Literal["fell", "rose", "changed"]
#: The confidence of a prediction's interval.
CONFIDENCE = 0.9
_FINE = 1000
_RESAMPLED = 200
#: Sizes [L/min] at which a prediction gives its probability of detection.
CURVE_SIZES = (0.0005, 0.001, 0.0042, 0.0075, 0.015)


@dataclass(frozen=True)
class ChangeDetector:
    """A scorer of `sealscope.diagnosis.calibration.scorers` that judges the change of one quantity over the split."""

    quantity: str
    chamber: str
    side: Side

    @property
    def name(self) -> str:
        """Its name among the scorers: `d3 of p_A fell`."""
        return f"{self.quantity} of {self.chamber} {self.side}"

    def change(self, look: Look) -> float:
        """The signed change of the log RMS; NaN where it cannot be computed."""
        found = look.sides.of(self.chamber, self.quantity, "change")
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
    """How the changes answer to leaks: `sizes` (m,) rising [L/min]; `mean` and `scatter` (m + 1, d) over the detectors,
    row 0 without a leak; `records`: leak-free records behind the scatter, of `freedom` degrees of freedom.

    `samples`: the changes (n, d) themselves of each row, where they were counted; `paired`: whether sample k of every
    row is the same machine; `error` (m + 1, d): where they were not, standard errors of the means' shifts from row 0,
    common to all sizes.
    """

    sizes: Array
    mean: Array
    scatter: Array
    records: int
    freedom: int
    samples: tuple[Array, ...] = ()
    paired: bool = False
    error: Array | None = None

    def __post_init__(self) -> None:
        if self.sizes.size == 0 or np.any(np.diff(self.sizes) <= 0) or not self.sizes[0] > 0:
            raise InputError("the sizes of leaks must be one or more, rise and be > 0")
        if self.mean.shape != self.scatter.shape or len(self.mean) != self.sizes.size + 1:
            raise InputError("mean and scatter must have a row for no leak and one for each size")
        if self.freedom < 1:
            raise InputError(f"a scatter needs 2 leak-free records or more, got {self.records}")

    def resampled(self, random: np.random.Generator) -> Responses:
        """The responses that another draw of as many samples might have given (Efron, doi 10.1214/aos/1176344552)."""
        n = [len(one) for one in self.samples]
        same = random.integers(n[0], size=n[0])
        drawn = [
            one[same] if self.paired else one[random.integers(k, size=k)]
            for one, k in zip(self.samples, n, strict=True)
        ]
        return counted(self.sizes, drawn, paired=self.paired)


def counted(sizes: Array, samples: Sequence[Array], *, paired: bool) -> Responses:
    """Responses from the changes (n, d) of records without a leak and with each of the `sizes`."""
    return Responses(
        sizes=sizes,
        mean=np.stack([one.mean(axis=0) for one in samples]),
        scatter=np.stack([one.std(axis=0, ddof=1) for one in samples]),
        records=len(samples[0]),
        freedom=len(samples[0]) - 1,
        samples=tuple(samples),
        paired=paired,
    )


@dataclass(frozen=True)
class Prediction:
    """What one detector finds.

    `smallest` [L/min]: the smallest leak found with the probability asked for, None where none of the sizes is;
    `low`, `high`: its interval, `CONFIDENCE` of it, from the chance in the samples (None: beyond the sizes);
    `lost_above` [L/min]: where a larger leak escapes again; `scatter`: of the leak-free change of the log RMS;
    `threshold`: the change beyond which it fires; `rate`: the largest probability of detection over the sizes;
    `curve`: (size, probability) at `CURVE_SIZES`, as far as they were simulated.
    """

    detector: str
    smallest: float | None
    low: float | None
    high: float | None
    lost_above: float | None
    scatter: float
    threshold: float
    rate: float
    curve: tuple[tuple[float, float], ...] = ()


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

    Sizes below the smallest simulated one are read off the curve that goes to no change at no leak.
    Raises InputError for probabilities outside 0..1.
    """
    for name, value in (("the false-alarm rate", false_alarm), ("the probability of detection", detection)):
        if not 0.0 < value < 1.0:
            raise InputError(f"{name} must be between 0 and 1, got {value}")
    fine = np.geomspace(responses.sizes[0] / 100.0, responses.sizes[-1], _FINE)
    shown = [size for size in CURVE_SIZES if size <= responses.sizes[-1]]
    again = _again(responses)
    found = []
    for k, detector in enumerate(detectors):
        if not (np.all(np.isfinite(responses.mean[:, k])) and np.all(responses.scatter[:, k] > 0.0)):
            found.append(Prediction(detector.name, None, None, None, None, math.nan, math.nan, math.nan))
            continue
        curve = _Curve(responses, k, detector.side, false_alarm)
        rates = curve.at(fine)
        smallest, lost = _crossing(fine, rates, detection)
        others = [_Curve(one, k, detector.side, false_alarm).at(fine) for one in again]
        low, high = _interval([_crossing(fine, one, detection)[0] for one in others])
        found.append(
            Prediction(
                detector=detector.name,
                smallest=smallest,
                low=low,
                high=high,
                lost_above=lost,
                scatter=curve.leak_free,
                threshold=curve.limit,
                rate=float(rates.max()),
                curve=tuple(zip(shown, map(float, curve.at(np.array(shown))), strict=True)),
            )
        )
    return tuple(found)


def _again(responses: Responses) -> list[Responses]:
    """Responses as chance might have given them: the samples drawn again, or, where only a scatter is known, the
    scatter as chi squared spreads it and the means shifted by their errors."""
    random = np.random.default_rng(0)
    if responses.samples:
        return [responses.resampled(random) for _ in range(_RESAMPLED)]
    factors = np.sqrt(responses.freedom / random.chisquare(responses.freedom, _RESAMPLED))
    error = np.zeros_like(responses.mean) if responses.error is None else responses.error
    return [
        replace(responses, scatter=factor * responses.scatter, mean=responses.mean + shift * error)
        for factor, shift in zip(factors, random.standard_normal(_RESAMPLED), strict=True)
    ]


def _interval(sizes: Sequence[float | None]) -> tuple[float | None, float | None]:
    """The middle `CONFIDENCE` of the sizes, None for an end that lies beyond what was tried."""
    tail = (1.0 - CONFIDENCE) / 2.0
    ordered = np.sort([math.inf if one is None else one for one in sizes])
    ends = (ordered[int(share * (len(ordered) - 1))] for share in (tail, 1.0 - tail))
    low, high = (float(end) if math.isfinite(end) else None for end in ends)
    return low, high


class _Curve:
    """One detector's probability of detection as a function of the size."""

    def __init__(self, responses: Responses, column: int, side: Side, false_alarm: float) -> None:
        from scipy.interpolate import PchipInterpolator

        self._knots = np.concatenate([[0.0], responses.sizes])
        self._shift = PchipInterpolator(self._knots, responses.mean[:, column] - responses.mean[0, column])
        self._spread = responses.scatter[:, column]
        self._side, self._false_alarm = side, false_alarm
        self.leak_free = float(self._spread[0])
        self.limit = probability(np.zeros(1), self._spread[:1], self.leak_free, side, false_alarm)[1]

    def at(self, sizes: Array) -> Array:
        """POD at sizes (m,) [L/min]."""
        shift = np.asarray(self._shift(sizes), dtype=np.float64)
        spread = np.interp(sizes, self._knots, self._spread)
        return probability(shift, spread, self.leak_free, self._side, self._false_alarm)[0]
