"""The detector of steps against its formulas: sums that onsets within a block share, and states that do not fit."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import betaln, gammaln, log_ndtr, logsumexp

from sealscope.diagnosis.estimate.change import ChangeSums
from sealscope.diagnosis.live.kernel.step import _CHANGES, _MEMORY, PARTS, SIZES, WALKS
from sealscope.diagnosis.live.sequential import StepDetector
from sealscope.diagnosis.priors.live import LIVE
from sealscope.errors import InputError

WARM, JUMP = 4, float(LIVE.coefficients.jump)


def filter_innovations(values, deviations):
    """Innovations, variances and gains (blocks, walks) of the Kalman filters, in the unit of the first deviation."""
    walks, unit = np.array(WALKS), deviations[0]
    level, spread = np.full(len(walks), values[0] / unit), np.full(len(walks), 1.0)
    rows = []
    for value, deviation in zip(values[1:] / unit, deviations[1:] / unit, strict=True):
        variance = spread + walks + deviation**2
        gain = (spread + walks) / variance
        rows.append((value - level, variance, gain))
        level, spread = level + gain * (value - level), gain * deviation**2
    return (np.array(part) for part in zip(*rows, strict=True))


def direct_log_e(values, deviations):
    """Log M by the formulas of `live.sequential`: each onset's response is run through the filters by itself."""
    e, variance, gain = filter_innovations(values, deviations)
    walks = len(WALKS)
    squares, count, log_weights = np.zeros(walks), 0.0, np.full(walks, -np.log(walks))
    before = []  # T, n and log prior of an onset in each block, before it
    for k in range(len(e)):
        before.append((squares, count, np.logaddexp(np.log1p(-_CHANGES) + log_weights, np.log(_CHANGES / walks))))
        square = np.maximum(e[k] ** 2 / variance[k], 1e-12)
        if count >= WARM:
            square = np.minimum(square, JUMP**2 * squares / count)
            log_weights = _MEMORY * log_weights - 0.5 * np.log(variance[k] * squares)
            log_weights = log_weights - 0.5 * (count + 1.0) * np.log1p(square / squares)
            log_weights = log_weights - logsumexp(log_weights)
        squares, count = _MEMORY * squares + square, _MEMORY * count + 1.0
    total = []
    for j in range(len(e)):
        squares, count, log_prior = before[j]
        if count < WARM:
            continue
        n, T = count + len(e) - j, squares + (e[j:] ** 2 / variance[j:]).sum(axis=0)
        spread = np.log(variance[j:]).sum(axis=0)
        scale = gammaln(0.5 * n) - gammaln(0.5 * count) - 0.5 * (n - count) * np.log(np.pi)
        log_p = scale + 0.5 * count * np.log(squares) - 0.5 * n * np.log(T) - 0.5 * spread
        for part in PARTS:
            f, followed = np.empty_like(gain[j:]), np.zeros(walks)
            for k in range(len(f)):
                f[k] = part if k == 0 else 1.0 - followed
                followed = followed + gain[j + k] * f[k]
            a, b = (f * e[j:] / variance[j:]).sum(axis=0), (f**2 / variance[j:]).sum(axis=0)
            for v in SIZES:
                score = -n * np.log1p(-(a**2) / ((b + 1.0 / v) * T))
                ratio = np.log(2.0) + 0.5 * (score - np.log1p(v * b)) + log_ndtr(np.sqrt(score))
                above = log_prior + log_p + np.where(a > 0.0, ratio, -np.inf)
                total.append(logsumexp(above) - logsumexp(log_prior + log_p) - np.log(len(SIZES) * len(PARTS)))
    return logsumexp(total)


@pytest.mark.parametrize("seed", range(6))
def test_log_m_is_that_of_its_formula(seed):
    """Of blocks with standard errors of any kind, so few that no onset is thinned out."""
    random = np.random.default_rng(seed)
    n = 8 + 4 * seed
    values = 3.0 + random.standard_normal(n) + np.cumsum(0.3 * seed * random.standard_normal(n))
    values[-4:] += random.uniform(0.0, 6.0)
    deviations = random.uniform(0.3, 3.0, n)
    detector = StepDetector()
    for k in range(n):
        detector.take(3.0 * k, 3.0 * k + 3.0, 1e-13 * values[k], 1e-13 * deviations[k])
    assert detector.log_e() == pytest.approx(direct_log_e(values, deviations), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("n", [4, 6, 12, 50, 400])
@pytest.mark.parametrize("gain", [1e-2, 1.0, 30.0, 1e4, 1e8])
def test_the_mean_ratio_of_a_rise_without_one_is_at_most_1(n, gain):
    """Over n innovations of which one direction shows the step: its part u of the squares has a beta distribution.

    This is what makes M an e-detector: `log_size_mixture` has the normal distribution in place of Student's.
    """
    # u = 1 - exp(-y): close to 1 as the ratio is largest there
    y = np.concatenate([[0.0], np.geomspace(1e-12, 700.0, 20001)])
    u = -np.expm1(-y)
    with np.errstate(divide="ignore"):
        log_density = -0.5 * np.log(u) - 0.5 * (n - 3.0) * y - betaln(0.5, 0.5 * (n - 1.0)) - y
    log_density[0] = -np.inf
    score = -n * np.log1p(-u * gain / (1.0 + gain))
    moment = np.sqrt(score * (1.0 + gain))  # of a change with the root sqrt(score), for a prior of the scale 1
    log_ratio = ChangeSums(np.full(len(y), gain), moment).log_mean_ratio(np.ones(len(y)))
    ratio = np.exp(log_density + log_ratio)
    mean = 0.5 * np.trapezoid(ratio, y)  # half of all have a rise, and the others count as 0
    assert 0.5 < mean < 1.0


def test_a_saved_state_that_does_not_fit_is_refused():
    detector, random = StepDetector(), np.random.default_rng(2)
    for k in range(90):
        detector.take(k, k + 1.0, random.standard_normal(), 1.0)
    state = json.loads(json.dumps(detector.state()))
    for name, value in {"n_stored": 10**6, "n_old": -1, "n_onsets": 7, "sums": state["blocks"]}.items():
        with pytest.raises(InputError, match="saved state"):
            StepDetector().load_state({**state, name: value})
