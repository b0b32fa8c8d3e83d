"""Rise of a recording's leakage, i.e. the leakage above that of healthy recordings, whose scatter is estimated.

The rise r_j of each healthy recording over the n - 1 others (`coefficients`) measures the scatter, including all
effects that the model does not describe. The comparison uses y_j = r_j (n - 1)/n, the rise over the mean of all n, and
for the judged recording y, its rise.

The width of the prior on the other coefficients is known only to within a factor: one machine, held at one temperature,
repeats its coefficients to a thousandth; another changes by a tenth from run to run. With too narrow a prior the rises
scatter, with too wide a prior they are imprecise. Therefore y is computed for several widths, each weighted by its
prior and by the likelihood of the healthy recordings, p(y_1 .. y_n).

Levels that are clearly above zero are compared as logarithms: z = asinh(a / 2 c). Here a = mean level + y is the level
(leak coefficient) of a recording, and c, which follows from the errors of a, is the level below which z is linear. For
each width all z are normal about an unknown mean. These effects contribute to their covariance:

- Scatter of single recordings: sigma^2 on the diagonal. sigma has a log-uniform prior from a part of a recording's
  standard error to a tenth of the flow, so five recordings that agree allow a smaller sigma than two do.
- Sessions: recordings of one session share oil and set-up. The deviation tau of a session has a half-normal prior.
  Sessions are separated by date; undated recordings form one session.
- Oil (`oil`): z has an uncertain slope in the temperature or in the viscous drop, so that a recording is the less
  certain the further its oil is from the mean; unknown oil is covered by tau.
- Conditions (`find_unusual_conditions`): load and speed outside of the known range make a recording less certain.

The rise follows the mixture over all of these. The priors are in `priors.toml`.

Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sections 3.2, 5.4 and 5.7; C. E. Rasmussen and C. K.
I. Williams, Gaussian Processes for Machine Learning (2006), section 2.7 (an unknown mean).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sealscope.diagnosis.estimate.population import NODES, Mixture, Population, number_sessions
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.comparison.oil import OilHypothesis, oil_hypotheses
from sealscope.diagnosis.inference.comparison.recording_sums import (
    ComparedColumns,
    RecordingSums,
    coefficient_level,
    eliminate_unshared,
    estimate_leak_excess,
    find_unusual_conditions,
)
from sealscope.diagnosis.inference.comparison.rise import Rise, rise_of_mixture
from sealscope.diagnosis.inference.rows.weak_form import MAX_READING
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: Largest standard deviation between sessions on the grid, over its prior.
MAX_SESSION_RATIO = 3.0
#: Number of widths of the prior on differences between recordings, and the largest log width [standard deviations].
SCALES, MAX_SCALE = 11, 2.5
#: Minimum number of healthy recordings with holds under pressure: for a mean and a scatter.
MIN_WITH_HOLDS = 2
#: A normal distribution of z is replaced by this number of narrower ones, with this fraction of its deviation.
PARTS, PART_WIDTH = 7, 0.5
#: Limit of abs(z), which keeps sinh(z) finite.
MAX_Z = 30.0


def rise(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    columns: Sequence[ComparedColumns],
    *,
    min_crossover: float = 0.0,
    session_deviation: float | None = None,
) -> Rise:
    """Estimate by how much a recording's leak coefficient exceeds that of healthy recordings of the same machine.

    The rise and its standard deviation are in the unit of the leak's coefficient, for the laminar leak m^3/(s Pa). The
    result is an average over widths of the prior on the differences of the other coefficients between recordings
    (`_compare_levels`, with `min_crossover` and `session_deviation`).
    """
    healthy_sums = np.sum([recording.sums for recording in baseline], axis=0)
    count, prior = len(baseline), INFERENCE.scatter
    # factors on the prior standard deviations; log(`prior.between`) is the standard deviation of their logarithm
    log_widths = np.linspace(-MAX_SCALE, MAX_SCALE, SCALES)
    widths = prior.between**log_widths
    rises, rise_errors = np.zeros((SCALES, count)), np.zeros((SCALES, 0))
    if count > 1:  # rises of each healthy recording over the others, scaled to its rise over the mean of all (else 0)
        excesses = [
            estimate_leak_excess(recording.sums, healthy_sums - recording.sums, columns, widths)
            for recording in baseline
        ]
        rises, rise_errors = np.array(excesses).transpose(1, 2, 0) * ((count - 1) / count)
    values, error = estimate_leak_excess(judged.sums, healthy_sums, columns, widths)
    level, level_error = coefficient_level(healthy_sums, columns)
    # smallest scatter of the rises for each width: a fraction of their median standard error, at least the fraction
    # `prior.finest` of the pump's mean flow, as a conductance, and never 0 (1 / MAX_READING)
    errors = prior.estimate * np.median(np.column_stack([error, rise_errors]), axis=1)
    errors = np.maximum(errors, max(prior.finest * judged.conductance_of_flow, 1.0 / MAX_READING))
    return _compare_levels(
        judged,
        baseline,
        values=values,
        rises=rises,
        errors=errors,
        log_widths=log_widths,
        level=level,
        level_error=level_error,
        min_crossover=min_crossover,
        session_deviation=session_deviation,
    )


def held_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of the leakage past the piston over healthy recordings, measured while valves hold a load.

    Return None if no load is held in the judged recording, or in fewer than `MIN_WITH_HOLDS` healthy recordings.
    """
    # a healthy piston alone leaks about nothing: such levels compare by their differences, not by their ratios
    min_crossover = INFERENCE.scatter.largest * judged.conductance_of_flow
    return _compare_held(judged, baseline, "held", min_crossover=min_crossover)


def held_pump_rise(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> Rise | None:
    """Estimate the rise of the pump's leakage over healthy recordings, measured just before valves shut to hold a load.

    Return None if it is unknown in the judged recording, or known in fewer than `MIN_WITH_HOLDS` healthy ones.
    """
    return _compare_held(judged, baseline, "held_pump", session_share=INFERENCE.held_oil.pump_session)


def _compare_held(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    name: str,
    *,
    min_crossover: float = 0.0,
    session_share: float | None = None,
) -> Rise | None:
    """Estimate the rise of a leak, measured while valves hold a load, over its mean in the healthy recordings.

    `name`: field of `RecordingSums` whose first two values are the leak's conductance and standard deviation
    [m^3/(s Pa)]; `min_crossover`: as in `_compare_levels`; `session_share`: standard deviation between sessions, over
    the healthy mean, or None for `scatter.session` of `priors.toml`. Return None if the field is None in the judged
    recording, or known in fewer than `MIN_WITH_HOLDS` healthy recordings.
    """
    baseline = [recording for recording in baseline if getattr(recording, name) is not None]
    if getattr(judged, name) is None or len(baseline) < MIN_WITH_HOLDS:
        return None
    leaks = np.array([getattr(recording, name)[:2] for recording in (*baseline, judged)])
    session_deviation = None if session_share is None else session_share * abs(float(leaks[:-1, 0].mean()))
    return leak_rise(
        [*baseline, judged], leaks, min_scatter=1.0, min_crossover=min_crossover, session_deviation=session_deviation
    )


def leak_rise(
    recordings: Sequence[RecordingSums],
    leaks: Array,
    *,
    min_scatter: float,
    min_crossover: float = 0.0,
    session_deviation: float | None = None,
) -> Rise:
    """Estimate by how much the leak of a recording, measured in each by itself, exceeds that of healthy recordings.

    `recordings` (n + 1): the healthy ones, then the judged one; `leaks` (n + 1, 2): conductance and standard deviation
    [m^3/(s Pa)] of each; `min_scatter`: smallest plausible scatter of the healthy leaks, over their median standard
    deviation; `min_crossover`, `session_deviation`: as in `_compare_levels`.
    """
    *baseline, judged = recordings
    *healthy_leaks, leak = leaks[:, 0]
    level = float(np.mean(healthy_leaks))
    # smallest scatter of a healthy leak: the fraction `finest` of the pump's mean flow, as a conductance, and never 0
    min_error = max(INFERENCE.scatter.finest * judged.conductance_of_flow, 1.0 / MAX_READING)
    error = max(float(np.median(leaks[:, 1])), min_error)  # median over all leaks, the judged one included
    rise = _compare_levels(
        judged,
        baseline,
        values=np.array([leak - level]),
        rises=(np.array(healthy_leaks) - level)[None],
        errors=np.array([max(min_scatter * error, min_error)]),
        level=max(level, 0.0),  # a mean below 0 is an error of the estimates
        level_error=error / np.sqrt(len(baseline)),
        min_crossover=min_crossover,
        session_deviation=session_deviation,
    )
    # the median `error` is included already; a less precise judged recording adds the difference
    return rise.widen(float(leaks[-1, 1]) ** 2 - error**2)


def _compare_levels(
    judged: RecordingSums,
    baseline: Sequence[RecordingSums],
    *,
    values: Array,
    rises: Array,
    errors: Array,
    log_widths: Array | float = 0.0,
    level: float,
    level_error: float,
    min_crossover: float = 0.0,
    session_deviation: float | None = None,
) -> Rise:
    """Estimate by how much the judged leak coefficient exceeds the coefficient that the healthy recordings predict.

    The coefficients a, the sums of healthy mean and rise, are compared as z = asinh(a / (2 c)), which is logarithmic
    for large a (`_LevelScale`). From z the predicted effect of the oil is subtracted. The rest is normal about an
    unknown mean, with an unknown standard deviation sigma of single recordings; sessions, oil and unusual conditions
    add covariances (see the module). In the unit of the coefficient, for s widths of the prior on the other
    coefficients, or s = 1 if there is no such prior:

    - `values` (s,): rises of the judged recording; `rises` (s, n): rises of n healthy recordings over their mean;
    - `errors` (s,): smallest plausible scatter of one rise, by its standard error; `log_widths` (s,): logarithms of the
      widths [standard deviations], 0 without the prior;
    - `level`, `level_error`: mean coefficient of the healthy recordings, and its standard error;
    - `min_crossover`: minimum of c, large where healthy levels are about zero, which makes z linear in them;
    - `session_deviation`: prior standard deviation between sessions with the same oil, None for that of the whole
      leakage (`scatter.session` of `priors.toml`).
    """
    prior = INFERENCE.scatter
    if session_deviation is None:
        session_deviation = prior.session * judged.conductance_of_flow
    recordings = [*baseline, judged]
    oils = oil_hypotheses(recordings)
    # scatter that the most probable oil does not explain: warmer oil is thinner and leaks more
    oil_factor = np.exp(oils[0].thinning[:-1])
    unexplained = rises - level * (oil_factor - oil_factor.mean())
    scatter = float(np.median(unexplained.std(axis=1)))
    # c, below which z is linear in a: the largest of errors, scatter, a tenth of the level, and `min_crossover`
    scale = _LevelScale(level, max(level_error, float(np.median(errors)), scatter, 0.1 * level, min_crossover))
    steepness = scale.slope(level)  # dz/da at the healthy mean
    relative_slope = steepness * level  # change of z for a relative change of a
    log_condition_excess = sum(condition.log_excess for condition in find_unusual_conditions(judged, baseline))
    pause = 3600.0 * INFERENCE.oil.shift  # from hours to seconds
    sessions = number_sessions([recording.start_s for recording in recordings], pause)
    # grid of sigma in z, for each row of the estimates: from the smallest plausible scatter to the largest, which is at
    # least ten times as large
    max_scatter = min(steepness * prior.largest * judged.conductance_of_flow, prior.relative)
    max_sigma = np.maximum(max_scatter, 10.0 * steepness * errors)
    sigma = np.geomspace(steepness * errors, max_sigma, NODES, axis=1)
    healthy_z = scale.transform(rises)
    # log Jacobian of z, plus log prior of the width, for each row
    log_priors = np.log(scale.slope(level + rises)).sum(axis=1) - 0.5 * np.square(log_widths)
    predictions = []
    for oil in oils:
        thinned = level * np.exp(oil.thinning)  # predicted levels
        candidates = _candidate_covariances(
            sessions,
            oil,
            scale.slope(thinned) * thinned,
            oil_deviation=relative_slope * oil.session_deviation,
            session_deviation=steepness * session_deviation,
            condition_deviation=relative_slope * (log_condition_excess * INFERENCE.conditions.leak),
        )
        shifts = scale.transform(thinned - level) - scale.transform(np.zeros(1))  # effect of the oil on z
        log_weights = (log_priors + oil.log_probability)[:, None]
        predicted = Population(*candidates).predict(healthy_z - shifts[:-1], sigma, log_weights)
        with_oil = predicted._replace(centres=predicted.centres + shifts[-1])
        predictions.append(scale.to_rises(with_oil))
    all_oils = Mixture(*(np.concatenate(parts, axis=1) for parts in zip(*predictions, strict=True)))
    return rise_of_mixture(all_oils, values)


def _candidate_covariances(
    sessions: Sequence[int],
    oil: OilHypothesis,
    relative_slopes: Array,
    *,
    oil_deviation: float,
    session_deviation: float,
    condition_deviation: float,
) -> tuple[Array, Array]:
    """Build g candidate covariances (g, n + 1, n + 1) of transformed leak coefficients, with log priors (g,).

    The candidates differ in the standard deviation between sessions. If the oil is unknown and no healthy recording is
    of the judged recording's session, they also differ in the oil of this session, which is either like that of the
    healthy sessions or unlike it. z is the transformed coefficient (`_LevelScale`).

    - `sessions` (n + 1,): session number of each recording, the judged one last;
    - `oil`: hypothesis on the oil's effect on the leakage of each recording;
    - `relative_slopes` (n + 1,): change of z per relative change of each recording's leak coefficient;
    - `oil_deviation`: standard deviation of z between sessions by unknown oil, 0 if the oil is known;
    - `session_deviation`: prior standard deviation of z between sessions with the same oil;
    - `condition_deviation`: standard deviation of the judged z due to unusual load and speed.
    """
    # grid of the standard deviation between sessions over its prior, denser near zero; the log priors are those of a
    # half-normal density times the distance of the grid points, which grows with the root of the ratio
    ratios = MAX_SESSION_RATIO * ((np.arange(NODES) + 0.5) / NODES) ** 2
    log_priors = 0.5 * np.log(ratios) - 0.5 * ratios**2
    if len(set(sessions)) == 1:  # the deviation of a single session is part of the unknown mean
        ratios, log_priors = np.zeros(1), np.zeros(1)
    session_variances = (np.hypot(oil_deviation, session_deviation) * ratios) ** 2
    # recordings of one session share the deviation of the session
    covariances = session_variances[:, None, None] * np.equal.outer(np.array(sessions), np.array(sessions))
    # the predicted effect of the oil has errors of its slope and of its values
    effects = relative_slopes * oil.thinning
    covariances = covariances + np.outer(effects, effects) * oil.slope_deviation**2
    covariances += np.diag(relative_slopes**2 * oil.variances)
    covariances[:, -1, -1] += condition_deviation**2
    if oil_deviation > 0.0 and sessions[-1] not in sessions[:-1]:
        # like oil, or unlike oil, which adds the variance of a difference between two sessions
        unlike = INFERENCE.scatter.unlike
        log_priors = (np.log([[1.0 - unlike], [unlike]]) + log_priors).ravel()
        covariances = np.tile(covariances, (2, 1, 1))
        covariances[len(ratios) :, -1, -1] += 2.0 * oil_deviation**2
    return covariances, log_priors


class _LevelScale(NamedTuple):
    """Transform z = asinh(a / (2 c)) of a leak coefficient a: logarithmic for a far above c, linear far below c.

    `level`: mean coefficient of the healthy recordings; `crossover`: c. Both are in the unit of the coefficient.
    """

    level: float
    crossover: float

    def transform(self, excess: Array) -> Array:
        """Compute z = asinh(a / (2 c)) of leak coefficients a = `level` + `excess`, of any shape."""
        return np.asarray(np.arcsinh((self.level + excess) / (2.0 * self.crossover)))

    def slope(self, level: Any) -> Any:
        """Compute dz/da = 1 / sqrt(a^2 + (2 c)^2) at leak coefficients a = `level`, a number or an array."""
        return 1.0 / np.hypot(level, 2.0 * self.crossover)

    def to_rises(self, predicted: Mixture) -> Mixture:
        """Convert a distribution of z to a distribution of the leak coefficient, relative to the healthy mean `level`.

        `predicted`: mixture of normal distributions, as from `Population.predict`. Each is split into `PARTS` narrower
        ones, along a new last axis, with the same mean and variance together.
        """
        x, part_weights = np.polynomial.hermite_e.hermegauss(PARTS)  # centres of the parts [standard deviations]
        deviations = predicted.deviations[..., None]
        z = predicted.centres[..., None] + np.sqrt(1.0 - PART_WIDTH**2) * deviations * x
        z = np.clip(z, -MAX_Z, MAX_Z)
        return Mixture(
            predicted.weights[..., None] + np.log(part_weights / part_weights.sum()),
            2.0 * self.crossover * np.cosh(z) * PART_WIDTH * deviations,  # da/dz times the deviation of a part
            2.0 * self.crossover * np.sinh(z) - self.level,
        )


def leak_deviations_from_mean(recordings: Sequence[RecordingSums], columns: Sequence[ColumnRoles]) -> Array:
    """Compute the deviation of each recording's leak coefficient from the mean of all n recordings, shape (n,).

    It is (n - 1)/n times the difference from the common leak coefficient of the others. The flow offset may differ by
    any amount between recordings, as it does behind valves that shut at rest: both assumptions on the valves, which
    are compared by these deviations, are thus treated alike.
    """
    columns = [roles.with_free_zero() for roles in columns]  # so that `eliminate_unshared` eliminates the flow offset
    all_sums = [eliminate_unshared(recording.sums, columns) for recording in recordings]
    total = np.sum(all_sums, axis=0)
    rises = [estimate_leak_excess(sums, total - sums, columns, widths=np.ones(1))[0] for sums in all_sums]
    return np.array(rises) * ((len(recordings) - 1) / len(recordings))
