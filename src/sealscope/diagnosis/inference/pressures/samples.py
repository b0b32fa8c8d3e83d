"""Recordings for a fit of the pressure response: requirements, summary of a healthy one, blocks, and mains hum."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.estimate.change import MIN_BLOCKS
from sealscope.diagnosis.healthy import Summary
from sealscope.diagnosis.inference.comparison import RecordingSums
from sealscope.diagnosis.inference.rows import MAX_READING
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE
from sealscope.recordings.quality import is_mostly_clipped
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


@dataclass(frozen=True, eq=False, kw_only=True)
class ResponseSummary(RecordingSums, Summary):
    """Summary of a healthy recording by the response of its pressures (`PressureResponse.learn`).

    `law`: law of friction that describes the recording (`reduced_rig.LAWS`); `sums` (1, p + 1, p + 1): likelihood of
    the averages of p parameters over the recording (`fit.Joint.sums`).
    """

    method: ClassVar[str] = PRESSURE_RESPONSE

    law: str

    def check(self) -> None:
        """Check law and shape; raise ValueError if they are unknown or wrong."""
        from sealscope.diagnosis.inference.pressures.reduced_rig import LAWS, PARAMETERS

        if self.law not in LAWS:
            raise ValueError(f"law must be {' or '.join(LAWS)}, got {self.law!r}")
        size = len(PARAMETERS) + 1
        if self.sums.shape != (1, size, size):
            raise ValueError(f"sums must be of the shape (1, {size}, {size}), got {self.sums.shape}")


def find_unmet_requirement(recording: Recording, rig: Rig) -> str | None:
    """Find the first requirement of a pressure-response fit that a recording does not meet; return a text, or None.

    The fit needs the command [V] and both pressures [Pa] of a pump that drives a cylinder of two equal areas, recorded
    for long enough and at a high enough rate, without missing samples.
    """
    blocks = PRESSURE.blocks
    if not rig.circuit.pump_feeds_chambers:
        return f"a {rig.circuit.name} machine needs a position"
    if rig.cylinder.single_rod:
        return "needs a cylinder with two equal areas; a single rod needs a position"
    for name, unit in {"u": "V", "p_A": "Pa", "p_B": "Pa"}.items():
        if name not in recording:
            return f"needs {name}"
        if recording.units[name] != unit:
            return f"needs {name} in {unit}, got counts"
    if recording.duration < MIN_BLOCKS * blocks.shortest:
        return f"needs {MIN_BLOCKS * blocks.shortest:g} s or more, got {recording.duration:.3g} s"
    if recording.rate < blocks.slowest:
        slow = f"got {recording.rate:.3g} Hz, too slow for the ringing after a reversal"
        return f"needs {blocks.slowest:g} Hz or more, {slow}"
    for name in ("u", "p_A", "p_B"):
        if not np.all(np.isfinite(recording[name])) or not np.ptp(recording[name]) > 0.0:
            return f"{name} is constant or has missing samples"
        if not np.max(np.abs(recording[name])) < MAX_READING:
            return f"{name} is not plausible: it exceeds {MAX_READING:g} {recording.units[name]}"
        # a command at its limit is still known
        if name != "u" and is_mostly_clipped(recording[name], recording.units[name]):
            return f"{name} is mostly clipped at an end of its range"
    return None


def block_edges(recording: Recording) -> NDArray[np.int64]:
    """Divide a recording into K blocks of equal length; return the indices of the samples that bound them, (K + 1,)."""
    n_blocks = max(1, min(PRESSURE.blocks.most, int(recording.duration / PRESSURE.blocks.shortest)))
    return np.round(np.linspace(0, len(recording), n_blocks + 1)).astype(np.int64)


def mains_waves(total: Array, rate: float) -> Array:
    """Compute the cosine and sine waves of the mains hum and its harmonics at n samples, shape (2 m, n).

    The fundamentals are the strongest lines near 50 and near 60 Hz in the spectrum of `total` (n,), p_A + p_B. `rate`:
    sampling rate [Hz]. Only the m frequencies below half the rate are used.
    """
    n_padded = 4 * total.size  # zero-padded for a finer grid of frequencies
    spectrum = np.abs(np.fft.rfft((total - total.mean()) * np.hanning(total.size), n_padded))
    frequency = np.fft.rfftfreq(n_padded, 1.0 / rate)
    mains, fundamentals = PRESSURE.mains, list[float]()
    for nominal in mains.lines:
        bins = np.flatnonzero(np.abs(frequency - nominal) <= mains.within * nominal)
        if bins.size:
            fundamentals.append(frequency[bins[np.argmax(spectrum[bins])]])
    waves = np.exp(2j * np.pi / rate * np.outer(fundamentals, np.arange(total.size)))
    orders = range(1, mains.harmonics + 1)  # the k-th power of a wave is its k-th harmonic
    harmonics = np.concatenate([waves[k * np.array(fundamentals) < 0.5 * rate] ** k for k in orders])
    return np.concatenate([harmonics.real, harmonics.imag])
