"""Declaration of a parameter: the field's name is the symbol; human name, SI unit and range stand in the model.

A model holds SI numbers and choices only. It has no default: every value comes from a rig's file, with its source. A
parameter may declare the value at which it is `absent` from the model; a file that does not state it means that one.
"""

from __future__ import annotations

import typing
from collections.abc import Iterator, Mapping
from typing import Any, Self, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from sealscope.errors import InputError
from sealscope.storage.plain_values import one_line


def quantity(name: str, unit: str, *, absent: float | None = None, **bounds: float) -> Any:
    """Declare a number: human `name`, SI `unit` ("1" where it has none), bounds `gt`, `ge`, `lt`, `le` in that unit.

    `absent`: the value that leaves what it stands for out of the model.
    """
    return Field(title=name, json_schema_extra={"unit": unit, "absent": absent}, **bounds)  # type: ignore[call-overload]


def choice(name: str, *, absent: str | None = None) -> Any:
    """Declare a choice between readings of the source, or between laws; the annotation is a Literal of the values.

    `absent`: the value that leaves all other laws out of the model.
    """
    return Field(title=name, json_schema_extra={"unit": "", "absent": absent})


def unit_of(field: FieldInfo) -> str:
    """Return the SI unit of a declared parameter ("" for a choice)."""
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) else ""


def absent_of(field: FieldInfo) -> float | str | None:
    """Return the value at which a parameter is absent from the model, None where it never is."""
    extra = field.json_schema_extra
    return extra["absent"] if isinstance(extra, dict) else None  # type: ignore[return-value]


def choices_of(field: FieldInfo) -> tuple[str, ...]:
    """Return the allowed values of a choice, () for a number."""
    annotation = field.annotation
    return get_args(annotation) if get_origin(annotation) is typing.Literal else ()


def with_unit(number: float, unit: str) -> str:
    """Format `number` with its unit, bare where it has none."""
    return f"{number:g}" if unit in ("", "1") else f"{number:g} {unit}"


def rule_broken(error: ValidationError, model: type[BaseModel]) -> str:
    """Format pydantic's first message on values of `model` as "SYMBOL must be ..., got ...", bounds with their unit."""
    first = error.errors(include_url=False)[0]
    symbol = ".".join(map(str, first["loc"]))
    bounded = symbol in model.model_fields and first.get("ctx", {}).keys() & {"gt", "ge", "lt", "le"}
    unit = unit_of(model.model_fields[symbol]) if bounded else ""
    return one_line(error, unit="" if unit in ("", "1") else f" {unit}")


class PartsDisagreeError(InputError):
    """A rule across several parameters is broken; no single one of them is to blame."""


class Part(BaseModel):
    """A group of parameters: immutable, finite numbers, no unknown names; breaking a rule raises InputError."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            across = error.errors(include_url=False)[0]["type"] == "value_error"
            raise (PartsDisagreeError if across else InputError)(rule_broken(error, type(self))) from None

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy; with `update` it raises InputError, because pydantic would not validate the new values."""
        if update:
            raise InputError("a rig must be changed by Rig.with_overrides, got model_copy(update=...)")
        return super().model_copy(deep=deep)


def leaves(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """List dotted name and declaration of every parameter below `model`, in the order of declaration."""
    for symbol, field in model.model_fields.items():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield from leaves(annotation, f"{prefix}{symbol}.")
        elif field.json_schema_extra is not None:
            yield prefix + symbol, field
