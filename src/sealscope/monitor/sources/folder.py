"""Blocks from the files of a folder: each whole recording that appears there, in the order of their times."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from sealscope.errors import InputError
from sealscope.monitor.sources.source_block import SourceBlock
from sealscope.recordings import Recording, read
from sealscope.recordings.formats.columns import ChannelMap
from sealscope.recordings.formats.headings.oil_temperature import stated_oil_temperature

_log = logging.getLogger(__name__)
#: Names of files that are still being written.
_UNFINISHED = (".part", ".tmp", ".temp", ".crdownload", "~")
#: A file that cannot be read is tried again until it has not changed for so many times the time to settle.
_PATIENCE = 6.0


class WatchedFolder:
    """The recordings of one actuator in a folder.

    Parameters
    ----------
    actuator : str
    folder : Path
    pattern : str
        Names of the files, such as ``*.csv``.
    settle_s : float
        A file is read when its size and time have not changed for so long [s].
    known : callable
        Whether a block with an identity is stored already.
    channel_map : mapping, optional
        Channel -> column, as for `read`.
    """

    def __init__(
        self,
        actuator: str,
        folder: Path,
        pattern: str,
        settle_s: float,
        known: Callable[[str, str], bool],
        channel_map: ChannelMap | None = None,
    ) -> None:
        self.actuator, self.folder, self.pattern, self.settle_s = actuator, folder, pattern, settle_s
        self._known, self._channel_map = known, channel_map
        self._handed: set[str] = set()

    def blocks(self) -> Iterator[SourceBlock]:
        """Yield the blocks of the files that are whole and not stored yet.

        A file's samples get the clock at which it was written last. A file that cannot be read is waited for, and given
        up with a line in the log when it has not changed for long.
        """
        now = time.time()
        for at, path, identity in sorted(self._files()):
            age = now - at
            if identity in self._handed or age < self.settle_s:
                continue
            if self._known(self.actuator, identity):
                self._handed.add(identity)
                continue
            samples = None
            try:
                samples = _on_the_clock(read(path, map=self._channel_map), at)
            except InputError as error:
                if age < _PATIENCE * self.settle_s:
                    continue
                _log.warning("%s: %s", self.actuator, error)
            self._handed.add(identity)
            yield SourceBlock(self.actuator, identity, samples, follows=False)

    def _files(self) -> Iterator[tuple[float, Path, str]]:
        try:
            entries = list(self.folder.iterdir())
        except OSError as error:
            _log.warning("%s: cannot read the folder %s: %s", self.actuator, self.folder, error.strerror)
            return
        for path in entries:
            if path.name.startswith(".") or path.name.endswith(_UNFINISHED) or not fnmatch(path.name, self.pattern):
                continue
            try:
                status = path.stat()
            except OSError:  # gone meanwhile
                continue
            if path.is_file():
                yield status.st_mtime, path, f"{path.name[:60]} {status.st_size} {status.st_mtime_ns}"


def _on_the_clock(recording: Recording, written: float) -> Recording:
    """Return a recording whose last sample was taken at the clock `written` [s].

    The oil's temperature that the file states beside its samples becomes a channel.
    """
    last = recording.t[np.isfinite(recording.t)]
    shift = written - float(last[-1]) if last.size else 0.0
    channels, units, celsius = (
        dict(recording.channels),
        dict(recording.units),
        stated_oil_temperature(recording.provenance),
    )
    if "T_oil" not in channels and celsius is not None:
        channels["T_oil"], units["T_oil"] = np.full(len(recording), celsius + 273.15), "K"
    return Recording(recording.t + shift, channels, units, recording.rate)
