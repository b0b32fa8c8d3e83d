"""Between recordings: Student's law of the rise under the null, coverage, and what few recordings allow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, kstest, norm

from sealscope.diagnosis.estimate.population import Mixture, Population, ScatterPrior
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, scale_grams
from sealscope.diagnosis.inference.comparison import (
    RecordingSums,
    Resistance,
    Rise,
    block_weights,
    eliminate_unshared,
    estimate_leak_excess,
    find_unusual_conditions,
    motion_change,
    rise,
    rise_of_mixture,
)
from sealscope.diagnosis.inference.equations.terms import LAG, LEAK, Equation, Term
from sealscope.diagnosis.inference.volumes.volume_detector import compare_motion
from sealscope.diagnosis.priors.inference import INFERENCE

from ..representatives import few

PRESSURE, FLOW = 1e5, 1e-5
#: Usual scatter of the leak's coefficient [m^3/(s Pa)].
PRIORS = 0.003 * FLOW / PRESSURE


def nothing(_: object) -> np.ndarray:
    raise AssertionError("sums are given, no channel is read")


COLUMNS = ColumnRoles(
    Equation(
        "test",
        nothing,
        (
            Term("oil", "", nothing, "air in the oil", "compliance"),
            Term("bias", "", nothing, "sensor fault", "bias"),
            Term(LEAK, "", nothing, "piston or pump leak", "piston"),
        ),
    )
)


def recording(random: np.random.Generator, leak: float, noise: float = 1e-5, shift: float = 0.0) -> Blocks:
    """Eight blocks of a recording with a zero of the flow that repeats; `noise` [FLOW], `shift` of pressures [Pa]."""
    x = random.standard_normal((8, 30, 3)) * [1.0, 0.0, PRESSURE] + [0.0, 1.0, 0.3 * PRESSURE]
    y = x @ [0.5 * FLOW, 0.5 * FLOW, leak] + noise * FLOW * random.standard_normal((8, 30))
    x[..., 2] += shift
    values = np.concatenate([x, y[..., None]], axis=2)
    start = 3.0 * np.arange(8)
    gram = np.einsum("kri,krj->kij", values, values)[:, None]
    return Blocks(
        start,
        start + 2.9,
        gram,
        np.full(8, 30.0),
        np.full(8, FLOW),
        np.full((8, 9), PRESSURE),
        np.zeros(8),
    )


def risen(random: np.random.Generator, count: int, scatter: float, leak: float = 0.0, **kind: float) -> Rise:
    """The rise of a recording beyond `count` healthy ones, in a fleet whose leakage scatters."""
    level = 20.0 * PRIORS
    healthy = [recording(random, level + scatter * random.normal(), **kind) for _ in range(count)]
    return beyond(recording(random, level + scatter * random.normal() + leak, **kind), healthy)


def beyond(judged: Blocks, healthy: Sequence[Blocks]) -> Rise:
    """The rise of a recording beyond healthy ones."""
    return rise(
        RecordingSums.from_blocks(judged, (COLUMNS,)),
        [RecordingSums.from_blocks(own, (COLUMNS,)) for own in healthy],
        (COLUMNS,),
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_leak_that_varies_causes_the_rise_that_the_weights_of_the_blocks_state(seed: int) -> None:
    """A leak of g_k in block k adds g_k times the leak's column to the left side: the rise grows by sum_k w_k g_k."""
    random = np.random.default_rng(seed)
    blocks, healthy = (recording(random, 20.0 * PRIORS) for _ in range(2))
    columns = (COLUMNS, COLUMNS.with_free_zero())[seed % 2]  # without and with a flow offset of each recording
    grams = scale_grams(blocks, (columns,))
    leaks, leak = PRIORS * random.standard_normal(len(blocks)), columns.leak
    leaking = grams.copy()
    leaking[..., -1] += leaks[:, None, None] * leaking[..., leak]  # the left side with all columns ...
    leaking[..., -1, :] += leaks[:, None, None] * leaking[..., leak, :]  # ... and all columns with it
    reference = eliminate_unshared(scale_grams(healthy, (columns,)).sum(axis=0), (columns,))
    before, after = (
        estimate_leak_excess(eliminate_unshared(gram.sum(axis=0), (columns,)), reference, (columns,), np.ones(1))[0][0]
        for gram in (grams, leaking)
    )
    weights = block_weights(grams, reference, (columns,))
    assert weights.sum() == pytest.approx(1.0)
    assert after - before == pytest.approx(weights @ leaks, rel=1e-6, abs=1e-6 * PRIORS)


DAY = 86400.0


def fleet(random: np.random.Generator, days: Sequence[int], viscosity: float, within: float) -> list[RecordingSums]:
    """Recordings of these days: leakage goes with the inverse of each day's viscosity (deviation of its logarithm)."""
    thin = dict(zip(dict.fromkeys(days), np.exp(viscosity * random.standard_normal(len(days))), strict=False))
    level = 20.0 * PRIORS
    return [
        RecordingSums.from_blocks(
            recording(random, level * thin[day] + within * random.normal()), (COLUMNS,), DAY * day
        )
        for day in days
    ]


@pytest.mark.parametrize("draws", [16, pytest.param(100, marks=[pytest.mark.slow, pytest.mark.long])])
@pytest.mark.parametrize(
    "days",
    [
        (1, 1, 1, 2),
        *(pytest.param(days, marks=pytest.mark.slow) for days in ((1, 1, 2, 2, 3, 3, 3, 4), (1, 1, 2, 2, 2, 2))),
    ],
)
@pytest.mark.slow
def test_a_day_of_other_oil_is_no_leak(days: Sequence[int], draws: int) -> None:
    """Between two days the viscosity differs as far as it is believed to."""
    random = np.random.default_rng(len(days))
    viscosity = 0.5 * np.log(INFERENCE.oil.warmest) / np.sqrt(2.0)
    chances = []
    for _ in range(draws):
        *healthy, judged = fleet(random, days, viscosity, PRIORS)
        chances.append(rise(judged, healthy, (COLUMNS,)).chance)
    for level in (0.1, 0.01):
        assert np.sum(np.array(chances) < level) <= binom.ppf(0.999, draws, level)


def test_recordings_without_a_date_are_of_one_day() -> None:
    random = np.random.default_rng(3)
    *healthy, judged = fleet(random, (1, 1, 1, 1), 0.0, PRIORS)
    undated = [replace(own, start_s=None) for own in (*healthy, judged)]
    alike, later = rise(judged, healthy, (COLUMNS,)), replace(judged, start_s=DAY * 2)
    assert rise(undated[-1], undated[:-1], (COLUMNS,))[:2] == alike[:2]
    assert rise(later, healthy, (COLUMNS,)).deviation > 5.0 * alike.deviation


def test_a_known_temperature_of_the_oil_takes_off_what_it_makes_of_the_level() -> None:
    """Twice the leakage in oil that is 17 K warmer is no leak, and as much at the same temperature is."""
    random, level = np.random.default_rng(5), 20.0 * PRIORS
    twice = np.exp(INFERENCE.oil.per_kelvin * 17.3)
    healthy = [RecordingSums.from_blocks(recording(random, level), (COLUMNS,), DAY * 1, 40.0) for _ in range(4)]

    def risen(day: int, warm: float) -> Rise:
        return rise(
            RecordingSums.from_blocks(recording(random, twice * level), (COLUMNS,), DAY * day, warm),
            healthy,
            (COLUMNS,),
        )

    assert abs(risen(1, 57.3).value) < 0.1 * level < risen(1, 40.0).value
    assert risen(2, 57.3).chance > 0.1
    assert risen(2, 40.0).chance < 1e-2


@pytest.mark.slow
def test_days_that_are_known_narrow_what_another_day_may_be() -> None:
    random = np.random.default_rng(4)

    def deviation(days: int) -> float:
        made = [fleet(random, [*np.repeat(range(days), 2), days], 0.01, PRIORS) for _ in range(3)]
        return float(np.median([rise(judged, healthy, (COLUMNS,)).deviation for *healthy, judged in made]))

    assert deviation(1) > 1.5 * deviation(6) > 1.5 * deviation(30)


def believed_scatter(random: np.random.Generator) -> float:
    """A machine's scatter, drawn from what is believed of it: any of its decades."""
    believed = INFERENCE.scatter
    ends = np.log([believed.finest * FLOW / PRESSURE, believed.largest * FLOW / PRESSURE])
    return float(np.exp(random.uniform(*ends)))


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, pytest.param(3, marks=pytest.mark.long), 6])
def test_the_chance_is_uniform_over_machines_as_they_are_believed(count: int) -> None:
    random = np.random.default_rng(count)
    made = [risen(random, count, believed_scatter(random)) for _ in range(80)]
    assert kstest([own.chance for own in made], "uniform").pvalue > 1e-3
    held = sum(low <= 0.0 <= high for low, high in (own.interval(0.9) for own in made))
    assert binom.ppf(0.0005, len(made), 0.9) <= held <= binom.ppf(0.9995, len(made), 0.9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "count",
    [
        1,
        *(pytest.param(count, marks=pytest.mark.long) for count in (2, 3)),
        6,
        pytest.param(12, marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize("scatter", [pytest.param(0.2, marks=pytest.mark.long), 1.0, 6.0])
def test_level_at_a_scatter_that_was_not_expected(count: int, scatter: float) -> None:
    """A machine that scatters six times as much as believed: the prior counts as one degree of freedom, no more, so
    the level is at most that of Student's t with one degree less at a score sqrt(n / (n - 1)) smaller."""
    from scipy.stats import t

    draws, level = 200, 0.01
    random = np.random.default_rng(count)
    made = sum(risen(random, count, scatter * PRIORS).chance < level for _ in range(draws))
    freedom = count - 1.0
    worst = 0.03 if count == 1 else float(t.sf(t.isf(level, freedom + 1.0) * np.sqrt(freedom / count), freedom))
    assert made <= binom.ppf(0.999, draws, worst if scatter > 1.0 else level)


def test_the_rise_is_the_leak_that_was_added() -> None:
    random = np.random.default_rng(0)
    for leak in (0.0, 5.0 * PRIORS, 100.0 * PRIORS):
        made = risen(random, 4, 1e-3 * PRIORS, leak)
        assert made.value == pytest.approx(leak, abs=0.05 * PRIORS)


def machine(random: np.random.Generator, count: int, differs: float) -> Rise:
    """The rise beyond `count` recordings whose compliance differs by a share of its size, and whose rows tell it and
    the leak apart badly."""

    def day() -> Blocks:
        x = random.standard_normal((8, 30, 3)) * [1.0, 0.0, PRESSURE] + [0.0, 1.0, 0.0]
        x[..., 2] += 3.0 * PRESSURE * x[..., 0]
        oil = 0.5 * FLOW * (1.0 + differs * random.standard_normal())
        y = x @ [oil, 0.0, 20.0 * PRIORS] + 1e-2 * FLOW * random.standard_normal((8, 30))
        values = np.concatenate([x, y[..., None]], axis=2)
        start = 3.0 * np.arange(8)
        gram = np.einsum("kri,krj->kij", values, values)[:, None]
        flows, pressures = np.full(8, FLOW), np.full((8, 9), PRESSURE)
        return Blocks(start, start + 2.9, gram, np.full(8, 30.0), flows, pressures, np.zeros(8))

    return beyond(day(), [day() for _ in range(count)])


@pytest.mark.parametrize("draws", [12, pytest.param(60, marks=[pytest.mark.slow, pytest.mark.long])])
@pytest.mark.slow
def test_a_machine_that_repeats_itself_is_judged_closer_and_another_not_falsely(draws: int) -> None:
    random = np.random.default_rng(7)
    believed = COLUMNS.between_deviation[0]
    same, usual, other = ([machine(random, 8, share * believed) for _ in range(draws)] for share in (1e-3, 1.0, 10.0))
    closer, wider = (float(np.median([own.deviation for own in made])) for made in (same, other))
    assert closer < 0.5 * wider
    for made in (same, usual, other):
        assert np.sum([own.chance < 0.05 for own in made]) <= binom.ppf(0.999, len(made), 0.05)


@pytest.mark.slow
def test_one_healthy_recording_tells_little() -> None:
    random = np.random.default_rng(1)

    def half_width(count: int) -> float:
        low, high = risen(random, count, 0.3 * PRIORS).interval(0.99)
        return 0.5 * (high - low)

    alone, few, many = (np.median([half_width(count) for _ in range(20)]) for count in (1, 3, 12))
    assert alone > 5.0 * few > 5.0 * many
    # never odds of one in ten thousand from two recordings: a leak of ten believed deviations is no proof
    assert risen(random, 1, 0.3 * PRIORS, 10.0 * PRIORS).chance > 1e-2
    assert risen(random, 12, 0.3 * PRIORS, 10.0 * PRIORS).chance < 1e-4


def test_a_zero_of_a_sensor_is_no_rise() -> None:
    """The judged recording's pressure difference is off by as much as is usual."""
    for shift in (-INFERENCE.zero.pressure, INFERENCE.zero.pressure):
        random = np.random.default_rng(2)
        healthy = [recording(random, 20.0 * PRIORS) for _ in range(4)]
        made = beyond(recording(random, 20.0 * PRIORS, shift=shift), healthy)
        assert abs(made.value) < 0.1 * PRIORS


def test_a_zero_of_the_flow_takes_no_part_of_an_orifice_s_flow() -> None:
    """Under a load that hardly changes, half of the flow through an orifice looks like a zero, half laminar."""

    def loaded(random: np.random.Generator, orifice_flow: float) -> RecordingSums:
        """Sums over 2000 rows under a load that changes by a tenth."""
        dp = PRESSURE * (1.0 + 0.1 * random.standard_normal(2000))
        x = np.column_stack([random.standard_normal(2000), np.ones(2000), dp])
        y = x @ [0.5 * FLOW, 0.5 * FLOW, 20.0 * PRIORS] + orifice_flow * np.sqrt(dp / PRESSURE)
        values = np.column_stack([x, y]) / (1e-3 * FLOW)
        return RecordingSums((values.T @ values)[None], FLOW, PRESSURE)

    random, orifice_flow = np.random.default_rng(4), 0.1 * FLOW
    healthy = [loaded(random, 0.0) for _ in range(6)]
    flow = rise(loaded(random, orifice_flow), healthy, (COLUMNS,)).value * PRESSURE
    assert flow == pytest.approx(orifice_flow, rel=0.1)


def test_chance_threshold_and_interval_agree() -> None:
    made = Rise(3.0, 2.0, 4.0)
    assert Rise(made.threshold(made.chance) * 2.0, 2.0, 4.0).value == pytest.approx(3.0)
    low, high = made.interval(1.0 - 2.0 * made.chance)
    assert (low, high) == (pytest.approx(0.0, abs=1e-9), pytest.approx(6.0))


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_a_rise_with_a_share_of_the_false_alarms_needs_a_higher_score(share: float) -> None:
    rise = Rise(2.0, 1.0, 5.0)
    shared = rise.share_alarms(share)
    assert shared.chance == pytest.approx(min(rise.chance / share, 1.0))
    assert shared.threshold(0.01) == pytest.approx(rise.threshold(0.01 * share))
    at_threshold = shared._replace(value=shared.threshold(0.01))
    assert at_threshold.chance == pytest.approx(0.01)


@pytest.mark.parametrize("scale", [0.0, 1e-200, 1.0, 1e150])
def test_recordings_of_any_size_have_a_rise_and_a_threshold(scale: float) -> None:
    random = np.random.default_rng(6)
    *healthy, judged = fleet(random, (1, 1, 2, 3), 0.1, PRIORS)
    scaled = [replace(own, sums=own.sums * scale, flow=own.flow * scale) for own in (*healthy, judged)]
    with np.errstate(all="ignore"):
        made = rise(scaled[-1], scaled[:-1], (COLUMNS,))
    assert 0.0 <= made.chance <= 1.0 and made.threshold(0.01) > 0.0


@pytest.mark.parametrize("seed", few(range(4), 1))
def test_what_others_let_expect_is_that_of_dense_algebra(seed: int) -> None:
    """A Gaussian process of an unknown mean, written out, integrated over sigma on a fine grid."""
    random = np.random.default_rng(seed)
    n, usual, freedom = 6, 0.7, 2.0
    root = random.standard_normal((n + 1, n + 1))
    covariance, values, ones = root @ root.T, random.standard_normal(n + 1), np.ones(n)
    logs, centres, deviations = [], [], []
    for variance in np.geomspace(1e-4, 1e6, 1500):
        inverse = np.linalg.inv(covariance[:n, :n] + variance * np.eye(n))
        precision, cross = ones @ inverse @ ones, covariance[:n, n]
        mean = (ones @ inverse @ values[:n]) / precision
        residual, missing = values[:n] - mean, 1.0 - ones @ inverse @ cross
        centres.append(mean + cross @ inverse @ residual)
        spread = variance + covariance[n, n] - cross @ inverse @ cross + missing**2 / precision
        deviations.append(np.sqrt(spread))
        logs.append(0.5 * (np.linalg.slogdet(inverse)[1] - np.log(precision) - residual @ inverse @ residual))
        logs[-1] -= 0.5 * freedom * (np.log(variance) + usual**2 / variance)
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    population = Population(covariance[None], np.zeros(1))
    predicted = population.predict_with_prior(values[None, :n], ScatterPrior(usual, freedom))
    result = rise_of_mixture(predicted, values[None, n])
    expected = weights @ norm.cdf((values[n] - result.value - np.array(centres)) / deviations)
    assert expected == pytest.approx(0.5, abs=0.02)
    chance = weights @ norm.sf((values[n] - np.array(centres)) / deviations)
    assert result.chance == pytest.approx(chance, rel=0.02)
    assert result._replace(value=4.0 + result.value).chance == pytest.approx(
        weights @ norm.sf((4.0 + values[n] - np.array(centres)) / deviations), rel=0.05
    )


def test_a_quantile_of_many_laws_is_that_of_all_of_them() -> None:
    """The search begins at the quantile of every tenth: the found one is as exact as of few laws."""
    random = np.random.default_rng(3)
    weights, deviations = random.random(10_000), np.exp(random.standard_normal(10_000))
    made = Mixture(weights / weights.sum(), 1e-13 * deviations, 1e-12 * random.standard_normal(10_000))
    for probability in (1e-9, 0.025, 0.5, 0.9, 1.0 - 1e-6):
        value = made.quantile(probability)
        assert made.weights @ norm.cdf((value - made.centres) / made.deviations) == pytest.approx(probability, rel=1e-9)


def test_a_rise_below_zero_bounds_a_leak_no_closer_than_none() -> None:
    low, none, high = (Rise(value, 2.0, 5.0) for value in (-20.0, 0.0, 3.0))
    assert low.bound() == none.bound() == pytest.approx(2.0 * 2.015, rel=1e-3)  # Student's t, 5 degrees, 95 %
    assert high.bound() == pytest.approx(3.0 + none.bound())


def test_the_ratio_of_densities_is_that_of_the_law() -> None:
    """The law of a rise is not centred where few recordings were compared: its density has the same centres."""
    stated = Rise(3.0, 2.0, np.inf, Mixture(np.array([0.3, 0.7]), np.array([1.0, 3.0]), np.array([-1.5, 4.0])))

    def density(value: float) -> float:
        step = 1e-4
        above = [stated._replace(value=value + side).chance for side in (-step, step)]
        return (above[0] - above[1]) / (2.0 * step)

    for leak in (0.5, 2.0, 5.0):
        assert stated.log_ratio(leak) == pytest.approx(np.log(density(3.0 - leak) / density(3.0)), abs=1e-5)


def test_five_that_agree_show_what_two_do_not() -> None:
    """Healthy recordings of one session that agree to a thousandth of what is usual; one passes a few times that."""
    random = np.random.default_rng(8)
    small, leak = 0.01 * PRIORS, 0.2 * PRIORS
    assert np.median([risen(random, 5, small, leak).chance for _ in range(9)]) < 2e-3
    assert np.median([risen(random, 2, small, leak).chance for _ in range(9)]) > 1e-2
    assert np.median([risen(random, 5, small).chance for _ in range(9)]) > 0.1


def warm_days(random: np.random.Generator, slope: float, judged: float, logged: bool = True) -> Rise:
    """The rise of a healthy recording in oil of one temperature [deg C] beyond seven in oil of 33 to 52."""

    def day(number: int, oil: float) -> RecordingSums:
        level = 20.0 * PRIORS * np.exp(slope * (oil - 45.0) + 0.03 * random.standard_normal())
        return RecordingSums.from_blocks(recording(random, level), (COLUMNS,), DAY * number, oil if logged else None)

    return rise(day(9, judged), [day(k, oil) for k, oil in enumerate(random.uniform(33.0, 52.0, 7))], (COLUMNS,))


@pytest.mark.parametrize("draws", [6, pytest.param(40, marks=[pytest.mark.slow, pytest.mark.long])])
@pytest.mark.parametrize("logged", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_warm_oil_is_no_leak_and_its_interval_holds(logged: bool, draws: int) -> None:
    random = np.random.default_rng(9)
    for judged in (60.0, 70.0):
        slopes = random.normal(0.04, 0.012 if logged else 0.003, draws)
        made = [warm_days(random, slope, judged, logged) for slope in slopes]
        assert sum(own.chance < 0.0075 for own in made) <= 2
        held = sum(low <= 0.0 <= high for low, high in (own.interval() for own in made))
        assert held >= binom.ppf(0.01, draws, 0.95) or (judged == 70.0 and not logged)
    near, far = (np.median([warm_days(random, 0.04, oil).deviation for _ in range(5)]) for oil in (45.0, 70.0))
    assert far > 2.0 * near


def oily_days(random: np.random.Generator, leak: float, error: float, *, shows: bool) -> Rise:
    """The rise beyond six days of unlogged oil, on a day with oil of half the mean viscosity.

    `error`: standard error of the logarithm of a viscous pressure drop; `shows`: it goes with the viscosity.
    """
    thinning = [*random.normal(0.0, 0.4, 6), 0.7]

    def day(number: int, thinner: float) -> RecordingSums:
        level = 20.0 * PRIORS * np.exp(thinner) + (leak if number == 6 else 0.0)
        log_drop = -thinner / INFERENCE.oil.per_drop if shows else random.normal(0.0, 0.3)
        drop = 1e6 * np.exp(log_drop + error * random.standard_normal())
        sums = RecordingSums.from_blocks(recording(random, level), (COLUMNS,), DAY * number)
        fit = Resistance(friction=1e5, friction_error=1e3, drop=drop, drop_error=error * drop, top_speed=0.1)
        return replace(sums, resistance=np.array(fit))

    *healthy, judged = (day(number, thinner) for number, thinner in enumerate(thinning))
    return rise(judged, healthy, (COLUMNS,))


@pytest.mark.slow
@pytest.mark.parametrize("draws", [2, pytest.param(9, marks=pytest.mark.long)])
def test_the_viscous_drop_tells_thin_oil_from_a_leak_where_no_thermometer_is_logged(draws: int) -> None:
    random, leak = np.random.default_rng(12), 20.0 * PRIORS
    precise, vague, useless = (
        [oily_days(random, 0.0, error, shows=shows) for _ in range(draws)]
        for error, shows in ((0.02, True), (1.0, True), (0.02, False))
    )
    assert np.median([own.chance for own in precise]) > 0.1
    assert np.median([own.deviation for own in precise]) < 0.5 * np.median([own.deviation for own in vague])
    assert sum(own.chance < 0.0075 for own in (*vague, *useless)) <= 1
    found, doubted = (
        np.median([oily_days(random, leak, error, shows=True).chance for _ in range(draws)]) for error in (0.02, 1.0)
    )
    assert found < 0.01 and found < 0.2 * doubted


MOTION_TERM = Term("motion", "", nothing, "sensor fault", "motion")
LEAK_TERM = Term(LEAK, "", nothing, "piston or pump leak", "piston")
MOVING = ColumnRoles(
    Equation("test", nothing, (MOTION_TERM, Term("oil", "", nothing, "air in the oil", "compliance"), LEAK_TERM))
)


def moving(random: np.random.Generator, leak: float, scale: float = 1.0) -> np.ndarray:
    """Gram matrix (4, 4) of a recording whose pressure goes with its speed, as friction makes it.

    `leak`: over the flow that motion takes; `scale` of that flow.
    """
    speed = random.standard_normal(400)
    pressure = np.sign(speed) + 0.5 * random.standard_normal(400)
    x = np.column_stack([speed, random.standard_normal(400), PRESSURE * pressure])
    y = FLOW * (scale * speed + 0.1 * x[:, 1] + leak * pressure + 1e-3 * random.standard_normal(400))
    values = np.column_stack([x, y]) / (1e-3 * FLOW)
    return values.T @ values


def test_the_flow_that_motion_takes_does_not_depend_on_what_leaks() -> None:
    """Leakage of 2 to 8 % of the flow, as cold and warm oil make it, under a pressure that goes with the speed."""
    random, errors = np.random.default_rng(4), []
    for leak, scale in (*10 * [(0.02, 1.0), (0.08, 1.0), (0.2, 1.0)], *10 * [(0.04, 1.02)]):
        healthy = [moving(random, healthy_leak) for healthy_leak in (0.02, 0.04, 0.08)]
        days = [*healthy, moving(random, leak, scale)]
        changes, deviations = zip(*(motion_change(day, np.sum(healthy, axis=0), MOVING) for day in days), strict=True)
        assert np.ptp(changes[:-1]) < 10.0 * max(deviations)
        errors.append((changes[-1] - np.mean(changes[:-1]) - np.log(scale)) / deviations[-1])
    assert np.std(errors) == pytest.approx(np.sqrt(1.0 + 1.0 / 3.0), rel=0.3)


def test_the_flow_that_motion_takes_does_not_depend_on_the_delay_of_the_position() -> None:
    """The column of the delay is in another unit than those of the motion, here with numbers ten times as large."""
    lag = Term(LAG, "", nothing, "sensor fault", "motion")
    roles = ColumnRoles(Equation("test", nothing, (MOTION_TERM, lag, LEAK_TERM)))
    random, days = np.random.default_rng(5), []
    for delay, scale in ((0.01, 1.0), (0.03, 1.0), (-0.02, 1.0), (0.02, 1.03)):
        x = random.standard_normal((400, 3)) * [1.0, 10.0, PRESSURE]
        y = FLOW * (scale * x[:, 0] + delay * x[:, 1] + 0.04 * x[:, 2] / PRESSURE + 1e-3 * random.standard_normal(400))
        values = np.column_stack([x, y]) / (1e-3 * FLOW)
        days.append(values.T @ values)
    changes = [motion_change(day, np.sum(days[:3], axis=0), roles)[0] for day in days]
    assert changes == pytest.approx([0.0, 0.0, 0.0, np.log(1.03)], abs=1e-3)


def test_a_scale_is_another_machine_only_at_speeds_that_are_known() -> None:
    """Another 5 % is rare at the speed of the healthy recordings; at half of it the slip of the pump may be as much."""
    random = np.random.default_rng(8)
    healthy, day = (
        [RecordingSums(moving(random, 0.04, scale)[None], FLOW, PRESSURE) for scale in scales]
        for scales in ([1.0] * 5, [1.03])
    )
    (usual,) = compare_motion(day[0], healthy, MOVING)
    (slow,) = compare_motion(replace(day[0], flow=0.5 * FLOW), healthy, MOVING)
    assert usual.chance < 1e-3 and slow.chance > 0.05
    assert usual.size == pytest.approx(slow.size)


def test_conditions_that_no_healthy_recording_had_are_named() -> None:
    random = np.random.default_rng(10)
    own = RecordingSums.from_blocks(recording(random, 20.0 * PRIORS), (COLUMNS,), DAY, 40.0)
    healthy = [own, replace(own, oil_degC=46.0, pressure=1.1 * PRESSURE)]
    assert not find_unusual_conditions(own, healthy)
    warmer = find_unusual_conditions(replace(own, oil_degC=60.0, pressure=1.87 * PRESSURE), healthy)
    assert [(of.name, of.low, of.high) for of in warmer] == [
        ("load", PRESSURE, pytest.approx(1.1 * PRESSURE)),
        ("oil", 40.0, 46.0),
    ]
    assert warmer[0].log_excess == pytest.approx(np.log(1.7))
    loaded = replace(own, pressure=1.87 * PRESSURE)
    assert rise(loaded, healthy, (COLUMNS,)).deviation > rise(own, healthy, (COLUMNS,)).deviation


def test_a_rise_that_is_expected_within_a_factor_is_one_over_its_logarithm() -> None:
    """The likelihood is averaged over the log-normal prior of the rise, by quadrature elsewhere."""
    shown = Rise(3.0, 0.05, 12.0)
    levels = np.exp(np.log(2.0) + 0.5 * np.linspace(-6.0, 6.0, 60_001))
    prior = np.exp(-0.5 * (np.log(levels / 2.0) / 0.5) ** 2) / (0.5 * levels * np.sqrt(2.0 * np.pi))
    ratios = np.exp([shown.log_ratio(level) for level in levels[::20]])
    expected = np.log(np.trapezoid(ratios * prior[::20], levels[::20]))
    assert shown.log_ratio(2.0, log_deviation=0.5) == pytest.approx(expected, abs=0.1)
    assert shown.log_ratio(0.02, log_deviation=0.5) < shown.log_ratio(2.0, log_deviation=0.5) - 20.0


def test_a_rise_of_infinite_freedom_is_normal() -> None:
    """Infinity times zero was no number, and no explanation had a probability."""
    assert Rise(3.0, 1.0, np.inf).log_ratio(3.0) == pytest.approx(4.5)
    assert Rise(3.0, 1.0, 1e9).log_ratio(3.0) == pytest.approx(4.5, rel=1e-6)


def test_a_condensed_mixture_has_the_same_quantiles():
    random = np.random.default_rng(5)
    weights = random.exponential(size=20_000)
    mixture = Mixture(weights / weights.sum(), random.lognormal(size=20_000), random.standard_normal(20_000))
    condensed = mixture.condense()
    assert len(condensed.weights) < 5_000
    assert condensed.mean == pytest.approx(mixture.mean, abs=1e-12)
    assert condensed.deviation == pytest.approx(mixture.deviation, rel=1e-12)
    assert condensed.interval == pytest.approx(mixture.interval, rel=5e-4)
