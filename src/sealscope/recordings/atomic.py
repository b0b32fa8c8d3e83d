"""Write files whole or not at all, and create the folders they go to."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sealscope.errors import InputError


def make_folder(folder: Path) -> None:
    """Create a folder with its parents where there is none; raise InputError where it cannot be created."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create folder: {error.strerror} ({folder})") from None


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary file in the folder of `path`: renamed to `path` when the block ends well, else removed.

    Raises InputError where the folder does not exist or cannot be written.
    """
    target = Path(path)
    try:
        if target.is_dir():
            raise InputError(f"a file to write must not be a folder, got {target}")
        handle, name = tempfile.mkstemp(prefix=f".{target.name[:80]}.", suffix=".part", dir=target.parent)
        os.close(handle)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes private files: give the file the mode that any new file of this user gets
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        temporary.replace(target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)
