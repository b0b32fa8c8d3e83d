"""Comparison of laws and terms by how well they explain the flow by which a recording exceeds healthy recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.comparison.recording_sums import (
    RecordingSums,
    marginal_difference,
    subtract_reference,
)
from sealscope.diagnosis.inference.equations.terms import AIR, LEAK, ORIFICE
from sealscope.diagnosis.inference.hypotheses import compare_residuals
from sealscope.recordings.recording import Array
from sealscope.signals.smoothing import TINY


class LawFit(NamedTuple):
    """Comparison of an orifice's law with the laminar law, for leakage above that of healthy recordings.

    `regression`: slope of the flow sign(dp) sqrt(abs(dp)) of a unit orifice on dp = p_A - p_B [Pa^-0.5], with all other
    terms eliminated; `log_ratio`: log likelihood ratio of the orifice to the laminar leak.
    """

    regression: float
    log_ratio: float


def compare_laws(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles]
) -> LawFit | None:
    """Compare how well a turbulent leak through an orifice and a laminar leak explain a recording's excess flow.

    Both are fitted alone, with all other columns integrated out, in all balances together; the coefficient may be
    negative. The result is the log of the likelihood ratio of the orifice to the laminar leak (`compare_residuals`),
    and the laminar coefficient that fits an orifice of coefficient 1. Return None if a balance has no column
    of an orifice, if the recording has no information on one of the two leaks, or if their columns, both with the sign
    of p_A - p_B, are not positively correlated.
    """
    if any(ORIFICE not in roles.names for roles in columns):
        return None
    gram, moments, left_square = _fit_excess(judged, baseline, columns, [LEAK, ORIFICE])
    energies, cross = np.diag(gram), gram[0, 1]
    if not energies.min() > 0.0 or not cross > 0.0:
        return None
    min_square = 1e-9 * abs(left_square) + TINY  # above rounding errors
    square_laminar, square_orifice = np.maximum(left_square - moments**2 / energies, min_square)
    return LawFit(float(cross / energies[0]), compare_residuals(square_orifice, square_laminar))


def compare_with_leak(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles], rival: str
) -> float | None:
    """Compare how well the leak and another term of the volume balance, `rival`, explain a recording's excess flow.

    Returns the log likelihood ratio of rival to leak (`compare_residuals`). While the rival (for example an external
    leak) is fitted, the leak may differ as it does between healthy recordings. A negative coefficient is not fitted,
    except that of free air, of which there may be less. Return None if the balance has no column named `rival`, or if
    the recording has no information on the leak or on the rival.
    """
    if any(rival not in roles.names for roles in columns):
        return None
    squares = []
    for name in (LEAK, rival):
        gram, moments, left_square = _fit_excess(judged, baseline, columns, [name], has_leak=name == rival)
        energy, moment = float(gram[0, 0]), float(moments[0])
        if not energy > 0.0:
            return None
        if name != AIR:
            moment = max(moment, 0.0)
        # above rounding errors
        squares.append(max(left_square - moment**2 / energy, 1e-9 * abs(left_square) + TINY))
    return compare_residuals(squares[1], squares[0])


def _fit_excess(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    columns: Sequence[ColumnRoles],
    names: Sequence[str],
    *,
    has_leak: bool = False,
) -> tuple[Array, Array, float]:
    """Compute the sums of a fit of c tested terms, by `names`, to the residual of `judged` under the `baseline`.

    All other terms are eliminated, the leak only if `has_leak` (`subtract_reference`). Returns sums over the equations:
    Gram matrix (c, c) of the tested columns, their products (c,) with the residual, and the residual's sum of squares.
    """
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    total = Gaussian(np.zeros((len(names), len(names))), np.zeros(len(names)))
    for e, roles in enumerate(columns):
        tested = [roles.names.index(name) for name in names]
        residual, nuisance, prior = subtract_reference(judged.sums[e], reference[e], roles, has_leak=has_leak)
        total += marginal_difference(residual, tested, nuisance, prior)
    return total.precision, total.moment, total.square
