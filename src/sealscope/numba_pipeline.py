"""Compilation by numba's documented extension points: its whole pipeline with one pass of ours, and no cache.

The pass settles which laws a rig has before types are inferred; without it a law that is absent would be typed, and
fail. `compiled` takes these functions for a version of numba whose private names are not known (`numba_private`): the
results are the same; each process compiles anew.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import types
from numba.core import ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.ir_utils import get_definition, guard
from numba.core.untyped_passes import RewriteSemanticConstants
from numba.extending import register_jitable

#: Names of numba beyond its reference manual that both ways of compiling, lanes and units use, by module.
EXTENSION_NAMES = {
    "numba.core": ("cgutils", "config", "ir"),
    "numba.core.compiler": ("CompilerBase", "DefaultPassBuilder"),
    "numba.core.compiler_machinery": ("FunctionPass", "register_pass"),
    "numba.core.ir_utils": ("get_definition", "guard"),
    "numba.core.typeconv": ("Conversion",),
    "numba.core.typing.templates": ("AbstractTemplate", "infer_global", "signature"),
    "numba.core.untyped_passes": ("RewriteSemanticConstants",),
    "numba.cpython.unsafe.tuple": ("tuple_setitem",),
    "numba.np.unsafe.ndarray": ("to_fixed_tuple",),
}


@register_pass(mutates_CFG=False, analysis_only=False)  # type: ignore[untyped-decorator]
class SettledLaws(FunctionPass):  # type: ignore[misc]
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

        def type_of(source: Any) -> Any:
            if isinstance(source, ir.Arg):
                return state.args[source.index]
            numbers = definition(source.value) if getattr(source, "op", None) == "getattr" else None
            kind = state.args[numbers.index] if isinstance(numbers, ir.Arg) else None
            if isinstance(kind, types.BaseNamedTuple) and source.attr in kind.fields:
                return kind.types[kind.fields.index(source.attr)]
            return kind.typeof(source.attr) if isinstance(kind, types.Record) and source.attr in kind.fields else None

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


class _WholeCompiler(CompilerBase):  # type: ignore[misc]
    """numba's own compiler, with `SettledLaws` where it settles other constants."""

    def define_pipelines(self) -> list[Any]:
        """Return the one pipeline."""
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state, "sealscope")
        pipeline.add_pass_after(SettledLaws, RewriteSemanticConstants)
        pipeline.finalize()
        return [pipeline]


_OPTIONS = {"nogil": True, "error_model": "numpy", "pipeline_class": _WholeCompiler}


def compile_kernel(function: Callable[..., Any], fastmath: Any, folder: Path | None) -> Any:
    """Compile a function that Python calls; `folder` is not used."""
    return numba.njit(fastmath=fastmath, **_OPTIONS)(function)


def compile_law(function: Callable[..., Any], fastmath: Any, inlined: bool, folder: Path | None) -> Any:
    """Compile a function that other compiled functions call; Python runs a small (`inlined`) one itself."""
    if inlined:
        return register_jitable(fastmath=fastmath, **_OPTIONS)(function)
    return compile_kernel(function, fastmath, folder)


def compile_at_address(function: Callable[..., Any], signature: Any, folder: Path | None) -> Callable[[], int]:
    """Prepare a function that C calls; what is returned compiles it, and returns its address."""

    def address() -> int:
        callback = numba.cfunc(signature, **_OPTIONS)(function)
        kept.append(callback)
        return int(callback.address)

    kept: list[Any] = []
    return address
