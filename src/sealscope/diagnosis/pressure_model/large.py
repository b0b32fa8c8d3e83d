"""A leak so large that a model which is linear about a sound machine does not reach it.

A machine is fitted to the beginning of its record, which is taken to be sound. With its parameters the model runs
through the whole record under leaks of all sizes up to more than the pump's flow, by either law; where the record
follows the sound machine up to one block, and a leaking one after it, the blocks are followed once more about that
leak. Whether it is a leak is asked of what comes after: a machine that is fitted anew there, everything but a leak free
within the prior, must explain it worse than the sound one of before with a leak. A change of friction, stiffness or
command is such another machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.pressure_model.fit import (
    LONG_WINDOW,
    SHORT_WINDOW,
    Prior,
    Window,
    first_guess,
    fit,
    minimise,
    noise_variance,
    prior_of,
    refit,
    window_at,
)
from sealscope.diagnosis.pressure_model.model import GAIN, ORIFICE, SOUND, STATES, DrivenModel, G, K
from sealscope.diagnosis.pressure_model.tracking.blocks import Blocks
from sealscope.diagnosis.pressure_model.tracking.laws import HOLE, WORN_SEAL, Law
from sealscope.diagnosis.pressure_model.tracking.noise import steps_beside_noise
from sealscope.diagnosis.pressure_model.tracking.steps import ConductanceSteps, PossibleLeak, excess_of
from sealscope.diagnosis.pressure_model.tracking.track import Track, track
from sealscope.diagnosis.pressure_model.tracking.wander import wandering
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
#: Another machine's gain of the drive and stiffness of the oil, as shares of those before (standard deviation). The
#: pressures hardly tell a laminar leak from a slower drive on stiffer oil: of either the strokes become shorter.
_GAIN_CHANGE, _STIFFNESS_CHANGE = 0.15, 0.1
#: ... of which the gain is at least this share of that before: no drive loses more from one instant to the next.
_LEAST_GAIN = 0.5
#: Stiffnesses at which such a fit begins where the gain is held there, as shares of that before.
_STIFFNESSES = (0.7, 0.85, 1.0, 1.2, 1.4)
#: Difference of cost to another machine from which the leak is the better explanation, and from which the other is.
BETTER, WORSE = 8.0, -100.0
#: The largest excess at which a leak is sized (a model that is off by some per cent misses more of a large leak than of
#: what wanders), and the largest cost of a sample, over that before the leak. Beyond, the model is of another kind of
#: machine: there a leak must be better by this share of what it explains, and explain this share of what the sound
#: machine misses: 0.19 and more of leaks of 0.05 and 0.5 L/min, 0.065 at most where friction sticks and none is large.
_LARGEST_EXCESS, _AS_BEFORE, _PLAIN, _MUCH = 4.0, 1.25, 0.1, 0.12
#: Least z, also over the root of the excess: a leak that linear blocks do not reach is at least as clear as those that
#: they do.
_CLEAR, _CLEAR_OF_SCATTER = 10.0, 5.0
#: The onset is anywhere where the cost is within this of the least, and that much [s] before and after.
_LIKELY, _TRANSIENT = 20.0, 0.5


@dataclass(frozen=True, eq=False)
class LargeLeak:
    """A record with a leak, about which its blocks are linear.

    `theta` (14,): the sound machine; `track`; `steps` beside the leak; `leaks` by either law and by both, the likelier
    first; `z` of the leak; `better`: cost of another machine less that of the leak; `onset`, its `limits` [samples];
    `excess`: chi square a degree of freedom of what scatters beside the leak; `sized`: whether the model follows the
    machine so well that the sizes of the leaks mean something; `explained`: as `better`, to another machine with any
    drive; `share` of the sound machine's cost that the leak explains.
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
    sized: bool
    explained: float
    share: float

    @property
    def stated(self) -> bool:
        """Whether a leak is the better explanation: by little, or of much and by much of it where it is not sized."""
        return self.better > BETTER if self.sized else self.better > _PLAIN * self.z**2 and self.share > _MUCH


def large_leak(blocks: Blocks, prior: Prior) -> LargeLeak | None:
    """Return the leak that begins within a record, None where none explains it; `prior` of the machine.

    Whether it, or another machine, explains the record better is for the caller to ask (`LargeLeak.better`).
    """
    model, dp, edges, seen = blocks.model, blocks.dp, blocks.edges, blocks.seen
    if blocks.count < 2 * _SOUND_BLOCKS + 1 or not np.all(seen[:_SOUND_BLOCKS]):
        return None
    window = window_at(model, dp, prior.centre, 0, int(edges[_SOUND_BLOCKS]))
    guess = first_guess(window, prior)
    model = model.with_travel(guess)
    blocks = replace(blocks, model=model)
    window = window_at(model, dp, guess, 0, int(edges[_SOUND_BLOCKS]))
    theta, _, anew = fit(window, window, prior, guess)
    tried = _ladder(blocks, theta, {law: _SHARES * flow for law, flow in _flows(model, dp, theta).items()})
    if tried is None:
        return None
    block, best = tried
    # of the few blocks at the beginning, which may ring alike with another oil, other minima are begun at, too
    refits = [_refitted(model, dp, int(edges[max(block - 1, _SOUND_BLOCKS)]), each, prior) for each in (theta, *anew)]
    theta, usual = min(refits, key=lambda each: each[1])
    tried = _ladder(blocks, theta, {law: _NEAR * size for law, size in best.items()})
    if tried is None:
        return None
    block, best = tried
    after = _After.of(model, dp, int(edges[block + 1]), theta)
    mixture = Law(1.0, best[HOLE] / best[WORN_SEAL]) if min(best.values()) > 0.0 else None
    fitted = [after.leaking(law, size) for law, size in best.items()]
    if mixture is not None:
        fitted.append(after.leaking(mixture, 0.5 * best[WORN_SEAL], [each.theta for each in fitted]))
    fitted = [each for each in fitted if each.size > 0.0]
    but_that = replace(blocks, seen=seen & (np.arange(blocks.count) != block))
    followed = []
    for leaking in fitted:
        path = np.tile(theta, (blocks.count, 1))
        path[block:] = leaking.sound
        rise, start = (leaking.law, block - 1), np.zeros(STATES)
        # of a leak that is none of this machine the model may diverge, or its blocks tell nothing
        with suppress(FloatingPointError, np.linalg.LinAlgError):
            there = track(but_that, theta, start, rise, path, size=leaking.size)
            followed.append((leaking, there, steps_beside_noise(but_that, theta, there, leaking.law)))
    if not followed:
        return None
    variance = min(each.variance for _, each, _ in followed)
    looks = []
    for leaking, each, steps in followed:
        cost = each.misfit / variance + each.strain
        size, deviation = float(steps.size[block - 1]), float(steps.deviation[block - 1])
        looks.append((PossibleLeak(leaking.law, block - 1, size, deviation, cost), each, leaking.cost))
    looks.sort(key=lambda look: look[0].cost)
    likely, there, cost = looks[0]
    steps = steps_beside_noise(but_that, theta, there, likely.law, likely)
    excess = excess_of(steps)
    sound = after.sound()
    z = float(np.sqrt(max(0.0, sound - cost)))
    if not z > max(_CLEAR, _CLEAR_OF_SCATTER * float(np.sqrt(max(1.0, excess)))):
        return None
    another, any_drive = after.another()
    better = another - cost
    onset, limits = _onset(blocks, there, likely)
    sized = excess <= _LARGEST_EXCESS and cost <= _AS_BEFORE * usual * after.window.dp.size
    if not sized:  # what the model misses moves the onset, too: it is in these blocks
        limits = min(limits[0], int(edges[block - 1])), max(limits[1], int(edges[min(block + 2, blocks.count)]))
    return LargeLeak(
        theta,
        there,
        steps,
        tuple(leak for leak, *_ in looks),
        z,
        better,
        onset,
        limits,
        excess,
        sized,
        any_drive - cost,
        z**2 / sound,
    )


def _ladder(blocks: Blocks, theta: Array, tried: Mapping[Law, Array]) -> tuple[int, dict[Law, float]] | None:
    """Return the block in which a leak begins, and its size by either law; None where no leak explains the record.

    `tried`: sizes of each law, the first of them 0.
    """
    best: dict[Law, tuple[float, int, float]] = {}
    sound = np.inf
    for law, sizes in tried.items():
        sets = np.tile(theta, (sizes.size, 1))
        for k, share in law.parts:
            sets[:, k] += share * sizes
        squares = _squares(blocks.dp - blocks.model.run(sets))
        misfit = np.add.reduceat(squares[:, : blocks.edges[-1]], blocks.edges[:-1], axis=1) * blocks.seen
        sound = float(misfit[0].sum())
        for block in range(_SOUND_BLOCKS, blocks.count - _SOUND_BLOCKS):
            rest = misfit[0, :block].sum() + misfit[:, block].min() + misfit[:, block + 1 :].sum(axis=1)
            at = int(np.argmin(rest))
            if law not in best or rest[at] < best[law][0]:
                best[law] = float(rest[at]), block, float(sizes[at])
    least, block, chosen = min(best.values())
    if chosen == 0.0 or not sound - least > max(_FALL * sound, _FALL_COST * noise_variance(blocks.dp)):
        return None
    return block, {law: each[2] for law, each in best.items()}


def _squares(apart: Array) -> Array:
    """Return the squares of what is left of dp, those of a model that diverges large and finite."""
    return np.asarray(np.minimum(np.nan_to_num(apart**2, nan=_DIVERGED), _DIVERGED))


def _flows(model: DrivenModel, dp: Array, theta: Array) -> dict[Law, float]:
    """Return the leak of either law that passes the pump's rms flow at the rms pressure difference."""
    flow = float(model.piston_speed(model.speed_amplitude(theta))) * model.numbers.A_A / np.sqrt(2.0)
    drop = float(np.sqrt(np.mean(dp**2)))
    return {WORN_SEAL: flow / drop, HOLE: flow / np.sqrt(drop)}


def _refitted(model: DrivenModel, dp: Array, until: int, theta: Array, prior: Prior) -> tuple[Array, float]:
    """Return the machine that is fitted to all that is sound, as far as the longest window reaches, and its cost.

    The cost is that of a sample.
    """
    length = min(until, int(LONG_WINDOW[-1] * model.rate))
    return refit(window_at(model, dp, theta, until - length, length), theta, prior)


class _Leaking(NamedTuple):
    """A leak fitted to what comes after: its size, 0 where it fits with none.

    `theta` (14,): the machine with it, `sound` (14,): without; `cost` of the fit.
    """

    law: Law
    size: float
    sound: Array
    theta: Array
    cost: float


@dataclass(frozen=True, eq=False)
class _After:
    """What comes after a leak: a window of it and a shorter one, the machine `theta` (14,) from before, its `wander`.

    Costs are minus twice the log likelihood.
    """

    window: Window
    short: Window
    theta: Array
    wander: Array

    @staticmethod
    def of(model: DrivenModel, dp: Array, since: int, theta: Array) -> _After:
        rest = dp.size - since
        window, short = (
            window_at(model, dp, theta, since, min(rest, int(seconds * model.rate)))
            for seconds in (LONG_WINDOW[-1], SHORT_WINDOW[-1])
        )
        wander = wandering(theta, model.samples / model.rate, model.speed_amplitude(theta))
        return _After(window, short, theta, np.append(wander, 0.0))

    def sound(self) -> float:
        """Return the cost of the machine from before, its parameters free to wander."""
        return float(
            minimise(self.window, self.theta[None], Prior(self.theta, self.wander), range(SOUND), 10, 1.0)[1][0]
        )

    def leaking(self, law: Law, size: float, also: Sequence[Array] = ()) -> _Leaking:
        """Return the machine from before with a leak of about that size, as free to wander.

        A leak of both laws may be more of either. `also`: other machines to begin with.
        """
        start, deviation = self.theta.copy(), self.wander.copy()
        for k, share in law.parts:
            start[k] += share * size
            deviation[k] = max(share * size, deviation[k])
        free = [*range(SOUND), *([ORIFICE] if law.orifice else [])]
        (theta, *_), costs = minimise(self.window, np.array([start, *also]), Prior(start, deviation), free, 20, 1.0)
        risen = theta - self.theta
        sound = theta.copy()
        for k, _ in law.parts:
            sound[k] = self.theta[k]
        size = float(risen[law.parts[0][0]])
        if law.laminar and law.orifice and size > 0.0:
            law = Law(1.0, float(risen[ORIFICE] / size))
            size = size if law.orifice > 0.0 else 0.0
        return _Leaking(law, size, sound, theta, float(costs[0]))

    def another(self) -> tuple[float, float]:
        """Return the cost of another machine, which does not leak: all else is free within a prior about that before.

        The second is its cost with any gain of the drive.

        A machine with another gain is far off, so a fit begins at the gain that suits best, too. To a model that misses
        some of how the machine moves, such as bristles, a leak of half of the pump's flow is best a drive that turns at
        a fifth of its speed: no drive does, so the gain is held at half of that before.
        """
        prior = prior_of(self.theta)
        gain, stiffness = _GAIN_CHANGE * self.theta[GAIN], _STIFFNESS_CHANGE * self.theta[K]
        prior.deviation[[GAIN, K, G]] = gain, stiffness, self.wander[G]
        guesses = self.theta, first_guess(self.short, prior)
        fits = [fit(self.window, self.short, prior, guess)[:2] for guess in guesses]
        least = _LEAST_GAIN * self.theta[GAIN]
        costs = [self.window.dp.size * each for theta, each in fits if theta[GAIN] >= least]
        free = self.window.dp.size * min(cost for _, cost in fits)
        if len(costs) == len(fits):
            return free, free
        starts = np.array([*(theta for theta, _ in fits), *np.tile(self.theta, (len(_STIFFNESSES), 1))])
        starts[len(fits) :, K] *= _STIFFNESSES
        starts[:, GAIN] = np.maximum(starts[:, GAIN], least)
        held = [k for k in range(SOUND) if k != GAIN]
        return float(min(*costs, *minimise(self.window, starts, prior, held, 20, 1.0)[1])), free


def _onset(blocks: Blocks, followed: Track, leak: PossibleLeak) -> tuple[int, tuple[int, int]]:
    """Return the sample from which the leaking machine explains dp better than the sound one, and its limits."""
    sound = followed.path.copy()
    for k, share in leak.law.parts:
        sound[leak.after + 1 :, k] -= share * leak.size
    leaking = sound.copy()
    for k, share in leak.law.parts:
        leaking[leak.after :, k] += share * leak.size
    first, last = int(blocks.edges[leak.after]), int(blocks.edges[min(leak.after + 3, blocks.count)])
    apart = _squares((blocks.dp - blocks.run(np.array([sound, leaking])))[:, first:last])
    costs = np.append(0.0, np.cumsum(apart[0] - apart[1])) / followed.variance
    best = int(np.argmin(costs))
    likely = np.flatnonzero(costs <= costs[best] + _LIKELY)
    margin, end = int(_TRANSIENT * blocks.model.rate), blocks.dp.size - 1
    return first + best, (max(first + int(likely[0]) - margin, 0), min(first + int(likely[-1]) + margin, end))
