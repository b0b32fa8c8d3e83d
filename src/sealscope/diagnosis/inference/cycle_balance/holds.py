"""What the pump delivers while a closed loop holds the piston at rest: all of it leaks, whatever moves the piston.

    D omega = G (p_A - p_B) + A v

at rest, where v, the creep of the piston, is 0 or known. Friction leaves a pressure difference behind, on either side;
no stroke is in the balance, so that neither the valves' changing over nor the sides' areas are. Two holds in a row make
a block, as the piston rests at either end in turn, and blocks share a hold.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, MOST_BLOCKS
from sealscope.diagnosis.inference.cycle_balance.series import ZERO, CycleFlows
from sealscope.diagnosis.inference.cycle_balance.shaft import Shaft, shows
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: The piston is held where its speed, or the shaft's, averaged over so long [s], is under this share of the largest;
#: the shortest hold [s]; what of a hold counts, as shares of the usual one: the loop settles first.
_MEANS, _STILL, _SHORTEST, _COUNTS = 0.05, 0.05, 0.5, (0.25, 0.9)
#: The pump holds the piston where it delivers over this share of what the piston takes as it creeps.
_TURNS = 0.2
#: Least pressure difference of a hold, rms, over what zeros of the transducers make.
_LEAST = 2.5


class _Hold(NamedTuple):
    """A hold: its middle [s], what the pump delivers and the piston takes [m^3/s], p_A - p_B, the lower pressure."""

    t: float
    delivered: float
    taken: float
    dp: float
    lower: float


def hold_flows(recording: Recording, rig: Rig) -> CycleFlows | str:
    """Return the balance over holds of a recording with both chamber pressures and a `shaft_shown`, or why none is."""
    shaft, rate = Shaft.of(recording, rig), recording.rate
    if shaft is None:
        return "the shaft is not shown"
    drive, dp, sense, flow = shaft.drive, shaft.dp, shaft.sense, shaft.flow(recording)
    theta = recording["theta"] if shaft.shown == "theta" else None
    x = recording["x"] if shows(recording, "x", "m") else None
    along = 1.0 if x is None else shaft.along(x)
    lower = np.minimum(recording["p_A"], recording["p_B"])
    holds = []
    for part in _held(shaft.speed if x is None else np.gradient(x) * rate, rate):
        if touched(recording, np.array([part.start, part.stop]))[0]:
            continue
        delivered = float(np.mean(flow[part])) if theta is None else drive.displacement * _slope(theta[part], rate)
        across = float(np.mean(dp[part]))
        area = rig.cylinder.A_A if sense * across > 0.0 else rig.cylinder.A_B
        crept = 0.0 if x is None else along * area * _slope(x[part], rate)
        middle = float(recording.t[part].mean())
        holds.append(_Hold(middle, sense * delivered, sense * crept, across, float(np.mean(lower[part]))))
    if len(holds) <= FEWEST:
        return f"the piston is held at rest {len(holds)} times for {_SHORTEST:g} s or more, {FEWEST + 1} are needed"
    at, given, taken, drop, least = (np.array(column) for column in zip(*holds, strict=True))
    pressure = float(np.sqrt(np.mean(drop**2)))
    if not pressure > _LEAST * ZERO:
        return f"while the piston is held p_A - p_B is {pressure:.3g} Pa, which zeros of the transducers make as well"
    if not abs(float(given @ drop)) > _TURNS * abs(float(taken @ drop)):
        return "the piston creeps at rest, and the pump stands: no controller holds it"
    # two in a row, or so many that the blocks are not too many
    group = max(2, -(-len(holds) // MOST_BLOCKS))
    first = np.arange(0, len(holds) - group + 1, 1 if len(holds) <= MOST_BLOCKS else group)

    def sums(values: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(values)])
        return np.asarray(total[first + group] - total[first])

    size = float(np.mean(np.abs(dp)))
    t, pumped = sums(at) / group, float(np.mean(np.abs(flow)))
    return CycleFlows(
        t=t,
        seconds=group * float(np.median(np.diff(at))),
        flow=sums((given - taken) * drop) / sums(drop**2) * pressure,
        dp=np.full(first.size, pressure),
        size=np.full(first.size, size),
        filled=sums(least) / group,
        pumped=pumped,
        shared=None if shaft.settled else (pumped * np.exp(-(t - recording.t[0]) / drive.lag))[:, None],
        share=1.0,
        counted=shaft.shown,
        halves=group == 2,
        by_orifice=float(np.sqrt(pressure) * np.mean(np.sqrt(np.abs(dp)))) / size,
        zero=ZERO / pressure,
        over="holds",
    )


def _held(speed: Array, rate: float) -> list[slice]:
    """Return the samples of holds of a piston, or shaft, of this speed (n,) that count.

    The loop settles throughout, so that all count from the same time on after they begin, for as long.
    """
    size = max(1, round(_MEANS * rate))
    slow = np.abs(speed[: speed.size // size * size].reshape(-1, size).mean(axis=1))
    still = slow < _STILL * slow.max()
    begins, ends = (np.flatnonzero(still[1:] & ~still[:-1]) + 1) * size, (np.flatnonzero(~still) * size)
    lasts = np.array([*ends, speed.size])[np.searchsorted(ends, begins)] - begins
    begins, lasts = (values[lasts >= _SHORTEST * rate] for values in (begins, lasts))
    if not begins.size:
        return []
    first, last = (round(share * float(np.median(lasts))) for share in _COUNTS)
    return [slice(begin + first, begin + last) for begin in begins[lasts >= last].tolist()]


def _slope(values: Array, rate: float) -> float:
    """Return the slope [1/s] of values (n,) by least squares."""
    t = (np.arange(values.size) - 0.5 * (values.size - 1)) / rate
    return float(t @ values / (t @ t))
