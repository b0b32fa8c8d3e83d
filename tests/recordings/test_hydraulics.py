"""Readings of every hydraulic machine pass, leaking or not; noise, copies and a wrong unit of the time are named."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.recordings import CHANNEL_UNITS, Recording, read
from sealscope.recordings.quality import find_implausibility

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
RATE, N = 500.0, 60_000
RANDOM = np.random.default_rng(0)


def machine(seed: int = 0, period: float = 1.6, noise: float = 8e3) -> Recording:
    """A duty against friction, with noise; `period` [s] of its strokes."""
    random, t = np.random.default_rng(seed), np.arange(N) / RATE
    angle = 2 * np.pi * t / period
    swing = 5e4 * np.tanh(6 * np.cos(angle))
    channels = {
        "u": 3 * np.cos(angle),
        "p_A": 3e5 + swing + noise * random.standard_normal(N),
        "p_B": 3e5 - swing + noise * random.standard_normal(N),
        "theta": 20 * np.sin(angle),
        "omega": 20 * 2 * np.pi / period * np.cos(angle),
        "x": 0.02 * np.sin(angle),
    }
    return Recording(t, channels, CHANNEL_UNITS, RATE)


def put(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, **channels})


def slower(recording: Recording, factor: float) -> Recording:
    return replace(recording, t=recording.t * factor, rate=recording.rate / factor)


@pytest.mark.parametrize("names", [("u", "p_A", "p_B"), ("p_A", "p_B"), ("p_A",), None])
@pytest.mark.parametrize(
    "recording",
    [
        machine(),
        machine(period=12.0),
        machine(noise=1e2),
        machine(noise=3e4),
        slower(machine(period=12.0), 25.0).only(["u", "x", "p_A", "p_B"]),
        put(machine(), x=np.full(N, 0.1)),
        put(machine(), u=np.zeros(N)),
        machine().samples(slice(0, 500)),
    ],
    ids=["machine", "slow", "quiet", "noisy", "at 20 Hz", "no position", "no command", "1 s"],
)
def test_a_machine_passes(recording: Recording, names: tuple[str, ...] | None) -> None:
    assert find_implausibility(recording if names is None else recording.only(names)) is None


@pytest.mark.parametrize("rests", ["p_A", "p_B"])
def test_one_chamber_may_rest_at_the_charge_pressure(rests: str) -> None:
    recording = machine()
    assert (
        find_implausibility(put(recording, **{rests: 5e5 + 2e3 * np.random.default_rng(2).standard_normal(N)})) is None
    )


def under_load(recording: Recording, swing: float, omega: float) -> Recording:
    """A load that swings at `omega` [rad/s] in a closed loop: pressures of +-`swing` [Pa] beside those of friction."""
    pushed = swing * np.sin(omega * recording.t)
    return put(recording, p_A=1e6 + recording["p_A"] + pushed, p_B=1e6 + recording["p_B"] - pushed)


@pytest.mark.parametrize("names", [("u", "p_A", "p_B"), ("x", "p_A", "p_B"), None])
@pytest.mark.parametrize(("swing", "omega", "period"), [(8e5, 0.3, 3.1), (1e6, 2.0, 4.0), (9e5, 1.3, 6.3)])
def test_a_machine_under_a_load_that_swings_passes(
    swing: float, omega: float, period: float, names: tuple[str, ...] | None
) -> None:
    recording = under_load(machine(period=period), swing, omega)
    assert find_implausibility(recording if names is None else recording.only(names)) is None


def test_a_constant_load_is_a_signal() -> None:
    """Pressures that hold a load vary less than their sensors' noise; their difference is not zero."""
    noise = 5e4 * np.random.default_rng(7).standard_normal((2, N))
    recording = machine()
    held = put(recording, p_A=3e6 + noise[0] + 2e3 * np.sin(recording.t), p_B=4e5 + noise[1])
    assert find_implausibility(held) is None


GARBAGE: dict[str, tuple[Callable[[Recording], Recording], str]] = {
    "noise": (lambda r: put(r, p_A=3e5 + 5e4 * RANDOM.standard_normal(N)), "p_A - p_B is noise"),
    "one chamber of noise": (lambda r: put(r, p_A=3e5 + RANDOM.standard_normal(N)).only(["u", "p_A"]), "p_A is noise"),
    "noisy copy": (lambda r: put(r, p_B=r["p_A"] + 4e3 * RANDOM.standard_normal(N)), "p_A - p_B is noise"),
    "copy": (lambda r: put(r, p_B=r["p_A"]), "p_B is a copy of p_A"),
    "ms labelled s": (lambda r: slower(r, 1e3), "the speed is 1e+03 times that at which the angle turns"),
}


@pytest.mark.parametrize("kind", GARBAGE)
def test_what_no_machine_reads_is_named(kind: str) -> None:
    make, reason = GARBAGE[kind]
    assert reason in (find_implausibility(make(machine())) or "")


@pytest.mark.parametrize("every", [12, pytest.param(1, marks=[pytest.mark.slow, pytest.mark.long])])
def test_real_rotary_strokes_pass(every: int) -> None:
    files = sorted((REAL / "vtnsi_actuator").glob("act_*/*.txt"))
    if not files:
        pytest.skip("the real recordings are not here")
    for path in files[::every]:
        assert find_implausibility(read(path, map={"p_A": "PG_1", "p_B": "PG_2"}, rate=1000)) is None


def test_pressures_of_one_circuit_of_a_real_test_rig_pass() -> None:
    """PS1 to PS3 lie in the rig's working circuit; 10 cycles of 60 s at 100 Hz."""
    path = REAL / "zema_hydraulic" / "fullrate_10cycles" / "testing_sample.csv"
    if not path.is_file():
        pytest.skip("the real recordings are not here")
    with path.open(encoding="utf-8") as file:
        head, *cycles = csv.reader(file)
    columns = {name: [k for k, own in enumerate(head) if own.startswith(f"{name}_")] for name in ("PS1", "PS2", "PS3")}
    for cycle in cycles:
        bar = {name: np.array([float(cycle[k]) for k in own]) for name, own in columns.items()}
        for p_A, p_B in (("PS1", "PS2"), ("PS2", "PS3"), ("PS3", "PS1")):
            channels = {"p_A": 1e5 * bar[p_A], "p_B": 1e5 * bar[p_B]}
            recording = Recording(np.arange(6000) / 100.0, channels, CHANNEL_UNITS, 100.0)
            assert find_implausibility(recording) is None
