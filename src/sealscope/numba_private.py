"""Compilation by numba's private classes: less of its work, and a cache whose damaged files are cache misses.

Imported for a version within `VERSIONS` alone; `NAMES` and `ATTRIBUTES` are all that this module relies on, and
`tests/physics/test_numba_names.py` looks at each. Elsewhere `numba_pipeline` compiles.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numba
from numba.core import config
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
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

from sealscope.numba_pipeline import SettledLaws

_log = logging.getLogger(__name__)
#: Names that are imported, by module.
NAMES = {
    "numba.core.caching": ("FunctionCache",),
    "numba.core.codegen": ("JITCodeLibrary",),
    "numba.core.compiler_machinery": ("PassManager",),
    "numba.core.registry": ("CPUDispatcher",),
    "numba.core.runtime": ("rtsys",),
    "numba.core.typed_passes": (
        *("AnnotateTypes", "IRLegalization", "NativeLowering", "NoPythonBackend", "NopythonTypeInference"),
        "PreLowerStripPhis",
    ),
    "numba.core.untyped_passes": (
        *("DeadBranchPrune", "FixupArgs", "GenericRewrites", "IRProcessing", "ReconstructSSA"),
        *("RewriteSemanticConstants", "TranslateByteCode"),
    ),
}
#: Attributes of these classes and modules that are overridden, called or set.
ATTRIBUTES = {
    "numba.core.caching:FunctionCache": (
        *("load_overload", "_load_overload", "_guard_against_spurious_io_errors"),
        *("save_overload", "flush", "cache_path"),
    ),
    "numba.core.codegen:JITCodeLibrary": ("_finalize_final_module", "get_pointer_to_function"),
    "numba.core.compiler:CompilerBase": ("define_pipelines",),
    "numba.core.compiler_machinery:PassManager": ("add_pass", "finalize"),
    "numba.core.registry:CPUDispatcher": ("add_overload", "compile"),
    "numba.core.runtime:rtsys": ("initialize",),
    "numba.core.config": ("CACHE_DIR",),
}


class PatientCache(FunctionCache):  # type: ignore[misc]
    """numba's cache, where a file that cannot be read or written is a cache miss."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled code of a signature, None where there is none or it is damaged.

        Of what numba prepares before it compiles, which takes longer than the loading, machine code needs the memory's
        reference counts alone. A compilation prepares the rest.
        """
        try:
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                return self._load_overload(sig, target_context)
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


#: What of numba's compiler numbers and arrays need, closures, literals and expressions of whole arrays apart.
_PASSES = (
    *(TranslateByteCode, FixupArgs, IRProcessing, RewriteSemanticConstants, SettledLaws, DeadBranchPrune),
    *(GenericRewrites, ReconstructSSA, NopythonTypeInference, PreLowerStripPhis, IRLegalization, AnnotateTypes),
    *(NativeLowering, NoPythonBackend),
)


class _ShortCompiler(CompilerBase):  # type: ignore[misc]
    """numba's compiler, reduced to `_PASSES`."""

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline."""
        pipeline = PassManager("nopython")
        for step in _PASSES:
            pipeline.add_pass(step, step.__name__)
        pipeline.finalize()
        return [pipeline]


_one_at_a_time = Lock()


def _dispatcher(function: Callable[..., Any], options: dict[str, Any], folder: Path | None) -> Any:
    dispatcher = numba.njit(pipeline_class=_ShortCompiler, nogil=True, error_model="numpy", **options)(function)
    if folder is None:
        return dispatcher
    # numba reads the folder when the decorator runs; other users of numba in this process keep theirs. Two threads that
    # import kernels at once would take each other's setting: none at all is the working directory.
    with _one_at_a_time:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(folder)
        try:
            dispatcher._cache = PatientCache(function)  # as `cache=True` does
        except (OSError, RuntimeError) as error:  # the folder is gone
            _log.debug("cannot cache compiled code in %s: %s", folder, error)
        finally:
            config.CACHE_DIR = before
    return dispatcher


def compile_kernel(function: Callable[..., Any], fastmath: Any, folder: Path | None) -> Any:
    """Compile a function that Python calls, and cache it in `folder`."""
    return _dispatcher(function, {"no_cfunc_wrapper": True, "fastmath": fastmath}, folder)


class _LawLibrary(JITCodeLibrary):  # type: ignore[misc]
    """The code of a law, which kernels are linked with: without machine code, for no address of it is asked for.

    It is optimised here, not anew within each kernel: a law gives the same bits in all of them.
    """

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _LawCompiler(_ShortCompiler):
    """The compiler of laws, which makes no machine code: it is a fifth of the time that a kernel takes."""

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline."""
        self.state.flags.no_compile = True
        self.state.library = _LawLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()


class _Law(CPUDispatcher):  # type: ignore[misc]
    """A function that other compiled functions take in whole: made without the code by which Python calls it.

    That code unpacks and checks each argument and takes more time to make than the law itself. Called from Python, a
    small law is run by Python, a large one is compiled a second time, as a kernel is, and cached in `folder`.
    """

    folder: Path | None = None

    def add_overload(self, cres: Any) -> None:
        """Keep compiled code for other compiled functions; nothing that Python could call."""
        name = object()  # in place of machine code
        self.targetctx.insert_user_function(name, cres.fndesc, [cres.library])
        self.overloads[tuple(cres.signature.args)] = cres._replace(entry_point=name)

    @cached_property
    def _for_python(self) -> Any:
        inlined = self.targetoptions["forceinline"]
        return self.py_func if inlined else compile_kernel(self.py_func, self.targetoptions["fastmath"], self.folder)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call from Python."""
        return self._for_python(*arguments, **named)


def compile_law(function: Callable[..., Any], fastmath: Any, inlined: bool, folder: Path | None) -> Any:
    """Compile a function that other compiled functions call, `inlined` at each of its calls."""
    options = {"nopython": True, "nogil": True, "error_model": "numpy", "fastmath": fastmath, "forceinline": inlined}
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    options |= {} if inlined else {"_nrt": False}
    law = _Law(function, targetoptions=options, pipeline_class=_LawCompiler)
    law.folder = folder
    return law


def compile_at_address(function: Callable[..., Any], signature: Any, folder: Path | None) -> Callable[[], int]:
    """Prepare a function that C calls; what is returned compiles it, and returns its address."""
    dispatcher = _dispatcher(function, {"no_cpython_wrapper": True}, folder)

    def address() -> int:
        dispatcher.compile(signature)
        code = dispatcher.overloads[signature.args]
        return int(code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name))

    return address
