"""A new rig's file from four numbers of its machine: all others are assumed, and marked as such."""

from __future__ import annotations

import math
from pathlib import Path
from string import Template

from sealscope.errors import InputError
from sealscope.parameters.load import load_rig

#: Dead volume of each side, over the larger swept volume.
_DEAD = 0.25
#: Gas in the accumulator over the oil that the rod displaces.
_GAS = 5.0


def rig_text(name: str, area_A: float, area_B: float, stroke: float, displacement: float) -> str:
    """Format a rig's file, with comments.

    What the four numbers do not tell is taken from `thesis` (equal areas) or `single-rod-eha`, scaled where the size of
    the machine says how: friction with the bore, moving mass with the oil displaced, valves with the volumes.

    Parameters
    ----------
    name : str
        Name of the rig.
    area_A, area_B : float
        Piston areas [m^2].
    stroke : float
        Stroke [m].
    displacement : float
        Displacement of the pump [m^3/rev].

    Raises
    ------
    InputError
        A number is not > 0, or the name has more than letters, digits, `-`, `_` and blanks.
    """
    for what, value in (("area-A", area_A), ("area-B", area_B), ("stroke", stroke), ("displacement", displacement)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{what} must be > 0, got {value:g}")
    if not name.strip() or not all(letter.isalnum() or letter in "-_ " for letter in name):
        raise InputError(f"name of a rig must be of letters, digits, '-', '_' and blanks, got {name!r}")
    single = area_A != area_B
    base = load_rig("single-rod-eha" if single else "thesis")
    larger = max(area_A, area_B)
    bore = math.sqrt(larger / max(base.cylinder.A_A, base.cylinder.A_B))
    V = (0.5 + _DEAD) * larger * stroke
    size = V / base.cylinder.V
    mass = base.cylinder.M_eq * size
    scaled = f"assumed: that of {base.name}, scaled with the"
    # side B is the smaller one in V_rod; a rod on side A leaves V to B
    V_rod = max(0.5 * (area_A - area_B) * stroke, 0.0)
    friction = base.friction
    text = Template(Path(__file__).with_name("new_rig.toml.txt").read_text(encoding="utf-8")).substitute(
        name=name,
        kind="Single" if single else "Double",
        base=base.name,
        stated="stated when this file was written: replace by drawing or data sheet",
        scaled=scaled,
        q_b=f"{1e6 * displacement:g}",
        displacement=f"{1e6 * displacement:.6g}",
        area_A=f"{1e6 * area_A:.6g}",
        area_B=f"{1e6 * area_B:.6g}",
        stroke=f"{1e3 * stroke:.6g}",
        V=f"{1e6 * V:.6g}",
        V_rod=f"{1e6 * V_rod:.6g}",
        M_eq=f"{mass:.4g}",
        d_stop=f"{math.sqrt(base.cylinder.k_stop * mass):.4g}",
        F_pr=f"{friction.F_pr * bore:.4g}",
        F_cfr=f"{friction.F_cfr * bore**2:.4g}",
        F_v=f"{friction.F_v * bore:.4g}",
        V_gas=f"{1e3 * _GAS * abs(area_A - area_B) * stroke:.4g}",
        G_check=f"{base.makeup.G_check * size:.4g}",
    )
    return text if single else text[: text.index("\n[makeup]")]
