"""Explanations of the observations: sets of at most three events, each with its probability.

A set's posterior is the product of its events' probabilities and, for each kind of data, the Bayes factor of the best
description that an event of the set gives; data that no event of the set moves earn nothing. So noise that steps
beside a leak is two events, and never takes the leak away. The Bayes factor of a change of chance p under the null is
at most 1 / (-e p log p), 1 for p > 1/e (Sellke, Bayarri and Berger); p is the predictive chance that healthy
recordings calibrate (`null`).

A term describes a change to within a few per cent only: logarithms of Bayes factors of the same data are divided by
1 + 2 m B, with B the largest and m the misfit (`priors.toml`), so that rivals are told apart no better than the terms
are known.

Source: T. Sellke, M. J. Bayarri, J. O. Berger, The American Statistician 55 (2001) 62.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.decision.events import Event, load_events
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.inference.scatter import RISE, Rise
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import Cause

#: Most events of an explanation, and the least log Bayes factor, of ten to one, of what shows an event beside another:
#: duty, noise and friction change together often enough that two would leave a leak no place.
MOST, LEAST = 3, 2.3
#: Events whose leakage passes the piston or the pump, which lie in parallel.
LEAK_EVENTS = ("piston leak", "pump leak")


class LeakRise(NamedTuple):
    """The rise of the leakage over healthy recordings, and the rise expected of a leak that begins within."""

    rise: Rise
    expected: float


@dataclass(frozen=True)
class Explanation:
    """A set of events with its posterior probability, and the kinds of `data` that it moves."""

    events: tuple[Event, ...]
    probability: float
    data: frozenset[str] = frozenset()

    def has(self, *names: str) -> bool:
        """Test whether one of the events has one of the names."""
        return any(event.name in names for event in self.events)


#: The log likelihood ratios of an event, by the data it moves.
_Gains = Mapping[str, float]


def explain(
    observables: Sequence[Observable],
    chance: Callable[[Observable], float] = lambda observable: observable.chance,
    rise: LeakRise | None = None,
) -> tuple[Explanation, ...]:
    """Compute the probability of every set of events, given that something happened.

    Parameters
    ----------
    observables : sequence of Observable
    chance : callable
        Predictive chance of an observable in a healthy recording (`null.HealthyNull.chance`).
    rise : LeakRise, optional
        The leakage against healthy recordings: a leak from the start raises it, one from an onset in proportion.

    Returns
    -------
    tuple of Explanation
        The most probable first; their probabilities add up to one.
    """
    events = load_events()
    factors = [(quantity, log_bayes_factor(chance(quantity))) for quantity in observables]
    misfit: float = 2.0 * priors("decision")["explanation"]["misfit"]
    largest: dict[str, float] = {}
    for observable, factor in factors:
        largest[observable.data] = max(factor, largest.get(observable.data, 0.0))
    weighted = [(quantity, factor / (1.0 + misfit * largest[quantity.data])) for quantity, factor in factors]
    ways = {event.name: _ways_of(event, weighted, rise) for event in events}
    telling_events = [event for event in events if max(sum(gains.values()) for gains in ways[event.name]) > LEAST]
    groups: list[tuple[Event, ...]] = [(event,) for event in events]
    groups += [group for size in range(2, MOST + 1) for group in combinations(telling_events, size)]
    moved = {
        name: frozenset(kind for gains in rows for kind, gain in gains.items() if gain > 0.0)
        for name, rows in ways.items()
    }
    logarithms = np.array([_logarithm(group, ways) for group in groups])
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    order = np.argsort(-weights, kind="stable")
    return tuple(
        Explanation(groups[k], float(weights[k]), frozenset().union(*(moved[event.name] for event in groups[k])))
        for k in order
    )


def _logarithm(group: Sequence[Event], ways: Mapping[str, Sequence[_Gains]]) -> float:
    """Compute the logarithm of a set's posterior, up to a constant, by the best way in which its events happen."""
    prior = float(sum(np.log(event.probability) for event in group))
    best = -np.inf
    for chosen in product(*(ways[event.name] for event in group)):
        data = {kind: max(gains.get(kind, 0.0) for gains in chosen) for gains in chosen for kind in gains}
        if any(RISE in gains for gains in chosen):
            data[RISE] = sum(gains.get(RISE, 0.0) for gains in chosen)
        best = max(best, sum(data.values()))
    return prior + best


def _ways_of(event: Event, weighted: Sequence[tuple[Observable, float]], rise: LeakRise | None) -> Sequence[_Gains]:
    """Return the ways an event happens: at the onset that explains most, and for a leak from the start."""
    moved = [(observable, gain) for observable, gain in weighted if event.does_move(observable)]
    gains: dict[str, float] = {}
    if moved:
        anchor = max(moved, key=lambda pair: pair[1])[0]
        # an event explains what it disturbs only once other data show it
        explained_data = {observable.data for observable, gain in moved if gain > LEAST}
        disturbed = [
            pair
            for pair in weighted
            if explained_data and pair[0].data not in explained_data and event.does_disturb(pair[0])
        ]
        for observable, gain in moved + disturbed:
            if _coincide(observable, anchor):
                size_gain = gain + (0.5 * observable.advantage if event.is_sized else 0.0)
                gains[observable.data] = max(size_gain, gains.get(observable.data, 0.0))
    ways: list[_Gains] = [gains]
    if rise is not None and event.name in LEAK_EVENTS:
        if gains.get("volumes", 0.0) > 0.0:
            gains[RISE] = rise.rise.log_ratio(rise.expected)
        ways.append({RISE: log_bayes_factor(rise.rise.chance)})
    return ways


def log_bayes_factor(chance: float) -> float:
    """Compute the logarithm of the largest Bayes factor that a chance under the null allows."""
    if chance >= np.exp(-1.0):
        return 0.0
    chance = max(chance, np.finfo(float).tiny)
    return -float(np.log(-np.e * chance * np.log(chance)))


def _coincide(observable: Observable, anchor: Observable) -> bool:
    """Test whether two observables may have changed at the same time."""
    if observable.onset is None or anchor.onset is None:
        return True
    reach = 0.5 * (observable.onset.high - observable.onset.low + anchor.onset.high - anchor.onset.low)
    return abs(observable.onset.value - anchor.onset.value) <= reach


def probability_of(
    explanations: Sequence[Explanation], *names: str, cause: Cause | None = None, data: str | None = None
) -> float:
    """Compute the probability that one of the named events, or one of a cause, happened.

    `data`: given that something happened that moves this kind of data; the chance under the null says whether it did.
    """
    relevant = [explanation for explanation in explanations if data is None or data in explanation.data]
    total = sum(explanation.probability for explanation in relevant)
    matching = sum(
        explanation.probability
        for explanation in relevant
        if explanation.has(*names) or (cause is not None and any(event.cause == cause for event in explanation.events))
    )
    return float(matching / total) if total > 0.0 else 0.0
