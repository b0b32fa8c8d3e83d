"""Scan for a step, or a growth, in a series that drifts smoothly.

The series g_1..g_n (estimates of short blocks of a recording) is a smooth drift, noise, and perhaps size * S(t; onset,
rise), a rise from 0 to 1 that begins at `onset`. The drift is a + b t and a walk, which is a random walk plus an
integrated random walk (the local level and the local linear trend of structural time series: Harvey, Forecasting,
structural time series models and the Kalman filter, 1989, ch. 2), or, in quiet series, one that is integrated twice.
Their strengths are unknown: likelihoods, restricted to what a and b leave (REML), are compared over a grid of
strengths, the scale of the noise being profiled out. Where blocks overlap by half, every other one has an a and b of
its own.

The score is twice the logarithm of the ratio of two likelihoods: of the best step against the best of its rivals, which
drift only, or drift and warm up exponentially, or swing at one period, or have one outlying block. Both sides choose
their own strengths of drift, so that a step is not mistaken for a strong drift, nor a strong drift for a step. The
threshold is the quantile of the score over series drawn from the drift that fits the data without a step, and from the
drift that fits beside the step, whichever is higher. It depends on the number of blocks and on the drift's strength and
is interpolated in a table (`tails.null_threshold`). Gaps, unequal deviations and shared errors, which the table does
not know, made the probability 0.45 to 1.7 times the stated one where they were tried (docs/notes/null-tables.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.shapes import least_blocks, rises, warm_ups
from sealscope.diagnosis.changepoint.tails import near_best, null_chance, null_threshold
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: Fewest blocks in which a step can be distinguished from a drift.
FEWEST = 16
#: Blocks that are searched at once, at most: the last of the tables.
MOST_BLOCKS = 96
#: Durations of the rise, as a share of the series: an abrupt step, and a growth. Slower growths look like drifts that
#: bend: with 0.3 half of all false alarms on a drifting bench were such.
_RISES = (0.0, 0.1)
#: Time constants of a warm-up, as a share of the series.
_WARM_UPS = (0.03, 0.06, 0.12, 0.25)
#: Periods of a swing, as a share of the series.
_SWINGS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18)
#: Strengths of the walk and of the integrated walk: variance of one block's move over that of one block's noise.
_WALKS = (0.0, 1e-3, 4e-3, 1.6e-2, 6e-2, 0.25, 1.0, 4.0, 20.0, 200.0)
_SLOPES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
_WALKS_BESIDE_SLOPES = (0.0, 1e-2, 0.25)
#: Strengths (walk, integrated walk, twice integrated walk) that are tried together.
STRENGTHS = tuple((walk, 0.0, 0.0) for walk in _WALKS) + tuple(
    (walk, slope, 0.0) for walk in _WALKS_BESIDE_SLOPES for slope in _SLOPES
)
#: ... and, where the noise is far below the drift, of stronger and of smoother walks beside these: only then a step is
#: told from a drift that is far larger.
_BENDS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
QUIET_STRENGTHS = (
    *STRENGTHS,
    *((0.0, slope, 0.0) for slope in (1.0, 10.0, 100.0)),
    *((0.0, 0.0, bend) for bend in _BENDS),
)
#: Onsets tried in a block.
_FRACTIONS = 3
#: Interventions whose score is within this of the best take part in the height of the step.
_NEAR = 20.0
#: Highest steps that are looked for as the smallest that would have been seen, over the noise: where that is far below
#: the drift, steps of the drift's size are far above it.
_HIGHEST = {False: 200.0, True: 2e4}
#: Where the smallest step that would have been seen is looked for, as shares of the series.
_ADDED_AT = (0.3, 0.5, 0.7)
#: Power of the likelihood that weighs drifts, onsets and rises for the height: under 1, because no real drift is of the
#: family (a power posterior: Holmes & Walker, Biometrika 104 (2017) 497-503).
_TRUST = 0.5
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class DriftStep:
    """The best step of a series.

    `score`, `threshold`: the score exceeds the threshold with the stated probability where nothing steps, and
    itself with that of `chance`; `index`:
    first block after the onset; `onset`, `onset_interval` (95 %): in the unit of t; `rise`: duration of the rise;
    `size`, `size_sd`: height of the step, averaged over the likely onsets, rises and drifts; `freedom`: degrees of
    freedom of `size_sd`; `level` (n,): the smooth drift fitted beside the step; `noise`: scale of the noise over the
    stated one.
    """

    score: float
    threshold: float
    chance: float
    index: int
    onset: float
    onset_interval: tuple[float, float]
    rise: float
    size: float
    size_sd: float
    freedom: float
    level: Array
    noise: float

    @property
    def alarm(self) -> bool:
        """Whether the score exceeds the threshold."""
        return self.score > self.threshold

    @property
    def quantile(self) -> float:
        """Half width of the 95 % interval of `size` over `size_sd`: Student's."""
        from scipy.special import stdtrit

        return float(stdtrit(max(self.freedom, 1.0), 0.975))


@dataclass(frozen=True, eq=False)
class WhitenedDrift:
    """One strength of drift, prepared for many series.

    `whiten` (n - 2, n) takes out a + b t and the drift's correlation; `steps`, `warm_ups`, `pulses`, `swings` (., n):
    unit vectors of the interventions after that, a swing in two rows; `weight`: factor of the sum of squares that makes
    likelihoods comparable; `root` (n, n): Cholesky factor of the covariance; `drift` (n, n): the part of it that is not
    noise.
    """

    whiten: Array
    steps: Array
    warm_ups: Array
    pulses: Array
    swings: Array
    weight: float
    root: Array
    drift: Array


@dataclass(frozen=True, eq=False)
class Posterior:
    """For every drift and intervention (d, k): log likelihood, height of the step, its variance, noise variance."""

    log_l: Array
    size: Array
    variance: Array
    scale: Array


class DriftFamily:
    """All drifts for one time axis `t` (n,) in blocks, and one set of relative deviations `sd` (n,).

    `shared` (n, m): errors common to the blocks, as columns, in units of the deviations; `quiet`: with
    `QUIET_STRENGTHS`; `length` of a block on the axis: over 1 where blocks overlap.
    """

    def __init__(self, t: Array, sd: Array, shared: Array, *, quiet: bool = False, length: float = 1.0) -> None:
        n = t.size
        self.n, self.t, self.quiet, self.length = n, t, quiet, length
        overlapping = length > 1.0
        least = round(length * least_blocks(round(n / length)))
        starts, durations = [], []
        for share in _RISES:
            rise = share * float(t[-1] - t[0])
            if 0.0 < rise < 2.0:
                continue
            begin, end = t[0] - 0.5 + (least if rise == 0 else 1), t[-1] + 0.5 - max(float(least), rise)
            every = 1.0 / _FRACTIONS if rise == 0 else max(1.0, rise / 6.0)
            usable = np.arange(begin, end + 1e-9, every)
            starts.append(usable)
            durations.append(np.full(usable.size, rise))
        self.onsets, self.rises = np.concatenate(starts), np.concatenate(durations)
        self.shapes = np.concatenate(
            [rises(t, some, float(r[0]), length) for some, r in zip(starts, durations, strict=True)]
        )
        u = t - t[0]
        span = float(u[-1])
        turns = 2.0 * np.pi * u / span
        swings = np.array([[np.sin(turns / share), np.cos(turns / share)] for share in _SWINGS])
        warm = warm_ups(u, span, _WARM_UPS)
        self.fixed = np.stack([np.ones(n), u / span], axis=1)
        if overlapping:  # every other block lies in the same part of a cycle
            self.fixed = np.concatenate([self.fixed, self.fixed * ((-1.0) ** np.round(u))[:, None]], axis=1)
        self.freedom = n - self.fixed.shape[1]
        relative = sd / np.median(sd)
        some = shared / np.median(sd)
        noise = np.diag(relative**2) + some @ some.T
        low, high = np.minimum.outer(u, u), np.maximum.outer(u, u)
        walk, slope, bend = low, low**2 * (3.0 * high - low) / 6.0, _twice_integrated(low, high, span)
        pulses = np.eye(n)
        if overlapping:
            pulses = np.concatenate([pulses, pulses[:-1] + pulses[1:]])
        strengths = QUIET_STRENGTHS if quiet else STRENGTHS
        self.drifts = [
            self._drift(noise, q1 * walk + q2 * slope + q3 * bend, warm, swings, pulses) for q1, q2, q3 in strengths
        ]

    def _drift(self, noise: Array, drift: Array, warm: Array, swings: Array, pulses: Array) -> WhitenedDrift:
        root = np.linalg.cholesky(noise + drift)
        inverse = np.linalg.inv(root)
        basis, triangle = np.linalg.qr(inverse @ self.fixed, mode="complete")
        whiten = basis[:, self.fixed.shape[1] :].T @ inverse
        log_det = 2.0 * np.sum(np.log(np.diag(root))) + 2.0 * np.sum(np.log(np.abs(np.diag(triangle))))

        def units(rows: Array) -> Array:
            white = whiten @ rows.T
            return np.asarray((white / np.maximum(np.sqrt(np.sum(white**2, axis=0)), 1e-12)).T)

        return WhitenedDrift(
            whiten,
            units(self.shapes) @ whiten,
            units(warm) @ whiten,
            units(pulses) @ whiten,
            np.concatenate(np.linalg.qr(whiten @ swings.transpose(0, 2, 1))[0].transpose(0, 2, 1)) @ whiten,
            float(np.exp(log_det / self.freedom)),
            np.asarray(root, dtype=np.float64),
            drift,
        )

    @property
    def table(self) -> str:
        """Name of the table of its thresholds."""
        if self.length > 1.0:
            return "overlapping_drift"
        return "quiet_drift" if self.quiet else "smooth_drift"

    def scores(self, y: Array, sign: int) -> tuple[Array, NDArray[np.intp]]:
        """Return the score of every intervention (k, m) in series y (n, m), and the drift (m,) likeliest without any.

        `sign`: 1 only a rise counts, -1 only a fall.
        """
        best = np.full((self.onsets.size, y.shape[1]), np.inf)
        plain, least = np.full((2, y.shape[1]), np.inf)
        number = np.zeros(y.shape[1], dtype=np.intp)
        for row, drift in enumerate(self.drifts):
            squares = np.sum((drift.whiten @ y) ** 2, axis=0)
            moved = np.maximum(sign * (drift.steps @ y), 0.0)
            np.minimum(best, drift.weight * (squares - moved**2), out=best)
            number[drift.weight * squares < plain] = row
            np.minimum(plain, drift.weight * squares, out=plain)
            for gain in (
                0.0,
                np.max((drift.warm_ups @ y) ** 2, axis=0),
                np.max((drift.pulses @ y) ** 2, axis=0),
                np.max(((drift.swings @ y) ** 2).reshape(len(_SWINGS), 2, -1).sum(axis=1), axis=0),
            ):
                np.minimum(least, drift.weight * (squares - gain), out=least)
        return np.asarray(self.freedom * np.log(np.maximum(least, _TINY) / np.maximum(best, _TINY))), number

    def posterior(self, y: Array, sign: int, near: NDArray[np.intp]) -> Posterior:
        """Return the posterior of one series y (n,) over every drift and every intervention of `near` (k,).

        The blocks in which a step begins are left out: how far they are moved depends on more than when within them the
        step came.
        """
        shape = (len(self.drifts), near.size)
        log_l, size, variance, scale = (np.empty(shape) for _ in range(4))
        hits = self._hit(near)
        for row, drift in enumerate(self.drifts):
            target = drift.whiten @ y
            squares = float(target @ target)
            outside = np.zeros(near.size)
            rise = drift.whiten @ self.shapes[near].T
            spares: list[Array] = []
            for hit in hits:
                spare = drift.whiten[:, hit] * (self.rises[near] == 0.0)
                for other in spares:
                    spare -= other * np.sum(other * spare, axis=0)
                spare /= np.maximum(np.sqrt(np.sum(spare**2, axis=0)), 1e-12)
                outside += (target @ spare) ** 2
                rise -= spare * np.sum(spare * rise, axis=0)
                spares.append(spare)
            norms = np.maximum(np.sqrt(np.sum(rise**2, axis=0)), 1e-9)
            moved = (target @ rise) / norms
            rest = np.maximum(squares - outside - moved**2, _TINY)
            rest = np.where(sign * moved < 0, squares, rest)
            size[row] = moved / norms
            scale[row] = rest / (self.freedom - 2)
            variance[row] = scale[row] / norms**2
            log_l[row] = -0.5 * self.freedom * np.log(drift.weight * rest)
        return Posterior(log_l, size, variance, scale)

    def _hit(self, near: NDArray[np.intp]) -> list[NDArray[np.intp]]:
        """Return the blocks (k,) in which each of the steps `near` (k,) begins: one where blocks do not overlap."""
        onsets = self.onsets[near]
        if self.length == 1.0:
            return [np.argmin(np.abs(self.t[None, :] - np.floor(onsets + 0.5)[:, None]), axis=1)]
        order = np.argsort(np.abs(self.t[None, :] - onsets[:, None]), axis=1, kind="stable")
        return list(order[:, : round(self.length)].T)

    def level(self, y: Array, number: int, best: int) -> Array:
        """Return the smooth drift (n,), its mean and slope included, beside the intervention `best`."""
        drift = self.drifts[number]
        columns = np.column_stack([self.fixed, self.shapes[best]])
        white, target = np.linalg.solve(drift.root, columns), np.linalg.solve(drift.root, y)
        coefficients, *_ = np.linalg.lstsq(white, target, rcond=None)
        rest = np.linalg.solve(drift.root.T, target - white @ coefficients)
        return np.asarray(self.fixed @ coefficients[:-1] + drift.drift @ rest)


def _twice_integrated(low: Array, high: Array, span: float) -> Array:
    """Return the covariance of a walk integrated twice, at the lower and the higher of two times since its start.

    Its curvature has walked for as long as the series before it begins: ``span low^2 high^2 / 4``.
    """
    apart = high - low
    own = low**3 * (low**2 / 5.0 + apart * low / 2.0 + apart**2 / 3.0) / 4.0
    return np.asarray(own + span * (low * high) ** 2 / 4.0)


@lru_cache(maxsize=16)
def _even_family(n: int, quiet: bool = False, length: float = 1.0) -> DriftFamily:
    """Return the family of blocks of equal length and equal noise, the common case."""
    return DriftFamily(np.arange(n, dtype=np.float64), np.ones(n), np.zeros((n, 1)), quiet=quiet, length=length)


def _family(t: Array, sd: Array, shared: Array | None, quiet: bool, length: float) -> DriftFamily:
    even = np.allclose(np.diff(t), t[1] - t[0], rtol=0.02) and np.ptp(sd) <= 0.1 * float(np.median(sd))
    if even and shared is None:
        return _even_family(t.size, quiet, length)
    zeros = np.zeros((t.size, 1))
    return DriftFamily(t, sd, zeros if shared is None else shared, quiet=quiet, length=length)


def find_step(
    t: Array,
    g: Array,
    sd: Array,
    false_alarm_probability: float,
    *,
    sign: int = 1,
    shared: Array | None = None,
    quiet: bool = False,
    halves: bool = False,
) -> DriftStep:
    """Look for a step or a growth in a series of block estimates against a smooth drift.

    `t` (n,): middles of the blocks, rising; `g` (n,): estimates; `sd` (n,): their deviations, whose common scale is
    estimated anew (only the ratios matter); `sign`: 1 only a rise counts, -1 only a fall; `shared` (n, m): errors
    common to the blocks, as columns: their covariance is shared shared^T, in the units of `g`; `quiet`: the noise is
    far below the drift (`QUIET_STRENGTHS`); `halves`: quiet blocks that overlap by half.

    Raises InputError where there are fewer than 16 blocks, or shapes or values do not fit.
    """
    t, g, sd = (np.asarray(values, dtype=np.float64) for values in (t, g, sd))
    _check(t, g, sd)
    spacing = float(np.median(np.diff(t)))
    u = (t - t[0]) / spacing
    unit = np.median(sd)
    family = _family(u, sd / unit, None if shared is None else shared / unit, quiet, 2.0 if halves else 1.0)
    y = g / unit
    scores, plain = family.scores(y[:, None], sign)
    course = scores[:, 0]
    best = int(np.argmax(course))
    near = np.flatnonzero(course >= course[best] - _NEAR)
    post = family.posterior(y, sign, near)
    here = int(np.flatnonzero(near == best)[0])
    beside = int(np.argmax(post.log_l[:, here]))
    drifts = (int(plain[0]), beside)
    threshold = max(null_threshold(family.table, false_alarm_probability, family.n, number) for number in drifts)
    size, size_sd = _height(post)
    onset, first, last = _onset(u, y, family, sign, beside, course)
    return DriftStep(
        score=float(course[best]),
        threshold=threshold,
        chance=max(null_chance(family.table, float(course[best]), family.n, number) for number in drifts),
        index=int(np.searchsorted(u, onset)),
        onset=float(t[0] + spacing * onset),
        onset_interval=(float(t[0] + spacing * first), float(t[0] + spacing * last)),
        rise=float(spacing * family.rises[best]),
        size=float(size * unit),
        size_sd=float(size_sd * unit),
        freedom=float(family.freedom - 2),
        level=family.level(y, beside, best) * unit,
        noise=float(np.sqrt(post.scale[beside, here])),
    )


def share_of_threshold(g: Array, false_alarm_probability: float, *, sign: int = 1) -> float:
    """Return the score that `find_step` finds in a series (n,), as a share of its least threshold of any drift.

    For blocks that follow each other evenly with equal deviations, at a thirtieth of the cost of `find_step`: no
    posterior, and the oldest n modulo 4 blocks are left out, so that few families are kept. Over 1 an alarm may follow.
    """
    n = g.size - g.size % 4
    scores, _ = _even_family(n).scores(np.asarray(g[g.size - n :], dtype=np.float64)[:, None], sign)
    return float(scores.max()) / _least_threshold(false_alarm_probability, n)


@lru_cache(maxsize=256)
def _least_threshold(false_alarm_probability: float, n: int) -> float:
    return min(null_threshold("smooth_drift", false_alarm_probability, n, k) for k in range(len(STRENGTHS)))


def findable_step(
    t: Array,
    g: Array,
    sd: Array,
    false_alarm_probability: float,
    noise: float,
    *,
    shared: Array | None = None,
    quiet: bool = False,
    halves: bool = False,
) -> float:
    """Return the smallest step that would have been an alarm in a series in which none was.

    Steps of growing height are added at three places of the middle of the series, to its own noise and drift; the
    height is that over which all three, and every higher one, exceed the threshold of any drift; infinite where none
    does. `noise`: scale of the noise over the stated one; `quiet`, `halves`: as in `find_step`.
    """
    u = (t - t[0]) / float(np.median(np.diff(t)))
    unit = float(np.median(sd))
    family = _family(u, sd / unit, None if shared is None else shared / unit, quiet, 2.0 if halves else 1.0)
    heights = noise * np.geomspace(0.2, _HIGHEST[quiet], 36)
    shapes = rises(u, u[0] + np.array(_ADDED_AT) * (u[-1] - u[0]), length=family.length)
    series = (g / unit)[:, None] + (shapes.T[:, :, None] * heights).reshape(u.size, -1)
    threshold = max(
        null_threshold(family.table, false_alarm_probability, family.n, number) for number in range(len(family.drifts))
    )
    seen = np.max(family.scores(series, 1)[0], axis=0).reshape(len(_ADDED_AT), -1).min(axis=0) > threshold
    if not seen[-1]:
        return float("inf")
    unseen = np.flatnonzero(~seen)
    return float(heights[unseen[-1] + 1 if unseen.size else 0] * unit)


def _height(post: Posterior) -> tuple[float, float]:
    """Return height and deviation of the step, averaged over drift, onset and rise by their likelihood."""
    weight = np.exp(_TRUST * (post.log_l - post.log_l.max()))
    total = weight.sum(axis=0) + _TINY
    joint = np.log(total)
    over = np.exp(joint - joint.max())
    over /= over.sum()
    weight = weight / total * over
    size = np.sum(weight * post.size)
    return float(size), float(np.sqrt(np.sum(weight * (post.variance + (post.size - size) ** 2))))


def _onset(
    u: Array, y: Array, family: DriftFamily, sign: int, beside: int, course: Array
) -> tuple[float, float, float]:
    """Return the onset and its 95 % interval [blocks].

    From the likelihood over all interventions, finer near the best, and half a block on either side, because how far a
    block is moved depends on more than when within it the step came.
    """
    near = near_best(course)
    first, last = float(family.onsets[near].min()), float(family.onsets[near].max())
    best = int(np.argmax(course))
    fine = float(family.onsets[best]) + np.arange(-8, 9) / 8.0
    drift = family.drifts[beside]
    white = drift.whiten @ rises(u, fine, float(family.rises[best]), family.length).T
    target = drift.whiten @ y
    moved = np.maximum(sign * (white.T @ target / np.maximum(np.sqrt(np.sum(white**2, axis=0)), 1e-12)), 0.0)
    gain = -family.freedom * np.log(np.maximum(target @ target - moved**2, _TINY))
    fitting = fine[near_best(gain)]
    return float(fine[np.argmax(gain)]), min(first, float(fitting.min())) - 0.5, max(last, float(fitting.max())) + 0.5


def _check(t: Array, g: Array, sd: Array) -> None:
    if t.ndim != 1 or t.size < FEWEST:
        raise InputError(f"a step needs {FEWEST} blocks or more to be distinguished from a drift, got {t.size}")
    if not g.shape == sd.shape == t.shape:
        raise InputError(
            f"estimates and deviations must have one shape, of {t.size} blocks, got {g.shape} and {sd.shape}"
        )
    if not all(np.all(np.isfinite(values)) for values in (t, g, sd)):
        raise InputError("times, estimates and deviations must be finite, got NaN or infinity")
    if np.any(np.diff(t) <= 0):
        raise InputError("times of blocks must rise, got some that do not")
    if np.any(sd <= 0):
        raise InputError(f"deviations must be > 0, got {sd.min()}")
