"""Does oil leave the circuit? What an accumulator that makes it up has given off, block by block of whole cycles.

Its gas expands, V dp/(n p) at its charge, as oil is lost, as the rod leaves, and as it warms. With p the pressure of
the side that does not carry, what has been given off by the middle of block k is

    y_k = -V p_k/(n p_charge) - (A_A - A_B) x_k = y_0 + sum_j g_j P_j tau (1 or 1/2) + w t + v t^2 + noise,

with the conductance g_j to the outside, P_j the pressure that drives it, w and v the warmth that is believed
(`priors.toml`). A level is known to the noise of a mean: its changes tell what 5 s of rates do not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.balance import whole_samples
from sealscope.diagnosis.inference.onset import FEWEST, Information, StepTest, step_test
from sealscope.diagnosis.inference.terms import Signals
from sealscope.diagnosis.priors import priors
from sealscope.recordings.cycle import cycle_of, fundamental
from sealscope.recordings.recording import Array, Recording
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def cycle_length(speed: Array, rate: float) -> float | None:
    """Return the duration of a stroke to and fro [s], or of the strongest line of the speed; None without one."""
    cycle, seconds = cycle_of(speed, rate), speed.size / rate
    if cycle is None:
        spectrum = np.abs(np.fft.rfft((speed - speed.mean()) * np.hanning(speed.size)))
        line = int(spectrum.argmax())
        if line < FEWEST:
            return None
        cycle = seconds / line
    return 1.0 / fundamental(speed, np.arange(speed.size) / rate, cycle)


def lost_beside(recording: Recording, rig: Rig, zero: float) -> dict[str, StepTest]:
    """Return `lost_oil` of a recording with a position; `zero`: what p_A - p_B reads too much [Pa].

    Empty but for a single rod: behind the check valves of a double rod's circuit either side may keep its own pressure.
    """
    if rig.makeup.check_valves == "absent" or not rig.cylinder.single_rod:
        return {}
    samples = whole_samples(recording, ("x", "p_A", "p_B"))
    signals = Signals(samples, recording.rate, {}, zero)
    moved = signals.step("x")
    cycle = cycle_length(np.where(np.isfinite(moved), moved, 0.0) * recording.rate, recording.rate)
    return lost_oil(signals, rig, cycle, float(recording.t[0]))


def lost_oil(signals: Signals, rig: Rig, cycle: float | None, begin: float) -> dict[str, StepTest]:
    """Return the tests of a step of the external leak of either side, by the term's name, empty without an accumulator.

    Parameters
    ----------
    signals : Signals
        Samples of both pressures and, where it is recorded, of the position; NaN where missing.
    rig : Rig
        The assumed machine.
    cycle : float or None
        Duration of a cycle of the duty [s].
    begin : float
        Time of the first sample [s].
    """
    if rig.makeup.check_valves == "absent":
        return {}
    unit = 1.0 / signals.rate if cycle is None else cycle
    seconds = len(signals.time_step) / signals.rate
    length = unit * max(1, round(seconds / (priors("inference")["blocks"]["coarse"] * unit)))
    ends = np.round(np.arange(int(seconds / length) + 1) * length * signals.rate).astype(int)
    if len(ends) <= FEWEST:
        return {}
    idle = np.where(signals.carried_by_A > 0.0, signals["p_B"], signals["p_A"])
    compliance = rig.makeup.V_gas / (rig.makeup.n_gas * (rig.fluid.p_charge + P_ATM))
    volume = -compliance * idle
    if "x" in signals:
        volume = volume - (rig.cylinder.A_A - rig.cylinder.A_B) * signals["x"]
    level = _means(volume, ends)
    tests = {}
    for side in "AB":
        pressure = _means(signals[f"p_{side}"], ends)
        if np.isfinite(level).all() and np.isfinite(pressure).all():
            tests[f"external leak {side}"] = step_test(_information(level, pressure, length, begin))
    return {name: test for name, test in tests.items() if test is not None}


def _means(values: Array, ends: Array) -> Array:
    known = np.isfinite(values)
    sums, counts = (
        np.concatenate([[0.0], np.cumsum(series)])[ends] for series in (np.where(known, values, 0.0), known)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.diff(sums) / np.diff(counts))


def _information(level: Array, pressure: Array, length: float, begin: float) -> Information:
    """Estimate the conductance to the outside from the levels (K,) [m^3], driven by `pressure` (K,) [Pa]."""
    count = len(level)
    time = (np.arange(count) + 0.5) * length
    flows = (np.tril(np.ones((count, count)), -1) + 0.5 * np.eye(count)) * pressure * length
    noise = float(np.mean(np.diff(level, 2) ** 2)) / 6.0
    warmth = priors("inference")["level"]["gas"] * np.column_stack([time, time**2 / time[-1]])
    weight = np.linalg.inv(max(noise, np.finfo(float).tiny) * np.eye(count) + warmth @ warmth.T)
    weight -= np.outer(weight.sum(axis=0), weight.sum(axis=1)) / weight.sum()
    healthy = priors("inference")["healthy"]["outside"]
    precision, vector = flows.T @ weight @ flows, flows.T @ weight @ level
    return Information(np.asarray(begin + time, dtype=float), 0.5 * (precision + precision.T), vector, healthy, healthy)
