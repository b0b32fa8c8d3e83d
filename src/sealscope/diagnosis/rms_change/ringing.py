"""Estimate how the ringing of a machine changes, from the RMS of wavelet details, with the noise removed.

The ringing is an oscillation of the pressures, which a leak damps. A detail d_j has the energy E_j = (1 + g)^2 S_j +
E_1. S_j is the mean energy of the machine's ringing in d_j, g the relative change of the ringing's amplitude, and E_1
the energy of white noise, which is equal in every detail; d1 is almost only noise. To first order g follows from

    y = log RMS d_j - log sqrt(S_j + E_1) = w g + error,    w = S_j / (S_j + E_1),

with E_1 measured in d1 of the same block or recording. A change of the noise therefore cancels, and the weight w is
small where noise dominates. For d1, y is the log RMS itself. The effect of the duty (how the machine is moved and
loaded) is eliminated: g follows powers of the duty's features (`blocks.DUTY`) with priors on the exponents
(`priors.toml`). For a duty that does not repeat, g has a wider random walk.
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.estimate.change import Information
from sealscope.diagnosis.estimate.population import Population, ScatterPrior, number_sessions
from sealscope.diagnosis.inference.comparison.rise import Rise, rise_of_mixture
from sealscope.diagnosis.priors.rms_change import RMS_PRIORS
from sealscope.diagnosis.rms_change.rms_blocks import DUTY, RmsBlocks, column_names
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES


def subtract_noise(log_rms: Array, healthy: Array) -> tuple[Array, Array]:
    """Compute the change of the log RMS of wavelet details relative to healthy values, with the noise removed.

    `log_rms` (n, 5 per chamber) are values of n blocks or recordings, for the details d1 to d4 and the product d3d4.
    S_j is estimated from `healthy` (k, 5 per chamber), as the mean energy of d_j minus that of d1. Returns the changes
    y and the fractions w of the energy that is not noise, both (n, 5 per chamber):

        d2, d3, d4:   y = log RMS - log sqrt(S_j + E_1),    w = S_j / (S_j + E_1)
        d1:           y = log RMS,    w = 1
        d3d4:         y = log RMS minus the terms log sqrt(S_j + E_1) of both d3 and d4,    w = 1.
    """
    y, weight = np.array(log_rms), np.ones_like(log_rms)
    min_signal_fraction = RMS_PRIORS.walk.least  # S_j is a difference of two estimates, which might be negative
    for d1 in range(0, log_rms.shape[1], len(QUANTITIES)):  # column of each chamber's d1
        noise = np.exp(2.0 * log_rms[:, d1])
        d3, d4, product = (d1 + QUANTITIES.index(name) for name in ("d3", "d4", "d3d4"))
        for column in range(d1 + 1, product):
            noise_energy, energy = np.exp(2.0 * healthy[:, [d1, column]]).mean(axis=0)
            signal = max(energy - noise_energy, min_signal_fraction * energy)
            y[:, column] -= 0.5 * np.log(signal + noise)
            weight[:, column] = signal / (signal + noise)
        # to first order the log RMS of d3d4 changes by the sum of the changes of d3 and d4
        y[:, product] += y[:, d3] - log_rms[:, d3] + y[:, d4] - log_rms[:, d4]
    return y, weight


def change_information(blocks: RmsBlocks) -> tuple[list[Information], Array]:
    """Compute the likelihood of the relative change g of the ringing in each block of a recording.

    Returns for each column of `blocks.log_rms` a normal likelihood of g over the blocks, and the means of w (columns,).
    """
    changes, weight = subtract_noise(blocks.log_rms, blocks.log_rms)
    variances = np.mean(np.diff(changes, axis=0) ** 2, axis=0) / 2.0  # a difference has twice the variance
    features = DUTY[:-1]  # no direction: it belongs to the phase of a cycle, whose mean difference is removed already
    duty = (blocks.duty - blocks.duty.mean(axis=0))[:, : len(features)]
    exponent_sd = np.array([getattr(RMS_PRIORS.duty, name) for name in features])
    time = blocks.edges[:-1] + 0.5 * blocks.seconds
    walks = RMS_PRIORS.walk
    # convert scales for `walk.time` to the length of all blocks: a random walk grows with the root of the time; the
    # linear change is given the same scale
    walk_scale = float(np.sqrt(len(time) * blocks.seconds / walks.time))
    machine_walk = walks.duty if blocks.cycle is None else walks.machine
    results = list[Information]()
    for name, y, w, variance in zip(column_names(blocks.chambers), changes.T, weight.T, variances, strict=True):
        drift_scale = (walks.noise if name.startswith("d1 ") else machine_walk) * walk_scale
        precision, vector = w**2 / variance, w * y / variance
        # eliminate the exponents of the duty D, which have normal priors: P - P D (D'P D + 1/sd^2)^-1 D'P
        weighted = precision[:, None] * duty
        gain = weighted @ np.linalg.inv(duty.T @ weighted + np.diag(exponent_sd**-2))
        precision, vector = np.diag(precision) - gain @ weighted.T, vector - gain @ (duty.T @ vector)
        results.append(Information(time, precision, vector, slope=drift_scale, walk=drift_scale))
    return results, weight.mean(axis=0)


def estimate_rises(
    log_rms: Array, duty: Array, healthy: Array, healthy_duty: Array, times: Array | None = None
) -> tuple[list[Rise], Array]:
    """Estimate the change g of the log RMS of wavelet details (ringing) relative to n leak-free recordings.

    `log_rms` (5 per chamber,) and `duty` (4,), the features `DUTY`, are those of the judged recording, `healthy` (n, 5
    per chamber) and `healthy_duty` (n, 4) those of the leak-free ones. `times` (n + 1,) are the start times [s], with
    that of the judged recording at the end; None if unknown. Returns the change of each wavelet quantity, and the
    fractions of energy that are not noise in the leak-free recordings, (5 per chamber,). g is the log RMS without its
    noise (`subtract_noise`) over this fraction.

    The model is the sum of a common mean, an effect of the duty, independent scatter, and an Ornstein-Uhlenbeck process
    over time, independent between sessions, which are separated by pauses. The likelihood is averaged over a prior on
    the rate of this process.
    """
    prior, walk, n = RMS_PRIORS.recordings, RMS_PRIORS.walk, len(healthy)
    exponent_sd = np.array([getattr(RMS_PRIORS.duty, name) for name in DUTY])
    # effects of exponents of one standard deviation, relative to the judged recording (last row)
    effects = (np.vstack([healthy_duty, duty]) - duty) * exponent_sd
    # quantiles of the half-Cauchy prior on the standard deviation that the process gains in `walk.time`
    probabilities = (np.arange(walk.tried) + 0.5) / walk.tried
    walk_sd = walk.machine * np.tan(0.5 * np.pi * probabilities)
    # within a time t, short compared with 1/rate, the process gains the variance 2 rate t session^2
    rates = (walk_sd / prior.session) ** 2 / (2.0 * walk.time)
    elapsed, same_session = np.zeros((n + 1, n + 1)), np.ones((n + 1, n + 1))  # without dates: one session
    if times is not None:
        sessions = number_sessions(list(times), prior.pause)
        elapsed = np.abs(np.subtract.outer(times, times))
        same_session = np.equal.outer(sessions, sessions).astype(float)
    walk_covariances = prior.session**2 * np.exp(-rates[:, None, None] * elapsed) * same_session
    population = Population(walk_covariances + effects @ effects.T, np.zeros(len(rates)))  # rates are equally likely
    y, weights = subtract_noise(np.vstack([log_rms, healthy]), healthy)
    weight = weights[1:].mean(axis=0)
    rises = []
    for judged_g, healthy_g, w in zip(y[0] / weight, y[1:].T / weight[:, None], weight, strict=True):
        scatter = float(np.hypot(prior.scatter, prior.error / w))  # g = y / w has the error of y over w
        predicted = population.predict_with_prior(healthy_g[None], ScatterPrior(scatter, prior.freedom))
        rises.append(rise_of_mixture(predicted, judged_g[None]))
    return rises, weight
