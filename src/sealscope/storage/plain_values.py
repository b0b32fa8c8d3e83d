"""Read plain values from others: parse JSON with finite numbers only, and convert values to expected types."""

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
#: Largest whole number that doubles represent exactly, like all smaller ones.
MAX_WHOLE = 2**53


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; raise ValueError if it is not valid, has a number that is not finite, or a whole number over 2^53."""
    try:
        return json.loads(text, parse_float=_parse_finite, parse_int=_parse_whole, parse_constant=_parse_finite)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _parse_finite(text: str) -> float:
    """Parse a number, or a constant of JSON such as NaN; raise ValueError unless it is finite."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"a number must be finite, got {text[:40]}")
    return number


def _parse_whole(text: str) -> int:
    """Parse a whole number; raise ValueError if its size exceeds 2^53."""
    if len(text) > len(f"-{MAX_WHOLE}") or abs(int(text)) > MAX_WHOLE:  # `int` takes long for long texts
        raise ValueError(f"a whole number must be at most 2^53, got {text[:40]}")
    return int(text)


@cache
def _type_adapter(kind: Any) -> Any:
    """Build pydantic's validator of a type, once for each type, as building is slow."""
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def convert_type(kind: type[_T], value: Any, entry_name: Callable[[str], str] = str, context: Any = None) -> _T:
    """Convert plain values to the dataclass, model or other type `kind`; raise ValueError if they do not fit.

    `entry_name`: function that converts the first name in the path of the wrong entry for the error (`format_error`);
    `context`: data for the validators of `kind`.
    """
    from pydantic import ValidationError

    try:
        return _type_adapter(kind).validate_python(value, context=context)  # type: ignore[no-any-return, arg-type]
    except ValidationError as error:
        raise ValueError(format_error(error, entry_name)) from None


#: Plainer texts for pydantic's types of error.
_PLAIN_RULES = {
    **dict.fromkeys(("missing", "missing_argument"), "is missing"),
    **dict.fromkeys(("extra_forbidden", "unexpected_keyword_argument"), "is not known"),
}


def format_error(error: ValidationError, entry_name: Callable[[str], str] = str, unit: str = "") -> str:
    """Format one of pydantic's errors in one line, such as "ENTRY must be ..., got ..." or "ENTRY is missing".

    An error about an unknown entry, perhaps a misspelt name, is preferred; otherwise the first error is taken. ENTRY is
    the path to the wrong entry, such as `line.V_1`. `entry_name`: function that converts the first name of this path,
    which is "" if the whole value is wrong; `unit`: text that is appended to the broken rule.
    """
    errors = error.errors(include_url=False)
    chosen = next((detail for detail in errors if _PLAIN_RULES.get(detail["type"]) == "is not known"), errors[0])
    # pydantic appends "[key]" if the key of an entry is wrong, rather than its value
    entry, *path = (str(part) for part in chosen["loc"] or ("",) if part != "[key]")
    inner_names = [f"[{int(part) + 1}]" if part.isdigit() else f".{part}" for part in path]  # items count from 1
    place = entry_name(entry) + "".join(inner_names)
    if plain_rule := _PLAIN_RULES.get(chosen["type"]):
        return f"{place} {plain_rule}"
    # pydantic writes "Input should be ..." and "tuple"
    rule = re.sub(r"^\w+ should", "must", chosen["msg"].removeprefix("Value error, ")).replace("tuple", "list") + unit
    # the validators of this project state the value in their own text
    value = "" if chosen["type"] == "value_error" else f", got {repr(chosen['input'])[:60]}"
    separator = "" if not place else " " if rule.startswith("must ") else ": "
    return f"{place}{separator}{rule}{value}"


def to_plain(value: Any) -> Any:
    """Convert a value to plain values for JSON, at any depth.

    Dataclasses and named tuples become dicts, tuples become lists, and numbers that are not finite become None. Other
    values are not changed.
    """
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None  # np.float64 is a float, too
    if isinstance(value, Mapping):
        return {name: to_plain(item) for name, item in value.items()}
    if hasattr(value, "_asdict"):
        return to_plain(value._asdict())
    if is_dataclass(value):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    return value
