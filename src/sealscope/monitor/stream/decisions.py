"""The sequential tests of one actuator, which share a stated rate of false alarms per operating hour.

Three tests look at the conductance of pump and piston, each at another pace:

- *step*: the last blocks are searched for a rise that no smooth drift explains (by volumes in a fit of the balance,
  `volume_balance.evidence.judge`, as `SequentialBalance` does; by pressures in the conductances), when two cheap
  contrasts and the score of the conductances have shown one worth it;
- *rise*: the same search over means of `GROUP` blocks, some fifty minutes;
- *level*: a mean of `GROUP` blocks over `WARMEST` times the least one of the baseline: more than oil that warms by 30 K
  makes of it.

The first two take 45 % of the rate each, the third 10 %. Each look has the probability rate x seconds between looks, so
the rate is an upper bound: looks overlap (Lai, JRSS B 57 (1995) 613-658).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, find_step, share_of_threshold
from sealscope.diagnosis.changepoint.tails import RARER
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.blocks import BalanceBlocks, Geometry
from sealscope.diagnosis.volume_balance.evidence import judge, trouble
from sealscope.diagnosis.volume_balance.fit import fit_balance
from sealscope.diagnosis.volume_balance.growth import WARMEST
from sealscope.errors import InputError
from sealscope.monitor.stream.baseline import WatchBaseline
from sealscope.monitor.stream.geometry import duty_of
from sealscope.recordings.recording import Array

#: Blocks of one mean of the slower tests.
GROUP = 16
#: Blocks, or means, that are searched for a rise.
WINDOW = 60
#: Share of the rate of false alarms that each test takes.
_SHARES = {"step": 0.45, "rise": 0.45, "level": 0.1}
#: Probabilities of a look for which a threshold is known.
_PROBABILITIES = (1e-12, 0.05)
#: A rise as rare as this share of the stated rate, or rarer, is said to be so rare: tails are not known further out.
_RAREST = 1e-9
#: A search is worth its time where the contrast of a step is this many deviations. An alarm has more: a score over 26,
#: the least threshold, is a contrast of 5.8, of which the deviation's own error takes a fifth.
_WORTH_A_SEARCH = 4.5
#: Fewer values than this do not show how far they wander.
_FEW = 40
#: ... and so many beside the means of so many values before it, where the conductance wanders.
_BESIDE_NEIGHBOURS, _NEIGHBOURS, _LAG = 3.5, (1, 2, 4, 8, 16, 24), 8
#: A balance is fitted anew and searched where the score of the frozen one is over this share of the threshold (of 184
#: searches the two scores differed by 0.6 at most, thresholds are 27 and more), or where the last tenth of the blocks
#: is this many times the first one, by so many deviations of a mean.
_NEAR_THE_THRESHOLD, _GROWN, _SURELY_GROWN = 0.6, 0.75 * WARMEST, 3.0
#: Blocks are even where they differ by less than this share of their spacing.
_EVEN = 0.02
#: Logarithm by which the duty changes where a rise of the conductance is not compared across it.
_OTHER_DUTY = 0.15
#: ... and by which a leak may lower the pressure difference, since the chambers ring less: 0.015 L/min by 0.24.
_DAMPED = 0.7
#: What pressures alone show: an external leak raises alarms as one inside does.
INSIDE_OR_OUTSIDE = "leak inside or outside"
#: What leaks over what shows of it, by cause: least, usual, most. By volumes one chamber loses the oil of an external
#: leak, and the balance is half the difference of both. What the make-up gives the other chamber counts as a leak, too,
#: so that all of it shows where one side carries the load, and about half where the load reverses (0.42 to 0.55 in
#: simulations). By pressures an external leak shows as 2.6 to 4.1 times what it is.
SHOWN = {"external leak": (1.0, 2.0, 2.5), INSIDE_OR_OUTSIDE: (0.2, 1.0, 1.0)}
_HALF_SHOWN = "; of what leaves one chamber the balance of both shows about half"
#: A rise that comes from these is an alarm, whichever of them it is.
_CAUSES = ("piston leak", "piston or pump leak", "pump leak", "external leak")


@dataclass(frozen=True)
class ConductanceRise:
    """A rise of the conductance that a test shows.

    `test`: which one; `onset_s`, `onset_interval_s`: clock [s]; `size`, `size_sd`: [m^3/(s Pa)]; `cause`, `reason`: in
    words; `score`, `threshold`.
    """

    test: str
    onset_s: float
    onset_interval_s: tuple[float, float]
    size: float
    size_sd: float
    cause: str
    reason: str
    score: float
    threshold: float


def probability_of(test: str, false_alarms_per_1000_h: float, seconds: float) -> float:
    """Return the probability of a false alarm of one look of a test, with so many seconds between looks.

    Raises InputError where no threshold is known for it.
    """
    probability = _SHARES[test] * false_alarms_per_1000_h / 1000.0 * seconds / 3600.0
    low, high = _PROBABILITIES
    if not low <= probability <= high:
        scale = 1000.0 * 3600.0 / (_SHARES[test] * seconds)
        raise InputError(
            f"false_alarms_per_1000_h must be {low * scale:.2g} to {high * scale:.2g}, got {false_alarms_per_1000_h:g}"
        )
    return probability


def rarity(test: str, score: float, threshold: float) -> float:
    """Return how much rarer than at the stated rate a healthy machine shows such a score, as a share <= 1.

    By the tail of the test: normal for a level, else exp(-(score - threshold) / `tails.RARER`), which overstates.
    """
    from scipy.special import log_ndtr

    normal = test == "level"
    exponent = float(log_ndtr(-score) - log_ndtr(-threshold)) if normal else (threshold - score) / RARER
    return min(1.0, max(_RAREST, math.exp(max(exponent, math.log(_RAREST)))))


@cache
def _contrasts(n: int) -> Array:
    """Return steps of a series of n values beyond a + b t, as unit vectors (k, n)."""
    steps = (np.arange(n)[None, :] >= np.arange(3, n - 2)[:, None]).astype(float)
    basis, _ = np.linalg.qr(np.stack([np.ones(n), np.arange(n)], axis=1))
    steps -= (steps @ basis) @ basis.T
    return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))


def _median(values: Array) -> float:
    """Return the median of a few values, in a third of the time of NumPy's."""
    ordered, half = np.sort(values), values.size // 2
    if math.isnan(ordered[-1]):  # which comes last
        return math.nan
    return float(ordered[half]) if values.size % 2 else 0.5 * float(ordered[half - 1] + ordered[half])


def worth_a_search(g: Array) -> bool:
    """Return whether any step in a series (n,) is so large that a search for a rise could end in an alarm.

    It must stand out from a straight line and noise, and beside its neighbours from noise and a random walk. The scale
    of the noise is that of the second differences, that of the walk of differences over `_LAG` blocks, by their
    medians, which one step does not move. Means of m values on either side differ by 2 s^2/m + 2 q m/3 (variance).
    """
    noise = _median(np.abs(np.diff(g, 2))) / (0.6745 * math.sqrt(6.0))
    if not np.max(_contrasts(g.size) @ g) > _WORTH_A_SEARCH * noise:
        return False
    if g.size < _FEW:
        return True
    moved = _median(np.abs(g[_LAG:] - g[:-_LAG])) / 0.6745
    walk = max(0.0, moved**2 - 2.0 * noise**2) / _LAG
    sums = np.concatenate([[0.0], np.cumsum(g)])
    for m in _NEIGHBOURS:
        if 2 * m > g.size:
            break
        rise = float(np.max(sums[2 * m :] - 2.0 * sums[m:-m] + sums[: -2 * m])) / m
        if rise > _BESIDE_NEIGHBOURS * np.sqrt(2.0 * noise**2 / m + 2.0 * walk * m / 3.0):
            return True
    return False


def near_an_alarm(t: Array, g: Array, probability: float) -> bool:
    """Return whether a search of blocks, middles `t` (n,) and conductances `g` (n,), could come near an alarm.

    Where blocks are missing that is not known without the search.
    """
    steps = np.diff(t)
    if np.ptp(steps) > _EVEN * float(np.median(steps)):
        return True
    ends = max(3, g.size // 10)
    noise = float(np.median(np.abs(np.diff(g, 2)))) / (0.6745 * math.sqrt(6.0 * ends))
    if float(g[-ends:].mean()) > _GROWN * max(float(g[:ends].mean()), 0.0) + _SURELY_GROWN * noise:
        return True
    return share_of_threshold(g, probability) > _NEAR_THE_THRESHOLD


def step_of(
    blocks: BalanceBlocks, g: Array, probability: float, geometry: Geometry, *, again: bool = False
) -> tuple[ConductanceRise | None, str | None]:
    """Return the rise that the last blocks show, and what else was seen that forbids to compare them, in a few words.

    `g` (n,): their conductances; `again`: an alarm stands, and is to be stated anew. The words are one of few, without
    figures: blocks are counted by them.
    """
    if len(blocks) < FEWEST:
        return None, None
    if not (again or (worth_a_search(g) and near_an_alarm(blocks.t, g, probability))):
        return None, None
    fit = fit_balance(blocks, metres=True, geometry=geometry)
    if trouble(fit) is not None:
        return None, "no balance can be fitted"
    evidence = judge(fit, probability, window=True)
    if not evidence.alarmed or evidence.onset_s is None:
        return None, None
    if evidence.cause not in _CAUSES:
        return None, evidence.cause or "another cause"
    if (duty := other_duty(blocks.t, duty_of(blocks), evidence.onset_s)) is not None:
        return None, duty
    return _rise(evidence, blocks, g), None


def _rise(evidence: Evidence, blocks: BalanceBlocks, g: Array) -> ConductanceRise:
    onset = evidence.onset_s or 0.0
    before, after = g[blocks.t < onset - 0.5 * blocks.seconds], g[blocks.t > onset + 0.5 * blocks.seconds]
    before, after = before[-GROUP:], after[:GROUP]
    if min(before.size, after.size) == 0:
        before, after = g[:1], g[-1:]
    scatter = float(np.median(np.abs(np.diff(g)))) / (0.6745 * np.sqrt(2.0))
    size = float(after.mean() - before.mean())
    deviation = scatter * math.sqrt(1.0 / before.size + 1.0 / after.size)
    if evidence.leak_lpm and evidence.leak_interval_lpm is not None:  # which knows how the conductance drifts
        low, high = evidence.leak_interval_lpm
        deviation = max(deviation, abs(size) * (high - low) / (2.0 * 1.96 * evidence.leak_lpm))
    return ConductanceRise(
        "step",
        onset,
        evidence.onset_interval_s or (onset, onset),
        size,
        deviation,
        evidence.cause or "",
        evidence.reason + (_HALF_SHOWN if evidence.cause == "external leak" else ""),
        float(evidence.score or 0.0),
        float(evidence.threshold or 0.0),
    )


def other_duty(t: Array, duty: Array, onset: float, *, damped: bool = False) -> str | None:
    """Return that the duty (n, 2) of blocks with the middles `t` (n,) changed with the rise, or None.

    `damped`: the first of it is a pressure difference that rings, which a leak lowers.
    """
    after = t >= onset
    if min(after.sum(), (~after).sum()) < 3:
        return None
    moved = np.median(duty[after], axis=0) - np.median(duty[~after], axis=0)
    fall = np.array([_DAMPED if damped else _OTHER_DUTY, _OTHER_DUTY])
    return "changed duty" if np.any((moved > _OTHER_DUTY) | (moved < -fall)) else None


def rise_of(
    test: str, t: Array, g: Array, sd: Array, probability: float, *, again: bool = False
) -> ConductanceRise | None:
    """Return the rise that blocks show, or means of them: middles `t` (n,), conductances `g` and deviations `sd` (n,).

    `again`: an alarm stands, and is to be stated anew.
    """
    if g.size < FEWEST or not (again or (worth_a_search(g) and near_an_alarm(t, g, probability))):
        return None
    step = find_step(t, g, sd, probability)
    if not step.alarm:
        return None
    reason = (
        f"the leakage conductance rises at {step.onset:.0f} s beyond its smooth drift over {t[-1] - t[0]:.0f} s "
        f"(score {step.score:.1f}, threshold {step.threshold:.1f})"
    )
    return ConductanceRise(
        test,
        step.onset,
        step.onset_interval,
        step.size,
        step.size_sd,
        "piston or pump leak",
        reason,
        step.score,
        step.threshold,
    )


def level_rise_of(
    at: float, g: float, sd: float, baseline: WatchBaseline, probability: float
) -> ConductanceRise | None:
    """Return the rise where a mean conductance is over `WARMEST` times the baseline's least."""
    from scipy.special import ndtri

    ceiling = WARMEST * max(baseline.low, 0.0)
    score, threshold = (g - ceiling) / sd, -float(ndtri(probability))
    if score <= threshold:
        return None
    reason = (
        f"the leakage conductance is {g:.3g} m^3/(s Pa), over {WARMEST:g} times the least of the baseline: more than "
        f"oil that warms by 30 K makes of it (score {score:.1f}, threshold {threshold:.1f})"
    )
    size = g - max(baseline.level, 0.0)
    # what is healthy may be anywhere from the least of the baseline to the ceiling
    healthy = baseline.level - baseline.low, ceiling - baseline.level
    size_sd = math.hypot(sd, max(*healthy, 0.0) / 1.96)
    return ConductanceRise(
        "level", at, (baseline.learned_s, at), size, size_sd, "piston or pump leak", reason, score, threshold
    )
