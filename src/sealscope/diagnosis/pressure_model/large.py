"""A leak so large that a model which is linear about a sound machine does not reach it.

A machine is fitted to the beginning of its record, which is taken to be sound. With its parameters the model runs
through the whole record under leaks of all sizes up to more than the pump's flow, by either law; where the record
follows the sound machine up to one block, and a leaking one after it, the blocks are followed once more about that
leak. Whether it is a leak is asked of what comes after: a machine that is fitted anew there, everything but a leak free
within the prior, must explain it worse than the sound one of before with a leak. A change of friction, stiffness or
command is such another machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.pressure_model.fit import (
    LONG_WINDOW,
    SHORT_WINDOW,
    Prior,
    first_guess,
    fit,
    minimise,
    noise_variance,
    prior_of,
    refit,
    window_at,
)
from sealscope.diagnosis.pressure_model.model import GAIN, ORIFICE, SOUND, STATES, DrivenModel, G, K
from sealscope.diagnosis.pressure_model.track import (
    ConductanceSteps,
    PossibleLeak,
    Track,
    excess_of,
    steps_in,
    track,
    wandering,
)
from sealscope.recordings.recording import Array

#: Blocks at the beginning that are taken to be sound, and the fewest after the leak.
_SOUND_BLOCKS = 3
#: Leaks that are tried, as shares of the pump's flow at the rms pressure difference.
_SHARES = np.concatenate([[0.0], np.geomspace(0.01, 3.0, 15)])
#: ... and once the sound machine is known better, as shares of the size that was best.
_NEAR = np.concatenate([[0.0], np.geomspace(0.6, 1.6, 15)])
#: A squared misfit that stands for a model which diverges [Pa^2].
_DIVERGED = 1e24
#: The misfit must fall by this share, and by so many variances of the noise, for a second look.
_FALL, _FALL_COST = 0.03, 200.0
#: Within a record the drive's gain and the oil's stiffness may change by these shares (standard deviation). Without
#: limits nothing tells a laminar leak from a slower drive on stiffer oil: to dp, either is a shorter stroke.
_GAIN_CHANGE, _STIFFNESS_CHANGE = 0.03, 0.15
#: Least difference of cost to another machine, and the largest excess: a model that is off by some per cent misses more
#: of a larger leak than of what wanders in a sound machine.
_BETTER, _LARGEST_EXCESS = 16.0, 2.5
#: Least z: a leak that linear blocks do not reach is at least as clear as those that they do.
_CLEAR = 10.0
#: The onset is anywhere where the cost is within this of the least, and that much [s] before and after.
_LIKELY, _TRANSIENT = 20.0, 0.5


@dataclass(frozen=True, eq=False)
class LargeLeak:
    """A record with a leak, about which its blocks are linear.

    `theta` (13,): the sound machine; `track`; `steps` beside the leak; `leaks` by either law, the likelier first;
    `z` of the leak; `better`: cost of another machine less that of the leak; `onset`, its `limits` [samples];
    `excess`: chi square a degree of freedom of what scatters beside the leak.
    """

    theta: Array
    track: Track
    steps: ConductanceSteps
    leaks: tuple[PossibleLeak, ...]
    z: float
    better: float
    onset: int
    limits: tuple[int, int]
    excess: float


def large_leak(
    model: DrivenModel, dp: Array, edges: NDArray[np.int64], seen: NDArray[np.bool_], prior: Prior
) -> LargeLeak | None:
    """Return the leak that begins within a record and explains it better than another machine does, or None.

    dp (n,) [Pa]; blocks between `edges` (b + 1,) [samples], of which those `seen` (b,) count; `prior` of the machine.
    """
    blocks = seen.size
    if blocks < 2 * _SOUND_BLOCKS + 1 or not np.all(seen[:_SOUND_BLOCKS]):
        return None
    window = window_at(model, dp, prior.centre, 0, int(edges[_SOUND_BLOCKS]))
    guess = first_guess(window, prior)
    model = model.with_travel(guess)
    window = window_at(model, dp, guess, 0, int(edges[_SOUND_BLOCKS]))
    theta, *_ = fit(window, window, prior, guess)
    tried = _ladder(
        model, dp, edges, theta, seen, {law: _SHARES * flow for law, flow in _flows(model, dp, theta).items()}
    )
    if tried is None:
        return None
    block, best = tried
    theta = _refitted(model, dp, int(edges[max(block - 1, _SOUND_BLOCKS)]), theta, prior)
    tried = _ladder(model, dp, edges, theta, seen, {law: _NEAR * size for law, size in best.items()})
    if tried is None:
        return None
    block, best = tried
    start = np.zeros(STATES)
    counted = seen & (np.arange(blocks) != block)
    skip = int(edges[0])
    path = np.tile(theta, (blocks, 1))
    followed = {
        law: track(model, dp, edges, theta, start, skip, (law, block - 1), path, seen=counted, size=size)
        for law, size in best.items()
    }
    variance = min(each.variance for each in followed.values())
    speed = model.speed_amplitude(theta)
    leaks = []
    for law, each in followed.items():
        steps = steps_in(each, theta, speed, rising=law)
        cost = each.misfit / variance + each.strain
        size, deviation = float(steps.size[block - 1]), float(steps.deviation[block - 1])
        leaks.append(PossibleLeak(law, block - 1, size, deviation, cost))
    leaks.sort(key=lambda leak: leak.cost)
    likely = leaks[0]
    there = followed[likely.rising]
    steps = steps_in(there, theta, speed, rising=likely.rising, beside=likely)
    better, z = _explained(model, dp, int(edges[block + 1]), theta, likely)
    excess = excess_of(steps)
    if not (better > _BETTER and z > _CLEAR and excess <= _LARGEST_EXCESS):
        return None
    onset, limits = _onset(model, dp, edges, there, likely)
    return LargeLeak(theta, there, steps, tuple(leaks), z, better, onset, limits, excess)


def _ladder(
    model: DrivenModel,
    dp: Array,
    edges: NDArray[np.int64],
    theta: Array,
    seen: NDArray[np.bool_],
    tried: Mapping[int, Array],
) -> tuple[int, dict[int, float]] | None:
    """Return the block in which a leak begins, and its size by either law; None where no leak explains the record.

    `tried`: sizes of each law, the first of them 0.
    """
    best: dict[int, tuple[float, int, float]] = {}
    sound = np.inf
    for law, sizes in tried.items():
        sets = np.tile(theta, (sizes.size, 1))
        sets[:, law] += sizes
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.nan_to_num((dp - model.run(sets)) ** 2, nan=_DIVERGED)
        squares = np.minimum(squares, _DIVERGED)
        misfit = np.add.reduceat(squares, edges[:-1], axis=1)
        misfit[:, -1] -= squares[:, edges[-1] :].sum(axis=1)
        misfit = misfit * seen
        sound = float(misfit[0].sum())
        for block in range(_SOUND_BLOCKS, seen.size - _SOUND_BLOCKS):
            rest = misfit[0, :block].sum() + misfit[:, block].min() + misfit[:, block + 1 :].sum(axis=1)
            at = int(np.argmin(rest))
            if law not in best or rest[at] < best[law][0]:
                best[law] = float(rest[at]), block, float(sizes[at])
    least, block, chosen = min(best.values())
    if chosen == 0.0 or not sound - least > max(_FALL * sound, _FALL_COST * noise_variance(dp)):
        return None
    return block, {law: each[2] for law, each in best.items()}


def _flows(model: DrivenModel, dp: Array, theta: Array) -> dict[int, float]:
    """Return the leak of either law that passes the pump's rms flow at the rms pressure difference."""
    flow = float(model.piston_speed(model.speed_amplitude(theta))) * model.numbers.A_A / np.sqrt(2.0)
    drop = float(np.sqrt(np.mean(dp**2)))
    return {G: flow / drop, ORIFICE: flow / np.sqrt(drop)}


def _refitted(model: DrivenModel, dp: Array, until: int, theta: Array, prior: Prior) -> Array:
    """Return the machine that is fitted to all that is sound, as far as the longest window reaches."""
    length = min(until, int(LONG_WINDOW[-1] * model.rate))
    return refit(window_at(model, dp, theta, until - length, length), theta, prior)[0]


def _explained(model: DrivenModel, dp: Array, since: int, theta: Array, leak: PossibleLeak) -> tuple[float, float]:
    """Return by how much a leak explains what comes after better than another machine does, and z of the leak.

    The first is a difference of cost, minus twice the log likelihood. The other machine does not leak; its parameters
    are free within a prior about those of the machine before. z is the root of the difference to the sound machine,
    whose parameters may wander as those of the leaking one.
    """
    rest = dp.size - since
    length, short = (min(rest, int(seconds * model.rate)) for seconds in (LONG_WINDOW[-1], SHORT_WINDOW[-1]))
    window = window_at(model, dp, theta, since, length)
    deviation = np.append(wandering(theta, model.samples / model.rate, model.speed_amplitude(theta)), 0.0)
    another = prior_of(theta)
    another.deviation[[GAIN, K, G]] = _GAIN_CHANGE * theta[GAIN], _STIFFNESS_CHANGE * theta[K], deviation[G]
    _, other, _ = fit(window, window_at(model, dp, theta, since, short), another, theta)
    _, sound = minimise(window, theta[None], Prior(theta, deviation), range(SOUND), 10, 1.0)
    leaking, apart = theta.copy(), deviation.copy()
    leaking[leak.rising] += leak.size
    apart[leak.rising] = max(leak.size, deviation[leak.rising])
    free = [*range(SOUND), *([ORIFICE] if leak.rising == ORIFICE else [])]
    _, costs = minimise(window, leaking[None], Prior(leaking, apart), free, 10, 1.0)
    return float(other * window.dp.size - costs[0]), float(np.sqrt(max(0.0, sound[0] - costs[0])))


def _onset(
    model: DrivenModel, dp: Array, edges: NDArray[np.int64], followed: Track, leak: PossibleLeak
) -> tuple[int, tuple[int, int]]:
    """Return the sample from which the leaking machine explains dp better than the sound one, and its limits."""
    blocks = edges.size - 1
    segment = np.clip(np.searchsorted(edges, np.arange(dp.size), side="right") - 1, 0, blocks - 1).astype(np.int64)
    sound = followed.path.copy()
    sound[leak.after + 1 :, leak.rising] -= leak.size
    leaking = sound.copy()
    leaking[leak.after :, leak.rising] += leak.size
    first, last = int(edges[leak.after]), int(edges[min(leak.after + 3, blocks)])
    apart = (dp - model.run(np.array([sound, leaking]), segment)) ** 2
    apart = apart[:, first:last]
    costs = np.append(0.0, np.cumsum(apart[0] - apart[1])) / followed.variance
    best = int(np.argmin(costs))
    likely = np.flatnonzero(costs <= costs[best] + _LIKELY)
    margin = int(_TRANSIENT * model.rate)
    return first + best, (max(first + int(likely[0]) - margin, 0), min(first + int(likely[-1]) + margin, dp.size - 1))
