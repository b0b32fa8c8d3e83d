"""A fleet watched live: run lengths as stated, alarms where something changed, whatever the blocks; bounded memory."""

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.fleet.fleet import LEARNING, MISSING, STILL, WATCHED, Fleet
from sealscope.diagnosis.fleet.run_length import cusum_run_length, cusum_threshold, glr_run_length, glr_threshold
from sealscope.diagnosis.fleet.sequential_tests import NUMBERS, forget, judge
from sealscope.errors import InputError

RATE = 200.0
#: A fleet that decides every 2 s and learns for one minute, so that tests are short.
SHORT = {"window_s": 1.0, "decision_s": 2.0, "learn_s": 60.0, "memory_s": 60.0, "late_s": 20.0, "alarms_per_hour": 0.05}
NEVER = 1e9


def pressures(actuators, seconds, seed=0):
    """Coloured noise on a sine, (2, actuators, n) [Pa]: leak-free readings of no machine in particular."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    x = rng.normal(size=(2, actuators, t.size))
    x[..., 1:] += 0.6 * x[..., :-1]
    return 3e5 + 1e5 * np.sin(2.0 * math.pi * t / 2.0) + 2e3 * x


def fed(fleet, x, block=777):
    for start in range(0, x.shape[-1], block):
        fleet.update(x[..., start : start + block])
    return fleet


def state_of(actuators, series=1, window=60, late=10):
    shape = (series, actuators)
    whole = np.int64
    arrays = (
        np.zeros((NUMBERS, *shape)), np.zeros((2, *shape), whole), np.empty((late + 2, *shape)),
        np.zeros((window + 1, *shape)), np.zeros(shape, whole), np.zeros((2, *shape)),
        np.full((5, actuators), -1, whole),
    )  # fmt: skip
    forget(np.arange(actuators), *arrays)
    return arrays


def alarm_rate(phi, learn, limits, decisions, actuators, seed=0):
    """False alarms a decision of AR(1) series with a level and a scale of their own, after so many to learn from."""
    rng = np.random.default_rng(seed)
    tests = state_of(actuators)
    level, scale = rng.normal(5.0, 3.0, (1, actuators)), 10.0 ** rng.uniform(-3, 1, (1, actuators))
    y = rng.normal(size=(1, actuators)) / math.sqrt(1.0 - phi**2)
    for k in range(1, learn + decisions + 2):
        judge(level + scale * y, k, learn, limits, *tests)
        y = phi * y + rng.normal(size=y.shape)
    raised = tests[-1][0]
    return np.count_nonzero(raised >= 0) / np.where(raised < 0, decisions, raised - learn - 1).sum()


@pytest.mark.parametrize(("h", "published"), [(3.0, 117.6), (4.0, 335.4), (5.0, 930.9)])
def test_cusum_run_length_is_the_published_one(h, published):
    """One-sided, k = 1/2: W. D. Ewan, K. W. Kemp, Biometrika 47 (1960); D. M. Hawkins, J. Quality Tech. 24 (1992)."""
    assert cusum_run_length(h, 0.5) == pytest.approx(published, rel=5e-4)


@pytest.mark.parametrize("wanted", [60.0, 1e3, 1e6, 1e9])
def test_thresholds_have_the_run_length_they_were_asked_for(wanted):
    assert cusum_run_length(cusum_threshold(wanted, 0.5), 0.5) == pytest.approx(2.0 * wanted, rel=1e-6)
    assert glr_run_length(glr_threshold(wanted, 40), 40) == pytest.approx(wanted, rel=1e-6)


def run_lengths(limits, runs, longest, window):
    """Run lengths of both tests on standard normal numbers, by plain vector code of its own."""
    rng = np.random.default_rng(11)
    h, k, b = limits
    up, down, sums = np.zeros(runs), np.zeros(runs), [np.zeros(runs)]
    found = np.full((2, runs), longest)
    for n in range(1, longest + 1):
        z = rng.normal(size=runs)
        up, down = np.maximum(0, up + z - k), np.maximum(0, down - z - k)
        sums.append(sums[-1] + z)
        sums = sums[-window - 1 :]
        ratio = np.max([np.abs(sums[-1] - sums[-1 - m]) / math.sqrt(m) for m in range(1, len(sums))], axis=0)
        for row, over in ((0, np.maximum(up, down) >= h), (1, ratio >= b)):
            found[row] = np.where(over & (found[row] == longest), n, found[row])
    return found


def test_run_lengths_of_the_formulae_are_those_of_a_simulation():
    wanted, longest = 150.0, 1500
    found = run_lengths((cusum_threshold(wanted), 0.5, glr_threshold(wanted, 20)), 1200, longest, 20)
    assert found[0].mean() == pytest.approx(wanted, rel=0.1)
    assert found[1].mean() == pytest.approx(wanted, rel=0.15)


@pytest.mark.parametrize("phi", [0.0, 0.6])
def test_false_alarms_come_at_the_stated_rate(phi):
    """Both tests together, thresholds for half the rate each; reference and phi learned from 60 decisions."""
    run_length = 300.0
    limits = (cusum_threshold(2 * run_length), 0.5, glr_threshold(2 * run_length, 60))
    rate = alarm_rate(phi, 60, limits, 150, 1500) * run_length
    assert 0.25 <= rate <= 1.15  # both tests see one change: less than their sum


@pytest.mark.slow
@pytest.mark.parametrize(
    ("phi", "learn", "most"),
    [
        (0.0, 30, 1.5),
        (0.6, 30, 2.0),
        (0.9, 30, 3.5),
        (0.0, 120, 1.1),
        (0.3, 120, 1.1),
        (0.6, 120, 1.1),
        (0.9, 120, 1.2),
    ],
)
@pytest.mark.parametrize(("run_length", "decisions"), [(3e3, 500), pytest.param(3e5, 4000, marks=pytest.mark.long)])
def test_average_run_length_on_autocorrelated_series(phi, learn, most, run_length, decisions):
    """AR(1) with normal innovations, level, scale and phi learned: the stated rate at most after 120 decisions (and
    counting error), more after 30, where phi is known badly."""
    h, b = cusum_threshold(run_length), glr_threshold(run_length, 60)
    for limits in ((h, 0.5, NEVER), (NEVER, 0.5, b)):
        assert 0.15 <= alarm_rate(phi, learn, limits, decisions, 4000) * run_length <= most


def test_a_step_is_found_soon_and_placed():
    tests, learn, at = state_of(200), 60, 90
    limits = (cusum_threshold(1e6), 0.5, glr_threshold(1e6, 60))
    rng = np.random.default_rng(3)
    for k in range(1, 131):
        judge(rng.normal(size=(1, 200)) - (3.0 if k > at else 0.0), k, learn, limits, *tests)
    raised, after, _, way, _ = tests[-1]
    assert np.all(raised > at) and np.median(raised - at) <= 6 and np.all(way == -1)
    assert np.mean(np.abs(after - at) <= 2) > 0.9


def test_only_the_actuator_that_changed_alarms():
    x = pressures(11, 200)
    quiet = fed(Fleet(RATE, 11, **SHORT), x)
    assert not quiet.alarms.alarm.any() and np.all(quiet.alarms.status == WATCHED)
    changed = x.copy()
    begin = round(120 * RATE)
    mean = 3e5 + 1e5 * np.sin(2.0 * math.pi * np.arange(x.shape[-1] - begin) / RATE / 2.0)
    changed[0, 4, begin:] = mean + 0.75 * (x[0, 4, begin:] - mean)
    fleet = fed(Fleet(RATE, [f"rig {i}" for i in range(11)], **SHORT), changed)
    told = fleet.alarms
    assert np.flatnonzero(told.alarm).tolist() == [4] and told.direction[4] == -1
    assert 120.0 < told.t[4] < 140.0 and abs(told.onset[4] - 120.0) <= 4.0
    assert fleet.series[told.series[4]].endswith("of p_A") and told.score[4] > 1.0
    others = np.delete(fleet.change_percent[:, :4], 4, axis=2)
    assert np.all(fleet.change_percent[0, :4, 4] < -10.0) and abs(others.mean()) < 3.0
    assert fleet.change_percent[0, 0, 4] == pytest.approx(-25.0, abs=8.0)
    fleet.relearn(["rig 4"])
    assert not fleet.alarms.alarm.any() and fleet.alarms.status[4] == LEARNING and math.isnan(fleet.alarms.t[4])


def test_missing_and_silent_actuators_pause_alone_and_come_back():
    x = pressures(9, 200)
    clean = fed(Fleet(RATE, 9, **SHORT), x)
    holed = x.copy()
    a, b = round(100 * RATE), round(150 * RATE)
    holed[1, 2, a:b] = np.nan
    holed[0, 5, a:b] = 3e5
    holed[0, 6, a] = np.inf
    fleet = fed(Fleet(RATE, 9, **SHORT), holed[..., : b - 200])
    assert fleet.alarms.status.tolist() == [1, 1, MISSING, 1, 1, STILL, 1, 1, 1]
    fed(fleet, holed[..., b - 200 :])
    assert np.all(fleet.alarms.status == WATCHED)
    others = [0, 1, 3, 4, 7, 8]
    assert np.array_equal(fleet.alarms.score[others], clean.alarms.score[others])
    assert np.array_equal(fleet.change_percent[..., others], clean.change_percent[..., others])
    assert not fleet.alarms.alarm[2] and not fleet.alarms.alarm[6] and np.all(np.isfinite(fleet.change_percent))


@settings(deadline=None, max_examples=12)
@given(cuts=st.lists(st.integers(0, 20_000), max_size=30), seed=st.integers(0, 100))
def test_blocks_of_any_size_give_the_same(cuts, seed):
    x = pressures(3, 100, seed)
    x[0, 1, 15_000:] *= 2.0
    whole, parts = Fleet(RATE, 3, **SHORT), Fleet(RATE, 3, **SHORT, threads=2)
    whole.update(x)
    news = 0
    ends = [*sorted(cuts), x.shape[-1]]
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        news += parts.update(x[..., start:end]).new
    for one, other in zip(whole.alarms[2:], parts.alarms[2:], strict=True):
        assert np.array_equal(one, other, equal_nan=True)
    assert news == whole.alarms.new == np.count_nonzero(whole.alarms.alarm) > 0


@pytest.mark.parametrize("cut", [0, 300, 9_999, 30_001])
def test_saved_and_restored_goes_on_the_same(cut):
    x = pressures(10, 200)
    x[1, 3, 30_000:] *= 1.1
    whole = fed(Fleet(RATE, 10, **SHORT), x)
    before = Fleet(RATE, 10, **SHORT)
    before.update(x[..., :cut])
    after = Fleet.from_state(before.state_dict(), threads=2)
    assert np.array_equal(after.alarms.status, before.alarms.status)
    fed(after, x[..., cut:], 1234)
    for one, other in zip(whole.alarms[2:], after.alarms[2:], strict=True):
        assert np.array_equal(one, other, equal_nan=True)
    assert np.array_equal(whole.change_percent, after.change_percent)
    assert whole.alarms.alarm[3] and np.array_equal(whole.windows.rms[-1], after.windows.rms[-1])


def grown_by(fleet, block, first, times):
    """Traced bytes that `times` further updates leave behind, and the most they took meanwhile."""
    for _ in range(first):
        fleet.update(block)
    tracemalloc.start()
    try:
        fleet.update(block)
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        for _ in range(times):
            fleet.update(block)
        now, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return now - before, peak - before


def test_memory_is_flat():
    block = pressures(16, 2.5, 7)
    left, most = grown_by(Fleet(RATE, 16, **SHORT), block, 60, 200)
    assert left < 5_000 and most < 40_000 < block.nbytes / 3


@pytest.mark.slow
@pytest.mark.long
def test_memory_is_flat_over_a_week():
    fleet = Fleet(500.0, 8)
    block = np.random.default_rng(0).normal(size=(2, 8, 50_000))  # 100 s
    left, most = grown_by(fleet, block, 10, 6 * 7 * 24 * 6)
    assert fleet._rms.samples >= 7 * 24 * 3600 * 500
    assert left < 5_000 and most < 100_000 < block.nbytes / 50


def saved(**changes):
    """A fleet from a saved state in which something is wrong."""
    return Fleet.from_state({**Fleet(500.0, 3).state_dict(), **changes})


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (lambda: Fleet(0.0, 3), "rate must be > 0 Hz"),
        (lambda: Fleet(500.0, ["a", "a"]), "names of their own"),
        (lambda: Fleet(500.0, 3, decision_s=3.0), "decision_s must be a whole number of windows"),
        (lambda: Fleet(500.0, 3, window_s=0.0011), "window_s must be a whole number of samples"),
        (lambda: Fleet(500.0, 3, learn_s=60.0), "learn_s must be 20 decisions or more"),
        (lambda: Fleet(500.0, 3, watched=("d7",)), "watched must be of d1, d2"),
        (lambda: Fleet(500.0, 3, alarms_per_hour=0.0), "alarms_per_hour must be > 0"),
        (lambda: Fleet(500.0, 3, alarms_per_hour=1e-9), "average run length must be"),
        (lambda: Fleet(500.0, 3).relearn(["seven"]), "actuators must be of this fleet, got seven"),
        (lambda: Fleet(500.0, "rig"), "actuators must be a list of names, got 'rig'"),
        (lambda: Fleet(500.0, 3, alarms_per_hour="few"), "alarms_per_hour must be > 0, got 'few'"),
        (lambda: Fleet(500.0, 3).relearn("1"), "actuators must be a list of names, got '1'"),
        (lambda: Fleet(500.0, 3).relearn(1), "actuators must be a list of names, got 1"),
        (lambda: Fleet(500.0, 3).relearn([1]), "actuators must be names, got 1"),
        (lambda: Fleet(500.0, 3).relearn(["1", "1"]), "got one name twice"),
        (lambda: Fleet.from_state({}), "saved fleet must have 'names'"),
        (lambda: Fleet.from_state(None), "saved fleet must be a mapping"),
        (lambda: saved(names="rig"), "saved fleet's names must be a list of names, got 'rig'"),
        (lambda: saved(names=["1", "2"]), "saved fleet's opened must have shape"),
        (lambda: saved(rate="fast"), "rate must be > 0 Hz, got 'fast'"),
        (lambda: saved(levels=2.5), "levels must be a whole number"),
        (lambda: saved(rms=3), "saved fleet must be a mapping, as state_dict returns it, got int"),
        (lambda: saved(pool=None), "saved fleet's pool must hold numbers"),
        (lambda: saved(lost=np.ones((2, 3))), "saved fleet's lost must hold numbers of type bool: got float64"),
        (lambda: saved(test_4=np.zeros((6, 3))), "saved fleet's test_4 must hold numbers of type int64: got float64"),
        (lambda: saved(means=np.zeros((2, 6, 4))), r"saved fleet's means must have shape \(2, 6, 3\), got"),
        (lambda: saved(window=-1), "saved fleet's window must be a whole number >= 0, got -1"),
        (lambda: saved(decision=1.5), "saved fleet's decision must be a whole number >= 0, got 1.5"),
        (lambda: saved(pooled=99), "saved fleet's pooled must be less than 5 windows, got 99"),
        (lambda: Fleet(500.0, 3).update(np.zeros((2, 4, 10))), r"block must have shape \(2, 3, n\)"),
    ],
)
def test_bad_calls_name_the_rule(call, rule):
    with pytest.raises(InputError, match=rule):
        call()
