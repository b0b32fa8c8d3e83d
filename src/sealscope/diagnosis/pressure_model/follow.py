"""From a record to its followed parameters: noise, window, first fit, blocks, and how G steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.baseline.level import Level
from sealscope.diagnosis.pressure_model.duty import Duty, differences, duty_of, moving
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
from sealscope.diagnosis.pressure_model.laws import F_C, F_V, GAIN, STATES, G, K, Machine, machine_of, nominal
from sealscope.diagnosis.pressure_model.steps import Steps, excess_of, steps_in
from sealscope.diagnosis.pressure_model.track import Track, leap, track
from sealscope.parameters import Rig
from sealscope.recordings.recording import Array

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
    """A record as the model sees it. `theta` (12,): first fit; `path` (b, 12); `steps` of G; `edges` (b + 1,) [samples]
    from the first sample; `seconds` of a block; `explained`: share of dp's variance; `level` [m^3/(s Pa)]: mean
    G; `friction_change`, `stiffness_change`: from the first to the last third, as shares."""

    theta: Array
    path: Array
    steps: Steps
    edges: NDArray[np.int64]
    seconds: float
    explained: float
    misfit: float
    level: Level
    friction_change: float
    stiffness_change: float
    command_rms: float

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.edges.size - 1


def noise_variance(dp: Array) -> float:
    """Variance [Pa^2] of white noise on dp, from its third differences: ringing and strokes hardly reach them."""
    return float(np.var(np.diff(dp, 3)) / 20.0)


def _window(duty: Duty, dp: Array, integral: float, first: int, n: int, settle: int, machine: Machine) -> Window:
    return Window(duty.part(first, n), dp[first + settle : first + n], settle, integral, noise_variance(dp), machine)


def _windows(duty: Duty, dp: Array, theta: Array, machine: Machine, rate: float, cycle: float) -> tuple[Window, Window]:
    """The long window of the fit and its beginning, the short one, with the speed loop's integral at their start."""
    n = dp.size
    long, short = (
        min(n, int(np.clip(cycles * cycle, least, most) * rate)) for cycles, least, most in (LONG_WINDOW, SHORT_WINDOW)
    )
    first = max(0, min(int(_WINDOW_AT * n), n - long))
    state = np.zeros((1, STATES))
    if first > 0:
        differences(duty.part(0, first), theta[None], machine, start=state)
    integral = float(state[0, _INTEGRAL] / theta[GAIN])
    settle = int(SETTLE * rate)
    return (
        _window(duty, dp, integral, first, long, settle, machine),
        _window(duty, dp, integral, first, min(short, long), settle, machine),
    )


def follow(rig: Rig, u: Array, p_A: Array, p_B: Array, rate: float, cycle: float | None) -> Followed | None:
    """Fit and follow a record of uniformly sampled channels (n,); None where no fit is finite.

    `cycle` [s]: length of the duty's cycle, None where it does not repeat.
    """
    machine = machine_of(rig)
    dp = p_A - p_B
    dp = dp * (1.0 if _same_way(u, dp) else -1.0)
    centre = nominal(rig)
    centre[G] = max(centre[G], USUAL_G)
    duty = duty_of(u, rate, p_A + p_B)
    span = BLOCK if cycle is None else cycle
    _, short = _windows(duty, dp, centre, machine, rate, span)
    prior = prior_of(centre)
    guess = first_guess(short, prior)
    duty = moving(duty, guess, machine)
    long, short = _windows(duty, dp, guess, machine, rate, span)
    theta, cost, anew = fit(long, short, prior, guess)
    if not np.isfinite(cost):
        return None
    length = max(1, int(np.ceil(BLOCK / span - 1e-9))) * span
    edges = np.round(np.arange(FIRST, dp.size / rate, length) * rate).astype(np.int64)
    if edges.size < 4:
        return None
    speed = float(np.sqrt(2.0) * theta[GAIN] * np.std(u))
    skip = int(FIRST * rate)
    followed, steps = _tracked(duty, dp, edges, theta, machine, skip, rate, speed)
    if excess_of(steps) > RESTLESS:
        for first in anew:
            other, dearer = refit(long, first, prior)
            if dearer > cost * (1.0 + _AS_GOOD):
                continue
            again = _tracked(duty, dp, edges, other, machine, skip, rate, speed)
            if excess_of(again[1]) < excess_of(steps) - 0.05:
                theta, (followed, steps) = other, again
    third = max(1, len(followed.path) // 3)
    early, late = followed.path[:third].mean(axis=0), followed.path[-third:].mean(axis=0)
    friction = _friction(late, machine, speed) / _friction(early, machine, speed) - 1.0
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
    )


def _same_way(u: Array, dp: Array) -> bool:
    """Whether dp follows the command, as it does where both are counted the same way."""
    return float(np.dot(u - u.mean(), dp - dp.mean())) >= 0.0


def _tracked(
    duty: Duty,
    dp: Array,
    edges: NDArray[np.int64],
    theta: Array,
    machine: Machine,
    skip: int,
    rate: float,
    speed: float,
) -> tuple[Track, Steps]:
    """The record followed from a first fit, and the steps of G in it.

    Where G seems to rise the blocks are linearised once more with that rise allowed: under the usual leash a leak pulls
    friction and gain off their values, which makes it smaller than it is. Sizes are taken from there; z, which a second
    look at what was chosen for being large would raise, is not.
    """
    followed, start = min(
        ((track(duty, dp, edges, theta, machine, one, skip, rate), one) for one in _starts(duty, theta, machine)),
        key=lambda both: float(both[0].block_variance[:_EARLY].mean()),
    )
    steps = steps_in(followed, theta, speed)
    after = int(np.argmax(steps.z))
    if steps.z[after] < _CLEAR:
        return followed, steps
    jumps = leap(edges.size - 1, after, G)
    anew = track(duty, dp, edges, theta, machine, start, skip, rate, jumps, followed.path)
    fresh = steps_in(anew, theta, speed)
    if excess_of(fresh) < max(1.0, excess_of(steps)) + 0.05:
        steps = replace(steps, size=fresh.size, deviation=fresh.deviation)
    return followed, steps


def _friction(theta: Array, machine: Machine, speed: float) -> float:
    """Friction [N] in mid-stroke."""
    v = machine.q_b / (2.0 * np.pi) / machine.A * speed
    return float(theta[F_C] + theta[F_V] * v)


def _starts(duty: Duty, theta: Array, machine: Machine) -> list[Array]:
    """States (5,) that the record may begin with: at rest, or on its way for long where the command does not begin at
    nought."""
    rest = np.zeros(STATES)
    grid = 2 * duty.every
    if abs(duty.u[0]) <= 0.02 * float(np.max(np.abs(duty.u))) and abs(duty.slope[0]) > 0.0:
        return [rest]
    n = (len(duty.inputs) - 1) // grid
    u, slope = duty.u[:-1:grid], duty.slope[:-1:grid]
    apart = np.abs(u - u[0]) / np.std(u) + np.abs(slope - slope[0]) / np.std(slope)
    same = n // 2 + int(np.argmin(apart[n // 2 :]))
    state = np.zeros((1, STATES))
    differences(duty.part(0, same), theta[None], machine, start=state)
    return [rest, state[0]]
