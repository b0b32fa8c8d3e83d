"""Draw Figs. 4.2 and 4.3: friction models, and the rig's Stribeck curve for both interpretations of eq. (4.22).

Eq. (4.22) is printed with an unbalanced bracket, which can be closed in two places.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.parameters import load_rig
from sealscope.physics.friction import stribeck_friction
from sealscope.recordings.recording import Array
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Figure, FigureCurve, Number, Panel
from sealscope.thesis.engine.texts import format_note

_AXES = ("v [m/s]", "F_f [N]")


def stribeck_force(v: Array, F_C: float, *, literal_bracket: bool = False) -> Array:
    """Compute the friction [N] of the thesis's rig at the velocities `v` (n,) [m/s], eqs. (4.21), (4.22) of the thesis.

    `F_C` [N]: Coulomb force; `literal_bracket`: True to close the unbalanced bracket of eq. (4.22) at its end. The
    friction then jumps at the threshold velocity v_th.
    """
    f = load_rig("thesis").friction
    # `py_func`: the law in Python, as 1601 points at most need no compilation; missing if numba is switched off
    friction = getattr(stribeck_friction, "py_func", stribeck_friction)
    return np.array([friction(float(value), F_C, f.K_brk, f.C_c, f.F_v, f.v_th, literal_bracket) for value in v])


def friction_at_threshold(F_C: float) -> dict[str, tuple[float, float]]:
    """Compute the friction [N] at the threshold velocity v_th and just above it; `F_C`: Coulomb force [N].

    The keys are "continuous", and "literal" for the unbalanced bracket of eq. (4.22) closed at its end.
    """
    v_th = load_rig("thesis").friction.v_th
    velocities = np.array([v_th, math.nextafter(v_th, 1.0)])
    forces = {}
    for name, literal_bracket in (("continuous", False), ("literal", True)):
        at_threshold, above = stribeck_force(velocities, F_C, literal_bracket=literal_bracket).tolist()
        forces[name] = at_threshold, above
    return forces


def falling_friction_limit(F_C: float) -> float:
    """Compute the velocity [m/s] up to which friction falls with speed, 0 if never; `F_C` > 0: Coulomb force [N].

    The limit v solves F_v = F_C (K_brk - 1) C_c exp(-C_c v): viscous coefficient F_v [N s/m], breakaway over Coulomb
    force K_brk, decay of the Stribeck effect C_c [s/m].
    """
    f = load_rig("thesis").friction
    # slope of the Stribeck friction at standstill over that of the viscous friction
    steepness = F_C * (f.K_brk - 1.0) * f.C_c / f.F_v
    return math.log(max(steepness, 1.0)) / f.C_c


def friction_models_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 4.2: Coulomb, static and stick-slip friction and the Stribeck curve; `context` is not used."""
    f = load_rig("thesis").friction
    F, F_brk, v_th = f.F_pr, f.F_pr * f.K_brk, f.v_th
    v = np.linspace(-0.1, 0.1, 801)
    sketches: dict[str, tuple[str, Any, Any]] = {
        "(a) Coulomb": ("F_C sign(v)", [-0.1, 0.0, 0.0, 0.1], [-F, -F, F, F]),
        "(b) Static": ("F_C K_brk at standstill", [-0.1, 0.0, 0.0, 0.0, 0.0, 0.1], [-F, -F, -F_brk, F_brk, F, F]),
        "(c) Stick-slip": ("linear below v_th", [-0.1, -v_th, v_th, 0.1], [-F, -F_brk, F_brk, F]),
        "(d) Stribeck": ("eqs. 4.21, 4.22", v, stribeck_force(v, F)),
    }
    panels = tuple(
        Panel(*_AXES, (FigureCurve(np.array(x), np.array(y), label, "reference"),), title)
        for title, (label, x, y) in sketches.items()
    )
    numbers = (
        Number("Coulomb force without pressure", f.F_pr, "N"),
        Number("breakaway force", F_brk, "N"),
        Number("threshold velocity", f.v_th, "m/s"),
    )
    return (item.figure(panels, numbers, notes=format_note("friction-models")),)


def stribeck_figure(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 4.3: friction over velocity, its slope, and both interpretations of eq. (4.22); `context` is unused."""
    rig = load_rig("thesis")
    f = rig.friction
    # Coulomb force with both chambers at charge pressure; F_cfr multiplies the sum of the pressures, eq. (4.20)
    charged = f.F_pr + f.F_cfr * 2.0 * rig.fluid.p_charge
    v = np.linspace(-0.2, 0.2, 1601)
    v_slow = np.linspace(-2.0 * f.v_th, 2.0 * f.v_th, 1601)
    v_above = np.linspace(f.v_th, 0.2, 800)
    slope = np.gradient(stribeck_force(v_above, f.F_pr), v_above)
    curves = (
        FigureCurve(v, stribeck_force(v, f.F_pr), "no pressure", "reference"),
        FigureCurve(v, stribeck_force(v, charged), f"both chambers at {rig.fluid.p_charge / 1e6:g} MPa", "other"),
    )
    brackets = (
        FigureCurve(v_slow, stribeck_force(v_slow, f.F_pr), "bracket closed: continuous", "converged"),
        FigureCurve(v_slow, stribeck_force(v_slow, f.F_pr, literal_bracket=True), "bracket over all", "as_published"),
    )
    slopes = (FigureCurve(v_above, slope, "slope above v_th", "reference"),)
    panels = (
        Panel(*_AXES, curves, "(a) Stribeck curve"),
        Panel(*_AXES, brackets, "(b) Both bracketings of eq. 4.22"),
        Panel("v [m/s]", "slope of F_f [N s/m]", slopes, "(c) Slope"),
    )
    numbers = (
        *(
            Number(f"friction {place} v_th, {name}", force, "N")
            for name, forces in friction_at_threshold(f.F_pr).items()
            for place, force in zip(("at", "above"), forces, strict=True)
        ),
        Number("friction falls up to", falling_friction_limit(f.F_pr), "m/s"),
    )
    return (item.figure(panels, numbers, notes=format_note("stribeck")),)
