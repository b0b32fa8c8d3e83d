"""Is it more than in the baseline? A recording's leakage against the scatter between healthy recordings.

The sums of the baseline's recordings, the zero of the flow of each set aside, are added up and give the coefficients of
all terms; what a recording's own rows leave of them along the leak's column is its rise. The rise of each healthy
recording against the others measures how recordings differ; whatever the model does not describe is in it, once.

Recordings of one session, by their dates, share oil and set-up: y_j of session s is m_s + e_j, with m_s ~ N(m, tau^2)
and e_j ~ N(0, sigma^2). With r_j the rise of recording j of n against the n - 1 others, y_j = r_j (n - 1)/n,

    sigma^2 = (nu_0 s_0^2 + sum_j (y_j - m_s)^2) / (nu_0 + n - S),
    tau^2 = (nu_1 tau_0^2 + sum_s max(m_s^2 - sigma^2/n_s, 0)) / (nu_1 + S - 1),
    t = (rise - (1 - q) m_k) / d,    d^2 = sigma^2 + q tau^2 + q^2 (sigma^2/n + tau^2 sum_s (n_s/n)^2),

for a judged recording of session k, q = sigma^2 / (sigma^2 + n_k tau^2); of a new session n_k = m_k = 0 and q = 1.
Where all are of a single session, d^2 = sigma^2 (1 + 1/n), Student's t with nu_0 + n - 1 degrees of freedom. s_0, tau_0
and what they count for, nu, are believed beforehand (`terms.toml`): between sessions a healthy machine's leakage goes
with the inverse of the oil's viscosity, in proportion to its level. Recordings without a date are of one session. Where
the oil's temperature T is known of all, what it makes of the level is taken off, and only that factor's error remains.

Sources: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2 and 5.4; F. E. Satterthwaite, Biometrics
Bulletin 2 (1946) 110 (degrees of freedom of d^2).
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
    ) -> Taught:
        """Return that of a recording's blocks."""
        weights = np.maximum(blocks.rows, 1e-9)
        flow, pressure = (float(np.average(of, weights=weights)) for of in (blocks.means[:, 2], blocks.driving()))
        return cls(_about_own(total(blocks, columns), columns), flow, pressure, start_s, oil_degC)


def rise(judged: Taught, baseline: Sequence[Taught], columns: Sequence[Columns]) -> Rise:
    """Return how far the leak's coefficient of a recording is beyond that of healthy recordings of the same machine."""
    everything, count = np.sum([own.sums for own in baseline], axis=0), len(baseline)
    beliefs, by_flow = priors()["scatter"], judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    apart = np.array([_rise(own.sums, everything - own.sums, columns) for own in baseline] if count > 1 else [0.0])
    *by_oil, warmer, oil = _of_oil([*baseline, judged], *_level(everything, columns))
    value, deviations = _rise(judged.sums, everything, columns) - warmer, apart * ((count - 1) / count) - by_oil
    *of_baseline, of_judged = sessions = _sessions([*baseline, judged])
    if len(set(sessions)) == 1:
        return student(value, deviations * (count / max(count - 1, 1)), beliefs["leak"].value * by_flow)
    members = [deviations[np.equal(of_baseline, session)] for session in dict.fromkeys(of_baseline)]
    sizes, means = np.array([len(own) for own in members]), np.array([own.mean() for own in members])
    squares = float(sum(((own - own.mean()) ** 2).sum() for own in members))
    within = _Variance.of(beliefs["leak"].value * by_flow, beliefs["freedom"].value, squares, count - len(members))
    squares = float(np.maximum(means**2 - within.value / sizes, 0.0).sum())
    believed = float(np.hypot(oil, beliefs["session"].value * by_flow))
    between = _Variance.of(believed, beliefs["sessions"].value, squares, len(members) - 1)
    at = list(dict.fromkeys(of_baseline)).index(of_judged) if of_judged in of_baseline else None
    alike, mean = (0, 0.0) if at is None else (int(sizes[at]), float(means[at]))
    q = within.value / (within.value + alike * between.value)
    # of a known session q tau^2 = (1 - q) sigma^2 / n_k
    of_within = within.value * (1.0 + q**2 / count + ((1.0 - q) / alike if alike else 0.0))
    of_between = between.value * (float(alike == 0) + q**2 * float(((sizes / count) ** 2).sum()))
    variance = max(of_within + of_between, np.finfo(float).tiny)
    freedom = variance**2 / (of_within**2 / within.freedom + of_between**2 / between.freedom)
    return Rise(value - (1.0 - q) * mean, float(np.sqrt(variance)), freedom)


class _Variance(NamedTuple):
    """An estimate of a variance, and its degrees of freedom."""

    value: float
    freedom: float

    @classmethod
    def of(cls, believed: float, weight: float, squares: float, freedom: int) -> _Variance:
        """Return that of a sum of squares of so many degrees of freedom, beside a belief that weighs as others."""
        return cls((weight * believed**2 + squares) / (weight + freedom), weight + freedom)


def _sessions(taught: Sequence[Taught]) -> list[int]:
    """Return the session of each recording: a number of its own after every gap in which the oil may have warmed."""
    apart = 3600.0 * priors()["oil"]["shift"].value
    dates = sorted(own.start_s for own in taught if own.start_s is not None)
    begins = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > apart]
    return [-1 if own.start_s is None else int(np.searchsorted(begins, own.start_s, "right")) for own in taught]


def _of_oil(taught: Sequence[Taught], level: float, error: float) -> list[float]:
    """Return by how much each recording's leakage is beyond its mean over all but the last, for its oil's temperature.

    Last the deviation of the last one's: what may still differ, as far as the `level` within its `error` goes.
    """
    beliefs = priors()["oil"]
    known = [own.oil_degC for own in taught if own.oil_degC is not None]
    if len(known) < len(taught):
        return [0.0] * len(taught) + [0.5 * (beliefs["warmest"].value - 1.0) * (level + error)]
    warmer = np.array(known) - np.mean(known[:-1])
    factor = np.exp(beliefs["per_kelvin"].value * warmer)
    deviation = beliefs["per_kelvin_deviation"].value * abs(warmer[-1]) * factor[-1] * (level + error)
    return [*(level * (factor - factor[:-1].mean())).tolist(), float(np.hypot(deviation, error * (factor[-1] - 1.0)))]


def _level(sums: Array, columns: Sequence[Columns]) -> tuple[float, float]:
    """Return the leak's coefficient in healthy recordings by their sums (E, m, m), at least zero, and its error."""
    precision, vector = 0.0, 0.0
    for e, column in enumerate(columns):
        others = [k for k in column.nuisance if k != column.leak and np.isfinite(column.between[k])]
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
    return student(logarithm(judged, everything), apart, priors()["between"]["motion"].value)


def student(value: float, apart: Sequence[float] | Array, believed: float) -> Rise:
    """Return a rise against n healthy recordings, each of which is so far `apart` from the others.

    `believed`: what is believed of the scatter beforehand.
    """
    beliefs, count = priors()["scatter"], len(apart)
    squares = beliefs["freedom"].value * believed * believed
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
