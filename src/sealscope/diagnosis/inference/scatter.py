"""Is it more than in the baseline? A recording's leakage against the scatter between healthy recordings.

The sums of the baseline's recordings, the zero of the flow of each set aside, are added up and give the coefficients of
all terms; what a recording's own rows leave of them along the leak's column is its rise, its other coefficients free
within what recordings of a machine differ by. The rise of each healthy recording against the others measures how
recordings differ; whatever the model does not describe is in it, once. With r_j the rise of recording j of n against
the n - 1 others, y_j = r_j (n - 1)/n; for the judged one y is its rise.

How far the other coefficients differ is believed to within a factor only: a machine held at one temperature repeats
them to a thousandth, another's change by a tenth from run to run. A narrow prior makes every rise precise where it is
true and scatter where it is not, so y is formed by several widths, each weighted by what is believed of it and the
evidence of the healthy ones, p(y_1 .. y_n).

All y of a width are normal about an unknown mean, with the variance sigma^2 of each by itself and a covariance between
them of which there are several candidates. sigma^2 has a scaled inverse chi square prior (s_0, nu_0): the
rise, y beyond what the others let expect, follows a mixture over all of these. Recordings of one session, by their
dates, share oil and set-up: a deviation tau of sessions, half-normal beforehand, of leakage in proportion to its level,
for it goes with the inverse of the oil's viscosity. Recordings without a date are of one session. Where the oil's
temperature T is known of all, what it makes of the level is taken off, and only that factor's error remains. What is
believed stands in `priors.toml`.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 5.4 and 5.7; C. E. Rasmussen and C. K.
I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown mean).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve, total
from sealscope.diagnosis.inference.weak_form import LARGEST
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Nodes of a deviation, and the largest one between sessions over what is believed; most recordings that are compared.
NODES, WIDEST, MOST = 32, 3.0, 60
#: Widths of what recordings differ by that are weighed, and how far from what is believed [deviations].
SCALES, FARTHEST = 11, 2.5


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
        """Return the score that a healthy recording exceeds with a probability; ArithmeticError where there is none."""
        from scipy.optimize import brentq
        from scipy.special import ndtri, stdtrit

        if self.parts is None:
            return float(stdtrit(self.freedom, 1.0 - chance))
        ends = np.sort((self.parts.centres - ndtri(chance) * self.parts.deviations) / self.deviation)
        try:
            return float(brentq(lambda score: self._beyond(score) - chance, ends[0], ends[-1]))
        except ValueError:  # no number lies between the ends
            raise ArithmeticError("no threshold of such a scatter") from None

    def log_ratio(self, rise: float) -> float:
        """Return the logarithm of the likelihood of a true rise over that of none."""
        return self._log_density(self.value - rise) - self._log_density(self.value)

    def _log_density(self, value: float) -> float:
        """Return the logarithm of the density of a healthy recording's rise, up to a constant."""
        if self.parts is None:
            z = value / self.deviation
            return float(-0.5 * (self.freedom + 1.0) * np.log1p(z * z / self.freedom))
        weights, deviations, centres = self.parts
        parts = np.log(np.maximum(weights, np.finfo(float).tiny)) - np.log(deviations)
        return float(np.logaddexp.reduce(parts - 0.5 * ((value - centres) / deviations) ** 2))

    def bound(self, probability: float = 0.95) -> float:
        """Return the upper bound that holds with a probability; a rise below zero does not make it smaller."""
        return max(self.value, 0.0) + self.threshold(1.0 - probability) * self.deviation

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
    """Return how far the leak's coefficient of a recording is beyond that of healthy recordings of the same machine.

    All are of `columns`, one of each equation.
    """
    everything, count = np.sum([own.sums for own in baseline], axis=0), len(baseline)
    believed, by_flow = priors("inference")["scatter"], judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    decades = np.linspace(-FARTHEST, FARTHEST, SCALES)
    widths = believed["between"] ** decades
    beyond = np.zeros((SCALES, count))
    if count > 1:
        beyond = np.array([_rises(own.sums, everything - own.sums, columns, widths) for own in baseline]).T
    *by_oil, warmer, oil = _of_oil([*baseline, judged], *_level(everything, columns))
    values = _rises(judged.sums, everything, columns, widths) - warmer
    starts, pause = [own.start_s for own in (*baseline, judged)], 3600.0 * priors("inference")["oil"]["shift"]
    sessions = np.array(sessions_of(starts, pause))
    usual, apart = believed["leak"] * by_flow, float(np.hypot(oil, believed["session"] * by_flow))
    nodes = WIDEST * ((np.arange(NODES) + 0.5) / NODES) ** 2  # closer near zero
    believed_of = 0.5 * np.log(nodes) - 0.5 * nodes**2
    if len(set(sessions)) == 1:
        nodes, believed_of = np.zeros(1), np.zeros(1)
    alike = np.equal.outer(sessions, sessions)
    population = Population(((apart * nodes) ** 2)[:, None, None] * alike, believed_of)
    return population.rise(
        values, beyond * ((count - 1) / count) - by_oil, usual, believed["freedom"], -0.5 * decades**2
    )


def leave_one_out(recordings: Sequence[RecordingSums], columns: Sequence[Columns]) -> Array:
    """Compute the rise (n,) of each recording beyond the n - 1 others, by what is believed of their differences."""
    everything = np.sum([recording.sums for recording in recordings], axis=0)
    rises = [_rises(own.sums, everything - own.sums, columns, np.ones(1))[0] for own in recordings]
    return np.array(rises) * ((len(recordings) - 1) / len(recordings))


class Population:
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

    def rise(self, values: Array, known: Array, usual: float, freedom: float, logarithms: Array | float = 0.0) -> Rise:
        """Return by how much a value is beyond what those known let expect.

        `values` (s,) and `known` (s, n): the same quantity, estimated in s ways of which `logarithms` (s,) are
        believed; the evidence of those known weighs the ways. `usual`, `freedom`: what is believed of sigma.
        """
        others, count = known[:, self._chosen], len(self._chosen)
        squares = freedom * usual**2 + np.sum((others - others.mean(axis=1, keepdims=True)) ** 2, axis=1)
        if not 1e4 * squares.max() < LARGEST:  # numbers that cannot be computed with bound nothing
            return Rise(float(values.mean()), np.inf, freedom)
        least = np.sqrt(np.maximum(0.1 * freedom * usual**2, 1e-9 * squares) / (freedom + count))
        most = np.maximum(100.0 * np.sqrt(squares), 10.0 / LARGEST)
        variance = np.geomspace(np.maximum(least, 1.0 / LARGEST), most, NODES, axis=1)[:, None] ** 2  # (s, 1, nodes)
        weight = 1.0 / (variance[..., None] + self._eigen)  # (s, g, nodes, n)
        of_ones, cross = weight * self._ones, self._cross
        precision = (of_ones * self._ones).sum(axis=-1)
        rotated = np.einsum("gij,si->sgj", self._basis, others)[:, :, None]
        mean = (of_ones * rotated).sum(axis=-1) / precision
        left = weight * (rotated - mean[..., None] * self._ones)
        logarithm = 0.5 * (np.log(weight).sum(axis=-1) - np.log(precision) - (left * rotated).sum(axis=-1))
        logarithm += self._logarithms - 0.5 * freedom * (np.log(variance) + usual**2 / variance)
        logarithm += np.reshape(logarithms, (-1, 1, 1)) + np.log(np.log(variance[..., 1:2] / variance[..., :1]))
        weights = np.exp(logarithm - logarithm.max())
        weights /= weights.sum()
        centres = mean + (left * cross).sum(axis=-1) - values[:, None, None]
        missing = 1.0 - (of_ones * cross).sum(axis=-1)
        variances = variance + self._own - (weight * cross**2).sum(axis=-1) + missing**2 / precision
        middle = float((weights * centres).sum())
        parts = Mixture(weights.ravel(), np.sqrt(variances).ravel(), (centres - middle).ravel())
        total = float((weights * (variances + (centres - middle) ** 2)).sum())
        return Rise(-middle, float(np.sqrt(total)), np.inf, parts)


def sessions_of(starts: Sequence[float | None], pause: float) -> list[int]:
    """Return the session of each recording: a number of its own after every gap [s] longer than `pause`."""
    dates = sorted(own for own in starts if own is not None)
    begins = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > pause]
    return [-1 if own is None else int(np.searchsorted(begins, own, "right")) for own in starts]


def _of_oil(recordings: Sequence[RecordingSums], level: float, error: float) -> list[float]:
    """Return by how much each recording's leakage is beyond its mean over all but the last, for its oil's temperature.

    Last the deviation of the last one's: what may still differ, as far as the `level` within its `error` goes.
    """
    believed = priors("inference")["oil"]
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


def motion_change(judged: Array, baseline: Sequence[Array], columns: Columns) -> float:
    """Compute the logarithm of the flow that motion takes in a recording over that in others, by sums (m, m).

    Area over displacement differs by it: another machine, or another scale.
    """
    everything, motion = np.sum(baseline, axis=0), list(columns.motion)
    chosen = list(columns.nuisance)
    places = [chosen.index(k) for k in motion]
    flows = [
        np.diag(judged)[motion] @ solve(sums[np.ix_(chosen, chosen)], sums[chosen, columns.left])[places]
        for sums in (judged, everything)
    ]
    return float(np.log(np.maximum(np.abs(flows), np.finfo(float).tiny)) @ [1.0, -1.0])


def student(value: float, deviations: Sequence[float] | Array, believed: float) -> Rise:
    """Return a rise against n healthy recordings, each of which deviates so far from the others.

    `believed`: what is believed of the scatter beforehand.
    """
    width, count = priors("inference")["scatter"], len(deviations)
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


def _rises(own: Array, reference: Array, columns: Sequence[Columns], widths: Array) -> Array:
    """Return the rise (s,) of the leak's coefficient in one recording's sums (E, m, m) beyond those of others.

    The recording's other coefficients differ from theirs by what is believed of recordings of one machine, over all
    `widths` (s,).
    """
    precision, vector = np.zeros((2, len(widths)))
    for e, column in enumerate(columns):
        chosen = [k for k in column.compared if k == column.leak or np.isfinite(column.between[k])]
        coefficients = solve(reference[e][np.ix_(chosen, chosen)], reference[e][chosen, column.left])
        residual = own[e][:, column.left] - own[e][:, chosen] @ coefficients
        others = [k for k in chosen if k != column.leak]
        size = np.abs(coefficients[[chosen.index(k) for k in others]])
        with np.errstate(divide="ignore", over="ignore"):
            prior = 1.0 / (size * column.between[others]) ** 2
        matrix, along = own[e][np.ix_(others, others)], own[e][others, column.leak]
        right = np.column_stack([along, residual[others]])
        for s, width in enumerate(widths):
            tied = matrix + np.diag(np.minimum(prior / width**2, 1e9 * np.diag(matrix)))
            solved = solve(tied, right)
            precision[s] += float(own[e][column.leak, column.leak] - along @ solved[:, 0])
            vector[s] += float(residual[column.leak] - along @ solved[:, 1])
    return np.where(precision > 0.0, vector / np.where(precision > 0.0, precision, 1.0), 0.0)
