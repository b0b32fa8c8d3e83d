"""Explanations of the observations: sets of at most three events, each with its probability.

A set's posterior is the product of its events' probabilities and, for each kind of data, the Bayes factor of the best
description by an event of the set; data that no event of the set changes contribute a factor of 1. So a step of the
noise together with a leak is two events, and does not compete with the leak. The Bayes factor of a change of chance p
under the null is at most 1 / (-e p log p), 1 for p > 1/e (Sellke, Bayarri and Berger); p is the predictive chance that
healthy recordings calibrate (`null`).

A term describes a change to within a few per cent only: logarithms of Bayes factors of the same data are divided by
1 + 2 m B, with B the largest and m the misfit (`priors.toml`), so that rivals differ no more than the terms are known.

Source: T. Sellke, M. J. Bayarri, J. O. Berger, The American Statistician 55 (2001) 62.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.decision.events import Event, load_events
from sealscope.diagnosis.inference.changes.volumes import VOLUMES
from sealscope.diagnosis.inference.observable import LeakRise, Observable
from sealscope.diagnosis.inference.scatter import RISE
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.evidence import Cause

#: Largest number of events in an explanation.
MAX_EVENTS = 3
#: Smallest log Bayes factor (ten to one) of the data that make an event part of a set of several: duty, noise and
#: friction change together so often that sets of events with less evidence would crowd out a leak.
MIN_LOG_FACTOR = 2.3
#: Events whose leakage passes the piston or the pump, which lie in parallel.
LEAK_EVENTS = ("piston leak", "pump leak")


@dataclass(frozen=True)
class Explanation:
    """A set of events with its posterior probability, and the kinds of `data` that it explains."""

    events: tuple[Event, ...]
    probability: float
    data: frozenset[str] = frozenset()

    def has(self, *names: str) -> bool:
        """Test whether one of the events has one of the names."""
        return any(event.name in names for event in self.events)


#: Log Bayes factors of an event by kind of data.
_Gains = Mapping[str, float]


def explain(
    observables: Sequence[Observable],
    chance: Callable[[Observable], float] = lambda observable: observable.chance,
    rise: LeakRise | None = None,
) -> tuple[Explanation, ...]:
    """Compute the posterior probabilities of sets of events, the most probable first.

    They are conditional on some event having happened. The sets are each single event, and combinations of the events
    that the observables support. `chance`: predictive chance of an observable in a healthy recording
    (`null.HealthyNull.chance`); `rise`: of the leakage over healthy recordings, which a leak causes in proportion to
    its size and the time since its onset.
    """
    events = load_events()
    log_factors = [(observable, _log_factor(observable, chance(observable), rise)) for observable in observables]
    factors = _compare_by_likelihood(_correct_for_misfit(log_factors))
    gains_of = {event.name: _possible_gains(event, factors, rise) for event in events}
    supported = [
        event for event in events if max(sum(gains.values()) for gains in gains_of[event.name]) > MIN_LOG_FACTOR
    ]
    groups: list[tuple[Event, ...]] = [(event,) for event in events]
    groups += [group for size in range(2, MAX_EVENTS + 1) for group in combinations(supported, size)]
    posteriors = [_explain_by_group(group, gains_of) for group in groups]
    logarithms = np.array([posterior.logarithm for posterior in posteriors])
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    order = np.argsort(-weights, kind="stable")
    return tuple(Explanation(groups[k], float(weights[k]), posteriors[k].data) for k in order)


def _compare_by_likelihood(log_factors: Sequence[tuple[Observable, float]]) -> list[tuple[Observable, float]]:
    """Reduce the log Bayes factors of the balance's terms by their likelihoods relative to the best.

    The terms are rival descriptions of the same residual. Healthy recordings calibrate how rare the best of them is,
    but are too few to tell which term describes it best: for that the likelihoods in the judged recording alone count.
    `log_factors` are corrected for misfit; so are the differences (`_correct_for_misfit`).
    """
    likelihoods = [log_bayes_factor(observable.chance) for observable, _ in log_factors]
    volumes = [k for k, (observable, _) in enumerate(log_factors) if observable.data == VOLUMES]
    if not volumes:
        return list(log_factors)
    best = max(volumes, key=likelihoods.__getitem__)
    level, factors = log_factors[best][1], list(log_factors)
    misfit_divisor = 1.0 + 2.0 * DECISION.explanation.misfit * likelihoods[best]
    for k in volumes:
        difference = (likelihoods[best] - likelihoods[k]) / misfit_divisor
        factors[k] = (log_factors[k][0], max(level - difference, 0.0))
    return factors


def _correct_for_misfit(log_factors: Sequence[tuple[Observable, float]]) -> list[tuple[Observable, float]]:
    """Reduce the log Bayes factors of each kind of data for the misfit of its model.

    Each is divided by 1 + 2 m B, where B is the largest factor of that kind and m the misfit.
    """
    max_factor: dict[str, float] = {}
    for observable, factor in log_factors:
        max_factor[observable.data] = max(factor, max_factor.get(observable.data, 0.0))
    misfit = 2.0 * DECISION.explanation.misfit
    return [(observable, factor / (1.0 + misfit * max_factor[observable.data])) for observable, factor in log_factors]


class _Posterior(NamedTuple):
    """Logarithm of the posterior of a set of events, up to a constant, and the kinds of data that it explains."""

    logarithm: float
    data: frozenset[str]


def _explain_by_group(group: Sequence[Event], gains_of: Mapping[str, Sequence[_Gains]]) -> _Posterior:
    """Maximise the posterior of a set of events over the times at which each of them may have begun."""
    log_prior = float(sum(np.log(event.probability) for event in group))
    best, explained = -np.inf, frozenset[str]()
    for choice in product(*(gains_of[event.name] for event in group)):
        gains = {data: max(other.get(data, 0.0) for other in choice) for event_gains in choice for data in event_gains}
        if RISE in gains:
            # the best description of the rise counts, and each event whose rise contradicts it reduces that
            rises = [event_gains.get(RISE, 0.0) for event_gains in choice]
            gains[RISE] = max(*rises, 0.0) + sum(min(rise, 0.0) for rise in rises)
        if (total := sum(gains.values())) > best:
            best, explained = total, frozenset(data for data, gain in gains.items() if gain > 0.0)
    return _Posterior(log_prior + best, explained)


def _possible_gains(
    event: Event, factors: Sequence[tuple[Observable, float]], rise: LeakRise | None
) -> Sequence[_Gains]:
    """Compute an event's log Bayes factors by kind of data, one mapping for each possible time of onset.

    The first mapping is for an onset within the recording. For a leak, if `rise` is given, a second one is for an onset
    before the recording: such a leak explains only the rise and no other data.
    """
    gains = _gains_at_onset(event, factors)
    if rise is None or event.name not in LEAK_EVENTS:
        return [gains]
    if gains.get("volumes", 0.0) > 0.0:
        gains[RISE] = rise.step_log_ratio  # of the rise, its step is the part that began within the recording
    return [gains, {RISE: log_bayes_factor(rise.rise.chance)}]


def _gains_at_onset(event: Event, factors: Sequence[tuple[Observable, float]]) -> dict[str, float]:
    """Compute the log Bayes factors of an event that begins within the recording, by kind of data.

    The event begins when the observable that it explains best changes. Others count if they may coincide with it.
    """
    affected = [(observable, gain) for observable, gain in factors if event.affects(observable)]
    if not affected:
        return {}
    best_explained, _ = max(affected, key=lambda pair: pair[1])
    # side effects count only if other data support the event
    supporting_data = {observable.data for observable, gain in affected if gain > MIN_LOG_FACTOR}
    side_effects = [
        (observable, gain)
        for observable, gain in factors
        if supporting_data and observable.data not in supporting_data and event.may_disturb(observable)
    ]
    gains: dict[str, float] = {}
    for observable, gain in affected + side_effects:
        if _coincide(observable, best_explained):
            # advantage: twice the log odds by the prior on the event's size
            size_log_odds = 0.5 * observable.advantage if event.is_sized else 0.0
            gains[observable.data] = max(gain + size_log_odds, gains.get(observable.data, 0.0))
    return gains


def _log_factor(observable: Observable, chance: float, rise: LeakRise | None) -> float:
    """Compute the log Bayes factor of an observable against no change.

    For an alternative to the leak the factor is at most that of the leak's rise plus their log likelihood ratio, as a
    rise of the leakage makes the alternative seem to rise as well.
    """
    factor = log_bayes_factor(chance)
    if observable.log_ratio_to_leak is None or rise is None:
        return factor
    leak_factor = log_bayes_factor(rise.rise.chance)
    return min(factor, max(leak_factor + observable.log_ratio_to_leak, 0.0))


def log_bayes_factor(chance: float) -> float:
    """Compute the logarithm of the largest Bayes factor that a chance c under the null allows.

    It is -log(-e c log c) for c < 1/e, else 0.
    """
    if chance >= np.exp(-1.0):
        return 0.0
    chance = max(chance, np.finfo(float).tiny)
    return -float(np.log(-np.e * chance * np.log(chance)))


def _coincide(observable: Observable, anchor: Observable) -> bool:
    """Test whether two observables may have changed at the same time, by the 95 % intervals of their onsets."""
    if observable.onset is None or anchor.onset is None:
        return True
    max_distance = 0.5 * (observable.onset.high - observable.onset.low + anchor.onset.high - anchor.onset.low)
    return abs(observable.onset.value - anchor.onset.value) <= max_distance


def probability_of(
    explanations: Sequence[Explanation], *names: str, cause: Cause | None = None, data_kind: str | None = None
) -> float:
    """Compute the probability that one of the named events, or any event with this cause, happened.

    `data_kind`: use only the explanations that explain this kind of data (`Observable.data`), renormalised.
    """
    relevant = [explanation for explanation in explanations if data_kind is None or data_kind in explanation.data]
    total = sum(explanation.probability for explanation in relevant)
    matching = sum(
        explanation.probability
        for explanation in relevant
        if explanation.has(*names) or (cause is not None and any(event.cause == cause for event in explanation.events))
    )
    return float(matching / total) if total > 0.0 else 0.0
