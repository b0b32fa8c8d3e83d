"""Response of p_A - p_B to the command, linearised block by block, without a position.

All lanes of a call of the kernel of `reduced_rig` are one Jacobian: the parameters, and the parameters with each
increased in turn; their states continue from block to block. An iterated Kalman filter leads from block to block
(`Follower`), live and over a recording alike; over a recording all blocks are then fitted together (`fit.Joint`). The
law of friction is the likelier one at the beginning.

The result is the factor p(pressures | command) of the likelihood; a balance of position and angle is conditional on p_A
and p_B, so that the two may be multiplied.

Source: B. M. Bell and F. W. Cathey, IEEE Trans. Autom. Control 38 (1993) 294 (iterated filter as Gauss-Newton steps).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg.lapack import dtbtrs
from scipy.ndimage import gaussian_filter1d

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.pressures.fit import Block, Joint, Linearisation, Normal, Priors
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
    G,
    Machine,
    response_priors,
)
from sealscope.diagnosis.inference.pressures.samples import block_edges, find_unmet_requirement, mains_waves
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.physics.lanes import SINGLE_WIDTH
from sealscope.recordings.recording import Array, Recording, compute_once

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_FOLLOW = PRESSURE.follow
#: Parameters that stay positive; minimum compliance of the contact [m/N] and lag [s].
_POSITIVE, _MIN = [GAIN, K_OIL, F_C, K_BRK, C_C], 1e-9
#: Gauss-Newton steps of a fit, fractions of a step that are tried together, and minimum gain of -2 log posterior for
#: which another simulation is run.
_N_STEPS, _FRACTIONS, _MIN_GAIN = 12, np.array([1.0, *np.geomspace(0.5, 0.02, 4)]), 5.0


def _geometric_grid(middle: float, factor: float, count: int) -> Array:
    """Space `count` starting values geometrically from `middle` / `factor` to `middle` * `factor`."""
    return np.asarray(middle * np.geomspace(1.0 / factor, factor, count))


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive samples that are fitted with one set of parameters.

    `command` (n + 1,) [V] with that of the previous sample; `dp` (n,) [Pa]; `states` (8, 12): simulated at the
    previous sample, with the parameters and with each perturbed set; `waves` (m, n): mains waves, which are projected
    out; `sample_weights` (n,): 1 for a recorded sample, 0 for a missing one. `smooth` [samples] > 0: width of a
    Gaussian that smooths the residual before it is fitted.
    """

    machine: Machine
    priors: Priors
    command: Array
    dp: Array
    states: Array
    waves: Array
    sample_weights: Array
    smooth: float = 0.0

    @cached_property
    def n_samples(self) -> float:
        """Number of known samples."""
        return float(np.count_nonzero(self.sample_weights))

    @cached_property
    def _wave_gram_inverse(self) -> Array:
        """Pseudo-inverse of the Gram matrix of the waves."""
        return np.asarray(np.linalg.pinv(self.waves @ self.waves.T, hermitian=True))

    def _project_on_waves(self, rows: Array) -> tuple[Array, Array, Array]:
        """Smooth and mask rows (m, n); return them, their products (m, k) with the mains waves, and wave amplitudes."""
        rows = gaussian_filter1d(rows, self.smooth) if self.smooth > 0.0 else rows
        if self.n_samples < rows.shape[1]:
            rows *= self.sample_weights
        products = rows @ self.waves.T
        return rows, products, products @ self._wave_gram_inverse

    def residual_squares(self, sets: Array) -> Array:
        """Compute the residual sums of squares (m,) [Pa^2], about the mean, of up to 16 parameter sets (m, p)."""
        simulated, _ = self.machine.simulate(self.command, sets, self.states[:, np.zeros(len(sets), dtype=int)])
        residual, _, amplitudes = self._project_on_waves(self.dp - sets[:, SCALE, None] * simulated)
        squares = self.dp.size * np.var(residual - amplitudes @ self.waves, axis=1)
        return np.asarray(np.nan_to_num(squares, nan=np.inf))

    def linearise(self, sets: Array) -> Linearisation:
        """Linearise about the first of up to 5 parameter sets (m, p), and compute the residual squares of all.

        The residual is dp - scale * simulated response - offset. Rows: the residual by the first set, its slopes (with
        the sign of the response) by a unit of each parameter, and the residuals by the other sets.
        """
        theta, n_sets, n_slopes = sets[0], len(sets), SPRING + 1
        # simulated together: theta, theta with each parameter up to SPRING increased by a unit, and the other sets
        simulated = np.concatenate([sets[:1], np.tile(theta, (n_slopes, 1)), sets[1:]])
        simulated[range(1, n_slopes + 1), range(n_slopes)] += self.priors.unit[:n_slopes]
        states = self.states[:, [*range(n_slopes + 1), *[0] * (n_sets - 1)]]
        responses, ends = self.machine.simulate(self.command, simulated, states)
        n_rows = 1 + len(PARAMETERS)  # of the linearisation: residual and slopes; then residuals of the other sets
        rows = np.empty((n_rows + n_sets - 1, self.dp.size))
        rows[0] = self.dp - theta[SCALE] * responses[0] - theta[OFFSET]
        rows[1 : n_slopes + 1] = theta[SCALE] * (responses[1 : n_slopes + 1] - responses[0])
        rows[1 + LEAD : 1 + OFFSET] = self._analytic_slopes(theta, responses[0])
        rows[1 + OFFSET] = self.priors.unit[OFFSET]
        rows[n_rows:] = self.dp - sets[1:, SCALE, None] * responses[n_slopes + 1 :] - sets[1:, OFFSET, None]
        rows, products, amplitudes = self._project_on_waves(rows)
        gram = rows @ rows.T - amplitudes @ products.T  # without the mains waves
        squares = np.diag(gram)[[0, *range(n_rows, len(rows))]]
        return Linearisation(theta, gram[:n_rows, :n_rows], rows[:n_rows], ends[:, : n_slopes + 1], squares)

    def _analytic_slopes(self, theta: Array, response: Array) -> Array:
        """Compute the slopes (3, n) of lead, lag and scale from the simulated p_A - p_B (n,).

        They need no further simulation.
        """
        change = np.asarray(np.gradient(response))
        change[1:-1] -= np.diff(change, 2) / 6.0  # to fourth order, since the ringing is fast
        by_lead = theta[SCALE] * self.machine.rate * change
        decay = math.exp(-1.0 / (self.machine.rate * max(theta[LAG], _MIN)))
        # first-order low pass of -by_lead, as the solution of a bidiagonal system
        by_lag = dtbtrs(np.tile([[1.0], [-decay]], by_lead.size), (decay - 1.0) * by_lead, uplo="L")[0]
        return np.array([by_lead, by_lag, response]) * self.priors.unit[LEAD:OFFSET, None]

    def descend(self, fit: Linearisation, prior: Normal, n_steps: int, noise: float | None = None) -> Linearisation:
        """Minimise -2 log posterior by Gauss-Newton steps with Levenberg-Marquardt damping from a linearisation.

        `noise`: its variance [Pa^2], None to estimate it from the residual. Fractions of each step are simulated
        together with the Jacobian at the full step; if none gains, the step is damped. A step with a smaller expected
        gain than `_MIN_GAIN` is not made.
        """
        damping = 0.0
        for _ in range(n_steps):
            variance = noise or self.residual_variance(float(fit.gram[0, 0]))
            hessian = fit.gram[1:, 1:] / variance + prior.precision
            gradient = fit.gram[0, 1:] / variance - prior.precision @ prior.deviations(fit.theta)
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
            if not float(gradient @ step) >= _MIN_GAIN:
                break
            sets = np.clip(fit.theta + _FRACTIONS[:, None] * step * prior.unit, *self.bounds(fit.theta))
            full_step, deviations = self.linearise(sets), prior.deviations(sets)
            costs = full_step.squares / variance + np.sum(deviations @ prior.precision * deviations, axis=1)
            gains = np.nan_to_num(fit.cost(variance, prior) - costs, nan=-np.inf)
            best = int(np.argmax(gains))
            if not gains[best] > 0.0:
                damping = max(10.0 * damping, 0.1)
                continue
            damping = 0.1 * damping if damping > 1e-3 else 0.0
            fit = full_step if best == 0 else self.linearise(sets[best : best + 1])
        return fit

    def bounds(self, theta: Array) -> tuple[Array, Array]:
        """Return lower and upper limits (p,) of a step from `theta`: positive parameters halve or double at most."""
        low, high = np.full(theta.size, -np.inf), np.full(theta.size, np.inf)
        low[_POSITIVE], high[_POSITIVE] = 0.5 * theta[_POSITIVE], 2.0 * theta[_POSITIVE]
        low[LAG], low[COMPLIANCE] = 0.0, _MIN
        return low, high

    def residual_variance(self, squares: float) -> float:
        """Compute the variance [Pa^2] of a residual from its sum of squares and the number of independent samples.

        2 sqrt(pi) sigma is the correlation length of noise smoothed by a Gaussian of width sigma [samples].
        """
        count = max(self.n_samples - len(PARAMETERS), 1.0)
        return max(squares, 1.0) / count * max(1.0, 2.0 * math.sqrt(math.pi) * self.smooth)

    def is_explained(self, cost: float) -> bool:
        """Test whether a chi-squared cost is consistent with the number of samples."""
        return bool(cost <= self.n_samples + _FOLLOW.unexplained * math.sqrt(2.0 * self.n_samples))

    def block_sums(self, fit: Linearisation) -> Block:
        """Return the sums of a linearisation, with the scores of the conductance in each second."""
        rows = fit.rows - (fit.rows @ self.waves.T) @ self._wave_gram_inverse @ self.waves
        first = np.arange(0, self.dp.size, round(self.machine.rate))
        scores = np.add.reduceat(rows[1 + G] * rows, first, axis=1).T
        return Block(fit.theta, fit.gram, self.n_samples, scores)


def fit_from_priors(segment: Segment, total: Array, noise: float) -> Linearisation:
    """Fit the parameters to a segment without any earlier fit; `noise`: its variance [Pa^2].

    The ringing makes many local minima. Therefore the slow part of the pressure is fitted first, from the best of
    several gains; then all of it, from stiffnesses at the peaks of the spectrum of p_A - p_B over that of p_A + p_B,
    `total` (n,), which does not ring, and from several breakaway forces.
    """
    priors = segment.priors

    def rank_starts(section: Segment, theta: Array, n_groups: int, values: dict[int, Array]) -> Array:
        """Sort 16 variants of the parameters `theta` (p,) by their residual squares, the best first, within each group.

        `values`: index of a parameter -> its value in each variant (16,). Consecutive variants form the `n_groups`
        groups. Return (16/n_groups, n_groups, p): row 0 has the best variant of each group.
        """
        sets = np.tile(theta, (SINGLE_WIDTH, 1))
        for parameter, column in values.items():
            sets[:, parameter] = column
        order = section.residual_squares(sets).reshape(n_groups, -1).argsort(axis=1).T
        return sets.reshape(n_groups, -1, len(PARAMETERS))[range(n_groups), order]

    slow_part = replace(segment, smooth=_FOLLOW.slow * segment.machine.ringing_period(priors.centre[K_OIL]))
    gains = priors.centre[GAIN] * _geometric_grid(*PRESSURE.start["gain"], 8)
    springs = priors.centre[SPRING] + priors.width[SPRING] * np.array([0.0, 1.0])
    slow_starts = rank_starts(slow_part, priors.centre, 1, {GAIN: np.tile(gains, 2), SPRING: np.repeat(springs, 8)})
    theta = slow_part.descend(slow_part.linearise(slow_starts[0]), priors.normal, _N_STEPS // 2).theta
    ringing = segment.machine.ringing_stiffnesses(segment.dp, total, priors)
    stiffnesses = np.append(ringing, priors.centre[K_OIL] * _geometric_grid(*PRESSURE.start["K"], 2))  # (4,)
    breakaways = theta[K_BRK] * _geometric_grid(*PRESSURE.start["K_brk"], 4)
    starts = rank_starts(segment, theta, 4, {K_OIL: np.repeat(stiffnesses, 4), K_BRK: np.tile(breakaways, 4)})
    fit = fit_from_starts(segment, starts[0], noise, n_best=2)  # the best breakaway force for each stiffness
    if not segment.is_explained(fit.cost(noise, priors.normal)):  # then the second best
        fit = fit_from_starts(segment, [fit.theta, *starts[1]], noise, n_best=2)
    return fit


def fit_from_starts(segment: Segment, starts: Sequence[Array] | Array, noise: float, n_best: int) -> Linearisation:
    """Descend from several starts (s, p), a few steps from all and more from the `n_best`; return the best result."""
    fits, prior = [segment.linearise(start[None]) for start in starts], segment.priors.normal
    for n_steps, n_kept in ((_N_STEPS // 6, n_best), (_N_STEPS, 1)):
        fits = [segment.descend(fit, prior, n_steps, noise) for fit in fits]
        costs = np.nan_to_num([fit.cost(noise, prior) for fit in fits], nan=np.inf)
        fits = [fits[index] for index in np.argsort(costs)[:n_kept]]
    return fits[0]


class Follower:
    """Iterated Kalman filter of the parameters of the response, from block to block.

    `machine`, `priors`; `sense`: 1 if p_A - p_B rises with the command, -1 if it falls. State: parameters `theta` (p,),
    their `covariance` (p, p) in units, `variance` of the noise [Pa^2], simulated `states` (8, 12), `last` command [V],
    and `excess`: (chi squared - n) / sqrt(2 n) of the last block.
    """

    def __init__(self, machine: Machine, priors: Priors, sense: float) -> None:
        self.machine, self.priors, self.sense = machine, priors, sense
        self.theta, self.variance, self.last = priors.centre, math.nan, math.nan
        self.covariance = np.diag(priors.variance)
        self.states, self.excess = np.zeros((8, SPRING + 2)), 0.0

    @staticmethod
    def fit_start(recording: Recording, rig: Rig) -> Follower:
        """Fit a follower to the first seconds of a recording.

        The friction is Stribeck's, or LuGre's if Stribeck's does not explain the samples and LuGre's fits better.
        """
        u, dp = recording["u"], recording["p_A"] - recording["p_B"]
        sense = float(np.sign(np.mean(u * (dp - dp.mean())))) or 1.0
        beginning = recording.samples(slice(0, math.ceil(_FOLLOW.window * recording.rate)))
        total = beginning["p_A"] + beginning["p_B"]
        # 20: sum of the third difference's squared coefficients
        noise = max(float(np.var(np.diff(total, 3))) / 20.0, 1.0)
        follower = Follower(Machine.from_rig(rig, recording.rate), response_priors(rig), sense)
        segment = follower.next_segment(beginning)
        fit = fit_from_priors(segment, total, noise)
        cost = fit.cost(noise, follower.priors.normal)
        if not segment.is_explained(cost):  # try LuGre's friction in place of Stribeck's
            bristles = Follower(Machine.from_rig(rig, recording.rate, BRISTLES), response_priors(rig, BRISTLES), sense)
            starts = np.array([fit.theta, bristles.priors.centre])
            # Stribeck's friction has no compliance
            starts[:, COMPLIANCE] = bristles.priors.centre[COMPLIANCE]
            bristles_fit = fit_from_starts(bristles.next_segment(beginning), starts, noise, n_best=1)
            if bristles_fit.cost(noise, bristles.priors.normal) < cost:
                follower, fit = bristles, bristles_fit
        follower.theta, follower.variance = fit.theta, segment.residual_variance(float(fit.gram[0, 0]))
        follower._converge_on_beginning(recording)
        return follower

    def _converge_on_beginning(self, recording: Recording) -> None:
        """Refine the start parameters by filtering the beginning of a recording; reset covariance and states."""
        covariance, states = self.covariance, self.states
        length = round(_FOLLOW.block * recording.rate)
        stop = min(round(_FOLLOW.beginning * recording.rate), len(recording) - length + 1)
        for first in range(0, stop, length):
            self.update(recording.samples(slice(first, first + length)))
        self.covariance, self.states, self.last = covariance, states, math.nan

    def at_rate(self, rig: Rig, rate: float) -> Follower:
        """Return a follower with the same parameters for samples at another rate [Hz]."""
        follower = Follower(Machine.from_rig(rig, rate, self.machine.law), self.priors, self.sense)
        follower.theta, follower.covariance = self.theta, self.covariance
        follower.variance, follower.states = self.variance, self.states
        return follower

    def interrupt(self, gap_s: float) -> None:
        """Widen the covariance after a gap of `gap_s` [s] without samples, by at most the prior variance."""
        added = np.minimum(self.priors.wander_variance(gap_s), self.priors.variance)
        self.covariance, self.last = self.covariance + np.diag(added), math.nan

    def next_segment(self, block: Recording) -> Segment:
        """Prepare the samples of the next block for a fit."""
        u, n = block["u"], len(block)
        sample_weights = np.ones(n) if block.bridged is None else (~block.bridged).astype(float)
        if math.isnan(self.last):  # at the start or after a gap: centre the stroke, and let the drive settle
            self.last, self.states = float(u[0]), self.states.copy()
            self.states[POSITION] = self.machine.centred_start(u * self.theta[GAIN])
            sample_weights[: round(_FOLLOW.settling * block.rate)] = 0.0
        # the frequencies of hum show best in the sum of the pressures, which it adds to
        waves = mains_waves(block["p_A"] + block["p_B"], block.rate) * sample_weights
        dp = self.sense * (block["p_A"] - block["p_B"])
        return Segment(self.machine, self.priors, np.append(self.last, u), dp, self.states, waves, sample_weights)

    def _prior(self, block_s: float, jumped: int | None = None) -> Normal:
        """Compute the prior on the parameters in the next block, of `block_s` [s].

        `jumped`: index of a parameter that may have jumped, whose prior variance at the start is added.
        """
        variance = self.priors.wander_variance(block_s)
        if jumped is not None:
            variance[jumped] += self.priors.variance[jumped]
        return Normal(self.theta, np.asarray(np.linalg.inv(self.covariance + np.diag(variance))), self.priors.unit)

    def _fit_block(self, segment: Segment, block_s: float) -> tuple[Linearisation, Normal]:
        """Fit a block of `block_s` [s]; return the linearisation and its prior.

        If random walks do not explain the block, a jump of the conductance or of the stiffness is allowed.
        """

        def fit_candidate(start: Array, prior: Normal) -> tuple[float, Linearisation, Normal]:
            """Fit the block from a start (p,); return the cost, the fit and its prior."""
            fit = segment.descend(segment.linearise(start[None]), prior, _N_STEPS, self.variance)
            return fit.cost(self.variance, prior), fit, prior

        candidates = [fit_candidate(self.theta, self._prior(block_s))]
        if not segment.is_explained(candidates[0][0]):
            for parameter, unit, jump in ((G, 1.0, PRESSURE.jump["G"]), (K_OIL, self.theta[K_OIL], PRESSURE.jump["K"])):
                sets = np.tile(self.theta, (SINGLE_WIDTH, 1))
                sets[:, parameter] = unit * _geometric_grid(*jump, SINGLE_WIDTH)
                best = int(segment.residual_squares(sets).argmin())  # of a grid of values after the jump
                candidates.append(fit_candidate(sets[best], self._prior(block_s, parameter)))
        return min(candidates, key=lambda entry: entry[0])[1:]

    def update(self, block: Recording) -> Block:
        """Fit the next block, update the parameters and their covariance, and return the block's sums."""
        segment = self.next_segment(block)
        fit, prior = self._fit_block(segment, block.duration)
        excess = fit.cost(self.variance, prior) - segment.n_samples
        self.excess = excess / math.sqrt(2.0 * max(segment.n_samples, 1.0))
        self.covariance = np.asarray(np.linalg.inv(fit.gram[1:, 1:] / self.variance + prior.precision))
        gradient = fit.gram[0, 1:] / self.variance - prior.precision @ prior.deviations(fit.theta)
        # one more Gauss-Newton step, which needs no simulation
        self.theta = np.clip(fit.theta + self.covariance @ gradient * prior.unit, *segment.bounds(fit.theta))
        self.states, self.last = fit.ends, float(block["u"][-1])
        return segment.block_sums(fit)


def fit_response(recording: Recording, rig: Rig) -> Joint | None:
    """Fit the response of a usable recording; None if no parameters describe it. The result is computed once."""

    def compute(recording: Recording) -> Joint | None:
        """Follow the blocks from the first to the last, then fit all together."""
        edges = block_edges(recording)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                follower = Follower.fit_start(recording, rig)
                blocks = [follower.update(recording.samples(slice(*map(int, pair)))) for pair in pairwise(edges)]
                joint = Joint.fit(blocks, follower.priors, recording.duration / len(blocks), G)
            except np.linalg.LinAlgError:
                return None
        is_finite = np.all(np.isfinite(joint.mean)) and np.all(np.isfinite(joint.covariance))
        max_variance = _FOLLOW.explained * np.var(recording["p_A"] - recording["p_B"])
        return joint if is_finite and joint.variance < max_variance else None

    return compute_once(recording, ("response", rig), compute, ("u", "p_A", "p_B"))


def measure_leak(recording: Recording, rig: Rig) -> ResponseLeak | None:
    """Estimate the conductance and the response's other parameters; None if they do not describe the recording."""
    joint = fit_response(recording, rig) if find_unmet_requirement(recording, rig) is None else None
    if joint is None:
        return None
    edges, dp = block_edges(recording), np.abs(recording["p_A"] - recording["p_B"])
    middles = recording.t[0] + 0.5 * (edges[1:] + edges[:-1]) / recording.rate
    parameters = parameter_information(joint, middles, recording.duration)
    pressure = np.add.reduceat(dp, edges[:-1]) / np.diff(edges)
    mean_speed = rig.motor.omega_per_volt * float(np.mean(np.abs(recording["u"])))
    pump_flow = mean_speed * rig.pump.q_b / (2.0 * np.pi)
    return ResponseLeak(parameters, pressure, (pump_flow, pump_flow), states_flow(rig))


def parameter_information(joint: Joint, time: Array, seconds: float) -> dict[str, Information]:
    """Compute the likelihood of each parameter, by name, in blocks at `time` (K,) [s], of `seconds` in total."""
    growth = math.sqrt(seconds / PRESSURE.blocks.wander)  # of a random walk, beyond the time that priors state
    wander = growth * joint.priors.wander
    wander[G] = growth * PRESSURE.conductance.wander  # that of a healthy machine
    return {name: joint.information(k, time, float(wander[k])) for k, name in enumerate(PARAMETERS)}
