"""Volume balance of a pump in an open circuit, which feeds one chamber at a time while the other drains to the tank.

The coefficient of a term of motion is the area of the side that the pump feeds in this direction, whichever side
carries the load; oil that the other chamber loses to the outside does not count. While the piston rests, the side that
carries the load counts instead, by whose oil the load creeps. Compliances count on both sides, although the pump's flow
shows that of the fed chamber only: without the other, more leaks are missed (decision 68).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.inference.equations.signals import Signals, interval_means
from sealscope.diagnosis.inference.equations.terms import (
    MOTIONS,
    Equation,
    Term,
    compensated_leak_term,
    external_leak_term,
)
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.recordings.motion import find_runs
from sealscope.recordings.recording import Array

#: Side of the terms of leaks to the outside, by their names.
_SIDES = {term.name: side for side in "AB" for term in (external_leak_term(side), compensated_leak_term(side))}


def feed_one_chamber(equation: Equation, signals: Signals) -> Equation:
    """Adapt the volume balance of a cylinder to a pump that feeds one chamber at a time.

    `fed_outward` of the result names the chamber that the pump feeds while x grows (`_find_fed_outward`). The terms of
    motion count the creep of a piston at rest with the area of the side that carries the load. A leak to the outside
    counts while its chamber is fed or, while the pump rests, carries the load. `signals`: the recording, with limits of
    rest.
    """
    adapted = equation._replace(fed_outward=_find_fed_outward(equation, signals))
    volumes = equation.left(signals) * signals.step("x")  # > 0 if flow and position have one sense
    sign_A = float(np.sign(np.nansum(volumes))) * (1.0 if adapted.fed_outward == "A" else -1.0)  # of the flow into A

    def adapt(term: Term) -> Term:
        """Adapt one term."""
        if term.name in MOTIONS:
            return term._replace(increments=partial(_carried_increments, term=term, equation=adapted))
        if term.name in _SIDES:
            return term._replace(increments=partial(_counted_increments, term=term, left=equation.left, sign_A=sign_A))
        return term

    return adapted._replace(terms=tuple(map(adapt, equation.terms)))


def _find_fed_outward(equation: Equation, signals: Signals) -> Literal["A", "B"]:
    """Find the chamber that the pump feeds while x grows: that of the larger area if more flow moves the piston then.

    Flows are compared per distance, whatever the signs of flow and position. If the areas differ by less than these
    ratios scatter (`feed.scatter` of `priors.toml`), it is A if the flow is positive while x grows.
    """
    volume, step = equation.left(signals), signals.step("x")
    is_moving = np.isfinite(volume * step) & (signals.moving(equation.left) > 0.0)
    outward, inward = is_moving & (step > 0.0), is_moving & (step < 0.0)
    areas_tell = abs(float(np.log(equation.area_ratio))) > INFERENCE.feed.scatter
    if not (areas_tell and outward.any() and inward.any()):
        feeds_A = float(volume[is_moving] @ step[is_moving]) >= 0.0
    else:
        flow_out, flow_in = (abs(float(volume[flags].sum() / step[flags].sum())) for flags in (outward, inward))
        feeds_A = (flow_out > flow_in) == (equation.area_ratio < 1.0)
    return "A" if feeds_A else "B"


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


def _counted_increments(signals: Signals, *, term: Term, left: Callable[[Signals], Array], sign_A: float) -> Array:
    """Compute the increments (n - 1,) of a leak to the outside, 0 while neither the pump's flow nor a load shows it.

    `left`: left side of the volume balance, the pump's flow; `sign_A`: its sign while the pump feeds A.
    """
    turns = signals.moving(left) + signals.holding(left) > 0.0  # the pump
    counts_A = np.where(turns, sign_A * left(signals) > 0.0, interval_means(signals.carried_by_A))
    return np.asarray(term.increments(signals) * (counts_A if _SIDES[term.name] == "A" else 1.0 - counts_A))


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
