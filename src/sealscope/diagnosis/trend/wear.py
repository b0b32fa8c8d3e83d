"""Wear over recordings: a mixed model of the level that each recording states, and a sequential test for its rise.

The level that recording i states at the time t_i is

    y_i = mu_l(i) + beta c_i + delta g(t_i) + d(t_i) + e_i,

mu of the group l that the recording belongs to (duty, sensors), a covariate c with a normal prior on beta, what changes
from day to day d, the recording's own error e_i of stated deviation s_i, and the change g: a step, ``g = [t >= t_j]``,
or a growth, ``g = max(t - t_(j-1), 0)``. d is normal with variance tau^2, of which a share r lasts, half of it for an
hour and half for a week: its covariance is ``tau^2 ((1 - r) [i = k] + r/2 sum_T exp(-|t_i - t_k|/T))``. tau has a
scaled inverse chi-square prior (`DayToDay`), r is uniform on a few values, and both are summed on a grid. mu has a flat
prior, and delta a half-normal one of some scales in units of tau. So every marginal likelihood has a closed form. With
L L' = cov(y), the rows of L^-1 y up to n are those of the first n recordings alone, and one factorisation serves all n.

The test is Shiryaev's and Roberts's: with the likelihood ratio LR_j(n) of a change after recording j - 1 against none,

    R_n = sum_(j <= n) w_j LR_j(n),   w_j = min(t_j - t_(j-1), longest wait),   alarm where R_n > A.

Without a change R_n - sum_(j <= n) w_j is a martingale, whatever the number of recordings, so that the mean time to a
false alarm is at least A: the threshold is that time itself. This holds for machines whose tau the prior describes.

Sources: M. Pollak, Optimal detection of a change in distribution, Annals of Statistics 13 (1985) 206-227, doi
10.1214/aos/1176346587 (Shiryaev-Roberts and its mean time); J. Shin, A. Ramdas, A. Rinaldo, E-detectors, New England
Journal of Statistics in Data Science 2 (2024) 229-260, doi 10.51387/23-NEJSDS51 (mixtures and unknown parameters);
Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), secs. 5.4 and 14.8 (grid of tau, regression with known
covariance); D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320-338, doi 10.1080/01621459.1977.10480998 (restricted
likelihood).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.recording import Array
from sealscope.signals.filters import IntArray

BoolArray: TypeAlias = NDArray[np.bool_]

#: Days of a month: a growth is stated per month.
MONTH = 365.25 / 12.0
#: Grid of tau, from a share of the prior's scale to so many times the larger of scale and scatter seen, and of r.
_LEAST, _MOST, _NODES = 0.1, 10.0, 14
_LASTING = (0.0, 0.5, 0.9)
#: How long what lasts does [days]: for an hour within a session (a machine warms up), for a week (weather, load).
_TIMES = (1.0 / 24.0, 7.0)
#: Recordings of a shorter time [days] state no growth by a month.
_LEAST_SPAN = 1.0
#: Scales of a step's prior in tau, and of a growth's: tau in so many typical intervals between recordings.
_STEPS, _INTERVALS = (2.0, 8.0, 40.0, 200.0), (0.05, 0.5, 4.0, 12.0, 48.0)
#: A single recording counts no further than so many deviations from those before it, until the next agrees ...
_HELD = 3.5
#: ... and it is left out where it is so far from those before and after it, in the same direction.
_ALONE = 5.0
#: Recordings on either side that such a recording is compared with.
_BESIDE = 3
#: Most recordings that are searched; neighbours of more are merged.
MOST = 240
#: Draws from the posterior for figures that have no closed form, and their seed.
_DRAWS, _SEED = 4000, 20
#: A wait for the next recording counts up to this time [days].
LONGEST_WAIT = 30.0
_TINY = 1e-10


@dataclass(frozen=True)
class Level:
    """Level that a recording states, and the standard error of it."""

    value: float
    error: float


@dataclass(frozen=True)
class DayToDay:
    """Prior on the standard deviation of the level from day to day: a `scale` with degrees of `freedom`."""

    scale: float
    freedom: float


@dataclass(frozen=True)
class WearPrior:
    """What is assumed of a machine: its scatter from day to day."""

    scatter: DayToDay


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels (n,) of n recordings in the order of their times.

    `t` [days]; `value`; `error`: standard deviation that each states of itself; `group` (n,): number of the group that
    shares a mean; `covariate` (n,) with the standard deviation `slope_sd` of its coefficient, 0 for none.
    """

    t: Array
    value: Array
    error: Array
    group: IntArray
    covariate: Array
    slope_sd: float = 0.0

    @classmethod
    def of(cls, t: Array, value: Array, error: Array | float, group: IntArray | None = None) -> Levels:
        """Return levels without a covariate, by default of a single group."""
        n = len(t)
        return cls(
            np.asarray(t, dtype=float),
            np.asarray(value, dtype=float),
            np.broadcast_to(np.asarray(error, dtype=float), n),
            np.zeros(n, dtype=np.int64) if group is None else np.asarray(group, dtype=np.int64),
            np.zeros(n),
        )

    def __len__(self) -> int:
        return self.t.size

    def part(self, rows: IntArray | slice) -> Levels:
        """Return some of the recordings."""
        t, value, error, covariate = (own[rows] for own in (self.t, self.value, self.error, self.covariate))
        return Levels(t, value, error, self.group[rows], covariate, self.slope_sd)

    @cached_property
    def interval(self) -> float:
        """Typical time between two recordings [days]."""
        waits = np.diff(self.t)
        waits = waits[waits > 0.0]
        return float(np.median(waits)) if waits.size else 1.0


@dataclass(frozen=True, eq=False)
class Path:
    """The sequential test.

    `log_R` (n,) after each recording; `log_share` (c,): logarithm of what each change has of it at the end; `change`
    (c,): the recording that shows each change first.
    """

    log_R: Array
    log_share: Array
    change: IntArray

    def alarm(self, threshold: float) -> int | None:
        """Return the first recording after which R is over a threshold, None where it never is."""
        over = np.flatnonzero(self.log_R > math.log(threshold))
        return int(over[0]) if over.size else None

    @property
    def likeliest(self) -> int:
        """The recording at which the likeliest change shows first."""
        return int(self.change[int(np.argmax(self.log_share))])


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Wear:
    """What the recordings of a segment say of its course.

    `now`: level after the last recording, without the day's own scatter; `growth`: by a month; `step`: size of a step,
    None where a growth is likelier, or nothing changed; `onset`: time of the change [days], None where there is none;
    `healthy`: where a recording of the machine before the change lies, in 95 of 100, about its mean; `scatter`:
    deviation from day to day; `limit`: the mean before the change and the rise that is allowed, None where none is
    stated; `reach`: days from the last recording until the level reaches it, infinite where it does not.
    """

    now: Interval
    growth: Interval
    step: Interval | None
    onset: Interval | None
    healthy: Interval
    scatter: float
    limit: float | None
    reach: Interval | None


def usual_scatter(levels: Levels, prior: WearPrior) -> float:
    """Return the deviation of a recording from its neighbours: their median step, shrunk towards the prior."""
    steps = np.abs(np.diff(levels.value))[np.diff(levels.group) == 0] / math.sqrt(2.0)
    known = prior.scatter.scale**2 + (float(np.mean(levels.error**2)) if len(levels) else 0.0)
    if steps.size == 0:
        return math.sqrt(known)
    seen = (1.4826 * float(np.median(steps))) ** 2
    return math.sqrt((prior.scatter.freedom * known + steps.size * seen) / (prior.scatter.freedom + steps.size))


def single_outliers(levels: Levels, prior: WearPrior) -> IntArray:
    """Return the recordings that lie apart from those before and after them, which agree."""
    far = _ALONE * usual_scatter(levels, prior)
    alone = []
    for k in range(len(levels)):
        same = np.flatnonzero(levels.group == levels.group[k])
        place = int(np.searchsorted(same, k))
        before, after = same[max(place - _BESIDE, 0) : place], same[place + 1 : place + 1 + _BESIDE]
        if before.size and after.size:
            apart = [levels.value[k] - float(np.median(levels.value[side])) for side in (before, after)]
            if apart[0] * apart[1] > 0.0 and min(map(abs, apart)) > far:
                alone.append(k)
    return np.array(alone, dtype=np.int64)


def _held(levels: Levels, prior: WearPrior) -> Array:
    """Return the values as each counts while it is the last one: within `_HELD` deviations of those before it.

    It counts whole where the one before it lies as far out, in the same direction.
    """
    held = levels.value.copy()
    for k in range(1, len(levels)):
        reach = _HELD * usual_scatter(levels.part(slice(0, k)), prior)
        before = levels.value[:k][levels.group[:k] == levels.group[k]][-_BESIDE:]
        if before.size:
            middle = float(np.median(before))
            apart, agreed = levels.value[k] - middle, before[-1] - middle
            if abs(apart) > reach and not (apart * agreed > 0.0 and abs(agreed) > reach):
                held[k] = middle + math.copysign(reach, apart)
    return held


def merged(levels: Levels) -> Levels:
    """Return at most `MOST` levels: neighbours of a group are averaged by their errors where there are more."""
    count = -(-len(levels) // MOST)
    if count <= 1:
        return levels
    rows: list[IntArray] = []
    begin = 0
    for k in range(1, len(levels) + 1):
        if k == len(levels) or k - begin == count or levels.group[k] != levels.group[begin]:
            rows.append(np.arange(begin, k))
            begin = k
    arrays = (levels.t, levels.value, levels.covariate)
    t, value, covariate = (np.array([float(values[own].mean()) for own in rows]) for values in arrays)
    error = np.array([float(np.sqrt(np.sum(levels.error[own] ** 2))) / own.size for own in rows])
    return Levels(t, value, error, levels.group[[own[0] for own in rows]], covariate, levels.slope_sd)


@dataclass(frozen=True, eq=False)
class _Node:
    """Sums of a node of the grid after each recording, level and covariate taken out.

    `log_prior`, `log_null` (n,): logarithm of its prior and of the marginal likelihood without a change; `a`, `b`
    (n, m): information on the size of each of m changes, and its product with the size that fits best; `inverse`
    (n, q, q), `S_xg` (n, q, m), `S_xy` (n, q): for the means.
    """

    tau: float
    log_prior: float
    log_null: Array
    a: Array
    b: Array
    inverse: Array
    S_xg: Array
    S_xy: Array


class _Model:
    """The mixed model of some levels with m possible changes; the values as they count while each is the last."""

    def __init__(self, levels: Levels, prior: WearPrior, changes: Array, *, sloping: bool = False) -> None:
        self.levels, self.prior, self.changes = levels, prior, changes
        self.held = _held(levels, prior)
        self.origin = float(levels.value[0])
        columns = [(levels.group == number).astype(float) for number in np.unique(levels.group)]
        precision = [0.0] * len(columns)
        if levels.slope_sd > 0.0 and np.ptp(levels.covariate) > 0.0:
            columns.append(levels.covariate)
            precision.append(levels.slope_sd**-2)
        if sloping:  # what may have grown before; its prior is wide
            columns.append(levels.t - levels.t[0])
            precision.append((10.0 * usual_scatter(levels, prior) / levels.interval) ** -2)
        self.columns, self.precision = np.stack(columns, axis=1), np.array(precision)

    def grid(self) -> list[tuple[float, float, float]]:
        """Return tau, r and the logarithm of their prior."""
        scale, freedom = self.prior.scatter.scale, self.prior.scatter.freedom
        apart = float(np.ptp(self.levels.value)) if len(self.levels) > 1 else 0.0
        tau = np.geomspace(_LEAST * scale, _MOST * max(scale, 0.3 * apart), _NODES)
        return [(float(s), r, -freedom * (math.log(s) + 0.5 * (scale / s) ** 2)) for s in tau for r in _LASTING]

    def nodes(self) -> list[_Node]:
        """Return the sums of every node."""
        from scipy.linalg import solve_triangular

        own = self.levels
        waits = np.abs(own.t[:, None] - own.t)
        lasting = np.mean([np.exp(-waits / time) for time in _TIMES], axis=0)
        right = np.column_stack([self.columns, own.value - self.origin, self.changes])
        q = self.columns.shape[1]
        result = []
        for tau, share, log_prior in self.grid():
            covariance = tau**2 * share * lasting
            covariance[np.diag_indices(len(own))] = tau**2 * (1.0 + _TINY) + own.error**2
            L = np.linalg.cholesky(covariance)
            z = solve_triangular(L, right, lower=True, check_finite=False)
            x, y, g = z[:, :q], z[:, q], z[:, q + 1 :]
            less = (own.value - self.held) / np.diag(L)  # what the last value is held back by
            S_xx = np.cumsum(x[:, :, None] * x[:, None, :], axis=0)
            S_xx[:, range(q), range(q)] += self.precision
            unseen = np.diagonal(S_xx, axis1=1, axis2=2) <= 0.0
            S_xx[:, range(q), range(q)] += unseen
            inverse = np.linalg.inv(S_xx)
            S_xy = np.cumsum(x * y[:, None], axis=0) - x * less[:, None]
            S_yy = np.cumsum(y * y) - y * y + (y - less) ** 2
            S_xg = np.cumsum(x[:, :, None] * g[:, None, :], axis=0)
            S_gg, S_gy = np.cumsum(g * g, axis=0), np.cumsum(g * y[:, None], axis=0) - g * less[:, None]
            fitted = inverse @ S_xg
            a = S_gg - np.einsum("nqm,nqm->nm", S_xg, fitted)
            b = S_gy - np.einsum("nq,nqm->nm", S_xy, fitted)
            nothing = a <= 1e-9 * S_gg
            a[nothing] = b[nothing] = 0.0
            rss = S_yy - np.einsum("nq,nqp,np->n", S_xy, inverse, S_xy)
            log_null = -np.cumsum(np.log(np.diag(L))) - 0.5 * (np.linalg.slogdet(S_xx)[1] + rss)
            result.append(_Node(tau, log_prior, log_null, a, b, inverse, S_xg, S_xy))
        return result


def _log_ratio(a: Array, b: Array, k: Array, sign: int) -> Array:
    """Return log E[exp(b delta - a delta^2/2)] for delta half-normal of scale k, of the sign that is asked for.

    ``2 (1 + a k^2)^(-1/2) exp(b^2 v/2) Phi(b sqrt(v))`` with ``v = 1/(a + 1/k^2)``.
    """
    from scipy.special import log_ndtr

    v = 1.0 / (a + k**-2)
    return np.asarray(
        math.log(2.0) - 0.5 * np.log1p(a * k * k) + 0.5 * b * b * v + log_ndtr(sign * b * np.sqrt(v)), dtype=float
    )


@dataclass(frozen=True, eq=False)
class _Changes:
    """Possible changes: c of them, of m shapes.

    `shape` (n, m); of each change (c,) the `column` of its shape, the `scale` of its size in tau, `begin`: the
    recording that shows it first, `grows`: whether it is a growth, `log_weight`: logarithm of its weight w_j, shared
    among the kinds and scales of a begin.
    """

    shape: Array
    column: IntArray
    scale: Array
    begin: IntArray
    grows: BoolArray
    log_weight: Array


def _changes(levels: Levels, known: int, *, steps_only: bool) -> _Changes:
    """Return the changes that may begin after the first `known` recordings."""
    n, begin = len(levels), np.arange(max(known, 1), len(levels))
    step = (np.arange(n)[:, None] >= begin).astype(float)
    growth = np.maximum(levels.t[:, None] - levels.t[begin - 1], 0.0) / MONTH
    slopes = tuple(MONTH / levels.interval / many for many in _INTERVALS)
    kinds = [(0, scale, len(_STEPS)) for scale in _STEPS]
    if not steps_only:
        kinds += [(1, scale, len(slopes)) for scale in slopes]
    kind, scale, share = (np.repeat(values, begin.size) for values in zip(*kinds, strict=True))
    share = share * (1.0 if steps_only else 2.0)
    waits = np.clip(levels.t[begin] - levels.t[begin - 1], 0.0, LONGEST_WAIT)
    place = np.tile(np.arange(begin.size), len(kinds))
    with np.errstate(divide="ignore"):
        log_weight = np.log(waits[place] / share)
    shape = step if steps_only else np.hstack([step, growth])
    return _Changes(shape, place + kind * begin.size, scale, begin[place], kind == 1, log_weight)


def search(levels: Levels, prior: WearPrior, known: int = 1, *, falls: bool = False, sloping: bool = False) -> Path:
    """Run the sequential test for a rise (a step or a growth), or for a fall (a step).

    `known`: how many of the first recordings are known to be of a machine that has not changed; `sloping`: whether the
    level may have grown evenly before.
    """
    n, changes = len(levels), _changes(levels, known, steps_only=falls)
    if not changes.begin.size:
        return Path(np.full(n, -np.inf), np.empty(0), changes.begin)
    joint, null = np.full((n, changes.begin.size), -np.inf), np.full(n, -np.inf)
    for node in _Model(levels, prior, changes.shape, sloping=sloping).nodes():
        own = node.log_prior + node.log_null
        a, b = node.a[:, changes.column], node.b[:, changes.column]
        null = np.logaddexp(null, own)
        ratio = _log_ratio(a, b, changes.scale * node.tau, -1 if falls else 1)
        joint = np.logaddexp(joint, own[:, None] + ratio)
    terms = joint - null[:, None] + changes.log_weight
    terms[np.arange(n)[:, None] < changes.begin] = -np.inf
    return Path(np.logaddexp.reduce(terms, axis=1), terms[-1], changes.begin)


def describe(levels: Levels, prior: WearPrior, allowed: float | None, alarmed: int | None) -> Wear:
    """Return level, growth and time to a limit after the last recording.

    `allowed`: rise of the level at which a repair is due, None where none is stated; `alarmed`: first recording that
    shows the change, as the test sees it; None where it did not alarm: then the even growth over all recordings is
    estimated, of either sign and with a flat prior.
    """
    from scipy.special import ndtr, ndtri

    random = np.random.default_rng(_SEED)
    if alarmed is None:
        shape = ((levels.t - levels.t[0]) / MONTH)[:, None]
        only = np.zeros(1, dtype=np.int64)
        changes = _Changes(shape, only, np.array([np.inf]), only, np.array([True]), np.zeros(1))
    else:
        changes = _changes(levels, 1, steps_only=False)
    nodes = _Model(levels, prior, changes.shape).nodes()
    a, b = (np.stack([getattr(node, name)[-1][changes.column] for node in nodes]) for name in ("a", "b"))
    k = changes.scale * np.array([[node.tau] for node in nodes])
    told = float(levels.t[-1] - levels.t[0]) >= _LEAST_SPAN and bool(alarmed is not None or (a > 0.0).all())
    if alarmed is not None or (a > 0.0).all():
        v = 1.0 / (a + k**-2)
        ratio = -0.5 * np.log(a) + 0.5 * b * b * v if alarmed is None else _log_ratio(a, b, k, 1)
    else:  # all recordings at one time, or each in a group of its own
        v, ratio = np.zeros_like(a), np.zeros_like(a)
    log_weight = np.array([[node.log_prior + node.log_null[-1]] for node in nodes]) + ratio + changes.log_weight
    weight = np.exp(log_weight - log_weight.max())
    node, column = np.unravel_index(random.choice(weight.size, _DRAWS, p=weight.ravel() / weight.sum()), weight.shape)
    mean, deviation = (b * v)[node, column], np.sqrt(v)[node, column]
    if alarmed is None:
        size = mean + deviation * random.standard_normal(_DRAWS)
    else:  # of a normal number that is known to be positive
        low = ndtr(-mean / deviation)
        size = mean + deviation * ndtri(np.clip(low + (1.0 - low) * random.random(_DRAWS), 1e-300, 1.0 - 1e-16))
    inverse, S_xy, S_xg = (np.stack([getattr(own, name)[-1] for own in nodes]) for name in ("inverse", "S_xy", "S_xg"))
    residual = S_xy[node] - S_xg[node, :, changes.column[column]] * size[:, None]
    noise = np.einsum("kij,kj->ki", np.linalg.cholesky(inverse)[node], random.standard_normal(residual.shape))
    means = np.einsum("kij,kj->ki", inverse[node], residual) + noise
    base = means[:, int(np.searchsorted(np.unique(levels.group), levels.group[-1]))] + float(levels.value[0])
    now = base + size * changes.shape[-1, changes.column[column]]
    grows = changes.grows[column]
    slope, growing = np.where(grows, size, 0.0), float(np.mean(grows)) >= 0.5
    unknown = Interval(math.nan, -math.inf, math.inf)
    healthy, scatter = _healthy(levels.part(slice(0, alarmed)), prior, int(levels.group[-1]))
    limit = reach = None
    if allowed is not None:
        limit = healthy.value + allowed
        with np.errstate(divide="ignore", invalid="ignore"):
            wait = np.where(slope > 0.0, (limit - now) / slope, math.inf) * MONTH
        reach = _interval(np.where(now >= limit, 0.0, wait)) if told else replace(unknown, low=0.0)
    return Wear(
        now=_interval(now),
        growth=_interval(slope[grows] if growing else slope) if told else unknown,
        step=None if growing else _interval(size[~grows]),
        onset=None if alarmed is None else _interval(levels.t[changes.begin[column]]),
        healthy=healthy,
        scatter=scatter,
        limit=limit,
        reach=reach,
    )


def _healthy(levels: Levels, prior: WearPrior, group: int) -> tuple[Interval, float]:
    """Return where a recording of the machine lies without a change, and its deviation from day to day.

    Of the group that is asked for, or of the last one where no recording is of it.
    """
    group = group if np.any(levels.group == group) else int(levels.group[-1])
    nodes = _Model(levels, prior, np.zeros((len(levels), 1))).nodes()
    log_weight = np.array([node.log_prior + node.log_null[-1] for node in nodes])
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    place = int(np.searchsorted(np.unique(levels.group), group))
    means = np.array([float((node.inverse[-1] @ node.S_xy[-1])[place]) for node in nodes]) + float(levels.value[0])
    tau = np.array([node.tau for node in nodes])
    error = float(np.mean(levels.error[levels.group == group] ** 2))
    variance = tau**2 + error + np.array([node.inverse[-1][place, place] for node in nodes])
    mean = float(weight @ means)
    half = 1.96 * math.sqrt(float(weight @ (variance + (means - mean) ** 2)))
    return Interval(mean, mean - half, mean + half), math.sqrt(float(weight @ tau**2))


def _interval(draws: Array) -> Interval:
    """Return median and 95 % interval of draws; of several that are not finite, the order still counts."""
    ordered = np.sort(draws)
    low, middle, high = (float(ordered[int(share * (ordered.size - 1))]) for share in (0.025, 0.5, 0.975))
    return Interval(middle, low, high)


@dataclass(frozen=True)
class Episode:
    """A stretch of recordings between two repairs: rows `begin` to `end` (exclusive) of what was judged.

    `alarm`: the row after which the test alarmed, None where it did not; `wear`: what the stretch says at its end;
    `fell`: whether the stretch began with a fall of the level.
    """

    begin: int
    end: int
    alarm: int | None
    wear: Wear
    fell: bool


def episodes(
    levels: Levels, prior: WearPrior, *, years: float, known: int = 1, allowed: float | None = None
) -> list[Episode]:
    """Return the stretches between repairs, each with its alarm.

    `years`: a healthy machine has one false alarm in so many, on average or less often; `known`: how many of the first
    recordings are of a healthy machine; `allowed`: rise at which a repair is due. A repair is a fall of the level that
    the same test finds; the level starts anew there, and the scatter seen before is kept in the prior.
    """
    threshold = years * 365.25
    result: list[Episode] = []
    begin, fell = 0, False
    while begin < len(levels):
        part = levels.part(slice(begin, None))
        alarm = search(part, prior, known).alarm(threshold)
        dropped = search(part, prior, known, falls=True).alarm(threshold)
        cut: int | None = None
        if dropped is not None and (alarm is None or dropped <= alarm):
            cut, alarm = search(part.part(slice(0, dropped + 1)), prior, known, falls=True).likeliest, None
        elif alarm is not None:
            begun = search(part.part(slice(0, alarm + 1)), prior, known).likeliest
            worn = part.part(slice(begun, None))
            dropped = search(worn, prior, 2, falls=True, sloping=True).alarm(threshold)
            if dropped is not None:
                until = worn.part(slice(0, dropped + 1))
                cut = begun + search(until, prior, 2, falls=True, sloping=True).likeliest
        end = len(part) if cut is None else max(cut, 1)
        own = part.part(slice(0, end))
        alarm = alarm if alarm is not None and alarm < end else None
        wear = describe(own, prior, allowed, None if alarm is None else search(own, prior, known).likeliest)
        result.append(Episode(begin, begin + end, None if alarm is None else begin + alarm, wear, fell))
        if cut is None:
            break
        freedom = prior.scatter.freedom + min(end - 1, 20)
        prior = replace(prior, scatter=DayToDay(wear.scatter, freedom))
        begin, fell, known = begin + end, True, 1
    return result
