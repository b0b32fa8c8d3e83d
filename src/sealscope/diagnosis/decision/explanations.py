"""Explanations of what the detectors observe in a recording: sets of at most three events, each with its probability.

The table `events.toml` states of each event how often it begins within a recording, and which observables it changes.

The posterior of a set of events is proportional to

    product over its events of the prior * product over kinds of data of the largest Bayes factor of its events.

Data that no event of the set changes have the factor 1. Thus a step of the noise together with a leak is explained by
two events, which do not compete. The Bayes factor of a change is at most 1 / (-e p log p), where p is the probability
of the change in a healthy recording, or 1 for p > 1/e (Sellke, Bayarri and Berger). p is calibrated by healthy
recordings (`HealthyNull`).

A model describes a change only to within a fraction, the misfit m (`priors.toml`). Therefore the logarithms of the
Bayes factors of the same data are divided by 1 + 2 m B, where B is the largest of them. Alternative explanations then
differ no more than this accuracy allows.

Source: T. Sellke, M. J. Bayarri, J. O. Berger, The American Statistician 55 (2001) 62.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from itertools import combinations, product
from typing import Literal, get_args

import numpy as np

from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.inference.changes.volumes import VOLUMES
from sealscope.diagnosis.inference.comparison import RISE
from sealscope.diagnosis.inference.hypotheses import temper
from sealscope.diagnosis.inference.observable import LeakRise, Observable
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.inference import INFERENCE

#: What an event does to an observable: it moves it, multiplies both pressures by one factor, or disturbs it aside.
Effect = Literal["moves", "scales", "disturbs"]


@dataclass(frozen=True)
class Event:
    """An event that may happen to a machine or its instruments within a recording, from `events.toml`."""

    name: str  # such as "piston leak" or "pump wear"
    cause: str | None  # heading under which a verdict names the event, None if no verdict names it
    probability: float  # prior probability that it begins within a recording
    patterns: Mapping[Effect, tuple[str, ...]]  # patterns "data: name" of the observables on which it has each effect
    description: str  # phrase for what it changes, used in a verdict's reason: "the external leakage on side A"

    def changes(self, observable: Observable, *effects: Effect) -> bool:
        """Return True if the event has one of the `effects` on an observable, by default if it moves or scales it."""
        key = f"{observable.data}: {observable.name}"
        return any(_matches(key, self.patterns[effect]) for effect in effects or ("moves", "scales"))


@lru_cache(maxsize=4096)
def _matches(key: str, patterns: tuple[str, ...]) -> bool:
    """Return True if the `key` "data: name" of an observable matches one of the patterns; a last "*" is any text."""
    return any(key.startswith(pattern[:-1]) if pattern.endswith("*") else key == pattern for pattern in patterns)


@cache
def load_events() -> Sequence[Event]:
    """Read the events that may happen to a machine, with their prior probabilities, from `events.toml`."""
    rows = tomllib.loads((files("sealscope.diagnosis.decision") / "events.toml").read_text("utf-8"))
    return tuple(
        Event(
            name,
            cause=row["cause"] or None,
            probability=row["probability"]["value"],
            patterns={effect: tuple(row.get(effect, ())) for effect in get_args(Effect)},
            description=row["words"],
        )
        for name, row in rows.items()
    )


#: Largest number of events in an explanation.
MAX_EVENTS = 3
#: Minimum log Bayes factor for an event to be combined with others.
MIN_LOG_FACTOR: float = DECISION.explanation.combined
#: Largest log odds that are told apart, so that their exponential is finite.
MAX_LOG_ODDS = 500.0
#: Events that are a leak past the piston or in the pump, which lie in parallel.
LEAK_EVENTS = ("piston leak", "pump leak")


@dataclass(frozen=True)
class Explanation:
    """A set of events that explains the changes in a recording."""

    events: tuple[Event, ...]
    probability: float  # posterior probability of the set, given that some event has happened
    data: frozenset[str] = frozenset()  # kinds of data (`Observable.data`) in which the set explains a change
    odds: float = 0.0  # posterior probability of the set over the probability that no event has happened

    def has(self, names: Container[str], causes: Container[str | None] = ()) -> bool:
        """Return True if this set of events contains one with any of the `names` or of the `causes`."""
        return any(event.name in names or event.cause in causes for event in self.events)


#: Log Bayes factors of an event by kind of data.
_Gains = Mapping[str, float]


def explain(
    observables: Sequence[Observable],
    chance: Callable[[Observable], float] = lambda observable: observable.chance,
    rise: LeakRise | None = None,
) -> tuple[Explanation, ...]:
    """Find the sets of events that may explain the tests (`observables`) of a recording, the most probable first.

    `chance` computes the p-value of an observable, by default the one that its detector states. `rise` is the leakage
    above that of healthy recordings, None without such recordings. Returns all single events of `events.toml`, and
    combinations of up to `MAX_EVENTS` events, each with a log Bayes factor, summed over kinds of data, above
    `MIN_LOG_FACTOR`. Their probabilities add up to 1, as they are given that some event has happened.
    """
    events = load_events()
    log_factors = [(observable, _log_factor(observable, chance(observable), rise)) for observable in observables]
    # tempered by the largest factor of the same data
    largest = _largest_by_data(log_factors)
    factors = _compare_by_likelihood(
        [(test, temper(gain, largest[test.data], INFERENCE.tempering.term)) for test, gain in log_factors]
    )
    gains_of = {event.name: _possible_gains(event, factors, rise) for event in events}  # log Bayes factors
    supported = [
        event for event in events if max(sum(gains.values()) for gains in gains_of[event.name]) > MIN_LOG_FACTOR
    ]
    groups: list[tuple[Event, ...]] = [(event,) for event in events]
    groups += [group for size in range(2, MAX_EVENTS + 1) for group in combinations(supported, size)]
    posteriors = [_explain_by_group(group, gains_of) for group in groups]
    logarithms = np.array([logarithm for logarithm, _ in posteriors])
    weights = weigh_alternatives(logarithms)
    order = np.argsort(-weights, kind="stable")
    # odds against the empty set of events, whose logarithm is 0: its prior is 1, and it explains no change
    odds = np.exp(np.minimum(logarithms, MAX_LOG_ODDS))
    return tuple(Explanation(groups[k], float(weights[k]), posteriors[k][1], float(odds[k])) for k in order)


def _compare_by_likelihood(log_factors: Sequence[tuple[Observable, float]]) -> list[tuple[Observable, float]]:
    """Derive the log Bayes factors of all terms of the volume balance from the term that describes a change best.

    The terms are alternative descriptions of the same residual. A term's log likelihood l is the log Bayes factor of
    its uncalibrated p-value. The best term has the log likelihood L and the calibrated log Bayes factor B. With the
    relative misfit m of models (`tempering.term` in `priors.toml`), each term gets

        log factor = max(B - (L - l) / (1 + 2 m L), 0).

    Healthy recordings show how rare the best description is, but are too few to show which term is the best. Only the
    judged recording shows this. Factors of other kinds of data are returned unchanged.
    """
    terms = [(log_bayes_factor(term.chance), factor) for term, factor in log_factors if term.data == VOLUMES]
    if not terms:
        return list(log_factors)
    best_likelihood, best_factor = max(terms, key=lambda term: term[0])
    factors = []
    for observable, factor in log_factors:
        deficit = temper(
            best_likelihood - log_bayes_factor(observable.chance), best_likelihood, INFERENCE.tempering.term
        )
        is_term = observable.data == VOLUMES
        factors.append((observable, max(best_factor - deficit, 0.0) if is_term else factor))
    return factors


def _largest_by_data(log_factors: Sequence[tuple[Observable, float]]) -> dict[str, float]:
    """Find the largest log Bayes factor, at least 0, of each kind of data."""
    largest: dict[str, float] = {}
    for observable, factor in log_factors:
        largest[observable.data] = max(factor, largest.get(observable.data, 0.0))
    return largest


def _explain_by_group(group: Sequence[Event], gains_of: Mapping[str, Sequence[_Gains]]) -> tuple[float, frozenset[str]]:
    """Compute the log posterior of a set of events, up to a constant, and the kinds of data that the set explains.

        log posterior = sum of log priors of the events + sum over kinds of data of the largest log Bayes factor.

    For the leakage's rise over healthy recordings (the kind of data `RISE`), the negative factors of events that
    contradict the rise are added. `gains_of` has the result of `_possible_gains` for each event; the combination of
    onsets with the largest sum counts.
    """
    log_prior = float(sum(np.log(event.probability) for event in group))
    best, explained = -np.inf, frozenset[str]()
    for choice in product(*(gains_of[event.name] for event in group)):  # one onset for each event
        all_data = [data for event_gains in choice for data in event_gains]
        gains = {data: max(event_gains.get(data, 0.0) for event_gains in choice) for data in all_data}
        if RISE in gains:
            # the best description of the rise counts; each event that contradicts the rise reduces it
            rises = [event_gains.get(RISE, 0.0) for event_gains in choice]
            gains[RISE] = max(*rises, 0.0) + sum(min(rise, 0.0) for rise in rises)
        if (total := sum(gains.values())) > best:
            best, explained = total, frozenset(data for data, gain in gains.items() if gain > 0.0)
    return log_prior + best, explained


def _possible_gains(
    event: Event, factors: Sequence[tuple[Observable, float]], rise: LeakRise | None
) -> Sequence[_Gains]:
    """Compute an event's log Bayes factors by kind of data, in one mapping for each possible time of its onset.

    `factors` are observables with the log Bayes factors of a change. The first mapping is for an onset within the
    recording. A leak gets a second one if `rise` is given, for an onset before the recording: such a leak explains the
    leakage above that of healthy recordings (the rise).
    """
    gains = _gains_at_onset(event, factors)
    if rise is None or event.name not in LEAK_EVENTS:
        return [gains]
    older_gains = {RISE: log_bayes_factor(rise.rise.chance)}
    if gains.get(VOLUMES, 0.0) > 0.0:
        gains[RISE] = rise.step_log_ratio  # a leak that began within the recording explains the rise by its step
    return [gains, older_gains]


def _gains_at_onset(event: Event, factors: Sequence[tuple[Observable, float]]) -> dict[str, float]:
    """Compute the log Bayes factors (at least 0) of an event that begins within the recording, by kind of data.

    The result for a kind of data is the largest sum of a log factor and the log odds from the prior on the event's
    size, over

    - observables that the event affects, or changes by a common scale of both pressures (`_agree_on_scale`);
    - side effects ("disturbs" of `Event.patterns`) on kinds of data in which no observable of the first group has a log
      factor above `MIN_LOG_FACTOR`, if one of another kind does. Their log factors are limited to the largest one of
      the first group: a much clearer change has another cause.

    The observable of the first group with the largest log factor gives the time of the event; only changes that may be
    of that time count.
    """
    affected = [(observable, gain) for observable, gain in factors if event.changes(observable, "moves")]
    affected += _agree_on_scale(
        [(observable, gain) for observable, gain in factors if event.changes(observable, "scales")]
    )
    if not affected:
        return {}
    clearest, best_gain = max(affected, key=lambda pair: pair[1])
    supporting_data = {observable.data for observable, gain in affected if gain > MIN_LOG_FACTOR}
    side_effects = [
        (observable, min(gain, best_gain))
        for observable, gain in factors
        if supporting_data and observable.data not in supporting_data and event.changes(observable, "disturbs")
    ]
    gains: dict[str, float] = {}
    for observable, gain in affected + side_effects:
        onsets = [test.onset for test in (observable, clearest) if test.onset is not None]
        max_distance = 0.5 * sum(onset.high - onset.low for onset in onsets)  # of the 95 % intervals
        if len(onsets) < 2 or abs(onsets[0].value - onsets[1].value) <= max_distance:
            # advantage: twice the log odds by the prior on the event's size. An event without a cause, such as unsteady
            # motion that looks like free air, may be of any size
            size_log_odds = 0.5 * observable.advantage if event.cause is not None else 0.0
            gains[observable.data] = max(gain + size_log_odds, gains.get(observable.data, 0.0))
    return gains


def _agree_on_scale(factors: Sequence[tuple[Observable, float]]) -> list[tuple[Observable, float]]:
    """Reduce the log Bayes factors of changes that a common scale of both pressures does not explain well.

    Each observable states the logarithm v of the scale that would cause its change, or is left out. If k is the
    logarithm of the common scale, the log factor is reduced by ((v - k) / s)^2 / 2, but not below 0. The variance s^2
    is that of v plus that of the law that relates the change to the scale (`explanation.scale` of `priors.toml`). For
    k, each v is tried, and the one with the largest sum over kinds of data of the largest reduced factor is used. The
    result is empty if no factor remains above 0.
    """
    best: list[tuple[Observable, float]] = []
    best_sum, misfit = 0.0, DECISION.explanation.scale
    scales = [(observable, gain, scale) for observable, gain in factors if (scale := observable.pressure_scale)]
    for _, _, candidate in scales:
        reduced = [
            (observable, max(gain - 0.5 * (scale.value - candidate.value) ** 2 / (scale.deviation**2 + misfit**2), 0.0))
            for observable, gain, scale in scales
        ]
        if (total := sum(_largest_by_data(reduced).values())) > best_sum:
            best, best_sum = reduced, total
    return best


def _log_factor(observable: Observable, chance: float, rise: LeakRise | None) -> float:
    """Compute the log Bayes factor of a change of an observable from its p-value `chance`.

    A leak also raises the estimates of similar quantities, such as an external leakage, whose observables state
    `log_ratio_to_leak`. Their log factor is limited to that of the leakage's rise over healthy recordings (`rise`) plus
    this ratio, but not below 0.
    """
    factor = log_bayes_factor(chance)
    if observable.log_ratio_to_leak is None or rise is None:
        return factor
    leak_factor = log_bayes_factor(rise.rise.chance)
    return min(factor, max(leak_factor + observable.log_ratio_to_leak, 0.0))


def log_bayes_factor(chance: float) -> float:
    """Compute the largest log Bayes factor that a p-value c allows (Sellke): -log(-e c log c) for c < 1/e, else 0."""
    if chance >= np.exp(-1.0):
        return 0.0
    chance = max(chance, np.finfo(float).tiny)
    return -float(np.log(-np.e * chance * np.log(chance)))


def probability_of(
    explanations: Sequence[Explanation], *names: str, causes: Sequence[str] = (), data_kind: str | None = None
) -> float:
    """Compute the probability of an event with one of the `names` or `causes`; 0 without `explanations`.

    With `data_kind`, only explanations (sets of events) of a change in this kind of data (`Observable.data`) count, and
    their probabilities are divided by their sum.
    """
    relevant = [explanation for explanation in explanations if data_kind is None or data_kind in explanation.data]
    total = sum(explanation.probability for explanation in relevant)
    matching = sum(explanation.probability for explanation in relevant if explanation.has(names, causes))
    return float(matching / total) if total > 0.0 else 0.0


def probability_against_chance(explanations: Sequence[Explanation], causes: Sequence[str], data_kind: str) -> float:
    """Compute the probability that an event with one of the `causes` changed a kind of data, `data_kind`.

    The alternatives are events with other causes, and chance. Only `explanations` (sets of events) that explain a
    change in these data count. With their odds against no event,

        probability = sum of the odds of sets with such an event / (1 + sum of the odds of all these sets).
    """
    relevant = [explanation for explanation in explanations if data_kind in explanation.data]
    matching = sum(explanation.odds for explanation in relevant if explanation.has((), causes))
    return float(matching / (1.0 + sum(explanation.odds for explanation in relevant)))
