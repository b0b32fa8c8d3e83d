"""The balance of volumes over blocks, one geometry for all and one conductance a block, and a rise in these.

    A x = s (q_b/(2 pi)) (theta - tau omega) - g_k integral(dp_AB) dt - (V/2K)_k dp_AB - (V_1/2K) dp_12 + a_k + b_k t

is the integral of eqs. (4.16)-(4.19) of the thesis with a leak Q_L = g (p_A - p_B); half the difference of the sides is
taken, so that what both sides lose alike cancels. `s`, the ratio of displacement and area over the assumed one, the lag
tau of the position's reading behind the angle's, and the line volumes are shared by all blocks, because within one
block a wrong s passes for a leak: the integral of a rectangular pressure difference is nearly the motion itself.
Where the areas of the piston's sides differ, A x is counted by the side that the pump feeds, which is told by the
pump's direction or by the higher pressure. docs/decisions/0023-volume-balance.md gives reasons and figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.volume_balance.blocks import (
    COMPRESSED,
    DP_12,
    FLOW,
    I_12,
    I_AB,
    I_ROOT,
    STORED_A,
    STORED_B,
    STORED_X_A,
    STORED_X_B,
    THETA,
    TIME,
    Y_PUMP,
    Y_SIDE,
    BalanceBlocks,
    Geometry,
    Y,
)
from sealscope.recordings.recording import Array

#: Laws that a leak may follow: proportional to the pressure difference (a worn seal), or to its root (an orifice).
Law = Literal["laminar", "orifice"]
#: A block's residual stands out where it is over this many times the usual one; the block does not balance under any
#: leak where the residual is over this share of the volume delivered, too.
_SPOILT = 5.0
_UNBALANCED = 0.05
#: A block stands where the integral of dp has under this many times the sum of squares that noise makes of it.
_STILL = 10.0
#: The sides' areas differ where counting them apart leaves under this share of the usual sum of squares.
_UNEQUAL = 0.5
#: A block in which the circuit is filled: both pressures together rise by this share of the usual size of dp, and by
#: so many times their usual rise, in no more than a share of the blocks: else it is the duty.
_FILLED, _UNUSUAL, _SELDOM = 0.2, 5.0, 0.1
#: Share of the blocks whose residuals are below the usual one: well under half, as most blocks may leak.
_USUAL = 0.25
#: A block's leak follows the root of dp where that leaves under this share of what a laminar leak leaves.
_OTHER_LAW = 0.9
#: Rounds of the fit of the geometry: the first add up norms, which has one minimum; the last weigh by variances.
_ROUNDS = (12, 8)
#: Relative changes of the coefficients at which the first rounds, and the last, are ended.
_CLOSE, _EXACT = 1e-5, 1e-9
#: Where a leak opens near an end of a block, the block's conductance may lie outside those of its neighbours by this
#: share of their difference.
_BENT = 0.25
#: The integrals of two pressure differences differ where what sets them apart is over this many times its noise, and
#: give two conductances where it is over so many times.
_APART = 1.5
_SEPARATE = 10.0
#: The stored oil tells the sense of the pressures where it is this many deviations from zero.
_SURE = 5.0
#: Share of the way on which the higher pressure may change sides unseen: 0.001 on single rods whose load keeps it on a
#: side, 0.23 to 0.34 where the circuit swings between its valves.
_SWINGING = 0.05
#: Either side of a single rod carries in turn where over this share of the squares of the integral of dp swings: 0.0015
#: at most under a load that stands on one side, 0.027 and more without a load (development machines).
_IN_TURN = 0.01
#: A machine rests where over this share of the time is in no block.
_RESTS = 0.1
#: Blocks between the others count where there are so many of them, over those.
_MOST_BETWEEN = 0.5
#: Slopes are not kept where conductances of a single rod scatter by over so many times what they do without; those of a
#: double rod where they scatter by over this share; blocks that show it.
_SCATTERS, _CALMER, _FEW = 2.0, 0.7, 4
#: What double rods share under a load: the oil stored in the side that carries it, what the pump compresses, and a
#: steady flow, which zeros of the transducers make.
_CARRIED = (STORED_A, STORED_X_A, COMPRESSED, TIME)
#: ... and single rods: the oil stored in either side.
_STORED = (STORED_B, STORED_X_A, STORED_X_B)
#: A load acts where the steady part of dp has this share of the squares of its integral, and more, and the steady part
#: of the way has less than this share of its: blocks are no parts of strokes, as those of short recordings are.
_LOADED, _OF_STROKES = 0.75, 0.7
#: Zero of a pressure difference as makers state it [Pa]: 0.1 % of 20 MPa; and values of a block that are independent of
#: each other, beyond what all share: what is left is no white noise.
_ZERO, _INDEPENDENT = 2e4, 10.0
#: Motion and the integral of dp go together where this share of the angle is beyond that integral; what is left of the
#: balance then errs alike by this share of it (0.2 to 0.3 on machines developed on).
_TOGETHER, _ALIKE = 0.05, 0.5
#: Median of the size of a standard normal number.
_QUARTILE = 0.6745
#: Displacement over area may differ by this share from that of a stated machine before it is another one.
GEOMETRY = 0.15


@dataclass(frozen=True, eq=False)
class Conductances:
    """Conductances `g` (n,) [m^3/(s Pa)] of blocks at `t` (n,) [s]."""

    t: Array
    g: Array


@dataclass(frozen=True, eq=False)
class BalanceFit:
    """Balance of a recording.

    `blocks`: those that took part; `left_out`: those that did not; `columns`: those that blocks share, with
    their coefficients `beta`; `sense`: 1, or -1 where dp counts against the motion; `pump`: the pump's own conductance
    where throttles tell it from the piston's, else None, and its deviation `pump_sd`; `g` (n,): conductance of the
    piston, or of both together [m^3/(s Pa)], positive where oil leaks; `sd` (n,): its deviation, from the residual and
    the noise of dp; `shared` (n, m): deviations common to the blocks, from the shared coefficients; `residual` [m^3]:
    rms; `signal` [m^3]: rms of the volume delivered; `slip` (n,): flow that nothing explains [m^3/s]; `metres`: the
    position has a unit; `unequal`: the sides' areas differ; `scale_sd`: deviation of `scale`; `geometry`: as assumed;
    `side`: 1 where p_A is the higher one along most of the way, -1 where p_B is; `by_side`: the volume displaced is
    counted by the assumed area of the side that carries the load, sample by sample; `swinging`: the fit of the same
    blocks without their slopes, where these are kept because a load acts on a double rod, else None; `between`: blocks
    half a block later by the same coefficients, where slopes are kept, else None.
    """

    blocks: BalanceBlocks
    left_out: BalanceBlocks
    columns: tuple[int, ...]
    beta: Array
    sense: int
    pump: float | None
    pump_sd: float
    g: Array
    sd: Array
    shared: Array
    residual: float
    signal: float
    slip: Array
    metres: bool
    unequal: bool
    scale_sd: float
    geometry: Geometry
    side: int
    by_side: bool
    swinging: BalanceFit | None = None
    between: Conductances | None = None

    @property
    def count(self) -> int:
        """Number of blocks that took part, those between them included."""
        return len(self.blocks) + (0 if self.between is None else self.between.t.size)

    @property
    def without_slopes(self) -> BalanceFit:
        """The fit by what swings alone, whose `slip` shows the steady flow that no conductance explains."""
        return self if self.swinging is None else self.swinging

    @property
    def keeps_slopes(self) -> bool:
        """Whether slopes are kept: conductances are known so well then that their drift is far above the noise."""
        return int(self.blocks.gram.shape[1]) > TIME

    @property
    def goes_together(self) -> bool:
        """Whether motion and the integral of dp go together, so that a leak is told from the scale by reversals alone.

        A piston that moves at one speed against dry friction turns both alike.
        """
        gram = self.blocks.gram
        return _beyond_integral(gram) < _TOGETHER**2 * float(np.median(gram[:, THETA, THETA]))

    @property
    def doubt(self) -> float:
        """Deviation of `scale` by what encoders and transducers do in every cycle where that tells it, else 0.

        No mean over samples or blocks takes it out: ``c r sqrt(N/<theta, theta>)`` for residuals r of N samples, of the
        angle what is beyond the integral of dp.
        """
        if not self.goes_together:
            return 0.0
        beyond = max(_beyond_integral(self.blocks.gram), np.finfo(float).tiny)
        return _ALIKE * self.residual * float(np.sqrt(self.blocks.samples / beyond))

    @property
    def leaning(self) -> Array:
        """By how much the conductance of a block (n,) changes with the scale [m^3/(s Pa)]."""
        gram = self.blocks.gram
        return np.asarray(self.sense * gram[:, I_AB, THETA] / np.maximum(gram[:, I_AB, I_AB], np.finfo(float).tiny))

    @property
    def slip_leaning(self) -> Array:
        """By how much the `slip` of a block (n,) changes with the scale [m^3/s]."""
        slope = self.blocks.slope
        return np.asarray(self.sense * self.leaning * slope[:, I_AB] - slope[:, THETA])

    @property
    def weights(self) -> Array:
        """Weights (c,) of the columns of a block as it was cut, in what the balance leaves beside the leak."""
        weights = np.zeros(self.blocks.gram.shape[1])
        weights[Y] = 1.0
        weights[list(self.columns)] -= self.beta
        return np.asarray(weights @ _turn(weights.size, self.side, self._counted, self.swinging is not None))[:TIME]

    @property
    def _counted(self) -> float:
        """Difference of the sides' areas over their sum by which the volume displaced is counted."""
        return self.geometry.asymmetry if self.by_side else 0.0

    @property
    def scale(self) -> float:
        """Displacement over area, over the assumed one, s; negative where an encoder counts the other way."""
        return float(self.beta[0])

    @property
    def carrying(self) -> float:
        """Area of the side that carries the load most of the way, over the mean of both, of the assumed machine.

        1 where the sides are counted by the pump's direction, then `scale` is by the mean, or each by its own area.
        """
        return 1.0 if self.by_side or Y_PUMP in self.columns else 1.0 + self.side * self.sense * self.geometry.asymmetry

    @property
    def misfit(self) -> float:
        """Displacement over area, over that of the assumed machine: 1 where it is this one."""
        return abs(self.scale) * self.carrying

    @property
    def changes_over(self) -> bool:
        """Whether either side of a single rod carries the load in turn: the integral of dp swings as well."""
        if not (self.geometry.unequal and self.keeps_slopes):
            return self.geometry.unequal
        gram = self.blocks.gram
        steady = gram[:, I_AB, TIME] ** 2 / (gram[:, I_AB, I_AB] * gram[:, TIME, TIME])
        return bool(1.0 - np.median(steady) > _IN_TURN)

    @property
    def settles(self) -> bool:
        """Whether it is a single rod that rests without a load, whose circuit may settle in another way each time."""
        balanced = (len(self.blocks) + len(self.left_out)) * self.blocks.seconds
        return self.changes_over and balanced < (1.0 - _RESTS) * (float(np.ptp(self.blocks.t)) + self.blocks.seconds)

    @property
    def lag(self) -> float:
        """Lag of the position's reading behind the angle's, tau [s]."""
        return float(-self.beta[1] / self.beta[0]) if self.beta[0] != 0 else float("inf")

    @property
    def by_pump(self) -> bool:
        """Whether volumes are counted by the pump's displacement, and not by the piston's area.

        They are where the areas of the piston's sides differ, and it depends on the load which of them counts; and
        where the displacement is stated and the area is not.
        """
        return self.unequal or (self.geometry.displacement_stated and not self.geometry.area_stated)

    def unit_flow(self, law: Law) -> Array:
        """Return the mean flow (n,) [m^3/s] over each block of a leak that shows as one unit of conductance there.

        A laminar leak has the flow g abs(dp). A leak C sign(dp) sqrt(abs(dp)) through an orifice shows as ``g = C
        <I_AB, I_root>/<I_AB, I_AB>`` and has the mean flow C sqrt(abs(dp)). Volumes are the piston's, or the pump's
        (`by_pump`).
        """
        volume = 1.0 / abs(self.scale) if self.by_pump else 1.0
        if law == "laminar":
            return volume * self.blocks.abs_dp
        gram = self.blocks.gram
        shown = gram[:, I_ROOT, I_AB] / np.maximum(gram[:, I_AB, I_AB], np.finfo(float).tiny)
        return np.asarray(volume * self.blocks.root_dp / shown)

    @property
    def share_left_out(self) -> float:
        """Share of the blocks that did not take part."""
        return len(self.left_out) / max(1, len(self.left_out) + len(self.blocks))


def _beyond(gram: Array, column: int) -> Array:
    """Return the sums of products (n, c, c) of what `column` leaves of the others in each block."""
    own = np.maximum(gram[:, column, column], np.finfo(float).tiny)
    return np.asarray(gram - gram[:, :, column, None] * gram[:, None, column, :] / own[:, None, None])


def swings(blocks: BalanceBlocks) -> bool:
    """Return whether the higher pressure changes sides faster than the samples tell."""
    return float(np.median(blocks.swinging)) > _SWINGING


def _shared_columns(blocks: BalanceBlocks, stored: Sequence[int]) -> list[int]:
    """Return the columns whose coefficients all blocks share.

    They are the angle, its lag (the flow), the pump's ports where they are recorded, those of `stored` that show
    anything, and the pump's leakage where throttles set the ports so far apart from the chambers that it can be told
    from the piston's; not where slopes are kept, as ports and chambers have other zeros.
    """
    diagonal = np.einsum("ncc->c", blocks.gram)
    stored = [column for column in stored if diagonal[column] > 0.0]
    if not np.any(blocks.noise_12):
        return [THETA, FLOW, *stored]
    own = float(np.median(_beyond(blocks.gram, I_AB)[:, I_12, I_12]))
    own_pump = own > _SEPARATE * _noise_of_integrals(blocks) and diagonal.size <= TIME
    return [THETA, FLOW, DP_12, *stored, I_12] if own_pump else [THETA, FLOW, DP_12, *stored]


def _noise_of_integral(blocks: BalanceBlocks, variance: Array) -> Array:
    """Return the sum of squares (n,) in a block of the random walk that noise of `variance` (n,) makes of an integral.

    Beyond offset and slope it is variance step^2 L^2/15: a Brownian path about its best line has the mean square T/15.
    """
    step = blocks.seconds / blocks.samples
    return np.asarray(variance * step**2 * blocks.samples**2 / 15.0)


def _noise_of_integrals(blocks: BalanceBlocks) -> float:
    """Return the usual sum of squares of the noise of the integral of dp_12 beyond that of dp_AB."""
    factor = np.median(blocks.gram[:, I_12, I_AB] / np.maximum(blocks.gram[:, I_AB, I_AB], np.finfo(float).tiny))
    variance = np.median(blocks.noise_12) + factor**2 * np.median(blocks.noise)
    return float(_noise_of_integral(blocks, np.asarray(variance)))


def _solve(rest: Array, weight: Array, steady: int | None = None, known: float = 0.0) -> tuple[Array, Array]:
    """Return the coefficients (m,) of the columns behind the first, and their covariance over the residual's variance.

    `rest` (n, 1 + m, 1 + m): sums of products beyond the leak of each block, those of the volume displaced first;
    `weight` (n,) of the blocks; `known`: by how many squares of the time, the column `steady`, the steady flow is known
    to be none.
    """
    total = (weight @ rest.reshape(len(rest), -1)).reshape(rest.shape[1:])
    if steady is not None:
        total[steady, steady] += known
    size = np.sqrt(np.maximum(np.diag(total)[1:], np.finfo(float).tiny))
    sizes = np.outer(size, size)
    values, vectors = np.linalg.eigh(total[1:, 1:] / sizes)
    clear = np.abs(values) > 1e-10 * np.max(np.abs(values))
    inverse = (vectors[:, clear] / values[clear]) @ vectors[:, clear].T / sizes
    return inverse @ total[1:, 0], inverse


def _left(rest: Array, beta: Array) -> Array:
    """Return the sum of squares (n,) that the balance with coefficients `beta` leaves in each block (`_solve`)."""
    weights = np.concatenate([[1.0], -beta])
    # differences of large numbers: what is left is known to rounding only
    return np.asarray(np.maximum((rest @ weights) @ weights, 1e-15 * rest[:, 0, 0]))


def _displaced(gram: Array, shared: list[int]) -> Array:
    """Return the sums of products (n, 1 + m, 1 + m) of the volume displaced and of the shared columns."""
    columns = [Y, *shared]
    return np.ascontiguousarray(gram[:, columns][:, :, columns])


def _usual(left: Array) -> float:
    """Return the quantile `_USUAL` of what is left in blocks (n,), as that of numpy, which takes nine times as long."""
    at = _USUAL * (left.size - 1)
    low = int(at)
    ordered = np.partition(left, (low, min(low + 1, left.size - 1)))
    return float(ordered[low] + (at - low) * (ordered[min(low + 1, left.size - 1)] - ordered[low]))


def _least(gram: Array, shared: list[int], beta: Array) -> float:
    """Return the usual sum of squares that the balance leaves in a block."""
    return _usual(_left(_displaced(_beyond(gram, I_AB), shared), beta))


def _geometry(gram: Array, shared: list[int]) -> tuple[Array, Array]:
    """Return the coefficients (m,) that all blocks share, and their covariance over the usual residual's variance.

    Every block has a leak of its own, of the law that leaves less of it. First the sum of the residuals' norms is
    least, in which a few blocks with faults do not count by their squares; then each block has the variance of its own
    residual (iteratively reweighted least squares). Both laws are begun with, as most blocks may leak by either, and
    the fit of the higher likelihood is taken.
    """
    laws = _displaced(_beyond(gram, I_AB), shared), _displaced(_beyond(gram, I_ROOT), shared)
    steady = 1 + shared.index(TIME) if TIME in shared else None
    precision = 0.0 if steady is None else 1.0 / _INDEPENDENT / _steady_flow(gram) ** 2
    fits = [_reweighted(laws, first, steady, precision) for first in laws]
    likeliest = min(fits, key=lambda fit: fit[2])
    return likeliest[:2]


def _beyond_integral(gram: Array) -> float:
    """Return the sum of squares that the integral of dp leaves of the angle, in the median of the blocks."""
    return float(np.median(_beyond(gram, I_AB)[:, THETA, THETA]))


def _steady_flow(gram: Array) -> float:
    """Return the deviation of the steady flow that zeros of the transducers make of what leaks [m^3/s]."""
    flows = gram[:, TIME] / gram[:, TIME, TIME, None]
    lost = float(np.median(np.abs(flows[:, Y] - flows[:, THETA])))
    # exact data of a machine that leaks nothing leave none: then its square is above zero all the same
    return max(lost * _ZERO / float(np.median(np.abs(flows[:, I_AB]))), 1e-30)


def _reweighted(
    laws: tuple[Array, Array], first: Array, steady: int | None, precision: float
) -> tuple[Array, Array, float]:
    """Return coefficients, covariance, and the sum of the logarithms of what is left, from the law `first`.

    `precision` of the steady flow, the coefficient of the column `steady` [s^2/m^6], over the squares of a usual block.
    """
    beta, inverse = _solve(first, np.ones(len(first)))
    rest, logs = first, float("inf")
    for convex, rounds in ((True, _ROUNDS[0]), (False, _ROUNDS[1])):
        for _ in range(rounds):
            left = _left(rest if convex else laws[0], beta)
            if not convex:
                other = _left(laws[1], beta)
                rest = np.where((other < _OTHER_LAW * left)[:, None, None], laws[1], laws[0])
                left = np.minimum(left, other)
            least = max(_usual(left), np.finfo(float).tiny)
            weight = least / np.maximum(left, least)
            before, logs = beta, float(np.log(np.maximum(left, np.finfo(float).tiny)).sum())
            beta, inverse = _solve(rest, np.sqrt(weight) if convex else weight, steady, least * precision)
            if np.all(np.abs(beta - before) <= (_CLOSE if convex else _EXACT) * np.abs(before)):
                break
    return beta, inverse, logs


def _between_neighbours(slope: Array, spoilt: NDArray[np.bool_], keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the spoilt blocks (n,) whose conductance lies between those of the kept blocks before and after.

    A large leak that opens within a block bends the volumes there, which the block's one conductance does not follow:
    that is no fault of the recording, and the block holds the onset.
    """
    known = np.flatnonzero(keep)
    between = np.zeros(spoilt.size, dtype=bool)
    for block in np.flatnonzero(spoilt):
        after = int(np.searchsorted(known, block))
        if 0 < after < known.size:
            low, high = sorted((slope[known[after - 1]], slope[known[after]]))
            margin = _BENT * (high - low)
            between[block] = low - margin <= slope[block] <= high + margin
    return between


def _moving(blocks: BalanceBlocks) -> NDArray[np.bool_]:
    """Return the blocks (n,) in which the integral of dp is more than noise: elsewhere the machine stands."""
    return np.asarray(blocks.gram[:, I_AB, I_AB] > _STILL * _noise_of_integral(blocks, blocks.noise))


def _filling(blocks: BalanceBlocks) -> NDArray[np.bool_]:
    """Return the blocks (n,) in which a make-up valve fills the circuit, by one side: that volume is in no balance.

    It is so at the start, until the lower pressure stays above the valve's; one such block outweighed a small step.
    """
    rise = np.abs(blocks.filled)
    filling = rise > max(_FILLED * float(np.median(blocks.abs_dp)), _UNUSUAL * float(np.median(rise)))
    return np.asarray(filling & (np.mean(filling) <= _SELDOM))


def _turn(columns: int, side: int, asymmetry: float, alike: bool = False) -> Array:
    """Return what makes the columns of the fit from those of a block as it was cut (c, c).

    In place of `Y_SIDE` there is the volume displaced under pressure from the side that has it less (`side`: 1 where
    that is B, -1 where it is A), which is nothing where one side carries the load throughout: twice it and the volume
    displaced differ by a sign only. The volume displaced is counted by areas that differ by `asymmetry` of their sum.
    `alike`: the oil stored in either side counts alike, by the columns of side A.
    """
    turn = np.eye(columns)
    turn[Y_SIDE, Y_SIDE] = -0.5 * side
    turn[Y_SIDE, Y] = 0.5
    turn[Y, Y_SIDE] = asymmetry
    if alike:
        turn[STORED_A, STORED_B], turn[STORED_X_A, STORED_X_B] = -1.0, 1.0
    return turn


def _turned(blocks: BalanceBlocks, turn: Array) -> BalanceBlocks:
    """Return the blocks with other columns, `turn` (c, c) of those that they have."""
    return replace(blocks, gram=turn @ blocks.gram @ turn.T, slope=blocks.slope @ turn.T, stored=blocks.stored @ turn.T)


def fit_balance(blocks: BalanceBlocks, *, metres: bool = True, geometry: Geometry) -> BalanceFit:
    """Fit the balance; blocks in which the machine stands or is filled, or that do not balance at all, are left out.

    `geometry`: what made volumes of the samples. Needs one block or more; `residual` and `signal` show a fit that means
    nothing (no motion, encoders that do not belong together). Under a load a leak is a steady flow: the slopes are
    kept then, where the conductances scatter less for it (of a double rod), or not more (of a single rod, where one
    side carries the load).
    """
    fit = _fitted(blocks, metres, geometry)
    if geometry.unequal:
        if swings(blocks):
            return fit
        steady = _slipping(_fitted(blocks.with_slopes(), metres, geometry))
        return fit if _scatter(steady) > _SCATTERS * _scatter(fit) else steady
    if (fit.unequal and not geometry.area_stated) or not loaded(blocks):
        return fit
    steady = _slipping(_fitted(blocks.whole(), metres, geometry, whole=True))
    if not _scatter(steady) < _CALMER * _scatter(fit):
        return fit
    return replace(steady, sense=fit.sense, g=steady.g * (steady.sense * fit.sense), swinging=fit)


def loaded(blocks: BalanceBlocks) -> bool:
    """Return whether a load acts: within blocks the integral of dp is steady rather than swinging, the way is not."""

    def steady(column: int) -> float:
        flow = float(np.sum(blocks.steady * blocks.slope[:, column] ** 2))
        return flow / max(flow + float(np.sum(blocks.gram[:, column, column])), np.finfo(float).tiny)

    return steady(I_AB) > _LOADED and steady(Y) < _OF_STROKES


def _scatter(fit: BalanceFit) -> float:
    """Return by how much a conductance differs from the mean of its neighbours; infinite where too few balance.

    What drifts, or steps once, does not count.
    """
    if len(fit.blocks) < _FEW or len(fit.left_out) > len(fit.blocks):
        return float("inf")
    return float(np.median(np.abs(np.diff(fit.g, 2))))


def _slipping(fit: BalanceFit) -> BalanceFit:
    """Return a fit with slopes kept, with the flow that neither motion nor leak explains in the deviations.

    Valves that change over as the load changes sides, and zeros of the transducers, make a flow of the deviation q that
    is another in each block. It moves a block's conductance by ``q <I_AB, t>/<I_AB, I_AB>``, and q is what the
    second differences of the blocks show.
    """
    if len(fit.blocks) < _FEW:
        return fit
    gram = fit.blocks.gram
    moved = np.abs(gram[:, I_AB, TIME]) / np.maximum(gram[:, I_AB, I_AB], np.finfo(float).tiny)
    spread = np.maximum(moved[2:] ** 2 + 4.0 * moved[1:-1] ** 2 + moved[:-2] ** 2, np.finfo(float).tiny)
    slip = float(np.median(np.abs(np.diff(fit.g, 2)) / np.sqrt(spread))) / _QUARTILE
    return replace(fit, sd=np.hypot(fit.sd, slip * moved))


def _share_off(beta: Array) -> float:
    """Return by which share displacement over area differs from the assumed one."""
    return abs(abs(float(beta[0])) - 1.0)


def _fitted(blocks: BalanceBlocks, metres: bool, geometry: Geometry, *, whole: bool = False) -> BalanceFit:
    """Return the fit of blocks; `whole`: those of a double rod under a load, slopes and stored oil kept."""
    side = 1 if float(np.sum(blocks.gram[:, Y, Y_SIDE])) >= 0 else -1
    cut = blocks
    by_side = geometry.asymmetry != 0.0 and geometry.area_stated and not swings(cut)
    blocks = _turned(cut, _turn(cut.gram.shape[1], side, geometry.asymmetry if by_side else 0.0, whole))
    keep = _moving(blocks) & ~_filling(blocks)
    if not keep.any():
        keep = np.ones(len(blocks), dtype=bool)
    freedom = max(1, blocks.samples - 4)
    stored = _STORED if geometry.unequal and not swings(blocks) else ()
    shared = _shared_columns(blocks.chosen(keep), _CARRIED if whole else stored)
    beta, inverse = _geometry(blocks.gram[keep], shared)
    least = _UNEQUAL * _least(blocks.gram[keep], shared, beta)
    known = by_side and geometry.displacement_stated
    plainly = _turned(cut, _turn(cut.gram.shape[1], side, 0.0)) if by_side else blocks
    for column in () if whole else (Y_PUMP, Y_SIDE):
        apart = [*shared[:2], column, *[other for other in shared[2:] if other not in (Y_PUMP, Y_SIDE)]]
        counted = _geometry(plainly.gram[keep], apart)
        left_over = _least(plainly.gram[keep], apart, counted[0])
        if left_over < least and not (known and _share_off(counted[0]) > GEOMETRY >= _share_off(beta)):
            least, shared, (beta, inverse) = left_over, apart, counted
    if by_side and {Y_PUMP, Y_SIDE} & set(shared):
        blocks, by_side = plainly, False
    own = np.maximum(blocks.gram[:, I_AB, I_AB], np.finfo(float).tiny)
    leaning = blocks.gram[:, I_AB][:, shared] / own[:, None]
    slope = blocks.gram[:, I_AB, Y] / own - leaning @ beta
    left = _left(_displaced(_beyond(_beyond(blocks.gram, I_AB), I_ROOT), shared), beta)
    usual = _usual(left[keep]) / freedom
    spoilt = left > _SPOILT**2 * usual * freedom
    bent = spoilt & _between_neighbours(slope, spoilt, keep & ~spoilt)
    keep &= ~spoilt | bent | (left <= _UNBALANCED**2 * beta[0] ** 2 * blocks.gram[:, THETA, THETA])
    used, own, leaning, slope = blocks.chosen(keep), own[keep], leaning[keep], slope[keep]
    left, astray = left[keep], (spoilt & ~bent)[keep]
    sense = _sense(used, slope, beta, shared)
    # a residual beyond noise may be all in the direction of the leak
    variance = np.where(left > 2.0 * usual * freedom, np.where(astray, left, left / freedom), usual)
    # numerically exact data have no residual; a relative rounding error keeps deviations above zero
    variance = np.maximum(variance, 1e-24 * used.gram[:, Y, Y] / used.samples)
    widths, turns = np.linalg.eigh(inverse)
    common = leaning @ turns * np.sqrt(np.maximum(widths, 0.0) * usual)
    g = -sense * slope
    slip = used.slope[:, Y] - used.slope[:, shared] @ beta - slope * used.slope[:, I_AB]
    return BalanceFit(
        blocks=used,
        left_out=blocks.chosen(~keep),
        columns=tuple(shared),
        beta=beta,
        sense=sense,
        pump=float(-sense * beta[-1]) if I_12 in shared else None,
        pump_sd=float(np.sqrt(inverse[-1, -1] * usual)) if I_12 in shared else 0.0,
        g=g,
        sd=np.sqrt(np.maximum(variance, np.finfo(float).tiny) / own + g**2 * used.walk),
        shared=common,
        residual=float(np.sqrt(usual)),
        signal=float(abs(beta[0]) * np.sqrt(np.median(used.gram[:, THETA, THETA]) / used.samples)),
        slip=slip,
        metres=metres,
        unequal=geometry.unequal or bool({Y_PUMP, Y_SIDE} & set(shared)),
        scale_sd=float(np.sqrt(max(inverse[0, 0], 0.0) * usual)),
        geometry=geometry,
        side=side,
        by_side=by_side,
    )


def with_between(fit: BalanceFit, later: BalanceBlocks) -> BalanceFit:
    """Return the fit with the conductances, by its coefficients, of `later` blocks: half a block after its own.

    Only where slopes are kept, or motion and the integral of dp go together and blocks are cycles: else it is what
    swings that tells a conductance, and half-way it is no other.
    """
    if not (fit.keeps_slopes or fit.goes_together) or not len(later):
        return fit
    whole = fit.swinging is not None
    later = later.whole() if whole else later.with_slopes() if fit.keeps_slopes else later
    blocks = _turned(later, _turn(later.gram.shape[1], fit.side, fit._counted, whole))
    shared = list(fit.columns)
    own = np.maximum(blocks.gram[:, I_AB, I_AB], np.finfo(float).tiny)
    slope = (blocks.gram[:, I_AB, Y] - blocks.gram[:, I_AB][:, shared] @ fit.beta) / own
    left = _left(_displaced(_beyond(_beyond(blocks.gram, I_AB), I_ROOT), shared), fit.beta)
    keep = _moving(blocks) & (left <= _SPOILT**2 * fit.residual**2 * max(1, blocks.samples - 4))
    keep &= (blocks.t > fit.blocks.t[0]) & (blocks.t < fit.blocks.t[-1])
    if np.count_nonzero(keep) < _MOST_BETWEEN * len(fit.blocks):
        return fit
    return replace(fit, between=Conductances(blocks.t[keep], -fit.sense * slope[keep]))


def _sense(blocks: BalanceBlocks, slope: Array, beta: Array, shared: list[int]) -> int:
    """Return 1 where p_A - p_B rises as the piston is pushed towards positive A x, -1 where channels count otherwise.

    Stored oil takes volume from the motion whatever the signs of the encoders are; where its share is not clear, the
    pressure works along the motion on the whole (friction).
    """
    stored = blocks.stored[:, Y] - beta[0] * blocks.stored[:, THETA] - slope * blocks.stored[:, I_AB]
    apart = {Y_PUMP, Y_SIDE, STORED_B, STORED_X_A, STORED_X_B}
    unequal = [j for j, column in enumerate(shared) if column in apart]
    stored -= blocks.stored[:, shared][:, unequal] @ beta[unequal]
    deviation = float(np.std(stored)) / np.sqrt(max(1, stored.size - 1))
    mean = float(np.mean(stored))
    if abs(mean) > _SURE * deviation:
        return 1 if mean < 0 else -1
    return 1 if float(np.sum(blocks.motion)) >= 0 else -1


def discriminate(fit: BalanceFit, onset: float, rise: float, *, within: float) -> dict[str, float]:
    """Compare the explanations of a rise of the conductance at `onset` [s] over `rise` [s].

    Returns twice the log likelihood by which each explains the blocks better than a laminar leak past the piston:
    `orifice` (past the piston, with the root of the pressure difference), `scale` (no leak: displacement or the reading
    of an encoder changed by a factor), `pump` (with the pressure difference at the pump's ports, where it is recorded).
    Near 0: the data do not tell.

    The coefficient of the other integral moves by nothing if the leak is laminar and past the piston, and by all of the
    leak if it is the other (`moved_share`). The scatter of the blocks, which knows the colour of the noise, judges
    between the two (Student's likelihoods).
    """
    evidence = {}
    for name, column in (("orifice", I_ROOT), ("scale", THETA), ("pump", I_12)):
        moved = moved_share(fit, column, onset, rise, within=within)
        if moved is None:
            continue
        z = np.array([moved.share, moved.share - 1.0]) / max(moved.deviation, np.finfo(float).tiny)
        here, there = (moved.freedom + 1) * np.log1p(z**2 / moved.freedom)
        evidence[name] = float(here - there)
    return evidence


class MovedShare(NamedTuple):
    """By how much of a leak the coefficient of another column moved.

    `share` of the whole leak and its `deviation` [1] by the scatter of the blocks, with so much `freedom`; `noise`:
    squares of the noise in the integral of dp_AB over those of the column beyond it.
    """

    share: float
    deviation: float
    freedom: int
    noise: float


def moved_share(fit: BalanceFit, column: int, onset: float, rise: float, *, within: float) -> MovedShare | None:
    """Return by how much of a rise at `onset` [s] over `rise` [s] the coefficient of a column moved.

    In each block within `within` seconds of the rise the column is fitted beside the integral of dp_AB; blocks that the
    rise passes through do not count. None where too few are left, or the column is not recorded or shows nothing of its
    own. A leak past the piston may follow either law: what is taken for the pump's is beyond both of its integrals.
    """
    t, half = fit.blocks.t, 0.5 * fit.blocks.seconds
    near = np.abs(t - onset - 0.5 * rise) < within + 0.5 * rise
    before, after = near & (t + half <= onset), near & (t - half >= onset + rise)
    gram, shared, beta = fit.blocks.gram, list(fit.columns), fit.beta
    recorded = column not in (DP_12, I_12) or bool(np.any(fit.blocks.noise_12))
    if min(before.sum(), after.sum()) < 3 or not recorded:
        return None
    rest = _beyond(gram, I_AB)
    if column == I_12:
        rest = _beyond(rest, I_ROOT)
    own = np.maximum(rest[:, column, column], np.finfo(float).tiny)
    if column == I_12 and np.median(own[before | after]) < _APART * _noise_of_integrals(fit.blocks):
        return None
    b = -fit.sense * (rest[:, column, Y] - rest[:, column][:, shared] @ beta) / own
    shown = gram[:, column, I_AB] / np.maximum(gram[:, I_AB, I_AB], np.finfo(float).tiny)
    whole = float(np.mean(fit.g[after]) - np.mean(fit.g[before])) / float(np.mean(shown[after]))
    moved = float(np.mean(b[after]) - np.mean(b[before]))
    deviation = np.sqrt(np.var(b[after], ddof=1) / after.sum() + np.var(b[before], ddof=1) / before.sum())
    if column == THETA:  # where nearly all flow leaks, noise of dp, integrated, is no small part of the motion
        taken = fit.g**2 * _noise_of_integral(fit.blocks, fit.blocks.noise)
        deviation = np.hypot(deviation, np.sqrt(np.mean(taken[after]) / np.mean(own[after])))
    else:
        leaning = rest[:, column, THETA] / own
        deviation = np.hypot(deviation, fit.doubt * (np.mean(leaning[after]) - np.mean(leaning[before])))
    size = max(abs(whole), np.finfo(float).tiny)
    freedom = int(before.sum() + after.sum()) - 2
    noise = _noise_of_integral(fit.blocks, fit.blocks.noise) * shown**2 / own
    return MovedShare(moved / whole if whole else 0.0, float(deviation) / size, freedom, float(np.mean(noise[after])))
