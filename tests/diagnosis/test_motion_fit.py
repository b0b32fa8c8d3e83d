"""The least-squares solution by a triangular factor, beside that of all rows' singular values."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.changes.motion_fit import solve_weighted, stack_equations


@pytest.mark.parametrize("rank", ["full", "too low"])
def test_the_factor_solves_as_all_rows_do(rank: str) -> None:
    """The bins of the position add up to the sign of a motion in one direction: the shortest solution is taken."""
    rng = np.random.default_rng(0)
    speed = rng.normal(size=500) if rank == "full" else rng.uniform(0.5, 1.0, 500)
    bins = np.eye(6)[rng.integers(0, 6, 500)]
    design = np.column_stack([np.sign(speed), np.linspace(-0.5, 0.5, 500), speed, bins])
    assert (np.linalg.matrix_rank(design) == design.shape[1]) == (rank == "full")
    values, weight = 1e5 * rng.normal(size=500), rng.uniform(0.0, 1.0, 500)
    expected = np.linalg.lstsq(design * weight[:, None], values * weight, rcond=None)[0]
    found = solve_weighted(stack_equations(design, values), weight)
    assert found == pytest.approx(expected, rel=1e-11, abs=1e-11 * np.abs(expected).max())
