"""The flow of a leak under laws between laminar and an orifice's, in blocks of a conductance.

A leak c |p_A - p_B|^e beside what pump and piston pass anyway adds to a block's conductance c r_k, with r_k the
regression of the law's flow on the pressure difference within the block. So one test of a step, its size in each block
in proportion to r_k, serves every law, and the laminar leakage of pump and piston stays what it was. A seal that goes
on wearing leaks more towards the end: so does the step, by a share of itself. The flow of a step is a mixture over
laws, growths and onsets, each weighed by its likelihood and what is believed of it.

A rise g beyond the healthy recordings is the regression of the leak's flow on p_A - p_B over the whole recording. Under
another law the flow is the larger, the more p_A - p_B varies: g <|dp|^e> / b_e, with b_e the regression of the law's
flow on p_A - p_B, all else eliminated. And a leak that began within the recording passed more while it lasted: an onset
after which a share s of what the recording tells lies asks for a step g / s, which the blocks know.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns
from sealscope.diagnosis.inference.observable import Flow
from sealscope.diagnosis.inference.onset import EDGE, PARTS, Information, StepTest, step_shapes, step_sizes
from sealscope.diagnosis.inference.terms import ORIFICE
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Exponents of the pressure difference that are tried.
EXPONENTS = (1.0, 0.75, 0.5)
#: Growths that are tried beside none, and the weight below which an onset counts for nothing, over the largest.
GROWTHS, FAINT = 6, 1e-3
#: Least share of what a recording tells that must lie after an onset for the flow since then to be known.
LEAST_SHARE = 0.1


def law_shapes(blocks: Blocks, columns: Sequence[Columns]) -> dict[float, Array]:
    """Compute what a leak of each exponent adds to the conductance of each block, shapes (K,).

    Between laminar and orifice by interpolation of the logarithm.
    """
    leak, orifice = columns[0].leak, columns[0].names.index(ORIFICE)
    gram = blocks.gram.sum(axis=1)
    energy = np.maximum(gram[:, leak, leak], np.finfo(float).tiny)
    root = np.maximum(gram[:, orifice, leak] / energy, np.finfo(float).tiny)
    return {exponent: root ** (2.0 * (1.0 - exponent)) for exponent in EXPONENTS}


def law_driving(blocks: Blocks) -> dict[float, Array]:
    """Compute the mean flow of a leak of one under each exponent in each block, shapes (K,)."""
    pressure, root = blocks.driving(), blocks.driving(root=True)
    return {exponent: pressure ** (2.0 * exponent - 1.0) * root ** (2.0 - 2.0 * exponent) for exponent in EXPONENTS}


def growth_priors() -> list[tuple[float, float]]:
    """Return growths from onset to end, as shares of the step, each with its prior probability."""
    believed = priors("inference")["growth"]
    steady = believed["steady"]
    grown = believed["most"] * (np.arange(GROWTHS) + 1.0) / GROWTHS
    return [(0.0, steady), *((float(growth), (1.0 - steady) / GROWTHS) for growth in grown)]


def step_flow(blocks: Blocks, columns: Sequence[Columns], leak: Information, test: StepTest) -> Flow:
    """Estimate the mean flow of a step of the leak while it lasts, over laws, growths and onsets."""
    onsets = np.flatnonzero(test.weights > FAINT * test.weights.max())
    positions, rows = EDGE + onsets / PARTS, np.maximum(blocks.rows, 1e-9)
    if np.isfinite(leak.level):  # what is believed of the level stands before the first block
        positions = positions - 1.0
    lasting = rows @ step_shapes(len(blocks), positions)
    shapes, driving = law_shapes(blocks, columns), law_driving(blocks)
    logarithms, flows, deviations = [], [], []
    for growth, share in growth_priors():
        grown = step_shapes(len(blocks), positions, growth)
        for exponent in EXPONENTS:
            sizes = step_sizes(leak, onsets, shapes[exponent], growth)
            unit = (rows * driving[exponent]) @ grown / np.maximum(lasting, np.finfo(float).tiny)
            logarithms.append(np.log(share) + sizes.likelihood)
            flows.append(sizes.size * unit)
            deviations.append(sizes.deviation * unit)
    weights = np.exp(np.ravel(logarithms) - np.max(logarithms))
    return mixed_flow(weights, np.ravel(flows), np.ravel(deviations))


def rise_flow(
    blocks: Blocks,
    columns: Sequence[Columns],
    leak: Information,
    test: StepTest | None,
    rise: tuple[float, float],
    laws: Sequence[tuple[float, float]],
    largest: float,
) -> Flow:
    """Estimate the mean flow of a leak that healthy recordings do not have, while it lasts, over laws and onsets.

    It is that of the likeliest law, and the others make it uncertain.

    Parameters
    ----------
    blocks : Blocks
    columns : sequence of Columns
    leak : Information
        Likelihood of the leak's coefficient in the blocks.
    test : StepTest, optional
        Test of its step.
    rise : tuple of two floats
        Rise of the coefficient over the whole recording, and its standard deviation.
    laws : sequence of tuples of two floats
        For each of `EXPONENTS` the mean flow of a rise of one, and the logarithm of its weight.
    largest : float
        Mean flow of the pump [m^3/s]: no leak is larger.

    Returns
    -------
    Flow
    """
    value, deviation = rise
    logarithms, shares = np.zeros(1), np.ones(1)  # from the start
    if test is not None and value > 0.0:
        positions = EDGE + np.arange(len(test.onsets)) / PARTS - (1.0 if np.isfinite(leak.level) else 0.0)
        tells = np.maximum(leak.precision.sum(axis=0), 0.0)
        after = tells @ step_shapes(len(blocks), positions) / max(float(tells.sum()), np.finfo(float).tiny)
        known = after > LEAST_SHARE
        step = value / np.maximum(after, LEAST_SHARE)
        precision = 1.0 / np.maximum(test.deviation, np.finfo(float).tiny) ** 2
        likelihood = precision * step * (test.size - 0.5 * step) - np.log(len(positions))
        logarithms, shares = np.append(logarithms, likelihood[known]), np.append(shares, after[known])
    units, weights = np.array(laws).T
    flows = value * units / shares[:, None]
    logarithms = np.where(np.abs(flows) > largest, -np.inf, logarithms[:, None] + weights)
    if not np.isfinite(logarithms).any():
        return Flow(value * float(units[0]), deviation * float(units[0]))
    mixture = np.exp(logarithms - logarithms.max())
    likeliest = int(mixture.sum(axis=0).argmax())
    value = float(mixture[:, likeliest] @ flows[:, likeliest] / mixture[:, likeliest].sum())
    squares = (deviation * units / shares[:, None]) ** 2 + (flows - value) ** 2
    return Flow(value, float(np.sqrt((mixture * squares).sum() / mixture.sum())))


def mixed_flow(weights: Array, flows: Array, deviations: Array) -> Flow:
    """Return mean and deviation of a mixture of flows (k,)."""
    shares = weights / weights.sum()
    value = float(shares @ flows)
    return Flow(value, float(np.sqrt(shares @ (deviations**2 + (flows - value) ** 2))))
