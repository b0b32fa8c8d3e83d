"""Cut a recording into blocks and keep of each what the balance of volumes needs: sums of squares and products.

In a block everything is taken beyond what the block alone cannot know or what may drift from block to block: an
offset and a slope of the volumes (where the integral starts, bias of the pressures), and the oil stored in the
chambers, (V/2K) dp. What is left of displaced volume A x, delivered volume q_b theta/(2 pi) and leaked volume (integral
of dp) enters the sums. Blocks do not depend on each other: a gap, a jump of an encoder or a restart spoils one block,
and a stream gives the same blocks as a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.volume_balance.rests import in_motion
from sealscope.diagnosis.volume_balance.sums import (
    ABS_DP,
    ABS_FLOW,
    FILLED,
    LIFT,
    MOTION,
    NOISE,
    ROOT_DP,
    SWINGING,
    WALK,
    beyond_pressure,
    block_means,
    carried_columns,
    volume_columns,
)
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Array, Recording

#: Columns of every block: displaced volume, angle, flow of the pump (d theta/dt), integrals of dp and of its root;
#: displaced volume counted by the pump's direction, and by the side of the higher pressure; and pressure difference at
#: the pump's ports with its integral, these two only where the pump's ports are recorded.
Y, THETA, FLOW, I_AB, I_ROOT, Y_PUMP, Y_SIDE, DP_12, I_12 = range(9)
#: Columns of the side that has the higher pressure, which carries the load: rise of p_B, integrals of x dp_A and of x
#: dp_B, rise of p_A, each while that side carries; what the pump compresses, the integral of its flow times dp while
#: it delivers there. Those of the ports are 0 where these are not recorded.
STORED_B, STORED_X_A, STORED_X_B, STORED_A, COMPRESSED = range(9, 14)
#: The time, the last column of blocks whose slopes are kept (`BalanceBlocks.with_slopes` and `whole`).
TIME = 14
#: Length a block should have [s], and the share of a short recording it may take.
BLOCK_SECONDS = 3.0
#: The size and the root of dp are taken of means over so long [s], which noise hardly moves and strokes do not notice.
SMOOTH_SECONDS = 0.016
_SHARE = 1.0 / 40.0
_SHORTEST_SECONDS = 1.0
_FEWEST_SAMPLES = 24
_FEWEST_BLOCKS = 18
#: Lengths tried where the duty has no cycle, and the share of the information of the longest that is enough.
_WITHOUT_CYCLE = (1.0, 2.0, 4.0)
_ENOUGH = 0.5
#: Neither side carries the load while dp is under this share of its usual size; that is rare up to a share of a block.
_UNLOADED, _RARE = 0.05, 0.05
#: The oil stored in a side is looked at where it varies by so many times the variance of its noise.
_MORE_THAN_NOISE = 10.0


@dataclass(frozen=True, eq=False)
class BalanceBlocks:
    """Sums over n blocks of equal length.

    `t` (n,): middles [s]; `gram` (n, c, c): sums of products of the columns beyond offset, slope and stored oil;
    `slope` (n, c): slopes of the columns [1/s] beside the stored oil; `stored` (n, c): their coefficients of dp;
    `abs_dp`, `root_dp` (n,): means of abs(dp), sqrt(abs(dp)), of dp smoothed; `abs_flow` (n,): mean size of the pump's
    flow, smoothed, by the assumed displacement [m^3/s]; `lift` (n,): the share by which noise
    lifts that root where dp is not smoothed; `motion` (n,): mean of dp times the piston's velocity; `walk` (n,):
    variance of the conductance, over its square, that the noise of dp makes in the integral; `filled` (n,): by how much
    the sum of both pressures rises from the first tenth of a block to its last; `lower` (n,): mean of the lower of both
    pressures [Pa]; `place` (n,): mean position [m]; `swinging` (n,): share of the way that
    the piston goes while dp has another sign than dp smoothed; `noise`, `noise_12` (n,):
    variance of the noise of dp, of dp_12; `steady` (n,): sum of squares of the time beyond offset and stored oil [s^2],
    by which the slopes count where they are kept (`with_slopes`), and `along` (n,): the coefficient of dp in the time
    [s/Pa]; `pressed` (n,): sum of squares of dp beyond offset and slope [Pa^2]; `samples`:
    samples of a block; `seconds`: its length.
    """

    t: Array
    gram: Array
    slope: Array
    stored: Array
    abs_dp: Array
    root_dp: Array
    abs_flow: Array
    lift: Array
    motion: Array
    walk: Array
    filled: Array
    lower: Array
    place: Array
    swinging: Array
    noise: Array
    noise_12: Array
    steady: Array
    along: Array
    pressed: Array
    samples: int
    seconds: float

    def __len__(self) -> int:
        return int(self.t.size)

    def chosen(self, which: Array | np.ndarray | slice) -> BalanceBlocks:
        """Return the blocks of an index, mask or slice."""
        arrays = {name: getattr(self, name)[which] for name in _ARRAYS}
        return BalanceBlocks(**arrays, samples=self.samples, seconds=self.seconds)

    def with_slopes(self) -> BalanceBlocks:
        """Return the blocks with sums of products of the columns beyond offset and stored oil alone, slopes kept.

        What remains beyond offset and dp is what remains beyond the slope, too, and the slope times what is left of the
        time, which becomes a column of its own (`TIME`).
        """
        slope = np.pad(self.slope, ((0, 0), (0, 1)), constant_values=1.0)
        stored = np.pad(self.stored, ((0, 0), (0, 1))) + slope * self.along[:, None]
        return self._with(slope, self.steady, stored)

    def whole(self) -> BalanceBlocks:
        """Return the blocks with sums of products of the columns beyond offset alone, slopes and stored oil kept.

        The time becomes a column of its own (`TIME`); of the difference at the pump's ports, what is beyond dp is kept.
        """
        tilt = self.along * self.pressed / self.steady
        stored = np.pad(self.stored, ((0, 0), (0, 1)))
        stored[:, DP_12] = 0.0
        slope = np.pad(self.slope, ((0, 0), (0, 1)), constant_values=1.0) + stored * tilt[:, None]
        own = (self.seconds / self.samples) ** 2 * self.samples * (self.samples**2 - 1) / 12.0
        kept = self._with(slope, np.full(len(self), own), np.zeros_like(stored))
        return replace(kept, gram=kept.gram + self.pressed[:, None, None] * stored[:, :, None] * stored[:, None, :])

    def _with(self, slope: Array, squares: Array, stored: Array) -> BalanceBlocks:
        """Return the blocks with slopes (n, c + 1) of a time that has the sum of `squares` (n,), and `stored` as given.

        A random walk of noise is told from a steady flow less well than from a swinging one: of a steady dp the
        integral is known to 1.2/samples of the variance of dp over dp^2.
        """
        gram = np.pad(self.gram, ((0, 0), (0, 1), (0, 1)))
        gram += squares[:, None, None] * slope[:, :, None] * slope[:, None, :]
        own = np.maximum(gram[:, I_AB, I_AB], np.finfo(float).tiny)
        swing = self.gram[:, I_AB, I_AB] / own
        steadily = 1.2 * self.noise / self.samples * (squares * slope[:, I_AB] / own) ** 2
        walk = self.walk * swing**2 + steadily
        return replace(self, gram=gram, slope=np.zeros_like(slope), stored=stored, walk=walk)

    @staticmethod
    def joined(parts: list[BalanceBlocks]) -> BalanceBlocks:
        """Return all blocks of the parts, in their order; the parts must have blocks of one length."""
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        return BalanceBlocks(**arrays, samples=parts[0].samples, seconds=parts[0].seconds)


_ARRAYS = tuple(field.name for field in fields(BalanceBlocks))[:-2]


def channels_needed(recording: Recording) -> str | None:
    """Return None where the recording has what the balance needs, else what is missing, in one line."""
    missing = [name for name in (*CHAMBERS, "x") if name not in recording]
    if "theta" not in recording and "omega" not in recording:
        missing.append("theta or omega")
    return f"needs {', '.join(missing)} as well (both chamber pressures and both encoders)" if missing else None


def balance_channels(recording: Recording) -> tuple[str, ...]:
    """Return the channels of the balance.

    They are `x`, `theta` (or `omega` where it is not recorded), `p_A`, `p_B`, and `p_1`, `p_2` where both are recorded
    and move.
    """
    names = ("x", "theta" if "theta" in recording else "omega", *CHAMBERS)
    ports = ("p_1", "p_2")
    moves = all(name in recording and np.nanmax(recording[name]) > np.nanmin(recording[name]) for name in ports)
    return names + ports if moves else names


def block_samples(recording: Recording, seconds: float | None = None, cycles: int = _FEWEST_BLOCKS) -> int:
    """Return the samples of a block.

    A block is whole cycles of the duty of about `seconds` (3 s, less for a short recording), where there are so many
    `cycles`; else it is as short as the information of the reversals within it allows.
    """
    rate, duration = recording.rate, recording.duration
    share = min(BLOCK_SECONDS, max(_SHORTEST_SECONDS, _SHARE * duration), max(duration, 1.0 / rate))
    wanted = share if seconds is None else seconds
    fewest = max(2, min(_FEWEST_SAMPLES, len(recording)))
    cycle = find_cycle(recording)
    if cycle is not None:
        whole = max(fewest, round(cycle * max(1, round(wanted / cycle)) * rate))
        if cycles * whole <= len(recording):
            return whole
    lengths = [max(fewest, round(wanted * factor * rate)) for factor in _WITHOUT_CYCLE]
    lengths = [length for length in lengths if _FEWEST_BLOCKS * length <= len(recording)] or lengths[:1]
    dp = recording["p_A"] - recording["p_B"]
    information = [_information(dp, length) for length in lengths]
    enough = (n for n, value in zip(lengths, information, strict=True) if value >= _ENOUGH * information[-1])
    return next(enough, lengths[-1])


def _information(dp: Array, length: int) -> float:
    """Return the sum of squares of the integral of dp beyond offset, slope and dp, over blocks of `length` samples."""
    count = dp.size // length
    rows = np.nan_to_num(dp[: count * length]).reshape(count, length)
    columns = np.stack([rows, _integral(rows, 1.0)], axis=1)
    return float(np.sum(beyond_pressure(_plain(columns[:, 1:]), _plain(columns[:, 0]), 1.0)[0] ** 2))


def _integral(rows: Array, step: float) -> Array:
    """Return the integral over each row (n, L) from its first sample, by trapezia."""
    integral = np.zeros_like(rows)
    np.cumsum(0.5 * step * (rows[:, 1:] + rows[:, :-1]), axis=1, out=integral[:, 1:])
    return integral


class _Beyond(NamedTuple):
    """What offset, slope and dp leave of columns (n, c, L), and coefficients (n, c) of slope [1/s] and dp.

    `steady` (n,): sum of squares of the time beyond offset and dp [s^2]; `along` (n,): coefficient of dp in it [s/Pa];
    `pressed` (n,): sum of squares of dp beyond offset and slope.
    """

    rest: Array
    slope: Array
    stored: Array
    steady: Array
    along: Array
    pressed: Array


def _plain(values: Array) -> Array:
    """Return values as compiled functions take them: in one piece, and not read-only."""
    return np.require(values, np.float64, ("C", "W"))


def _half(size: int, rate: float) -> int:
    """Return the samples to either side over which dp and flow of rows of `size` samples are smoothed."""
    return min(2 * round(0.5 * SMOOTH_SECONDS * rate) + 1, size - 1) // 2


def _smooth(rows: Array, samples: int) -> Array:
    """Return the means over `samples` (odd) about each sample of rows (n, L), over fewer at the ends."""
    half = min(samples, rows.shape[1] - 1) // 2
    sums = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(rows, axis=1)], axis=1)
    middles = np.arange(rows.shape[1])
    first, last = np.maximum(middles - half, 0), np.minimum(middles + half + 1, rows.shape[1])
    return np.asarray((sums[:, last] - sums[:, first]) / (last - first))


def _noise(rows: Array) -> Array:
    """Return the variance (n,) of white noise in rows of slow signals (n, L): that of the second differences over 6."""
    return np.asarray(np.mean(np.diff(rows, 2, axis=1) ** 2, axis=1) / 6.0)


@dataclass(frozen=True)
class Geometry:
    """What turns samples into volumes.

    Parameters
    ----------
    area : float
        Area of the piston, the mean of both sides [m^2].
    displacement : float
        Displacement of the pump [m^3/rad].
    unequal : bool
        Whether the areas of the two sides differ.
    area_stated, displacement_stated : bool
        Whether they are this machine's, or were merely assumed.
    asymmetry : float
        (A_A - A_B)/(A_A + A_B) of the assumed machine.
    """

    area: float
    displacement: float
    unequal: bool = False
    area_stated: bool = True
    displacement_stated: bool = True
    asymmetry: float = 0.0


def volumes(rows: Mapping[str, Array], rate: float, geometry: Geometry) -> tuple[Array, Array, Array]:
    """Return the columns (n, c, L) of samples `rows` (n, L) of the `balance_channels`, dp, and dp smoothed (n, L)."""
    step = 1.0 / rate
    by_angle = "theta" in rows
    turned = rows["theta" if by_angle else "omega"] * geometry.displacement
    dp = _plain(rows["p_A"] - rows["p_B"])
    # the mean of a root is not the root of the mean: noise would pass for a smaller root near zero
    half = _half(dp.shape[1], rate)
    common, smooth = volume_columns(_plain(rows["x"] * geometry.area), _plain(turned), by_angle, dp, step, half)
    dp_12 = rows["p_1"] - rows["p_2"] if "p_1" in rows else np.zeros_like(dp)
    x, p_A, p_B = (_plain(rows[name]) for name in ("x", *CHAMBERS))
    carried = carried_columns(x, p_A, p_B, _plain(common[:, FLOW]), smooth, step, half)
    columns = np.concatenate([common, np.stack([dp_12, _integral(dp_12, step)], axis=1), carried], axis=1)
    return _under_load(columns, dp, smooth) if geometry.unequal else (columns, dp, smooth)


def _under_load(columns: Array, dp: Array, smooth: Array) -> tuple[Array, Array, Array]:
    """Return columns (n, c, L) and dp (n, L) that stand still while neither side carries the load; and dp smoothed.

    Both sides are open to the supply then, and what the pump delivers goes round. Blocks in which that is rare are left
    as they are: near a reversal dp is small, too, and the volumes balance.
    """
    size = np.abs(smooth)
    carried = size > _UNLOADED * size.mean(axis=1, keepdims=True)
    going_round = np.mean(~carried, axis=1) > _RARE
    if not going_round.any():
        return columns, dp, smooth
    kept = (carried | ~going_round[:, None])[:, None, 1:]
    both = np.concatenate([columns, dp[:, None]], axis=1)
    steps = np.where(kept, np.diff(both, axis=2), 0.0)
    both = both[:, :, :1] + np.concatenate([np.zeros_like(both[:, :, :1]), np.cumsum(steps, axis=2)], axis=2)
    return both[:, :-1], both[:, -1], smooth


def _shown(columns: Array, beyond: _Beyond) -> _Beyond:
    """Return what offset, slope and dp leave, with 0 for the oil stored in a side where that is mostly noise.

    Where one side carries throughout, the rise of its pressure is that of dp, and nothing but noise is beyond it.
    """
    rest, slope, stored = beyond.rest.copy(), beyond.slope.copy(), beyond.stored.copy()
    for column in (STORED_B, STORED_X_A, STORED_X_B):
        hidden = np.var(rest[:, column], axis=1) <= _MORE_THAN_NOISE * _noise(columns[:, column])
        rest[hidden, column], slope[hidden, column], stored[hidden, column] = 0.0, 0.0, 0.0
    return beyond._replace(rest=rest, slope=slope, stored=stored)


def _passed_over(
    t: Array, samples: Mapping[str, Array], moving: NDArray[np.bool_], rate: float
) -> tuple[Array, Array, dict[str, Array]]:
    """Return times, times without what is passed over, and samples, of those in motion alone.

    What the pump delivers against a stop does not count, nor what makes good the leakage of a rest, which is in no
    integral: where only some rests of a record are passed over, it looked like a leak.
    """
    kept = np.flatnonzero(moving)
    steps = np.diff(t[kept], prepend=t[kept[:1]])
    steps[1:][np.diff(kept) > 1] = 1.0 / rate
    rest = {name: np.asarray(values, dtype=np.float64) for name, values in samples.items()}
    if "theta" in rest:
        turns = np.diff(rest["theta"], prepend=rest["theta"][0])
        rest["theta"] = np.cumsum(np.where(moving, turns, 0.0))
    return t[kept], np.cumsum(steps), {name: values[kept] for name, values in rest.items()}


def _over_rests(
    samples: Mapping[str, Array], moving: NDArray[np.bool_], stopped: NDArray[np.bool_], length: int, rate: float
) -> Array:
    """Return means (2, n) of abs(dp) and its root from the start of each block to that of the next, rests included."""
    dp = np.asarray(samples["p_A"] - samples["p_B"], dtype=np.float64)[None]
    size = np.where(stopped, 0.0, np.abs(_smooth(dp, 2 * round(0.5 * SMOOTH_SECONDS * rate) + 1)[0]))
    sums = np.cumsum(np.stack([size, np.sqrt(size), 1.0 - stopped]), axis=1)
    ends = np.append(np.flatnonzero(moving)[::length], size.size - 1)
    over = np.diff(sums[:, ends], axis=1)
    return np.asarray(over[:2] / np.maximum(over[2], 1.0))


def mean_pressures(samples: Mapping[str, Array], chosen: NDArray[np.bool_], rate: float) -> tuple[float, float] | None:
    """Return the means of abs(dp) [Pa] and of its root over the chosen samples (m,), end stops left out.

    None where less than a tenth of a second is chosen, or dp is not known there.
    """
    motion = in_motion(samples, rate)
    chosen = chosen if motion is None else chosen & ~motion[1]
    dp = np.asarray(samples["p_A"] - samples["p_B"], dtype=np.float64)[chosen]
    if dp.size < 0.1 * rate or not np.isfinite(dp).all():
        return None
    size = np.abs(_smooth(dp[None], 2 * round(0.5 * SMOOTH_SECONDS * rate) + 1)[0])
    return float(size.mean()), float(np.sqrt(size).mean())


def cut_blocks(t: Array, samples: Mapping[str, Array], length: int, rate: float, geometry: Geometry) -> BalanceBlocks:
    """Cut samples into whole blocks of `length` samples from the first on.

    What is left over is not used, nor is a block with a missing value or an uneven time base. `t` (m,) [s]; `samples`:
    the `balance_channels`, in any unit. Where the machine rests or is at an end stop for long, blocks are of the
    samples in motion, and shorter by what is passed over.
    """
    elapsed, everything = t, samples
    motion = in_motion(samples, rate) if t.size > length else None
    if motion is not None:
        moving, _ = motion
        length = max(_FEWEST_SAMPLES, round(length * float(np.mean(moving))))
        t, elapsed, samples = _passed_over(t, samples, moving, rate)
    count = t.size // length

    def rows(values: Array) -> Array:
        return np.asarray(values[: count * length], dtype=np.float64).reshape(count, length)

    step, times = 1.0 / rate, rows(t)
    cut = {name: rows(values) for name, values in samples.items()}
    usable = np.all(np.isfinite(sum(cut.values())), axis=1)
    spacing = np.diff(rows(elapsed), axis=1) * rate
    usable &= np.all(np.isfinite(times), axis=1) & np.all((spacing > 0.5) & (spacing < 1.5), axis=1)
    cut = {name: values[usable] for name, values in cut.items()}
    columns, dp, smooth = volumes(cut, rate, geometry)
    columns, dp = _plain(columns), _plain(dp)
    beyond = _Beyond(*beyond_pressure(columns, dp, step))
    if geometry.unequal:
        beyond = _shown(columns, beyond)
    rest = beyond.rest
    y, flow, integral = (_plain(values) for values in (columns[:, Y], columns[:, FLOW], rest[:, I_AB]))
    means = block_means(y, flow, integral, dp, _plain(smooth), cut["p_A"] + cut["p_B"], step, _half(length, rate))
    abs_dp, root_dp, abs_flow = means[ABS_DP], means[ROOT_DP], means[ABS_FLOW]
    if motion is not None:
        abs_flow = abs_flow * float(np.mean(motion[0]))
        abs_dp, root_dp = _over_rests(everything, *motion, length, rate)[:, :count][:, usable]
    return BalanceBlocks(
        t=times[usable].mean(axis=1),
        gram=rest @ rest.transpose(0, 2, 1),
        slope=beyond.slope,
        stored=beyond.stored,
        abs_dp=abs_dp,
        root_dp=root_dp,
        abs_flow=abs_flow,
        lift=means[LIFT],
        motion=means[MOTION],
        walk=means[WALK],
        swinging=means[SWINGING],
        filled=means[FILLED],
        lower=np.minimum(cut["p_A"], cut["p_B"]).mean(axis=1),
        place=cut["x"].mean(axis=1),
        noise=means[NOISE],
        noise_12=_noise(columns[:, DP_12]) if "p_1" in cut else np.zeros_like(abs_dp),
        steady=beyond.steady,
        along=beyond.along,
        pressed=beyond.pressed,
        samples=length,
        seconds=length * step,
    )
