"""The step over all onsets: a brute-force oracle, the law of its score under the null, coverage of onset and bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import binom, truncnorm

from sealscope.diagnosis.estimate.change import (
    MIN_BLOCKS,
    Information,
    NullLaw,
    StepTest,
    filter_changes,
    fit_history,
    largest_step_likelihood,
    step_test,
    step_tests_of_columns,
)
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.live.kernel import step as stream
from sealscope.diagnosis.live.sequential import StepDetector

from ..representatives import few

SPACING = 3.0


def precision_of(random: np.random.Generator, count: int, width: float = 0.5, eliminated: int = 0) -> np.ndarray:
    """Precision of K blocks, log-normal; `eliminated` other columns took most of what lay along them."""
    size = np.exp(width * random.standard_normal(count))
    taken = np.linalg.qr(random.standard_normal((count, eliminated)))[0] if eliminated else np.zeros((count, 0))
    root = np.sqrt(size)
    return np.asarray(np.diag(size) - 0.8 * (root[:, None] * taken) @ (taken.T * root))


def drawn(
    random: np.random.Generator, precision: np.ndarray, walk: float = 0.0, coefficient: np.ndarray | float = 0.0
) -> Information:
    """Information of a coefficient with level, slope and a random walk whose variance over the noise's averages `walk`
    in the directions that level and slope leave."""
    count = len(precision)
    values, vectors = np.linalg.eigh(precision)
    design = (vectors * np.sqrt(values)).T
    index = np.arange(count)
    trend = np.column_stack([np.ones(count), index - index.mean()])
    free = np.linalg.qr(design @ trend, mode="complete")[0][:, 2:].T @ design
    outer = np.minimum.outer(index, index) + 1.0
    size = walk * len(free) / np.trace(free @ outer @ free.T)
    wandering = np.sqrt(size) * np.cumsum(random.standard_normal(count))
    g = coefficient + 3.0 - 0.02 * index + wandering
    vector = precision @ g + vectors @ (np.sqrt(values) * random.standard_normal(count))
    return Information(SPACING * (index + 0.5), precision, vector)


def judged(information: Information) -> StepTest:
    test = step_test(information)
    assert test is not None
    return test


def step(count: int, onset: float) -> np.ndarray:
    """A step at a time; of the block it falls into a part."""
    return np.clip(np.arange(count) + 1.0 - onset / SPACING, 0.0, 1.0)


def deviation_of(precision: np.ndarray, onset: float, walk: float) -> float:
    """Standard deviation of a step's size beside level, slope and a walk, by generalised least squares."""
    count = len(precision)
    index = np.arange(count)
    free = np.column_stack([np.ones(count), index - index.mean(), step(count, onset)])
    inner = np.minimum.outer(index, index) + 1.0
    covariance = np.linalg.inv(precision) + walk * inner
    return float(np.sqrt(np.linalg.inv(free.T @ np.linalg.solve(covariance, free))[2, 2]))


def restricted(information: Information, onset: float | None, walk: float) -> float:
    """Restricted log-likelihood over (kappa, step) for a walk, by the textbook formula in the blocks' own coordinates;
    with an onset the best step > 0 is taken out, its determinant is not."""
    precision, vector = information.precision, information.vector
    count = len(precision)
    index = np.arange(count)
    trend = np.column_stack([np.ones(count), index - index.mean()])
    covariance = np.linalg.inv(precision) + walk * (np.minimum.outer(index, index) + 1.0)
    estimate = np.linalg.solve(precision, vector)
    inverse = np.linalg.inv(covariance)
    inner = trend.T @ inverse @ trend
    projected = inverse - inverse @ trend @ np.linalg.solve(inner, trend.T @ inverse)
    rest = estimate @ projected @ estimate
    if onset is not None:
        s = step(count, onset)
        rest -= max(s @ projected @ estimate, 0.0) ** 2 / (s @ projected @ s)
    n = count - 2
    determinants = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(inner)[1]
    return float(-0.5 * determinants - 0.5 * n * np.log(rest / n))


def largest(information: Information, onset: float | None) -> float:
    """Largest restricted likelihood over walks of any size, none included."""

    def cost(log_walk: float) -> float:
        return -restricted(information, onset, float(np.exp(log_walk)))

    starts = np.linspace(-14.0, 4.0, 10)
    best = starts[int(np.argmin([cost(at) for at in starts]))]
    fitted = minimize_scalar(cost, bounds=(best - 2.0, best + 2.0), method="bounded")
    return max(-float(fitted.fun), restricted(information, onset, 0.0))


@pytest.mark.parametrize(("count", "walk", "size"), few([(9, 0.5, 0.0), (9, 0.0, 6.0), (5, 0.0, 0.0), (14, 3.0, 6.0)]))
def test_score_and_onset_equal_the_brute_force_likelihood(count: int, walk: float, size: float) -> None:
    random = np.random.default_rng(count)
    precision = precision_of(random, count, eliminated=2 if count > 9 else 0)
    made = drawn(random, precision, walk, size * step(count, 0.55 * SPACING * count))
    test = judged(made)
    without = largest(made, None)
    beside = np.array([largest(made, float(onset)) for onset in test.onsets])
    # the scan tries four walks a decade: it may miss the largest likelihood by a little, and never exceeds it
    assert test.score == pytest.approx(2.0 * (beside.max() - without), abs=0.06)
    np.testing.assert_allclose(test.likelihood - test.likelihood.max(), beside - beside.max(), atol=0.06)
    assert beside[test.best] > beside.max() - 0.05


def test_level_slope_and_units_do_not_matter() -> None:
    random = np.random.default_rng(3)
    made = drawn(random, precision_of(random, 20), 1.0, 2.0 * step(20, 33.0))
    test = judged(made)
    trend = 50.0 - 7.0 * np.arange(20)
    moved = judged(Information(made.time, made.precision, made.vector + made.precision @ trend))
    scaled = judged(Information(made.time, 1e24 * made.precision, 1e12 * made.vector))
    noisier = judged(Information(made.time, made.precision / 100.0, made.vector / 100.0))
    for other, unit in ((moved, 1.0), (scaled, 1e-12), (noisier, 1.0)):
        assert other.score == pytest.approx(test.score, rel=1e-6)
        assert other.chance == pytest.approx(test.chance, rel=1e-5)
        assert np.array(other.fitted) == pytest.approx(unit * np.array(test.fitted), rel=1e-5)
        assert other.best == test.best


def test_the_score_grows_with_the_step() -> None:
    random = np.random.default_rng(4)
    precision = precision_of(random, 30)
    noise = drawn(random, precision, 0.3)
    along = precision @ step(30, 40.0)
    scores = [judged(noise._replace(vector=noise.vector + size * along)).score for size in np.linspace(0.0, 8.0, 15)]
    assert (np.diff(scores[2:]) > 0.0).all()
    fallen = judged(noise._replace(vector=noise.vector - 8.0 * along))
    assert fallen.score < scores[4]


def test_threshold_is_the_inverse_of_the_chance() -> None:
    random = np.random.default_rng(5)
    for count in (5, 17, 60):
        test = judged(drawn(random, precision_of(random, count), 1.0))
        for chance in (0.2, 1e-2, 1e-4):
            assert test.law.chance(test.threshold(chance)) == pytest.approx(chance, rel=1e-6)
        assert test.law.chance(test.score) == test.chance


def test_a_curve_without_length_leaves_students_t() -> None:
    """One onset known beforehand: half a beta tail is Student's t of n - 1 degrees of freedom."""
    from scipy.stats import t

    n, ratio = 9, 2.3
    score = n * np.log1p(ratio**2 / (n - 1))
    assert NullLaw(n, 0.0).chance(score) == pytest.approx(float(t.sf(ratio, n - 1)), rel=1e-9)


def rejected(random: np.random.Generator, count: int, walk: float, draws: int, level: float, **kind: float) -> int:
    """Draws of healthy blocks whose chance is below a level; each has precisions of its own."""
    made = 0
    for _ in range(draws):
        precision = precision_of(random, count, **kind)  # type: ignore[arg-type]
        made += judged(drawn(random, precision, walk)).chance < level
    return made


@pytest.mark.parametrize("count", few([5, 40, 12]))
@pytest.mark.parametrize("walk", few([0.0, 100.0, 3.0]))
def test_the_chance_is_uniform_or_larger_in_healthy_machines(count: int, walk: float) -> None:
    draws = 60
    made = rejected(np.random.default_rng(count), count, walk, draws, 0.05)
    assert made <= binom.ppf(0.999, draws, 0.05)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("count", [5, 6, 8, 12, 20, 40, 60, 120])
@pytest.mark.parametrize("walk", [0.0, 0.3, 1.0, 3.0, 10.0, 100.0])
@pytest.mark.parametrize("kind", [{"width": 0.5}, {"width": 1.5}, {"width": 0.5, "eliminated": 4}], ids=str)
def test_the_chance_over_machines_of_any_kind(count: int, walk: float, kind: dict[str, float]) -> None:
    if kind.get("eliminated", 0) > count - 7:
        pytest.skip("fewer blocks than columns that are eliminated")
    draws = min(2000, 60000 // count)
    random = np.random.default_rng(int(100 * walk) + count)
    chances = []
    for _ in range(draws):
        precision = precision_of(random, count, **kind)  # type: ignore[arg-type]
        chances.append(judged(drawn(random, precision, walk)).chance)
    for level in (0.01, 0.05, 0.2):
        assert np.count_nonzero(np.array(chances) < level) <= binom.ppf(0.999, draws, 1.1 * level)


def coverage(random: np.random.Generator, count: int, walk: float, size: float, draws: int) -> tuple[int, int]:
    """Draws whose onset interval holds the onset, and whose bound holds the step, `size` deviations of the step."""
    held = bounded = 0
    for _ in range(draws):
        precision = precision_of(random, count)
        onset = SPACING * random.uniform(0.15 * count, 0.85 * count)
        index = np.arange(count)
        # variance of the walk a block, as `drawn` makes it
        values, vectors = np.linalg.eigh(precision)
        design = (vectors * np.sqrt(values)).T
        trend = np.column_stack([np.ones(count), index])
        free = np.linalg.qr(design @ trend, mode="complete")[0][:, 2:].T @ design
        unit = walk * len(free) / np.trace(free @ (np.minimum.outer(index, index) + 1.0) @ free.T)
        height = size * deviation_of(precision, onset, unit)
        test = judged(drawn(random, precision, walk, height * step(count, onset)))
        interval = test.onset()
        held += interval.low <= onset <= interval.high
        bounded += test.bound() >= height
    return held, bounded


@pytest.mark.parametrize(("count", "walk"), few([(10, 0.0), (25, 3.0), (25, 0.0), (60, 1.0)]))
@pytest.mark.parametrize(
    "size", [*(pytest.param(size, marks=[pytest.mark.slow, pytest.mark.long]) for size in (1.0, 8.0)), 3.0]
)
def test_onset_interval_and_bound_hold(count: int, walk: float, size: float) -> None:
    draws = 60
    held, bounded = coverage(np.random.default_rng(count), count, walk, size, draws)
    assert held >= binom.ppf(0.001, draws, 0.95)
    assert bounded >= binom.ppf(0.001, draws, 0.95)


def test_history_is_the_conditional_mean_of_the_blocks() -> None:
    random = np.random.default_rng(8)
    made = drawn(random, precision_of(random, 15), 20.0)
    walk, noise = 0.3, 1.4
    test = replace(judged(made), walk=(walk, 0.0), noise=(noise, 1.0))
    given = fit_history(made, test, with_step=False)
    index = np.arange(15)
    # level and slope are free: what the walk's precision says of them is projected out
    wandering = np.linalg.inv(walk * noise * (np.minimum.outer(index, index) + 1.0))
    trend = np.column_stack([np.ones(15), index - 7.0])
    across = wandering @ trend
    prior = wandering - across @ np.linalg.solve(trend.T @ across, across.T)
    covariance = np.linalg.inv(made.precision / noise + prior)
    np.testing.assert_allclose(given.mean, covariance @ made.vector / noise, rtol=1e-6)
    np.testing.assert_allclose(given.covariance, covariance, atol=1e-6 * float(covariance.max()))


def test_too_few_blocks_have_no_test() -> None:
    random = np.random.default_rng(6)
    assert step_test(drawn(random, precision_of(random, MIN_BLOCKS - 1))) is None
    silent = drawn(random, precision_of(random, 10))
    assert step_test(silent._replace(precision=0.0 * silent.precision, vector=0.0 * silent.vector)) is None


@pytest.mark.slow
@pytest.mark.parametrize("walk", [0.0, 1.0])
def test_what_is_believed_of_slope_and_walk_keeps_the_false_alarms_and_finds_more(walk: float) -> None:
    """A slope that is believed is nearly known: a step is found that a free slope would pass for."""
    count, draws = 30, 200
    random, time = np.random.default_rng(11), SPACING * (np.arange(count) + 0.5)
    false = result = free = 0
    for _ in range(draws):
        deviation = 2.0 * np.exp(0.3 * random.standard_normal(count))
        healthy = random.standard_normal() * np.arange(count) / count + walk * np.cumsum(
            random.standard_normal(count)
        ) / np.sqrt(count)
        noise = deviation * random.standard_normal(count)
        for size in (0.0, 4.5):
            values = healthy + size * (np.arange(count) >= count // 2) + noise
            own = Information(time, np.diag(deviation**-2.0), values / deviation**2, slope=1.0, walk=1.0)
            alarm = judged(own).chance < 0.05
            false += alarm and size == 0.0
            result += alarm and size > 0.0
            free += size > 0.0 and judged(own._replace(slope=np.inf, walk=np.inf)).chance < 0.05
    assert binom.sf(false - 1, draws, 0.05) > 1e-3
    assert result > 1.3 * free


def test_numbers_that_cannot_be_computed_with_show_no_step() -> None:
    precision = np.eye(20)
    precision[3, 3] = np.inf
    assert step_test(Information(np.arange(20.0), precision, np.zeros(20), slope=1.0, walk=1.0)) is None


def test_blocks_without_information_at_either_end_change_nothing() -> None:
    """A step there is no step of what is known: it would have any size, and made the bound 10^8 L/min."""
    estimates = np.random.default_rng(6).standard_normal(12)
    known = step_test(Information(np.arange(12.0), np.eye(12), estimates))
    precision, vector = np.zeros((22, 22)), np.zeros(22)
    precision[7:19, 7:19], vector[7:19] = np.eye(12), estimates
    padded = step_test(Information(np.arange(22.0) - 7.0, precision, vector))
    assert known is not None and padded is not None
    assert padded.onsets.min() >= -0.5
    assert padded.onsets.max() <= 11.5
    assert padded.bound() < 3.0 * known.bound()
    assert padded.detectable_step(1e-3) < 3.0 * known.detectable_step(1e-3)


def test_a_turbulent_part_of_the_healthy_leakage_is_no_step_but_a_leak_beside_it_is() -> None:
    """Where the pressure falls for good, the conductance of an orifice rises, as by a leak that begins."""
    random = np.random.default_rng(5)
    shape = 1.0 + step(30, 27.0)
    values = 10.0 + 3.0 * shape + 0.3 * random.standard_normal(30)

    def chance(values: np.ndarray, turbulent: bool) -> float:
        information = Information(SPACING * (np.arange(30) + 0.5), np.eye(30), values, slope=1.0, walk=1.0)
        return judged(information._replace(disturbance=4.0, shape=shape) if turbulent else information).chance

    assert chance(values, turbulent=False) < 1e-4
    assert chance(values, turbulent=True) > 0.01
    assert chance(values + 3.0 * step(30, 60.0), turbulent=True) < 1e-4
    # a part that is larger than believed is not explained away
    assert chance(values + 100.0 * shape, turbulent=True) < 1e-3


@pytest.mark.parametrize("value", [-30.0, -2.0, -0.3, 0.0, 0.4, 1.9, 1.97, 8.0])
def test_a_flow_that_is_never_negative_keeps_its_95_percent(value: float) -> None:
    """The interval holds 95 % of the normal distribution truncated at 0, and is the usual one far above 0."""
    deviation = 0.7
    estimate = Estimate(value * deviation, deviation)
    interval = estimate.nonnegative_interval()
    probability = truncnorm(-value, np.inf, loc=estimate.value, scale=deviation).cdf
    mass = probability(interval.high) - probability(interval.low)
    assert 0.0 <= interval.low <= interval.value <= interval.high
    # with half the tail beyond the end at 0 cut off, the usual interval holds up to 97.5 %
    assert 0.95 - 1e-6 <= mass <= 0.976
    assert interval.low > 0.0 or mass == pytest.approx(0.95, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_level_or_slope_that_other_columns_took_already_is_not_taken_twice(seed: int) -> None:
    """A step is tested beside any level and slope: eliminating them from the likelihood beforehand changes nothing."""
    random = np.random.default_rng(seed)
    count = int(random.integers(8, 40))
    made = drawn(random, precision_of(random, count), 1.0, 3.0 * step(count, 0.6 * SPACING * count))
    columns = np.column_stack([np.ones(count), np.arange(count)])[:, [[0], [1], [0, 1]][seed % 3]]
    inner = columns.T @ made.precision @ columns * (1.0 + 1e-10 * np.eye(columns.shape[1]))  # with a ridge, as others
    gain = np.linalg.solve(inner, columns.T @ made.precision)
    left = made.precision - made.precision @ columns @ gain
    taken = judged(made._replace(precision=left, vector=made.vector - gain.T @ (columns.T @ made.vector)))
    test = judged(made)
    assert (taken.score, taken.chance) == pytest.approx((test.score, test.chance), rel=1e-5)
    assert np.array(taken.fitted) == pytest.approx(np.array(test.fitted), rel=1e-5)


def test_a_prior_on_the_level_does_not_make_the_blocks_uninformed() -> None:
    """However well the level before the recording is known, all blocks count in the test of a step after it."""
    random, precision = np.random.default_rng(9), precision_of(np.random.default_rng(9), 20)
    values = 9.0 * step(20, 35.0) + random.standard_normal(20) / np.sqrt(np.diag(precision))
    made = Information(SPACING * (np.arange(20) + 0.5), precision, precision @ values)
    tests = [judged(made._replace(level=level)) for level in (1e2, 1e-4, 1e-8)]
    assert len({test.law.dimensions for test in tests}) == 1
    assert max(test.chance for test in tests) < 1e-3


def kalman_sums(values: np.ndarray, variances: np.ndarray, walk: float, begin: int) -> tuple[float, float, np.ndarray]:
    """Energy and moment of a step that begins with the block `begin`, and the squares of all innovations, by the Kalman
    filter of a random walk, whose level is the first value."""
    level, level_variance, response, energy, moment, squares = values[0], variances[0], 0.0, 0.0, 0.0, []
    for k in range(1, len(values)):
        predicted = level_variance + walk
        innovation, variance = values[k] - level, predicted + variances[k]
        shown = (k >= begin) - response  # of a unit step, by the prediction error
        energy += shown**2 / variance
        moment += shown * innovation / variance
        squares.append(innovation**2 / variance)
        gain = predicted / variance
        response += gain * shown
        level, level_variance = level + gain * innovation, (1.0 - gain) * predicted
    return energy, moment, np.array(squares)


def drawn_stream(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of blocks with a walk and a step, and the variances of their errors."""
    random = np.random.default_rng([7, seed])
    variances = np.exp(0.4 * random.standard_normal(count))
    walk = np.cumsum(random.choice([0.0, 0.3, 1.5]) * random.standard_normal(count))
    change = 3.0 * (np.arange(count) >= random.integers(3, count - 3))
    return walk + change + np.sqrt(variances) * random.standard_normal(count), variances


@pytest.mark.parametrize("seed", range(6))
def test_a_file_smooths_the_model_that_a_stream_and_a_folder_filter(seed: int) -> None:
    """Size and error of a step at each onset are the same by the smoother of a file, by a Kalman filter, and by the
    innovations of the covariance of all values, as for the recordings of a folder."""
    count = 12 + seed
    values, variances = drawn_stream(seed, count)
    information = Information(np.arange(count) + 0.5, np.diag(1.0 / variances), values / variances, slope=0.0)
    smoothed = step_test(information)
    assert smoothed is not None
    walk, index = smoothed.walk[0], np.arange(count)
    wide = 1e6
    factor = np.linalg.cholesky(wide + walk * np.minimum.outer(index, index) + np.diag(variances))
    steps = (index[:, None] >= index).astype(float)
    z, effects = np.linalg.solve(factor, values[:, None]), np.linalg.solve(factor, steps)
    filtered = filter_changes(z, effects, z)
    for begin in range(2, count - 1):
        energy, moment, squares = kalman_sums(values, variances, walk, begin)
        place = int(np.argmin(np.abs(smoothed.positions - begin)))
        error = np.sqrt((squares.sum() - moment**2 / energy) / len(squares) / energy)
        assert smoothed.size[place] == pytest.approx(moment / energy, rel=1e-6, abs=1e-9)
        assert smoothed.deviation[place] == pytest.approx(error, rel=1e-6)
        for last in (begin, count - 1):  # also while the stream is running
            energy, moment, _ = kalman_sums(values[: last + 1], variances[: last + 1], walk, begin)
            assert filtered.energy[last, begin] == pytest.approx(energy, rel=1e-4)
            assert filtered.moment[last, begin] == pytest.approx(moment, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_the_record_of_a_stream_holds_the_sums_of_the_kalman_filter(seed: int) -> None:
    """For each walk, and each onset at the beginning of a block, while all blocks are kept."""
    count = 12 + seed
    values, variances = drawn_stream(seed, count)
    variances /= variances[0]
    detector = StepDetector()
    for k, (value, variance) in enumerate(zip(values, variances, strict=True)):
        detector.take(float(k), k + 1.0, value, float(np.sqrt(variance)))
    record = detector._memory.view(np.recarray)[0]
    assert record.n_old == 0
    for place in range(int(record.n_stored)):
        begin = int(record.blocks[place, stream.BLOCK]) - 1
        for q, walk in enumerate(stream.WALKS):
            energy, moment, _ = kalman_sums(values, variances, walk, begin)
            assert stream._step_sums(record, q, place, 1.0) == pytest.approx((moment, energy), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_whitened_values_are_tested_as_blocks_are(seed: int) -> None:
    """The likelihood of a step is that of its residual in the covariance of noise and walk; it has no other course."""
    random = np.random.default_rng([11, seed])
    count, n = 7, 12
    effects, values = random.standard_normal((n, count)), random.standard_normal(n) + 1.5 * random.standard_normal()
    values += 2.0 * effects[:, 3]
    cases = np.array([effects, 2.0 * random.standard_normal((n, count))])
    walks = np.array([0.1, 0.2]) * (seed + 1)
    likelihoods, likeliest = largest_step_likelihood(cases, values, walks)
    for matrix, likelihood, walk in zip(cases, likelihoods, likeliest, strict=True):
        highest = []
        for variance in walks * n / np.trace(matrix @ matrix.T):
            inverse = np.linalg.inv(np.eye(n) + variance * matrix @ matrix.T)
            energies, moments = np.diag(matrix.T @ inverse @ matrix), matrix.T @ inverse @ values
            squares = values @ inverse @ values - np.maximum(moments, 0.0) ** 2 / energies
            highest.append((0.5 * np.linalg.slogdet(inverse)[1] - 0.5 * n * np.log(squares / n)).max())
        assert likelihood == pytest.approx(max(highest), rel=1e-9)
        assert walk == walks[np.argmax(highest)]


def test_coefficients_of_one_precision_are_tested_as_each_alone() -> None:
    """Up or down, with the log likelihood of each, tested or not, without a step."""
    random, time = np.random.default_rng(5), np.arange(12.0)
    values = random.standard_normal((12, 3)) - 4.0 * (time > 6.0)[:, None]
    tested = step_tests_of_columns(Information(time, np.eye(12), values), 2)
    assert tested is not None
    tests, without = tested
    alone = [step_test(Information(time, np.eye(12), column), (1.0, -1.0)) for column in values.T]
    expected = [number for test in alone[:2] if test for number in (test.score, test.sign)]
    assert [number for test in tests for number in (test.score, test.sign)] == pytest.approx(expected, rel=1e-12)
    assert without == pytest.approx([test.likelihood.max() - 0.5 * test.score for test in alone if test], rel=1e-12)
