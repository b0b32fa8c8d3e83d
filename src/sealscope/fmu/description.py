"""The description of a unit as FMI asks for it: modelDescription.xml, versions 2.0 and 3.0."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from xml.etree import ElementTree

from sealscope.fmu.variables import Variable
from sealscope.units import parse_unit

#: The inputs that an output follows without delay; all other outputs are states or follow from states.
DIRECT: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"V": ("u",), "P_electric": ("u",), "q_leak": ("G", "C"), "q_ext": ("G_ext_A", "G_ext_B")}
)
_DEFAULT = {"startTime": "0", "stopTime": "20", "stepSize": "0.001"}


def base_units(unit: str) -> dict[str, str] | None:
    """Return a unit as FMI writes it: exponents of SI's base units and a factor; None where one is not whole.

    Raises InputError for a unit that is not known.
    """
    parsed = parse_unit(unit)
    if any(power.denominator != 1 for _, power in parsed.powers):
        return None
    base = {name: str(power) for name, power in parsed.powers if name != "count"}
    factor = float(parsed.factor) * math.pi ** float(parsed.pi_power)
    return base if factor == 1.0 else base | {"factor": repr(factor)}


def _units(parent: ElementTree.Element, variables: Sequence[Variable]) -> None:
    definitions = ElementTree.SubElement(parent, "UnitDefinitions")
    for unit in sorted({"s", *(variable.unit for variable in variables)} - {"1"}):  # that of the time is always needed
        element = ElementTree.SubElement(definitions, "Unit", name=unit)
        base = base_units(unit)
        if base:
            ElementTree.SubElement(element, "BaseUnit", base)
        if unit == "m^3/s":
            ElementTree.SubElement(element, "DisplayUnit", name="L/min", factor="60000")
        if unit == "Pa":
            ElementTree.SubElement(element, "DisplayUnit", name="bar", factor="1e-5")


def _common(root: ElementTree.Element, identifier: str, words: str, variables: Sequence[Variable], state: str) -> None:
    from importlib.metadata import version

    root.set("description", words)
    root.set("generationTool", f"Sealscope {version('sealscope')}")
    root.set("variableNamingConvention", "structured")
    can = {"modelIdentifier": identifier, f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    unit = ElementTree.SubElement(root, "CoSimulation", can)
    unit.set("canHandleVariableCommunicationStepSize", "true")
    if state == "FMUstate":
        unit.set("canInterpolateInputs", "true")
        unit.set("canNotUseMemoryManagementFunctions", "true")
    _units(root, variables)
    ElementTree.SubElement(ElementTree.SubElement(root, "LogCategories"), "Category", name="logStatusError")
    ElementTree.SubElement(root, "DefaultExperiment", _DEFAULT)


def _attributes(variable: Variable) -> dict[str, str]:
    return {
        "name": variable.name,
        "valueReference": str(variable.reference),
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.variability,
    }


def _value(variable: Variable) -> dict[str, str]:
    given = {} if variable.unit == "1" else {"unit": variable.unit}
    return given if variable.start is None else given | {"start": repr(float(variable.start))}


def _document(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def description_2(identifier: str, token: str, words: str, variables: Sequence[Variable]) -> bytes:
    """Return modelDescription.xml of FMI 2.0."""
    root = ElementTree.Element("fmiModelDescription", fmiVersion="2.0", modelName=identifier, guid=token)
    _common(root, identifier, words, variables, "FMUstate")
    held = ElementTree.SubElement(root, "ModelVariables")
    for variable in variables:
        scalar = ElementTree.SubElement(held, "ScalarVariable", _attributes(variable))
        if variable.causality == "output":
            scalar.set("initial", "calculated")
        elif variable.causality == "parameter":
            scalar.set("initial", "exact")
        ElementTree.SubElement(scalar, "Real", _value(variable))
    index = {variable.name: str(k) for k, variable in enumerate(variables, 1)}
    structure = ElementTree.SubElement(root, "ModelStructure")
    outputs, initial = (
        ElementTree.SubElement(structure, "Outputs"),
        ElementTree.SubElement(structure, "InitialUnknowns"),
    )
    for variable in variables:
        if variable.causality == "output":
            direct = " ".join(index[name] for name in DIRECT.get(variable.name, ()))
            ElementTree.SubElement(outputs, "Unknown", index=index[variable.name], dependencies=direct)
            ElementTree.SubElement(initial, "Unknown", index=index[variable.name])
    return _document(root)


def description_3(identifier: str, token: str, words: str, variables: Sequence[Variable]) -> bytes:
    """Return modelDescription.xml of FMI 3.0."""
    root = ElementTree.Element("fmiModelDescription", fmiVersion="3.0", modelName=identifier, instantiationToken=token)
    _common(root, identifier, words, variables, "FMUState")
    held = ElementTree.SubElement(root, "ModelVariables")
    time = {"name": "time", "valueReference": "0", "causality": "independent", "variability": "continuous"}
    ElementTree.SubElement(held, "Float64", time | {"unit": "s"})
    for variable in variables:
        ElementTree.SubElement(held, "Float64", _attributes(variable) | _value(variable))
    references = {variable.name: str(variable.reference) for variable in variables}
    structure = ElementTree.SubElement(root, "ModelStructure")
    outputs = [variable for variable in variables if variable.causality == "output"]
    for variable in outputs:
        direct = " ".join(references[name] for name in DIRECT.get(variable.name, ()))
        ElementTree.SubElement(structure, "Output", valueReference=references[variable.name], dependencies=direct)
    for variable in outputs:
        ElementTree.SubElement(structure, "InitialUnknown", valueReference=references[variable.name])
    return _document(root)
