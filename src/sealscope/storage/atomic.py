"""Write files atomically: at any time a file has either its old or its new content, complete."""

from __future__ import annotations

import logging
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
from sealscope.storage.opening import find_wrong_kind

_log = logging.getLogger(__name__)
#: Bytes to which the file's name is cut in the name of its temporary file, as file systems limit names to 255 bytes.
_MAX_NAME = 60
#: Name of a temporary file: .TARGET.COMPUTER-PROCESS.RANDOM.part.
_TEMPORARY = re.compile(
    r"\.(?P<target>.{1,60})\.(?P<computer>[0-9a-f]{6})-(?P<process>\d{1,9})\.[a-z0-9_]{8}\.part", re.DOTALL
)
#: Age [s] from which a temporary file is removed even if the process that fills it may still run.
_MAX_AGE = 86_400.0


def _computer_hash() -> str:
    """Compute 6 hexadecimal digits that identify this computer in names of temporary files: a hash of its name."""
    return sha256(platform.node().encode()).hexdigest()[:6]


def _cut_name(name: str) -> str:
    """Cut a file's name to `_MAX_NAME` bytes, without the rest of a letter that is cut apart."""
    return os.fsencode(name)[:_MAX_NAME].decode("utf-8", "ignore")


def check_folder(file: Path) -> None:
    """Check that the folder of a file to write exists; raise InputError otherwise."""
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")


@contextmanager
def atomic_write(path: str | os.PathLike[str], like: Path | None = None) -> Iterator[Path]:
    """Write a file atomically: the `with` block fills a temporary file, which then replaces the file `path`.

    The block gets the path of the temporary file, which is in the same folder and is removed after an error. File and
    folder are synced to the disk: a power loss leaves either the old or the new file. Owner, group and permissions are
    those of the file `like`, if it exists, else of the replaced file. Raises InputError if `path` cannot be written,
    and for any OSError in the block.
    """
    target = Path(path)
    try:
        check_folder(target)
        if target.exists() and (kind := find_wrong_kind(target.stat().st_mode)) is not None:
            raise InputError(f"a file to write must not be {kind}, got {target}")
        # the name tells `remove_temporaries` which process of which computer fills the file
        prefix = f".{_cut_name(target.name)}.{_computer_hash()}-{os.getpid()}."
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=".part", dir=target.parent)
        os.close(handle)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    temporary = Path(name)
    try:
        yield temporary
        _sync(temporary, os.O_RDWR)  # Windows syncs only what is open for writing
        present = next((file for file in (like, target) if file is not None and file.exists()), None)
        if present is None:
            mask = os.umask(0)  # the mask can be read only by setting it
            os.umask(mask)
            temporary.chmod(0o666 & ~mask)
        else:
            copy_access(present, temporary, name=target)
        temporary.replace(target)
        with suppress(OSError):  # Windows cannot open folders, and some file systems cannot sync them
            _sync(target.parent, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def copy_access(source: Path, file: Path, name: Path | None = None) -> None:
    """Give a file the owner, the group and the permissions of the file `source`.

    Only the administrator may give a file to another user: a process of somebody else changes the group, if it may, and
    logs that the file has another owner than before, under the `name` that the file will have. Raises OSError if the
    permissions cannot be changed.
    """
    status, present = source.stat(), file.stat()
    if hasattr(os, "chown"):
        for user, group in ((status.st_uid, status.st_gid), (-1, status.st_gid)):
            if (present.st_uid, present.st_gid) == (status.st_uid, status.st_gid):
                break
            with suppress(PermissionError):
                os.chown(file, user, group)
                present = file.stat()
        if present.st_uid != status.st_uid:
            _log.warning("%s now belongs to user %d, no more to %d", name or file, present.st_uid, status.st_uid)
    if present.st_mode & 0o777 != status.st_mode & 0o777:
        file.chmod(status.st_mode & 0o777)


def _sync(path: Path, flags: int) -> None:
    """Write a file or folder, opened with the `flags` of `os.open`, from the system's buffers to the disk."""
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove_temporaries(folder: Path, target: str | None = None) -> None:
    """Remove the temporary files that killed processes have left in a folder.

    `target`: name of the file whose temporary files are removed; None for those of all files, also in subfolders except
    linked ones. A temporary file is removed if its process ran on this computer and has ended, or if the file has not
    been changed for a day.
    """
    paths = folder.rglob(".*.part") if target is None else folder.glob(".*.part")
    for path in paths:
        match = _TEMPORARY.fullmatch(path.name)  # has the target's name, cut by `_cut_name`
        if match is None or (target is not None and match["target"] != _cut_name(target)):
            continue
        with suppress(OSError):
            is_abandoned = match["computer"] == _computer_hash() and not _is_alive(int(match["process"]))
            if is_abandoned or path.lstat().st_mtime < time.time() - _MAX_AGE:
                path.unlink()


def _is_alive(process: int) -> bool:
    """Return True if the process with this number runs on this computer, or if this cannot be found out."""
    if os.name == "nt":  # signal 0 would end the process
        return True
    try:
        os.kill(process, 0)  # sends nothing, but fails if there is no such process
    except ProcessLookupError:
        return False
    except OSError:  # for example a process of another user
        return True
    return True
