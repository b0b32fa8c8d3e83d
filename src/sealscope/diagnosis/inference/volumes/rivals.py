"""Rivals of a leak: other faults that may explain a change of the flow since the healthy recordings.

Such faults are an external leak, wear of the pump, and free air. Each has a term in the volume balance. The change of
its coefficient is fitted to the residual of a recording under the healthy coefficients, with priors on the changes of
all other coefficients (`priors.toml`). The scatter of the coefficient among the healthy recordings shows which change
is normal (`observable.compare_with_healthy`). An external leak and a leak past the piston look nearly alike: the
likelihood ratio of the two is stated with the observable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.estimate.population import MIN_HEALTHY, excess_error
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.circuit.holds.leaks import HeldLeaks
from sealscope.diagnosis.inference.comparison.levels import (
    RISE,
    compare_laws,
    compare_with_leak,
    held_pump_rise,
    oil_hypotheses,
    rise,
)
from sealscope.diagnosis.inference.comparison.recording_sums import (
    RecordingSums,
    coefficient_level,
    marginal_difference,
)
from sealscope.diagnosis.inference.equations.terms import AIR, LEAK, SPEED_LOSS, TURNING
from sealscope.diagnosis.inference.observable import Observable, compare_with_healthy
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.recording import Array

#: `Observable.data` of the leakage of the turning pump, in a machine whose rests show the piston's leakage alone.
TURNING_DATA = "turning"
#: Smallest number that is divided by.
TINY = float(np.finfo(float).tiny)


def rival_rises(
    judged: RecordingSums,
    healthy: Sequence[RecordingSums],
    columns: Sequence[ColumnRoles],
    volume_ratio: float = 1.0,
    unit_flows: Mapping[str, float] | None = None,
) -> tuple[Observable, ...]:
    """Test for faults other than a leak past the piston that may explain a change since the healthy recordings.

    The result has one test for each rival that can be compared. Leakages that are measured while shut valves hold the
    load (`held_rivals`), or just before (`held_pump_rise`), are compared only by these measurements.

    `columns`: roles of the columns of each balance, the same for all recordings. `volume_ratio`: measured over assumed
    ratio of the piston's area to the pump's displacement, by which prior volumes of air are multiplied. `unit_flows`:
    flow [m^3/s] of an external leak with a conductance of 1 m^3/(s Pa), by the name of its term. A leak without an
    entry is assumed to be driven by the mean of abs(p_A - p_B) in the judged recording.
    """
    names, hold_rivals = columns[0].names, held_rivals(judged, healthy, unit_flows)
    laws = compare_laws(judged, healthy, columns)
    # if an orifice fits better than a laminar leak, a rival is compared with the orifice
    orifice_log_ratio = 0.0 if laws is None else max(laws.log_ratio, 0.0)
    observables = list[Observable | None]()
    for k, name in enumerate(names):
        # a balance without a speed loss has a flow meter downstream of the pump, which does not show the pump's leakage
        if name == TURNING and SPEED_LOSS in names:
            observables.append(_turning_rise(judged, healthy, columns, k))
            continue
        is_outside = name.startswith("external leak") and hold_rivals is None
        if name != AIR and not is_outside:
            continue
        (*healthy_values, value), error, _ = _compare_changes(judged, healthy, columns, k)
        prior_change = np.inf if is_outside else INFERENCE.free_air.size * volume_ratio
        rival = compare_with_healthy(
            name, RISE, value, healthy_values, error, above=is_outside, prior_change=prior_change
        )  # free air may also decrease
        if rival is None:
            continue
        if is_outside:
            rival = _penalise_size(rival, judged, unit_flows)
        # likelihood ratio of the rival to a leak past the piston
        log_ratio = compare_with_leak(judged, healthy, columns, name)
        if log_ratio is not None:
            rival = replace(rival, log_ratio_to_leak=log_ratio - orifice_log_ratio)
        observables.append(rival)
    return (*filter(None, observables), *(hold_rivals or ()))


def _compare_changes(
    judged: RecordingSums, healthy: Sequence[RecordingSums], columns: Sequence[ColumnRoles], tested: int
) -> tuple[list[float], float, list[RecordingSums]]:
    """Estimate the change of a coefficient from the healthy recordings, in each of these and in the judged recording.

    A healthy recording is compared with the other healthy ones, and left out if no pressure drives the flow of the
    tested term. Returns the changes, that of the judged recording last; the part of its standard error that the scatter
    of the others does not contain (`excess_error`); and the healthy recordings that were compared. `tested`: column of
    the coefficient.
    """
    total = np.sum([recording.sums for recording in healthy], axis=0)
    change, error = _estimate_change(judged.sums, total, columns, tested)
    known, values, errors = list[RecordingSums](), list[float](), list[float]()
    for recording in healthy:
        healthy_change, healthy_error = _estimate_change(recording.sums, total - recording.sums, columns, tested)
        if np.isfinite(healthy_error):
            known.append(recording)
            values.append(healthy_change)
            errors.append(healthy_error)
    return [*values, change], excess_error(error, errors), known


def _turning_rise(
    judged: RecordingSums, healthy: Sequence[RecordingSums], columns: Sequence[ColumnRoles], tested: int
) -> Observable | None:
    """Test the leakage of the turning pump, the coefficient of the column `tested`, for a rise over healthy recordings.

    It describes data of its own, and so does not compete with the leak for the rise of the leakage. Return None if too
    few healthy recordings show it.
    """
    pump_rise = held_pump_rise(judged, healthy)
    if pump_rise is not None:  # measured just before valves shut to hold a load
        score = max(pump_rise.score, 0.0) ** 2  # a fall does not count
        return Observable(name=TURNING, data=TURNING_DATA, score=score, chance=pump_rise.chance, size=pump_rise.value)
    changes, error, known = _compare_changes(judged, healthy, columns, tested)
    turning_columns = [roles.replace_leak(TURNING) for roles in columns]
    level, _ = coefficient_level(np.sum([recording.sums for recording in healthy], axis=0), turning_columns)
    # levels instead of changes, since the oil's viscosity scales the whole leakage
    likeliest_oil, *_ = oil_hypotheses([*known, judged])
    levels = _without_oil(level + np.array(changes), likeliest_oil.thinning)
    *healthy_values, value = levels.tolist()
    observable = compare_with_healthy(TURNING, TURNING_DATA, value, healthy_values, error, above=True)
    if observable is None:
        return None
    # a rise that warmer oil explains does not count
    return replace(observable, chance=max(observable.chance, rise(judged, healthy, turning_columns).chance))


def _without_oil(coefficients: Array, thinning: Array) -> Array:
    """Remove the effect of the oil's viscosity from leakage coefficients (n + 1,), if healthy ones then scatter less.

    `thinning` (n + 1,): logarithm of the factor by which thinner oil raises each coefficient. The last coefficient is
    that of the judged recording.
    """

    def relative_scatter(values: Array) -> float:
        """Compute the standard deviation of the healthy values over their mean."""
        return float(np.std(values[:-1])) / max(abs(float(values[:-1].mean())), TINY)

    corrected = coefficients * np.exp(-thinning)
    return min(coefficients, corrected, key=relative_scatter)


def held_rivals(
    judged: RecordingSums, healthy: Sequence[RecordingSums], unit_flows: Mapping[str, float] | None = None
) -> tuple[Observable, ...] | None:
    """Test chambers A and B for larger external leaks than in healthy recordings, while shut valves hold the load.

    Return one test for each chamber that can be compared, None without such holds in the judged recording and in at
    least `MIN_HEALTHY` healthy ones. `unit_flows`: as in `rival_rises`.
    """
    healthy_leaks = [HeldLeaks(*recording.held) for recording in healthy if recording.held is not None]
    if judged.held is None or len(healthy_leaks) < MIN_HEALTHY:
        return None
    judged_leaks = HeldLeaks(*judged.held)
    # no machine repeats its leakage to less than the fraction `scatter.finest` of the pump's mean flow
    min_error = INFERENCE.scatter.finest * judged.conductance_of_flow
    observables = list[Observable]()
    for side in "AB":
        value, *healthy_values = (float(getattr(leaks, f"outside_{side}")) for leaks in (judged_leaks, *healthy_leaks))
        errors = [getattr(leaks, f"deviation_{side}") for leaks in (judged_leaks, *healthy_leaks)]
        error = max(float(np.median(errors)), min_error)
        observable = compare_with_healthy(f"external leak {side}", RISE, value, healthy_values, error, above=True)
        if observable is not None:
            observables.append(_penalise_size(observable, judged, unit_flows))
    return tuple(observables)


def _penalise_size(observable: Observable, judged: RecordingSums, unit_flows: Mapping[str, float] | None) -> Observable:
    """Set the `advantage` of a test for an external leak to a penalty for the size of the leak, which is at most 0.

    A large external leak is improbable, since someone would have noticed the oil outside. The penalty is 2 log(prior
    density / largest prior density) of the leak's flow, and 0 for flows below the centre of the prior (`outside` in
    `priors.toml`). `unit_flows`: as in `rival_rises`.
    """
    flow = observable.size * (unit_flows or {}).get(observable.name, judged.pressure)
    return replace(observable, advantage=-INFERENCE.outside.penalty(flow, above=True))


def _estimate_change(gram: Array, reference: Array, columns: Sequence[ColumnRoles], tested: int) -> tuple[float, float]:
    """Estimate the change of a coefficient of a recording from healthy recordings, with its standard error.

    `gram`, `reference` (E, m, m): Gram matrices (`RecordingSums.sums`) of the recording, and of the sum of the healthy
    recordings, for E equations; `tested`: column of the coefficient, which counts as 0 in the healthy recordings. The
    differences of the other coefficients have normal priors and are eliminated. Except for the leak, columns without a
    finite prior deviation are left out: `sums` no longer contain them. Without information the result is (0, inf).
    """
    precision, moment = 0.0, 0.0
    for e, roles in enumerate(columns):
        leak = roles.names.index(LEAK)
        fitted = [k for k in roles.compared if k != tested and (k == leak or np.isfinite(roles.between_deviation[k]))]
        coefficients = np.zeros(roles.left)
        coefficients[fitted] = Gaussian.from_gram(reference[e]).among(fitted).mean
        prior = roles.difference_precisions(fitted, coefficients[fitted], coefficients[leak])
        residual = Gaussian.from_gram(gram[e]).subtract(coefficients)
        change = marginal_difference(residual, [tested], fitted, prior)
        precision, moment = precision + change.precision[0, 0], moment + change.moment[0]
    return (moment / precision, precision**-0.5) if precision > 0.0 else (0.0, np.inf)
