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


#: Value of a valve in each direction of the flow into chamber A: +1, 0 and -1.
VALVES = {
    "per cent": {1: 100.0, 0: 0.0, -1: -100.0},
    "reversed": {1: -1.0, 0: 0.0, -1: 1.0},
    "bit": {1: 1.0, 0: 0.0, -1: 0.0},
    "codes": {1: 1.0, 0: 0.0, -1: 2.0},
    "mA": {1: 20.0, 0: 12.0, -1: 4.0},
    "proportional": {1: 63.0, 0: 0.3, -1: -48.0},
}


def press(
    seed: int, valve: str = "per cent", directions: tuple[float, float] = (1.0, 1.0)
) -> tuple[Recording, np.ndarray]:
    """Make a press of drawn strokes with holds against a workpiece, in which its pump also turns back a little.

    Return the recording, with the speed of the pump behind the valve, which is negative only where the pump turns back,
    and the signed speed of the flow into A. `directions`: speeds of the strokes out and in [1000 rpm].
    """
    random, rate = np.random.default_rng(seed), 50.0
    pieces = []  # (direction of the valve, speed of the pump [rpm], piston speed per pump speed, seconds)
    for _ in range(8):
        speed_out, speed_in = directions * random.uniform(700.0, 1300.0, 2)
        seconds = random.uniform(1.0, 2.0)
        pieces += [(0, 0.0, 0.0, 1.0), (1, speed_out, 1.0, seconds), (1, random.uniform(20.0, 60.0), 0.0, 2.0)]
        pieces += [(1, -30.0, 0.0, 0.3), (-1, speed_in, -1.0, seconds * speed_out / speed_in)]
    rows = np.concatenate([np.tile([*piece[:3]], (round(piece[3] * rate), 1)) for piece in pieces])
    side, speed, gain = rows.T
    t, v = np.arange(len(rows)) / rate, gain * speed * 5e-5
    x = np.cumsum(v) / rate + 1e-5 * random.standard_normal(t.size)
    values = np.array([VALVES[valve][int(number)] for number in side])
    if valve == "proportional":
        values = values * random.uniform(0.5, 1.0, t.size)
    omega = RPM * (speed + 0.5 * random.standard_normal(t.size))
    channels = {
        "omega": omega,
        "x": x,
        "p_A": np.where(side > 0, 8e6, 1e6),
        "p_B": np.full(t.size, 1e6),
        "valve": values,
    }
    units = {"omega": "rad/s", "x": "m", "p_A": "Pa", "p_B": "Pa", "valve": "count"}
    return Recording(t, channels, units, rate), omega * side


@pytest.mark.parametrize("valve", VALVES)
def test_a_recorded_valve_gives_the_speed_its_sign(valve: str) -> None:
    """In any coding, through holds in which nothing moves and the pump turns back a little."""
    for seed in range(5):
        recording, signed = press(seed, valve)
        restored, (finding,) = restore_signs(recording)
        assert (finding.code, finding.severity) == ("unsigned_speed", "note")
        assert "never changes its sign and the piston does: its sign is taken from valve" in finding.text
        assert restored.channels.keys() == {"omega", "x", "p_A", "p_B"}
        rests = 3.0 * RPM  # what the sensor's noise is at rest
        np.testing.assert_allclose(restored["omega"], signed, atol=rests if valve in ("bit", "proportional") else 1e-12)


def test_without_the_valve_the_position_and_the_pressures_tell() -> None:
    for seed in range(5):
        recording, signed = press(seed)
        restored, (finding,) = restore_signs(recording.only(["omega", "x", "p_A", "p_B"]))
        assert "record its direction (--map valve=...)" in finding.text
        assert np.abs(restored["omega"] - signed).sum() < 0.02 * np.abs(signed).sum()


def test_a_valve_that_does_not_direct_the_flow_is_none() -> None:
    """A charge valve switches at random: the position tells; one that never switches tells nothing."""
    for seed in range(5):
        recording, signed = press(seed)
        random = np.random.default_rng(seed)
        for values in (
            np.repeat(random.choice([0.0, 1.0], len(recording) // 10 + 1), 10)[: len(recording)],
            np.ones(len(recording)),
            np.full(len(recording), np.nan),
        ):
            other = replace(recording, channels={**recording.channels, "valve": values})
            restored, (finding,) = restore_signs(other)
            assert "taken from the position" in finding.text
            assert np.abs(restored["omega"] - signed).sum() < 0.02 * np.abs(signed).sum()


@pytest.mark.parametrize("valve", ["per cent", "bit"])
def test_a_speed_with_a_sign_stays_as_it_is(valve: str) -> None:
    """Also one of a machine whose pump hardly moves the piston back, which falls by its weight."""
    for seed in range(5):
        for share in (1.0, 0.05):
            recording, signed = press(seed, valve)
            signed = np.where(signed < 0.0, share * signed, signed)
            plain = replace(recording, channels={**recording.channels, "omega": signed})
            restored, findings = restore_signs(plain)
            assert np.array_equal(restored["omega"], signed)
            assert not findings
            assert "valve" not in restored
