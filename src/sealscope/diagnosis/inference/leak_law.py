"""Mean flow of a leak whose law is unknown, from the conductance in blocks: laminar, an orifice, or between the two.

The law of a leak is the exponent e of its flow c |p_A - p_B|^e. Such a leak changes the conductance of block k by c
r_k, where r_k is the regression coefficient of |p_A - p_B|^e on the pressure difference within the block. A step test
with a size proportional to r_k in each block thus covers every law, and the healthy laminar leakage does not enter. The
flow of a leak that began within the recording follows in `volumes/leak_flow.py`.

The arguments `blocks` and `columns` are Gram matrices of the volume balance in K blocks of the recording, and for each
equation the roles of their columns (`blocks.ColumnRoles`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sealscope.diagnosis.estimate.change import Information, StepTest, step_test
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles
from sealscope.diagnosis.inference.equations.terms import ORIFICE
from sealscope.diagnosis.inference.hypotheses import LAWS
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Smallest divisor, and base of a power, where a block has no pressure difference.
_TINY = np.finfo(float).tiny


def apparent_conductances(blocks: Blocks, columns: Sequence[ColumnRoles]) -> dict[float, Array]:
    """Compute the conductance that a leak with the flow |p_A - p_B|^e appears to have in each of K blocks.

    For an orifice, e = 1/2, it is the regression coefficient r of its column on that of the laminar leak. For the other
    exponents it is approximated by r^(2 (1 - e)), which is 1 for laminar flow, e = 1. The result maps each exponent e
    of `LAWS` to an array (K,) [Pa^(e - 1)].
    """
    leak, orifice = columns[0].leak, columns[0].names.index(ORIFICE)
    gram = blocks.gram.sum(axis=1)  # sum over the equations
    energy = np.maximum(gram[:, leak, leak], _TINY)
    orifice_slope = np.maximum(gram[:, orifice, leak] / energy, _TINY)  # r
    return {exponent: orifice_slope ** (2.0 * (1.0 - exponent)) for exponent in LAWS}


def law_flows(blocks: Blocks) -> dict[float, Array]:
    """Compute the mean of |p_A - p_B|^e in each of K blocks: the flow of a leak with the coefficient 1.

    With dp = p_A - p_B, and <> for the mean over a block, it is approximated by <|dp|>^(2 e - 1) <|dp|^(1/2)>^(2 - 2
    e), exact for e = 1 (laminar) and e = 1/2 (orifice). The result maps each exponent e of `LAWS` to (K,) [Pa^e].
    """
    pressure, root = blocks.mean_pressure(), blocks.mean_root()
    return {exponent: pressure ** (2.0 * exponent - 1.0) * root ** (2.0 - 2.0 * exponent) for exponent in LAWS}


def with_turbulence(leak: Information, blocks: Blocks, columns: Sequence[ColumnRoles]) -> Information:
    """Add a prior for a turbulent part of the healthy leakage to `leak`, the likelihood of the conductance in K blocks.

    This part flows as through an orifice: it adds an unknown constant times the apparent conductance of an orifice,
    scaled to the mean 1 (`Information.shape`). The prior standard deviation of the constant (`Information.disturbance`)
    is the fraction `healthy.turbulent` (`priors.toml`) of the mean conductance. Without information on the conductance,
    `leak` is returned unchanged.
    """
    shape = apparent_conductances(blocks, columns)[0.5]
    weights = np.maximum(leak.precision.sum(axis=0), 0.0)  # information of each block; it may be negative
    total_weight = float(leak.precision.sum())
    mean_shape = float(weights @ shape) / max(float(weights.sum()), _TINY)
    if not (mean_shape > 0.0 and total_weight > 0.0):
        return leak
    # mean conductance; its sign does not matter, since it scales a standard deviation
    conductance = abs(float(leak.vector.sum())) / total_weight
    return leak._replace(disturbance=INFERENCE.healthy.turbulent * conductance, shape=shape / mean_shape)


def find_leak_step(blocks: Blocks, columns: Sequence[ColumnRoles], leak: Information) -> StepTest | None:
    """Test for a leak that begins within a recording, with a flow proportional to a power of |p_A - p_B|.

    A step is tested for each exponent of `LAWS`; the p-value of each is divided by the prior probability of the
    exponent, and the smallest one counts. For an exponent other than 1 the step varies with the pressure, and its size
    is the mean over the blocks, weighted by their information. `leak`: likelihood of the leak's coefficient in the
    blocks. Return None if too few blocks determine this coefficient.
    """
    weights = np.maximum(leak.precision.sum(axis=0), 0.0)  # information of each block; it may be negative
    shapes = apparent_conductances(blocks, columns)
    tests = []
    for exponent, prior in LAWS.items():
        mean_shape = float(weights @ shapes[exponent]) / max(float(weights.sum()), _TINY)
        test = step_test(leak, shape=shapes[exponent] / max(mean_shape, _TINY))
        if test is not None:
            tests.append(test.share_alarms(prior))
    # of equal p-values, such as 1, the highest score counts
    return min(tests, key=lambda test: (test.chance, -test.score), default=None)


def mixture_flow(probabilities: Array, flows: Array, deviations: Array) -> Estimate:
    """Compute mean and standard deviation of a mixture of k estimates of a flow [m^3/s] or another quantity.

    `probabilities`, `flows`, `deviations` (k,): those of the estimates, and these with their standard errors.
    """
    value = float(probabilities @ flows)
    return Estimate(value, float(np.sqrt(probabilities @ (deviations**2 + (flows - value) ** 2))))
