"""The trend of a machine: its test against a slow oracle, its false alarms, and what it makes of a life with events."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from functools import partialmethod

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import halfnorm, multivariate_normal

import sealscope as ss
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.trend import TREND
from sealscope.diagnosis.trend import machine_trend
from sealscope.diagnosis.trend.machine_trend import Trend
from sealscope.diagnosis.trend.machine_trend import trend as trend_of
from sealscope.diagnosis.trend.reading import LeakReading, estimate_reading
from sealscope.diagnosis.trend.wear import Levels, ScatterPrior, outlier_excess, score_changes
from sealscope.recordings.header import oil_temperature
from sealscope.units import DAY, DAYS_PER_MONTH, LITRE_PER_MINUTE

from ..refusals import refusal

PRIOR = ScatterPrior(1.0, 4.0)
#: 0.0044 L/min at 0.11 MPa.
HEALTHY, PRESSURE = 6.7e-13, 1.1e5
#: 0.5 L/min [m^3/s].
PUMP = 0.5 * LITRE_PER_MINUTE


def reading(day: float, level: float = HEALTHY, *, number: int | None = None, **more: object) -> LeakReading:
    """A recording of 60 s whose volume balance states a level, made on a day of 2024."""
    own = round(day) if number is None else number
    fields = {
        "file": f"day_{own}.csv",
        "start": 1.704e9 + day * DAY,
        "duration": 60.0,
        "basis": "volume balance",
        "level": level,
        "error": 0.02 * HEALTHY,
        "pressure": PRESSURE,
        "states_flow": True,
        "pump": PUMP,
        "area": 633e-6,
        "machine": None,
        "temperature": None,
        "scale": 1.0,
        "digest": f"{day} {level}",
    }
    return LeakReading(**(fields | more))  # type: ignore[arg-type]


def life(
    days: int, *, wears: float = 0.0, since: float = 0.0, scatter: float = 0.07, seed: int = 0
) -> list[LeakReading]:
    """One recording a day; `wears` L/min a month from day `since` on."""
    random = np.random.default_rng(seed)
    growth = wears * LITRE_PER_MINUTE / PRESSURE / DAYS_PER_MONTH
    return [
        reading(day, HEALTHY * (1.0 + scatter * random.standard_normal()) + growth * max(day - since, 0.0))
        for day in range(days)
    ]


def levels_at(t: np.ndarray, value: np.ndarray, error: np.ndarray | float) -> Levels:
    zeros = np.zeros(len(t))
    return Levels(t, value, zeros + error, zeros.astype(int), zeros, PRIOR)


def flow(level: float) -> float:
    return level * PRESSURE / LITRE_PER_MINUTE


def oracle(levels: Levels, prior: ScatterPrior, known: int) -> float:
    """Shiryaev and Roberts's R after all recordings, each likelihood as an integral over the size of the change."""
    n, flat = len(levels), 1e4
    reach = max(prior.scale, 0.3 * float(np.ptp(levels.value)))
    grid = np.geomspace(0.1 * prior.scale, 10.0 * reach, 3)
    nodes = [(tau, 0.5, -prior.freedom * (math.log(tau) + 0.5 * (prior.scale / tau) ** 2)) for tau in grid]
    change = TREND.change
    kinds = [("step", scale) for scale in change.steps] + [("growth", every) for every in change.intervals]
    joint, null = dict.fromkeys(itertools.product(range(known, n), kinds), 0.0), 0.0
    for tau, share, log_prior in nodes:
        waits = np.abs(levels.t[:, None] - levels.t)
        lasting = 0.5 * (np.exp(-waits / 7.0) + np.exp(-24.0 * waits))
        cov = tau**2 * ((1 - share) * np.eye(n) + share * lasting) + np.diag(levels.error**2) + flat**2
        law = multivariate_normal(np.full(n, levels.value[0]), cov, allow_singular=True)
        weight = math.exp(log_prior)
        null += weight * law.pdf(levels.value)
        for (j, (kind, scale)), before in joint.items():
            if kind == "step":
                shape, size = (np.arange(n) >= j).astype(float), scale * tau
            else:
                shape = np.maximum(levels.t - levels.t[j - 1], 0.0)
                size = tau / scale / levels.interval

            def integrand(d: float, law=law, shape=shape, size=size) -> float:
                return law.pdf(levels.value - d * shape) * halfnorm.pdf(d, scale=size)

            value = quad(integrand, 0.0, 8.0 * size, limit=60, points=[0.01 * size, 0.1 * size, size])[0]
            joint[j, (kind, scale)] = before + weight * value
    many = {"step": len(change.steps), "growth": len(change.intervals)}
    waits = np.diff(levels.t)
    return sum(waits[j - 1] * value / null / 2.0 / many[kind] for (j, (kind, _)), value in joint.items())


def test_the_statistic_is_the_ratio_of_the_likelihoods(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sums of one factorisation against integrals of multivariate normal densities, unequal errors and waits."""
    monkeypatch.setitem(vars(TREND.between), "nodes", 3)
    monkeypatch.setitem(vars(TREND.between), "lasting_share", (0.5,))
    levels = levels_at(np.array([0.0, 1.0, 3.0, 4.0]), np.array([5.0, 5.5, 6.2, 6.9]), np.array([0.1, 0.5, 0.2, 0.3]))
    assert not np.any(outlier_excess(levels))
    assert score_changes(levels, 2).log_R[-1] == pytest.approx(math.log(oracle(levels, PRIOR, 2)), abs=2e-3)


def test_later_recordings_do_not_change_what_was_said_before() -> None:
    random = np.random.default_rng(3)
    levels = levels_at(np.arange(12.0), random.standard_normal(12), 0.1)
    whole = score_changes(levels, 2).log_R
    part = score_changes(levels.select(slice(0, 7)), 2).log_R
    # but for the upper end of the grid of tau, which follows the range of the values
    assert whole[2:7] == pytest.approx(part[2:], abs=0.1)


def alarms(machines: int, days: int, years: float, *, seed: int, tails: float = np.inf, lasting: float = 0.0) -> int:
    """Healthy machines that alarm within some days; their scatter is drawn from the prior."""
    random = np.random.default_rng(seed)
    count = 0
    for _ in range(machines):
        tau = math.sqrt(PRIOR.freedom / random.chisquare(PRIOR.freedom))
        noise = random.standard_normal(days)
        if math.isfinite(tails):
            noise = random.standard_t(tails, days) / math.sqrt(tails / (tails - 2.0))
        for k in range(1, days):
            noise[k] = lasting * noise[k - 1] + math.sqrt(1.0 - lasting**2) * noise[k]
        levels = levels_at(np.arange(float(days)), 3.0 + tau * noise, 0.02)
        count += score_changes(levels, 1).find_alarm(years * 365.25) is not None
    return count


@pytest.mark.parametrize("machines", [30, pytest.param(120, marks=[pytest.mark.slow, pytest.mark.long])])
@pytest.mark.slow
def test_the_rate_of_false_alarms_is_at_most_the_stated_one(machines: int) -> None:
    """With 1 in 0.1 years, 36.5 days, at most 20/36.5 of all machines alarm within 20 days, and some do."""
    days, years = 21, 0.1
    count = alarms(machines, days, years, seed=1)
    most = (days - 1) / (years * 365.25)
    assert 0 < count <= machines * most + 2.0 * math.sqrt(machines * most * (1.0 - most))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tails", "lasting"),
    [
        pytest.param(np.inf, 0.0, id="", marks=pytest.mark.long),  # as the test above, of more days
        pytest.param(4.0, 0.0, id="tails"),
        pytest.param(np.inf, 0.6, id="lasting"),
    ],
)
def test_the_rate_holds_for_other_scatter(tails: float, lasting: float) -> None:
    """Heavy tails, and scatter that lasts from day to day, within 60 days at 1 in 0.5 years."""
    machines, days, years = 60, 61, 0.5
    most = (days - 1) / (years * 365.25)
    assert alarms(machines, days, years, seed=2, tails=tails, lasting=lasting) <= machines * most


def delay(wears: float, seed: int) -> float:
    trend = trend_of(life(80, wears=wears, since=20.0, seed=seed), healthy=20)
    assert trend.alarm is not None
    return trend.alarm.day - 20.0


@pytest.mark.slow
@pytest.mark.parametrize("machines", [1, pytest.param(3, marks=pytest.mark.long)])
def test_faster_wear_alarms_earlier_and_before_it_has_doubled_the_level(machines: int) -> None:
    slow, fast = (np.median([delay(wears, seed) for seed in range(machines)]) for wears in (0.002, 0.02))
    assert 1.0 <= fast < 0.5 * slow
    assert slow * 0.002 / DAYS_PER_MONTH < flow(HEALTHY)


def test_growth_and_limit_hold_the_truth() -> None:
    trend = trend_of(life(60, wears=0.006, since=15.0), healthy=5, limit="15.6 mL/min")
    own = trend.wear
    assert (trend.verdict, trend.unit, trend.basis) == ("leak", "L/min", "volume balance")
    assert own is not None and own.step is None and own.onset is not None and own.reach is not None
    assert own.growth.low < 0.006 < own.growth.high < 0.0075
    assert own.onset.low <= 15.0 <= own.onset.high
    truth = flow(HEALTHY) + 0.006 * (59.0 - 15.0) / DAYS_PER_MONTH
    assert own.total.low < truth < own.total.high
    assert own.reach.low < (0.0156 + flow(HEALTHY) - truth) / 0.006 * DAYS_PER_MONTH < own.reach.high
    assert own.healthy.low < flow(HEALTHY) < own.healthy.high


def test_the_limit_is_reached_after_the_last_recording_that_is_compared() -> None:
    """A defective recording ten days later belongs to the trend, and changes no date but that of the last."""
    days = life(40, wears=0.006, since=15.0)
    defective = replace(reading(49.0), basis=None, problem="p_A is constant", level=math.nan, error=math.nan)
    own, later = (trend_of(given, healthy=5, limit="15.6 mL/min").as_dict() for given in (days, [*days, defective]))
    assert own["limit_reached"] is not None and later["limit_reached"] == own["limit_reached"]
    assert later["first"] == own["first"] and later["last"] > own["last"]


def test_leak_and_total_are_named_as_in_a_diagnosis() -> None:
    trend = trend_of(life(60, wears=0.006, since=15.0), healthy=5)
    row, truth = trend.as_dict(), 0.006 * (59.0 - 15.0) / DAYS_PER_MONTH
    assert row["leak_interval_lpm"][0] < truth < row["leak_interval_lpm"][1]
    assert row["leak_level"] == dict(
        zip(("value", "low", "high"), (row["leak_lpm"], *row["leak_interval_lpm"]), strict=True)
    )
    total = row["total_leakage"]
    assert row["total_level"] == dict(
        zip(("value", "low", "high"), (total["lpm"], *total["interval_lpm"]), strict=True)
    )
    assert total["lpm"] == pytest.approx(row["leak_lpm"] + flow(HEALTHY), rel=0.05)
    assert row["chance"] < 1.0 / 3652.0 and row["bound_lpm"] is None


@pytest.mark.parametrize("times", [pytest.param(100.0, marks=pytest.mark.slow), 1e6])
def test_a_leak_beyond_the_smallest_floating_point_chance_is_still_a_leak(times: float) -> None:
    random = np.random.default_rng(0)
    levels = HEALTHY * (1.0 + 0.05 * random.standard_normal(160))
    levels[80:] += times * HEALTHY
    trend = trend_of([reading(day, float(level)) for day, level in enumerate(levels)])
    assert trend.verdict == "leak" and trend.alarm is not None
    assert trend.leak.value == pytest.approx(flow(times * HEALTHY), rel=0.05)


@pytest.mark.parametrize("size", [*(pytest.param(size, marks=pytest.mark.long) for size in (0.0, 2.0)), 1.0])
@pytest.mark.slow
def test_a_step_that_raises_no_alarm_is_below_the_bound(size: float) -> None:
    """Steps of so many deviations between recordings, on any day: 5 of 100 may be above."""
    random, scatter = np.random.default_rng(1), 0.07 * HEALTHY
    broken, count = 0, 20
    for seed in range(count):
        onset = int(random.integers(8, 30))
        days = [
            replace(day, level=day.level + size * scatter * (k >= onset)) for k, day in enumerate(life(30, seed=seed))
        ]
        trend = trend_of(days, healthy=5)
        bound = trend.decision.bound_lpm
        assert trend.verdict == "leak" if bound is None else bound < 6.0 * flow(scatter)
        broken += bound is not None and bound < size * flow(scatter)
    assert broken <= 2


def test_a_rise_that_another_event_explains_is_no_leak(monkeypatch: pytest.MonkeyPatch) -> None:
    days = [reading(day, HEALTHY * (1.0 + 0.05 * (-1) ** day) * (1.0 if day < 12 else 1.35)) for day in range(16)]
    alone = trend_of(days, healthy=8)
    assert alone.verdict == "leak" and alone.decision.cause == "piston or pump leak"
    lost = Observable(name="external leak A", data="rise", score=200.0, chance=1e-40)
    monkeypatch.setattr(machine_trend, "_rival_changes", lambda last, before, since: (lost,))
    trend = trend_of(days, healthy=8)
    assert trend.alarm is not None and trend.verdict != "leak"
    assert trend.decision.cause == "external leak" and trend.state.cause == "external leak"
    assert "the external leakage on side A changed" in trend.reason


@pytest.mark.parametrize(("error", "compared"), [(0.0, 3), (1e-6, 3), (1e-2, 0)])
def test_rates_by_unlike_clocks_are_compared(monkeypatch: pytest.MonkeyPatch, error: float, compared: int) -> None:
    """Rates that are estimated from times differ in their last digits."""
    used: list[int] = []
    compare = machine_trend.compare_summaries
    monkeypatch.setattr(
        machine_trend,
        "compare_summaries",
        lambda judged, healthy, chambers: used.append(len(healthy)) or compare(judged, healthy, chambers),
    )
    days = [ss.simulate(duration="20 s", seed=seed) for seed in range(4)]
    ss.trend(
        replace(day, rate=day.rate * (1.0 + error * (k == 3)), provenance={"start": f"2024-05-0{k + 1}T08:00"})
        for k, day in enumerate(days)
    )
    assert sum(used) == compared


@pytest.mark.parametrize("seed", range(4))
def test_no_change_begins_while_the_machine_is_known_to_be_healthy(seed: int) -> None:
    wear = trend_of(life(30, wears=0.008, since=12.0, seed=seed), healthy=12).wear
    assert wear is not None and wear.onset is not None
    assert 12.0 <= wear.onset.low <= wear.onset.value <= wear.onset.high


@pytest.mark.parametrize("days", [2, 5])
def test_a_machine_whose_recordings_are_all_healthy_has_a_bound(days: int) -> None:
    wear = trend_of(life(days), healthy=5).wear
    assert wear is not None and 0.0 < wear.bound < math.inf


@pytest.mark.slow
def test_a_worn_pump_and_a_seal_are_one_cause_and_the_balance_names_its_rivals(simulated: Trend) -> None:
    points = [simulated.points[row] for row in simulated.rows]
    assert simulated.wear is not None and simulated.decision.cause == "piston, pump or external leak"
    before, since = machine_trend._split_at_onset(points, simulated.wear)
    names = {observable.name for observable in machine_trend._rival_changes(points[-1], before, since)}
    assert {"external leak A", "external leak B", "free air"} <= names


def test_a_healthy_machine_is_no_leak_and_its_growth_is_about_none() -> None:
    trend = trend_of(life(40), healthy=5)
    assert trend.verdict == "no leak" and trend.alarm is None and trend.wear is not None
    assert trend.wear.growth.low < 0.0 < trend.wear.growth.high < 0.001
    assert trend.limit == pytest.approx(trend.wear.healthy.value + 8e-3 * 633e-6 * 1e3)  # 8 mm/min, in L/min


def test_a_few_recordings_do_not_show_that_nothing_grows() -> None:
    for count in (1, 2):
        trend = trend_of(life(count))
        assert trend.verdict == "cannot tell" and "too few" in trend.reason


def test_the_order_of_files_does_not_matter_and_a_repeated_file_counts_once() -> None:
    days = life(30, wears=0.02, since=10.0)
    ordered = trend_of(days, healthy=5)
    mixed = trend_of([*days[::-2], *days[-2::-2]], healthy=5)
    assert mixed == ordered
    copies = [replace(days[7], file="copy.csv"), *days]
    again = trend_of(copies, healthy=5)
    assert again.wear == ordered.wear
    assert [point.note for point in again.points if point.value is None] == ["the same samples as copy.csv"]
    assert any("the same samples" in finding.text for finding in again.findings)


def test_a_single_outlier_neither_alarms_nor_counts() -> None:
    days = life(30)
    days[14] = replace(days[14], level=3.0 * HEALTHY)
    trend = trend_of(days, healthy=5)
    assert trend.verdict == "no leak"
    assert "far from the recordings before and after" in trend.points[14].note
    at_the_end = trend_of(days[:15], healthy=5)
    assert at_the_end.alarm is None  # the last recording is not confirmed by another one
    stepped = [replace(own, level=3.0 * HEALTHY) for own in days[14:17]]
    trend = trend_of([*days[:14], *stepped], healthy=5)
    assert trend.alarm is not None and trend.alarm.day <= 15.0
    assert trend.wear is not None and trend.wear.step is not None and trend.wear.onset is not None
    assert trend.wear.onset.value == 14.0


def test_a_repair_begins_a_new_stretch() -> None:
    worn, after = life(50, wears=0.02, since=20.0), life(75, seed=9)[50:]
    trend = trend_of([*worn, *after], healthy=5)
    assert [own.alarm is not None for own in trend.episodes] == [True, False]
    assert [point.day for point in trend.repairs] == [50.0]
    assert trend.verdict == "no leak" and "since the repair" in trend.reason
    assert trend.wear is not None and trend.wear.total.high < 1.2 * flow(HEALTHY)


@pytest.mark.slow
def test_other_sensors_are_compared_among_themselves() -> None:
    days = life(60)
    sensor = [replace(own, scale=1.03, level=0.8 * own.level) for own in days[30:40]]
    trend = trend_of([*days[:30], *sensor, *days[40:]], healthy=5)
    assert trend.verdict == "no leak" and len(trend.groups) == 2 and trend.alarm is None
    texts = [finding.text for finding in trend.findings]
    assert any("a sensor exchanged" in text and "10 of 60" in text for text in texts)
    one = [*days[:30], *sensor, *(replace(own, level=own.level * 2.0, error=1e-14) for own in days[40:])]
    assert trend_of(one, healthy=5).verdict == "leak"  # the first sensors again, and twice as much


def test_a_scale_that_no_recording_determines_is_no_other_sensor() -> None:
    """A gate that moves with one speed: the ratio of displacement to area scatters by half from day to day."""
    random = np.random.default_rng(1)
    days = [replace(own, scale=float(np.exp(0.3 * random.standard_normal()))) for own in life(40)]
    groups = [point.group for point in trend_of(days, healthy=5).points]
    assert groups.count(0) > 30
    exchanged = [replace(own, scale=own.scale or 1.0) for own in life(40)]
    exchanged[20:] = [replace(own, scale=1.03 * (own.scale or 1.0)) for own in exchanged[20:]]
    assert len(trend_of(exchanged, healthy=5).groups) == 2
    unknown = [replace(exchanged[0], scale=None), *exchanged[1:]]
    assert any("+3 %" in finding.text for finding in trend_of(unknown, healthy=5).findings)


def test_the_oil_s_temperature_is_taken_out_where_it_is_known() -> None:
    """A summer: the oil warms by 25 K within 60 days, and a healthy machine passes 2.7 times as much."""
    days = life(60, scatter=0.03)
    warm = [
        replace(
            own,
            temperature=25.0 + 25.0 * k / 59.0,
            level=own.level * math.exp(0.04 * 25.0 * k / 59.0),
        )
        for k, own in enumerate(days)
    ]
    assert trend_of(warm, healthy=5).verdict == "no leak"
    unknown = [replace(own, temperature=None) for own in warm]
    assert trend_of(unknown, healthy=5).verdict == "leak"


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("Oil temperature", "42 degC", 42.0),
        ("Öltemperatur", "41,5 °C", 41.5),
        ("Oil", "104 °F", 40.0),
        ("Temp [C]", "38", 38.0),
        ("Operator", "7 C", None),
        ("Oil", "ISO VG 46", None),
    ],
)
def test_the_temperature_is_read_beside_the_samples(name: str, text: str, expected: float | None) -> None:
    recording = ss.Recording(np.arange(4.0), {"p_A": np.ones(4)}, {"p_A": "Pa"}, 1.0, {"about": {name: text}})
    assert oil_temperature(recording) == (None if expected is None else pytest.approx(expected))
    recorded = replace(recording, channels={"T_oil": np.array([np.nan, 300.0, 310.0, np.nan])}, units={"T_oil": "K"})
    assert oil_temperature(recorded) == pytest.approx(305.0 - 273.15)
    assert [finding.code for finding in ss.inspect(recorded)] == ["too_short"]


def test_a_clock_set_back_is_named() -> None:
    days = life(30)
    back = [*days[:20], *(replace(own, start=(own.start or 0.0) - 3.5 * DAY) for own in days[20:])]
    text = next(own.text for own in trend_of(back, healthy=5).findings if own.code == "clock")
    assert "day_20.csv is numbered after day_19.csv" in text and "set back" in text
    overlapping = [*days, reading(12.0003, number=12)]
    text = next(own.text for own in trend_of(overlapping, healthy=5).findings if own.code == "clock")
    assert "was still recording" in text


def test_files_without_a_time_are_refused_or_spaced() -> None:
    days = [replace(own, start=None) for own in life(12)]
    with refusal("day_0.csv", "every"):
        trend_of(days)
    trend = trend_of(days[::-1], every=DAY)
    assert [point.file for point in trend.points] == [f"day_{k}.csv" for k in range(12)]
    assert [point.day for point in trend.points] == list(range(12))


@pytest.mark.parametrize("wrong", [{"healthy": 0}, {"years": 0.0}, {"limit": "-1 L/min"}, {"every": math.nan}])
def test_numbers_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with refusal():
        trend_of(life(3), **wrong)  # type: ignore[arg-type]


def test_the_first_recordings_are_healthy_whether_they_are_compared_or_not() -> None:
    """A leak from day 5 on, five healthy days: it is found as well where one of these is defective, or comes twice."""
    days = [reading(day, HEALTHY * (1.0 + 0.02 * (-1) ** day) * (1.0 if day < 5 else 4.0)) for day in range(10)]
    defective = replace(days[0], basis=None, problem="p_A is constant", level=math.nan, error=math.nan)
    copy = replace(days[1], file="day_1_copy.csv")
    assert trend_of(days, healthy=5).verdict == "leak"
    trend = trend_of([defective, *days[1:]], healthy=5)
    assert (trend.verdict, trend.alarm and trend.alarm.day) == ("leak", 6.0)
    assert trend_of([*days, copy], healthy=5).verdict == "leak"


def test_many_recordings_are_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Levels, "average_neighbours", partialmethod(Levels.average_neighbours, 60))
    trend = trend_of(life(150, wears=0.004, since=100.0, scatter=0.05), healthy=20)
    assert trend.verdict == "leak" and len(trend.rows) == 50 and len(trend.points) == 150
    assert trend.alarm is not None and 100.0 < trend.alarm.day < 125.0


def test_a_trend_is_plain_json(tmp_path_factory: pytest.TempPathFactory) -> None:
    tree = trend_of(life(3)).as_dict()
    assert json.loads(json.dumps(tree, allow_nan=False)) == tree
    assert tree["points"][0]["time"] == "2023-12-31T05:20:00"


@pytest.fixture(scope="module")
def simulated() -> Trend:
    """Real recordings of a simulated machine, with all channels: four healthy days, then 0.004 L/min more each day."""
    days = [
        ss.simulate(duration="20 s", rate=100.0, seed=k, set={"pump.G_pump": 2.4e-13}, leak=leak)
        for k, leak in enumerate([None] * 4 + [f"{0.004 * k} L/min from 0 s" for k in (1, 2, 3)])
    ]
    return ss.trend(
        [replace(own, provenance={"start": f"2024-05-0{k + 1}T08:00"}) for k, own in enumerate(days)],
        healthy=4,
        rig="thesis",
    )


def test_recordings_become_a_trend(simulated: Trend) -> None:
    assert simulated.verdict == "leak" and simulated.basis == "volume balance"
    assert simulated.alarm is not None and simulated.alarm.day == 5.0  # the second one that leaks
    rise = simulated.points[-1].value - np.mean([point.value for point in simulated.points[:5]])
    assert rise == pytest.approx(0.012, rel=0.15)


def test_a_recording_that_states_nothing_is_left_out() -> None:
    still = ss.Recording(
        np.arange(400) / 100.0, {"p_A": np.ones(400), "p_B": np.ones(400)}, {"p_A": "Pa", "p_B": "Pa"}, 100.0
    )
    own = estimate_reading(still, file="still.csv")
    assert own.basis is None and "constant" in own.problem
    trend = trend_of([replace(own, start=1.704e9), *life(5)])
    assert trend.points[0].value is None or trend.points[1].value is None
    assert any("still.csv" in finding.text for finding in trend.findings)


def test_a_level_that_overflows_is_none() -> None:
    run = ss.simulate(duration="15 s", rate=100.0, seed=1)
    reading = estimate_reading(replace(run, channels={**run.channels, "x": 1e200 * run["x"]}))
    assert (reading.basis, reading.problem) == (None, "the volume balance states no finite level")


def test_without_a_stated_machine_levels_are_relative_and_a_creep_is_still_a_limit() -> None:
    days = [replace(own, states_flow=False) for own in life(30, wears=0.01, since=10.0)]
    trend = trend_of(days, healthy=5)
    assert trend.verdict == "leak" and trend.unit == "%" and trend.pressure is None
    known = trend_of([replace(own, states_flow=True) for own in days], healthy=5)
    assert trend.wear is not None and known.wear is not None and trend.limit is not None and known.limit is not None
    assert trend.wear.total.value / trend.limit == pytest.approx(known.wear.total.value / known.limit, rel=1e-6)
    assert trend_of(days, healthy=5, limit="5 mL/min").limit is None


def test_a_session_states_no_growth_by_a_month() -> None:
    minutes = [replace(own, start=1.7e9 + 60.0 * k) for k, own in enumerate(life(30))]
    minutes = [replace(own, duration=20.0) for own in minutes]
    wear = trend_of(minutes, healthy=5).wear
    assert wear is not None and math.isnan(wear.growth.value) and wear.reach is not None
    assert math.isnan(wear.reach.value)
