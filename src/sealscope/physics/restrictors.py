"""Orifices: the turbulent restrictor, regularised once, and the one-way throttle made of two of them."""

from __future__ import annotations

import math
from typing import Any

from sealscope.compiled import contracted, law
from sealscope.physics.lanes import anywhere, select


@law
def orifice_coefficient(C_d: float, area: float, rho: float) -> float:
    """Compute the flow coefficient c = C_d A sqrt(2/rho) [m^3/(s Pa^0.5)] of an orifice (factor of eqs. 4.9-4.12)."""
    return C_d * area * math.sqrt(2.0 / rho)


def behind_shut_off(c: float, c_line: float, opening: Any) -> Any:
    """Compute the flow coefficient [m^3/(s Pa^0.5)] of a throttle `c` in series with a shut-off valve.

    1/C^2 = 1/c^2 + (1/opening^2 - 1)/c_line^2, solved for C: the valve opens the share `opening` in 0..1 of its line,
    whose whole area has the coefficient `c_line`. Fully open it leaves `c`, shut 0.

    Source: Merritt, Hydraulic Control Systems, 1967, section 3.4: pressure drops of orifices in series add.
    """
    square = opening * opening
    return c * c_line * opening * (c_line * c_line * square + c * c * (1.0 - square)) ** -0.5


_in_series = law(behind_shut_off)


@law
def behind_valve(c: float, c_line: float, opening: float) -> float:
    """Compute `behind_shut_off` in compiled code; a valve that is fully open leaves `c` to the last bit."""
    return c if opening >= 1.0 else _in_series(c, c_line, opening)


@contracted
def orifice_flow(dp: float, c: float, dp_0: float) -> float:
    """Compute the flow [m^3/s] through an orifice under the pressure difference `dp` [Pa].

    Q = c dp / (dp^2 + dp_0^2)^(1/4), eqs. 4.9-4.12 with the square root made smooth: Q -> c sign(dp) sqrt|dp| for
    |dp| >> dp_0, and laminar, Q = c dp / sqrt(dp_0), for |dp| << dp_0, where the slope of the bare square root would
    be infinite.
    """
    return c * dp / math.sqrt(math.sqrt(dp * dp + dp_0 * dp_0))


@contracted
def one_way_coefficient(dp: float, c_forward: float, c_reverse: float) -> float:
    """Choose the coefficient of a one-way throttle by the direction of the pressure difference."""
    return select(dp > 0.0, c_forward, c_reverse)  # type: ignore[no-any-return]


@contracted
def _implicit_share(b: float, a: float) -> float:
    """Solve w r(w) + a w = b for the share w, b >= 0, a >= 0, where r = sqrt((w^2 + sqrt(w^4 + 4))/2) >= 1.

    w = Q/(c sqrt(dp_0)) is the flow through an orifice and w r its pressure difference over dp_0 (`orifice_flow` solved
    for the difference). The left side grows and is convex, so the root is unique; Halley's method finds it, in one turn
    where the volumes are stiff (a >> 1: r hardly matters), and ends where its rest is below 1e-12 of w.
    """
    w = b / (a + 1.0)
    w = b / (a + select(w < 2.0, 1.0 + 0.25 * w * w, w))
    for _ in range(50):
        square = w * w
        r = math.sqrt(0.5 * (square + math.sqrt(square * square + 4.0)))
        r_2 = r * r
        r_4 = r_2 * r_2
        over = w * (r + a) - b
        d = 1.0 + r_4
        slope = 2.0 * r * r_4 + a * d  # of the left side, times d
        bend = w * (r * r_2 * r_4) * (10.0 + 2.0 * r_4)  # its second derivative, times d^3
        step = 2.0 * over * d * d * slope / (2.0 * d * slope * slope - over * bend)
        w = w - step
        if not anywhere(abs(step * step * step) * r_2 > 1e-12 * square * w * (a + r) * (a + r)):
            break
    return w  # type: ignore[no-any-return]


@contracted
def implicit_orifice_flow(total: float, g: float, c_forward: float, c_reverse: float, dp_0: float) -> float:
    """Compute the flow Q [m^3/s] of a one-way throttle between two volumes in an implicit stage.

    d + g Q(d) = total, g >= 0 [Pa s/m^3].

    This scalar equation is all that an implicit stage has to solve for one line volume against one chamber; the root
    is unique and has the sign of `total`.
    """
    c = one_way_coefficient(total, c_forward, c_reverse)
    root = math.sqrt(dp_0)
    w = _implicit_share(abs(total) / dp_0, g * c / root)
    return math.copysign(c * root * w, total)


@contracted
def clogged_resistance(R: float, passed: float, k: float, n: float) -> float:
    """Compute the resistance [Pa s/m^3] of a filter after `passed` [m^3] of oil; `R` when new.

    dR/dV = k R_new (R/R_new)^n, the blocking laws of filtration for a steady share of dirt:
    R = R_new (1 + (1 - n) k V)^(1/(1 - n)). That is 1 + k V for a cake (n = 0), exp(k V) for intermediate (1),
    (1 - k V/2)^-2 for standard (1.5) and 1/(1 - k V) for complete blocking (2). Of n > 1 the base is kept above 1e-3,
    where hardly anything would pass any more.

    Source: J. Hermia, Constant pressure blocking filtration laws, Trans. IChemE 60 (1982) 183-187.
    """
    e = 1.0 - n
    e = select(abs(e) < 1e-6, 1e-6, e)
    return R * math.pow(max(1.0 + e * k * passed, 1e-3), 1.0 / e)


@contracted
def filtered_flow(
    total: float, g: float, R: float, p_bypass: float, G_bypass: float, c_forward: float, c_reverse: float, dp_0: float
) -> float:
    """Compute the flow [m^3/s] of a throttle in series with a filter and its bypass valve.

    d + g Q(d) + dp_f(Q) = total, with the filter's dp_f = R Q, and where that is above `p_bypass` [Pa] what the valve
    leaves: Q = dp_f/R + G_bypass (dp_f - p_bypass). Both are straight lines, so each is `implicit_orifice_flow`.
    """
    through = implicit_orifice_flow(total, g + R, c_forward, c_reverse, dp_0)
    share = 1.0 / (1.0 + G_bypass * R)
    rest = total - math.copysign(G_bypass * R * p_bypass * share, total)
    bypassed = implicit_orifice_flow(rest, g + R * share, c_forward, c_reverse, dp_0)
    return select(R * abs(through) > p_bypass, bypassed, through)  # type: ignore[no-any-return]


@contracted
def flow_through_filter(Q: float, R: float, p_bypass: float, G_bypass: float) -> float:
    """Compute the flow [m^3/s], without its sign, through the filter itself and not its bypass."""
    return min(abs(Q), (abs(Q) + G_bypass * p_bypass) / (1.0 + G_bypass * R))
