"""Declaration of parameters as fields of pydantic models: symbol, human name, SI unit and range.

A model contains SI numbers and choices only. Values have no default: each comes from a rig's file, with its source. A
parameter may declare the value that switches its law off (`absent`), which a file that does not state it implies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, Self, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from sealscope.errors import InputError
from sealscope.storage.plain_values import format_error


def quantity(name: str, unit: str, *, absent: float | None = None, **bounds: float) -> Any:
    """Declare a numeric parameter with its name in words, its SI unit ("1" if it has none) and its bounds.

    `bounds`: `gt`, `ge`, `lt` or `le`, in that unit. `absent`: the value for a rig without the part or effect that the
    number describes, or None if every rig must state the parameter.
    """
    return Field(title=name, json_schema_extra={"unit": unit, "absent": absent}, **bounds)  # type: ignore[call-overload]


def conductance(name: str, *, absent: float | None = None) -> Any:
    """Declare a leak's or valve's conductance of 0 to 1e-6 m^3/(s Pa); `name`, `absent`: arguments of `quantity`."""
    return quantity(name, "m^3/(s Pa)", absent=absent, ge=0, le=1e-6)


def choice(name: str, *, absent: str | None = None) -> Any:
    """Declare a parameter, called `name` in words, whose value is one of the options in its annotation, a Literal.

    `absent`: the option for a rig whose file does not state the parameter, or None if every rig must state it.
    """
    return Field(title=name, json_schema_extra={"unit": "", "absent": absent})


def unit_of(field: FieldInfo) -> str:
    """Return the SI unit of a declared parameter: "1" for a number without unit, "" for a choice."""
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) else ""


def absent_of(field: FieldInfo) -> float | str | None:
    """Return a parameter's value in a rig without the part or effect it describes; None if every rig must state it."""
    extra = field.json_schema_extra
    return extra["absent"] if isinstance(extra, dict) else None  # type: ignore[return-value]


def choices_of(field: FieldInfo) -> tuple[str, ...]:
    """Return the options of a parameter that is a choice, () for a number."""
    return get_args(field.annotation) if get_origin(field.annotation) is Literal else ()


def with_unit(number: float, unit: str) -> str:
    """Format `number` with its unit; without a unit if `unit` is "" or "1"."""
    return f"{number:g}" if unit in ("", "1") else f"{number:g} {unit}"


def format_broken_rule(error: ValidationError, model: type[BaseModel]) -> str:
    """Format a validation error of pydantic about the parameters of a class as a line "SYMBOL must be ..., got ...".

    Of several errors, one about an unknown name is formatted if there is any, otherwise the first.
    """
    first = error.errors(include_url=False)[0]
    symbol = ".".join(map(str, first["loc"]))
    # pydantic states a broken bound under its name, as in {"gt": 0}; for an unknown name `format_error` drops the unit
    has_bound = symbol in model.model_fields and first.get("ctx", {}).keys() & {"gt", "ge", "lt", "le"}
    unit = unit_of(model.model_fields[symbol]) if has_bound else ""
    return format_error(error, unit="" if unit in ("", "1") else f" {unit}")


class PartsDisagreeError(InputError):
    """A rule that relates several parameters is broken, and no single one of them is the cause."""


class Part(BaseModel):
    """A group of parameters, such as those of the pump; immutable and validated.

    Numbers must be finite and within their bounds, and unknown names are refused; InputError is raised otherwise.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        """Make the group from its parameters' values; raise InputError, or PartsDisagreeError if values conflict."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            # "value_error": a ValueError of a validator in this package, which checks several parameters
            is_joint_rule = error.errors(include_url=False)[0]["type"] == "value_error"
            raise (PartsDisagreeError if is_joint_rule else InputError)(format_broken_rule(error, type(self))) from None

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return an unchanged copy of this group; raise InputError for an `update`, which would not be validated."""
        if update:
            raise InputError("a rig must be changed by Rig.with_overrides, got model_copy(update=...)")
        return super().model_copy(deep=deep)


def iter_fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield (dotted name, declaration) of each parameter of a class and its groups; `prefix`: start of the names."""
    for symbol, field in model.model_fields.items():
        annotation = field.annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield from iter_fields(annotation, f"{prefix}{symbol}.")
        elif field.json_schema_extra is not None:  # declared by `quantity` or `choice`
            yield prefix + symbol, field
