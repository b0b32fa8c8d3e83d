"""Write files whole or not at all."""

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

#: Names of temporary files: that of the target, the machine and the process that wrote, a random word.
_TEMPORARY = re.compile(r"\.(.{1,60})\.([0-9a-f]{6})-(\d{1,9})\.[a-z0-9_]{8}\.part", re.DOTALL)
#: Age [s] from which a temporary file of another machine's process is given up.
_GIVEN_UP = 86_400.0


def _machine() -> str:
    return sha256(platform.node().encode()).hexdigest()[:6]


def check_folder(file: Path) -> None:
    """Raise InputError where the folder of a file to write is not there."""
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary file in the folder of `path`: renamed to `path` when the block ends well, else removed.

    The file is on the disk before it is renamed, and its new name when the block has ended: a loss of power leaves the
    old file or the new one. A file that is replaced keeps its mode. Raises InputError where the folder does not exist
    or cannot be written.
    """
    target = Path(path)
    try:
        check_folder(target)
        if target.is_dir():
            raise InputError(f"a file to write must not be a folder, got {target}")
        handle, name = tempfile.mkstemp(
            prefix=f".{target.name[:60]}.{_machine()}-{os.getpid()}.", suffix=".part", dir=target.parent
        )
        os.close(handle)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    temporary = Path(name)
    try:
        yield temporary
        _sync(temporary, os.O_RDWR)
        temporary.chmod(_mode_of(target))
        temporary.replace(target)
        with suppress(OSError):  # Windows opens no folder, and some file systems sync none
            _sync(target.parent, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _mode_of(target: Path) -> int:
    """Return the mode of the file, or else the mode of any new file of this user."""
    with suppress(FileNotFoundError):
        return target.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


def _sync(path: Path, flags: int) -> None:
    """Have the system write a file, or the names in a folder, to the disk."""
    number = os.open(path, flags)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def remove_temporaries(folder: Path, target: str | None = None) -> None:
    """Remove the temporary files of killed processes in `folder`, those of the file `target` or of all.

    A process of this machine that is gone has left its files for good; those of another machine are given up after a
    day. Links to folders are not resolved.
    """
    for path in folder.glob(".*.part") if target is not None else folder.rglob(".*.part"):
        name = _TEMPORARY.fullmatch(path.name)
        if name is None or (target is not None and name[1] != target[:60]):
            continue
        with suppress(OSError):
            gone = name[2] == _machine() and not _is_alive(int(name[3]))
            if gone or path.lstat().st_mtime < time.time() - _GIVEN_UP:
                path.unlink()


def _is_alive(process: int) -> bool:
    if os.name == "nt":  # where signal 0 would end the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
