"""What no curve and no error can be computed of is refused."""

from __future__ import annotations

import math

import pytest

from sealscope.evaluation.estimates import estimate_errors
from sealscope.evaluation.pod import fit_hit_miss

from ..refusals import refusal


@pytest.mark.parametrize(
    ("sizes", "hits", "named"),
    [([1.0, 2.0], [1, 1], "2 hits of 2"), ([1.0, 2.0], [0, 0], "0 hits of 2"), ([1.0, 1.0], [0, 1], "2 of one size")],
)
def test_a_curve_without_misses_hits_or_sizes_is_refused(sizes, hits, named):
    with refusal(named):
        fit_hit_miss(sizes, hits)


def test_an_error_that_cannot_be_squared_is_refused():
    with refusal("1e+200"):
        estimate_errors([1e200], [0.0], [math.nan], [math.nan])
