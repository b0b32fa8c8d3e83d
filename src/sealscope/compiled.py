"""Compile functions by numba, with a cache that never returns code of outdated sources.

Numba's ``cache=True`` keys a kernel by its own file only: after an edit to a law in another file it would silently
return the old machine code. Here the name of the cache folder is a hash over the sources of all packages with compiled
code, the versions of numba and Python, and the processor. It lies in the user's cache folder, as site-packages may be
read-only. `SEALSCOPE_CACHE_DIR` moves it; an empty value turns caching off.

Compiled code is unpickled, which can run any command: only folders that no other user can write are used. A file of
the cache that is truncated or cannot be written is a cache miss.
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
from numba.extending import intrinsic
from platformdirs import user_cache_path

# ignore numba's settings in the working folder, which may be hostile and name a library to load
numba.config._config_fname = ""
numba.config.reload_config()
_F = TypeVar("_F", bound=Callable[..., Any])
_MESSAGE_LIMITS = "monitor/sources/message_limits.py"
_COMPILED_PACKAGES = (
    *("compiled.py", "numba_pipeline.py", "numba_private.py"),
    *("physics", "signals", "control", "simulation", "diagnosis", _MESSAGE_LIMITS),
)
#: Cache folders of the last sources that are not removed.
_MAX_GENERATIONS = 4
#: Range of numba versions with known private names: from the first to before the second.
KNOWN_VERSIONS = (0, 61, 2), (0, 69, 0)
_log = logging.getLogger(__name__)


def is_known_version(version: str) -> bool:
    """Test whether the private names of this numba version are known."""
    first, after = KNOWN_VERSIONS
    return first <= tuple(int(digits) for digits in re.findall(r"\d+", version)[:3]) < after


@cache
def _compiler() -> ModuleType:
    """Import the compiler, `numba_private` for a known version of numba, else `numba_pipeline`."""
    if is_known_version(numba.__version__):
        return import_module("sealscope.numba_private")
    low, high = (".".join(map(str, version)) for version in KNOWN_VERSIONS)
    _log.warning(
        "numba %s is not a version from %s to before %s: laws compile slowly and are not cached",
        *(numba.__version__, low, high),
    )
    return import_module("sealscope.numba_pipeline")


def source_hash(root: Path) -> str:
    """Compute a hash over the Python and TOML files of the compiled packages under `root`."""
    digest = hashlib.sha256()
    for package in _COMPILED_PACKAGES:
        place = root / package
        files = (path for path in place.rglob("*") if path.suffix in (".py", ".toml"))
        for path in sorted(files) if place.is_dir() else [place]:
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _user_cache_folder() -> Path | None:
    """Choose the folder for compiled code.

    None if caching is turned off or the user has no home folder.
    """
    setting = os.environ.get("SEALSCOPE_CACHE_DIR")
    if setting is not None:
        return Path(setting) if setting else None
    folder = user_cache_path("sealscope", appauthor=False)
    return folder if folder.is_absolute() else None  # relative for a user without a home


def _prune(kernels: Path, current: str) -> None:
    """Remove old folders of compiled code in `kernels`.

    Keeps `current` and the `_MAX_GENERATIONS` - 1 most recently used others.
    """
    older = sorted(
        (entry for entry in kernels.iterdir() if entry.is_dir() and entry.name != current),
        key=lambda entry: entry.stat().st_mtime,
        reverse=True,
    )
    for entry in older[_MAX_GENERATIONS - 1 :]:
        shutil.rmtree(entry, ignore_errors=True)


def _check_owner(folder: Path, forbidden: int) -> None:
    """Raise PermissionError unless `folder` is a private directory of this user, and no link.

    `forbidden`: mode bits that must not be set. On Windows all folders pass.
    """
    status = folder.lstat()
    if not hasattr(os, "getuid"):  # on Windows the folders of a user are private
        return
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & forbidden:
        raise PermissionError(f"{folder} must be a folder of this user alone")


def _make_private(folder: Path) -> None:
    """Make a folder with mode 0700; raise OSError if another user owns it or can write to it."""
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_owner(folder, 0o022)
    if folder.lstat().st_mode & 0o077:
        folder.chmod(0o700)
    _check_owner(folder, 0o077)


@cache
def cache_directory() -> Path | None:
    """Make and return the folder for compiled code of these sources; None if none can be written safely."""
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
                _check_owner(base.resolve(), 0o022)
            _make_private(directory.parent)
            _make_private(directory)
            os.utime(directory)
            with tempfile.TemporaryFile(dir=directory):
                pass
            _prune(directory.parent, key)
        except OSError as error:
            _log.debug("cannot cache compiled code in %s: %s", directory, error)
        else:
            return directory
    _log.warning("no folder for compiled code can be used: every process compiles anew (set SEALSCOPE_CACHE_DIR)")
    return None


def kernel(function: _F, fastmath: Any = False) -> _F:
    """Compile a function that runs without Python objects and the GIL, and cache its code.

    By default floating-point errors follow IEEE 754; `fastmath`: numba's flags that relax it.
    """
    return _compiler().compile_kernel(function, fastmath, cache_directory())  # type: ignore[no-any-return]


def _compile_law(function: _F, fastmath: Any, inlined: bool = True) -> _F:
    """Compile a law for calls from other compiled functions; return it unchanged if numba is disabled."""
    if numba.config.DISABLE_JIT:
        return function
    return _compiler().compile_law(function, fastmath, inlined, cache_directory())  # type: ignore[no-any-return]


def law(function: _F) -> _F:
    """Compile a small law that is inlined in other compiled functions; called from Python it is plain Python."""
    return _compile_law(function, False)


def large_law(function: _F) -> _F:
    """Compile a law that is too large to be inlined in other compiled functions, which call it."""
    return _compile_law(function, False, inlined=False)


def contracted(function: _F) -> _F:
    """Compile a law whose products and sums may be contracted to fused multiply-adds.

    Divisions may become products with the reciprocal. The last digits depend on the processor, but not on the block or
    the lane.
    """
    return _compile_law(function, {"contract", "arcp"})


class Entry:
    """A function double f(double *memory, double *input), compiled when its address is first requested."""

    _SIGNATURE = numba.float64(types.CPointer(numba.float64), types.CPointer(numba.float64))

    def __init__(self, function: Callable[..., Any]) -> None:
        self._address = _compiler().compile_at_address(function, self._SIGNATURE, cache_directory())

    @cached_property
    def address(self) -> int:
        """Address of the compiled function, for C, `call_at` and ctypes."""
        return int(self._address())


def entry(function: Callable[..., Any]) -> Entry:
    """Compile a function of two arrays of doubles that kernels call by its address."""
    return Entry(function)


@intrinsic  # type: ignore[misc]
def call_at(context: Any, address: Any, memory: Any, sample: Any) -> Any:
    """Call double f(double *memory, double *sample) by its address; all three arguments are integer addresses."""

    def emit_call(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Emit the LLVM instructions that call the function at the address."""
        double = target.get_value_type(numba.float64)
        pointer = double.as_pointer()
        function = builder.inttoptr(values[0], llvm.FunctionType(double, [pointer, pointer]).as_pointer())
        return builder.call(function, [builder.inttoptr(value, pointer) for value in values[1:]])

    return numba.float64(numba.int64, numba.int64, numba.int64), emit_call


@intrinsic  # type: ignore[misc]
def address_of(context: Any, pointer: Any) -> Any:
    """Return the address of a pointer as an integer."""

    def emit_conversion(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Emit the LLVM instruction that converts the pointer to a 64-bit integer."""
        return builder.ptrtoint(values[0], target.get_value_type(numba.int64))

    return numba.int64(pointer), emit_conversion


def record_dtype(*numbers: str, **parts: Any) -> np.dtype[Any]:
    """Build the dtype of a record of doubles `numbers`, and of `parts`, each an array's shape or a record's dtype."""
    shaped = [(name, part) if isinstance(part, np.dtype) else (name, "f8", part) for name, part in parts.items()]
    return np.dtype([*((name, "f8") for name in numbers), *shaped])


def make_record(layout: np.dtype[Any], source: object = None, **values: Any) -> np.recarray[Any, Any]:
    """Make a record array (1,) with the dtype `layout`.

    Each field is taken from `values`, else from the attribute of `source` with its name, else zero.
    """
    record = np.zeros(1, layout).view(np.recarray)
    for name in layout.fields or ():
        record[name] = values.get(name, getattr(source, name, 0.0))
    return record


def record_view(layout: Any) -> Callable[[Any], Any]:
    """Build the law that views the doubles at a pointer as a record, without copying them.

    `layout`: NumPy's dtype of a record of doubles and arrays of them.
    """
    kind = numba.types.CPointer(numba.from_dtype(layout))

    @intrinsic  # type: ignore[misc]
    def cast_pointer(context: Any, pointer: Any) -> Any:
        """Cast a pointer to doubles to a pointer to the record."""

        def emit_cast(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            """Emit the LLVM instruction that casts the pointer."""
            return builder.bitcast(values[0], target.get_value_type(kind))

        return kind(pointer), emit_cast

    @law
    def record(pointer: Any) -> Any:
        """View the doubles at a pointer as the record."""
        return numba.carray(cast_pointer(pointer), 1)[0]

    return record  # type: ignore[no-any-return]


def plain_code(function: Callable[..., Any], *arguments: str) -> tuple[str, str]:
    """Compile a function to LLVM code without Python; return the code and the function's symbol.

    `arguments`: "double*", "double" or "int64" each. The function returns an integer, takes pointers and numbers, and
    allocates nothing; C calls it as ``int symbol(int64_t *result, void **unused, arguments...)``.
    """
    kinds = {"double*": numba.types.CPointer(numba.float64), "double": numba.float64, "int64": numba.int64}
    signature = numba.int64(*(kinds[argument] for argument in arguments))
    dispatcher = numba.njit(signature, nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    (compiled,) = dispatcher.overloads.values()
    text = dispatcher.inspect_llvm(compiled.signature.args)
    # remove numba's reference counting, which is not called and is specific to one processor
    text = re.sub(r"^define linkonce_odr void @NRT_decref\(.*?^}\n", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^declare .* @(NRT_MemInfo_call_dtor|llvm\.x86\.[\w.]+)\(.*\n", "", text, flags=re.MULTILINE)
    return text, compiled.fndesc.llvm_func_name
