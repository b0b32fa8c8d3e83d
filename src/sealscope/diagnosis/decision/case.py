"""Grounds of a decision: the judging report, rival explanations, healthy recordings, and the questions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.decision.events import load_events
from sealscope.diagnosis.decision.explanations import (
    LEAK_EVENTS,
    Explanation,
    LeakRise,
    explain,
    probability_of,
)
from sealscope.diagnosis.decision.null import HealthyNull, key_of
from sealscope.diagnosis.inference.observable import LeakMeasure, Observable, Observed
from sealscope.diagnosis.inference.scatter import RISE
from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import AGAINST, WITHIN, Cause

_PRIORS = priors("decision")
#: The question beside WITHIN and AGAINST: is there more than the rig's file allows?
LEVEL = "against the rig's file"


class Question(NamedTuple):
    """A question: its score and threshold, its predictive chance, its share of the false-alarm probability."""

    name: str
    score: float
    threshold: float
    chance: float
    probability: float


class OtherEvent(NamedTuple):
    """An event other than a leak: cause, words, probability, and its rarest observable."""

    cause: Cause
    words: str
    probability: float
    observable: Observable
    chance: float


@dataclass(frozen=True, eq=False, kw_only=True)
class DecisionContext:
    """Conditions of a decision.

    Parameters
    ----------
    false_alarm_probability : float
        Probability of `leak` on a leak-free recording.
    refusal : str, optional
        Why the recording cannot be compared with the healthy ones that were given.
    is_weighed : bool
        Whether other causes compete; False for a method by its own rule.
    """

    false_alarm_probability: float
    refusal: str | None = None
    is_weighed: bool = True


@dataclass(frozen=True, eq=False)
class Case:
    """Grounds of a decision: the judging report, all observables, the null, and the context."""

    judge: Observed
    observables: Sequence[Observable]
    null: HealthyNull
    context: DecisionContext

    @property
    def leak(self) -> LeakMeasure | None:
        """Leak as measured by the judging provider."""
        return self.judge.leak

    @cached_property
    def explanations(self) -> tuple[Explanation, ...]:
        """Sets of events with their probabilities."""
        rise = None
        if self.leak is not None and self.leak.rise is not None:
            step = 0.0 if self.leak.step is None else self.leak.step.fitted[0] * self.leak.share_after
            rise = LeakRise(self.leak.rise, step)
        return explain(self.observables, self.null.chance, rise)

    def leak_probability(self, alarm: Question) -> float:
        """Compute the probability of a leak past piston or pump, given a change in the data of the alarm's question.

        A level above the rig's file is that of a leak unless a change within the recording, which raised it, is none.
        """
        if not self.context.is_weighed:
            return 1.0
        if alarm.name == LEVEL:
            within = next((question for question in self.alarms if question.name == WITHIN), None)
            return 1.0 if within is None else self.leak_probability(within)
        data = RISE if alarm.name == AGAINST and self.leak is not None else self.judge.observables[0].data
        return probability_of(self.explanations, *LEAK_EVENTS, data=data)

    @cached_property
    def questions(self) -> tuple[Question, ...]:
        """The questions that can be asked, each with its share of the false-alarm probability."""
        return _leak_questions(self, self.leak) if self.leak is not None else _change_questions(self)

    @property
    def alarms(self) -> tuple[Question, ...]:
        """The questions that are answered with yes, whatever explains it."""
        return tuple(question for question in self.questions if question.chance < question.probability)

    @cached_property
    def other_event(self) -> OtherEvent | None:
        """The event other than a leak that surely explains the rarest change it can; None where none does."""
        share: float = _PRIORS["explanation"]["heading"]
        allowed = share * self.context.false_alarm_probability
        allowed /= max(len({observable.data for observable in self.observables}), 1)
        chances = {id(observable): self.null.chance(observable) for observable in self.observables}
        for observable in sorted(self.observables, key=lambda candidate: chances[id(candidate)]):
            if chances[id(observable)] >= allowed:
                return None
            moving_events = [event for event in load_events() if event.does_move(observable)]
            causes = dict.fromkeys(event.cause for event in moving_events if event.name not in LEAK_EVENTS)
            for cause in (named for named in causes if named is not None):
                certainty = probability_of(self.explanations, cause=cause, data=observable.data)
                if certainty > _PRIORS["explanation"]["named"]:
                    words = max((e for e in moving_events if e.cause == cause), key=lambda e: e.probability).words
                    return OtherEvent(cause, words, certainty, observable, chances[id(observable)])
        return None


def _leak_questions(case: Case, leak: LeakMeasure) -> tuple[Question, ...]:
    from scipy.special import ndtr, ndtri

    allowed, questions = case.context.false_alarm_probability, []
    step, rise, excess = leak.step, leak.rise, leak.excess
    shared = step is not None and (rise is not None or excess is not None)
    second = _PRIORS["questions"]["within"] * allowed if shared else 0.0
    if step is not None:
        share, key = second if rise is not None else allowed - second, step_key(leak.provider)
        threshold = step.threshold(case.null.law_chance(key, share))
        questions.append(Question(WITHIN, step.score, threshold, case.null.inflate(key, step.chance), share))
    if rise is not None:
        share = allowed - second
        questions.append(Question(AGAINST, rise.score, rise.threshold(share), rise.chance, share))
    if excess is not None:
        share = second or allowed
        questions.append(Question(LEVEL, excess, float(-ndtri(share)), float(ndtr(-excess)), share))
    return tuple(questions)


def step_key(provider: str) -> str:
    """Return the name under which the rarity of a provider's leak within a recording is kept."""
    return f"{provider}: step"


def _change_questions(case: Case) -> tuple[Question, ...]:
    """Return the question of a provider that measures no leak: the change of the observables that a leak moves."""
    leak = next(event for event in load_events() if event.name == LEAK_EVENTS[0])
    moved_observables = [observable for observable in case.judge.observables if leak.does_move(observable)]
    rarest = min(moved_observables, key=lambda observable: observable.chance, default=None)
    if rarest is None:
        return ()
    allowed, chance = case.context.false_alarm_probability, case.null.chance(rarest)
    law = case.null.law_chance(key_of(rarest), allowed)
    threshold = rarest.score * np.log(law) / np.log(min(max(rarest.chance, 1e-300), 1.0 - 1e-9))
    where = WITHIN if rarest.onset is not None else AGAINST
    return (Question(where, rarest.score, max(float(threshold), 0.0), chance, allowed),)
