"""Pressures and command alone: the damping of a ring that is known in closed form is told, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sealscope.diagnosis.inference.pressures.ring_down import Machine, evidence, reversals, ring_down
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from .ringing import Ring, recording_of, step_of

THESIS = load_rig("thesis")
KNOWN = Ring(frequency=65.0, damping=12.0, step=4.0)


def ring_step(recording: Recording) -> tuple[float, float]:
    """Return the step of the damping [1/s] at mid-record, and its deviation."""
    ring = ring_down(recording, THESIS)
    result = evidence(recording, THESIS)
    step, deviation = step_of(result.information, 0.5 * recording.duration)
    return step / ring.compliance, deviation / ring.compliance


@settings(max_examples=5)
@given(
    frequency=st.floats(48.0, 82.0),
    damping=st.floats(8.0, 16.0),
    step=st.floats(0.0, 8.0),
    amplitude=st.floats(3e3, 9e3),
    breakaway=st.floats(0.05, 0.1),
    seed=st.integers(0, 1000),
)
def test_a_known_step_of_the_damping_is_recovered_within_its_deviation(seed: int, **ring: float) -> None:
    step, deviation = ring_step(recording_of(Ring(**ring), THESIS, seed=seed))
    assert abs(step - ring["step"]) < 4.5 * deviation + 0.02 * ring["step"]
    assert 0.0 < deviation < 4.0


@pytest.mark.parametrize("seeds", [4, pytest.param(60, marks=pytest.mark.slow)])
def test_without_a_step_its_estimate_scatters_as_its_deviation_says(seeds: int) -> None:
    ring = KNOWN._replace(step=0.0)
    z = [step / deviation for step, deviation in (ring_step(recording_of(ring, THESIS, seed=k)) for k in range(seeds))]
    assert stats.chi2.cdf(np.sum(np.square(z)), seeds) < 0.999
    assert abs(np.mean(z)) < 3.5 / np.sqrt(seeds)


def test_the_ring_itself_gives_the_compliance() -> None:
    cylinder = THESIS.cylinder
    softer = ring_down(recording_of(KNOWN._replace(frequency=50.0), THESIS), THESIS)
    assert softer.compliance == pytest.approx(
        2.0 * cylinder.A_A**2 / (cylinder.M_eq * (2.0 * np.pi * 50.0) ** 2), rel=2e-3
    )


def test_a_line_of_the_mains_beside_the_ring_does_no_harm() -> None:
    quiet = ring_step(recording_of(KNOWN._replace(frequency=61.0), THESIS))
    humming = ring_step(recording_of(KNOWN._replace(frequency=61.0), THESIS, mains=6e3))
    assert abs(humming[0] - quiet[0]) < 0.5 * quiet[1]
    assert humming[1] < 1.2 * quiet[1]


def test_sides_and_command_that_count_the_other_way_change_nothing() -> None:
    recording = recording_of(KNOWN, THESIS)
    u, p_A, p_B = (np.array(recording[name]) for name in ("u", "p_A", "p_B"))
    swapped = replace(recording, channels={"u": u, "p_A": p_B, "p_B": p_A})
    reversed_command = replace(recording, channels={"u": -u, "p_A": p_A, "p_B": p_B})
    for other in (swapped, reversed_command):
        np.testing.assert_allclose(ring_step(other), ring_step(recording), rtol=1e-6)


def test_windows_with_missing_samples_say_nothing() -> None:
    recording = recording_of(KNOWN, THESIS)
    gap = (recording.t > 20.0) & (recording.t < 22.0)
    results = []
    for level in (-3e6, 7e6):
        channels = {name: np.where(gap & (name != "u"), level, recording[name]) for name in recording.channels}
        channels["p_B"] = np.where(gap, channels["p_A"], channels["p_B"])
        results.append(ring_step(replace(recording, channels=channels, bridged=gap)))
    assert abs(results[0][0] - ring_step(recording)[0]) < ring_step(recording)[1]
    np.testing.assert_allclose(results[0], results[1], rtol=0.02)


def test_more_leak_is_more_damping_and_a_longer_recording_is_surer() -> None:
    steps = [ring_step(recording_of(KNOWN._replace(step=step), THESIS))[0] for step in (0.0, 3.0, 6.0, 12.0)]
    assert np.all(np.diff(steps) > 0.0)
    assert ring_step(recording_of(KNOWN, THESIS, seconds=120.0))[1] < 0.85 * ring_step(recording_of(KNOWN, THESIS))[1]


def test_a_flow_holds_either_law_and_the_doubt_in_the_scale() -> None:
    result = evidence(recording_of(KNOWN, THESIS), THESIS)
    unit = float(result.pressure.mean()) * 6e4
    flow, (low, high) = result.flow(1e-12, 0.0)
    assert low < 1e-12 * unit < flow < 2e-12 * unit < high
    assert result.flow(1e-12, 1e-12)[1][0] == 0.0


def test_reversals_are_found_between_samples_and_not_in_noise_about_zero() -> None:
    t = np.arange(2000) / 200.0
    place, sense = reversals(np.sin(4.0 * t) + 0.05 * np.sin(900.0 * t))
    np.testing.assert_allclose(place / 200.0, np.pi / 4.0 * np.arange(1, place.size + 1), atol=0.02)
    assert set(np.diff(sense)) == {2.0, -2.0}


def test_a_command_that_never_reverses_leaves_nothing_to_tell() -> None:
    recording = recording_of(KNOWN, THESIS, seconds=20.0)
    held = {"u": 1.0 + 0.1 * np.array(recording["u"]) / KNOWN.volts}
    assert evidence(replace(recording, channels={**recording.channels, **held}), THESIS) is None


def test_a_rate_below_the_ring_s_leaves_nothing_to_tell() -> None:
    recording = recording_of(KNOWN, THESIS, seconds=20.0)
    slow = {name: recording[name][::8] for name in recording.channels}
    assert evidence(Recording(recording.t[::8], slow, recording.units, recording.rate / 8), THESIS) is None


def test_what_moves_slowly_and_does_not_ring_is_no_ring() -> None:
    result = ring_down(recording_of(KNOWN._replace(frequency=4.0, damping=20.0, amplitude=3e4), THESIS), THESIS)
    assert np.all((result.omega / Machine.of(THESIS).omega) ** 2 > 0.3)
