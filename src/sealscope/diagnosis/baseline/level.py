"""Level of a conductance in a recording against its levels in leak-free recordings of the same machine.

The level that recording i states is

    y_i = mu + d_i + e_i,    d_i ~ N(0, tau^2),    e_i ~ N(0, s_i^2),

with the machine's level mu, what changes from day to day d_i (temperature of the oil, how the seals lie), and the
recording's own error e_i, whose deviation s_i is stated. Of mu nothing is known beforehand; tau^2 has a scaled inverse
chi-square prior, ``tau^2 ~ nu tau_0^2 / chi^2_nu``, whose scale tau_0 and degrees of freedom nu each detector states
(`DayToDay`). The test compares y_0 with its predictive distribution without a leak, given the levels y_1 .. y_k of the
leak-free recordings. Without errors of their own that is Student's distribution with nu + k - 1 degrees of freedom, the
mean of y_1 .. y_k and

    scale^2 = (1 + 1/k) (nu tau_0^2 + sum_i (y_i - mean)^2) / (nu + k - 1);

with errors it is the mixture of normal distributions over the posterior of tau, which is summed on a grid. One
baseline recording is enough; more of them replace the prior by the machine's own scatter.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2 and 5.4 (eqs. 5.17 to 5.21).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealscope.diagnosis.verdict.evidence import Cause, Evidence, Figure, LeakCourse, RelativeLeak
from sealscope.recordings.recording import Array

#: The grid of tau: from this share of the prior's scale to so many times the larger of scale and scatter seen.
_LEAST, _MOST, _NODES = 0.02, 50.0, 200


@dataclass(frozen=True)
class Level:
    """Mean conductance of a recording and the standard error it states for it, in the detector's unit."""

    value: float
    error: float


@dataclass(frozen=True)
class DayToDay:
    """Prior on the standard deviation of the level from day to day: a `scale` with degrees of `freedom`."""

    scale: float
    freedom: float


@dataclass(frozen=True)
class Rise:
    """Level of a recording beyond that of the baseline.

    `size` and its 95 % interval, in the unit of the levels; `score`: the standard normal deviate of the probability
    that a leak-free recording exceeds this level; `threshold`: that of the false-alarm probability; `chance`: that
    probability itself.
    """

    size: float
    interval: tuple[float, float]
    score: float
    threshold: float
    chance: float


def share_of_each(false_alarm_probability: float, baseline: Sequence[object]) -> float:
    """Return the false-alarm probability of each test of a recording.

    With a baseline two tests may alarm, that of a step within the recording and that of its level; each gets half.
    """
    return false_alarm_probability / (2.0 if baseline else 1.0)


def rise_of(own: Level, baseline: Sequence[Level], prior: DayToDay, false_alarm_probability: float) -> Rise:
    """Compare a level with those of one leak-free recording or more."""
    from scipy.optimize import brentq
    from scipy.special import log_ndtr, logsumexp, ndtr, ndtri, ndtri_exp

    log_weight, mean, deviation = _predictions(baseline, prior)
    size, deviation = own.value - mean, np.hypot(deviation, own.error)
    weight = np.exp(log_weight)
    log_exceeds = float(logsumexp(log_weight + log_ndtr(-size / deviation)))
    low, high = float(np.min(size - 40.0 * deviation)), float(np.max(size + 40.0 * deviation))

    def limit(probability: float) -> float:
        return float(brentq(lambda x: float(weight @ ndtr((x - size) / deviation)) - probability, low, high))

    return Rise(
        size=float(weight @ size),
        interval=(limit(0.025), limit(0.975)),
        score=-float(ndtri_exp(log_exceeds)),
        threshold=-float(ndtri(false_alarm_probability)),
        chance=float(np.exp(log_exceeds)),
    )


def _predictions(baseline: Sequence[Level], prior: DayToDay) -> tuple[Array, Array, Array]:
    """Return the logarithm of the posterior of tau on a grid, and mean and deviation of the next level for each.

    With weights w_i = 1/(tau^2 + s_i^2) and mu = sum w_i y_i / sum w_i, the marginal likelihood of tau is
    ``prod w_i^(1/2) (sum w_i)^(-1/2) exp(-sum w_i (y_i - mu)^2 / 2)``.
    """
    from scipy.special import logsumexp

    values = np.array([level.value for level in baseline])
    errors = np.array([level.error for level in baseline])
    tau = np.geomspace(_LEAST * prior.scale, _MOST * max(prior.scale, float(np.ptp(values))), _NODES)
    w = 1.0 / (tau[:, None] ** 2 + errors**2)
    total = w.sum(axis=1)
    mean = w @ values / total
    log_prior = -prior.freedom * (np.log(tau) + 0.5 * (prior.scale / tau) ** 2)  # of log tau
    log_likelihood = 0.5 * (np.log(w).sum(axis=1) - np.log(total) - np.sum(w * (values - mean[:, None]) ** 2, axis=1))
    log_weight = log_prior + log_likelihood
    return log_weight - float(logsumexp(log_weight)), mean, np.sqrt(tau**2 + 1.0 / total)


def against_baseline(
    within: Evidence,
    own: Level,
    baseline: Sequence[Level],
    prior: DayToDay,
    false_alarm_probability: float,
    *,
    part: str,
    flows: Sequence[float],
    cause: Cause | None,
    course: LeakCourse | None = None,
    refuses: frozenset[Figure] = frozenset(),
    relative: Callable[[float, tuple[float, float]], RelativeLeak] | None = None,
) -> Evidence:
    """Return the evidence of both tests: of a rise `within` the recording, and of its level against the baseline's.

    A rise within the recording that is a leak, or has another cause, decides; else the level does. `part`: name of the
    level's test; `flows`: L/min in a unit of the level, by each law that the leak may follow, the first of them for the
    size and all of them for the interval (none where L/min is not stated). `cause`, `course`, `refuses`: of a leak that
    the level shows; `relative`: gives the leak of a rise of the level and of its interval beside the pump's flow.
    """
    if not baseline:
        return incomparable(within, "none has the same duty and follows the model")
    rise = rise_of(own, baseline, prior, false_alarm_probability)
    alarm = rise.score > rise.threshold
    parts = (*within.parts, Evidence("leak" if alarm else "no leak", "", rise.score, rise.threshold, detector=part))
    count = f"{len(baseline)} baseline recording{'s' if len(baseline) > 1 else ''}"
    figures = f"score {rise.score:.1f}, threshold {rise.threshold:.1f}, {count}"
    if within.verdict == "leak" or within.cause is not None or not alarm:
        order = "higher than" if alarm else "not above"
        reason = f"{within.reason}; over the whole recording the leakage conductance is {order} the baseline's"
        return replace(within, reason=f"{reason} ({figures})", parts=parts, chance=_of_both(within.chance))
    lpm, interval, by = None, None, ""
    if flows:
        lpm = rise.size * flows[0]
        limits = [limit * flow for limit in rise.interval for flow in flows]
        interval = (max(0.0, min(limits)), max(limits))
        by = f" by {lpm:.2g} L/min ({interval[0]:.2g} to {interval[1]:.2g})"
    return Evidence(
        "leak",
        f"the leakage conductance is above the baseline's{by}, from the start ({figures}); within the recording: "
        f"{within.reason}",
        rise.score,
        rise.threshold,
        leak_lpm=lpm,
        leak_interval_lpm=interval,
        parts=parts,
        cause=cause,
        course=course,
        refuses=refuses,
        chance=_of_both(rise.chance),
        relative=None if relative is None else relative(rise.size, (max(0.0, rise.interval[0]), rise.interval[1])),
    )


def incomparable(within: Evidence, reason: str) -> Evidence:
    """Return the evidence where a baseline was given and no recording of it can be compared."""
    verdict = within.verdict if within.verdict == "leak" or within.cause is not None else "cannot tell"
    reason = f"{within.reason}; no baseline recording can be compared: {reason}"
    return replace(within, verdict=verdict, reason=reason, chance=_of_both(within.chance))


def _of_both(chance: float | None) -> float | None:
    """Return the probability that either of two tests shows as much."""
    return None if chance is None else min(1.0, 2.0 * chance)
