"""What the line volumes V_1 = V_2, which the thesis does not give, do to chapter 4's pressures."""

from __future__ import annotations

import numpy as np

from sealscope.thesis.chapters.chapter4.cases import OURS, Pair, Reading, literal, mean_difference, span, spec
from sealscope.thesis.engine.context import Context
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Curve, Figure, Number, Panel, Role

_VOLUMES = (10.0, 20.0, 44.0, 100.0, 234.0, 500.0)
_QUICK = (10.0, 44.0, 234.0)
_COMMAND, _CLOSED = "3 sin(4t)", 25.0


def volume_sweep(context: Context, item: Item) -> tuple[Figure, ...]:
    """Range of p_1 and p_A and their mean difference over V_1 = V_2, converged and with RK4 at 1e-4 s."""
    volumes = _QUICK if context.quick else _VOLUMES
    pairs = []
    for volume in volumes:
        converged = spec(_COMMAND, _CLOSED, Reading(V_line_cm3=volume))
        pairs.append(Pair(context.run(literal(converged)), context.run(converged)))
    x = np.array(volumes)
    roles: tuple[tuple[Role, str], ...] = (("literal", "RK4, 1e-4 s"), ("converged", "converged"))
    panels, numbers = [], []
    for letter, name in zip("ab", ("p_1", "p_A"), strict=True):
        curves = []
        for role, label in roles:
            spans = np.array([span(getattr(one, role), name) * 1e-6 for one in pairs])
            curves.append(Curve(x, spans, label, role))
            numbers += [
                Number(f"range of {name} at {volume:g} cm3, {label}", float(one), "MPa")
                for volume, one in zip(volumes, spans, strict=True)
            ]
        panels.append(Panel("V_1 = V_2 [cm3]", f"range of {name} [MPa]", tuple(curves), f"({letter})", log_x=True))
    gaps = []
    for role, label in roles:
        means = np.array([mean_difference(getattr(one, role), "p_1", "p_A") * 1e-6 for one in pairs])
        gaps.append(Curve(x, means, label, role))
        numbers += [
            Number(f"mean of p_1 - p_A at {volume:g} cm3, {label}", float(one), "MPa")
            for volume, one in zip(volumes, means, strict=True)
        ]
    panels.append(Panel("V_1 = V_2 [cm3]", "mean of p_1 - p_A [MPa]", tuple(gaps), "(c)", log_x=True))
    notes = (
        f"{_COMMAND}, {_CLOSED:g} % closed, {OURS.title}. Converged, the volumes only shift the ringing of the oil; "
        "with RK4 at 1e-4 s the smaller the volume, the further the pump's pressure settles from the chamber's."
    )
    resolved = all(one.resolved for one in pairs)
    return (Figure(item.id, item.title, tuple(panels), tuple(numbers), ("claim-4.1",), resolved, notes),)
