"""From a record to its followed parameters: window, first fit, blocks, and the steps of G."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.baseline.level import Level
from sealscope.diagnosis.pressure_model.fit import (
    LONG_WINDOW,
    PRIOR,
    SETTLE,
    SHORT_WINDOW,
    USUAL_G,
    Window,
    first_guess,
    fit,
    prior_of,
    refit,
)
from sealscope.diagnosis.pressure_model.interference import advanced, lines_in, skew
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
from sealscope.diagnosis.pressure_model.track import RISES, ConductanceSteps, Track, excess_of, steps_in, track
from sealscope.parameters import Rig
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

#: The model must explain this share of the pressure difference's variance, in so many blocks or more.
EXPLAINED, FEWEST_BLOCKS = 0.9, 12
#: Blocks are whole cycles of at least so long [s]; what comes before is left out: the start from rest.
BLOCK, FIRST = 6.0, 3.0
#: The window begins at this share of the record: what a start leaves behind has decayed there.
_WINDOW_AT = 0.55
_INTEGRAL = 4
_EARLY = 4
#: A rise of G worth another look.
_CLEAR = 2.7
#: A record that the model follows so badly is tried again from other first fits.
RESTLESS = 1.15
#: ... of which one is as good whose cost is higher by no more than this share.
_AS_GOOD = 1e-3


@dataclass(frozen=True, eq=False)
class PossibleLeak:
    """A leak that would explain the record.

    `rising`: its conductance G, or its coefficient as an orifice; `after` which block; `size`, `deviation`
    [m^3/(s Pa)], of an orifice [m^3/(s Pa^0.5)]; `cost`: minus twice the log likelihood but for a constant.
    """

    rising: int
    after: int
    size: float
    deviation: float
    cost: float


class _Look(NamedTuple):
    """A record followed from one first fit; `excess`: chi square over its degrees of freedom, beside the best leak."""

    track: Track
    steps: ConductanceSteps
    leaks: tuple[PossibleLeak, ...]
    excess: float


@dataclass(frozen=True, eq=False)
class Followed:
    """A record as the model sees it.

    `theta` (13,): first fit; `path` (b, 13); `steps` of G; `leaks` that explain its largest, the likelier first;
    `excess`: chi square a degree of freedom of what scatters beside it; `edges` (b + 1,) [samples] from the first
    sample; `seconds` of a block; `level` [m^3/(s Pa)]: mean G; `friction_change`, `stiffness_change`: from the first to
    the last third, as shares; `share` of the blocks that have no missing samples and count.
    """

    theta: Array
    path: Array
    steps: ConductanceSteps
    leaks: tuple[PossibleLeak, ...]
    excess: float
    edges: NDArray[np.int64]
    seconds: float
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


def follow(rig: Rig, recording: Recording, cycle: float | None) -> Followed | str:
    """Fit and follow the chamber pressures and the command of a record, or return the reason why that is not possible.

    `cycle` [s]: length of the duty's cycle, None where it does not repeat.
    """
    u, p_A, p_B, rate = recording["u"], recording["p_A"], recording["p_B"], recording.rate
    p_B = advanced(p_B, skew(p_A, p_B, rate), rate)
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
        return "the model of the rig cannot be fitted to the pressures"
    hum = lines_in(dp - model.run(theta[None])[0], rate, cycle)
    if np.any(hum):
        dp = dp - hum
        long, short = _windows(model, dp, theta, span)
        theta, cost = refit(long, theta, prior)
    length = max(1, int(np.ceil(BLOCK / span - 1e-9))) * span
    edges = np.round(np.arange(FIRST, dp.size / rate, length) * rate).astype(np.int64)
    seen = ~touched(recording, edges)
    share = float(np.mean(seen)) if seen.size else 0.0
    counted = np.flatnonzero(seen)
    if counted.size < 3 or counted[-1] - counted[0] + 1 < FEWEST_BLOCKS:
        return f"too short: {counted.size} whole blocks of {length:.3g} s, {FEWEST_BLOCKS} are needed"
    edges, seen = edges[counted[0] : counted[-1] + 2], seen[counted[0] : counted[-1] + 1]
    speed = float(np.sqrt(2.0) * theta[GAIN] * np.std(u))
    skip = int(FIRST * rate)
    look = _tracked(model, dp, edges, theta, skip, speed, seen)
    if isinstance(look, str):
        return look
    if look.excess > RESTLESS:
        for first in anew:
            other, dearer = refit(long, first, prior)
            if dearer > cost * (1.0 + _AS_GOOD):
                continue
            again = _tracked(model, dp, edges, other, skip, speed, seen)
            if not isinstance(again, str) and again.excess < look.excess - 0.05:
                theta, look = other, again
    followed = look.track
    stiffness = float(np.mean(followed.path[:, K])) / centre[K]
    if stiffness > 1.0 + 3.0 * PRIOR[K]:
        return (
            f"the rig does not describe this machine: its oil would be {stiffness:.2g} times as stiff as the rig's; "
            "the fit has a ring too many in each reversal, or another --rig describes it"
        )
    third = max(1, len(followed.path) // 3)
    early, late = followed.path[:third].mean(axis=0), followed.path[-third:].mean(axis=0)
    friction = _friction(late, model, speed) / _friction(early, model, speed) - 1.0
    return Followed(
        theta,
        followed.path,
        look.steps,
        look.leaks,
        look.excess,
        edges,
        length,
        Level(float(look.steps.level.mean()), float(look.steps.level_deviation.mean())),
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
) -> _Look | str:
    """Follow the record from a first fit; estimate the steps of G in it, and the leaks that may be the largest of them.

    Where G seems to rise the blocks are linearised once more with that rise allowed, by either law: under the usual
    leash a leak pulls friction and gain off their values, which makes it smaller than it is. Sizes and the scatter
    beside the leak are taken from there; z, which a second look at what was chosen for being large would raise, is not.
    """
    followed, start = min(
        ((track(model, dp, edges, theta, start, skip, seen=seen), start) for start in _starts(model, theta)),
        key=lambda both: float(both[0].block_variance[:_EARLY].mean()),
    )
    explained = 1.0 - followed.variance / float(np.var(dp))
    if not explained >= EXPLAINED:
        return (
            f"the model of the rig explains {100.0 * explained:.0f} % of the pressure difference, "
            f"{100.0 * EXPLAINED:.0f} % are needed; another --rig may describe this machine"
        )
    steps = steps_in(followed, theta, speed)
    after = int(np.argmax(steps.z))
    if steps.z[after] < _CLEAR:
        return _Look(followed, steps, (), excess_of(steps))
    risen = [track(model, dp, edges, theta, start, skip, (rising, after), followed.path, seen=seen) for rising in RISES]
    variance = min(fresh.variance for fresh in risen)
    leaks, excess = [], excess_of(steps)
    for rising, fresh in zip(RISES, risen, strict=True):
        again = steps_in(fresh, theta, speed, rising=rising)
        cost = fresh.misfit / variance + fresh.strain
        leaks.append(PossibleLeak(rising, after, float(again.size[after]), float(again.deviation[after]), cost))
        excess = min(excess, excess_of(again))
    return _Look(followed, steps, tuple(sorted(leaks, key=lambda leak: leak.cost)), excess)


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
