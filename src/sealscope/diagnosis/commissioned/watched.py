"""Read from a machine's file what the monitor needs: rig, layout of its logs, repair limit and healthy leakage."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sealscope.diagnosis.commissioned.machine import CommissionedMachine
from sealscope.diagnosis.commissioned.machine_file import read_machine
from sealscope.diagnosis.estimate.linear import Gaussian
from sealscope.diagnosis.healthy import SummarisedRecording
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.comparison import BalanceSummary
from sealscope.diagnosis.inference.equations.balances import equations
from sealscope.diagnosis.inference.equations.terms import PUMP
from sealscope.diagnosis.live.estimates import HealthyLevel
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.channels import METERS, flow_source
from sealscope.recordings.formats.columns import ChannelMap
from sealscope.storage.toml_file import read_toml

#: Fewest healthy recordings that a leakage is compared with, as a single one has no scatter.
_MIN_RECORDINGS = 2
#: Names of the parameters for the piston areas and the pump's displacement.
_AREAS, _DISPLACEMENT = ("cylinder.A_A", "cylinder.A_B"), "pump.q_b"


@dataclass(frozen=True)
class WatchedMachine:
    """An actuator to be monitored, as stated by the file of a rig or of a commissioned machine.

    - `rig`: sizes; if only the areas are stated, the pump's displacement is measured from the healthy recordings.
    - `channel_map`, `rate`: column of the logs for each channel, and sampling rate [Hz] of logs without a time column.
    - `limit_lpm`: leak at which the machine must be repaired [L/min], None for the file of a rig, or if it follows from
      a creep speed and a piston area that is not stated.
    - `machine`: machine with the healthy recordings that recordings are compared with, None if there are none.
    - `healthy`: leakage of pump and piston together in the healthy recordings, None if it cannot be determined.
    """

    rig: Rig
    channel_map: ChannelMap = field(default_factory=dict)
    rate: float | None = None
    limit_lpm: float | None = None
    machine: CommissionedMachine | None = None
    healthy: HealthyLevel | None = None


def load_watched(rig: str) -> WatchedMachine:
    """Load an actuator for the monitor by the name or file of a `rig`, or by the file of a commissioned machine.

    Raises InputError if the file cannot be read.
    """
    if not rig.endswith(".toml") or "machine" not in read_toml(Path(rig), "a rig file", rig):
        named_rig = load_rig(rig)
        return WatchedMachine(named_rig, named_rig.channel_map)
    machine = read_machine(rig)
    sizes = measured_rig(machine)
    cylinder = sizes.cylinder
    area = 0.5 * (cylinder.A_A + cylinder.A_B) if sizes.states(*_AREAS) else None
    return WatchedMachine(
        sizes,
        machine.channel_map,
        machine.rate,
        limit_lpm=RepairLimit.parse(machine.limit).flow_lpm(area),
        machine=machine if machine.healthy else None,
        healthy=_healthy_level(machine.healthy, machine.rig or unstated_rig()),  # rig of the stored summaries
    )


def measured_rig(machine: CommissionedMachine) -> Rig:
    """Return the rig of a machine; if it states only piston areas, with the displacement that healthy recordings show.

    That is the median of the recordings. Where none measures it, and for any other rig, the rig is returned unchanged.
    """
    rig = machine.rig or unstated_rig()
    if rig.states(_DISPLACEMENT) or not rig.states(*_AREAS):
        return rig
    # a flow meter needs no displacement, and does not measure it
    by_pump = (recording for recording in machine.healthy if flow_source(recording.units) not in METERS)
    summaries = (recording.summary(BalanceSummary) for recording in by_pump)
    # measured over assumed displacement, 0 if not measured
    scales = [summary.scale for summary in summaries if summary is not None and summary.scale > 0.0]
    if not scales:
        return rig
    source = f"measured by {len(scales)} healthy recordings beside the stated areas"
    return rig.with_overrides({_DISPLACEMENT: float(np.median(scales)) * rig.pump.q_b}, source=source)


def is_remeasured(rig: Rig, rig_before: Rig) -> bool:
    """Return True if two rigs differ only in the pump displacement, and by 5 % at most, like repeated measurements."""
    values, values_before = rig.model_dump(), rig_before.model_dump()
    for tree in (values, values_before):
        tree.get("pump", {}).pop("q_b", None)
    return values == values_before and bool(np.isclose(rig.pump.q_b, rig_before.pump.q_b, rtol=0.05))


def _healthy_level(healthy: tuple[SummarisedRecording, ...], rig: Rig) -> HealthyLevel | None:
    """Estimate mean, range and deviation of the leakage conductance [m^3/(s Pa)] of pump and piston together.

    The lower end of the range is at least the largest conductance divided by `oil.warmest` of `priors.toml`, the factor
    by which the warmest oil raises the leakage. The machine is known to be healthy until the start of the last
    recording (`known_s`), 0 if no recording has a date. The result is None if fewer than two recordings have an
    estimate.
    """
    levels = [level for recording in healthy if (level := _leak_conductance(recording, rig)) is not None]
    if len(levels) < _MIN_RECORDINGS:
        return None
    low = max(min(levels), max(levels) / INFERENCE.oil.warmest)
    known_s = max((recording.start_s for recording in healthy if recording.start_s is not None), default=0.0)
    mean, deviation = float(np.mean(levels)), float(np.std(levels, ddof=1))
    return HealthyLevel(mean, low, high=max(levels), deviation=deviation, known_s=known_s, count=len(levels))


def _leak_conductance(recording: SummarisedRecording, rig: Rig) -> float | None:
    """Estimate the leakage conductance of pump and piston together in a recording [m^3/(s Pa)] from its summary.

    The result is None without a summary by the balance, for a rig with no or several balances (servo valve), for one
    whose stream leaves the pump's leakage out (open circuit), if valves shut the pump off at rest, where the recording
    shows the piston alone and a stream shows nothing, if the summary has other terms than the rig's balance, or if the
    fit fails.
    """
    summary, balances = recording.summary(BalanceSummary), equations(rig, frozenset(recording.units))
    if summary is None or len(balances) != 1 or rig.circuit.feeds_one_chamber:
        return None
    if summary.held_odds is not None and summary.held_odds > 0.0:
        return None
    roles = ColumnRoles(balances[0])
    gram = summary.sums[0]  # Gram matrix of the only balance
    n_columns = roles.left + 1  # the left side is the last column
    if gram.shape != (n_columns, n_columns):
        return None
    # without a column for the pump's leakage, which lies in parallel, the leak's column stands for both
    nuisance = [k for k in roles.nuisance if k != roles.leak and roles.names[k] != PUMP]
    columns = [*nuisance, roles.leak]
    *_, leak_coefficient = Gaussian.from_gram(gram).among(columns).mean
    # true over computed flow; 0 if it is unknown: the stream computes its flows with the same assumed sizes
    scale = summary.scale or 1.0
    conductance = float(leak_coefficient * scale)
    return conductance if np.isfinite(conductance) else None
