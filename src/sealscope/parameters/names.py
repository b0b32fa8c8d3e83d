"""Find parameters by their names, and split overrides as they are typed on a command line."""

from __future__ import annotations

from collections.abc import Sequence

from sealscope.calls import suggestion
from sealscope.errors import InputError

#: Names of parameters in textbooks and other programs, in lower case and without underscores.
_OTHER_NAMES = {
    **dict.fromkeys(("beta", "betae", "bulkmodulus"), "fluid.K_oil"),
    **dict.fromkeys(("ap", "area", "pistonarea"), "cylinder.A_A"),
    **dict.fromkeys(("m", "mass"), "cylinder.M_eq"),
    **dict.fromkeys(("dp", "displacement"), "pump.q_b"),
    **dict.fromkeys(("kt", "torqueconstant"), "motor.C_m"),
    **dict.fromkeys(("stroke", "strokelength"), "cylinder.L"),
}


def resolve_name(name: str, dotted: Sequence[str]) -> str:
    """Find the dotted name of a parameter from its end, such as `V_1` or `p_A.noise`, or from the dotted name itself.

    `dotted`: the dotted names of all parameters. Raises InputError if no parameter has the name, or if several have it.
    The error for a name that is usual in other programs (`_OTHER_NAMES`) suggests the parameter.
    """
    if name in dotted:
        return name
    matches = [full_name for full_name in dotted if full_name.endswith("." + name)] if name else []
    if len(matches) == 1:
        return matches[0]
    if matches:
        listed_names = ", ".join(matches[:6]) + (", ..." if len(matches) > 6 else "")
        raise InputError(f"parameter {name} is not unique, give one of {listed_names}")
    synonym = _OTHER_NAMES.get(name.casefold().replace("_", "").replace(" ", ""))
    if synonym in dotted:
        raise InputError(f"{name!r} is not a parameter; did you mean {synonym}?")
    symbols = dict.fromkeys(full_name.rpartition(".")[2] for full_name in dotted)
    raise InputError(f"{name!r} is not a parameter{suggestion(name, dotted if '.' in name else symbols)}")


def parse_overrides(texts: Sequence[str]) -> dict[str, str]:
    """Parse overrides `NAME=VALUE[unit]` to a mapping from `NAME` to the text `VALUE[unit]`.

    Raises InputError for a text of another form, or for a name with two different values.
    """
    overrides: dict[str, str] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if not (name and value):
            raise InputError(f"an override must be NAME=VALUE or NAME=VALUE[unit], got {text!r}")
        if overrides.setdefault(name, value) != value:
            raise InputError(f"{name} must be set once, got {overrides[name]} and {value}")
    return overrides
