"""Sensors and data acquisition, each effect against what it is defined to do."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.parameters import load_rig
from sealscope.physics.rig import OUTPUTS
from sealscope.recordings.channels import PRESSURES
from sealscope.signals.details import details
from sealscope.simulation.experiment import FILTER_REACH, Experiment
from sealscope.simulation.instruments import decimate, record
from sealscope.simulation.integrate import Trajectory
from sealscope.simulation.simulate import simulate

PSI = 6894.757293168361
RATE, FACTOR = 500.0, 4
QUIET = {"sensors.common_noise": 0.0} | {
    f"sensors.{name}.{what}": 0.0 for name in PRESSURES for what in ("noise", "drift")
}


def still(n: int, pressure: float = 1e6, **outputs: np.ndarray) -> Trajectory:
    """A trajectory at `FACTOR` times the sampling rate: pressures constant, all else zero but what is given."""
    rows = np.zeros(((n + FILTER_REACH) * FACTOR, len(OUTPUTS)))
    for name in PRESSURES:
        rows[:, OUTPUTS.index(name)] = pressure
    for name, values in outputs.items():
        rows[:, OUTPUTS.index(name)] = values
    return Trajectory(np.arange(len(rows)) / (RATE * FACTOR), rows, "made up", 1.0)


def read(n: int, values: dict | None = None, seed: int = 0, path: Trajectory | None = None):
    rig = load_rig("thesis").with_overrides(values or {})
    experiment = Experiment(rig, duration=n / rig.daq.sample_rate, seed=seed)
    return record(experiment, path or still(n), np.zeros(n), FACTOR)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def demo():
    return simulate(command="3 sin(4t)", duration=180.0, seed=3)


@pytest.mark.parametrize(("name", "psi"), [("p_A", 1.23), ("p_B", 1.50)])
def test_the_finest_detail_has_the_rms_of_the_measured_records(demo, name, psi):
    for recording in (demo, read(90_000)):
        result = details(recording[name])
        assert rms(result[1][result.inside(1)]) / PSI == pytest.approx(psi, rel=0.015)


def test_chambers_share_a_part_of_their_noise():
    reading = read(90_000, {f"sensors.{name}.drift": 0.0 for name in PRESSURES})
    # 0.8^2 / (1.23 * 1.50)
    assert np.corrcoef(reading["p_A"], reading["p_B"])[0, 1] == pytest.approx(0.347, abs=0.015)


def test_pressures_come_in_steps_of_the_converter(demo):
    step = 3000.0 * PSI / 2**13  # 14 bits over +-10 V, the transducer on 0-10 V
    assert step / PSI == pytest.approx(0.3662, abs=5e-5)
    for name in PRESSURES:
        counts = demo[name] / step
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)
        assert np.unique(np.rint(counts)).size > 20
    fine = read(2000, {"bits": 16})
    np.testing.assert_allclose(fine["p_A"] / (step / 4), np.rint(fine["p_A"] / (step / 4)), atol=1e-6)
    assert np.abs(fine["p_A"] / step - np.rint(fine["p_A"] / step)).max() > 0.2


def test_a_transducer_saturates_at_its_range():
    top = 3000.0 * PSI
    high, low = read(500, QUIET, path=still(500, 2 * top)), read(500, QUIET, path=still(500, -1e5))
    for name in PRESSURES:
        assert np.all(high[name] == high[name][0])
        assert top - 1.01 * top / 2**13 <= high[name][0] < top  # the highest code but one step below 10 V
        np.testing.assert_allclose(low[name], 0.0, atol=1e-6)


def test_offset_and_gain_error_and_hum_read_as_they_are_set():
    settings = {"sensors.p_A.offset": 2e4, "sensors.p_A.gain_error": 0.01, "sensors.p_B.hum": 5e4, "bits": 24}
    reading = read(5000, {**QUIET, **settings})
    np.testing.assert_allclose(reading["p_A"], 1.01e6 + 2e4, atol=2.0)
    np.testing.assert_allclose(reading["p_1"], 1e6, atol=2.0)
    spectrum = np.abs(np.fft.rfft(reading["p_B"] - 1e6)) / 2500
    assert np.argmax(spectrum) * RATE / 5000 == pytest.approx(60.0)
    assert spectrum.max() == pytest.approx(5e4, rel=1e-3)


def test_the_zero_walks_as_the_root_of_time():
    ends = [read(250, {**QUIET, "sensors.p_A.drift": 500.0, "bits": 24}, seed)["p_A"][-1] - 1e6 for seed in range(120)]
    # 0.5 s at 500 Pa per root second
    assert np.std(ends) == pytest.approx(500 * np.sqrt(0.5), rel=0.15)


def test_lost_samples_are_missing_at_their_rate():
    reading = read(50_000, {"sensors.p_A.drop_rate": 25.0})
    assert np.isnan(reading["p_A"]).mean() == pytest.approx(0.05, rel=0.1)
    assert not np.isnan(reading["p_B"]).any()


def test_a_reading_sticks_at_its_rate_and_not_otherwise():
    """Once in two seconds for one second on average: some of the time."""
    stuck, free = (read(20_000, {"sensors.p_A.stuck_rate": rate, "bits": 32})["p_A"] for rate in (0.5, 0.0))
    assert 0.1 < np.mean(np.diff(stuck) == 0.0) < 0.8
    assert np.count_nonzero(np.diff(free) == 0.0) < 3


@pytest.mark.slow
def test_a_stuck_reading_repeats_for_a_second_on_average():
    reading = read(500_000, {"sensors.p_A.stuck_rate": 0.02, "bits": 32})["p_A"]
    same = np.diff(reading) == 0.0
    starts = np.flatnonzero(same & ~np.r_[False, same[:-1]])
    lengths = [int(np.argmin(np.r_[same[start:], False])) for start in starts]
    assert len(lengths) == pytest.approx(0.02 * 1000, rel=0.5)
    assert np.mean(lengths) / RATE == pytest.approx(1.0, rel=0.5)
    assert np.count_nonzero(np.diff(read(500_000, {"bits": 32})["p_A"]) == 0.0) < 3


@pytest.mark.parametrize(
    ("hertz", "low", "high"),
    [
        (1.0, 0.9999, 1.0001),
        (100.0, 0.9999, 1.0001),
        (175.0, 0.999, 1.001),
        (225.0, 0.45, 0.55),
        (270.0, 0.0, 5e-4),
        (400.0, 0.0, 3e-4),
        (900.0, 0.0, 3e-4),
    ],
)
def test_the_anti_alias_filter_passes_and_stops(hertz, low, high):
    """At 500 Hz: flat to 175 Hz, half at 225 Hz, nothing from 270 Hz on; and no phase."""
    n = 4000
    t = np.arange((n + FILTER_REACH) * FACTOR) / (RATE * FACTOR)
    inside = slice(100, n)
    observed = decimate(np.cos(2 * np.pi * hertz * t), FACTOR, n)[inside]
    quadrature = decimate(np.sin(2 * np.pi * hertz * t), FACTOR, n)[inside]
    turned = (observed + 1j * quadrature) * np.exp(-2j * np.pi * hertz * np.arange(n)[inside] / RATE)
    assert low <= np.abs(turned).mean() <= high
    if low > 0:
        np.testing.assert_allclose(turned.imag, 0.0, atol=1e-9)


def test_decimation_by_one_changes_nothing_and_a_constant_stays():
    values = np.random.default_rng(0).normal(size=200)
    np.testing.assert_array_equal(decimate(values, 1, 150), values[:150])
    np.testing.assert_allclose(decimate(np.full(4 * 116, 7.0), 4, 100), 7.0, rtol=1e-14)


def test_encoders_count():
    n = 2000
    t = np.arange((n + FILTER_REACH) * FACTOR) / (RATE * FACTOR)
    theta, x = 30.0 * np.sin(t), 0.1 * np.cos(t)
    reading = read(n, path=still(n, theta=theta, x=x))
    count = 2 * np.pi / 20_000
    for values, step, true in ((reading["theta"], count, theta), (reading["x"], 20e-6, x)):
        np.testing.assert_allclose(values / step, np.rint(values / step), atol=1e-6)
        error = true[: n * FACTOR : FACTOR] - values
        assert error.min() >= -1e-12
        assert error.max() < step
        assert error.max() > 0.9 * step
    np.testing.assert_allclose(reading["omega"], np.diff(reading["theta"], prepend=reading["theta"][0]) * RATE)
    np.testing.assert_allclose(reading["omega"][1:], 30.0 * np.cos(reading.t[1:]), atol=count * RATE + 30.0 / RATE)


def test_the_flow_meter_has_a_range_a_resolution_and_noise():
    millilitre = 1e-6 / 60
    quiet = {"sensors.q_leak.noise": 0.0}
    reading = read(500, quiet, path=still(500, q_leak=np.full(516 * FACTOR, 4.23 * millilitre)))
    np.testing.assert_allclose(reading["q_leak"] / millilitre, 4.2, rtol=1e-9)
    over = read(500, quiet, path=still(500, q_leak=np.full(516 * FACTOR, -2000 * millilitre)))
    np.testing.assert_allclose(over["q_leak"] / millilitre, -1000.0, rtol=1e-9)
    assert np.std(read(20_000)["q_leak"]) / millilitre == pytest.approx(0.2, rel=0.05)


def test_the_seed_is_the_noise():
    one, again, other = (simulate(command="3 sin(4t)", duration=3.0, seed=seed) for seed in (5, 5, 6))
    for name in one.channels:
        assert one[name].tobytes() == again[name].tobytes()
    for name in (*PRESSURES, "q_leak"):
        assert one[name].tobytes() != other[name].tobytes()
        assert np.corrcoef(one[name] - other[name], one[name])[0, 1] < 0.95


def test_no_channel_s_noise_depends_on_another_s_settings():
    plain = read(2000)
    changed = read(
        2000,
        {
            "sensors.p_1.noise": 9e4,
            "sensors.p_1.stuck_rate": 5.0,
            "sensors.p_B.drop_rate": 50.0,
            "sensors.x.noise": 1e-3,
            "sensors.q_leak.noise": 0.0,
        },
    )
    for name in ("p_2", "p_A", "theta", "omega"):
        assert plain[name].tobytes() == changed[name].tobytes()
    kept = ~np.isnan(changed["p_B"])
    np.testing.assert_array_equal(plain["p_B"][kept], changed["p_B"][kept])
    for name in ("p_1", "x", "q_leak"):
        assert plain[name].tobytes() != changed[name].tobytes()


def test_a_recording_holds_no_truth(demo):
    recording = simulate(command="3 sin(4t)", leak="0.02 L/min from 1 s", duration=3.0)
    assert set(recording.channels) == {"u", "omega", "theta", "x", *PRESSURES, "q_leak"}
    disclosed = str(dict(recording.provenance)) + str(recording.history)
    assert "leak" not in disclosed
    assert "0.02" not in disclosed
    assert (len(demo), demo.rate, demo.t[0], demo.t[-1]) == (90_000, 500.0, 0.0, 89_999 / 500)
    np.testing.assert_allclose(demo["u"], 3.0 * np.sin(4.0 * demo.t), rtol=0, atol=1e-12)
