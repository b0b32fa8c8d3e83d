"""Compile functions by numba, with a cache that never returns code of outdated sources.

Numba's ``cache=True`` stores the machine code of a function by the source of its own file only. After an edit to
another file, with a function that it calls, it would silently return the old machine code. Here the name of the cache
folder is a hash over the sources of all packages with compiled code, the versions of numba and Python, and the
processor. The folder is in the user's cache folder, as site-packages may be read-only. `SEALSCOPE_CACHE_DIR` moves
it; an empty value turns caching off.

Two kinds of functions are compiled: kernels, which Python calls, and laws, small functions such as a formula of
physics that kernels call.

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
#: Number of cache folders that are kept, those of the current sources and of the sources used before.
_MAX_GENERATIONS = 4
#: Range of numba versions with known private names: from the first to before the second.
KNOWN_VERSIONS = (0, 61, 2), (0, 69, 0)
_log = logging.getLogger(__name__)


def is_known_version(version: str) -> bool:
    """Return True if a numba version, such as "0.61.2", is within the range `KNOWN_VERSIONS`.

    In these versions numba has the private names that `numba_private` uses.
    """
    first, after = KNOWN_VERSIONS
    return first <= tuple(int(digits) for digits in re.findall(r"\d+", version)[:3]) < after


@cache
def _compiler() -> ModuleType:
    """Import the module that compiles functions with the installed version of numba.

    The module is `numba_private` for a version in `KNOWN_VERSIONS`. For other versions the module is `numba_pipeline`,
    which compiles slowly and does not cache; a warning is then logged.
    """
    if is_known_version(numba.__version__):
        return import_module("sealscope.numba_private")
    low, high = (".".join(map(str, version)) for version in KNOWN_VERSIONS)
    message = "numba %s is not a version from %s to before %s: laws compile slowly and are not cached"
    _log.warning(message, numba.__version__, low, high)
    return import_module("sealscope.numba_pipeline")


def source_hash(root: Path) -> str:
    """Compute a hash over the Python and TOML files of all packages with compiled code, as hexadecimal digits.

    `root`: folder that contains these packages.
    """
    digest = hashlib.sha256()
    for package in _COMPILED_PACKAGES:
        files = [root / package]
        if files[0].is_dir():
            files = sorted(path for path in files[0].rglob("*") if path.suffix in (".py", ".toml"))
        for path in files:
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _user_cache_folder() -> Path | None:
    """Choose the folder in which compiled code of this user is cached.

    The folder is `SEALSCOPE_CACHE_DIR` if this environment variable is set, else a folder in the user's cache folder.
    None if the variable is empty, which turns caching off, or if the user has no home folder.
    """
    setting = os.environ.get("SEALSCOPE_CACHE_DIR")
    if setting is not None:
        return Path(setting) if setting else None
    folder = user_cache_path("sealscope", appauthor=False)
    return folder if folder.is_absolute() else None  # relative for a user without a home


def _prune(kernels: Path, current: str) -> None:
    """Remove old subfolders of `kernels`, which has one for each version of the sources.

    The subfolder named `current` is kept, and so are the `_MAX_GENERATIONS` - 1 most recently used others.
    """
    older = sorted(
        (entry for entry in kernels.iterdir() if entry.is_dir() and entry.name != current),
        key=lambda entry: entry.stat().st_mtime,
        reverse=True,
    )
    for entry in older[_MAX_GENERATIONS - 1 :]:
        shutil.rmtree(entry, ignore_errors=True)


def _check_owner(folder: Path, forbidden: int) -> None:
    """Raise PermissionError unless `folder` is a directory, not a link, that belongs to this user alone.

    `forbidden`: permission bits that must not be set, such as 0o022, with which others could write. On Windows all
    existing folders pass.
    """
    status = folder.lstat()
    if not hasattr(os, "getuid"):  # on Windows the folders of a user are private
        return
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & forbidden:
        raise PermissionError(f"{folder} must be a folder of this user alone")


def _make_private(folder: Path) -> None:
    """Create a folder that only this user can read and write (mode 0700), or restrict an existing one to this user.

    Raises OSError if the folder belongs to another user, or if others could write to it until now.
    """
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_owner(folder, forbidden=0o022)  # others cannot write
    if folder.lstat().st_mode & 0o077:
        folder.chmod(0o700)
    _check_owner(folder, forbidden=0o077)  # others cannot read, either


@cache
def cache_directory() -> Path | None:
    """Create the folder for the compiled code of these sources, and return its path.

    The user's cache folder is preferred; if it is not safe or not writable, a private folder among the temporary
    files is used. Folders of older sources are removed (`_prune`). Returns None if caching is turned off, and None
    after a warning if no folder can be used.
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
                _check_owner(base.resolve(), forbidden=0o022)  # others cannot write
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


def kernel(function: _F, fastmath: Any = False) -> _F:
    """Compile a function that Python calls, without Python objects and without the GIL, and cache its code.

    Floating-point arithmetic follows IEEE 754, unless `fastmath` allows deviations: True, or a set of LLVM's
    fast-math flags, as for `numba.njit`.
    """
    return _compiler().compile_kernel(function, fastmath, cache_directory())  # type: ignore[no-any-return]


def _compile_law(function: _F, fastmath: Any, inlined: bool = True) -> _F:
    """Compile a law, a function that other compiled functions call.

    `fastmath`: allowed deviations from IEEE 754 as LLVM's fast-math flags, False for none; `inlined`: True to insert
    the law's code in place of each call. The law is returned uncompiled if numba's compilation is disabled.
    """
    if numba.config.DISABLE_JIT:
        return function
    return _compiler().compile_law(function, fastmath, inlined, cache_directory())  # type: ignore[no-any-return]


def law(function: _F) -> _F:
    """Compile a small function, such as a formula of physics, for use in other compiled functions.

    Its code is inserted in place of each call. A call from Python runs the uncompiled function.
    """
    return _compile_law(function, fastmath=False)


def large_law(function: _F) -> _F:
    """Compile a large function for use in other compiled functions, which call it instead of containing its code.

    A call from Python runs compiled code, too.
    """
    return _compile_law(function, fastmath=False, inlined=False)


def contracted(function: _F) -> _F:
    """Compile a small function for use in other compiled functions, with fused multiply-adds allowed.

    A division may also become a product with the reciprocal. The last digits of the results then depend on the
    processor, but not on how the data are split into blocks or lanes (`physics.lanes`).
    """
    return _compile_law(function, fastmath={"contract", "arcp"})  # fused multiply-adds, reciprocals


class Entry:
    """A compiled function with the C signature double f(double *memory, double *input), called by its address.

    It is compiled when its `address` is first requested.
    """

    _SIGNATURE = numba.float64(types.CPointer(numba.float64), types.CPointer(numba.float64))

    def __init__(self, function: Callable[..., Any]) -> None:
        """Prepare the compilation of `function`, which takes two arrays of doubles and returns a double."""
        self._address = _compiler().compile_at_address(function, self._SIGNATURE, cache_directory())

    @cached_property
    def address(self) -> int:
        """Address of the compiled function, for calls from C, ctypes and `call_at`."""
        return int(self._address())


def entry(function: Callable[..., Any]) -> Entry:
    """Wrap a function of two arrays of doubles in an `Entry`, for calls by its address from kernels and from C."""
    return Entry(function)


@intrinsic  # type: ignore[misc]
def call_at(context: Any, address: Any, memory: Any, sample: Any) -> Any:
    """Call the function double f(double *memory, double *sample) at an address, and return its result.

    For use in compiled code only. The function's `address`, `memory` and `sample` are addresses as 64-bit integers.
    Numba passes `context`, and gets the signature of the call and the generator of its code (`emit_call`).
    """

    def emit_call(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Emit the LLVM instructions that call the function at the address; return its result, a double.

        Numba passes the arguments. `values` are the addresses of the function, of `memory` and of `sample`: 64-bit
        integers, which are converted to pointers here.
        """
        double = target.get_value_type(numba.float64)
        pointer = double.as_pointer()
        function = builder.inttoptr(values[0], llvm.FunctionType(double, [pointer, pointer]).as_pointer())
        return builder.call(function, [builder.inttoptr(value, pointer) for value in values[1:]])

    return numba.float64(numba.int64, numba.int64, numba.int64), emit_call


@intrinsic  # type: ignore[misc]
def address_of(context: Any, pointer: Any) -> Any:
    """Convert a pointer to a 64-bit integer, its address; for use in compiled code only.

    Numba passes `context`, and gets the signature of the conversion and the generator of its code (`emit_conversion`).
    """

    def emit_conversion(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Emit the LLVM instruction that converts the pointer to a 64-bit integer; return its result.

        Numba passes the arguments; the only item of `values` is the pointer.
        """
        return builder.ptrtoint(values[0], target.get_value_type(numba.int64))

    return numba.int64(pointer), emit_conversion


def record_dtype(*numbers: str, **parts: Any) -> np.dtype[Any]:
    """Build the NumPy dtype of a record of doubles.

    `numbers`: names of the fields that are single doubles; they come first. `parts`: further fields by name, each with
    the shape of an array of doubles or with the dtype of a nested record.
    """
    further = [(name, part) if isinstance(part, np.dtype) else (name, "f8", part) for name, part in parts.items()]
    return np.dtype([*((name, "f8") for name in numbers), *further])  # f8: NumPy's name of a double


def make_record(layout: np.dtype[Any], source: object = None, **values: Any) -> np.recarray[Any, Any]:
    """Make a record array (1,) with the dtype `layout`.

    Each field is taken from `values`, else from the attribute of `source` with its name, else zero.
    """
    record = np.zeros(1, layout).view(np.recarray)
    for name in layout.fields or ():
        record[name] = values.get(name, getattr(source, name, 0.0))
    return record


def record_view(layout: Any) -> Callable[[Any], Any]:
    """Build a compiled function that views the doubles at a pointer as a record, without copying them.

    `layout`: NumPy dtype of the record, with doubles and arrays of doubles as fields.
    """
    record_pointer = numba.types.CPointer(numba.from_dtype(layout))

    @intrinsic  # type: ignore[misc]
    def cast_pointer(context: Any, pointer: Any) -> Any:
        """Cast a pointer to doubles to a pointer to the record, in compiled code only.

        Numba passes `context`, and gets the signature of the cast and the generator of its code (`emit_cast`).
        """

        def emit_cast(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            """Emit the LLVM instruction that casts the pointer, the only item of `values`; return its result.

            Numba passes the arguments.
            """
            return builder.bitcast(values[0], target.get_value_type(record_pointer))

        return record_pointer(pointer), emit_cast

    @law
    def record(pointer: Any) -> Any:
        """View the doubles at a pointer as the record with the dtype `layout`."""
        return numba.carray(cast_pointer(pointer), 1)[0]

    return record  # type: ignore[no-any-return]


def plain_code(function: Callable[..., Any], *arguments: str) -> tuple[str, str]:
    """Compile a function to LLVM code that needs no Python; return the code and the function's symbol.

    `arguments`: type of each argument, "double*", "double" or "int64". The function must return an integer and
    allocate nothing. C calls it as ``int symbol(int64_t *result, void **unused, arguments...)``.
    """
    numba_types = {"double*": numba.types.CPointer(numba.float64), "double": numba.float64, "int64": numba.int64}
    signature = numba.int64(*(numba_types[argument] for argument in arguments))
    dispatcher = numba.njit(signature, nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    (compiled,) = dispatcher.overloads.values()
    text = dispatcher.inspect_llvm(compiled.signature.args)
    # remove numba's reference counting, which is not called and is specific to one processor
    text = re.sub(r"^define linkonce_odr void @NRT_decref\(.*?^}\n", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^declare .* @(NRT_MemInfo_call_dtor|llvm\.x86\.[\w.]+)\(.*\n", "", text, flags=re.MULTILINE)
    return text, compiled.fndesc.llvm_func_name
