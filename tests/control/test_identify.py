"""Parameters from recordings: regressions against closed forms, simulated rigs, other kinds of machine."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.control.identification import Estimate, identified_rig_text, identify
from sealscope.control.identification.estimate import instrumented, least_squares, long_run
from sealscope.control.identification.friction import friction
from sealscope.errors import InputError
from sealscope.parameters import load_rig

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "identification.py"
DUTY = "position 60 mm sin(0.9t) + 14 mm sin(3.1t)"
UNLIKE = {"A_A": 655e-6, "A_B": 655e-6, "K_oil": 760e6, "G_pump": 4e-13, "k_p": 1.3, "K_i": 0.12, "F_l": 120.0}


@pytest.fixture(scope="module")
def recordings():
    words = {"rig": "thesis-closed-loop", "set": UNLIKE, "command": DUTY, "controller": "pi", "duration": 30.0}
    return [ss.simulate(**words, seed=5), ss.simulate(**words, seed=6, load="1 kN sin(0.7t) + 1 kN")]


@pytest.fixture(scope="module")
def recording(recordings):
    return recordings[0]


def test_long_run_covariance_of_a_moving_average():
    """e(k) + 0.8 e(k-1) has the long-run variance 1.8^2; taken as independent, it would be 1.64."""
    e = np.random.default_rng(1).standard_normal(200_001)
    series = (e[1:] + 0.8 * e[:-1])[:, None]
    assert long_run(series, 0)[0, 0] / 200_000 == pytest.approx(1.64, rel=0.02)
    assert long_run(series, 60)[0, 0] / 200_000 == pytest.approx(1.8**2, rel=0.05)


def test_an_instrument_takes_the_bias_of_noise_in_a_column_away():
    random = np.random.default_rng(2)
    true = random.standard_normal(40_000)
    column, instrument = (true + 0.7 * random.standard_normal(true.size) for _ in range(2))
    y = 3.0 * true + 0.1 * random.standard_normal(true.size)
    plain, _, _ = instrumented(y, column[:, None], column[:, None], 0)
    b, covariance, _ = instrumented(y, column[:, None], instrument[:, None], 0)
    assert plain[0] == pytest.approx(3.0 / 1.49, rel=0.02)
    assert abs(b[0] - 3.0) < 4.0 * np.sqrt(covariance[0, 0])
    assert covariance[0, 0] < 0.05**2


def test_least_squares_gives_the_deviation_of_a_mean():
    y = 5.0 + np.random.default_rng(3).standard_normal(900)
    q, covariance, _ = least_squares(lambda q: q[0] - y, (1.0,), 0)
    assert q[0] == pytest.approx(y.mean())
    assert covariance[0, 0] ** 0.5 == pytest.approx(y.std(ddof=1) / 30.0, rel=1e-3)


def test_friction_is_told_from_strokes_in_which_the_piston_does_not_ring():
    """Eq. (4.21) written out; in a third of the time, at low speeds, v swings by 40 mm/s at 60 Hz, as machines do."""
    rig = load_rig("servo-valve").with_overrides({"M_eq": 1.0})
    rate, t = 2000.0, np.arange(80_000) / 2000.0
    slow = 0.05 * np.sin(0.9 * t) + 0.045 * np.sin(3.1 * t)
    ring = 0.04 * (np.sin(1.3 * t) > 0.4) * (np.abs(slow) < 0.06)
    v = slow + ring * np.sin(120 * np.pi * t)
    x, p_B = np.cumsum(v) / rate, 3e6
    speed = np.abs(v)
    law = (30.0 + 2e-6 * p_B) * (1.0 + 2.2 * np.exp(-10.0 * speed)) * np.sign(v) + 250.0 * v
    p_A = p_B + (100.0 + law) / rig.cylinder.A_A  # F_cfr (p_A + p_B) within 0.3 N of that
    p_A = p_A + 2e3 * np.random.default_rng(4).standard_normal(t.size)
    channels = {"x": x, "p_A": p_A, "p_B": np.full_like(t, p_B)}
    recording = ss.Recording(t, channels, {"x": "m", "p_A": "Pa", "p_B": "Pa"}, rate)
    told = friction([recording], rig, rig.cylinder.A_A, rig.cylinder.A_B)
    truth = {"cylinder.F_l": 100.0, "friction.F_pr": 30.0, "friction.K_brk": 3.2, "friction.F_v": 250.0}
    for estimate in told:
        assert abs(estimate.value - truth[estimate.name]) < 4.0 * estimate.with_model_error(1e-2).sd, estimate
        assert estimate.sd < 0.15 * truth[estimate.name]


def test_a_rig_that_is_not_the_stated_one_is_identified(recordings):
    found = identify(recordings, "thesis-closed-loop")
    assert found.mismatch is None
    for name, truth in (
        ("cylinder.A_A", 655e-6),
        ("fluid.K_oil", 760e6),
        ("pump.G_pump", 4e-13),
        ("motor.k_p", 1.3),
        ("motor.K_i", 0.12),
        ("cylinder.F_l", 120.0),
    ):
        assert abs(found[name].value - truth) < 4.0 * found[name].sd
        assert found[name].sd < 0.03 * truth
    told = dict(found.untold)
    assert "displacement only" in told["pump.q_b"]
    assert "one conductance" in told["piston or pump"]
    assert not set(told) & {estimate.name for estimate in found.estimates}
    assert "needs a load that changes" in dict(identify(recordings[:1], "thesis-closed-loop").untold)["the drive"]


def test_a_rig_s_file_is_written_with_intervals_as_sources(recording, tmp_path):
    found = identify([recording], "thesis-closed-loop")
    path = tmp_path / "mine.toml"
    path.write_text(identified_rig_text(found, "mine", "thesis-closed-loop", 1), encoding="utf-8")
    rig = load_rig(path)
    assert pytest.approx(found["cylinder.A_A"].value, rel=1e-6) == rig.cylinder.A_A
    assert rig.pump.q_b == load_rig("thesis-closed-loop").pump.q_b
    sources = {row.name: row.source for row in rig.table()}
    assert sources["fluid.K_oil"].startswith("identified from 1 recordings: ")
    assert "# not told: pump.q_b" in path.read_text()


@pytest.mark.slow
def test_another_kind_of_machine_is_said(recording):
    words = {"command": "position 60 mm sin(0.9t)", "duration": 15.0}
    single = identify([ss.simulate(rig="thesis-closed-loop", **words)], "single-rod-eha")
    assert "got 1: take a rig of equal areas" in (single.mismatch or "")
    double = identify([ss.simulate(rig="single-rod-eha", load="3 kN sin(0.5t)", **words)], "thesis-closed-loop")
    assert "take a rig of a single-rod cylinder" in (double.mismatch or "")
    assert single.estimates == ()
    random = np.random.default_rng(0)
    channels = {name: recording[name] for name in ("theta", "p_A", "p_B", "u")}
    still = ss.Recording(recording.t, channels | {"x": 1e-3 * random.standard_normal(len(recording))}, recording.units,
                         recording.rate)  # fmt: skip
    other = identify([still], "thesis-closed-loop")
    assert "no pump-controlled machine" in (other.mismatch or "")


@pytest.mark.slow
def test_a_machine_behind_a_servo_valve_is_identified_and_no_other_one_taken_for_it(recording):
    unlike = {"Q_N": 1.9e-4, "K_oil": 760e6, "o_PA": 8e-6, "o_AT": -5e-6, "o_PB": 3e-6, "o_BT": -2e-6}
    words = {"rig": "servo-valve", "command": DUTY, "controller": "pi", "duration": 16.0}
    behind = ss.simulate(**words, set=unlike, load="1 kN sin(0.7t) + 1 kN")
    found = identify([behind], "servo-valve")
    for name, truth in unlike.items():
        estimate = found[f"{'fluid' if name == 'K_oil' else 'valve'}.{name}"]
        assert abs(estimate.value - truth) < 4.0 * estimate.sd
        assert estimate.sd < 0.03 * max(abs(truth), 1e-6)
    told = dict(found.untold)
    assert "rated flow only" in told["cylinder.A_A, cylinder.A_B"]
    assert told["friction"] == "friction needs a recording in which the load is constant"
    assert "a rig has no parameter for it" in told["leakage of the piston"]
    assert "no machine behind a servo valve" in (identify([recording], "servo-valve").mismatch or "")
    with pytest.raises(InputError, match="and p_B of a machine behind a pump, got a recording without theta"):
        identify([behind], "thesis-closed-loop")
    single = ss.simulate(**words | {"set": {"A_B": "400[mm^2]", "V_rod": "40[cm^3]"}, "duration": 12.0})
    assert "got 1.58: take a rig of a single-rod cylinder" in (identify([single], "servo-valve").mismatch or "")


def test_what_cannot_be_identified_is_one_line(recording):
    with pytest.raises(InputError, match="identification must have one recording or more, got none"):
        identify([], "thesis")
    short = ss.Recording(recording.t, {"p_A": recording["p_A"]}, {"p_A": "Pa"}, recording.rate)
    with pytest.raises(
        InputError, match="must have theta, x, p_A and p_B of a machine behind a pump, got a recording without theta"
    ):
        identify([short], "thesis")


def test_intervals_hold_95_percent():
    low, high = Estimate("pump.G_pump", 2.0, 0.5).interval
    assert (low, high) == pytest.approx((2.0 - 0.98, 2.0 + 0.98), abs=1e-4)


@pytest.mark.slow
def test_intervals_hold_the_truth_on_rigs_of_their_own():
    spec = importlib.util.spec_from_file_location("identification_benchmark", BENCHMARK)
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    rows = [benchmark.judged(("thesis-closed-loop", number, 99)) for number in range(6)]
    of = [row[name] for row in rows for name in row]
    assert len(of) > 40
    assert sum(r["low"] <= r["truth"] <= r["high"] for r in of) > 0.85 * len(of)
