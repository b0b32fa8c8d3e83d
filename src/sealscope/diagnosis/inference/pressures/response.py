"""Fit of the response of p_A - p_B to the command in a recording without a position, block by block.

One call of the simulation (`reduced_rig`) gives a whole Jacobian: it simulates in parallel the parameters, and the
parameters with each of them increased in turn. An iterated Kalman filter tracks the parameters from block to block
(`Follower`). All blocks are then fitted together (`fit.Joint`). What
healthy recordings tell of a machine is the prior of the next (`KnownMachine`).
Friction follows Stribeck's law, or LuGre's if Stribeck's does not explain the beginning of the recording and LuGre's
fits better.

Source: B. M. Bell and F. W. Cathey, IEEE Trans. Autom. Control 38 (1993) 294 (iterated filter as Gauss-Newton steps).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from sealscope.diagnosis.estimate.change import Information
from sealscope.diagnosis.inference.pressures.fit import (
    Block,
    Joint,
    Linearisation,
    Normal,
    Priors,
    joint_prior_precision,
    newton_step,
    prior_cost,
    residual_squares,
)
from sealscope.diagnosis.inference.pressures.leak import ResponseLeak, states_flow
from sealscope.diagnosis.inference.pressures.reduced_rig import (
    BRISTLES,
    C_C,
    COMPLIANCE,
    F_C,
    GAIN,
    K_BRK,
    K_OIL,
    LAG,
    LEAD,
    OFFSET,
    PARAMETERS,
    POSITION,
    SCALE,
    SPRING,
    STRIBECK,
    G,
    Machine,
    response_priors,
)
from sealscope.diagnosis.inference.pressures.samples import (
    ResponseSummary,
    block_edges,
    find_unmet_requirement,
    mains_waves,
)
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.physics.lanes import WIDTH
from sealscope.recordings.header import oil_temperature, start_seconds
from sealscope.recordings.recording import Array, Recording, compute_once
from sealscope.signals.recursion import filter_recursively

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_FOLLOW = PRESSURE.follow
#: Parameters that stay positive; minimum compliance of the contact [m/N], and minimum lag that is divided by [s].
_POSITIVE, _MIN = [GAIN, K_OIL, F_C, K_BRK, C_C], 1e-9
#: Maximum number of Gauss-Newton steps of a fit, and minimum expected decrease of -2 log posterior for another step.
_N_STEPS, _MIN_GAIN = 12, 5.0
#: Fractions of a Gauss-Newton step that are tried together.
_FRACTIONS = np.array([1.0, *np.geomspace(0.5, 0.02, 4)])
#: Number of conductances from which the fit to a known machine starts.
_N_CONDUCTANCES = 3
#: Joint fit of all blocks: maximum number of steps; expected decreases of -2 log posterior below which the fit is close
#: to its minimum, and below which it has converged, a small part of its scatter.
_N_JOINT_STEPS, _ROUGHLY, _CONVERGED = 20, 10.0, 1.0
#: Smallest damping of a block, and factors on the damping after a bad step and a good one.
_MIN_DAMPING, _MORE_DAMPING, _LESS_DAMPING = 0.3, 8.0, 0.1
#: A step is bad for a block if its squares exceed the expected ones by half of the expected change, plus this.
_TOLERATED = 0.3


def _geometric_grid(middle: float, factor: float, count: int) -> Array:
    """Return `count` values that are spaced geometrically from `middle` / `factor` to `middle` * `factor`."""
    return np.asarray(middle * np.geomspace(1.0 / factor, factor, count))


def limit_step(stepped: Array, theta: Array) -> Array:
    """Limit parameters (..., p) after one step from `theta` (..., p).

    Parameters that must be positive can at most halve or double. Lag and compliance have lower limits.
    """
    limited = stepped.copy()
    limited[..., _POSITIVE] = np.clip(stepped[..., _POSITIVE], 0.5 * theta[..., _POSITIVE], 2.0 * theta[..., _POSITIVE])
    limited[..., [LAG, COMPLIANCE]] = np.maximum(stepped[..., [LAG, COMPLIANCE]], [0.0, _MIN])
    return limited


def is_explained(cost: float, n_samples: float) -> bool:
    """Return True if the chi-squared `cost` of a fit to n samples is at most n + c sqrt(2 n).

    That is c = `follow.unexplained` (`priors.toml`) standard deviations above the mean of chi-squared.
    """
    return bool(cost <= n_samples + _FOLLOW.unexplained * math.sqrt(2.0 * n_samples))


def noise_variance(recording: Recording) -> float:
    """Estimate the variance of the noise of p_A - p_B [Pa^2], at least 1, as it is a divisor.

    p_A - p_B and p_A + p_B have the same noise but for what the readings share. The smaller estimate is used, since
    p_A - p_B also rings. The squares of the coefficients (1, -3, 3, -1) of a third difference have the sum 20.
    """
    total, difference = recording["p_A"] + recording["p_B"], recording["p_A"] - recording["p_B"]
    return max(float(np.diff([total, difference], 3).var(axis=1).min()) / 20.0, 1.0)


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive samples of a recording that are fitted with one set of parameters.

    - `machine`, `priors`: simulator, and priors of its parameters;
    - `command` (n + 1,): command [V] at the sample before the first, and at each of the n samples;
    - `dp` (n,): recorded p_A - p_B [Pa], with the sign reversed if it falls with the command;
    - `states` (8, 12): states at the sample before the first, as simulated with the parameters (column 0), and with
      each parameter up to `SPRING` increased in turn;
    - `waves` (m, n): waves of the mains hum, which are projected out; `wave_gram_inverse` (m, m): pseudo-inverse of
      their Gram matrix;
    - `sample_weights` (n,): 0 for samples that are missing or recorded while the drive settles, otherwise 1;
    - `smooth`: width [samples] of a Gaussian that smooths the residual.
    """

    machine: Machine
    priors: Priors
    command: Array
    dp: Array
    states: Array
    waves: Array
    wave_gram_inverse: Array
    sample_weights: Array
    smooth: float = 0.0

    @cached_property
    def n_samples(self) -> float:
        """Number of samples with a weight above zero."""
        return float(np.count_nonzero(self.sample_weights))

    def _project_on_waves(self, rows: Array) -> tuple[Array, Array, Array]:
        """Smooth rows (m, n), set samples without a weight to 0, and fit k waves of mains hum to each row.

        Returns the rows, which may overwrite the argument, and their products with the waves and the waves' amplitudes,
        (m, k) each.
        """
        rows = gaussian_filter1d(rows, self.smooth) if self.smooth > 0.0 else rows
        if self.n_samples < rows.shape[1]:
            rows *= self.sample_weights
        products = rows @ self.waves.T
        return rows, products, products @ self.wave_gram_inverse

    def residual_squares(self, sets: Array) -> Array:
        """Compute the residual sums of squares (m,) of p_A - p_B [Pa^2] for each of up to 16 parameter sets (m, p).

        The mean of the residual and the mains hum are removed. The result is infinite if a simulation diverges.
        """
        states = self.states[:, np.zeros(len(sets), dtype=int)]  # each set starts from the state in column 0
        simulated, _ = self.machine.simulate(self.command, sets, states)
        difference, _, amplitudes = self._project_on_waves(self.dp - sets[:, SCALE, None] * simulated)
        squares = self.dp.size * np.var(difference - amplitudes @ self.waves, axis=1)  # without the hum
        return np.asarray(np.nan_to_num(squares, nan=np.inf))

    def linearise(self, sets: Array) -> Linearisation:
        """Linearise the model dp = scale * simulated response + offset about the first of up to 5 sets (m, p).

        The derivatives are per unit of `priors.unit`. The other sets are simulated only for their residual sums of
        squares, `squares` of the result.
        """
        theta, n_sets = sets[0], len(sets)
        n_slopes = SPRING + 1  # the derivatives by the first parameters, up to SPRING, are simulated
        # simulated together, in up to 16 lanes: theta, theta with each parameter up to SPRING increased by a unit, and
        # the other sets
        simulated = np.concatenate([sets[:1], np.tile(theta, (n_slopes, 1)), sets[1:]])
        simulated[range(1, n_slopes + 1), range(n_slopes)] += self.priors.unit[:n_slopes]
        states = self.states[:, [*range(n_slopes + 1), *[0] * (n_sets - 1)]]  # column 0 for the other sets
        responses, ends = self.machine.simulate(self.command, simulated, states)
        n_rows = 1 + len(PARAMETERS)  # residual and derivatives; after these come the residuals of the other sets
        rows = np.empty((n_rows + n_sets - 1, self.dp.size))
        rows[0] = self.dp - theta[SCALE] * responses[0] - theta[OFFSET]
        rows[1 : n_slopes + 1] = theta[SCALE] * (responses[1 : n_slopes + 1] - responses[0])
        rows[1 + LEAD : 1 + OFFSET] = self._analytic_slopes(theta, responses[0])
        rows[1 + OFFSET] = self.priors.unit[OFFSET]
        rows[n_rows:] = self.dp - sets[1:, SCALE, None] * responses[n_slopes + 1 :] - sets[1:, OFFSET, None]
        rows, products, amplitudes = self._project_on_waves(rows)
        gram = rows @ rows.T - amplitudes @ products.T  # without the mains waves
        squares = np.diag(gram)[[0, *range(n_rows, len(rows))]]
        return Linearisation(
            theta, gram[:n_rows, :n_rows], rows[:n_rows], amplitudes[:n_rows], ends[:, : n_slopes + 1], squares
        )

    def _analytic_slopes(self, theta: Array, response: Array) -> Array:
        """Compute the derivatives (3, n) of scale * response by lead, lag and scale, per unit of `priors.unit`.

        `theta` (p,): all parameters; `response` (n,): simulated p_A - p_B [Pa].
        """
        change = np.empty(len(response))  # central differences, at the ends one-sided
        change[1:-1] = 0.5 * (response[2:] - response[:-2])
        change[0], change[-1] = response[1] - response[0], response[-1] - response[-2]
        # accurate to fourth order, since the ringing is fast
        change[1:-1] -= (change[2:] - 2.0 * change[1:-1] + change[:-2]) / 6.0
        by_lead = theta[SCALE] * self.machine.rate * change  # time derivative of the reading
        decay = math.exp(-1.0 / (self.machine.rate * max(theta[LAG], _MIN)))
        by_lag = filter_recursively(by_lead, decay, decay - 1.0)  # first-order low pass of -by_lead
        return np.array([by_lead, by_lag, response]) * self.priors.unit[LEAD:OFFSET, None]

    def descend(self, fit: Linearisation, prior: Normal, n_steps: int, noise: float | None = None) -> Linearisation:
        """Fit the parameters by up to `n_steps` Gauss-Newton steps, and return the linearisation at the best fit.

        `fit`: linearisation at the start. The steps minimise -2 log posterior under a `prior`, with Levenberg-Marquardt
        damping. `noise`: variance of the noise [Pa^2], None to estimate it from the residual. Fractions of each step
        are simulated together with the Jacobian at the full step; if none is an improvement, the step is damped.
        """
        damping = 0.0
        for _ in range(n_steps):
            variance = noise or self.residual_variance(float(fit.squares[0]))
            hessian, gradient = fit.newton_terms(variance, prior)
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            if not float(gradient @ step) >= _MIN_GAIN:
                break
            sets = limit_step(fit.theta + _FRACTIONS[:, None] * step * prior.unit, fit.theta)
            full_step, deviations = self.linearise(sets), prior.deviations(sets)
            # -2 log posterior after each fraction of the step, (5,)
            costs = full_step.squares / variance + np.sum(deviations @ prior.precision * deviations, axis=1)
            gains = np.nan_to_num(fit.cost(variance, prior) - costs, nan=-np.inf)
            best = int(np.argmax(gains))
            if not gains[best] > 0.0:
                damping = max(10.0 * damping, 0.1)
                continue
            damping = 0.1 * damping if damping > 1e-3 else 0.0
            fit = full_step if best == 0 else self.linearise(sets[best : best + 1])
        return fit

    def residual_variance(self, squares: float) -> float:
        """Compute the variance of a residual [Pa^2] from its sum of squares and the number of independent samples.

        Smoothing by a Gaussian of width sigma [samples] correlates the noise over 2 sqrt(pi) sigma samples.
        """
        count = max(self.n_samples - len(PARAMETERS), 1.0)
        # a sum of at least 1 Pa^2, since the variance is a divisor elsewhere
        return max(squares, 1.0) / count * max(1.0, 2.0 * math.sqrt(math.pi) * self.smooth)

    def block_sums(self, fit: Linearisation) -> Block:
        """Reduce a linearised fit of these samples to sums of products; the scores are those of G for each second."""
        slope = fit.rows[1 + G] - fit.amplitudes[1 + G] @ self.waves  # without the hum
        length, scores = round(self.machine.rate), list[Array]()
        for first in range(0, self.dp.size, length):  # first sample of each second
            second = slice(first, first + length)
            by_waves = fit.amplitudes @ (self.waves[:, second] @ slope[second])
            scores.append(fit.rows[:, second] @ slope[second] - by_waves)
        return Block(fit.theta, fit.gram, self.n_samples, np.array(scores))


def _prepare_hum(block: Recording, n_settling: int) -> tuple[Array, Array, Array]:
    """Compute waves, the inverse of their Gram matrix, and the samples' weights for a `Segment`.

    The first `n_settling` samples have no weight.
    """
    sample_weights = np.ones(len(block)) if block.bridged is None else (~block.bridged).astype(float)
    sample_weights[:n_settling] = 0.0
    # hum has the same sign in both pressures, so that its frequencies show best in their sum
    waves = mains_waves(block["p_A"] + block["p_B"], block.rate) * sample_weights
    gram_inverse = np.linalg.pinv(waves @ waves.T, hermitian=True)
    return waves, np.asarray(gram_inverse), sample_weights


def fit_from_priors(segment: Segment, total: Array, noise: float) -> Linearisation:
    """Fit the parameters to a first segment of samples, without parameters from an earlier fit.

    The ringing causes many local minima. Therefore the slow part of p_A - p_B is fitted first, from the best of several
    gains and stiffnesses of the load. Then all of it is fitted from several breakaway forces and several stiffnesses of
    the oil, two of which follow from the strongest ringing. `total` (n,): p_A + p_B [Pa]; `noise`: variance of the
    noise [Pa^2].
    """
    priors = segment.priors

    def rank_starts(section: Segment, theta: Array, n_groups: int, values: dict[int, Array]) -> Array:
        """Sort 16 variants of the parameters `theta` (p,) by their fit, within `n_groups` groups of consecutive ones.

        `values` maps the index of a varied parameter to its value in each variant (16,). The result has the shape
        (16/n_groups, n_groups, p), the best of each group first.
        """
        sets = np.tile(theta, (WIDTH, 1))
        for parameter, column in values.items():
            sets[:, parameter] = column
        order = section.residual_squares(sets).reshape(n_groups, -1).argsort(axis=1).T
        return sets.reshape(n_groups, -1, len(PARAMETERS))[range(n_groups), order]

    slow_part = replace(segment, smooth=_FOLLOW.slow * segment.machine.ringing_period(priors.centre[K_OIL]))
    gains = priors.centre[GAIN] * _geometric_grid(*PRESSURE.start["gain"], count=8)
    springs = priors.centre[SPRING] + priors.width[SPRING] * np.array([0.0, 1.0])
    variants = {GAIN: np.tile(gains, 2), SPRING: np.repeat(springs, 8)}  # all 16 combinations
    best_start, *_ = rank_starts(slow_part, priors.centre, n_groups=1, values=variants)  # (1, p)
    theta = slow_part.descend(slow_part.linearise(best_start), priors.normal, _N_STEPS // 2).theta
    ringing = segment.machine.ringing_stiffnesses(segment.dp, total, priors)
    stiffnesses = np.append(ringing, priors.centre[K_OIL] * _geometric_grid(*PRESSURE.start["K"], count=2))  # (4,)
    breakaways = theta[K_BRK] * _geometric_grid(*PRESSURE.start["K_brk"], count=4)
    variants = {K_OIL: np.repeat(stiffnesses, 4), K_BRK: np.tile(breakaways, 4)}
    # one group for each stiffness of the oil: its best and its second-best breakaway force, (4, p) each
    best_starts, second_best_starts, *_ = rank_starts(segment, theta, n_groups=4, values=variants)
    fit = fit_from_starts(segment, best_starts, noise, n_best=2)
    further_starts = [priors.centre]
    if not is_explained(fit.cost(noise, priors.normal), segment.n_samples):
        further_starts += [*second_best_starts]
    return fit_from_starts(segment, [fit.theta, *further_starts], noise, n_best=2)


def fit_from_conductances(segment: Segment, noise: float) -> Linearisation:
    """Fit the parameters to a first segment of samples of a known machine, of which only the leakage is not known.

    The fit starts from the best of several conductances. `noise`: variance of the noise [Pa^2].
    """
    sets = np.tile(segment.priors.centre, (WIDTH, 1))
    sets[1:, G] = _geometric_grid(*PRESSURE.jump["G"], count=WIDTH - 1)
    best_starts = sets[segment.residual_squares(sets).argsort()[:_N_CONDUCTANCES]]
    return fit_from_starts(segment, best_starts, noise, n_best=2)


def fit_from_starts(segment: Segment, starts: Sequence[Array] | Array, noise: float, n_best: int) -> Linearisation:
    """Fit the parameters to the samples `segment` from several starts (s, p), and return the best fit.

    A few Gauss-Newton steps from all starts are followed by more from the `n_best` best. `noise`: variance [Pa^2].
    """
    fits, prior = [segment.linearise(start[None]) for start in starts], segment.priors.normal
    for n_steps, n_kept in ((_N_STEPS // 6, n_best), (_N_STEPS, 1)):
        fits = [segment.descend(fit, prior, n_steps, noise) for fit in fits]
        costs = np.nan_to_num([fit.cost(noise, prior) for fit in fits], nan=np.inf)
        fits = [fits[index] for index in np.argsort(costs)[:n_kept]]
    return fits[0]


class KnownMachine(NamedTuple):
    """A machine known by healthy recordings: law of friction (`reduced_rig.LAWS`), priors of a further recording."""

    law: str
    priors: Priors


class Follower:
    """Iterated Kalman filter that tracks the parameters of the pressure response from block to block.

    `rig`: assumed machine; `rate`: sampling rate [Hz]; `sense`: 1 if p_A - p_B rises with the command, else -1; `law`:
    law of friction, one of `reduced_rig.LAWS`; `priors`: priors of the parameters, None for those of the rig.
    """

    def __init__(self, rig: Rig, rate: float, sense: float, law: str = STRIBECK, priors: Priors | None = None) -> None:
        self.machine, self.sense = Machine.from_rig(rig, rate, law), sense
        self.priors = response_priors(rig, law) if priors is None else priors
        self.theta = self.priors.centre  # parameters (p,)
        self.covariance = self.priors.covariance  # covariance of the parameters, in units of `priors.unit`
        self.variance = math.nan  # variance of the noise [Pa^2]
        self.states = np.zeros((8, SPRING + 2))  # simulated states of all simulated parameter sets, as in `Segment`
        self.last = math.nan  # command at the last sample [V], NaN at the start and after a gap

    @staticmethod
    def fit_start(
        recording: Recording, rig: Rig, known: KnownMachine | None = None, *, is_healthy: bool = False
    ) -> Follower:
        """Start a filter with parameters that are fitted to the beginning of a recording.

        `rig`: assumed machine, which gives sizes and priors; `known`: law of friction and priors of a known machine, or
        None, for the priors of the rig (`is_healthy`: of a healthy machine), and a law that is chosen as the module
        states.
        """
        u, dp = recording["u"], recording["p_A"] - recording["p_B"]
        # 1 if a positive command raises p_A - p_B or has no effect, -1 if it lowers it
        sense = float(np.sign(np.mean(u * (dp - dp.mean())))) or 1.0
        beginning = recording.samples(slice(0, math.ceil(_FOLLOW.window * recording.rate)))
        noise = noise_variance(beginning)
        law, priors = known or (STRIBECK, response_priors(rig, is_healthy=is_healthy))
        follower = Follower(rig, recording.rate, sense, law, priors)
        segment = follower.next_segment(beginning)
        if known is not None:
            fit = fit_from_conductances(segment, noise)
            follower.theta, follower.variance = fit.theta, segment.residual_variance(float(fit.squares[0]))
            follower._converge_on_beginning(recording)
            return follower
        fit = fit_from_priors(segment, beginning["p_A"] + beginning["p_B"], noise)
        cost = fit.cost(noise, follower.priors.normal)
        if not is_explained(cost, segment.n_samples):  # try LuGre's friction in place of Stribeck's
            priors = response_priors(rig, BRISTLES, is_healthy=is_healthy)
            bristles = Follower(rig, recording.rate, sense, BRISTLES, priors)
            starts = np.array([fit.theta, bristles.priors.centre])
            # the fit with Stribeck's friction says nothing about the compliance
            starts[:, COMPLIANCE] = bristles.priors.centre[COMPLIANCE]
            bristles_fit = fit_from_starts(bristles.next_segment(beginning), starts, noise, n_best=1)
            if bristles_fit.cost(noise, bristles.priors.normal) < cost:
                follower, fit = bristles, bristles_fit
        follower.theta, follower.variance = fit.theta, segment.residual_variance(float(fit.squares[0]))
        follower._converge_on_beginning(recording)
        # the filter lets the conductance wander as far as a leak takes it, be it into a wrong minimum: a faster pump
        # that feeds a leak fits nearly as well
        if follower.theta[G] > follower.priors.centre[G] + follower.priors.width[G]:
            follower.theta = fit.theta
        return follower

    def _converge_on_beginning(self, recording: Recording) -> None:
        """Refine the parameters by filtering the beginning of a recording, then return to its first sample.

        Covariance and simulated states are reset, since the same samples are filtered again.
        """
        covariance, states = self.covariance, self.states
        length = round(_FOLLOW.block * recording.rate)
        # blocks that begin before `stop` lie within the recording
        stop = min(round(_FOLLOW.beginning * recording.rate), len(recording) - length + 1)
        for first in range(0, stop, length):
            self.update(recording.samples(slice(first, first + length)))
        self.covariance, self.states, self.last = covariance, states, math.nan

    def next_segment(self, block: Recording) -> Segment:
        """Prepare the samples of the next block for a fit; at the start or after a gap, change `last` and `states`.

        The stroke is then centred, and samples have no weight until the drive has settled.
        """
        u, n_settling = block["u"], 0
        if math.isnan(self.last):
            self.last, self.states = float(u[0]), self.states.copy()
            self.states[POSITION] = self.machine.centred_start(u * self.theta[GAIN])
            n_settling = round(_FOLLOW.settling * block.rate)
        # a fit simulates each block many times
        waves, gram_inverse, sample_weights = compute_once(
            block, ("mains hum", n_settling), lambda samples: _prepare_hum(samples, n_settling)
        )
        dp = self.sense * (block["p_A"] - block["p_B"])
        return Segment(
            self.machine,
            self.priors,
            command=np.append(self.last, u),
            dp=dp,
            states=self.states,
            waves=waves,
            wave_gram_inverse=gram_inverse,
            sample_weights=sample_weights,
        )

    def _prior(self, block_s: float, jumped: int | None = None) -> Normal:
        """Compute the prior on the parameters in the next block, of `block_s` [s].

        The parameter with the index `jumped` may have jumped: its variance increases by its whole prior variance.
        """
        variance = self.priors.wander_variance(block_s)
        if jumped is not None:
            variance[jumped] += self.priors.variance[jumped]
        return Normal(self.theta, np.asarray(np.linalg.inv(self.covariance + np.diag(variance))), self.priors.unit)

    def _fit_block(self, segment: Segment, block_s: float) -> tuple[Linearisation, Normal]:
        """Fit the parameters to the next block of samples, of `block_s` [s]; return the fit and the prior that it used.

        If slow variations of the parameters do not explain the block, fits with a jump of the conductance or of the
        oil's stiffness are tried as well, and the one with the highest posterior density is returned.
        """

        def fit_candidate(start: Array, prior: Normal) -> tuple[float, Linearisation, Normal]:
            """Fit the block from parameters `start` (p,); return -2 log posterior, the fit and its prior."""
            fit = segment.descend(segment.linearise(start[None]), prior, _N_STEPS, self.variance)
            return fit.cost(self.variance, prior), fit, prior

        candidates = [fit_candidate(self.theta, self._prior(block_s))]
        if not is_explained(candidates[0][0], segment.n_samples):
            # the grid of the conductance after a jump is absolute, that of the stiffness relative to the current one
            for parameter, unit, jump in ((G, 1.0, PRESSURE.jump["G"]), (K_OIL, self.theta[K_OIL], PRESSURE.jump["K"])):
                sets = np.tile(self.theta, (WIDTH, 1))
                sets[:, parameter] = unit * _geometric_grid(*jump, count=WIDTH)
                best = int(segment.residual_squares(sets).argmin())
                candidates.append(fit_candidate(sets[best], self._prior(block_s, jumped=parameter)))
        _, fit, prior = min(candidates, key=lambda candidate: candidate[0])
        return fit, prior

    def update(self, block: Recording) -> Block:
        """Fit the parameters to the next block of samples, and return the block's sums for a joint fit of all blocks.

        The prior of the fit is the estimate from the earlier blocks; that from this block replaces it.
        """
        segment = self.next_segment(block)
        fit, prior = self._fit_block(segment, block.duration)
        hessian, gradient = fit.newton_terms(self.variance, prior)
        self.covariance = np.asarray(np.linalg.inv(hessian))
        # one more Gauss-Newton step, which needs no simulation
        self.theta = limit_step(fit.theta + self.covariance @ gradient * prior.unit, fit.theta)
        self.states, self.last = fit.ends, float(block["u"][-1])
        return segment.block_sums(fit)

    def linearise(self, block: Recording, theta: Array) -> Block:
        """Linearise the model of the next block of samples about parameters `theta` (p,), without a fit."""
        self.theta = theta
        segment = self.next_segment(block)
        fit = segment.linearise(theta[None])
        self.states, self.last = fit.ends, float(block["u"][-1])
        return segment.block_sums(fit)


def fit_jointly(follower: Follower, blocks: Sequence[Recording], starts: Iterable[Array], noise: float) -> Joint:
    """Fit the parameters in all K consecutive blocks of a recording together.

    `follower`: filter at the first sample; `noise`: variance of the noise [Pa^2]. From each of the `starts`, parameters
    (K, p), -2 log posterior is minimised by Gauss-Newton steps, until a fit explains the recording but for its noise;
    the noise is white at first, and then inflated by the correlation of the residual (`Joint.noise`). The model is
    nonlinear in some blocks: a block is damped in which the residual's squares decrease less than expected
    (Levenberg-Marquardt). Returns the best fit; raises LinAlgError if there is none.
    """
    states, priors = follower.states, follower.priors
    seconds = float(np.mean([block.duration for block in blocks]))
    prior_precision = joint_prior_precision(len(blocks), priors, seconds)

    def linearise(theta: Array, variance: float, max_cost: float = math.inf) -> tuple[list[Block], float]:
        """Simulate all blocks with the parameters `theta` (K, p); return their sums, and -2 log posterior of `theta`.

        `variance`: that of the noise [Pa^2]. The simulation ends as soon as -2 log posterior exceeds `max_cost`; the
        sums are then those of the first blocks.
        """
        follower.states, follower.last = states, math.nan
        cost, sums = prior_cost(theta, priors, prior_precision), list[Block]()
        for block, row in zip(blocks, theta, strict=True):
            if not cost <= max_cost:
                break
            sums.append(follower.linearise(block, row))
            cost += sums[-1].square / variance
        return sums, cost

    def converge(sums: list[Block], damping: Array, variance: float, least_gain: float) -> list[Block]:
        """Minimise -2 log posterior, from the `sums` over the blocks, until a step gains less than `least_gain`.

        `damping` (K,), that of each block, is changed in place.
        """
        cost = posterior_cost(sums, variance)
        for _ in range(_N_JOINT_STEPS):
            step, gain = newton_step(sums, priors, prior_precision, variance, damping)
            if not gain >= least_gain:
                break
            theta = np.array([block.theta for block in sums])
            stepped = limit_step(theta + step * priors.unit, theta)
            new_sums, new_cost = linearise(stepped, variance, max_cost=cost)
            is_bad, is_good = np.ones(len(blocks), dtype=bool), np.zeros(len(blocks), dtype=bool)
            if len(new_sums) == len(blocks):
                before, after = (
                    np.array([block.square for block in blocks_sums]) / variance for blocks_sums in (sums, new_sums)
                )
                expected = residual_squares(sums, (stepped - theta) / priors.unit) / variance
                is_bad = after - expected > 0.5 * np.abs(before - expected) + _TOLERATED
                is_good = after - expected < 0.2 * np.abs(before - expected) + 0.3 * _TOLERATED
            if new_cost < cost:
                sums, cost = new_sums, new_cost
            elif is_good.all():  # the decrease is too small for the simulation's rounding
                break
            else:  # a block may also fit worse by the state that an earlier one leaves
                is_bad, is_good = ~is_good, np.zeros(len(blocks), dtype=bool)
            damping[is_bad] = np.maximum(_MORE_DAMPING * damping[is_bad], _MIN_DAMPING)
            damping[is_good] *= _LESS_DAMPING
            damping[damping < _LESS_DAMPING * _MIN_DAMPING] = 0.0
        return sums

    def posterior_cost(sums: Sequence[Block], variance: float) -> float:
        """Compute -2 log posterior of the parameters of all blocks for a `variance` of the noise [Pa^2]."""
        theta = np.array([block.theta for block in sums])
        return prior_cost(theta, priors, prior_precision) + sum(block.square for block in sums) / variance

    best_cost, best = math.inf, None
    for start in starts:
        try:
            sums, cost = linearise(start, noise)
            if not math.isfinite(cost):
                continue
            damping = np.full(len(blocks), _MIN_DAMPING)  # the first full step nearly always goes too far
            sums = converge(sums, damping, noise, _ROUGHLY)
            correlated_noise = Joint.fit(sums, priors, prior_precision, G).noise
            joint = Joint.fit(converge(sums, damping, correlated_noise, _CONVERGED), priors, prior_precision, G)
        except np.linalg.LinAlgError:
            continue
        cost = posterior_cost(sums, noise)
        if cost < best_cost:
            best_cost, best = cost, joint
        if is_explained(best_cost, sum(block.samples for block in sums)):
            break
    if best is None:
        raise np.linalg.LinAlgError("no start leads to a fit")
    return best


class Fit(NamedTuple):
    """Joint fit of the response in a recording, and its law of friction."""

    joint: Joint
    law: str


def fit_response(
    recording: Recording, rig: Rig, known: KnownMachine | None = None, *, is_healthy: bool = False
) -> Fit | None:
    """Fit the response of p_A and p_B to the command in a recording; None if no parameters describe it.

    `recording` must meet the requirements (`find_unmet_requirement`). `rig`: assumed machine; `known`: a known machine,
    None to fit it once by the priors of the rig; `is_healthy`: true if the machine is known to be healthy.
    """

    def starts(follower: Follower, blocks: Sequence[Recording]) -> Iterator[Array]:
        """Yield parameters (K, p) that the fit starts from.

        They are those with which the filter begins, those that it tracks through the blocks, as a leak may begin, and
        for a known machine those that describe the recording by itself.
        """
        begin = copy(follower)
        yield np.tile(begin.theta, (len(blocks), 1))
        yield np.array([begin.update(block).theta for block in blocks])
        by_itself = fit_response(recording, rig) if known is not None else None
        if by_itself is not None and by_itself.law == follower.machine.law:
            yield limit_step(by_itself.joint.fitted, by_itself.joint.theta)

    def compute_fit(recording: Recording) -> Fit | None:
        """Fit all blocks together; None if that fails or explains little."""
        edges = block_edges(recording).tolist()
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                follower = Follower.fit_start(recording, rig, known, is_healthy=is_healthy)
                blocks = [recording.samples(slice(first, end)) for first, end in pairwise(edges)]
                joint = fit_jointly(follower, blocks, starts(follower, blocks), noise_variance(recording))
            except np.linalg.LinAlgError:
                return None
        is_finite = np.all(np.isfinite(joint.mean)) and np.all(np.isfinite(joint.covariance))
        # within blocks, since the sensor offset follows what changes from block to block, whatever it is
        variance_in_blocks = np.mean([np.var(block["p_A"] - block["p_B"]) for block in blocks])
        describes = is_finite and joint.variance < _FOLLOW.explained * variance_in_blocks
        return Fit(joint, follower.machine.law) if describes else None

    if known is not None:
        return compute_fit(recording)
    return compute_once(recording, ("response", rig, is_healthy), compute_fit, ("u", "p_A", "p_B"))


def measure_leak(
    recording: Recording, rig: Rig, healthy: Sequence[ResponseSummary] = (), *, is_healthy: bool = False
) -> ResponseLeak | None:
    """Measure the leakage of a recording by the response of its pressures.

    `healthy`: healthy recordings of the machine, which tell all of it but the leakage; `is_healthy`: true if this
    recording is one of these. Return None if a requirement is not met (`find_unmet_requirement`), or if no parameters
    describe the response.
    """
    if find_unmet_requirement(recording, rig) is not None:
        return None
    fit = None
    if healthy:
        law, _ = Counter(response.law for response in healthy).most_common(1)[0]
        healthy = [response for response in healthy if response.law == law]
        priors = response_priors(rig, law).condition_on([response.sums[0] for response in healthy], G)
        priors = replace(priors, centre=limit_step(priors.centre, priors.centre))
        fit = fit_response(recording, rig, KnownMachine(law, priors))
    if fit is None:  # no healthy recordings, or the recording is like none of them
        fit, healthy = fit_response(recording, rig, is_healthy=is_healthy), ()
    if fit is None:
        return None
    joint, law = fit
    edges, dp = block_edges(recording), np.abs(recording["p_A"] - recording["p_B"])
    middles = recording.t[0] + 0.5 * (edges[1:] + edges[:-1]) / recording.rate
    parameters = parameter_information(joint, middles, recording.duration)
    pressure = np.add.reduceat(dp, edges[:-1]) / np.diff(edges)
    mean_speed = rig.motor.omega_per_volt * float(np.mean(np.abs(recording["u"])))
    step = PRESSURE.conductance.wander * math.sqrt(recording.duration / len(middles) / PRESSURE.blocks.wander)
    conditions = ResponseSummary(
        joint.sums(G, step)[None],
        law=law,
        flow=mean_speed * rig.pump.q_b / (2.0 * np.pi),
        pressure=float(pressure.mean()),
        start_s=start_seconds(recording),
        oil_degC=oil_temperature(recording),
    )
    priors = response_priors(rig, law)
    return ResponseLeak(parameters, pressure, conditions, priors=priors, stated=states_flow(rig), healthy=healthy)


def parameter_information(joint: Joint, time: Array, seconds: float) -> dict[str, Information]:
    """Compute the likelihood of each parameter in K blocks, by the parameter's name, from the joint fit of all blocks.

    Each comes with the scale of the priors on a linear change and on a random walk: the standard deviation that a walk
    reaches over the recording (for the leakage conductance G that of a healthy machine). `time` (K,): middles of the
    blocks [s]; `seconds`: duration recorded [s].
    """
    # `Priors.wander` is reached within the time `blocks.wander`; a random walk grows with the root of the time
    growth = math.sqrt(seconds / PRESSURE.blocks.wander)
    deviations = growth * joint.priors.wander
    deviations[G] = growth * PRESSURE.conductance.wander
    return {name: joint.information(k, time, float(deviations[k])) for k, name in enumerate(PARAMETERS)}
