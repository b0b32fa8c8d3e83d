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
from sealscope.evaluation.checks import share
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
        """Return the signed change of the log RMS; NaN where it cannot be computed."""
        change = look.sides.of(self.chamber, self.quantity, "change")
        return math.nan if change is None else change


def change_detector(name: str) -> ChangeDetector:
    """Return the detector of that name; raise InputError, naming the form, where it is no scorer of a change."""
    parts = re.fullmatch(r"(\w+) of (\w+) (fell|rose|changed)", name.strip())
    if not parts or name.strip() not in SCORERS:
        raise InputError(
            f"a detector to predict must be like 'd3 of p_A fell', 'd3d4 of p_B rose' or 'd2 of p_A changed', "
            f"got {name!r}"
        )
    side: Side = parts[3]  # type: ignore[assignment]
    return ChangeDetector(parts[1], parts[2], side)


#: The thesis's detectors: d3, d4 and d3d4, which fall in p_A and rise in p_B; for p_B also without a side, for in a
#: simulated rig they fall there too.
THESIS_DETECTORS = tuple(
    ChangeDetector(quantity, chamber, side)  # type: ignore[arg-type]
    for chamber, side in (("p_A", "fell"), ("p_B", "rose"), ("p_B", "changed"))
    for quantity in ("d3", "d4", "d3d4")
)


@dataclass(frozen=True, eq=False)
class Responses:
    """How the changes answer to leaks.

    `sizes` (m,) rising [L/min]; `mean` and `scatter` (m + 1, d) over the detectors, row 0 without a leak; `records`:
    leak-free records behind the scatter, of `freedom` degrees of freedom.

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
        """Return the responses of another draw of as many samples (Efron, doi 10.1214/aos/1176344552)."""
        n = [len(changes) for changes in self.samples]
        same = random.integers(n[0], size=n[0])
        drawn = [
            changes[same] if self.paired else changes[random.integers(k, size=k)]
            for changes, k in zip(self.samples, n, strict=True)
        ]
        return counted(self.sizes, drawn, paired=self.paired)


def counted(sizes: Array, samples: Sequence[Array], *, paired: bool) -> Responses:
    """Return the responses from the changes (n, d) of records without a leak and with each of the `sizes`."""
    return Responses(
        sizes=sizes,
        mean=np.stack([changes.mean(axis=0) for changes in samples]),
        scatter=np.stack([changes.std(axis=0, ddof=1) for changes in samples]),
        records=len(samples[0]),
        freedom=len(samples[0]) - 1,
        samples=tuple(samples),
        paired=paired,
    )


@dataclass(frozen=True)
class DetectorPrediction:
    """The leaks that one detector finds.

    `smallest` [L/min]: the smallest leak found with the probability asked for, None where none of the sizes is;
    `low`, `high`: its interval, `CONFIDENCE` of it, from the chance in the samples (None: beyond the sizes);
    `lost_above` [L/min]: where a larger leak escapes again; `scatter`: of the leak-free change of the log RMS;
    `threshold`: the change beyond which it fires; `largest_detection`: the largest probability of detection over the
    sizes; `curve`: (size, probability) at `CURVE_SIZES`, as far as they were simulated.
    """

    detector: str
    smallest: float | None
    low: float | None
    high: float | None
    lost_above: float | None
    scatter: float
    threshold: float
    largest_detection: float
    curve: tuple[tuple[float, float], ...] = ()


def probability(
    shift: Array, scatter: Array, leak_free_scatter: float, side: Side, false_alarm: float
) -> tuple[Array, float]:
    """Return the POD for shifts of the mean (m,) with scatters (m,), and the threshold as a shift.

    Scatters are > 0 and the false-alarm probability is within 0..1.
    """
    from scipy.special import ndtr, ndtri

    tails = 2.0 if side == "changed" else 1.0
    limit = float(ndtri(1.0 - false_alarm / tails)) * leak_free_scatter
    towards = -shift if side == "fell" else shift
    detection = ndtr((towards - limit) / scatter)
    if side == "changed":
        detection = detection + ndtr((-towards - limit) / scatter)
    return np.asarray(detection, dtype=np.float64), limit


def _crossing(sizes: Array, probabilities: Array, detection: float) -> tuple[float | None, float | None]:
    """Return the first size whose probability reaches `detection`, and the next where it falls below again."""
    enough = probabilities >= detection
    if not enough.any():
        return None, None
    first = int(np.argmax(enough))
    lost = np.flatnonzero(~enough[first:])
    return float(sizes[first]), float(sizes[first + lost[0]]) if lost.size else None


def smallest_leaks(
    responses: Responses, detectors: Sequence[ChangeDetector], false_alarm: float, detection: float = 0.9
) -> tuple[DetectorPrediction, ...]:
    """Return the smallest leak that each detector finds with probability `detection`.

    The detectors are the columns of `responses`. Sizes below the smallest simulated one are read off the curve that
    goes to no change at no leak. Raises InputError for probabilities outside 0..1.
    """
    share(false_alarm, "the false-alarm probability")
    share(detection, "the probability of detection")
    fine = np.geomspace(responses.sizes[0] / 100.0, responses.sizes[-1], _FINE)
    shown = [size for size in CURVE_SIZES if size <= responses.sizes[-1]]
    redrawn = _redrawn(responses)
    predictions = []
    for k, detector in enumerate(detectors):
        if not (np.all(np.isfinite(responses.mean[:, k])) and np.all(responses.scatter[:, k] > 0.0)):
            predictions.append(DetectorPrediction(detector.name, None, None, None, None, math.nan, math.nan, math.nan))
            continue
        curve = _DetectionCurve(responses, k, detector.side, false_alarm)
        probabilities = curve.at(fine)
        smallest, lost = _crossing(fine, probabilities, detection)
        others = [_DetectionCurve(other, k, detector.side, false_alarm).at(fine) for other in redrawn]
        low, high = _interval([_crossing(fine, other, detection)[0] for other in others])
        predictions.append(
            DetectorPrediction(
                detector=detector.name,
                smallest=smallest,
                low=low,
                high=high,
                lost_above=lost,
                scatter=curve.leak_free,
                threshold=curve.limit,
                largest_detection=float(probabilities.max()),
                curve=tuple(zip(shown, map(float, curve.at(np.array(shown))), strict=True)),
            )
        )
    return tuple(predictions)


def _redrawn(responses: Responses) -> list[Responses]:
    """Return the responses as chance might have given them.

    The samples are drawn again, or, where only a scatter is known, the scatter is spread as chi squared and the means
    are shifted by their errors.
    """
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
    """Return the middle `CONFIDENCE` of the sizes, None for an end that lies beyond what was tried."""
    tail = (1.0 - CONFIDENCE) / 2.0
    ordered = np.sort([math.inf if size is None else size for size in sizes])
    ends = (ordered[int(order * (len(ordered) - 1))] for order in (tail, 1.0 - tail))
    low, high = (float(end) if math.isfinite(end) else None for end in ends)
    return low, high


class _DetectionCurve:
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
        """Return the POD at sizes (m,) [L/min]."""
        shift = np.asarray(self._shift(sizes), dtype=np.float64)
        spread = np.interp(sizes, self._knots, self._spread)
        return probability(shift, spread, self.leak_free, self._side, self._false_alarm)[0]
