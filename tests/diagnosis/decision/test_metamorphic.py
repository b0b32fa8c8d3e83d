"""What an instrument or an operator adds to a recording changes no verdict: leaks stay leaks, healthy ones healthy.

A leaking record of each machine is changed by a step of noise, hum, a zero, a pause, a ramp, another rate or healthy
recordings beside it: verdict, size and onset stay. The healthy record of the same machine, changed alike, is no alarm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.recordings.recording import Recording
from sealscope.simulation.commands import sampled_signal

from ...representatives import few
from ..balance_machine import machine, step

SECONDS, ONSET = 40.0, 20.0
Array = np.ndarray
Envelope = Callable[[Array], Array]


class Machine(NamedTuple):
    """A machine: its rig, the amplitude [V] and angular frequency [rad/s] of its duty, and its leak."""

    rig: str
    amplitude: float
    omega: float
    leak: str


#: The packaged rigs; "by the balance" is made of the balance alone.
MACHINES = {
    "thesis": Machine("thesis", 3.0, 4.0, "0.02 L/min"),
    "thesis, slow": Machine("thesis", 5.0, 2.0, "0.02 L/min"),
    "closed loop": Machine("thesis-closed-loop", 3.0, 4.0, "0.02 L/min"),
    "calibrated": Machine("thesis-calibrated", 3.0, 4.0, "0.02 L/min"),
    "single rod": Machine("single-rod-eha", 2.0, 6.0, "0.1 L/min"),
    "servo valve": Machine("servo-valve", 2.0, 4.0, "0.2 L/min"),
}
BY_BALANCE = "by the balance"


def always(t: Array) -> Array:
    return np.ones_like(t)


def paused(t: Array) -> Array:
    """Rest for six seconds, well before the leak."""
    return 1.0 - np.clip(np.minimum(t - 8.0, 14.0 - t) / 0.2, 0.0, 1.0)


def ramped(t: Array) -> Array:
    """Ramp in over three seconds."""
    return np.clip(t / 3.0, 0.0, 1.0)


@cache
def record(name: str, leaks: bool, seed: int, envelope: Envelope = always) -> Recording:
    """Record a machine under its duty times an envelope."""
    if name == BY_BALANCE:
        G = step(0.0, 2e-12, ONSET) if leaks else 0.0
        return machine(seed, G=G, speed=lambda t: 12.0 * envelope(t) * np.sin(4.0 * t), duration=SECONDS)
    own = MACHINES[name]
    t = np.arange(0.0, SECONDS + 0.1, 0.002)
    command = sampled_signal(t, own.amplitude * envelope(t) * np.sin(own.omega * t))
    leak = f"{own.leak} from {ONSET:g} s" if leaks else ()
    return ss.simulate(rig=own.rig, command=command, leak=leak, duration=SECONDS, seed=seed)


def with_pressures(recording: Recording, change: Callable[[Array, Array], Array]) -> Recording:
    """Change p_A and p_B, each by a function of the time and itself."""
    changed = {name: change(recording.t, recording[name]) for name in ("p_A", "p_B")}
    return replace(recording, channels={**recording.channels, **changed})


def add_noise(recording: Recording) -> Recording:
    """Add noise from 12 s on that makes the recorded one's deviation 1.5 times as large."""
    random = np.random.default_rng(7)

    def louder(t: Array, p: Array) -> Array:
        noise = float(np.median(np.abs(np.diff(p, 4)))) / 0.6745 / np.sqrt(70.0)
        return p + np.where(t > 12.0, 1.1 * noise, 0.0) * random.standard_normal(p.size)

    return with_pressures(recording, louder)


def add_hum(recording: Recording) -> Recording:
    return with_pressures(recording, lambda t, p: p + np.where(t > 12.0, 5e3, 0.0) * np.sin(2.0 * np.pi * 50.0 * t))


def shift_zero(recording: Recording) -> Recording:
    """Read p_B six bar too high, throughout."""
    return replace(recording, channels={**recording.channels, "p_B": recording["p_B"] + 6e5})


def resample(recording: Recording) -> Recording:
    """Read every channel at 0.62 of the rate, between samples by a straight line."""
    t = np.arange(0.0, recording.t[-1], 1.0 / (0.62 * recording.rate))
    channels = {name: np.interp(t, recording.t, values) for name, values in recording.channels.items()}
    return replace(recording, t=t, channels=channels, rate=0.62 * recording.rate)


#: What is done to a recording, or to its duty.
CHANGES: dict[str, Callable[[Recording], Recording]] = {
    "noise": add_noise,
    "hum": add_hum,
    "zero": shift_zero,
    "resampling": resample,
}
DUTIES: dict[str, Envelope] = {"pause": paused, "ramp": ramped}
HEALTHY = ("one healthy recording", "two healthy recordings")
KINDS = (*CHANGES, *DUTIES, *HEALTHY)


@cache
def judge(name: str, leaks: bool, kind: str = "") -> Diagnosis:
    """Judge a machine's record as it is, or changed."""
    recording = record(name, leaks, 1, DUTIES.get(kind, always))
    recording = CHANGES.get(kind, lambda plain: plain)(recording)
    baseline = [record(name, False, 11 + k) for k in range(1 + HEALTHY.index(kind))] if kind in HEALTHY else []
    return diagnose(recording, baseline, rig="thesis" if name == BY_BALANCE else MACHINES[name].rig)


def check_leak(name: str, kind: str) -> None:
    plain, changed = judge(name, True), judge(name, True, kind)
    assert plain.verdict == "leak", plain.reason
    assert changed.verdict == "leak", changed.reason
    assert changed.onset_s == pytest.approx(ONSET, abs=2.0)
    if plain.leak_interval_lpm is not None:
        assert changed.leak_interval_lpm is not None
        assert changed.leak_lpm == pytest.approx(plain.leak_lpm, rel=0.15)


def check_healthy(name: str, kind: str) -> None:
    changed = judge(name, False, kind)
    assert changed.verdict != "leak", changed.reason


@pytest.mark.parametrize("kind", few(KINDS, 1))
def test_a_leak_of_a_machine_by_the_balance_stays(kind: str, two_methods: None) -> None:
    check_leak(BY_BALANCE, kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", few(KINDS, 1))
def test_a_healthy_machine_by_the_balance_stays_healthy(kind: str, two_methods: None) -> None:
    check_healthy(BY_BALANCE, kind)


#: Machines that differ from the first by their duty or their numbers alone take long.
EACH = [
    pytest.param(name, marks=pytest.mark.long) if name in ("thesis, slow", "closed loop", "calibrated") else name
    for name in MACHINES
]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", EACH)
def test_a_leak_stays(name: str, kind: str) -> None:
    check_leak(name, kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", EACH)
def test_a_healthy_machine_stays_healthy(name: str, kind: str) -> None:
    check_healthy(name, kind)
