"""The volume balance of a running machine, block by block, in bounded memory, with alarms of a stated rate.

After each block of a few seconds the balance is fitted to the last ones (`window`), and the conductance is searched
for a rise by the same statistic as a whole recording (`fit.search`): the generalised likelihood ratio over a moving
window (Lai, Sequential changepoint detection in quality control and dynamical systems, JRSS B 57 (1995) 613-658). The
threshold is that of the probability per window

    p = alarms_per_hour * block_seconds / 3600,

so a healthy machine alarms at that rate at most, and its average run length is at least 1/alarms_per_hour: windows
overlap, so false alarms come in clusters, which leaves the true rate some 2 to 5 times below the stated one.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.changepoint.smooth_drift import FEWEST
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.blocks import (
    BLOCK_SECONDS,
    BalanceBlocks,
    balance_channels,
    channels_needed,
)
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.evidence import judge, total_lpm, trouble
from sealscope.diagnosis.volume_balance.fit import fit_balance, with_between
from sealscope.diagnosis.volume_balance.live import (
    LEARN_SECONDS,
    BalanceState,
    JoinedSamples,
    WindowStream,
    check_stream,
    replaces,
)
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Cycles of a duty that the first part of a stream must hold for blocks to be whole ones.
_CYCLES = 5
_CHANNELS = ("u", "x", "theta", "omega", "p_A", "p_B", "p_1", "p_2")


class SequentialBalance:
    """Volume balance of a live machine, which names onset and L/min of a leak.

    It needs both chamber pressures, the piston's position and the pump's angle or speed. Behind a servo valve it needs
    the command and the pressures of supply and return besides, and no angle; a window of whole cycles is looked at anew
    after each.

    Parameters
    ----------
    rig : Rig, str or path, default "thesis"
        Gives the piston's area and the pump's displacement.
    alarms_per_hour : float, default 0.01
        False alarms of a healthy machine per operating hour, at most.
    window : int, default 60
        Blocks that are searched for a rise, 16 or more.
    block_seconds : float, default 3
        About how long a block is [s]: whole cycles of the duty.

    Attributes
    ----------
    state : BalanceState
        The state after the last update.

    Raises
    ------
    InputError
        For a rate of alarms for which no threshold can be set, or a window of under 16 blocks.

    Examples
    --------
    >>> import sealscope as ss
    >>> recording = ss.simulate(command="3 sin(4t)", duration="2 min", leak="0.0042 L/min from 80 s", seed=1)
    >>> balance = ss.SequentialBalance("thesis", alarms_per_hour=0.1)
    >>> for start in range(0, 120, 10):
    ...     state = balance.update(recording.between(start, start + 10))
    ...     if state.alarm is not None:
    ...         break
    >>> round(state.alarm.onset_s), f"{state.alarm.leak_lpm:.3f} L/min"
    (80, '0.004 L/min')
    """

    def __init__(
        self,
        rig: Rig | str | os.PathLike[str] = "thesis",
        *,
        alarms_per_hour: float = 0.01,
        window: int = 60,
        block_seconds: float = BLOCK_SECONDS,
    ) -> None:
        from sealscope.parameters import load_rig

        if not block_seconds > 0:
            raise InputError(f"block_seconds must be > 0 s, got {block_seconds}")
        check_stream(alarms_per_hour, window, block_seconds)
        self.alarms_per_hour, self.window, self.block_seconds = alarms_per_hour, window, block_seconds
        self._detector = VolumeBalance(load_rig(rig))
        behind_valve = self._detector.rig.valve.spool == "present"
        self._windows = (
            WindowStream(self._detector, VolumeBalance.reads, alarms_per_hour, window) if behind_valve else None
        )
        self._samples = JoinedSamples(_CHANNELS)
        self._length = 0
        self._used: tuple[str, ...] = ()
        self._before = 0  # samples kept of the block before the next one
        self._window: BalanceBlocks | None = None
        self._between: BalanceBlocks | None = None
        waiting = Evidence("cannot tell", "waits for the first blocks")
        self.state = BalanceState(float("nan"), 0, 0, waiting, None, None)

    def acknowledge(self) -> None:
        """Take the alarm back, and forget the blocks before now: the machine was repaired, or the leak accepted."""
        if self._windows is not None:
            self._windows.acknowledge()
            self.state = self._windows.state
            return
        self._window = self._between = None
        waiting = Evidence("cannot tell", "waits for blocks after the alarm was acknowledged")
        self.state = BalanceState(self.state.t, self.state.blocks, self.state.refused, waiting, None, None)

    def update(self, samples: Recording) -> BalanceState:
        """Take the next samples; every whole block is judged in its turn.

        Parameters
        ----------
        samples : Recording
            The next samples, of any number, in order.

        Returns
        -------
        BalanceState
            The state after these samples.

        Raises
        ------
        InputError
            Where channels, units or rate are not those of the stream's beginning.
        """
        if self._windows is not None:
            self.state = self._windows.update(samples)
            return self.state
        if not self._samples.begun and (missing := channels_needed(samples)) is not None:
            raise InputError(f"a stream for the volume balance {missing}")
        joined = self._samples.joined(samples)
        if self._length == 0:
            if joined.duration < LEARN_SECONDS:
                self._samples.keep(joined, 0)
                return self.state
            first = joined.samples(slice(0, round(LEARN_SECONDS * joined.rate)))
            self._used = balance_channels(first)
            self._length = self._detector.length(first, self._used, seconds=self.block_seconds, cycles=_CYCLES)
        half = self._length // 2
        starts = range(self._before, len(joined) - self._length + 1, self._length)
        for start in starts:
            between = joined.samples(slice(start - half, start - half + self._length)) if start else None
            self._take(joined.samples(slice(start, start + self._length)), between)
        if starts:
            self._samples.keep(joined, starts[-1] + self._length - half)
            self._before = half
        else:
            self._samples.keep(joined, 0)
        return self.state

    def _take(self, block: Recording, between: Recording | None) -> None:
        if between is not None and self._window is not None:
            self._between = self._joined(self._between, self._detector.blocks(between, self._length, self._used))
        cut = self._detector.blocks(block, self._length, self._used)
        end = float(block.t[-1]) + 1.0 / block.rate
        before = self.state
        evidence, alarm, total = before.evidence, before.alarm, before.total_lpm
        usable = len(cut) > 0 and bool(np.all(np.isfinite(cut.gram)))
        if usable:
            self._window = self._joined(self._window, cut)
            if len(self._window) + (0 if self._between is None else len(self._between)) >= FEWEST:
                evidence, total = self._judge(self._window, block.units["x"] == "m")
        if replaces(evidence, alarm):
            alarm = evidence
        self.state = BalanceState(end, before.blocks + 1, before.refused + (not usable), evidence, alarm, total)

    def _joined(self, window: BalanceBlocks | None, cut: BalanceBlocks) -> BalanceBlocks:
        """Return the last blocks of a window and of what was cut after it."""
        joined = cut if window is None else BalanceBlocks.joined([window, cut])
        return joined.chosen(slice(max(0, len(joined) - self.window), None))

    def _judge(self, blocks: BalanceBlocks, metres: bool) -> tuple[Evidence, float | None]:
        fit = fit_balance(blocks, metres=metres, geometry=self._detector.geometry)
        if self._between is not None:
            fit = with_between(fit, self._between)
        if len(blocks) < FEWEST and fit.between is None:
            return self.state.evidence, None
        problem = trouble(fit)
        if problem is not None:
            return Evidence("cannot tell", problem), None
        return judge(fit, self.alarms_per_hour * blocks.seconds / 3600.0, window=True), total_lpm(fit)
