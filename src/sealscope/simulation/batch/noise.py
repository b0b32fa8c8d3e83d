"""White noise for many runs at once: normal random numbers from a counter and a key for each run.

A vector register holds a number of each run in one of its lanes. The generator is SplitMix64, evaluated directly at any
position of its sequence (Steele, Lea, Flood, Fast splittable pseudorandom number generators, OOPSLA 2014). The random
number of a sample therefore depends only on the run's key and the sample's position, not on how runs are grouped. It
differs from that of a single run (`instruments.record`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types

from sealscope.compiled import contracted
from sealscope.physics.lanes import LANES, WIDTH, register_lowering, select
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import GOLDEN, LAST_SHIFT, MIX

_INTEGERS, _DOUBLES = ir.VectorType(ir.IntType(64), WIDTH), ir.VectorType(ir.DoubleType(), WIDTH)
#: Double precision: bits of 1.0, mask of the 52 mantissa bits, bias of the exponent.
_ONE_BITS, _MANTISSA_MASK, _MANTISSA_BITS, _EXPONENT_BIAS = 0x3FF0000000000000, 0x000FFFFFFFFFFFFF, 52, 1023
_SQRT_2, _LN_2 = math.sqrt(2.0), math.log(2.0)


def _integer_constant(value: int) -> Any:
    """Make the LLVM constant of a vector whose elements all are the 64-bit integer `value`."""
    return ir.Constant(_INTEGERS, [value] * WIDTH)


def _result_type(arg_types: Any) -> Any:
    """Return the result's type, that of the first argument, if that is a vector of doubles (lanes), else None."""
    return LANES if arg_types[0] == LANES else None


def noise_keys(seeds: list[int]) -> Array:
    """Compute the 64-bit key (runs,) of each run's noise from its seed.

    The bits of a key are stored as those of a double, because compiled code loads vectors of doubles only.
    """
    states = [np.random.SeedSequence(seed).generate_state(1, np.uint64) for seed in seeds]
    return np.concatenate(states).view(np.float64)


def uniform(key: Any, position: int) -> Any:
    """Draw a uniform random number in (0, 1] for each run of a vector of runs, in code that `_lower_uniform` builds.

    `key`: keys of the runs' noise (`noise_keys`); `position` >= 0: position in the sequences of random numbers.
    """


@register_lowering(uniform, 2, _result_type)
def _lower_uniform(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `uniform`: SplitMix64's bits become the mantissa of a number in (0, 1]."""
    key, position = values
    int64 = ir.IntType(64)
    k = context.cast(builder, position, arg_types[1], types.int64)
    increment = builder.mul(builder.add(k, ir.Constant(int64, 1)), ir.Constant(int64, GOLDEN))
    first_lane = builder.insert_element(ir.Constant(_INTEGERS, ir.Undefined), increment, ir.Constant(ir.IntType(32), 0))
    to_all_lanes = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    z = builder.add(builder.bitcast(key, _INTEGERS), builder.shuffle_vector(first_lane, first_lane, to_all_lanes))
    for shift, factor in MIX:
        z = builder.mul(builder.xor(z, builder.lshr(z, _integer_constant(shift))), _integer_constant(factor))
    z = builder.xor(z, builder.lshr(z, _integer_constant(LAST_SHIFT)))
    # a random mantissa with the exponent of 1 is a number in [1, 2); 2 minus this number is in (0, 1]
    bits = builder.or_(builder.lshr(z, _integer_constant(64 - _MANTISSA_BITS)), _integer_constant(_ONE_BITS))
    return builder.fsub(ir.Constant(_DOUBLES, [2.0] * WIDTH), builder.bitcast(bits, _DOUBLES))


def _exponent(x: Any) -> Any:
    """Extract the binary exponent of positive normal doubles, as doubles, in code that `_lower_exponent` builds."""


@register_lowering(_exponent, 1, _result_type)
def _lower_exponent(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `_exponent`: the bits above the mantissa, minus the exponent's bias."""
    biased_exponent = builder.lshr(builder.bitcast(values[0], _INTEGERS), _integer_constant(_MANTISSA_BITS))
    return builder.sitofp(builder.sub(biased_exponent, _integer_constant(_EXPONENT_BIAS)), _DOUBLES)


def _fraction(x: Any) -> Any:
    """Extract the significand 1 <= m < 2 of positive normal doubles, in code that `_lower_fraction` builds."""


@register_lowering(_fraction, 1, _result_type)
def _lower_fraction(context: Any, builder: Any, arg_types: Any, values: Any) -> Any:
    """Build the LLVM instructions of `_fraction`: the bits of the mantissa with the exponent of 1."""
    bits = builder.and_(builder.bitcast(values[0], _INTEGERS), _integer_constant(_MANTISSA_MASK))
    return builder.bitcast(builder.or_(bits, _integer_constant(_ONE_BITS)), _DOUBLES)


@contracted
def logarithm(x: Any) -> Any:
    """Compute ln x for a vector of numbers x > 0, none of them subnormal.

    ln x = e ln 2 + 2 artanh((m - 1)/(m + 1)) with x = 2^e m and m in sqrt(1/2)..sqrt(2), by the series of artanh. The
    error is 2e-15, absolute near 1 and relative elsewhere.
    """
    e, m = _exponent(x), _fraction(x)
    above_sqrt_2 = m > _SQRT_2
    e, m = select(above_sqrt_2, e + 1.0, e), select(above_sqrt_2, 0.5 * m, m)
    f = (m - 1.0) / (m + 1.0)
    s = f * f
    q = s * s
    series = (1.0 + s * (1.0 / 3.0)) + q * ((1.0 / 5.0 + s * (1.0 / 7.0)) + q * (1.0 / 9.0 + s * (1.0 / 11.0)))
    series = series + q * q * q * ((1.0 / 13.0 + s * (1.0 / 15.0)) + q * (1.0 / 17.0))
    return e * _LN_2 + 2.0 * f * series


@contracted
def half_turn_sine(v: Any) -> Any:
    """Compute sin(pi v) for -1/2 <= v <= 1/2 with an error of 5e-14, by Taylor's polynomial of degree 17."""
    x = v * math.pi
    s = x * x
    q = s * s
    low = (1.0 - s * (1.0 / 6.0)) + q * (1.0 / 120.0 - s * (1.0 / 5040.0))
    high = (1.0 / 362880.0 - s * (1.0 / 39916800.0)) + q * (1.0 / 6227020800.0 - s * (1.0 / 1307674368000.0))
    return x * (low + q * q * (high + q * q * (1.0 / 355687428096000.0)))


@contracted
def normals(key: Any, pair: int) -> tuple[Any, Any]:
    """Draw two independent standard normal random numbers for each of a vector of runs, in compiled code.

    They follow from the uniform numbers at positions 2 `pair` and 2 `pair` + 1 of the sequences that `key` selects,
    by the method of Box and Muller (Annals of Mathematical Statistics 29 (1958) 610-611).
    """
    radius = math.sqrt(-2.0 * logarithm(uniform(key, 2 * pair)))
    s = half_turn_sine(uniform(key, 2 * pair + 1) - 0.5)
    c = math.sqrt(max(1.0 - s * s, 0.0))
    return radius * (2.0 * s * c), radius * (1.0 - 2.0 * s * s)  # sine and cosine of twice the angle of s and c
