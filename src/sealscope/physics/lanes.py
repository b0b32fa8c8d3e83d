"""Lanes: vectors of numbers that the laws take in place of one number.

One source serves one run and eight on a processor's vector registers (sixteen in single precision). A law written
without branches on its numbers (`select` instead of `if`) is compiled for plain floats, for `LANES` and for `SINGLES`
alike; the type of an array says which of them `load` takes from it. Each operation on lanes is one
instruction over a whole vector register where the processor has it (two or four where its registers are shorter), by
construction and not by a compiler's guess. Products and sums of lanes may be contracted to fused multiply-adds, so a
lane and a plain run agree to rounding, not to the bit. Lanes live inside compiled functions only: `load` and `store`
move them from and to rows of arrays.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model

from sealscope.compiled import contracted

#: Runs side by side: a register of 512 bits.
WIDTH = 8
#: ... and runs side by side in single precision.
SINGLE_WIDTH = 2 * WIDTH
_FLAGS = ("contract",)


class Lanes(types.Type):  # type: ignore[misc]
    """`width` numbers of a kind, float64 or float32."""

    def __init__(self, number: Any, width: int) -> None:
        self.number, self.width = number, width
        super().__init__(name=f"Lanes({number}, {width})")

    def can_convert_from(self, typingctx: Any, source: Any) -> Any:
        """Allow any number to become lanes."""
        from numba.core.typeconv import Conversion

        return Conversion.safe if isinstance(source, types.Number) else None


class Mask(types.Type):  # type: ignore[misc]
    """Truth values, one of each of the lanes."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        super().__init__(name=f"Mask({lanes.width})")


LANES, SINGLES = Lanes(types.float64, WIDTH), Lanes(types.float32, SINGLE_WIDTH)
_MASKS = {LANES: Mask(LANES), SINGLES: Mask(SINGLES)}


def _vector(lanes: Lanes) -> Any:
    """Return the vector type of LLVM's code."""
    return ir.VectorType(ir.DoubleType() if lanes.number == types.float64 else ir.FloatType(), lanes.width)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _vector(kind))


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.lanes.width))


def _spread(builder: Any, scalar: Any, lanes: Lanes) -> Any:
    """Build the instructions that put the same number into every lane."""
    zero = ir.Constant(ir.IntType(32), 0)
    first = builder.insert_element(ir.Constant(_vector(lanes), ir.Undefined), scalar, zero)
    places = ir.Constant(ir.VectorType(ir.IntType(32), lanes.width), [0] * lanes.width)
    return builder.shuffle_vector(first, first, places)


def _as_lanes(context: Any, builder: Any, value: Any, kind: Any, lanes: Lanes) -> Any:
    if isinstance(kind, Lanes):
        return value
    return _spread(builder, context.cast(builder, value, kind, lanes.number), lanes)


@lower_cast(types.Number, Lanes)  # type: ignore[untyped-decorator]
def _cast(context: Any, builder: Any, kind: Any, to: Any, value: Any) -> Any:
    return _as_lanes(context, builder, value, kind, to)


def _lanes_of(kinds: tuple[Any, ...]) -> Lanes | None:
    """Find the lanes among kinds, with plain numbers allowed between them; None for any other mixture."""
    lanes = {kind for kind in kinds if isinstance(kind, Lanes)}
    compatible = len(lanes) == 1 and all(isinstance(kind, Lanes | types.Number) for kind in kinds)
    return lanes.pop() if compatible else None


def _define(function: Any, build: Any, *, asks: bool = False) -> None:
    """Let `function` take lanes (and plain numbers beside them): `build(builder, *values)` makes the instructions.

    It returns lanes, or truth values where it `asks`.
    """

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            lanes = None if kws else _lanes_of(args)
            return None if lanes is None else signature(_MASKS[lanes] if asks else lanes, *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = _lanes_of(sig.args)
        assert lanes is not None
        return build(builder, *(_as_lanes(context, builder, v, k, lanes) for v, k in zip(args, sig.args, strict=True)))

    for kinds in ((Lanes,), (Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(function, *kinds)(lower)


def _arithmetic(name: str) -> Any:
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_FLAGS)


def _quotient(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Divide lanes by one number: multiply by its reciprocal, found once where the number does not change."""
    number = context.cast(builder, args[1], sig.args[1], types.float64)
    reciprocal = builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), number)
    lanes = sig.args[0]
    reciprocal = context.cast(builder, reciprocal, types.float64, lanes.number)
    return builder.fmul(args[0], _spread(builder, reciprocal, lanes), flags=_FLAGS)


_ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_ORDER = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "=="}
for _function, _name in _ARITHMETIC.items():
    _define(_function, _arithmetic(_name))
for _function, _sign in _ORDER.items():
    _define(_function, lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b), asks=True)
lower_builtin(operator.truediv, Lanes, types.Number)(_quotient)
_define(operator.neg, lambda builder, a: builder.fneg(a))


def _called(name: str) -> Any:
    """Build a call of an LLVM intrinsic over the lanes."""

    def build(builder: Any, *values: Any) -> Any:
        vector = values[0].type
        bits = 64 if vector.element == ir.DoubleType() else 32
        kind = ir.FunctionType(vector, [vector] * len(values))
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{vector.count}f{bits}")
        return builder.call(function, values)

    return build


_define(math.sqrt, _called("sqrt"))
_define(abs, _called("fabs"))
_define(math.copysign, _called("copysign"))
_define(math.pow, _called("pow"))  # lane by lane
_define(min, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))
_define(max, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))


for _function, _name in ((operator.and_, "and_"), (operator.or_, "or_")):

    @infer_global(_function)
    class _MaskTemplate(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            compatible = not kws and len(args) == 2 and isinstance(args[0], Mask) and args[0] == args[1]
            return signature(args[0], *args) if compatible else None

    lower_builtin(_function, Mask, Mask)(lambda context, builder, sig, args, name=_name: getattr(builder, name)(*args))


def lowered(function: Any, arity: int, result: Any, build: Any) -> None:
    """Give a plain function a compiled form as well.

    `result(kinds)` is the kind of what it returns (None where it does not take these kinds), and
    `build(context, builder, kinds, values)` makes the instructions.
    """

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if len(args) != arity or kws:
                return None
            kind = result(args)
            return None if kind is None else signature(kind, *args)

    lower_builtin(function, *[types.Any] * arity)(
        lambda context, builder, sig, args: build(context, builder, sig.args, args)
    )


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Choose `yes` where the condition holds, `no` elsewhere; both are computed."""
    return yes if condition else no


def _kind_of_choice(kinds: Any) -> Any:
    if isinstance(kinds[0], Mask):
        return kinds[0].lanes
    return next((kind for kind in kinds if isinstance(kind, Lanes)), types.float64)


def _select(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    kind = _kind_of_choice(kinds)
    if isinstance(kind, Lanes):
        a, b = (_as_lanes(context, builder, v, k, kind) for v, k in zip(values[1:], kinds[1:], strict=True))
    else:
        a, b = (context.cast(builder, v, k, types.float64) for v, k in zip(values[1:], kinds[1:], strict=True))
    return builder.select(values[0], a, b)


lowered(select, 3, _kind_of_choice, _select)


def anywhere(condition: Any) -> Any:
    """Return True where a condition holds in any lane; a plain truth value is returned as it is."""
    return condition


def _anywhere(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    if not isinstance(kinds[0], Mask):
        return values[0]
    bits = ir.IntType(kinds[0].lanes.width)
    return builder.icmp_unsigned("!=", builder.bitcast(values[0], bits), ir.Constant(bits, 0))


lowered(anywhere, 1, lambda _: types.boolean, _anywhere)


def _constant(kind: Any, value: float) -> Any:
    if not isinstance(kind, Lanes):
        return ir.Constant(ir.DoubleType(), value)
    return ir.Constant(_vector(kind), [value] * kind.width)


def nearest_whole(x: Any) -> Any:
    """Round x to the nearest whole number, |x| < 2^51 (2^22 in single precision)."""
    return (x + _ROUND) - _ROUND


def _nearest_whole(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    large = _constant(kinds[0], _ROUND_SINGLE if kinds[0] == SINGLES else _ROUND)
    return builder.fsub(builder.fadd(values[0], large, flags=_FLAGS), large, flags=_FLAGS)


lowered(nearest_whole, 1, lambda kinds: kinds[0], _nearest_whole)


def power_of_two(n: Any) -> Any:
    """Compute 2^n for whole n in -1022..1023, held within -126..127 in single precision, from the bits of n."""
    return math.ldexp(1.0, int(n))


def _power_of_two(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    kind, n = kinds[0], values[0]
    single = kind == SINGLES
    bits = ir.IntType(32 if single else 64)
    integers = ir.VectorType(bits, kind.width) if isinstance(kind, Lanes) else bits
    places = 23 if single else 52
    if single:
        least, most = _constant(kind, -126.0), _constant(kind, 127.0)
        n = builder.select(builder.fcmp_ordered("<", n, least), least, n)
        n = builder.select(builder.fcmp_ordered(">", n, most), most, n)
    # the last bits of 1.5 * 2^52 + k (2^23) are those of the whole number k: no conversion, of doubles one by one
    large = _constant(kind, _ROUND_SINGLE + 127.0 if single else _ROUND + 1023.0)
    biased = builder.bitcast(builder.fadd(n, large), integers)
    shift = ir.Constant(integers, [places] * kind.width if isinstance(kind, Lanes) else places)
    return builder.bitcast(builder.shl(biased, shift), n.type)


lowered(power_of_two, 1, lambda kinds: kinds[0], _power_of_two)

_LOADED = {types.float64: LANES, types.float32: SINGLES}


def _is_block(array: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype in _LOADED and array.layout == "C"


def _place(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    """Find the address of the lanes of a row."""
    data = context.make_array(kinds[0])(context, builder, values[0]).data
    row = context.cast(builder, values[1], kinds[1], types.intp)
    lanes = _LOADED[kinds[0].dtype]
    place = builder.mul(row, ir.Constant(row.type, lanes.width))
    return builder.bitcast(cgutils.gep_inbounds(builder, data, place), _vector(lanes).as_pointer())


def load(array: Any, row: int) -> Any:
    """Load the lanes of row `row` of a C-ordered array, rows counted through all leading axes.

    It is (..., WIDTH) of doubles, or (..., SINGLE_WIDTH) in single precision.
    """


def _load(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    return builder.load(_place(context, builder, kinds, values), align=kinds[0].dtype.bitwidth // 8)


def _loaded(kinds: Any) -> Any:
    return _LOADED[kinds[0].dtype] if _is_block(kinds[0]) and isinstance(kinds[1], types.Integer) else None


lowered(load, 2, _loaded, _load)


def store(array: Any, row: int, value: Any) -> None:
    """Write lanes into row `row` of an array as `load` reads it."""


def _store(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    builder.store(values[2], _place(context, builder, kinds, values), align=kinds[0].dtype.bitwidth // 8)
    return context.get_dummy_value()


def _stored(kinds: Any) -> Any:
    return types.none if _loaded(kinds) == kinds[2] else None


lowered(store, 3, _stored, _store)


def spread(value: Any) -> Any:
    """Put the same number into every lane of doubles."""


def _spread_out(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    return _as_lanes(context, builder, values[0], kinds[0], LANES)


lowered(spread, 1, lambda _: LANES, _spread_out)


_LOG2_E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
# 1.5 * 2^52 and 1.5 * 2^23: adding it rounds to a whole number
_ROUND, _ROUND_SINGLE = 6755399441055744.0, 12582912.0


@contracted
def exponential(x: Any) -> Any:
    """Compute exp(x) for x in -708..709 (held at these ends): 2^n times a polynomial in r = x - n ln 2.

    Within 1e-14 of exp(x), relatively; compiled from this source for a number and for lanes. In single precision it is
    within 2e-6 for x in -60..60, and beyond -87..88 held at a power of two.
    Source: W. J. Cody, W. Waite, Software Manual for the Elementary Functions, 1980 (reduction in two parts of ln 2);
    Taylor's polynomial, whose rest for |r| <= ln 2/2 is below 7e-15.
    """
    x = min(max(x, -708.0), 709.0)
    n = nearest_whole(x * _LOG2_E)
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    s = r * r
    q = s * s
    low = (1.0 + r) + s * (0.5 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + s * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + s * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    return (low + q * (middle + q * high)) * power_of_two(n)
