"""Create, list and lock folders of results; links that lead out of them are refused."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sealscope.errors import InputError, printable
from sealscope.storage.atomic import copy_access
from sealscope.storage.opening import open_inner

_log = logging.getLogger(__name__)


def make_folder(folder: Path) -> None:
    """Create a folder and its parents if they do not exist; raise InputError if it cannot be created."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create folder: {error.strerror} ({folder})") from None


def make_inner_folder(folder: Path, *names: str) -> Path:
    """Create the nested folders `names` within `folder`; return the innermost, or raise InputError for a link."""
    make_folder(folder)
    for name in names:
        folder /= name
        if folder.is_symlink():
            raise InputError(f"a folder of results must not be a link, got one ({folder})")
        make_folder(folder)
    return folder


def iter_inner_files(folder: Path, paths: Iterable[Path]) -> Iterator[Path]:
    """Yield those of `paths` that are files in `folder`, which may itself be a link; log and skip links out of it."""
    root = folder.resolve()
    for path in paths:
        try:
            is_file, is_inside = path.is_file(), path.resolve().is_relative_to(root)
        except (OSError, RuntimeError):  # removed meanwhile, or circular links
            continue
        if is_file and not is_inside:
            _log.warning("%s", printable(f"a link that leads out of its folder is left out ({path})"))
        elif is_file:
            yield path


def numeric_sort_key(name: str) -> list[str | int]:
    """Build a sorting key that puts "day_2" before "day_10": the texts and whole numbers in `name`, which alternate."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


@contextmanager
def lock_file(file: Path, busy: str | None, wait: float = 0.0, like: Path | None = None) -> Iterator[None]:
    """Hold the lock `file` against other processes while the block runs; the lock also ends with the process.

    If another process still holds it after `wait` [s], InputError with the message `busy` is raised; if `busy` is None,
    the wait has no limit. The file is created if necessary, and never emptied. It gets the owner and the permissions of
    the file `like`, if that exists, so that whoever may write that file can lock it. Raises InputError for a link.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(file, timeout=-1 if busy is None else wait)  # -1: no limit
    try:
        open_inner(file, "a lock", mode="ab+").close()  # creates the file, or raises an error if it is a link
        if like is not None and like.exists():
            with suppress(PermissionError):  # a lock of somebody else, which can be used nevertheless
                copy_access(like, file)
        lock.acquire(poll_interval=0.01)
    except Timeout:
        raise InputError(str(busy)) from None
    except (OSError, NotImplementedError) as error:
        raise InputError(f"cannot lock {file}: {getattr(error, 'strerror', None) or error}") from None
    try:
        yield
    finally:
        lock.release()
