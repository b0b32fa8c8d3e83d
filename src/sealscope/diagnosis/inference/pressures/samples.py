"""Samples for the response of the pressures: usable recordings, blocks and mains waves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.onset import MIN_BLOCKS
from sealscope.diagnosis.inference.rows.weak_form import MAX_READING
from sealscope.diagnosis.priors.pressures import PRESSURE
from sealscope.recordings.quality import is_mostly_clipped
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig


def find_unmet_requirement(recording: Recording, rig: Rig) -> str | None:
    """Return the first requirement of the response that a recording does not meet, as a text; None if it meets all.

    It needs command and pressures in their units, of a pump that drives two equal areas, long and fast enough.
    """
    blocks = PRESSURE.blocks
    if not rig.circuit.pump_feeds_chambers:
        return "behind a servo valve a position is needed"
    if rig.cylinder.single_rod:
        return "needs a cylinder of two like areas: on a single rod a position is needed"
    for name, unit in {"u": "V", "p_A": "Pa", "p_B": "Pa"}.items():
        if name not in recording:
            return f"needs {name}"
        if recording.units[name] != unit:
            return f"needs {name} in a unit, got counts"
    if recording.duration < MIN_BLOCKS * blocks.shortest:
        return f"needs {MIN_BLOCKS * blocks.shortest:g} s or more, got {recording.duration:.3g} s"
    if recording.rate < blocks.slowest:
        slow = f"got {recording.rate:.3g} Hz: the ringing after a reversal is not seen"
        return f"needs {blocks.slowest:g} Hz or more, {slow}"
    for name in ("u", "p_A", "p_B"):
        if not np.all(np.isfinite(recording[name])) or not np.ptp(recording[name]) > 0.0:
            return f"{name} is constant or has missing samples"
        if not np.max(np.abs(recording[name])) < MAX_READING:
            return f"{name} is no reading: it exceeds {MAX_READING:g} {recording.units[name]}"
        if name != "u" and is_mostly_clipped(recording[name]):
            return f"{name} is mostly cut off at an end of its range"
    return None


def block_edges(recording: Recording) -> NDArray[np.int64]:
    """Return the sample indices (K + 1,) at which the blocks of a recording begin and end."""
    n_blocks = max(1, min(PRESSURE.blocks.most, int(recording.duration / PRESSURE.blocks.shortest)))
    return np.round(np.linspace(0, len(recording), n_blocks + 1)).astype(np.int64)


def mains_waves(total: Array, rate: float) -> Array:
    """Build cosines and sines (2 m, n) of the mains hum and its harmonics.

    The fundamentals are the strongest lines near 50 and 60 Hz in the spectrum of p_A + p_B, `total` (n,). Only waves
    below half the `rate` [Hz] are built.
    """
    n_padded = 4 * total.size  # zero-padded for a finer grid of frequencies
    spectrum = np.abs(np.fft.rfft((total - total.mean()) * np.hanning(total.size), n_padded))
    frequency = np.fft.rfftfreq(n_padded, 1.0 / rate)
    mains, lines = PRESSURE.mains, []
    for nominal in mains.lines:
        bins = np.flatnonzero(np.abs(frequency - nominal) <= mains.within * nominal)
        lines += [frequency[bins[np.argmax(spectrum[bins])]]] if bins.size else []
    waves = np.exp(2j * np.pi / rate * np.outer(lines, np.arange(total.size)))
    harmonics = np.concatenate([waves[k * np.array(lines) < 0.5 * rate] ** k for k in range(1, mains.harmonics + 1)])
    return np.concatenate([harmonics.real, harmonics.imag])
