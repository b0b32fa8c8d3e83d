"""Wear over recordings: a Gaussian model of the leakage level in each recording, and a sequential test for its rise.

The level that recording i states at the time t_i is

    y_i = mu_l(i) + beta c_i + delta g(t_i) + d(t_i) + e_i.

Here mu_l is the mean of the group l of comparable recordings, c a covariate with a normal prior on beta, and e_i the
recording's own error with the stated standard deviation s_i. The change g is a step, ``g = [t >= t_j]``, or a growth,
``g = max(t - t_(j-1), 0)``. The deviation d from recording to recording is normal with variance tau^2. A fraction r of
this variance is correlated over time, half of it for an hour and half for a week, so that the covariance of d is
``tau^2 ((1 - r) [i = k] + r/2 sum_T exp(-|t_i - t_k|/T))``. tau has a scaled inverse chi-square prior (`ScatterPrior`),
r is uniform on a few values, and both are summed on a grid. mu has a wide prior; delta has half-normal priors of
several scales in units of tau. The test is that of `estimate.change` by the mean time to a false alarm, which holds for
machines whose tau the prior describes: a change after recording j - 1 has the weight w_j = min(t_j - t_(j-1), longest
wait).

Source: Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 5.4 and 14.8 (grid of tau, regression with known
covariance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import ChangeScores, ChangeSums, filter_changes, score_in_time
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.estimate.population import BOUND_PROBABILITY, weigh_alternatives
from sealscope.diagnosis.estimate.special import SD_PER_MEDIAN
from sealscope.diagnosis.priors.trend import TREND
from sealscope.recordings.recording import Array
from sealscope.signals.details import IntArray
from sealscope.units import DAYS_PER_MONTH, DAYS_PER_YEAR

#: Standard deviation of a flat prior, over scatter and range of the values: its square leaves half of the digits.
_WIDE = 1e2
#: Fractions of tau^2 and of the flat prior's variance, added to the diagonal to keep the covariance positive definite.
_JITTER, _ROUNDING = 1e-10, 1e-13
#: Draws from a posterior: the ends of a 95 % interval then have a relative error of a few per cent.
_N_DRAWS = 4000
#: Most recordings of an episode that count for the next one's prior, as the machine may scatter otherwise then.
_MAX_FREEDOM = 20


class ScatterPrior(NamedTuple):
    """Prior on the standard deviation of a healthy machine's leakage level between recordings, inverse chi-square."""

    scale: float  # typical standard deviation, in the unit of the levels
    freedom: float  # degrees of freedom


@dataclass(frozen=True, eq=False)
class Levels:
    """Leakage levels of n recordings in the order of time, and the prior on their scatter."""

    t: Array  # (n,): times [days]
    value: Array  # (n,): leakage in each recording, in any unit that is common to all
    error: Array  # (n,): standard error that each recording states for its level
    group: IntArray  # (n,): number of the group of comparable recordings, which have a common mean
    covariate: Array  # (n,): an explanatory variable, the warming of the oil [K]
    prior: ScatterPrior  # prior on the standard deviation between recordings
    slope_sd: float = 0.0  # prior standard deviation of the covariate's coefficient, 0 if it has no effect

    def __len__(self) -> int:
        return self.t.size

    def select(self, rows: slice) -> Levels:
        """Return the leakage levels of a slice of the recordings, with the same prior."""
        names = ("t", "value", "error", "group", "covariate")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    @property
    def interval(self) -> float:
        """Median of the times > 0 between successive recordings [days]; 1 if there is none."""
        steps = np.diff(self.t)
        return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0

    @property
    def scatter(self) -> float:
        """Standard deviation of the levels between recordings of a machine that does not change.

        Its square is the mean of two variances: that of the prior plus the mean square of the stated errors, weighted
        by the prior's degrees of freedom, and that of the changes between neighbours in a group, from the median of
        their sizes, weighted by their number.
        """
        prior = self.prior
        # a change between neighbours has twice the variance of a level
        changes = np.abs(np.diff(self.value))[np.diff(self.group) == 0] / math.sqrt(2.0)
        prior_variance = prior.scale**2 + (float(np.mean(self.error**2)) if len(self) else 0.0)
        measured_variance = (SD_PER_MEDIAN * float(np.median(changes))) ** 2 if changes.size else 0.0
        weights = prior.freedom, changes.size
        return math.sqrt(float(np.average([prior_variance, measured_variance], weights=weights)))

    def average_neighbours(self, max_count: int = 240) -> Levels:
        """Average levels of successive recordings of a group, so that about `max_count` levels remain, to save time."""
        size = math.ceil(len(self) / max_count)
        if size <= 1:
            return self
        runs = np.split(np.arange(len(self)), np.flatnonzero(np.diff(self.group)) + 1)
        parts = [run[k : k + size] for run in runs for k in range(0, run.size, size)]
        error = np.array([math.sqrt(np.sum(self.error[rows] ** 2)) / rows.size for rows in parts])
        t, value, covariate = (
            np.array([values[rows].mean() for rows in parts]) for values in (self.t, self.value, self.covariate)
        )
        group = self.group[[rows[0] for rows in parts]]
        return replace(self, t=t, value=value, error=error, group=group, covariate=covariate)


def outlier_excess(levels: Levels) -> tuple[Array, Array]:
    """Compute the part of each leakage level beyond the limit of outliers, which the fit of the wear subtracts.

    The limit is `outlier` (`priors.toml`) times the scatter of all earlier levels (`Levels.scatter`), as a distance
    from the median of up to three levels before it in its group; the first level of a group has no excess. Two
    successive levels beyond the limit on the same side are a change of the machine, whose excess is 0. Returns two
    variants, each (n,). The first treats each level as the latest level. The second is for the whole series, in which
    the next level may show a change; it is 0 for the last level of a group, whose next is not known.
    """
    excess_as_last, excess = np.zeros((2, len(levels)))
    for group in np.unique(levels.group):
        rows = np.flatnonzero(levels.group == group)
        values = levels.value[rows]
        for position, row in enumerate(rows[1:], 1):
            max_distance = TREND.history.outlier * levels.select(slice(0, row)).scatter
            distances = values - np.median(values[max(position - 3, 0) : position])
            sign = np.sign(distances[position])
            if sign * distances[position - 1] > max_distance:  # a change
                continue
            excess_as_last[row] = sign * max(abs(distances[position]) - max_distance, 0.0)
            is_single = position + 1 < rows.size and sign * distances[position + 1] <= max_distance
            excess[row] = excess_as_last[row] if is_single else 0.0
    return excess_as_last, excess


class _Changes(NamedTuple):
    """Hypotheses of a change of the leakage level: c changes over n recordings, with m different profiles over time."""

    profiles: Array  # (n, m): effect of a change of unit size on each recording, g in the module's docstring
    profile_index: IntArray  # (c,): column of `profiles` that belongs to each change
    scale: Array  # (c,): prior scale of the size of each change, in units of the scatter tau
    begin: IntArray  # (c,): index of the first recording after each change
    grows: NDArray[np.bool_]  # (c,): True for a growth, False for a step
    log_weight: Array  # (c,): logarithm of w_j in the module's docstring, shared by changes with the same `begin`

    @classmethod
    def enumerate(cls, levels: Levels, n_healthy: int, *, steps_only: bool = False) -> _Changes:
        """Build the hypotheses of all steps and growths that may begin after the first `n_healthy` recordings.

        Each is combined with several prior scales of its size: for a step, multiples of the scatter tau (`change.steps`
        in `priors.toml`); for a growth per month, tau over multiples of the median interval of recordings
        (`change.intervals`).
        """
        scales = TREND.change
        begin = np.arange(max(n_healthy, 1), len(levels))  # first recording after each change
        step = (np.arange(len(levels))[:, None] >= begin).astype(float)
        # months since the last recording before the change
        growth = np.maximum(levels.t[:, None] - levels.t[begin - 1], 0.0) / DAYS_PER_MONTH
        slopes = [] if steps_only else [DAYS_PER_MONTH / levels.interval / n for n in scales.intervals]
        n_steps = len(scales.steps)
        # each row of the following arrays belongs to one scale
        scale = np.array([*scales.steps, *slopes], dtype=float)[:, None]
        grows = np.arange(scale.size)[:, None] >= n_steps
        # the weight w_j, the time before the change, is shared equally by steps and growths, and by the scales of each
        n_rivals = np.where(grows, len(slopes), n_steps) * (1.0 if steps_only else 2.0)
        with np.errstate(divide="ignore"):  # no weight for a change between recordings of one time
            log_weight = np.log(np.clip(levels.t[begin] - levels.t[begin - 1], 0.0, scales.wait) / n_rivals)
        profile_index = np.arange(begin.size) + begin.size * grows  # profiles of growths follow those of steps
        fields = np.broadcast_arrays(profile_index, scale, begin, grows, log_weight)  # (scales, begins) each
        return cls(np.hstack([step, growth]), *(values.ravel() for values in fields))  # type: ignore[call-arg]

    @classmethod
    def from_profile(cls, profile: Array, scale: float) -> _Changes:
        """Build the single hypothesis of a change with the effect `profile` (n,), which counts as a growth."""
        first = np.zeros(1, dtype=np.int64)
        return cls(
            profile[:, None], first, np.array([scale]), first, grows=np.ones(1, dtype=bool), log_weight=np.zeros(1)
        )


class _Node(NamedTuple):
    """Likelihoods at one point of the grid of tau and r, for n recordings and m profiles of a change over time."""

    tau: float  # standard deviation between recordings
    log_null: Array  # (n,): logarithm of prior times likelihood without a change, after each recording
    sums: ChangeSums  # (n, m): of each change, after each recording
    # mean level of the last group of comparable recordings without a change, and its variance
    mean: float
    variance: float
    mean_slope: Array  # (m,): decrease of this mean per unit of a change


def _evaluate_grid(levels: Levels, profiles: Array, *, may_grow: bool = False) -> list[_Node]:
    """Compute the likelihoods of leakage levels with and without a change, at each point of a grid of tau and r.

    `profiles` (n, m) are the effects of m changes of unit size on each of n recordings. With `may_grow`, the level may
    have grown evenly since the first recording even without a change. The covariance of the levels is

        shared + tau^2 (r C + (1 - r) I) + diag(error^2) = L L'.

    Here `shared` is due to the priors on the level of each group, the growth and the covariate's coefficient, and C is
    the correlation over time. Multiplied by L^-1, the levels without their outlying parts (`outlier_excess`) become z,
    the profiles become G, and the covariances of the levels with the last group's mean level become u.
    """
    from scipy.linalg import solve_triangular

    between, prior = TREND.between, levels.prior
    # outlying part of each level: while its recording is the last one, and in the whole series
    outlying_as_last, outlying = outlier_excess(levels)
    values = levels.value - levels.value[0] - outlying  # relative to the first level, which is added again below
    # 0.3 of the range is about the standard deviation of ten normal values
    max_scatter = max(prior.scale, 0.3 * float(np.ptp(levels.value)))
    wide_variance = (_WIDE * max_scatter) ** 2
    rounding = _ROUNDING * wide_variance
    # covariance of each level with the mean level of the last group
    mean_covariance = wide_variance * (levels.group == levels.group[-1])
    shared = wide_variance * (levels.group[:, None] == levels.group)
    shared = shared + levels.slope_sd**2 * np.outer(levels.covariate, levels.covariate)
    if may_grow:
        growth = 10.0 * levels.scatter / levels.interval * (levels.t - levels.t[0])  # 10: a wide prior
        shared += np.outer(growth, growth)
    elapsed = np.abs(levels.t[:, None] - levels.t)
    correlation = np.mean([np.exp(-elapsed / time) for time in between.times], axis=0)
    right_sides = np.column_stack([values, mean_covariance, profiles])
    nodes = []
    for tau in np.geomspace(0.1 * prior.scale, 10.0 * max_scatter, between.nodes):
        # scaled inverse chi-square, as a density of log tau, in which the grid is uniform
        log_prior = -prior.freedom * (math.log(tau) + 0.5 * (prior.scale / tau) ** 2)
        for r in between.lasting_share:
            covariance = shared + tau**2 * r * correlation
            covariance[np.diag_indices(len(levels))] += tau**2 * (1.0 - r + _JITTER) + levels.error**2 + rounding
            L = np.linalg.cholesky(covariance)
            z, u, G = np.split(solve_triangular(L, right_sides, lower=True, check_finite=False), [1, 2], axis=1)
            # while a recording is the last one, more of its level may be outlying, which changes only its own row of z
            z_as_last = z - ((outlying_as_last - outlying) / L.diagonal())[:, None]
            # sum of z^2 up to each recording, with the last term of each sum from `z_as_last`
            square = np.cumsum(z**2) - (z**2 - z_as_last**2)[:, 0]
            log_null = log_prior - np.cumsum(np.log(L.diagonal())) - 0.5 * square
            # mean level of the last group and its variance, given all levels, if nothing has changed
            level = float(levels.value[0] + u[:-1, 0] @ z[:-1, 0] + u[-1, 0] * z_as_last[-1, 0])
            variance = wide_variance - float(u[:, 0] @ u[:, 0])
            nodes.append(_Node(float(tau), log_null, filter_changes(z, G, z_as_last), level, variance, G.T @ u[:, 0]))
    return nodes


def score_changes(levels: Levels, n_healthy: int = 1, *, falls: bool = False, may_grow: bool = False) -> ChangeScores:
    """Compute the statistic R of the sequential test for a rise of the leakage level, either a step or a growth.

    A change may begin after the first `n_healthy` recordings. With `falls` the test is for a downward step instead.
    With `may_grow`, an even growth since the first recording does not count as a change.
    """
    if falls:
        levels = replace(levels, value=-levels.value)
    n, changes = len(levels), _Changes.enumerate(levels, n_healthy, steps_only=falls)
    # logarithms of prior times likelihood with each change, and without one, summed over the grid of tau and r
    log_terms, log_null = np.full((n, changes.begin.size), -np.inf), np.full(n, -np.inf)
    for node in _evaluate_grid(levels, changes.profiles, may_grow=may_grow) if changes.begin.size else []:
        log_null = np.logaddexp(log_null, node.log_null)
        log_ratio = node.sums.select((slice(None), changes.profile_index)).log_mean_ratio(changes.scale * node.tau)
        log_terms = np.logaddexp(log_terms, node.log_null[:, None] + log_ratio)
    return score_in_time(log_terms - log_null[:, None], changes.log_weight, changes.begin)


class _Draws(NamedTuple):
    """Random draws (d,) from the posterior distribution of a change of the leakage level."""

    tau: Array  # standard deviation between recordings
    change: IntArray  # index of the drawn hypothesis in `_Changes`
    amplitude: Array  # size of the change: of a step, or of a growth per month
    mean_before: Array  # mean level before the change

    @classmethod
    def sample(cls, levels: Levels, changes: _Changes, *, signed: bool = False) -> _Draws:
        """Draw random samples from the posterior of scatter, change (one of `changes`), its size and mean level before.

        The size has a half-normal prior or, with `signed`, a normal prior. The seed is fixed.
        """
        from scipy.special import ndtr, ndtri

        random = np.random.default_rng(20)  # a fixed seed, so that results repeat
        nodes = _evaluate_grid(levels, changes.profiles)
        # given all recordings, up to the last one
        sums = ChangeSums(*np.stack([node.sums.select((-1, changes.profile_index)) for node in nodes], axis=1))
        scale = changes.scale * np.array([[node.tau] for node in nodes])
        mean, variance = sums.size(scale)
        log_ratio = sums.log_mean_ratio(scale, signed=signed)
        log_weight = np.array([[node.log_null[-1]] for node in nodes]) + log_ratio + changes.log_weight
        weight = weigh_alternatives(log_weight)
        # draw a point of the grid and a change together
        flat_index = random.choice(weight.size, _N_DRAWS, p=weight.ravel())
        node_number, change = np.unravel_index(flat_index, weight.shape)
        mean, sd = mean[node_number, change], np.sqrt(variance[node_number, change])
        # by the inverse distribution function, of random probabilities; without `signed`, only numbers above 0
        p_negative = np.zeros(len(mean)) if signed else ndtr(-mean / sd)
        p = np.clip(p_negative + (1.0 - p_negative) * random.random(len(mean)), 1e-300, 1.0 - 1e-16)  # finite ndtri
        amplitude = np.asarray(mean + sd * ndtri(p))
        tau, level, level_variance = np.array([(node.tau, node.mean, node.variance) for node in nodes])[node_number].T
        # a change lowers the mean before it, by `slope` per unit of its size
        slope = np.stack([node.mean_slope[changes.profile_index] for node in nodes])[node_number, change]
        error = np.sqrt(np.maximum(level_variance, 0.0)) * random.standard_normal(_N_DRAWS)
        return cls(tau, change, amplitude, level - slope * amplitude + error)

    def last_rises(self, changes: _Changes) -> Array:
        """Compute for each draw from `changes` the rise (d,) of the last recording's level over the mean before it."""
        return np.asarray(self.amplitude * changes.profiles[-1, changes.profile_index[self.change]])


class Wear(NamedTuple):
    """State of a machine after the last of a series of recordings: level, change, growth and time to the limit.

    Quantities are in the unit of the levels, with 95 % intervals.

    Attributes
    ----------
    total : Interval
        Present level, without the scatter of the last recording.
    leak, bound, growth : Interval, float, Interval
        Rise of the level since the change or, if the test found none, the rise that the levels allow; its 95 % upper
        bound; rise per month.
    step : Interval or None
        Size of the step; None if a growth is more probable or nothing changed.
    onset : Interval or None
        Time of the change [days], None if nothing changed.
    healthy, scatter : Interval, float
        Mean level before the change, with the range of 95 % of the recordings then, and the standard deviation between
        these, without their errors.
    limit : float or None
        Level at which a repair is due, None if there is no limit.
    reach : Interval or None
        Days from the last recording until the limit is reached, infinite if never; None if there is no limit.
    """

    total: Interval
    leak: Interval
    bound: float
    growth: Interval
    step: Interval | None
    onset: Interval | None
    healthy: Interval
    scatter: float
    limit: float | None
    reach: Interval | None


def _interval_of_draws(draws: Array) -> Interval:
    """Compute the median and the 95 % interval of random draws (d,), some of which may be infinite."""
    # "lower" takes one of the draws, as infinite ones cannot be interpolated
    low, median, high = np.quantile(draws, [0.025, 0.5, 0.975], method="lower")
    return Interval(float(median), float(low), float(high))


def estimate_wear(levels: Levels, n_healthy: int, allowed_rise: float | None, change_begin: int | None) -> Wear:
    """Estimate leakage level, growth and time to the repair limit after the last recording.

    A change begins after the first `n_healthy` recordings, or with the last one if all are healthy. `change_begin` is
    the index of the first recording after the change that the test has found. If it is None, an even growth or decrease
    over all recordings is estimated, with a wide prior. If the recordings span less than a day, growth and time are NaN
    with unlimited intervals. For a single recording the rise (`leak`) is 0 with an infinite interval.
    """
    is_changed = change_begin is not None
    is_long = levels.t[-1] - levels.t[0] >= 1.0  # [days]
    # without a change the growth may begin with the first recording
    months = (levels.t - levels.t[0]) / DAYS_PER_MONTH if is_long else np.zeros(len(levels))
    # prior scale: 100 times the scatter in each interval
    even_growth = _Changes.from_profile(months, _WIDE * DAYS_PER_MONTH / levels.interval)
    n_healthy = min(n_healthy, len(levels) - 1)
    changes = _Changes.enumerate(levels, n_healthy) if is_changed else even_growth
    draws = _Draws.sample(levels, changes, signed=not is_changed)
    leak, leak_upper_95 = Interval(0.0, -math.inf, math.inf), math.inf
    if len(levels) > 1:
        # a leak is bounded by the rise that the levels allow, even if the test has found no change
        rises = changes if is_changed else _Changes.enumerate(levels, n_healthy)
        leak_draws = (draws if is_changed else _Draws.sample(levels, rises)).last_rises(rises)
        leak, leak_upper_95 = _interval_of_draws(leak_draws), float(np.quantile(leak_draws, BOUND_PROBABILITY))
    current_level = draws.mean_before + draws.last_rises(changes)
    is_growth = changes.grows[draws.change]
    growth = np.where(is_growth, draws.amplitude, 0.0)
    mostly_grows = float(np.mean(is_growth)) >= 0.5
    healthy, scatter = _estimate_healthy_range(levels.select(slice(0, change_begin)))  # None: of all recordings
    limit = reach = None
    if allowed_rise is not None:
        limit = healthy.value + allowed_rise
        reach = Interval(math.nan, 0.0, math.inf)
        if is_long:
            with np.errstate(divide="ignore", invalid="ignore"):  # a division by a growth of 0 is not used
                days = np.where(growth > 0.0, (limit - current_level) / growth, math.inf) * DAYS_PER_MONTH
            reach = _interval_of_draws(np.where(current_level >= limit, 0.0, days))
    unknown = Interval(math.nan, -math.inf, math.inf)
    # if a growth is more probable than a step, the draws of a step do not count for the growth
    return Wear(
        total=_interval_of_draws(current_level),
        leak=leak,
        bound=leak_upper_95,
        growth=_interval_of_draws(growth[is_growth] if mostly_grows else growth) if is_long else unknown,
        step=None if mostly_grows else _interval_of_draws(draws.amplitude[~is_growth]),
        onset=_interval_of_draws(levels.t[changes.begin[draws.change]]) if is_changed else None,
        healthy=healthy,
        scatter=scatter,
        limit=limit,
        reach=reach,
    )


def _estimate_healthy_range(levels: Levels) -> tuple[Interval, float]:
    """Estimate the mean level of recordings without a change, with the range of 95 % of them, and their scatter tau.

    Mean and errors are those of the last group of comparable recordings.
    """
    no_change = _Changes.from_profile(np.zeros(len(levels)), scale=1.0)  # a change without effect on any recording
    draws = _Draws.sample(levels, no_change)
    error_variance = float(np.mean(levels.error[levels.group == levels.group[-1]] ** 2))
    # level of a single recording: mean plus scatter between recordings (tau) plus its error
    noise = np.random.default_rng(21).standard_normal(draws.tau.size)  # a fixed seed, so that results repeat
    interval = _interval_of_draws(draws.mean_before + np.sqrt(draws.tau**2 + error_variance) * noise)
    return interval._replace(value=float(draws.mean_before.mean())), math.sqrt(float(np.mean(draws.tau**2)))


class Episode(NamedTuple):
    """A period between two repairs of a machine, and the result of the test for a leak in it."""

    begin: int  # index of the first recording of the period, among all compared recordings
    end: int  # index after its last recording
    alarm: int | None  # index of the first recording at which the test raised an alarm, None if it did not
    log_days: float  # logarithm of the largest mean time to a false alarm [days] with which the test raises an alarm
    wear: Wear  # state after the last recording
    fell: bool  # True if the period began with a repair, i.e. a fall of the level


def find_episodes(
    levels: Levels, *, years: float, n_healthy: int = 1, allowed_rise: float | None = None
) -> list[Episode]:
    """Divide a series of recordings at repairs, and test and estimate the leakage in each period between them.

    `years` is the mean time to a false alarm [machine-years]. The first `n_healthy` recordings are known to be healthy;
    after a repair it is the first one. `allowed_rise`, in the unit of the levels, is the rise at which a repair is due,
    None if there is no limit. Of the earlier periods only the scatter is kept, as the prior for the next one.
    """
    days = years * DAYS_PER_YEAR
    begin, episodes = 0, list[Episode]()
    while begin < len(levels):
        remaining = levels.select(slice(begin, None))
        rise = score_changes(remaining, n_healthy)
        alarm, end = rise.find_alarm(days), _find_repair(remaining, rise, n_healthy, days)
        if alarm is not None and alarm >= end:  # an alarm after the repair belongs to the next episode
            alarm = None
        change_begin = None if alarm is None else int(rise.begin[end - 1])  # by all recordings of the period
        wear = estimate_wear(remaining.select(slice(0, end)), n_healthy, allowed_rise, change_begin)
        alarm_row, log_days = None if alarm is None else begin + alarm, float(rise.log_R[:end].max())
        episodes.append(Episode(begin, begin + end, alarm_row, log_days, wear, fell=bool(episodes)))
        # n recordings (`end`) add n - 1 degrees of freedom to the knowledge of the scatter
        prior = ScatterPrior(wear.scatter, levels.prior.freedom + min(end - 1, _MAX_FREEDOM))
        levels = replace(levels, prior=prior)
        begin, n_healthy = begin + end, 1
    return episodes


def _find_repair(levels: Levels, rise: ChangeScores, n_healthy: int, days: float) -> int:
    """Find the index of the first recording after the first repair; the number of recordings if there is no repair.

    A repair is a fall of the leakage level. `rise` is the result of the test for a rise, and `days` the mean time to a
    false alarm [days]. If a rise is detected first, the search for a fall begins with the recordings that show the
    rise, at the worn level.
    """
    first = 0  # index of the first recording that is tested for a fall
    fall = score_changes(levels, n_healthy, falls=True)
    rise_alarm, fall_alarm = rise.find_alarm(days), fall.find_alarm(days)
    if rise_alarm is not None and (fall_alarm is None or rise_alarm < fall_alarm):
        first = int(rise.begin[rise_alarm])
        # at least two recordings must show the worn level, which may grow
        fall = score_changes(levels.select(slice(first, None)), n_healthy=2, falls=True, may_grow=True)
        fall_alarm = fall.find_alarm(days)
    return len(levels) if fall_alarm is None else first + int(fall.begin[fall_alarm])
