"""Parameters that wander from block to block: Gauss-Newton steps to the likeliest, and all blocks together.

With y(theta) what a model gives and theta_k the parameters of block k, each block is linear about its own theta_k^0,

    y_k(theta_k) = y_k(theta_k^0) + J_k (theta_k - theta_k^0),

and keeps sums only. What is left is Gaussian in all theta_k together (`Joint`), so that what the blocks say of one
parameter, all others eliminated, is a block of its inverse. Units are shares of what is believed of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from sealscope.diagnosis.inference.onset import Information
from sealscope.diagnosis.priors import priors as believed_of
from sealscope.recordings.recording import Array

#: Differences as a share of what is believed; most steps of a fit, shares of one that are tried, and the gain of twice
#: the log likelihood that is worth a run.
_NUDGE, STEPS, _SHARES, _ENOUGH = 0.05, 12, np.array([1.0, *np.geomspace(0.5, 0.02, 4)]), 5.0


class Normal(NamedTuple):
    """Normal prior on the parameters: mean (p,) and precision (p, p) in units."""

    mean: Array
    precision: Array


class Priors(NamedTuple):
    """Prior on the parameters (p,): centre and `width` of their mean, and how far they `wander` in 90 s."""

    centre: Array
    width: Array
    wander: Array

    @property
    def unit(self) -> Array:
        """Units of the parameters, small enough for differences."""
        return np.asarray(_NUDGE * np.minimum(self.width, self.wander))

    @property
    def normal(self) -> Normal:
        """Prior on a machine before its first block."""
        return Normal(self.centre, np.diag((self.unit / self.width) ** 2))

    def spread(self, seconds: float) -> Array:
        """Return the variances (p,), in units, that wandering adds in so many seconds."""
        time = believed_of("inference.pressures")["blocks"]["wander"]
        return np.asarray((self.wander / self.unit) ** 2 * (seconds / time))


class Look(NamedTuple):
    """A model about parameters `theta` (p,): `gram` (1 + p, 1 + p) of its residual [Pa] and Jacobian [Pa per unit].

    Of a simulation also these themselves, `rows` (1 + p, n), and the states at the end.
    """

    theta: Array
    gram: Array
    rows: Array = np.empty(0)
    ends: Array = np.empty(0)

    def cost(self, variance: float, prior: Normal, unit: Array) -> float:
        """Return minus twice the logarithm of the posterior, beside a noise's variance [Pa^2]."""
        off = (self.theta - prior.mean) / unit
        return float(self.gram[0, 0] / variance + off @ prior.precision @ off)


class Model(Protocol):
    """Model to be fitted; `unit` (p,) of its parameters."""

    @property
    def unit(self) -> Array: ...  # noqa: D102

    def look(self, paths: Array) -> tuple[Look, Array]:
        """Return the look about the first of some sets (m, p), and the squares [Pa^2] that each leaves, (m,)."""
        ...

    def bounds(self, theta: Array) -> tuple[Array, Array]:
        """Return between which parameters a step from `theta` may lead."""
        ...

    def spread(self, squares: float) -> float:
        """Return the variance of the noise [Pa^2] where so much is left."""
        ...


def descend(model: Model, look: Look, prior: Normal, steps: int, variance: float | None = None) -> Look:
    """Return the look about likelier parameters; their noise's variance [Pa^2] is fitted where it is not given.

    A whole step is run with its Jacobian, beside shares of it; where none of them gains, it is damped. A step is not
    made where it would gain less than is worth a run.
    """
    unit, damping = model.unit, 0.0
    for _ in range(steps):
        noise = variance or model.spread(float(look.gram[0, 0]))
        H = look.gram[1:, 1:] / noise + prior.precision
        rise = look.gram[0, 1:] / noise - prior.precision @ ((look.theta - prior.mean) / unit)
        move = np.linalg.solve(H + damping * np.diag(np.diag(H)), rise)
        if not float(rise @ move) >= _ENOUGH:
            break
        paths = np.clip(look.theta + _SHARES[:, None] * move * unit, *model.bounds(look.theta))
        whole, squares = model.look(paths)
        off = (paths - prior.mean) / unit
        costs = squares / noise + np.sum(off @ prior.precision * off, axis=1)
        gains = np.nan_to_num(look.cost(noise, prior, unit) - costs, nan=-np.inf)
        best = int(np.argmax(gains))
        if not gains[best] > 0.0:
            damping = max(10.0 * damping, 0.1)
            continue
        damping = 0.1 * damping if damping > 1e-3 else 0.0
        look = whole if best == 0 else model.look(paths[best : best + 1])[0]
    return look


class Block(NamedTuple):
    """A block's sums about its own parameters `theta` (p,).

    `gram` (1 + p, 1 + p) of residual and Jacobian over so many `samples`; `scores` (s, 1 + p): in each of s pieces the
    products of the column of the parameter in question with them, which show how far the residual is from white.
    """

    theta: Array
    gram: Array
    samples: float
    scores: Array


@dataclass(frozen=True, eq=False)
class Joint:
    """All K blocks of a recording together: deviations' `mean` (K p,) and `covariance` (K p, K p) about `theta` (K, p).

    In units, a block's after another's; `strain` (K p, K p): precision of what is believed of them; `variance` of the
    residual [Pa^2].
    """

    priors: Priors
    theta: Array
    mean: Array
    covariance: Array
    strain: Array
    variance: float

    @staticmethod
    def fit(blocks: Sequence[Block], priors: Priors, seconds: float, parameter: int) -> Joint:
        """Fit blocks of so many seconds jointly; the noise has its long-run variance in the score of `parameter`."""
        theta = np.array([block.theta for block in blocks])
        strain = _strain(len(blocks), priors, seconds)
        pull = strain @ ((theta - priors.centre) / priors.unit).ravel()
        normal = block_diag(*(block.gram[1:, 1:] for block in blocks))
        vector = np.concatenate([block.gram[0, 1:] for block in blocks])
        white, inflation = _noise(blocks, np.zeros(theta.size), parameter)[0], 1.0
        for _ in range(2):  # the noise's variance is one of the unknowns
            factor = cho_factor(normal / (white * inflation) + strain, check_finite=False)
            mean = cho_solve(factor, vector / (white * inflation) - pull, check_finite=False)
            white, inflation = _noise(blocks, mean, parameter)
        covariance = cho_solve(factor, np.eye(theta.size), check_finite=False)
        return Joint(priors, theta, mean, covariance, strain, white)

    def information(self, parameter: int, time: Array, reach: float) -> Information:
        """Compute the likelihood of a parameter in the blocks at `time` (K,) [s], all others eliminated.

        What is believed of the parameter itself, which guided the fit, is taken out; that it wanders evenly or as a
        random walk, by `reach` over all blocks, is stated beside.
        """
        places = slice(parameter, None, self.theta.shape[1])
        inverse = np.linalg.inv(self.covariance[places, places])
        believed, unit = self.strain[places, places], self.priors.unit[parameter]
        value, precision = self.theta[:, parameter] / unit, inverse - believed
        off = value - self.priors.centre[parameter] / unit
        vector = inverse @ self.mean[places] + believed @ off + precision @ value
        precision = 0.5 * (precision + precision.T) / unit**2
        return Information(time, precision, vector / unit, slope=reach, walk=reach)


def _strain(count: int, priors: Priors, seconds: float) -> Array:
    """Return the precision (K p, K p), in units, of what is believed of the parameters of K blocks."""
    steps = np.diff(np.eye(count), axis=0)
    walk = np.kron(steps.T @ steps, np.diag(1.0 / priors.spread(seconds)))
    return np.asarray(walk + np.kron(np.full((count, count), 1.0 / count**2), priors.normal.precision))


def _noise(blocks: Sequence[Block], off: Array, parameter: int) -> tuple[float, float]:
    """Return the variance [Pa^2] left at deviations (P,), and the long-run variance of the scores over it."""
    moved = [np.append(1.0, -deviation) for deviation in off.reshape(len(blocks), -1)]
    pairs = list(zip(blocks, moved, strict=True))
    squares = sum(float(direction @ block.gram @ direction) for block, direction in pairs)
    variance = max(squares, 1.0) / sum(block.samples for block in blocks)
    scores = np.concatenate([block.scores @ direction for block, direction in pairs])
    expected = variance * sum(float(block.gram[1 + parameter, 1 + parameter]) for block in blocks)
    return variance, max(1.0, float(scores @ scores) / max(expected, np.finfo(float).tiny))
