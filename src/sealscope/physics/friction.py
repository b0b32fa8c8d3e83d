"""Friction of piston and rod: Coulomb, Stribeck and viscous, linear near standstill (eqs. 4.20-4.22)."""

from __future__ import annotations

import math

from sealscope.compiled import contracted
from sealscope.physics.lanes import exponential, select


@contracted
def coulomb_friction(p_A: float, p_B: float, F_pr: float, F_cfr: float, of_difference: bool) -> float:
    """Return the Coulomb force F_C = F_pr + F_cfr (p_A + p_B) [N], eq. (4.20).

    `of_difference` takes p_A - p_B, the literal reading.
    """
    return F_pr + F_cfr * ((p_A - p_B) if of_difference else (p_A + p_B))


@contracted
def stribeck_friction(
    v: float, F_C: float, K_brk: float, C_c: float, F_v: float, v_th: float, literal_bracket: bool
) -> float:
    """Friction force [N] against the velocity v [m/s], eqs. (4.21)-(4.22).

    |v| > v_th: F = F_C (1 + (K_brk - 1) exp(-C_c |v|)) sign(v) + F_v v;
    |v| <= v_th: F = v [F_C (1 + (K_brk - 1) exp(-C_c v_th)) + F_v v_th] / v_th, continuous at v_th.
    `literal_bracket` reads the unbalanced bracket of eq. (4.22) the other way, F_C times the whole sum and |v| in the
    exponential, so that F jumps at v_th (from 73.2 N to 145 N with Table 4.1 and no pressure): F = v F_C [1 + (K_brk
    - 1) exp(-C_c |v|) + F_v v_th] / v_th.
    """
    speed = abs(v)
    if literal_bracket:
        stribeck = 1.0 + (K_brk - 1.0) * exponential(-C_c * speed)
        slow = v * F_C * (stribeck + F_v * v_th) / v_th
        return select(speed > v_th, math.copysign(F_C * stribeck, v) + F_v * v, slow)  # type: ignore[no-any-return]
    stribeck = 1.0 + (K_brk - 1.0) * exponential(-C_c * max(speed, v_th))
    return F_C * stribeck * min(max(v / v_th, -1.0), 1.0) + F_v * v  # type: ignore[no-any-return]
