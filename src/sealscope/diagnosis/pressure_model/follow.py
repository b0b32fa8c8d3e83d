"""From a record to its followed parameters: window, first fit, blocks, and the steps of G."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.baseline.level import Level
from sealscope.diagnosis.pressure_model.behind_valve import STANDING, stalled, standing_load
from sealscope.diagnosis.pressure_model.fit import (
    LONG_WINDOW,
    PRIOR,
    SHORT_WINDOW,
    USUAL_G,
    Prior,
    Window,
    first_guess,
    fit,
    long_strokes,
    prior_of,
    refit,
    window_at,
)
from sealscope.diagnosis.pressure_model.interference import advanced, lines_in, skew
from sealscope.diagnosis.pressure_model.large import WORSE, LargeLeak, large_leak
from sealscope.diagnosis.pressure_model.load import SWINGS, carried_by_load, swing
from sealscope.diagnosis.pressure_model.model import (
    F_C,
    F_V,
    GAIN,
    SOUND,
    STATES,
    DrivenModel,
    G,
    K,
    assumed_numbers,
    nominal,
)
from sealscope.diagnosis.pressure_model.tracking.blocks import Blocks
from sealscope.diagnosis.pressure_model.tracking.laws import LAWS
from sealscope.diagnosis.pressure_model.tracking.noise import steps_beside_noise
from sealscope.diagnosis.pressure_model.tracking.steps import ConductanceSteps, PossibleLeak, excess_of
from sealscope.diagnosis.pressure_model.tracking.track import DIVERGED, Track, track
from sealscope.parameters import Rig
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

#: The model must explain this share of the pressure difference's variance, in so many blocks or more.
EXPLAINED, FEWEST_BLOCKS = 0.9, 12
#: Blocks are whole cycles of at least so long [s], or of so long where these are too few; what comes before is left
#: out: the start from rest.
BLOCK, SHORTER, FIRST = 6.0, 4.9, 3.0
#: The window begins at this share of the record: what a start leaves behind has decayed there.
_WINDOW_AT = 0.55
_EARLY = 4
#: Friction and stiffness that fall by more than these shares from the first third to the last are those of oil that
#: warms: 0.05 and 0.03 at most on 16 machines of the bench that do not warm, with a leak or without.
THINNER = (-0.1, -0.04)
#: A rise of G worth another look.
_CLEAR = 2.7
#: ... and one that no other minimum of the blocks takes away.
_EVIDENT = 8.0
#: A rise of G so clear that it may be too large for linear blocks.
_STRONG = 15.0
#: A record that the model follows so badly is tried again from other first fits.
RESTLESS = 1.15
#: ... of which one is as good whose cost is higher by no more than this share.
_AS_GOOD = 1e-3
#: A model that is led predicts next samples with any oil: its stiffness is within so many prior deviations.
_OIL = 4.0


class _Look(NamedTuple):
    """A record followed from one first fit; `excess`: chi square over its degrees of freedom, beside the best leak.

    `risen`: the track with the likelier of `leaks` allowed, None without one; `warming`: whether its parameters may
    drift as in oil that warms; `lost`: whether with a leak allowed blocks are too far from the model to be linear.
    """

    track: Track
    steps: ConductanceSteps
    leaks: tuple[PossibleLeak, ...]
    excess: float
    risen: Track | None = None
    warming: bool = False
    lost: bool = False


@dataclass(frozen=True, eq=False)
class Followed:
    """A record as the model sees it.

    `theta` (14,): first fit; `path` (b, 14); `steps` of G; `leaks` that explain its largest, the likelier first;
    `excess`: chi square a degree of freedom of what scatters beside it; `edges` (b + 1,) [samples] from the first
    sample; `level` [m^3/(s Pa)]: mean G; `friction_change`, `stiffness_change`: from the first to
    the last third, as shares; `share` of the blocks that have no missing samples and count;
    `large`: a leak that linear blocks did not reach, beside which all this is then taken; `change`: what looks like
    one, but another machine from then on explains the record as well; `predicted` (n,): p_A - p_B [Pa] as a model that
    is led by its readings predicts it, None where the model follows under the command alone; `pumped` [m^3/s]: the
    pump's mean flow; `warming`: whether its parameters may drift as in oil that warms.
    """

    theta: Array
    path: Array
    steps: ConductanceSteps
    leaks: tuple[PossibleLeak, ...]
    excess: float
    edges: NDArray[np.int64]
    level: Level
    friction_change: float
    stiffness_change: float
    command_rms: float
    pumped: float
    share: float = 1.0
    large: LargeLeak | None = None
    change: LargeLeak | None = None
    predicted: Array | None = None
    warming: bool = False

    @property
    def another(self) -> bool:
        """Whether another machine from an instant on explains the record far better than a large leak."""
        return self.change is not None and self.change.better < WORSE

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return self.edges.size - 1


def _windows(model: DrivenModel, dp: Array, theta: Array, cycle: float) -> tuple[Window, Window]:
    """Return the long window of the fit and its beginning, the short one, in steps twice as long where these do."""
    n = dp.size
    long, short = (
        min(n, int(np.clip(cycles * cycle, least, most) * model.rate))
        for cycles, least, most in (LONG_WINDOW, SHORT_WINDOW)
    )
    first = max(0, min(int(_WINDOW_AT * n), n - long))
    whole = window_at(model, dp, theta, first, long)
    length = min(short, long)
    # of long strokes, whose stiffness follows the place, coarse steps find another place
    starts = model if long_strokes(model) else model.coarse(theta)
    return whole, replace(whole, model=starts.part(first, length), dp=whole.dp[: length - whole.settle])


def follow(rig: Rig, recording: Recording, cycle: float | None, unruly: float = np.inf) -> Followed | str:
    """Fit and follow the chamber pressures and the command of a record, or return the reason why that is not possible.

    `cycle` [s]: length of the duty's cycle, None where it does not repeat; a record that is hardly explained, or whose
    parameters wander `unruly` times as much as a healthy machine's, is followed by a model that is led by its readings,
    by default none.
    """
    u, p_A, p_B, rate = recording["u"], recording["p_A"], recording["p_B"], recording.rate
    numbers = assumed_numbers(rig)
    if not numbers.valved:  # behind a valve the chambers do not ring as each other's mirror
        p_B = advanced(p_B, skew(p_A, p_B, rate), rate)
    dp = p_A - p_B
    dp = raw = dp * (1.0 if _same_sense(u, dp) else -1.0)
    centre = nominal(rig)
    centre[G] = max(centre[G], USUAL_G)
    carried = None if numbers.valved or cycle is None else carried_by_load(u, dp, rate, cycle)
    model = plain = DrivenModel.of(u, rate, numbers, p_A + p_B, carried)
    # what leaks under a force moves the strokes, which the force then seems to do: under a weak one a leak is sized
    # without it, too
    weak = carried is not None and swing(dp, rate, cycle) < SWINGS
    unfed = DrivenModel.of(u, rate, numbers, p_A + p_B) if weak else None
    span = BLOCK if cycle is None else cycle
    if model.numbers.valved and (at := stalled(dp, model.supply, rate)) is not None:
        return (
            f"p_A - p_B takes nearly all of the supply's pressure at {recording.t[at]:.1f} s: the piston is at an end "
            "of its stroke there, or a load holds it"
        )
    if model.numbers.valved and (ratio := standing_load(dp)) > STANDING:
        return (
            f"a load stands on the piston: the mean of p_A - p_B is {ratio:.2g} times its deviation, and what a servo "
            "valve's edges pass under it rises as a leak does"
        )
    _, short = _windows(model, dp, centre, span)
    prior = prior_of(centre)
    guess = first_guess(short, prior)
    model = model.with_travel(guess)
    long, short = _windows(model, dp, guess, span)
    theta, cost, anew = fit(long, short, prior, guess)
    if not np.isfinite(cost):
        return "the model of the rig cannot be fitted to the pressures"
    shown = model.run(theta[None])[0]
    hum = lines_in(dp - shown, rate, cycle)
    humming = bool(np.any(hum))
    if humming:
        dp = dp - hum
        long, short = _windows(model, dp, theta, span)
        theta, cost = refit(long, theta, prior)
    cut = _cut(recording, model, dp, span)
    if isinstance(cut, str):
        return cut
    blocks, share = cut
    look, large = _tracked(blocks, theta, unruly, None if humming else shown), None
    doubtful = isinstance(look, str) or look.excess > RESTLESS or bool(np.max(look.steps.z) > _STRONG)
    if isinstance(look, str) or look.warming or doubtful:
        large = _large(replace(blocks, model=unfed or plain, dp=raw), prior)
        if large is not None and large.stated and large.sized and large.excess <= unruly:
            return replace(_beside(large, blocks), share=share)
    # where the model follows beside a large leak, or beside another machine in its place, that is its word
    weighed = large is not None and large.sized and large.excess <= unruly
    sizing = None if unfed is None else replace(blocks, model=unfed.with_travel(guess))
    if not isinstance(look, str):
        look = _looked_again(look, blocks, theta, sizing)
    astray = np.isfinite(unruly) if isinstance(look, str) else look.excess > unruly
    # beside a leak too large for any block to be linear it is the large one's word, too
    weighed = weighed or (large is not None and large.stated and not isinstance(look, str) and look.lost)
    if astray and not weighed and not numbers.valved:
        led = _led(replace(blocks, model=model.led(dp, guess)), guess, prior, span, unruly)
        if led is not None and (led.large is not None or led.excess <= unruly):
            return replace(led, share=share)
    # in oil that warms, where nothing else asked for a large leak, it must be sized, too
    if large is not None and large.stated and (large.sized or doubtful):
        return replace(_beside(large, blocks), share=share)
    if isinstance(look, str):
        return look
    if look.excess > RESTLESS:
        for first in anew:
            other, dearer = refit(long, first, prior)
            if dearer > cost * (1.0 + _AS_GOOD):
                continue
            again = _tracked(blocks, other, unruly)
            if isinstance(again, str):
                continue
            again = _looked_again(again, blocks, other, sizing)
            if again.excess < look.excess - 0.05:
                theta, look = other, again
    stiffness = float(np.mean(look.track.path[:, K])) / centre[K]
    if stiffness > 1.0 + 3.0 * PRIOR[K]:
        return (
            f"the rig does not describe this machine: its oil would be {stiffness:.2g} times as stiff as the rig's; "
            "the fit has a ring too many in each reversal, or another --rig describes it"
        )
    return replace(_seen_so(look, theta, blocks), change=large, share=share)


def _cut(recording: Recording, model: DrivenModel, dp: Array, span: float) -> tuple[Blocks, float] | str:
    """Return the record in blocks of whole spans [s], and the share of them that count; or why there are too few."""
    rate = recording.rate
    lengths = [max(1, int(np.ceil(least / span - 1e-9))) * span for least in (BLOCK, SHORTER)]
    length = lengths[dp.size / rate - FIRST < FEWEST_BLOCKS * lengths[0]]
    edges = np.round(np.arange(FIRST, dp.size / rate, length) * rate).astype(np.int64)
    seen = ~touched(recording, edges)
    counted = np.flatnonzero(seen)
    if counted.size < 3 or counted[-1] - counted[0] + 1 < FEWEST_BLOCKS:
        return f"too short: {counted.size} whole blocks of {length:.3g} s, {FEWEST_BLOCKS} are needed"
    first, end = counted[0], counted[-1] + 1
    return Blocks(model, dp, edges[first : end + 1], seen[first:end]), float(np.mean(seen))


def _led(blocks: Blocks, guess: Array, prior: Prior, span: float, unruly: float) -> Followed | None:
    """Return the record as a model that is led by its readings sees it, None where it does not follow either.

    A machine that rings by itself, or breaks away from a rest, keeps no phase that the command sets: to follow it under
    the command alone all parameters must wander. Predicted from one sample to the next, the record is followed by those
    of a machine (the prediction-error method: L. Ljung, System Identification, 2nd ed., 1999, ch. 7). None where it is
    not followed, or only by a machine whose oil is not the rig's.
    """
    long, short = _windows(blocks.model, blocks.dp, guess, span)
    try:
        theta, cost, _ = fit(long, short, prior, guess)
    except FloatingPointError:
        return None
    if not np.isfinite(cost) or abs(math.log(theta[K] / prior.centre[K])) > _OIL * PRIOR[K]:
        return None
    look = _tracked(blocks, theta, unruly)
    if isinstance(look, str):
        return None
    look, large = _looked_again(look, blocks, theta), None
    if np.max(look.steps.z) > _STRONG:
        large = _large(blocks, prior)
        if large is not None and large.stated and large.sized:
            return replace(_beside(large, blocks), predicted=_predicted(blocks, large.track))
    # beside a leak friction and stiffness are those with the leak allowed: without it they take its part
    beside = look.track if look.risen is None else look.risen
    followed = _seen_so(look._replace(track=beside), theta, blocks)
    return replace(followed, change=large, predicted=_predicted(blocks, beside))


def _predicted(blocks: Blocks, followed: Track) -> Array:
    """Return what a model that is led by its readings predicts of dp (n,) [Pa], with the mean of the readings."""
    shown = blocks.run(followed.path[None], followed.start)[0]
    return np.asarray(shown + np.mean(blocks.dp - shown))


def _seen_so(look: _Look, theta: Array, blocks: Blocks) -> Followed:
    """Return the record as a look sees it."""
    followed, model = look.track, blocks.model
    friction, stiffness = _changes(followed, model, model.speed_amplitude(theta))
    return Followed(
        theta,
        followed.path,
        look.steps,
        look.leaks,
        look.excess,
        blocks.edges,
        Level(float(look.steps.level.mean()), float(look.steps.level_deviation.mean())),
        friction,
        stiffness,
        float(np.std(model.u[: -1 : 2 * model.every])),
        float(model.piston_speed(theta[GAIN] * np.mean(np.abs(model.u)))) * model.numbers.A_A,
        warming=look.warming,
    )


def _beside(large: LargeLeak, blocks: Blocks) -> Followed:
    """Return the record beside a large leak."""
    look = _Look(large.track, large.steps, large.leaks, large.excess)
    return replace(_seen_so(look, large.theta, blocks), large=large)


def _same_sense(u: Array, dp: Array) -> bool:
    """Return whether dp follows the command, as it does where both count in the same sense."""
    return float(np.dot(u - u.mean(), dp - dp.mean())) >= 0.0


def _large(blocks: Blocks, prior: Prior) -> LargeLeak | None:
    """Return the leak that linear blocks do not reach, None where there is none or the model diverges."""
    try:
        return large_leak(blocks, prior)
    except FloatingPointError:
        return None


def _tracked(blocks: Blocks, theta: Array, unruly: float, shown: Array | None = None) -> _Look | str:
    """Follow the record from a first fit, and estimate the steps of G in it.

    Where friction and stiffness fall all may drift as in oil that warms, and so may the parameters of a model that is
    led, which wander `unruly` times as much as a healthy machine's and then do not. `shown` (n,): what the model shows
    with that fit from rest.
    """
    model = blocks.model
    try:
        followed = min(
            (track(blocks, theta, start, shown=None if np.any(start) else shown) for start in _starts(model, theta)),
            key=lambda each: float(each.block_variance[:_EARLY].mean()),
        )
    except FloatingPointError:
        return DIVERGED
    explained = 1.0 - followed.variance / float(np.var(blocks.dp - model.carried))
    if not explained >= EXPLAINED:
        return (
            f"the model of the rig explains {100.0 * explained:.0f} % of the pressure difference, "
            f"{100.0 * EXPLAINED:.0f} % are needed; another --rig may describe this machine"
        )
    steps = steps_beside_noise(blocks, theta, followed)
    look = _Look(followed, steps, (), excess_of(steps))
    friction, stiffness = _changes(followed, model, model.speed_amplitude(theta))
    thinner = friction < THINNER[0] and stiffness < THINNER[1]
    # what the command leads may have lost the phase of the ringing, which looks like a drift as well
    drifts = thinner or (look.excess > unruly and model.correction > 0.0)
    if drifts and not model.numbers.valved:
        followed = track(blocks, theta, followed.start, begin=followed, warming=True)
        steps = steps_beside_noise(blocks, theta, followed, warming=True)
        if excess_of(steps) <= max(unruly, look.excess if thinner else 0.0):
            return _Look(followed, steps, (), excess_of(steps), warming=True)
    return look


def _looked_again(look: _Look, blocks: Blocks, theta: Array, sizing: Blocks | None = None) -> _Look:
    """Return the look with the leaks that may be the largest of its steps.

    Where G seems to rise the blocks are linearised once more with that rise allowed, by either law: under the usual
    leash a leak pulls friction and gain off their values, which makes it smaller than it is. Sizes and the scatter
    beside the leak are taken from there; z, which a second look at what was chosen for being large would raise, is not.
    Nothing rose where the blocks, begun at those that the leak led to, explain the record as well without one: blocks
    may stop in different minima. `sizing`: with another model in which leaks are looked for: what either says may be.
    """
    followed, steps, warming = look.track, look.steps, look.warming
    after = int(np.argmax(steps.z))
    if steps.z[after] < _CLEAR:
        return look
    fits = [_risen(blocks, theta, followed.start, after, followed, warming)]
    if sizing is not None:
        fits.append(_risen(sizing, theta, _starts(sizing.model, theta)[-1], after, followed.path, warming))
    leaks = sorted((leak for fit in fits for leak, *_ in fit), key=lambda leak: leak.cost)
    beside = [excess for *_, excess in fits[0]]
    excess, lost = min(look.excess, *beside), bool(np.any(np.isinf(beside)))
    likelier = min(fits[0], key=lambda each: each[0].cost)[1]
    if steps.z[after] < _EVIDENT:
        sound = likelier.path.copy()
        sound[:, SOUND:] = theta[SOUND:]
        other = track(blocks, theta, followed.start, begin=sound, warming=warming)
        if (other.misfit - followed.misfit) / followed.variance + other.strain <= followed.strain:
            flat = steps_beside_noise(blocks, theta, other, warming=warming)
            if np.max(flat.z) < _CLEAR:
                return _Look(other, flat, (), excess_of(flat), warming=warming)
    return _Look(followed, steps, tuple(leaks), excess, likelier, warming, lost)


def _risen(
    blocks: Blocks, theta: Array, start: Array, after: int, begin: Track | Array, warming: bool
) -> list[tuple[PossibleLeak, Track, float]]:
    """Return a leak of either law after a block, the record followed with it, and its excess; costs from the least."""
    tracks = [track(blocks, theta, start, (law, after), begin, warming=warming) for law in LAWS]
    variance = min(each.variance for each in tracks)
    costs = [each.misfit / variance + each.strain for each in tracks]
    risen = []
    for law, each, cost in zip(LAWS, tracks, costs, strict=True):
        again = steps_beside_noise(blocks, theta, each, law, warming=warming)
        leak = PossibleLeak(law, after, float(again.size[after]), float(again.deviation[after]), cost - min(costs))
        risen.append((leak, each, excess_of(again)))
    return risen


def _changes(followed: Track, model: DrivenModel, speed: float) -> tuple[float, float]:
    """Return how far friction in mid-stroke and stiffness changed from the first to the last third, as shares."""
    third = max(1, len(followed.path) // 3)
    early, late = followed.path[:third].mean(axis=0), followed.path[-third:].mean(axis=0)
    return _friction(late, model, speed) / _friction(early, model, speed) - 1.0, float(late[K] / early[K] - 1.0)


def _friction(theta: Array, model: DrivenModel, speed: float) -> float:
    """Return the friction [N] in mid-stroke."""
    return float(theta[F_C] + theta[F_V] * model.piston_speed(speed))


def _starts(model: DrivenModel, theta: Array) -> list[Array]:
    """Return the states (5,) that the record may begin with: at rest, or in motion where the command is not at zero."""
    rest = np.zeros(STATES)
    rest[0] = model.carried[0]
    u, slope = (model.inputs[: -1 : 2 * model.every, column] for column in (0, 1))
    if abs(u[0]) <= 0.02 * float(np.max(np.abs(model.u))) and abs(slope[0]) > 0.0:
        return [rest]
    n = model.samples
    apart = np.abs(u - u[0]) / np.std(u) + np.abs(slope - slope[0]) / np.std(slope)
    same = n // 2 + int(np.argmin(apart[n // 2 :]))
    state = rest[None].copy()
    model.part(0, same).run(theta[None], start=state)
    return [rest, state[0]]
