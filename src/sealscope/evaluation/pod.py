"""Probability of detection over the size of the leak, without a model: the rate at each size and what it proves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from sealscope.errors import InputError
from sealscope.evaluation.binomial import Rate, lower_bound, rate_of
from sealscope.evaluation.checks import Array, flags, numbers, share, sizes

#: The scale on which the size (or the signal) is modelled.
Scale = Literal["log", "linear"]


@dataclass(frozen=True)
class SizeRate:
    """Detection at one `size`: the `rate` with its two-sided interval and the one-sided `lower` bound, both at the
    rate's confidence."""

    size: float
    rate: Rate
    lower: float


def scaled(values: npt.ArrayLike, scale: Scale, what: str) -> Array:
    """`values` on the model's scale: their natural logarithm (all must be > 0), or as they are."""
    if scale == "log":
        return np.asarray(np.log(sizes(values, what)), dtype=np.float64)
    if scale == "linear":
        return numbers(values, what)
    raise InputError(f"the scale must be 'log' or 'linear', got {scale!r}")


def unscaled(value: float, scale: Scale) -> float:
    """The value that `scaled` would take to `value`; infinite where it is too large to be one."""
    if scale == "linear" or math.isnan(value):
        return value
    return math.exp(value) if value < 709.0 else math.inf


def by_size(leaks: npt.ArrayLike, hits: npt.ArrayLike, confidence: float = 0.95) -> list[SizeRate]:
    """The detection rate at each size of leak, with Clopper-Pearson's bounds, in rising order.

    `leaks` (n,) sizes, any unit; `hits` (n,) whether each was found. Raises InputError for sizes <= 0.
    """
    size = sizes(leaks)
    hit = flags(hits, size.size, "hits")
    share(confidence, "confidence")
    rows = []
    for one in np.unique(size):
        here = hit[size == one]
        k, n = int(here.sum()), int(here.size)
        rows.append(SizeRate(float(one), rate_of(k, n, confidence), lower_bound(k, n, confidence)))
    return rows


def proven_size(rows: list[SizeRate], detection: float = 0.9) -> float:
    """The smallest size from which on every tested size has its lower bound >= `detection`; infinite where none has.

    With 29 hits of 29 at 95 % the size proves 90 % (a90/95 without a model). Nothing is said between the sizes, and
    the confidence is that of each size alone. Source: Clopper and Pearson (1934), doi
    10.1093/biomet/26.4.404.
    """
    share(detection, "the probability of detection")
    proven = math.inf
    for row in sorted(rows, key=lambda row: -row.size):
        if row.lower < detection:
            break
        proven = row.size
    return proven
