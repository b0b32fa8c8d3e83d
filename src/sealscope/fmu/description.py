"""The description of a functional mock-up unit (FMU): modelDescription.xml of FMI 2.0 and 3.0."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from typing import TYPE_CHECKING

from sealscope.fmu.variables import DIRECT, Variable
from sealscope.units import parse_unit

if TYPE_CHECKING:
    import jinja2


@cache
def templates() -> jinja2.Environment:
    """Return the jinja2 environment with the templates of an FMU's files: XML description and C header."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("sealscope.fmu"),
        autoescape=jinja2.select_autoescape(enabled_extensions=("xml.j2",)),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )


def base_units(unit: str) -> dict[str, str] | None:
    """Express a physical unit in SI base units, as FMI describes it; None if an exponent is not whole.

    Returns the exponents by base unit, and "factor" if it is not 1: "mm" gives {"m": "1", "factor": "0.001"}.
    """
    parsed = parse_unit(unit)
    if any(power.denominator != 1 for _, power in parsed.powers):
        return None
    base = {name: str(power) for name, power in parsed.powers if name != "count"}  # FMI has no unit of counts
    factor = float(parsed.factor) * math.pi ** float(parsed.pi_power)  # pi occurs in rpm, for example
    return base if factor == 1.0 else base | {"factor": repr(factor)}


def format_build_description(identifier: str, sources: Sequence[str]) -> str:
    """Format sources/buildDescription.xml of FMI 3, which lists the C files to compile."""
    return templates().get_template("build.xml.j2").render(identifier=identifier, sources=sources)


def format_description(
    fmi: int, identifier: str, token: str, summary: str, variables: Sequence[Variable], sources: Sequence[str]
) -> str:
    """Format modelDescription.xml, the description of an FMU for version 2 or 3 of FMI.

    `identifier`: prefix of the C functions; `token`: hash by which the compiled library recognises this description;
    `summary`: one line that describes the FMU; `sources`: names of the C files to compile.
    """
    by_name = {variable.name: variable for variable in variables}
    outputs = [variable for variable in variables if variable.causality == "output"]
    units = sorted({"s", *(variable.unit for variable in variables)} - {"1"})  # s: unit of time; 1: no unit
    template = templates().get_template(f"fmi{fmi}.xml.j2")
    return template.render(
        identifier=identifier,
        token=token,
        summary=summary,
        sealscope=version("sealscope"),
        units=[(unit, base_units(unit)) for unit in units],
        variables=variables,
        sources=sources,
        outputs=outputs,
        index={variable.name: k for k, variable in enumerate(variables, 1)},  # by which FMI 2 names variables
        dependencies={
            output.name: [by_name[name] for name in DIRECT.get(output.name, ()) if name in by_name]
            for output in outputs
        },
    )
