"""Volume balance of a pump in an open circuit, which feeds one chamber at a time while the other drains to the tank.

The coefficient of a term of motion is the area of the side that the pump feeds in this direction, whichever side
carries the load; oil that the other chamber loses to the outside does not count. While the piston rests, the side that
carries the load counts instead, by whose oil the load creeps. Compliances count on both sides, although the pump's flow
shows that of the fed chamber only: without the other, more leaks are missed (decision 68).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple

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


class FeedSums(NamedTuple):
    """Sums over the time in which pump and piston move, which show how an open circuit's pump feeds the chambers.

    They add up over the parts of a recording, so that a stream learns them block by block.

    Parameters
    ----------
    volumes : pair of floats
        Volume of the pump [m^3], > 0, while x grows and while it falls.
    distances : tuple of 4 floats
        Distance of the piston [m], > 0, in each of `MOTIONS`.
    work : float
        Sum of the products of the increments of volume and distance [m^4]: > 0 if flow and position have one sense.
    delivered, time : float, float
        Volume that the pump delivers either way [m^3], and the time [s] over which its flow is known.
    """

    volumes: tuple[float, ...] = (0.0, 0.0)
    distances: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    work: float = 0.0
    delivered: float = 0.0
    time: float = 0.0

    @classmethod
    def measure(cls, equation: Equation, signals: Signals, span: slice = slice(None)) -> FeedSums:
        """Sum over the sampling intervals `span` of the signals, which have limits of rest."""
        volume, step = equation.left(signals)[span], signals.step("x")[span]
        is_known = (signals.moving(equation.left)[span] > 0.0) & np.isfinite(volume)
        is_counted = is_known & np.isfinite(step)
        # of a coarse encoder most increments are 0, so that its averaged speed tells the direction
        weights = {motion: signals.direction_weights(*motion)[span][is_counted] for motion in MOTIONS.values()}
        counted_volume, counted_step = volume[is_counted], step[is_counted]
        volumes = [
            abs(float((weights[outward, True] + weights[outward, False]) @ counted_volume)) for outward in (True, False)
        ]
        return cls(
            volumes=tuple(volumes),
            distances=tuple(abs(float(weight @ counted_step)) for weight in weights.values()),
            work=float(counted_volume @ counted_step),
            delivered=float(np.abs(volume[is_known]).sum()),
            time=float(np.count_nonzero(is_known) * signals.dt),
        )

    def add(self, other: FeedSums) -> FeedSums:
        """Return the sums over two parts of a recording."""
        return FeedSums(
            volumes=tuple(map(sum, zip(self.volumes, other.volumes, strict=True))),
            distances=tuple(map(sum, zip(self.distances, other.distances, strict=True))),
            work=self.work + other.work,
            delivered=self.delivered + other.delivered,
            time=self.time + other.time,
        )

    @property
    def ways(self) -> tuple[float, float]:
        """Distance [m] while x grows, and while it falls."""
        out_A, out_B, in_A, in_B = self.distances
        return out_A + out_B, in_A + in_B

    @property
    def flow_per_speed(self) -> tuple[float, float]:
        """Volume over distance [m^2] while x grows, and while it falls, both of which must have been recorded."""
        (volume_out, volume_in), (way_out, way_in) = self.volumes, self.ways
        return volume_out / way_out, volume_in / way_in

    @property
    def mean_flow(self) -> float | None:
        """Mean flow in motion [m^3/s], None without motion."""
        return self.delivered / self.time if self.time > 0.0 else None

    def find_feed(self, area_ratio: float) -> Feed:
        """Find the chamber that the pump feeds while x grows: that of the larger area if more flow moves the piston.

        Flows are compared per distance, whatever the signs of flow and position. If the areas differ by less than these
        ratios scatter (`feed.scatter` of `priors.toml`), it is A if the flow is positive while x grows. `area_ratio`:
        that of `Equation`.
        """
        areas_tell = abs(float(np.log(area_ratio))) > INFERENCE.feed.scatter
        if areas_tell and min(self.ways) > 0.0:
            flow_out, flow_in = self.flow_per_speed
            feeds_A = (flow_out > flow_in) == (area_ratio < 1.0)
        else:
            feeds_A = self.work >= 0.0
        sense = float(np.sign(self.work))  # of the flow while x grows
        return Feed("A" if feeds_A else "B", sense if feeds_A else -sense)


class Feed(NamedTuple):
    """Order in which the pump of an open circuit feeds the chambers.

    `outward`: chamber that it feeds while x grows; `sign_A`: sign of its flow while it feeds A, 0 if it never moves.
    """

    outward: Literal["A", "B"]
    sign_A: float


def feed_one_chamber(equation: Equation, feed: Feed) -> Equation:
    """Adapt the volume balance of a cylinder to a pump that feeds one chamber at a time.

    The terms of motion count the creep of a piston at rest with the area of the side that carries the load. A leak to
    the outside counts while its chamber is fed or, while the pump rests, carries the load. The signals from which the
    terms are computed must have limits of rest.
    """
    adapted = equation._replace(fed_outward=feed.outward)

    def adapt(term: Term) -> Term:
        """Adapt one term."""
        if term.name in MOTIONS:
            return term.with_increments(partial(_carried_increments, term=term, equation=adapted))
        if term.name in _SIDES:
            counted = partial(_counted_increments, term=term, left=equation.left, sign_A=feed.sign_A)
            return term.with_increments(counted)
        return term

    return adapted._replace(terms=tuple(map(adapt, equation.terms)))


def motions_of_side(equation: Equation, side: str) -> list[str]:
    """Return the names of the terms of motion (`MOTIONS`) whose coefficient is the piston's area on `side` "A" or "B".

    In a closed circuit that is the side that carries the load, otherwise the one that the pump feeds.
    """
    if not equation.fed_outward:
        return [name for name in MOTIONS if name.endswith(f"{side} carries")]
    return [name for name, (outward, _) in MOTIONS.items() if outward == (equation.fed_outward == side)]


class HoldCounts(NamedTuple):
    """Numbers of holds of an open circuit: with a pump `connected` to the cylinder, and with a flow `circulating`."""

    connected: int = 0
    circulating: int = 0

    @classmethod
    def measure(cls, is_held: NDArray[np.bool_], circulates: NDArray[np.bool_], rate: float) -> HoldCounts:
        """Count the holds that last for `rest.shortest_hold` (`priors.toml`) or longer.

        `is_held`, `circulates` (n - 1,): flags of the sampling intervals, the latter by `flag_circulation`; `rate`:
        sampling rate [Hz].
        """
        min_length = INFERENCE.rest.shortest_hold * rate
        runs = find_runs(is_held).tolist()
        states = [bool(circulates[first]) for first, length in runs if length >= min_length]
        return cls(connected=states.count(False), circulating=states.count(True))

    @property
    def log_odds(self) -> float:
        """Log odds that the flow circulates in a further hold; those of `feed.circulation_odds` count as one hold."""
        share = 1.0 / (1.0 + np.exp(-INFERENCE.feed.circulation_odds))
        return float(np.log((self.circulating + share) / (self.connected + 1.0 - share)))


def flag_circulation(
    equation: Equation, signals: Signals, mean_flow: float | None, healthy_holds: HoldCounts | None = None
) -> NDArray[np.bool_]:
    """Flag the sampling intervals (n - 1,) in which the pump's flow probably circulates to the tank, past the cylinder.

    Valves of an open circuit may be in neutral while the pump turns and the piston rests. Otherwise the pump holds the
    load, and its flow is what leaks and compresses the oil. The two are told apart for each hold by its mean flow, as a
    fraction f of that in motion. A flow that circulates has any fraction up to 1. That of a pump that holds the load is
    a log-normal one, with the median `feed.holding_flow` and the spread `feed.spread` (`priors.toml`); or, with the
    probability `size.present`, it has any fraction up to 1 as well, since a leak stalls the piston. The log odds of a
    flow that circulates are those of `healthy_holds`, the holds of the healthy recordings. Holds that are shorter than
    `rest.shortest_hold`, in which a pump builds up a pressure, have no leak and the prior odds. Nothing is flagged if f
    is unknown. Each block of a stream judges a hold by the part of it that the block's samples contain. `mean_flow`:
    `FeedSums.mean_flow`.
    """
    prior, healthy_log_odds = INFERENCE.feed, (healthy_holds or HoldCounts()).log_odds
    flow, is_held = np.abs(equation.left(signals)), signals.holding(equation.left) > 0.0
    circulates = np.zeros(len(flow), dtype=bool)
    if not (mean_flow and is_held.any()):
        return circulates
    for first, length in find_runs(is_held).tolist():
        hold = slice(first, first + length)
        flow_held = flow[hold][np.isfinite(flow[hold])] * signals.rate
        if not flow_held.any():
            continue
        fraction = float(flow_held.mean()) / mean_flow
        deviation = np.log(fraction / prior.holding_flow) / prior.spread
        density = np.exp(-0.5 * deviation**2) / (fraction * prior.spread * np.sqrt(2.0 * np.pi))
        is_lasting = length >= INFERENCE.rest.shortest_hold * signals.rate
        leaks, log_odds = (INFERENCE.size.present, healthy_log_odds) if is_lasting else (0.0, prior.circulation_odds)
        # the density of f is 1 if the flow circulates or leaks, also for a few f above 1
        circulates[hold] = log_odds - np.log(max((1.0 - leaks) * density + leaks, np.finfo(float).tiny)) > 0.0
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
