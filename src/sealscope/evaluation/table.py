"""Compute rates of events per hour and confusion matrices of faults, with exact confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion
from sealscope.evaluation.checks import as_probability

#: The verdict that names no fault; it is always the last column of a confusion matrix.
CANNOT_TELL = "cannot tell"


def poisson_interval(count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the exact confidence interval (low, high) of a Poisson mean after `count` events.

    With k the count, G(p; s) the quantile of the gamma distribution of shape s, and alpha = 1 - confidence, ``low =
    G(alpha/2; k)`` and ``high = G(1 - alpha/2; k + 1)``; low is 0 if there was no event. Raises InputError for an
    impossible count or confidence. Source: Garwood, Biometrika 28 (1936) 437-442, doi 10.1093/biomet/28.3-4.437.
    """
    from scipy.special import gammainccinv, gammaincinv

    if count < 0 or count != int(count):
        raise InputError(f"a number of events must be whole and >= 0, got {count}")
    tail = (1.0 - as_probability(confidence, "confidence")) / 2.0
    low = 0.0 if count == 0 else float(gammaincinv(count, tail))
    high = float(gammainccinv(count + 1, tail))
    return low, high


def events_per_hour(count: int, hours: float, confidence: float = 0.95) -> IntervalEstimate:
    """Compute the rate of events per operating hour with its exact confidence interval.

    In the result, `n` is the `count` of events. Raises InputError unless `hours` is positive and `count` a whole number
    that is not negative.
    """
    if not (math.isfinite(hours) and hours > 0.0):
        raise InputError(f"operating hours must be > 0, got {hours}")
    low, high = poisson_interval(count, confidence)
    return IntervalEstimate(int(count), count / hours, low / hours, high / hours)


@dataclass(frozen=True)
class Confusion:
    """A confusion matrix of true faults (rows) and verdicts (columns), the last column being "cannot tell".

    Attributes
    ----------
    rows, columns : tuple of str
        Names of the true faults and of the verdicts.
    counts, shares : ndarray, tuple of tuple of Proportion, shape (rows, columns)
        Number of records with this fault and this verdict, and their fraction of the records of the row.
    accuracy : Proportion
        Fraction of correct verdicts among all records, "cannot tell" counted as incorrect.
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: npt.NDArray[np.int_]
    shares: tuple[tuple[Proportion, ...], ...]
    accuracy: Proportion


def confusion_matrix(
    truth: Sequence[str], verdicts: Sequence[str], faults: Sequence[str], confidence: float = 0.95
) -> Confusion:
    """Count the verdicts for each true fault, with Clopper-Pearson intervals of their fractions.

    `truth`, `verdicts`: true fault and verdict of each record; `faults`: names of all faults, including that for no
    fault, in the order of rows and columns. Raises InputError for a name that is not in `faults`, if "cannot tell" is
    among the faults, if there are no records, or if `truth` and `verdicts` differ in length.
    """
    if len(truth) != len(verdicts) or not truth:
        raise InputError(f"verdicts must be as many as the true faults, got {len(verdicts)} for {len(truth)}")
    if CANNOT_TELL in truth or CANNOT_TELL in faults:
        raise InputError(f"{CANNOT_TELL!r} is a verdict, not a fault")
    rows = tuple(dict.fromkeys(faults))
    columns = (*rows, CANNOT_TELL)
    unknown = [name for name in truth if name not in rows] + [name for name in verdicts if name not in columns]
    if unknown:
        raise InputError(f"a fault must be one of {', '.join(rows)}, got {unknown[0]!r}")
    counts = np.zeros((len(rows), len(columns)), dtype=np.int_)
    for fault, verdict in zip(truth, verdicts, strict=True):
        counts[rows.index(fault), columns.index(verdict)] += 1
    shares = tuple(tuple(proportion(int(k), int(row.sum()), confidence) for k in row) for row in counts)
    return Confusion(rows, columns, counts, shares, proportion(int(np.trace(counts)), len(truth), confidence))
