"""Wear over recordings: one Gaussian model of the level that each states, and a sequential test for its rise.

The level that recording i states at the time t_i is

    y_i = mu_l(i) + beta c_i + delta g(t_i) + d(t_i) + e_i,

mu of the group l of recordings that can be compared, a covariate c with a normal prior on beta, what changes from
recording to recording d, the recording's own error e_i of stated deviation s_i, and the change g: a step,
``g = [t >= t_j]``, or a growth, ``g = max(t - t_(j-1), 0)``. d is normal with variance tau^2, of which a share r lasts,
half of it for an hour and half for a week: its covariance is ``tau^2 ((1 - r) [i = k] + r/2 sum_T exp(-|t_i -
t_k|/T))``. tau has a scaled inverse chi-square prior (`DayToDay`), r is uniform on a few values, and both are summed on
a grid. mu has a wide prior, delta a half-normal one of some scales in units of tau. With L L' = cov(y), the rows of
z = L^-1 y up to n are those of the first n recordings alone, so that one factorisation serves all n: with G = L^-1 g,
a = sum G^2 and b = sum G z, a change of size delta has the likelihood ratio exp(b delta - a delta^2/2).

The test is Shiryaev's and Roberts's: with the likelihood ratio LR_j(n) of a change after recording j - 1 against none,

    R_n = sum_(j <= n) w_j LR_j(n),   w_j = min(t_j - t_(j-1), longest wait),   alarm where R_n > A.

Without a change R_n - sum_(j <= n) w_j is a martingale, whatever the number of recordings, so that the mean time to a
false alarm is at least A: the threshold is that time itself. This holds for machines whose tau the prior describes.

Sources: M. Pollak, Annals of Statistics 13 (1985) 206-227, doi 10.1214/aos/1176346587 (Shiryaev-Roberts and its mean
time); J. Shin, A. Ramdas, A. Rinaldo, New England Journal of Statistics in Data Science 2 (2024) 229-260, doi
10.51387/23-NEJSDS51 (mixtures and unknown parameters); Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections
5.4 and 14.8 (grid of tau, regression with known covariance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import Interval
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array
from sealscope.signals.filters import IntArray
from sealscope.units import DAYS_PER_MONTH, DAYS_PER_YEAR

#: Deviation of a prior that says nothing, over scatter and range of the values: its square leaves half of the digits.
_WIDE, _TINY = 1e2, 1e-10


class DayToDay(NamedTuple):
    """Prior on the standard deviation of the level between recordings: a `scale` with degrees of `freedom`."""

    scale: float
    freedom: float


@dataclass(frozen=True, eq=False)
class Levels:
    """Levels (n,) of n recordings in the order of their times, and the `prior` on their scatter.

    `t` [days]; `value`; `error`: standard deviation that each states of itself; `group` (n,): number of the group that
    shares a mean; `covariate` (n,) with the standard deviation `slope_sd` of its coefficient, 0 for none.
    """

    t: Array
    value: Array
    error: Array
    group: IntArray
    covariate: Array
    prior: DayToDay
    slope_sd: float = 0.0

    def __len__(self) -> int:
        return self.t.size

    def part(self, rows: slice) -> Levels:
        """Select some of the recordings by `rows`."""
        t, value, error, covariate = (values[rows] for values in (self.t, self.value, self.error, self.covariate))
        return Levels(t, value, error, self.group[rows], covariate, self.prior, self.slope_sd)

    @property
    def interval(self) -> float:
        """Typical time between two recordings [days]."""
        steps = np.diff(self.t)
        return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0

    @property
    def scatter(self) -> float:
        """Deviation of a recording from its neighbours: their median step, shrunk towards the prior."""
        prior = self.prior
        steps = np.abs(np.diff(self.value))[np.diff(self.group) == 0] / math.sqrt(2.0)
        prior_variance = prior.scale**2 + (float(np.mean(self.error**2)) if len(self) else 0.0)
        measured = (1.4826 * float(np.median(steps))) ** 2 if steps.size else 0.0
        return math.sqrt((prior.freedom * prior_variance + steps.size * measured) / (prior.freedom + steps.size))

    def merged(self, most: int = 240) -> Levels:
        """Reduce the levels to about `most`: average neighbours of a group where there are more."""
        size = -(-len(self) // most)
        if size <= 1:
            return self
        runs = np.split(np.arange(len(self)), np.flatnonzero(np.diff(self.group)) + 1)
        rows = [run[k : k + size] for run in runs for k in range(0, run.size, size)]
        t, value, covariate = (
            np.array([values[r].mean() for r in rows]) for values in (self.t, self.value, self.covariate)
        )
        error = np.array([math.sqrt(np.sum(self.error[r] ** 2)) / r.size for r in rows])
        return Levels(t, value, error, self.group[[r[0] for r in rows]], covariate, self.prior, self.slope_sd)


def outlier_excess(levels: Levels) -> tuple[Array, Array]:
    """Return the excess of each value not counted while it is the last one, and not once the next one is known.

    That is what lies beyond some deviations of the three before it, unless its neighbour lies as far out.
    """
    (last, later), outlier = np.zeros((2, len(levels))), priors("trend")["course"]["outlier"]
    for k in range(1, len(levels)):
        same = np.flatnonzero(levels.group == levels.group[k])
        place = int(np.searchsorted(same, k))
        before, after = levels.value[same[max(place - 3, 0) : place]], levels.value[same[place + 1 : place + 2]]
        if before.size:
            reach, middle = outlier * levels.part(slice(0, k)).scatter, float(np.median(before))
            distance = levels.value[k] - middle
            agree = [np.sign(distance) * (other - middle) > reach for other in (before[-1], *after)]
            last[k] = 0.0 if agree[0] else np.sign(distance) * max(abs(distance) - reach, 0.0)
            later[k] = 0.0 if any(agree) or not after.size else last[k]
    return last, later


class _Changes(NamedTuple):
    """Possible changes: c of them, of m shapes (n, m).

    Of each change (c,) the `column` of its shape, the `scale` of its size in tau, `begin`: the recording that shows it
    first, `grows`: whether it is a growth, `log_weight`: logarithm of its weight w_j, shared among the kinds and scales
    of a begin.
    """

    shape: Array
    column: IntArray
    scale: Array
    begin: IntArray
    grows: NDArray[np.bool_]
    log_weight: Array

    @classmethod
    def after(cls, levels: Levels, known: int, *, steps_only: bool = False) -> _Changes:
        """Return the changes that may begin after the first `known` recordings."""
        believed = priors("trend")["change"]
        begin = np.arange(max(known, 1), len(levels))
        step = (np.arange(len(levels))[:, None] >= begin).astype(float)
        growth = np.maximum(levels.t[:, None] - levels.t[begin - 1], 0.0) / DAYS_PER_MONTH
        slopes = (
            [] if steps_only else [DAYS_PER_MONTH / levels.interval / interval for interval in believed["intervals"]]
        )
        steps = len(believed["steps"])
        scale = np.array([*believed["steps"], *slopes], dtype=float)[:, None]
        grows = np.arange(scale.size)[:, None] >= steps
        share = np.where(grows, len(slopes), steps) * (1.0 if steps_only else 2.0)
        with np.errstate(divide="ignore"):
            log_weight = np.log(np.clip(levels.t[begin] - levels.t[begin - 1], 0.0, believed["wait"]) / share)
        column = np.arange(begin.size) + begin.size * grows
        spread = np.broadcast_arrays(column, scale, begin, grows, log_weight)
        return cls(np.hstack([step, growth]), *(values.ravel() for values in spread))  # type: ignore[call-arg]

    @classmethod
    def single(cls, shape: Array, scale: float) -> _Changes:
        """Make a single change of one shape (n,), with its `scale` in tau."""
        first, one = np.zeros(1, dtype=np.int64), np.ones(1)
        return cls(shape[:, None], first, scale * one, first, one > 0.0, 0.0 * one)


class _Node(NamedTuple):
    """A pair (tau, r) of the grid, with all recordings whitened by it.

    `log` (n,): logarithm of its prior and of the likelihood without a change, after each recording; `a`, `b` (n, m) of
    m shapes of changes; of the last group's mean `mean`, `variance`, and by how much it `yields` (m,) to each change.
    """

    tau: float
    log: Array
    a: Array
    b: Array
    mean: float
    variance: float
    yields: Array


def _nodes(levels: Levels, shapes: Array, *, sloping: bool = False) -> list[_Node]:
    """Return every node of the grid, for changes (n, m); `sloping`: the level may have grown evenly before."""
    from scipy.linalg import solve_triangular

    believed, prior = priors("trend")["between"], levels.prior
    last, later = outlier_excess(levels)
    values = levels.value - levels.value[0] - later
    reach = max(prior.scale, 0.3 * float(np.ptp(levels.value)))
    wide_variance = (_WIDE * reach) ** 2
    mean = wide_variance * (levels.group == levels.group[-1])
    shared = wide_variance * (levels.group[:, None] == levels.group) + levels.slope_sd**2 * np.outer(
        *(levels.covariate,) * 2
    )
    if sloping:
        growth = 10.0 * levels.scatter / levels.interval * (levels.t - levels.t[0])
        shared += np.outer(growth, growth)
    waits = np.abs(levels.t[:, None] - levels.t)
    correlation = np.mean([np.exp(-waits / time) for time in believed["times"]], axis=0)
    right = np.column_stack([values, mean, shapes])
    nodes = []
    for tau in np.geomspace(0.1 * prior.scale, 10.0 * reach, believed["nodes"]):
        log_prior = -prior.freedom * (math.log(tau) + 0.5 * (prior.scale / tau) ** 2)
        for share in believed["lasts"]:
            covariance = shared + tau**2 * share * correlation
            covariance[np.diag_indices(len(levels))] += tau**2 * (1.0 - share + _TINY) + levels.error**2
            L = np.linalg.cholesky(covariance)
            z, u, g = np.split(solve_triangular(L, right, lower=True, check_finite=False), [1, 2], axis=1)
            held = z - ((last - later) / L.diagonal())[:, None]  # the value counts so while it is the last
            square = np.cumsum(z**2) - (z**2 - held**2)[:, 0]
            log = log_prior - np.cumsum(np.log(L.diagonal())) - 0.5 * square
            a, b = np.cumsum(g**2, axis=0), np.cumsum(g * z, axis=0) - g * (z - held)
            base = float(levels.value[0] + u[:-1, 0] @ z[:-1, 0] + u[-1, 0] * held[-1, 0])
            nodes.append(_Node(float(tau), log, a, b, base, wide_variance - float(u[:, 0] @ u[:, 0]), g.T @ u[:, 0]))
    return nodes


def _log_ratio(a: Array, b: Array, scale: Array) -> Array:
    """Return log E[exp(b delta - a delta^2/2)] for delta > 0, half-normal of a scale.

    ``2 (1 + a k^2)^(-1/2) exp(b^2 v/2) Phi(b sqrt(v))`` with ``v = 1/(a + 1/k^2)``.
    """
    from scipy.special import log_ndtr

    v = 1.0 / (a + scale**-2)
    log_factor = math.log(2.0) - 0.5 * np.log1p(a * scale**2) + log_ndtr(b * np.sqrt(v))
    return np.asarray(log_factor + 0.5 * b * b * v, dtype=float)


class Path(NamedTuple):
    """The sequential test after each recording (n,): `log_R`, and `first`: which shows the likeliest change first."""

    log_R: Array
    first: IntArray

    def alarm(self, days: float) -> int | None:
        """Find the first recording with R over a mean time to a false alarm; None where there is none."""
        over = np.flatnonzero(self.log_R > math.log(days))
        return int(over[0]) if over.size else None


def search(levels: Levels, known: int = 1, *, falls: bool = False, sloping: bool = False) -> Path:
    """Run the sequential test for a rise (a step or a growth), or for a fall (a step).

    `known`: how many of the first recordings are known to be of a machine that has not changed; `sloping`: whether the
    level may have grown evenly before.
    """
    if falls:
        levels = replace(levels, value=-levels.value)
    n, changes = len(levels), _Changes.after(levels, known, steps_only=falls)
    terms, null = np.full((n, changes.begin.size), -np.inf), np.full(n, -np.inf)
    if not changes.begin.size:
        return Path(null, np.zeros(n, dtype=np.int64))
    for node in _nodes(levels, changes.shape, sloping=sloping):
        null = np.logaddexp(null, node.log)
        a, b = node.a[:, changes.column], node.b[:, changes.column]
        terms = np.logaddexp(terms, node.log[:, None] + _log_ratio(a, b, changes.scale * node.tau))
    terms += changes.log_weight - null[:, None]
    terms[np.arange(n)[:, None] < changes.begin] = -np.inf
    return Path(np.logaddexp.reduce(terms, axis=1), changes.begin[np.argmax(terms, axis=1)])


class _Draws(NamedTuple):
    """Draws (d,) from the posterior after all recordings: `tau`, which `change`, its `size`, mean before it `base`."""

    tau: Array
    change: IntArray
    size: Array
    base: Array

    @classmethod
    def sample(cls, levels: Levels, changes: _Changes, *, signed: bool = False) -> _Draws:
        """Return draws; `signed`: the size may be of either sign, its prior flat."""
        from scipy.special import ndtr, ndtri

        random, count = np.random.default_rng(20), 4000
        nodes = _nodes(levels, changes.shape)
        a, b = (np.stack([getattr(node, name)[-1][changes.column] for node in nodes]) for name in ("a", "b"))
        scale = changes.scale * np.array([[node.tau] for node in nodes])
        v = 1.0 / (a + scale**-2)
        ratio = 0.5 * (np.log(v) + b * b * v) if signed else _log_ratio(a, b, scale)
        log_weight = np.array([[node.log[-1]] for node in nodes]) + ratio + changes.log_weight
        weight = np.exp(log_weight - log_weight.max())
        chosen = random.choice(weight.size, count, p=weight.ravel() / weight.sum())
        node, change = np.unravel_index(chosen, weight.shape)
        mean, deviation = (b * v)[node, change], np.sqrt(v)[node, change]
        low = np.zeros(count) if signed else ndtr(-mean / deviation)  # of a normal number that is known to be positive
        size = mean + deviation * ndtri(np.clip(low + (1.0 - low) * random.random(count), 1e-300, 1.0 - 1e-16))
        tau, base, variance = np.array([(node_of.tau, node_of.mean, node_of.variance) for node_of in nodes])[node].T
        yields = np.stack([node_of.yields[changes.column] for node_of in nodes])[node, change]
        spread = np.sqrt(np.maximum(variance, 0.0)) * random.standard_normal(count)
        return cls(tau, change, size, base - yields * size + spread)


class Wear(NamedTuple):
    """Course of a segment of recordings.

    `now`: level after the last recording, without the day's own scatter; `growth`: by a month; `step`: size of a step,
    None where a growth is likelier, or nothing changed; `onset`: time of the change [days], None where there is none;
    `healthy`: where a recording of the machine before the change lies, in 95 of 100, about its mean; `scatter`:
    deviation between recordings; `limit`: the mean before the change and the rise that is allowed, None where none is
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


def _interval(draws: Array) -> Interval:
    """Return median and 95 % interval of draws; of several that are not finite, the order still counts."""
    low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975], method="lower")
    return Interval(float(middle), float(low), float(high))


def describe(levels: Levels, allowed: float | None, alarmed: int | None) -> Wear:
    """Return level, growth and time to a limit after the last recording.

    `allowed`: rise of the level at which a repair is due, None where none is stated; `alarmed`: first recording that
    shows the change, as the test sees it; None where it did not alarm: then the even growth over all recordings is
    estimated, of either sign and with a wide prior. Recordings of less than a day state no growth by a month.
    """
    spans, rises = levels.t[-1] - levels.t[0] >= 1.0, alarmed is not None
    even = (levels.t - levels.t[0]) / DAYS_PER_MONTH if spans else np.zeros(len(levels))
    changes = _Changes.after(levels, 1) if rises else _Changes.single(even, _WIDE * DAYS_PER_MONTH / levels.interval)
    draws = _Draws.sample(levels, changes, signed=not rises)
    grows = changes.grows[draws.change]
    now = draws.base + draws.size * changes.shape[-1, changes.column[draws.change]]
    slope, growing = np.where(grows, draws.size, 0.0), float(np.mean(grows)) >= 0.5
    before = levels.part(slice(0, alarmed))
    usual = _Draws.sample(before, _Changes.single(np.zeros(len(before)), 1.0))
    error = float(np.mean(before.error[before.group == before.group[-1]] ** 2))
    noise = np.random.default_rng(21).standard_normal(usual.tau.size)
    healthy = _interval(usual.base + np.sqrt(usual.tau**2 + error) * noise)._replace(value=float(usual.base.mean()))
    limit = reach = None
    unknown = Interval(math.nan, -math.inf, math.inf)
    if allowed is not None:
        limit = healthy.value + allowed
        with np.errstate(divide="ignore", invalid="ignore"):
            wait = np.where(slope > 0.0, (limit - now) / slope, math.inf) * DAYS_PER_MONTH
        reach = _interval(np.where(now >= limit, 0.0, wait)) if spans else unknown._replace(low=0.0)
    return Wear(
        now=_interval(now),
        growth=_interval(slope[grows] if growing else slope) if spans else unknown,
        step=None if growing else _interval(draws.size[~grows]),
        onset=_interval(levels.t[changes.begin[draws.change]]) if rises else None,
        healthy=healthy,
        scatter=math.sqrt(float(np.mean(usual.tau**2))),
        limit=limit,
        reach=reach,
    )


class Episode(NamedTuple):
    """A stretch of recordings between two repairs: rows `begin` to `end` (exclusive) of the judged ones.

    `alarm`: the row after which the test alarmed, None where it did not; `wear`: what the stretch says at its end;
    `fell`: whether the stretch began with a fall of the level.
    """

    begin: int
    end: int
    alarm: int | None
    wear: Wear
    fell: bool


def episodes(levels: Levels, *, years: float, known: int = 1, allowed: float | None = None) -> list[Episode]:
    """Return the stretches between repairs, each with its alarm.

    `years`: a healthy machine has one false alarm in so many, on average or less often; `known`: how many of the first
    recordings are of a healthy machine; `allowed`: rise at which a repair is due. A repair is a fall of the level that
    the same test finds; the level starts anew there, and the scatter seen before is kept in the prior.
    """
    days, begin, result = years * DAYS_PER_YEAR, 0, list[Episode]()
    while begin < len(levels):
        part = levels.part(slice(begin, None))
        rise, fall = search(part, known), search(part, known, falls=True)
        alarm, dropped, first = rise.alarm(days), fall.alarm(days), 0
        if alarm is not None and (dropped is None or alarm < dropped):  # worn: what falls back to its beginning
            first = int(rise.first[alarm])
            fall = search(part.part(slice(first, None)), 2, falls=True, sloping=True)
            dropped = fall.alarm(days)
        end = len(part) if dropped is None else max(first + int(fall.first[dropped]), 1)
        alarm = None if alarm is None or alarm >= end else alarm
        wear = describe(part.part(slice(0, end)), allowed, None if alarm is None else int(rise.first[end - 1]))
        result.append(Episode(begin, begin + end, None if alarm is None else begin + alarm, wear, bool(result)))
        levels = replace(levels, prior=DayToDay(wear.scatter, levels.prior.freedom + min(end - 1, 20)))
        begin, known = begin + end, 1
    return result
