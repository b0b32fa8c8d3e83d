"""A load that valves hold and whose flow nobody records: it creeps by what leaks, and healthy days show that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import CommissionedMachine
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

RATE, SECONDS, AREA_A, AREA_B = 50.0, 120.0, 3600e-6, 2700e-6
#: Conductance of the holding valves of the healthy machine, and of a worn piston [m^3/(s Pa)].
VALVES, WORN = 5e-13, 3e-12
#: Positions [m] between which the boom moves for 3 s; it is held for 9 s at each.
STATIONS = (0.1, 0.4, 0.6, 0.3, 0.5, 0.2, 0.45, 0.25, 0.55, 0.15, 0.4)


def record_boom(
    seed: int, leak: float = 0.0, since: float = 0.0, *, is_held: bool = False, compliance: float = 0.0
) -> Recording:
    """Record chamber pressures and position of a boom under its load, which creeps in its holds.

    A_A dx/dt = -(G_valves + G_leak) (p_A - p_B) - C dp_A/dt while it is held. With `is_held`, a control loop holds it
    instead. With a `compliance` C [m^3/Pa], p_A and p_B also rise by 2 bar/s in the holds.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * RATE)) / RATE
    load = 3e6 * random.uniform(0.8, 1.2) + 4e5 * np.sin(2.0 * np.pi * t / random.uniform(7.0, 11.0))
    step, phase = (t // 12.0).astype(int), t % 12.0
    begin, end = np.array(STATIONS)[step], np.array(STATIONS)[step + 1]
    is_moving = phase < 3.0
    path = np.where(is_moving, begin + (end - begin) * (1.0 - np.cos(np.pi * phase / 3.0)) / 2.0, end)
    conductance = VALVES * random.uniform(0.8, 1.25) + np.where(t >= since, leak, 0.0)
    rise = np.where(is_moving, 0.0, 2e5 * (phase - 3.0)) if compliance else np.zeros(t.size)
    lost_flow = conductance * load + compliance * np.gradient(load + rise, t)
    creep = np.where(is_moving | is_held, 0.0, -lost_flow / AREA_A)
    x = path + np.cumsum(creep) / RATE + 2e-6 * random.standard_normal(t.size)
    p_B = 2e6 + rise + 1e4 * random.standard_normal(t.size)
    channels = {"p_A": p_B + load + 1e4 * random.standard_normal(t.size), "p_B": p_B, "x": x}
    return Recording(t, channels, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE)


def add_joystick(recording: Recording, seed: int) -> Recording:
    """Add the voltage of the joystick that moves the boom: it has a dead band, and the speed falls with the load.

    Dead band, noise and the pressure before the valve are drawn at random.
    """
    random = np.random.default_rng([seed, 1])
    phase = recording.t % 12.0
    speed = np.where(phase < 3.0, np.gradient(recording["x"], recording.t), 0.0)
    supply = random.uniform(8e6, 12e6)
    drop = np.where(speed > 0.0, supply - recording["p_A"], recording["p_A"])
    opening = speed / 0.16 * np.sqrt(0.5 * supply / drop)
    u = np.where(phase < 3.0, random.uniform(0.2, 1.0) * np.sign(speed), 0.0) + 8.0 * opening
    u += random.choice([0.0, 0.01, 0.03]) * random.standard_normal(u.size)
    return replace(recording, channels={**recording.channels, "u": u}, units={**recording.units, "u": "V"})


def commission(
    folder: Path, count: int = 5, *, is_held: bool = False, compliance: float = 0.0, has_joystick: bool = False
) -> CommissionedMachine:
    """Commission the boom from healthy recordings, with its piston areas stated."""
    for seed in range(count):
        recording = record_boom(seed, is_held=is_held, compliance=compliance)
        ss.write(add_joystick(recording, seed) if has_joystick else recording, folder / f"healthy-{seed}.nc")
    rig = unstated_rig().with_areas(AREA_A, AREA_B, source="data sheet")
    return ss.commission(folder, rig=rig)


@pytest.fixture(scope="module")
def boom(tmp_path_factory: pytest.TempPathFactory) -> CommissionedMachine:
    return commission(tmp_path_factory.mktemp("boom"))


def flow_lpm(recording: Recording, conductance: float) -> float:
    """Mean flow of a leak of `conductance` [m^3/(s Pa)] under the recorded pressures [L/min]."""
    return conductance * float(np.mean(recording["p_A"] - recording["p_B"])) / LITRE_PER_MINUTE


def test_a_worn_piston_shows_in_the_creep_of_the_held_load(boom: CommissionedMachine) -> None:
    recording = record_boom(20, WORN)
    diagnosis = boom.diagnose(recording)
    assert (diagnosis.verdict, diagnosis.cause) == ("leak", "piston or external leak")
    assert diagnosis.leak_interval_lpm is not None
    low, high = diagnosis.leak_interval_lpm
    assert low < flow_lpm(recording, WORN) < high < 1.5 * flow_lpm(recording, WORN)


def test_oil_that_rising_pressures_compress_is_no_leak(tmp_path: Path) -> None:
    """1.5 L of oil under a pressure that rises by 2 bar/s take as much as a leak of 0.015 L/min."""
    compliance = 1.5e-3 / 1.2e9
    boom = commission(tmp_path, compliance=compliance)
    assert boom.diagnose(record_boom(25, compliance=compliance)).summary == "no leak"
    recording = record_boom(26, WORN, compliance=compliance)
    diagnosis = boom.diagnose(recording)
    assert diagnosis.verdict == "leak"
    assert diagnosis.leak_lpm == pytest.approx(flow_lpm(recording, WORN), rel=0.15)
    assert diagnosis.leak_interval_lpm is not None
    assert diagnosis.leak_interval_lpm[0] < flow_lpm(recording, WORN) < diagnosis.leak_interval_lpm[1]


def test_a_leak_that_begins_in_a_hold_is_dated(boom: CommissionedMachine) -> None:
    diagnosis = boom.diagnose(record_boom(21, WORN, since=66.0))
    assert diagnosis.verdict == "leak"
    assert diagnosis.onset_interval_s is not None
    assert diagnosis.onset_interval_s[0] <= 66.0 <= diagnosis.onset_interval_s[1]


def test_a_healthy_boom_has_no_leak_and_a_bound_in_the_scale_of_its_areas(boom: CommissionedMachine) -> None:
    recording = record_boom(22)
    diagnosis = boom.diagnose(recording)
    assert diagnosis.summary == "no leak"
    assert diagnosis.bound_lpm is not None
    assert diagnosis.bound_lpm < flow_lpm(recording, VALVES)


@pytest.mark.slow
def test_nothing_is_said_where_a_loop_may_hold_the_load(tmp_path: Path, boom: CommissionedMachine) -> None:
    """A loop replaces what leaks, so that even a torn seal moves nothing; nor does one recording tell valves."""
    held = commission(tmp_path, 3, is_held=True)
    assert held.diagnose(record_boom(23, WORN, is_held=True)).verdict == "cannot tell"
    assert boom.rig is not None
    assert ss.diagnose(record_boom(24, WORN), rig=boom.rig).verdict == "cannot tell"


def test_a_joystick_leaves_the_creep_to_show_the_leak(tmp_path: Path) -> None:
    """A valve's command is no flow of a pump: the holds show the leak as closely as without it."""
    boom = commission(tmp_path, has_joystick=True)
    healthy = boom.diagnose(add_joystick(record_boom(22), 22))
    assert healthy.summary == "no leak"
    assert healthy.bound_lpm is not None
    assert healthy.bound_lpm < flow_lpm(record_boom(22), VALVES)
    recording = record_boom(20, WORN)
    diagnosis = boom.diagnose(add_joystick(recording, 20))
    assert (diagnosis.verdict, diagnosis.cause) == ("leak", "piston or external leak")
    assert diagnosis.leak_interval_lpm is not None
    assert diagnosis.leak_interval_lpm[0] < flow_lpm(recording, WORN) < diagnosis.leak_interval_lpm[1]


@pytest.mark.slow
def test_a_joystick_tells_no_creep_where_a_loop_holds_the_load(tmp_path: Path) -> None:
    held = commission(tmp_path, 3, is_held=True, has_joystick=True)
    for seed in (23, 24):
        diagnosis = held.diagnose(add_joystick(record_boom(seed, is_held=True), seed))
        assert diagnosis.verdict != "leak"
        assert diagnosis.bound_lpm is None or diagnosis.bound_lpm > flow_lpm(record_boom(seed), WORN)
