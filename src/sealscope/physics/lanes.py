"""Lanes: a numba type for a short vector of numbers, which laws take in place of one number.

One source serves a single run and sixteen parameter sets on a processor's vector registers. A law written without
branches on its numbers (`select` instead of `if`) compiles for a double and for `LANES` of single-precision numbers.
Each operation on lanes is one LLVM vector instruction, so vectorisation does not depend on the compiler's heuristics.
Products and sums may be contracted to fused multiply-adds, so a lane agrees with a single run to rounding, not to the
bit. Lanes exist inside compiled functions only: `load` and `store` move them from and to rows of arrays.
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

#: Number of lanes of single-precision numbers in a register of 512 bits.
WIDTH = 16
_FLAGS = ("contract",)  # LLVM may fuse products and sums


class Lanes(types.Type):  # type: ignore[misc]
    """The numba type of a vector of `WIDTH` single-precision numbers, its lanes."""

    def __init__(self) -> None:
        self.llvm_type = ir.VectorType(ir.FloatType(), WIDTH)
        super().__init__(name=f"Lanes({WIDTH})")

    def can_convert_from(self, typingctx: Any, source: Any) -> Any:
        """Tell numba that a single number, but no other `source`, can be converted to lanes of equal numbers."""
        from numba.core.typeconv import Conversion

        return Conversion.safe if isinstance(source, types.Number) else None


class Mask(types.Type):  # type: ignore[misc]
    """The numba type of a vector of truth values, one for each lane of a vector of numbers."""

    def __init__(self) -> None:
        self.llvm_type = ir.VectorType(ir.IntType(1), WIDTH)
        super().__init__(name=f"Mask({WIDTH})")


LANES, MASK = Lanes(), Mask()


@register_model(Lanes)
@register_model(Mask)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    """The representation of lanes or a mask in machine code: one LLVM vector."""

    def __init__(self, manager: Any, vector: Any) -> None:
        """Set the LLVM type of `vector`, the numba type of lanes or a mask; `manager`: numba's data models."""
        super().__init__(manager, vector, vector.llvm_type)


def _broadcast(builder: Any, scalar: Any) -> Any:
    """Build the LLVM instructions that copy the number `scalar` into every lane of a vector."""
    zero = ir.Constant(ir.IntType(32), 0)
    first_lane = builder.insert_element(ir.Constant(LANES.llvm_type, ir.Undefined), scalar, zero)
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first_lane, first_lane, zeros)


def _convert_to_lanes(context: Any, builder: Any, value: Any, value_type: Any) -> Any:
    """Build the LLVM instructions that convert a number of the type `value_type` to lanes; lanes stay as they are."""
    if isinstance(value_type, Lanes):
        return value
    return _broadcast(builder, context.cast(builder, value, value_type, types.float32))


@lower_cast(types.Number, Lanes)  # type: ignore[untyped-decorator]
def _cast_to_lanes(context: Any, builder: Any, value_type: Any, lanes: Any, value: Any) -> Any:
    """Convert a number to lanes for a variable that has a number in one branch and lanes in the other."""
    return _convert_to_lanes(context, builder, value, value_type)


def _have_lanes(arg_types: tuple[Any, ...]) -> bool:
    """Return True if lanes are among the types of arguments, and all others are single numbers."""
    return LANES in arg_types and all(isinstance(arg_type, Lanes | types.Number) for arg_type in arg_types)


def _define_type(function: Any, infer_type: Any) -> None:
    """Make a Python function or operator known to numba, with the type of its result.

    `infer_type(arg_types)`: returns this type, or None if the function does not take arguments of these types.
    """

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            """Return the signature for arguments of the types `args`, None if they are not taken."""
            result_type = None if kws else infer_type(args)
            return None if result_type is None else signature(result_type, *args)


def register_lowering(function: Any, arity: int, infer_type: Any) -> Any:
    """Make a Python function of `arity` arguments known to numba; return a decorator for the builder of its code.

    `infer_type`: as in `_define_type`. The decorated function builds the LLVM instructions of one call: it takes
    numba's context, LLVM's builder, and the types and values of the arguments, and returns the value of the result.
    """
    _define_type(function, infer_type)

    def register(build: Any) -> Any:
        """Register the decorated function `build` with numba."""
        lower_builtin(function, *[types.Any] * arity)(
            lambda context, builder, sig, args: build(context, builder, sig.args, args)
        )
        return build

    return register


def _define_on_lanes(function: Any, build: Any, *, is_test: bool = False) -> None:
    """Tell numba how a Python function or operator on lanes (vectors of numbers) is compiled.

    Its arguments may mix lanes with single numbers. `build(builder, *values)` adds the LLVM instructions to LLVM's
    `builder` for `values` that are lanes. The result is lanes, or a mask of truth values if `is_test`.
    """

    def result_type(arg_types: tuple[Any, ...]) -> Any:
        """Find the type of the result, None for arguments without lanes."""
        if not _have_lanes(arg_types):
            return None
        return MASK if is_test else LANES

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Build the LLVM instructions of one call, with single numbers first converted to lanes."""
        pairs = zip(args, sig.args, strict=True)
        vectors = [_convert_to_lanes(context, builder, value, value_type) for value, value_type in pairs]
        return build(builder, *vectors)

    _define_type(function, result_type)
    for arg_types in ((Lanes,), (Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(function, *arg_types)(lower)


def _lower_division_by_number(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Build the LLVM instructions for lanes / number: a product with the reciprocal, which LLVM moves out of loops."""
    number = context.cast(builder, args[1], sig.args[1], types.float64)
    reciprocal = builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), number)
    reciprocal = context.cast(builder, reciprocal, types.float64, types.float32)
    return builder.fmul(args[0], _broadcast(builder, reciprocal), flags=_FLAGS)


_ARITHMETIC = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_COMPARISONS = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "=="}
for _function, _name in _ARITHMETIC.items():
    _define_on_lanes(_function, lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=_FLAGS))
for _function, _symbol in _COMPARISONS.items():
    _define_on_lanes(_function, lambda builder, a, b, symbol=_symbol: builder.fcmp_ordered(symbol, a, b), is_test=True)
lower_builtin(operator.truediv, Lanes, types.Number)(_lower_division_by_number)
_define_on_lanes(operator.neg, lambda builder, a: builder.fneg(a))


def _intrinsic_builder(name: str) -> Any:
    """Return a `build` for `_define_on_lanes` that calls the LLVM intrinsic `name`, such as "fabs"."""

    def build(builder: Any, *values: Any) -> Any:
        """Build the call of the intrinsic, whose full name ends with the vector's type, such as llvm.fabs.v16f32."""
        function_type = ir.FunctionType(LANES.llvm_type, [LANES.llvm_type] * len(values))
        function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{WIDTH}f32")
        return builder.call(function, values)

    return build


_define_on_lanes(abs, _intrinsic_builder("fabs"))
_define_on_lanes(min, lambda builder, a, b: builder.select(builder.fcmp_ordered("<", b, a), b, a))
_define_on_lanes(max, lambda builder, a, b: builder.select(builder.fcmp_ordered(">", b, a), b, a))


def _mask_type(arg_types: tuple[Any, ...]) -> Any:
    """Find the type of `&` or `|` of two masks of one type; None for any other arguments."""
    return arg_types[0] if isinstance(arg_types[0], Mask) and arg_types[0] == arg_types[-1] else None


for _function, _name in ((operator.and_, "and_"), (operator.or_, "or_")):
    _define_type(_function, _mask_type)
    lower_builtin(_function, Mask, Mask)(lambda context, builder, sig, args, name=_name: getattr(builder, name)(*args))


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Choose `yes` where the condition is true, else `no`, for one number or, compiled, in each lane of a vector.

    Both values are computed before the call, unlike with `if`.
    """
    return yes if condition else no


def _select_type(arg_types: Any) -> Any:
    """Find the type of the result of `select`: that of the vectors among its arguments, double if there are none."""
    has_lanes = isinstance(arg_types[0], Mask) or LANES in arg_types  # [0]: the condition
    return LANES if has_lanes else types.float64


@register_lowering(select, 3, _select_type)
def _lower_select(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `select`: convert both values to one type, then choose by the condition."""
    result_type = _select_type(arg_types)
    pairs = zip(values[1:], arg_types[1:], strict=True)
    if isinstance(result_type, Lanes):
        yes, no = (_convert_to_lanes(context, builder, value, value_type) for value, value_type in pairs)
    else:
        yes, no = (context.cast(builder, value, value_type, types.float64) for value, value_type in pairs)
    return builder.select(values[0], yes, no)


def _float_constant(value_type: Any, value: float) -> Any:
    """Return the LLVM constant of a number, repeated for every lane if `value_type` is a type of vectors (lanes)."""
    if not isinstance(value_type, Lanes):
        return ir.Constant(ir.DoubleType(), value)
    return ir.Constant(value_type.llvm_type, [value] * WIDTH)


def nearest_integer(x: Any) -> Any:
    """Round x to the nearest whole number, for |x| < 2^51 (in single precision |x| < 2^22).

    A constant is added and subtracted again. It is so large that its sum with x has no bits for a fraction.
    """
    return (x + _ROUNDING_DOUBLE) - _ROUNDING_DOUBLE


@register_lowering(nearest_integer, 1, lambda arg_types: arg_types[0])
def _lower_nearest_integer(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `nearest_integer`: add the constant of x's precision and subtract it again."""
    large = _float_constant(arg_types[0], _ROUNDING_SINGLE if arg_types[0] == LANES else _ROUNDING_DOUBLE)
    return builder.fsub(builder.fadd(values[0], large, flags=_FLAGS), large, flags=_FLAGS)


def power_of_two(n: Any) -> Any:
    """Compute 2^n for whole n (float or vector of floats) in -1022..1023; for a vector n is limited to -126..127."""
    return math.ldexp(1.0, int(n))


@register_lowering(power_of_two, 1, lambda arg_types: arg_types[0])
def _lower_power_of_two(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `power_of_two`: shift n plus the exponent's bias to the bits of the exponent."""
    n_type, n = arg_types[0], values[0]
    single = n_type == LANES
    integer = ir.IntType(32 if single else 64)
    integers = ir.VectorType(integer, WIDTH) if single else integer
    mantissa_bits = 23 if single else 52
    if single:
        n_min, n_max = _float_constant(n_type, -126.0), _float_constant(n_type, 127.0)
        n = builder.select(builder.fcmp_ordered("<", n, n_min), n_min, n)
        n = builder.select(builder.fcmp_ordered(">", n, n_max), n_max, n)
    # the last bits of 1.5 * 2^52 + k (in single precision 1.5 * 2^23 + k) are the integer k, here n + 1023 (n + 127):
    # this is faster than converting each lane to an integer
    rounding = _float_constant(n_type, _ROUNDING_SINGLE + 127.0 if single else _ROUNDING_DOUBLE + 1023.0)
    exponent = builder.bitcast(builder.fadd(n, rounding), integers)
    shift = ir.Constant(integers, [mantissa_bits] * WIDTH if single else mantissa_bits)
    return builder.bitcast(builder.shl(exponent, shift), n.type)


def _row_address(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions for a pointer to a row of an array, as a pointer to a vector of lanes.

    The first two `values` are the array and the row's index, as in `load`.
    """
    data = context.make_array(arg_types[0])(context, builder, values[0]).data
    row = context.cast(builder, values[1], arg_types[1], types.intp)
    first_element = builder.mul(row, ir.Constant(row.type, WIDTH))
    return builder.bitcast(cgutils.gep_inbounds(builder, data, first_element), LANES.llvm_type.as_pointer())


def load(array: Any, row: int) -> Any:
    """Load one row of a C-ordered array as lanes (a vector of numbers), in compiled code only (`_lower_load`).

    `array`: (..., WIDTH) in single precision; `row`: index of the row, counted over all axes but the last.
    """


def _loaded_type(arg_types: Any) -> Any:
    """Find the type of the vector (lanes) that `load` reads; None unless it gets a suitable array and an integer."""
    array, row = arg_types[:2]  # `_stored_type` passes the vector's type, too
    is_loadable = isinstance(array, types.Array) and array.dtype == types.float32 and array.layout == "C"
    return LANES if is_loadable and isinstance(row, types.Integer) else None


@register_lowering(load, 2, _loaded_type)
def _lower_load(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `load`."""
    return builder.load(_row_address(context, builder, arg_types, values), align=4)


def store(array: Any, row: int, value: Any) -> None:
    """Write the lanes `value` to one row of an array, in compiled code only; `array`, `row`: as in `load`."""


def _stored_type(arg_types: Any) -> Any:
    """Return numba's type `none`, the result of `store`, or None if the array cannot contain such a vector."""
    _, _, vector_type = arg_types
    return types.none if _loaded_type(arg_types) == vector_type else None


@register_lowering(store, 3, _stored_type)
def _lower_store(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `store`."""
    builder.store(values[2], _row_address(context, builder, arg_types, values), align=4)
    return context.get_dummy_value()


_LOG2_E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10  # their sum is ln 2 to more than double precision
# 1.5 * 2^52 and 1.5 * 2^23: adding one of them leaves no bits behind the point, and so rounds to a whole number
_ROUNDING_DOUBLE, _ROUNDING_SINGLE = 6755399441055744.0, 12582912.0


@contracted
def exponential(x: Any) -> Any:
    """Compute exp(x) for a number or for lanes (a vector of numbers), with x limited to -708..709.

    exp(x) is 2^n times a polynomial in r = x - n ln 2, where n is the whole number nearest to x/ln 2. The relative
    error is below 1e-14. On lanes, in single precision, it is below 2e-6 for x in -60..60; beyond -87..88 the result
    stays near 2^-126 or 2^127.

    Source: W. J. Cody, W. Waite, Software Manual for the Elementary Functions, 1980 (reduction by ln 2 in two parts);
    Taylor's polynomial, whose remainder for |r| <= ln 2/2 is below 7e-15.
    """
    x = min(max(x, -708.0), 709.0)
    n = nearest_integer(x * _LOG2_E)
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    s = r * r
    q = s * s
    # Taylor's polynomial of degree 11, low + q middle + q^2 high
    low = (1.0 + r) + s * (0.5 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + s * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + s * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    return (low + q * (middle + q * high)) * power_of_two(n)
