"""Blocks from the files of a folder: each whole recording that appears there, in the order of their times."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from stat import S_ISREG

import numpy as np

from sealscope.errors import SealscopeError
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.source_block import UNREADABLE_FILE, BlockReceiver, RefusedMessage, SourceBlock
from sealscope.monitor.supervisor import DATABASE, PartAway, place_of
from sealscope.parameters import load_rig
from sealscope.recordings import Recording, read
from sealscope.recordings.corrections.samples import correct_samples, without_holes
from sealscope.recordings.oil import oil_temperature

_log = logging.getLogger(__name__)
#: Names of files that are still being written.
_UNFINISHED = (".part", ".tmp", ".temp", ".crdownload", "~")
#: How often folders are looked at [s].
_LOOK_S = 0.5
#: A file that cannot be read is tried once more when it has not changed for so many times the time to settle.
_PATIENCE = 6.0
#: A file that is dated so much later than now [s] is dated in the future.
_AHEAD_S = 60.0


class WatchedFolder:
    """The recordings of one actuator in its folder.

    `settle_s`: a file is read when its size and time have not changed for so long [s]; `known`: whether a block with an
    identity is stored already.
    """

    def __init__(self, settings: ActuatorSettings, settle_s: float, known: Callable[[str, str], bool]) -> None:
        assert settings.folder is not None
        self.actuator, self.folder, self.pattern = settings.name, settings.folder, settings.pattern
        self.settle_s, self._known = settle_s, known
        self._channel_map = settings.map or load_rig(settings.rig).channel_map or None
        self._met: dict[str, float] = {}  # clock at which a file was met [s]
        self._handed, self._tried, self._outside = set[str](), set[str](), set[str]()

    def blocks(self) -> Iterator[SourceBlock | RefusedMessage]:
        """Yield the blocks of the files that are whole and not stored yet.

        A file's samples get the clock at which it was written last. One that cannot be read is tried once more when it
        has not changed for long, then refused: it is stored as a block without samples, and never read again. Raises
        PartAway where the folder cannot be read.
        """
        files = sorted(self._files())
        self._met = {identity: self._met.get(identity, time.monotonic()) for _, _, identity in files}
        self._handed &= self._met.keys()
        self._tried &= self._met.keys()
        for at, path, identity in files:
            # of a file that is dated in the future, how long it was not seen to change
            age = max(time.time() - at, time.monotonic() - self._met[identity])
            patient = age < _PATIENCE * self.settle_s
            if identity in self._handed or age < self.settle_s or (patient and identity in self._tried):
                continue
            if self._known(self.actuator, identity):
                self._handed.add(identity)
                continue
            try:
                samples = _on_the_clock(read(path, map=self._channel_map), at)
            except Exception as error:
                reason = f"{_shown(path.name)}: {place_of(error)}"
                if isinstance(error, (SealscopeError, OSError, MemoryError)):  # what is foreseen may be better later
                    self._tried.add(identity)
                    if patient:
                        continue
                    reason = _shown(str(error)) or type(error).__name__
                yield RefusedMessage(UNREADABLE_FILE, f"{self.actuator}: {reason}")
                samples = None
            if samples is not None and at > time.time() + _AHEAD_S:
                _log.warning("%s: %s is dated in the future", self.actuator, _shown(path.name))
            self._handed.add(identity)
            yield SourceBlock(self.actuator, identity, samples, follows=False)

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
                        _log.warning("%s: %s is a link out of the folder", self.actuator, _shown(path.name))
                    self._outside.add(path.name)
                    continue
                status = path.stat()
            except (OSError, RuntimeError):  # gone meanwhile, or links in a circle
                continue
            if S_ISREG(status.st_mode):
                yield status.st_mtime, path, f"{_shown(path.name[:60])} {status.st_size} {status.st_mtime_ns}"


def folders_of(service: BlockReceiver, *, once: bool) -> None:
    """Hand over what appears in the folders of a service's actuators; `once`: what is there now."""
    settle_s, part = 0.0 if once else service.settings.settle_s, service.supervisor.part
    folders = {
        part(f"folder of {each.name}"): WatchedFolder(each, settle_s, service.store.is_known)
        for each in service.settings.actuator
        if each.folder is not None
    }

    def hand_over(folder: WatchedFolder) -> None:
        for block in folder.blocks():
            if service.stopping.is_set():
                return
            service.hand(block)

    while not service.stopping.is_set():
        done = [own.attempt(partial(hand_over, folder)) for own, folder in folders.items()]
        if once and (all(done) or part(DATABASE).since is None):
            return
        service.stopping.wait(_LOOK_S)


def _shown(name: str) -> str:
    """Return a name as text that a log and a database can hold, whatever its bytes are."""
    return "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in name)


def _on_the_clock(recording: Recording, written: float) -> Recording:
    """Return a recording whose last sample was taken at the clock `written` [s].

    Its samples are corrected as for `diagnose`. The oil's temperature that the file states beside them becomes a
    channel.
    """
    recording = without_holes(correct_samples(recording).recording)
    last = recording.t[np.isfinite(recording.t)]
    shift = written - float(last[-1]) if last.size else 0.0
    channels, units = dict(recording.channels), dict(recording.units)
    if "T_oil" not in channels and (celsius := oil_temperature(recording)) is not None:
        channels["T_oil"], units["T_oil"] = np.full(len(recording), celsius + 273.15), "K"
    return Recording(recording.t + shift, channels, units, recording.rate)
