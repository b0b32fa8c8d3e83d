"""The fitted parameters followed through a record, block by block, and a step of the leak's conductance in them.

In every block the model is linear about the block's own parameters: its information matrix N_b and right side r_b come
from the slopes of dp. The parameters theta_b wander from block to block (a random walk, each with a strength that
machines have), so that the whole record is one normal model with precision matrix Lambda (block tridiagonal). A step d
of G after block k adds N_b e_G d to the right sides of all later blocks; with everything else eliminated its estimate
is s_k / I_k with variance 1 / I_k, and z_k = s_k / sqrt(I_k) is standard normal where nothing steps, with a known
correlation between any two instants. A step of an orifice's coefficient, which sound blocks do not have, is estimated
in the same way from the slopes of dp for it.

Sources: A. C. Harvey, Forecasting, Structural Time Series Models and the Kalman Filter, 1989, ch. 4; P. de Jong, J.
Penzer, Diagnosing shocks in time series, JASA 93 (1998) 796-806.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.pressure_model.chain import Chain, Drifting
from sealscope.diagnosis.pressure_model.fit import LARGEST_SIDE, steps_of
from sealscope.diagnosis.pressure_model.model import (
    BIAS,
    C_C,
    F_C,
    F_CFR,
    F_V,
    GAIN,
    K_BRK,
    LEAD,
    OFFSET,
    ORIFICE,
    SIDE,
    SOUND,
    STROKE,
    DrivenModel,
    G,
    K,
)
from sealscope.recordings.recording import Array

DIVERGED = "the model of the rig diverges"
#: How far each parameter may wander in 90 s (standard deviation): shares of its value, lead in s, G in m^3/(s Pa).
WANDER = {GAIN: 2e-3, K: 0.03, F_C: 0.06, F_V: 0.06, K_BRK: 0.02, C_C: 0.02}
WANDER_REST = {LEAD: 1e-4, G: 3e-14, F_CFR: 2e-8, STROKE: 0.02, OFFSET: 0.05, SIDE: 0.01}
_WANDER_SECONDS = 90.0
#: The bias of the speed settles within a minute of a start: this share of the command's speed in 6 s.
_WANDER_BIAS = 0.003
#: Where the record's mean parameters may be, around the first fit (standard deviations as above).
ANCHOR = {GAIN: 0.02, K: 0.1, F_C: 0.1, F_V: 0.15, K_BRK: 0.1, C_C: 0.15}
ANCHOR_REST = {LEAD: 5e-4, G: 1.5e-12, F_CFR: 5e-7, STROKE: 0.3, OFFSET: 0.2, SIDE: 0.1}
#: How far oil that warms takes them from the first block to the last (standard deviation, over a course that is even,
#: half of it besides over one that bends): shares, and G in m^3/(s Pa).
DRIFT = {K: 0.1, F_C: 0.15, F_V: 0.4, K_BRK: 0.1, C_C: 0.1}
DRIFT_REST = {G: 3e-13}
_PASSES = 10
#: Blocks are stuck whose residual is by so many of its deviations larger than the others', or before or after which
#: the stiffness leaps by so many deviations of its walk: they are set between their neighbours, at one of these biases
#: of the speed, in units of the bias's own wandering, and followed once more.
_STUCK, _LEAPS, _BIASES = 3.0, 1.7, np.array([0.0, -0.25, 0.25, -0.5, 0.5, -1.0, 1.0, 2.0])
#: Shares of a Gauss-Newton step that are looked at first, those that are tried side by side where the whole one is not
#: the best of these, and the fall of the cost to go on for.
_FIRST_SHARES = (1.0, 0.5)
_SHARES = np.array([1.0, 0.85, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 1.2, 1.4])
_ENOUGH = 4.0
#: Slopes of coarse steps do as long as a step gains this share of what they promise.
_KEPT = 0.5
#: How far the parameters may wander in the first passes, times the usual: the record's mean comes first, so that what
#: is left in a block is small and the model is linear over it.
_LEASHES = (0.1, 0.3, 1.0)
#: Wandering that is tried, times the usual one: the likelihood chooses.
SCALES = (1.0, 2.0, 4.0)
#: What wanders: the parameters of a sound machine and a constant of dp.
SIZE = SOUND + 1


@dataclass(frozen=True)
class Law:
    """What a leak of unit size adds: `laminar` to G [m^3/(s Pa)], `orifice` to its coefficient [m^3/(s Pa^0.5)]."""

    laminar: float
    orifice: float

    @property
    def parts(self) -> tuple[tuple[int, float], ...]:
        """The parameters that rise, and by how much with the size."""
        return tuple((k, each) for k, each in ((G, self.laminar), (ORIFICE, self.orifice)) if each != 0.0)

    @property
    def name(self) -> str:
        """The law in words."""
        return {(True, False): "a worn seal", (False, True): "an orifice"}.get(
            (self.laminar != 0.0, self.orifice != 0.0), "a worn seal and an orifice"
        )

    def flow(self, drop: Array) -> float:
        """Return the mean flow [m^3/s] of a leak of unit size at the pressure differences `drop` (n,) [Pa]."""
        size = np.abs(drop)
        return float(self.laminar * np.mean(size) + self.orifice * np.mean(np.sqrt(size)))


#: A leak is a gap, or an orifice.
WORN_SEAL, HOLE = Law(1.0, 0.0), Law(0.0, 1.0)
LAWS = (WORN_SEAL, HOLE)


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

    Blocks between `edges` (b + 1,) [samples]; parameters `path` (b, 14) about which the model is linear; `N` (b, p, p),
    `r` (b, p) information in units of `units` (p,), the last a constant of dp; `N_all`, `r_all` with that on an
    orifice; `variance` [Pa^2] of the residual and of each block's (b,); `misfit` [Pa^2]: sum of squares of what is left
    of dp; `strain`: chi square of the wandering; `start` (5,): the state at the first sample.
    """

    edges: NDArray[np.int64]
    path: Array
    N: Array
    r: Array
    N_all: Array
    r_all: Array
    units: Array
    variance: float
    block_variance: Array
    anchor: Array
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
        return Rise(along[:, _WANDERING], along @ at, self.r_all @ at, unit)


def _in_units(law: Law, theta: Array) -> tuple[Array, float]:
    """Return what a leak raises (15,), in units of the parameters, and the size of the leak that raises so much."""
    h = steps_of(theta)
    at = np.zeros(SIZE + 1)
    unit = float(h[law.parts[0][0]])
    for k, share in law.parts:
        at[k] = share * unit / h[k]
    return at, unit


def _deviations(theta: Array, shares: dict[int, float], rest: dict[int, float]) -> Array:
    return np.array([shares.get(k, 0.0) * abs(theta[k]) + rest.get(k, 0.0) for k in range(SOUND)])


def wandering(theta: Array, seconds: float, speed: float) -> Array:
    """Return the standard deviation (13,) by which the parameters of a sound machine wander in so many seconds."""
    walk = _deviations(theta, WANDER, WANDER_REST)
    walk *= np.sqrt(seconds / _WANDER_SECONDS)
    walk[BIAS] = _WANDER_BIAS * speed * np.sqrt(seconds / 6.0)
    return walk


def wander(theta: Array, units: Array, seconds: float, speed: float) -> Array:
    """Return the standard deviation (p,) of the walk from block to block, in `units`."""
    return np.append(wandering(theta, seconds, speed), 1500.0 * np.sqrt(seconds / _WANDER_SECONDS)) / units


def drift_courses(theta: Array, units: Array, blocks: int) -> Array:
    """Return what oil that warms adds to the parameters (b, p, q), in `units`.

    Each drifts over an even course and over one that bends.
    """
    deviation = np.append(_deviations(theta, DRIFT, DRIFT_REST), 0.0) / units
    drifting = np.flatnonzero(deviation)
    tau = np.linspace(-0.5, 0.5, blocks)
    shapes = np.column_stack([tau, 0.5 * 6.0 * (tau**2 - np.mean(tau**2))])
    courses = np.zeros((blocks, units.size, drifting.size, 2))
    courses[:, drifting, np.arange(drifting.size)] = deviation[drifting, None] * shapes[:, None]
    return courses.reshape(blocks, units.size, -1)


def _anchor(theta: Array, units: Array) -> Array:
    """Return the weight (p,) of the first fit on the record's mean parameters."""
    deviation = _deviations(theta, ANCHOR, ANCHOR_REST)
    weight = np.zeros(SIZE)
    known = deviation > 0
    weight[:SOUND][known] = (units[:SOUND][known] / deviation[known]) ** 2
    return weight


def right_sides(r: Array, anchor: Array, centre: Array) -> Array:
    """Return the right sides (b, p) of the blocks with the first fit's weight `anchor` (p,) on `centre` (p,)."""
    return r + anchor * centre / len(r)


def track(
    model: DrivenModel,
    dp: Array,
    edges: NDArray[np.int64],
    theta: Array,
    start: Array,
    skip: int,
    rise: tuple[Law, int] | None = None,
    begin: Track | Array | None = None,
    *,
    seen: NDArray[np.bool_] | None = None,
    size: float = 0.0,
    shown: Array | None = None,
) -> Track:
    """Follow the parameters from the first fit `theta` (14,) through blocks between `edges` of the whole record.

    `start` (5,): the model's state at the first sample; `rise`: the law of a leak of the size that suits, and after
    which block it is open; `begin`: a path (b, 14) to begin at, or a track of the same blocks that is linear about its
    own, the first fit by default; `seen` (b,): blocks that count (default: all), through the others the parameters
    wander unseen; `shown` (n,): what the model shows where it begins. Blocks are linearised about their own parameters,
    until these stand still, by slopes of coarse steps until the last time. The trend of the speed's bias within a block
    is eliminated.
    """
    blocks = edges.size - 1
    seen = np.ones(blocks, dtype=bool) if seen is None else seen
    n = dp.size
    segment = np.clip(np.searchsorted(edges, np.arange(n), side="right") - 1, 0, blocks - 1).astype(np.int64)
    h = steps_of(theta)
    units = np.append(h[:SOUND], 1.0)
    seconds = float(np.median(np.diff(edges))) / model.rate
    speed = model.speed_amplitude(theta)
    walk = np.tile(wander(theta, units, seconds, speed), (blocks - 1, 1))
    anchor = _anchor(theta, units)
    leashes = _LEASHES if begin is None else _LEASHES[-1:]
    centre = np.append(theta[:SOUND] / h[:SOUND], 0.0)
    known = begin if isinstance(begin, Track) else None
    path = np.tile(theta, (blocks, 1)) if begin is None else known.path if known is not None else np.asarray(begin)
    limits = [slice(max(int(edges[b]), skip), int(edges[b + 1])) for b in range(blocks)]
    counts = np.array([here.stop - here.start - SIZE - 1 for here in limits])
    # where a leak is open, one of unit size
    risen, unit = np.zeros(path.shape), 1.0
    if rise is not None:
        at, unit = _in_units(rise[0], theta)
        risen[rise[1] + 1 :] = at[:-1] * h
        size /= unit

    begins, end = np.array([here.start for here in limits]), limits[-1].stop

    def misfits(shown: Array) -> Array:
        rest = dp[begins[0] : end] - shown[..., begins[0] : end]
        sums, squares = (np.add.reduceat(each, begins - begins[0], axis=-1) for each in (rest, rest**2))
        return np.asarray((squares - sums**2 / (counts + SIZE + 1)) * seen)

    def strain(at: Array, walk: Array) -> float:
        at = at[:, :SOUND] / h[:SOUND]
        steps = np.diff(at, axis=0) / walk[:, :-1]
        off = at.mean(axis=0) - centre[:-1]
        return float(np.sum(steps**2)) + float(anchor[:-1] @ off**2)

    def freed(path: Array, stuck: NDArray[np.bool_]) -> Array:
        """Return the path with stuck blocks set between their neighbours, at the speed's bias that suits each best."""
        at, free = np.arange(blocks), np.flatnonzero(np.logical_not(stuck))
        between = np.column_stack([np.interp(at, free, path[free, k]) for k in range(path.shape[1])])
        tries = np.tile(between, (_BIASES.size, 1, 1))
        tries[:, :, BIAS] += _BIASES[:, None] * _WANDER_BIAS * speed
        runs = model.run(tries + size * risen, segment, np.tile(start, (_BIASES.size, 1)))
        best = np.argmin(misfits(runs), axis=0)
        return np.where(stuck[:, None], tries[best, at], path)

    rows, trend = np.ones((SIZE + 3, n)), np.zeros(n)
    for here in limits:
        trend[here] = np.linspace(-1.0, 1.0, here.stop - here.start)

    def linear(shown: Array, moved: Array, at: Array, strained: float) -> Track:
        """Return the blocks, linear about the path `at` (b, 14), where the model shows (n,) [Pa].

        `moved` (15, n): what it shows there, in steps of slopes, and for a unit more of each parameter; `strained`: chi
        square of the wandering.
        """
        np.subtract(moved[1:], moved[0], out=rows[: h.size])
        np.multiply(rows[BIAS], trend, out=rows[-2])
        np.subtract(dp, shown, out=rows[-1])
        N, r, squares = _normal(rows, limits, at / h)
        variance = float(squares[seen].sum() / counts[seen].sum())
        N, r = N * seen[:, None, None], r * seen[:, None]
        if not (np.all(np.isfinite(N)) and np.all(np.isfinite(r)) and np.isfinite(variance)):
            raise FloatingPointError(DIVERGED)
        return Track(
            edges,
            at,
            N[:, _WANDERING[:, None], _WANDERING] / variance,
            r[:, _WANDERING] / variance,
            N / variance,
            r / variance,
            units,
            variance,
            np.where(seen, squares / counts, variance),
            np.concatenate([anchor, centre]),
            seconds,
            float(misfits(shown).sum()),
            strained,
            start,
        )

    now = model if known is not None else model.coarse(theta)
    lack: Array | float = 0.0

    def sets(shares: Sequence[float] | Array, move: Array, grown: float) -> Array:
        """Return the parameters (runs, b, 14) at those shares of a move and of what the leak grows with it."""
        each = np.asarray(shares)[:, None, None]
        return np.asarray(path + each * move + (size + each * grown) * risen)

    def looked(at: Array, others: Array) -> tuple[Array, Array]:
        """Return what the model shows at `at` (b, 14) and for a step of each parameter, and at `others`."""
        slopes = np.tile(at, (h.size + 1, 1, 1))
        for k in range(h.size):
            slopes[k + 1, :, k] += h[k]
        every = np.concatenate([slopes, others])
        runs = now.run(every, segment, np.tile(start, (len(every), 1)))
        return runs[: h.size + 1], runs[h.size + 1 :]

    before: tuple[float, float, Track] | None = None
    last, number = _PASSES, 0
    runs: Array | None = None
    good: Track | None = None
    nothing = np.zeros(path.shape)
    while True:
        allowed = leashes[min(number, len(leashes) - 1)] * walk
        at = path + size * risen
        if known is not None:
            followed, known = replace(known, strain=strain(path, allowed)), None
        else:
            if runs is None:
                runs, _ = looked(at, sets([], nothing, 0.0))
                if now is not model:
                    exact = model.run(at[None], segment, start[None].copy())[0] if shown is None else shown
                    lack = exact - runs[0]
            try:
                followed = linear(runs[0] + lack, runs, at, strain(path, allowed))
            except FloatingPointError:
                # beside where it shows something finite the model diverges: what was there before is all there is
                if now is model and good is None:
                    raise
                if now is model and good is not None:
                    return good
                now, lack, runs, shown = model, 0.0, None, None
                continue
        runs = shown = None
        good = followed
        chain, right = Chain(followed.N, allowed, anchor), right_sides(followed.r, anchor, centre).reshape(-1, 1)
        if rise is None:
            solved, fitted = chain.solve(right), 0.0
        else:
            solved, fitted = _with_rise(chain, right, followed.rise(rise[0]), rise[1] + 1)
        solved, fitted = solved.reshape(blocks, SIZE), max(0.0, fitted)
        fresh = np.column_stack([_held(solved[:, :SOUND] * h[:SOUND], theta), path[:, SOUND:]])
        further = np.column_stack([(fresh + fitted * risen - at) / h, solved[:, -1]])
        promised = followed.strain - strain(fresh, allowed) + followed.fall(at / h, further)
        apart, strained = followed.misfit, followed.strain
        if number + 1 < len(leashes) or promised > _ENOUGH:
            # the whole step is looked at with its slopes, as it is taken nearly always, beside two shorter ones
            move, grown, before_it = fresh - path, fitted - size, apart / followed.variance + strained
            shares = np.array(_FIRST_SHARES)
            there, others = looked(sets(shares[:1], move, grown)[0], sets(shares[1:], move, grown))
            reached = misfits(np.concatenate([there[:1], others]) + lack).sum(axis=1)
            costs = reached / followed.variance + np.array([strain(path + each * move, allowed) for each in shares])
            whole = bool(before_it - costs[0] > _KEPT * promised)
            if not (whole or np.any(before_it - costs > _KEPT * promised)):
                shares = _SHARES
                tries = now.run(sets(shares, move, grown), segment, np.tile(start, (shares.size, 1)))
                reached = misfits(tries + lack).sum(axis=1)
                costs = reached / followed.variance + np.array([strain(path + each * move, allowed) for each in shares])
            if np.all(np.isnan(costs)):
                raise FloatingPointError(DIVERGED)
            best = 0 if whole else int(np.nanargmin(costs))
            gained = before_it - costs[best]
            apart, strained = float(reached[best]), strain(path + shares[best] * move, allowed)
            if gained > 0.0:
                path, size = path + shares[best] * move, float(size + shares[best] * grown)
                runs = there if whole else None
            number += 1
            if number < len(leashes) or (gained > _ENOUGH and number < last):
                if now is not model and gained < _KEPT * promised:
                    now, lack, runs = model, 0.0, None
                continue
        if now is not model:
            now, lack, runs = model, 0.0, None
            continue
        if before is not None:
            return before[2] if (before[0] - apart) / followed.variance + before[1] < strained else followed
        stuck = _stuck(followed, counts, walk if rise is None else None)
        if not np.any(stuck) or np.all(stuck):
            return followed
        before = apart, strained, followed
        path, now, runs = freed(path, stuck), model.coarse(theta), None
        last = number + _PASSES


#: Rows of the normal equations of what wanders: all but the orifice.
_WANDERING = np.delete(np.arange(SIZE + 1), ORIFICE)


def _with_rise(chain: Chain, right: Array, rise: Rise, first: int) -> tuple[Array, float]:
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
    own = g[:, _WANDERING]
    try:
        inverse = np.linalg.pinv(H[:, _WANDERING[:, None], _WANDERING], rcond=1e-12, hermitian=True)
    except np.linalg.LinAlgError:  # numbers that are nearly too large
        raise FloatingPointError(DIVERGED) from None
    squares = products[:, -1, -1] - np.einsum("bi,bij,bj->b", own, inverse, own)
    return H, g + np.einsum("bij,bj->bi", H[:, :, :-1], at), squares


def _stuck(followed: Track, counts: Array, walk: Array | None) -> NDArray[np.bool_]:
    """Return the blocks (b,) that Gauss-Newton steps left in another minimum.

    Their residual is larger than that of the others, or the stiffness leaps, and then those on the shorter side of the
    leap; `walk` (b - 1, p) [units]: None where leaps are allowed.
    """
    here = followed.block_variance
    stuck = here > np.median(here) * (1.0 + _STUCK * np.sqrt(2.0 / counts))
    if walk is not None:
        leaps = np.abs(np.diff(followed.path[:, K])) / followed.units[K] / walk[:, K]
        after = int(np.argmax(leaps)) + 1
        if leaps[after - 1] > _LEAPS:
            stuck[after if 2 * after >= here.size else 0 : None if 2 * after >= here.size else after] = True
    return np.asarray(stuck)


def _held(path: Array, theta: Array) -> Array:
    """Hold the path within what the laws can be evaluated for."""
    for k in (GAIN, K, F_C, C_C):
        path[:, k] = np.clip(path[:, k], 0.3 * theta[k], 3.0 * theta[k])
    path[:, K_BRK] = np.maximum(path[:, K_BRK], 1.05)
    path[:, SIDE] = np.clip(path[:, SIDE], -LARGEST_SIDE, LARGEST_SIDE)
    return path


@dataclass(frozen=True, eq=False)
class PossibleLeak:
    """A leak that would explain the record.

    `law`; `after` which block; `size`, `deviation`: of that law; `cost`: minus twice the log likelihood but for a
    constant.
    """

    law: Law
    after: int
    size: float
    deviation: float
    cost: float


@dataclass(frozen=True, eq=False)
class ConductanceSteps:
    """A step of a leak after each block.

    `size`, `deviation` (b - 1,) of its law; `z` and their `correlation`; `level`
    (b,) the wandering G with no step, and its `level_deviation`; `scale` of the wandering that was chosen; `excess`:
    chi square of the blocks against the wandering, and its degrees of freedom.
    """

    size: Array
    deviation: Array
    z: Array
    correlation: Array
    level: Array
    level_deviation: Array
    scale: float
    excess: tuple[float, float]


def excess_of(steps: ConductanceSteps) -> float:
    """Return the chi square of the blocks over its degrees of freedom, beside the best step (Birge's ratio).

    Where blocks are so far from the model that nothing is left of its digits, and no step can explain more than there
    is, the ratio is infinite: nothing is followed there.
    """
    chi_square, freedom = steps.excess
    ratio = float((chi_square - np.max(np.abs(steps.z)) ** 2) / freedom)
    return ratio if ratio >= 0.0 else np.inf


def steps_in(
    followed: Track,
    theta: Array,
    speed: float,
    scales: Sequence[float] = SCALES,
    law: Law = WORN_SEAL,
    beside: PossibleLeak | None = None,
    warming: bool = False,
) -> ConductanceSteps:
    """Estimate a step of a leak of a law after each block.

    Everything else is free to wander as far as the likelihood chooses, and to drift as in oil that warms where
    `warming`. `beside` a leak of the same law, which is taken away first, the steps are further ones.
    """
    anchor, centre = np.split(followed.anchor, 2)
    walk = np.tile(wander(theta, followed.units, followed.seconds, speed), (len(followed.N) - 1, 1))
    rise, r = followed.rise(law), followed.r
    rise_right = rise.right
    if beside is not None:
        size = np.where(np.arange(len(r)) > beside.after, beside.size / rise.unit, 0.0)
        r, rise_right = r - size[:, None] * rise.cross, rise_right - size * rise.own
    right = right_sides(r, anchor, centre).reshape(-1, 1)
    blocks = len(followed.N)
    best: tuple[float, float, Chain | Drifting, float] | None = None
    courses = drift_courses(theta, followed.units, blocks) if warming else None
    for scale in scales:
        wandering_only = Chain(followed.N, scale * walk, anchor)
        chain = wandering_only if courses is None else Drifting(wandering_only, followed.N, courses)
        fit = float(np.vdot(right, chain.solve(right)))
        likelihood = fit - chain.log_determinant()
        likelihood -= 2.0 * np.sum(np.log(scale * walk))
        if best is None or likelihood > best[0] + 2.0:
            best = (float(likelihood), scale, chain, fit)
    assert best is not None
    _, scale, chain, fit = best
    free, ranks = float(np.sum(anchor * centre**2)), 0
    for N, r_block in zip(followed.N, r, strict=True):
        solution, _, rank, _ = np.linalg.lstsq(N, r_block, rcond=1e-12)
        free += float(r_block @ solution)
        ranks += int(rank)
    later_blocks = np.zeros((blocks, SIZE, blocks - 1))
    for k in range(1, blocks):
        later_blocks[k:, :, k - 1] = rise.cross[k:]
    inner = later_blocks.reshape(blocks * SIZE, blocks - 1)
    level_rows = np.zeros((blocks * SIZE, blocks))
    level_rows[np.arange(blocks) * SIZE + G, np.arange(blocks)] = 1.0
    solved = chain.solve(np.hstack([inner, right, level_rows]))
    steps, middle, levels = solved[:, : blocks - 1], solved[:, blocks - 1], solved[:, blocks:]
    later = np.cumsum(rise.own[::-1])[::-1]
    at = np.arange(1, blocks)
    information = later[np.maximum(at[:, None], at[None, :])] - inner.T @ steps
    right_sum = np.cumsum(rise_right[::-1])[::-1][1:]
    score = right_sum - inner.T @ middle
    own = np.sqrt(np.diagonal(information))
    unit = followed.units[G]
    return ConductanceSteps(
        score / own**2 * rise.unit,
        rise.unit / own,
        score / own,
        information / np.outer(own, own),
        middle.reshape(blocks, SIZE)[:, G] * unit,
        np.sqrt(levels[np.arange(blocks) * SIZE + G, np.arange(blocks)]) * unit,
        scale,
        (free - fit, float(ranks - SIZE + np.count_nonzero(anchor))),
    )
