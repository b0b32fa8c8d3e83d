"""A machine made of nothing but the balance of volumes, with known truth: for the checks of the volume balance.

The pump turns as told, friction makes the pressure difference, the piston goes where the oil pushes it. Not the
simulator's equations: friction is a rounded sign, nothing rings, and drifts, loads and sensors are given by hand.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sealscope.recordings.recording import CHANNEL_UNITS, Recording

AREA = 633e-6
DISPLACEMENT = 4.9e-6 / (2.0 * np.pi)
STORED = 1.7e-13
Profile = Callable[[np.ndarray], np.ndarray]


def at(profile: Profile | float, t: np.ndarray) -> np.ndarray:
    return profile(t) if callable(profile) else np.full_like(t, profile)


def step(before: float, after: float, at: float = 60.0) -> Profile:
    return lambda t: np.where(t < at, before, after)


def machine(
    seed: int = 0,
    *,
    G: Profile | float = 0.0,
    C: Profile | float = 0.0,
    G_pump: Profile | float = 2.4e-13,
    ratio: float = 1.0,
    speed: Profile = lambda t: 12.0 * np.sin(4.0 * t),
    load: Profile | float = 0.0,
    drop: float = 0.0,
    duration: float = 120.0,
    rate: float = 200.0,
    p_noise: float = 8000.0,
    bias: float = 10e3,
    x_step: float = 20e-6,
) -> Recording:
    """Record a machine: `G`, `C` of the piston, `G_pump` over time; `ratio`: true displacement over area, as a share of
    the assumed one; `speed` [rad/s]; `load` [Pa]; `drop`: what a throttle takes at full speed, as a share of the
    chambers' difference; it goes with the square of the speed."""
    random = np.random.default_rng(seed)
    inner = 10
    t = np.arange(round(duration * rate * inner)) / (rate * inner)
    dt = t[1]
    omega = speed(t)
    top = max(float(np.abs(omega).max()), 1e-9)
    dp = 1.0e5 * np.tanh(omega / (0.05 * top)) + 2.0e4 * omega / top + at(load, t)
    dp_12 = dp * (1.0 + drop * (omega / top) ** 2)
    leak = at(G, t) * dp + at(C, t) * np.sign(dp) * np.sqrt(np.abs(dp)) + at(G_pump, t) * dp_12
    theta = np.cumsum(omega) * dt
    x = (ratio * DISPLACEMENT * theta - np.cumsum(leak) * dt - STORED * dp) / AREA
    chosen = slice(None, None, inner)
    t, theta, x, dp, dp_12 = t[chosen], theta[chosen], x[chosen], dp[chosen], dp_12[chosen]

    def gauge(p: np.ndarray) -> np.ndarray:
        return 3.0e5 + p + bias * random.uniform(-1, 1) + p_noise * random.standard_normal(t.size)

    channels = {
        "u": speed(t) / 10.0,
        "theta": np.floor(theta / (2 * np.pi / 20000)) * (2 * np.pi / 20000),
        "x": np.floor(x / x_step) * x_step if x_step else x,
        "p_A": gauge(0.5 * dp),
        "p_B": gauge(-0.5 * dp),
        "p_1": gauge(0.5 * dp_12),
        "p_2": gauge(-0.5 * dp_12),
    }
    return Recording(t, channels, {name: CHANNEL_UNITS[name] for name in channels}, rate)


def irregular(seed: int) -> Profile:
    """A speed that never repeats: a smoothed random signal."""
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.5, 6.0, 12), random.uniform(0, 2 * np.pi, 12)

    def speed(t: np.ndarray) -> np.ndarray:
        return np.asarray(5.0 * np.sin(np.outer(t, frequency) + phase).sum(axis=1))

    return speed
