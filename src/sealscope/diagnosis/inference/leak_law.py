"""Flow of a leak under laws between laminar and orifice, from the conductance in blocks.

A leak c |p_A - p_B|^e, in addition to the healthy leakage, changes a block's conductance by c r_k, with r_k the
regression of its flow on the pressure difference within the block. A step test with a size proportional to r_k in each
block thus covers every law, and the healthy laminar leakage does not enter. A seal that continues to wear leaks more
towards the end: the step grows by a fraction of itself. The flow of a step is a mixture over laws, growths and onsets,
each weighted by its likelihood and prior.

A rise g beyond the healthy recordings is the regression of the leak's flow on p_A - p_B over the whole recording. Under
another law the flow is g <|dp|^e> / b_e, with b_e the regression of that law's flow on p_A - p_B, all else eliminated.
A leak that began within the recording had a larger flow while it lasted: if a fraction s of the recording's
information lies after the onset, the step is g / s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.observable import Flow
from sealscope.diagnosis.inference.onset import EDGE, PARTS, Information, StepTest, step_shapes, step_sizes
from sealscope.diagnosis.inference.terms import ORIFICE
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Exponents e of the leak laws.
EXPONENTS = (1.0, 0.75, 0.5)
#: Number of growths above zero.
N_GROWTHS = 6
#: Probability of an onset over the largest below which it is omitted.
NEGLIGIBLE = 1e-3
#: Minimum fraction of the information after an onset, for a flow since then.
MIN_FRACTION = 0.1
_TINY = np.finfo(float).tiny


def law_shapes(blocks: Blocks, columns: Sequence[ColumnRoles]) -> dict[float, Array]:
    """Compute the conductance (K,) that a leak of unit coefficient adds in each block, by leak law.

    The keys are `EXPONENTS`. For an orifice it is the regression coefficient of the flow on p_A - p_B; for the laws
    between laminar and orifice flow its logarithm is interpolated.
    """
    leak, orifice = columns[0].leak, columns[0].names.index(ORIFICE)
    gram = blocks.gram.sum(axis=1)
    energy = np.maximum(gram[:, leak, leak], _TINY)
    root = np.maximum(gram[:, orifice, leak] / energy, _TINY)
    return {exponent: root ** (2.0 * (1.0 - exponent)) for exponent in EXPONENTS}


def law_flows(blocks: Blocks) -> dict[float, Array]:
    """Compute the mean flow (K,) in each block of a leak of unit coefficient, for each of `EXPONENTS`.

    The mean of |p_A - p_B|^e is interpolated between those for e = 1 and e = 1/2, in its logarithm.
    """
    pressure, root = blocks.mean_pressure(), blocks.mean_root()
    return {exponent: pressure ** (2.0 * exponent - 1.0) * root ** (2.0 - 2.0 * exponent) for exponent in EXPONENTS}


def law_priors() -> Array:
    """Return the prior probability of each of `EXPONENTS`: that of laminar flow, the rest shared equally."""
    laminar: float = INFERENCE.size.laminar
    n_others = len(EXPONENTS) - 1
    return np.array([laminar, *[(1.0 - laminar) / n_others] * n_others])


def _growth_priors() -> list[tuple[float, float]]:
    """List the possible relative growths of a step after its onset, with their prior probabilities."""
    prior = INFERENCE.growth
    growths = prior.most * (np.arange(N_GROWTHS) + 1.0) / N_GROWTHS  # evenly spaced up to the largest
    return [(0.0, prior.steady), *((float(growth), (1.0 - prior.steady) / N_GROWTHS) for growth in growths)]


def _onset_positions(leak: Information, onsets: NDArray[np.intp]) -> Array:
    """Convert indices of a step test's onsets to positions, counted in blocks from the start of the first block.

    A prior on the level counts in the test as one block before the first.
    """
    return EDGE + onsets / PARTS - float(np.isfinite(leak.level))


def estimate_step_flow(blocks: Blocks, columns: Sequence[ColumnRoles], leak: Information, test: StepTest) -> Flow:
    """Estimate the mean flow of a step of the leak after its onset, averaged over laws, growths and onsets."""
    onsets = np.flatnonzero(test.weights > NEGLIGIBLE * test.weights.max())
    positions, rows = _onset_positions(leak, onsets), np.maximum(blocks.rows, 1e-9)
    n_rows_after = np.maximum(rows @ step_shapes(len(blocks), positions), _TINY)
    shapes, unit_flows = law_shapes(blocks, columns), law_flows(blocks)
    log_weights, flows, standard_errors = [], [], []
    for growth, probability in _growth_priors():
        steps = step_shapes(len(blocks), positions, growth)
        for exponent in EXPONENTS:
            sizes = step_sizes(leak, onsets, shapes[exponent], growth)
            unit = (rows * unit_flows[exponent]) @ steps / n_rows_after  # mean flow of a step of 1 after its onset
            log_weights.append(np.log(probability) + sizes.likelihood)
            flows.append(sizes.size * unit)
            standard_errors.append(sizes.deviation * unit)
    weights = np.exp(np.ravel(log_weights) - np.max(log_weights))
    return mixture_flow(weights, np.ravel(flows), np.ravel(standard_errors))


class LawWeight(NamedTuple):
    """A law of the leak: mean `flow` of a unit rise of the coefficient, and the logarithm of its probability."""

    flow: float
    log_weight: float


def estimate_rise_flow(
    leak: Information, test: StepTest | None, value: float, deviation: float, laws: Sequence[LawWeight], max_flow: float
) -> Flow:
    """Estimate the mean flow of a leak after its onset, from its rise over healthy recordings.

    The value is that of the most probable law; the other laws contribute to its standard deviation. `leak`: likelihood
    of the coefficient in the blocks; `test`: of its step, or None; `value`, `deviation`: mean rise over the whole
    recording and its standard deviation; `laws`: of `EXPONENTS`; `max_flow`: mean flow of the pump [m^3/s].
    """
    log_weights, fractions = _weigh_rise_onsets(leak, test, value)
    unit_flows, law_log_weights = np.array(laws).T
    flows = value * unit_flows / fractions[:, None]  # for each onset and law
    log_weights = np.where(np.abs(flows) > max_flow, -np.inf, log_weights[:, None] + law_log_weights)
    if not np.isfinite(log_weights).any():
        return Flow(value * float(unit_flows[0]), deviation * float(unit_flows[0]))
    weights = np.exp(log_weights - log_weights.max())
    law = int(weights.sum(axis=0).argmax())
    flow = float(weights[:, law] @ flows[:, law] / weights[:, law].sum())
    variances = (deviation * unit_flows / fractions[:, None]) ** 2 + (flows - flow) ** 2
    return Flow(flow, float(np.sqrt((weights * variances).sum() / weights.sum())))


def _weigh_rise_onsets(leak: Information, test: StepTest | None, value: float) -> tuple[Array, Array]:
    """Compute the log weight of each possible onset of a rise, and the fraction of information after it.

    The first onset is the recording's start, with fraction 1. `value`: rise of the coefficient over the whole
    recording, which is the step after the onset times this fraction. The weight is the likelihood of such a step,
    relative to no step, over the number of onsets.
    """
    if test is None or not value > 0.0:
        return np.zeros(1), np.ones(1)
    positions = _onset_positions(leak, np.arange(len(test.onsets)))
    information = np.maximum(leak.precision.sum(axis=0), 0.0)
    fraction_after = information @ step_shapes(len(information), positions) / max(float(information.sum()), _TINY)
    step = value / np.maximum(fraction_after, MIN_FRACTION)
    precision = 1.0 / np.maximum(test.deviation, _TINY) ** 2
    log_likelihood = precision * step * (test.size - 0.5 * step) - np.log(len(positions))
    is_used = fraction_after > MIN_FRACTION
    return np.append(0.0, log_likelihood[is_used]), np.append(1.0, fraction_after[is_used])


def mixture_flow(weights: Array, flows: Array, deviations: Array) -> Flow:
    """Compute the mean and the standard deviation of a mixture of k flows.

    `weights`, `flows` (or other sizes of a leak) and their standard `deviations`: (k,) each.
    """
    probabilities = weights / weights.sum()
    value = float(probabilities @ flows)
    return Flow(value, float(np.sqrt(probabilities @ (deviations**2 + (flows - value) ** 2))))
