"""Explain an increase of the leakage of a running machine by a leak or by another event.

The e-detector (`sequential`) detects the increase at its rate of false alarms. The probability that a leak, a sensor or
the duty (motion and load) caused it is computed as for a recording, from the same observables and events.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sealscope.diagnosis.decision.events import load_events
from sealscope.diagnosis.decision.explanations import LEAK_EVENTS, explain, probability_of
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause

#: Probabilities from which a leak (`leak`) and its cause (`named`) explain a rise.
_MIN_PROBABILITY = DECISION.explanation
#: Largest p-value of a change that the blocks show clearly enough.
_MAX_CHANCE: float = LIVE.explanation.rare
#: Cause of leaks to the outside. A part of their flow appears in the estimated leakage of pump and piston.
OUTSIDE: Cause = "external leak"
#: Events for which a watched machine raises an alarm.
ALARMING = (*LEAK_EVENTS, *(event.name for event in load_events() if event.cause == OUTSIDE))


class RiseExplanation(NamedTuple):
    """Explanation of an increase of the leakage."""

    is_leak: bool
    is_outside: bool = False  # True if oil leaks almost surely to the outside
    other_events: str = ""  # the events that explain the increase instead of a leak, in words


#: The blocks do not explain the rise yet.
UNKNOWN = RiseExplanation(is_leak=False)


def explain_rise(observables: Sequence[Observable], data: str, onset: Interval, is_settled: bool) -> RiseExplanation:
    """Find the cause of an increase of the leakage among the changes observed in the blocks around it.

    `observables` are results of tests for changes, and `onset` is the interval in which the increase began [s]. `data`
    is the kind of data from which the leakage is estimated, "volumes" or "response". Changes of this kind count only if
    they may have begun in the same interval. `is_settled` is True if enough blocks have followed to distinguish a leak
    to the outside from a sensor fault; until then, only a leak past piston or pump counts as a leak.

    The result is a leak if leaks are more probable than all other events together, else the most probable explanation
    without a leak, inside or outside. It is `UNKNOWN` if there is no such explanation, if no change of the kind `data`
    is significant (p-value below `_MAX_CHANCE`), or if a leak, although more probable, affects none of the significant
    changes.
    """
    leak_names = ALARMING if is_settled else LEAK_EVENTS
    leak_events = [event for event in load_events() if event.name in leak_names]
    at_onset = [observable for observable in observables if observable.data != data or _coincides(observable, onset)]
    significant_changes = [
        observable for observable in at_onset if observable.data == data and observable.chance < _MAX_CHANCE
    ]
    # only sets of events that explain a change of the leakage
    explanations = [explanation for explanation in explain(at_onset) if data in explanation.data]
    if probability_of(explanations, *leak_names) > _MIN_PROBABILITY.leak:
        if not any(event.affects(change) for event in leak_events for change in significant_changes):
            return UNKNOWN
        is_outside = probability_of(explanations, causes=[OUTSIDE]) > _MIN_PROBABILITY.named
        return RiseExplanation(is_leak=True, is_outside=is_outside)
    without_leak = [explanation for explanation in explanations if not explanation.has(*ALARMING)]
    if not without_leak or not significant_changes:
        return UNKNOWN
    most_probable, *_ = without_leak  # sorted by probability
    other_events = " and ".join(event.description for event in most_probable.events)
    return RiseExplanation(is_leak=False, other_events=other_events)


def _coincides(observable: Observable, onset: Interval) -> bool:
    """Return True if the 95 % interval of a change's onset is known and overlaps the interval `onset` [s]."""
    change = observable.onset
    return change is not None and change.low <= onset.high and change.high >= onset.low
