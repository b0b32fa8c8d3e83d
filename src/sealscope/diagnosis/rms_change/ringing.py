"""The machine's own part in the RMS of a detail, within a recording and between recordings.

Energy of a detail d_j is that of white noise, which every level holds alike (d1 holds hardly anything else), and the
machine's own: E_j = (1 + g)^2 E_own,j + E_1. So the change g of the machine's amplitude is, to first order,

    y = log RMS d_j - log sqrt(E_own,j + E_1) = w g + error,    w = E_own,j / (E_own,j + E_1),

with E_1 of the same block or recording: noise that changes by any amount drops out, and where it drowns the machine
the weight w is small. Of d1 y is the log RMS itself. What the duty explains is eliminated: g follows `blocks.DUTY`
by exponents that are believed within a width (`priors.toml`); where it does not repeat, g walks further.
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.inference.scatter import Population, Rise, sessions_of
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.rms_change.blocks import DUTY, RmsBlocks
from sealscope.recordings.recording import Array
from sealscope.signals.details import QUANTITIES


def beyond_noise(log_rms: Array, known: Array) -> tuple[Array, Array]:
    """Return y and w (n, 5 per chamber) of log RMS (n, 5 per chamber), the machine's own energy that of `known`."""
    left, weight = np.array(log_rms), np.ones_like(log_rms)
    least = priors("rms_change")["walk"]["least"]
    for first in range(0, log_rms.shape[1], len(QUANTITIES)):
        noise = np.exp(2.0 * log_rms[:, first])
        for column in range(first + 1, first + QUANTITIES.index("d3d4")):
            energy = np.exp(2.0 * known[:, [first, column]]).mean(axis=0)
            signal = max(energy[1] - energy[0], least * energy[1])
            left[:, column] -= 0.5 * np.log(signal + noise)
            weight[:, column] = signal / (signal + noise)
        d3, d4, product = (first + QUANTITIES.index(name) for name in ("d3", "d4", "d3d4"))
        left[:, product] += left[:, d3] - log_rms[:, d3] + left[:, d4] - log_rms[:, d4]
    return left, weight


def information(blocks: RmsBlocks) -> tuple[list[Information], Array]:
    """Compute the information on the change g of each quantity, duty eliminated, and the mean of each w."""
    left, weight = beyond_noise(blocks.log_rms, blocks.log_rms)
    error = np.mean(np.diff(left, axis=0) ** 2, axis=0) / 2.0
    explaining = DUTY[:-1]  # the direction is that of the phase
    duty = (blocks.duty - blocks.duty.mean(axis=0))[:, : len(explaining)]
    exponents, walks = (priors("rms_change")[table] for table in ("duty", "walk"))
    believed = np.array([float(exponents[name]) for name in explaining])
    time = blocks.edges[:-1] + 0.5 * blocks.seconds
    over_all = float(np.sqrt(len(time) * blocks.seconds / walks["time"]))
    machine, results = "duty" if blocks.cycle is None else "machine", []
    for name, y, w, variance in zip(blocks.names, left.T, weight.T, error, strict=True):
        drift = walks["noise" if name.startswith("d1 ") else machine] * over_all
        precision, vector = w**2 / variance, w * y / variance
        weighted = precision[:, None] * duty
        gain = weighted @ np.linalg.inv(duty.T @ weighted + np.diag(believed**-2))
        precision, vector = np.diag(precision) - gain @ weighted.T, vector - gain @ (duty.T @ vector)
        results.append(Information(time, precision, vector, slope=drift, walk=drift))
    return results, weight.mean(axis=0)


def rises(
    log_rms: Array, duty: Array, known: Array, known_duty: Array, times: Array | None = None
) -> tuple[list[Rise], Array]:
    """Estimate the rise g of each quantity over n leak-free recordings, duty removed; return these and w.

    `log_rms` (5 per chamber,), `duty` (4,); `known` (n, 5 per chamber), `known_duty` (n, 4). The quantities of healthy
    recordings are normal about a mean, what the duty explains, and a deviation that fades with the time between them,
    an Ornstein-Uhlenbeck process: it grows as a walk of a rate nobody knows, up to what sessions differ by; a session
    begins anew after a pause. `times` (n + 1,) of these and of the recording [s], None where they are not known.
    """
    prior, walk, n = priors("rms_change")["recordings"], priors("rms_change")["walk"], len(known)
    exponents = np.array([float(priors("rms_change")["duty"][name]) for name in DUTY])
    effects = (np.vstack([known_duty, duty]) - duty) * exponents
    quantiles = (np.arange(walk["tried"]) + 0.5) / walk["tried"]
    gained = walk["machine"] * np.tan(0.5 * np.pi * quantiles)
    rates = (gained / prior["session"]) ** 2 / (2.0 * walk["time"])
    elapsed, same_session = np.zeros((n + 1, n + 1)), np.ones((n + 1, n + 1))
    if times is not None:
        sessions = sessions_of(list(times), prior["pause"])
        elapsed, same_session = (
            np.abs(np.subtract.outer(times, times)),
            np.equal.outer(sessions, sessions).astype(float),
        )
    fading = prior["session"] ** 2 * np.exp(-rates[:, None, None] * elapsed) * same_session
    population = Population(fading + effects @ effects.T, np.zeros(len(rates)))
    values, weights = beyond_noise(np.vstack([log_rms, known]), known)
    weight = weights[1:].mean(axis=0)
    results = []
    for change, healthy, w in zip(values[0] / weight, values[1:].T / weight[:, None], weight, strict=True):
        scatter = float(np.hypot(prior["scatter"], prior["error"] / w))
        results.append(population.rise(change[None], healthy[None], scatter, prior["freedom"]))
    return results, weight
