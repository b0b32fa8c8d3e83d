"""The reduced rig fitted to a recorded pressure difference: where all later linearisation starts from.

The fit is a maximum a posteriori estimate: least squares over a window of the record beside a wide normal prior around
the numbers of a rig that is assumed. The ringing after each reversal makes many local minima (a ring too many or too
few fits nearly as well), so the way there has three stages: gain, lead and friction from the slow part of the pressure,
which has one minimum; the oil's stiffness from starts all over its range; then all parameters together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.pressure_laws import (
    BIAS,
    C_C,
    F_C,
    F_V,
    GAIN,
    K_BRK,
    LEAD,
    LONGEST_STEP,
    PARAMETERS,
    RUNS,
    STATES,
    G,
    K,
    Machine,
    pressure_differences,
)
from sealscope.recordings.recording import Array

#: Prior standard deviations: of the logarithm of gain, K, F_C, F_v, K_brk and C_c; of lead [s] and G [m^3/(s Pa)].
PRIOR = {GAIN: 1.0, K: 0.3, F_C: 0.3, F_V: 0.3, K_BRK: 0.3, C_C: 0.3}
PRIOR_LEAD, PRIOR_G = 5e-4, 1.2e-12
#: What the pump alone may let pass where a rig knows nothing of it [m^3/(s Pa)].
USUAL_G = 4e-13
#: Length of the window, and of a shorter one for the starts: so many cycles, at least and at most so many seconds.
LONG_WINDOW, SHORT_WINDOW = (12.0, 40.0, 75.0), (5.0, 18.0, 32.0)
#: What the model needs to settle before the window [s].
SETTLE = 0.8
_GAINS = np.geomspace(0.35, 3.5, 11)
_STIFFNESSES = np.geomspace(0.62, 1.4, 8)
#: The slow part: a Gaussian of this width [s] takes the ringing (60 to 80 Hz) out.
_SLOW_WIDTH = 0.008
#: Weight of the slow part: its samples hang together over some 30.
_SLOW_WEIGHT = 1.0 / 30.0
_DAMPINGS = (0.0, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0)


@dataclass(frozen=True, eq=False)
class Duty:
    """The command as the solver takes it: `u`, `slope` at every half step, `every` steps of h [s] to a sample."""

    u: Array
    slope: Array
    h: float
    every: int

    def part(self, first: int, n: int) -> Duty:
        """The command of n samples from `first` on."""
        begin, end = 2 * self.every * first, 2 * self.every * (first + n) + 1
        return Duty(self.u[begin:end], self.slope[begin:end], self.h, self.every)


def duty_of(u: Array, rate: float) -> Duty:
    """A recorded command (n,) [V] between its samples, and its slope; what jumps from one sample to the next ramps."""
    every = int(np.ceil(1.0 / rate / LONGEST_STEP))
    n = u.size
    at = np.arange(2 * every * n + 1) / (2.0 * every)
    fine = np.interp(at, np.arange(n), u)
    h = 1.0 / rate / every
    return Duty(fine, np.gradient(fine, 0.5 * h), h, every)


def differences(
    duty: Duty, thetas: Array, machine: Machine, segment: NDArray[np.int64] | None = None, start: Array | None = None
) -> Array:
    """dp [Pa] (runs, n) of parameter sets `thetas` (runs, 9), or (runs, segments, 9) with `segment` (n,) telling which
    holds at a sample; `start` (runs, 5) is the state at the first sample, at rest by default, and becomes the last."""
    sets = thetas[:, None, :] if thetas.ndim == 2 else thetas
    runs = len(sets)
    n = (duty.u.size - 1) // (2 * duty.every)
    which = np.zeros(n, dtype=np.int64) if segment is None else segment
    found = np.empty((runs, n))
    for first in range(0, runs, RUNS):
        lanes = np.minimum(np.arange(first, first + RUNS), runs - 1)
        table = np.ascontiguousarray(np.moveaxis(sets[lanes], 0, -1))
        state = np.zeros((STATES, RUNS))
        if start is not None:
            state[:] = start[lanes].T
        out = np.empty((n, RUNS))
        pressure_differences(duty.u, duty.slope, duty.h, duty.every, table, which, machine, state, out)
        here = lanes[: min(RUNS, runs - first)]
        found[here] = out.T[: here.size]
        if start is not None:
            start[here] = state.T[: here.size]
    return found


def steps_of(theta: Array) -> Array:
    """Steps (9,) of the forward differences, small against what the data can tell and large against rounding."""
    return np.array(
        [
            1e-3 * theta[GAIN],
            2e-5,
            1e-3 * abs(theta[GAIN]),
            5e-4 * theta[K],
            2e-14,
            1e-3 * theta[F_C] + 0.01,
            1e-3 * abs(theta[F_V]) + 0.1,
            1e-3 * theta[K_BRK],
            3e-3 * theta[C_C] + 1e-3,
        ]
    )


def _sound(theta: Array) -> bool:
    return bool(
        np.all(np.isfinite(theta)) and min(theta[GAIN], theta[K], theta[F_C], theta[C_C]) > 0.0 and theta[K_BRK] > 1.0
    )


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of the record to fit: dp (n,) [Pa] after `settle` samples of command alone, the speed loop's integral
    over the gain at its beginning, noise variance [Pa^2] of a sample; `width` > 0: samples of the Gaussian that takes
    the ringing out."""

    duty: Duty
    dp: Array
    settle: int
    integral: float
    variance: float
    machine: Machine
    width: float = 0.0

    def slow(self, dp: Array) -> Array:
        """The slow part of dp (..., n), its mean taken out."""
        if self.width > 0:
            reach = int(3.0 * self.width)
            taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / self.width) ** 2)
            dp = np.apply_along_axis(np.convolve, -1, dp, taps / taps.sum(), "valid")
        return np.asarray(dp - dp.mean(axis=-1, keepdims=True))

    def runs(self, thetas: Array) -> Array:
        """What the model shows in the window for parameter sets (runs, 9), as `slow` leaves it."""
        start = np.zeros((len(thetas), STATES))
        start[:, 4] = self.integral * thetas[:, GAIN]
        start[:, 2] = 0.9 * self.duty.u[0] * thetas[:, GAIN]
        start[:, 1] = start[:, 2] * self.machine.q_b / (2.0 * np.pi) / self.machine.A
        return self.slow(differences(self.duty, thetas, self.machine, start=start)[:, self.settle :])

    @property
    def weight(self) -> float:
        """What a squared Pa of misfit costs."""
        return (_SLOW_WEIGHT if self.width > 0 else 1.0) / self.variance


@dataclass(frozen=True, eq=False)
class Prior:
    """A normal prior: centre and standard deviation (9,) of each parameter."""

    centre: Array
    deviation: Array

    def cost(self, theta: Array, free: Sequence[int]) -> float:
        """Minus twice its logarithm, but for a constant."""
        off = (theta - self.centre)[list(free)] / self.deviation[list(free)]
        return float(off @ off)


def prior_of(centre: Array) -> Prior:
    """How far a machine may be from the rig that is assumed of it."""
    deviation = np.array([PRIOR.get(k, 0.0) * centre[k] for k in range(len(PARAMETERS))])
    deviation[LEAD], deviation[G], deviation[BIAS] = PRIOR_LEAD, PRIOR_G, 0.1 * centre[GAIN]
    return Prior(centre, deviation)


def _fit(
    window: Window, theta: Array, prior: Prior, free: Sequence[int], most: int, enough: float
) -> tuple[Array, float]:
    """Levenberg-Marquardt over the free parameters: the best set and its cost; `enough`: gain of cost to go on for."""
    free = list(free)
    data = window.slow(window.dp)

    def cost_of(shown: Array, at: Array) -> float:
        return window.weight * float(np.sum((data - shown) ** 2)) + prior.cost(at, free)

    cost = np.inf
    for _ in range(most):
        h = steps_of(theta)
        sets = np.tile(theta, (len(free) + 1, 1))
        for row, k in enumerate(free, 1):
            sets[row, k] += h[k]
        shown = window.runs(sets)
        if not np.all(np.isfinite(shown)):
            return theta, np.inf
        cost = cost_of(shown[0], theta)
        slopes = shown[1:] - shown[0]
        scale = h[free] / prior.deviation[free]
        H = window.weight * (slopes @ slopes.T) + np.diag(scale**2)
        g = window.weight * (slopes @ (data - shown[0])) - (theta - prior.centre)[free] / prior.deviation[free] * scale
        # dampings tried side by side, the best taken
        tries = np.tile(theta, (len(_DAMPINGS), 1))
        for row, factor in enumerate(_DAMPINGS):
            tries[row, free] += np.linalg.solve(H + factor * np.diag(np.diag(H)), g) * h[free]
        sound = [row for row in range(len(_DAMPINGS)) if _sound(tries[row])]
        if not sound:
            break
        costs = [cost_of(one, at) for one, at in zip(window.runs(tries[sound]), tries[sound], strict=True)]
        best = int(np.nanargmin(costs)) if np.any(np.isfinite(costs)) else 0
        if not costs[best] < cost:
            break
        gained, theta, cost = cost - costs[best], tries[sound[best]], costs[best]
        if gained < enough:
            break
    return theta, cost


def fit(window: Window, short: Window, prior: Prior) -> tuple[Array, float, list[Array]]:
    """The parameters (9,) of the best fit, its cost per sample, and other starts for a record that this one does not
    lead through; `short`: part of the window, for the many starts."""
    centre = prior.centre
    slow = Window(
        short.duty, short.dp, short.settle, short.integral, short.variance, short.machine, _SLOW_WIDTH * _rate(short)
    )
    starts = np.tile(centre, (_GAINS.size, 1))
    starts[:, GAIN] *= _GAINS
    data = slow.slow(slow.dp)
    misfit = np.sum((slow.runs(starts) - data) ** 2, axis=1)
    theta, _ = _fit(slow, starts[int(np.nanargmin(misfit))], prior, (GAIN, LEAD, BIAS, F_C, F_V, K_BRK), 12, 1e-2)
    everything = range(len(PARAMETERS))
    tried = []
    for factor in _STIFFNESSES:
        start = theta.copy()
        start[K] = centre[K] * factor
        start, _ = _fit(short, start, prior, (GAIN, LEAD, K, G, F_V), 3, 3.0)
        tried.append(_fit(short, start, prior, everything, 8, 1.0))
    tried.sort(key=lambda one: one[1])
    finalists = [_fit(window, start, prior, everything, 4, 1.0) for start, _ in tried[:2]]
    finalists.sort(key=lambda one: one[1])
    theta, cost = _fit(window, finalists[0][0], prior, everything, 20, 0.1)
    plain = theta.copy()
    plain[[LEAD, BIAS]] = 0.0
    plain[[G, F_C, F_V, K_BRK, C_C]] = centre[[G, F_C, F_V, K_BRK, C_C]]
    return theta, cost / window.dp.size, [finalists[1][0], plain]


def refit(window: Window, start: Array, prior: Prior) -> tuple[Array, float]:
    """The best fit that is reached from another start, and its cost per sample."""
    theta, _ = _fit(window, start, prior, (GAIN, K), 6, 1.0)
    theta, cost = _fit(window, theta, prior, range(len(PARAMETERS)), 20, 0.1)
    return theta, cost / window.dp.size


def _rate(window: Window) -> float:
    return 1.0 / (window.duty.h * window.duty.every)
