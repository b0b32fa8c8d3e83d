"""Read the files of a folder as blocks of samples, one for each complete recording, in order of their start times."""

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
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.commissioned.machine import read_by_map
from sealscope.diagnosis.commissioned.watched import load_watched
from sealscope.diagnosis.hold.recorded_holds import date_hold, is_hold_results, read_hold_results
from sealscope.errors import InputError, SealscopeError, escape_text
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import (
    UNREADABLE_FILE,
    BlockReceiver,
    RefusedMessage,
    SourceBlock,
    compute_digest,
    count_bytes,
)
from sealscope.monitor.supervisor import DATABASE, PartAway, SupervisedPart, describe_error
from sealscope.monitor.verdicts import judge_hold_results, judge_recording
from sealscope.recordings import Recording
from sealscope.recordings.corrections.samples import correct_samples, remove_holes
from sealscope.recordings.header import file_seconds, oil_temperature
from sealscope.units import DAY

_log = logging.getLogger(__name__)
#: Endings of the names of files that are still being written.
_UNFINISHED = (".part", ".tmp", ".temp", ".crdownload", "~")
#: How often folders are scanned [s].
_LOOK_S = 0.5
#: An unreadable file is tried again when it has not changed for this many times `settle_s`.
_PATIENCE_FACTOR = 6.0
#: A file dated more than this after the present [s] counts as dated in the future.
_AHEAD_S = 60.0
#: Recordings read to find their order are kept up to this many bytes.
_READ_AHEAD_BYTES = 64_000_000
#: Letters of a file's name in the identity of its block, at most; the database limits the identity to 120.
_MAX_NAME = 60
#: Gap between recordings of one day that state no time of day [s].
_GAP_S = 1.0
#: A recording and "", or None and the reason why its file cannot be read.
_Reading = tuple[Recording | None, str]


class _FoundFile(NamedTuple):
    """A file in a watched folder; `modified_s` [s since 1970]: last change; `identity`: text of name, size and time."""

    modified_s: float
    path: Path
    identity: str


class WatchedFolder:
    """The folder with the recordings of one actuator, read file by file as they arrive.

    `settle_s` [s]: time without a change after which a file is read; `is_stored`: function of actuator and identity
    that returns True if this block is stored; `newest_s` [s since 1970]: time of the newest stored sample.
    """

    def __init__(
        self,
        settings: ActuatorSettings,
        settle_s: float,
        is_stored: Callable[[str, str], bool],
        newest_s: float = -math.inf,
    ) -> None:
        assert settings.folder is not None
        self.actuator, self.folder, self._settings = settings.name, settings.folder, settings
        self.settle_s, self._is_stored = settle_s, is_stored
        self._channel_map = settings.map or load_watched(settings.rig).channel_map
        # start and end of the newest recording [s since 1970]; after a restart both are the last stored sample's time
        self._newest_s = self._end_s = newest_s
        self._first_found: dict[str, float] = {}  # by identity of the file: time at which it was first found [s]
        self._submitted, self._unreadable = set[str](), set[str]()  # identities
        self._outside_links = set[str]()  # names

    def blocks(self) -> Iterator[SourceBlock | RefusedMessage]:
        """Yield the blocks of all files that are complete and not stored yet, in the order of their recording.

        A file is complete when it has not changed for `settle_s`. It is refused if it is older than the newest one
        (`_find_refusal_reason`), or if it cannot be read and has not changed for `_PATIENCE_FACTOR` times as long: the
        reason and a block without samples are then yielded. Raises PartAway if the folder cannot be read.
        """
        files = sorted(self._files())  # by the time of their last change
        self._first_found = {file.identity: self._first_found.get(file.identity, time.monotonic()) for file in files}
        self._submitted &= self._first_found.keys()  # forget the files that are gone
        self._unreadable &= self._first_found.keys()
        due_files = [file for file in files if file.identity not in self._submitted and self._is_due(file)]
        for file, reading in self._sort_by_start(due_files):
            identity = file.identity
            samples, reason = reading or self._read(file.path)
            if reason and self._may_be_incomplete(file):
                self._unreadable.add(identity)  # tried again later
                continue
            if samples is not None:
                reason = self._find_refusal_reason(samples, file)
            if reason:
                yield RefusedMessage(UNREADABLE_FILE, f"{self.actuator}: {reason}")
                samples = None
            block = SourceBlock(self.actuator, identity, None, follows=False)
            if samples is not None and len(samples):
                block = self._judge_block(block, samples, file.path)
            self._submitted.add(identity)
            yield block

    def _unchanged_s(self, file: _FoundFile) -> float:
        """Compute the time [s] since a file changed or since it was first found, whichever is longer."""
        # the time of the change may lie in the future
        return max(time.time() - file.modified_s, time.monotonic() - self._first_found[file.identity])

    def _is_due(self, file: _FoundFile) -> bool:
        """Return True if a file has not changed for `settle_s` and is not stored; mark a stored file as submitted."""
        is_incomplete = file.identity in self._unreadable and self._may_be_incomplete(file)
        if is_incomplete or self._unchanged_s(file) < self.settle_s:
            return False
        if self._is_stored(self.actuator, file.identity):
            self._submitted.add(file.identity)
            return False
        return True

    def _may_be_incomplete(self, file: _FoundFile) -> bool:
        """Return True if an unreadable file may be unfinished: it changed within `_PATIENCE_FACTOR` x `settle_s`."""
        return self._unchanged_s(file) < _PATIENCE_FACTOR * self.settle_s

    def _sort_by_start(self, files: list[_FoundFile]) -> list[tuple[_FoundFile, _Reading | None]]:
        """Sort files by the time of their first sample, or of their last change if they are unreadable.

        They may be copied in another order than recorded. The result has what was read of each file for this, or None
        where it must be read again, as the recordings exceed `_READ_AHEAD_BYTES`.
        """
        if len(files) < 2:  # nothing to sort
            return [(file, None) for file in files]
        rows: list[tuple[float, _FoundFile, _Reading | None]] = []
        n_bytes = 0
        for file in files:
            samples, reason = self._read(file.path)
            size = 0 if samples is None else count_bytes(samples)
            is_kept = n_bytes + size < _READ_AHEAD_BYTES
            n_bytes += size if is_kept else 0
            start = file.modified_s if samples is None else file_seconds(samples, file.path)
            rows.append((start, file, (samples, reason) if is_kept else None))
        rows.sort(key=lambda row: row[0])
        return [(file, reading) for _, file, reading in rows]

    def _read(self, path: Path) -> _Reading:
        """Read a file by the actuator's map of columns; after any error return None and the reason.

        Results of hold tests are read as a single time, that of the last test.
        """
        try:
            if is_hold_results(path):
                dates = [(date_hold(result), result.file) for result in read_hold_results(path)]
                if undated := [file for date, file in dates if date is None]:
                    raise InputError(f"hold tests in order of time must have dates, got none of {undated[0]} ({path})")
                provenance = {"start_epoch_s": max(date or 0.0 for date, _ in dates)}
                return Recording(np.zeros(1), {}, {}, rate=1.0, provenance=provenance), ""
            return read_by_map(path, self._channel_map, self._settings.rate), ""
        except (SealscopeError, OSError, MemoryError) as error:
            return None, escape_text(str(error)) or type(error).__name__
        except Exception as error:
            return None, f"{escape_text(path.name)}: {describe_error(error)}"

    def _find_refusal_reason(self, samples: Recording, file: _FoundFile) -> str:
        """Return the reason to refuse a recording that starts before the newest recording so far, or "" to accept it.

        An earlier recording is accepted if it states only the day of the newest one, by a start at midnight, or if the
        newest one is dated in the future. A new recording that is dated in the future is logged.
        """
        path, now = file.path, time.time()
        start = file_seconds(samples, path)
        if max(start, file.modified_s) > now + _AHEAD_S:
            _log.warning("%s: %s is dated in the future", self.actuator, escape_text(path.name))
        if start >= self._newest_s or self._newest_s > now + _AHEAD_S or _is_midnight_before(start, self._newest_s):
            return ""
        # [:19]: without the time zone
        dates = (datetime.fromtimestamp(t, UTC).isoformat(" ", "seconds")[:19] for t in (start, self._newest_s))
        return "{} must not be older than the recordings before, got {} after {}".format(escape_text(path.name), *dates)

    def _judge_block(self, block: SourceBlock, recording: Recording, path: Path) -> SourceBlock:
        """Add a recording's samples to a block, and the verdict on the recording if its machine is commissioned.

        The samples are corrected for the defects of loggers, and their times converted to seconds since 1970. A
        recording without a time of day begins `_GAP_S` after the previous one of its day. An oil temperature in the
        file's header becomes the channel `T_oil`. Raises PartAway if the file of the machine cannot be read.
        """
        start = file_seconds(recording, path)
        # long gaps, which the correction fills in, become NaN again
        corrected_samples = remove_holes(correct_samples(recording).recording)
        if not len(corrected_samples):
            return replace(block, samples=corrected_samples)
        try:
            watched = load_watched(self._settings.rig)  # read anew, as the file may have changed
        except (SealscopeError, OSError) as error:
            raise PartAway(escape_text(str(error))) from None
        name, limit_lpm = escape_text(path.name), self._settings.error_lpm
        if is_hold_results(path):
            self._newest_s = self._end_s = start
            trend_verdict = judge_hold_results(watched, read_hold_results(path), name, limit_lpm=limit_lpm)
            return replace(block, samples=recording.samples(slice(0, 0)), verdict=trend_verdict)
        if _is_midnight_before(start, self._newest_s):
            start = max(start, self._end_s + _GAP_S)
        finite_t = recording.t[np.isfinite(recording.t)]
        shift = start - float(finite_t[0]) if finite_t.size else 0.0
        times = corrected_samples.t + shift
        verdict = None
        try:
            verdict = judge_recording(watched, recording, name, shift, limit_lpm=limit_lpm)
        except Exception as error:  # the samples are still watched
            reason = describe_error(error)
            _log.warning("%s: %s is not judged as a whole: %s", self.actuator, name, reason)
        self._newest_s, self._end_s = start, float(np.nanmax(times, initial=start))
        channels, units = dict(corrected_samples.channels), dict(corrected_samples.units)
        if "T_oil" not in channels and (celsius := oil_temperature(corrected_samples)) is not None:
            channels["T_oil"], units["T_oil"] = np.full(len(corrected_samples), celsius + 273.15), "K"
        return replace(block, samples=Recording(times, channels, units, corrected_samples.rate), verdict=verdict)

    def _files(self) -> Iterator[_FoundFile]:
        """Yield the files that match the pattern, except hidden or unfinished ones, and links out of the folder.

        Raises PartAway if the folder cannot be read.
        """
        try:
            root = self.folder.resolve()
            entries = list(self.folder.iterdir())
        except OSError as error:
            raise PartAway(f"{self.folder}: {error.strerror}") from None
        for path in entries:
            is_unfinished = path.name.startswith(".") or path.name.endswith(_UNFINISHED)
            if is_unfinished or not fnmatch(path.name, self._settings.pattern):
                continue
            try:
                if path.is_symlink() and not path.resolve().is_relative_to(root):
                    if path.name not in self._outside_links:  # logged once: files outside the folder are not read
                        _log.warning("%s: %s is a link out of the folder", self.actuator, escape_text(path.name))
                    self._outside_links.add(path.name)
                    continue
                status = path.stat()
            except (OSError, RuntimeError):  # deleted meanwhile, or a loop of links
                continue
            if S_ISREG(status.st_mode):
                identity = f"{_shorten_name(path.name)} {status.st_size} {status.st_mtime_ns}"
                yield _FoundFile(status.st_mtime, path, identity)


def watch_folders(service: BlockReceiver, *, once: bool) -> None:
    """Submit new files of the actuators' folders as blocks until the service stops.

    `once`: True to submit only the files that are found now, and then return.
    """
    settle_s = 0.0 if once else service.settings.settle_s
    part, summaries = service.supervisor.part, service.summaries()
    folders: dict[SupervisedPart, WatchedFolder] = {}
    for actuator in service.settings.actuator:
        if actuator.folder is not None:
            folder_part = part(f"folder of {actuator.name}")
            t = summaries.get(actuator.name, {}).get("t")  # of the newest stored sample [s since 1970], or None
            newest_s = -math.inf if t is None else float(t)
            folders[folder_part] = WatchedFolder(actuator, settle_s, service.store.is_known, newest_s)

    def submit_blocks(folder: WatchedFolder) -> None:
        for block in folder.blocks():
            if service.stopping.is_set():
                return
            service.submit(block)

    while not service.stopping.is_set():
        succeeded = [folder_part.attempt(partial(submit_blocks, folder)) for folder_part, folder in folders.items()]
        # with `once`, folders are read again only if they failed in an outage of the database
        if once and (all(succeeded) or part(DATABASE).since is None):
            return
        service.stopping.wait(_LOOK_S)


def _shorten_name(name: str) -> str:
    """Escape a file's name, and replace the end of a long one by its hash: other names may differ only there."""
    text = escape_text(name)
    return text if len(text) <= _MAX_NAME else f"{text[:28]}{compute_digest(text.encode())}"


def _is_midnight_before(start: float, t: float) -> bool:
    """Return True if `start`, as of a recording without a time of day, is the midnight (UTC) of the day of `t`."""
    return start % DAY == 0.0 and start <= t < start + DAY
