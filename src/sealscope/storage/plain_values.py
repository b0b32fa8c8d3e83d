"""Plain values of files from outside: JSON of finite numbers, and values of the types that the program counts on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from pydantic import ValidationError

_T = TypeVar("_T")
#: Largest whole number: beyond it, doubles are no longer exact.
LARGEST_WHOLE = 2**53


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; ValueError where it is none, or holds a number that is not finite or too large.

    Whole numbers are at most 2^53 in size.
    """
    try:
        return json.loads(text, parse_float=_finite, parse_int=_whole, parse_constant=_finite)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"a number must be finite, got {text[:40]}")
    return number


def _whole(text: str) -> int:
    if len(text) > 17 or abs(int(text)) > LARGEST_WHOLE:
        raise ValueError(f"a whole number must be at most 2^53, got {text[:40]}")
    return int(text)


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def as_type(kind: type[_T], value: Any) -> _T:
    """Return plain values as the dataclass `kind`; ValueError of one line where a value has no place in it."""
    from pydantic import ValidationError

    if is_dataclass(kind) and isinstance(value, dict):
        unknown = sorted(map(str, value.keys() - {field.name for field in fields(kind)}))
        if unknown:
            raise ValueError(f"{unknown[0][:60]}: not known")
    try:
        return _adapter(kind).validate_python(value)  # type: ignore[no-any-return, arg-type]
    except ValidationError as error:
        raise ValueError(one_line(error)) from None


def one_line(error: ValidationError, whole: str = "value") -> str:
    """Return what pydantic says first of values: place (`whole` for all of them), rule and value."""
    first = error.errors(include_url=False)[0]
    place, rule = ".".join(map(str, first["loc"])) or whole, first["msg"].removeprefix("Value error, ")
    value = "" if first["type"] in ("value_error", "missing") else f", got {str(first['input'])[:60]!r}"
    return f"{place}: {rule}{value}"


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: records as objects, tuples as lists, a number that is not finite as null."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: plain(own) for name, own in value.items()}
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple | list):
        return [plain(own) for own in value]
    return value
