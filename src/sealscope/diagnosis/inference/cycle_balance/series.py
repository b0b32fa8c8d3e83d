"""What the pump delivers over each cycle of a duty, beside the pressure that stands on one side of the piston.

Over a whole cycle of a closed position loop the piston comes back, so that the pump delivers, in the mean, what leaks:

    D mean(omega) = G mean(p_A - p_B) + A dx/T,

where x moves on from cycle to cycle (dx, known where it is recorded). That takes a load, or unlike areas, by which one
side has the higher pressure throughout: what leaks to and fro in a cycle is in no mean. A load that changes is as good
on a double rod, once what its changes store is taken out (`_evened`). The shaft's angle is counted
where it is recorded; else it is what the drive makes of its command (`control.drive`), whose speed loop misses no turn
for long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST, MOST_BLOCKS
from sealscope.diagnosis.inference.cycle_balance.shaft import Shaft, shows
from sealscope.physics.leakage import orifice_over_laminar
from sealscope.recordings.cycle import find_cycle, fundamental
from sealscope.recordings.gaps import touched
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Length of a block, but for rounding to cycles, and how much of a recording is left out at its start [s], or a cycle:
#: a machine that starts from rest does not come back to where it was at first.
BLOCK, _START = 3.0, 5.0
#: Readings are averaged about each end of a block over this share of a cycle: of the position, one instant is noise.
_AT_ENDS = 0.1
#: One side has the higher pressure throughout where p_A - p_B, averaged over so long [s], has its mean's sign for all
#: but this share of the time.
_MEANS, _ELSEWHERE = 0.02, 0.002
#: No load stands on a single rod where p_A - p_B falls under this share of its mean; it rests where it is below this
#: share of its highest speed for longer than this share of the time.
_LOADED, _SLOW, _RESTS = 0.5, 0.05, 0.1
#: Why nothing is said of an unloaded piston.
_UNLOADED = (
    "no load stands on the piston: neither side has the higher pressure throughout, and what leaks to and fro within a "
    "cycle is in no mean"
)
_SETTLES = "no load stands on a single rod that rests: its circuit may settle in another way at each rest"
#: A load that changes moves the mean of p_A - p_B over a cycle by this share of its size (rms over mean) or more:
#: without a load it is 0.37 at most, where friction holds the piston at rest, 0.59 at least under the loads developed
#: on. Knots of the drift of G beside which its changes are fitted; the most by which flows may scatter about that, as
#: a share.
_STANDS, KNOTS, COMES_BACK = 0.45, 6, 0.01
#: Zero of a pressure difference as makers state it [Pa]: 0.1 % of 20 MPa.
ZERO = 2e4
#: Cycles over which the drive of a machine that starts in motion is taken to be settled.
_SETTLED_CYCLES = 3


@dataclass(frozen=True, eq=False)
class CycleFlows:
    """The balance over n blocks of whole cycles.

    `t` (n,) middles [s]; `seconds` of a block; `flow` (n,) [m^3/s]: mean of what the pump delivers to a side, to that
    of the higher pressure where it does not change, and the piston does not take; `dp` (n,) [Pa]: mean pressure
    difference in that sense; `size` (n,) [Pa]: mean of abs(p_A - p_B); `filled` (n,) [Pa]: mean of the other side's
    pressure, of both where the load changes, which falls where oil leaves; `pumped` [m^3/s]: mean size of the pump's
    flow; `shared` (n, m) [m^3/s]: errors of `flow` that all blocks share, as columns, None where there are none;
    `share` of the recording's blocks that count; `counted`: the channel that shows the shaft; `halves`: whether blocks
    overlap by half; `by_orifice`: where the load changes, the mean flow of an orifice over that of a worn seal which
    shows alike, else None; `zero`: what zeros of the transducers are of the pressure difference, where they count;
    `over`: the time that counts, cycles, `holds` or `stretches`.
    """

    t: Array
    seconds: float
    flow: Array
    dp: Array
    size: Array
    filled: Array
    pumped: float
    shared: Array | None
    share: float
    counted: str
    halves: bool
    by_orifice: float | None = None
    zero: float = 0.0
    over: Literal["cycles", "holds", "stretches"] = "cycles"

    @property
    def level(self) -> float:
        """The conductance of the last third [m^3/(s Pa)]: by then, whatever the drive's state was at the start."""
        flow, dp = self.flow[-self.t.size // 3 :], self.dp[-self.t.size // 3 :]
        return float(np.dot(flow, dp) / np.dot(dp, dp))


def cycle_flows(recording: Recording, rig: Rig) -> CycleFlows | str:
    """Return the balance of a recording that has both chamber pressures and a `shaft_shown`, or why there is none."""
    shaft, cycle, rate = Shaft.of(recording, rig), find_cycle(recording), recording.rate
    if shaft is None:
        return "the shaft is not shown"
    dp, speed, drive = shaft.dp, shaft.speed, shaft.drive
    side = math.copysign(1.0, float(dp.mean()))  # which pressure is the higher
    lowest = _lowest(side * dp, rate)
    if changes := lowest <= 0.0 and not rig.cylinder.single_rod:
        side, cycle = 1.0, _strokes(speed, rate)
    elif lowest <= 0.0:
        return _UNLOADED
    if cycle is None:
        return "the duty does not repeat, so that the piston comes back at no known time"
    settled = 0 if shaft.settled else round(_SETTLED_CYCLES * cycle * rate)
    cycle = 1.0 / fundamental(speed, recording.t, cycle)
    rests = float(np.mean(np.abs(speed) < _SLOW * np.abs(speed).max())) > _RESTS
    if rig.cylinder.single_rod and lowest < _LOADED and rests:
        return _SETTLES
    flow = shaft.flow(recording, settled)
    volume = drive.displacement * recording["theta"] if shaft.shown == "theta" else integral(flow, rate)
    if shows(recording, "x", "m"):
        area = rig.cylinder.A_A if side > 0.0 else rig.cylinder.A_B
        volume = volume - shaft.along(recording["x"]) * area * recording["x"]
    # blocks that overlap by half follow a drift more closely; not where each differs by what changes of the load store
    blocks = _Blocks.of(recording, cycle, overlap=not changes)
    if isinstance(blocks, str):
        return blocks
    other = recording["p_B" if side > 0.0 else "p_A"]
    flows = CycleFlows(
        t=float(recording.t[0]) + blocks.middles,
        seconds=blocks.length / rate,
        flow=side * shaft.sense * blocks.means(volume),
        dp=side * blocks.means(integral(dp, rate)),
        size=blocks.means(integral(np.abs(dp), rate)),
        filled=blocks.means(integral(other if not changes else 0.5 * (recording["p_A"] + recording["p_B"]), rate)),
        pumped=float(np.mean(np.abs(flow))),
        shared=None,
        share=float(np.mean(blocks.used)),
        counted=shaft.shown,
        halves=blocks.halves,
    )
    if settled and drive.lag > 0.5 * cycle:
        flows = replace(flows, shared=(flows.pumped * np.exp(-blocks.middles / drive.lag))[:, None])
    return _evened(flows, dp, blocks.means(dp), rate) if changes else flows


class _Blocks(NamedTuple):
    """Blocks of whole cycles of a recording.

    `ends` (n + overlap,): samples at which they begin and end, `overlap` apart for a block; `half`: samples about an
    end over which readings are averaged; `length` of a block in samples; `used` (n,): which of them count; `halves`:
    whether a recording that is longer has blocks that overlap by half.
    """

    ends: Array
    overlap: int
    half: float
    length: float
    used: NDArray[np.bool_]
    halves: bool
    rate: float

    @classmethod
    def of(cls, recording: Recording, cycle: float, overlap: bool) -> Self | str:
        """Return the blocks of a recording whose cycle takes `cycle` s, or why there are too few."""
        rate = recording.rate
        length, half = cycle * rate * max(1, round(BLOCK / cycle)), 0.5 * _AT_ENDS * cycle * rate
        last = len(recording) - 1 - half
        seconds = (last - max(_START, cycle) * rate) / rate
        halves = overlap and 2.0 * seconds * rate < MOST_BLOCKS * length
        shift = 2 if halves or seconds * rate < FEWEST * length else 1
        count = int(shift * (seconds * rate / length - 1.0) + 1e-6) + 1
        if count < FEWEST:
            return (
                f"too short for a balance over cycles: {seconds:.4g} s after the start, {(FEWEST + 1) / 2:g} cycles of "
                f"{length / rate:.3g} s are needed"
            )
        ends = last - length / shift * np.arange(count + shift - 1, -1, -1.0)
        pairs = np.stack([ends[:-shift], ends[shift:]], axis=1).astype(np.int64)
        used = ~np.array([touched(recording, pair)[0] for pair in pairs], dtype=bool)
        if np.count_nonzero(used) < FEWEST:
            return f"samples are missing in {count - np.count_nonzero(used)} of {count} blocks of {length / rate:.3g} s"
        return cls(ends, shift, half, length, used, halves, rate)

    @property
    def middles(self) -> Array:
        """Return the middles of the blocks that count [s], from the recording's start on."""
        return np.asarray(0.5 * (self.ends[: -self.overlap] + self.ends[self.overlap :])[self.used] / self.rate)

    def means(self, whole: Array) -> Array:
        """Return the mean over each block that counts of what has this integral (m,), averaged about a block's ends."""
        twice, places, half = integral(whole, self.rate), np.arange(whole.size), self.half
        above, below = (np.interp(self.ends + shift, places, twice) for shift in (half, -half))
        at_ends = (above - below) / (2.0 * half / self.rate)
        return np.asarray((at_ends[self.overlap :] - at_ends[: -self.overlap])[self.used] / (self.length / self.rate))


def _evened(flows: CycleFlows, dp: Array, moved: Array, rate: float) -> CycleFlows | str:
    """Return the flows under a load that changes without what its changes store, and without the drive's zero.

    `dp` (m,): the samples of p_A - p_B; `moved` (n,) [Pa/s]: by how much it changes from a block's start to its end.
    What the oil and the controller give way is C `moved`. C and the zero are fitted beside a conductance that drifts,
    by least squares; what is not known of them is an error that all blocks share.
    """
    if float(np.sqrt(np.mean(flows.dp**2))) < _STANDS * float(np.mean(flows.size)):
        return _UNLOADED
    at = np.linspace(flows.t[0], flows.t[-1], KNOTS)
    drifting = np.stack([np.interp(flows.t, at, row) for row in np.eye(KNOTS)], axis=1) * flows.dp[:, None]
    fixed = np.stack([np.ones(flows.t.size), moved], axis=1)
    columns = np.concatenate([fixed, drifting] if flows.shared is None else [fixed, drifting, flows.shared], axis=1)
    columns_size = np.sqrt(np.mean(columns**2, axis=0)) + np.finfo(float).tiny
    scaled = columns / columns_size
    fitted, *_ = np.linalg.lstsq(scaled, flows.flow, rcond=None)
    left = flows.flow - scaled @ fitted
    deviation = float(np.sqrt(left @ left / max(1, left.size - columns.shape[1])))
    if not deviation < COMES_BACK * flows.pumped:
        return f"the piston does not come back after each stroke: flows scatter by {deviation / flows.pumped:.1%}"
    own = deviation * np.sqrt(np.diag(np.linalg.pinv(scaled.T @ scaled)))[:2]
    errors = scaled[:, :2] * own
    size = np.abs(dp[: dp.size // 8 * 8].reshape(-1, 8).mean(axis=1))
    return replace(
        flows,
        flow=flows.flow - scaled[:, :2] @ fitted[:2],
        shared=errors if flows.shared is None else np.concatenate([flows.shared, errors], axis=1),
        by_orifice=orifice_over_laminar(size),
    )


def _strokes(speed: Array, rate: float) -> float | None:
    """Return the period [s] of the strongest line in the shaft's speed (m,), None where it is no line.

    The cycle of strokes and load together is longer than a stroke, or without end.
    """
    spectrum = np.abs(np.fft.rfft((speed - speed.mean()) * np.hanning(speed.size))) ** 2
    best = int(np.argmax(spectrum))
    if best < FEWEST // 2 or best + 1 >= spectrum.size:
        return None
    a, b, c = np.log(spectrum[best - 1 : best + 2] + np.finfo(float).tiny)
    return float(speed.size / rate / (best + 0.5 * (a - c) / (a - 2.0 * b + c)))


def integral(values: Array, rate: float) -> Array:
    """Return the integral of values (m,) from the first sample on, by trapezia."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))]) / rate


def _lowest(dp: Array, rate: float) -> float:
    """Return the least of a pressure difference (m,) over its mean, which is > 0, but for `_ELSEWHERE` of the time."""
    size = max(1, round(_MEANS * rate))
    slow = dp[: dp.size // size * size].reshape(-1, size).mean(axis=1)
    return float(np.quantile(slow, _ELSEWHERE)) / float(dp.mean())
