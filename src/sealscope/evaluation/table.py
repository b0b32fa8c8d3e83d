"""Compute rates of events per hour and confusion matrices of faults, with exact confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.evaluation.binomial import IntervalEstimate, Proportion, proportion

#: The verdict that names no fault; it is always the last column of a confusion matrix.
CANNOT_TELL = "cannot tell"


def poisson_interval(count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the exact confidence interval (low, high) of a Poisson mean after `count` events.

    With k the count, G(p; s) the quantile of the gamma distribution of shape s, and alpha = 1 - confidence, ``low =
    G(alpha/2; k)`` and ``high = G(1 - alpha/2; k + 1)``; low is 0 if there was no event. Source: Garwood, Biometrika 28
    (1936) 437-442, doi 10.1093/biomet/28.3-4.437.
    """
    from scipy.special import gammainccinv, gammaincinv

    tail = (1.0 - confidence) / 2.0
    low = 0.0 if count == 0 else float(gammaincinv(count, tail))
    high = float(gammainccinv(count + 1, tail))
    return low, high


def events_per_hour(count: int, hours: float, confidence: float = 0.95) -> IntervalEstimate:
    """Compute the rate of events per operating hour with its exact interval; `n` of the result is the `count`."""
    low, high = poisson_interval(count, confidence)
    return IntervalEstimate(count, count / hours, low / hours, high / hours)


@dataclass(frozen=True)
class Confusion:
    """A confusion matrix of true faults (rows) and verdicts (columns), the last column being "cannot tell".

    - `rows`, `columns`: names of the true faults and of the verdicts
    - `counts`, `shares`, both (rows, columns): number of records with this fault and this verdict, and their fraction
      of the records of the row
    - `accuracy`: fraction of correct verdicts among all records, "cannot tell" counted as incorrect
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

    `truth`, `verdicts`: true fault and verdict (a fault or "cannot tell") of each record, at least one; `faults`: names
    of all faults, including that for no fault, in the order of rows and columns; repeated names count once.
    """
    rows = tuple(dict.fromkeys(faults))
    columns = (*rows, CANNOT_TELL)
    counts = np.zeros((len(rows), len(columns)), dtype=np.int_)
    for fault, verdict in zip(truth, verdicts, strict=True):
        counts[rows.index(fault), columns.index(verdict)] += 1
    shares = tuple(tuple(proportion(int(k), int(row.sum()), confidence) for k in row) for row in counts)
    n_correct = int(np.trace(counts))  # row i and column i are the same fault
    return Confusion(rows, columns, counts, shares, proportion(n_correct, len(truth), confidence))
