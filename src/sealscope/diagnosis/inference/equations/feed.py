"""Volume balance of a pump in an open circuit, which feeds one chamber at a time while the other drains to the tank.

The coefficient of a term of motion is the area of the side that the pump feeds in this direction, whichever side
carries the load. While valves shut the chambers, however, a load creeps by the oil of the side that carries it.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.equations.signals import Signals
from sealscope.diagnosis.inference.equations.terms import MOTIONS, Equation, Term
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array


def feed_one_chamber(equation: Equation, signals: Signals) -> Equation:
    """Adapt the volume balance of a cylinder to a pump that feeds one chamber at a time.

    `fed_outward` of the result names the chamber that the pump feeds while x grows: A if its flow is positive then,
    which the recording tells (`signals`, with limits of rest). The terms of motion count the creep of a piston at rest
    with the area of the side that carries the load.
    """
    volume, step = equation.left(signals), signals.step("x")
    is_known = np.isfinite(volume * step)
    adapted = equation._replace(fed_outward="A" if float(volume[is_known] @ step[is_known]) >= 0.0 else "B")
    terms = [
        term._replace(increments=partial(_carried_increments, term=term, equation=adapted))
        if term.name in MOTIONS
        else term
        for term in equation.terms
    ]
    return adapted._replace(terms=tuple(terms))


def motions_of_side(equation: Equation, side: str) -> list[str]:
    """Return the names of the terms of motion (`MOTIONS`) whose coefficient is the piston's area on `side` "A" or "B".

    In a closed circuit that is the side that carries the load, otherwise the one that the pump feeds.
    """
    if not equation.fed_outward:
        return [name for name in MOTIONS if name.endswith(f"{side} carries")]
    return [name for name, (outward, _) in MOTIONS.items() if outward == (equation.fed_outward == side)]


def flag_circulation(equation: Equation, signals: Signals) -> NDArray[np.bool_]:
    """Flag the sampling intervals (n - 1,) in which the pump's flow probably circulates to the tank, past the cylinder.

    Valves of an open circuit may be in neutral while the pump turns and the piston rests. Otherwise the pump holds the
    load, and its flow is what leaks and compresses the oil. The two are told apart for each hold by its mean flow, as a
    fraction f of that in motion: a flow that circulates has any fraction up to 1, that of a pump that holds the load a
    log-normal one, with the median `feed.held` and the spread `feed.spread` (`priors.toml`). `feed.circulates`: log
    odds, before any recording, of a flow that circulates. Nothing is flagged if f is unknown.
    """
    prior = INFERENCE.feed
    flow, is_held = np.abs(equation.left(signals)), signals.holding(equation.left) > 0.0
    is_moving = signals.moving(equation.left) > 0.0
    circulates = np.zeros(len(flow), dtype=bool)
    if not (is_moving.any() and is_held.any()):
        return circulates
    flow_in_motion = float(np.nanmean(flow[is_moving]))
    for first, length in find_runs(is_held).tolist():
        hold = slice(first, first + length)
        fraction = float(np.nanmean(flow[hold])) / flow_in_motion
        deviation = np.log(fraction / prior.held) / prior.spread
        log_density_if_held = -0.5 * deviation**2 - np.log(fraction * prior.spread * np.sqrt(2.0 * np.pi))
        # the density of f is 1 if the flow circulates, also for a few f above 1
        circulates[hold] = prior.circulates - log_density_if_held > 0.0
    return circulates


def _carried_increments(signals: Signals, *, term: Term, equation: Equation) -> Array:
    """Compute the increments (n - 1,) of a term of motion whose creep at rest moves the area that carries the load.

    While pump or piston rests, the increments are multiplied by the area of the side that carries the load, over that
    of the side that the pump feeds in this direction.
    """
    _, by_A = MOTIONS[term.name]
    feeds_A = term.name in motions_of_side(equation, "A")
    area_B = equation.area_ratio  # over the area of A
    factor = (1.0 if by_A else area_B) / (1.0 if feeds_A else area_B)
    is_moving = signals.moving(equation.left)
    return np.asarray(term.increments(signals) * np.where(is_moving > 0.0, 1.0, factor))
