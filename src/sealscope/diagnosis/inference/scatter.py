"""Is it more than in the baseline? A recording's leakage against the scatter between healthy recordings.

The sums of the baseline's recordings, the zero of the flow of each set aside, are added up and give the coefficients of
all terms; what a recording's own rows leave of them along the leak's column is its rise. The rise of each healthy
recording against the others measures how recordings differ; whatever the model does not describe is in it, once.

    t = rise / (s sqrt(1 + 1/n)),    s^2 = (nu_0 s_0^2 + sum_j r_j^2 ((n - 1)/n)^2) / (nu_0 + n - 1),

Student's t with nu_0 + n - 1 degrees of freedom: r_j is the rise of recording j of n against the n - 1 others, s_0 and
nu_0 what is believed of the scatter beforehand (`terms.toml`).

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve, total
from sealscope.diagnosis.inference.terms import priors
from sealscope.recordings.recording import Array


class Rise(NamedTuple):
    """The leak's coefficient beyond the baseline's: `value` and its `deviation`, with `freedom` degrees of freedom."""

    value: float
    deviation: float
    freedom: float

    @property
    def score(self) -> float:
        """Student's t of the rise."""
        return self.value / self.deviation

    @property
    def chance(self) -> float:
        """Probability that a healthy recording scores as high."""
        from scipy.special import stdtr

        return float(stdtr(self.freedom, -self.score))

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy recording exceeds with a probability."""
        from scipy.special import stdtrit

        return float(stdtrit(self.freedom, 1.0 - chance))

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the interval of the rise that holds with a probability."""
        half = self.threshold(0.5 - 0.5 * probability) * self.deviation
        return self.value - half, self.value + half


class Taught(NamedTuple):
    """What a healthy recording teaches of its machine.

    `sums` (E, m, m) of its rows, the zero of its flow set aside; `flow` of the pump and `pressure`, mean sizes
    [m^3/s], [Pa].
    """

    sums: Array
    flow: float
    pressure: float

    @classmethod
    def of(cls, blocks: Blocks, columns: Sequence[Columns]) -> Taught:
        """Return that of a recording's blocks."""
        weights = np.maximum(blocks.rows, 1e-9)
        flow, pressure = (float(np.average(of, weights=weights)) for of in (blocks.means[:, 2], blocks.driving()))
        return cls(_about_own(total(blocks, columns), columns), flow, pressure)


def rise(judged: Taught, baseline: Sequence[Array], columns: Sequence[Columns]) -> Rise:
    """Return how far the leak's coefficient of a recording is beyond that of healthy recordings of the same machine.

    `baseline`: the sums of each of them.
    """
    everything = np.sum(baseline, axis=0)
    value = _rise(judged.sums, everything, columns)
    share = priors()["scatter"]["leak"].value
    believed = share * judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    apart = [_rise(own, everything - own, columns) for own in baseline] if len(baseline) > 1 else [0.0]
    return student(value, apart, believed)


def motion_change(judged: Array, baseline: Sequence[Array], columns: Columns) -> Rise:
    """Return the logarithm of the flow that motion takes in a recording, over that in healthy ones, as they scatter.

    Of the sums (m, m) of one equation. Area over displacement differs by it: another machine, or another scale.
    """
    everything, motion = np.sum(baseline, axis=0), list(columns.motion)
    chosen = list(columns.nuisance)

    def logarithm(own: Array, reference: Array) -> float:
        flows = [
            np.diag(own)[motion] @ solve(of[np.ix_(chosen, chosen)], of[chosen, columns.left])[at]
            for of in (own, reference)
        ]
        return float(np.log(np.maximum(np.abs(flows), np.finfo(float).tiny)) @ [1.0, -1.0])

    at = [chosen.index(k) for k in motion]
    apart = [logarithm(own, everything - own) for own in baseline] if len(baseline) > 1 else [0.0]
    return student(logarithm(judged, everything), apart, priors()["between"]["motion"].value)


def student(value: float, apart: Sequence[float], believed: float) -> Rise:
    """Return a rise against n healthy recordings, each of which is so far `apart` from the others.

    `believed`: what is believed of the scatter beforehand.
    """
    beliefs, count = priors()["scatter"], len(apart)
    squares = beliefs["freedom"].value * believed**2
    freedom = beliefs["freedom"].value + count - 1
    if count > 1:
        squares += float(np.sum(np.square(apart))) * ((count - 1) / count) ** 2
    deviation = np.sqrt(squares / freedom * (1.0 + 1.0 / count))
    return Rise(value, max(float(deviation), np.finfo(float).tiny), freedom)


def _about_own(sums: Array, columns: Sequence[Columns]) -> Array:
    """Return a recording's sums (E, m, m) with the coefficients set aside that nothing ties to another recording's."""
    reduced = sums.copy()
    for e, column in enumerate(columns):
        apart = [k for k in column.nuisance if k != column.leak and not np.isfinite(column.between[k])]
        cross = sums[e][:, apart]
        reduced[e] -= cross @ solve(sums[e][np.ix_(apart, apart)], cross.T)
        reduced[e][apart] = reduced[e][:, apart] = 0.0
    return reduced


def _rise(own: Array, reference: Array, columns: Sequence[Columns]) -> float:
    """Return the rise of the leak's coefficient in one recording's sums (E, m, m) beyond those of others.

    The recording's other coefficients differ from theirs by what is believed of recordings of one machine.
    """
    precision, vector = 0.0, 0.0
    for e, column in enumerate(columns):
        chosen = [k for k in column.nuisance if k == column.leak or np.isfinite(column.between[k])]
        coefficients = solve(reference[e][np.ix_(chosen, chosen)], reference[e][chosen, column.left])
        left = own[e][:, column.left] - own[e][:, chosen] @ coefficients
        others = [k for k in chosen if k != column.leak]
        size = np.abs(coefficients[[chosen.index(k) for k in others]])
        with np.errstate(divide="ignore", over="ignore"):
            belief = 1.0 / (size * column.between[others]) ** 2
        matrix = own[e][np.ix_(others, others)]
        matrix = matrix + np.diag(np.minimum(belief, 1e9 * np.diag(matrix)))
        along = own[e][others, column.leak]
        solved = solve(matrix, np.column_stack([along, left[others]]))
        precision += float(own[e][column.leak, column.leak] - along @ solved[:, 0])
        vector += float(left[column.leak] - along @ solved[:, 1])
    return vector / precision if precision > 0.0 else 0.0
