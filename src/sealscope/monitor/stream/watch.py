"""One running actuator, block by block: L/min with an interval, and alarms at a stated rate per operating hour."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.volume_balance.blocks import BLOCK_SECONDS
from sealscope.diagnosis.volume_balance.growth import WARMEST
from sealscope.errors import InputError
from sealscope.monitor.stream.baseline import BaselineLearning, WatchBaseline, plain_dataclass
from sealscope.monitor.stream.decisions import (
    GROUP,
    INSIDE_OR_OUTSIDE,
    SHOWN,
    WINDOW,
    ConductanceRise,
    level_rise_of,
    probability_of,
    rise_of,
)
from sealscope.monitor.stream.estimates import BlockEstimate, WatchedLeak
from sealscope.monitor.stream.estimator import PAUSE_S, BlockConductance, ConductanceEstimator, NotJudged, RecentBlocks
from sealscope.monitor.stream.joining import SampleJoiner
from sealscope.monitor.stream.pressures import PressureEstimator
from sealscope.monitor.stream.volumes import VolumeEstimator
from sealscope.recordings.recording import Array, Recording
from sealscope.storage.plain_state import array_of, part_of, plain_array, plain_fields

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Format of the saved state.
STATE_VERSION = 6
#: The duty's cycle is looked for in so long a run without a hole [s].
_LEARN_SECONDS = 60.0
#: Means of blocks are not compared across a pause of over so many seconds.
_LONGEST_PAUSE_S = 3600.0
#: Oil warms by 30 K in a shift of so many hours, at most.
_SHIFT_HOURS = 8.0
#: Blocks whose mean is the leak after an alarm.
_RECENT = 8


_ESTIMATORS: dict[str, type[VolumeEstimator] | type[PressureEstimator]] = {
    "volumes": VolumeEstimator,
    "pressures": PressureEstimator,
}


class Watch:
    """One running actuator, whose state can be saved; `watch` makes one.

    Where the position is recorded it is watched by the balance of volumes, else by the pressures and the command.

    Parameters
    ----------
    rig : Rig
        Gives the piston's area and the pump's displacement; without a position all of the machine's model.
    false_alarms_per_1000_h : float
        False alarms of a healthy machine per 1000 operating hours, at most.
    learn_hours : float
        Operating hours of healthy running that the baseline is learned from.

    Attributes
    ----------
    leak : WatchedLeak or None
        The leak that the tests show.
    baseline : WatchBaseline or None
        What the machine is compared with, None while it is learned.
    blocks : int
        Whole blocks so far.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", duration="2 min", leak="0.0042 L/min from 90 s", seed=1)
    >>> watch = ss.watch("thesis", learn_hours=0.02)
    >>> estimates = watch.update(recording.between(0, 70)) + watch.update(recording.between(70, 120))
    >>> estimates[-1].status, f"{estimates[-1].leak_lpm:.4f} L/min", round(watch.leak.onset_s)
    ('alarm', '0.0042 L/min', 90)
    >>> again = ss.Watch.from_state(watch.state())
    >>> again.leak == watch.leak
    True
    """

    def __init__(self, rig: Rig, false_alarms_per_1000_h: float, learn_hours: float) -> None:
        probability_of("step", false_alarms_per_1000_h, BLOCK_SECONDS)
        if not 0.0 < learn_hours <= 1000.0:
            raise InputError(f"learn_hours must be > 0 and at most 1000 h, got {learn_hours:g}")
        self._estimators: dict[str, ConductanceEstimator] = {by: kind.of(rig) for by, kind in _ESTIMATORS.items()}
        self.false_alarms_per_1000_h, self.learn_hours = false_alarms_per_1000_h, learn_hours
        self.baseline: WatchBaseline | None = None
        self.leak: WatchedLeak | None = None
        self.blocks = 0
        self._version = 1
        self._samples = SampleJoiner()
        self._seconds = 0.0
        self._learning = BaselineLearning()
        self._means = np.empty((0, 4))  # t, g, sd, offset of means of GROUP blocks
        self._group = np.empty((0, 4))  # the same of the blocks of the mean to come

    @property
    def by(self) -> str:
        """Way of watching, "volumes" where the position is recorded, else "pressures"."""
        return "volumes" if "x" in self._samples.names or not self._samples.names else "pressures"

    @property
    def estimator(self) -> ConductanceEstimator:
        """What turns blocks into conductances."""
        return self._estimators[self.by]

    @property
    def counters(self) -> dict[str, int]:
        """What was dropped, passed over or interrupted, by reason, in samples, blocks or events."""
        return dict(self._samples.counters)

    @property
    def block_seconds(self) -> float:
        """About how long a block is [s]."""
        return self._seconds or BLOCK_SECONDS

    def update(self, samples: Recording, *, follows: bool = True) -> list[BlockEstimate]:
        """Take the next samples; results do not depend on how they are cut.

        Parameters
        ----------
        samples : Recording
            The next samples, in SI units: ``p_A``, ``p_B``, ``x``, ``theta`` or ``omega``, and ``p_1``, ``p_2`` where
            there are any; or ``p_A``, ``p_B`` and ``u``, ``omega`` or ``theta``. What does not fit is dropped and
            counted (`counters`).
        follows : bool, default True
            False where the clock begins anew, as with a file of its own.

        Returns
        -------
        list of BlockEstimate
            Of every block that the samples complete.
        """
        return [estimate for estimate, _ in self.each(samples, follows=follows)]

    def each(self, samples: Recording, *, follows: bool = True) -> Iterator[tuple[BlockEstimate, WatchedLeak | None]]:
        """Yield what `update` returns, each estimate with the leak as of that block; to be gone through to the end."""
        if not follows:
            self._samples.restart("restart")
        for _ in self._samples.runs(samples):
            if not self._seconds and not self._find_duty():
                continue
            length = round(self._seconds * self._samples.rate)
            while len(self._samples) >= length:
                with np.errstate(all="ignore"):  # a block whose sums overflow is passed over
                    estimate = self._taken(self._samples.taken(length))
                yield estimate, self.leak

    def continue_from(self, blocks: int, baseline_version: int) -> None:
        """Count blocks and baselines on from those of a watch before, whose settings or state were of another kind."""
        self.blocks, self._version = blocks, baseline_version + 1

    @property
    def baseline_version(self) -> int:
        """Version of the baseline, or of that which is being learned."""
        return self._version

    def relearn(self) -> None:
        """Learn a new baseline from now on: the machine was repaired, or is another."""
        self._version += 1
        self.baseline, self._learning = None, BaselineLearning()
        self.estimator.relearn()
        self.dismiss()

    def dismiss(self) -> None:
        """Take the leak back and compare with nothing before now; the baseline stays."""
        self.leak = None
        self._forget(0)

    def _forget(self, keep: int) -> None:
        self.estimator.forget(keep)
        self._means, self._group = np.empty((0, 4)), np.empty((0, 4))

    def _find_duty(self) -> bool:
        """Set the length of a block from the first minute in which every value is known and the machine moves."""
        count = round(_LEARN_SECONDS * self._samples.rate)
        while len(self._samples) >= count:
            first = self._samples.first(count)
            if all(np.isfinite(first[name]).all() for name in first.channels):
                seconds = self.estimator.seconds_of(first)
                if seconds is not None:
                    self._seconds = seconds
                    self._samples.settled = True
                    self._estimators = {self.by: self.estimator}
                    return True
            self._samples.taken(count // 2)
            self._samples.count("half minutes at rest or with missing values before the first block")
        return False

    def _taken(self, block: Recording) -> BlockEstimate:
        return self.judged(self.estimator.take(block, self.to_learn), float(block.t[-1]) + 1.0 / block.rate)

    @property
    def to_learn(self) -> int:
        """Blocks of the baseline."""
        return max(FEWEST + 4, math.ceil(self.learn_hours * 3600.0 / self.block_seconds))

    def judged(self, shown: Sequence[BlockConductance] | NotJudged, end: float) -> BlockEstimate:
        """Return the estimate of a block that ends at the clock `end` [s], from what the estimator shows of it."""
        self.blocks += 1
        if isinstance(shown, NotJudged):
            if shown.apart:
                self._forget(0)
            if shown.counted:
                self._samples.count(shown.counted, shown.number)
            return BlockEstimate(self.blocks, end, shown.status)
        for block in shown:
            estimate = self._judge(block, end)
        return estimate

    def _judge(self, block: BlockConductance, end: float) -> BlockEstimate:
        if self.baseline is not None and not self.baseline.knows(block.duty):
            self._samples.count("blocks: another duty")
            return BlockEstimate(self.blocks, end, "another duty")
        estimator = self.estimator
        series = estimator.append(block)
        self._test(series, end)
        self._group_of(np.array([block.t, block.g, block.sd, block.offset]), end)
        if self.baseline is None and self.leak is None:
            self._learning.add(block.g, block.flow, block.duty, GROUP)
            if self._learning.blocks >= self.to_learn:
                hours = self._learning.blocks * self.block_seconds / 3600.0
                self.baseline = self._learning.frozen(self._version, end, hours, estimator.litres and estimator.levels)
                self._learning = BaselineLearning()
        status = "alarm" if self.leak is not None else "learning" if self.baseline is None else "watched"
        if not estimator.litres:
            return BlockEstimate(self.blocks, end, status)
        return self._estimate(status, end, series, block)

    def _test(self, series: RecentBlocks, end: float) -> None:
        """Search the last blocks for a rise; an alarm that stands is stated anew while more blocks sharpen it."""
        leak = self.leak
        again = leak is not None and leak.test == "step" and leak.onset_s > float(series.t[0])
        if leak is not None and not again:
            return
        probability = probability_of("step", self.false_alarms_per_1000_h, self.estimator.pace * self.block_seconds)
        rise, other = self.estimator.step(probability, again=again)
        if other is not None and leak is None:
            self._samples.count(f"blocks not compared: {other}"[:120])
            if other in ("changed duty", "sensor fault"):
                self._forget(3)
        if rise is not None and (leak is None or rise.score > leak.score):
            before = series.g[series.t < rise.onset_s - 0.5 * self.block_seconds][-GROUP:]
            level = float(before.mean()) if before.size else float(series.g[0])
            raised = end if leak is None else leak.raised_s
            self._raise(rise, raised, level, float(np.median(series.flow)))

    def _group_of(self, block: Array, end: float) -> None:
        """Gather blocks to means, and test these."""
        last = float(self._group[-1, 0]) if len(self._group) else float("nan")
        if not np.isnan(last) and not 0.0 < float(block[0]) - last <= PAUSE_S:
            self._group = np.empty((0, 4))
        self._group = np.concatenate([self._group, block[None]])
        if len(self._group) < GROUP:
            return
        mean = self._group.mean(axis=0)
        mean[2] = float(np.sqrt(np.sum(self._group[:, 2] ** 2))) / GROUP
        self._group = np.empty((0, 4))
        if len(self._means) and not 0.0 < float(mean[0] - self._means[-1, 0]) <= _LONGEST_PAUSE_S:
            self._means = np.empty((0, 4))
        self._means = np.concatenate([self._means, mean[None]])[-WINDOW:]
        if self.leak is not None:
            return
        t, g, sd, offset = self._means.T
        seconds = GROUP * self.block_seconds
        rise = rise_of("rise", t, g, sd, probability_of("rise", self.false_alarms_per_1000_h, seconds))
        before = g[:-1]
        if rise is not None:
            before = g[t < rise.onset_s][-4:]
        elif self.baseline is not None:
            deviation = math.hypot(float(sd[-1]), float(offset[-1]) * (1.0 if self.estimator.levels else WARMEST - 1.0))
            probability = probability_of("level", self.false_alarms_per_1000_h, seconds)
            rise = level_rise_of(float(mean[0]), float(mean[1]), deviation, self.baseline, probability)
            before = np.array([self.baseline.level])
        if rise is not None:
            level = float(before.mean()) if before.size else float(g[0])
            self._raise(rise, end, level, float(np.median(self.estimator.series().flow)))

    def _raise(self, rise: ConductanceRise, raised: float, before: float, flow: float) -> None:
        size = rise.size * flow
        half = 1.96 * math.hypot(rise.size_sd, self.estimator.size_error * rise.size) * flow
        cause = rise.cause if self.by == "volumes" else INSIDE_OR_OUTSIDE
        least, usual, most = _share_shown(cause)
        upper = most * self.estimator.orifice * (size + half)
        lpm, interval = usual * size, (least * max(0.0, size - half), upper)
        self.leak = WatchedLeak(
            raised,
            rise.onset_s,
            rise.onset_interval_s,
            lpm if self.estimator.litres else None,
            interval if self.estimator.litres else None,
            before,
            rise.size_sd,
            rise.test,
            cause,
            rise.reason,
            rise.score,
            rise.threshold,
        )

    def _estimate(self, status: str, end: float, series: RecentBlocks, block: BlockConductance) -> BlockEstimate:
        """Return the block's estimate: total flow, and flow beyond the baseline's, or since the onset of the leak."""
        t, g, _ = series
        sd, flow = block.sd, block.flow
        total, half = float(g[-1]), 1.96 * math.hypot(sd, block.offset)
        beyond: tuple[float, float, float] | None = None
        if self.leak is not None:
            recent = g[t > self.leak.onset_interval_s[1]][-_RECENT:]
            recent = recent if recent.size else g[-1:]
            now = float(recent.mean())
            warmed = WARMEST ** min(1.0, max(0.0, end - self.leak.onset_s) / (_SHIFT_HOURS * 3600.0))
            before = max(self.leak.before, 0.0)
            spread = 1.96 * math.hypot(
                sd / math.sqrt(recent.size), self.leak.before_sd, self.estimator.size_error * (now - self.leak.before)
            )
            least, usual, most = _share_shown(self.leak.cause)
            low, high = now - before * warmed - spread, now - before / warmed + spread
            beyond = usual * (now - self.leak.before), least * low, most * high
        elif self.baseline is not None:
            base = self.baseline
            beyond = total - base.level, total - base.high - 1.96 * sd, total - base.low + 1.96 * sd
        estimator = self.estimator
        total_lpm = leak_lpm = total_interval = leak_interval = None
        if estimator.levels:
            total_lpm, total_interval = total * flow, (max(0.0, total - half) * flow, max(0.0, total + half) * flow)
        if beyond is not None:
            leak_lpm, low, high = (value * flow for value in beyond)
            leak_interval = max(0.0, low), estimator.orifice * max(0.0, high)
        return BlockEstimate(self.blocks, end, status, total_lpm, total_interval, leak_lpm, leak_interval)

    def state(self) -> dict[str, Any]:
        """Return all that the watch knows as plain values that JSON holds; `from_state` continues with the same bits.

        Returns
        -------
        dict
            Mappings, lists, texts and numbers; ``"version"`` is the format's.
        """
        return {
            "version": STATE_VERSION,
            "false_alarms_per_1000_h": self.false_alarms_per_1000_h,
            "learn_hours": self.learn_hours,
            "blocks": self.blocks,
            "baseline_version": self._version,
            "seconds": self._seconds,
            "samples": self._samples.state(),
            "estimators": {by: estimator.state() for by, estimator in self._estimators.items()},
            "learning": self._learning.state(),
            "baseline": None if self.baseline is None else plain_fields(self.baseline),
            "leak": None if self.leak is None else plain_fields(self.leak),
            "means": plain_array(self._means),
            "group": plain_array(self._group),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> Watch:
        """Return the watch that `state` was of.

        Parameters
        ----------
        state : mapping
            What `state` returned, also after JSON.

        Returns
        -------
        Watch
            It continues with the same bits.

        Raises
        ------
        InputError
            Where the state is none, of another version, or damaged.
        """
        version = part_of(state, "version", int)
        if version != STATE_VERSION:
            raise InputError(f"saved state must have version {STATE_VERSION}, got {version}")
        watch = cls.__new__(cls)
        number = {name: part_of(state, name, (float, int)) for name in _NUMBERS}
        watch.false_alarms_per_1000_h, watch.learn_hours = number["false_alarms_per_1000_h"], number["learn_hours"]
        watch.blocks, watch._version = int(number["blocks"]), int(number["baseline_version"])
        watch._seconds = number["seconds"]
        watch._samples = SampleJoiner.from_state(part_of(state, "samples", Mapping))
        estimators = part_of(state, "estimators", Mapping)
        watch._estimators = {
            by: kind.from_state(part_of(estimators, by, Mapping))
            for by, kind in _ESTIMATORS.items()
            if not watch._samples.settled or by == watch.by
        }
        watch._learning = BaselineLearning.from_state(part_of(state, "learning", Mapping))
        baseline, leak = (part_of(state, name, (Mapping, type(None))) for name in ("baseline", "leak"))
        watch.baseline = None if baseline is None else plain_dataclass(WatchBaseline, baseline, "baseline")
        watch.leak = None if leak is None else plain_dataclass(WatchedLeak, leak, "leak")
        watch._means = array_of(part_of(state, "means", Mapping), "means")
        watch._group = array_of(part_of(state, "group", Mapping), "group")
        return watch


_NUMBERS = ("false_alarms_per_1000_h", "learn_hours", "blocks", "baseline_version", "seconds")


def _share_shown(cause: str) -> tuple[float, float, float]:
    """Return what leaks over what the conductance shows of it: least, usual and most."""
    return SHOWN.get(cause, (1.0, 1.0, 1.0))


@checked_call
def watch(
    rig: Rig | str | os.PathLike[str] = "thesis", *, false_alarms_per_1000_h: float = 1.0, learn_hours: float = 8.0
) -> Watch:
    """Watch a running actuator: blocks in, L/min with an interval and alarms out.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the piston's area and the pump's displacement; without a position all of the machine's model.
    false_alarms_per_1000_h : float, default 1
        False alarms of a healthy machine per 1000 operating hours, at most.
    learn_hours : float, default 8
        Operating hours of healthy running that the baseline is learned from; then it is frozen.

    Returns
    -------
    Watch
        Its `update` takes samples, its `state` can be saved.

    Raises
    ------
    InputError
        For a rig that cannot be read, or a rate of false alarms for which no threshold can be set.

    Examples
    --------
    >>> import sealscope as ss
    >>> watch = ss.watch("thesis", false_alarms_per_1000_h=2.0, learn_hours=24.0)
    >>> watch.blocks, watch.counters, watch.leak is None
    (0, {}, True)
    """
    from sealscope.parameters import load_rig

    return Watch(load_rig(rig), false_alarms_per_1000_h, learn_hours)
