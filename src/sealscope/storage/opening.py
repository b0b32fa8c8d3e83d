"""Open files that come from others, without waiting for pipes or following links out of a folder of results."""

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
#: Flags of `os.open` that do not wait for the other end of a pipe, and do not follow a link; 0 where unknown.
_NO_WAITING = getattr(os, "O_NONBLOCK", 0)
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
#: Names of kinds of files that are not regular, for messages.
_KINDS = (
    (stat.S_ISLNK, "a link"), (stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"),
)  # fmt: skip


def find_wrong_kind(mode: int) -> str | None:
    """Name the kind of a file that is not regular, such as "a pipe", from its `st_mode`; return None for others."""
    return next((name for is_kind, name in _KINDS if is_kind(mode)), None)


def is_file_path(text: str | os.PathLike[str]) -> bool:
    """Return True if a text is the path of an existing file; False also for a text that cannot be a path."""
    return os.path.isfile(text)  # noqa: PTH113 - pathlib raises for texts that cannot be paths until Python 3.14


def open_regular(path: str | os.PathLike[str], what: str) -> BinaryIO:
    """Open a regular file for reading, in binary mode.

    `what` names the file in error messages, such as "a recording". Raises InputError for a folder, pipe, socket or
    device, and for an empty file. A file in /proc counts as empty, as its stated size is 0. Raises OSError if the file
    cannot be opened.
    """
    file = _open_checked(path, what, "rb", _NO_WAITING)
    if not os.fstat(file.fileno()).st_size:
        file.close()
        raise InputError(f"{what} must hold data, got an empty file ({path})")
    return file


def open_inner(path: str | os.PathLike[str], what: str, mode: Literal["rb", "ab+"] = "rb") -> BinaryIO:
    """Open a file, in binary mode, in a folder of results that other people may have prepared.

    `mode`: `rb` to read, `ab+` to append or create; `what`: name in messages. Raises InputError for a link and any
    other file that is not regular, and in mode `ab+` for a file with several hard links, as one of them may be a file
    elsewhere; OSError if opening fails.
    """
    if Path(path).is_symlink():
        raise InputError(f"{what} must be a file, got a link ({path})")
    return _open_checked(path, what, mode, _NO_WAITING | _NO_LINK)


def _open_checked(path: str | os.PathLike[str], what: str, mode: Literal["rb", "ab+"], extra_flags: int) -> BinaryIO:
    """Open a regular file, with `extra_flags` of `os.open`; raise InputError for any other file.

    `what`: name in messages; `mode`: `rb` to read, `ab+` to append or create, which refuses several hard links, too.
    """
    flags = os.O_RDONLY if mode == "rb" else os.O_RDWR | os.O_CREAT | os.O_APPEND
    flags |= extra_flags | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    try:
        descriptor = os.open(path, flags, 0o666)
    except IsADirectoryError:
        raise InputError(f"{what} must be a file, got a folder ({path})") from None
    status = os.fstat(descriptor)
    wrong_kind = find_wrong_kind(status.st_mode)
    if wrong_kind is None and mode != "rb" and status.st_nlink > 1:
        wrong_kind = f"one of {status.st_nlink} hard links"
    if wrong_kind is not None:
        os.close(descriptor)
        raise InputError(f"{what} must be a file, got {wrong_kind} ({path})")
    return os.fdopen(descriptor, mode)


@contextmanager
def raising_unreadable(what: str, place: str | os.PathLike[str]) -> Iterator[None]:
    """Convert any error that a damaged file causes in the block to an UnreadableFile with a message of one line.

    `what` ("a rig") and `place` appear in the message. MissingExtra and UnreadableFile are not changed. Unexpected
    errors are also logged.
    """
    try:
        yield
    except (MissingExtra, UnreadableFile):
        raise
    except InputError as error:
        raise UnreadableFile(str(error) if str(place) in str(error) else f"{error} ({place})") from None
    except MemoryError as error:
        raise UnreadableFile(f"{what} must be readable, got: too little memory ({place})") from error
    except Exception as error:  # libraries raise errors of any class for damaged files
        _log.debug("cannot read %s", place, exc_info=True)
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise UnreadableFile(f"{what} must be whole, got: {text} ({place})") from error


#: Largest unpacked size of any file [bytes].
MAX_UNPACKED = 8 * 2**30
#: Unpacked size that is allowed for every file [bytes], and largest ratio of a larger one to the size on the disk.
_MIN_LIMIT, _MAX_EXPANSION = 2**26, 200


def max_unpacked_size(path: Path) -> int:
    """Compute the largest size [bytes] that the packed file at `path` may unpack to.

    The limit is 200 times the size on the disk, but at least 64 MiB and at most 8 GiB. Packing usually reduces a log to
    a tenth of its size, and a log of constant channels to a hundredth. Holes of a sparse file do not count.
    """
    status = path.stat()
    disk_bytes = 512 * getattr(status, "st_blocks", 0)  # 512 bytes a block; 0 where the file system does not say
    return min(MAX_UNPACKED, max(_MIN_LIMIT, _MAX_EXPANSION * min(status.st_size, disk_bytes or status.st_size)))


def check_unpacked(size: int, max_bytes: int, place: str | Path) -> None:
    """Check that the unpacked `size` of the file `place` is at most `max_bytes`; raise UnreadableFile otherwise."""
    if size > max_bytes:
        raise UnreadableFile(
            f"a packed file must unpack to at most {max_bytes} bytes, got {size} or more: if you trust it, unpack it "
            f"or export it as CSV ({place})"
        )
