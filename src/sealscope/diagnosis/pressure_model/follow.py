"""From a record to its followed parameters: window, first fit, blocks, and the steps of G."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.baseline.level import Level
from sealscope.diagnosis.pressure_model.fit import (
    LONG_WINDOW,
    SETTLE,
    SHORT_WINDOW,
    USUAL_G,
    Window,
    first_guess,
    fit,
    prior_of,
    refit,
)
from sealscope.diagnosis.pressure_model.model import (
    F_C,
    F_V,
    GAIN,
    STATES,
    DrivenModel,
    G,
    K,
    assumed_numbers,
    nominal,
)
from sealscope.diagnosis.pressure_model.track import ConductanceSteps, Track, excess_of, leap, steps_in, track
from sealscope.parameters import Rig
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

#: Blocks are whole cycles of at least so long [s]; what comes before is left out: the start from rest.
BLOCK, FIRST = 6.0, 3.0
#: The window begins at this share of the record: what a start leaves behind has decayed there.
_WINDOW_AT = 0.55
_INTEGRAL = 4
_EARLY = 4
#: A rise of G worth another look.
_CLEAR = 2.0
#: A record that the model follows so badly is tried again from other first fits.
RESTLESS = 1.15
#: ... of which one is as good whose cost is higher by no more than this share.
_AS_GOOD = 1e-3


@dataclass(frozen=True, eq=False)
class Followed:
    """A record as the model sees it.

    `theta` (12,): first fit; `path` (b, 12); `steps` of G; `edges` (b + 1,) [samples]
    from the first sample; `seconds` of a block; `explained`: share of dp's variance; `level` [m^3/(s Pa)]: mean
    G; `friction_change`, `stiffness_change`: from the first to the last third, as shares; `share` of the blocks that
    have no missing samples and count.
    """

    theta: Array
    path: Array
    steps: ConductanceSteps
    edges: NDArray[np.int64]
    seconds: float
    explained: float
    misfit: float
    level: Level
    friction_change: float
    stiffness_change: float
    command_rms: float
    share: float

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.edges.size - 1


def noise_variance(dp: Array) -> float:
    """Return the variance [Pa^2] of white noise on dp, from its third differences, which hardly hold the ringing."""
    return float(np.var(np.diff(dp, 3)) / 20.0)


def _windows(model: DrivenModel, dp: Array, theta: Array, cycle: float) -> tuple[Window, Window]:
    """Return the long window of the fit and its beginning, the short one."""
    n = dp.size
    long, short = (
        min(n, int(np.clip(cycles * cycle, least, most) * model.rate))
        for cycles, least, most in (LONG_WINDOW, SHORT_WINDOW)
    )
    first = max(0, min(int(_WINDOW_AT * n), n - long))
    state = np.zeros((1, STATES))
    if first > 0:
        model.part(0, first).run(theta[None], start=state)
    integral = float(state[0, _INTEGRAL] / theta[GAIN])
    settle, noise = int(SETTLE * model.rate), noise_variance(dp)

    def window(length: int) -> Window:
        here = dp[first + settle : first + length]
        return Window(model.part(first, length), here, settle, integral, noise)

    return window(long), window(min(short, long))


def follow(rig: Rig, recording: Recording, cycle: float | None) -> Followed | None:
    """Fit and follow the chamber pressures and the command of a record; None where no fit is finite.

    `cycle` [s]: length of the duty's cycle, None where it does not repeat.
    """
    u, p_A, p_B, rate = recording["u"], recording["p_A"], recording["p_B"], recording.rate
    dp = p_A - p_B
    dp = dp * (1.0 if _same_sense(u, dp) else -1.0)
    centre = nominal(rig)
    centre[G] = max(centre[G], USUAL_G)
    model = DrivenModel.of(u, rate, assumed_numbers(rig), p_A + p_B)
    span = BLOCK if cycle is None else cycle
    _, short = _windows(model, dp, centre, span)
    prior = prior_of(centre)
    guess = first_guess(short, prior)
    model = model.with_travel(guess)
    long, short = _windows(model, dp, guess, span)
    theta, cost, anew = fit(long, short, prior, guess)
    if not np.isfinite(cost):
        return None
    length = max(1, int(np.ceil(BLOCK / span - 1e-9))) * span
    edges = np.round(np.arange(FIRST, dp.size / rate, length) * rate).astype(np.int64)
    if edges.size < 4:
        return None
    seen = ~touched(recording, edges)
    share = float(np.mean(seen))
    if np.count_nonzero(seen) < 3:
        return None
    first, last = np.flatnonzero(seen)[[0, -1]]
    edges, seen = edges[first : last + 2], seen[first : last + 1]
    speed = float(np.sqrt(2.0) * theta[GAIN] * np.std(u))
    skip = int(FIRST * rate)
    followed, steps = _tracked(model, dp, edges, theta, skip, speed, seen)
    if excess_of(steps) > RESTLESS:
        for first in anew:
            other, dearer = refit(long, first, prior)
            if dearer > cost * (1.0 + _AS_GOOD):
                continue
            again = _tracked(model, dp, edges, other, skip, speed, seen)
            if excess_of(again[1]) < excess_of(steps) - 0.05:
                theta, (followed, steps) = other, again
    third = max(1, len(followed.path) // 3)
    early, late = followed.path[:third].mean(axis=0), followed.path[-third:].mean(axis=0)
    friction = _friction(late, model, speed) / _friction(early, model, speed) - 1.0
    return Followed(
        theta,
        followed.path,
        steps,
        edges,
        length,
        1.0 - followed.variance / float(np.var(dp)),
        followed.variance / long.variance,
        Level(float(steps.level.mean()), float(steps.level_deviation.mean())),
        friction,
        float(late[K] / early[K] - 1.0),
        float(np.std(u)),
        share,
    )


def _same_sense(u: Array, dp: Array) -> bool:
    """Return whether dp follows the command, as it does where both count in the same sense."""
    return float(np.dot(u - u.mean(), dp - dp.mean())) >= 0.0


def _tracked(
    model: DrivenModel,
    dp: Array,
    edges: NDArray[np.int64],
    theta: Array,
    skip: int,
    speed: float,
    seen: NDArray[np.bool_],
) -> tuple[Track, ConductanceSteps]:
    """Follow the record from a first fit, and estimate the steps of G in it.

    Where G seems to rise the blocks are linearised once more with that rise allowed: under the usual leash a leak pulls
    friction and gain off their values, which makes it smaller than it is. Sizes are taken from there; z, which a second
    look at what was chosen for being large would raise, is not.
    """
    followed, start = min(
        ((track(model, dp, edges, theta, start, skip, seen=seen), start) for start in _starts(model, theta)),
        key=lambda both: float(both[0].block_variance[:_EARLY].mean()),
    )
    steps = steps_in(followed, theta, speed)
    after = int(np.argmax(steps.z))
    if steps.z[after] < _CLEAR:
        return followed, steps
    jumps = leap(edges.size - 1, after, G)
    fresh = steps_in(track(model, dp, edges, theta, start, skip, jumps, followed.path, seen=seen), theta, speed)
    if excess_of(fresh) < max(1.0, excess_of(steps)) + 0.05:
        steps = replace(steps, size=fresh.size, deviation=fresh.deviation)
    return followed, steps


def _friction(theta: Array, model: DrivenModel, speed: float) -> float:
    """Return the friction [N] in mid-stroke."""
    return float(theta[F_C] + theta[F_V] * model.piston_speed(speed))


def _starts(model: DrivenModel, theta: Array) -> list[Array]:
    """Return the states (5,) that the record may begin with: at rest, or in motion where the command is not at zero."""
    rest = np.zeros(STATES)
    u, slope = (model.inputs[: -1 : 2 * model.every, column] for column in (0, 1))
    if abs(u[0]) <= 0.02 * float(np.max(np.abs(model.u))) and abs(slope[0]) > 0.0:
        return [rest]
    n = model.samples
    apart = np.abs(u - u[0]) / np.std(u) + np.abs(slope - slope[0]) / np.std(slope)
    same = n // 2 + int(np.argmin(apart[n // 2 :]))
    state = np.zeros((1, STATES))
    model.part(0, same).run(theta[None], start=state)
    return [rest, state[0]]
