"""Friction, drifts and spectra of whole recordings, against those of healthy ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfilt

from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inference.changes.pressure_bands import compare_octaves
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
    assert 2.0 * learnt["friction_pressure"] == pytest.approx(2 * 3e5, rel=0.03)
    assert learnt["friction_error"] < 0.05 * learnt["friction_pressure"]
    assert (learnt["drift_A"], learnt["drift_B"]) == (pytest.approx(2e5, rel=0.05), pytest.approx(-1e5, rel=0.05))


def test_each_change_shows_in_its_number_alone() -> None:
    for change, name in (
        ({"friction": 8e5}, "friction"),
        ({"drift_A": 3e5}, "drift of p_A"),
        ({"drift_B": -3e5}, "drift of p_B"),
        ({"drift_A": 3e5, "drift_B": 3e5}, "drift of both"),
        ({"filter_B": 1.0}, "p_A beside p_B"),
    ):
        found = chances(record(**change, seed=9))
        assert min(found, key=lambda known: found[known]) == name
        assert found[name] < 1e-3
        if name != "drift of both":  # which both pressures show
            found.pop(name)
            assert min(found.values()) > 0.01


def test_less_friction_is_no_wear() -> None:
    assert chances(record(1e5))["friction"] > 0.9


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


def test_spectra_need_three_octaves_and_differ_by_a_filter_in_both_numbers() -> None:
    recording = record()
    slow = Recording(T[::50], {name: values[::50] for name, values in recording.channels.items()}, recording.units, 2.0)
    assert compare_octaves(slow) is None
    assert compare_octaves(recording.only(["p_A", "x"])) is None
    # a larger share of the load tilts nothing
    louder = replace(recording, channels={**recording.channels, "p_B": 10e5 + 3.0 * (recording["p_B"] - 10e5)})
    octaves, by_load, by_filter = (compare_octaves(each) for each in (recording, louder, record(filter_B=1.0)))
    assert octaves is not None and by_load is not None and by_filter is not None
    assert by_load == pytest.approx((octaves.ratio - np.log(3.0), octaves.tilt), abs=0.02)
    assert min(by_filter.ratio - octaves.ratio, by_filter.tilt - octaves.tilt) > 0.7


@pytest.mark.parametrize("missing", ["ratio", "tilt"])
@pytest.mark.parametrize("known", [0, 2])
def test_healthy_days_without_spectra_leave_the_other_comparisons(known: int, missing: str) -> None:
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
            {"signals": {key: learnt[key] for key in learnt if key != missing or k < known}},
        )
        for k, learnt in enumerate(HealthyLevels().learn(day) or {} for day in HEALTHY)
    ]
    found = {observable.name: observable.chance for observable in HealthyLevels().compare(record(5e5, seed=9), days)}
    assert expected.pop("p_A beside p_B") > 0.01
    assert found == pytest.approx(expected)


def test_nothing_is_learnt_of_a_piston_that_rests() -> None:
    still = record()
    assert HealthyLevels().learn(still.only(["p_A", "p_B"])) is None


@pytest.mark.parametrize("count", [0, 1, 2])
def test_nothing_is_learnt_of_hardly_any_samples(count: int) -> None:
    """A file with a heading and no rows is read as an empty recording, which has no difference to take."""
    shortest = Recording(T[:count], {name: np.zeros(count) for name in ("p_A", "p_B", "x")}, record().units, RATE)
    assert HealthyLevels().learn(shortest) is None
