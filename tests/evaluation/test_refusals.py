"""What no statistic can be made of is refused."""

from __future__ import annotations

import math

import pytest

from sealscope.errors import InputError
from sealscope.evaluation.binomial import clopper_pearson, holm, sign_test, upper_tail
from sealscope.evaluation.estimates import estimate_errors, estimate_quantile
from sealscope.evaluation.pod import fit_hit_miss
from sealscope.evaluation.roc import auc, roc_curve
from sealscope.evaluation.table import CANNOT_TELL, confusion_matrix, events_per_hour, poisson_interval
from sealscope.evaluation.thresholds import quantile_threshold, records_needed


@pytest.mark.parametrize(
    ("call", "given"),
    [
        (clopper_pearson, (5, 4)), (clopper_pearson, (-1, 4)), (clopper_pearson, (1, 4, 95.0)),
        (clopper_pearson, (0, 0)), (upper_tail, (1, 4, 1.5)), (holm, ([0.1, math.nan],)), (sign_test, (-1, 4)),
        (poisson_interval, (-1,)), (events_per_hour, (1, 0.0)), (estimate_quantile, ([], 0.5)),
        (estimate_quantile, ([1.0], 1.0)),
        (estimate_errors, ([1.0], [1.0, 2.0])), (estimate_errors, ([math.nan], [1.0])),
        (fit_hit_miss, ([0.0, 1.0], [0, 1])), (fit_hit_miss, ([1.0, 2.0], [1, 1])), (fit_hit_miss, ([1, 1], [0, 1])),
        (fit_hit_miss, ([1.0, 2.0], [0, 0.5])), (fit_hit_miss, ([1.0, 2.0], [0])),
        (auc, ([], [1.0])), (auc, ([0.0, 1.0], [1.0])), (auc, ([0.0, math.nan], [1.0, 2.0])), (auc, (["a"], [1.0])),
        (roc_curve, ([[0.0]], [1.0])),
        (confusion_matrix, (["none"], [], ["none"])), (confusion_matrix, ([CANNOT_TELL], ["none"], ["none"])),
        (confusion_matrix, (["none"], ["rust"], ["none"])),
        (quantile_threshold, (range(50), 1.5)), (quantile_threshold, ([1.0, math.inf], 0.5)),
        (quantile_threshold, (range(50), 0.1, 0.95, "hope")), (records_needed, (0.0,)),
    ],
)  # fmt: skip
def test_impossible_input_is_refused(call, given):
    with pytest.raises(InputError):
        call(*given)


@pytest.mark.parametrize(("promise", "given", "needed"), [("average", 50, "99"), ("bound", 298, "299")])
def test_too_few_records_are_told_how_many_it_takes(promise, given, needed):
    with pytest.raises(InputError, match=f"at least {needed} .* got {given}"):
        quantile_threshold(range(given), 0.01, promise=promise)
