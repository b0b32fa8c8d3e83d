"""Friction of piston and rod: Coulomb, Stribeck and viscous, linear near standstill (eqs. 4.20-4.22 of the thesis).

A rig may have one of two other laws instead: in Karnopp's the piston sticks at standstill; in LuGre's the contact is an
elastic bristle that deflects before it slides.
"""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import exponential, select


@contracted
def coulomb_friction(p_A: float, p_B: float, F_pr: float, F_cfr: float, use_difference: bool) -> float:
    """Compute the Coulomb friction force F_C = F_pr + F_cfr (p_A + p_B) [N].

    `p_A`, `p_B` [Pa]: chamber pressures; `F_pr` [N]: preload force of the seals; `F_cfr` [N/Pa]: Coulomb friction per
    pressure. `use_difference`: take p_A - p_B instead of the sum, as eq. (4.20) of the thesis is printed.
    """
    return F_pr + F_cfr * ((p_A - p_B) if use_difference else (p_A + p_B))


@contracted
def stribeck_force(speed: float, F_C: float, K_brk: float, C_c: float) -> float:
    """Compute the sum of Coulomb and Stribeck friction [N] at `speed` >= 0 [m/s], eq. (4.21) without viscous friction.

    The sum F_C (1 + (K_brk - 1) exp(-C_c speed)) falls from the breakaway force K_brk F_C at standstill to the Coulomb
    force F_C [N] at high speed. `K_brk`: breakaway force over Coulomb force; `C_c` [s/m]: transition coefficient.
    """
    return F_C * (1.0 + (K_brk - 1.0) * exponential(-C_c * speed))  # type: ignore[no-any-return]


@contracted
def karnopp_friction(
    v: float, applied: float, breakaway: float, F_C: float, K_brk: float, C_c: float, F_v: float, v_th: float
) -> float:
    """Compute Karnopp's friction force [N]: the piston sticks at velocities |v| < v_th, and slides otherwise.

    While it sticks, friction balances `applied` [N], the sum of all other forces, up to `breakaway` [N], which is
    K_brk F_C of the direction in which they push. While it slides at the velocity `v` [m/s], friction is that of eq.
    (4.21) (`stribeck_friction`), with `F_C` [N] and `F_v` [N s/m] of the direction of `v`.

    Source: D. Karnopp, Computer simulation of stick-slip friction in mechanical dynamic systems, ASME Journal of
    Dynamic Systems, Measurement and Control 107 (1985) 100-103.
    """
    speed = abs(v)
    sliding = math.copysign(stribeck_force(speed, F_C, K_brk, C_c), v) + F_v * v
    stuck = min(max(applied, -breakaway), breakaway)
    return select(speed < v_th, stuck, sliding)  # type: ignore[no-any-return]


@contracted
def stuck_velocity(v: float, v_th: float) -> float:
    """Compute the velocity [m/s] of a piston with Karnopp's friction: v, or 0 while the piston sticks, |v| < v_th."""
    return select(abs(v) < v_th, 0.0 * v, v)  # type: ignore[no-any-return]  # 0.0 * v: a zero of v's type


@contracted
def bristle_rate(v: float, z: float, g: float, sigma_0: float) -> float:
    """Compute the rate dz/dt [m/s] of the mean deflection z [m] of the contact's elastic bristles in LuGre's law.

    dz/dt = v - sigma_0 |v|/g z, with the velocity v [m/s], the friction `g` > 0 [N] of steady sliding at v without its
    viscous part, and the bristles' stiffness `sigma_0` [N/m].

    Source: C. Canudas de Wit, H. Olsson, K. J. Astrom, P. Lischinsky, A new model for control of systems with
    friction, IEEE Transactions on Automatic Control 40 (1995) 419-425, eq. (2). The paper's g is a Gaussian of v, here
    eq. (4.21) of the thesis (`stribeck_force`).
    """
    return v - sigma_0 * abs(v) / g * z


@contracted
def lugre_friction(v: float, z: float, dz: float, sigma_0: float, sigma_1: float, F_v: float, v_th: float) -> float:
    """Compute LuGre's friction force [N] from the deflection of the contact's bristles and the velocity.

    F = sigma_0 z + sigma_1 exp(-(v/v_th)^2) dz + F_v v. `v` [m/s]: velocity; `z` [m], `dz` [m/s]: the bristles' mean
    deflection and its rate (`bristle_rate`); `sigma_0` [N/m], `sigma_1` [N s/m]: stiffness and damping of the bristles;
    `F_v` [N s/m]: viscous coefficient. The damping decays at speeds above `v_th` [m/s]; else it could drive the motion.

    Source: eq. (3) of the paper cited in `bristle_rate`; H. Olsson, Control Systems with Friction, Lund 1996, sect. 5.
    """
    relative_v = v / v_th
    return sigma_0 * z + sigma_1 * exponential(-relative_v * relative_v) * dz + F_v * v  # type: ignore[no-any-return]


@contracted
def stribeck_friction(
    v: float, F_C: float, K_brk: float, C_c: float, F_v: float, v_th: float, literal_bracket: bool
) -> float:
    """Compute the thesis's friction force [N] at the velocity v [m/s], eqs. (4.21)-(4.22).

    - |v| > v_th: F = F_C (1 + (K_brk - 1) exp(-C_c |v|)) sign(v) + F_v v, eq. (4.21).
    - |v| <= v_th: F = v [F_C (1 + (K_brk - 1) exp(-C_c v_th)) + F_v v_th] / v_th, linear, and continuous at v_th.

    `F_C` [N]: Coulomb force; `K_brk`: breakaway force over Coulomb force; `C_c` [s/m]: transition coefficient; `F_v` [N
    s/m]: viscous coefficient; `v_th` [m/s]: velocity below which friction is linear.

    Eq. (4.22), for |v| <= v_th, is printed with an unbalanced bracket. `literal_bracket` takes F = v F_C [1 + (K_brk -
    1) exp(-C_c |v|) + F_v v_th] / v_th, as if F_C multiplied F_v v_th, too. F then drops where the speed rises beyond
    v_th, with Table 4.1 and no pressure from 145.2 N to 73.2 N.
    """
    speed = abs(v)
    if literal_bracket:
        stribeck = 1.0 + (K_brk - 1.0) * exponential(-C_c * speed)
        slow = v * F_C * (stribeck + F_v * v_th) / v_th
        return select(speed > v_th, math.copysign(F_C * stribeck, v) + F_v * v, slow)  # type: ignore[no-any-return]
    smooth_sign = min(max(v / v_th, -1.0), 1.0)  # sign(v) for |v| > v_th, so that one formula serves both cases
    return stribeck_force(max(speed, v_th), F_C, K_brk, C_c) * smooth_sign + F_v * v
