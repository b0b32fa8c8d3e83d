"""Figs. 4.2 and 4.3: friction models and the Stribeck curve of the rig, under both bracketings of eq. (4.22)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.parameters import Rig, load_rig
from sealscope.physics.friction import stribeck_friction
from sealscope.recordings.recording import Array
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Figure, FigureCurve, Number, Panel
from sealscope.thesis.engine.texts import note

_AXES = ("v [m/s]", "F_f [N]")


def thesis_rig() -> Rig:
    """Load the rig of the thesis."""
    return load_rig("thesis")


def stribeck(v: Array, F_C: float, *, literal_bracket: bool = False) -> Array:
    """Compute the rig's friction [N] at `v` [m/s] (n,) under the Coulomb force `F_C` [N], eqs. (4.21), (4.22)."""
    f = thesis_rig().friction
    plain = getattr(stribeck_friction, "py_func", stribeck_friction)
    return np.array([plain(float(value), F_C, f.K_brk, f.C_c, f.F_v, f.v_th, literal_bracket) for value in v])


def jumps_at_threshold(F_C: float) -> dict[str, tuple[float, float]]:
    """Compute friction [N] at and just above v_th for both bracketings of eq. (4.22), "continuous" and "literal"."""
    v_th = thesis_rig().friction.v_th
    sides = np.array([v_th, math.nextafter(v_th, 1.0)])
    jumps = {}
    for name, literal_bracket in (("continuous", False), ("literal", True)):
        below, above = stribeck(sides, F_C, literal_bracket=literal_bracket)
        jumps[name] = float(below), float(above)
    return jumps


def falls_up_to(F_C: float) -> float:
    """Compute the velocity [m/s] up to which friction falls: where F_v = F_C (K_brk - 1) C_c exp(-C_c v)."""
    f = thesis_rig().friction
    return max(0.0, math.log(F_C * (f.K_brk - 1.0) * f.C_c / f.F_v) / f.C_c)


def friction_models(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 4.2: Coulomb, static and stick-slip friction and the Stribeck curve, with Table 4.1's numbers."""
    f = thesis_rig().friction
    F, peak, v_th = f.F_pr, f.F_pr * f.K_brk, f.v_th
    v = np.linspace(-0.1, 0.1, 801)
    sketches: dict[str, tuple[str, Any, Any]] = {
        "(a) Coulomb": ("F_C sign(v)", [-0.1, 0.0, 0.0, 0.1], [-F, -F, F, F]),
        "(b) Static": ("F_C K_brk at standstill", [-0.1, 0.0, 0.0, 0.0, 0.0, 0.1], [-F, -F, -peak, peak, F, F]),
        "(c) Stick-slip": ("linear below v_th", [-0.1, -v_th, v_th, 0.1], [-F, -peak, peak, F]),
        "(d) Stribeck": ("eqs. 4.21, 4.22", v, stribeck(v, F)),
    }
    panels = tuple(
        Panel(*_AXES, (FigureCurve(np.array(x), np.array(y), label, "reference"),), title)
        for title, (label, x, y) in sketches.items()
    )
    numbers = (
        Number("Coulomb force without pressure", f.F_pr, "N"),
        Number("breakaway force", peak, "N"),
        Number("threshold velocity", f.v_th, "m/s"),
    )
    return (item.figure(panels, numbers, notes=note("friction-models")),)


def stribeck_curve(context: Context, item: Item) -> tuple[Figure, ...]:
    """Draw Fig. 4.3: friction against velocity, near standstill under both bracketings, and its slope."""
    rig = thesis_rig()
    f = rig.friction
    charged = f.F_pr + f.F_cfr * 2.0 * rig.fluid.p_charge
    v = np.linspace(-0.2, 0.2, 1601)
    near = np.linspace(-2.0 * f.v_th, 2.0 * f.v_th, 1601)
    ahead = np.linspace(f.v_th, 0.2, 800)
    slope = np.gradient(stribeck(ahead, f.F_pr), ahead)
    curves = (
        FigureCurve(v, stribeck(v, f.F_pr), "no pressure", "reference"),
        FigureCurve(v, stribeck(v, charged), f"both chambers at {rig.fluid.p_charge / 1e6:g} MPa", "other"),
    )
    brackets = (
        FigureCurve(near, stribeck(near, f.F_pr), "bracket closed: continuous", "converged"),
        FigureCurve(near, stribeck(near, f.F_pr, literal_bracket=True), "bracket over all", "literal"),
    )
    slopes = (FigureCurve(ahead, slope, "slope above v_th", "reference"),)
    panels = (
        Panel(*_AXES, curves, "(a) Stribeck curve"),
        Panel(*_AXES, brackets, "(b) Both bracketings of eq. 4.22"),
        Panel("v [m/s]", "slope of F_f [N s/m]", slopes, "(c) Slope"),
    )
    numbers = (
        *(
            Number(f"friction {side} v_th, {name}", value, "N")
            for name, both in jumps_at_threshold(f.F_pr).items()
            for side, value in zip(("at", "above"), both, strict=True)
        ),
        Number("friction falls up to", falls_up_to(f.F_pr), "m/s"),
    )
    return (item.figure(panels, numbers, notes=note("stribeck")),)
