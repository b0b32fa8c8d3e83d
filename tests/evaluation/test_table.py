"""The confusion over named faults."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.evaluation.table import CANNOT_TELL, confusion_matrix

FAULTS = ["none", "piston leak", "pump leak"]
names = st.lists(st.tuples(st.sampled_from(FAULTS), st.sampled_from([*FAULTS, CANNOT_TELL])), min_size=1, max_size=60)


def test_a_confusion_by_hand():
    truth = ["none"] * 4 + ["piston leak"] * 5 + ["pump leak"]
    said = ["none", "none", "none", "piston leak", *["piston leak"] * 3, CANNOT_TELL, "pump leak", CANNOT_TELL]
    result = confusion_matrix(truth, said, FAULTS)
    assert result.rows == tuple(FAULTS)
    assert result.columns == (*FAULTS, CANNOT_TELL)
    assert result.counts.tolist() == [[3, 1, 0, 0], [0, 3, 1, 1], [0, 0, 0, 1]]
    assert (result.accuracy.count, result.accuracy.n) == (6, 10)
    assert result.shares[0][1].high == pytest.approx(0.8059, abs=5e-5)


def test_a_fault_without_records_has_an_empty_row():
    empty = confusion_matrix(["none"], ["none"], FAULTS)
    assert empty.counts.shape == (3, 4)
    assert math.isnan(empty.shares[2][2].value)
    assert empty.accuracy.value == 1.0


@settings(deadline=None)
@given(names, st.randoms())
def test_counts_add_up_in_any_order(pairs, random):
    truth, said = zip(*pairs, strict=True)
    result = confusion_matrix(truth, said, FAULTS)
    assert result.counts.sum() == len(pairs)
    for i, fault in enumerate(FAULTS):
        shares = [share.value for share in result.shares[i]]
        assert fault not in truth or sum(shares) == pytest.approx(1.0)
    random.shuffle(pairs)
    again = confusion_matrix(*zip(*pairs, strict=True), FAULTS)
    assert np.array_equal(again.counts, result.counts)
