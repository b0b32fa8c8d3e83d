"""A pump-controlled single-rod cylinder made of nothing but volumes and forces, with known truth.

The pump feeds the side that carries the load, whose area the piston displaces; what the other side takes or gives more
comes through a pilot-operated check valve from the charge line. At a stop the pump turns on against a relief valve.
"""

from __future__ import annotations

import numpy as np

from sealscope.recordings.recording import CHANNEL_UNITS, Recording

A_A, A_B = 1256e-6, 1056e-6
DISPLACEMENT = 10.0e-6 / (2.0 * np.pi)
CHARGE, RELIEF, FRICTION = 5.0e5, 1.2e7, 1800.0
STORED = 2.0e-13


def strokes(t: np.ndarray, *, period: float = 8.0, top: float = 60.0, rest: float = 0.2) -> np.ndarray:
    """Return a pump speed [rad/s] out and back with rounded corners, at rest for a share of the time after each."""
    phase = (t / period) % 1.0
    move = 0.5 * (1.0 - rest)
    out = np.clip(np.minimum(phase, move - phase) / 0.05, 0.0, 1.0)
    # the smaller side needs less oil for the same way back
    back = np.clip(np.minimum(phase - 0.5, 0.5 + move - phase) / 0.05, 0.0, 1.0)
    return np.asarray(top * (np.maximum(out, 0.0) - A_B / A_A * np.maximum(back, 0.0)))


def single_rod(
    seed: int = 0,
    *,
    G: float = 2.0e-12,
    rise: float = 0.0,
    onset: float = 120.0,
    load: float = 0.0,
    rest: float = 0.2,
    stop: float = np.inf,
    duration: float = 240.0,
    rate: float = 200.0,
    p_noise: float = 2.0e4,
) -> tuple[Recording, float]:
    """Record a machine: `G` [m^3/(s Pa)] of pump and piston, `rise` of it from `onset` [s] on; constant `load` [N];
    `stop` [m]: where the piston's way out ends. Also returns the mean flow [L/min] of the rise while it is open."""
    random = np.random.default_rng(seed)
    inner = 5
    dt = 1.0 / (rate * inner)
    t = np.arange(round(duration * rate * inner)) * dt
    omega = strokes(t, rest=rest) * (1.0 + 0.1 * np.sin(0.37 * t))
    direction = np.tanh(omega / 1.0)
    force = FRICTION * direction * (1.0 + 0.3 * np.abs(omega) / 60.0) + load
    on_A = force > CHARGE * (A_A - A_B)
    p_A = np.where(on_A, (force + CHARGE * A_B) / A_A, CHARGE)
    p_B = np.where(on_A, CHARGE, (CHARGE * A_A - force) / A_B)
    area = np.where(on_A, A_A, A_B)
    conductance = G + np.where(t >= onset, rise, 0.0)
    volume_rate = DISPLACEMENT * omega - conductance * (p_A - p_B)
    x = np.empty(t.size)
    at = 0.0
    for k, step in enumerate((volume_rate * dt / area).tolist()):
        at = min(at + step, stop)
        x[k] = at
    pressed = (x >= stop) & (omega > 0.0)
    p_A = np.where(pressed, RELIEF, p_A)
    x = x - STORED * (p_A - p_B) / area
    keep = slice(None, None, inner)
    theta = np.cumsum(omega) * dt
    channels = {
        "u": omega[keep] / 10.0,
        "theta": np.floor(theta[keep] / 1e-3) * 1e-3,
        "x": np.floor(x[keep] / 1e-5) * 1e-5,
        "p_A": p_A[keep] + p_noise * random.standard_normal(t[keep].size),
        "p_B": p_B[keep] + p_noise * random.standard_normal(t[keep].size),
    }
    after = (t >= onset) & ~pressed
    lpm = rise * float(np.mean(np.abs(p_A - p_B)[after])) * 6e4
    return Recording(t[keep], channels, {name: CHANNEL_UNITS[name] for name in channels}, rate), lpm
