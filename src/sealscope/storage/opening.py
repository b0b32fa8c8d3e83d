"""Open files from outside: a pipe is not waited for, and no link is followed out of a folder of results."""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Literal

from sealscope.errors import InputError, MissingExtra, UnreadableFile

_log = logging.getLogger(__name__)
_NO_WAITING = getattr(os, "O_NONBLOCK", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
#: How messages call what is no regular file.
_KINDS = (
    (stat.S_ISLNK, "a link"),
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def names_a_file(text: str | os.PathLike[str]) -> bool:
    """Return True for a text that can be the path of a file; too long a text or odd bytes cannot."""
    return os.path.isfile(text)  # noqa: PTH113 - pathlib raises for these until Python 3.14


def kind_of(mode: int) -> str | None:
    """Name the kind of a file of this `st_mode`; None for a regular file."""
    return next((name for is_kind, name in _KINDS if is_kind(mode)), None)


def open_regular(path: str | os.PathLike[str], what: str) -> BinaryIO:
    """Open the regular file `path` to read; `what` it is ("a recording") stands in the error.

    Raises InputError for a folder, pipe, socket or device, which may never end, and for a file of no length, as those
    of the system in /proc are said to be, which may never end either; OSError where it cannot be opened.
    """
    opened = _opened(path, what, "rb", _NO_WAITING)
    if not os.fstat(opened.fileno()).st_size:
        opened.close()
        raise InputError(f"{what} must hold data, got an empty file ({path})")
    return opened


def open_inner(path: str | os.PathLike[str], what: str, mode: Literal["rb", "ab+"] = "rb") -> BinaryIO:
    """Open a file of a folder of results: `rb` to read, `ab+` to append to it, and to create it first if need be.

    The folder may come from outside. Raises InputError for a link, for anything else that is no regular file and,
    to write, for a file with a second name (a hard link); OSError where it cannot be opened.
    """
    if Path(path).is_symlink():
        raise InputError(f"{what} must be a file, got a link ({path})")
    return _opened(path, what, mode, _NO_WAITING | _NO_LINK)


def _opened(path: str | os.PathLike[str], what: str, mode: Literal["rb", "ab+"], more: int) -> BinaryIO:
    flags = os.O_RDONLY if mode == "rb" else os.O_RDWR | os.O_CREAT | os.O_APPEND
    try:
        number = os.open(path, flags | more | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0), 0o666)
    except IsADirectoryError:
        raise InputError(f"{what} must be a file, got a folder ({path})") from None
    status = os.fstat(number)
    kind = kind_of(status.st_mode)
    if kind is None and mode != "rb" and status.st_nlink > 1:
        kind = f"one of {status.st_nlink} hard links"
    if kind is not None:
        os.close(number)
        raise InputError(f"{what} must be a file, got {kind} ({path})")
    return os.fdopen(number, mode)


@contextmanager
def whole(what: str, place: str | os.PathLike[str]) -> Iterator[None]:
    """Turn any error of a damaged file in the block into an UnreadableFile of one line; the log has the original.

    `what` it is ("a rig") and its `place` stand in the message. MissingExtra and UnreadableFile pass.
    """
    try:
        yield
    except (MissingExtra, UnreadableFile):
        raise
    except InputError as error:
        raise UnreadableFile(str(error) if str(place) in str(error) else f"{error} ({place})") from None
    except MemoryError as error:
        raise UnreadableFile(f"{what} must be readable, got: too little memory ({place})") from error
    except Exception as error:  # the libraries of formats raise whatever a damaged file makes them
        _log.debug("cannot read %s", place, exc_info=True)
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise UnreadableFile(f"{what} must be whole, got: {text} ({place})") from error
