"""Friction, drifts and spectra of whole recordings, against those of healthy ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from sealscope.diagnosis.healthy import SummarisedRecording, summary_table
from sealscope.diagnosis.inference.changes.healthy_levels import (
    PAIRS,
    HealthyLevels,
    Octaves,
    compare_spectra,
    compute_octaves,
)
from sealscope.recordings.recording import Recording

RATE, SECONDS = 100.0, 40.0
T = np.arange(round(RATE * SECONDS)) / RATE


def record(
    friction: float = 2e5,
    drift_A: float = 0.0,
    drift_B: float = 0.0,
    contact: float = 0.0,
    filter_B: float = np.inf,
    seed: int = 0,
) -> Recording:
    """Record a sine against a spring; `friction` and drifts [Pa]; `contact`: pressure at one end of the stroke.

    `filter_B`: corner of a low-pass filter of p_B [Hz].
    """
    rng = np.random.default_rng(seed)
    x = 0.1 * np.sin(2.0 * np.pi * 0.4 * T)
    way = np.sign(np.cos(2.0 * np.pi * 0.4 * T))
    p_A = 30e5 + 5e6 * x + 0.5 * friction * way + drift_A * T / SECONDS + contact * (x > 0.095)
    p_B = 10e5 - 0.5 * friction * way + drift_B * T / SECONDS
    if np.isfinite(filter_B):
        p_B = sosfilt(butter(1, filter_B, fs=RATE, output="sos"), p_B - p_B[0]) + p_B[0]
    noise = 2e3 * rng.standard_normal((2, len(T)))
    return Recording(
        T, {"p_A": p_A + noise[0], "p_B": p_B + noise[1], "x": x}, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE
    )


HEALTHY = [record(2e5 * factor, seed=seed) for seed, factor in enumerate((0.9, 1.0, 1.1, 1.05, 0.95), 1)]


def chances(recording: Recording) -> dict[str, float]:
    return {observable.name: observable.chance for observable in HealthyLevels().compare(recording, HEALTHY)}


@pytest.mark.parametrize("contact", [0.0, 80e5])
def test_friction_and_drifts_are_those_of_the_recording(contact: float) -> None:
    learnt = HealthyLevels().learn(record(3e5, drift_A=2e5, drift_B=-1e5, contact=contact))
    assert learnt is not None
    assert learnt.friction is not None
    assert 2.0 * learnt.friction.value == pytest.approx(2 * 3e5, rel=0.03)
    assert learnt.friction.deviation < 0.05 * learnt.friction.value
    assert (learnt.drift_A, learnt.drift_B) == (pytest.approx(2e5, rel=0.05), pytest.approx(-1e5, rel=0.05))


def test_each_change_shows_in_its_number_alone() -> None:
    for change, name in (
        ({"friction": 8e5}, "friction"),
        ({"drift_A": 3e5}, "drift of p_A"),
        ({"drift_B": -3e5}, "drift of p_B"),
        ({"drift_A": 3e5, "drift_B": 3e5}, "drift of both"),
        ({"filter_B": 1.0}, "filter of p_B"),
    ):
        found = chances(record(**change, seed=9))
        assert min(found, key=lambda known: found[known]) == name
        assert found[name] < 1e-3
        if name != "drift of both":  # which both pressures show
            found.pop(name)
            assert min(found.values()) > 0.01


def test_less_friction_is_no_wear() -> None:
    assert chances(record(1e5))["friction"] > 0.9


@pytest.mark.slow
def test_friction_has_the_sign_of_most_healthy_days_and_a_day_that_shows_none_says_nothing() -> None:
    """Position counted the other way: friction and speed change their signs together, on every day."""

    def reverse(recording: Recording) -> Recording:
        return replace(recording, channels={**recording.channels, "x": -recording["x"]})

    def chance(judged: Recording, healthy: list[Recording]) -> float:
        return next(o.chance for o in HealthyLevels().compare(judged, healthy) if o.name == "friction")

    expected = chance(record(5e5, seed=9), HEALTHY)
    assert expected < 1e-3
    assert chance(reverse(record(5e5, seed=9)), [reverse(day) for day in HEALTHY]) == pytest.approx(expected)
    assert chance(record(5e5, seed=9), [*HEALTHY, record(-1e5)]) == pytest.approx(expected)


def ring(filter_A: float = np.inf, filter_B: float = np.inf, gain: float = 1.0, seed: int = 0) -> Recording:
    """Record pressures that move at all frequencies, in opposite senses, and differ by 10 % from day to day.

    `filter_A`, `filter_B`: corners of low-pass filters [Hz]; `gain` multiplies p_B.
    """
    rng = np.random.default_rng(seed)
    # as much power in each octave
    spectrum = np.fft.rfft(rng.standard_normal(len(T))) / np.sqrt(np.maximum(np.fft.rfftfreq(len(T), 1.0 / RATE), 0.1))
    p_A = 2e5 * np.fft.irfft(spectrum, len(T))
    p_B = -0.5 * gain * p_A * (1.0 + 0.1 * rng.standard_normal())
    p_A, p_B = (
        sosfilt(butter(1, corner, fs=RATE, output="sos"), p) if np.isfinite(corner) else p
        for p, corner in ((p_A, filter_A), (p_B, filter_B))
    )
    noise = 1e3 * rng.standard_normal((2, len(T)))
    return Recording(T, {"p_A": 50e5 + p_A + noise[0], "p_B": 20e5 + p_B + noise[1]}, {"p_A": "Pa", "p_B": "Pa"}, RATE)


def test_spectra_need_three_octaves() -> None:
    recording = record()
    slow = Recording(T[::50], {name: values[::50] for name, values in recording.channels.items()}, recording.units, 2.0)
    assert compute_octaves(slow) is None
    assert compute_octaves(recording.only(["p_A", "x"])) is None
    assert compute_octaves(recording.only(["p_A", "x"]), ("p_A", "x")) is not None


def test_windows_with_missing_samples_say_nothing() -> None:
    recording, holes = ring(seed=1), {name: values.copy() for name, values in ring(seed=1).channels.items()}
    holes["p_A"][1000:1010] = np.nan
    whole, holed = compute_octaves(recording), compute_octaves(replace(recording, channels=holes))
    assert whole is not None and holed is not None
    assert holed.log_A == pytest.approx(whole.log_A, abs=0.2)
    assert np.cos(holed.phase - whole.phase)[:5] == pytest.approx(1.0, abs=0.01)
    holes["p_A"][::100] = np.nan
    assert compute_octaves(replace(recording, channels=holes)) is None


@pytest.mark.parametrize("corner", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("channel", ["p_A", "p_B"])
def test_a_filter_is_told_by_the_law_of_its_ratio_and_phase(channel: str, corner: float) -> None:
    healthy, judged = compute_octaves(ring(seed=1)), compute_octaves(ring(**{f"filter_{channel[-1]}": corner}, seed=1))
    assert healthy is not None and judged is not None
    sign = 1.0 if channel == "p_A" else -1.0
    frequencies = 0.2 * 2.0 ** (np.arange(len(healthy.phase)) + 0.5)
    busy = slice(0, 5)  # the sensors' noise, which is not filtered, covers the other octaves
    damped = sign * (judged.log_A - judged.log_B - healthy.log_A + healthy.log_B)
    turned = sign * np.angle(np.exp(1j * (judged.phase - healthy.phase)))
    assert damped[busy] == pytest.approx(-0.5 * np.log(1.0 + (frequencies / corner) ** 2)[busy], abs=0.25)
    assert turned[busy] == pytest.approx(-np.arctan(frequencies / corner)[busy], abs=0.3)


@pytest.mark.parametrize(
    ("change", "name", "corner"),
    [({"filter_A": 1.0}, "filter of p_A", 1.0), ({"filter_B": 2.0}, "filter of p_B", 2.0), ({"gain": 3.0}, None, None)],
)
def test_a_filter_has_a_side_and_a_corner_and_a_larger_pressure_is_none(change, name, corner) -> None:
    healthy = [compute_octaves(ring(seed=seed)) for seed in range(1, 6)]
    judged = compute_octaves(ring(**change, seed=9))
    assert judged is not None and None not in healthy
    found = compare_spectra({"octaves": judged}, [{"octaves": day} for day in healthy])
    assert found is not None
    if name is None:
        assert found.chance > 0.1
    else:
        assert (found.name, found.size) == (name, pytest.approx(corner, rel=0.4))
        assert found.chance < 1e-6


def press(filter_A: float = np.inf, seed: int = 0) -> Recording:
    """Record a load that swings on p_A, each day at other frequencies, in a machine whose p_B is the charge pressure.

    `filter_A`: corner of a low-pass filter of p_A [Hz].
    """
    rng = np.random.default_rng(seed)
    swing = np.fft.rfft(rng.standard_normal(len(T))) / np.sqrt(np.maximum(np.fft.rfftfreq(len(T), 1.0 / RATE), 0.1))
    tilt = np.maximum(np.fft.rfftfreq(len(T), 1.0 / RATE), 0.1) ** rng.uniform(-0.3, 0.3)
    load = np.fft.irfft(swing * tilt, len(T))
    p_A = 50e5 + 2e5 * load
    if np.isfinite(filter_A):
        p_A = sosfilt(butter(1, filter_A, fs=RATE, output="sos"), p_A - p_A[0]) + p_A[0]
    noise = rng.standard_normal((3, len(T)))
    channels = {"p_A": p_A + 1e3 * noise[0], "p_B": 6e5 + 1e3 * noise[1], "x": 2e-4 * load + 1e-6 * noise[2]}
    return Recording(T, channels, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE)


def test_a_filter_is_told_by_the_position_where_the_other_chamber_rests() -> None:
    def spectra(recording: Recording, names: list[str]) -> dict[str, Octaves]:
        return {name: octaves for name in names if (octaves := compute_octaves(recording, PAIRS[name])) is not None}

    def chance(recording: Recording, names: list[str]) -> tuple[str, float]:
        healthy = [spectra(press(seed=seed), names) for seed in range(1, 6)]
        found = compare_spectra(spectra(recording, names), healthy)
        assert found is not None
        return found.name, found.chance

    assert chance(press(filter_A=2.0, seed=9), ["octaves"])[1] > 1e-3
    assert chance(press(filter_A=2.0, seed=9), list(PAIRS)) == ("filter of p_A", pytest.approx(0.0, abs=1e-6))
    assert chance(press(seed=9), list(PAIRS))[1] > 0.03


@pytest.mark.slow
def test_healthy_spectra_seldom_favour_a_filter() -> None:
    """The mean Bayes factor over healthy recordings is 1."""
    octaves = [{"octaves": compute_octaves(ring(seed=seed))} for seed in range(24)]
    factors = []
    for k, judged in enumerate(octaves):
        test = compare_spectra(judged, octaves[:k] + octaves[k + 1 :])
        assert test is not None
        factors.append(np.exp(0.5 * test.score))
    assert max(factors) < 100.0


@pytest.mark.parametrize("known", [0, 2])
def test_healthy_days_without_spectra_leave_the_other_comparisons(known: int) -> None:
    """A machine's file may be older than this comparison, or hold recordings that are too short for it."""
    expected = chances(record(5e5, seed=9))
    days = [
        SummarisedRecording(
            str(k),
            "",
            {},
            RATE,
            SECONDS,
            None,
            {"signals": {key: learnt[key] for key in learnt if key not in PAIRS or k < known}},
        )
        for k, learnt in enumerate(summary_table(HealthyLevels(), day) or {} for day in HEALTHY)
    ]
    found = {observable.name: observable.chance for observable in HealthyLevels().compare(record(5e5, seed=9), days)}
    assert expected.pop("filter of p_A", 1.0) * expected.pop("filter of p_B", 1.0) > 0.01
    assert found == pytest.approx(expected)


def test_spectra_alone_are_learnt_of_a_piston_that_rests() -> None:
    still = record()
    learnt = HealthyLevels().learn(still.only(["p_A", "p_B"]))
    assert learnt is not None and set(learnt.table()) == {"octaves"}


@pytest.mark.parametrize("count", [0, 1, 2])
def test_nothing_is_learnt_of_hardly_any_samples(count: int) -> None:
    """A file with a heading and no rows is read as an empty recording, which has no difference to take."""
    shortest = Recording(T[:count], {name: np.zeros(count) for name in ("p_A", "p_B", "x")}, record().units, RATE)
    assert HealthyLevels().learn(shortest) is None
