"""Comparison with leak-free recordings: the prediction against a textbook, and what may be compared with what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.rms_change.blocks import excess
from sealscope.diagnosis.rms_change.detector import predict, student_threshold
from sealscope.recordings.recording import Recording

pytestmark = pytest.mark.usefixtures("rms_change_alone")

#: Rocket propellant data: age [weeks] and shear strength [psi]; Montgomery, Peck & Vining, Introduction to Linear
#: Regression Analysis, Table 2.1.
AGE = np.array(
    [15.5, 23.75, 8, 17, 5.5, 19, 24, 2.5, 7.5, 11, 13, 3.75, 25, 9.75, 22, 18, 6, 12.5, 2, 21.5]
)  # fmt: skip
STRENGTH = np.array(
    [2158.70, 1678.15, 2316.00, 2061.30, 2207.50, 1708.30, 1784.70, 2575.00, 2357.90, 2256.70,
     2165.20, 2399.55, 1779.80, 2336.75, 1765.30, 2053.50, 2414.40, 2200.50, 2654.20, 1753.70]
)  # fmt: skip


def test_prediction_interval_of_the_rocket_propellant() -> None:
    """The book's Example 2.7: at 10 weeks 2256.32 psi, 95 % of new observations within 2048.32 to 2464.32."""
    found = predict(STRENGTH[:, None], AGE, 10.0)
    half = student_threshold(0.05, found.freedom) * found.deviation[0]
    assert found.freedom == 18
    assert found.mean[0] == pytest.approx(2256.32, abs=0.05)
    assert found.mean[0] - half == pytest.approx(2048.32, abs=0.2)
    assert found.mean[0] + half == pytest.approx(2464.32, abs=0.2)
    residual = np.sqrt(np.sum((STRENGTH - found.fitted[:, 0]) ** 2) / 18)
    assert residual == pytest.approx(96.1, abs=0.1)


def test_prediction_of_few_is_their_mean() -> None:
    """n <= 5: mean and s sqrt(1 + 1/n), whatever the levels."""
    known = np.array([[1.0, 10.0], [2.0, 14.0], [6.0, 12.0]])
    found = predict(known, np.array([0.0, 1.0, 2.0]), 5.0)
    np.testing.assert_allclose(found.mean, [3.0, 12.0])
    np.testing.assert_allclose(found.deviation, [np.sqrt(7.0 * 4 / 3), np.sqrt(4.0 * 4 / 3)])
    assert found.freedom == 2


def test_prediction_holds_its_rate() -> None:
    """Of many new observations a share p lies beyond the threshold."""
    random = np.random.default_rng(0)
    beyond = 0
    for _ in range(2000):
        levels = random.normal(size=9)
        y = 2.0 + 0.7 * levels + 0.1 * random.standard_normal(9)
        found = predict(y[:-1, None], levels[:-1], float(levels[-1]))
        beyond += abs(y[-1] - found.mean[0]) > student_threshold(0.05, found.freedom) * found.deviation[0]
    assert beyond / 2000 == pytest.approx(0.05, abs=0.015)


@pytest.mark.parametrize(
    ("probability", "freedom", "table"),
    [(0.05, 1, 12.706), (0.05, 2, 4.303), (0.01, 5, 4.032), (0.01, 10, 3.169), (0.05, 18, 2.101), (0.10, 30, 1.697),
     (0.05, 120, 1.980), (0.001, 20, 3.850)],
)  # fmt: skip
def test_threshold_of_published_t_tables(probability: float, freedom: int, table: float) -> None:
    assert student_threshold(probability, freedom) == pytest.approx(table, abs=5.1e-4)


def test_excess_of_white_noise_alone_scatters_alike_on_both_sides() -> None:
    """Four times the noise energy in a short second part over a signal of unit energy: no shift, equal scatter."""
    random = np.random.default_rng(1)
    shifts, scatter = [], []
    for _ in range(400):
        noise = np.r_[np.full(90, 1.0), np.full(30, 4.0)][:, None]
        signal = np.array([0.0, 1.0, 1.0, 1.0, 0.0])
        energy = (noise + signal) * (1.0 + 0.05 * random.standard_normal((120, 5)))
        x = excess(0.5 * np.log(energy), 90)
        shifts.append(x[90:].mean(axis=0) - x[:90].mean(axis=0))
        scatter.append(x.std(axis=0))
    nominal = np.mean(scatter, axis=0) * np.sqrt(1 / 90 + 1 / 30)
    assert np.all(np.abs(np.mean(shifts, axis=0)) < 0.3 * nominal)
    assert np.all(np.std(shifts, axis=0) < 1.1 * nominal)
    assert np.all(x[90:].std(axis=0) / x[:90].std(axis=0) < 1.5)


@pytest.fixture(scope="module")
def sound_ones(records) -> list[Recording]:  # type: ignore[no-untyped-def]
    return [records(seed, duration=60.0, throttled=True) for seed in range(100, 108)]


def test_a_leak_from_the_start_needs_a_baseline(records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    recording = records(1, leak="0.0042 L/min", duration=60.0, throttled=True)
    alone = diagnose(recording)
    assert alone.verdict == "no leak"
    assert "--baseline" in alone.reason
    for count in (1, 2, 6, 8):
        found = diagnose(recording, sound_ones[:count])
        assert found.verdict == "leak", found.reason
        assert found.onset_s is None
        assert f"{count} comparable leak-free recording" in found.reason


@pytest.mark.parametrize("count", [1, 3, 7])
def test_a_sound_one_is_no_leak_beside_sound_ones(count: int, records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    found = [diagnose(records(seed, duration=60.0, throttled=True), sound_ones[:count]) for seed in range(8)]
    assert [one.verdict for one in found] == ["no leak"] * 8


@pytest.mark.parametrize("count", [1, 4])
def test_more_noise_than_in_the_baseline_is_no_leak(count: int, records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    alarms = 0
    for seed in range(12):
        recording = records(seed, duration=60.0, throttled=True)
        random = np.random.default_rng(seed)
        noisy = {name: recording[name] + 16e3 * random.standard_normal(len(recording)) for name in ("p_A", "p_B")}
        found = diagnose(replace(recording, channels={**recording.channels, **noisy}), sound_ones[:count])
        assert found.verdict == "leak" or "the noise (d1) changed too" in found.reason
        alarms += found.verdict == "leak"
    assert alarms <= 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("other duty", "another c"),
        ("half the rate", "another sampling rate"),
        ("pressures alone", "only one of them has a command"),
        ("one chamber", "other channels or units"),
        ("counts", "other channels or units"),
        ("other level", "the pressure level"),
    ],
)
def test_what_may_not_be_compared_is_not(change: str, reason: str, records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    one = sound_ones[0]
    other = {
        "other duty": lambda: records(1, command="5 sin(2t)", duration=60.0),
        "half the rate": lambda: replace(one, t=one.t * 2, rate=one.rate / 2),
        "pressures alone": lambda: one.only(["p_A", "p_B"]),
        "one chamber": lambda: one.only(["p_A", "u"]),
        "counts": lambda: replace(one, units={**one.units, "p_A": "count", "p_B": "count"}),
        "other level": lambda: replace(one, channels={**one.channels, "p_A": one["p_A"] * 2, "p_B": one["p_B"] * 2}),
    }[change]()
    found = diagnose(other, sound_ones)
    assert found.verdict == "cannot tell"
    assert reason in found.reason


def test_the_comparable_ones_are_chosen_among_others(records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    recording = records(1, leak="0.0042 L/min", duration=60.0, throttled=True)
    strangers = [one.only(["p_A", "p_B"]) for one in sound_ones]
    mixed, pure = diagnose(recording, [*strangers, *sound_ones[:4]]), diagnose(recording, sound_ones[:4])
    assert replace(mixed, quality=pure.quality) == pure
    (finding,) = mixed.quality[len(pure.quality) :]
    assert finding.text.startswith("8 of 12 baseline recordings are left out: only one of them has a command (")


def test_a_baseline_given_twice_counts_once(records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    recording = records(1, duration=60.0, throttled=True)
    for many, few in ((sound_ones[:1] * 3, sound_ones[:1]), ([*sound_ones[:4], sound_ones[2]], sound_ones[:4])):
        found, expected = diagnose(recording, many), diagnose(recording, few)
        assert replace(found, quality=expected.quality) == expected
        assert "the same samples as another baseline recording" in found.quality[-1].text


def test_baselines_that_do_not_scatter_tell_nothing() -> None:
    """Recordings that differ by a shift of their zero alone, as from a simulator without noise."""
    random = np.random.default_rng(0)
    x = random.standard_normal(5000)
    units = {"p_A": "Pa"}
    ones = [Recording(np.arange(5000) / 500, {"p_A": x + offset}, units, 500.0) for offset in (0.0, 1.0, 2.0, 3.0)]
    other = Recording(np.arange(5000) / 500, {"p_A": random.standard_normal(5000)}, units, 500.0)
    found = diagnose(other, ones)
    assert found.verdict == "cannot tell"
    assert "do not scatter" in found.reason


def test_opposite_strokes_are_not_compared(records) -> None:  # type: ignore[no-untyped-def]
    stroke = records(1, command="step 1 at 0.5 s", duration=10.0)
    turned = {"x": -stroke["x"], "u": -stroke["u"], "p_A": stroke["p_B"], "p_B": stroke["p_A"]}
    back = replace(stroke, channels={**stroke.channels, **turned})
    for names in (["x", "p_A", "p_B"], ["p_A", "p_B"]):
        found = diagnose(back.only(names), [stroke.only(names)] * 2)
        assert found.verdict == "cannot tell"
        assert "another direction" in found.reason


def test_no_usable_baseline_is_said(sound_ones: list[Recording]) -> None:
    found = diagnose(sound_ones[0], [sound_ones[1].samples(slice(0, 100))])
    assert found.verdict == "cannot tell"
    assert "no baseline recording can be used: needs 226 samples" in found.reason
