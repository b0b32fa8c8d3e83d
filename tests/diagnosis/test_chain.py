"""The precision of wandering parameters against its dense matrix, element by element."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.pressure_model.tracking.chain import Chain, Drifting


def dense(N: np.ndarray, walk: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return Lambda as its definition says."""
    blocks, p, _ = N.shape
    matrix = np.zeros((blocks, p, blocks, p))
    for b in range(blocks):
        matrix[b, :, b] += N[b] + 1e-10 * np.diag(np.diagonal(N[b]))
    for b in range(1, blocks):
        for k in range(p):
            weight = 1.0 / walk[b - 1, k] ** 2
            matrix[b, k, b, k] += weight
            matrix[b - 1, k, b - 1, k] += weight
            matrix[b - 1, k, b, k] -= weight
            matrix[b, k, b - 1, k] -= weight
    for k in range(p):
        matrix[:, k, :, k] += anchor[k] / blocks**2
    return matrix.reshape(blocks * p, blocks * p)


@pytest.mark.parametrize("unseen", [False, True], ids=["each parameter shows", "one is known by its anchor alone"])
@pytest.mark.parametrize("blocks", [2, 3, 17])
def test_the_chain_is_the_dense_matrix(blocks: int, unseen: bool) -> None:
    rng = np.random.default_rng(blocks)
    p = 5
    X = rng.standard_normal((blocks, 8, p)) * np.array([1.0, 30.0, 0.1, 1.0, 5.0])
    if unseen:
        X[:, :, 3] = 0.0
    N = X.transpose(0, 2, 1) @ X
    walk = rng.uniform(0.05, 2.0, (blocks - 1, p))
    anchor = np.array([3.0, 0.0, 1e-3, 0.7, 40.0])
    matrix, chain = dense(N, walk, anchor), Chain(N, walk, anchor)
    right = rng.standard_normal((blocks * p, 3))
    solution = np.linalg.solve(matrix, right)
    assert chain.solve(right) == pytest.approx(solution, rel=1e-8, abs=1e-10 * np.abs(solution).max())
    assert chain.log_determinant() == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-10)


def test_a_drift_is_the_dense_matrix_of_wandering_and_amounts_together() -> None:
    rng = np.random.default_rng(4)
    blocks, p, q = 9, 5, 4
    X = rng.standard_normal((blocks, 8, p)) * np.array([1.0, 30.0, 0.1, 1.0, 5.0])
    N, walk, anchor = X.transpose(0, 2, 1) @ X, rng.uniform(0.05, 2.0, (blocks - 1, p)), np.full(p, 2.0)
    courses = rng.standard_normal((blocks, p, q))
    courses -= courses.mean(axis=0)
    U, seen = courses.reshape(-1, q), np.concatenate([N[b] @ courses[b] for b in range(blocks)])
    joint = np.block([[dense(N, walk, anchor), seen], [seen.T, U.T @ seen + np.eye(q)]])
    right = rng.standard_normal((blocks * p, 3))
    both = np.linalg.solve(joint, np.vstack([right, U.T @ right]))
    solution = both[: blocks * p] + U @ both[blocks * p :]
    drifting = Drifting(Chain(N, walk, anchor), N, courses)
    assert drifting.solve(right) == pytest.approx(solution, rel=1e-7, abs=1e-9 * np.abs(solution).max())
    assert drifting.log_determinant() == pytest.approx(np.linalg.slogdet(joint)[1], rel=1e-9)


def test_what_is_not_positive_definite_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        Chain(-np.ones((3, 2, 2)), np.ones((2, 2)), np.zeros(2)).log_determinant()
