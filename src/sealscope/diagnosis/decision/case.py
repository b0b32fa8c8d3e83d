"""Grounds of a decision: the report of the judging detector, other explanations, and the tests for a leak."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.decision.events import Event, load_events
from sealscope.diagnosis.decision.explanations import (
    LEAK_EVENTS,
    Explanation,
    explain,
    log_bayes_factor,
    probability_beside_chance,
    probability_of,
)
from sealscope.diagnosis.decision.null import HealthyNull, null_key
from sealscope.diagnosis.inference.observable import LeakMeasure, Observable, Observed
from sealscope.diagnosis.inference.scatter import RISE
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.evidence import AGAINST, WITHIN
from sealscope.diagnosis.verdict.states import joint_causes

#: Name of the third test, besides WITHIN and AGAINST: whether the leakage exceeds the limit in the rig's file.
LEVEL = "against the rig's file"


class LeakTest(NamedTuple):
    """Result of a test for a leak.

    `name`: WITHIN, AGAINST or LEVEL, i.e. within the recording, against healthy recordings, or against the rig's file;
    `score`: statistic of the test, which grows with the evidence of a leak; `chance`: probability of at least this
    score without a leak; `probability`: allowed probability of a false alarm, i.e. that without a leak the score
    exceeds the `threshold`.
    """

    name: str
    score: float
    threshold: float
    chance: float
    probability: float


class OtherEvent(NamedTuple):
    """Event other than a leak that explains a rare change in a recording.

    `cause`, `description`: cause of the event, and what it changes in words; `probability`: posterior probability of an
    event with this cause, rather than another one or none; `observable`: the rarest observable that it explains;
    `chance`: probability that a healthy recording has at least its score.
    """

    cause: str
    description: str
    probability: float
    observable: Observable
    chance: float


@dataclass(frozen=True, eq=False)
class Case:
    """Everything that a decision on one recording depends on.

    `judge`: report of the detector that judges; `observables`: tests of all detectors that are considered; `null`:
    distribution of the observables in healthy recordings; `false_alarm_probability`: allowed probability of the
    verdict `leak` on a leak-free recording; `weigh_rivals`: true if other causes (rivals) compete with a leak, false
    for a method that decides alone.
    """

    judge: Observed
    observables: Sequence[Observable]
    null: HealthyNull
    false_alarm_probability: float
    weigh_rivals: bool = True

    @property
    def leak(self) -> LeakMeasure | None:
        """Leakage as measured by the judging detector; None if it does not measure leakage."""
        return self.judge.leak

    @property
    def rarest_observable(self) -> Observable:
        """The test result (observable) of the judging detector that is least probable in a healthy recording."""
        return min(self.judge.observables, key=lambda observable: observable.chance)

    @cached_property
    def explanations(self) -> tuple[Explanation, ...]:
        """Sets of events that explain the test results of the recording, each with its posterior probability.

        The most probable set comes first. An event is a change of the machine, its sensors or its motion, such as a
        leak.
        """
        return explain(self.observables, self.null.chance, None if self.leak is None else self.leak.step_rise)

    def leak_probability(self, alarm: LeakTest) -> float:
        """Compute the probability that a leak past piston or pump caused an alarm, rather than another event.

        It is 1 if other causes are not weighed (`weigh_rivals`). If the alarm is a leakage above the limit of the rig's
        file, a leak that began within the recording may have raised it: the result is then the probability for the
        alarm of the test for such a leak, or 1 if that test raised none.
        """
        if not self.weigh_rivals:
            return 1.0
        if alarm.name == LEVEL:
            step_alarm = next((test for test in self.alarms if test.name == WITHIN), None)
            return 1.0 if step_alarm is None else self.leak_probability(step_alarm)
        return probability_of(self.explanations, *LEAK_EVENTS, data_kind=self._data_kind(alarm))

    def external_probability(self, alarm: LeakTest) -> float:
        """Compute the probability that oil leaks out of the circuit, given the data that raised the alarm.

        It is 0 if other causes are not weighed (`weigh_rivals`).
        """
        if not self.weigh_rivals:
            return 0.0
        return probability_of(self.explanations, causes=["external leak"], data_kind=self._data_kind(alarm))

    def _data_kind(self, alarm: LeakTest) -> str:
        """Return the kind of data (`Observable.data`) by which a test raised its alarm.

        It is `RISE`, the difference from healthy recordings, if the alarm is from the comparison with them and leakage
        is measured. Otherwise it is the kind of data that the judging detector tests for changes.
        """
        is_rise = alarm.name == AGAINST and self.leak is not None
        return RISE if is_rise else self.judge.observables[0].data

    @cached_property
    def tests(self) -> tuple[LeakTest, ...]:
        """The tests for a leak that the detector's report allows.

        Each test has its own allowed probability of a false alarm. Their sum is `false_alarm_probability`.
        """
        return _leak_tests(self, self.leak) if self.leak is not None else _change_tests(self)

    @property
    def alarms(self) -> tuple[LeakTest, ...]:
        """Tests that raise an alarm, i.e. whose p-value is below their allowed false-alarm probability.

        The test for a leak that began within the recording comes first, unless the leak seems older than the
        recording.
        """
        alarms = [test for test in self.tests if test.chance < test.probability]
        return tuple(alarms if self._has_onset_within else reversed(alarms))

    @property
    def _has_onset_within(self) -> bool:
        """True if a leak that began within the recording is a better explanation than an older leak.

        An older leak explains only the leakage above that of healthy recordings (the rise). One that began within the
        recording explains a step, i.e. a sudden increase of the leakage, and the rise that this step causes. The result
        is also true if there are no healthy recordings, or if the times in which valves hold the load show that the
        leak began within the recording (`rise_onset`).
        """
        leak = self.leak
        if leak is None or leak.step_rise is None or leak.rise_onset is not None:
            return True
        step_factor = sum(log_bayes_factor(test.chance) for test in self.tests if test.name == WITHIN)
        return step_factor + leak.step_rise.step_log_ratio > log_bayes_factor(leak.step_rise.rise.chance)

    @cached_property
    def other_event(self) -> OtherEvent | None:
        """Event other than a leak that explains a rare change with sufficient probability; None if there is none.

        The changes are tried in the order of their probability in a healthy recording, the least probable first. The
        search ends at a change that is more probable than the allowed probability of naming an event by mistake. Two
        causes that the data cannot separate are named together if neither is probable enough alone (`joint_causes`).
        """
        named_events = [event for event in load_events() if event.cause and event.name not in LEAK_EVENTS]
        candidates_of = {
            observable: [event for event in named_events if event.affects(observable)]
            for observable in self.observables
        }
        # each distribution in healthy recordings is one more test that may name an event by mistake
        n_tests = len({null_key(observable) for observable, candidates in candidates_of.items() if candidates})
        allowed = DECISION.explanation.heading * self.false_alarm_probability / max(n_tests, 1)
        chances = {observable: self.null.chance(observable) for observable in self.observables}
        for observable in sorted(self.observables, key=chances.__getitem__):
            if chances[observable] >= allowed:
                return None
            single_causes = {event.cause: (event.cause,) for event in candidates_of[observable] if event.cause}
            joined = {name: causes for name, causes in joint_causes().items() if single_causes.keys() & set(causes)}
            for cause, alternatives in (single_causes | joined).items():
                probability = self._probability_of_causes(alternatives, observable.data)
                if probability is not None:
                    description = " or ".join(self._describe(cause, observable.data) for cause in alternatives)
                    return OtherEvent(cause, description, probability, observable, chances[observable])
        return None

    def _probability_of_causes(self, causes: Sequence[str], data_kind: str) -> float | None:
        """Compute the probability that a change of a kind of data has one of the causes, and is not by chance.

        None if it is too improbable to be named, be it against all other causes or against chance, or if one of
        several causes is excluded.
        """
        limits = DECISION.explanation
        among_events = [probability_of(self.explanations, causes=[cause], data_kind=data_kind) for cause in causes]
        probability = probability_beside_chance(self.explanations, causes, data_kind)
        is_named = probability_of(self.explanations, causes=causes, data_kind=data_kind) > limits.named
        is_whole = min(among_events) > 1.0 - limits.sure
        return probability if is_named and is_whole and probability > limits.happened else None

    def _describe(self, cause: str, data_kind: str) -> str:
        """Describe the most probable event with a cause that explains a kind of data (`Observable.data`) in words."""
        tests = [observable for observable in self.observables if observable.data == data_kind]
        events = [event for event in load_events() if event.cause == cause and any(map(event.affects, tests))]

        def probability(event: Event) -> float:
            return probability_of(self.explanations, event.name, data_kind=data_kind)

        return max(events, key=probability).description


def _leak_tests(case: Case, leak: LeakMeasure) -> tuple[LeakTest, ...]:
    """Make the tests for a leak from the measured leakage, as far as `leak` allows.

    The leakage is tested for a step (a sudden increase) within the recording, for a rise over healthy recordings, and
    for a level above the limit in the rig's file. The tests share the allowed false-alarm probability. If a step and
    a rise are tested, the fraction `questions.within` of `priors.toml` goes to the step; if a step and a level are
    tested, it goes to the level.
    """
    from scipy.special import ndtr, ndtri

    allowed, tests = case.false_alarm_probability, []
    step, rise, excess = leak.step, leak.rise, leak.excess
    is_shared = step is not None and (rise is not None or excess is not None)
    reserved = DECISION.questions.within * allowed if is_shared else 0.0
    if step is not None:
        probability, key = reserved if rise is not None else allowed - reserved, step_key(leak.provider)
        threshold = step.threshold(case.null.uncalibrated_chance(key, probability))
        tests.append(LeakTest(WITHIN, step.score, threshold, case.null.calibrate(key, step.chance), probability))
    if rise is not None:
        probability = allowed - reserved
        tests.append(LeakTest(AGAINST, rise.score, rise.threshold(probability), rise.chance, probability))
    if excess is not None:
        probability = reserved or allowed
        tests.append(LeakTest(LEVEL, excess, float(-ndtri(probability)), float(ndtr(-excess)), probability))
    return tuple(tests)


def step_key(provider: str) -> str:
    """Return the key under which `HealthyNull` stores a detector's test for a step of the leak within a recording.

    It is the name of the detector, `provider`, and the word "step", such as "volume balance: step".
    """
    return f"{provider}: step"


def _change_tests(case: Case) -> tuple[LeakTest, ...]:
    """Make the test for a leak from the report of a detector that does not measure leakage.

    The detector tests each of its observables. Of those that a leak changes, the one with the smallest p-value
    (`Observable.chance`) gives the test for a leak, with its score and its calibrated p-value (`HealthyNull.chance`).
    The result is empty if a leak changes none of them.

    The detector states no threshold. It is estimated as the score at which the calibrated p-value would equal the
    allowed false-alarm probability, from the score and the p-value of this observable, with the score taken as
    proportional to the logarithm of the p-value.
    """
    leak = next(event for event in load_events() if event.name == LEAK_EVENTS[0])
    affected = [observable for observable in case.judge.observables if leak.affects(observable)]
    rarest = min(affected, key=lambda observable: observable.chance, default=None)
    if rarest is None:
        return ()
    allowed = case.false_alarm_probability
    # a score is about proportional to the logarithm of its chance: the threshold is the score of the allowed chance
    allowed_by_law = case.null.uncalibrated_chance(null_key(rarest), allowed)
    threshold = rarest.score * np.log(allowed_by_law) / np.log(min(max(rarest.chance, 1e-300), 1.0 - 1e-9))
    name = WITHIN if rarest.onset is not None else AGAINST
    return (LeakTest(name, rarest.score, max(float(threshold), 0.0), case.null.chance(rarest), allowed),)
