"""White noise for runs side by side: normal numbers from a counter and a key for each lane.

The generator is SplitMix64 at a stated place of its sequence (Steele, Lea, Flood, Fast splittable pseudorandom number
generators, OOPSLA 2014): the number of a sample depends on the run's key and the sample's place alone, never on the
lane, the group or the block. It is another stream than that of a run by itself (`instruments.record`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types

from sealscope.compiled import contracted
from sealscope.physics.lanes import LANES, WIDTH, lowered, select
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import GOLDEN, MIX

_WORDS, _DOUBLES = ir.VectorType(ir.IntType(64), WIDTH), ir.VectorType(ir.DoubleType(), WIDTH)
_ONE_BITS, _MANTISSA = 0x3FF0000000000000, 0x000FFFFFFFFFFFFF


def _constant(value: int) -> Any:
    return ir.Constant(_WORDS, [value] * WIDTH)


def keys(seeds: list[int]) -> Array:
    """Compute a key for each run's noise, as the bits of doubles: (runs,)."""
    states = [np.random.SeedSequence(seed).generate_state(1, np.uint64) for seed in seeds]
    return np.concatenate(states).view(np.float64)


def uniform(key: Any, place: int) -> Any:
    """Compute numbers evenly spread over (0, 1], one a lane: those at `place` >= 0 of the keys' sequences."""


def _uniform(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    word = ir.IntType(64)
    step = context.cast(builder, values[1], kinds[1], types.int64)
    step = builder.mul(builder.add(step, ir.Constant(word, 1)), ir.Constant(word, GOLDEN))
    lane = builder.insert_element(ir.Constant(_WORDS, ir.Undefined), step, ir.Constant(ir.IntType(32), 0))
    step = builder.shuffle_vector(lane, lane, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH))
    z = builder.add(builder.bitcast(values[0], _WORDS), step)
    for shift, factor in MIX:
        z = builder.mul(builder.xor(z, builder.lshr(z, _constant(shift))), _constant(factor))
    z = builder.xor(z, builder.lshr(z, _constant(31)))
    bits = builder.or_(builder.lshr(z, _constant(12)), _constant(_ONE_BITS))
    return builder.fsub(ir.Constant(_DOUBLES, [2.0] * WIDTH), builder.bitcast(bits, _DOUBLES))


def _exponent(x: Any) -> Any:
    """Compute the exponent of positive normal doubles, as doubles."""


def _raised(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    raised = builder.lshr(builder.bitcast(values[0], _WORDS), _constant(52))
    return builder.sitofp(builder.sub(raised, _constant(1023)), _DOUBLES)


def _fraction(x: Any) -> Any:
    """Compute the fraction of positive normal doubles, 1 <= m < 2."""


def _mantissa(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    bits = builder.and_(builder.bitcast(values[0], _WORDS), _constant(_MANTISSA))
    return builder.bitcast(builder.or_(bits, _constant(_ONE_BITS)), _DOUBLES)


for _function, _arity, _build in ((uniform, 2, _uniform), (_exponent, 1, _raised), (_fraction, 1, _mantissa)):
    lowered(_function, _arity, lambda kinds: kinds[0] if kinds[0] == LANES else None, _build)


@contracted
def logarithm(x: Any) -> Any:
    """Compute ln x for lanes of normal numbers x > 0, within 2e-15 (absolute near 1, relative elsewhere).

    ln x = e ln 2 + 2 artanh((m - 1)/(m + 1)), m in sqrt(1/2)..sqrt(2), by the artanh's series.
    """
    e, m = _exponent(x), _fraction(x)
    high = m > 1.4142135623730951
    e, m = select(high, e + 1.0, e), select(high, 0.5 * m, m)
    f = (m - 1.0) / (m + 1.0)
    s = f * f
    q = s * s
    series = (1.0 + s * (1.0 / 3.0)) + q * ((1.0 / 5.0 + s * (1.0 / 7.0)) + q * (1.0 / 9.0 + s * (1.0 / 11.0)))
    series = series + q * q * q * ((1.0 / 13.0 + s * (1.0 / 15.0)) + q * (1.0 / 17.0))
    return e * 0.6931471805599453 + 2.0 * f * series


@contracted
def half_turn_sine(v: Any) -> Any:
    """Compute sin(pi v) for -1/2 <= v <= 1/2, within 5e-14: Taylor's polynomial to the 17th power."""
    x = v * math.pi
    s = x * x
    q = s * s
    low = (1.0 - s * (1.0 / 6.0)) + q * (1.0 / 120.0 - s * (1.0 / 5040.0))
    high = (1.0 / 362880.0 - s * (1.0 / 39916800.0)) + q * (1.0 / 6227020800.0 - s * (1.0 / 1307674368000.0))
    return x * (low + q * q * (high + q * q * (1.0 / 355687428096000.0)))


@contracted
def normals(key: Any, place: int) -> tuple[Any, Any]:
    """Compute two independent standard normal numbers a lane, from places 2 k and 2 k + 1 of the keys' sequences.

    Source: Box and Muller, Annals of Mathematical Statistics 29 (1958) 610-611.
    """
    radius = math.sqrt(-2.0 * logarithm(uniform(key, 2 * place)))
    s = half_turn_sine(uniform(key, 2 * place + 1) - 0.5)
    c = math.sqrt(max(1.0 - s * s, 0.0))
    return radius * (2.0 * s * c), radius * (1.0 - 2.0 * s * s)
