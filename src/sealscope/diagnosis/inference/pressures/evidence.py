"""What the providers of evidence from pressures and command share: beliefs, blocks, elimination, and their result."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import FEWEST, Information
from sealscope.recordings.recording import Array, Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Most blocks of a recording, and their least length [s]; a wander is stated for so long [s].
BLOCKS, SHORTEST_BLOCK, WANDER_TIME = 30, 2.0, 90.0
#: Fewest samples a second: two and a half times the highest ring of the rigs.
SLOWEST = 200.0


class Prior(NamedTuple):
    """A normal prior: its centre `value` and standard deviation `width`, both in `unit`, and the `source` of them."""

    value: float
    width: float
    unit: str
    source: str


@cache
def priors(table: str) -> Mapping[str, Prior]:
    """Return the priors of a table of `pressures.toml`, by name."""
    tree = tomllib.loads((files("sealscope.diagnosis.inference.pressures") / "pressures.toml").read_text("utf-8"))
    return {name: Prior(**row) for name, row in tree[table].items()}


@dataclass(frozen=True, eq=False)
class PressureEvidence:
    """Evidence of pressures and command on the conductance g past the piston [m^3/(s Pa)], one number a block.

    Parameters
    ----------
    information : Information
        What K blocks say of g, all nuisance parameters eliminated.
    pressure : array of float, shape (K,)
        Mean of abs(p_A - p_B) in each block [Pa], by which g is a flow.
    scale : float
        Standard deviation of the factor that all g share [1]: the ring shows flows beside M/A^2.
    laws : tuple of two floats
        Mean flow over g times `pressure`, of the law of leakage with the least and of that with the largest.
    """

    information: Information
    pressure: Array
    scale: float
    laws: tuple[float, float]

    def flow(self, step: float, deviation: float) -> tuple[float, tuple[float, float]]:
        """Return the mean flow [L/min] of a step of g [m^3/(s Pa)] with its `deviation`, and the 95 % interval.

        The interval holds those of all `laws` and the doubt in the scale; the flow is that of their middle.
        """
        unit = float(self.pressure.mean()) / LITRE_PER_MINUTE
        reach = 1.96 * math.hypot(deviation, self.scale * step)
        least, most = self.laws
        low, high = least * (step - reach) * unit, most * (step + reach) * unit
        return 0.5 * (least + most) * step * unit, (max(0.0, low), max(0.0, high))


def pressure_evidence(
    recording: Recording, edges: NDArray[np.int64], information: Information, laws: tuple[float, float]
) -> PressureEvidence:
    """Return the evidence of blocks between the samples `edges` (K + 1,), from what they say of g."""
    dp = np.abs(recording["p_A"] - recording["p_B"])
    return PressureEvidence(information, np.add.reduceat(dp, edges[:-1]) / np.diff(edges), flow_scale(), laws)


def flow_scale() -> float:
    """Return the standard deviation of the factor that all conductances share [1]: M/A^2 is not known closer."""
    known = priors("ring_down")
    return math.hypot(known["mass"].width, 2.0 * known["area"].width)


def states_flow(rig: Rig) -> bool:
    """Return whether a rig states what turns a conductance into L/min."""
    return rig.states("cylinder.A_A", "cylinder.A_B", "cylinder.M_eq")


def middles(recording: Recording, edges: NDArray[np.int64]) -> Array:
    """Return the times (K,) of the middles of blocks between the samples `edges` (K + 1,) [s]."""
    return np.asarray(recording.t[0] + 0.5 * (edges[1:] + edges[:-1]) / recording.rate)


def wander_of_conductance(seconds: float) -> float:
    """Return how far a healthy machine's conductance wanders in so many seconds [m^3/(s Pa)]."""
    return priors("response")["G_wander"].width * math.sqrt(seconds / WANDER_TIME)


def unusable(recording: Recording, rig: Rig) -> str | None:
    """Return None where a recording has command and pressures in their units, of a pump that drives two like areas.

    Else why not, in words.
    """
    if rig.valve.spool != "absent":
        return "behind a servo valve a position is needed"
    if rig.cylinder.single_rod:
        return "needs a cylinder of two like areas: on a single rod a position is needed"
    for name, unit in {"u": "V", "p_A": "Pa", "p_B": "Pa"}.items():
        if name not in recording:
            return f"needs {name}"
        if recording.units[name] != unit:
            return f"needs {name} in a unit, got counts"
    if recording.duration < FEWEST * SHORTEST_BLOCK:
        return f"needs {FEWEST * SHORTEST_BLOCK:g} s or more, got {recording.duration:.3g} s"
    if recording.rate < SLOWEST:
        return f"needs {SLOWEST:g} Hz or more, got {recording.rate:.3g} Hz: the ringing after a reversal is not seen"
    for name in ("u", "p_A", "p_B"):
        if not np.all(np.isfinite(recording[name])) or not np.ptp(recording[name]) > 0.0:
            return f"{name} is constant or has missing samples"
    return None


def block_edges(recording: Recording) -> NDArray[np.int64]:
    """Return the samples (K + 1,) between which the blocks of a recording lie."""
    count = max(1, min(BLOCKS, int(recording.duration / SHORTEST_BLOCK)))
    return np.round(np.linspace(0, len(recording), count + 1)).astype(np.int64)


def mains_lines(total: Array, rate: float) -> Array:
    """Return the frequencies (m,) [Hz] of the mains' lines, from p_A + p_B (n,), where the ring cancels."""
    if not total.size:
        return np.array([])
    spectrum = np.abs(np.fft.rfft((total - total.mean()) * np.hanning(total.size), 4 * total.size))
    frequency = np.fft.rfftfreq(4 * total.size, 1.0 / rate)
    known = priors("mains")
    lines: list[float] = []
    for mains in (known["mains_50"], known["mains_60"]):
        near = np.abs(frequency - mains.value) <= 2.0 * mains.width
        if np.any(near):
            line = float(frequency[near][int(np.argmax(spectrum[near]))])
            lines += [line * k for k in range(1, int(known["harmonics"].value) + 1)]
    return np.array([line for line in lines if line < 0.5 * rate])


def eliminated(H: Array, right: Array, kept: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return precision and vector of the `kept` unknowns, from H (p, p) and right (p,), by a Schur complement."""
    rest = np.setdiff1d(np.arange(len(H)), kept)
    inner, cross = H[np.ix_(rest, rest)], H[np.ix_(kept, rest)]
    size = 1.0 / np.sqrt(np.maximum(np.diag(inner), np.finfo(float).tiny))
    inverse = np.linalg.pinv(inner * size[:, None] * size, rcond=1e-12, hermitian=True) * size[:, None] * size
    precision = H[np.ix_(kept, kept)] - cross @ inverse @ cross.T
    return 0.5 * (precision + precision.T), right[kept] - cross @ (inverse @ right[rest])
