"""A force that swings, from what of the pressure difference neither repeats with the strokes nor rings.

Friction reverses with the piston and repeats with the duty; a force that swings, or comes and goes at a rate of its
own, does not. So harmonics of the duty's cycle are fitted to the pressure difference, and the slow remainder is the
force's part. The fit is weighted by a Hann window, under which neither a mean nor a rate a few lines away leaks into
the harmonics. A steady force is left alone: it makes a mean, which the fit takes out.
"""

from __future__ import annotations

import numpy as np

from sealscope.diagnosis.pressure_model.model import smoothed
from sealscope.recordings.cycle import fundamental
from sealscope.recordings.recording import Array

#: A force swings where the mean of dp over a cycle deviates by this share of the deviation of dp: without one it is
#: 0.03 at most under a duty that repeats, 0.07 under sines that beat.
SWINGS = 0.2
#: Its part is slower than a Gaussian of this width [s] leaves; harmonics are taken to this frequency [Hz], on means
#: over so long [s].
_WIDTH, _HIGHEST, _MEANS = 0.08, 5.0, 0.02
#: Fewest cycles.
_CYCLES = 4
#: A command repeats where its mean over a cycle deviates by under this share of its deviation: by 0.0008 at most in an
#: open loop, by 0.006 at least where a controller works against a force that swings.
_REPEATS = 0.002


def swing(values: Array, rate: float, cycle: float | None) -> float:
    """Return the deviation of the mean of values (n,) over a cycle [s] as a share of theirs; 0 without a cycle."""
    size = 0 if cycle is None else max(1, round(cycle * rate))
    if size == 0 or values.size < _CYCLES * size:
        return 0.0
    sums = np.cumsum(np.insert(values, 0, 0.0))
    return float(np.std(sums[size:] - sums[:-size])) / size / max(float(np.std(values)), np.finfo(float).tiny)


def moves_strokes(u: Array, dp: Array, rate: float, cycle: float | None) -> bool:
    """Return whether a force swings and no controller works against it.

    What leaks under the force moves the strokes then, and with them the friction, to and fro with the force: that is
    taken for part of it, and leaks of 0.05 L/min come out as 0.006 to 0.02.
    """
    return swing(dp, rate, cycle) >= SWINGS and swing(u, rate, cycle) < _REPEATS


def carried_by_load(u: Array, dp: Array, rate: float, cycle: float | None) -> Array | None:
    """Return the part of p_A - p_B (n,) [Pa] that carries a force that swings; None where none does.

    `u` (n,): the command, whose fundamental gives the phase of the strokes; `cycle` [s]: the duty's.
    """
    if cycle is None or swing(dp, rate, cycle) < SWINGS:
        return None
    stride = max(1, round(_MEANS * rate))
    count = dp.size // stride
    slow, command = (values[: count * stride].reshape(count, stride).mean(axis=1) for values in (dp, u))
    t = np.asarray((np.arange(count) + 0.5) * stride / rate, dtype=np.float64)
    orders = np.arange(1, max(2, int(_HIGHEST * cycle)))
    angles = 2.0 * np.pi * fundamental(command, t, cycle) * t[:, None] * orders
    columns = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    weighted = columns.T * np.hanning(count + 2)[1:-1]
    repeated = columns @ (np.linalg.pinv(weighted @ columns, hermitian=True) @ (weighted @ slow))
    load = smoothed(slow - repeated, rate / stride, _WIDTH)
    return np.interp(np.arange(dp.size) / rate, t, load)
