"""Balances of recordings without position or without flow: over whole cycles, or while the piston is held.

A suitable test function removes the piston's displacement from the volume balance. A box of one cycle, convolved with
itself, has a double zero at every harmonic of the cycle. With this test function phi, a piston that a control loop
returns displaces nothing,

    integral of phi D dtheta = G integral of phi (p_A - p_B) dt + sum_j c_j integral of phi f_j dg_j,

so the pump delivers just the leakage. D is the pump's displacement per angle theta, G the leakage conductance, and c_j
are the coefficients of the other terms f_j dg_j. If the pump delivers less than any pump leaks, no loop replaces the
leakage, and the balance contains no information. While a loop holds the piston at standstill, any test function will
do. Rows of a single rod in which the loaded side changes have no weight, since the circuit then exchanges oil. If no
channel gives a flow, shut valves hold the piston, and the leakage of the loaded side moves it slowly. While the command
moves, the valve may replace the lost oil, and the samples do not count.

Oil that leaves is replaced by an accumulator. Its gas (volume V and polytropic exponent n at the absolute charge
pressure) expands by V dp/(n p) when oil is lost, when the rod extends, and when it warms. With the pressure p of the
unloaded side, the position x and the piston's areas A_A and A_B, the volume delivered by the middle of block k, of
whole cycles, is

    y_k = -V p_k/(n p_charge) - (A_A - A_B) x_k = y_0 + sum_j g_j P_j tau (1 or 1/2) + w t + v t^2 + noise,

where g_j is the conductance to the outside in block j, P_j the pressure that drives the leak, and tau the length of a
block (1/2 applies to block k itself). w and v describe the gas temperature and have priors (`priors.toml`).

Sources: M. Shinbrot, Trans. ASME 79 (1957) 547; L. Breiman, Technometrics 37 (1995) 373.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import MIN_BLOCKS, Information, StepTest, step_test
from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.inference.block_stream import MAX_BLOCK_TIME
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, Weighting, sorted_part_means
from sealscope.diagnosis.inference.equations.balances import (
    READ,
    circulation,
    derive_drive_signals,
    locked,
    samples_without_holes,
)
from sealscope.diagnosis.inference.equations.terms import LEAK, ORIFICE, Equation, Flow, Signals
from sealscope.diagnosis.inference.machine_states import find_holds, find_rests, rest_limit
from sealscope.diagnosis.inference.rows import Rows
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.motion import estimate_period, fundamental_frequency
from sealscope.recordings.recording import Array, Recording
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig


_PRIORS = INFERENCE.held
#: Half-width of the test functions over holds [s].
HOLD_HALF_WIDTH: float = _PRIORS.half_width
#: Channels that these balances read: none of their terms needs the pressures at the ports.
_READ = tuple(name for name in READ if name not in ("p_1", "p_2"))


class CycleBalance(NamedTuple):
    """Volume balance of a recording without position or flow, over whole cycles or times of standstill (holds).

    `columns`: roles of the columns of `equation`; `oil_loss`: tests for an external leak of either side by the volume
    that the accumulator loses, by the name of the term.
    """

    blocks: Blocks
    equation: Equation
    columns: ColumnRoles
    oil_loss: Mapping[str, StepTest]


def cycle_balances(recording: Recording, rig: Rig) -> list[CycleBalance]:
    """Compute the volume balances of a recording without position or without flow; empty if none is possible.

    Without a position, the pump's flow is balanced over cycles, and over the times in which the piston is held at
    standstill (holds). With a position but no flow, the volume that the creeping piston displaces is balanced over the
    holds in which valves are shut.
    """
    channels, begin = frozenset(recording.channels), float(recording.t[0])
    equation = locked(rig, channels) if "x" in channels else circulation(rig, channels)
    if equation is None:
        return []
    is_locked = equation.flow is Flow.CREEP  # shut valves hold the piston
    samples = samples_without_holes(recording, _READ)
    if not is_locked:
        # `loaded`: a droop of the speed under load is no leakage
        samples = derive_drive_signals(samples, rig, recording.rate, loaded=True)
    signals = Signals(samples, recording.rate)
    # left side of the balance as a flow [m^3/s]: delivered by the pump, or displaced by a piston behind shut valves
    flow, dp = equation.left(signals) * recording.rate, signals.pressure_difference
    # friction dissipates power, so a negative power means reversed signs of the flow; the mean of p_A - p_B does not
    # count, as a constant load takes no power over whole cycles
    if not is_locked and float(np.nansum((dp - np.nanmean(dp)) * flow)) < 0.0:
        recorded_left = equation.left
        equation, flow = equation._replace(left=lambda s: -recorded_left(s)), -flow
    is_known = np.isfinite(flow + dp)
    if not is_known.any() or not np.ptp(flow[is_known]) > 0.0:  # missing or stuck
        return []
    single_rod = rig.cylinder.single_rod
    # behind shut valves the piston is held while the command is constant; a control loop may hold it at any command
    is_constant = np.ones_like(is_known)
    # fastest flow of a piston that creeps behind shut valves; a flow up to this limit counts as a hold
    max_creep = _PRIORS.creep_speed * max(rig.cylinder.A_A, rig.cylinder.A_B) if is_locked else 0.0
    is_stated_valve = "u" in channels and rig.circuit.holds_load
    if is_locked and is_stated_valve:
        is_constant = signals.step("u") == 0.0  # the least change may feed the load
    elif is_locked and "u" in channels:
        is_constant = _find_command_rests(signals)
        max_creep = max(max_creep, rest_limit(equation.left(signals), recording.rate, _PRIORS.held_speed))
    may_hold = is_known & is_constant
    is_held = is_known & find_holds(np.where(may_hold, flow, np.inf), recording.rate, min_limit=max_creep)
    if is_locked and not is_stated_valve and not is_held.all():
        first_motion = int(np.argmin(is_held))
        is_held[:first_motion] = False  # the machine may be off before the first motion
    cycle = None if is_locked else cycle_length(np.where(is_known, flow, 0.0), recording.rate)
    balances = []
    for half_width, is_used in ((cycle, is_known), (HOLD_HALF_WIDTH, is_held)):
        if half_width is None:
            continue
        blocks = _build_blocks(signals, equation, half_width, is_used, begin, one_sided=single_rod)
        if blocks is not None:
            # shut valves part the chambers from the accumulator
            oil_loss = {} if is_locked else oil_loss_tests(signals, rig, cycle, begin)
            balances.append(CycleBalance(blocks, equation, ColumnRoles(equation), oil_loss))
    return balances


def _find_command_rests(signals: Signals) -> NDArray[np.bool_]:
    """Flag the sampling intervals (n - 1,) in which a constant command u is near its null, where a valve is shut.

    The null is the middle between the least commands that move the piston out and in: a fraction `held.ramp_share` of
    the commands in motion is nearer to it. u may differ from it by the fraction `held.null_distance` of the distance
    between the least commands (`priors.toml`): a control loop that feeds what leaks has a larger command. Nothing is
    flagged without motion both ways.
    """
    step, command = signals.step("x"), signals.mean("u")
    is_moving = ~find_rests(step, signals.rate, rest_limit(step, signals.rate, _PRIORS.held_speed))
    is_known = is_moving & np.isfinite(step * command)
    outward, inward = command[is_known & (step > 0.0)], command[is_known & (step < 0.0)]
    if not (outward.size and inward.size):
        return np.zeros_like(is_moving)
    sense = np.sign(np.median(outward) - np.median(inward))
    least_outward, least_inward = (
        float(np.quantile(sense * outward, _PRIORS.ramp_share)),
        float(np.quantile(sense * inward, 1.0 - _PRIORS.ramp_share)),
    )
    distance = np.abs(sense * command - 0.5 * (least_outward + least_inward))
    is_near_null = distance < _PRIORS.null_distance * (least_outward - least_inward)
    return np.asarray(find_rests(signals.step("u"), signals.rate) & is_near_null)


def _build_blocks(
    signals: Signals, equation: Equation, half_width: float, is_used: NDArray[np.bool_], begin: float, one_sided: bool
) -> Blocks | None:
    """Compute the blocks of a volume balance from rows, each a mean over a triangular window of a `half_width` [s].

    `is_used` (n,): flags of the sampling intervals that may be part of a row; `begin`: time of the first sample [s];
    `one_sided`: use only rows in which one side has the higher pressure throughout, but for noise. Return None for
    fewer than `MIN_BLOCKS` blocks with rows.
    """
    left, dp, rate = equation.left(signals), signals.pressure_difference, signals.rate
    rows = _integrate_rows([*(term.increments(signals) for term in equation.terms), left], is_used, half_width, rate)
    _shrink_offset(rows.values, [term.name for term in equation.terms])
    if one_sided:
        # weighted fraction of each row's window in which A has the higher pressure; the rows are rates, hence `/ rate`
        share_A = _integrate_rows([signals.carried_by_A[1:] / rate], is_used, half_width, rate).values[:, 0]
        rows = rows._replace(whole=rows.whole & (np.minimum(share_A, 1.0 - share_A) < _PRIORS.ambiguous_share))
    # rows are half of `half_width` apart; a block has the rows of one cycle (`half_width`) or, for holds and shorter
    # cycles, of `MAX_BLOCK_TIME`
    rows_per_block = 2 if half_width > HOLD_HALF_WIDTH else round(2.0 * MAX_BLOCK_TIME / half_width)
    n_blocks = len(rows.time) // rows_per_block
    n_used = n_blocks * rows_per_block
    is_whole = rows.whole[:n_used]
    n_rows = np.count_nonzero(is_whole.reshape(n_blocks, rows_per_block), axis=1)
    if np.count_nonzero(n_rows) < MIN_BLOCKS:
        return None
    whole_rows = rows.values[:n_used][is_whole]
    gram = Weighting((ColumnRoles(equation),)).compute_gram_matrices([whole_rows], np.cumsum(n_rows))
    # each row stands for a quarter of `half_width` on either side of its middle
    middles = rows.time[:n_used].reshape(n_blocks, rows_per_block)
    ends = middles[:, [0, -1]] + np.array([-0.25, 0.25]) * half_width
    samples = [slice(*pair) for pair in np.round(ends * rate).astype(int)]
    flow = np.array([_mean_flow(left[block], rate) for block in samples])
    pressures = np.array([sorted_part_means(dp[block], rate) for block in samples])
    start, end = begin + ends.T
    no_offset = np.zeros(n_blocks)
    return Blocks(start, end, gram, n_rows.astype(float), flow, pressures, zero=no_offset).merge()


def _integrate_rows(increments: list[Array], is_used: NDArray[np.bool_], half_width: float, rate: float) -> Rows:
    """Compute rows of a regression: mean rates of c columns over overlapping triangular windows.

    `increments`: each column's increments in n sampling intervals; `is_used` (n,): flags of the intervals that may be
    part of a row (a row with any other is flagged as not whole); `half_width`: half the width of a window, and twice
    the distance of windows [s]. The integral over a triangle is the second difference of the twice integrated
    increments.
    """
    half_length, n_samples = half_width * rate, len(is_used)
    centres = np.arange(half_length, n_samples - half_length, 0.5 * half_length)
    indices = np.arange(n_samples + 1)

    def integrate(values: Array) -> Array:
        """Average values (n,) with the weights of a triangular window about each of the r `centres`, shape (r,)."""
        integral = np.concatenate([[0.0], np.cumsum(values)])
        double_integral = np.concatenate([[0.0], np.cumsum(0.5 * (integral[1:] + integral[:-1]))])
        before, middle, after = (
            np.interp(centres + shift, indices, double_integral) for shift in (-half_length, 0.0, half_length)
        )
        return np.asarray((before - 2.0 * middle + after) / half_length**2)

    # a window contains (parts of) the intervals `first` to `last` - 1
    n_unused = np.concatenate([[0], np.cumsum(~is_used)])
    first, last = (np.clip(centres + shift, 0, n_samples).astype(int) for shift in (-half_length, half_length + 1.0))
    values = np.column_stack([integrate(np.where(is_used, increment, 0.0)) * rate for increment in increments])
    return Rows(centres / rate, values, n_unused[last] == n_unused[first])


def _shrink_offset(values: Array, names: list[str]) -> None:
    """Reduce, in place, the leak's columns of rows `values` (r, c) by the part that sensor offsets may cause.

    The mean pressure difference d of a row, in the column of a laminar leak, becomes d - z^2/d, or 0 if |d| is smaller
    than the offset z that 95 % of usual sensors do not exceed (Breiman's garrote). The column of an orifice is
    multiplied by the same factor.
    """
    max_offset = WITHIN_95 * INFERENCE.zero.pressure
    mean_pressure = values[:, names.index(LEAK)]
    fraction = np.maximum(1.0 - (max_offset / np.maximum(np.abs(mean_pressure), max_offset)) ** 2, 0.0)
    for name in (LEAK, ORIFICE):
        values[:, names.index(name)] *= fraction


def _mean_flow(increments: Array, rate: float) -> float:
    """Compute a flow's mean magnitude [m^3/s] from volume increments [m^3] at `rate` [Hz]; 0 if all are missing."""
    known = increments[np.isfinite(increments)]
    return float(np.abs(known).mean()) * rate if known.size else 0.0


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
    if not rig.cylinder.single_rod or rig.makeup.check_valves == "absent":
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
