"""Plain values of files from outside: JSON of finite numbers, and values of expected types."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from pydantic import ValidationError

_T = TypeVar("_T")
#: Largest whole number: beyond it, doubles are no longer exact.
LARGEST_WHOLE = 2**53


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON text; raise ValueError for any other, and for numbers that are not finite or too large.

    Whole numbers are at most 2^53 in size.
    """
    try:
        return json.loads(text, parse_float=_finite, parse_int=_whole_number, parse_constant=_finite)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"a number must be finite, got {text[:40]}")
    return number


def _whole_number(text: str) -> int:
    if len(text) > 17 or abs(int(text)) > LARGEST_WHOLE:
        raise ValueError(f"a whole number must be at most 2^53, got {text[:40]}")
    return int(text)


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def as_type(kind: type[_T], value: Any, named: Callable[[str], str] = str, context: Any = None) -> _T:
    """Convert plain values to the dataclass or model `kind`; ValueError of one line names a value without a place.

    `named`: name in the error of an entry of `value`; `context` is for the validators of `kind`.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_python(value, context=context)  # type: ignore[no-any-return, arg-type]
    except ValidationError as error:
        raise ValueError(one_line(error, named)) from None


#: Rules in plainer words than those of pydantic, by the type of its error.
_PLAIN_RULES = {
    "missing": "is missing",
    "missing_argument": "is missing",
    "extra_forbidden": "is not known",
    "unexpected_keyword_argument": "is not known",
}


def one_line(error: ValidationError, named: Callable[[str], str] = str, unit: str = "") -> str:
    """Format pydantic's first error: entry, rule and value, as "ENTRY must be ..., got ...".

    An entry that is not known comes before others. `named`: name of an entry of the whole ("" for this); `unit`: of the
    rule.
    """
    errors = error.errors(include_url=False)
    first = next((detail for detail in errors if _PLAIN_RULES.get(detail["type"]) == "is not known"), errors[0])
    entry, *inner = (str(part) for part in first["loc"] or ("",) if part != "[key]")
    place = "".join([named(entry), *(f"[{int(part) + 1}]" if part.isdigit() else f".{part}" for part in inner)])
    if plain_rule := _PLAIN_RULES.get(first["type"]):
        return f"{place} {plain_rule}"
    rule = re.sub(r"^\w+ should", "must", first["msg"].removeprefix("Value error, ")).replace("tuple", "list") + unit
    value = "" if first["type"] == "value_error" else f", got {repr(first['input'])[:60]}"
    separator = "" if not place else " " if rule.startswith("must ") else ": "
    return f"{place}{separator}{rule}{value}"


def plain(value: Any) -> Any:
    """Convert a value for JSON: records to objects, tuples to lists, numbers that are not finite to null."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value
