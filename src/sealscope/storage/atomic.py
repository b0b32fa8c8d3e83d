"""Write files atomically: at any time a file has either its old or its new content, complete."""

from __future__ import annotations

import os
import platform
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path

from sealscope.errors import InputError

#: Name of a temporary file: .TARGET.MACHINE-PROCESS.RANDOM.part.
_TEMPORARY = re.compile(r"\.(.{1,60})\.([0-9a-f]{6})-(\d{1,9})\.[a-z0-9_]{8}\.part", re.DOTALL)
#: Age [s] from which a temporary file of another machine is removed.
_MAX_AGE = 86_400.0


def _machine_hash() -> str:
    """Return the first 6 hexadecimal digits of the SHA-256 of this computer's name."""
    return sha256(platform.node().encode()).hexdigest()[:6]


def check_folder(file: Path) -> None:
    """Check that the folder of a file to write exists; raise InputError otherwise."""
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file atomically: the `with` block fills a temporary file, which then replaces the file `path`.

    The path of the temporary file is yielded. This file is in the folder of `path`, and is removed if the block raises
    an error. File and folder are synced to the disk: a power loss leaves either the old or the new file. A replaced
    file keeps its permissions. Raises InputError if the folder does not exist or cannot be written.
    """
    target = Path(path)
    try:
        check_folder(target)
        if target.is_dir():
            raise InputError(f"a file to write must not be a folder, got {target}")
        handle, name = tempfile.mkstemp(
            prefix=f".{target.name[:60]}.{_machine_hash()}-{os.getpid()}.", suffix=".part", dir=target.parent
        )
        os.close(handle)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    temporary = Path(name)
    try:
        yield temporary
        _sync(temporary, os.O_RDWR)
        temporary.chmod(_file_mode(target))
        temporary.replace(target)
        with suppress(OSError):  # Windows cannot open folders, and some file systems cannot sync them
            _sync(target.parent, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _file_mode(target: Path) -> int:
    """Return the permission bits of the file `target`; if it does not exist, those that umask gives a new file."""
    with suppress(FileNotFoundError):
        return target.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


def _sync(path: Path, flags: int) -> None:
    """Write what the system holds in memory of a file's content, or of a folder's list of files, to the disk.

    `path`: the file or folder; `flags`: flags for `os.open`, with which it is opened.
    """
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_temporaries(folder: Path, target: str | None = None) -> None:
    """Remove the temporary files that killed processes have left in a folder.

    If `target` is given, only the temporary files of the file with this name are removed. Otherwise those of all
    files are removed, in subfolders, too. A file is removed if its process ran on this computer and has ended, or if
    it was last changed more than a day ago. Links to folders are not followed.
    """
    for path in folder.glob(".*.part") if target is not None else folder.rglob(".*.part"):
        match = _TEMPORARY.fullmatch(path.name)
        if match is None or (target is not None and match[1] != target[:60]):
            continue
        with suppress(OSError):
            is_abandoned = match[2] == _machine_hash() and not _is_alive(int(match[3]))
            if is_abandoned or path.lstat().st_mtime < time.time() - _MAX_AGE:
                path.unlink()


def _is_alive(process: int) -> bool:
    """Return True if a process of this computer is running, or if this cannot be found out.

    `process`: number of the process.
    """
    if os.name == "nt":  # signal 0 would end the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
