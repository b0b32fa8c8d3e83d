"""Drift of the charge pressure, which falls where oil leaves the circuit.

In a closed circuit an accumulator keeps the chamber that carries no load at the charge pressure. A leak past the piston
returns its oil to the circuit; an external leak empties the accumulator, so that its pressure falls through the whole
recording. A sensor whose offset drifts moves the low values of its own chamber alone. Of each pressure, the steady
samples near its lowest values, the "low pressure" of the chamber, are fitted by

    p = level + k x + r_+ max(q, 0) + r_- min(q, 0) + drift t,

with the position x, whose rod volume moves oil into the accumulator, and the flow q of the pump, which drops pressure
in lines and check valves; without the pump's angle or speed there is no fit, as behind a valve. The fit is robust
(Cauchy weights) and gives samples above it less weight than those below: where valves shut a chamber off, its
pressure lies above the charge pressure. A standard error has two parts: that of a jackknife, and the scatter between
parts of the recording. Called for healthy and judged recordings by `healthy_levels`, and for a step that looks like a
loss of oil by `volumes`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import MIN_HEALTHY, ScatterPrior
from sealscope.diagnosis.inference.changes.motion_fit import (
    GROUPS,
    equal_parts,
    jackknife_errors,
    part_quantiles,
    part_sizes,
    solve_weighted,
    stack_equations,
)
from sealscope.diagnosis.inference.hypotheses import step_penalty
from sealscope.diagnosis.inference.machine_states import find_rests
from sealscope.diagnosis.inference.observable import Observable, compare_estimates
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.channels import flow_source
from sealscope.recordings.recording import Array, Recording, keep_with_recording
from sealscope.signals.smoothing import TINY, average_over
from sealscope.units import P_ATM

#: `Observable.data` of all drifts, and names of a fall of both low pressures and of a drift of one low pressure.
DRIFT, FALL, LOW = "drift", "fall of the charge pressure", "drift of low p_{}"
#: Channels of a pump that feeds the cylinder directly; behind a valve neither chamber is at a charge pressure.
PUMP = ("theta", "omega")
#: Quantile of a pressure that counts as its lowest value.
LOWEST = 0.02
#: Fraction of the samples, the lowest ones, with which the fit of an envelope begins.
BEGIN = 0.3
#: Maximum and minimum number of samples of a fit, and its number of iterations.
MAX_SAMPLES, MIN_SAMPLES, ITERATIONS = 4000, 200, 15
#: Weight of samples above the fit, over that of samples below.
ABOVE = 0.1
#: Scale of the weights' decrease over the median residual below the fit, and smallest scale [Pa].
WEIGHT_SCALE, MIN_SCALE = 2.0, 300.0
#: Number of gas volumes of the accumulator over which a likelihood is averaged.
N_VOLUMES = 25


def turned_angle(recording: Recording, flow_channel: str) -> Array:
    """Compute the angle [rad] by which the pump turns in each sampling interval, by "theta" or "omega"; (n - 1,)."""
    drive = recording[flow_channel]
    return np.asarray(np.diff(drive) if flow_channel == "theta" else drive[1:] / recording.rate)


@keep_with_recording
@np.errstate(all="ignore")
def estimate_low_drifts(recording: Recording) -> Mapping[str, Estimate]:
    """Estimate the drifts [Pa/s] of the lowest pressures of the chambers, by their names "A" and "B".

    In a closed circuit a chamber that carries no load is at the charge pressure. Samples count if they are within
    `charge.band` (`priors.toml`) of the chamber's lowest pressure, its quantile `LOWEST`, and change more slowly than
    `charge.steady` [Pa/s]: a load that swings through zero lowers the pressure only for a moment. While the pump rests
    no sample counts, as shut valves may enclose any pressure. A chamber is left out if its lowest pressure exceeds that
    of the other chamber by `charge.band` or more, if at most the fraction `charge.share` of the samples of a turning
    pump counts, or if these do not determine the drift (`_fit_drift`). The result is empty for a recording shorter than
    `MIN_SAMPLES`, and if a pressure, or both angle and speed of the pump, are not recorded. It is cached.
    """
    flow_channel = flow_source(recording.channels)
    if len(recording) < MIN_SAMPLES or flow_channel not in PUMP or not {"p_A", "p_B"} <= set(recording.channels):
        return {}
    prior, regressors = CHANGES.charge, _regressors(recording, flow_channel)
    rate, turned = recording.rate, turned_angle(recording, flow_channel)
    # one flag for each sample, that of the interval after it; none follows the last sample
    is_turning = np.append(~find_rests(turned, rate), False)
    is_known = np.isfinite(regressors).all(axis=1) & is_turning
    pressures = [average_over(prior.seconds, recording[name], rate) for name in ("p_A", "p_B")]
    lowest = [float(np.nanquantile(p[is_known], LOWEST)) if is_known.any() else np.nan for p in pressures]
    window = max(1, round(prior.seconds * rate))
    drifts = dict[str, Estimate]()
    for side, p, low in zip("AB", pressures, lowest, strict=True):
        slope = np.full(len(p), np.nan)  # over twice `charge.seconds`; samples at the ends, with NaN, do not count
        slope[window:-window] = (p[2 * window :] - p[: -2 * window]) * rate / (2 * window)
        is_low = is_known & np.isfinite(p) & (p < low + prior.band) & (np.abs(slope) < prior.steady)
        if low < min(lowest) + prior.band and is_low.sum() > prior.share * is_known.sum():
            drift = _fit_drift(recording.t, p, regressors, np.flatnonzero(is_low))
            if drift is not None:
                drifts[side] = drift
    return drifts


class ChargeTrend(NamedTuple):
    """Trend of the charge pressure in a recording, which shows whether oil may have left the circuit.

    `fall`, `error`: rate at which the charge pressure falls, and its standard error [Pa/s]; `pressure`: absolute charge
    pressure [Pa]; `begin`, `end`: times of the first and the last sample [s].
    """

    fall: float
    error: float
    pressure: float
    begin: float
    end: float

    def loss_support(self, flow: float, onset: float) -> float:
        """Compute twice the log likelihood ratio of a loss of oil to no loss, by the fall of the charge pressure.

        A constant loss q = abs(`flow`) [m^3/s] since `onset` [s] empties an accumulator, whose gas volume at the charge
        pressure p, divided by the polytropic exponent of the gas, is V. A straight line fitted to the pressure over the
        whole recording then falls at the rate

            fall = (p q / V) (1 - f)^2 (1 + 2 f),

        where f is the fraction of the recording before the onset. The likelihood is averaged over a log-normal prior on
        V (`accumulator` in `priors.toml`). With a small probability, a measured fall has another cause.
        """
        prior, z = CHANGES.accumulator, np.linspace(-3.0, 3.0, N_VOLUMES)  # log V in standard deviations
        weights = np.exp(-0.5 * z**2) / np.exp(-0.5 * z**2).sum()
        volumes = prior.size * np.exp(prior.spread * z)
        f = float(np.clip((onset - self.begin) / max(self.end - self.begin, TINY), 0.0, 1.0))
        expected = self.pressure * abs(flow) / volumes * (1.0 - f) ** 2 * (1.0 + 2.0 * f)
        deviation = float(np.hypot(self.error, CHANGES.charge.scatter))
        # a fall by another cause has the probability `unlike` and the uniform density 1 / `zero_drift.size`; it is
        # multiplied by sqrt(2 pi) times the deviation, by which the normal densities below are not divided
        other_cause = CHANGES.charge.unlike * np.sqrt(2.0 * np.pi) * deviation / CHANGES.zero_drift.size
        with_loss = float(weights @ np.exp(-0.5 * ((self.fall - expected) / deviation) ** 2)) + other_cause
        without_loss = float(np.exp(-0.5 * (self.fall / deviation) ** 2)) + other_cause
        return 2.0 * float(np.log(with_loss / without_loss))


def estimate_charge_trend(recording: Recording) -> ChargeTrend | None:
    """Estimate the rate [Pa/s] at which the charge pressure of a closed circuit falls, from both low pressures.

    It is minus the mean of both drifts (`estimate_low_drifts`), weighted by their precisions. Return None if no drift
    is known.
    """
    drifts = estimate_low_drifts(recording)
    fall = _mean_fall(drifts, {side: max(drift.deviation**2, TINY) for side, drift in drifts.items()})
    if fall is None:
        return None
    lowest = min(float(np.nanquantile(recording[name], LOWEST)) for name in ("p_A", "p_B"))
    pressure = max(lowest, 0.0) + P_ATM  # gauge to absolute pressure; a reading below 0 counts as 0
    begin, end = float(recording.t[0]), float(recording.t[-1])
    return ChargeTrend(fall=fall.value, error=fall.deviation, pressure=pressure, begin=begin, end=end)


def _regressors(recording: Recording, flow_channel: str) -> Array:
    """Compute the quantities (n, 2 or 3) that change the charge pressure besides a drift: pump flow and position.

    The columns are the positive and the negative part of the flow, relative to its largest magnitude, and, if recorded,
    the position [m] minus its mean. All are averaged over `charge.seconds`. `flow_channel`: the pump's angle or speed.
    """
    drive = average_over(CHANGES.charge.seconds, recording[flow_channel], recording.rate)
    flow = np.gradient(drive) if flow_channel == "theta" else drive
    flow = flow / max(float(np.nanmax(np.abs(flow))), TINY)
    columns = [np.maximum(flow, 0.0), np.minimum(flow, 0.0)]
    if "x" in recording:
        position = average_over(CHANGES.charge.seconds, recording["x"], recording.rate)
        columns.append(position - np.nanmean(position))
    return np.column_stack(columns)


def _fit_drift(t: Array, pressure: Array, regressors: Array, rows: NDArray[np.intp]) -> Estimate | None:
    """Estimate the drift [Pa/s] of the lower envelope of a pressure (n,) [Pa] at times `t` [s], and its standard error.

    The envelope is a robust fit in which samples above it count less than those below. `regressors` (n, k): pump flow
    and position, which are fitted together with the drift; `rows`: indices of the samples to fit, which are thinned out
    if they are many. Return None for fewer than `MIN_SAMPLES` samples, without a finite standard error, and if the
    drift over the recording reaches `charge.range` times `charge.band`: as all samples lie within `charge.band`, such a
    drift comes from too few visits to the charge pressure.
    """
    rows = rows[:: max(1, len(rows) // MAX_SAMPLES)]
    if len(rows) < MIN_SAMPLES:
        return None
    time, values = t[rows] - t[rows].mean(), pressure[rows]
    varying = regressors[rows][:, np.ptp(regressors[rows], axis=0) > 0.0]  # a constant one cannot be told from level
    design = np.column_stack([time, np.ones(len(rows)), varying])
    equations = stack_equations(design, values)
    # at first 1 for the lowest samples of each part of the recording, else 0
    weight = (values <= np.repeat(part_quantiles(values, BEGIN), part_sizes(len(rows)))).astype(float)
    for _ in range(ITERATIONS):
        coefficients = solve_weighted(equations, weight)
        residual = values - design @ coefficients
        below = np.abs(residual[residual < 0.0])
        scale = WEIGHT_SCALE * float(np.median(below) if below.size else 0.0) + MIN_SCALE
        # 1/hypot is the root of a Cauchy weight; samples above the envelope count less
        weight = np.where(residual > 0.0, ABOVE, 1.0) / np.hypot(1.0, residual / scale)
    slope = 0  # index of the column of the time, whose coefficient is the drift
    parts = equal_parts(len(rows))
    (jackknife_error,) = jackknife_errors(equations, weight, [slope], parts)
    drift = Estimate(float(coefficients[slope]), float(np.hypot(jackknife_error, _envelope_error(time, residual))))
    is_determined = abs(drift.value) * np.ptp(time) < CHANGES.charge.range * CHANGES.charge.band
    return drift if is_determined and np.isfinite(drift).all() else None


def _envelope_error(time: Array, residual: Array) -> float:
    """Compute the standard error [Pa/s] of a lower envelope's slope from its scatter between n parts of a recording.

    The standard error of the robust fit misses this scatter, since a part that lies off the envelope gets low weights.
    `residual`: pressure minus the fitted envelope. With its quantile r_k in part k, at the level `BEGIN` from which the
    robust fit begins, and the mean time t_k of the part,

        error^2 = (sum (r_k - mean of r)^2 / (n - 2)) / sum (t_k - mean of t)^2.
    """
    levels, sizes = part_quantiles(residual, BEGIN), part_sizes(len(residual))
    times = np.add.reduceat(time, np.cumsum(sizes) - sizes) / sizes
    return float(levels.std() / np.sqrt(GROUPS - 2) / max(float(times.std()), TINY))


def compare_low_drifts(
    judged: Mapping[str, Estimate], healthy: Sequence[Mapping[str, Estimate]]
) -> Iterator[Observable]:
    """Compare the drifts of the lowest readings (`estimate_low_drifts`) with those of healthy recordings.

    Yields a test for each of three explanations, if enough healthy recordings have the drift: the sensor of p_A drifts,
    the sensor of p_B drifts, or the charge pressure falls, which lowers both pressures alike. The `advantage` of each
    comes from a prior on its size. A fall does not explain a difference between the two drifts: if both are known, its
    p-value is

        chance = min(1, chance of the weighted mean of both drifts / chance of their difference),

    or 1 if too few healthy recordings have both.
    """
    prior = CHANGES.charge
    scatter = ScatterPrior(deviation=prior.scatter, recordings=prior.recordings, deflation=prior.deflation)
    known = {side: [other[side] for other in healthy if side in other] for side in judged}
    drifts = {side: drift for side, drift in judged.items() if len(known[side]) >= MIN_HEALTHY}
    if not drifts:
        return
    for side, drift in drifts.items():
        change = compare_estimates(LOW.format(side), DRIFT, drift, known[side], scatter)
        if change is not None:
            yield replace(change, advantage=-step_penalty(change.size, CHANGES.zero_drift))
    # of each side's drift: prior variance between days, squared standard error, variance between healthy recordings
    healthy_var = {side: float(np.var([drift.value for drift in known[side]])) for side in drifts}
    variances = {side: prior.scatter**2 + drift.deviation**2 + healthy_var[side] for side, drift in drifts.items()}
    falls = [mean for other in healthy if (mean := _mean_fall(other, variances)) is not None]
    judged_fall = _mean_fall(judged, variances)
    assert judged_fall is not None  # at least one drift of the judged recording is known
    fall = compare_estimates(FALL, DRIFT, judged_fall, falls, scatter, above=True)  # a fall is positive
    if fall is None:
        return
    if len(drifts) > 1:
        differences = [subtract_drifts(other) for other in healthy if len(other) > 1]
        difference = compare_estimates(FALL, DRIFT, subtract_drifts(judged), differences, scatter)
        chance = 1.0 if difference is None else min(1.0, fall.chance / max(difference.chance, TINY))
        fall = replace(fall, chance=chance)
    yield replace(fall, advantage=-step_penalty(fall.size, CHANGES.charge_fall))


def _mean_fall(drifts: Mapping[str, Estimate], variances: Mapping[str, float]) -> Estimate | None:
    """Compute the rate at which the charge pressure falls [Pa/s], as a mean of both chambers, with its standard error.

    The rate is -sum(drift / variance) / sum(1 / variance) over chambers with a known drift and variance [Pa^2/s^2].
    Return None if there is no such chamber.
    """
    known = [(drift, 1.0 / variances[side]) for side, drift in drifts.items() if side in variances]
    if not known:
        return None
    total_weight = sum(weight for _, weight in known)
    mean = sum(weight * drift.value for drift, weight in known) / total_weight
    error = float(np.sqrt(sum((weight * drift.deviation) ** 2 for drift, weight in known))) / total_weight
    return Estimate(-mean, error)


def subtract_drifts(drifts: Mapping[str, Estimate]) -> Estimate:
    """Compute the drift of p_A minus that of p_B, with its standard error."""
    (drift_A, error_A), (drift_B, error_B) = drifts["A"], drifts["B"]
    return Estimate(drift_A - drift_B, float(np.hypot(error_A, error_B)))
