"""Is there a step, or a growth, in a series that drifts smoothly?

The series g_1..g_n (estimates of short blocks of a recording) is a smooth drift (`smooth_drift`), noise, and perhaps
size * S(t; onset, rise), a rise from 0 to 1 that begins at `onset`. The score is twice the logarithm of the ratio of
two likelihoods: of the best step against the best of its rivals, which drift only, or drift and warm up exponentially,
or swing at one period, or have one block that stands out. Both sides choose their own strengths of drift, so that a
step does not pass for a wild drift, nor a wild drift for a step. The threshold is the quantile of the score over series
drawn from the drift that fits the data without a step, and from the one that fits beside the step, whichever is higher.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import RIVALS, DriftFamily, Posterior, interventions
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: Fewest blocks in which a step can be told from a drift.
FEWEST = 16
#: 95 % of the time the likelihood ratio at the true instant is within this of its maximum: P(2 log LR <= x) = (1 -
#: exp(-x/2))^2 (Eo & Morley, Likelihood-ratio-based confidence sets for the timing of structural breaks, Quantitative
#: Economics 6 (2015) 463-497).
ONSET_CUT = -2.0 * float(np.log(1.0 - np.sqrt(0.95)))
_DRAWS = 500
_TAIL = 0.1
#: Interventions whose score is within this of the best take part in the height of the step.
_NEAR = 20.0
#: Power of the likelihood that weighs drifts, onsets and rises for the height: under 1, because no real drift is of the
#: family (a power posterior: Holmes & Walker, Biometrika 104 (2017) 497-503).
_TRUST = 0.5


@dataclass(frozen=True, eq=False)
class StepFound:
    """The best step of a series.

    `score`, `threshold`: the score exceeds the threshold with the stated probability where nothing steps; `index`:
    first block after the onset; `onset`, `onset_interval` (95 %): in the unit of t; `rise`: duration of the rise;
    `size`, `size_sd` (f,): height of the step, averaged over what onset, rise and drift may be; `freedom`: degrees of
    freedom of `size_sd`; `drift_wins`: no step explains the series better than its rivals do; `rival`: the best of them
    ("drift", "warm-up", "pulse"); `level` (n, f): the smooth drift that was found beside the step; `drift_range` (f,):
    its extent over the series; `noise` (f,): scale of the noise over the stated one.
    """

    score: float
    threshold: float
    index: int
    onset: float
    onset_interval: tuple[float, float]
    rise: float
    size: Array
    size_sd: Array
    freedom: float
    drift_wins: bool
    rival: str
    level: Array
    drift_range: Array
    noise: Array

    @property
    def found(self) -> bool:
        """Whether the score is over the threshold."""
        return self.score > self.threshold


@lru_cache(maxsize=8)
def _even_family(n: int) -> DriftFamily:
    """Blocks of equal length and equal noise: the common case, made once."""
    return DriftFamily(np.arange(n, dtype=np.float64), np.ones(n), np.zeros((n, 1)))


def _upper_tail(null: Array, probability: float) -> float:
    """The value that a sample (m,) of the null exceeds with `probability`: beyond its upper tenth by an exponential
    tail (as of any chi-square), within by its order statistics."""
    ordered = np.sort(null)
    if probability >= _TAIL:
        return float(np.quantile(ordered, 1.0 - probability))
    start = float(np.quantile(ordered, 1.0 - _TAIL))
    mean = float(np.mean(ordered[ordered > start] - start))
    return start + mean * float(np.log(_TAIL / probability))


def find_step(
    t: Array,
    g: Array,
    sd: Array,
    false_alarm_probability: float,
    *,
    sign: int | Sequence[int] = 0,
    shared: Array | None = None,
    seed: int = 0,
) -> StepFound:
    """Look for a step or a growth in a series of block estimates against a smooth drift.

    `t` (n,): middles of the blocks, rising; `g` (n,) or (n, f): estimates; `sd`, same shape: their deviations, whose
    common scale is found anew (only the ratios matter); features are taken as independent of each other; `sign`: 1 only
    a rise counts, -1 only a fall, 0 either (one for each feature, or one for all); `shared` (n, m): errors common to
    the blocks, as columns: their covariance is shared shared^T, in the units of `g` (one feature only).

    Raises InputError where there are fewer than 16 blocks, or shapes or values do not fit.
    """
    t, g2, sd2 = (np.asarray(one, dtype=np.float64) for one in (t, g, sd))
    _check(t, g2, sd2)
    g2, sd2 = g2.reshape(t.size, -1), sd2.reshape(t.size, -1)
    f = g2.shape[1]
    signs = [sign] * f if isinstance(sign, int) else list(sign)
    spacing = float(np.median(np.diff(t)))
    u = (t - t[0]) / spacing
    unit = np.median(sd2, axis=0)
    families = [_family(u, sd2[:, j] / unit[j], None if shared is None else shared / unit[0]) for j in range(f)]
    y = g2 / unit
    found = [family.scores(y[:, j : j + 1], signs[j]) for j, family in enumerate(families)]
    course = np.sum([one[0][:, 0] for one in found], axis=0)
    best = int(np.argmax(course))
    near = np.flatnonzero(course >= course[best] - _NEAR)
    posts = [family.posterior(y[:, j], signs[j], near) for j, family in enumerate(families)]
    here = int(np.flatnonzero(near == best)[0])
    beside = tuple(int(np.argmax(post.log_l[:, here])) for post in posts)
    plain = tuple(int(one[2][0]) for one in found)
    threshold = max(
        _upper_tail(_null(families, strengths, signs, seed), false_alarm_probability) for strengths in {plain, beside}
    )
    size, size_sd = _height(posts)
    onset, first, last = _onset(u, y, families, signs, beside, course)
    levels = [family.level(y[:, j], beside[j], best) for j, family in enumerate(families)]
    return StepFound(
        score=float(course[best]),
        threshold=threshold,
        index=int(np.searchsorted(u, onset)),
        onset=float(t[0] + spacing * onset),
        onset_interval=(float(t[0] + spacing * first), float(t[0] + spacing * last)),
        rise=float(spacing * families[0].rises[best]),
        size=size * unit,
        size_sd=size_sd * unit,
        freedom=float(families[0].freedom - 2),
        drift_wins=bool(course[best] <= 0.0),
        rival=RIVALS[int(found[int(np.argmin([one[0][best, 0] for one in found]))][1][0])],
        level=np.stack(levels, axis=1) * unit,
        drift_range=np.array([np.ptp(level) for level in levels]) * unit,
        noise=np.array([np.sqrt(post.scale[row, here]) for post, row in zip(posts, beside, strict=True)]),
    )


def _family(t: Array, sd: Array, shared: Array | None) -> DriftFamily:
    even = np.allclose(np.diff(t), t[1] - t[0], rtol=0.02) and np.ptp(sd) <= 0.1 * float(np.median(sd))
    if even and shared is None:
        return _even_family(t.size)
    return DriftFamily(t, sd, np.zeros((t.size, 1)) if shared is None else shared)


def _null(families: Sequence[DriftFamily], strengths: Sequence[int], signs: Sequence[int], seed: int) -> Array:
    """Largest scores (m,) of series that drift as said and do not step."""
    kept = families[0].nulls if len(families) == 1 else {}
    key = (strengths[0], signs[0] != 0, seed)
    if key not in kept:
        random = np.random.default_rng((seed, *strengths))
        total: Array | float = 0.0
        for family, number, sign in zip(families, strengths, signs, strict=True):
            y = family.drifts[number].root @ random.standard_normal((family.n, _DRAWS))
            total = total + family.scores(y, abs(sign))[0]
        kept[key] = np.asarray(np.max(total, axis=0))
    return kept[key]


def _height(posts: Sequence[Posterior]) -> tuple[Array, Array]:
    """Height of the step (f,) and its deviation (f,), averaged over drift, onset and rise by their likelihood."""
    joint: Array | float = 0.0
    inner = []
    for post in posts:
        weight = np.exp(_TRUST * (post.log_l - post.log_l.max()))
        joint = joint + np.log(weight.sum(axis=0) + np.finfo(float).tiny)
        inner.append(weight / (weight.sum(axis=0) + np.finfo(float).tiny))
    joint = np.asarray(joint)
    over = np.exp(joint - joint.max())
    over /= over.sum()
    size, sd = np.empty(len(posts)), np.empty(len(posts))
    for j, (post, weight) in enumerate(zip(posts, inner, strict=True)):
        both = weight * over
        size[j] = np.sum(both * post.size)
        sd[j] = np.sqrt(np.sum(both * (post.variance + (post.size - size[j]) ** 2)))
    return size, sd


def _onset(
    u: Array,
    y: Array,
    families: Sequence[DriftFamily],
    signs: Sequence[int],
    beside: Sequence[int],
    course: Array,
) -> tuple[float, float, float]:
    """Onset and its 95 % interval [blocks]: the likelihood over all interventions, finer near the best, and half a
    block on either side, because how far a block is moved depends on more than when within it the step came."""
    family = families[0]
    near = course >= course.max() - ONSET_CUT
    first, last = float(family.onsets[near].min()), float(family.onsets[near].max())
    best = int(np.argmax(course))
    onset, rise = float(family.onsets[best]), float(family.rises[best])
    fine = onset + np.arange(-8, 9) / 8.0
    gain = np.zeros(fine.size)
    for j, one in enumerate(families):
        drift = one.drifts[beside[j]]
        white = drift.whiten @ interventions(u, fine, rise).T
        target = drift.whiten @ y[:, j]
        moved = white.T @ target / np.maximum(np.sqrt(np.sum(white**2, axis=0)), 1e-12)
        if signs[j]:
            moved = np.maximum(signs[j] * moved, 0.0)
        gain -= one.freedom * np.log(np.maximum(target @ target - moved**2, np.finfo(float).tiny))
    fitting = fine[gain >= gain.max() - ONSET_CUT]
    onset = float(fine[np.argmax(gain)])
    return onset, min(first, float(fitting.min())) - 0.5, max(last, float(fitting.max())) + 0.5


def _check(t: Array, g: Array, sd: Array) -> None:
    if t.ndim != 1 or t.size < FEWEST:
        raise InputError(f"a step needs {FEWEST} blocks or more to be told from a drift, got {t.size}")
    if g.shape != sd.shape or g.ndim not in (1, 2) or g.shape[0] != t.size:
        raise InputError(
            f"estimates and deviations must have one shape, of {t.size} blocks, got {g.shape} and {sd.shape}"
        )
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(g)) and np.all(np.isfinite(sd))):
        raise InputError("times, estimates and deviations must be finite, got NaN or infinity")
    if np.any(np.diff(t) <= 0):
        raise InputError("times of blocks must rise, got some that do not")
    if np.any(sd <= 0):
        raise InputError(f"deviations must be > 0, got {sd.min()}")
