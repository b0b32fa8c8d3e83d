"""Write the file of a new rig from the numbers of a data sheet; all other values are assumed, and marked as such."""

from __future__ import annotations

import math
from pathlib import Path
from string import Template

from sealscope.errors import InputError
from sealscope.parameters.rig import GAS_OVER_ROD, Rig, load_rig
from sealscope.units import BAR, LITRE_PER_MINUTE

_DEAD_VOLUME_RATIO = 0.25  # dead volume of each side, divided by the larger swept volume
_SUPPLY_SPEED = 25.0  # speed of a supply's pump [rev/s]
#: Pressure [Pa] above the setting of a supply's relief valve at which the valve passes the pump's whole flow.
_RELIEF_RANGE = 2.5e5
_PRECHARGE_RATIO = 0.7  # precharge pressure of a supply's accumulator, divided by the setting of the relief valve
_STATED = "stated when this file was written: replace by drawing or data sheet"


def piston_areas(bore: float, rod: float, *, double_rod: bool = False) -> tuple[float, float]:
    """Compute the piston areas [m^2] of sides A and B from the diameters of bore and rod [m].

    The rod is on side B only, or on both sides with `double_rod`. Raises InputError unless 0 <= rod < bore.
    """
    if not (math.isfinite(bore) and 0.0 <= rod < bore):
        raise InputError(f"rod must be >= 0 mm and below the bore, {1e3 * bore:g} mm, got {1e3 * rod:g} mm")
    ring_area = 0.25 * math.pi * (bore**2 - rod**2)
    return (ring_area if double_rod else 0.25 * math.pi * bore**2), ring_area


def rig_text(name: str, area_A: float, area_B: float, stroke: float, displacement: float) -> str:
    """Format a new rig's TOML file, with comments, for a cylinder that is controlled by its pump.

    `area_A`, `area_B` [m^2]: piston areas; `stroke` [m]; `displacement` [m^3/rev] of the pump. All other parameters are
    taken from the rig `thesis` if the areas are equal, else from `single-rod-eha`. Some of them are scaled to the
    machine's size, such as friction with the bore or area, and the moving mass with the volume. A table `[makeup]`, for
    the oil that the rod displaces, is written only if the areas differ. Raises InputError as `_check_arguments` does.
    """
    _check_arguments(name, {"area-A": area_A, "area-B": area_B, "stroke": stroke, "displacement": displacement})
    is_single_rod = area_A != area_B
    base = load_rig("single-rod-eha" if is_single_rod else "thesis")
    sizes = _cylinder_parameters(base, area_A, area_B, stroke)
    text = _read_template("new_rig.toml.txt").substitute(
        sizes,
        name=name,
        q_b=f"{1e6 * displacement:g}",
        displacement=f"{1e6 * displacement:.6g}",
        G_healthy=f"{base.pump.G_healthy * displacement / base.pump.q_b:.4g}",
        V_gas=f"{1e3 * GAS_OVER_ROD * abs(area_A - area_B) * stroke:.4g}",
        G_check=f"{base.makeup.G_check * _volume_ratio(base, area_A, area_B, stroke):.4g}",
    )
    # equal areas need no make-up valves, whose table is the last one
    return text if is_single_rod else text[: text.index("\n[makeup]")]


def valve_rig_text(
    name: str,
    area_A: float,
    area_B: float,
    stroke: float,
    rated_flow: float,
    rated_drop: float | None = None,
    pressure: float | None = None,
) -> str:
    """Format a new rig's TOML file, with comments, for a cylinder that is controlled by a servo valve.

    `area_A`, `area_B` [m^2]: piston areas; `stroke` [m]; `rated_flow` [m^3/s]: flow of the valve at the pressure drop
    `rated_drop` [Pa] of one edge, by default 35 bar; `pressure` [Pa]: that of the supply above the return, by default
    as in the rig `servo-valve`. All other parameters are taken from this rig; some of them are scaled to the machine's
    size. Raises InputError as `_check_arguments` does.
    """
    base = load_rig("servo-valve")
    drop = base.valve.dp_N if rated_drop is None else rated_drop
    setting = base.supply.p_set if pressure is None else pressure
    sizes = {"area-A": area_A, "area-B": area_B, "stroke": stroke, "valve": rated_flow, "drop": drop, "supply": setting}
    _check_arguments(name, sizes)
    assumed = f"assumed: that of {base.name}"
    usual_drop = "assumed: usual of servo valves; proportional valves are rated at 5 bar"
    # the motor is scaled as if `n_motors` motors of the base rig were on one shaft, connected in parallel; this number
    # is the ratio of the pumps' torques
    n_motors = rated_flow / _SUPPLY_SPEED * setting / (base.pump.q_b * base.supply.p_set)
    motor = {key: f"{base[f'motor.{key}'] * n_motors:.4g}" for key in ("i_max", "J_M", "B_M")}  # type: ignore[operator]
    motor |= {key: f"{base[f'motor.{key}'] / n_motors:.4g}" for key in ("R_c", "L_c")}  # type: ignore[operator]
    return _read_template("new_valve_rig.toml.txt").substitute(
        _cylinder_parameters(base, area_A, area_B, stroke),
        name=name,
        flow=f"{rated_flow / LITRE_PER_MINUTE:.6g}",
        drop=f"{drop / BAR:.6g}",
        drop_source=usual_drop if rated_drop is None else _STATED,
        pressure=f"{setting / BAR:.6g}",
        pressure_source=assumed if pressure is None else _STATED,
        charge=f"{_PRECHARGE_RATIO * setting / BAR:.4g}",
        G_set=f"{rated_flow / _RELIEF_RANGE:.4g}",
        V_acc=f"{1e3 * base.supply.V_acc * rated_flow / base.valve.Q_N:.4g}",
        q_b=f"{1e6 * rated_flow / _SUPPLY_SPEED:.4g}",
        **motor,
    )


def _check_arguments(name: str, sizes: dict[str, float]) -> None:
    """Raise InputError unless a new rig's `name` is valid, and its `sizes`, argument -> value, are finite and > 0."""
    for argument, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{argument} must be > 0, got {value:g}")
    if not name.strip() or not all(letter.isalnum() or letter in "-_ " for letter in name):
        raise InputError(f"name of a rig must consist of letters, digits, '-', '_' and blanks, got {name!r}")


def _read_template(file: str) -> Template:
    """Read the template of a rig's file from this module's folder."""
    return Template(Path(__file__).with_name(file).read_text(encoding="utf-8"))


def _volume_ratio(base: Rig, area_A: float, area_B: float, stroke: float) -> float:
    """Compute the ratio of a new cylinder's volume at mid-stroke, with assumed dead volume, to V of the rig `base`."""
    return (0.5 + _DEAD_VOLUME_RATIO) * max(area_A, area_B) * stroke / base.cylinder.V


def _cylinder_parameters(base: Rig, area_A: float, area_B: float, stroke: float) -> dict[str, str]:
    """Format the cylinder and friction parameters of a new rig, scaled from the rig `base`, for a template.

    `area_A`, `area_B` [m^2] and `stroke` [m] are those of the new cylinder. In the texts, areas are in mm^2, lengths in
    mm, volumes in cm^3, and other values in SI units.
    """
    friction, volume_ratio = base.friction, _volume_ratio(base, area_A, area_B, stroke)
    bore_ratio = math.sqrt(max(area_A, area_B) / max(base.cylinder.A_A, base.cylinder.A_B))
    mass = base.cylinder.M_eq * volume_ratio
    # V: volume of the larger side at half stroke; V_rod: volume that a rod on side B takes from side B at half stroke
    V_rod = max(0.5 * (area_A - area_B) * stroke, 0.0)
    return {
        "kind": "Double" if area_A == area_B else "Single",
        "base": base.name,
        "stated": _STATED,
        "scaled": f"assumed: that of {base.name}, scaled with the",  # the template names the quantity
        "area_A": f"{1e6 * area_A:.6g}",
        "area_B": f"{1e6 * area_B:.6g}",
        "stroke": f"{1e3 * stroke:.6g}",
        "V": f"{1e6 * volume_ratio * base.cylinder.V:.6g}",
        "V_rod": f"{1e6 * V_rod:.6g}",
        "M_eq": f"{mass:.4g}",
        "d_stop": f"{math.sqrt(base.cylinder.k_stop * mass):.4g}",  # damping ratio 1/2
        "F_pr": f"{friction.F_pr * bore_ratio:.4g}",
        "F_cfr": f"{friction.F_cfr * bore_ratio**2:.4g}",
        "F_v": f"{friction.F_v * bore_ratio:.4g}",
    }
