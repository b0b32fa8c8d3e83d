"""Prepare the samples that volume balances read: mark clips and holes, derive the drive, leave out unknown flows.

Called for whole recordings (`regimes`, `circuit.without_position`), for each block of a stream (`block_stream`), and
for the curves of the workbench.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.control.drive import Drive
from sealscope.diagnosis.inference.equations.signals import MIN_ABSOLUTE_PRESSURE, Signals
from sealscope.diagnosis.inference.equations.terms import START, Equation
from sealscope.diagnosis.inference.machine_states import LoweringLimits, flag_lowering
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.corrections.gaps import flag_holes
from sealscope.recordings.quality import find_rails
from sealscope.recordings.recording import Array, Recording
from sealscope.units import P_ATM

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Channels that balances read.
READ = ("u", "theta", "omega", *METERS, "x", "p_1", "p_2", "p_A", "p_B")
#: Name of a signal that is 1 in holes (long gaps of missing samples that were filled in), else 0; absent without holes.
HOLE = "hole"
#: Name of p_A - p_B as recorded, among the samples of a recording in which pressures are clipped.
CLIPPED_DIFFERENCE = "p_A - p_B, clipped"


def bridged_samples(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples (n,) of those channels `names` that are recorded, with clipped pressures as NaN.

    Holes, i.e. long gaps of missing samples, keep the values with which the inspection filled them
    (`corrections.gaps`); the additional entry `HOLE` is then 1 there and 0 elsewhere. If a pressure is clipped, the
    additional entry `CLIPPED_DIFFERENCE` is p_A - p_B as recorded, for the pressure level of a block: clipped values
    are closer to the true ones than the mean of the other samples.
    """
    samples, is_clipped = {}, False
    is_hole = flag_holes(recording)
    if is_hole.any():
        samples[HOLE] = is_hole.astype(float)
    for name, values in recording.channels.items():
        if name in names:
            # rails: values at which the pressure transducer clips
            rails = list[float]()
            if name.startswith("p_"):
                finite = values[np.isfinite(values)]
                rails = [rail.value for rail in find_rails(finite, recording.units[name])]
            samples[name] = np.where(np.isin(values, rails), np.nan, values) if rails else values
            is_clipped |= bool(rails)
    if is_clipped and {"p_A", "p_B"} <= samples.keys():
        samples[CLIPPED_DIFFERENCE] = recording["p_A"] - recording["p_B"]
    return samples


def samples_without_holes(recording: Recording, names: Collection[str]) -> dict[str, Array]:
    """Return the samples (n,) of the channels `names` as `bridged_samples` does, but NaN in long gaps."""
    samples = bridged_samples(recording, names)
    is_hole = samples.pop(HOLE, np.zeros(0)) > 0.0
    return {name: np.where(is_hole, np.nan, values) for name, values in samples.items()} if is_hole.any() else samples


def derive_drive_signals(
    samples: Mapping[str, Array], rig: Rig, rate: float, *, loaded: bool = False
) -> dict[str, Array]:
    """Add signals from a model of the drive to the samples of a recording, each an array (n,) by channel name.

    `rate`: sampling rate [Hz]. The added entry `START` is exp(-t/lag) at the time t since the first sample: the effect
    of the drive's unknown initial state decays with the time constant lag. If only the command u shows the pump's flow,
    the drive's response to u is added as the pump's speed "omega" [rad/s], NaN where u is missing. If `loaded` is true,
    the drive responds to the load p_A - p_B as well. Otherwise the droop of the real speed under load counts as
    leakage.
    """
    drive = Drive.from_rig(rig)
    derived = {START: np.exp(-np.arange(len(samples["p_A"])) / (rate * drive.lag))}
    if flow_source(samples) == "u":
        u = _hold_missing(samples["u"])
        load = np.zeros(len(u))
        if loaded:
            dp = _hold_missing(samples["p_A"] - samples["p_B"])
            # the order of the pump's ports is unknown: the load is dp or -dp, whichever correlates positively with u
            load = dp if float((u - u.mean()) @ (dp - dp.mean())) >= 0.0 else -dp
        speed = drive.speed(u, load, rate)
        derived["omega"] = np.where(np.isnan(samples["u"]), np.nan, speed)
    return {**samples, **derived}


def _hold_missing(values: Array) -> Array:
    """Replace each missing value (NaN) of an array (n,) by the last known one; by 0 before the first."""
    last = np.maximum.accumulate(np.where(np.isnan(values), -1, np.arange(len(values))))
    return np.where(last < 0, 0.0, values[last])


def without_lowering(
    samples: Mapping[str, Array], rate: float, balance: Equation, limits: LoweringLimits | None = None
) -> dict[str, Array]:
    """Set the channel of the pump's flow to NaN while the piston moves past the resting pump (`flag_lowering`).

    `samples`: arrays by channel name at the `rate` [Hz]; `balance`: volume balance, whose left side is the pump's flow;
    `limits`: as in `flag_lowering`.
    """
    signals = Signals(samples, rate)
    difference = signals.compute_pressure_difference()
    is_lowered = flag_lowering(balance.left(signals), samples["x"], difference, rate, limits)
    return without_flow(samples, is_lowered)


def without_flow(samples: Mapping[str, Array], is_unknown: NDArray[np.bool_]) -> dict[str, Array]:
    """Set the channel of the pump's flow to NaN on either side of the sampling intervals that `is_unknown` flags."""
    source = flow_source(samples)  # not None: the balance has a recorded flow
    if source is None or not is_unknown.any():
        return dict(samples)
    is_touched = np.append(is_unknown, False) | np.append(False, is_unknown)
    return {**samples, source: np.where(is_touched, np.nan, samples[source])}


def absolute_offset(pressure: Array) -> float:
    """Compute absolute minus gauge pressure [Pa] for a sensor with the readings `pressure` (n,) [Pa].

    It is the atmospheric pressure, or more where the lowest reading would otherwise lie below `MIN_ABSOLUTE_PRESSURE`.
    """
    finite = pressure[np.isfinite(pressure)]
    min_reading = float(np.min(finite)) if finite.size else 0.0
    return max(P_ATM, MIN_ABSOLUTE_PRESSURE - min_reading)
