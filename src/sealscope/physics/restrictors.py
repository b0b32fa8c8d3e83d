"""Orifices and filters: the turbulent restrictor, made smooth at zero flow, one-way throttles, clogging filters."""

from __future__ import annotations

import math
from typing import Any

from sealscope.compiled import contracted, law
from sealscope.physics.lanes import select


@law
def orifice_coefficient(C_d: float, area: float, rho: float) -> float:
    """Compute an orifice's flow coefficient C_d A sqrt(2/rho) [m^3/(s Pa^0.5)], A = `area` [m^2]; eqs. (4.9)-(4.12).

    `C_d`: discharge coefficient; `rho` [kg/m^3]: density of the oil.
    """
    return C_d * area * math.sqrt(2.0 / rho)


@law
def series_coefficient(c: float, c_line: float, opening: Any) -> Any:
    """Compute the flow coefficient C [m^3/(s Pa^0.5)] of a throttle in series with a shut-off valve.

    1/C^2 = 1/c^2 + (1/opening^2 - 1)/c_line^2, with the flow coefficients `c` of the throttle and `c_line` of the free
    line, both > 0. The valve opens the fraction `opening` of the line's area, in Python also an array: fully open C = c
    but for rounding, shut C = 0.

    Source: Merritt, Hydraulic Control Systems, 1967, section 3.4: pressure drops of orifices in series add.
    """
    square = opening * opening
    # no division by `opening`, so that a shut valve gives 0
    return c * c_line * opening * (c_line * c_line * square + c * c * (1.0 - square)) ** -0.5


@contracted
def orifice_flow(dp: float, c: float, dp_0: float) -> float:
    """Compute the flow [m^3/s] through an orifice under the pressure difference `dp` [Pa].

    Q = c dp / (dp^2 + dp_0^2)^(1/4), with the flow coefficient `c` [m^3/(s Pa^0.5)]. This is the square-root law of
    eqs. (4.9)-(4.12), made smooth at dp = 0 where its slope is infinite. Around `dp_0` [Pa] the flow changes from
    laminar, c dp / sqrt(dp_0) for |dp| << dp_0, to turbulent, c sign(dp) sqrt|dp| for |dp| >> dp_0.
    """
    return c * dp / math.sqrt(math.sqrt(dp * dp + dp_0 * dp_0))


@contracted
def one_way_flow(dp: float, c_forward: float, c_reverse: float, dp_0: float) -> float:
    """Compute the flow [m^3/s] of a one-way throttle: `orifice_flow` with `c_forward` if dp > 0, else `c_reverse`."""
    return orifice_flow(dp, select(dp > 0.0, c_forward, c_reverse), dp_0)


@contracted
def _solve_scaled_flow(b: float, a: float) -> float:
    """Solve w r(w) + a w = b for the scaled flow w = Q/(c sqrt(dp_0)) >= 0 of an orifice, with a >= 0 and b >= 0.

    All three terms are pressure differences divided by dp_0. The first is that of the orifice, w r(w) with
    r = sqrt((w^2 + sqrt(w^4 + 4))/2) >= 1, which is `orifice_flow` solved for dp. The left side rises and is convex, so
    the root is unique. Halley's method finds it to a relative error of 1e-12.
    """
    w = b / (a + 1.0)  # first guess, with r = 1
    w = b / (a + select(w < 2.0, 1.0 + 0.25 * w * w, w))  # better, with r(w) approximated for small and for large w
    for _ in range(50):  # a limit that is not reached: with a and b up to 1e10 at most 13 iterations are needed
        square = w * w
        r = math.sqrt(0.5 * (square + math.sqrt(square * square + 4.0)))
        r_2 = r * r
        r_4 = r_2 * r_2
        residual = w * (r + a) - b
        d = 1.0 + r_4
        slope = 2.0 * r * r_4 + a * d  # first derivative of the left side, times d
        curvature = w * (r * r_2 * r_4) * (10.0 + 2.0 * r_4)  # its second derivative, times d^3
        # Halley's step, its numerator and denominator multiplied by d^3
        step = 2.0 * residual * d * d * slope / (2.0 * d * slope * slope - residual * curvature)
        w = w - step
        # convergence is cubic: after this step the relative error is of the order of (step/w)^3 r^2/(a + r)^2
        if not abs(step * step * step) * r_2 > 1e-12 * square * w * (a + r) * (a + r):
            break
    return w  # type: ignore[no-any-return]


@contracted
def implicit_orifice_flow(total: float, g: float, c_forward: float, c_reverse: float, dp_0: float) -> float:
    """Compute the flow Q [m^3/s] of a one-way throttle at the end of an implicit stage of the solver.

    Q solves d + g Q(d) = total, where Q(d) is the flow of the throttle (`one_way_flow`) under the pressure difference d
    [Pa] at the end of the stage. `total` [Pa]: d if nothing flowed in the stage; `g` >= 0 [Pa s/m^3]: fall of d over
    the stage per unit flow. The root is unique and has the sign of `total`.
    """
    c = select(total > 0.0, c_forward, c_reverse)
    sqrt_dp_0 = math.sqrt(dp_0)
    w = _solve_scaled_flow(abs(total) / dp_0, g * c / sqrt_dp_0)
    return math.copysign(c * sqrt_dp_0 * w, total)


@contracted
def clogged_resistance(R: float, V: float, k: float, n: float) -> float:
    """Compute the resistance [Pa s/m^3] of a filter through which the oil volume `V` [m^3] has passed.

    The blocking laws of filtration at a constant dirt concentration, dR_V/dV = k R (R_V/R)^n, give
    R_V = R (1 + (1 - n) k V)^(1/(1 - n)): `R` is the resistance of the new filter, `k` [1/m^3] the relative rise of the
    resistance per volume at first, and `n` selects the law: cake filtration (0), intermediate (1), standard (1.5) or
    complete blocking (2). 1 + (1 - n) k V is limited to at least 1e-3, where a filter with n > 1 passes almost nothing.

    Source: J. Hermia, Constant pressure blocking filtration laws, Trans. IChemE 60 (1982) 183-187.
    """
    e = 1.0 - n
    e = select(abs(e) < 1e-6, 1e-6, e)  # near n = 1, where the exponent 1/e is infinite
    return R * math.pow(max(1.0 + e * k * V, 1e-3), 1.0 / e)


@contracted
def filtered_flow(
    total: float, g: float, R: float, p_bypass: float, G_bypass: float, c_forward: float, c_reverse: float, dp_0: float
) -> float:
    """Compute the flow Q [m^3/s] of a throttle and a filter in series at the end of an implicit stage of the solver.

    The filter has the resistance `R` [Pa s/m^3], and a bypass valve of conductance `G_bypass` [m^3/(s Pa)] that opens
    at the filter's pressure drop `p_bypass` [Pa]. Q solves d + dp_f + g Q = total, with the pressure drops d of the
    throttle and dp_f of the filter. `total` [Pa]: sum of both drops if nothing flowed in the stage; `g` [Pa s/m^3]:
    fall of this sum over the stage per unit flow; `c_forward`, `c_reverse`, `dp_0`: as in `implicit_orifice_flow`.

    dp_f is R Q while the bypass valve is shut; while it is open, Q = dp_f/R + G_bypass (dp_f - p_bypass). As dp_f is
    linear in Q in both cases, `implicit_orifice_flow` solves the equation for either case.
    """
    shut_flow = implicit_orifice_flow(total, g + R, c_forward, c_reverse, dp_0)
    # while the valve is open, dp_f = filter_fraction R (Q + G_bypass p_bypass) for Q > 0
    filter_fraction = 1.0 / (1.0 + G_bypass * R)
    open_total = total - math.copysign(G_bypass * R * p_bypass * filter_fraction, total)
    open_flow = implicit_orifice_flow(open_total, g + R * filter_fraction, c_forward, c_reverse, dp_0)
    return select(R * abs(shut_flow) > p_bypass, open_flow, shut_flow)  # type: ignore[no-any-return]


@contracted
def flow_through_filter(Q: float, R: float, p_bypass: float, G_bypass: float) -> float:
    """Compute the part of a flow [m^3/s, >= 0] that passes a filter rather than its bypass valve.

    `Q` [m^3/s]: both flows together, of either sign; `R` [Pa s/m^3]: resistance of the filter. The valve opens at the
    pressure drop `p_bypass` [Pa] and has the conductance `G_bypass` [m^3/(s Pa)].
    """
    part_with_open_valve = (abs(Q) + G_bypass * p_bypass) / (1.0 + G_bypass * R)
    return min(abs(Q), part_with_open_valve)  # the valve is shut while the whole flow is the smaller one
