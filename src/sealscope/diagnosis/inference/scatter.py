"""Is it more than in the baseline? A recording's leakage against the scatter between healthy recordings.

The sums of the baseline's recordings, the zero of the flow of each set aside, are added up and give the coefficients of
all terms; what a recording's own rows leave of them along the leak's column is its rise. The rise of each healthy
recording against the others measures how recordings differ; whatever the model does not describe is in it, once. With
r_j the rise of recording j of n against the n - 1 others, y_j = r_j (n - 1)/n; for the judged one y is its rise.

All y are normal about a mean near that of the sums, with the variance sigma^2 of each by itself and a covariance
between them of which there are several candidates (`Among`). sigma^2 has a scaled inverse chi square prior (s_0, nu_0):
the rise, y beyond what the others let expect, follows a mixture over both; with no covariance it is Student's with
nu_0 + n - 1 degrees of freedom. Recordings of one session, by their dates, share oil and set-up: a deviation tau of
sessions, half-normal beforehand, of leakage in proportion to its level, for it goes with the inverse of the oil's
viscosity. Recordings without a date are of one session. Where the oil's temperature T is known of all, what it makes of
the level is taken off, and only that factor's error remains. What is believed stands in `priors.toml`.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 5.4 and 5.7; C. E. Rasmussen and C. K.
I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown mean).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.beliefs import beliefs
from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve, total
from sealscope.diagnosis.inference.weak_form import LARGEST
from sealscope.recordings.recording import Array

#: Nodes of a deviation, and the largest one between sessions over what is believed; most recordings that are compared.
NODES, WIDEST, MOST = 32, 3.0, 60


class Mixture(NamedTuple):
    """A mixture of normal laws: `weights`, `deviations` and `centres` beside that of the whole, (k,) each."""

    weights: Array
    deviations: Array
    centres: Array


class Rise(NamedTuple):
    """The leak's coefficient beyond the baseline's: `value` and its `deviation`, with `freedom` degrees of freedom.

    `parts`: the mixture that it follows, where that is no single Student's law.
    """

    value: float
    deviation: float
    freedom: float
    parts: Mixture | None = None

    @property
    def score(self) -> float:
        """The rise over its deviation."""
        return self.value / self.deviation

    @property
    def chance(self) -> float:
        """Probability that a healthy recording scores as high."""
        return self._beyond(self.score)

    def _beyond(self, score: float) -> float:
        from scipy.special import ndtr, stdtr

        if self.parts is None:
            return float(stdtr(self.freedom, -score))
        weights, deviations, centres = self.parts
        return float(weights @ ndtr((centres - score * self.deviation) / deviations))

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy recording exceeds with a probability."""
        from scipy.optimize import brentq
        from scipy.special import ndtri, stdtrit

        if self.parts is None:
            return float(stdtrit(self.freedom, 1.0 - chance))
        ends = np.sort((self.parts.centres - ndtri(chance) * self.parts.deviations) / self.deviation)
        return float(brentq(lambda score: self._beyond(score) - chance, ends[0], ends[-1]))

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the interval of the rise that holds with a probability."""
        half = self.threshold(0.5 - 0.5 * probability) * self.deviation
        return self.value - half, self.value + half


class RecordingSums(NamedTuple):
    """What a recording says of its machine, to be added to what others say.

    `sums` (E, m, m) of its rows, the zero of its flow set aside; `flow` of the pump and `pressure`, mean sizes
    [m^3/s], [Pa]; `start_s`: its date [s since 1970], and `oil_degC`, its oil's temperature, None where
    they are not known.
    """

    sums: Array
    flow: float
    pressure: float
    start_s: float | None = None
    oil_degC: float | None = None

    @classmethod
    def of(
        cls,
        blocks: Blocks,
        columns: Sequence[Columns],
        start_s: float | None = None,
        oil_degC: float | None = None,
    ) -> RecordingSums:
        """Return that of a recording's blocks."""
        weights = np.maximum(blocks.rows, 1e-9)
        flow, pressure = (float(np.average(of, weights=weights)) for of in (blocks.flow, blocks.driving()))
        return cls(_about_own(total(blocks, columns), columns), flow, pressure, start_s, oil_degC)


def rise(judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[Columns]) -> Rise:
    """Return how far the leak's coefficient of a recording is beyond that of healthy recordings of the same machine."""
    everything, count = np.sum([own.sums for own in baseline], axis=0), len(baseline)
    believed, by_flow = beliefs("inference")["scatter"], judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    beyond = np.array([_rise(own.sums, everything - own.sums, columns) for own in baseline] if count > 1 else [0.0])
    *by_oil, warmer, oil = _of_oil([*baseline, judged], *_level(everything, columns))
    value, deviations = _rise(judged.sums, everything, columns) - warmer, beyond * ((count - 1) / count) - by_oil
    starts, pause = [own.start_s for own in (*baseline, judged)], 3600.0 * beliefs("inference")["oil"]["shift"]
    sessions = np.array(sessions_of(starts, pause))
    usual, apart = believed["leak"] * by_flow, float(np.hypot(oil, believed["session"] * by_flow))
    if len(set(sessions)) == 1:
        return student(value, deviations * (count / max(count - 1, 1)), usual)
    nodes = WIDEST * ((np.arange(NODES) + 0.5) / NODES) ** 2  # closer near zero
    alike = np.equal.outer(sessions, sessions)
    believed_of = 0.5 * np.log(nodes) - 0.5 * nodes**2
    among = Among(((apart * nodes) ** 2)[:, None, None] * alike, believed_of)
    return among.rise(value, deviations - deviations.mean(), usual, believed["freedom"])


class Among:
    """Values that are normal about an unknown mean, the last of them the judged one.

    Parameters
    ----------
    candidates : array of float, shape (g, n + 1, n + 1)
        Covariances between them, beside the variance of each by itself; those of n = 0 are of a single value.
    logarithms : array of float, shape (g,)
        Of what is believed of each candidate.
    """

    def __init__(self, candidates: Array, logarithms: Array) -> None:
        n = candidates.shape[1] - 1
        self._chosen = np.unique(np.linspace(0, n - 1, min(n, MOST)).astype(int))
        known = candidates[:, self._chosen[:, None], self._chosen]
        eigen, basis = np.linalg.eigh(known)
        self._eigen, self._basis = np.maximum(eigen, 0.0)[:, None], basis  # (g, 1, n), beside nodes of sigma
        self._cross = np.einsum("gij,gi->gj", basis, candidates[:, self._chosen, n])[:, None]
        self._ones = basis.sum(axis=1)[:, None]
        self._own, self._logarithms = candidates[:, n, n, None], logarithms[:, None]

    def rise(self, value: float, known: Array, usual: float, freedom: float) -> Rise:
        """Return by how much a `value` is beyond what those `known` (n,) let expect.

        `usual`, `freedom`: what is believed of the deviation sigma.
        """
        others, count = known[self._chosen], len(self._chosen)
        spread = float(np.sum((others - others.mean()) ** 2))
        squares = freedom * usual**2 + spread
        least = math.sqrt(max(0.1 * freedom * usual**2, 1e-9 * squares) / (freedom + count))
        most = 100.0 * math.sqrt(squares)
        if not most < LARGEST:  # numbers that cannot be computed with bound nothing
            return Rise(value, np.inf, freedom)
        variance = np.geomspace(max(least, 1.0 / LARGEST), max(most, 10.0 / LARGEST), NODES) ** 2
        weight = 1.0 / (variance[:, None] + self._eigen)  # (g, nodes, n)
        of_ones, cross = weight * self._ones, self._cross
        precision = (of_ones * self._ones).sum(axis=2)
        rotated = np.einsum("gij,i->gj", self._basis, others)[:, None]
        mean = (of_ones * rotated).sum(axis=2) / precision
        left = weight * (rotated - mean[..., None] * self._ones)
        logarithm = 0.5 * (np.log(weight).sum(axis=2) - np.log(precision) - (left * rotated).sum(axis=2))
        logarithm += self._logarithms - 0.5 * freedom * (np.log(variance) + usual**2 / variance)
        weights = np.exp(logarithm - logarithm.max())
        weights /= weights.sum()
        centres = mean + (left * cross).sum(axis=2)
        missing = 1.0 - (of_ones * cross).sum(axis=2)
        variances = variance + self._own - (weight * cross**2).sum(axis=2) + missing**2 / precision
        middle = float((weights * centres).sum())
        parts = Mixture(weights.ravel(), np.sqrt(variances).ravel(), (centres - middle).ravel())
        total = float((weights * (variances + (centres - middle) ** 2)).sum())
        return Rise(value - middle, float(np.sqrt(total)), np.inf, parts)


def sessions_of(starts: Sequence[float | None], pause: float) -> list[int]:
    """Return the session of each recording: a number of its own after every gap [s] longer than `pause`."""
    dates = sorted(own for own in starts if own is not None)
    begins = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > pause]
    return [-1 if own is None else int(np.searchsorted(begins, own, "right")) for own in starts]


def _of_oil(recordings: Sequence[RecordingSums], level: float, error: float) -> list[float]:
    """Return by how much each recording's leakage is beyond its mean over all but the last, for its oil's temperature.

    Last the deviation of the last one's: what may still differ, as far as the `level` within its `error` goes.
    """
    believed = beliefs("inference")["oil"]
    known = [own.oil_degC for own in recordings if own.oil_degC is not None]
    if len(known) < len(recordings):  # the difference of two sessions has twice the variance of each
        return [0.0] * len(recordings) + [0.5**1.5 * (believed["warmest"] - 1.0) * (level + error)]
    warmer = np.array(known) - np.mean(known[:-1])
    factor = np.exp(believed["per_kelvin"] * warmer)
    deviation = believed["per_kelvin_deviation"] * abs(warmer[-1]) * factor[-1] * (level + error)
    return [*(level * (factor - factor[:-1].mean())).tolist(), float(np.hypot(deviation, error * (factor[-1] - 1.0)))]


def _level(sums: Array, columns: Sequence[Columns]) -> tuple[float, float]:
    """Return the leak's coefficient in healthy recordings by their sums (E, m, m), at least zero, and its error."""
    precision, vector = 0.0, 0.0
    for e, column in enumerate(columns):
        others = [k for k in column.compared if k != column.leak and np.isfinite(column.between[k])]
        along = sums[e][others, column.leak]
        solved = solve(sums[e][np.ix_(others, others)], np.column_stack([along, sums[e][others, column.left]]))
        precision += float(sums[e][column.leak, column.leak] - along @ solved[:, 0])
        vector += float(sums[e][column.leak, column.left] - along @ solved[:, 1])
    return (max(vector, 0.0) / precision, precision**-0.5) if precision > 0.0 else (0.0, 0.0)


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
    return student(logarithm(judged, everything), apart, beliefs("inference")["between"]["motion"])


def student(value: float, deviations: Sequence[float] | Array, believed: float) -> Rise:
    """Return a rise against n healthy recordings, each of which deviates so far from the others.

    `believed`: what is believed of the scatter beforehand.
    """
    width, count = beliefs("inference")["scatter"], len(deviations)
    squares = width["freedom"] * believed * believed
    freedom = width["freedom"] + count - 1
    if count > 1:
        squares += float(np.sum(np.square(deviations))) * ((count - 1) / count) ** 2
    deviation = np.sqrt(squares / freedom * (1.0 + 1.0 / count))
    return Rise(value, max(float(deviation), np.finfo(float).tiny), freedom)


def _about_own(sums: Array, columns: Sequence[Columns]) -> Array:
    """Return a recording's sums (E, m, m) with the coefficients set aside that nothing ties to another recording's."""
    reduced = sums.copy()
    for e, column in enumerate(columns):
        untied = [k for k in column.compared if k != column.leak and not np.isfinite(column.between[k])]
        cross = sums[e][:, untied]
        reduced[e] -= cross @ solve(sums[e][np.ix_(untied, untied)], cross.T)
        reduced[e][untied] = reduced[e][:, untied] = 0.0
    return reduced


def _rise(own: Array, reference: Array, columns: Sequence[Columns]) -> float:
    """Return the rise of the leak's coefficient in one recording's sums (E, m, m) beyond those of others.

    The recording's other coefficients differ from theirs by what is believed of recordings of one machine.
    """
    precision, vector = 0.0, 0.0
    for e, column in enumerate(columns):
        chosen = [k for k in column.compared if k == column.leak or np.isfinite(column.between[k])]
        coefficients = solve(reference[e][np.ix_(chosen, chosen)], reference[e][chosen, column.left])
        residual = own[e][:, column.left] - own[e][:, chosen] @ coefficients
        others = [k for k in chosen if k != column.leak]
        size = np.abs(coefficients[[chosen.index(k) for k in others]])
        with np.errstate(divide="ignore", over="ignore"):
            belief = 1.0 / (size * column.between[others]) ** 2
        matrix = own[e][np.ix_(others, others)]
        matrix = matrix + np.diag(np.minimum(belief, 1e9 * np.diag(matrix)))
        along = own[e][others, column.leak]
        solved = solve(matrix, np.column_stack([along, residual[others]]))
        precision += float(own[e][column.leak, column.leak] - along @ solved[:, 0])
        vector += float(residual[column.leak] - along @ solved[:, 1])
    return vector / precision if precision > 0.0 else 0.0
