"""One running actuator, block by block: L/min with an interval, and alarms at a stated rate per operating hour."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.calls import checked_call
from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.volume_balance.blocks import (
    BLOCK_SECONDS,
    BalanceBlocks,
    Geometry,
    balance_channels,
    block_samples,
    cut_blocks,
)
from sealscope.diagnosis.volume_balance.evidence import trouble
from sealscope.diagnosis.volume_balance.fit import fit_balance
from sealscope.diagnosis.volume_balance.growth import WARMEST
from sealscope.errors import InputError
from sealscope.monitor.stream.baseline import BaselineLearning, WatchBaseline, plain_dataclass
from sealscope.monitor.stream.decisions import (
    GROUP,
    WINDOW,
    ConductanceRise,
    level_rise_of,
    probability_of,
    slow_rise_of,
    step_of,
)
from sealscope.monitor.stream.geometry import LEVEL, FrozenBalance, duty_of, in_motion
from sealscope.monitor.stream.joining import SampleJoiner
from sealscope.monitor.stream.plain_state import array_of, part_of, plain_array
from sealscope.recordings.recording import Array, Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Format of the saved state.
STATE_VERSION = 3
#: The duty's cycle is looked for in so long a run without a hole [s].
_LEARN_SECONDS = 60.0
#: Blocks that the frozen balance is fitted to, at most.
_FIT_BLOCKS = 60
#: Blocks, and means of blocks, are not compared across a pause of over so many seconds.
_PAUSES = (300.0, 3600.0)
#: Oil warms by 30 K in a shift of so many hours, at most.
_SHIFT_HOURS = 8.0
#: Blocks whose mean is the leak after an alarm.
_RECENT = 8


@dataclass(frozen=True)
class BlockEstimate:
    """What one block shows.

    Parameters
    ----------
    number : int
        Blocks so far, this one included.
    t : float
        End of the block [s].
    status : str
        "learning", "watched", "alarm", or why the block is not judged: "at rest", "missing values", "another duty", ...
    total_lpm, total_interval_lpm : float and pair of floats, optional
        Flow past pump and piston together, and its 95 % interval [L/min]; None where it is not known.
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Flow beyond that of the healthy machine, and its interval [L/min], in which the oil may have warmed.
    """

    number: int
    t: float
    status: str
    total_lpm: float | None = None
    total_interval_lpm: tuple[float, float] | None = None
    leak_lpm: float | None = None
    leak_interval_lpm: tuple[float, float] | None = None


@dataclass(frozen=True)
class WatchedLeak:
    """A leak that the tests show, until `dismiss` or `relearn` is called.

    Parameters
    ----------
    raised_s : float
        Clock when it was first shown [s].
    onset_s, onset_interval_s : float and pair of floats
        Since when it leaks, and its 95 % interval [s].
    leak_lpm, leak_interval_lpm : float and pair of floats, optional
        Size when it was shown, and its 95 % interval [L/min].
    before : float
        Conductance before the onset [m^3/(s Pa)].
    before_sd : float
        Its deviation [m^3/(s Pa)].
    test, cause, reason : str
        Which test shows it, where the oil goes, and why, in one line.
    score, threshold : float
        The test's statistic and threshold.
    """

    raised_s: float
    onset_s: float
    onset_interval_s: tuple[float, float]
    leak_lpm: float | None
    leak_interval_lpm: tuple[float, float] | None
    before: float
    before_sd: float
    test: str
    cause: str
    reason: str
    score: float
    threshold: float


class Watch:
    """The volume balance of one running actuator, whose state can be saved; `watch` makes one.

    Parameters
    ----------
    rig : Rig
        Gives the piston's area and the pump's displacement.
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
        areas = rig.cylinder.A_A, rig.cylinder.A_B
        self._geometry = Geometry(0.5 * sum(areas), rig.pump.q_b / (2.0 * np.pi), areas[0] != areas[1])
        self.false_alarms_per_1000_h, self.learn_hours = false_alarms_per_1000_h, learn_hours
        self.baseline: WatchBaseline | None = None
        self.leak: WatchedLeak | None = None
        self.blocks = 0
        self._version = 1
        self._samples = SampleJoiner()
        self._seconds = 0.0
        self._used: tuple[str, ...] = ()
        self._balance: FrozenBalance | None = None
        self._learning = BaselineLearning()
        self._window: BalanceBlocks | None = None
        self._means = np.empty((0, 4))  # t, g, sd, offset of means of GROUP blocks
        self._group = np.empty((0, 4))  # the same of the blocks of the mean to come

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
            there are any. What does not fit is dropped and counted (`counters`).
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
                    estimate = self._take(self._samples.taken(length))
                yield estimate, self.leak

    def continue_from(self, before: Watch) -> None:
        """Count blocks and baselines on from those of another watch, whose settings were others."""
        self.blocks, self._version = before.blocks, before._version + 1

    def relearn(self) -> None:
        """Learn a new baseline from now on: the machine was repaired, or is another."""
        self._version += 1
        self.baseline, self._balance, self._learning = None, None, BaselineLearning()
        self.dismiss()

    def dismiss(self) -> None:
        """Take the leak back and compare with nothing before now; the baseline stays."""
        self.leak, self._window = None, None
        self._means, self._group = np.empty((0, 4)), np.empty((0, 4))

    def _find_duty(self) -> bool:
        """Set the length of a block from the first minute in which every value is known and the piston moves."""
        count = round(_LEARN_SECONDS * self._samples.rate)
        while len(self._samples) >= count:
            first = self._samples.first(count)
            values = np.stack([first[name] for name in first.channels])
            if np.isfinite(values).all() and np.ptp(first["x"]) > 0.0:
                self._seconds = block_samples(first, BLOCK_SECONDS) / self._samples.rate
                self._used = balance_channels(first)
                return True
            self._samples.taken(count // 2)
            self._samples.count("half minutes at rest or with missing values before the first block")
        return False

    def _take(self, block: Recording) -> BlockEstimate:
        samples = {name: block[name] for name in self._used}
        cut = cut_blocks(block.t, samples, len(block), block.rate, self._geometry)
        return self.judged(cut, float(block.t[-1]) + 1.0 / block.rate)

    def judged(self, cut: BalanceBlocks, end: float) -> BlockEstimate:
        """Return the estimate of a block that is cut already, none or one, which ends at the clock `end` [s]."""
        self.blocks += 1
        if len(cut) == 0 or not np.all(np.isfinite(cut.gram)):
            return self._passed_over(end, "missing values")
        if not in_motion(cut).all():
            return self._passed_over(end, "at rest")
        if self._balance is None:
            return self._learn_balance(cut, end)
        return self._judge(cut, end)

    def _passed_over(self, end: float, status: str) -> BlockEstimate:
        self._samples.count(f"blocks: {status}")
        return BlockEstimate(self.blocks, end, status)

    def _append(self, cut: BalanceBlocks) -> BalanceBlocks:
        """Return the last blocks, this one included."""
        before = self._window
        if before is not None and float(cut.t[0] - before.t[-1]) > _PAUSES[0]:
            before = None
        if before is not None and not float(cut.t[0] - before.t[-1]) > 0.0:
            before = None  # the clock was set back
        if before is not None and (before.samples, before.gram.shape[1]) != (cut.samples, cut.gram.shape[1]):
            before = None
        window = cut if before is None else BalanceBlocks.joined([before, cut])
        self._window = window.chosen(np.arange(max(0, len(window) - WINDOW), len(window)))
        return self._window

    def _learn_balance(self, cut: BalanceBlocks, end: float) -> BlockEstimate:
        """Take a block until there are enough to fit the shared coefficients."""
        window = self._append(cut)
        if len(window) < min(_FIT_BLOCKS, max(FEWEST, self._to_learn)):
            return BlockEstimate(self.blocks, end, "learning")
        fit = fit_balance(window, metres=True, geometry=self._geometry)
        problem = trouble(fit)
        if problem is not None:
            self._samples.count("blocks: no balance can be fitted", len(window) // 2)
            self._window = window.chosen(np.arange(len(window) // 2, len(window)))
            return BlockEstimate(self.blocks, end, problem)
        self._balance, self._window = FrozenBalance.of(fit), None
        for k in range(len(window)):
            estimate = self._judge(window.chosen(np.array([k])), end)
        return estimate

    @property
    def _to_learn(self) -> int:
        """Blocks of the baseline."""
        return max(FEWEST + 4, math.ceil(self.learn_hours * 3600.0 / self._seconds))

    def _judge(self, cut: BalanceBlocks, end: float) -> BlockEstimate:
        balance = self._balance
        assert balance is not None
        problem = balance.unusable(cut)
        if problem is not None:
            return self._passed_over(end, problem)
        duty = duty_of(cut)[0]
        if self.baseline is not None and not self.baseline.knows(duty):
            return self._passed_over(end, "another duty")
        window = self._append(cut)
        g, sd = balance.conductances(window)
        flow = float(balance.flow(cut)[0])
        offset = float(balance.offset(cut)[0])
        self._test(window, g, end)
        self._group_of(np.array([float(cut.t[0]), float(g[-1]), float(sd[-1]), offset]), end)
        if self.baseline is None and self.leak is None:
            self._learning.add(float(g[-1]), flow, duty, GROUP)
            if self._learning.blocks >= self._to_learn:
                hours = self._learning.blocks * self._seconds / 3600.0
                self.baseline = self._learning.frozen(self._version, end, hours, balance.litres)
                self._learning = BaselineLearning()
        status = "alarm" if self.leak is not None else "learning" if self.baseline is None else "watched"
        if not balance.litres:
            return BlockEstimate(self.blocks, end, status)
        return self._estimate(status, end, window.t, g, float(sd[-1]), flow, offset)

    def _test(self, window: BalanceBlocks, g: Array, end: float) -> None:
        """Search the last blocks for a rise; an alarm that stands is stated anew while more blocks sharpen it."""
        leak, balance = self.leak, self._balance
        assert balance is not None
        again = leak is not None and leak.test == "step" and leak.onset_s > float(window.t[0])
        if leak is not None and not again:
            return
        probability = probability_of("step", self.false_alarms_per_1000_h, self._seconds)
        rise, other = step_of(window, g, probability, self._geometry, again=again)
        if other is not None and leak is None:
            self._samples.count(f"blocks not compared: {other}"[:120])
            if other in ("changed duty", "sensor fault"):
                self._window = window.chosen(np.arange(max(0, len(window) - 3), len(window)))
                self._means, self._group = np.empty((0, 4)), np.empty((0, 4))
        if rise is not None and (leak is None or rise.score > leak.score):
            before = g[window.t < rise.onset_s - 0.5 * window.seconds][-GROUP:]
            level = float(before.mean()) if before.size else float(g[0])
            raised = end if leak is None else leak.raised_s
            self._raise(rise, raised, level, float(np.median(balance.flow(window))))

    def _group_of(self, block: Array, end: float) -> None:
        """Gather blocks to means, and test these."""
        last = float(self._group[-1, 0]) if len(self._group) else float("nan")
        if not np.isnan(last) and not 0.0 < float(block[0]) - last <= _PAUSES[0]:
            self._group = np.empty((0, 4))
        self._group = np.concatenate([self._group, block[None]])
        if len(self._group) < GROUP:
            return
        mean = self._group.mean(axis=0)
        mean[2] = float(np.sqrt(np.sum(self._group[:, 2] ** 2))) / GROUP
        self._group = np.empty((0, 4))
        if len(self._means) and not 0.0 < float(mean[0] - self._means[-1, 0]) <= _PAUSES[1]:
            self._means = np.empty((0, 4))
        self._means = np.concatenate([self._means, mean[None]])[-WINDOW:]
        if self.leak is not None or self._balance is None:
            return
        t, g, sd, offset = self._means.T
        seconds = GROUP * self._seconds
        rise = slow_rise_of(t, g, sd, probability_of("rise", self.false_alarms_per_1000_h, seconds))
        before = g[:-1]
        if rise is not None:
            before = g[t < rise.onset_s][-4:]
        elif self.baseline is not None:
            deviation = math.hypot(float(sd[-1]), float(offset[-1]))
            probability = probability_of("level", self.false_alarms_per_1000_h, seconds)
            rise = level_rise_of(float(mean[0]), float(mean[1]), deviation, self.baseline, probability)
            before = np.array([self.baseline.level])
        if rise is not None and self._window is not None:
            level = float(before.mean()) if before.size else float(g[0])
            self._raise(rise, end, level, float(np.median(self._balance.flow(self._window))))

    def _raise(self, rise: ConductanceRise, raised: float, before: float, flow: float) -> None:
        balance = self._balance
        assert balance is not None
        size = rise.size * flow
        half = 1.96 * math.hypot(rise.size_sd, LEVEL * rise.size) * flow
        lpm, interval = (size, (max(0.0, size - half), size + half)) if balance.litres else (None, None)
        self.leak = WatchedLeak(
            raised,
            rise.onset_s,
            rise.onset_interval_s,
            lpm,
            interval,
            before,
            rise.size_sd,
            rise.test,
            rise.cause,
            rise.reason,
            rise.score,
            rise.threshold,
        )

    def _estimate(
        self, status: str, end: float, t: Array, g: Array, sd: float, flow: float, offset: float
    ) -> BlockEstimate:
        """Return the block's estimate: total flow, and flow beyond the baseline's, or since the onset of the leak."""
        total, half = float(g[-1]), 1.96 * math.hypot(sd, offset)
        beyond: tuple[float, float, float] | None = None
        if self.leak is not None:
            recent = g[t > self.leak.onset_interval_s[1]][-_RECENT:]
            recent = recent if recent.size else g[-1:]
            now = float(recent.mean())
            warmed = WARMEST ** min(1.0, max(0.0, end - self.leak.onset_s) / (_SHIFT_HOURS * 3600.0))
            before = max(self.leak.before, 0.0)
            spread = 1.96 * math.hypot(
                sd / math.sqrt(recent.size), self.leak.before_sd, LEVEL * (now - self.leak.before)
            )
            beyond = now - self.leak.before, now - before * warmed - spread, now - before / warmed + spread
        elif self.baseline is not None:
            base = self.baseline
            beyond = total - base.level, total - base.high - 1.96 * sd, total - base.low + 1.96 * sd
        return BlockEstimate(
            self.blocks,
            end,
            status,
            total * flow,
            (max(0.0, total - half) * flow, max(0.0, total + half) * flow),
            None if beyond is None else beyond[0] * flow,
            None if beyond is None else (max(0.0, beyond[1]) * flow, max(0.0, beyond[2]) * flow),
        )

    def state(self) -> dict[str, Any]:
        """Return all that the watch knows as plain values that JSON holds; `from_state` continues with the same bits.

        Returns
        -------
        dict
            Mappings, lists, texts and numbers; ``"version"`` is the format's.
        """
        window = self._window
        return {
            "version": STATE_VERSION,
            "area": self._geometry.area,
            "displacement": self._geometry.displacement,
            "unequal": self._geometry.unequal,
            "false_alarms_per_1000_h": self.false_alarms_per_1000_h,
            "learn_hours": self.learn_hours,
            "blocks": self.blocks,
            "baseline_version": self._version,
            "seconds": self._seconds,
            "used": list(self._used),
            "samples": self._samples.state(),
            "balance": None if self._balance is None else self._balance.state(),
            "learning": self._learning.state(),
            "baseline": None if self.baseline is None else asdict(self.baseline),
            "leak": None if self.leak is None else asdict(self.leak),
            "means": plain_array(self._means),
            "group": plain_array(self._group),
            "window": None
            if window is None
            else {
                name: plain_array(value) if isinstance(value, np.ndarray) else value
                for name, value in ((field.name, getattr(window, field.name)) for field in fields(window))
            },
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
        watch._geometry = Geometry(number["area"], number["displacement"], bool(part_of(state, "unequal", bool)))
        watch.false_alarms_per_1000_h, watch.learn_hours = number["false_alarms_per_1000_h"], number["learn_hours"]
        watch.blocks, watch._version = int(number["blocks"]), int(number["baseline_version"])
        watch._seconds = number["seconds"]
        watch._used = tuple(part_of(state, "used", list))
        watch._samples = SampleJoiner.from_state(part_of(state, "samples", Mapping))
        watch._learning = BaselineLearning.from_state(part_of(state, "learning", Mapping))
        balance, baseline, leak, window = (
            part_of(state, name, (Mapping, type(None))) for name in ("balance", "baseline", "leak", "window")
        )
        watch._balance = None if balance is None else FrozenBalance.from_state(balance)
        watch.baseline = None if baseline is None else plain_dataclass(WatchBaseline, baseline, "baseline")
        watch.leak = None if leak is None else plain_dataclass(WatchedLeak, leak, "leak")
        watch._means = array_of(part_of(state, "means", Mapping), "means")
        watch._group = array_of(part_of(state, "group", Mapping), "group")
        watch._window = None if window is None else _blocks_of(window)
        return watch


_NUMBERS = (
    "area",
    "displacement",
    "false_alarms_per_1000_h",
    "learn_hours",
    "blocks",
    "baseline_version",
    "seconds",
)


def _blocks_of(state: Mapping[str, Any]) -> BalanceBlocks:
    values: dict[str, Any] = {}
    for field in fields(BalanceBlocks):
        value = part_of(state, field.name, (Mapping, int, float))
        values[field.name] = array_of(value, field.name) if isinstance(value, Mapping) else value
    return BalanceBlocks(**values)


@checked_call
def watch(
    rig: Rig | str | os.PathLike[str] = "thesis", *, false_alarms_per_1000_h: float = 1.0, learn_hours: float = 8.0
) -> Watch:
    """Watch a running actuator: blocks in, L/min with an interval and alarms out.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the piston's area and the pump's displacement.
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
