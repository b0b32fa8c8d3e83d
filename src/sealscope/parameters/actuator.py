"""Parameters of the cylinder and its friction."""

from __future__ import annotations

from typing import Literal

from sealscope.parameters.fields import Part, choice, conductance, quantity

#: Largest difference of a double-rod cylinder's areas, divided by their mean: makers' tolerances.
_MAX_DOUBLE_ROD_UNEVENNESS = 0.1


class Cylinder(Part):
    """Parameters of the cylinder, its end stops and its load, eqs. (4.13)-(4.15), (4.18), (4.19) of the thesis.

    The position x is 0 at mid-stroke. The areas A_A and A_B of a double-rod cylinder are equal to within makers'
    tolerances; those of a single-rod cylinder differ by more (`single_rod`).
    """

    A_A: float = quantity("piston area on side A", "m^2", gt=0, le=10)
    A_B: float = quantity("piston area on side B", "m^2", gt=0, le=10)
    L: float = quantity("stroke", "m", gt=0, le=100)
    M_eq: float = quantity("moving mass", "kg", gt=0, le=1e6)
    V: float = quantity("volume of each side at mid-stroke", "m^3", gt=0, le=100)
    V_rod: float = quantity("rod in side B at mid-stroke: V less this is left", "m^3", absent=0, ge=0, le=100)
    volumes: Literal["fixed", "position"] = choice("chamber volumes: constant V, or V + A_A x and V - A_B x")
    balance: Literal["mass", "volume"] = choice(
        "what chambers balance where volumes move with the piston", absent="mass"
    )
    k_stop: float = quantity("stiffness of the end stop", "N/m", gt=0, le=1e12)
    d_stop: float = quantity("damping of the end stop", "N s/m", ge=0, le=1e9)
    V_hose_A: float = quantity("hose on side A: volume beside the chamber's", "m^3", absent=0, ge=0, le=1)
    V_hose_B: float = quantity("hose on side B: volume beside the chamber's", "m^3", absent=0, ge=0, le=1)
    k_load: float = quantity("spring of the load about mid-stroke", "N/m", absent=0, ge=0, le=1e9)
    d_load: float = quantity("damper of the load", "N s/m", absent=0, ge=0, le=1e9)
    A_opp: float = quantity("piston area of an opposing cylinder (0: none)", "m^2", absent=0, ge=0, le=10)
    p_opp: float = quantity("pressure that feeds the opposing cylinder", "Pa", absent=0, ge=0, le=1e9)
    C_opp: float = quantity("coefficient of the orifice in that feed", "m^3/(s Pa^0.5)", absent=1, gt=0, le=1)
    F_l: float = quantity("constant external load", "N", ge=-1e8, le=1e8)
    G_ext_A: float = conductance("leakage conductance of the rod seal of A")
    G_ext_B: float = conductance("leakage conductance of the rod seal of B")

    @property
    def single_rod(self) -> bool:
        """True if the piston areas differ by more than makers' tolerances, 10 % of their mean."""
        return abs(self.A_A - self.A_B) / (0.5 * (self.A_A + self.A_B)) > _MAX_DOUBLE_ROD_UNEVENNESS


class Friction(Part):
    """Coulomb, Stribeck and viscous friction of the piston, eqs. (4.20)-(4.22) of the thesis.

    `law` may select another law near standstill, which uses the same forces while the piston slides.
    """

    F_pr: float = quantity("preload force of the seals", "N", ge=0, le=1e7)
    F_cfr: float = quantity("Coulomb friction per pressure", "N/Pa", ge=0, le=1)
    C_c: float = quantity("transition coefficient", "s/m", gt=0, le=1e6)
    K_brk: float = quantity("breakaway force over Coulomb force", "1", ge=1, le=100)
    F_v: float = quantity("viscous friction coefficient", "N s/m", ge=0, le=1e8)
    v_th: float = quantity("velocity below which friction is linear", "m/s", gt=0, le=10)
    coulomb_pressure: Literal["sum", "difference"] = choice("pressure in the Coulomb force, eq. (4.20)")
    law: Literal["stribeck", "karnopp", "lugre"] = choice("law of friction near standstill", absent="stribeck")
    sigma_0: float = quantity("stiffness of the contact, LuGre", "N/m", absent=1e6, gt=0, le=1e12)
    sigma_1: float = quantity("damping of the contact, LuGre", "N s/m", absent=1e3, ge=0, le=1e9)
    backward: float = quantity("friction of motion towards -x over that towards +x", "1", absent=1, gt=0, le=100)
    bracket: Literal["continuous", "literal"] = choice("bracketing of the linear part, eq. (4.22)")
