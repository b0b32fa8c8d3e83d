"""The tables: the confusion over named faults, and the summary with its two rows that do not look."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.evaluation.table import ALWAYS, CANNOT_TELL, NEVER, confusion_matrix, events_per_hour, summary

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


def test_the_summary_by_hand():
    sizes = [0.0] * 10 + [0.015] * 5 + [0.0042] * 2
    d3 = ["leak"] + ["no leak"] * 9 + ["leak"] * 4 + [CANNOT_TELL] + ["leak", "no leak"]
    d4 = ["no leak"] * 10 + ["leak"] * 5 + ["no leak"] * 2
    table = summary(sizes, {"d3": d3, "d4": d4}, hours=0.05)
    assert [(row.detector, row.leak_lpm) for row in table] == [
        (name, size) for name in ("d3", "d4", ALWAYS, NEVER) for size in (0.0042, 0.015)
    ]
    row = table[1]
    assert (row.n, row.detection.count, row.cannot_tell.count) == (5, 4, 1)
    assert (row.false_alarm.count, row.false_alarm.n) == (1, 10)
    assert row.per_hour == events_per_hour(1, 0.5)
    assert row.informedness == pytest.approx(0.8 - 0.1)


SIZES = st.sampled_from((0.0, 0.0042, 0.015))


@settings(deadline=None)
@given(st.lists(st.tuples(SIZES, st.sampled_from(["leak", "no leak", CANNOT_TELL])), min_size=1))
def test_the_rows_that_do_not_look_are_always_there_and_never_informed(cases):
    sizes, said = zip(*cases, strict=True)
    table = summary(sizes, {"any": said})
    own, always, never = ([row for row in table if row.detector == name] for name in ("any", ALWAYS, NEVER))
    assert [row.leak_lpm for row in own] == [row.leak_lpm for row in always] == [row.leak_lpm for row in never]
    for row, fires, silent in zip(own, always, never, strict=True):
        assert row.n == fires.n == silent.n
        assert row.leak_lpm == 0.0 or (fires.detection.value, silent.detection.value) == (1.0, 0.0)
        if row.false_alarm is None:
            assert all(size > 0.0 for size in sizes)
        else:
            assert (fires.false_alarm.value, silent.false_alarm.value) == (1.0, 0.0)
            assert row.leak_lpm == 0.0 or fires.informedness == silent.informedness == 0.0
