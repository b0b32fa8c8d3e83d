"""Folders of results: made, entered and held by one process; links out of them are refused."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from sealscope.errors import InputError, printable
from sealscope.storage.opening import open_inner

_log = logging.getLogger(__name__)


def make_folder(folder: Path) -> None:
    """Create a folder with its parents where there is none; raise InputError where it cannot be created."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create folder: {error.strerror} ({folder})") from None


def inner_folder(folder: Path, *names: str) -> Path:
    """Create the folders `names`, each in the one before it, within `folder`, which may come from outside.

    Returns the last of them. Raises InputError where one cannot be created, or is a link to a folder elsewhere.
    """
    make_folder(folder)
    for name in names:
        folder /= name
        if folder.is_symlink():
            raise InputError(f"a folder of results must not be a link, got one ({folder})")
        make_folder(folder)
    return folder


def inner_files(folder: Path, paths: Iterable[Path]) -> Iterator[Path]:
    """Yield the files among the paths in a folder, which may come from outside; a link out of it is logged, not read.

    Links within the folder are followed; the folder itself may be a link.
    """
    root = folder.resolve()
    for path in paths:
        try:
            is_file, within = path.is_file(), path.resolve().is_relative_to(root)
        except (OSError, RuntimeError):  # gone meanwhile, or links in a circle
            continue
        if is_file and not within:
            _log.warning("%s", printable(f"a file of a folder must lie in it, got a link out of it, left out ({path})"))
        elif is_file:
            yield path


def by_numbers(name: str) -> list[str | int]:
    """Compute a key that orders names as people count: day_2 before day_10."""
    return [int(word) if word.isdecimal() else word for word in re.split(r"(\d+)", name)]


@contextmanager
def locked(file: Path, busy: str | None, wait: float = 0.0) -> Iterator[None]:
    """Hold the lock `file` of a folder of results while the block runs; the process's end releases it, too.

    `busy`: message of the InputError that is raised where another holds it for longer than `wait` [s]; None to wait for
    its end. The file is created where it is absent, and never emptied. Raises InputError for a link in its place, and
    where it cannot be created.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(file, timeout=-1 if busy is None else wait)
    try:
        open_inner(file, "a lock", "ab+").close()
        lock.acquire(poll_interval=0.01)
    except Timeout:
        raise InputError(str(busy)) from None
    except (OSError, NotImplementedError) as error:
        raise InputError(f"cannot lock {file}: {getattr(error, 'strerror', None) or error}") from None
    try:
        yield
    finally:
        lock.release()
