"""The one way a function is compiled: numba, with a cache that cannot return old physics.

Plain ``cache=True`` keys a kernel by its own file only, so an edit to a law in another file leaves the kernel's
old machine code valid and silently wrong. Here the cache directory is named by a hash over the sources of every
room that holds compiled code, the versions of numba and Python and the processor, and lies in the user's cache folder
(never in site-packages, which may be read-only). `SEALSCOPE_CACHE_DIR` moves it; an empty value turns caching off.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config

_F = TypeVar("_F", bound=Callable[..., Any])
_COMPILED_ROOMS = ("compiled.py", "physics", "signals", "simulation", "diagnosis")
_KEPT_GENERATIONS = 4
_log = logging.getLogger(__name__)


def source_hash(root: Path) -> str:
    """Hash of every source file in the rooms under `root` that hold compiled functions."""
    digest = hashlib.sha256()
    for room in _COMPILED_ROOMS:
        place = root / room
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _user_cache_folder() -> Path | None:
    chosen = os.environ.get("SEALSCOPE_CACHE_DIR")
    if chosen is not None:
        return Path(chosen) if chosen else None
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "sealscope"


def _prune(kernels: Path, current: str) -> None:
    """Forget the generations of compiled code that nobody used for the longest time."""
    others = sorted(
        (entry for entry in kernels.iterdir() if entry.is_dir() and entry.name != current),
        key=lambda entry: entry.stat().st_mtime,
        reverse=True,
    )
    for entry in others[_KEPT_GENERATIONS - 1 :]:
        shutil.rmtree(entry, ignore_errors=True)


@cache
def cache_directory() -> Path | None:
    """The directory of this source's compiled code, made if need be; None where none can be written."""
    base = _user_cache_folder()
    if base is None:
        return None
    environment = f"{numba.__version__} {platform.python_version()} {platform.machine()} {config.CPU_NAME}"
    key = hashlib.sha256((source_hash(Path(__file__).parent) + environment).encode()).hexdigest()[:20]
    for folder in (base, Path(tempfile.gettempdir()) / f"sealscope-{os.getuid() if hasattr(os, 'getuid') else 'user'}"):
        directory = folder / "kernels" / key
        try:
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
            os.utime(directory)
            with tempfile.TemporaryFile(dir=directory):
                pass
            _prune(directory.parent, key)
        except OSError as error:
            _log.debug("cannot cache compiled code in %s: %s", directory, error)
        else:
            return directory
    _log.warning("no folder for compiled code can be written: every process compiles anew (set SEALSCOPE_CACHE_DIR)")
    return None


def kernel(function: _F) -> _F:
    """Compile `function` (no Python objects, GIL released) with the safe cache; errors in floats follow IEEE 754."""
    directory = cache_directory()
    if directory is None:
        return numba.njit(nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]
    # numba reads the folder when the decorator runs; other users of numba in this process keep theirs
    before = config.CACHE_DIR
    config.CACHE_DIR = str(directory)
    try:
        return numba.njit(nogil=True, error_model="numpy", cache=True)(function)  # type: ignore[no-any-return]
    finally:
        config.CACHE_DIR = before


def law(function: _F) -> _F:
    """Compile a small law that only other compiled functions call: inlined there, cached with them, never alone."""
    return numba.njit(nogil=True, error_model="numpy", forceinline=True)(function)  # type: ignore[no-any-return]


def contracted(function: _F) -> _F:
    """A law whose products and sums may be contracted to fused multiply-adds and whose divisions by what does not
    change may become products: last digits depend on the processor, never on the block or the lane."""
    return numba.njit(nogil=True, error_model="numpy", fastmath={"contract", "arcp"}, forceinline=True)(function)  # type: ignore[no-any-return]
