"""Folders of results: made, entered and held by one process; links out of them are refused."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sealscope.errors import InputError
from sealscope.storage.opening import open_inner


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


def by_numbers(name: str) -> list[str | int]:
    """Compute a key that orders names as people count: day_2 before day_10."""
    return [int(word) if word.isdecimal() else word for word in re.split(r"(\d+)", name)]


@contextmanager
def locked(file: Path, busy: str | None) -> Iterator[None]:
    """Hold the lock `file` of a folder of results while the block runs; the process's end releases it, too.

    `busy`: message of the InputError that is raised where a second process holds it; None to wait for its end. The file
    is created where it is absent, and never emptied. Raises InputError for a link in its place.
    """
    from filelock import FileLock, Timeout

    try:
        open_inner(file, "a lock", "ab+").close()
        with FileLock(file, timeout=-1 if busy is None else 0):
            yield
    except Timeout:
        raise InputError(str(busy)) from None
