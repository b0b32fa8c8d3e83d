"""Recognise an open circuit: a pump that feeds one chamber at a time while the other drains to the tank.

In a closed circuit the pump delivers into one chamber and draws from the other. Its flow moves the area of the side
that carries the load, while check valves keep the other side at the charge pressure. In an open circuit, as of many
presses and clamps, its flow moves the area of the side that valves connect it with. With a rod on one side only, the
ratios of flow to speed under the same load tell the two circuits apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.balance import find_rest_limits
from sealscope.diagnosis.inference.equations.balances import equations
from sealscope.diagnosis.inference.equations.feed import FeedSums, feed_one_chamber, motions_of_side
from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.inference.equations.terms import CYLINDER, MOTIONS, Equation
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.channels import flow_source
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Channels that show the flow of a pump, which a valve does not meter.
_PUMP_FLOWS = ("theta", "omega", "q_pump")


def shows_open_circuit(rig: Rig, recordings: Sequence[Recording]) -> bool | None:
    """Return True if recordings show that the pump feeds one chamber at a time.

    Their mean evidence (`open_circuit_evidence`) counts, since its errors repeat in all recordings of a machine, beside
    the log odds `feed.one` (`priors.toml`) before any recording. A recording whose evidence is 0, because its piston
    moves one way only under each load, does not count. The result is None if the channels of no recording can tell.
    """
    evidence = [value for recording in recordings if (value := open_circuit_evidence(rig, recording)) is not None]
    if not evidence:
        return None
    return INFERENCE.feed.one + float(np.mean([value for value in evidence if value] or [0.0])) > 0.0


def open_circuit_evidence(rig: Rig, recording: Recording) -> float | None:
    """Compute the log Bayes factor of an open circuit that a recording gives (`open_circuit_log_factor`).

    The result is None if the recording cannot tell: the areas of the piston in `rig` are not stated, or hardly differ;
    the flow of the pump or the position is not recorded, or a valve meters the flow; a chamber pressure is not recorded
    in Pa; or there are fewer than two samples.
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
    signals = Signals(samples.channels, samples.rate, rest_limits=limits)
    feed = FeedSums.measure(balances[0], signals).find_feed(balances[0].area_ratio)
    return open_circuit_log_factor(feed_one_chamber(balances[0], feed), signals)


def open_circuit_log_factor(equation: Equation, signals: Signals) -> float:
    """Compute the log Bayes factor of an open circuit, from the pump's flow in either direction of motion.

    With the volume V that the pump delivers and the distance X of the piston, under the load of one side, let

        r = log((V/X while A grows) / (V/X while B grows)).

    In a closed circuit r is 0, in an open one log(A_A / A_B). Losses of the pump and oil that is compressed let r
    scatter: it has a normal density of the variance `feed.scatter`^2 (1/w_A + 1/w_B) / 4 (`priors.toml`), where w is
    the fraction of the whole distance. The log factors under the loads of A and of B are added. Only the time in which
    pump and piston move counts, with the weight 1 - exp(-dp^2 / (2 z^2)): p_A - p_B = dp within the sensors' offsets z
    (`zero.pressure`) does not tell which side carries the load. `equation`: volume balance of an open circuit
    (`feed_one_chamber`).
    """
    log_factor = 0.0
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
