"""Blocks from the files of a folder: each whole recording that appears there, in the order of their times."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from stat import S_ISREG

import numpy as np

from sealscope.diagnosis.commissioned.machine import CommissionedMachine, read_of_machine
from sealscope.diagnosis.commissioned.watched import load_watched
from sealscope.errors import SealscopeError
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import (
    UNREADABLE_FILE,
    BlockReceiver,
    RefusedMessage,
    SourceBlock,
    bytes_of,
)
from sealscope.monitor.supervisor import DATABASE, PartAway, place_of
from sealscope.monitor.verdicts import RecordingVerdict, judge_recording
from sealscope.recordings import Recording
from sealscope.recordings.corrections.samples import correct_samples, without_holes
from sealscope.recordings.joining import file_seconds
from sealscope.recordings.oil import oil_temperature
from sealscope.units import DAY

_log = logging.getLogger(__name__)
#: Names of files that are still being written.
_UNFINISHED = (".part", ".tmp", ".temp", ".crdownload", "~")
#: How often folders are looked at [s].
_LOOK_S = 0.5
#: A file that cannot be read is tried once more when it has not changed for so many times the time to settle.
_PATIENCE = 6.0
#: A file that is dated so much later than now [s] is dated in the future.
_AHEAD_S = 60.0
#: Files that are read to be put in order are kept up to so many bytes.
_AHEAD_BYTES = 64_000_000
#: How far recordings of a day without times of day are placed apart [s].
_APART_S = 1.0


class WatchedFolder:
    """The recordings of one actuator in its folder.

    `settle_s`: a file is read when its size and time have not changed for so long [s]; `known`: whether a block with an
    identity is stored already; `newest_s`: clock of the newest sample that is stored [s since 1970].
    """

    def __init__(
        self,
        settings: ActuatorSettings,
        settle_s: float,
        known: Callable[[str, str], bool],
        newest_s: float = -math.inf,
    ) -> None:
        assert settings.folder is not None
        self.actuator, self.folder, self.pattern = settings.name, settings.folder, settings.pattern
        self.settle_s, self._known = settle_s, known
        watched = load_watched(settings.rig)
        self._rig, self._channel_map, self._rate = settings.rig, settings.map or watched.channel_map, settings.rate
        # the machine's limit stays in its words: a creep is compared with a creep
        self._limit_lpm = None if settings.error_lpm == watched.limit_lpm else settings.error_lpm
        self._newest_s = self._end_s = newest_s
        self._met: dict[str, float] = {}  # clock at which a file was met [s]
        self._starts: dict[str, float] = {}  # when the first sample of a file was taken [s since 1970]
        self._ahead: dict[str, tuple[Recording | None, str]] = {}  # what files hold that are handed over next
        self._handed, self._tried, self._outside = set[str](), set[str](), set[str]()

    def blocks(self) -> Iterator[SourceBlock | RefusedMessage]:
        """Yield the blocks of the files that are whole and not stored yet, in the order of their recordings.

        One that cannot be read is tried once more when it has not changed for long, then refused: it is stored as a
        block without samples, and never read again. So is one that is older than what was watched. Raises PartAway
        where the folder cannot be read.
        """
        files = sorted(self._files())
        self._met = {identity: self._met.get(identity, time.monotonic()) for _, _, identity in files}
        self._handed &= self._met.keys()
        self._tried &= self._met.keys()
        self._ahead.clear()
        self._starts = {identity: start for identity, start in self._starts.items() if identity in self._met}
        whole = [file for file in files if file[2] not in self._handed and self._is_whole(*file)]
        if len(whole) > 1:  # one that was copied last may have been recorded first
            whole.sort(key=lambda entry: self._start_of(*entry))
        for written, path, identity in whole:
            samples, reason = self._ahead.pop(identity) if identity in self._ahead else self._read(path)
            if reason and self._is_patient(written, identity):
                self._tried.add(identity)
                continue
            if not reason:
                reason = self._refusal(samples, path, written)
            if reason:
                yield RefusedMessage(UNREADABLE_FILE, f"{self.actuator}: {reason}")
                samples = None
            block = SourceBlock(self.actuator, identity, None, follows=False)
            if samples is not None and len(samples):
                block = self._judged_block(block, samples, path)
            self._handed.add(identity)
            yield block

    def _is_whole(self, written: float, path: Path, identity: str) -> bool:
        """Test whether a file has settled, is not stored, and is due for another attempt."""
        # of a file that is dated in the future, how long it was not seen to change
        age = max(time.time() - written, time.monotonic() - self._met[identity])
        if age < self.settle_s or (identity in self._tried and self._is_patient(written, identity)):
            return False
        if self._known(self.actuator, identity):
            self._handed.add(identity)
            return False
        return True

    def _is_patient(self, written: float, identity: str) -> bool:
        """Test whether an unreadable file may be complete later."""
        age = max(time.time() - written, time.monotonic() - self._met[identity])
        return age < _PATIENCE * self.settle_s

    def _start_of(self, written: float, path: Path, identity: str) -> float:
        """Return when the first sample of a file was taken [s since 1970]; of one that cannot be read its change."""
        if identity not in self._starts:
            samples, reason = self._read(path)
            kept = sum(bytes_of(recording) for recording, _ in self._ahead.values() if recording is not None)
            if samples is None or kept + bytes_of(samples) < _AHEAD_BYTES:  # others are read once more
                self._ahead[identity] = samples, reason
            if reason:
                return written
            self._starts[identity] = written if samples is None else file_seconds(samples, path)
        return self._starts[identity]

    def _read(self, path: Path) -> tuple[Recording | None, str]:
        """Read a file; without a recording the reason, and a line in the log where it was not foreseen."""
        try:
            return read_of_machine(path, self._channel_map, self._rate), ""
        except (SealscopeError, OSError, MemoryError) as error:
            return None, _printable(str(error)) or type(error).__name__
        except Exception as error:
            return None, f"{_printable(path.name)}: {place_of(error)}"

    def _refusal(self, samples: Recording | None, path: Path, written: float) -> str:
        """Return the reason not to watch a recording, "" if none: one before the newest watched is too late."""
        if samples is None:
            return ""
        start, now = file_seconds(samples, path), time.time()
        if max(start, written) > now + _AHEAD_S:
            _log.warning("%s: %s is dated in the future", self.actuator, _printable(path.name))
        if start >= self._newest_s or self._newest_s > now + _AHEAD_S or _is_day(start, self._newest_s):
            return ""
        dates = (datetime.fromtimestamp(clock, UTC).isoformat(" ", "seconds")[:19] for clock in (start, self._newest_s))
        return "{} must not be older than what was watched, got {} after {}".format(_printable(path.name), *dates)

    def _judged_block(self, block: SourceBlock, recording: Recording, path: Path) -> SourceBlock:
        """Add to a block its recording's samples, and the verdict on them where its machine has healthy recordings.

        Samples are at the times at which they were taken [s since 1970]; those of a day without a time of day follow
        those of the day that were watched. They are corrected as for `diagnose`. The oil's temperature that the file
        states beside its samples becomes a channel. Raises PartAway where the machine's file cannot be read.
        """
        start, corrected = file_seconds(recording, path), without_holes(correct_samples(recording).recording)
        if not len(corrected):
            return replace(block, samples=corrected)
        machine = self._read_machine()
        if _is_day(start, self._newest_s):
            start = max(start, self._end_s + _APART_S)
        known = recording.t[np.isfinite(recording.t)]
        shift = start - float(known[0]) if known.size else 0.0
        times = corrected.t + shift
        verdict = None if machine is None else self._judge(machine, recording, path, shift)
        self._newest_s, self._end_s = start, float(np.nanmax(times, initial=start))
        channels, units = dict(corrected.channels), dict(corrected.units)
        if "T_oil" not in channels and (celsius := oil_temperature(corrected)) is not None:
            channels["T_oil"], units["T_oil"] = np.full(len(corrected), celsius + 273.15), "K"
        return replace(block, samples=Recording(times, channels, units, corrected.rate), verdict=verdict)

    def _judge(
        self, machine: CommissionedMachine, recording: Recording, path: Path, shift: float
    ) -> RecordingVerdict | None:
        """Judge a recording; None, and a line in the log, where that raises an error: its blocks are watched then."""
        try:
            return judge_recording(machine, recording, _printable(path.name), shift, limit_lpm=self._limit_lpm)
        except Exception as error:
            _log.warning("%s: %s is not judged as a whole: %s", self.actuator, _printable(path.name), place_of(error))
            return None

    def _read_machine(self) -> CommissionedMachine | None:
        """Read the machine anew, for a mark or an engineer may have changed its file meanwhile."""
        try:
            return load_watched(self._rig).machine
        except (SealscopeError, OSError) as error:
            raise PartAway(_printable(str(error))) from None

    def _files(self) -> Iterator[tuple[float, Path, str]]:
        try:
            root = self.folder.resolve()
            entries = list(self.folder.iterdir())
        except OSError as error:
            raise PartAway(f"{self.folder}: {error.strerror}") from None
        for path in entries:
            if path.name.startswith(".") or path.name.endswith(_UNFINISHED) or not fnmatch(path.name, self.pattern):
                continue
            try:
                if path.is_symlink() and not path.resolve().is_relative_to(root):
                    if path.name not in self._outside:  # said once: what is there is nobody's recording
                        _log.warning("%s: %s is a link out of the folder", self.actuator, _printable(path.name))
                    self._outside.add(path.name)
                    continue
                status = path.stat()
            except (OSError, RuntimeError):  # gone meanwhile, or links in a circle
                continue
            if S_ISREG(status.st_mode):
                yield status.st_mtime, path, f"{_printable(path.name[:60])} {status.st_size} {status.st_mtime_ns}"


def folders_of(service: BlockReceiver, *, once: bool) -> None:
    """Hand over new files in the folders of a service's actuators; `once`: only the present ones."""
    settle_s, part = 0.0 if once else service.settings.settle_s, service.supervisor.part
    shown = service.plain()

    def newest(name: str) -> float:
        clock = shown.get(name, {}).get("t")
        return -math.inf if clock is None else float(clock)

    folders = {
        part(f"folder of {actuator.name}"): WatchedFolder(
            actuator, settle_s, service.store.is_known, newest(actuator.name)
        )
        for actuator in service.settings.actuator
        if actuator.folder is not None
    }

    def hand_over(folder: WatchedFolder) -> None:
        for block in folder.blocks():
            if service.stopping.is_set():
                return
            service.hand(block)

    while not service.stopping.is_set():
        done = [watcher.attempt(partial(hand_over, folder)) for watcher, folder in folders.items()]
        if once and (all(done) or part(DATABASE).since is None):
            return
        service.stopping.wait(_LOOK_S)


def _printable(name: str) -> str:
    """Escape the unprintable signs of a name, for a log and a database."""
    return "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in name)


def _is_day(start: float, newest: float) -> bool:
    """Test whether a start [s since 1970] is a mere date, on the day of the newest watched recording."""
    return start % DAY == 0.0 and start <= newest < start + DAY
