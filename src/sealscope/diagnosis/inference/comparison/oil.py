"""Effect of the oil's viscosity on the leakage of several recordings, by its temperature or the viscous drop.

Leakage is proportional to the inverse of the viscosity. If the oil's temperature is known for all recordings, the
logarithm of the leakage has a slope in the temperature with a prior. Otherwise the viscous pressure drop of the motion
(`changes.motion_fit`) may show the viscosity, or the oil is unknown. The priors are in `priors.toml`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.comparison.recording_sums import RecordingSums, Resistance
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array


class OilHypothesis(NamedTuple):
    """Hypothesis on how the oil's viscosity changed the leakage of n + 1 recordings, the judged one last.

    - `thinning` (n + 1,): predicted logarithm of the leakage, relative to the mean over the n healthy recordings;
    - `variances` (n + 1,): variance of the error of each prediction, without the error of its slope;
    - `log_probability`: log probability of the hypothesis, given the resistances to the motion;
    - `slope_deviation`: relative standard deviation of the slope of `thinning` in temperature or pressure drop;
    - `session_deviation`: standard deviation of a session's log leakage by unknown oil, 0 if the oil is known.
    """

    thinning: Array
    variances: Array
    log_probability: float = 0.0
    slope_deviation: float = 0.0
    session_deviation: float = 0.0


def oil_hypotheses(recordings: Sequence[RecordingSums]) -> list[OilHypothesis]:
    """List the hypotheses on how the oil changed the leakage of `recordings`, the judged one last, most probable first.

    If all recordings have an oil temperature, it predicts the effect. Otherwise the viscous drop of the motion may show
    the viscosity (`_oils_by_drop`), or the oil is unknown.
    """
    prior, zeros = INFERENCE.oil, np.zeros(len(recordings))
    temperatures = [recording.oil_degC for recording in recordings if recording.oil_degC is not None]
    if len(temperatures) == len(recordings):
        warmer = np.array(temperatures) - np.mean(temperatures[:-1])
        slope_deviation = prior.per_kelvin_deviation / prior.per_kelvin
        return [OilHypothesis(prior.per_kelvin * warmer, zeros, slope_deviation=slope_deviation)]
    # half of log(warmest), the range, is the standard deviation of the difference of two sessions: sqrt(2) times that
    # of one session
    unknown = OilHypothesis(zeros, zeros, session_deviation=float(np.sqrt(0.125) * np.log(prior.warmest)))
    by_drop = _oils_by_drop(recordings, unknown.session_deviation)
    if not by_drop:
        return [unknown]
    oils = [*by_drop, unknown._replace(log_probability=float(np.log1p(-prior.drop_tells)))]
    return sorted(oils, key=lambda oil: -oil.log_probability)


def _oils_by_drop(recordings: Sequence[RecordingSums], unknown_deviation: float) -> list[OilHypothesis]:
    """List the hypotheses on the oil that follow from the viscous drop of the motion.

    `recordings`: the healthy ones, then the judged one. The resistance to the motion at the top speed v, friction +
    drop v, is known well. Friction and viscous drop are known less well, since friction varies with speed and load.
    There are two hypotheses, in which the healthy friction and v are medians over the healthy recordings. Only the
    first counts if the judged or the healthy friction is not positive:

    - Friction changed, as if seals wore, and the drop is the fitted one.
    - Friction was what it is in the healthy recordings, and drop = (resistance at v - healthy friction) / v.

    Their probabilities, with the sum `oil.drop_tells` of `priors.toml`, follow from the judged friction and from the n
    healthy drops. Splitting the resistance wrongly makes these drops scatter more. With an unknown scatter, their
    density is proportional to S^(-(n - 1) / 2), where S is the sum of two kinds of squares: of the logarithms of the
    drops about their mean, and of the relative errors of the drops.

    Each hypothesis is listed twice: once with the judged drop as a sign of the oil, and once, with the small prior
    probability `oil.drop_misleads`, without this sign, as if something else, such as a swollen seal, had changed the
    judged drop. That changes the friction, too, which therefore has the density of the first hypothesis.

    A drop predicts the thinning -`oil.per_drop` r (log drop - mean of the healthy ones), with the reliability r, the
    variance of true drops over that of measured ones. A drop below its standard error is replaced by this error. A
    recording without a drop gets the mean drop, and the error of unknown oil: `unknown_deviation`, the standard
    deviation of the logarithm of the leakage. The list is empty if the judged recording has no drop, or none of the
    healthy ones has.
    """
    prior, no_fit = INFERENCE.oil, np.full(len(Resistance._fields), np.nan)
    friction, friction_error, drop, drop_error, speed = np.array(
        [no_fit if recording.resistance is None else recording.resistance for recording in recordings]
    ).T  # (n + 1,) each, NaN where unknown
    is_known = np.isfinite(drop)
    if not (is_known[-1] and is_known[:-1].any()):
        return []
    healthy = np.flatnonzero(is_known[:-1])
    # friction resists the motion: the sign depends on the channel that shows the motion
    sign = np.sign((friction / friction_error)[healthy].sum()) or 1.0
    friction, drop = sign * friction, sign * drop
    healthy_friction, top_speed = (float(np.median(values[healthy])) for values in (friction, speed))
    drops, log_densities = [drop], np.zeros(1)  # one for each hypothesis
    if min(healthy_friction, friction[-1]) > 0.0:  # else their ratio has no logarithm
        drops.append(drop + (friction - healthy_friction) / top_speed)
        change = float(np.log(friction[-1] / healthy_friction))
        # prior deviations of this change under the two hypotheses: friction changed, or did not
        deviations = np.array([prior.friction_changes, prior.friction_session])
        log_densities = -0.5 * (change / deviations) ** 2 - np.log(deviations)
    drops_by_hypothesis = np.maximum(drops, drop_error)  # (hypotheses, n + 1)
    healthy_logs = np.log(drops_by_hypothesis[:, healthy])
    squares = (healthy_logs - healthy_logs.mean(axis=1, keepdims=True)) ** 2
    squares += (drop_error[healthy] / drops_by_hypothesis[:, healthy]) ** 2
    log_scatters = -0.5 * (len(healthy) - 1) * np.log(squares.sum(axis=1))
    log_misleads = np.log(prior.drop_misleads) + log_densities[0] + log_scatters
    log_tells = np.log1p(-prior.drop_misleads) + log_densities + log_scatters
    log_sum = np.logaddexp.reduce(np.concatenate([log_tells, log_misleads]))
    log_probabilities = np.log(prior.drop_tells) + np.column_stack([log_tells, log_misleads]) - log_sum
    variance = unknown_deviation**2
    judged_unknown = is_known.copy()
    judged_unknown[-1] = False
    oils = list[OilHypothesis]()
    for positive_drops, mean, probabilities in zip(
        drops_by_hypothesis, healthy_logs.mean(axis=1), log_probabilities.tolist(), strict=True
    ):
        error_variance = (prior.per_drop * drop_error / positive_drops) ** 2
        for is_informative, log_probability in zip((is_known, judged_unknown), probabilities, strict=True):
            # variance of the true drop over that of the measured one
            reliability = np.where(is_informative, variance / (variance + error_variance), 0.0)
            log_ratio = np.where(is_informative, np.log(positive_drops) - mean, 0.0)
            oils.append(
                OilHypothesis(
                    thinning=-prior.per_drop * reliability * log_ratio,
                    variances=(1.0 - reliability) * variance,
                    log_probability=log_probability,
                    slope_deviation=prior.per_drop_deviation / prior.per_drop,
                )
            )
    return oils
