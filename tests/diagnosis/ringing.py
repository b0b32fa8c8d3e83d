"""Recordings whose ringing is known in closed form: p_A - p_B sticks, ramps, breaks away and rings, without a rig."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.pressures.ring_down import Machine
from sealscope.parameters import Rig
from sealscope.recordings.recording import Recording

RATE, PLATEAU, CHARGE = 500.0, 1e5, 3e5


class Ring(NamedTuple):
    """Frequency [Hz], damping at the start, its step at mid-record [1/s], amplitude and noise [Pa], command."""

    frequency: float
    damping: float
    step: float
    amplitude: float = 6e3
    noise: float = 8e3
    volts: float = 5.0
    turn: float = 4.0
    breakaway: float = 0.08


def recording_of(ring: Ring, rig: Rig, *, seconds: float = 60.0, seed: int = 0, mains: float = 0.0) -> Recording:
    """Return a recording of this ring after each reversal; `mains`: amplitude [Pa] of a line of 60.01 Hz on p_A."""
    t = np.arange(round(seconds * RATE)) / RATE
    u, machine = ring.volts * np.sin(ring.turn * t), Machine.of(rig)
    half = np.pi / ring.turn
    number = np.floor(t / half)
    tau, sense = t - number * half, 1.0 - 2.0 * (number % 2)
    sliding = np.clip(tau / ring.breakaway, 0.0, 1.0)
    ended = np.clip((half - tau) / ring.breakaway, 0.0, 1.0)
    slow = PLATEAU * (2.0 * sliding - 1.0) * (tau < 0.5 * half) + PLATEAU * (2.0 * ended - 1.0) * (tau >= 0.5 * half)
    slow = np.where(tau < 0.5 * half, slow, PLATEAU * (0.9 + 0.1 * ended))
    since = np.maximum(tau - ring.breakaway, 0.0)
    v = machine.speed * np.abs(u)
    stribeck = np.cumsum(np.exp(-machine.transition * v) * (tau > ring.breakaway)) / RATE
    begun = np.maximum.accumulate(np.where(tau <= ring.breakaway, stribeck, 0.0))
    damping = ring.damping + ring.step * (t >= 0.5 * seconds)
    decay = damping * since + machine.falling * (stribeck - begun)
    rings = ring.amplitude * np.exp(-decay) * np.cos(2.0 * np.pi * ring.frequency * since) * (tau > ring.breakaway)
    dp, random = sense * (slow + rings), np.random.default_rng(seed)
    hum = mains * np.sin(2.0 * np.pi * 60.01 * t)
    pressures = {
        "p_A": CHARGE + 0.5 * dp + hum + random.normal(0.0, ring.noise / np.sqrt(2.0), t.size),
        "p_B": CHARGE - 0.5 * dp + random.normal(0.0, ring.noise / np.sqrt(2.0), t.size),
    }
    return Recording(t, {"u": u, **pressures}, {"u": "V", "p_A": "Pa", "p_B": "Pa"}, RATE)


def step_of(information: Information, onset: float) -> tuple[float, float]:
    """Return the step of g at a known onset [s] beside its level, by least squares, and its standard deviation."""
    basis = np.column_stack([np.ones(len(information.time)), information.time > onset])
    covariance = np.linalg.inv(basis.T @ information.precision @ basis)
    return float((covariance @ basis.T @ information.vector)[1]), float(np.sqrt(covariance[1, 1]))
