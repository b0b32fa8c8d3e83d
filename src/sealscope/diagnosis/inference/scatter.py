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

Leakage goes with the inverse of the oil's viscosity, so that levels compare in logarithms where they are clearly above
zero: z = asinh(a / 2 c) of the level a = level of all + y, c what errors make of it. All z of a width are normal about
an unknown mean, with the variance sigma^2 of each by itself and a covariance between them of which there are several
candidates. Of sigma nothing is known beforehand but its decades, from a recording's own deviation to a tenth of the
flow: five recordings that agree show what two do not. Recordings of one session, by their dates, share oil and set-up:
a deviation tau of sessions, half-normal beforehand. Recordings without a date are of one session. Where the oil's
temperature T is known of all, z goes with a slope a kelvin that the recordings tell, about what is believed of it, and
one of other oil than they had is the less certain; else tau holds what oil may do. So it is under another load or speed
than theirs. The rise, y beyond what the others let expect, follows a mixture over all of these. What is believed stands
in `priors.toml`.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 5.4 and 5.7; C. E. Rasmussen and C. K.
I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown mean).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, Columns, solve, total
from sealscope.diagnosis.inference.rows.weak_form import LARGEST
from sealscope.diagnosis.inference.terms import ORIFICE
from sealscope.diagnosis.priors import priors
from sealscope.recordings.recording import Array

#: Name of the data that leakage against healthy recordings is.
RISE = "rise"
#: Nodes of a deviation, and the largest one between sessions over what is believed; most recordings that are compared.
NODES, WIDEST, MOST = 32, 3.0, 60
#: Widths of what recordings differ by that are weighed, and how far from what is believed [deviations].
SCALES, FARTHEST = 11, 2.5
#: Fewest healthy recordings that hold pressures: their mean and scatter.
FEWEST_HELD = 2
#: Least deviation: what is divided by is no zero.
TINY = 1e-300
#: Laws that one of logarithms is split into, how much narrower each is, where logarithms end, what weighs nothing.
PARTS, NARROWER, FARTHEST_Z, FAINTEST = 7, 0.5, 30.0, 16.0


class Mixture(NamedTuple):
    """A mixture of normal laws: `weights`, `deviations` and `centres` beside that of the whole, (k,) each."""

    weights: Array
    deviations: Array
    centres: Array

    def quantile(self, probability: float) -> float:
        """Return the value below which the mixture lies with a probability."""
        from scipy.optimize import brentq
        from scipy.special import ndtr, ndtri

        unit = max(float(self.weights @ np.minimum(self.deviations, 1e3 * self.deviations.min())), TINY)
        centres, deviations = self.centres / unit, self.deviations / unit

        def excess(value: float) -> float:
            return float(self.weights @ ndtr((value - centres) / deviations)) - probability

        ends = centres + ndtri(probability) * deviations
        low, high = float(ends.min()), float(ends.max())
        return unit * (low if not excess(low) < 0.0 < excess(high) else float(brentq(excess, low, high)))


class Rise(NamedTuple):
    """The leak's coefficient beyond the baseline's: `value` and its `deviation`, with `freedom` degrees of freedom.

    `parts`: the mixture that it follows, where that is no single Student's law; `at_most`: a leak that begins within
    the recording raises it by anything up to its mean.
    """

    value: float
    deviation: float
    freedom: float
    parts: Mixture | None = None
    at_most: bool = False

    @property
    def score(self) -> float:
        """The rise over its deviation."""
        return self.value / self.deviation

    @property
    def chance(self) -> float:
        """Probability that a healthy recording scores as high."""
        return min(self._exceedance(self.score), 1.0)

    def _exceedance(self, score: float) -> float:
        from scipy.special import ndtr, stdtr

        if self.parts is None:
            return float(stdtr(self.freedom, -score))
        weights, deviations, centres = self.parts
        return float(weights @ ndtr((centres - score * self.deviation) / deviations))

    def threshold(self, chance: float) -> float:
        """Return the score that a healthy recording exceeds with a probability."""
        from scipy.special import stdtrit

        if self.parts is None:
            return float(stdtrit(self.freedom, 1.0 - chance))
        return self.parts.quantile(1.0 - chance) / self.deviation

    def log_ratio(self, rise: float) -> float:
        """Return the logarithm of the likelihood of a true rise over that of none."""
        if self.at_most and rise > 0.0:
            densities = [self._log_density(self.value - part) for part in np.linspace(0.0, rise, NODES)]
            if 0.0 < self.value < rise:
                densities.append(self._log_density(0.0))
            return float(np.logaddexp.reduce(densities) - np.log(len(densities))) - self._log_density(self.value)
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
        return max(self.value, 0.0) - self.threshold(probability) * self.deviation

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the interval of the rise that holds with a probability."""
        tail = 0.5 - 0.5 * probability
        high, low = (self.threshold(chance) * self.deviation for chance in (tail, 1.0 - tail))
        return self.value - high, self.value - low


class RecordingSums(NamedTuple):
    """Sums over a recording of one machine, to be added to those of other recordings.

    `sums` (E, m, m) of its rows, the zero of its flow set aside; `flow` of the pump and `pressure`, mean sizes
    [m^3/s], [Pa]; `start_s`: its date [s since 1970], `oil_degC`, its oil's temperature, and `held`, what its holds
    leak (`locked_holds.HeldLeaks`), None where they are not known.
    """

    sums: Array
    flow: float
    pressure: float
    start_s: float | None = None
    oil_degC: float | None = None
    held: Array | None = None

    @classmethod
    def from_blocks(
        cls,
        blocks: Blocks,
        columns: Sequence[Columns],
        start_s: float | None = None,
        oil_degC: float | None = None,
    ) -> RecordingSums:
        """Compute the sums of a recording's blocks."""
        weights = np.maximum(blocks.rows, 1e-9)
        flow, pressure = (float(np.average(values, weights=weights)) for values in (blocks.flow, blocks.driving()))
        return cls(_about_own(total(blocks, columns), columns), flow, pressure, start_s, oil_degC)


def rise(judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[Columns]) -> Rise:
    """Estimate the rise of a recording's leak coefficient beyond healthy recordings of the same machine.

    All are of `columns`, one of each equation.
    """
    everything, count = np.sum([recording.sums for recording in baseline], axis=0), len(baseline)
    believed, by_flow = priors("inference")["scatter"], judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    decades = np.linspace(-FARTHEST, FARTHEST, SCALES)
    widths = believed["between"] ** decades
    rises, own_errors = np.zeros((SCALES, count)), np.zeros((SCALES, count))
    if count > 1:
        pairs = [_rises(recording.sums, everything - recording.sums, columns, widths) for recording in baseline]
        rises, own_errors = (np.array(numbers).T * ((count - 1) / count) for numbers in zip(*pairs, strict=True))
    values, error = _rises(judged.sums, everything, columns, widths)
    level, level_error = _level(everything, columns)
    errors = believed["own"] * np.median(np.column_stack([error, own_errors]), axis=1)
    errors = np.maximum(errors, max(believed["finest"] * by_flow, 1.0 / LARGEST))
    return _compare_levels(judged, baseline, _Estimates(values, rises, errors, level, level_error))


def held_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of what passes the piston while valves shut the chambers; None where too few hold pressures.

    A leak that begins within the recording raises it by anything between nothing and its mean.
    """
    baseline = [recording for recording in baseline if recording.held is not None]
    known = [recording.held for recording in baseline if recording.held is not None]
    if judged.held is None or len(known) < FEWEST_HELD:
        return None
    count, by_flow = len(known), judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    healthy = np.array(known)
    level = float(healthy[:, 0].mean())
    least = max(priors("inference")["scatter"]["finest"] * by_flow, 1.0 / LARGEST)
    errors = np.maximum(np.median(np.append(healthy[:, 1], judged.held[1])), least)
    values, rises = np.array([judged.held[0] - level]), (healthy[:, 0] - level)[None]
    shown = _compare_levels(
        judged, baseline, _Estimates(values, rises, errors[None], max(level, 0.0), errors / np.sqrt(count))
    )
    return shown._replace(at_most=True)


class _Estimates(NamedTuple):
    """Rises `values` (s,) of the judged recording, and `rises` (s, n) of the healthy ones, by each of s ways.

    `errors` (s,) of one; `level` of all healthy ones, with its error.
    """

    values: Array
    rises: Array
    errors: Array
    level: float
    level_error: float


def _compare_levels(judged: RecordingSums, baseline: Sequence[RecordingSums], estimates: _Estimates) -> Rise:
    """Compare rises with what healthy recordings let expect, their levels in logarithms."""
    values, rises, errors, level, level_error = estimates
    believed, by_flow = priors("inference")["scatter"], judged.flow / judged.pressure if judged.pressure > 0.0 else 0.0
    decades = np.linspace(-FARTHEST, FARTHEST, SCALES) if len(values) == SCALES else np.zeros(len(values))
    starts, pause = (
        [recording.start_s for recording in (*baseline, judged)],
        3600.0 * priors("inference")["oil"]["shift"],
    )
    sessions = np.array(sessions_of(starts, pause))
    warmer, oil = _oil_shifts([*baseline, judged])
    unseen = (
        sum(condition.excess for condition in conditions_beyond(judged, baseline))
        * priors("inference")["conditions"]["leak"]
    )
    nodes = WIDEST * ((np.arange(NODES) + 0.5) / NODES) ** 2  # closer near zero
    believed_of = 0.5 * np.log(nodes) - 0.5 * nodes**2
    if len(set(sessions)) == 1:
        nodes, believed_of = np.zeros(1), np.zeros(1)
    slope, doubt = (priors("inference")["oil"][name] for name in ("per_kelvin", "per_kelvin_deviation"))
    thin = np.exp(slope * warmer[:-1])
    left = rises - level * (thin - thin.mean())
    turn = max(level_error, float(np.median(errors)), float(np.median(left.std(axis=1))), 0.1 * level)
    scale = _Levels(level, turn)
    steep = scale.slope(level)
    relative = steep * level
    between = ((np.hypot(relative * oil, steep * believed["session"] * by_flow) * nodes) ** 2)[:, None, None]
    between = between * np.equal.outer(sessions, sessions) + np.outer(warmer, warmer) * (relative * doubt) ** 2
    between[:, -1, -1] += (relative * unseen) ** 2
    if relative * oil > 0.0 and sessions[-1] not in sessions[:-1]:  # a day like those that are known, or like none
        logs = np.log([[1.0 - believed["unlike"]], [believed["unlike"]]])
        believed_of, between = (logs + believed_of).ravel(), np.tile(between, (2, 1, 1))
        between[len(nodes) :, -1, -1] += 2.0 * (relative * oil) ** 2
    shifts = relative * slope * warmer
    most = np.maximum(min(steep * believed["largest"] * by_flow, believed["relative"]), 10.0 * steep * errors)
    transformed, known = scale.transform(values), scale.transform(rises) - shifts[:-1]
    predicted = Population(between, believed_of).predict(
        transformed - shifts[-1],
        known,
        np.geomspace(steep * errors, most, NODES, axis=1),
        np.log(scale.slope(level + rises)).sum(axis=1) - 0.5 * decades**2,
    )
    return _combined(scale.levels(predicted, transformed), values)


class _Levels(NamedTuple):
    """Levels a of a coefficient as z = asinh(a / 2 c): logarithms beyond c, proportional to a below."""

    level: float
    turn: float

    def transform(self, excess: Array) -> Array:
        """Return z of levels that are so far beyond that of all."""
        return np.asarray(np.arcsinh((self.level + excess) / (2.0 * self.turn)))

    def slope(self, level: Any) -> Any:
        """Return dz/da at levels."""
        return 1.0 / np.hypot(level, 2.0 * self.turn)

    def levels(self, predicted: Mixture, transformed: Array) -> Mixture:
        """Convert a law of z, relative to `transformed` (s,), to one of levels relative to the level of all.

        Each part is split into narrower ones, in which the levels are linear in z.
        """
        x, shares = np.polynomial.hermite_e.hermegauss(PARTS)
        centres, deviations = predicted.centres + transformed[:, None, None], predicted.deviations[..., None]
        z = np.clip(centres[..., None] + np.sqrt(1.0 - NARROWER**2) * deviations * x, -FARTHEST_Z, FARTHEST_Z)
        return Mixture(
            predicted.weights[..., None] + np.log(shares / shares.sum()),
            2.0 * self.turn * np.cosh(z) * NARROWER * deviations,
            2.0 * self.turn * np.sinh(z) - self.level,
        )


def _combined(predicted: Mixture, values: Array) -> Rise:
    """Return the rise of `values` (s,) over laws (s, ...) of what healthy recordings show, by their log weights."""
    offset = np.reshape(values, (-1, *[1] * (predicted.centres.ndim - 1)))
    logs, deviations, centres = (
        part.ravel() for part in (predicted.weights, predicted.deviations, predicted.centres - offset)
    )
    kept = logs > logs.max() - FAINTEST
    weights = np.exp(logs[kept] - logs.max())
    law = Mixture(weights / weights.sum(), deviations[kept], centres[kept])
    low, middle, high = (law.quantile(probability) for probability in (0.16, 0.5, 0.84))
    return Rise(-middle, 0.5 * (high - low), np.inf, law._replace(centres=law.centres - middle))


class Beyond(NamedTuple):
    """A condition of a recording that no healthy one had: its `name`, value, range of theirs, and unit.

    `excess`: how far it is beyond them, in powers of e of load or speed, or as they would change the oil.
    """

    name: str
    value: float
    low: float
    high: float
    unit: str
    excess: float


def conditions_beyond(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> list[Beyond]:
    """Find the conditions of a recording that are beyond those of the healthy ones: oil, load, speed."""
    allowed, extremes = priors("inference")["conditions"], list[Beyond]()
    for name, unit, field in (("load", "Pa", "pressure"), ("speed", "m^3/s", "flow")):
        value, known = getattr(judged, field), [getattr(healthy, field) for healthy in baseline]
        if not known or not min(value, *known) > 0.0:
            continue
        excess = float(max(np.log(value / max(known)), np.log(min(known) / value)))
        if excess > allowed["ratio"]:
            extremes.append(Beyond(name, value, min(known), max(known), unit, excess))
    warm = [healthy.oil_degC for healthy in baseline if healthy.oil_degC is not None]
    if judged.oil_degC is not None and warm:
        excess = max(judged.oil_degC - max(warm), min(warm) - judged.oil_degC)
        if excess > allowed["oil"]:  # what it does is in the slope's doubt
            extremes.append(Beyond("oil", judged.oil_degC, min(warm), max(warm), "degC", 0.0))
    return extremes


def leave_one_out(recordings: Sequence[RecordingSums], columns: Sequence[Columns]) -> Array:
    """Compute the rise (n,) of each recording beyond the n - 1 others, by what is believed of their differences."""
    everything = np.sum([recording.sums for recording in recordings], axis=0)
    rises = [_rises(recording.sums, everything - recording.sums, columns, np.ones(1))[0] for recording in recordings]
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

    def rise(self, values: Array, known: Array, usual: float, freedom: float) -> Rise:
        """Estimate the rise of a value beyond its prediction from the known ones.

        `values` (s,) and `known` (s, n): the same quantity, estimated in s ways; the evidence of those known weighs the
        ways. `usual`, `freedom`: what is believed of sigma, whose square has a scaled inverse chi square law.
        """
        count = len(self._chosen)
        healthy = known[:, self._chosen]
        squares = freedom * usual**2 + np.sum((healthy - healthy.mean(axis=1, keepdims=True)) ** 2, axis=1)
        if not 1e4 * squares.max() < LARGEST:  # numbers that cannot be computed with bound nothing
            return Rise(float(values.mean()), np.inf, freedom)
        least = np.sqrt(np.maximum(0.1 * freedom * usual**2, 1e-9 * squares) / (freedom + count))
        most = np.maximum(100.0 * np.sqrt(squares), 10.0 / LARGEST)
        sigma = np.geomspace(np.maximum(least, 1.0 / LARGEST), most, NODES, axis=1)
        believed = -0.5 * freedom * (np.log(sigma**2) + usual**2 / sigma**2)
        predicted = self.predict(values, known, sigma, np.zeros(len(values)), believed)
        return _combined(predicted._replace(centres=predicted.centres + values[:, None, None]), values)

    def predict(
        self, values: Array, known: Array, sigma: Array, logarithms: Array, believed: Array | float = 0.0
    ) -> Mixture:
        """Return the law of the judged value beside `values` (s,): log weights, deviations, centres (s, g, nodes).

        `known` (s, n): the others, in s ways of which `logarithms` (s,) are believed; `sigma` (s, nodes): evenly spaced
        in their logarithms, of whose densities `believed` (s, nodes) are the logarithms.
        """
        healthy = known[:, self._chosen]
        variance = sigma[:, None] ** 2  # (s, 1, nodes)
        weight = 1.0 / (variance[..., None] + self._eigen)  # (s, g, nodes, n)
        of_ones, cross = weight * self._ones, self._cross
        precision = (of_ones * self._ones).sum(axis=-1)
        rotated = np.einsum("gij,si->sgj", self._basis, healthy)[:, :, None]
        mean = (of_ones * rotated).sum(axis=-1) / precision
        left = weight * (rotated - mean[..., None] * self._ones)
        logarithm = 0.5 * (np.log(weight).sum(axis=-1) - np.log(precision) - (left * rotated).sum(axis=-1))
        logarithm += self._logarithms + np.reshape(logarithms, (-1, 1, 1))
        logarithm += (
            np.broadcast_to(believed, sigma.shape)[:, None] + np.log(np.log(sigma[:, 1:2] / sigma[:, :1]))[:, None]
        )
        centres = mean + (left * cross).sum(axis=-1) - values[:, None, None]
        missing = 1.0 - (of_ones * cross).sum(axis=-1)
        variances = variance + self._own - (weight * cross**2).sum(axis=-1) + missing**2 / precision
        return Mixture(logarithm, np.sqrt(variances), centres)


def sessions_of(starts: Sequence[float | None], pause: float) -> list[int]:
    """Return the session of each recording: a number of its own after every gap [s] longer than `pause`."""
    dates = sorted(start for start in starts if start is not None)
    begins = [date for before, date in zip([-np.inf, *dates], dates, strict=False) if date - before > pause]
    return [-1 if start is None else int(np.searchsorted(begins, start, "right")) for start in starts]


def _oil_shifts(recordings: Sequence[RecordingSums]) -> tuple[Array, float]:
    """Compute the oil temperature of each recording over the mean of all but the last [K], and a doubt.

    Where a temperature is missing none counts: the levels of sessions deviate in their logarithms by the doubt, else 0.
    """
    known = [recording.oil_degC for recording in recordings if recording.oil_degC is not None]
    if len(known) < len(recordings):  # the difference of two sessions has twice the variance of each
        return np.zeros(len(recordings)), float(np.sqrt(0.125) * np.log(priors("inference")["oil"]["warmest"]))
    return np.array(known) - np.mean(known[:-1]), 0.0


def _level(sums: Array, columns: Sequence[Columns]) -> tuple[float, float]:
    """Return the leak's coefficient in healthy recordings by their sums (E, m, m), at least zero, and its error."""
    precision, vector = 0.0, 0.0
    for e, column in enumerate(columns):
        nuisance = [k for k in column.compared if k != column.leak and np.isfinite(column.between[k])]
        cross = sums[e][nuisance, column.leak]
        solved = solve(sums[e][np.ix_(nuisance, nuisance)], np.column_stack([cross, sums[e][nuisance, column.left]]))
        precision += float(sums[e][column.leak, column.leak] - cross @ solved[:, 0])
        vector += float(sums[e][column.leak, column.left] - cross @ solved[:, 1])
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


class LawFit(NamedTuple):
    """Fit of an orifice's law to a rise, beside the laminar law.

    `regression` of its flow on p_A - p_B [Pa^-0.5], all else eliminated; `log_ratio` of the likelihoods a row, by the
    residuals that either leaves.
    """

    regression: float
    log_ratio: float


def compare_laws(judged: RecordingSums, baseline: Sequence[RecordingSums], columns: Sequence[Columns]) -> LawFit | None:
    """Compare the law of an orifice with the laminar one by what a recording leaves of the healthy ones' balance.

    None where the columns hold no such law, or nothing tells.
    """
    if any(ORIFICE not in column.names for column in columns):
        return None
    reference = np.sum([recording.sums for recording in baseline], axis=0)
    grams, leads, square = np.zeros((2, 2)), np.zeros(2), 0.0
    for e, column in enumerate(columns):
        sums, tests = judged.sums[e], [column.leak, column.names.index(ORIFICE)]
        residual, nuisance, prior = _left_over(sums, reference[e], column)
        tied = sums[np.ix_(nuisance, nuisance)] + np.diag(prior)
        solved = solve(tied, np.column_stack([sums[np.ix_(nuisance, tests)], residual[nuisance]]))
        grams += sums[np.ix_(tests, tests)] - sums[np.ix_(tests, nuisance)] @ solved[:, :2]
        leads += residual[tests] - sums[np.ix_(tests, nuisance)] @ solved[:, 2]
        square += float(residual[-1] - residual[nuisance] @ solved[:, 2])
    energy = np.diag(grams)
    if not energy.min() > 0.0 or not grams[0, 1] > 0.0:
        return None
    unexplained = np.maximum(square - leads**2 / energy, 1e-9 * abs(square) + TINY)
    return LawFit(float(grams[0, 1] / energy[0]), float(-0.5 * np.log(unexplained[1] / unexplained[0])))


def _left_over(sums: Array, reference: Array, column: Columns) -> tuple[Array, list[int], Array]:
    """Compute the residual of a recording under the others' balance, as products with all columns, itself last.

    Returned with the columns that may differ, and the prior precision of their differences.
    """
    chosen = [k for k in column.compared if k == column.leak or np.isfinite(column.between[k])]
    coefficients = np.zeros(len(sums))
    coefficients[chosen] = -solve(reference[np.ix_(chosen, chosen)], reference[chosen, column.left])
    nuisance = [k for k in chosen if k != column.leak]
    size = np.abs(coefficients[nuisance])
    with np.errstate(divide="ignore", over="ignore"):
        prior = 1.0 / (size * column.between[nuisance]) ** 2
    coefficients[column.left] = 1.0
    residual = sums @ coefficients
    residual[column.left] = coefficients @ residual
    return residual, nuisance, np.minimum(prior, 1e9 * np.diag(sums)[nuisance])


def _rises(sums: Array, reference: Array, columns: Sequence[Columns], widths: Array) -> tuple[Array, Array]:
    """Return the rise (s,) of the leak's coefficient in one recording's sums (E, m, m) beyond others', and its error.

    The recording's other coefficients differ from theirs by what is believed of recordings of one machine, over all
    `widths` (s,).
    """
    precision, vector = np.zeros((2, len(widths)))
    for e, column in enumerate(columns):
        residual, nuisance, prior = _left_over(sums[e], reference[e], column)
        matrix, cross = sums[e][np.ix_(nuisance, nuisance)], sums[e][nuisance, column.leak]
        right = np.column_stack([cross, residual[nuisance]])
        for s, width in enumerate(widths):
            tied = matrix + np.diag(np.minimum(prior / width**2, 1e9 * np.diag(matrix)))
            solved = solve(tied, right)
            precision[s] += float(sums[e][column.leak, column.leak] - cross @ solved[:, 0])
            vector[s] += float(residual[column.leak] - cross @ solved[:, 1])
    known = precision > 0.0
    divisor = np.where(known, precision, 1.0)
    return np.where(known, vector / divisor, 0.0), np.where(known, divisor**-0.5, 0.0)
