"""Fit of the reduced rig to a recorded pressure difference: where all later linearisation starts.

The fit is a maximum a posteriori estimate: least squares over a window of the record beside a wide normal prior around
the numbers of a rig that is assumed. The ringing after each reversal makes many local minima (a ring too many or too
few fits nearly as well), so the fit has three stages: gain, lead and friction from the slow part of the pressure,
which has one minimum; the oil's stiffness from starts all over its range; then all parameters together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealscope.diagnosis.pressure_model.model import (
    BIAS,
    C_C,
    F_C,
    F_CFR,
    F_V,
    GAIN,
    K_BRK,
    LEAD,
    OFFSET,
    PARAMETERS,
    RUNS,
    SIDE,
    SLOW_WIDTH,
    SOUND,
    STATES,
    STROKE,
    DrivenModel,
    G,
    K,
    gaussian,
)
from sealscope.recordings.recording import Array

#: Prior standard deviations: of the logarithm of gain, K, F_C, F_v, K_brk, C_c and F_cfr; of lead [s], G [m^3/(s Pa)],
#: the stroke's share and offset, the friction's side.
PRIOR = {GAIN: 1.0, K: 0.3, F_C: 0.3, F_V: 0.3, K_BRK: 0.3, C_C: 0.3, F_CFR: 0.5}
PRIOR_LEAD, PRIOR_G, PRIOR_STROKE, PRIOR_OFFSET, PRIOR_SIDE = 5e-4, 1.2e-12, 0.5, 0.2, 0.15
#: How far friction may depend on the pressures where a rig knows nothing of it [N/Pa].
LEAST_F_CFR = 5e-7
#: No friction is larger one way than the other by more than this share of the mean of both.
LARGEST_SIDE = 0.7
#: What the pump alone may let pass where a rig knows nothing of it [m^3/(s Pa)].
USUAL_G = 4e-13
#: Length of the window, and of a shorter one for the starts: so many cycles, at least and at most so many seconds.
LONG_WINDOW, SHORT_WINDOW = (12.0, 40.0, 75.0), (5.0, 18.0, 32.0)
#: What the model needs to settle before the window [s].
SETTLE = 0.8
_GAINS = np.geomspace(0.35, 3.5, 11)
_STIFFNESSES = np.geomspace(0.62, 1.4, 8)
_INTEGRAL = 4
#: Weight of the slow part: its samples hang together over some 30.
_SLOW_WEIGHT = 1.0 / 30.0
#: Dampings tried from one start, and from each of several.
_DAMPINGS = (0.0, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)
_FEWER_DAMPINGS = (0.0, 1e-2, 0.3, 10.0)
#: A stroke is long that takes away this share of V.
_LONG_STROKE = 0.25
#: What the stiffness of a machine with long strokes may do: share that follows the stroke, offset of mid-stroke.
_STROKES = ((0.0, 0.0), (1.0, -0.3), (1.0, -0.15), (1.0, 0.0), (1.0, 0.15), (1.0, 0.3))
#: Starts are gone on with whose cost after the first turns is this near to the least; fits are the same minimum within
#: this share of stiffness.
_NEAR, _SAME = 50.0, 0.01


def steps_of(theta: Array) -> Array:
    """Return the steps (14,) of the forward differences, small against the data's errors and large against rounding.

    Single precision leaves 0.1 Pa; of 10^5 Pa most steps move 10 to 100 Pa.
    """
    return np.array(
        [
            1e-3 * theta[GAIN],
            2e-5,
            1e-3 * abs(theta[GAIN]) + 1e-4 * abs(theta[BIAS]),
            5e-4 * theta[K],
            2e-14,
            1e-3 * theta[F_C] + 0.01,
            1e-3 * abs(theta[F_V]) + 0.1,
            1e-3 * theta[K_BRK],
            3e-3 * theta[C_C] + 1e-3,
            2e-7,
            2e-2,
            2e-3,
            1e-3,
            5e-12,
        ]
    )


def _valid(theta: Array) -> bool:
    return bool(
        np.all(np.isfinite(theta))
        and min(theta[GAIN], theta[K], theta[F_C], theta[C_C]) > 0.0
        and theta[K_BRK] > 1.0
        and abs(theta[SIDE]) < LARGEST_SIDE
    )


@dataclass(frozen=True, eq=False)
class Window:
    """A part of the record to fit.

    dp (n,) [Pa] after `settle` samples of command alone, the speed loop's integral over the gain at its beginning,
    noise variance [Pa^2] of a sample; `width` > 0: samples of the Gaussian that takes the ringing out.
    """

    model: DrivenModel
    dp: Array
    settle: int
    integral: float
    variance: float
    width: float = 0.0

    def slow(self, dp: Array) -> Array:
        """Return the slow part of dp (..., n), its mean taken out."""
        if self.width > 0:
            dp = np.apply_along_axis(np.convolve, -1, dp, gaussian(self.width), "valid")
        return np.asarray(dp - dp.mean(axis=-1, keepdims=True))

    def runs(self, thetas: Array) -> Array:
        """Return what the model shows in the window for parameter sets (runs, 14), as `slow` leaves it."""
        start = np.zeros((len(thetas), STATES))
        start[:, 0] = self.model.carried[0]
        start[:, 4] = self.integral * thetas[:, GAIN]
        start[:, 2] = 0.9 * self.model.u[0] * thetas[:, GAIN]
        start[:, 1] = self.model.piston_speed(start[:, 2])
        return self.slow(self.model.run(thetas, start=start)[:, self.settle :])

    @property
    def weight(self) -> float:
        """Cost of a squared Pa of misfit."""
        return (_SLOW_WEIGHT if self.width > 0 else 1.0) / self.variance


def noise_variance(dp: Array) -> float:
    """Return the variance [Pa^2] of white noise on dp, from its third differences, which hardly hold the ringing."""
    return float(np.var(np.diff(dp, 3)) / 20.0)


def window_at(model: DrivenModel, dp: Array, theta: Array, first: int, length: int) -> Window:
    """Return the window of `length` samples from `first` on; the model comes to it with parameters `theta` (14,)."""
    state = np.zeros((1, STATES))
    state[:, 0] = model.carried[0]
    if first > 0:
        model.coarse(theta).part(0, first).run(theta[None], start=state)
    integral = float(state[0, _INTEGRAL] / theta[GAIN])
    settle = int(SETTLE * model.rate)
    here = dp[first + settle : first + length]
    return Window(model.part(first, length), here, settle, integral, noise_variance(dp))


@dataclass(frozen=True, eq=False)
class Prior:
    """A normal prior: centre and standard deviation (14,) of each parameter."""

    centre: Array
    deviation: Array

    def cost(self, theta: Array, free: Sequence[int]) -> float:
        """Return minus twice its logarithm, but for a constant."""
        off = (theta - self.centre)[list(free)] / self.deviation[list(free)]
        return float(off @ off)


def prior_of(centre: Array) -> Prior:
    """Return how far a machine may be from the assumed rig."""
    deviation = np.array([PRIOR.get(k, 0.0) * centre[k] for k in range(len(PARAMETERS))])
    deviation[LEAD], deviation[G], deviation[BIAS] = PRIOR_LEAD, PRIOR_G, 0.1 * centre[GAIN]
    deviation[STROKE], deviation[OFFSET], deviation[SIDE] = PRIOR_STROKE, PRIOR_OFFSET, PRIOR_SIDE
    deviation[F_CFR] = max(deviation[F_CFR], LEAST_F_CFR)
    return Prior(centre, deviation)


def minimise(
    window: Window, thetas: Array, prior: Prior, free: Sequence[int], most: int, enough: float
) -> tuple[Array, Array]:
    """Minimise the cost over the free parameters by Levenberg-Marquardt from several starts (m, 14) side by side.

    Returns the sets that are reached, cheapest first, and their costs (m,). A start is left where the linear model
    promises less than `enough` of cost, or a step gains less.
    """
    free = list(free)
    data = window.slow(window.dp)
    thetas = thetas.copy()
    shown = window.runs(thetas)

    def cost_of(here: Array, at: Array) -> float:
        misfit = window.weight * float(np.sum((data - here) ** 2)) + prior.cost(at, free)
        return misfit if np.isfinite(misfit) else np.inf

    costs = np.array([cost_of(here, at) for here, at in zip(shown, thetas, strict=True)])
    active = [int(start) for start in np.flatnonzero(np.isfinite(costs))]
    known: dict[int, Array] = {}  # what starts show for a step of each free parameter

    def run(parts: Sequence[Array]) -> list[Array]:
        """Run sets of several starts, which fill the vector registers together."""
        shown = window.runs(np.concatenate(parts))
        return np.split(shown, np.cumsum([len(part) for part in parts])[:-1])

    def stepped(theta: Array) -> Array:
        """Return a set for a step of each free parameter."""
        sets = np.tile(theta, (len(free), 1))
        sets[range(len(free)), free] += steps_of(theta)[free]
        return sets

    def damped(theta: Array, system: tuple[Array, Array, Array], dampings: Sequence[float]) -> Array:
        """Return the sets that a linear system leads to from a start, one a damping."""
        H, g, h = system
        tries = np.tile(theta, (len(dampings), 1))
        for row, factor in zip(tries, dampings, strict=True):
            row[free] += np.linalg.solve(H + factor * np.diag(np.diag(H)), g) * h
            if not _valid(row):
                row[:] = theta
        return tries

    for turn in range(most):
        unknown = [start for start in active if start not in known]
        if unknown:
            known.update(zip(unknown, run([stepped(thetas[start]) for start in unknown]), strict=True))
        systems: dict[int, tuple[Array, Array, Array]] = {}
        for start in active:
            h = steps_of(thetas[start])[free]
            slopes = known.pop(start) - shown[start]
            scale = h / prior.deviation[free]
            off = (thetas[start] - prior.centre)[free] / prior.deviation[free]
            H = window.weight * (slopes @ slopes.T) + np.diag(scale**2)
            g = window.weight * (slopes @ (data - shown[start])) - off * scale
            promised = float(g @ np.linalg.solve(H, g)) if np.all(np.isfinite(H)) else 0.0
            if promised >= enough:
                systems[start] = H, g, h
        active = list(systems)
        if not active:
            break

        # a whole step is looked at with its slopes, as it is taken nearly always; the last one needs none
        # (a start that is alone looks closer where the whole step is not the best, and its runs fill one register)
        dampings = _FEWER_DAMPINGS[: None if len(active) > 1 else RUNS - len(free)]
        tries = {start: damped(thetas[start], systems[start], dampings) for start in active}
        final = turn + 1 == most
        parts = [tries[start] if final else np.vstack([tries[start], stepped(tries[start][0])]) for start in active]
        tried = dict(zip(active, run(parts), strict=True))
        reached = {
            start: [cost_of(here, at) for here, at in zip(tried[start], tries[start], strict=False)] for start in active
        }
        again = [start for start in active if int(np.argmin(reached[start])) != 0] if len(active) == 1 else []
        for start in again:
            tries[start] = damped(thetas[start], systems[start], _DAMPINGS)
            tried[start] = window.runs(tries[start])
            reached[start] = [cost_of(here, at) for here, at in zip(tried[start], tries[start], strict=True)]
        going = []
        for start in active:
            best = int(np.argmin(reached[start]))
            gained = costs[start] - reached[start][best]
            if gained > 0.0:
                thetas[start], costs[start] = tries[start][best], reached[start][best]
                shown[start] = tried[start][best]
                if best == 0 and len(tried[start]) > len(tries[start]):
                    known[start] = tried[start][len(tries[start]) :]
            if gained >= enough:
                going.append(start)
        active = going
    order = np.argsort(costs, kind="stable")
    return thetas[order], costs[order]


def first_guess(short: Window, prior: Prior) -> Array:
    """Return parameters (14,) of which gain, lead, bias and friction fit the slow part of the pressure.

    The others are the prior's.
    """
    centre = prior.centre
    slow = replace(short, width=SLOW_WIDTH * short.model.rate)
    starts = np.tile(centre, (_GAINS.size, 1))
    starts[:, GAIN] *= _GAINS
    data = slow.slow(slow.dp)
    misfit = np.sum((slow.runs(starts) - data) ** 2, axis=1)
    slowly = (GAIN, LEAD, BIAS, F_C, F_V, K_BRK)
    if np.all(np.isnan(misfit)):
        raise FloatingPointError("the model of the rig diverges")
    fitted, _ = minimise(slow, starts[[int(np.nanargmin(misfit))]], prior, slowly, 12, 1e-2)
    return np.asarray(fitted[0])


def long_strokes(model: DrivenModel) -> bool:
    """Return whether the piston's place changes the chambers' volumes much."""
    return float(np.max(np.abs(model.travel))) > _LONG_STROKE


def fit(window: Window, short: Window, prior: Prior, guess: Array) -> tuple[Array, float, list[Array]]:
    """Return the parameters (14,) of the best fit, its cost per sample, and other starts.

    The other starts are for a record that the model does not follow from the first; `short`: part of the window, for
    the many starts about the first `guess`.
    """
    centre = prior.centre
    long = long_strokes(short.model)
    starts = np.tile(guess, (_STIFFNESSES.size, 1))
    starts[:, K] = centre[K] * _STIFFNESSES
    if long:
        # the stiffness may follow long strokes or not, and mid-stroke may lie anywhere: the two likeliest of each
        starts = np.repeat(starts, len(_STROKES), axis=0)
        starts[:, [STROKE, OFFSET]] = np.tile(_STROKES, (_STIFFNESSES.size, 1))
        misfit = np.sum((short.runs(starts) - short.slow(short.dp)) ** 2, axis=1).reshape(_STIFFNESSES.size, -1)
        likely = (
            np.argsort(misfit, axis=1, kind="stable")[:, :2] + len(_STROKES) * np.arange(_STIFFNESSES.size)[:, None]
        )
        starts = starts[likely.reshape(-1)]
    starts, costs = minimise(short, starts, prior, (GAIN, LEAD, K, G, F_V, *((OFFSET,) if long else ())), 3, 3.0)
    everything = range(SOUND)
    tried, _ = minimise(short, starts[costs <= costs[0] + _NEAR], prior, everything, 8, 1.0)
    other = next((k for k in range(1, len(tried)) if abs(tried[k, K] / tried[0, K] - 1.0) > _SAME), None)
    finalists, _ = minimise(window, tried[[0] if other is None else [0, other]], prior, everything, 4, 1.0)
    (theta, *_), costs = minimise(window, finalists[:1], prior, everything, 20, 1.0)
    plain = theta.copy()
    plain[[LEAD, BIAS]] = 0.0
    plain[[G, F_C, F_V, K_BRK, C_C, F_CFR]] = centre[[G, F_C, F_V, K_BRK, C_C, F_CFR]]
    return theta, float(costs[0]) / window.dp.size, [*finalists[1:], plain]


def refit(window: Window, start: Array, prior: Prior) -> tuple[Array, float]:
    """Return the best fit that is reached from another start, and its cost per sample."""
    fitted, _ = minimise(window, start[None], prior, (GAIN, K), 6, 1.0)
    fitted, costs = minimise(window, fitted, prior, range(SOUND), 20, 1.0)
    return fitted[0], float(costs[0]) / window.dp.size
