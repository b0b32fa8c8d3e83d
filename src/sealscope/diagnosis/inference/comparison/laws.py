"""Comparison of laws and terms by how well they explain the flow by which a recording exceeds healthy recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.comparison.coefficients import eliminate, subtract_reference
from sealscope.diagnosis.inference.comparison.recording_sums import RecordingSums
from sealscope.diagnosis.inference.comparison.rise import TINY
from sealscope.diagnosis.inference.equations.terms import AIR, ORIFICE


class LawFit(NamedTuple):
    """Comparison of an orifice's law with the laminar law, for leakage above that of healthy recordings.

    `regression`: slope of the flow sign(dp) sqrt(abs(dp)) of a unit orifice on dp = p_A - p_B [Pa^-0.5], with all other
    terms eliminated; `log_ratio`: log likelihood ratio of the orifice to the laminar leak for one independent residual,
    -log(residual sum of squares with the orifice / the same with the laminar leak) / 2. A recording counts as
    `size.readings` independent residuals (`priors.toml`).
    """

    regression: float
    log_ratio: float


def compare_laws(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles]
) -> LawFit | None:
    """Compare how well a turbulent leak through an orifice and a laminar leak explain a recording's excess flow.

    Each leak is fitted to the residual that remains if the coefficients of the healthy recordings, `baseline`, predict
    the recording `judged`. `columns`: roles of the columns of each volume balance; all balances are fitted together.
    Return None if a balance has no column of an orifice, if the recording has no information on one of the two leaks,
    or if their columns are not positively correlated.
    """
    if any(ORIFICE not in roles.names for roles in columns):
        return None
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    grams, moments, square_without_leak = np.zeros((2, 2)), np.zeros(2), 0.0
    for e, roles in enumerate(columns):
        leaks = [roles.leak, roles.names.index(ORIFICE)]  # laminar, orifice
        reduced = eliminate(*subtract_reference(judged.sums[e], reference[e], roles))
        grams += reduced[np.ix_(leaks, leaks)]
        moments += reduced[leaks, roles.left]
        square_without_leak += float(reduced[roles.left, roles.left])
    energies, cross = np.diag(grams), grams[0, 1]
    if not energies.min() > 0.0 or not cross > 0.0:
        return None
    min_square = 1e-9 * abs(square_without_leak) + TINY  # above rounding errors
    square_laminar, square_orifice = np.maximum(square_without_leak - moments**2 / energies, min_square)
    log_ratio = float(-0.5 * np.log(square_orifice / square_laminar))
    return LawFit(regression=float(cross / energies[0]), log_ratio=log_ratio)


def compare_with_leak(
    judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[ColumnRoles], rival: str
) -> float | None:
    """Compare how well the leak and another term of the volume balance, `rival`, explain a recording's excess flow.

    Each of the two is fitted to the residual of the recording `judged` under the coefficients of the healthy
    recordings, `baseline`. Returns the log likelihood ratio of rival to leak per independent residual,

        -log(residual sum of squares with the rival / the same with the leak) / 2.

    While the rival (for example an external leak) is fitted, the leak may differ as it does between healthy recordings.
    A negative coefficient is not fitted, except that of free air, of which there may be less. Return None if the
    balance has no column named `rival`, or if the recording has no information on the leak or on the rival.
    """
    if any(rival not in roles.names for roles in columns):
        return None
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    residual_squares = []
    for is_rival in (False, True):
        # sums over the equations: square of the tested column, its product with the residual, square of the residual
        energy = moment = square_without = 0.0
        for e, roles in enumerate(columns):
            tested = roles.names.index(rival) if is_rival else roles.leak
            reduced = eliminate(*subtract_reference(judged.sums[e], reference[e], roles, has_leak=is_rival))
            energy += float(reduced[tested, tested])
            moment += float(reduced[tested, roles.left])
            square_without += float(reduced[roles.left, roles.left])
        if not energy > 0.0:
            return None
        can_be_negative = is_rival and rival == AIR  # there may be less air, but oil only leaves
        gain = (moment if can_be_negative else max(moment, 0.0)) ** 2 / energy  # decrease of the residual square
        min_square = 1e-9 * abs(square_without) + TINY  # above rounding errors
        residual_squares.append(max(square_without - gain, min_square))
    with_leak, with_rival = residual_squares
    return float(-0.5 * np.log(with_rival / with_leak))
