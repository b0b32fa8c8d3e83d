"""The one way a function is compiled: numba, with a cache that cannot return old physics.

Plain ``cache=True`` keys a kernel by its own file only, so an edit to a law in another file leaves the kernel's
old machine code valid and silently wrong. Here the cache directory is named by a hash over the sources of every
package that holds compiled code, the versions of numba and Python and the processor, and lies in the user's cache
folder (never in site-packages, which may be read-only). `SEALSCOPE_CACHE_DIR` moves it; an empty value turns caching
off.

Compiled code is unpickled, which can run any command: only folders of the user that nobody else can write are used. A
file of the cache that is cut off or cannot be written is a cache miss.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir as llvm
from numba import types
from numba.core import config, ir
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import FunctionPass, PassManager, register_pass
from numba.core.ir_utils import get_definition, guard
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import (
    AnnotateTypes,
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    RewriteSemanticConstants,
    TranslateByteCode,
)
from numba.extending import intrinsic

config._config_fname = ""  # numba's settings in the working folder may be hostile, and name a library to load
config.reload_config()
_F = TypeVar("_F", bound=Callable[..., Any])
_WALK = "monitor/sources/message_limits.py"
_COMPILED_PACKAGES = ("compiled.py", "physics", "signals", "control", "simulation", "diagnosis", _WALK)
_KEPT_GENERATIONS = 4
_log = logging.getLogger(__name__)


def source_hash(root: Path) -> str:
    """Hash of every source file, and of the numbers beside them, in the compiled packages under `root`."""
    digest = hashlib.sha256()
    for package in _COMPILED_PACKAGES:
        place = root / package
        files = (path for path in place.rglob("*") if path.suffix in (".py", ".toml"))
        for path in sorted(files) if place.is_dir() else [place]:
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


def _check_owner(folder: Path, forbidden: int) -> None:
    """Raise PermissionError unless `folder` is a directory, no link, of this user, without the `forbidden` bits."""
    status = folder.lstat()
    if not hasattr(os, "getuid"):  # Windows keeps the folders of a user to itself
        return
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & forbidden:
        raise PermissionError(f"{folder} must be a folder of this user alone")


def _private(folder: Path) -> None:
    """Make a folder with mode 0700; raise OSError where one is there that another user owns or can write."""
    folder.mkdir(mode=0o700, exist_ok=True)
    _check_owner(folder, 0o022)
    if folder.lstat().st_mode & 0o077:
        folder.chmod(0o700)
    _check_owner(folder, 0o077)


@cache
def cache_directory() -> Path | None:
    """Return the directory of this source's compiled code, made if need be; None where none can be written safely."""
    base = _user_cache_folder()
    if base is None:
        return None
    environment = f"{numba.__version__} {platform.python_version()} {platform.machine()} {config.CPU_NAME}"
    key = hashlib.sha256((source_hash(Path(__file__).parent) + environment).encode()).hexdigest()[:20]
    for temporary in (False, True):
        directory = Path("kernels") / key
        try:
            if temporary:  # anybody can make a folder of this name
                user = os.getuid() if hasattr(os, "getuid") else "user"
                base = Path(tempfile.gettempdir()) / f"sealscope-{user}"
                _private(base)
            else:
                base.mkdir(mode=0o700, parents=True, exist_ok=True)
                _check_owner(base.resolve(), 0o022)
            directory = base / directory
            _private(directory.parent)
            _private(directory)
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


_one_at_a_time = Lock()


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache, where a file that cannot be read or written is a cache miss."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code of a signature, None where there is none or it is damaged."""
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # unpickling a cut-off file raises many kinds
            _log.debug("compiled code in %s is damaged: %s", self.cache_path, error)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled code of a signature, if there is room for it."""
        try:
            super().save_overload(sig, data)
        except Exception as error:
            _log.debug("cannot save compiled code in %s: %s", self.cache_path, error)


@register_pass(mutates_CFG=False, analysis_only=False)  # type: ignore[untyped-decorator]
class _SettledLaws(FunctionPass):  # type: ignore[misc]
    """Replace len(p.law) by its number, `p` an argument that is a named tuple or a record, `law` a tuple or an array.

    So is len(choice) of an argument that is a tuple itself. Branches on it are then settled before types are inferred,
    and a law that is absent is not even compiled.
    """

    _name = "sealscope_settled_laws"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Run the pass; True where it changed something."""
        code, changed = state.func_ir, False

        def definition(variable: Any) -> Any:
            return guard(get_definition, code, variable)

        def type_of(given: Any) -> Any:
            if isinstance(given, ir.Arg):
                return state.args[given.index]
            numbers = definition(given.value) if getattr(given, "op", None) == "getattr" else None
            kind = state.args[numbers.index] if isinstance(numbers, ir.Arg) else None
            if isinstance(kind, types.BaseNamedTuple) and given.attr in kind.fields:
                return kind.types[kind.fields.index(given.attr)]
            return kind.typeof(given.attr) if isinstance(kind, types.Record) and given.attr in kind.fields else None

        def length(value: Any) -> int | None:
            if getattr(value, "op", None) != "call" or len(value.args) != 1:
                return None
            if getattr(definition(value.func), "value", None) is not len:
                return None
            kind = type_of(definition(value.args[0]))
            if isinstance(kind, types.NestedArray):
                return int(kind.shape[0])
            return kind.count if isinstance(kind, types.BaseTuple) else None

        for block in code.blocks.values():
            for statement in block.body:
                value = statement.value if isinstance(statement, ir.Assign) else None
                count = length(value)
                if count is not None:
                    statement.value = ir.Const(count, statement.loc)
                    known = code._definitions[statement.target.name]
                    known[known.index(value)] = statement.value
                    changed = True
        return changed


#: What of numba's compiler numbers and arrays need, closures, literals and expressions of whole arrays apart.
_PASSES = (
    *(TranslateByteCode, FixupArgs, IRProcessing, RewriteSemanticConstants, _SettledLaws, DeadBranchPrune),
    *(GenericRewrites, ReconstructSSA, NopythonTypeInference, PreLowerStripPhis, IRLegalization, AnnotateTypes),
    *(NativeLowering, NoPythonBackend),
)


class _Compiler(CompilerBase):  # type: ignore[misc]
    """numba's compiler, reduced to `_PASSES`."""

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline."""
        pipeline = PassManager("nopython")
        for own in _PASSES:
            pipeline.add_pass(own, own.__name__)
        pipeline.finalize()
        return [pipeline]


def kernel(function: _F, fastmath: Any = False) -> _F:
    """Compile `function` (no Python objects, GIL released) with the safe cache; errors in floats follow IEEE 754."""
    return _cached(function, {"no_cfunc_wrapper": True, "fastmath": fastmath})


def _cached(function: _F, own: dict[str, Any]) -> _F:
    directory = cache_directory()
    options = {"nogil": True, "error_model": "numpy"} | own
    dispatcher = numba.njit(pipeline_class=_Compiler, **options)(function)
    if directory is None:
        return dispatcher  # type: ignore[no-any-return]
    # numba reads the folder when the decorator runs; other users of numba in this process keep theirs. Two threads that
    # import kernels at once would take each other's setting: none at all is the working directory.
    with _one_at_a_time:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(directory)
        try:
            dispatcher._cache = _Cache(function)  # as `cache=True` does
        except (OSError, RuntimeError) as error:  # the folder is gone
            _log.debug("cannot cache compiled code in %s: %s", directory, error)
        finally:
            config.CACHE_DIR = before
    return dispatcher  # type: ignore[no-any-return]


class _LawLibrary(JITCodeLibrary):  # type: ignore[misc]
    """The code of a law, which kernels are linked with: without machine code, for no address of it is asked for.

    It is optimised here, not anew within each kernel: a law gives the same bits in all of them.
    """

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _LawCompiler(_Compiler):
    """The compiler of laws, which makes no machine code: it is a fifth of the time that a kernel takes."""

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline."""
        self.state.flags.no_compile = True
        self.state.library = _LawLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()


class _Law(CPUDispatcher):  # type: ignore[misc]
    """A function that other compiled functions take in whole: made without the code by which Python calls it.

    That code unpacks and checks each argument and takes more time to make than the law itself. Called from Python, a
    small law is run by Python, a large one is compiled a second time, as a kernel is.
    """

    def add_overload(self, cres: Any) -> None:
        """Keep compiled code for other compiled functions; nothing that Python could call."""
        name = object()  # in place of machine code
        self.targetctx.insert_user_function(name, cres.fndesc, [cres.library])
        self.overloads[tuple(cres.signature.args)] = cres._replace(entry_point=name)

    @cached_property
    def _for_python(self) -> Any:
        inlined = self.targetoptions["forceinline"]
        return self.py_func if inlined else kernel(self.py_func, self.targetoptions["fastmath"])

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call from Python."""
        return self._for_python(*arguments, **named)


def _law(function: _F, fastmath: Any, inline: bool = True) -> _F:
    if config.DISABLE_JIT:
        return function
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "fastmath": fastmath, "forceinline": inline}
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    options |= {} if inline else {"_nrt": False}
    return _Law(function, targetoptions=options, pipeline_class=_LawCompiler)  # type: ignore[return-value]


def law(function: _F) -> _F:
    """Compile a small law that other compiled functions call: inlined and cached with them. Python runs it itself."""
    return _law(function, False)


def large_law(function: _F) -> _F:
    """Compile a law that is too large to be inlined at each of its calls; else as `law`."""
    return _law(function, False, inline=False)


def contracted(function: _F) -> _F:
    """Compile a law whose products and sums may be contracted to fused multiply-adds.

    Divisions by what does not change may become products. Last digits depend on the processor, never on the block or
    the lane.
    """
    return _law(function, {"contract", "arcp"})


class Entry:
    """A function double f(double *memory, double *given), compiled when its address is first asked for, and cached."""

    _SIGNATURE = numba.float64(types.CPointer(numba.float64), types.CPointer(numba.float64))

    def __init__(self, function: Callable[..., Any]) -> None:
        self._dispatcher: Any = _cached(function, {"no_cpython_wrapper": True})

    @cached_property
    def address(self) -> int:
        """Where the compiled function is: C, `call_at` and ctypes can call it."""
        self._dispatcher.compile(self._SIGNATURE)
        compiled = self._dispatcher.overloads[self._SIGNATURE.args]
        return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name))


def entry(function: Callable[..., Any]) -> Entry:
    """Compile a function of two blocks of numbers that is called by its address, by kernels that do not know it."""
    return Entry(function)


@intrinsic  # type: ignore[misc]
def call_at(context: Any, address: Any, memory: Any, given: Any) -> Any:
    """Call double f(double *memory, double *given) at an address; all three are addresses as whole numbers."""

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        double = target.get_value_type(numba.float64)
        pointer = double.as_pointer()
        function = builder.inttoptr(values[0], llvm.FunctionType(double, [pointer, pointer]).as_pointer())
        return builder.call(function, [builder.inttoptr(value, pointer) for value in values[1:]])

    return numba.float64(numba.int64, numba.int64, numba.int64), generate


@intrinsic  # type: ignore[misc]
def address_of(context: Any, pointer: Any) -> Any:
    """Return the address of a pointer as a whole number."""

    def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.ptrtoint(values[0], target.get_value_type(numba.int64))

    return numba.int64(pointer), generate


def layout_of(*numbers: str, **parts: Any) -> np.dtype[Any]:
    """Return the type of a record of numbers by name, and of parts: arrays of a shape, or records of a type."""
    shaped = [(name, part) if isinstance(part, np.dtype) else (name, "f8", part) for name, part in parts.items()]
    return np.dtype([*((name, "f8") for name in numbers), *shaped])


def record_of(layout: np.dtype[Any], source: object = None, **values: Any) -> np.recarray[Any, Any]:
    """Return an array (1,) of a record: its parts are `values` or else attributes of `source` by name, or zeros."""
    record = np.zeros(1, layout).view(np.recarray)
    for name in layout.fields or ():
        record[name] = values.get(name, getattr(source, name, 0.0))
    return record


def record_at(layout: Any) -> Callable[[Any], Any]:
    """Return the law that reads a block of numbers, at the pointer to its first, as a record, in code for `plain_code`.

    `layout`: NumPy's type of a record of doubles and arrays of them; what is assigned to its parts is in the block.
    """
    kind = numba.types.CPointer(numba.from_dtype(layout))

    @intrinsic  # type: ignore[misc]
    def cast(context: Any, pointer: Any) -> Any:
        def generate(target: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.bitcast(values[0], target.get_value_type(kind))

        return kind(pointer), generate

    @law
    def record(pointer: Any) -> Any:
        return numba.carray(cast(pointer), 1)[0]

    return record  # type: ignore[no-any-return]


def plain_code(function: Callable[..., Any], *arguments: str) -> tuple[str, str]:
    """Return a function's LLVM code, free of Python, and its symbol there.

    `arguments`: "double*", "double" or "int64" each. The function returns an integer, takes pointers and numbers, and
    allocates nothing; what C calls is ``int symbol(int64_t *result, void **unused, arguments...)``.
    """
    kinds = {"double*": numba.types.CPointer(numba.float64), "double": numba.float64, "int64": numba.int64}
    signature = numba.int64(*(kinds[argument] for argument in arguments))
    dispatcher = numba.njit(signature, nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    (compiled,) = dispatcher.overloads.values()
    text = dispatcher.inspect_llvm(compiled.signature.args)
    # numba's counting of references comes with every module; nothing calls it here, and it is for one processor only
    text = re.sub(r"^define linkonce_odr void @NRT_decref\(.*?^}\n", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"^declare .* @(NRT_MemInfo_call_dtor|llvm\.x86\.[\w.]+)\(.*\n", "", text, flags=re.MULTILINE)
    return text, compiled.fndesc.llvm_func_name
