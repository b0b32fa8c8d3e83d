"""Compile functions by numba, with a cache that never returns code of outdated sources.

After an edit to another file, with a function that it calls, numba's ``cache=True`` would return the old machine code
of a function. Here the name of the cache folder is a hash over the sources of all packages with compiled code and of
the modules from which these take constants, the versions of numba and Python, and the processor. It is in the user's
cache folder, unless `SEALSCOPE_CACHE_DIR` moves it; an empty value turns caching off. Compiled code is unpickled, which
can run any command: only folders that no other user can write are used.

Kernels are functions that Python calls; laws are functions, such as a formula of physics, that kernels call. They
allocate nothing, and write to arrays of the caller.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import re
import shutil
import stat
import tempfile
from collections.abc import Callable
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir as llvm
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from platformdirs import user_cache_path

# ignore numba's settings in the working folder, which may be hostile and name a library to load
numba.config._config_fname = ""
numba.config.reload_config()
_F = TypeVar("_F", bound=Callable[..., Any])
#: Packages and modules with compiled code that is cached, or from which it takes constants (`units`) or the order of a
#: record's fields (`parameters`).
_COMPILED_PACKAGES = (
    *("compiled.py", "numba_pipeline.py", "numba_private.py", "units.py", "units.toml", "parameters"),
    *("physics", "signals", "control", "simulation", "diagnosis", "monitor/sources/message_limits.py"),
)
#: Number of cache folders that are kept, those of the current sources and of the sources used before.
_MAX_GENERATIONS = 4
#: Range of numba versions with known private names: from the first to before the second.
KNOWN_VERSIONS = (0, 61, 2), (0, 69, 0)
_log = logging.getLogger(__name__)


def is_known_version(version: str) -> bool:
    """Return True if a numba version, such as "0.61.2", has the private names that `numba_private` uses."""
    first, after = KNOWN_VERSIONS
    # [:3]: without a suffix such as rc1
    return first <= tuple(int(digits) for digits in re.findall(r"\d+", version)[:3]) < after


@cache
def _compiler() -> ModuleType:
    """Import the module that compiles: `numba_private` for the `KNOWN_VERSIONS` of numba, else `numba_pipeline`."""
    if is_known_version(numba.__version__):
        return import_module("sealscope.numba_private")
    low, high = (".".join(map(str, version)) for version in KNOWN_VERSIONS)
    message = "numba %s is not a version from %s to before %s: laws compile slowly and are not cached"
    _log.warning(message, numba.__version__, low, high)
    return import_module("sealscope.numba_pipeline")


def source_hash(root: Path) -> str:
    """Compute a hash, in hex digits, over the sources in the folder `root` that compiled code depends on."""
    digest = hashlib.sha256()
    for package in _COMPILED_PACKAGES:
        # .toml: numbers, such as priors, that are compiled into kernels as constants
        paths = (f"{folder}/{name}" for folder, _, names in os.walk(root / package) for name in names)
        files = sorted(path for path in paths if path.endswith((".py", ".toml")))
        for path in files or [f"{root}/{package}"]:  # an entry that is itself a file contains no `files`
            digest.update(path.removeprefix(f"{root}").encode() + b"\0")
            digest.update(Path(path).read_bytes())
    return digest.hexdigest()


def _user_cache_folder() -> Path | None:
    """Find the folder for compiled code: `SEALSCOPE_CACHE_DIR` if that is set, else the user's cache folder.

    Returns None if the variable is set but empty, or if the user has no home folder.
    """
    setting = os.environ.get("SEALSCOPE_CACHE_DIR")
    if setting is not None:
        return Path(setting) if setting else None
    folder = user_cache_path("sealscope", appauthor=False)
    return folder if folder.is_absolute() else None  # relative for a user without a home


def _prune(kernels: Path, current: str) -> None:
    """Remove all subfolders of `kernels` but `current` and the `_MAX_GENERATIONS` - 1 most recently used others."""
    older = sorted(
        (entry for entry in kernels.iterdir() if entry.is_dir() and entry.name != current),
        key=lambda entry: entry.stat().st_mtime,
        reverse=True,
    )
    for entry in older[_MAX_GENERATIONS - 1 :]:
        shutil.rmtree(entry, ignore_errors=True)


def _check_owner(folder: Path, forbidden: int) -> None:
    """Raise PermissionError unless `folder` is a directory, not a link, of this user, without the `forbidden` bits."""
    status = folder.lstat()
    if not hasattr(os, "getuid"):  # on Windows the folders of a user are private
        return
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & forbidden:
        raise PermissionError(f"{folder} must be a folder of this user alone")


def _make_private(folder: Path) -> None:
    """Create a folder for this user only, or restrict an existing one; raise OSError if others could write to it."""
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_owner(folder, forbidden=0o022)  # others cannot write
    folder.chmod(0o700)
    _check_owner(folder, forbidden=0o077)  # others cannot read, either


@cache
def cache_directory() -> Path | None:
    """Create the folder for the compiled code of these sources, and return its path.

    If the user's cache folder is not safe or not writable, a private folder among the temporary files is used. Returns
    None if caching is turned off, or after a warning if no folder is usable.
    """
    base = _user_cache_folder()
    if base is None:
        return None
    environment = f"{numba.__version__} {platform.python_version()} {platform.machine()} {numba.config.CPU_NAME}"
    key = hashlib.sha256((source_hash(Path(__file__).parent) + environment).encode()).hexdigest()[:20]
    for temporary in (False, True):
        if temporary:
            base = Path(tempfile.gettempdir()) / f"sealscope-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
        directory = base / "kernels" / key
        try:
            if temporary:  # another user may have made a folder with this name
                _make_private(base)
            else:
                base.mkdir(mode=0o700, parents=True, exist_ok=True)
                _check_owner(base.resolve(), forbidden=0o022)  # others cannot write; `base` may be a link
            _make_private(directory.parent)
            _make_private(directory)
            os.utime(directory)  # `_prune` keeps the folders that were used last
            with tempfile.TemporaryFile(dir=directory):  # raises OSError if no file can be written
                pass
            _prune(directory.parent, key)
        except OSError as error:
            _log.debug("cannot cache compiled code in %s: %s", directory, error)
        else:
            return directory
    _log.warning("no folder for compiled code can be used: every process compiles anew (set SEALSCOPE_CACHE_DIR)")
    return None


def kernel(function: _F) -> _F:
    """Compile a function that Python calls, without Python objects and GIL; cache its code if there is a folder."""
    return _compiler().compile_kernel(function, cache_directory())  # type: ignore[no-any-return]


def _compile_law(function: _F, fastmath: Any = False, inlined: bool = True) -> _F:
    """Compile a law; `fastmath`: LLVM's fast-math flags, False for none; `inlined`: True to insert its code at calls.

    If numba's compilation is switched off (`NUMBA_DISABLE_JIT`), `function` itself is returned.
    """
    if numba.config.DISABLE_JIT:
        return function
    return _compiler().compile_law(function, fastmath, inlined, cache_directory())  # type: ignore[no-any-return]


def law(function: _F) -> _F:
    """Compile a small function, such as a formula, for use in other compiled functions; Python runs it uncompiled."""
    return _compile_law(function)


def large_law(function: _F) -> _F:
    """Compile a large function for calls from Python and from compiled functions; its code is not inlined in these."""
    return _compile_law(function, inlined=False)


def contracted(function: _F) -> _F:
    """Compile a small function like `law`, with fused multiply-adds and divisions by reciprocals allowed.

    The results' last digits then depend on the processor, and may differ between numbers and vectors (`physics.lanes`),
    but do not depend on the division of samples into blocks.
    """
    return _compile_law(function, fastmath={"contract", "arcp"})


class Entry:
    """A C function `double f(double *memory, double *input)`, compiled when its `address` is first requested.

    An example is a control law: `memory` holds its state and parameters, `input` the measured values of a sample.
    """

    _SIGNATURE = numba.float64(types.CPointer(numba.float64), types.CPointer(numba.float64))

    def __init__(self, function: Callable[..., Any]) -> None:
        self._address = _compiler().compile_at_address(function, self._SIGNATURE, cache_directory())

    @cached_property
    def address(self) -> int:
        """Address of the compiled function, for calls from C, ctypes and `call_at`."""
        return int(self._address())


#: The decorator of functions that kernels and C call by their address.
entry = Entry


@intrinsic  # type: ignore[misc]
def call_at(context: Any, address: Any, memory: Any, sample: Any) -> Any:
    """Call the function double f(double *memory, double *sample) at an address, in compiled code only.

    `address`, `memory` and `sample` are addresses as 64-bit integers. Numba passes `context`.
    """

    def emit_call(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Emit LLVM instructions that call the function at the address `values[0]` with the pointers `values[1:]`."""
        double = target.get_value_type(numba.float64)
        pointer = double.as_pointer()
        function = builder.inttoptr(values[0], llvm.FunctionType(double, [pointer, pointer]).as_pointer())
        return builder.call(function, [builder.inttoptr(value, pointer) for value in values[1:]])

    return numba.float64(numba.int64, numba.int64, numba.int64), emit_call


@intrinsic  # type: ignore[misc]
def address_of(context: Any, pointer: Any) -> Any:
    """Convert a pointer to a 64-bit integer, its address, in compiled code only; numba passes `context`."""
    return numba.int64(pointer), lambda target, builder, signature, values: builder.ptrtoint(
        values[0], target.get_value_type(numba.int64)
    )


@intrinsic  # type: ignore[misc]
def copy_to_stack(context: Any, record: Any) -> Any:
    """Copy a record to the stack of a kernel, in compiled code only; numba passes `context`.

    No write to an array can then change the record, so that LLVM reads its fields and inverts divisors once, before a
    loop, instead of in each round. A tuple is returned as it is: it is a value, which no write changes.
    """

    def emit_copy(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Emit LLVM instructions that load the record at the address `values[0]` and store it on the stack."""
        if not isinstance(record, types.Record):
            if target.enable_nrt:
                target.nrt.incref(builder, record, values[0])  # the arrays of a tuple have one more owner
            return values[0]
        copy = cgutils.alloca_once(builder, values[0].type.pointee)
        cgutils.raw_memcpy(builder, copy, values[0], target.get_constant(types.intp, record.size), 1)
        return copy

    return record(record), emit_copy


def record_dtype(*numbers: str, **parts: Any) -> np.dtype[Any]:
    """Build the NumPy dtype of a record: a field of one double for each name in `numbers`, then the fields `parts`.

    `parts`: name -> shape of an array of doubles, or dtype of a nested record.
    """
    further = [(name, part) if isinstance(part, np.dtype) else (name, "f8", part) for name, part in parts.items()]
    return np.dtype([*((name, "f8") for name in numbers), *further])  # f8: NumPy's name of a double


def make_record(layout: np.dtype[Any], source: object = None, **values: Any) -> np.recarray[Any, Any]:
    """Make a record (1,) of dtype `layout`: each field is from `values`, else an attribute of `source`, else 0."""
    record = np.zeros(1, layout).view(np.recarray)
    for name in layout.fields or ():
        record[name] = values.get(name, getattr(source, name, 0.0))
    return record


def record_view(layout: Any) -> Callable[[Any], Any]:
    """Build a compiled function that views the doubles at a pointer as a record of the dtype `layout`."""
    record_type = numba.from_dtype(layout)

    @intrinsic  # type: ignore[misc]
    def record(context: Any, pointer: Any) -> Any:
        """View the doubles at a pointer as the record, whose value is its address; numba passes `context`."""
        return record_type(pointer), lambda target, builder, signature, values: builder.bitcast(
            values[0], target.get_value_type(record_type)
        )

    return record  # type: ignore[no-any-return]
