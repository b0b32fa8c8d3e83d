"""The likelihood of the coefficients of a linear model, or a normal density of them, as its precision and moment.

A regression of a left side y on columns X, with coefficients c and errors of variance s^2, has the log likelihood

    -(c' A c - 2 c' b + q) / 2,    A = X' X / s^2,    b = X' y / s^2,    q = y' y / s^2.

Likelihoods of independent rows add, a normal prior adds its own precision, and a coefficient that is of no interest is
integrated out by a Schur complement. All blocks, recordings and equations of the diagnosis are combined in this way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from sealscope.compiled import large_law
from sealscope.recordings.recording import Array

#: Relative increase of a matrix diagonal, against rounding.
RIDGE = 1e-10
#: Largest prior precision of a coefficient over that by the data: enough to fix the coefficient.
MAX_PRIOR = 1e9
_LOG_2_PI = float(np.log(2.0 * np.pi))


def solve(matrix: Array, right: Array) -> Array:
    """Solve matrix x = right for a positive semidefinite `matrix` (n, n) and `right` (n,) or (n, k).

    The matrix is scaled to a unit diagonal, to which the small number `RIDGE` is added. Components of x in the null
    space of the matrix are about zero.
    """
    scale = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    scale[~(scale > 0.0)] = 1.0  # a column of zeros stays as it is
    column = scale[:, None]
    scaled = matrix / column / scale
    scaled.flat[:: len(scale) + 1] += RIDGE  # this stride selects the diagonal
    right_scale = scale if right.ndim == 1 else column
    scaled_right = right / right_scale
    if not scaled_right.size:  # nothing to solve
        return np.asarray(scaled_right)
    # of LAPACK, which is faster for a few columns than NumPy
    _, solution, has_failed = dposv(scaled, scaled_right)
    if has_failed:  # not positive definite, by rounding
        solution = np.asarray(np.linalg.solve(scaled, scaled_right))
    return np.asarray(solution / right_scale)


@large_law
def solve_in_place(matrix: Any, values: Any, scale: Any) -> None:
    """Solve a system of equations as `solve` does, in compiled code.

    `matrix` (n, n): positive semidefinite, of which the upper triangle is used and overwritten by D L' of its factors
    L D L'; `values` (n,): right side, replaced by the solution; `scale` (n,): scratch.
    """
    n = len(values)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else 1.0
    for i in range(n):
        values[i] *= scale[i]
        for j in range(i, n):
            matrix[i, j] *= scale[i] * scale[j]
        matrix[i, i] += RIDGE
    for i in range(n):
        inverse = 1.0 / matrix[i, i]
        for k in range(i + 1, n):
            factor = matrix[i, k] * inverse
            values[k] -= factor * values[i]
            for j in range(k, n):
                matrix[k, j] -= factor * matrix[i, j]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            values[i] -= matrix[i, j] * values[j]
        values[i] /= matrix[i, i]
    for i in range(n):
        values[i] *= scale[i]


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Log likelihood -(c' A c - 2 c' b + q)/2 of n coefficients c; without q also a normal density up to its factor.

    A coefficient without information has a row and column of zeros, and counts as 0.

    Attributes
    ----------
    precision : array, (n, n)
        A, the inverse of the covariance where that exists.
    moment : array, (n,)
        b, the precision times the most probable coefficients.
    square : float
        q, the sum of squares of the left side; 0 where only coefficients are of interest.
    """

    precision: Array
    moment: Array
    square: float = 0.0

    @staticmethod
    def from_gram(gram: Array) -> Gaussian:
        """Take the likelihood of a regression from its Gram matrix (n + 1, n + 1), with the left side last."""
        return Gaussian(gram[:-1, :-1], gram[:-1, -1], float(gram[-1, -1]))

    @property
    def gram(self) -> Array:
        """The Gram matrix (n + 1, n + 1) of a regression with this likelihood (`from_gram`)."""
        return np.block([[self.precision, self.moment[:, None]], [self.moment, np.array(self.square)]])

    def __add__(self, other: Gaussian) -> Gaussian:
        """Multiply two independent likelihoods of the same coefficients."""
        return Gaussian(self.precision + other.precision, self.moment + other.moment, self.square + other.square)

    def with_prior(self, precisions: Array, mean: Array | float = 0.0) -> Gaussian:
        """Multiply by independent normal priors with the `precisions` (n,) about the `mean` (n,) or a number.

        A precision may be infinite: all are limited to 1e9 times those of the data, which fixes a coefficient. A
        coefficient without data gets no prior.
        """
        limited = limit_precisions(precisions, self.precision)
        precision = self.precision.copy()
        precision.flat[:: len(precision) + 1] += limited
        return Gaussian(precision, self.moment + limited * mean, self.square + float((limited * mean**2).sum()))

    def subtract(self, coefficients: Array) -> Gaussian:
        """Compute the likelihood of the differences from `coefficients` (n,), with the residual as the left side."""
        moment = self.moment - self.precision @ coefficients
        return Gaussian(self.precision, moment, self.square - float(coefficients @ (self.moment + moment)))

    def __truediv__(self, variance: float) -> Gaussian:
        """Divide the log likelihood by the `variance` of a row, where the sums are those of rows of any variance."""
        return Gaussian(self.precision / variance, self.moment / variance, self.square / variance)

    def integrate_out(self, coupling: Array, tested: Gaussian) -> Gaussian:
        """Compute the likelihood of k `tested` coefficients, with these n coefficients integrated out.

        With the joint precision [[O, C], [C', A]] and the moments (o, b), where C (k, n) is the `coupling`, it has the
        Schur complement O - C A^-1 C' as its precision, and the moment o - C A^-1 b.
        """
        solution = solve(self.precision, np.column_stack([coupling.T, self.moment]))
        return Gaussian(
            tested.precision - coupling @ solution[:, :-1],
            tested.moment - coupling @ solution[:, -1],
            tested.square - float(self.moment @ solution[:, -1]),
        )

    def marginal(self, kept: Sequence[int], dropped: Sequence[int]) -> Gaussian:
        """Compute the likelihood of the coefficients `kept` (k,), with those `dropped` (d,) integrated out.

        Coefficients of neither group count as 0.
        """
        coupling = self.precision[np.ix_(kept, dropped)]
        return self.among(dropped).integrate_out(coupling, self.among(kept))

    def drop(self, dropped: Sequence[int]) -> Gaussian:
        """Integrate out the coefficients `dropped`, which keep their places, with zeros."""
        marginal = self.among(dropped).integrate_out(self.precision[:, dropped], self)
        marginal.precision[dropped] = marginal.precision[:, dropped] = marginal.moment[dropped] = 0.0
        return marginal

    def among(self, columns: Sequence[int]) -> Gaussian:
        """Compute the likelihood of some coefficients, by their places `columns`, where all others are 0."""
        places = np.array(columns, dtype=np.intp)  # `np.ix_` takes longer than the selection
        return Gaussian(self.precision[places[:, None], places], self.moment[places], self.square)

    def transform(self, matrix: Array) -> Gaussian:
        """Compute the likelihood of k coefficients d, of which c = T d, with the `matrix` T (n, k)."""
        return Gaussian(matrix.T @ self.precision @ matrix, matrix.T @ self.moment, self.square)

    def widen(self, variances: Array) -> Gaussian:
        """Add independent errors of the coefficients, with `variances` (n,), to the covariance.

        With their diagonal matrix E, the covariance A^-1 + E has the inverse (I + A E)^-1 A, without A^-1, which may
        not exist.
        """
        widening = np.linalg.inv(np.eye(len(self.moment)) + self.precision * variances)
        return Gaussian(widening @ self.precision, widening @ self.moment)

    @property
    def mean(self) -> Array:
        """The most probable coefficients (n,), A^-1 b."""
        return solve(self.precision, self.moment)

    @property
    def covariance(self) -> Array:
        """The covariance (n, n) of the coefficients, A^-1."""
        return solve(self.precision, np.eye(len(self.moment)))

    def robust_covariance(self, spread: Array) -> Array:
        """Compute White's covariance (n, n) of the coefficients from the `spread` (n, n) of the scores over blocks.

        A score is a block's product of the columns with the residual; with the sum S of s s' it is A^-1 S A^-1.

        Source: H. White, Econometrica 48 (1980) 817.
        """
        inverse = self.covariance
        return np.asarray(inverse @ spread @ inverse)

    def contrast(self, weights: Array) -> tuple[float, float]:
        """Compute the mean and the variance of the weighted sum of the coefficients, with `weights` (n,)."""
        factors = solve(self.precision, weights)
        return float(factors @ self.moment), float(factors @ weights)

    @property
    def residual_square(self) -> float:
        """The least value of c' A c - 2 c' b + q: the residual's sum of squares, plus what the prior adds."""
        return self.square - float(self.moment @ self.mean)

    def evidence(self) -> float:
        """Compute the log of the likelihood's integral over all coefficients; A must be positive definite.

        With the densities of the errors and the priors as factors, this is the log probability of the data under the
        model, by which hypotheses are compared: -(q - b' A^-1 b)/2 - log det(A / 2 pi)/2.
        """
        _, log_determinant = np.linalg.slogdet(self.precision)
        return -0.5 * (self.residual_square + float(log_determinant) - len(self.moment) * _LOG_2_PI)


def limit_precisions(prior: Array, precision: Array) -> Array:
    """Limit prior precisions (n,), which may be infinite, to 1e9 times those of the data, the diagonal of `precision`.

    This is enough to fix a coefficient, and 0 for a column of zeros, whose coefficient `solve` makes 0.
    """
    return np.minimum(prior, MAX_PRIOR * np.diag(precision))
