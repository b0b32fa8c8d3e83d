"""Orifices: the turbulent restrictor, regularised once, and the one-way throttle made of two of them."""

from __future__ import annotations

import math

from sealscope.compiled import law


def orifice_coefficient(C_d: float, area: float, rho: float) -> float:
    """Flow coefficient c = C_d A sqrt(2/rho) [m^3/(s Pa^0.5)] of an orifice (factor of eqs. 4.9-4.12)."""
    return C_d * area * math.sqrt(2.0 / rho)


@law
def orifice_flow(dp: float, c: float, dp_0: float) -> float:
    """Flow [m^3/s] through an orifice under the pressure difference `dp` [Pa].

    Q = c dp / (dp^2 + dp_0^2)^(1/4), eqs. 4.9-4.12 with the square root made smooth: Q -> c sign(dp) sqrt|dp| for
    |dp| >> dp_0, and laminar, Q = c dp / sqrt(dp_0), for |dp| << dp_0, where the slope of the bare square root would
    be infinite.
    """
    return c * dp / math.sqrt(math.sqrt(dp * dp + dp_0 * dp_0))


@law
def one_way_coefficient(dp: float, c_forward: float, c_reverse: float) -> float:
    """Coefficient that is in force in a one-way throttle: one for each direction of the pressure difference."""
    return c_forward if dp > 0.0 else c_reverse


@law
def implicit_orifice_drop(total: float, g: float, c_forward: float, c_reverse: float, dp_0: float) -> float:
    """Pressure difference d [Pa] that solves d + g Q(d) = total for a one-way throttle, g >= 0 [Pa s/m^3].

    This scalar equation is all that an implicit stage has to solve for one line volume against one chamber. The left
    side grows with d, so the root is unique, has the sign of `total`, and Newton's method started below it climbs to
    it without overshoot (for d > 0 the left side is concave but for a neighbourhood of zero, where the second bound
    below is sharp). Both bounds used as the start solve a simpler law that lets more flow pass: the bare
    square root (a quadratic), and the laminar tangent at zero.
    """
    c = one_way_coefficient(total, c_forward, c_reverse)
    gc = g * c
    magnitude = abs(total)
    root = 0.5 * (math.sqrt(gc * gc + 4.0 * magnitude) - gc)
    d = max(root * root, magnitude / (1.0 + gc / math.sqrt(dp_0)))
    for _ in range(20):
        square = d * d + dp_0 * dp_0
        fourth = 1.0 / math.sqrt(math.sqrt(square))
        residual = d + gc * d * fourth - magnitude
        step = residual / (1.0 + gc * fourth * (1.0 - 0.5 * d * d / square))
        d -= step
        if abs(step) <= 1e-10 * d + 1e-12:
            break
    return math.copysign(d, total)
