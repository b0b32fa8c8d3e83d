"""The detectors and alarms of all actuators of a monitor, stored in its database with each block of samples.

One transaction stores the identities of blocks, their estimates, alarms and samples. The samples are stored as pending
until the next checkpoint, which stores the whole state of an actuator: after 16 blocks or 400 kB, and with each mark of
a person. Those of a stream's recording that has not ended stay pending until it ends. A restart loads the last
checkpoint and judges the samples after it again, with the settings of the first time.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from sqlalchemy.exc import IntegrityError

from sealscope.diagnosis.commissioned.watched import WatchedMachine, is_remeasured, load_watched
from sealscope.diagnosis.live.estimates import BlockEstimate
from sealscope.diagnosis.live.watch import STATE_VERSION, Watch, watch
from sealscope.diagnosis.verdict.severity import LEAKING, MachineState, state_of
from sealscope.errors import InputError, SealscopeError
from sealscope.monitor.alarms import Alarm, AlarmJudge
from sealscope.monitor.database import tables
from sealscope.monitor.database.machine_files import record_mark
from sealscope.monitor.database.store import MAX_IDENTITIES, MonitorStore, StoredRows, StoredSamples, outage_reason
from sealscope.monitor.logged_counts import LoggedCounts, log_growth
from sealscope.monitor.settings import ActuatorSettings, WatchSettings
from sealscope.monitor.sources.source_block import TIME_UNITS, SourceBlock, count_bytes
from sealscope.monitor.sources.stream_recordings import StreamRecorder
from sealscope.monitor.supervisor import Supervisor, describe_error
from sealscope.monitor.verdicts import STREAM_SHARE, RecordingVerdict, judge_stream
from sealscope.recordings.header import measured_oil_temperature
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import require_part, restore, restore_attributes, save_attributes

_log = logging.getLogger(__name__)
_Made = TypeVar("_Made")
_MAX_COMMENT_LENGTH = 2000
#: How long an alarm is shelved, on the clock of the samples [s].
_SHELVED_S = 8 * 3600.0
#: Blocks of samples between two checkpoints, and their bytes, at most.
PENDING_BLOCKS, PENDING_BYTES = 16, 400_000
#: Counter of the blocks that raised an error.
DROPPED = "blocks that raised an error"
#: Counter of transactions that the database lacks at the start (`MonitorStore.n_lost`).
LOST_TRANSACTIONS = "transactions that the database has lost"
#: How often a machine's file that cannot be read is tried again [s].
_RETRY_S = 5.0
#: Counter of blocks whose times seem to be in another unit than seconds, and the relative deviation up to which they
#: seem so.
WRONG_PACE, _SAME_PACE = "blocks whose clock runs too fast for their rate", 0.01
#: Fields of the verdict on a recording that the summary of an actuator contains.
_VERDICT_TEXTS = ("file", "verdict", "summary", "size", "odds", "reason")
#: Fields of the healthy baseline that the summary contains.
_BASELINE_VALUES = ("version", "hours", "lpm")
#: Last results of an actuator that a checkpoint stores: type of each by attribute, which may also be None.
_RESULT_TYPES = {"last": BlockEstimate, "oil_celsius": float, "judged_s": float, "verdict": RecordingVerdict}
#: Status of an actuator before its first block.
_WAITS = "waits for samples"
#: Length of the last samples that are kept during an alarm [s].
_ALARM_SAMPLES_S = 120.0
#: A change of an alarm: the changed alarm, name of the event, such as "raised" or "returned" (the leak has ended), and
#: time of the change [s].
_AlarmEvent = tuple[Alarm, str, float]


@dataclass
class _Actuator:
    """The state of one watched actuator in memory."""

    settings: ActuatorSettings
    watch: Watch  # the detector of a leak
    judge: AlarmJudge
    bytes: int = 0  # of the blocks of samples since the last checkpoint
    n_stored: int = 0  # number of all stored blocks
    last: BlockEstimate | None = None  # last estimate, with flows averaged over the machine's cycles
    stored_summary: dict[str, Any] | None = None
    oil_celsius: float | None = None
    judged_s: float | None = None  # end of the last judged block, or of the first block if none is judged yet [s]
    verdict: RecordingVerdict | None = None  # on the last recording, None also if newer results replace it
    # last samples during an alarm, which may become a healthy recording
    alarm_samples: list[Recording] = field(default_factory=list)
    last_times: tuple[float, float] = (0.0, 0.0)  # begin and end of the last block of samples by its rate [s]
    recorder: StreamRecorder | None = None  # None for files, and for `recording_s` = 0
    is_commissioned: bool = False  # True if recordings are compared with healthy ones

    def record(self, number: int, samples: Recording) -> Recording | None:
        """Collect a stream's block with the running `number`; return the recording that ends with it, if it is judged.

        Without a commissioned machine recordings are judged only if the blocks are not, for want of a position.
        """
        if self.recorder is None or not (self.is_commissioned or self.watch.lacks_channels(samples)):
            return None
        return self.recorder.take(number, samples)

    def judge_samples(
        self, samples: Recording, *, follows: bool, settings: WatchSettings, verdict: RecordingVerdict | None = None
    ) -> tuple[list[BlockEstimate], list[_AlarmEvent]]:
        """Judge new samples; return the leakage estimates of blocks of some seconds, and the changes of the alarm.

        `follows`: False after a gap; `settings`: thresholds of the alarm; `verdict`: verdict on the recording that ends
        with these samples, None for none. For a file, the recording consists of these samples: a verdict that decides,
        "leak" or "no leak" (`RecordingVerdict.decides`), replaces the leak in the estimates, and alone updates the
        alarm. For a stream, the recording has the last minutes, and both the estimates and the verdict update the
        alarm. A stream's verdict is forgotten `not_comparable_s` after its recording, if no other has followed.
        """
        estimates: list[BlockEstimate] = []
        events: list[_AlarmEvent] = []
        deciding_verdict = verdict if verdict is not None and verdict.decides else None
        self.bytes += count_bytes(samples)
        if (oil_celsius := measured_oil_temperature(samples)) is not None:
            self.oil_celsius = oil_celsius
        for estimate, leak in self.watch.each(samples, follows=follows):  # leak: found so far, or None
            self.last = self.watch.with_cycle_means(estimate)
            if estimate.judged or self.judged_s is None or self.judged_s > estimate.t:  # the clock may be set back
                self.judged_s = estimate.t
            if deciding_verdict is not None and self.recorder is None:
                estimates.append(deciding_verdict.restate_block(estimate))
                continue
            estimates.append(estimate)
            allowed_rate = self.watch.false_alarms_per_1000_h
            change = self.judge.update(self.last, leak, self._baseline_version(), settings, allowed_rate)
            if change is not None:
                events.append((*change, estimate.t))
                if change[1] == "raised":  # newer than the verdict on an earlier recording
                    self.verdict = None
        if verdict is not None or self.recorder is None:
            events.extend(self._apply_verdict(verdict, settings))
        elif self.verdict is not None and len(samples):
            age_s = float(samples.t[-1]) - self.verdict.end_s
            self.verdict = None if age_s > settings.not_comparable_s else self.verdict
        if events:  # the last one has the present alarm: it states the leak that the summary states
            alarm, event, t = events[-1]
            result = self._result
            restated = self.judge.restate_leak(alarm, event, result.leak_lpm, result.leak_interval_lpm)
            events[-1] = (*restated, t)
        self._update_alarm_samples(samples, follows=follows)
        return estimates, events

    @property
    def _result(self) -> RecordingVerdict | BlockEstimate:
        """The result whose flows are stated: the verdict on the last recording, if it decides, else the last block."""
        if self.verdict is not None and self.verdict.decides:
            return self.verdict
        return self.last or BlockEstimate(0, math.nan, _WAITS)

    def _apply_verdict(self, verdict: RecordingVerdict | None, settings: WatchSettings) -> list[_AlarmEvent]:
        """Keep the verdict on a recording and, if it decides, update the alarm; return the changes of the alarm.

        None, for samples without a verdict, only replaces the earlier verdict. For a stream, a verdict that does not
        decide is dropped once there is an estimate of a block, which tells more, and the verdict `no leak` is dropped
        if its bound does not exclude the leak of the alarm. Otherwise `no leak` makes the detector withdraw its leak.
        """
        earlier_verdict, self.verdict = self.verdict, verdict
        is_stream, alarm = self.recorder is not None, self.judge.alarm
        if is_stream and verdict is not None:
            self.judge.add_evidence(verdict)
        if verdict is None or not verdict.decides:
            if is_stream and self.last is not None:
                self.verdict = None
            return []
        if verdict.excludes_leak:
            if is_stream and alarm is not None and not verdict.excludes(alarm.leak_lpm):
                self.verdict = None
                return []
            if self.watch.leak is not None:
                self.watch.dismiss()
        version = self._baseline_version()
        change = self.judge.update_from_verdict(verdict, earlier_verdict, version, settings, is_stream=is_stream)
        return [] if change is None else [(*change, verdict.end_s)]

    def _baseline_version(self) -> int:
        """Return the version number of the actuator's healthy baseline, 0 while a baseline is being learned."""
        return 0 if self.watch.baseline is None else self.watch.baseline.version

    def _update_alarm_samples(self, samples: Recording, *, follows: bool) -> None:
        """Keep the last `_ALARM_SAMPLES_S` seconds of samples while an alarm is open.

        The kept samples start anew after a gap (`follows` is False), or if the sampling rate or the units change.
        """
        first = self.alarm_samples[0] if self.alarm_samples else samples
        same_format = (first.units, first.rate) == (samples.units, samples.rate)
        if self.judge.alarm is None or not follows or not same_format:
            self.alarm_samples = []
        if self.judge.alarm is not None and len(samples):
            max_samples = round(_ALARM_SAMPLES_S * samples.rate)
            self.alarm_samples.append(samples.samples(slice(-max_samples, None)))
            while sum(map(len, self.alarm_samples[1:])) > max_samples:  # enough without the first block
                del self.alarm_samples[0]

    def state(self) -> dict[str, Any]:
        """Convert the detector, the alarm and the last results to plain values, for a checkpoint in the database."""
        return save_attributes(self, ("watch", "judge", *_RESULT_TYPES, "n_stored", "recorder"))

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore detector, recorder and last results from a checkpoint's `state`; not its alarm and `n_stored`."""
        self.watch = Watch.from_state(state["watch"])
        restore_attributes(self, _RESULT_TYPES, state, _RESULT_TYPES)
        if self.recorder is not None and state["recorder"] is not None:
            self.recorder.load_state(state["recorder"])

    def _machine_state(self) -> MachineState:
        """Determine the state of the machine by NAMUR NE 107, such as "good" or "maintenance required".

        It comes from an active alarm, else from the verdict on the last recording, else from what the detector does:
        "no data", "not comparable" (no block was judged for some time), "learning" (the healthy baseline) or "watched".
        """
        alarm, baseline, alarm_end_s = self.judge.alarm, self.watch.baseline, self.judge.over_s
        if alarm is not None and alarm.active:
            return state_of(alarm.condition, alarm.cause, since_s=alarm.onset_s, action=alarm.next_check)
        if self.verdict is not None:
            return MachineState(**self.verdict.state)
        if self.last is None or self.judged_s is None:
            return state_of("no data")
        if self.last.t - self.judged_s > self.settings.not_comparable_s:
            return state_of("not comparable", self.last.status, since_s=self.judged_s)
        if baseline is None:
            return state_of("learning", since_s=alarm_end_s)  # the last alarm's end, as by a repair, or None
        # watched since the baseline is known or the last alarm ended, whichever is later
        return state_of("watched", since_s=max(baseline.known_s, alarm_end_s or -math.inf))

    def summary(self) -> dict[str, Any]:
        """Build the summary of the actuator for the page, the metrics and messages, as plain values by name.

        The status is that of the verdict on the last recording, if there is one, else of the last block. The flows are
        those of this verdict only if it decides (`RecordingVerdict.decides`). Unknown values are None.

        - `blocks`: number of blocks of some seconds so far; `t`: end of the last block or of the verdict's recording,
          whichever is later [s]; `status`: result in words; `state`: state by NAMUR NE 107;
        - `by`: what is judged, "volumes" of blocks or, without a position, "recordings"; `counters`: those of the
          detector of blocks; `why_no_litres`: reason why it states no L/min, else "", and "" beside a verdict, whose
          own texts are shown;
        - `total_lpm`, `leak_lpm`, `bound_lpm` [L/min]: total leakage, leak, and upper bound of a leak that is not
          found; `recording`: texts of the last verdict; `alarm`: id of the open alarm; `status_word`: 0 without one.
        """
        baseline, alarm, verdict, result = self.watch.baseline, self.judge.alarm, self.verdict, self._result
        t = None if self.last is None else self.last.t
        return {
            "blocks": self.watch.blocks,
            "t": t if verdict is None else max(verdict.end_s, t or -math.inf),
            "status": (_WAITS if self.last is None else self.last.status) if verdict is None else verdict.summary,
            "state": self._machine_state().as_dict(),
            "by": "volumes" if self.watch.has_begun or self.verdict is None else "recordings",
            "total_lpm": result.total_lpm,
            "total_interval_lpm": result.total_interval_lpm,
            "leak_lpm": result.leak_lpm,
            "leak_interval_lpm": result.leak_interval_lpm,
            "bound_lpm": result.bound_lpm if isinstance(result, RecordingVerdict) else None,
            "recording": None if verdict is None else {name: getattr(verdict, name) for name in _VERDICT_TEXTS},
            "why_no_litres": self.watch.why_no_litres if verdict is None else "",
            "oil_celsius": self.oil_celsius,
            "baseline": None if baseline is None else {name: getattr(baseline, name) for name in _BASELINE_VALUES},
            "alarm": None if alarm is None else alarm.id,
            "status_word": 0 if alarm is None else alarm.status_word,
            "counters": self.watch.counters,
        }


class _AlreadyStored(Exception):  # noqa: N818 (says what happened)
    """Raised if the database already has one of the blocks of samples that are to be stored."""


class WatchedActuators:
    """The watched actuators of a monitor, restored from its `store`, with estimates of `keep_days` of operation."""

    def __init__(self, settings: list[ActuatorSettings], store: MonitorStore, keep_days: float = 90.0) -> None:
        """Restore the actuator of each of the `settings` from the database, or create it if it is not stored."""
        self.store, self.settings = store, {setting.name: setting for setting in settings}
        # arrival of each one's last block [s], at first the start of the monitor
        self._last_block_clock = dict.fromkeys(self.settings, time.monotonic())
        self._keep_s = keep_days * 86_400.0
        self._counters, self._counting = Counter[str](), threading.Lock()
        self._logged_counts = LoggedCounts(self.count)
        # change_number: see `_notify_change`; closed: set to True when open web pages must end
        self._changes, self.change_number, self.closed = itertools.count(1), 0, False
        self.supervisor = Supervisor(outage_reason, self._notify_change)
        self._lock = threading.RLock()
        self._machines: dict[str, WatchedMachine] = {}  # by the name or file of a rig, as last read
        self._unread_files: dict[str, float] = {}  # files that could not be read, with the time of the next attempt [s]
        self.count(LOST_TRANSACTIONS, store.n_lost)
        self._actuators = {name: self._restore(self.settings[name]) for name in self.settings}

    def _restore(self, settings: ActuatorSettings) -> _Actuator:
        """Restore an actuator from its last checkpoint and the samples since then, or create and store it.

        If the stored state is damaged, the actuator begins anew, and this is logged; its open alarm stays.
        """
        name = settings.name
        n_stored = self.store.last_number(tables.blocks, name)
        actuator = self._make_actuator(settings, n_stored)
        try:
            checkpoint = self.store.checkpoint(name)
            is_incomplete = checkpoint is None or self._load_checkpoint(actuator, *checkpoint)
        except Exception as error:
            if outage_reason(error) is not None:
                raise
            _log.error("%s: begins anew, as its stored state is damaged: %s", name, describe_error(error))
            actuator, is_incomplete = self._make_actuator(settings, n_stored), True
            self._restore_numbers(actuator)
        if is_incomplete:  # a new checkpoint is needed
            rows = StoredRows()
            self._checkpoint(actuator, rows)
            self.store.commit_rows(rows)
        return actuator

    def _make_actuator(self, settings: ActuatorSettings, n_stored: int) -> _Actuator:
        """Make an actuator that has not judged any samples, of which `n_stored` blocks are stored."""
        name = settings.name

        def make(watched: WatchedMachine) -> _Actuator:
            is_recorded = settings.folder is None and settings.recording_s > 0.0
            is_commissioned = watched.machine is not None
            # the blocks have a share of the allowed false alarms; the recordings take the rest
            share = 1.0 - STREAM_SHARE if is_recorded and is_commissioned else 1.0
            fresh = watch(
                watched.rig,
                false_alarms_per_1000_h=settings.false_alarms_per_1000_h * share,
                learn_hours=settings.learn_hours,
                healthy=watched.healthy,
            )
            recorder = StreamRecorder(name, settings.recording_s) if is_recorded else None
            return _Actuator(
                settings,
                fresh,
                AlarmJudge(name),
                n_stored=n_stored,
                recorder=recorder,
                is_commissioned=is_commissioned,
            )

        return self._with_machine(settings.rig, make)

    def _with_machine(self, rig: str, make: Callable[[WatchedMachine], _Made]) -> _Made:
        """Call `make` with the machine or rig of a name or file `rig`, read anew, and return its result.

        If the file cannot be read or used, as while somebody edits it, the machine read before stays, and an outage
        begins, which ends when the file can be read again. Without an earlier machine the error is raised.
        """
        part = f"machine's file {Path(rig).name}"
        try:
            watched = load_watched(rig)
            result = make(watched)
        except Exception as error:
            if rig not in self._machines:
                raise
            self._unread_files[rig] = time.monotonic() + _RETRY_S
            reason = str(error) if isinstance(error, SealscopeError) else describe_error(error)
            self.supervisor.part(part).begin_outage(f"the machine read before stays: {reason}")
            return make(self._machines[rig])
        self._machines[rig] = watched
        if self._unread_files.pop(rig, None) is not None:
            self.supervisor.part(part).end_outage()
        return result

    def _restore_numbers(self, actuator: _Actuator) -> None:
        """Continue the numbers of blocks, baselines and alarms of an actuator without its state; keep its open alarm.

        The numbers and the alarm are those of the other tables.
        """
        name = actuator.settings.name
        alarms = self.store.alarms(actuator=name)
        baseline_version = max((int(alarm["baseline"]) for alarm in alarms), default=0)
        with suppress(KeyError, TypeError, ValueError):  # of a summary without a baseline
            baseline_version = max(baseline_version, int(self.store.summaries()[name]["baseline"]["version"]))
        actuator.watch.continue_from(self.store.last_number(tables.estimates, name), baseline_version)
        actuator.judge.raised = self.store.last_alarm_number(name)
        latest_alarm = next(iter(alarms), None)
        if latest_alarm is not None and latest_alarm["id"] == f"{name}-{actuator.judge.raised}":
            alarm = restore(Alarm, {field.name: latest_alarm[field.name] for field in fields(Alarm)}, "alarm")
            actuator.judge.alarm = None if alarm.is_over else alarm

    def _load_checkpoint(self, actuator: _Actuator, settings_json: str, state: Mapping[str, Any]) -> bool:
        """Restore an actuator from the settings and `state` of its checkpoint, and judge the samples since then again.

        The detector (`watch`) starts anew if its state has another `STATE_VERSION`, and the samples are then not judged
        again, or if its rig or learning time has changed. A pump displacement within 5 % of the stored one counts as
        the same, measured again. Returns True if a new checkpoint must be saved, because the detector starts anew or
        the settings have changed.
        """
        settings, name = actuator.settings, actuator.settings.name
        fresh = actuator.watch
        actuator.judge = restore(AlarmJudge, state["judge"], "alarm")
        if (version := require_part(state["watch"], "version", int)) != STATE_VERSION:
            _log.warning("%s: starts anew, as its state has version %s, not %d", name, version, STATE_VERSION)
            baseline_version = require_part(state["watch"], "baseline_version", int)
            n_blocks = self.store.last_number(tables.estimates, name)
            fresh.continue_from(n_blocks, baseline_version)
            return True
        actuator.load_state(state)
        stored_settings = None
        with suppress(ValidationError):  # another version may have written them in another form
            stored_settings = WatchSettings.model_validate_json(settings_json)
        # number of the last block whose effect the state includes; an old state without it includes no pending block
        n_judged = state.get("n_stored", 0)
        for number, samples, follows, verdict in self.store.pending(name):
            if number <= n_judged:
                if actuator.recorder is not None:
                    actuator.recorder.refill(number, samples)
                continue
            actuator.record(number, samples)  # a recording that ends here has the stored verdict
            # with the settings of the first time, if readable
            actuator.judge_samples(samples, follows=follows, settings=stored_settings or settings, verdict=verdict)
        # samples that are damaged have no effect on the restored detector, but their estimates are stored
        actuator.watch.blocks = max(actuator.watch.blocks, self.store.last_number(tables.estimates, name))
        actuator.watch.false_alarms_per_1000_h = fresh.false_alarms_per_1000_h  # may change without a new baseline
        if actuator.watch.healthy is not None:  # None once a leak was withdrawn (`Watch.dismiss`)
            actuator.watch.healthy = fresh.healthy
        rig, *learning_settings = fresh.learned_with
        stored_rig, *stored_learning_settings = actuator.watch.learned_with
        is_same_rig = rig == stored_rig or is_remeasured(rig, stored_rig)
        if is_same_rig and learning_settings == stored_learning_settings:
            return stored_settings != settings.watched_with
        _log.warning("%s: starts anew, as its rig or learn_hours have changed", name)
        fresh.continue_from(actuator.watch.blocks, actuator.watch.baseline_version)
        actuator.watch = fresh
        return True

    def count(self, reason: str, number: int = 1) -> None:
        """Add `number` to the counter called `reason`, usually the reason why messages or blocks are dropped."""
        if number:
            with self._counting:
                self._counters[reason] += number

    @property
    def counters(self) -> dict[str, int]:
        """Numbers of messages and blocks dropped since the start, by reason."""
        with self._counting:
            return dict(self._counters)

    def process_blocks(self, blocks: Sequence[SourceBlock]) -> None:
        """Judge blocks of samples, and store them with their estimates and alarms in one transaction.

        Blocks of actuators not in the settings are only counted. After an error nothing is stored: repeat the call.
        """
        with self._lock:
            for rig, retry in [*self._unread_files.items()]:
                if time.monotonic() >= retry:
                    self._with_machine(rig, lambda watched: watched)
            known_blocks = [block for block in blocks if block.actuator in self.settings]
            self._last_block_clock |= dict.fromkeys((block.actuator for block in known_blocks), time.monotonic())
            self._store_once(known_blocks)
            self.count("blocks of an actuator that is not in the settings", len(blocks) - len(known_blocks))

    def _store_once(self, blocks: Sequence[SourceBlock]) -> None:
        """Judge and store those blocks that are not in the database yet.

        Repeated blocks are rare: the database is searched for them only after it has refused a block.
        """
        if not blocks:
            return
        # of two blocks with the same identity the first is kept: in reversed order the first replaces the second
        by_identity = {(block.actuator, block.identity): block for block in reversed(blocks)}
        new_blocks = [block for block in blocks if by_identity[block.actuator, block.identity] is block]
        try:
            try:
                self._store_new(new_blocks)
            except _AlreadyStored:
                stored_keys = self.store.select_stored(by_identity)
                new_blocks = [block for block in new_blocks if (block.actuator, block.identity) not in stored_keys]
                self._store_new(new_blocks)
        except BaseException:
            # the detectors have judged blocks that are not stored: the next block restores them from the database
            for name in {block.actuator for block in blocks}:
                self._actuators.pop(name, None)
            raise
        self.count("blocks stored already", len(blocks) - len(new_blocks))
        self._notify_change()

    def _store_new(self, blocks: Sequence[SourceBlock]) -> None:
        """Judge and store blocks in one transaction; raise _AlreadyStored, before judging, if one is stored already."""
        rows = StoredRows()
        with self.store.writing() as connection:
            pairs = [(block, self._actuator(block.actuator)) for block in blocks]
            # by actuator: running numbers of the new blocks
            numbers = {actuator.settings.name: itertools.count(actuator.n_stored + 1) for _, actuator in pairs}
            identities = [(block.actuator, block.identity, next(numbers[block.actuator])) for block in blocks]
            if identities:
                try:
                    self.store.insert_blocks(connection, identities)
                except IntegrityError:
                    raise _AlreadyStored from None
            for block, actuator in pairs:
                actuator.n_stored += 1
                self._add_samples(rows, actuator, block)
            self.store.write_rows(connection, rows)

    def _actuator(self, name: str) -> _Actuator:
        """Return the actuator called `name`; restore it from the database if it is not in memory."""
        if name not in self._actuators:
            self._actuators[name] = self._restore(self.settings[name])
        return self._actuators[name]

    def _add_samples(self, rows: StoredRows, actuator: _Actuator, block: SourceBlock) -> None:
        """Judge any samples of an actuator's block, and add the results to the database rows that will be stored.

        If a recording of the stream ends with the block, it is judged, too. A checkpoint is added when it is due.
        """
        samples, follows, verdict = block.samples, block.follows, block.verdict
        if samples is None:
            return
        self._check_time_unit(actuator, samples)
        settings, recorder = actuator.settings, actuator.recorder
        name, number = settings.name, actuator.n_stored
        if (recording := actuator.record(number, samples)) is not None:
            try:
                watched = self._with_machine(settings.rig, lambda watched: watched)  # the file may have changed
                verdict = judge_stream(watched, recording, limit_lpm=settings.error_lpm)
            except Exception as error:
                _log.warning("%s: its last recording is not judged: %s", name, describe_error(error))
        estimates, events = actuator.judge_samples(samples, follows=follows, settings=settings, verdict=verdict)
        rows.add_estimates(name, estimates, actuator.oil_celsius)
        for event in events:
            rows.add_alarm(*event)
        # the hash of the name spreads the checkpoints of the actuators over time
        is_due = (actuator.n_stored + zlib.crc32(name.encode())) % PENDING_BLOCKS == 0
        is_due = is_due or actuator.bytes >= PENDING_BYTES
        if is_due:
            self._checkpoint(actuator, rows)
        else:
            self._add_summary(actuator, rows)
        if not is_due or (recorder is not None and recorder.first):  # the recording that has not ended needs the block
            rows.add_pending(name, StoredSamples(number, samples, follows, verdict))

    def _check_time_unit(self, actuator: _Actuator, samples: Recording) -> None:
        """Count and log samples whose clock runs a thousand, a million or a billion times too fast for their rate.

        The times of a block then count milliseconds, microseconds or nanoseconds, and each block looks like a pause.
        """
        start, stop = actuator.last_times
        if len(samples):
            actuator.last_times = float(samples.t[0]), float(samples.t[0]) + len(samples) / samples.rate
        if not stop > start or not len(samples):
            return
        pace = (float(samples.t[0]) - start) / (stop - start)
        for unit, parts in TIME_UNITS.items():
            if abs(pace / parts - 1.0) < _SAME_PACE:
                step, duration = pace * (stop - start), stop - start
                detail = f"is t in {unit}? It steps by {step:g} where the samples take {duration:g} s"
                self._logged_counts.add(WRONG_PACE, actuator.settings.name, detail=detail)

    def _checkpoint(self, actuator: _Actuator, rows: StoredRows) -> None:
        """Add a checkpoint of an actuator's state to the rows that will be stored, and mark old rows for deletion."""
        settings, recorder = actuator.settings, actuator.recorder
        # the pending samples of a stream's recording that has not ended are kept
        first_kept = recorder.first if recorder is not None and recorder.first else actuator.n_stored + 1
        rows.add_checkpoint(settings.name, settings.watched_with.model_dump_json(), actuator.state(), first_kept)
        self._add_summary(actuator, rows)
        n_kept_estimates = self._keep_s / actuator.watch.block_seconds
        rows.old[tables.blocks][settings.name] = actuator.n_stored - MAX_IDENTITIES
        rows.old[tables.estimates][settings.name] = math.floor(max(0.0, actuator.watch.blocks - n_kept_estimates))
        actuator.bytes = 0

    @staticmethod
    def _add_summary(actuator: _Actuator, rows: StoredRows) -> None:
        """Add the summary of an actuator to the rows that will be stored, if it has changed; log counters that grew."""
        summary = actuator.summary()
        if summary != actuator.stored_summary:
            if actuator.settings.folder is None:  # between files there are always pauses
                counters_before = (actuator.stored_summary or summary)["counters"]
                log_growth(actuator.settings.name, counters_before, summary["counters"])
            actuator.stored_summary = summary
            rows.add_summary(actuator.settings.name, summary)

    def apply_mark(self, name: str, mark: str, *, by_whom: str = "", text: str = "") -> Alarm:
        """Apply the mark that a person gives an actuator's alarm, store it in one transaction, and return the alarm.

        `name`: the actuator; `by_whom`: name of the person; `text`: comment, or reason of ``invalid``; `mark`:

        - ``acknowledged``, ``comment``, or ``valid``, which confirms the leak;
        - ``shelved``: the alarm is not announced for 8 h on the clock of the samples;
        - ``invalid``: the detector withdraws the leak; ``repaired``: it also learns a new healthy baseline.

        A mark ``valid``, ``invalid`` or ``repaired`` is also written to the file of a commissioned machine, and an
        event states the result. Raises InputError if there is no open alarm or an argument is invalid.
        """
        if len(text) > _MAX_COMMENT_LENGTH or len(by_whom) > 80:
            raise InputError(f"a comment must have at most {_MAX_COMMENT_LENGTH} characters, a name 80")
        if "\0" in text + by_whom or any("\ud800" <= letter <= "\udfff" for letter in text + by_whom):
            raise InputError("a comment must be text, got a NUL or half of a surrogate pair")
        with self._lock:
            if name not in self.settings:
                raise InputError(f"the settings have no actuator {name[:60]!r}")
            actuator, rows = self._actuator(name), StoredRows()
            open_alarm = actuator.judge.alarm
            t = 0.0 if open_alarm is None else open_alarm.updated_s  # without an open alarm, the mark is refused below
            if actuator.last is not None:
                t = actuator.last.t
            alarm_samples = list(actuator.alarm_samples)
            alarm = actuator.judge.apply_mark(mark, t, until=t + _SHELVED_S, reason=text)
            try:
                if mark in ("invalid", "repaired"):
                    if actuator.verdict is not None:
                        actuator.verdict = actuator.verdict.neutral_after_mark(mark)
                    if actuator.recorder is not None:
                        actuator.recorder.clear()
                if mark == "invalid":
                    actuator.watch.dismiss()
                elif mark == "repaired":
                    actuator.watch.relearn()
                rows.add_alarm(alarm, mark, t, by_whom, text)
                self._checkpoint(actuator, rows)
                self.store.commit_rows(rows)
            except BaseException:  # the mark is not stored: the next block restores the actuator from the database
                self._actuators.pop(name, None)
                raise
        # outside the lock, as writing the machine's file may take a second
        if outcome := record_mark(self.settings[name].rig, alarm, mark, alarm_samples):
            rows = StoredRows()
            rows.add_alarm(alarm, "comment", t, "Sealscope", outcome)
            del rows.current[tables.alarms]  # the alarm may have changed meanwhile: store the event only
            self.store.commit_rows(rows)
        self._notify_change()
        return alarm

    @property
    def false_alarms_per_1000_h(self) -> float:
        """Limit of the expected number of false alarms in 1000 h in which all actuators run and are healthy."""
        return sum(settings.false_alarms_per_1000_h for settings in self.settings.values())

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Read the last stored summary of each actuator in the settings, by name.

        The state is "no data" if unknown, or if it reports no leak and no block has come for `no_data_s` seconds. An
        actuator without a stored summary is left out.
        """
        stored_summaries, now = self.store.summaries(), time.monotonic()
        summaries = {}
        for name, settings in self.settings.items():
            if name in stored_summaries:
                summary = stored_summaries[name]
                state = summary.get("state")
                is_silent = now - self._last_block_clock[name] > settings.no_data_s
                if state is None or (is_silent and state["condition"] not in LEAKING):
                    state = state_of("no data", since_s=summary["t"]).as_dict()
                summaries[name] = {**summary, "state": state}
        return summaries

    def _notify_change(self) -> None:
        """Increase `change_number`, by which open web pages notice that results, alarms or outages have changed."""
        self.change_number = next(self._changes)
