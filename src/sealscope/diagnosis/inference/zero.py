"""The zero of the pressure difference: what is taken off p_A - p_B so that leakage is proportional to it.

Sensors that read wrong by a constant z turn a leak g (p_A - p_B) into g (d - z), d what is recorded: a change of g is a
change of the flow's zero, too, by -g z. Near z = 0 it is a term of every fit (`blocks`); a zero that is wrong by more
than the pressure difference itself is looked for here. In block k the Gram matrix tells two numbers apart: g_k, by how
flow follows d within the block, and the flow's offset o_k at the block's mean difference d_k. With a step of the leak's
coefficient, a random walk w of unknown size q, and a drift of the flow's zero,

    g = F a + w + delta s,    o = (d_k - z) g + B b,    cov w = kappa q min(k, l);

F (level and slope) and B (level, slope and curvature) are projected out. z maximises the restricted likelihood, over
onsets and (q, kappa), times what is believed: a normal density of good sensors, and at small odds one of those far off.
The walk is no larger than without z, or z and a walk that is free in every block explain what no leak does. Where the
leak does not change nothing is known of z, it stays near zero, and nothing depends on it. Of the two chambers behind a
servo valve each tells of the same leak, step and zero: their whitened rows stand below each other.

Source: D. A. Harville, J. Am. Statist. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, cost_of_zero, pair
from sealscope.diagnosis.inference.onset import FEWEST, RANK, WALKS
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Zeros that are tried at first, within three times what is believed of one that is far off.
TRIED = 21


def about_zero(blocks: Blocks, columns: Sequence[Columns]) -> Blocks:
    """Return the blocks with their sums taken about the zero of p_A - p_B that a change of the leak shows.

    They are returned as they are where a balance has no offset of the flow, or too few blocks.
    """
    from scipy.optimize import minimize_scalar

    if len(blocks) < FEWEST or any(equation.bias is None for equation in columns):
        return blocks
    coarse = blocks.merged(priors("inference")["blocks"]["coarse"])
    known = [
        effects
        for k, equation in enumerate(columns)
        if (effects := _effects(replace(coarse, gram=coarse.gram[:, k : k + 1]), equation)) is not None
    ]
    if not known:
        return blocks
    within, offset, z = (np.concatenate(parts) for parts in zip(*known, strict=True))
    usual, far = (priors("inference")["zero"][name] for name in ("pressure", "far"))
    width = columns[0].zero_deviation(columns[0].leak, blocks)
    walks = WALKS[: int(_likelihoods(within, z, WALKS).argmax()) + 1]

    def likelihood(position: float) -> float:
        return float(_likelihoods(within - width * np.sinh(position) * offset, z, walks).max())

    def cost(position: float) -> float:
        return 0.5 * cost_of_zero(usual * float(np.sinh(position))) - likelihood(position)

    positions = np.arcsinh(3.0 * far / usual) * np.linspace(-1.0, 1.0, TRIED)
    # the likelihood rises towards a zero from far away, beside which what is believed would hide it
    starts = {TRIED // 2, int(np.argmax([likelihood(position) for position in positions]))}
    ends = [(positions[max(start - 1, 0)], positions[min(start + 1, TRIED - 1)]) for start in starts]
    fits = [minimize_scalar(cost, bounds=end, method="bounded", options={"xatol": 1e-3}) for end in ends]
    position = min(fits, key=lambda fit: fit.fun).x
    zero, gram = width * float(np.sinh(position)), blocks.gram.copy()
    for k, equation in enumerate(columns):
        assert equation.bias is not None
        gram[:, k, equation.leak] -= zero * gram[:, k, equation.bias]
        gram[:, k, :, equation.leak] -= zero * gram[:, k, :, equation.bias]
    return replace(blocks, gram=gram, zero=blocks.zero + zero)


def _effects(blocks: Blocks, columns: Columns) -> tuple[Array, Array, Array] | None:
    """Return whitened effects (n, K) of a step of leak and of offset, and residuals z (n,); None: too little is known.

    Column k is a step from block k on; that of the leak goes with the recorded mean pressure difference.
    """
    count = len(blocks)
    precision, vector, middle = pair(blocks, columns)
    scale = np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(precision / np.outer(scale, scale))
    kept = values > RANK * max(float(values[-1]), 0.0)
    index = np.linspace(-1.0, 1.0, count)
    trend, drift = (np.polynomial.legendre.legvander(index, degree) for degree in (1, 2))
    fixed = np.block([[trend, np.zeros_like(drift)], [middle[:, None] * trend, drift]])
    if np.count_nonzero(kept) < fixed.shape[1] + FEWEST - 2:
        return None
    root = np.sqrt(values[kept])
    design = (vectors[:, kept] * root).T * scale
    fixed = design @ fixed
    fixed /= np.maximum(np.linalg.norm(fixed, axis=0), np.finfo(float).tiny)
    free = np.linalg.qr(fixed, mode="complete")[0][:, fixed.shape[1] :].T
    z = free @ ((vectors[:, kept].T @ (vector / scale)) / root)
    steps = np.tril(np.ones((count, count)))
    offset = free @ design[:, count:]
    return (free @ design[:, :count] + offset * middle) @ steps, offset @ steps, z


def _likelihoods(steps: Array, z: Array, walks: Array) -> Array:
    """Return the log-likelihood of z (n,) for each walk, beside its best step; a walk takes each of `steps` (n, K)."""
    eigen, basis = np.linalg.eigh(steps.T @ steps)
    kept = eigen > RANK * max(float(eigen[-1]), np.finfo(float).tiny)
    eigen, basis, n = eigen[kept], basis[:, kept], len(z)
    walks = walks * n / max(float(eigen.sum()), np.finfo(float).tiny)
    spread = 1.0 + walks[:, None] * eigen
    directions = steps @ (basis / np.sqrt(eigen))
    inside = directions.T @ z
    outside = z - directions @ inside
    total = float(outside @ outside) + (inside**2 / spread).sum(axis=1)
    lead = (np.sqrt(eigen) * inside / spread) @ basis.T
    size = np.maximum((eigen / spread) @ (basis**2).T, np.finfo(float).tiny)
    rest = np.maximum(total - (np.maximum(lead, 0.0) ** 2 / size).max(axis=1), 1e-9 * total)
    return np.asarray(-0.5 * np.log(spread).sum(axis=1) - 0.5 * n * np.log(rest))
