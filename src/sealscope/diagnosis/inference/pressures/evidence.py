"""Evidence from pressures and command: blocks, lines of the mains, and what blocks say of the conductance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import FEWEST, WITHIN_95, Information, StepTest, step_test
from sealscope.diagnosis.priors import priors
from sealscope.recordings.quality import mostly_clipped
from sealscope.recordings.recording import Array, Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

PRIORS = priors("inference.pressures")
#: No reading is larger, in SI: squares of sums of what is would overflow.
_LARGEST = 1e100


@dataclass(frozen=True, eq=False)
class PressureEvidence:
    """Evidence of pressures and command on the conductance g past the piston [m^3/(s Pa)], one number a block.

    Parameters
    ----------
    information : Information
        What K blocks say of g, all nuisance parameters eliminated.
    pressure : array of float, shape (K,)
        Mean of abs(p_A - p_B) in each block [Pa], by which g is a flow.
    pump : float
        Mean size of the pump's flow [m^3/s].
    stated : bool
        Whether the rig states what turns g into L/min.
    others : mapping of str to Information
        What they say of other parameters that may have stepped, by name.
    """

    information: Information
    pressure: Array
    pump: float
    stated: bool
    others: Mapping[str, Information] = field(default_factory=dict)

    @staticmethod
    def from_blocks(recording: Recording, rig: Rig, information: Mapping[str, Information]) -> PressureEvidence:
        """Build the evidence from the likelihood of each parameter in a recording, `information["G"]` of g."""
        edges, dp = block_edges(recording), np.abs(recording["p_A"] - recording["p_B"])
        pressure = np.add.reduceat(dp, edges[:-1]) / np.diff(edges)
        speed = rig.motor.omega_per_volt * float(np.mean(np.abs(recording["u"])))
        nuisance = {name: value for name, value in information.items() if name != "G"}
        pump = speed * rig.pump.q_b / (2.0 * np.pi)
        return PressureEvidence(information["G"], pressure, pump, states_flow(rig), nuisance)

    @cached_property
    def test(self) -> StepTest | None:
        """Test of a step of g."""
        return step_test(self.information)

    @property
    def level(self) -> tuple[float, float]:
        """Level of g over the recording and its standard deviation [m^3/(s Pa)]."""
        precision = max(float(self.information.precision.sum()), np.finfo(float).tiny)
        return float(self.information.vector.sum()) / precision, precision**-0.5

    @property
    def orifice(self) -> float:
        """Mean flow over g times `pressure` of an orifice; that of a worn seal is 1."""
        return float(PRIORS["conductance"]["orifice"])

    def flow(self, step: float, deviation: float) -> tuple[float, tuple[float, float]]:
        """Return the mean flow [L/min] of a step of g [m^3/(s Pa)] with its `deviation`, and the 95 % interval.

        The interval holds those of a worn seal and of an orifice and the doubt in the scale; the flow is that of their
        middle.
        """
        unit = float(self.pressure.mean()) / LITRE_PER_MINUTE
        reach = WITHIN_95 * math.hypot(deviation, flow_scale() * step)
        low, high = (step - reach) * unit, self.orifice * (step + reach) * unit
        return 0.5 * (1.0 + self.orifice) * step * unit, (max(0.0, low), max(0.0, high))


def flow_scale() -> float:
    """Return the standard deviation of the factor that all conductances share [1]: M/A^2 is not known closer."""
    known = PRIORS["scale"]
    return math.hypot(known["mass"], 2.0 * known["area"])


def states_flow(rig: Rig) -> bool:
    """Test whether a rig states the sizes to convert a conductance into L/min."""
    return rig.states("cylinder.A_A", "cylinder.A_B", "cylinder.M_eq")


def wander_of_conductance(seconds: float) -> float:
    """Compute the drift of a healthy machine's conductance in so many seconds [m^3/(s Pa)]."""
    return float(PRIORS["conductance"]["wander"]) * math.sqrt(seconds / PRIORS["blocks"]["wander"])


def unusable(recording: Recording, rig: Rig) -> str | None:
    """Return None where a recording has command and pressures in their units, of a pump that drives two like areas.

    Else why not, in words.
    """
    blocks = PRIORS["blocks"]
    if rig.valve.spool != "absent":
        return "behind a servo valve a position is needed"
    if rig.cylinder.single_rod:
        return "needs a cylinder of two like areas: on a single rod a position is needed"
    for name, unit in {"u": "V", "p_A": "Pa", "p_B": "Pa"}.items():
        if name not in recording:
            return f"needs {name}"
        if recording.units[name] != unit:
            return f"needs {name} in a unit, got counts"
    if recording.duration < FEWEST * blocks["shortest"]:
        return f"needs {FEWEST * blocks['shortest']:g} s or more, got {recording.duration:.3g} s"
    if recording.rate < blocks["slowest"]:
        slow = f"got {recording.rate:.3g} Hz: the ringing after a reversal is not seen"
        return f"needs {blocks['slowest']:g} Hz or more, {slow}"
    for name in ("u", "p_A", "p_B"):
        if not np.all(np.isfinite(recording[name])) or not np.ptp(recording[name]) > 0.0:
            return f"{name} is constant or has missing samples"
        if not np.max(np.abs(recording[name])) < _LARGEST:
            return f"{name} is no reading: it exceeds {_LARGEST:g} {recording.units[name]}"
        if name != "u" and mostly_clipped(recording[name]):
            return f"{name} is mostly cut off at an end of its range"
    return None


def block_edges(recording: Recording) -> NDArray[np.int64]:
    """Return the samples (K + 1,) between which the blocks of a recording lie."""
    count = max(1, min(PRIORS["blocks"]["most"], int(recording.duration / PRIORS["blocks"]["shortest"])))
    return np.round(np.linspace(0, len(recording), count + 1)).astype(np.int64)


def middles(recording: Recording, edges: NDArray[np.int64]) -> Array:
    """Return the times (K,) of the middles of blocks between the samples `edges` (K + 1,) [s]."""
    return np.asarray(recording.t[0] + 0.5 * (edges[1:] + edges[:-1]) / recording.rate)


def mains_waves(total: Array, rate: float) -> Array:
    """Return waves (2 m, n) of the mains' lines, whose frequencies p_A + p_B (n,) shows, where the ring cancels."""
    spectrum = np.abs(np.fft.rfft((total - total.mean()) * np.hanning(total.size), 4 * total.size))
    frequency = np.fft.rfftfreq(4 * total.size, 1.0 / rate)
    mains, lines = PRIORS["mains"], []
    for grid in mains["lines"]:
        near = np.flatnonzero(np.abs(frequency - grid) <= mains["within"] * grid)
        lines += [frequency[near[np.argmax(spectrum[near])]]] if near.size else []
    waves = np.exp(2j * np.pi / rate * np.outer(lines, np.arange(total.size)))
    shown = np.concatenate([waves[k * np.array(lines) < 0.5 * rate] ** k for k in range(1, mains["harmonics"] + 1)])
    return np.concatenate([shown.real, shown.imag])
