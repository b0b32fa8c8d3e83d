"""Balances without position or without flow: over whole cycles of the duty, or while the piston is held.

Test functions that annihilate what repeats take the displacement out of the balance. A box of one cycle, convolved with
itself, has a double zero at every harmonic of the duty: over it a piston that a loop brings back displaces nothing,

    integral of phi D dtheta = G integral of phi (p_A - p_B) dt + sum_j c_j integral of phi f_j dg_j,

so that what the pump delivers is what leaks. While a loop holds the piston at standstill any test function will do.
Rows that touch a missing sample weigh nothing, nor do rows of a single rod that touch a change of the side that
carries: the circuit exchanges oil there. Of the mean pressure difference only what zeros of the sensors cannot make
counts, d - z^2/d beyond z (Breiman's garrote). A loop makes good what leaks; where the pump delivers less than any pump
loses, none does, and the balance says nothing. Where nothing gives a flow, shut valves hold the piston, and what the
loaded side loses shows by how it gives way; while a command moves the valve may feed what is lost, and nothing counts.

Sources: M. Shinbrot, Trans. ASME 79 (1957) 547; L. Breiman, Technometrics 37 (1995) 373.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.balance import LONGEST, commanded, whole_samples
from sealscope.diagnosis.inference.blocks import Blocks, Columns, Weighting
from sealscope.diagnosis.inference.circuit.store import cycle_length, lost_oil
from sealscope.diagnosis.inference.onset import FEWEST, WITHIN_95, StepTest
from sealscope.diagnosis.inference.rows.distribution import distribution
from sealscope.diagnosis.inference.terms import (
    LEAK,
    LOCKED,
    ORIFICE,
    Equation,
    Signals,
    circulation,
    locked,
)
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_PRIORS = priors("inference")["held"]
HELD: float = _PRIORS["half"]
_READ = ("u", "omega", "theta", "q_pump", "x", "p_A", "p_B")


class _WideRows(NamedTuple):
    """Rows of a regression: `time` (r,), `values` (r, c), and whether each counts, `whole` (r,)."""

    time: Array
    values: Array
    whole: NDArray[np.bool_]


class CycleBalance(NamedTuple):
    """A balance without a position, or without flow, over a recording.

    `lost`: tests of a step of the external leak of either side by the accumulator's own balance, by the term's name.
    """

    blocks: Blocks
    equation: Equation
    columns: Columns
    lost: Mapping[str, StepTest]


def circulations(recording: Recording, rig: Rig) -> list[CycleBalance]:
    """Return the balances over cycles and over holds of a recording.

    With a position and nothing that gives a flow, over holds by shut valves.
    """
    channels = frozenset(recording.channels)
    equation = locked(rig, channels) if "x" in channels else circulation(rig, channels)
    if equation is None:
        return []
    shut, samples = equation.name == LOCKED, whole_samples(recording, _READ)
    if not shut:
        samples = commanded(samples, rig, recording.rate, loaded=True)
    signals = Signals(samples, recording.rate, {})
    speed, dp = equation.left(signals) * recording.rate, signals.pressure_difference
    if not shut and float(np.nansum((dp - np.nanmean(dp)) * speed)) < 0.0:  # friction takes work: wired reversed
        forward = equation.left
        equation, speed = equation._replace(left=lambda s: -forward(s)), -speed
    known = np.isfinite(speed + dp)
    if not known.any() or not np.ptp(speed[known]) > 0.0:
        return []
    area = max(rig.cylinder.A_A, rig.cylinder.A_B)
    counts = known & (signals.step("u") == 0.0) if shut else known
    still = _find_holds(np.where(counts, speed, np.inf), recording.rate, area if shut else 0.0)
    begin, balances = float(recording.t[0]), list[CycleBalance]()
    carries = rig.cylinder.single_rod
    if shut:
        blocks = _blocks(signals, equation, HELD, known & still, begin, carries)
        return [] if blocks is None else [CycleBalance(blocks, equation, Columns(equation), {})]
    cycle = cycle_length(np.where(known, speed, 0.0), recording.rate)
    for half, counts in ((cycle, known), (HELD, known & still)):
        blocks = None if half is None else _blocks(signals, equation, half, counts, begin, carries)
        if blocks is not None:
            lost = lost_oil(signals, rig, cycle, begin)
            balances.append(CycleBalance(blocks, equation, Columns(equation), lost))
    return balances


def _find_holds(speed: Array, rate: float, area: float = 0.0) -> NDArray[np.bool_]:
    """Find the samples in which the piston is held, after it has settled; with an `area`, creep is a standstill."""
    size, settles = max(1, round(_PRIORS["averaged"] * rate)), max(1, round(_PRIORS["settles"] * rate))
    slow = np.abs(np.convolve(speed, np.full(size, 1.0 / size), "same"))
    finite = np.isfinite(slow)
    limit = max(_PRIORS["slow"] * slow[finite].max(initial=0.0), _PRIORS["creep"] * area)
    moves = ~finite | (slow > limit)
    return np.asarray(np.convolve(moves, np.ones(settles))[: speed.size] == 0)


def _blocks(
    signals: Signals,
    equation: Equation,
    half: float,
    counts: NDArray[np.bool_],
    begin: float,
    carries: bool = False,
) -> Blocks | None:
    """Return the blocks of test functions of a half-width [s]; None for fewer than `FEWEST`.

    `carries`: rows count where one side carries throughout.
    """
    left, dp, rate = equation.left(signals), signals.pressure_difference, signals.rate
    increments = [*(term.increments(signals) for term in equation.terms), left]
    rows = _rows(increments, counts, half, rate)
    _less_the_zero(rows.values, [term.name for term in equation.terms])
    if carries:
        side = _rows([signals.carried_by_A[1:] / rate], counts, half, rate).values[:, 0]
        one_side = np.minimum(side, 1.0 - side) < _PRIORS["elsewhere"]
        rows = rows._replace(whole=rows.whole & one_side)
    group = 2 if half > HELD else round(2.0 * LONGEST / half)
    parts = [slice(k * group, (k + 1) * group) for k in range(len(rows.time) // group)]
    if sum(bool(rows.whole[part].any()) for part in parts) < FEWEST:
        return None
    kept = np.array([np.count_nonzero(rows.whole[part]) for part in parts])
    whole = rows.values[: len(parts) * group][rows.whole[: len(parts) * group]]
    gram = Weighting((Columns(equation),)).close([whole], np.cumsum(kept))
    ends = np.array([[rows.time[part][0], rows.time[part][-1]] for part in parts]) + np.array([-0.25, 0.25]) * half
    measured = [_measured(dp[a:b], left[a:b], rate) for a, b in np.round(ends * rate).astype(int)]
    flow, pressures = (np.array(values) for values in zip(*measured, strict=True))
    start, end = begin + ends.T
    return Blocks(start, end, gram, kept.astype(float), flow, pressures, np.zeros(len(parts))).merged()


def _rows(increments: list[Array], counts: NDArray[np.bool_], half: float, rate: float) -> _WideRows:
    """Return the rows of increments, c times (n,), for triangles of a half-width [s], half of it apart.

    The integral over a triangle is the second difference of the twice integrated increments.
    """
    length, n = half * rate, len(counts)
    centres = np.arange(length, n - length, 0.5 * length)
    places = np.arange(n + 1)

    def over(values: Array) -> Array:
        once = np.concatenate([[0.0], np.cumsum(values)])
        twice = np.concatenate([[0.0], np.cumsum(0.5 * (once[1:] + once[:-1]))])
        before, middle, after = (np.interp(centres + shift, places, twice) for shift in (-length, 0.0, length))
        return np.asarray((before - 2.0 * middle + after) / length**2)

    missing = np.concatenate([[0], np.cumsum(~counts)])
    first, last = (np.clip(centres + shift, 0, n).astype(int) for shift in (-length, length + 1.0))
    values = np.column_stack([over(np.where(counts, increment, 0.0)) * rate for increment in increments])
    return _WideRows(centres / rate, values, missing[last] == missing[first])


def _less_the_zero(values: Array, names: list[str]) -> None:
    """Take from the mean pressure difference of each row what zeros of the sensors may have made."""
    zero = WITHIN_95 * priors("inference")["zero"]["pressure"]
    mean = values[:, names.index(LEAK)]
    share = np.maximum(1.0 - (zero / np.maximum(np.abs(mean), zero)) ** 2, 0.0)
    for name in (LEAK, ORIFICE):
        values[:, names.index(name)] *= share


def _measured(dp: Array, left: Array, rate: float) -> tuple[float, Array]:
    """Return `Blocks.flow` and `Blocks.pressures` of a block's samples."""
    flow = left[np.isfinite(left)]
    return float(np.abs(flow).mean()) * rate if flow.size else 0.0, distribution(dp, rate)
