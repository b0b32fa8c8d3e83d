"""What a campaign's rows add up to, against rows whose truth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.judging.judge import judge
from sealscope.evaluation.binomial import clopper_pearson

from ..refusals import refusal

CHANGED, SIGN = "d3 of p_A changed", "sign rule: d3 of p_A fell"


def row(number, score, use="judge", leak=0.0, fault="", command="3 sin(4t)"):
    return CaseRow(
        id=f"{number:016x}",
        use=use,
        leak_lpm=leak,
        fault=fault,
        levels={"command": command},
        replicate=number,
        flow_lpm=leak,
        scores={CHANGED: (score, None), SIGN: (None if score is None else score - 0.5, None)},
    )


def rows_of(seed, calibrate=199, free=400, leaky=200):
    """Leak-free scores uniform in 0..1; a leak of size 1 raises them by 0.3, one of 2 by 2."""
    random = np.random.default_rng(seed)
    result = [row(k, random.random(), "calibrate") for k in range(calibrate)]
    result += [row(10000 + k, random.random()) for k in range(free)]
    result += [row(20000 + k, random.random() + 0.3, leak=1.0) for k in range(leaky)]
    result += [row(30000 + k, random.random() + 2.0, leak=2.0) for k in range(leaky)]
    return result


def judged(rows, false_alarm=0.05, **options):
    return judge(rows, (CHANGED, SIGN), false_alarm=false_alarm, **options)


def test_the_table_counts_by_hand():
    rows = rows_of(1)
    result = judged(rows, hours=0.05)
    ranked = sorted(one.scores[CHANGED][0] for one in rows if one.use == "calibrate")
    threshold = ranked[-10]  # 5 % of 200
    free = [one.scores[CHANGED][0] > threshold for one in rows if one.use == "judge" and one.leak_lpm == 0]
    small = [one.scores[CHANGED][0] > threshold for one in rows if one.leak_lpm == 1.0]
    table = {(one.detector, one.leak_lpm): one for one in result.table}
    first = table[CHANGED, 1.0]
    assert first.false_alarm.count == sum(free)
    assert first.alarms.count == sum(small)
    assert (first.alarms.low, first.alarms.high) == pytest.approx(clopper_pearson(sum(small), 200))
    assert first.per_hour.value == pytest.approx(sum(free) / 20.0)
    assert first.informedness == pytest.approx(sum(small) / 200 - sum(free) / 400)
    assert table[CHANGED, 2.0].alarms.value == 1.0
    assert table["always fire", 1.0].alarms.value == table["always fire", 1.0].false_alarm.value == 1.0
    assert table["never fire", 1.0].alarms.value == table["never fire", 1.0].false_alarm.value == 0.0
    assert table[SIGN, 1.0].false_alarm.value == pytest.approx(0.5, abs=0.1)  # a threshold of its own


@pytest.mark.slow
def test_the_false_alarm_rate_is_kept_on_fresh_records():
    """Over many campaigns the mean rate on fresh records is the one asked for (exact: 10 of 200 are beyond)."""
    rates = [
        next(r for r in judged(rows_of(seed, leaky=2)).table if r.detector == CHANGED).false_alarm.value
        for seed in range(40)
    ]
    assert np.mean(rates) == pytest.approx(0.05, abs=4 * np.std(rates) / math.sqrt(40))
    assert np.std(rates) > 0


def test_roc_and_area_know_the_closed_form():
    """Uniform scores moved by 0.3: area 1 - 0.7^2/2."""
    result = judged(rows_of(3, free=1500, leaky=900))
    area = next(one.area for one in result.rocs if one.detector == CHANGED and one.leak_lpm == 1.0)
    assert area.low < 1 - 0.7**2 / 2 < area.high
    assert any(math.isnan(one.leak_lpm) for one in result.rocs)


def test_a_duty_without_leak_free_records_cannot_be_told():
    rows = [*rows_of(4), row(50000, 9.0, leak=3.0, command="5 sin(2t)"), row(50001, 9.0, leak=3.0)]
    result = judged(rows)
    last = next(one for one in result.table if (one.detector, one.leak_lpm) == (CHANGED, 3.0))
    assert (last.alarms.count, last.cannot_tell.count, last.alarms.n) == (1, 1, 2)
    with refusal("999", "199"):
        judged(rows, false_alarm=0.001)


def test_duties_have_thresholds_of_their_own():
    random = np.random.default_rng(5)
    rows = [row(k, random.random(), "calibrate") for k in range(100)]
    rows += [row(100 + k, 10 + random.random(), "calibrate", command="5 sin(2t)") for k in range(100)]
    rows += [row(10000 + k, random.random()) for k in range(100)]
    rows += [row(11000 + k, 10 + random.random(), command="5 sin(2t)") for k in range(100)]
    rows += [row(12000, 5.0, leak=1.0), row(12001, 5.0, leak=1.0, command="5 sin(2t)")]
    result = judged(rows)
    assert {duty for _, duty in result.thresholds} == {"3 sin(4t)", "5 sin(2t)"}
    table = next(one for one in result.table if one.detector == CHANGED)
    assert table.alarms.count == 1  # the same score is high at the one point and low at the other
    assert table.false_alarm.value == pytest.approx(0.05, abs=0.05)


def test_other_faults_are_not_leaks():
    rows = [*rows_of(6), *(row(60000 + k, 9.0, fault="air in the oil") for k in range(4))]
    result = judged(rows)
    assert next(one for one in result.table if one.detector == CHANGED).false_alarm.n == 400
    alarms = {one.detector: (one.fault, one.alarms.count, one.alarms.n) for one in result.faults}
    assert alarms[CHANGED] == alarms["always fire"] == ("air in the oil", 4, 4)
    assert alarms["never fire"] == ("air in the oil", 0, 4)


def test_the_order_of_rows_does_not_matter():
    rows = rows_of(7)
    assert repr(judged(rows[::-1]).table) == repr(judged(rows).table)


def test_a_campaign_without_records_to_judge_is_refused():
    rows = [one for one in rows_of(8) if one.use == "calibrate"]
    with refusal("record"):
        judged(rows)
