"""Which fault a detector names for which fault there is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Proportion, proportion

#: The verdict that names no fault; it always has a column of its own, the last.
CANNOT_TELL = "cannot tell"


@dataclass(frozen=True)
class Confusion:
    """`counts[i, j]`: records with fault `rows[i]` that were called `columns[j]`; the last column is `cannot tell`.

    `shares[i][j]`: that count over all records of the row, with its interval; `accuracy`: right verdicts over all
    records, `cannot tell` not among the right ones.
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: npt.NDArray[np.int_]
    shares: tuple[tuple[Proportion, ...], ...]
    accuracy: Proportion


def confusion_matrix(
    truth: Sequence[str], verdicts: Sequence[str], faults: Sequence[str], confidence: float = 0.95
) -> Confusion:
    """Count verdicts by true fault, with Clopper-Pearson's intervals for each row.

    `truth`, `verdicts`: as many names (`none` is a name like any other; `cannot tell` is no truth); `faults`: order of
    rows and columns, and all names that may occur. Raises InputError for a name outside `faults`.
    """
    if len(truth) != len(verdicts) or not truth:
        raise InputError(f"verdicts must be as many as the true faults, got {len(verdicts)} for {len(truth)}")
    if CANNOT_TELL in truth or CANNOT_TELL in faults:
        raise InputError(f"{CANNOT_TELL!r} is a verdict and no fault")
    rows = tuple(dict.fromkeys(faults))
    columns = (*rows, CANNOT_TELL)
    strange = [name for name in truth if name not in rows] + [name for name in verdicts if name not in columns]
    if strange:
        raise InputError(f"a fault must be one of {', '.join(rows)}, got {strange[0]!r}")
    counts = np.zeros((len(rows), len(columns)), dtype=np.int_)
    for true, verdict in zip(truth, verdicts, strict=True):
        counts[rows.index(true), columns.index(verdict)] += 1
    shares = tuple(tuple(proportion(int(k), int(line.sum()), confidence) for k in line) for line in counts)
    return Confusion(rows, columns, counts, shares, proportion(int(np.trace(counts)), len(truth), confidence))
