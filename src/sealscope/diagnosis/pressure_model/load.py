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
#: From this share on the force is fed to the model: under a command that repeats, where it is 0.012 at most without a
#: force (32 records of the bench), and under another one.
FED, FED_BESIDE = 0.05, 0.1
#: Its part is what a Gaussian of this width [s] leaves, or of these shares of a cycle, the widest that leaves the means
#: over a cycle to under this share of the friction's deviation: what it lets pass of the strokes shakes the reversals.
#: Of 60 sound machines under forces of 6 to 28 N five had a z of 3.6 to 6.7 with the narrowest, 2.5 at most with one as
#: wide as half a cycle.
_WIDTH, _CYCLES_WIDE, _LEFT = 0.08, (0.5, 0.125), 0.02
#: Harmonics are taken to this frequency [Hz], on means over so long [s].
_HIGHEST, _MEANS = 5.0, 0.02
#: Fewest cycles.
_CYCLES = 4
#: A command repeats where its mean over a cycle deviates by under this share of its deviation: by 0.0008 at most in an
#: open loop, by 0.006 at least where a controller works against a force that swings.
_REPEATS = 0.002


def swing(values: Array, rate: float, cycle: float | None) -> float:
    """Return the deviation of the mean of values (n,) over a cycle [s] as a share of theirs; 0 without a cycle."""
    if cycle is None or values.size < _CYCLES * max(1, round(cycle * rate)):
        return 0.0
    return _over_cycles(values, rate, cycle) / max(float(np.std(values)), np.finfo(float).tiny)


def _over_cycles(values: Array, rate: float, cycle: float) -> float:
    """Return the deviation of the mean of values (n,) over a cycle [s]."""
    size = max(1, round(cycle * rate))
    sums = np.cumsum(np.insert(values, 0, 0.0))
    return float(np.std(sums[size:] - sums[:-size])) / size


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
    if cycle is None or swing(dp, rate, cycle) < (FED if swing(u, rate, cycle) < _REPEATS else FED_BESIDE):
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
    rest, coarse = slow - repeated, rate / stride
    for width in (*(share * cycle for share in _CYCLES_WIDE), _WIDTH):
        load = smoothed(rest, coarse, width)
        if _over_cycles(rest - load, coarse, cycle) < _LEFT * float(np.std(repeated)):
            break
    return np.interp(np.arange(dp.size) / rate, t, load)
