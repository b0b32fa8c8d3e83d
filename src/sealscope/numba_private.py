"""Compile by numba's private classes: fewer passes, and a cache that treats damaged files as cache misses.

A law is a function that only other compiled functions call. This module is imported only for numba versions within
`compiled.KNOWN_VERSIONS`; others use `numba_pipeline`. `tests/physics/test_numba_names.py` checks all private names.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numba
from numba.core import config, types
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.lowering import Lower
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import (
    AnnotateTypes,
    BaseNativeLowering,
    IRLegalization,
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

from sealscope.numba_pipeline import ConstantLengths

_log = logging.getLogger(__name__)


class TolerantCache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of compiled code, changed so that an unreadable or unwritable file is a cache miss."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the compiled code of a function for the argument types `sig`; None if it is missing or damaged.

        The set-up of numba takes longer than loading, and is left to the next compilation: loaded code needs none of
        it, as kernels count no references. A damaged cache is emptied.
        """
        try:
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
        except Exception as error:  # unpickling a truncated file raises errors of many classes
            _log.debug("compiled code in %s is damaged: %s", self.cache_path, error)
            with suppress(OSError):
                self.flush()
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the compiled code `data` of a function for the argument types `sig`; an error is only logged."""
        try:
            super().save_overload(sig, data)
        except Exception as error:
            _log.debug("cannot save compiled code in %s: %s", self.cache_path, error)


class _Lower(Lower):  # type: ignore[misc]
    """numba's translation into LLVM code, with fewer instructions where a number of an array is read or set.

    An array is a value of seven or more fields, which numba copies to memory at each access; the optimiser has to find
    out that this has no effect.
    """

    def _address_of_number(self, array: Any, index: Any) -> Any:
        """Emit code for the address of a number of a contiguous array; None if it is another array or index.

        `array`, `index`: numba's variables. As in numba and Python, an index below 0 counts from the end, and none is
        checked against the array's size.
        """
        array_type, index_type = self.typeof(array.name), self.typeof(index.name)
        is_tuple = hasattr(index_type, "types")
        axis_types = index_type.types if is_tuple else (index_type,)
        if type(array_type) is not types.Array or array_type.layout != "C" or len(axis_types) != array_type.ndim:
            return None
        if not all(isinstance(axis_type, types.Integer) for axis_type in axis_types):
            return None
        if not isinstance(array_type.dtype, types.Number):
            return None
        build, cast = self.builder, self.context.cast
        fields, position = self.loadvar(array.name), self.context.data_model_manager[array_type].get_field_position
        data, shape = (build.extract_value(fields, position(name)) for name in ("data", "shape"))
        indices, place = self.loadvar(index.name), None
        for axis, axis_type in enumerate(axis_types):
            k, size = build.extract_value(indices, axis) if is_tuple else indices, build.extract_value(shape, axis)
            k = cast(build, k, axis_type, types.intp)
            if axis_type.signed:
                k = build.select(build.icmp_signed("<", k, k.type(0)), build.add(k, size), k)
            place = k if place is None else build.add(build.mul(place, size), k)
        return build.gep(data, [place])

    def lower_getitem(self, result_type: Any, expression: Any, value: Any, index: Any, signature: Any) -> Any:
        """Emit code that reads an element."""
        address = self._address_of_number(value, index)
        if address is None:
            return super().lower_getitem(result_type, expression, value, index, signature)
        number_type = self.typeof(value.name).dtype
        number = self.context.unpack_value(self.builder, number_type, address)
        return self.context.cast(self.builder, number, number_type, result_type)

    def lower_setitem(self, target: Any, index: Any, value: Any, signature: Any) -> Any:
        """Emit code that sets an element."""
        address = self._address_of_number(target, index)
        if address is None:
            return super().lower_setitem(target, index, value, signature)
        number_type = self.typeof(target.name).dtype
        number = self.context.cast(self.builder, self.loadvar(value.name), self.typeof(value.name), number_type)
        return self.context.pack_value(self.builder, number_type, number, address)


@register_pass(mutates_CFG=True, analysis_only=False)  # type: ignore[untyped-decorator]
class _Lowering(BaseNativeLowering):  # type: ignore[misc]
    """numba's pass that translates a function into LLVM code, by `_Lower`."""

    _name = "sealscope_lowering"
    lowering_class = _Lower


#: Passes that code of numbers and arrays needs; those for closures, literals and array expressions are left out.
_PASSES = (
    *(TranslateByteCode, FixupArgs, IRProcessing, RewriteSemanticConstants, ConstantLengths, DeadBranchPrune),
    *(GenericRewrites, ReconstructSSA, NopythonTypeInference, PreLowerStripPhis, IRLegalization, AnnotateTypes),
    *(_Lowering, NoPythonBackend),
)


class _ShortCompiler(CompilerBase):  # type: ignore[misc]
    """numba's compiler with only the passes in `_PASSES`."""

    def compile_extra(self, function: Any) -> Any:
        """Compile a function, and the laws it calls, without collections of garbage, which take a tenth of the time.

        Most objects that the compiler makes live as long as the compiled function.
        """
        collects = gc.isenabled()
        gc.disable()
        try:
            return super().compile_extra(function)
        finally:
            if collects:
                gc.enable()

    def define_pipelines(self) -> list[Any]:
        """Build a list with one pipeline of numba, which has the passes in `_PASSES`."""
        pipeline = PassManager("nopython")
        for step in _PASSES:
            pipeline.add_pass(step, step.__name__)
        pipeline.finalize()
        return [pipeline]


_config_lock = Lock()


def _dispatcher(function: Callable[..., Any], options: dict[str, Any], folder: Path | None) -> Any:
    """Build numba's dispatcher, which compiles the function when it is called; `options`: further ones of `njit`.

    The function allocates nothing, so that its code counts no references to arrays (`_nrt`): it writes to arrays of the
    caller. `folder`: folder of the cache, None for no cache.
    """
    options = {"pipeline_class": _ShortCompiler, "nogil": True, "error_model": "numpy", "_nrt": False, **options}
    dispatcher = numba.njit(**options)(function)
    if folder is None:
        return dispatcher
    # numba reads this global setting when the cache is made. It is restored for other users of numba in the process;
    # the lock keeps two threads that import kernels from restoring each other's value.
    with _config_lock:
        previous_folder = config.CACHE_DIR
        config.CACHE_DIR = str(folder)
        try:
            dispatcher._cache = TolerantCache(function)  # as `cache=True` does
        except (OSError, RuntimeError) as error:  # the folder is gone
            _log.debug("cannot cache compiled code in %s: %s", folder, error)
        finally:
            config.CACHE_DIR = previous_folder
    return dispatcher


def compile_kernel(function: Callable[..., Any], folder: Path | None) -> Any:
    """Prepare a function for compilation at Python's first call; `folder`: cache, None for none."""
    return _dispatcher(function, {"no_cfunc_wrapper": True}, folder)


class _LawLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Compiled code of a function that only other compiled functions call, without machine code of its own.

    The code is linked into these functions as LLVM code. It is optimised here once, not in each function that calls it,
    so that all of them compute identical results.
    """

    def _optimize_functions(self, module: Any) -> None:
        """Leave out the passes over single functions: those over the whole library, which follow, repeat them.

        Kernels keep them: without, single-precision sums of contracted laws are rounded otherwise.
        """
        module.data_layout = self._codegen._data_layout

    def _finalize_final_module(self) -> None:
        """Mark the library as final without generating machine code, which numba would do here."""
        self._finalized = True


class _LawCompiler(_ShortCompiler):
    """Compiler of laws, the functions for other compiled functions; its result is LLVM code in a `_LawLibrary`."""

    def define_pipelines(self) -> list[Any]:
        """Build a list with one pipeline of numba, with the passes in `_PASSES` but without machine code."""
        self.state.flags.no_compile = True
        self.state.library = _LawLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()


class _Law(CPUDispatcher):  # type: ignore[misc]
    """A law, i.e. a function for other compiled functions, without numba's wrapper for calls from Python.

    The wrapper, which unpacks and checks each argument, takes longer to compile than the law. Without it, Python cannot
    call the compiled code. Python's calls run the uncompiled source of a small law, which is inlined. They compile a
    large law a second time, as a kernel with the wrapper, which is cached in `folder`.
    """

    folder: Path | None = None

    def add_overload(self, cres: Any) -> None:
        """Register the compiled code `cres` for other compiled functions, without an entry point for Python.

        Raises TypeError if a law returns an array: it counts no references to one (`compile_law`).
        """
        if isinstance(cres.signature.return_type, types.Array):
            raise TypeError(f"a law must return numbers, got an array ({self.py_func.__qualname__})")
        placeholder = object()  # in place of the entry point, under which numba finds the code
        self.targetctx.insert_user_function(placeholder, cres.fndesc, [cres.library])
        self.overloads[tuple(cres.signature.args)] = cres._replace(entry_point=placeholder)

    @cached_property
    def _for_python(self) -> Any:
        """The function that Python calls: uncompiled for a small (inlined) law, a kernel for a large one."""
        return self.py_func if self.targetoptions["forceinline"] else compile_kernel(self.py_func, self.folder)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._for_python(*arguments, **named)


def compile_law(function: Callable[..., Any], fastmath: Any, inlined: bool, folder: Path | None) -> Any:
    """Prepare a law for compilation when it is first needed.

    `fastmath`: as for `numba.njit`; `inlined`: True to insert the law's code in place of each call; `folder`: cache for
    Python's calls of a large law (`_Law`), None without a cache.
    """
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "fastmath": fastmath, "forceinline": inlined}
    # _nrt: no reference counting, as a law allocates nothing
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}
    law = _Law(function, targetoptions=options, pipeline_class=_LawCompiler)
    law.folder = folder
    return law


def compile_at_address(function: Callable[..., Any], signature: Any, folder: Path | None) -> Callable[[], int]:
    """Build a function that compiles `function` for C by its `signature` and returns its address; `folder`: cache."""
    dispatcher = _dispatcher(function, {"no_cpython_wrapper": True}, folder)

    def compile_address() -> int:
        """Compile the function and return its address."""
        dispatcher.compile(signature)
        code = dispatcher.overloads[signature.args]
        return int(code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name))

    return compile_address
