"""The fitted parameters followed through a record, block by block.

In every block the model is linear about the block's own parameters: its information matrix N_b and right side r_b come
from the slopes of dp. The parameters theta_b wander from block to block (a random walk, each with a strength that
machines have), so that the whole record is one normal model with precision matrix Lambda (block tridiagonal).

Source: A. C. Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989, ch. 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.pressure_model.fit import LARGEST_SIDE, steps_of
from sealscope.diagnosis.pressure_model.model import BIAS, C_C, F_C, GAIN, K_BRK, ORIFICE, SIDE, SOUND, K
from sealscope.diagnosis.pressure_model.tracking.blocks import Blocks
from sealscope.diagnosis.pressure_model.tracking.chain import Chain, Drifting
from sealscope.diagnosis.pressure_model.tracking.laws import Law
from sealscope.diagnosis.pressure_model.tracking.wander import SIZE, WANDER_BIAS, anchor_weight, drift_courses, wander
from sealscope.recordings.recording import Array

DIVERGED = "the model of the rig diverges"
_PASSES = 10
#: Blocks are stuck whose residual is by so many of its deviations larger than the others', or before or after which
#: the stiffness leaps by so many deviations of its walk: they are set between their neighbours, at one of these biases
#: of the speed, in units of the bias's own wandering, and followed once more.
_STUCK, _LEAPS, _BIASES = 3.0, 1.7, np.array([0.0, -0.25, 0.25, -0.5, 0.5, -1.0, 1.0, 2.0])
#: Shares of a Gauss-Newton step that are looked at first, those that are tried side by side where the whole one is not
#: the best of these, and the fall of the cost to go on for.
_FIRST_SHARES = np.array([1.0, 0.5])
_SHARES = np.array([1.0, 0.85, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 1.2, 1.4])
_ENOUGH = 4.0
#: Slopes of coarse steps do as long as a step gains this share of what they promise.
_KEPT = 0.5
#: How far the parameters may wander in the first passes, times the usual: the record's mean comes first, so that what
#: is left in a block is small and the model is linear over it.
_LEASHES = (0.1, 0.3, 1.0)
#: Rows of the normal equations of what wanders: all but the orifice.
WANDERING = np.delete(np.arange(SIZE + 1), ORIFICE)


@dataclass(frozen=True, eq=False)
class Rise:
    """What a leak of a law does in a block, in the model that is linear there.

    `cross` (b, p): information shared with what wanders; `own` (b,), `right` (b,): its own information and right side;
    `unit`: of its size.
    """

    cross: Array
    own: Array
    right: Array
    unit: float


@dataclass(frozen=True, eq=False)
class Track:
    """Parameters of a record, followed.

    Parameters `path` (b, 14) about which the model is linear; `N` (b, p, p), `r` (b, p) information in units of `units`
    (p,), the last a constant of dp; `N_all`, `r_all` with that on an orifice; `variance` [Pa^2] of the residual and of
    each block's (b,); weight `anchor` (p,) of the first fit `centre` (p,) on the record's means; `seconds` of a block;
    `misfit` [Pa^2]: sum of squares of what is left of dp; `strain`: chi square of the wandering; `start` (5,): the
    state at the first sample.
    """

    path: Array
    N: Array
    r: Array
    N_all: Array
    r_all: Array
    units: Array
    variance: float
    block_variance: Array
    anchor: Array
    centre: Array
    seconds: float
    misfit: float
    strain: float
    start: Array

    def fall(self, at: Array, further: Array) -> float:
        """Return by how much the misfit [its variance] falls from parameters `at` (b, 14) [units] to `further` ones.

        `further` (b, 15): the steps to those [units], and of the constant of dp.
        """
        slope = self.r_all - np.einsum("bij,bj->bi", self.N_all[:, :, :-1], at)
        fallen = 2.0 * further * slope - further * np.einsum("bij,bj->bi", self.N_all, further)
        # the misfit is that beside a constant of its own
        counted = self.N_all[:, -1, -1] > 0.0
        return float(fallen.sum() - np.sum(slope[counted, -1] ** 2 / self.N_all[counted, -1, -1]))

    def rise(self, law: Law) -> Rise:
        """Return what a leak of a law does."""
        at, unit = _in_units(law, self.path[0])
        along = self.N_all @ at
        return Rise(along[:, WANDERING], along @ at, self.r_all @ at, unit)


def _in_units(law: Law, theta: Array) -> tuple[Array, float]:
    """Return what a leak raises (15,), in units of the parameters, and the size of the leak that raises so much."""
    h = steps_of(theta)
    at = np.zeros(SIZE + 1)
    unit = float(h[law.parts[0][0]])
    for k, share in law.parts:
        at[k] = share * unit / h[k]
    return at, unit


def right_sides(r: Array, anchor: Array, centre: Array) -> Array:
    """Return the right sides (b, p) of the blocks with the first fit's weight `anchor` (p,) on `centre` (p,)."""
    return r + anchor * centre / len(r)


@dataclass(frozen=True, eq=False)
class Following:
    """What stays the same while a record is followed.

    The first fit `theta` (14,), the state (5,) at the first sample, after which block a leak of which law is open, and
    whether the parameters may drift as in oil that warms.
    """

    blocks: Blocks
    theta: Array
    start: Array
    rise: tuple[Law, int] | None
    warming: bool

    @cached_property
    def coarse(self) -> Blocks:
        """The blocks with a model in steps twice as long, themselves where that would be too long."""
        model = self.blocks.model.coarse(self.theta)
        return self.blocks if model is self.blocks.model else replace(self.blocks, model=model)

    @cached_property
    def h(self) -> Array:
        """Steps (14,) of the slopes."""
        return steps_of(self.theta)

    @cached_property
    def units(self) -> Array:
        """Units (p,) of what wanders."""
        return np.append(self.h[:SOUND], 1.0)

    @cached_property
    def walk(self) -> Array:
        """Standard deviation (b - 1, p) of the walk from each block to the next [units]."""
        each = wander(self.theta, self.units, self.blocks.seconds, self.speed)
        return np.tile(each, (self.blocks.count - 1, 1))

    @cached_property
    def speed(self) -> float:
        """Amplitude of the speed that the command asks for."""
        return self.blocks.model.speed_amplitude(self.theta)

    @cached_property
    def anchor(self) -> Array:
        """Weight (p,) of the first fit on the record's means."""
        return anchor_weight(self.theta, self.units)

    @cached_property
    def centre(self) -> Array:
        """The first fit (p,) [units]."""
        return np.append(self.theta[:SOUND] / self.h[:SOUND], 0.0)

    @cached_property
    def freedom(self) -> NDArray[np.int64]:
        """Degrees of freedom (b,) that are left in a block."""
        return self.blocks.lengths - SIZE - 1

    @cached_property
    def risen(self) -> Array:
        """What a leak of one step of its slope adds to the parameters (b, 14) where it is open."""
        risen = np.zeros((self.blocks.count, self.h.size))
        if self.rise is not None:
            risen[self.rise[1] + 1 :] = _in_units(self.rise[0], self.theta)[0][:-1] * self.h
        return risen

    @cached_property
    def _trend(self) -> Array:
        trend = np.zeros(self.blocks.dp.size)
        for part in self.blocks.parts:
            trend[part] = np.linspace(-1.0, 1.0, part.stop - part.start)
        return trend

    @cached_property
    def _rows(self) -> Array:
        """Scratch (17, n): slopes, a constant, the trend of the speed's bias, and what is left of dp."""
        return np.ones((SIZE + 3, self.blocks.dp.size))

    @cached_property
    def courses(self) -> Array:
        """What oil that warms adds (b, p, q) to the parameters [units]."""
        return drift_courses(self.theta, self.units, self.blocks.count)

    def strain(self, path: Array, leash: float) -> float:
        """Return the chi square of the wandering, which may be `leash` times the usual, and of the drift."""
        at, walk = path[:, :SOUND] / self.h[:SOUND], (leash * self.walk)[:, :-1]
        steps = (np.diff(at, axis=0) / walk).ravel()
        off = at.mean(axis=0) - self.centre[:-1]
        strain = float(steps @ steps) + float(self.anchor[:-1] @ off**2)
        if self.warming:
            drift = (np.diff(self.courses[:, :-1], axis=0) / walk[:, :, None]).reshape(steps.size, -1)
            shared = drift.T @ steps
            strain -= float(shared @ np.linalg.solve(np.eye(shared.size) + drift.T @ drift, shared))
        return strain

    def linear(self, shown: Array, moved: Array, at: Array, strain: float) -> Track:
        """Return the blocks, linear about the path `at` (b, 14), where the model shows (n,) [Pa].

        `moved` (15, n): what it shows there, in steps of slopes, and for a unit more of each parameter.
        """
        rows, seen = self._rows, self.blocks.seen
        np.subtract(moved[1:], moved[0], out=rows[: self.h.size])
        np.multiply(rows[BIAS], self._trend, out=rows[-2])
        np.subtract(self.blocks.dp, shown, out=rows[-1])
        N, r, squares = _normal(rows, self.blocks.parts, at / self.h)
        variance = float(squares[seen].sum() / self.freedom[seen].sum())
        N, r = N * seen[:, None, None], r * seen[:, None]
        if not (np.all(np.isfinite(N)) and np.all(np.isfinite(r)) and np.isfinite(variance)):
            raise FloatingPointError(DIVERGED)
        return Track(
            at,
            N[:, WANDERING[:, None], WANDERING] / variance,
            r[:, WANDERING] / variance,
            N / variance,
            r / variance,
            self.units,
            variance,
            np.where(seen, squares / self.freedom, variance),
            self.anchor,
            self.centre,
            self.blocks.seconds,
            float(self.blocks.misfits(shown).sum()),
            strain,
            self.start,
        )

    def looked(self, now: Blocks, at: Array, others: Array) -> tuple[Array, Array]:
        """Return what the model shows at `at` (b, 14) and for a step of each parameter, and at `others`."""
        slopes = np.tile(at, (self.h.size + 1, 1, 1))
        for k in range(self.h.size):
            slopes[k + 1, :, k] += self.h[k]
        runs = now.run(np.concatenate([slopes, others]), self.start)
        return runs[: self.h.size + 1], runs[self.h.size + 1 :]

    def solved(self, linear: Track, leash: float) -> tuple[Array, Array, float]:
        """Return the path (b, 14) that is the likeliest where blocks are linear, a constant of dp (b,), and the leak.

        The leak's size is in steps of its slope, and not negative.
        """
        wandering = Chain(linear.N, leash * self.walk, self.anchor)
        chain = Drifting(wandering, linear.N, self.courses) if self.warming else wandering
        right, size = right_sides(linear.r, self.anchor, self.centre).reshape(-1, 1), 0.0
        if self.rise is None:
            solution = chain.solve(right)
        else:
            solution, size = _with_rise(chain, right, linear.rise(self.rise[0]), self.rise[1] + 1)
        solution = solution.reshape(self.blocks.count, SIZE)
        return _held(solution[:, :SOUND] * self.h[:SOUND], self.theta), solution[:, -1], max(0.0, size)

    def freed(self, path: Array, size: float, stuck: NDArray[np.bool_]) -> Array:
        """Return the path with stuck blocks set between their neighbours, at the speed's bias that suits each best."""
        at, free = np.arange(self.blocks.count), np.flatnonzero(np.logical_not(stuck))
        between = np.column_stack([np.interp(at, free, path[free, k]) for k in range(path.shape[1])])
        tries = np.tile(between, (_BIASES.size, 1, 1))
        tries[:, :, BIAS] += _BIASES[:, None] * WANDER_BIAS * self.speed
        best = np.argmin(self.blocks.misfits(self.blocks.run(tries + size * self.risen, self.start)), axis=0)
        return np.where(stuck[:, None], tries[best, at], path)

    def stuck(self, followed: Track) -> NDArray[np.bool_]:
        """Return the blocks (b,) that Gauss-Newton steps left in another minimum.

        Their residual is larger than that of the others, or, without a leak, the stiffness leaps: then those on the
        shorter side of the leap.
        """
        here = followed.block_variance
        stuck = here > np.median(here) * (1.0 + _STUCK * np.sqrt(2.0 / self.freedom))
        if self.rise is None:
            leaps = np.abs(np.diff(followed.path[:, K])) / followed.units[K] / self.walk[:, K]
            after = int(np.argmax(leaps)) + 1
            if leaps[after - 1] > _LEAPS:
                stuck[after if 2 * after >= here.size else 0 : None if 2 * after >= here.size else after] = True
        return np.asarray(stuck)


def track(
    blocks: Blocks,
    theta: Array,
    start: Array,
    rise: tuple[Law, int] | None = None,
    begin: Track | Array | None = None,
    *,
    size: float = 0.0,
    shown: Array | None = None,
    warming: bool = False,
) -> Track:
    """Follow the parameters from the first fit `theta` (14,) through the blocks of a record.

    `start` (5,): the model's state at the first sample; `rise`: the law of a leak of the size that suits, and after
    which block it is open; `begin`: a path (b, 14) to begin at, or a track of the same blocks that is linear about its
    own, the first fit by default; through blocks that do not count the parameters wander unseen; `size` to begin with;
    `shown` (n,): what the model shows where it begins; `warming`: they may drift besides, as in oil that warms. Blocks
    are linearised about their own parameters, until these stand still, by slopes of coarse steps until the last time.
    The trend of the speed's bias within a block is eliminated.
    """
    following = Following(blocks, theta, start, rise, warming)
    risen, strain = following.risen, following.strain
    if rise is not None:
        size /= _in_units(rise[0], theta)[1]
    leashes = _LEASHES if begin is None else _LEASHES[-1:]
    known = begin if isinstance(begin, Track) else None
    path = (
        np.tile(theta, (blocks.count, 1)) if begin is None else known.path if known is not None else np.asarray(begin)
    )
    now = blocks if known is not None else following.coarse
    lack: Array | float = 0.0
    runs: Array | None = None
    good: Track | None = None
    before: tuple[float, float, Track] | None = None
    last, number = _PASSES, 0

    def sets(shares: Array, move: Array, grown: float) -> Array:
        """Return the parameters (runs, b, 14) at those shares of a move and of what the leak grows with it."""
        each = shares[:, None, None]
        return np.asarray(path + each * move + (size + each * grown) * risen)

    while True:
        leash = leashes[min(number, len(leashes) - 1)]
        at = path + size * risen
        if known is not None:
            followed, known = replace(known, strain=strain(path, leash)), None
        else:
            if runs is None:
                runs, _ = following.looked(now, at, np.empty((0, *at.shape)))
                if now is not blocks:
                    lack = (blocks.run(at[None], start)[0] if shown is None else shown) - runs[0]
            try:
                followed = following.linear(runs[0] + lack, runs, at, strain(path, leash))
            except FloatingPointError:
                # beside where it shows something finite the model diverges: what was there before is all there is
                if now is blocks and good is None:
                    raise
                if now is blocks and good is not None:
                    return good
                now, lack, runs, shown = blocks, 0.0, None, None
                continue
        runs = shown = None
        good = followed
        fresh, constant, fitted = following.solved(followed, leash)
        fresh = np.column_stack([fresh, path[:, SOUND:]])
        further = np.column_stack([(fresh + fitted * risen - at) / following.h, constant])
        promised = followed.strain - strain(fresh, leash) + followed.fall(at / following.h, further)
        apart, strained = followed.misfit, followed.strain
        if number + 1 < len(leashes) or promised > _ENOUGH:
            # the whole step is looked at with its slopes, as it is taken nearly always, beside a shorter one
            move, grown, before_it = fresh - path, fitted - size, apart / followed.variance + strained
            shares = _FIRST_SHARES
            there, others = following.looked(now, sets(shares[:1], move, grown)[0], sets(shares[1:], move, grown))
            reached = blocks.misfits(np.concatenate([there[:1], others]) + lack).sum(axis=1)
            costs = reached / followed.variance + np.array([strain(path + each * move, leash) for each in shares])
            whole = bool(before_it - costs[0] > _KEPT * promised)
            if not (whole or np.any(before_it - costs > _KEPT * promised)):
                shares = _SHARES
                reached = blocks.misfits(now.run(sets(shares, move, grown), start) + lack).sum(axis=1)
                costs = reached / followed.variance + np.array([strain(path + each * move, leash) for each in shares])
            if np.all(np.isnan(costs)):
                raise FloatingPointError(DIVERGED)
            best = 0 if whole else int(np.nanargmin(costs))
            gained = before_it - costs[best]
            apart, strained = float(reached[best]), strain(path + shares[best] * move, leash)
            if gained > 0.0:
                path, size = path + shares[best] * move, float(size + shares[best] * grown)
                runs = there if whole else None
            number += 1
            if number < len(leashes) or (gained > _ENOUGH and number < last):
                if now is not blocks and gained < _KEPT * promised:
                    now, lack, runs = blocks, 0.0, None
                continue
        if now is not blocks:
            now, lack, runs = blocks, 0.0, None
            continue
        if before is not None:
            return before[2] if (before[0] - apart) / followed.variance + before[1] < strained else followed
        stuck = following.stuck(followed)
        if not np.any(stuck) or np.all(stuck):
            return followed
        before = apart, strained, followed
        path, now, runs = following.freed(path, size, stuck), following.coarse, None
        last = number + _PASSES


def _with_rise(chain: Chain | Drifting, right: Array, rise: Rise, first: int) -> tuple[Array, float]:
    """Return the solution with a rise in all blocks from the `first` on as one more unknown, and that rise."""
    cross = rise.cross.copy()
    cross[:first] = 0.0
    border = cross.reshape(-1)
    without, shared = chain.solve(np.hstack([right, border[:, None]])).T
    own, side = float(rise.own[first:].sum()), float(rise.right[first:].sum())
    size = (side - border @ without) / (own - border @ shared)
    return without - size * shared, float(size)


def _normal(rows: Array, limits: Sequence[slice], at: Array) -> tuple[Array, Array, Array]:
    """Return the normal equations of each block between `limits`.

    They are N (b, 15, 15) and r (b, 15) of the model that is linear about `at` (b, 14) [units], the last a constant
    of dp, and the sum of squares (b,) that nothing which wanders explains. `rows` (17, n): what a unit more of each
    parameter adds to dp, the constant, the trend of the speed's bias, which is eliminated, and dp less the model's.
    """
    size = len(rows) - 2
    products = np.array([rows[:, here] @ rows[:, here].T for here in limits])
    if not np.all(np.isfinite(products)):
        raise FloatingPointError(DIVERGED)
    trend = products[:, size]
    products -= trend[:, :, None] * trend[:, None, :] / trend[:, size, None, None]
    H, g = products[:, :size, :size], products[:, :size, -1]
    own = g[:, WANDERING]
    try:
        inverse = np.linalg.pinv(H[:, WANDERING[:, None], WANDERING], rcond=1e-12, hermitian=True)
    except np.linalg.LinAlgError:  # numbers that are nearly too large
        raise FloatingPointError(DIVERGED) from None
    squares = products[:, -1, -1] - np.einsum("bi,bij,bj->b", own, inverse, own)
    return H, g + np.einsum("bij,bj->bi", H[:, :, :-1], at), squares


def _held(path: Array, theta: Array) -> Array:
    """Hold the path within what the laws can be evaluated for."""
    for k in (GAIN, K, F_C, C_C):
        path[:, k] = np.clip(path[:, k], 0.3 * theta[k], 3.0 * theta[k])
    path[:, K_BRK] = np.maximum(path[:, K_BRK], 1.05)
    path[:, SIDE] = np.clip(path[:, SIDE], -LARGEST_SIDE, LARGEST_SIDE)
    return path
