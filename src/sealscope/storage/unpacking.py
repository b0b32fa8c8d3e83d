"""Limit the size that a packed file may unpack to, before it uses memory or disk."""

from __future__ import annotations

from pathlib import Path

from sealscope.errors import UnreadableFile

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
