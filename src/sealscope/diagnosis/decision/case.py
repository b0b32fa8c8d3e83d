"""Grounds of a decision: the report of the judging detector, other explanations, the tests for a leak, and their null.

An observable is the result of a detector's test of one quantity for a change (`inference.observable`).

The chances that detectors state are calibrated by those that they stated for healthy recordings, the null of the tests.
A detector states for each statistic a chance (p-value) P, the probability that a healthy recording scores as high. If
that is right, the surprisal u = -log P of a healthy recording is exponentially distributed. In a fraction of machines
(`priors.toml`) the stated chances are too small: there u / lambda is exponential, with an exponential prior on log
lambda > 0. With the u_1 .. u_n of n healthy recordings, and prior probabilities p_k of values lambda_k, the calibrated
(predictive) chance is

    P(u) = sum_k w_k exp(-u / lambda_k),    w_k ~ p_k lambda_k^(-n) exp(-sum_i u_i / lambda_k),

where lambda_0 = 1 leaves the stated chance as it is.

Thus a rest, a ramp or a warm-up that every healthy recording has raises no alarm. Without healthy recordings the
stated chances are not changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.decision.explanations import (
    LEAK_EVENTS,
    Event,
    Explanation,
    explain,
    load_events,
    log_bayes_factor,
    probability_against_chance,
    probability_of,
)
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.estimate.population import weigh_alternatives
from sealscope.diagnosis.estimate.special import find_root
from sealscope.diagnosis.inference.comparison import RISE
from sealscope.diagnosis.inference.observable import LeakMeasure, Observable, Observed
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.evidence import AGAINST, WITHIN
from sealscope.diagnosis.verdict.severity import joint_causes
from sealscope.recordings.recording import Array

#: Number of values of lambda that the calibrated chance sums over, in addition to 1.
NODES = 64


@dataclass(frozen=True, eq=False)
class HealthyNull:
    """Distribution of p-values in healthy recordings of a machine, by which the p-values of detectors are calibrated.

    `surprisals`: -log(chance) of each test in each healthy recording, by the test's key (`Observable.key`, `STEP_KEY`).
    """

    surprisals: Mapping[str, Sequence[float]] = field(default_factory=dict)
    _posteriors: dict[str, tuple[Array, Array]] = field(default_factory=dict, init=False)

    def chance(self, observable: Observable) -> float:
        """Compute the p-value of an observable, corrected by those of healthy recordings as in `calibrate`."""
        return self.calibrate(observable.key, observable.chance)

    def calibrate(self, key: str, chance: float) -> float:
        """Correct a detector's p-value `chance` by the p-values that it stated for healthy recordings (`key`).

        The result is the predictive chance P(u) of the module's docstring.
        """
        if key not in self._posteriors:
            self._posteriors[key] = _inflation_posterior(self.surprisals.get(key, ()))
        weights, inflations = self._posteriors[key]
        log_chance = np.log(max(chance, np.finfo(float).tiny))
        return min(float(weights @ np.exp(log_chance / inflations)), 1.0)

    def uncalibrated_chance(self, key: str, chance: float) -> float:
        """Invert `calibrate`: compute the p-value that a detector must state so that the calibrated one is `chance`.

        If no p-value is small enough, the smallest normal float is returned.
        """
        max_surprisal = -np.log(np.finfo(float).tiny)
        if self.calibrate(key, np.exp(-max_surprisal)) >= chance:
            return float(np.finfo(float).tiny)
        surprisal = find_root(lambda u: self.calibrate(key, np.exp(-u)) - chance, 0.0, max_surprisal)
        return float(np.exp(-surprisal))


def _inflation_posterior(surprisals: Sequence[float]) -> tuple[Array, Array]:
    """Compute the posterior weights w_k and the values lambda_k (NODES + 1,); without surprisals both are [1]."""
    priors = DECISION.null
    if not len(surprisals):
        return np.ones(1), np.ones(1)
    log_inflation = np.append(0.0, np.linspace(0.0, np.log(priors.largest), NODES))
    inflation = np.exp(log_inflation)
    prior = np.exp(-log_inflation / priors.inflation)
    prior[1:] *= priors.wrong_share / prior[1:].sum()  # `wrong_share`: fraction of machines with wrong p-values
    prior[0] = 1.0 - priors.wrong_share
    log_posterior = np.log(prior) - len(surprisals) * log_inflation - float(np.sum(surprisals)) / inflation
    return weigh_alternatives(log_posterior), inflation


#: Key in `HealthyNull.surprisals` of a detector's test for a step of the leakage, by the detector's name.
STEP_KEY = "{}: step"


#: Name of the third test, besides WITHIN and AGAINST: for leakage above the limit in the rig's file.
LEVEL = "against the rig's file"


class LeakTest(NamedTuple):
    """Result of a test for a leak."""

    name: str  # WITHIN the recording, AGAINST healthy recordings, or LEVEL: against the limit in the rig's file
    score: float  # statistic of the test, which grows with the evidence of a leak
    threshold: float  # score that is exceeded with the `probability` if there is no leak
    chance: float  # p-value, i.e. probability of at least this score without a leak
    probability: float  # part of the allowed probability of a false alarm that the test gets


class OtherEvent(NamedTuple):
    """Event other than a leak that explains a rare change in a recording."""

    cause: str  # cause of the event, such as "sensor fault"
    description: str  # the quantities that the event changes, in words
    probability: float  # posterior probability of an event with this cause, against other causes and chance
    observable: Observable  # the rarest change that the event explains, as the result of a detector's test
    chance: float  # probability that a healthy recording has at least the score of the `observable`


@dataclass(frozen=True, eq=False)
class Case:
    """Everything that a decision on one recording depends on."""

    judge: Observed  # report of the detector that judges
    observables: Sequence[Observable]  # test results of all detectors that are considered
    null: HealthyNull  # distribution of the test results in healthy recordings
    false_alarm_probability: float  # allowed probability of the verdict `leak` on a leak-free recording
    weigh_rivals: bool = True  # False for a method that decides alone, without other causes (rivals)

    @property
    def leak(self) -> LeakMeasure | None:
        """Leakage as measured by the judging detector; None if it does not measure leakage."""
        return self.judge.leak

    @property
    def tested_observable(self) -> Observable | None:
        """Observable by which a judging detector that does not measure leakage is tested for a leak; None without one.

        Of those that a piston leak affects, it has the smallest p-value, as stated by the detector.
        """
        # the other leak event, "pump leak", affects the volume balance alone, which measures leakage
        leak = next(event for event in load_events() if event.name == LEAK_EVENTS[0])
        affected = [observable for observable in self.judge.observables if leak.changes(observable, "moves")]
        return min(affected, key=lambda observable: observable.chance, default=None)

    def find_rarest(self) -> tuple[float, str]:
        """Find the smallest calibrated p-value of the observables, times the number of tests, and words for its change.

        Observables with the same distribution in healthy recordings (`Observable.key`) count as one test (Bonferroni
        correction). The words are those of the event with the largest prior probability that changes the observable,
        or else its name; 1 and "" without observables.
        """
        rarest = min(self.observables, key=self.null.chance, default=None)
        if rarest is None:
            return 1.0, ""
        events = [event for event in load_events() if event.cause and event.changes(rarest)]
        likeliest = max(events, key=lambda event: event.probability, default=None)
        n_tests = len({observable.key for observable in self.observables})
        chance = min(1.0, n_tests * self.null.chance(rarest))
        return chance, rarest.name if likeliest is None else likeliest.description

    @cached_property
    def explanations(self) -> tuple[Explanation, ...]:
        """Sets of events that explain the test results, with posterior probabilities, the most probable first."""
        rise = None if self.leak is None else self.leak.step_rise  # leakage above that of healthy recordings
        return explain(self.observables, self.null.chance, rise)

    def leak_probability(self, alarm: LeakTest) -> float:
        """Compute the probability that a leak past piston or pump, rather than another event, caused the `alarm`.

        It is 1 if other causes are not weighed. No event explains an alarm by the limit in the rig's file (LEVEL): it
        has the probability of the alarm by the test WITHIN, or 1 if that test raised no alarm.
        """
        if not self.weigh_rivals:
            return 1.0
        if alarm.name == LEVEL:
            within_alarm = next((test for test in self.alarms if test.name == WITHIN), None)
            return 1.0 if within_alarm is None else self.leak_probability(within_alarm)
        return probability_of(self.explanations, *LEAK_EVENTS, data_kind=self._data_kind(alarm))

    def external_probability(self, alarm: LeakTest) -> float:
        """Compute the probability that oil leaks out of the circuit, given an `alarm`; 0 if rivals are not weighed."""
        if not self.weigh_rivals:
            return 0.0
        return probability_of(self.explanations, causes=["external leak"], data_kind=self._data_kind(alarm))

    def resembles_external(self, alarm: LeakTest) -> bool:
        """Return True if the rise over healthy recordings alone does not exclude that the leak is an external one.

        That is so if L_external / (L_external + L_leak) > 1 - `sure` (`[explanation]` of `priors.toml`), with the
        likelihoods L of the rise by either leak (`Observable.log_ratio_to_leak`). Priors, such as that a large external
        leak would have been seen, do not count.
        """
        if not self.weigh_rivals or self._data_kind(alarm) != RISE:
            return False
        sure = DECISION.explanation.sure
        return any(
            observable.log_ratio_to_leak is not None and observable.log_ratio_to_leak > np.log(1.0 / sure - 1.0)
            for observable in self.observables
            if observable.name.startswith("external leak")
        )

    def shows_leak(self, alarm: LeakTest) -> bool:
        """Return True if a leak probably caused an `alarm`, or if an internal and an external leak cannot be separated.

        They cannot if the probability of the two together is above `named`, that of the external leak alone is not, and
        the probability of each is above 1 - `sure` (limits in `[explanation]` of `priors.toml`).
        """
        limits, leak = DECISION.explanation, self.leak_probability(alarm)
        if leak > limits.leak:
            return True
        external, data_kind = self.external_probability(alarm), self._data_kind(alarm)
        joint = probability_of(self.explanations, *LEAK_EVENTS, causes=["external leak"], data_kind=data_kind)
        return joint > limits.named >= external and min(leak, external) > 1.0 - limits.sure

    def _data_kind(self, alarm: LeakTest) -> str:
        """Return the kind of data (`Observable.data`) from which the test `alarm` was computed."""
        if self.leak is None and self.tested_observable is not None:
            return self.tested_observable.data
        if alarm.name == AGAINST or not self.judge.observables:  # `RISE` merely fills in without observables
            return RISE
        return self.judge.observables[0].data  # volume balance and pressure response list first their tests for steps

    @cached_property
    def tests(self) -> tuple[LeakTest, ...]:
        """The tests that the report allows; their false-alarm probabilities add up to `false_alarm_probability`.

        A detector that does not measure leakage has one, by `tested_observable`, and states no threshold. It is
        computed as the score with a calibrated p-value equal to the allowed false-alarm probability, assuming that
        scores are proportional to the logarithm of the detector's p-value.
        """
        if self.leak is not None:
            return _leak_tests(self, self.leak)
        rarest = self.tested_observable
        if rarest is None:
            return ()
        allowed = self.false_alarm_probability
        allowed_chance = self.null.uncalibrated_chance(rarest.key, allowed)  # p-value that the detector would state
        rarest_chance = min(max(rarest.chance, 1e-300), 1.0 - 1e-9)  # the logarithm is finite and not 0
        threshold = max(float(rarest.score * np.log(allowed_chance) / np.log(rarest_chance)), 0.0)
        name = WITHIN if rarest.onset is not None else AGAINST  # only a change within a recording has an onset
        return (LeakTest(name, rarest.score, threshold, chance=self.null.chance(rarest), probability=allowed),)

    @property
    def alarms(self) -> tuple[LeakTest, ...]:
        """Tests whose p-value is below their allowed false-alarm probability, the one that fits the leak best first."""
        alarms = [test for test in self.tests if test.chance < test.probability]
        return tuple(alarms if self.has_onset_within else reversed(alarms))  # WITHIN is the first of `tests`

    @property
    def has_onset_within(self) -> bool:
        """True if a leak that began within the recording is a better explanation than an older leak.

        An older leak was there from the first sample on. Compared are the log Bayes factors

            began within:    B(step) + step_log_ratio,
            older:           B(rise over healthy recordings).

        B is the largest one that the p-value of a test allows (`log_bayes_factor`); `step_log_ratio` is that of
        `LeakRise`. The result is True without measured leakage or healthy recordings, or if the times in which valves
        hold the load show when the rise began (`rise_onset` is not None).
        """
        leak = self.leak
        if leak is None or leak.step_rise is None or leak.rise_onset is not None:
            return True
        rise = leak.step_rise
        step_gain = sum(log_bayes_factor(test.chance) for test in self.tests if test.name == WITHIN)  # 0 or 1 test
        return step_gain + rise.step_log_ratio > log_bayes_factor(rise.rise.chance)

    def leak_flow(self, alarm: LeakTest) -> Estimate | None:
        """Return the mean flow of the leak that raised an `alarm`; None if it is unknown.

        After an alarm by a step within the recording, it is the step's flow; after one by comparison with healthy
        recordings, that of the rise over them; after one by the limit in the rig's file, the total leakage.
        """
        leak = self.leak
        if leak is None:
            return None
        # without healthy recordings, as in a test by the limit, `rise_flow` is the total leakage
        return leak.step_flow if alarm.name == WITHIN else leak.rise_flow

    @cached_property
    def other_event(self) -> OtherEvent | None:
        """Event other than a leak that explains a rare change with sufficient probability; None if there is none.

        The observables are tried in the order of their p-values. For each, single causes are tried before groups of
        inseparable causes (`joint_causes`); the first that may be named (`_probability_of_causes`) is returned.
        """
        named_events = [event for event in load_events() if event.cause and event.name not in LEAK_EVENTS]
        candidates_of = {
            observable: [event for event in named_events if event.changes(observable)]
            for observable in self.observables
        }
        # observables with the same distribution in healthy recordings (`Observable.key`) count as one test
        n_tests = len({observable.key for observable, candidates in candidates_of.items() if candidates})
        # `heading`: probability of naming an event by mistake, over that of a false alarm
        allowed = DECISION.explanation.heading * self.false_alarm_probability / max(n_tests, 1)
        chances = {observable: self.null.chance(observable) for observable in self.observables}
        for observable in sorted(self.observables, key=chances.__getitem__):
            if chances[observable] >= allowed:
                return None
            singles = {event.cause: (event.cause,) for event in candidates_of[observable] if event.cause}
            groups = {name: causes for name, causes in joint_causes().items() if singles.keys() & set(causes)}
            for name, causes in (singles | groups).items():
                if not all(self._events_of(cause, observable.data) for cause in causes):
                    continue  # one of the group's causes cannot change this kind of data
                probability = self._probability_of_causes(causes, observable.data)
                if probability is not None:
                    description = " or ".join(self._describe(cause, observable.data) for cause in causes)
                    return OtherEvent(name, description, probability, observable, chances[observable])
        return None

    def _probability_of_causes(self, causes: Sequence[str], data_kind: str) -> float | None:
        """Compute the probability that one of the causes changed a kind of data; None if they must not be named.

        The alternatives are other causes and chance. The causes may be named if three limits of `priors.toml` are
        exceeded: `happened` by this probability, `named` by the probability against other causes only, and 1 - `sure`
        by the latter probability of each single cause.
        """
        limits = DECISION.explanation
        by_cause = [probability_of(self.explanations, causes=[cause], data_kind=data_kind) for cause in causes]
        probability = probability_against_chance(self.explanations, causes, data_kind)
        is_named = probability_of(self.explanations, causes=causes, data_kind=data_kind) > limits.named
        is_each_possible = min(by_cause) > 1.0 - limits.sure
        return probability if is_named and is_each_possible and probability > limits.happened else None

    def _describe(self, cause: str, data_kind: str) -> str:
        """Describe in words the most probable event with a given cause that changes a kind of data."""
        events = self._events_of(cause, data_kind)
        probabilities = [probability_of(self.explanations, event.name, data_kind=data_kind) for event in events]
        return events[int(np.argmax(probabilities))].description

    def _events_of(self, cause: str, data_kind: str) -> list[Event]:
        """List the events with a given cause that change an observable of a kind of data (`Observable.data`)."""
        tests = [observable for observable in self.observables if observable.data == data_kind]
        return [event for event in load_events() if event.cause == cause and any(map(event.changes, tests))]


def _leak_tests(case: Case, leak: LeakMeasure) -> tuple[LeakTest, ...]:
    """Make the tests for a leak that the measured leakage `leak` allows, at most two of the following three.

    - WITHIN: a step (a sudden increase) within the recording.
    - AGAINST: a rise over healthy recordings.
    - LEVEL: without healthy recordings, a level above the limit in the rig's file.

    Two tests share the allowed false-alarm probability. A fraction of it (`questions.within` in `priors.toml`) goes to
    WITHIN if the other test is AGAINST, or to LEVEL if the other test is WITHIN. The rest goes to the other test.

    The p-value (`chance`) of each test is compared with the test's part of the probability. The p-value of a step is
    `StepTest.chance` (`estimate/change.py`), in the volume balance the joint one of all laws of a leak
    (`find_leak_step` of `inference/leak_flow.py`). It is calibrated (`HealthyNull`) by the p-values that the
    same test gave in healthy recordings (`healthy_null` of `detectors/registry.py`). The p-value of a rise is
    `Rise.chance`, which rests on healthy recordings already; that of a level follows from the normal distribution.
    """
    from scipy.special import ndtr, ndtri  # standard normal distribution and its inverse

    allowed = case.false_alarm_probability
    tests = []
    step, rise, excess = leak.step, leak.rise, leak.excess
    is_shared = step is not None and (rise is not None or excess is not None)
    reserved = DECISION.questions.within * allowed if is_shared else 0.0
    if step is not None:
        probability = reserved if rise is not None else allowed - reserved
        key = STEP_KEY.format(leak.provider)
        chance = case.null.calibrate(key, step.chance)
        # the p-value before calibration, which the calibration converts to `probability`
        threshold = step.threshold(case.null.uncalibrated_chance(key, probability))
        tests.append(LeakTest(WITHIN, step.score, threshold, chance=chance, probability=probability))
    if rise is not None:
        probability = allowed - reserved
        threshold = rise.threshold(probability)
        tests.append(LeakTest(AGAINST, rise.score, threshold, chance=rise.chance, probability=probability))
    if excess is not None:  # in standard deviations, i.e. standard normal without a leak
        probability = reserved or allowed  # all of it if this is the only test
        threshold, chance = float(-ndtri(probability)), float(ndtr(-excess))
        tests.append(LeakTest(LEVEL, excess, threshold, chance=chance, probability=probability))
    return tuple(tests)
