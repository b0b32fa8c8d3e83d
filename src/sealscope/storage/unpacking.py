"""Limits on the unpacked size of a packed file, checked before memory or disk is spent."""

from __future__ import annotations

from pathlib import Path

from sealscope.errors import UnreadableFile

#: Most bytes that any file may unpack to.
LARGEST = 8 * 2**30
#: Up to this many bytes any file may; beyond, so many times the bytes that it has on the disk.
_SMALL, _EXPANSION = 2**26, 200


def most_unpacked(path: Path) -> int:
    """Compute the most bytes that a packed file may unpack to.

    Logs shrink to a tenth, those of standing channels to a hundredth. What a sparse file does not have on the disk does
    not count.
    """
    status = path.stat()
    blocks = 512 * getattr(status, "st_blocks", 0)  # 0 where the file system does not say
    return min(LARGEST, max(_SMALL, _EXPANSION * min(status.st_size, blocks or status.st_size)))


def check_unpacked(size: int, most: int, place: str | Path) -> None:
    """Raise UnreadableFile where a file unpacks to more than `most` bytes, as `most_unpacked` has it."""
    if size > most:
        raise UnreadableFile(
            f"a packed file must unpack to at most {most} bytes, got {size} or more: unpack it, or export it as CSV, "
            f"where you know it ({place})"
        )
