"""Lanes: vectors of doubles that the laws take in place of one number.

One source serves one run, eight on a processor's vector registers, and one a thread on a GPU.

A law written without branches on its numbers (`select` instead of `if`) is compiled for plain floats and for `LANES`
alike; each operation on lanes is one instruction over a whole vector register where the processor has it (two or four
where its registers are shorter), by construction and not by a compiler's guess. Products and sums of lanes may be
contracted to fused multiply-adds, so a lane and a plain run agree to rounding, not to the bit. Lanes live inside
compiled functions only: `load` and `store` move them from and to rows of arrays. On a GPU, and in plain Python as its
simulator runs it, there are no lanes: each thread has one run, and `load` and `store` move one plain number, that of
the thread's own place in the row.
"""

from __future__ import annotations

import math
import operator
import threading
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.typing import Context
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model

from sealscope.compiled import contracted

#: Runs side by side: a register of 512 bits; threads of a GPU that run in step, and so the places of a row there.
WIDTH, WARP = 8, 32
_FLAGS = ("contract",)


class Lanes(types.Type):  # type: ignore[misc]
    """WIDTH doubles."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes({WIDTH})")

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Say that any number becomes lanes safely."""
        from numba.core.typeconv import Conversion

        return Conversion.safe if isinstance(other, types.Number) else None


class Mask(types.Type):  # type: ignore[misc]
    """WIDTH truth values."""

    def __init__(self) -> None:
        super().__init__(name=f"Mask({WIDTH})")


LANES, MASK = Lanes(), Mask()
_DOUBLE, _BIT, _LONG = (ir.VectorType(kind, WIDTH) for kind in (ir.DoubleType(), ir.IntType(1), ir.IntType(64)))


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLE)


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BIT)


def _spread(builder: Any, scalar: Any) -> Any:
    """Return the same number in every lane."""
    zero = ir.Constant(ir.IntType(32), 0)
    first = builder.insert_element(ir.Constant(_DOUBLE, ir.Undefined), scalar, zero)
    return builder.shuffle_vector(first, first, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH))


def _as_lanes(context: Any, builder: Any, value: Any, kind: Any) -> Any:
    if isinstance(kind, Lanes):
        return value
    return _spread(builder, context.cast(builder, value, kind, types.float64))


@lower_cast(types.Number, Lanes)  # type: ignore[untyped-decorator]
def _cast(context: Any, builder: Any, kind: Any, to: Any, value: Any) -> Any:
    return _as_lanes(context, builder, value, kind)


def _both(args: tuple[Any, ...]) -> bool:
    return any(isinstance(arg, Lanes) for arg in args) and all(isinstance(arg, Lanes | types.Number) for arg in args)


def _define(function: Any, result: Any, build: Any) -> None:
    """Let `function` take lanes (and plain numbers beside them): `build(builder, *values)` makes the instructions."""

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            return signature(result, *args) if not kws and _both(args) else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return build(builder, *(_as_lanes(context, builder, v, k) for v, k in zip(args, sig.args, strict=True)))

    for kinds in ((Lanes,), (Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(function, *kinds)(lower)


def _arithmetic(name: str) -> Any:
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_FLAGS)


def _quotient(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Return lanes over one number: times its reciprocal, which is found once where the number does not change."""
    number = context.cast(builder, args[1], sig.args[1], types.float64)
    reciprocal = builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), number)
    return builder.fmul(args[0], _spread(builder, reciprocal), flags=_FLAGS)


_ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_ORDER = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "=="}
for _function, _name in _ARITHMETIC.items():
    _define(_function, LANES, _arithmetic(_name))
for _function, _sign in _ORDER.items():
    _define(_function, MASK, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b))
lower_builtin(operator.truediv, Lanes, types.Number)(_quotient)
_define(operator.neg, LANES, lambda builder, a: builder.fneg(a))


def _called(name: str, arity: int = 1) -> Any:
    """Return an LLVM intrinsic over the lanes."""

    def build(builder: Any, *values: Any) -> Any:
        kind = ir.FunctionType(_DOUBLE, [_DOUBLE] * arity)
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f64")
        return builder.call(function, values)

    return build


_define(math.sqrt, LANES, _called("sqrt"))
_define(abs, LANES, _called("fabs"))
_define(math.copysign, LANES, _called("copysign", 2))
_define(math.pow, LANES, _called("pow", 2))  # lane by lane
_define(min, LANES, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))
_define(max, LANES, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))


for _function, _name in ((operator.and_, "and_"), (operator.or_, "or_")):

    @infer_global(_function)
    class _MaskTemplate(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            return signature(MASK, *args) if not kws and args == (MASK, MASK) else None

    lower_builtin(_function, Mask, Mask)(lambda context, builder, sig, args, name=_name: getattr(builder, name)(*args))


def lowered(function: Any, arity: int, result: Any, build: Any) -> None:
    """Give a plain function a compiled form too.

    `result(kinds, device)` is the kind of what it returns (None where it does not take these kinds), and
    `build(context, builder, kinds, values)` makes the instructions. `device` is true where code for a GPU is made.
    """

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if len(args) != arity or kws:
                return None
            kind = result(args, not isinstance(self.context, Context))
            return None if kind is None else signature(kind, *args)

    lower_builtin(function, *[types.Any] * arity)(
        lambda context, builder, sig, args: build(context, builder, sig.args, args)
    )


def select(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` where the condition holds, `no` elsewhere; both are computed."""
    return yes if condition else no


def _select(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    if any(isinstance(kind, Lanes | Mask) for kind in kinds):
        a, b = (_as_lanes(context, builder, v, k) for v, k in zip(values[1:], kinds[1:], strict=True))
    else:
        a, b = (context.cast(builder, v, k, types.float64) for v, k in zip(values[1:], kinds[1:], strict=True))
    return builder.select(values[0], a, b)


lowered(
    select, 3, lambda kinds, _: LANES if any(isinstance(k, Lanes | Mask) for k in kinds) else types.float64, _select
)


def anywhere(condition: Any) -> Any:
    """Whether a condition holds in any lane; of a plain truth value: itself."""
    return condition


def _anywhere(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    if not isinstance(kinds[0], Mask):
        return values[0]
    return builder.icmp_unsigned("!=", builder.bitcast(values[0], ir.IntType(WIDTH)), ir.Constant(ir.IntType(WIDTH), 0))


lowered(anywhere, 1, lambda *_: types.boolean, _anywhere)


def power_of_two(n: Any) -> Any:
    """2^n for whole n in -1022..1023; compiled, from the bits of a double."""
    return math.ldexp(1.0, int(n))


def _power_of_two(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    lanes = isinstance(kinds[0], Lanes)
    whole, real = (_LONG, _DOUBLE) if lanes else (ir.IntType(64), ir.DoubleType())

    def constant(kind: Any, value: float) -> Any:
        return ir.Constant(kind, [value] * WIDTH if lanes else value)

    # the last bits of 1.5 * 2^52 + k are those of the whole number k: no conversion, which lanes have only one by one
    biased = builder.bitcast(builder.fadd(values[0], constant(real, _ROUND + 1023.0)), whole)
    return builder.bitcast(builder.shl(biased, constant(whole, 52)), real)


lowered(power_of_two, 1, lambda kinds, _: kinds[0], _power_of_two)


def _is_block(array: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype == types.float64 and array.layout == "C"


def on_device(context: Any) -> bool:
    """Whether a target context makes code for a GPU."""
    return not isinstance(context.typing_context, Context)


def _place(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    """Where the lanes of a row are; on a GPU, where the number of this thread is."""
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    row = context.cast(builder, values[1], kinds[1], types.intp)
    if on_device(context):
        kind = ir.FunctionType(ir.IntType(32), [])
        thread = cgutils.get_or_insert_function(builder.module, kind, "llvm.nvvm.read.ptx.sreg.tid.x")
        own = builder.and_(builder.call(thread, []), ir.Constant(ir.IntType(32), WARP - 1))
        at = builder.mul(row, ir.Constant(row.type, WARP))
        return cgutils.gep_inbounds(builder, data, builder.add(at, builder.zext(own, row.type)))
    at = builder.mul(row, ir.Constant(row.type, WIDTH))
    return builder.bitcast(cgutils.gep_inbounds(builder, data, at), _DOUBLE.as_pointer())


def _own(array: Any, row: int) -> tuple[Any, int]:
    """Return all numbers of an array, and the place of this thread's number of a row among them, in plain Python.

    The simulator wraps arrays twice, and each attribute of its wrappers is slow.
    """
    for wrapper in ("_item", "_ary"):
        array = getattr(array, wrapper, array)
    width = array.shape[-1]
    return array.reshape(-1), row * width + getattr(threading.current_thread(), "thread_id", 0) % width


def load(array: Any, row: int) -> Any:
    """Return the lanes of row `row` of a C-ordered array (..., WIDTH), rows counted through all leading axes.

    On a GPU the thread's number of row `row` of an array (..., WARP).
    """
    numbers, at = _own(array, row)
    return numbers[at]


def load_number(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    """Return the instructions of `load`."""
    return builder.load(_place(context, builder, kinds, values), align=8)


def _loaded(kinds: Any, device: bool) -> Any:
    if not (_is_block(kinds[0]) and isinstance(kinds[1], types.Integer)):
        return None
    return types.float64 if device else LANES


lowered(load, 2, _loaded, load_number)


def store(array: Any, row: int, value: Any) -> None:
    """Write lanes into row `row` of a C-ordered array (..., WIDTH); on a GPU the thread's number."""
    numbers, at = _own(array, row)
    numbers[at] = value


def _store(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    builder.store(values[2], _place(context, builder, kinds, values), align=8)
    return context.get_dummy_value()


def _stored(kinds: Any, device: bool) -> Any:
    return types.none if _loaded(kinds, device) == kinds[2] else None


lowered(store, 3, _stored, _store)


def spread(value: Any) -> Any:
    """Return the same number in every lane."""
    return float(value)


def _spread_out(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    if on_device(context):
        return context.cast(builder, values[0], kinds[0], types.float64)
    return _as_lanes(context, builder, values[0], kinds[0])


lowered(spread, 1, lambda kinds, device: types.float64 if device else LANES, _spread_out)


_LOG2_E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to a whole number


@contracted
def exponential(x: Any) -> Any:
    """exp(x) for x in -708..709 (held at these ends): 2^n times a polynomial of degree 11 in r = x - n ln 2.

    Within 1e-14 of exp(x), relatively; compiled from this source for a number and for lanes.
    Source: W. J. Cody, W. Waite, Software Manual for the Elementary Functions, 1980 (reduction in two parts of ln 2);
    Taylor's polynomial, whose rest for |r| <= ln 2/2 is below 7e-15.
    """
    x = min(max(x, -708.0), 709.0)
    n = (x * _LOG2_E + _ROUND) - _ROUND
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    s = r * r
    q = s * s
    low = (1.0 + r) + s * (0.5 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + s * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + s * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    return (low + q * (middle + q * high)) * power_of_two(n)
