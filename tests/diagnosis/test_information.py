"""Blocks of information: sums that add, elimination against dense least squares, weights that bound a spike."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.estimate.linear import solve
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, Weighting, information
from sealscope.diagnosis.inference.equations.terms import LEAK, Equation, Term
from sealscope.diagnosis.inference.rows import HUBER, OVERLAP, SUPPORT, block_gram_matrices, weak_form_rows
from sealscope.diagnosis.priors.inference import INFERENCE

FIELDS = tuple(Blocks.__dataclass_fields__)
STROKE, OIL, ZERO, TESTED, OTHER, LEFT = range(6)


def nothing(_: object) -> np.ndarray:
    raise AssertionError("rows are given, no channel is read")


def columns() -> ColumnRoles:
    """A balance of three terms that drift, the leak, and a term that is no nuisance."""
    kinds = {"stroke": "compliance", "oil": "air", "bias": "bias", LEAK: "piston", "other": ""}
    terms = [Term(name, "", nothing, "sensor fault", drift) for name, drift in kinds.items()]
    return ColumnRoles(Equation("test", nothing, tuple(terms)))


def recorded(count: int, each: int = 24, noise: float = 0.05, seed: int = 0) -> np.ndarray:
    """Rows (count, each, 6) of a balance whose terms drift, and whose leak is another number in every block."""
    random = np.random.default_rng(seed)
    x = random.standard_normal((count, each, 5))
    x[..., ZERO] = 1.0
    x[..., TESTED] += 0.5 * x[..., STROKE] + 0.7
    tau = np.linspace(-1.0, 1.0, count)[:, None]
    y = (3.0 + 0.1 * tau) * x[..., STROKE] - 1.5 * x[..., OIL] + 0.2 * tau**2
    y += random.uniform(-0.5, 1.0, (count, 1)) * x[..., TESTED] + noise * random.standard_normal((count, each))
    return np.concatenate([x, y[..., None]], axis=2)


def blocks(values: np.ndarray, seconds: float = 3.0) -> Blocks:
    count, each, _ = values.shape
    start = seconds * np.arange(count)
    gram = np.einsum("kri,krj->kij", values, values)[:, None]
    return Blocks(
        start,
        start + seconds,
        gram,
        np.full(count, float(each)),
        np.ones(count),
        np.ones((count, 9)),
        np.zeros(count),
    )


def oracle(values: np.ndarray, seconds: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Estimates (K,) and covariance (K, K) of the tested coefficient by dense least squares: other columns with every
    drift and its prior as a row, the tested one free in each block, the variance a fixed point; then the errors of the
    oil's expansion."""
    count, each, _ = values.shape
    own, others = columns(), [STROKE, OIL, ZERO]
    flat = values.reshape(-1, values.shape[2])
    block = np.repeat(np.arange(count), each)
    length = seconds * count
    middle = seconds * (np.arange(count) + 0.5)
    shapes = np.polynomial.legendre.legvander(2.0 * middle / length - 1.0, 2)[block]
    drifting = np.hstack([flat[:, [k]] * shapes for k in others])
    free = np.where(block[:, None] == np.arange(count), flat[:, [TESTED]], 0.0)
    level = np.linalg.lstsq(flat[:, others], flat[:, LEFT], rcond=None)[0]
    width = np.abs(level) * np.array([INFERENCE.drift.compliance, INFERENCE.drift.air, INFERENCE.drift.bias])
    width *= length / 60.0
    assert own.nuisance == (STROKE, OIL, ZERO, TESTED)
    variance = float(np.var(flat[:, LEFT]))
    for _ in range(100):
        believed = np.zeros((6, drifting.shape[1] + count))
        for row, (k, power) in enumerate((k, power) for k in range(3) for power in (1, 2)):
            believed[row, 3 * k + power] = np.sqrt(OVERLAP * variance) / width[k]
        design = np.vstack([np.hstack([drifting, free]), believed])
        target = np.concatenate([flat[:, LEFT], np.zeros(6)])
        coefficients = np.linalg.lstsq(design, target, rcond=None)[0]
        weight = (target - design @ coefficients) @ target
        variance = weight / len(flat)
    covariance = np.linalg.inv(design.T @ design) * OVERLAP * variance
    # the volumes of compliance (STROKE) and air (OIL) are known to within a fraction in each block; the square of what
    # they explain, less what errors of the fit add to it
    products = np.einsum("br,brc->bc", values[..., TESTED], drifting.reshape(count, each, -1))[:, :6]
    squares = (products @ coefficients[:6]) ** 2 - np.einsum("bc,cd,bd->b", products, covariance[:6, :6], products)
    energies = (values[..., TESTED] ** 2).sum(axis=1)
    errors = INFERENCE.blocks.expansion * np.sqrt(np.maximum(squares, 0.0)) / energies
    covariance = covariance[-count:, -count:]
    return coefficients[-count:], covariance + np.diag(errors**2)


@pytest.mark.parametrize(("count", "noise"), [(2, 0.05), (6, 0.05), (20, 0.5), (20, 1e-3)])
def test_elimination_equals_dense_least_squares(count: int, noise: float) -> None:
    values = recorded(count, noise=noise)
    estimate, covariance = oracle(values)
    made = information(blocks(values), (columns(),), TESTED, with_expansion=True)
    size = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(np.linalg.solve(made.precision, made.vector), estimate, atol=0.02 * size.min())
    np.testing.assert_allclose(np.linalg.inv(made.precision), covariance, atol=0.02 * float(covariance.max()))


def test_two_equations_of_one_coefficient_add() -> None:
    first, second = recorded(8, seed=1), recorded(8, seed=2)
    alone = [information(blocks(values), (columns(),), TESTED) for values in (first, second)]
    one = blocks(first)
    both = Blocks(
        one.start,
        one.end,
        np.concatenate([one.gram, blocks(second).gram], axis=1),
        one.rows,
        one.flow,
        one.pressures,
        one.zero,
    )
    together = information(both, (columns(), columns()), TESTED)
    np.testing.assert_allclose(together.precision, alone[0].precision + alone[1].precision, rtol=1e-12)
    np.testing.assert_allclose(together.vector, alone[0].vector + alone[1].vector, rtol=1e-12)


@pytest.mark.parametrize("most", [1, 2, 3, 7, 16, 17, 100])
def test_sums_add(most: int) -> None:
    whole = blocks(recorded(17))
    merged = whole.merge(most)
    assert len(merged) <= most or len(merged) == len(whole)
    np.testing.assert_allclose(merged.gram.sum(axis=0), whole.gram.sum(axis=0), rtol=1e-12)
    assert merged.rows.sum() == whole.rows.sum()
    assert (merged.start[0], merged.end[-1]) == (whole.start[0], whole.end[-1])
    assert (merged.start[1:] >= merged.end[:-1]).all()
    np.testing.assert_allclose(merged.flow, 1.0)
    np.testing.assert_allclose(merged.pressures, 1.0)


def test_joined_blocks_are_those_of_the_whole() -> None:
    whole = blocks(recorded(12))
    parts = [Blocks(*(getattr(whole, name)[cut] for name in FIELDS))
             for cut in (slice(0, 5), slice(5, 6), slice(6, 12))]  # fmt: skip
    joined = Blocks.join(parts)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))


def test_what_says_nothing_is_left_at_zero() -> None:
    values = recorded(6)
    values[..., OIL] = 0.0
    made = information(blocks(values), (columns(),), TESTED)
    assert np.isfinite(made.precision).all() and np.isfinite(made.vector).all()
    without = information(blocks(recorded(6)), (columns(),), TESTED)
    assert made.precision.shape == without.precision.shape


def case_leaks(values: np.ndarray) -> float:
    """One coefficient of the leak, from the weighted sums of blocks that are closed one after the other."""
    weighting = Weighting((columns(),))
    total = sum(weighting.compute_gram_matrices([block], np.array([len(block)]))[0, 0] for block in values)
    chosen = [STROKE, OIL, ZERO, TESTED]
    return float(solve(total[np.ix_(chosen, chosen)], total[chosen, LEFT])[-1])


def steady(seed: int, noise: float = 0.05) -> np.ndarray:
    random = np.random.default_rng(seed)
    x = random.standard_normal((10, 24, 5))
    x[..., ZERO] = 1.0
    y = 3.0 * x[..., STROKE] - 1.5 * x[..., OIL] + 0.4 * x[..., TESTED] + noise * random.standard_normal((10, 24))
    return np.concatenate([x, y[..., None]], axis=2)


def test_a_spike_moves_the_estimate_by_a_bounded_amount() -> None:
    """Huber's influence is bounded: a spike 1000 times larger moves the leak no further, and little at all."""
    clean = case_leaks(steady(0))
    moved = []
    for size in (1.0, 1e3, 1e6):
        values = steady(0)
        values[4, 11, LEFT] += size
        moved.append(abs(case_leaks(values) - clean))
    error = 0.05 / np.sqrt(values.shape[0] * values.shape[1])
    assert max(moved) < 2.0 * error
    assert moved[2] == pytest.approx(moved[1], abs=0.01 * error)


def test_weights_cost_five_percent_of_normal_errors() -> None:
    robust, plain = [], []
    for seed in range(60):
        flat = steady(seed).reshape(-1, 6)
        robust.append(case_leaks(flat[None]) - 0.4)
        plain.append(np.linalg.lstsq(flat[:, :4], flat[:, LEFT], rcond=None)[0][-1] - 0.4)
    assert abs(np.mean(robust)) < 4.0 * np.std(robust) / np.sqrt(len(robust))
    assert 0.85 < np.mean(np.square(plain)) / np.mean(np.square(robust)) < 1.03


def test_overlap_is_the_ratio_of_variances_of_means() -> None:
    """White noise of a rate: the mean of many rows varies more than that of as many independent ones."""
    random = np.random.default_rng(1)
    rate = 200.0
    made = weak_form_rows([random.standard_normal(round(4000.0 * rate)) / rate], rate).values[:, 0]
    each = 200
    means = made[: len(made) // each * each].reshape(-1, each).mean(axis=1)
    assert np.var(means) * each / np.var(made) == pytest.approx(OVERLAP, rel=0.3)


def by_iteration(blocks: np.ndarray, turns: int = 60) -> np.ndarray:
    """Huber's weights of rows of blocks (K, r, 6) by dense least squares: stroke and oil common, the others free."""
    count, each, _ = blocks.shape
    design = np.zeros((count, each, 2 + 2 * count))
    design[..., :2] = blocks[..., [STROKE, OIL]]
    for k in range(count):
        design[k, :, 2 + 2 * k : 4 + 2 * k] = blocks[k][:, [ZERO, TESTED]]
    flat, left = design.reshape(count * each, -1), blocks[..., LEFT].ravel()
    weights = np.ones(len(left))
    for _ in range(turns):
        root = np.sqrt(weights)
        fit = np.linalg.lstsq(flat * root[:, None], left * root, rcond=None)[0]
        size = np.abs(left - flat @ fit)
        weights = np.minimum(1.0, HUBER * 1.4826 * np.median(size) / size)
    return weights


@pytest.mark.parametrize("each", [11, 24])
def test_compiled_sums_are_those_of_a_dense_iteration(each: int) -> None:
    """The fixed point of the weights, to the iteration's tolerance, for an even and an odd number of rows."""
    values = recorded(3, each, noise=0.2)
    values[1, 3, LEFT] += 5.0
    flat = values.reshape(-1, 6)
    ends, known = each * np.arange(1, 4), np.zeros((3, 3))
    gram = block_gram_matrices(flat, ends, np.array([ZERO, TESTED]), np.array([STROKE, OIL, LEFT]), known, 1.0)
    root = np.sqrt(by_iteration(values)).reshape(3, each, 1)
    expected = np.einsum("kri,krj->kij", values * root, values * root)
    assert gram == pytest.approx(expected, abs=0.02 * np.abs(expected).max())
    assert np.abs(gram - np.einsum("kri,krj->kij", values, values)).max() > 0.1 * np.abs(expected).max()
    inner = [np.ix_(*2 * ([STROKE, OIL, LEFT],)), np.ix_([STROKE, OIL, LEFT], [ZERO, TESTED])]
    free = [own[inner[0]] - own[inner[1]] @ solve(own[2:4, 2:4], own[inner[1]].T) for own in gram]
    assert known == pytest.approx(SUPPORT / 3 * sum(free), rel=1e-6)


def test_what_is_known_weighs_a_block_that_cannot_tell_alone() -> None:
    """One block of five rows has four coefficients: the outlier shows by what the blocks before say."""
    values = steady(1)
    before, known = values[:9].reshape(-1, 6), np.zeros((3, 3))
    fast, own = np.array([ZERO, TESTED]), np.array([STROKE, OIL, LEFT])
    block_gram_matrices(before, 24 * np.arange(1, 10), fast, own, known, 1.0)
    block = values[9, :5].copy()
    block[2, LEFT] += 1.0
    alone = block_gram_matrices(block, np.array([5]), fast, own, np.zeros((3, 3)), 0.0)[0, ZERO, ZERO]
    beside = block_gram_matrices(block, np.array([5]), fast, own, known, 0.0)[0, ZERO, ZERO]
    assert beside < alone
