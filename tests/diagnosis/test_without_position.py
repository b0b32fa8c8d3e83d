"""Balances without a position: over cycles and holds, what the pump delivers is what leaks."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import Run, simulate_experiment
from sealscope.units import LITRE_PER_MINUTE

from .judging import judge

RATE, SECONDS = 200.0, 120.0
RIG = load_rig("thesis-closed-loop")
D = RIG.pump.q_b / (2.0 * math.pi)
DOUBLE, SINGLE = "thesis-closed-loop", "single-rod-eha"


def balanced(
    stroke: float, load: float, G: float, rise: float = 0.0, wiring: float = 1.0, swing: float = 0.0, seed: int = 0
) -> Recording:
    """A piston that a loop brings back: strokes [rad/s], load [Pa], G and its rise at 60 s, load that swings [Pa]."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    v = 0.03 * stroke * np.cos(stroke * t)
    dp = load + swing * np.sin(0.37 * t) + 1e5 * np.tanh(40.0 * v) + 4e5 * v
    flow = RIG.cylinder.A_A * v + (G + np.where(t >= 60.0, rise, 0.0)) * dp
    noise = np.random.default_rng(seed)
    theta = np.concatenate([[0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]))]) / RATE / D
    channels = {
        "theta": wiring * theta + 1e-3 * noise.standard_normal(t.size),
        "p_A": 3e6 + 0.5 * dp + 5e3 * noise.standard_normal(t.size),
        "p_B": 3e6 - 0.5 * dp + 5e3 * noise.standard_normal(t.size),
    }
    return Recording(t, channels, {"theta": "rad", "p_A": "Pa", "p_B": "Pa"}, RATE)


def examined(recording: Recording, rig: str = "thesis-closed-loop") -> Evidence:
    detector = VolumeBalance(load_rig(rig))
    assert detector.usable(recording) is None
    return judge(detector, recording)


@settings(max_examples=10, deadline=None)
@given(
    st.floats(1.2, 5.0), st.floats(6e5, 2e6), st.sampled_from([1.0, -1.0]), st.sampled_from([1.0, -1.0]),
    st.floats(5e-13, 3e-12),
)  # fmt: skip
def test_what_is_left_over_a_cycle_is_what_leaks(
    stroke: float, load: float, side: float, wiring: float, G: float
) -> None:
    """Whatever side carries the load, and whichever way the shaft is counted."""
    balance = VolumeBalance(RIG).balance(balanced(stroke, side * load, G, wiring=wiring))
    assert balance is not None
    assert balance.conductance.value == pytest.approx(G, rel=0.02)


@pytest.mark.parametrize("swing", [0.0, 6e5])
def test_a_step_is_sized_and_dated(swing: float) -> None:
    evidence = examined(balanced(2.0, 1e6, 1e-12, rise=3e-13, swing=swing))
    rise = 3e-13 * 1e6 / LITRE_PER_MINUTE
    assert evidence.verdict == "leak"
    assert evidence.leak_interval_lpm is not None and evidence.onset_interval_s is not None
    assert evidence.leak_interval_lpm[0] < rise < evidence.leak_interval_lpm[1] < 2.0 * rise
    assert evidence.onset_interval_s[0] < 60.0 < evidence.onset_interval_s[1] < 75.0


def test_samples_that_are_missing_cost_the_rows_that_touch_them() -> None:
    recording = balanced(2.0, 1e6, 1e-12, rise=3e-13)
    gap = (recording.t > 30.0) & (recording.t < 31.0)
    wrong = {name: np.where(gap, 1e9, values) for name, values in recording.channels.items()}
    evidence = examined(replace(recording, channels=wrong, bridged=gap))
    whole = examined(recording)
    assert evidence.leak_lpm == pytest.approx(whole.leak_lpm, rel=0.1)


def test_a_pressure_difference_that_zeros_of_sensors_make_tells_nothing() -> None:
    evidence = examined(balanced(2.0, 2e4, 1e-12, rise=3e-12))
    assert (evidence.verdict, evidence.score) == ("cannot tell", None)
    assert "needs the position x" in evidence.reason


def test_the_accumulator_tells_oil_that_leaves_from_oil_that_passes() -> None:
    """Under a steady load both ask the same of the pump; what leaves is missing, and the lower pressure falls."""
    recording = balanced(2.0, 1e6, 5e-13, rise=3e-13)  # below the limit of the rig's file, which alone would be a leak
    lost = 3e-13 * 1e6 * np.maximum(recording.t - 60.0, 0.0)
    fallen = 2.5e6 * np.expm1(-RIG.makeup.n_gas * lost / RIG.makeup.V_gas)
    channels = {name: recording[name] + fallen * name.startswith("p_") for name in recording.channels}
    assert examined(recording).cause == "piston or pump leak"
    assert examined(replace(recording, channels=channels)).verdict != "leak"


@cache
def simulated(rig: str, command: str, load: str = "0 N", leak: str = "") -> Run:
    words = {"rig": rig, "command": command, "load": load, "duration": SECONDS, "seed": 2}
    return simulate_experiment(Experiment.of(**words, leak=leak or ()))


@pytest.mark.slow
def test_an_open_loop_delivers_nothing_of_what_leaks() -> None:
    """The command stands whatever leaks; what the drive makes good of the load's droop fades."""
    recording = simulated(DOUBLE, "3 sin(4t)", "600 N", "0.05 L/min from 60 s").recording
    for channels in (("u", "p_A", "p_B"), ("theta", "p_A", "p_B")):
        evidence = examined(recording.only(channels), DOUBLE)
        assert (evidence.verdict, evidence.bound_lpm) == ("cannot tell", None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "channels", [("u", "p_A", "p_B"), pytest.param(("omega", "p_A", "p_B"), marks=[pytest.mark.slow, pytest.mark.long])]
)
@pytest.mark.parametrize(
    ("rig", "command", "load", "leak"),
    [
        (DOUBLE, "position 40 mm sin(1.6t)", "1.2 kN", "0.0042"),
        pytest.param(
            SINGLE, "position trapezoid 45 mm within 1.1 s every 5.3 s", "0 N", "0.002", marks=pytest.mark.slow
        ),
    ],
)
def test_a_closed_loop_delivers_what_leaks(
    rig: str, command: str, load: str, leak: str, channels: tuple[str, ...]
) -> None:
    """Under a load over cycles; unloaded, where the valves of a single rod settle anew at each stop, while it is held.

    From the command the drive's own law tells the speed.
    """
    run = simulated(rig, command, load, f"{leak} L/min from 60 s")
    evidence = examined(run.recording.only(channels), rig)
    assert evidence.verdict == "leak"
    assert evidence.leak_interval_lpm is not None
    assert evidence.leak_interval_lpm[0] <= run.truth.mean_leak_lpm <= evidence.leak_interval_lpm[1]
    healthy = examined(simulated(rig, command, load).recording.only(channels), rig)
    assert healthy.verdict == "no leak"
    assert healthy.bound_lpm is not None and healthy.bound_lpm < float(leak)


def held(G: float, feeds: bool = False) -> Recording:
    """A load that a shut valve holds for 48 s of 60: the piston gives way by what is lost; or the valve feeds it."""
    rig, random = load_rig("servo-valve"), np.random.default_rng(5)
    t = np.arange(6000) / 100.0
    moving = (t > 10.0) & (t < 14.0) | (t > 30.0) & (t < 34.0) | (t > 50.0) & (t < 54.0)
    p_A = 6e6 + 2e5 * np.sin(0.3 * t)
    v = np.where(moving, 0.02 * np.sign(np.sin(0.16 * t)), 0.0 if feeds else -G * (p_A - 1e6) / rig.cylinder.A_A)
    u = np.where(moving, 2.0, 1e-3 * random.standard_normal(t.size) if feeds else 0.0)
    channels = {
        "u": u,
        "x": np.cumsum(v) / 100.0 + 1e-5 * random.standard_normal(t.size),
        "p_A": p_A + 5e3 * random.standard_normal(t.size),
        "p_B": 1e6 + 5e3 * random.standard_normal(t.size),
    }
    return Recording(t, channels, {"u": "V", "x": "m", "p_A": "Pa", "p_B": "Pa"}, 100.0)


@pytest.mark.parametrize("G", [0.0, 1e-13])
def test_what_a_held_load_loses_shows_by_how_it_gives_way(G: float) -> None:
    detector, recording = VolumeBalance(load_rig("servo-valve")), held(G)
    assert detector.usable(recording) is None
    balance = detector.balance(recording)
    assert balance is not None
    assert balance.conductance.low <= G <= balance.conductance.high
    assert (balance.conductance.high - balance.conductance.low) * 5e6 < 0.005 * LITRE_PER_MINUTE
    assert judge(detector, recording).verdict != "leak"


def test_a_valve_that_may_feed_a_held_load_tells_nothing() -> None:
    assert VolumeBalance(load_rig("servo-valve")).balance(held(1e-13, feeds=True)) is None
