"""Every actuator's detector and alarm, and the database behind them: a block is taken whole or not at all.

Each transaction stores blocks' identities, estimates, alarms and pending samples; every 16 blocks or 400 kB of an
actuator, and with each mark, its whole state takes the place of the pending samples. So a restart is the last state and
the pending samples gone through once more, with the settings that they were judged by.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import ValidationError
from sqlalchemy.exc import IntegrityError

from sealscope.diagnosis.commissioned.watched import is_remeasured, load_watched
from sealscope.diagnosis.live.estimates import BlockEstimate
from sealscope.diagnosis.live.watch import STATE_VERSION, Watch, watch
from sealscope.diagnosis.verdict.states import LEAKING, MachineState, state_of
from sealscope.errors import InputError
from sealscope.monitor.alarms import Alarm, AlarmJudge
from sealscope.monitor.database.machine_files import pass_on
from sealscope.monitor.database.store import KEPT_IDENTITIES, MonitorStore, StoredRows, outage_reason
from sealscope.monitor.settings import ActuatorSettings, WatchSettings
from sealscope.monitor.sources.source_block import SourceBlock, bytes_of
from sealscope.monitor.supervisor import Supervisor
from sealscope.monitor.verdicts import RecordingVerdict
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import part_of, restored, saved

_log = logging.getLogger(__name__)
_LONGEST_TEXT = 2000
#: Blocks of samples between two checkpoints, and their bytes.
PENDING_BLOCKS, PENDING_BYTES = 16, 400_000
#: What a block is counted under that raised an error.
DROPPED = "blocks that raised an error"
#: Texts of a verdict on a recording that a summary shows.
_SHOWN_OF_VERDICTS = ("file", "verdict", "summary", "size", "odds", "reason")
#: How long the samples of an alarm are kept [s].
_KEPT_S = 120.0


@dataclass
class _Actuator:
    """The state of an actuator in memory.

    `pending`, `bytes`: blocks since the checkpoint; `taken`: blocks so far; `judged_s`: end of the last block that was
    judged [s]; `last`: the last estimate, of flows over the cycles seen; `verdict`: on the last recording, None where
    no whole recordings are judged; `kept`: the last samples while there is an alarm, which a machine's file may be
    taught.
    """

    settings: ActuatorSettings
    watch: Watch
    judge: AlarmJudge
    pending: int = 0
    bytes: int = 0
    taken: int = 0
    last: BlockEstimate | None = None
    shown: dict[str, Any] | None = None
    oil_celsius: float | None = None
    judged_s: float | None = None
    verdict: RecordingVerdict | None = None
    kept: list[Recording] = field(default_factory=list)

    def judge_samples(
        self, samples: Recording, follows: bool, settings: WatchSettings, verdict: RecordingVerdict | None = None
    ) -> tuple[list[BlockEstimate], list[tuple[Alarm, str, float]]]:
        """Judge samples: return their estimates and the events of alarms. A replay gives the same.

        The `verdict` on the whole recording, where there is one that can tell, decides instead of the blocks' tests.
        """
        estimates, happened = [], []
        decided = verdict is not None and verdict.decides
        self.pending += 1
        self.bytes += bytes_of(samples)
        if "T_oil" in samples and samples.units["T_oil"] == "K":
            known = samples["T_oil"][np.abs(samples["T_oil"] - 373.15) < 200.0]  # that of oil
            if known.size:
                self.oil_celsius = float(known.mean()) - 273.15
        for estimate, leak in self.watch.each(samples, follows=follows):
            version = 0 if self.watch.baseline is None else self.watch.baseline.version
            self.last = self.watch.over_cycles(estimate)
            change = None if decided else self.judge.take(self.last, leak, version, settings)
            estimates.append(estimate if verdict is None or not decided else verdict.restate_block(estimate))
            if estimate.judged or self.judged_s is None or self.judged_s > estimate.t:  # the clock may be set back
                self.judged_s = estimate.t
            if change is not None:
                happened.append((*change, estimate.t))
        if verdict is not None and decided:
            if verdict.clears and self.watch.leak is not None:
                self.watch.dismiss()
            version = 0 if self.watch.baseline is None else self.watch.baseline.version
            change = self.judge.take_verdict(verdict, self.verdict, version, settings)
            if change is not None:
                happened.append((*change, verdict.end_s))
        self.verdict = verdict
        same_format = self.kept and (self.kept[0].units, self.kept[0].rate) == (samples.units, samples.rate)
        if self.judge.alarm is None or not (follows and same_format):
            self.kept = []
        if self.judge.alarm is not None and len(samples):
            most = round(_KEPT_S * samples.rate)
            self.kept.append(samples.samples(slice(-most, None)))
            while sum(map(len, self.kept[1:])) > most:
                del self.kept[0]
        return estimates, happened

    def state(self) -> dict[str, Any]:
        """Return the state for a checkpoint as plain values."""
        return saved(self, ("watch", "judge", "last", "oil_celsius", "judged_s", "verdict"))

    def _machine_state(self) -> MachineState:
        """Return the state of NE 107, as far as the samples tell."""
        alarm, baseline, over = self.judge.alarm, self.watch.baseline, self.judge.over_s
        if alarm is not None and alarm.active:
            return state_of(alarm.condition, alarm.cause, since_s=alarm.onset_s, action=alarm.next_check)
        if self.verdict is not None:
            return MachineState(**self.verdict.state)
        if self.last is None or self.judged_s is None:
            return state_of("no data")
        if self.last.t - self.judged_s > self.settings.not_comparable_s:
            return state_of("not comparable", self.last.status, since_s=self.judged_s)
        if baseline is None:
            return state_of("learning", since_s=over)
        return state_of("watched", since_s=max(baseline.learned_s, over or -math.inf))

    def summary(self) -> dict[str, Any]:
        """Return the present summary as plain values."""
        base, alarm, verdict = self.watch.baseline, self.judge.alarm, self.verdict
        last = self.last or BlockEstimate(0, math.nan, "waits for samples")
        headline: BlockEstimate | RecordingVerdict = last if verdict is None or not verdict.decides else verdict
        t = None if self.last is None else last.t
        return {
            "blocks": self.watch.blocks,
            "t": t if verdict is None else verdict.end_s,
            "status": last.status if verdict is None else verdict.summary,
            "state": self._machine_state().as_dict(),
            "by": self.watch.method,
            "total_lpm": headline.total_lpm,
            "total_interval_lpm": headline.total_interval_lpm,
            "leak_lpm": headline.leak_lpm,
            "leak_interval_lpm": headline.leak_interval_lpm,
            "bound_lpm": None if verdict is None else verdict.bound_lpm,
            "recording": None if verdict is None else {name: getattr(verdict, name) for name in _SHOWN_OF_VERDICTS},
            "why_no_litres": self.watch.why_no_litres if verdict is None else "",
            "oil_celsius": self.oil_celsius,
            "baseline": None if base is None else {"version": base.version, "hours": base.hours, "lpm": base.lpm},
            "alarm": None if alarm is None else alarm.id,
            "status_word": 0 if alarm is None else alarm.status_word,
            "counters": self.watch.counters,
        }


def _settings_of(stored: str) -> WatchSettings | None:
    """Return the settings of a checkpoint, None where an earlier Sealscope stored others."""
    try:
        return WatchSettings.model_validate_json(stored)
    except ValidationError:
        return None


def _learned_alike(stored: Watch, fresh: Watch) -> bool:
    """Test whether a stored watch learned under the conditions of a fresh one, up to a remeasured displacement."""
    (rig, *rest), (before, *other_conditions) = fresh.learned_with, stored.learned_with
    return rest == other_conditions and (rig == before or is_remeasured(rig, before))


class _Repeated(Exception):  # noqa: N818 (says what happened)
    """One of the blocks is stored already."""


class WatchedActuators:
    """The actuators of a monitor, restored from its database, which keeps estimates of `keep_days` of operation."""

    def __init__(self, settings: list[ActuatorSettings], store: MonitorStore, keep_days: float = 90.0) -> None:
        self.store, self.settings = store, {setting.name: setting for setting in settings}
        self._heard = dict.fromkeys(self.settings, time.monotonic())  # when the last block of each came [s]
        self._keep_s = keep_days * 86_400.0
        self._counters, self._counting = Counter[str](), threading.Lock()
        self._changes, self.changed, self.closed = itertools.count(1), 0, False
        self.supervisor = Supervisor(outage_reason, self._tell)
        self._lock = threading.RLock()
        self._actuators = {name: self._restore(self.settings[name]) for name in self.settings}

    def _restore(self, settings: ActuatorSettings) -> _Actuator:
        """Restore an actuator from its last transaction, or begin anew if it is new or its settings changed."""
        name, rate = settings.name, settings.false_alarms_per_1000_h
        state, block_count = self.store.checkpoint(name), self.store.last_number(self.store.tables.blocks, name)
        machine = load_watched(settings.rig)
        fresh = watch(
            machine.rig,
            false_alarms_per_1000_h=rate,
            learn_hours=settings.learn_hours,
            healthy=machine.healthy,
        )
        actuator, anew = _Actuator(settings, fresh, AlarmJudge(name), taken=block_count), True
        if state is not None:
            stored, checkpoint, pending = state
            before = _settings_of(stored)
            actuator.judge = restored(AlarmJudge, checkpoint["judge"], "alarm")
            if (version := part_of(checkpoint["watch"], "version", int)) != STATE_VERSION:
                _log.warning("%s: its state has version %s, not %d, begins anew", name, version, STATE_VERSION)
                learned = part_of(checkpoint["watch"], "baseline_version", int)
                fresh.continue_from(self.store.last_number(self.store.tables.estimates, name), learned)
            else:
                actuator.watch = Watch.from_state(checkpoint["watch"])
                actuator.last = (
                    None if checkpoint["last"] is None else restored(BlockEstimate, checkpoint["last"], "last")
                )
                actuator.oil_celsius, actuator.judged_s = checkpoint.get("oil_celsius"), checkpoint.get("judged_s")
                if checkpoint.get("verdict") is not None:
                    actuator.verdict = restored(RecordingVerdict, checkpoint["verdict"], "verdict")
                for samples, follows, verdict in pending:  # as they were judged before
                    actuator.judge_samples(samples, follows, before or settings, verdict)
                anew = before != settings.watched_with
                actuator.watch.false_alarms_per_1000_h = rate  # with the same baseline
                if actuator.watch.healthy is not None:  # no person has said that it is another
                    actuator.watch.healthy = machine.healthy
                if not _learned_alike(actuator.watch, fresh):
                    _log.warning("%s: its rig or learn_hours are others than it learned with, begins anew", name)
                    fresh.continue_from(actuator.watch.blocks, actuator.watch.baseline_version)
                    actuator.watch, anew = fresh, True
        if anew:
            rows = StoredRows()
            self._checkpoint(actuator, rows)
            self.store.keep(rows)
        return actuator

    def count(self, reason: str, number: int = 1) -> None:
        """Count something that was dropped."""
        if number:
            with self._counting:
                self._counters[reason] += number

    @property
    def counters(self) -> dict[str, int]:
        """Messages and blocks that were dropped since the start, by reason."""
        with self._counting:
            return dict(self._counters)

    def take(self, blocks: Sequence[SourceBlock]) -> None:
        """Take blocks in one transaction: samples, estimates, alarms and the blocks' identities, or nothing of it.

        Raises what the database raises; the blocks can then be taken again.
        """
        with self._lock:
            known = [block for block in blocks if block.actuator in self.settings]
            for name in {block.actuator for block in known}:
                self._heard[name] = time.monotonic()
            self._take(known)
            self.count("blocks of an actuator that is not in the settings", len(blocks) - len(known))

    def _take(self, blocks: Sequence[SourceBlock]) -> None:
        """Take blocks of known actuators.

        None of them is likely to be stored: that is asked only where the database refuses to store one again.
        """
        if not blocks:
            return
        new = {(block.actuator, block.identity): block for block in reversed(blocks)}  # of two the first
        fresh = [block for block in blocks if new[block.actuator, block.identity] is block]
        try:
            try:
                self._store_new(fresh)
            except _Repeated:
                known = self.store.select_stored(new)
                fresh = [block for block in fresh if (block.actuator, block.identity) not in known]
                self._store_new(fresh)
        except BaseException:
            # what the detectors took is not stored: the next blocks begin at the last transaction
            for name in {block.actuator for block in blocks}:
                self._actuators.pop(name, None)
            raise
        self.count("blocks stored already", len(blocks) - len(fresh))
        self._tell()

    def _store_new(self, blocks: Sequence[SourceBlock]) -> None:
        """Take blocks in one transaction.

        Raises _Repeated, and no detector has taken anything, where one of the blocks is stored already.
        """
        rows = StoredRows()
        with self.store.writing() as connection:
            mine = [(block, self._actuator(block.actuator)) for block in blocks]
            numbers = {actuator.settings.name: itertools.count(actuator.taken + 1) for _, actuator in mine}
            numbered = [(block.actuator, block.identity, next(numbers[block.actuator])) for block, _ in mine]
            if numbered:
                try:
                    self.store.keep_blocks(connection, numbered)
                except IntegrityError:
                    raise _Repeated from None
            for block, actuator in mine:
                actuator.taken += 1
                if block.samples is not None:
                    self._add_samples(rows, actuator, block, block.samples)
            self.store.keep_rows(connection, rows)

    def _actuator(self, name: str) -> _Actuator:
        if name not in self._actuators:
            self._actuators[name] = self._restore(self.settings[name])
        return self._actuators[name]

    def _add_samples(self, rows: StoredRows, actuator: _Actuator, block: SourceBlock, samples: Recording) -> None:
        """Judge the samples of an actuator's block, and add the results to the rows."""
        name, follows, verdict = actuator.settings.name, block.follows, block.verdict
        estimates, happened = actuator.judge_samples(samples, follows, actuator.settings, verdict)
        rows.add_estimates(name, estimates, actuator.oil_celsius)
        for alarm, kind, t in happened:
            rows.add_alarm(alarm, kind, t)
        turn = (actuator.taken + zlib.crc32(name.encode())) % PENDING_BLOCKS  # not all actuators at the same instant
        if turn == 0 or actuator.bytes >= PENDING_BYTES:
            self._checkpoint(actuator, rows)
        else:
            rows.add_pending(name, actuator.pending, samples, follows, verdict)
            self._show(actuator, rows)

    def _checkpoint(self, actuator: _Actuator, rows: StoredRows) -> None:
        """Add the state to the rows, and what is old then."""
        settings = actuator.settings
        rows.add_checkpoint(settings.name, settings.watched_with.model_dump_json(), actuator.state())
        self._show(actuator, rows)
        kept = self._keep_s / actuator.watch.block_seconds
        rows.old[settings.name] = actuator.taken - KEPT_IDENTITIES, math.floor(actuator.watch.blocks - kept)
        actuator.pending = actuator.bytes = 0

    @staticmethod
    def _show(actuator: _Actuator, rows: StoredRows) -> None:
        """Add the summary of an actuator to the rows if it has changed."""
        summary = actuator.summary()
        if summary != actuator.shown:
            actuator.shown = summary
            rows.add_summary(actuator.settings.name, summary)

    def mark(self, name: str, mark: str, *, by_whom: str = "", text: str = "", hours: float = 8.0) -> Alarm:
        """Keep what a person says of an actuator's alarm, in one transaction.

        `mark`: one of `MARKS`; ``invalid``, for the reason `text`, takes the leak back, ``repaired`` begins a new
        baseline as well; ``shelved`` announces nothing for `hours`. The file of a commissioned machine learns of the
        mark (`pass_on`), and an event says what it made of it. Raises InputError where there is no such alarm.
        """
        if len(text) > _LONGEST_TEXT or len(by_whom) > 80:
            raise InputError(f"a comment must have at most {_LONGEST_TEXT} characters, a name 80")
        if "\0" in text + by_whom or any("\ud800" <= letter <= "\udfff" for letter in text + by_whom):
            raise InputError("a comment must be text, got a NUL or half of a surrogate pair")
        if not 0.0 < hours <= 10_000.0:
            raise InputError(f"an alarm must be shelved for > 0 h, got {hours:g}")
        with self._lock:
            if name not in self.settings:
                raise InputError(f"the settings must have the actuator {name[:60]!r}, got none")
            actuator, rows = self._actuator(name), StoredRows()
            t = getattr(actuator.last, "t", getattr(actuator.judge.alarm, "updated_s", 0.0))
            kept = list(actuator.kept)
            alarm = actuator.judge.marked(mark, t, until=t + hours * 3600.0, reason=text)
            try:
                if mark in ("invalid", "repaired") and actuator.verdict is not None:
                    actuator.verdict = actuator.verdict.mark_over(mark)
                if mark == "invalid":
                    actuator.watch.dismiss()
                elif mark == "repaired":
                    actuator.watch.relearn()
                rows.add_alarm(alarm, mark, t, by_whom, text)
                self._checkpoint(actuator, rows)
                self.store.keep(rows)
            except BaseException:  # the next one begins at the last transaction
                self._actuators.pop(name, None)
                raise
        if done := pass_on(self.settings[name].rig, alarm, mark, kept):  # takes a second, and holds nothing up
            rows = StoredRows()
            rows.add_alarm(alarm, "comment", t, "Sealscope", done)
            rows.alarms.clear()  # it may have changed meanwhile
            self.store.keep(rows)
        self._tell()
        return alarm

    @property
    def false_alarms_per_1000_h(self) -> float:
        """False alarms of all healthy actuators together per 1000 h in which all of them run, at most."""
        return sum(settings.false_alarms_per_1000_h for settings in self.settings.values())

    def plain(self) -> dict[str, dict[str, Any]]:
        """Return the present summary of each actuator of the settings, as its last transaction left it.

        Where nothing has come for `no_data_s` and no alarm lasts, its state says so.
        """
        known, now = self.store.summaries(), time.monotonic()
        shown = {}
        for name, settings in self.settings.items():
            if name in known:
                summary, state = known[name], known[name].get("state")
                silent = now - self._heard[name] > settings.no_data_s
                if state is None or (silent and state["condition"] not in LEAKING):
                    state = state_of("no data", since_s=summary["t"]).as_dict()
                shown[name] = {**summary, "state": state}
        return shown

    def _tell(self) -> None:
        self.changed = next(self._changes)
