"""Which fault a detector names for which fault there is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Rate, rate_of

#: The verdict that names no fault; it always has a column of its own, the last.
CANNOT_TELL = "cannot tell"


@dataclass(frozen=True)
class Confusion:
    """`counts[i, j]`: records with fault `rows[i]` that were called `columns[j]`; the last column is `cannot tell`.

    `rates[i][j]`: that count over all records of the row, with its interval; `accuracy`: right verdicts over all
    records, `cannot tell` not among the right ones; `decided`: over the records with a verdict; `balanced`: mean of
    the rows' rates of right verdicts, over the rows that have records.
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: npt.NDArray[np.int_]
    rates: tuple[tuple[Rate, ...], ...]
    accuracy: Rate
    decided: Rate
    balanced: float

    def recall(self, fault: str) -> Rate:
        """How often records with this fault are called so."""
        if fault not in self.rows:
            raise InputError(f"the fault must be one of {', '.join(self.rows)}, got {fault!r}")
        return self.rates[self.rows.index(fault)][self.columns.index(fault)]

    def precision(self, verdict: str, confidence: float = 0.95) -> Rate:
        """How often this verdict is right, among these records: it depends on how many of each fault there are."""
        if verdict not in self.columns[:-1]:
            raise InputError(f"the verdict must be one of {', '.join(self.columns[:-1])}, got {verdict!r}")
        column = self.counts[:, self.columns.index(verdict)]
        right = column[self.rows.index(verdict)] if verdict in self.rows else 0
        return rate_of(int(right), int(column.sum()), confidence)


def confusion_matrix(
    truth: Sequence[str],
    verdicts: Sequence[str],
    faults: Sequence[str] | None = None,
    confidence: float = 0.95,
) -> Confusion:
    """Count verdicts by true fault, with Clopper-Pearson's intervals for each row.

    `truth`, `verdicts`: as many names (`none` is a name like any other; `cannot tell` is no truth); `faults`: order of
    rows and columns, and all names that may occur; by default the names in the order of the truth, then verdicts that
    are no true fault, as columns without a row. Raises InputError for a name outside `faults`.
    """
    if len(truth) != len(verdicts) or not truth:
        raise InputError(f"verdicts must be as many as the true faults, got {len(verdicts)} for {len(truth)}")
    if CANNOT_TELL in truth or CANNOT_TELL in (faults or ()):
        raise InputError(f"{CANNOT_TELL!r} is a verdict and no fault")
    rows = tuple(dict.fromkeys(truth if faults is None else faults))
    named = rows if faults is not None else tuple(dict.fromkeys([*rows, *(v for v in verdicts if v != CANNOT_TELL)]))
    columns = (*named, CANNOT_TELL)
    strange = [name for name in truth if name not in rows] + [name for name in verdicts if name not in columns]
    if strange:
        raise InputError(f"a fault must be one of {', '.join(rows)}, got {strange[0]!r}")
    counts = np.zeros((len(rows), len(columns)), dtype=np.int_)
    row_of, column_of = ({name: i for i, name in enumerate(names)} for names in (rows, columns))
    for true, said in zip(truth, verdicts, strict=True):
        counts[row_of[true], column_of[said]] += 1
    totals = counts.sum(axis=1)
    right = np.array([counts[i, column_of[name]] for i, name in enumerate(rows)])
    rates = tuple(
        tuple(rate_of(int(k), int(n), confidence) for k in line) for line, n in zip(counts, totals, strict=True)
    )
    return Confusion(
        rows=rows,
        columns=columns,
        counts=counts,
        rates=rates,
        accuracy=rate_of(int(right.sum()), int(totals.sum()), confidence),
        decided=rate_of(int(right.sum()), int(counts[:, :-1].sum()), confidence),
        balanced=float(np.mean(right[totals > 0] / totals[totals > 0])),
    )
