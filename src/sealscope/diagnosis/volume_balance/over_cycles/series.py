"""What the pump delivers over each cycle of a duty, beside the pressure that stands on one side of the piston.

Over a whole cycle of a closed position loop the piston comes back, so that the pump delivers, in the mean, what leaks:

    D mean(omega) = G mean(p_A - p_B) + A dx/T,

where x moves on from cycle to cycle (dx, known where it is recorded). That takes a load, or unlike areas, by which one
side has the higher pressure throughout: what leaks to and fro in a cycle is in no mean. The shaft's angle is counted
where it is recorded; else it is what the drive makes of its command (`control.drive`), whose speed loop misses no turn
for long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sealscope.control.drive import Drive
from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.recordings.cycle import find_cycle, fundamental
from sealscope.recordings.gaps import touched
from sealscope.recordings.motion import moves
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Length of a block, but for rounding to cycles, and how much of a recording is left out at its start [s], or a cycle:
#: a machine that starts from rest does not come back to where it was at first.
BLOCK, SETTLED = 3.0, 5.0
#: Readings are averaged about each end of a block over this share of a cycle: of the position, one instant is noise.
_AT_ENDS = 0.1
#: One side has the higher pressure throughout where p_A - p_B, averaged over so long [s], has its mean's sign for all
#: but this share of the time.
_MEANS, _ELSEWHERE = 0.02, 0.002
#: No load stands on a single rod where p_A - p_B falls under this share of its mean; it rests where it is below this
#: share of its highest speed for longer than this share of the time.
_LOADED, _SLOW, _RESTS = 0.5, 0.05, 0.1
#: A recording starts from rest where its first command is under this share of the largest.
_AT_REST = 0.02
#: Cycles over which the drive of a machine that starts in motion is taken to be settled.
_SETTLED_CYCLES = 3


@dataclass(frozen=True, eq=False)
class CycleFlows:
    """The balance over n blocks of whole cycles.

    `t` (n,) middles [s]; `seconds` of a block; `flow` (n,) [m^3/s]: mean of what the pump delivers to the side of the
    higher pressure and the piston does not take; `dp` (n,) [Pa]: mean pressure difference, > 0; `lower` (n,) [Pa]: mean
    of the other side's pressure; `pumped` [m^3/s]: mean size of the pump's flow; `fading` (n,): what the drive's state
    at the first sample, unknown, adds to the flow, in units of that state, None where nothing; `share` of the
    recording's blocks that count; `counted`: the channel that shows the shaft; `settles`: whether it is a single rod
    that rests unloaded, whose circuit may settle in another way at each rest.
    """

    t: Array
    seconds: float
    flow: Array
    dp: Array
    lower: Array
    pumped: float
    fading: Array | None
    share: float
    counted: str
    settles: bool


def shaft_shown(recording: Recording) -> str | None:
    """Return the channel that shows the shaft: theta, omega or u, whichever is recorded and moves; None without one."""
    units = {"theta": "rad", "omega": "rad/s", "u": "V"}
    return next((name for name, unit in units.items() if _shows(recording, name, unit)), None)


def _shows(recording: Recording, name: str, unit: str) -> bool:
    return name in recording and recording.units[name] == unit and moves(recording[name])


def cycle_flows(recording: Recording, rig: Rig) -> CycleFlows | str:
    """Return the balance of a recording that has both chamber pressures and a `shaft_shown`, or why there is none."""
    counted, cycle, rate = shaft_shown(recording), find_cycle(recording), recording.rate
    if counted is None or cycle is None:
        return "the duty does not repeat, so that the piston comes back at no known time"
    dp = recording["p_A"] - recording["p_B"]
    drive, settled = Drive.of(rig), 0
    if counted == "u":
        u = recording["u"]
        settled = round(_SETTLED_CYCLES * cycle * rate) if abs(u[0]) > _AT_REST * np.max(np.abs(u)) else 0
        speed = drive.omega_per_volt * u
    else:
        speed = np.gradient(recording["theta"]) * rate if counted == "theta" else recording["omega"]
    cycle = 1.0 / fundamental(speed, recording.t, cycle)
    sense = 1.0 if float(np.dot(speed - speed.mean(), dp - dp.mean())) >= 0.0 else -1.0
    side = math.copysign(1.0, float(dp.mean()))  # which pressure is the higher
    lowest = _lowest(side * dp, rate)
    if lowest <= 0.0:
        return (
            "no load stands on the piston: neither side has the higher pressure throughout, and what leaks to and fro "
            "within a cycle is in no mean"
        )
    rests = float(np.mean(np.abs(speed) < _SLOW * np.abs(speed).max())) > _RESTS
    flow = drive.flow(recording["u"], sense * dp, rate, settled) if counted == "u" else drive.displacement * speed
    volume = drive.displacement * recording["theta"] if counted == "theta" else _integral(flow, rate)
    if _shows(recording, "x", "m"):
        x, area = recording["x"], rig.cylinder.A_A if side > 0.0 else rig.cylinder.A_B
        along = 1.0 if float(np.dot(speed - speed.mean(), np.gradient(x))) >= 0.0 else -1.0
        volume = volume - along * area * x
    length, half = cycle * rate * max(1, round(BLOCK / cycle)), 0.5 * _AT_ENDS * cycle * rate
    last = len(recording) - 1 - half
    seconds = (last - max(SETTLED, cycle) * rate) / rate
    # few long cycles overlap by half
    overlap = 1 if seconds * rate >= FEWEST * length else 2
    count = int(overlap * (seconds * rate / length - 1.0) + 1e-6) + 1
    if count < FEWEST:
        return (
            f"too short for a balance over cycles: {seconds:.4g} s after the start, {(FEWEST + 1) / 2:g} cycles of "
            f"{length / rate:.3g} s are needed"
        )
    ends = last - length / overlap * np.arange(count + overlap - 1, -1, -1.0)
    first, stop = ends[:-overlap], ends[overlap:]
    used = ~np.array([touched(recording, np.array(pair, dtype=np.int64))[0] for pair in zip(first, stop, strict=True)])
    if np.count_nonzero(used) < FEWEST:
        return f"samples are missing in {count - np.count_nonzero(used)} of {count} blocks of {length / rate:.3g} s"

    def means(integral: Array) -> Array:
        """Return the mean over each block that counts of what has this integral (m,), averaged about a block's ends."""
        twice, places = _integral(integral, rate), np.arange(integral.size)
        at_ends = (np.interp(ends + half, places, twice) - np.interp(ends - half, places, twice)) / (2.0 * half / rate)
        return np.asarray((at_ends[overlap:] - at_ends[:-overlap])[used] / (length / rate))

    middles = 0.5 * (first + stop)[used] / rate
    lower = recording["p_B" if side > 0.0 else "p_A"]
    return CycleFlows(
        t=float(recording.t[0]) + middles,
        seconds=length / rate,
        flow=side * sense * means(volume),
        dp=side * means(_integral(dp, rate)),
        lower=means(_integral(lower, rate)),
        pumped=float(np.mean(np.abs(flow))),
        fading=np.exp(-middles / drive.lag) if settled and drive.lag > 0.5 * cycle else None,
        share=float(np.mean(used)),
        counted=counted,
        settles=rig.cylinder.single_rod and lowest < _LOADED and rests,
    )


def _integral(values: Array, rate: float) -> Array:
    """Return the integral of values (m,) from the first sample on, by trapezia."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))]) / rate


def _lowest(dp: Array, rate: float) -> float:
    """Return the least of a pressure difference (m,) over its mean, which is > 0, but for `_ELSEWHERE` of the time."""
    size = max(1, round(_MEANS * rate))
    slow = dp[: dp.size // size * size].reshape(-1, size).mean(axis=1)
    return float(np.quantile(slow, _ELSEWHERE)) / float(dp.mean())
