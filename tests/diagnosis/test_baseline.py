"""Comparison with leak-free recordings: what is found, and what may be compared with what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.rms_change.blocks import excess
from sealscope.recordings.recording import Recording

pytestmark = pytest.mark.usefixtures("rms_change_alone")


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


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 4])
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
    x = 1e3 * np.cumsum(random.standard_normal(5000))
    units = {"p_A": "Pa"}
    ones = [Recording(np.arange(5000) / 500, {"p_A": x + offset}, units, 500.0) for offset in (0.0, 1.0, 2.0, 3.0)]
    other = Recording(np.arange(5000) / 500, {"p_A": x[::-1]}, units, 500.0)
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
