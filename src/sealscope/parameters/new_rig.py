"""A new rig's file from four numbers of its machine: what they do not tell is assumed, and says so."""

from __future__ import annotations

import math

from sealscope.errors import InputError
from sealscope.parameters.load import load_rig

#: Dead volume of each side, over the larger swept volume.
_DEAD = 0.25
#: Gas in the accumulator over the oil that the rod displaces.
_GAS = 5.0


def rig_text(name: str, area_A: float, area_B: float, stroke: float, displacement: float) -> str:
    """Return the text of a rig's file, with comments.

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
    stated = "stated when this file was written: replace by drawing or data sheet"
    scaled = f"assumed: that of {base.name}, scaled with the"
    k_stop = base.cylinder.k_stop
    # side B is the smaller one in V_rod; a rod on side A leaves V to B
    V_rod = max(0.5 * (area_A - area_B) * stroke, 0.0)
    lines = [
        f"# {name}: written by `sealscope rigs new`. Each entry has a value, a unit and a source; a source that begins",
        f'# with "assumed:" is a guess to be replaced. What is not stated here is that of {base.name}:',
        f"# `sealscope parameters {base.name}`.",
        "",
        "[rig]",
        f'name = "{name}"',
        f'title = "{"Single" if single else "Double"}-rod cylinder, {1e6 * displacement:g} cm^3 pump"',
        f'extends = "{base.name}"',
        "",
        "# Speed of the motor for a volt of command, speed loop and winding (motor.omega_per_volt, k_p, K_i, R_c, ...)",
        "# are worth stating next: `sealscope parameters` lists them.",
        "[pump]",
        f'q_b = {{ value = {1e6 * displacement:.6g}, unit = "cm^3/rev", source = "{stated}" }}',
        "",
        "[cylinder]",
        f'A_A = {{ value = {1e6 * area_A:.6g}, unit = "mm^2", source = "{stated}" }}',
        f'A_B = {{ value = {1e6 * area_B:.6g}, unit = "mm^2", source = "{stated}" }}',
        f'L = {{ value = {1e3 * stroke:.6g}, unit = "mm", source = "{stated}" }}',
        f'V = {{ value = {1e6 * V:.6g}, unit = "cm^3", source = "assumed: half the swept volume, and a quarter of it '
        'in dead volume and hoses" }',
        f'V_rod = {{ value = {1e6 * V_rod:.6g}, unit = "cm^3", source = "assumed: (A_A - A_B) L/2, so that both sides '
        'have the same dead volume" }',
        'volumes = { value = "position", source = "assumed: the stroke moves the volumes" }',
        f'M_eq = {{ value = {mass:.4g}, unit = "kg", source = "{scaled} volume" }}',
        f'd_stop = {{ value = {math.sqrt(k_stop * mass):.4g}, unit = "N s/m", source = "assumed: half of critical '
        'damping of the stop" }',
        "",
        "[friction]",
    ]
    lines += [
        f'{symbol} = {{ value = {getattr(base.friction, symbol) * factor:.4g}, unit = "{unit}", source = "{scaled} '
        f'{with_}" }}'
        for symbol, factor, unit, with_ in (
            ("F_pr", bore, "N", "bore"),
            ("F_cfr", bore**2, "N/Pa", "area"),
            ("F_v", bore, "N s/m", "bore"),
        )
    ]
    if single:
        gas = _GAS * abs(area_A - area_B) * stroke
        valve = base.makeup.G_check * size
        lines += [
            "",
            "[makeup]",
            f'V_gas = {{ value = {1e3 * gas:.4g}, unit = "L", source = "assumed: five times the oil that the rod '
            'displaces" }',
            f'G_check = {{ value = {valve:.4g}, unit = "m^3/(s Pa)", source = "{scaled} volume" }}',
            f'G_relief = {{ value = {valve:.4g}, unit = "m^3/(s Pa)", source = "{scaled} volume" }}',
        ]
    return "\n".join(lines) + "\n"
