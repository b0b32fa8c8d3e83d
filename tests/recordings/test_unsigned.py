"""Speeds without a sign: the sign changes only where the magnitude passes zero."""

from dataclasses import replace

import numpy as np
import pytest

from sealscope.recordings.corrections.unsigned import (
    _is_in_supply_line,
    _most_likely_signs,
    _noise_variance,
    _piston_speed,
    restore_signs,
)
from sealscope.recordings.recording import Recording

RPM = 2.0 * np.pi / 60.0


def held_lift(hold_speed: float, noise: float) -> tuple[Recording, np.ndarray]:
    """Make a lift that moves up and down between holds; return it with an unsigned speed, and the signed speed.

    The pump turns at `hold_speed` [rpm] in holds, to replace what leaks; `noise` [rpm] of the speed. The position has
    steps of 0.1 mm, as coarse as 2 rpm over the time of a difference.
    """
    rate, random = 100.0, np.random.default_rng(3)
    t = np.arange(0.0, 120.0, 1.0 / rate)
    phase = t % 20.0
    v = 0.05 * ((phase > 5.0) & (phase < 7.0)) - 0.05 * ((phase > 15.0) & (phase < 17.0))
    v = np.convolve(v, np.ones(20) / 20.0, "same")
    speed = (v / 0.05 * 1000.0 + hold_speed) * RPM
    measured = speed + noise * RPM * random.standard_normal(t.size)
    x = np.round(np.cumsum(v) / rate + 2e-5 * random.standard_normal(t.size), 4)
    channels = {"omega": np.abs(measured), "x": x, "p_A": np.full(t.size, 8e6), "p_B": np.full(t.size, 1e6)}
    return Recording(t, channels, {"omega": "rad/s", "x": "m", "p_A": "Pa", "p_B": "Pa"}, rate), speed


@pytest.mark.parametrize("hold_speed", [2.0, 5.0, 20.0])
def test_a_pump_that_holds_a_load_turns_one_way(hold_speed: float) -> None:
    recording, speed = held_lift(hold_speed, noise=0.5)
    restored, (finding,) = restore_signs(recording)
    in_hold = np.abs(speed - hold_speed * RPM) < 1e-9
    assert finding.code == "unsigned_speed"
    assert np.mean(restored["omega"][in_hold]) == pytest.approx(hold_speed * RPM, rel=0.03)
    assert np.mean(restored["omega"][~in_hold] * speed[~in_hold] > 0.0) > 0.98


def test_noise_at_rest_has_no_mean_and_a_slow_flow_keeps_its_own() -> None:
    """The magnitude of noise has a mean of 0.8 standard deviations, which would pass for a pump that turns."""
    resting, speed = held_lift(0.0, noise=2.0)
    assert np.abs(resting["omega"][np.abs(speed) < 1e-9]).mean() > 1.5 * RPM
    restored, _ = restore_signs(resting)
    rest = restored["omega"][np.abs(speed) < 1e-9]
    assert abs(rest.mean()) < 0.2 * RPM and rest.std() == pytest.approx(2.0 * RPM, rel=0.1)
    again, _ = restore_signs(resting)
    assert np.array_equal(restored["omega"], again["omega"])
    assert np.abs(restored["omega"]) == pytest.approx(np.abs(resting["omega"]))


def test_samples_beside_a_gap_keep_the_sign_of_their_stroke() -> None:
    """A gate whose poll missed a sample had a jump of twice its speed there: a leak of half the flow."""
    fast, speed = held_lift(2.0, noise=0.5)
    polled = slice(None, None, 20)  # at 5 Hz
    t, speed = fast.t[polled], speed[polled]
    missing = np.arange(t.size) % 10 == 0  # in strokes up and down, and in holds
    channels = {name: np.where(missing, np.nan, values[polled]) for name, values in fast.channels.items()}
    restored, _ = restore_signs(replace(fast, t=t, channels=channels, rate=5.0))
    in_stroke = ~missing & (np.abs(speed) > 900.0 * RPM)
    assert np.all(restored["omega"][in_stroke] * speed[in_stroke] > 0.0)


def test_a_pump_that_turns_one_way_keeps_the_signed_noise_of_its_sensor() -> None:
    recording, speed = held_lift(0.0, noise=2.0)
    signed_noise = np.random.default_rng(5).standard_normal(len(recording)) * 2.0 * RPM
    one_way = replace(recording, channels={**recording.channels, "omega": np.abs(speed) + signed_noise})
    restored, _ = restore_signs(one_way)
    rest = np.abs(speed) < 1e-9
    assert abs(restored["omega"][rest].mean()) < 0.05 * RPM
    assert np.mean(restored["omega"][~rest] * speed[~rest] > 0.0) > 0.98


@pytest.mark.parametrize("rate", [50.0, 100.0, 500.0])
def test_noise_of_a_speed_is_that_of_its_positions(rate: float) -> None:
    """The speed is (x_(k+n) - x_(k-n)) rate / 2 n, with a variance of sigma^2 rate^2 / 2 n^2 for white noise of x."""
    sigma, n = 1e-4, round(0.05 * rate)
    x = sigma * np.random.default_rng(7).standard_normal(round(400 * rate))
    variance = 0.5 * (sigma * rate / n) ** 2
    assert _noise_variance(_piston_speed(x, rate), rate) == pytest.approx(variance, rel=0.1)


def test_signs_are_those_of_the_most_likely_path() -> None:
    """Every path of a short chain, one by one."""
    random = np.random.default_rng(1)
    for _ in range(50):
        odds, cost = random.standard_normal(8), random.exponential(1.0, 7)
        paths = 1.0 - 2.0 * ((np.arange(2**8)[:, None] >> np.arange(8)) & 1)
        value = 0.5 * paths @ odds - (paths[:, 1:] != paths[:, :-1]) @ cost
        assert np.array_equal(_most_likely_signs(odds, cost), paths[np.argmax(value)])


def test_a_meter_whose_flow_has_the_wrong_sense_throughout_is_no_error() -> None:
    """Its position moves against the flow: no direction has motion of the flow's sign, which tells no supply line."""
    recording, _ = held_lift(0.0, noise=0.5)
    opposite = -np.sign(np.gradient(recording["x"]))
    metered = {**recording.only(["x"]).channels, "u": opposite, "q_pump": np.abs(np.gradient(recording["x"]))}
    meter = Recording(recording.t, metered, {"x": "m", "u": "V", "q_pump": "m^3/s"}, recording.rate)
    assert not _is_in_supply_line(meter, opposite)
