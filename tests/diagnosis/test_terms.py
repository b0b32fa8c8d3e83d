"""The terms of each circuit: a leak put into a balance in closed form is found again, with its size."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from sealscope.control.drive import Drive
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.estimate.change import StepTest, step_test
from sealscope.diagnosis.inference.block_stream import BlockStream
from sealscope.diagnosis.inference.blocks import estimate_offset, information
from sealscope.diagnosis.inference.equations.balances import derive_drive_signals, equations
from sealscope.diagnosis.inference.regimes import recorded_blocks
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.recording import Array, Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

from ..representatives import SLOW, few
from ..wording import says

RATE, DURATION, ONSET = 200.0, 60.0, 30.0
LEAK = 5e-12
LATE = "0.05 L/min from 60 s"
NOISE = np.random.default_rng(43)


def recording(channels: Mapping[str, Array]) -> Recording:
    """Return channels in SI units as a recording."""
    n = len(next(iter(channels.values())))
    return Recording(np.arange(n) / RATE, dict(channels), {name: CHANNEL_UNITS[name] for name in channels}, RATE)


def step_of(channels: Mapping[str, Array], rig: Rig) -> StepTest:
    """Return the test of a step of the leak."""
    made = recorded_blocks(recording(channels), rig)
    assert made is not None
    regime = made.regime(made.odds)
    blocks, columns = regime.blocks, regime.columns
    test = step_test(information(blocks, columns, columns[0].leak))
    assert test is not None
    return test


def cylinder(rig: Rig, u: Array, leak: float = LEAK) -> dict[str, Array]:
    """Return the channels of a pump-controlled cylinder whose piston leaks from ONSET on.

    A dx = D omega dt - (V/K) dp_A/2 + (V/K) dp_B/2 - G (p_A - p_B) dt, with the speed that the drive makes of u.
    """
    drive = Drive.from_rig(rig)
    omega = drive.speed(u, np.zeros(len(u)), RATE)
    true = [3e6 + sign * (5e4 * np.tanh(omega / 5.0) + 300.0 * omega) for sign in (1.0, -1.0)]
    conductance = leak * (np.arange(len(u)) / RATE >= ONSET)
    flow = rig.pump.q_b / (2.0 * np.pi) * omega
    compliance = 0.5 * rig.cylinder.V / rig.fluid.K_oil
    rate = flow - conductance * (true[0] - true[1]) - compliance * np.gradient(true[0] - true[1]) * RATE
    area = 0.5 * (rig.cylinder.A_A + rig.cylinder.A_B)
    x, theta = (np.concatenate([[0.0], np.cumsum(0.5 * (of[1:] + of[:-1])) / RATE]) for of in (rate / area, omega))
    p_A, p_B = (own + NOISE.normal(0.0, 1e3, len(u)) for own in true)
    return {"u": u, "omega": omega, "theta": theta, "x": x, "p_A": p_A, "p_B": p_B, "q_pump": flow}


def command() -> Array:
    """Return a command [V] of strokes that differ."""
    t = np.arange(0.0, DURATION, 1.0 / RATE)
    return 3.0 * np.sin(2.0 * t) + 1.5 * np.sin(3.1 * t)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("thesis")


@pytest.fixture(scope="module")
def leaking(rig: Rig) -> dict[str, Array]:
    return cylinder(rig, command())


@pytest.mark.parametrize("source", ["theta", "omega", "q_pump", "u"])
def test_any_source_of_the_pump_s_flow_gives_the_leak(source: str, rig: Rig, leaking: dict[str, Array]) -> None:
    test = step_of({name: leaking[name] for name in ("x", "p_A", "p_B", source)}, rig)
    assert test.chance < 1e-4
    assert test.fitted[0] == pytest.approx(LEAK, rel=0.05)
    assert test.onset().value == pytest.approx(ONSET, abs=1.5)


@pytest.mark.parametrize("source", ["theta", "omega", "q_pump", "u"])
def test_without_a_leak_none_is_found(source: str, rig: Rig) -> None:
    healthy = cylinder(rig, command(), leak=0.0)
    assert step_of({name: healthy[name] for name in ("x", "p_A", "p_B", source)}, rig).chance > 0.01


def test_connections_change_nothing(rig: Rig, leaking: dict[str, Array]) -> None:
    """Swapped sides, with the directions or without, and encoders that count backwards: the same leak."""
    read = {name: leaking[name] for name in ("x", "p_A", "p_B", "theta")}
    plain = step_of(read, rig)
    swapped = {"p_A": read["p_B"], "p_B": read["p_A"]}
    for other in (
        {**read, **swapped, "x": -read["x"], "theta": -read["theta"]},
        {**read, "theta": -read["theta"]},
        {**read, "x": -read["x"]},
        {**read, **swapped},
    ):
        test = step_of(other, rig)
        assert test.fitted[0] == pytest.approx(plain.fitted[0], rel=0.01)
        assert test.score == pytest.approx(plain.score, rel=0.05)


def test_the_zero_of_a_pressure_changes_neither_leak_nor_chance(rig: Rig, leaking: dict[str, Array]) -> None:
    """p_A reads too much by one prior width: the leak is the same, and its flow's change tells the zero."""
    read = {name: leaking[name] for name in ("x", "p_A", "p_B", "theta")}
    width = INFERENCE.zero.pressure
    shifted = {**read, "p_A": read["p_A"] + width}
    assert step_of(shifted, rig).fitted[0] == pytest.approx(LEAK, rel=0.05)
    regime = (recorded_blocks(recording(shifted), rig) or pytest.fail("no blocks")).open
    blocks, columns = regime.blocks, regime.columns
    assert estimate_offset(blocks, columns) == pytest.approx(width, rel=0.1)
    mean = np.abs(np.diff([leaking["p_B"], leaking["p_A"]], axis=0)).mean()
    assert blocks.mean_pressure(estimate_offset(blocks, columns)).mean() == pytest.approx(mean, rel=0.05)


@pytest.mark.parametrize("loaded", [False, True])
def test_a_missing_command_is_held_and_its_speed_is_missing(rig: Rig, leaking: dict[str, Array], loaded: bool) -> None:
    read = {name: leaking[name] for name in ("u", "x", "p_A", "p_B")}
    holed, held = read["u"].copy(), read["u"].copy()
    holed[1000:1010], held[1000:1010] = np.nan, held[999]
    speed, oracle = (derive_drive_signals({**read, "u": u}, rig, RATE, loaded=loaded)["omega"] for u in (holed, held))
    assert np.isnan(speed[1000:1010]).all()
    rest = np.delete(np.arange(len(holed)), slice(1000, 1010))
    np.testing.assert_allclose(speed[rest], oracle[rest], rtol=1e-12)


def behind_valve(friction: Array, leak: Array) -> dict[str, Array]:
    """Return the channels of a symmetric cylinder behind a valve without overlap; friction as a pressure [Pa].

    A v = c u_+ sqrt(p_1 - p_A) - c u_- sqrt(p_A - p_2) - G (p_A - p_B), and the same of B by p_A + p_B = p_1 + p_2.
    """
    rig = load_rig("servo-valve")
    t = np.arange(0.0, DURATION, 1.0 / RATE)
    u = 2.0 * np.sin(3.0 * t) + np.sin(5.3 * t)
    half = 0.5 * friction * np.tanh(u / 0.05) + 1e4 * u
    p_1, p_2 = np.full(len(t), 7e6), np.full(len(t), 3e5)
    p_A, p_B = 0.5 * (p_1 + p_2) + half, 0.5 * (p_1 + p_2) - half
    gain = rig.valve.Q_N / np.sqrt(rig.valve.dp_N) / rig.valve.u_N
    v = (gain * u * np.sqrt(np.where(u > 0.0, p_1 - p_A, p_A - p_2)) - leak * (p_A - p_B)) / rig.cylinder.A_A
    x = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1])) / RATE])
    noisy = {name: own + NOISE.normal(0.0, 1e3, len(t)) for name, own in (("p_A", p_A), ("p_B", p_B))}
    return {"u": u, "x": x, "p_1": p_1, "p_2": p_2, **noisy}


def test_behind_a_valve_a_leak_is_found_and_friction_is_none() -> None:
    rig = load_rig("servo-valve")
    late = np.arange(0.0, DURATION, 1.0 / RATE) >= ONSET
    leak = step_of(behind_valve(np.full(late.shape, 1.2e5), LEAK * late), rig)
    assert leak.chance < 1e-4
    assert leak.fitted[0] == pytest.approx(LEAK, rel=0.1)
    assert step_of(behind_valve(1.2e5 * (1.0 + 0.2 * late), np.zeros(late.shape)), rig).chance > 0.01


def test_port_pressures_that_are_the_chambers_leave_the_leak_whole(rig: Rig, leaking: dict[str, Array]) -> None:
    """Without lines p_1 - p_2 is p_A - p_B: the flow is the leak's, not shared with the pump's."""
    read = {name: leaking[name] for name in ("x", "p_A", "p_B", "theta")}
    with_ports = step_of({**read, "p_1": read["p_A"], "p_2": read["p_B"]}, rig)
    assert with_ports.fitted[0] == pytest.approx(step_of(read, rig).fitted[0], rel=1e-3)


def test_a_stream_is_oriented_as_the_recording_is(rig: Rig, leaking: dict[str, Array]) -> None:
    """Pieces of any size give the same blocks, from a command and with the encoder's sense unknown."""
    read = {"u": -leaking["u"], "x": leaking["x"], "p_A": leaking["p_A"], "p_B": leaking["p_B"]}
    balances, read = equations(rig, frozenset(read)), derive_drive_signals(read, rig, RATE)
    whole = BlockStream(balances, RATE).push(read, last=True)
    stream, parts = BlockStream(balances, RATE), []
    for piece in np.array_split(np.arange(len(read["u"])), 7):
        blocks = stream.push(
            {name: values[piece] for name, values in read.items()}, last=piece[-1] == len(read["u"]) - 1
        )
        parts += [blocks.gram] if blocks is not None else []
    assert whole is not None
    assert np.allclose(np.concatenate(parts), whole.gram, rtol=1e-6, atol=1e-9 * np.abs(whole.gram).max())


def test_nothing_is_balanced_without_a_source_of_flow(rig: Rig) -> None:
    assert equations(rig, frozenset({"x", "p_A", "p_B"})) == ()
    assert equations(load_rig("servo-valve"), frozenset({"x", "p_A", "p_B", "u"})) == ()


@pytest.fixture(scope="module")
def single_rod() -> Recording:
    words = {"rig": "single-rod-eha", "command": "5 sin(2t)", "load": "-3000 N", "leak": LATE}
    return simulate_experiment(Experiment.of(duration=120, seed=3, **words)).recording


@pytest.mark.parametrize(
    "bar",
    [-6.0, pytest.param(-1.0, marks=[pytest.mark.slow, pytest.mark.long]), pytest.param(6.0, marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_a_zero_that_is_far_off_leaves_a_single_rod_s_leak_as_it_is(single_rod: Recording, bar: float) -> None:
    """Which side carries, and the root of an orifice's law, are taken about the zero."""
    single, own = load_rig("single-rod-eha"), single_rod
    shifted = replace(own, channels={**own.channels, "p_A": own["p_A"] + bar * 1e5})
    diagnosis = diagnose(shifted, rig=single)
    assert diagnosis.verdict == "leak"
    low, high = diagnosis.leak_interval_lpm or pytest.fail("no interval")
    assert low <= 0.05 <= high
    assert says(diagnosis.reason, "remark.zero too high" if bar > 0.0 else "remark.zero too low")


@pytest.mark.parametrize("samples", few([2, 0, -2], 1, SLOW))
def test_a_position_recorded_late_is_named_and_changes_no_size(samples: int) -> None:
    experiment = Experiment.of(command="3 sin(4t)", duration=40, leak="0.05 L/min from 20 s", seed=3)
    own = simulate_experiment(experiment).recording
    shifted = replace(own, channels={**own.channels, "x": np.roll(own["x"], samples)}).between(0.1, 39.9)
    diagnosis = diagnose(shifted, rig=load_rig("thesis"))
    assert diagnosis.verdict == "leak" and diagnosis.leak_lpm == pytest.approx(0.05, rel=0.03)
    named = re.search(r"x is recorded (\S+) ms (later|earlier)", diagnosis.reason)
    assert (named is None) == (samples == 0)
    if named is not None:
        assert float(named[1]) == pytest.approx(4.0, rel=0.02) and named[2] == ("later" if samples > 0 else "earlier")
