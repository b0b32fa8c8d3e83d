"""The rig that detectors assume for a recording: the stated one, or one whose circuit the recording shows.

The circuit of a pump is closed, closed with an asymmetric pump, or open (`recognise_circuit`). In a closed circuit the
pump delivers into one chamber and draws from the other. Its flow moves the area of the side that carries the load,
while check valves keep the other side at the charge pressure. In an open circuit, as of many presses and clamps, the
pump feeds one chamber at a time while the other drains to the tank, and its flow moves the area of the side that valves
connect it with. An asymmetric pump, or two pumps on one shaft, has a displacement for each side, in the ratio of the
areas. With a rod on one side only, the ratios of flow to speed tell the circuits apart: out and in under the same load,
and under the loads of either side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.diagnosis.inference.equations.balances import (
    FeedSums,
    equations,
    feed_one_chamber,
    find_rest_limits,
    motions_of_side,
)
from sealscope.diagnosis.inference.equations.terms import (
    BIAS,
    CYLINDER,
    LAG,
    LEAK,
    MOTIONS,
    Equation,
    Signals,
    interval_means,
)
from sealscope.diagnosis.inference.rows import OVERLAP, weak_form_rows
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.priors.verdict import VERDICT
from sealscope.diagnosis.verdict.machine_sizes import (
    DEFAULT,
    UNSTATED,
    AssumedMachine,
    StatedBy,
    measures_flow,
    states_rig,
)
from sealscope.parameters import Rig, load_rig, rig_names
from sealscope.parameters.parts import ASYMMETRIC_CIRCUIT, OPEN_CIRCUIT
from sealscope.parameters.rig import ASSUMED
from sealscope.recordings.channels import flow_source
from sealscope.recordings.corrections.unsigned import is_two_way
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Parameters that convert a motion to a flow.
_GEOMETRY = ("cylinder.A_A", "cylinder.A_B", "pump.q_b")
#: Rig that is assumed of a machine whose recording shows the supply of a servo valve.
_BEHIND_VALVE = "servo-valve"
#: Source of a circuit that a recording shows.
_SHOWN = f"{ASSUMED} a recording shows it"


def assumed_rig(rig: Rig | str | os.PathLike[str] | None, recording: Recording) -> tuple[Rig, AssumedMachine]:
    """Choose the rig that detectors assume for a recording, and tell who stated its areas and displacement.

    A given `rig` counts as stated by the caller if it defines a whole machine, else by nobody. Without a rig, the
    thesis's rig is used, or the one of `infer_rig`. It counts as stated by the recording if that was simulated with a
    packaged rig of the same areas and displacement; otherwise all its values are marked as assumptions. Raises
    InputError if `rig` cannot be read.
    """
    rig = infer_rig(None if rig is None else load_rig(rig), [recording])
    used_rig = load_rig(DEFAULT) if rig is None else rig
    stated_by: StatedBy = "call" if rig is not None and states_rig(rig) else "nobody"
    if rig is None and _names_rig_of_same_geometry(recording.provenance, used_rig):
        stated_by = "recording"
    elif rig is None:
        used_rig = used_rig.as_assumed(UNSTATED)
    return used_rig, AssumedMachine(
        used_rig.name,
        stated_by,
        area=0.5 * (used_rig.cylinder.A_A + used_rig.cylinder.A_B),
        displacement=used_rig.pump.q_b,
        area_stated=used_rig.states("cylinder.A_A", "cylinder.A_B"),
        displacement_stated=used_rig.states("pump.q_b"),
        flow_meter=measures_flow(recording.units),
        areas=(used_rig.cylinder.A_A, used_rig.cylinder.A_B),
        bypass="q_leak" in recording.units,
    )


def infer_rig(rig: Rig | None, recordings: Sequence[Recording]) -> Rig | None:
    """Replace a rig that nobody stated as a whole, if recordings of the machine show its circuit.

    With stated areas, the circuit of a pump is that of `recognise_circuit`; the rig notes it, so that these recordings
    decide for all later ones of a machine. The first recording with the supply's pressure may also show a servo valve
    (`_shows_valve_supply`). Stated sizes are kept.
    """
    circuit = OPEN_CIRCUIT.parameter
    if rig is not None and (states_rig(rig) or rig.entry(circuit).source == _SHOWN):
        return rig
    if rig is not None and (value := recognise_circuit(rig, recordings)) is not None:
        return rig.with_overrides({circuit: value}, source=_SHOWN)
    is_valve = (shown for recording in recordings if (shown := _shows_valve_supply(rig, recording)) is not None)
    if not next(is_valve, False):
        return rig
    valve_rig = load_rig(_BEHIND_VALVE).as_assumed(UNSTATED)
    if rig is None or not rig.states("cylinder.A_A", "cylinder.A_B"):
        return valve_rig
    return valve_rig.with_areas(rig.cylinder.A_A, rig.cylinder.A_B, source=rig.entry("cylinder.A_A").source)


def _shows_valve_supply(rig: Rig | None, recording: Recording) -> bool | None:
    """Return True if a recording shows the supply of a servo valve; None if it cannot tell.

    That is so if no flow and no pump is recorded, only the command, and if p_1 exceeds both chamber pressures by
    `supply.margin` (`priors.toml`) in more than the fraction `supply.above` of the samples that have all three: at the
    port of a pump, p_1 is about the pressure of one chamber. A recording cannot tell without these pressures in Pa: raw
    counts cannot be compared. A displacement that `rig` states is that of a pump that feeds the chambers: the result is
    then False.
    """
    states_pump = rig is not None and rig.states("pump.q_b")
    if states_pump or flow_source(recording.channels) != "u":
        return False
    if any(recording.units.get(name) != "Pa" for name in ("p_1", "p_A", "p_B")):
        return None
    excess = recording["p_1"] - np.maximum(recording["p_A"], recording["p_B"])
    excess = excess[np.isfinite(excess)]
    return bool(np.mean(excess > VERDICT.supply.margin) > VERDICT.supply.above) if excess.size else None


def _names_rig_of_same_geometry(provenance: Mapping[str, Any], rig: Rig) -> bool:
    """Return True if a recording was simulated with a packaged rig of the areas and displacement of `rig`.

    `provenance` is that of the recording. The result is False if the simulation replaced an area or the displacement.
    """
    experiment = provenance.get("experiment")
    if not isinstance(experiment, Mapping):
        return False
    name, overrides = experiment.get("rig"), experiment.get("overrides")
    if name not in rig_names() or not isinstance(overrides, Mapping) or set(_GEOMETRY) & set(overrides):
        return False
    stated_rig = load_rig(name)
    return all(stated_rig[parameter] == rig[parameter] for parameter in _GEOMETRY)


#: Channels that show the flow of a pump, which a valve does not meter.
_PUMP_FLOWS = ("theta", "omega", "q_pump")
#: Fraction of the samples beyond each end of the stroke.
_END_QUANTILE = 0.02


def recognise_circuit(rig: Rig, recordings: Sequence[Recording]) -> str | None:
    """Return the most probable value of `pump.circuit`: "closed", "open" or "asymmetric"; None if nothing can tell.

    The mean evidence of the recordings counts (`open_circuit_log_factor`, `asymmetric_pump_log_factor`), since its
    errors repeat in all recordings of a machine, beside the log odds of `feed` (`priors.toml`) before any recording. A
    recording whose evidence is 0, because its piston moves one way only under each load, or under one load only, does
    not count. A recording cannot tell if the areas of the piston in `rig` are not stated, or hardly differ; if the flow
    of the pump or the position is not recorded, or a valve meters the flow; if a chamber pressure is not recorded in
    Pa; or if there are fewer than two samples.
    """
    signals = [parts for recording in recordings if (parts := _cylinder_signals(rig, recording)) is not None]
    if not signals:
        return None

    def log_odds(prior: float, log_factor: Callable[[Equation, Signals], float]) -> float:
        """Compute the log odds of a circuit relative to a closed one."""
        evidence = [log_factor(equation, samples) for equation, samples in signals]
        return prior + float(np.mean([value for value in evidence if value] or [0.0]))

    odds = {
        "closed": 0.0,
        OPEN_CIRCUIT.value: log_odds(INFERENCE.feed.one_chamber_odds, open_circuit_log_factor),
        ASYMMETRIC_CIRCUIT.value: log_odds(INFERENCE.feed.asymmetric_odds, asymmetric_pump_log_factor),
    }
    return max(odds, key=odds.__getitem__)


def _cylinder_signals(rig: Rig, recording: Recording) -> tuple[Equation, Signals] | None:
    """Return the volume balance of a cylinder in a closed circuit, and the signals of a recording for it.

    The balance tells a closed circuit from an open one only where their flows differ: on a single rod whose two areas
    are stated. It also needs a flow of the pump and two pressures in Pa. Return None otherwise.
    """
    channels = frozenset(recording.channels)
    if not (rig.states("cylinder.A_A", "cylinder.A_B") and rig.cylinder.single_rod):
        return None
    if flow_source(channels) not in _PUMP_FLOWS or any(recording.units.get(name) != "Pa" for name in ("p_A", "p_B")):
        return None
    samples = inspect_recording(recording).part  # with the signs of flows that are recorded without one
    balances = equations(rig, channels)
    if not balances or balances[0].name != CYLINDER or len(samples) < 2:
        return None
    limits = find_rest_limits(samples.channels, samples.rate, balances[0])
    return balances[0], Signals(samples.channels, samples.rate, rest_limits=limits)


def open_circuit_log_factor(equation: Equation, signals: Signals) -> float:
    """Compute the log Bayes factor of an open circuit to a closed one, from the pump's flow in either direction.

    With the volume V that the pump delivers and the distance X of the piston, under the load of one side, let

        r = log((V/X while A grows) / (V/X while B grows)).

    In a closed circuit r is 0, in an open one log(A_A / A_B). Losses of the pump and oil that is compressed let r
    scatter: it has a normal density of the variance `feed.scatter`^2 (1/w_A + 1/w_B) / 4 (`priors.toml`), where w is
    the fraction of the whole distance. The log factors under the loads of A and of B are added. Only the time in which
    pump and piston move counts, with the weight 1 - exp(-dp^2 / (2 z^2)): p_A - p_B = dp within the sensors' offsets z
    (`zero.pressure`) does not tell which side carries the load. `equation`: volume balance of a closed circuit.
    """
    log_factor = 0.0
    equation = feed_one_chamber(equation, FeedSums.measure(equation, signals).find_feed(equation.area_ratio))
    volume, step = equation.left(signals), signals.step("x")
    certainty = -np.expm1(-0.5 * (signals.pressure_difference / INFERENCE.zero.pressure) ** 2)
    is_counted = np.isfinite(volume * step * certainty) & (signals.moving(equation.left) > 0.0)
    volumes, distances = {}, {}
    for name, motion in MOTIONS.items():
        weights = (signals.direction_weights(*motion) * certainty)[is_counted]
        volumes[name], distances[name] = float(weights @ volume[is_counted]), float(weights @ step[is_counted])
    whole = sum(map(abs, distances.values()))
    in_open_circuit = -float(np.log(equation.area_ratio))  # r
    growing_A = motions_of_side(equation, "A")
    for loaded_side in "AB":
        same_load = [name for name in MOTIONS if name.endswith(f"{loaded_side} carries")]
        # the motion in which the pump feeds A, so that A grows, and the one in which B grows
        (of_A,), (of_B,) = ([name for name in same_load if (name in growing_A) == is_A] for is_A in (True, False))
        if not (volumes[of_A] * volumes[of_B] < 0.0 and distances[of_A] * distances[of_B] < 0.0):
            continue  # the piston does not move both ways under this load
        ratio = float(np.log(volumes[of_A] * distances[of_B] / (distances[of_A] * volumes[of_B])))
        variance = INFERENCE.feed.scatter**2 * sum(whole / abs(distances[name]) for name in (of_A, of_B)) / 4.0
        log_factor += (ratio**2 - (ratio - in_open_circuit) ** 2) / (2.0 * variance)
    return log_factor


def asymmetric_pump_log_factor(equation: Equation, signals: Signals) -> float:
    """Compute the log Bayes factor of an asymmetric pump to one of a closed circuit, from the loads of either side.

    The pump's flow per speed of the piston, with leakage and delay fitted beside it, is a under the load of one side.
    It contains the oil that the load compresses: where the pressure p follows the position, k = kappa L dp/dx of the
    flow that moves the piston, with the compressibility kappa of `held_oil` (`priors.toml`). L is the length of the oil
    column: the distance from the end of the recorded stroke at which the chamber is empty, and a dead volume. With

        r = log(a_A / (1 + k_A)) - log(a_B / (1 + k_B)),

    a closed circuit has r = log(A_A / A_B), an asymmetric pump r = 0. The variance of r is `feed.scatter`^2, and those
    of a and k. Motion has the weight 1 - exp(-dp^2 / (2 s^2)), with s = `feed.side_pressure`; the rest of it gets an a
    of its own. The result is 0 unless the piston moves under both loads and the flow has both signs, or if the
    displacement is not that of a pump.
    """
    oil, terms, step = INFERENCE.held_oil, {term.name: term for term in equation.terms}, signals.step("x")
    if not ("theta" in signals or "omega" in signals):
        return 0.0
    by_A = interval_means(signals.carried_by_A)
    certainty = -np.expm1(-0.5 * (signals.pressure_difference / INFERENCE.feed.side_pressure) ** 2)
    motions = [certainty * by_A * step, certainty * (1.0 - by_A) * step, (1.0 - certainty) * step]
    further_columns = [terms[name].increments(signals) for name in (LEAK, BIAS, LAG)]
    # rises of pressure while x grows, if A grows with x, and the position
    rises = [by_A * signals.step("p_A"), (by_A - 1.0) * signals.step("p_B"), signals.mean("x") * signals.dt]
    rows = weak_form_rows([*motions, *further_columns, *rises, equation.left(signals)], signals.rate)
    values = rows.values[rows.whole]
    columns, (rise_A, rise_B, x, volume) = values[:, :6], values[:, 6:].T
    if not is_two_way(*(float(np.maximum(signed, 0.0).sum()) for signed in (volume, -volume))):
        return 0.0  # a pump that turns one way, or whose speed has no sign
    targets = np.column_stack([rise_A, rise_B, volume])
    scale = np.linalg.norm(columns, axis=0)
    if len(values) <= columns.shape[1] or not scale.all():
        return 0.0
    fitted, _, rank, _ = np.linalg.lstsq(columns / scale, targets, rcond=None)
    fitted /= scale[:, None]
    flow_per_speed = fitted[:2, 2]
    if rank < columns.shape[1] or not flow_per_speed.prod() > 0.0:
        return 0.0
    inverse = np.linalg.inv(columns.T @ columns / np.outer(scale, scale)) / np.outer(scale, scale)
    variances = OVERLAP * np.var(volume - columns @ fitted[:, 2]) * np.diag(inverse)[:2]
    variance = INFERENCE.feed.scatter**2 + float((variances / flow_per_speed**2).sum())
    low, high = np.nanquantile(signals["x"], (_END_QUANTILE, 1.0 - _END_QUANTILE))
    dead, ratio = oil.dead_volume * (high - low), float(np.log(flow_per_speed[0] / flow_per_speed[1]))
    for side, (rise, sign) in enumerate(((rise_A, 1.0), (rise_B, -1.0))):
        stiffness = fitted[side, side]  # dp/dx
        weights = np.abs(columns[:, side] * rise)
        position = float(weights @ x) / max(float(weights.sum()), np.finfo(float).tiny)
        # the chamber is empty at the low end of x if x grows with it
        length = dead + (position - low if sign * stiffness > 0.0 else high - position)
        compressed = oil.compressibility * length * abs(stiffness)
        ratio -= sign * float(np.log1p(compressed))
        relative_variance = oil.deviation**2 + (oil.dead_volume_deviation * dead / length) ** 2
        variance += relative_variance * (compressed / (1.0 + compressed)) ** 2
    in_closed_circuit = -float(np.log(equation.area_ratio))
    return ((ratio - in_closed_circuit) ** 2 - ratio**2) / (2.0 * variance)
