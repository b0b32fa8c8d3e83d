"""External leakage, from the volume of an accumulator that replaces the lost oil, in blocks of whole cycles.

The gas of the accumulator (volume V and polytropic exponent n at the absolute charge pressure) expands by V dp/(n p)
when oil is lost, when the rod extends, and when it warms. With the pressure p of the unloaded side, the position x and
the piston's areas A_A and A_B, the volume delivered by the middle of block k is

    y_k = -V p_k/(n p_charge) - (A_A - A_B) x_k = y_0 + sum_j g_j P_j tau (1 or 1/2) + w t + v t^2 + noise,

where g_j is the conductance to the outside in block j, P_j the pressure that drives the leak, and tau the length of a
block (1/2 applies to block k itself). w and v describe the gas temperature and have priors (`priors.toml`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.estimate.change import MIN_BLOCKS, Information, StepTest, step_test
from sealscope.diagnosis.inference.balance import samples_without_holes
from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.cycle import estimate_period, fundamental_frequency
from sealscope.recordings.recording import Array, Recording
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def cycle_length(speed: Array, rate: float) -> float | None:
    """Estimate the period of a machine's cycle [s], from its strokes or else the strongest line of a speed's spectrum.

    Return None for fewer than `MIN_BLOCKS` periods of that line, too few for a step test. `speed` (n,): speed or flow,
    without NaN; `rate` [Hz].
    """
    cycle = estimate_period(speed, rate)
    if cycle is None:
        spectrum = np.abs(np.fft.rfft((speed - speed.mean()) * np.hanning(speed.size)))
        n_periods = int(spectrum.argmax())  # periods in the recording
        if n_periods < MIN_BLOCKS:
            return None
        cycle = speed.size / rate / n_periods
    return 1.0 / fundamental_frequency(speed, np.arange(speed.size) / rate, cycle)  # refines the period


def recorded_oil_loss_tests(recording: Recording, rig: Rig, offset: float) -> dict[str, StepTest]:
    """Test a recording with a position for an external leak that begins within it (`oil_loss_tests`).

    `offset`: sensor offset of p_A - p_B [Pa]. Empty for a double rod: its strokes draw no oil from the accumulator, so
    the check valves may stay shut, and no chamber then has the pressure of the accumulator.
    """
    if not rig.cylinder.single_rod:
        return {}
    signals = Signals(samples_without_holes(recording, ("x", "p_A", "p_B")), recording.rate, offset=offset)
    x_step = signals.step("x")  # missing steps count as 0 in the search for the cycle
    cycle = cycle_length(np.where(np.isfinite(x_step), x_step, 0.0) * recording.rate, recording.rate)
    return oil_loss_tests(signals, rig, cycle, float(recording.t[0]))


def oil_loss_tests(signals: Signals, rig: Rig, cycle: float | None, begin: float) -> dict[str, StepTest]:
    """Test for an external leak of chamber A or B that begins within a recording, by the volume of the accumulator.

    The accumulator is connected to the unloaded side, whose pressure thus gives the oil that it has delivered, by the
    polytropic law of the gas; the oil that the rod displaces is subtracted if the position is recorded. The leak's
    conductance is tested for a step between blocks (`step_test`). Blocks are whole multiples of the machine's `cycle`
    [s], so that motion within it averages out, or of any length if it is None. `begin`: time of the first sample [s].

    The result maps "external leak A" and "external leak B" to their tests; a side that cannot be tested is left out. It
    is empty without an accumulator (`makeup.check_valves` = "absent") or for fewer than `MIN_BLOCKS` blocks.
    """
    if rig.makeup.check_valves == "absent":
        return {}
    unit_s = 1.0 / signals.rate if cycle is None else cycle  # a block is a multiple of this time
    duration = len(signals.time_step) / signals.rate
    block_s = unit_s * max(1, round(duration / (INFERENCE.blocks.coarse * unit_s)))  # about `blocks.coarse` blocks
    edges = np.round(np.arange(int(duration / block_s) + 1) * block_s * signals.rate).astype(int)
    if len(edges) <= MIN_BLOCKS:
        return {}
    unloaded_pressure = np.where(signals.carried_by_A > 0.0, signals["p_B"], signals["p_A"])
    # volume that the accumulator has delivered, up to a constant
    volume = -rig.makeup.V_gas / (rig.makeup.n_gas * (rig.fluid.p_charge + P_ATM)) * unloaded_pressure
    if "x" in signals:
        volume = volume - (rig.cylinder.A_A - rig.cylinder.A_B) * signals["x"]
    volumes = _block_means(volume, edges)
    tests = dict[str, StepTest]()
    for side in "AB":
        pressures = _block_means(signals[f"p_{side}"], edges)
        if np.isfinite(volumes + pressures).all():
            test = step_test(_estimate_conductance(volumes, pressures, block_s, begin))
            if test is not None:
                tests[f"external leak {side}"] = test
    return tests


def _block_means(values: Array, edges: Array) -> Array:
    """Average the known `values` (n,) over K blocks with the bounds `edges` (K + 1,); NaN for a block without any."""
    is_known = np.isfinite(values)
    sums, counts = (
        np.concatenate([[0.0], np.cumsum(series)])[edges] for series in (np.where(is_known, values, 0.0), is_known)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.diff(sums) / np.diff(counts))


def _estimate_conductance(volume: Array, pressure: Array, block_s: float, begin: float) -> Information:
    """Compute the likelihood of an external leak's conductance [m^3/(s Pa)] in K blocks of `block_s` [s].

    The initial volume and the effect of the gas temperature are eliminated. `volume` (K,): block means of the volume
    [m^3] that the accumulator has delivered so far, up to a constant; `pressure` (K,): block means of the pressure that
    drives the leak [Pa]; `begin`: start of the first block [s].
    """
    n_blocks = len(volume)
    time = (np.arange(n_blocks, dtype=float) + 0.5) * block_s
    # volume lost by the middle of each block (rows) with unit conductance in each (columns): half within the block
    losses = (np.tril(np.ones((n_blocks, n_blocks)), -1) + 0.5 * np.eye(n_blocks)) * pressure * block_s
    noise_variance = float(np.mean(np.diff(volume, 2) ** 2)) / 6.0  # a second difference has 6 times the variance
    # prior standard deviations of the linear and the quadratic change of the volume by the gas temperature
    gas_volume = INFERENCE.level.gas * np.column_stack([time, time**2 / time[-1]])
    # inverse covariance of the volumes, whose errors are noise and the effect of the gas temperature
    weight = np.linalg.inv(max(noise_variance, np.finfo(float).tiny) * np.eye(n_blocks) + gas_volume @ gas_volume.T)
    weight -= np.outer(weight.sum(axis=0), weight.sum(axis=1)) / weight.sum()  # eliminates the initial volume
    precision, vector = losses.T @ weight @ losses, losses.T @ weight @ volume
    healthy_deviation = INFERENCE.healthy.outside  # prior of the conductance in a healthy machine
    precision = 0.5 * (precision + precision.T)  # exactly symmetric
    return Information(begin + time, precision, vector, level=healthy_deviation, slope=healthy_deviation)
