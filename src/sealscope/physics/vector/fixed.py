"""Numbers of a rig that stand still over many steps: the same for all runs of a set, or each run's own from a table.

On a processor they are plain numbers or lanes; the compiler turns divisions by what does not change into products by
itself (`compiled.contracted`). On a GPU it does not, and a division there takes some ten times a product's time, so a
fixed number carries its reciprocal along: the laws divide as they always do and get the product.
"""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model

from sealscope.physics.lanes import LANES, load, load_number, lowered, on_device

if TYPE_CHECKING:
    from collections.abc import Collection

    from sealscope.physics.rig import RigNumbers


class Fixed(types.Type):  # type: ignore[misc]
    """A double and its reciprocal, on a GPU; taken for a plain double by everything but a division by it."""

    def __init__(self) -> None:
        super().__init__(name="Fixed")

    def unify(self, typingctx: Any, other: Any) -> Any:
        """With a double: a double."""
        return types.float64 if other == types.float64 else None


FIXED = Fixed()


@register_model(Fixed)
class _FixedModel(models.StructModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, [("value", types.float64), ("reciprocal", types.float64)])


@lower_cast(Fixed, types.Float)  # type: ignore[untyped-decorator]
def _plain(context: Any, builder: Any, kind: Any, to: Any, value: Any) -> Any:
    return builder.extract_value(value, 0)


def _let_take(function: Any, result: Any, divides: bool = False) -> None:
    """Let `function` take fixed numbers, as doubles (and as a divisor as it is)."""

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if kws or FIXED not in args or not all(isinstance(arg, types.Number | Fixed) for arg in args):
                return None
            kinds = [types.float64] * len(args)
            if divides and args[1] == FIXED:
                kinds[1] = FIXED
            return signature(result, *kinds)


for _function in (operator.add, operator.sub, operator.mul, operator.neg, abs, math.sqrt, math.pow):
    _let_take(_function, types.float64)
for _function in (operator.lt, operator.le, operator.gt, operator.ge):
    _let_take(_function, types.boolean)
_let_take(math.copysign, types.float64)
_let_take(operator.truediv, types.float64, divides=True)


def _let_choose(function: Any, sign: str) -> None:
    """Let `min` or `max` take fixed numbers."""

    @infer_global(function)
    class Template(AbstractTemplate):  # type: ignore[misc]
        def generic(self, args: tuple[Any, ...], kws: Any) -> Any:
            if kws or len(args) != 2 or FIXED not in args:
                return None
            return signature(types.float64, *args)

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = (context.cast(builder, v, k, types.float64) for v, k in zip(args, sig.args, strict=True))
        return builder.select(builder.fcmp_ordered(sign, b, a), b, a)

    for kinds in ((Fixed, Fixed), (Fixed, types.Number), (types.Number, Fixed)):
        lower_builtin(function, *kinds)(build)


_let_choose(min, "<")
_let_choose(max, ">")


@lower_builtin(operator.truediv, types.Float, Fixed)  # type: ignore[untyped-decorator]
def _divide(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fmul(args[0], builder.extract_value(args[1], 1))


def taken(number: Any, table: Any, at: int) -> Any:
    """Return `number` itself where it is one for all runs.

    Where it is (), that of row `at` of a table (`lanes.load`).
    """
    return load(table, at) if isinstance(number, tuple) else number


def pair(context: Any, builder: Any, value: Any) -> Any:
    """Return the instructions that make a fixed number of a double."""
    number = cgutils.create_struct_proxy(FIXED)(context, builder)
    number.value, number.reciprocal = value, builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), value)
    return number._getvalue()


def _take(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    own = isinstance(kinds[0], types.BaseTuple)
    value = load_number(context, builder, kinds[1:], values[1:]) if own else values[0]
    return pair(context, builder, value) if on_device(context) else value


def _taken(kinds: Any, device: bool) -> Any:
    if device:
        return FIXED
    return LANES if isinstance(kinds[0], types.BaseTuple) else kinds[0]


lowered(taken, 3, _taken, _take)


def settled(choice: Any) -> Any:
    """Return a choice as a truth value.

    () and (True,) stand for choices that are known when the code is made, so that what they leave out is left out of
    the code (on a GPU a branch not taken costs too).
    """
    return bool(choice)


def _settle(context: Any, builder: Any, kinds: Any, values: Any) -> Any:
    known = isinstance(kinds[0], types.BaseTuple)
    return ir.Constant(ir.IntType(1), int(len(kinds[0]) > 0)) if known else values[0]


lowered(settled, 1, lambda *_: types.boolean, _settle)


def left_to_table(numbers: RigNumbers, fields: Collection[str], choices: bool = False) -> RigNumbers:
    """Return the numbers with () in place of those that stand in a table, and with settled `choices` if asked."""
    replaced: dict[str, Any] = dict.fromkeys(fields, ())
    if choices:
        replaced |= {name: (True,) if own else () for name, own in numbers._asdict().items() if isinstance(own, bool)}
    return numbers._replace(**replaced)
