"""A press whose pump feeds one chamber at a time: recognised by its flow out and in, and its creep is that of its load.

The recordings follow from the volumes of the two chambers in closed form, with a leak past the piston of the
conductance G, so that the expected numbers do not come from a simulator or from the detector.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope import diagnose, load_rig, simulate
from sealscope.diagnosis.assumed_rig import assumed_rig, infer_rig
from sealscope.diagnosis.verdict.machine import unstated_rig
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording

RATE, DISPLACEMENT = 100.0, 20e-6 / (2.0 * np.pi)  # [Hz], [m^3/rad]
AREA_A, AREA_B, COMPLIANCE = 80e-4, 30e-4, 4e-12  # [m^2], [m^2], [m^3/Pa] of chamber A
LPM = 1e-3 / 60.0
#: Phases of a cycle: duration [s], pump's speed [rad/s], p_A and p_B at its end [bar].
CYCLE = (
    (3.0, 150.0, 5.0, 60.0),  # closing: the pump feeds A, the valve at B holds the load
    (1.0, 20.0, 150.0, 60.0),  # pressing
    (3.0, 0.0, 150.0, 60.0),  # dwell: all valves shut
    (1.0, -20.0, 2.0, 80.0),  # release
    (1.05, -150.0, 2.0, 80.0),  # opening: the pump feeds B
    (6.0, 0.0, 2.0, 60.0),  # rest: the load hangs on B
)


def press(conductance: float, seed: int, idle: float = 0.0) -> Recording:
    """Record six cycles of a press whose piston leaks with `conductance` [m^3/(s Pa)], areas as above.

    For the last `idle` seconds of its rests the pump turns already, and its flow returns to the tank.
    """
    rng = np.random.default_rng(seed)
    speeds, ends_A, ends_B, times = [], [2.0], [60.0], [0.0]
    for _ in range(6):
        for duration, speed, p_A, p_B in CYCLE:
            spread = duration * (1.0 + 0.1 * rng.standard_normal()) if speed == 0.0 else duration
            speeds.append((len(times) - 1, speed))
            times.append(times[-1] + spread)
            ends_A.append(p_A)
            ends_B.append(p_B)
    t = np.arange(0.0, times[-1], 1.0 / RATE)
    phase = np.searchsorted(times, t, side="right") - 1
    omega = np.array([speed for _, speed in speeds])[phase]
    # pressures reach the values of a phase in its first half second
    settled = np.clip((t - np.array(times)[phase]) / 0.5, 0.0, 1.0)
    p_A, p_B = (
        1e5 * (np.array(ends)[phase] + settled * (np.array(ends)[phase + 1] - np.array(ends)[phase]))
        for ends in (ends_A, ends_B)
    )
    leak, compressed = conductance * (p_A - p_B), COMPLIANCE * np.gradient(p_A, 1.0 / RATE)
    by_A, by_B = (DISPLACEMENT * omega - leak - compressed) / AREA_A, (DISPLACEMENT * omega - leak) / AREA_B
    moves_A = np.where(omega == 0.0, p_A > p_B, omega > 0.0)
    is_idle = (omega == 0.0) & (np.array(times)[phase + 1] - t < idle) & (p_B > p_A)
    x = 0.1 + np.cumsum(np.where(moves_A, by_A, by_B)) / RATE
    x += 1e-5 * np.round(rng.standard_normal(len(t)))
    channels = {
        "x": x,
        "omega": np.where(is_idle, 150.0, omega) + 0.02 * rng.standard_normal(len(t)),
        "p_A": p_A + 5e3 * rng.standard_normal(len(t)),
        "p_B": p_B + 5e3 * rng.standard_normal(len(t)),
    }
    return Recording(t=t, rate=RATE, channels=channels, units={"x": "m", "omega": "rad/s", "p_A": "Pa", "p_B": "Pa"})


def stated_areas(area_A: float = AREA_A, area_B: float = AREA_B) -> Rig:
    return unstated_rig().with_areas(area_A, area_B, source="nameplate")


def is_open(recording: Recording, rig: Rig) -> bool:
    return assumed_rig(rig, recording)[0].circuit.feeds_one_chamber


@pytest.mark.parametrize("change", ["none", "position reversed", "speed without sign", "leak"])
def test_a_pump_that_moves_either_area_is_in_an_open_circuit(change: str) -> None:
    recording = press(1e-12 if change == "leak" else 0.0, seed=1)
    channels = dict(recording.channels)
    if change == "position reversed":
        channels["x"] = -channels["x"]
    if change == "speed without sign":
        channels["omega"] = np.abs(channels["omega"])
    assert is_open(replace(recording, channels=channels), stated_areas())


def test_a_pump_between_the_chambers_is_in_a_closed_circuit() -> None:
    rig = load_rig("single-rod-eha")
    for load in ("8 kN", "-3 kN"):
        recording = simulate(rig=rig, command="2 sin(4t)", load=load, duration="20 s", seed=1)
        named = replace(recording, provenance={})
        assert not is_open(named, stated_areas(rig.cylinder.A_A, rig.cylinder.A_B))
    # without areas that differ nothing is told, and a whole rig that was stated is believed
    assert not is_open(press(0.0, seed=1), unstated_rig())
    assert not is_open(press(0.0, seed=1), rig)


def test_what_healthy_recordings_show_holds_for_later_ones() -> None:
    rig, _ = assumed_rig(stated_areas(), press(0.0, seed=1))
    closed = simulate(rig="single-rod-eha", command="2 sin(4t)", load="8 kN", duration="20 s", seed=1)
    assert is_open(replace(closed, provenance={}), rig)


def test_recordings_whose_piston_moves_one_way_tell_nothing() -> None:
    recording = press(0.0, seed=1)
    closing = recording.between(0.0, 2.5)
    rig = infer_rig(stated_areas(), [closing] * 100 + [recording])
    assert rig is not None and rig.circuit.feeds_one_chamber
    alone = infer_rig(stated_areas(), [closing])
    assert alone is not None and not alone.circuit.feeds_one_chamber


@pytest.mark.parametrize(("flow", "idle"), [(0.05, 0.0), (0.3, 0.0), (0.3, 1.0)])
def test_a_leak_is_sized_by_the_creep_of_the_side_that_carries_the_load(flow: float, idle: float) -> None:
    """`flow` [L/min] at the mean pressure difference, of some 10 L/min pumped; a pump that idles shows no leak."""
    reference = press(0.0, seed=9)
    unit_flow = float(np.mean(np.abs(reference["p_A"] - reference["p_B"]))) / LPM  # [L/min] of 1 m^3/(s Pa)
    healthy_conductances = [1e-14 * (1 + seed % 3) for seed in range(1, 6)]
    healthy = [press(conductance, seed, idle) for seed, conductance in enumerate(healthy_conductances, start=1)]
    conductance = float(np.mean(healthy_conductances)) + flow / unit_flow
    diagnosis = diagnose(press(conductance, seed=8, idle=idle), rig=stated_areas(), baseline=healthy)
    assert diagnosis.verdict == "leak"
    assert diagnosis.leak_lpm == pytest.approx(flow, rel=0.15)
    low, high = diagnosis.leak_interval_lpm
    assert low < flow < high
    assert diagnose(press(2e-14, seed=7, idle=idle), rig=stated_areas(), baseline=healthy).verdict == "no leak"
