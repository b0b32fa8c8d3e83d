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

Sources: M. Shinbrot, Trans. ASME 79 (1957) 547; L. Breiman, Technometrics 37 (1995) 373.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import MIN_BLOCKS, StepTest
from sealscope.diagnosis.estimate.interval import WITHIN_95
from sealscope.diagnosis.inference.balance import MAX_BLOCK_TIME, READ, derive_drive_signals, samples_without_holes
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, Weighting
from sealscope.diagnosis.inference.circuit.store import cycle_length, oil_loss_tests
from sealscope.diagnosis.inference.equations.balances import circulation, locked
from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.inference.equations.terms import LEAK, ORIFICE, Equation, Flow
from sealscope.diagnosis.inference.rows.distribution import sorted_part_means
from sealscope.diagnosis.inference.rows.weak_form import Rows
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = INFERENCE.held
#: Half-width of the test functions over holds [s].
HOLD_HALF_WIDTH: float = _PRIORS.half
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
    may_hold = is_known & (signals.step("u") == 0.0) if is_locked and "u" in channels else is_known
    # fastest flow of a piston that creeps behind shut valves; a flow up to this limit counts as a hold
    max_creep = _PRIORS.creep * max(rig.cylinder.A_A, rig.cylinder.A_B) if is_locked else 0.0
    is_held = is_known & _find_holds(np.where(may_hold, flow, np.inf), recording.rate, min_limit=max_creep)
    if is_locked and "u" not in channels and not is_held.all():
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


def _find_holds(flow: Array, rate: float, min_limit: float = 0.0) -> NDArray[np.bool_]:
    """Flag the samples (n,) in which the piston is held, i.e. the flow has been near zero for the settling time.

    The flow is averaged over `held.averaged` (`priors.toml`). It is near zero up to the fraction `held.slow` of its
    largest value, or up to `min_limit` [m^3/s] if this is larger. The settling time is `held.settles`; before the first
    sample the piston counts as held. `flow` (n,): flow [m^3/s], infinite where the piston is surely not held.
    """
    window, settling = max(1, round(_PRIORS.averaged * rate)), max(1, round(_PRIORS.settles * rate))  # [samples]
    mean_flow = np.abs(np.convolve(flow, np.full(window, 1.0 / window), "same"))
    is_finite = np.isfinite(mean_flow)
    limit = max(_PRIORS.slow * mean_flow[is_finite].max(initial=0.0), min_limit)
    is_moving = ~is_finite | (mean_flow > limit)
    n_moving = np.convolve(is_moving, np.ones(settling))[: flow.size]  # among the last `settling` samples
    return np.asarray(n_moving == 0)


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
        rows = rows._replace(whole=rows.whole & (np.minimum(share_A, 1.0 - share_A) < _PRIORS.elsewhere))
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
