"""Compile by numba's documented extension points: its whole pipeline with one additional pass, without a cache.

The pass decides which laws a rig has before types are inferred; otherwise the code of an absent law would be typed, and
fail. `compiled` uses these functions for versions of numba whose private names are not known (`numba_private`). The
results are the same, but each process compiles anew.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
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


@register_pass(mutates_CFG=False, analysis_only=False)  # type: ignore[untyped-decorator]
class ConstantLengths(FunctionPass):  # type: ignore[misc]
    """Compiler pass that replaces `len` of a tuple or array of known size by a constant.

    It applies to `len(p)` of an argument `p` that is a tuple, and to `len(p.law)` of a field `law` of a named tuple or
    record `p`, if this field is a tuple or an array. A law of physics that a rig lacks has the length 0. Branches on
    the length are thus decided before types are inferred, and the code of an absent law is not compiled.
    """

    _name = "sealscope_settled_laws"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Replace `len` of arguments of known size by constants in numba's `state.func_ir`; return True if any was."""
        code, changed = state.func_ir, False
        find_definition = partial(guard, get_definition, code)  # the one expression that defines a variable, or None

        def type_of(source: Any) -> Any:
            """Find the numba type of `source`, an argument of the compiled function or its attribute; else None."""
            if isinstance(source, ir.Arg):
                return state.args[source.index]
            owner = find_definition(source.value) if getattr(source, "op", None) == "getattr" else None
            owner_type = state.args[owner.index] if isinstance(owner, ir.Arg) else None
            if isinstance(owner_type, types.BaseNamedTuple) and source.attr in owner_type.fields:
                return owner_type.types[owner_type.fields.index(source.attr)]
            if isinstance(owner_type, types.Record) and source.attr in owner_type.fields:
                return owner_type.typeof(source.attr)
            return None

        def find_length(value: Any) -> int | None:
            """Find the result of the expression `value` if it is `len` of a tuple or array of known size, else None."""
            if getattr(value, "op", None) != "call" or len(value.args) != 1:
                return None
            if getattr(find_definition(value.func), "value", None) is not len:
                return None
            argument_type = type_of(find_definition(value.args[0]))
            if isinstance(argument_type, types.NestedArray):
                return int(argument_type.shape[0])
            return argument_type.count if isinstance(argument_type, types.BaseTuple) else None

        for block in code.blocks.values():
            for statement in block.body:
                value = statement.value if isinstance(statement, ir.Assign) else None
                length = find_length(value)
                if length is not None:
                    statement.value = ir.Const(length, statement.loc)
                    # numba also lists the values of each variable, where it looks for definitions
                    definitions = code._definitions[statement.target.name]
                    definitions[definitions.index(value)] = statement.value
                    changed = True
        return changed


class _FullCompiler(CompilerBase):  # type: ignore[misc]
    """numba's own compiler, with `ConstantLengths` after its pass that replaces other constants."""

    def define_pipelines(self) -> list[Any]:
        """Build a list with numba's usual pipeline, to which the pass `ConstantLengths` is added."""
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state, "sealscope")
        pipeline.add_pass_after(ConstantLengths, RewriteSemanticConstants)
        pipeline.finalize()
        return [pipeline]


_OPTIONS = {"nogil": True, "error_model": "numpy", "pipeline_class": _FullCompiler}


def compile_kernel(function: Callable[..., Any], folder: Path | None) -> Any:
    """Prepare a function for compilation at Python's first call; `folder`: unused."""
    return numba.njit(**_OPTIONS)(function)


def compile_law(function: Callable[..., Any], fastmath: Any, inlined: bool, folder: Path | None) -> Any:
    """Compile a law, a function that compiled functions call; `folder`: unused.

    `fastmath`: as for `numba.njit`; `inlined`: True if Python is to run the uncompiled function.
    """
    if inlined:
        return register_jitable(fastmath=fastmath, **_OPTIONS)(function)
    return compile_kernel(function, folder)


def compile_at_address(function: Callable[..., Any], signature: Any, folder: Path | None) -> Callable[[], int]:
    """Build a function that compiles `function` for C by its `signature` and returns its address; `folder`: unused."""
    callbacks: list[Any] = []  # keeps the compiled code in memory

    def compile_address() -> int:
        """Compile `function` for C's calling convention and return the address of its machine code."""
        callback = numba.cfunc(signature, **_OPTIONS)(function)
        callbacks.append(callback)
        return int(callback.address)

    return compile_address
