"""Whether a step resolves a run: a window of it integrated again at half the step, and what moved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Default for the rms error [Pa] that a pressure may have (a transducer's noise is 8600 Pa), and for the share by which
#: a detail's RMS in a recording (truth and noise together) may be off.
PRESSURE_TOLERANCE = 100.0
DETAIL_TOLERANCE = 1e-3
#: What is found in windows, times this, stands for the whole run; a difference to half the step is at least 14/15 of
#: the error of a method of order four.
SAFETY = 1.2
#: Lengths [s] of the first window and of the later ones, and where these begin as shares of the run.
FIRST_WINDOW, LATER_WINDOW = 2.0, 1.0
LATER = (0.5, 0.9)
LEVELS = 4


def windows(n_out: int, rate: float) -> list[tuple[int, int]]:
    """Output indices (start, stop) of the windows in which a run of `n_out` outputs at `rate` [Hz] is checked."""
    first = min(n_out, round(FIRST_WINDOW * rate))
    found = [(0, first)]
    length = round(LATER_WINDOW * rate)
    for share in LATER:
        start = round(share * n_out)
        if length and start >= found[-1][1] and start + length <= n_out:
            found.append((start, start + length))
    return found


class Judge:
    """Compares windows of a run at one step with those at half of it; `found` [Pa rms]: how far pressures moved."""

    def __init__(self, rig: Rig, rate: float, tolerance: float) -> None:
        """`rate` [Hz] of the outputs; `tolerance` [Pa] of a pressure."""
        self._tolerance = tolerance
        self._every = max(1, round(rate / rig.daq.sample_rate))
        sensors = [getattr(rig.sensors, name) for name in CHAMBERS]
        self._noise = np.repeat([one.noise**2 + rig.sensors.common_noise**2 for one in sensors], 2)
        self._squares, self._samples = np.zeros((LEVELS, 4)), 0
        self.found = 0.0

    def beyond(self, coarse: Array, fine: Array) -> float:
        """How many times further than it may anything has moved, with one window more.

        `coarse`, `fine`: (n, 4) p_A, p_B, p_1, p_2 [Pa]. Each window's pressures are judged by themselves, the RMS of
        db8's d_1 .. d_4 in both chambers over all windows so far, at the recording's rate and with its noise.
        """
        pressure = SAFETY * float(np.sqrt(np.mean(np.square(coarse - fine), axis=0)).max(initial=0.0))
        self.found = max(self.found, pressure)
        if not pressure <= self._tolerance:
            return pressure / self._tolerance
        self._add(coarse, fine)
        if self._samples == 0:
            return pressure / self._tolerance
        recorded = np.sqrt(self._squares / self._samples + self._noise)
        a, b = recorded[:, ::2], recorded[:, 1::2]
        change = float(np.max(np.abs(a - b) / np.where(b > 0, b, 1.0)))
        return max(pressure / self._tolerance, change / DETAIL_TOLERANCE)

    def _add(self, coarse: Array, fine: Array) -> None:
        """Sum the squares of a window's details where they see nothing but the window."""
        import pywt

        from sealscope.signals.filters import reach

        before, after = reach("db8", LEVELS)[-1]
        runs = np.array([run[:: self._every, column] for column in range(2) for run in (coarse, fine)])
        n = runs.shape[1] // 2**LEVELS * 2**LEVELS
        if n <= before + after:
            return
        _, *details = pywt.swt(runs[:, :n], "db8", level=LEVELS, trim_approx=True, norm=False, axis=-1)
        inside = np.array(details)[..., before : n - after]
        self._squares += np.sum(np.square(inside), axis=-1)
        self._samples += inside.shape[-1]
