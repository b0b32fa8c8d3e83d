"""The scan against plain loops and dense matrices, its thresholds against known order statistics, its power on steps
that were put in, its silence on drifts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.changepoint.scatter import WANDERS, HealthyDrift, Scan, StepScan
from sealscope.diagnosis.changepoint.scatter import _orders as orders
from sealscope.diagnosis.changepoint.shapes import least_blocks
from sealscope.diagnosis.changepoint.tails import ONSET_CUT, near_best, seed_of, upper_quantile


def scan(x: np.ndarray, joint: list[int], drift: HealthyDrift | None = None) -> Scan:
    return StepScan(x, joint, drift).observed()


def slow_scan(x: np.ndarray, joint: list[int], least: int) -> tuple[np.ndarray, np.ndarray, float]:
    """T2, single and trend by plain sums, as the formulas of the module stand."""
    n, f = x.shape
    mean = [sum(x[i, j] for i in range(n)) / n for j in range(f)]
    s = np.zeros((f, f))
    for i in range(1, n):
        step = x[i] - x[i - 1]
        s += np.outer(step, step) / (2 * (n - 1))
    inverse = np.linalg.inv(s[np.ix_(joint, joint)])
    t2, single = np.zeros(n - 1), np.zeros((n - 1, f))
    for k in range(least, n - least + 1):
        c = np.array([sum(x[i, j] - mean[j] for i in range(k)) for j in range(f)])
        weight = n / (k * (n - k))
        t2[k - 1] = weight * c[joint] @ inverse @ c[joint]
        for j in range(f):
            difference = x[k:, j].mean() - x[:k, j].mean()
            single[k - 1, j] = difference / np.sqrt(s[j, j] * (1 / k + 1 / (n - k)))
    time = np.arange(n) - (n - 1) / 2
    slope = np.array([sum(time[i] * (x[i, j] - mean[j]) for i in range(n)) for j in joint])
    return t2, single, float(slope @ inverse @ slope / sum(time**2))


@settings(max_examples=25, deadline=None)
@given(n=st.integers(12, 60), f=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_scan_is_what_plain_loops_give(n: int, f: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    x = random.standard_normal((n, f)) @ (np.eye(f) + 0.3 * random.standard_normal((f, f))) + random.normal(size=f)
    joint = sorted(random.permutation(f)[: max(1, f - 1)].tolist())
    t2, single, trend = slow_scan(x, joint, least_blocks(n))
    found = scan(x, joint)
    np.testing.assert_allclose(found.joint, t2, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.single, single, rtol=1e-6, atol=1e-9)
    assert found.trend == pytest.approx(trend, rel=1e-6)


def slow_t2(x: np.ndarray, joint: list[int], drift: HealthyDrift, shape: np.ndarray) -> float:
    """T2 of a change of that shape (n,) by generalised least squares with the whole covariance matrix of all blocks and
    columns: what the change in `joint` adds to the fit of means and of the changes of no account."""
    n, f = x.shape
    d = np.diff(x, axis=0)
    i = np.arange(1.0, n + 1)
    dense = np.kron(np.eye(n), d.T @ d / (2 * (n - 1)))
    dense += np.kron(np.minimum.outer(i, i), drift.walks @ drift.walks.T)
    inverse = np.linalg.inv(dense)

    def explained(heights: np.ndarray) -> float:
        design = np.concatenate([np.kron(np.ones((n, 1)), np.eye(f)), np.kron(shape[:, None], heights)], axis=1)
        right = design.T @ inverse @ x.ravel()
        return float(right @ np.linalg.solve(design.T @ inverse @ design, right))

    return explained(np.concatenate([np.eye(f)[:, joint], drift.other], axis=1)) - explained(drift.other)


@settings(max_examples=20, deadline=None)
@given(n=st.integers(14, 40), q=st.integers(0, 4), seed=st.integers(0, 2**32 - 1))
def test_scan_with_drift_is_generalised_least_squares(n: int, q: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    x = random.standard_normal((n, 4)) @ (np.eye(4) + 0.3 * random.standard_normal((4, 4)))
    x += 0.3 * np.cumsum(random.standard_normal((n, 4)), axis=0)
    drift = HealthyDrift(random.uniform(0.0, 1.0, (4, q)), np.array([[1.0], [0.8], [0.0], [0.4]]))
    found = scan(x, [1, 2, 3], drift)
    for k in (least_blocks(n), n // 2, n - least_blocks(n)):
        shape = (np.arange(n) >= k).astype(float)
        assert found.joint[k - 1] == pytest.approx(slow_t2(x, [1, 2, 3], drift, shape), rel=1e-6, abs=1e-8)
        alone = slow_t2(x[:, 2:3], [0], HealthyDrift(drift.walks[2:3], np.zeros((1, 0))), shape)
        assert found.single[k - 1, 2] ** 2 == pytest.approx(alone, rel=1e-6, abs=1e-8)
    even = slow_t2(x, [1, 2, 3], drift, np.linspace(0.0, 1.0, n))
    assert found.trend == pytest.approx(even, rel=1e-6)


def test_other_steps_are_not_seen() -> None:
    """A step of any height along `other` moves no T2; across it does."""
    random = np.random.default_rng(4)
    x = random.standard_normal((90, 3))
    drift = HealthyDrift(0.1 * np.eye(3), np.array([[1.0], [0.9], [0.5]]))
    late = (np.arange(90) >= 50)[:, None] * drift.other.T
    made = StepScan(x, [1, 2], drift)
    plain, along, across = (made(one[None])[0][0] for one in (x, x + 0.3 * late, x + 2.0 * late * [1.0, 0.0, 1.0]))
    # the step itself is in the scatter's estimate, at one block of 90
    np.testing.assert_allclose(along[49], plain[49], rtol=0.05)
    assert across[49] > plain[49] + 15


@pytest.mark.parametrize("strength", [0.1, 0.5])
def test_drift_of_the_stated_size_alarms_as_seldom_as_stated(strength: float) -> None:
    """Random walks as allowed: 5 % of alarms with the drift in the model, most of the series without."""
    random = np.random.default_rng(16)
    held, bare = 0, 0
    for _ in range(80):
        x = random.standard_normal((50, 3))
        x += strength * np.cumsum(random.standard_normal((50, 3)), axis=0)
        for drift in (HealthyDrift(strength * np.eye(3), np.zeros((3, 0))), None):
            made = StepScan(x, [0, 1, 2], drift)
            alarm = made.observed().joint.max() > upper_quantile(made.null(199)[0], 0.05)
            held, bare = held + (alarm and drift is not None), bare + (alarm and drift is None)
    assert held <= 11  # of 80 at 5 %: more has a probability of 0.1 %
    assert bare >= 20


def test_a_series_says_how_much_it_wanders() -> None:
    """Walks four times as large as stated are told, and alarm no more; a step beside those stated is none of them."""
    random = np.random.default_rng(19)
    stated = HealthyDrift(0.1 * np.eye(3), np.zeros((3, 0)))
    bare, held, found = 0, 0, 0
    for _ in range(40):
        x = random.standard_normal((80, 3)) + 0.4 * np.cumsum(random.standard_normal((80, 3)), axis=0)
        made = StepScan(x, [0, 1, 2], stated)
        restless = made.likeliest()
        bare += made.observed().joint.max() > upper_quantile(made.null(199)[0], 0.05)
        held += restless.observed().joint.max() > upper_quantile(restless.null(199)[0], 0.05)
        x = stepped(random, 80, 40, 3.0) + 0.1 * np.cumsum(random.standard_normal((80, 3)), axis=0)
        made = StepScan(x, [0, 1, 2], stated).likeliest()
        found += made.observed().joint.max() > upper_quantile(made.null(199)[0], 0.05)
    assert bare >= 15
    assert held <= 7  # of 40 at 5 %: more has a probability of 0.2 %
    assert found >= 36


def test_the_cost_is_the_likelihood_beside_the_best_step() -> None:
    """Differences of the cost against dense covariance matrices, for series whose scatter is 1 by construction."""
    random = np.random.default_rng(20)
    n = 40
    x = random.standard_normal((n, 1)) + 0.2 * np.cumsum(random.standard_normal((n, 1)), axis=0)
    x /= np.sqrt(0.5 * np.mean(np.diff(x, axis=0) ** 2))
    made = StepScan(x, [0], HealthyDrift(0.1 * np.eye(1), np.zeros((1, 0))))
    costs, dense = [], []
    for wander in WANDERS:
        costs.append(StepScan(x, [0], made.drift, wander=wander).cost())
        walk = np.tril(np.ones((n, n)))
        contrast = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, : n - 1]]))[0][:, 1:]  # the mean is unknown
        S = contrast.T @ (np.eye(n) + (0.1 * wander) ** 2 * walk @ walk.T) @ contrast
        best = -np.inf
        for k in range(made.least, n - made.least + 1):
            step, y = contrast.T @ (np.arange(n) >= k), contrast.T @ x[:, 0]
            solved = np.linalg.solve(S, step)
            best = max(best, float(y @ solved) ** 2 / float(step @ solved))
        dense.append(np.linalg.slogdet(S)[1] + y @ np.linalg.solve(S, y) - best)
    np.testing.assert_allclose(np.diff(costs), np.diff(dense), rtol=1e-6)


@pytest.mark.parametrize("n", [24, 60])
def test_many_columns_in_few_blocks_alarm_as_seldom_as_stated(n: int) -> None:
    """The scatter of eight columns is known badly from 24 blocks: orders must know it as badly."""
    random = np.random.default_rng(17)
    drift = HealthyDrift(np.zeros((8, 0)), np.zeros((8, 0)))
    alarms = 0
    for _ in range(100):
        made = StepScan(random.standard_normal((n, 8)), list(range(8)), drift)
        alarms += made.observed().joint.max() > upper_quantile(made.null(99)[0], 0.1)
    assert alarms <= 20  # of 100 at 10 %: more has a probability of 0.1 %


def test_a_step_is_found_beside_a_drift() -> None:
    random = np.random.default_rng(18)
    drift = HealthyDrift(0.05 * np.eye(3), np.zeros((3, 0)))
    found = 0
    for _ in range(30):
        x = stepped(random, 100, 50, 2.0) + 0.05 * np.cumsum(random.standard_normal((100, 3)), axis=0)
        made = StepScan(x, [0, 1, 2], drift)
        found += made.observed().joint.max() > upper_quantile(made.null(199)[0], 0.01)
    assert found >= 26


def test_scan_leaves_out_steps_near_the_ends() -> None:
    x = np.random.default_rng(0).standard_normal((100, 2))
    t2 = scan(x, [0, 1]).joint
    least = least_blocks(100)
    assert least == 3
    assert np.all(t2[: least - 1] == 0)
    assert np.all(t2[-(least - 1) :] == 0)
    assert np.all(t2[least - 1 : -(least - 1)] > 0)


def test_a_column_twice_adds_nothing() -> None:
    x = np.random.default_rng(1).standard_normal((80, 2))
    doubled = np.column_stack([x, x[:, 0]])
    np.testing.assert_allclose(scan(doubled, [0, 1, 2]).joint, scan(x, [0, 1]).joint, rtol=1e-6)


def test_t2_of_nothing_is_chi_squared() -> None:
    """At a fixed instant T2 has f degrees of freedom: mean f, 95 % point 7.815 for f = 3 (any chi-squared table)."""
    random = np.random.default_rng(3)
    t2 = np.array([scan(random.standard_normal((200, 3)), [0, 1, 2]).joint[99] for _ in range(800)])
    assert t2.mean() == pytest.approx(3.0, rel=0.08)
    assert np.mean(t2 > 7.815) == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize(
    ("m", "p", "rank"), [(999, 0.01, 990), (999, 0.05, 950), (1999, 0.01, 1980), (100, 0.01, 100), (9, 0.01, 9)]
)
def test_quantile_is_the_order_statistic(m: int, p: float, rank: int) -> None:
    shuffled = np.random.default_rng(0).permutation(np.arange(1.0, m + 1))
    assert upper_quantile(shuffled, p) == rank
    both = np.stack([shuffled, -shuffled], axis=1)
    np.testing.assert_array_equal(upper_quantile(both, p), [rank, rank - m - 1])


@pytest.mark.parametrize("p", [0.01, 0.05, 0.1, 0.13])
def test_quantile_keeps_the_rate_exactly(p: float) -> None:
    """Of m + 1 exchangeable values each is as likely the observed one: at most p may exceed the rest's quantile."""
    values = np.arange(100.0)
    exceeding = sum(value > upper_quantile(np.delete(values, k), p) for k, value in enumerate(values))
    assert exceeding == int(100 * p + 1e-9)


def test_enough_orders_exceed_the_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = []
    made = StepScan(np.random.default_rng(0).standard_normal((24, 2)), [0, 1])
    monkeypatch.setattr(made, "null", lambda count, after: counts.append(count) or (np.arange(9.0),) * 3)
    for probability in (0.05, 0.01, 1e-4):
        made.thresholds(probability)
    assert counts == [999, 1999, 199999]


@pytest.mark.parametrize("n", [24, 25])
def test_orders_keep_neighbours_together(n: int) -> None:
    found = orders(n, 50, np.random.default_rng(0))
    np.testing.assert_array_equal(np.sort(found, axis=1), np.tile(np.arange(n), (50, 1)))
    for order in found:
        together = np.sum(np.diff(order) % n == 1)
        assert together >= n // 2
    assert len({tuple(order) for order in found}) == 50


def test_random_orders_come_from_the_series() -> None:
    """The same series has the same orders, in any unit; another series has others."""
    x = np.random.default_rng(0).standard_normal((40, 3))
    drift = HealthyDrift(0.1 * np.eye(3), np.zeros((3, 0)))
    null, same = (StepScan(x, [0, 2], drift).null(300) for _ in range(2))
    for first, second, shape in zip(null, same, ((300,), (300, 3), (300,)), strict=True):
        np.testing.assert_array_equal(first, second)
        assert first.shape == shape
    assert seed_of(x) == seed_of(3.0 * x - 7.0)
    assert len({seed_of(np.random.default_rng(k).standard_normal((40, 3))) for k in range(50)}) == 50


def test_nothing_alarms_as_seldom_as_stated() -> None:
    random = np.random.default_rng(11)
    alarms = 0
    for _ in range(60):
        x = random.standard_normal((40, 4))
        null, *_ = StepScan(x, [0, 1, 2, 3]).null(399)
        alarms += scan(x, [0, 1, 2, 3]).joint.max() > upper_quantile(null, 0.05)
    assert alarms <= 9  # of 60 at 5 %: more has a probability of 0.1 %


def stepped(random: np.random.Generator, n: int, at: int, size: float) -> np.ndarray:
    x = random.standard_normal((n, 3))
    x[at:, 1] += size
    return x


def test_a_step_is_found_where_it_is() -> None:
    random = np.random.default_rng(12)
    found, near = 0, 0
    for _ in range(30):
        x = stepped(random, 100, 40, 1.2)
        null, *_ = StepScan(x, [0, 1, 2]).null(199)
        result = scan(x, [0, 1, 2])
        found += result.joint.max() > upper_quantile(null, 0.01)
        near += abs(int(np.argmax(result.joint)) + 1 - 40) <= 5
        assert result.single[39, 1] > 0
    assert found >= 27
    assert near >= 25


def test_onset_interval_covers_the_truth_as_often_as_stated() -> None:
    assert pytest.approx(7.35, abs=0.01) == ONSET_CUT  # the 95 % value of Eo and Morley's table
    assert near_best(np.array([0.0, 5.0, 10.0, 9.0, 1.0])).tolist() == [1, 2, 3]
    random = np.random.default_rng(13)
    covered = 0
    for _ in range(300):
        near = near_best(scan(stepped(random, 100, 60, 1.0), [1]).joint) + 1
        covered += near[0] <= 60 <= near[-1]
    assert covered >= 0.93 * 300


def test_a_step_beats_a_trend_and_a_trend_a_step() -> None:
    random = np.random.default_rng(14)
    steps = sum(scan(stepped(random, 100, 50, 1.5), [0, 1, 2]).step_wins() for _ in range(60))
    drifts = 0
    for _ in range(60):
        x = random.standard_normal((100, 3))
        x[:, 1] += np.linspace(-1.5, 1.5, 100)
        drifts += scan(x, [0, 1, 2]).step_wins()
    assert steps >= 57
    assert drifts <= 6


def test_two_samples_are_the_scan_at_one_instant() -> None:
    x = np.random.default_rng(15).standard_normal((200, 3))
    made = StepScan(x, [0, 1], least=1)
    whole = scan(x, [0, 1])
    assert made.observed().joint[19] == pytest.approx(whole.joint[19])
    np.testing.assert_allclose(made.observed().single[19], whole.single[19])
    null, single_null, _ = made.null(999, after=20)
    assert null.shape == (999,)
    assert single_null.shape == (999, 3)
    assert np.median(null) == pytest.approx(1.386, rel=0.25)  # chi-squared with 2 degrees of freedom
    np.testing.assert_array_equal(made.null(999, after=20)[0], null)


@settings(max_examples=20, deadline=None)
@given(step=st.floats(0.0, 2.5), probability=st.sampled_from([0.02, 0.2]), seed=st.integers(0, 2**32 - 1))
def test_an_alarm_is_a_score_over_the_threshold(step: float, probability: float, seed: int) -> None:
    """Orders that stop early say what all of them together say."""
    made = StepScan(stepped(np.random.default_rng(seed), 40, 20, step), [0, 2])
    assert made.alarms(probability) == (made.observed().joint.max() > made.thresholds(probability)[0])
