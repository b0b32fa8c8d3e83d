"""Probabilities of sets of events: by closed forms, and what neither adds to nor takes from a leak."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from sealscope.diagnosis.decision.case import Case, HealthyNull
from sealscope.diagnosis.decision.explanations import (
    LEAK_EVENTS,
    explain,
    load_events,
    log_bayes_factor,
    probability_against_chance,
    probability_of,
)
from sealscope.diagnosis.estimate.interval import Estimate
from sealscope.diagnosis.inference.comparison import Rise
from sealscope.diagnosis.inference.observable import LeakRise, Observable, Observed
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.diagnosis.verdict.severity import state_of

from .cases import observable

EVENTS = {event.name: event for event in load_events()}
LEAK = observable("volumes: leak", 1e-12)
NOISE = observable("noise: noise of the pressures", 1e-30)


def leak_probability(*observables: object) -> float:
    return probability_of(explain(observables), *LEAK_EVENTS, data_kind="volumes")  # type: ignore[arg-type]


@pytest.mark.parametrize("chance", [1e-2, 1e-6, 1e-40])
def test_a_chance_is_worth_the_bound_of_sellke(chance: float) -> None:
    bound = -math.log(-math.e * chance * math.log(chance))
    assert log_bayes_factor(chance) == pytest.approx(bound)
    assert bound > 0.0


def test_rivals_are_told_apart_no_better_than_the_terms_are_known() -> None:
    """However long the recording, the odds of two rivals of the same data end at exp(1 / 4 m)."""
    misfit = INFERENCE.tempering.term
    probable = {event.name: event.probability for event in EVENTS.values()}
    for chance in (1e-20, 1e-100, 1e-280):
        rivals = [observable("levels: friction", chance), observable("levels: load", math.sqrt(chance))]
        one, other = (
            next(row.probability for row in explain(rivals) if [event.name for event in row.events] == [name])
            for name in ("friction", "load")
        )
        odds = math.log(one / other) - math.log(probable["friction"] / probable["load"])
        assert 0.0 < odds < 1.0 / (4.0 * misfit)


def test_what_is_not_rare_is_worth_nothing() -> None:
    assert log_bayes_factor(0.4) == log_bayes_factor(1.0) == 0.0
    chances = np.geomspace(1e-300, 1.0, 200)
    assert np.all(np.diff([log_bayes_factor(chance) for chance in chances]) <= 0.0)


def test_one_observable_by_hand() -> None:
    """Events that move it earn its Bayes factor, all others their probability, and pairs of the former both."""
    bound = log_bayes_factor(LEAK.chance)
    factor = math.exp(bound / (1.0 + 2.0 * INFERENCE.tempering.term * bound))
    moving = [event.probability for event in EVENTS.values() if event.changes(LEAK, "moves")]
    silent = sum(event.probability for event in EVENTS.values() if not event.changes(LEAK, "moves"))
    pairs = 0.5 * (sum(moving) ** 2 - sum(p * p for p in moving))
    triples = (sum(moving) ** 3 - 3 * sum(moving) * sum(p * p for p in moving) + 2 * sum(p**3 for p in moving)) / 6
    total = factor * (sum(moving) + pairs + triples) + silent
    explained = explain([LEAK])
    alone = next(row for row in explained if [event.name for event in row.events] == ["piston leak"])
    assert alone.probability == pytest.approx(factor * EVENTS["piston leak"].probability / total, rel=1e-9)
    assert sum(row.probability for row in explained) == pytest.approx(1.0)


def scaled(key: str, log_scale: float) -> Observable:
    return replace(observable(key, 1e-12), pressure_scale=Estimate(log_scale, 0.05))


@pytest.mark.parametrize(("log_scales", "is_scale"), [((-0.7, -0.7, -0.7), True), ((-0.7, -2.5, 0.9), False)])
def test_one_scale_of_the_pressures_explains_sizes_that_agree(
    log_scales: tuple[float, float, float], is_scale: bool
) -> None:
    """The same evidence is one faulty supply of the sensors, or a leak, another friction and another noise."""
    keys = ("volumes: leak", "levels: friction", "noise: noise of the pressures")
    changes = [scaled(key, log_scale) for key, log_scale in zip(keys, log_scales, strict=True)]
    assert (probability_of(explain(changes), "gain of the pressures") > 0.9) == is_scale
    assert (leak_probability(*changes) > 0.9) != is_scale


def test_a_scale_of_the_pressures_is_described_whatever_shows_it() -> None:
    """No other sensor fault changes the leakage, so that its words are those of this one."""
    keys = ("volumes: leak", "levels: friction", "noise: noise of the pressures")
    changes = [scaled(key, -0.7) for key in keys]
    for first in changes:
        judge = Observed("volume balance", (first, *(other for other in changes if other is not first)))
        event = Case(judge, judge.observables, HealthyNull(), 0.01).other_event
        assert event is not None and event.description == EVENTS["gain of the pressures"].description


def test_a_cause_beside_is_not_named_of_data_that_it_does_not_change() -> None:
    """The noise stepped as well: no `external leak or sensor fault` of a residual that no sensor fault explains."""
    changes = (LEAK, observable("volumes: external leak A", 1e-12), NOISE)
    event = Case(Observed("volume balance", changes), changes, HealthyNull(), 0.01).other_event
    assert event is None or (event.cause == "sensor fault" and event.observable is NOISE)


def test_a_leak_alone_is_no_scale_of_the_pressures() -> None:
    assert leak_probability(scaled("volumes: leak", -0.7)) == pytest.approx(leak_probability(LEAK), abs=0.02)


def test_a_noise_step_beside_a_leak_leaves_the_leak() -> None:
    alone, beside = leak_probability(LEAK), leak_probability(LEAK, NOISE)
    assert beside == pytest.approx(alone, abs=0.02)
    best = explain([LEAK, NOISE])[0]
    assert {event.name for event in best.events} == {"piston leak", "noise of a pressure"}


def test_data_that_no_event_moves_earn_nothing() -> None:
    before, after = explain([LEAK]), explain([LEAK, observable("weather: rain", 1e-200)])
    assert [row.probability for row in after] == pytest.approx([row.probability for row in before])


def test_three_things_that_happen_are_three_events() -> None:
    happened = [LEAK, NOISE, observable("duty: size of the duty", 1e-30, onset=20.0)]
    names = {event.name for event in explain(happened)[0].events}
    assert names == {"piston leak", "noise of a pressure", "duty"}
    assert leak_probability(*happened) > 0.5


def test_a_side_effect_that_is_clearer_than_its_event_has_another_cause() -> None:
    """A scale of the position beside a doubtful change of friction, which can change the motion as well."""
    friction, motion = observable("friction: friction", 1e-3), observable("motion: motion", 1e-8)
    doubtful = explain([friction, motion])
    assert probability_of(doubtful, "scale of the motion") > 0.9
    clear = explain([observable("friction: friction", 1e-8), motion])
    assert clear[0].events == (EVENTS["friction"],)


def test_a_step_of_the_turning_pump_s_leakage_is_a_leak() -> None:
    """Behind valves that shut at rest, a step in motion alone is that of the pump, beside a scale of the motion."""
    step = observable("volumes: pump leak while it turns", 1e-40)
    rivals = [step, observable("volumes: leak", 1e-20), observable("volumes: scale", 1e-36)]
    assert leak_probability(*rivals) > DECISION.explanation.leak


def test_a_rare_change_with_an_improbable_cause_is_by_chance() -> None:
    """Only a scale explains the motion; its odds against chance are its probability times the Bayes factor."""
    scale = EVENTS["scale of the motion"]
    for chance, happened in ((3e-4, False), (1e-8, True)):
        motion = observable("motion: motion", chance)
        explained = explain([motion])
        assert probability_of(explained, causes=[scale.cause], data_kind="motion") > 0.99
        against_chance = probability_against_chance(explained, ["sensor fault"], "motion")
        bound = log_bayes_factor(chance)
        odds = scale.probability * math.exp(bound / (1.0 + 2.0 * INFERENCE.tempering.term * bound))
        assert against_chance == pytest.approx(odds / (1.0 + odds), rel=0.1)
        assert (against_chance > DECISION.explanation.happened) == happened


def test_what_an_event_disturbs_speaks_for_it_only_where_it_shows_itself() -> None:
    ringing = observable("details: rise of d3 of p_A", 1e-9)
    friction = observable("levels: friction", 1e-9)
    assert probability_of(explain([ringing]), "friction") < 2.0 * EVENTS["friction"].probability
    assert probability_of(explain([ringing, friction]), "friction") > 0.5
    later = observable("details: rise of d3 of p_A", 1e-9, onset=90.0)
    together, apart = (
        next(row for row in explain([friction, own]) if [event.name for event in row.events] == ["friction"])
        for own in (ringing, later)
    )
    assert together.data == {"levels", "details"}
    assert together.probability > 100.0 * apart.probability


def test_air_that_shows_itself_also_explains_the_ringing_and_the_charge_pressure() -> None:
    """Oil with air rings at another pitch, and raises the pressure of a closed circuit."""
    side_effects = [
        observable("details: rise of d4 of p_A", 1e-16),
        observable("noise of details: rise of d4 of p_A", 1e-16),
        observable("levels: what feeds both chambers", 1e-10),
    ]
    best = explain([observable("volumes: free air", 1e-16), *side_effects])[0]
    assert [event.name for event in best.events] == ["air"]
    assert not explain(side_effects)[0].has(["air"])


def test_rivals_of_the_same_data_are_not_added_up() -> None:
    """Two descriptions of one residual are one: a second one as good adds nothing to the first."""
    twice = [LEAK, observable("volumes: leak through an orifice", LEAK.chance)]
    assert leak_probability(*twice) == pytest.approx(leak_probability(LEAK))


def test_the_likelier_of_two_rivals_is_the_more_probable() -> None:
    for data, first, second in (
        ("volumes", "leak", "pump leak"),
        ("levels", "zero of p_A", "zero of p_B"),
        ("levels", "zero of p_A", "friction"),
    ):
        ratios = []
        for chance in (1e-9, 1e-12, 1e-15):
            explained = explain([observable(f"{data}: {first}", chance), observable(f"{data}: {second}", 1e-9)])
            ratios.append(
                probability_of(explained, *(e for e in EVENTS if EVENTS[e].changes(explained_by(data, first), "moves")))
            )
        assert ratios == sorted(ratios)


def test_healthy_recordings_do_not_set_terms_of_one_residual_apart() -> None:
    """A healthy step of the leak's coefficient makes steps rarer news, but tells nothing on which term has stepped."""
    leak, rival = observable("volumes: leak", 1e-12), observable("volumes: external leak B", 1e-10)
    calibrated = {leak: 1e-4, rival: 1e-5}
    by_likelihood = explain([leak, rival])
    after_healthy_step = explain([leak, rival], calibrated.__getitem__)
    for explained in (by_likelihood, after_healthy_step):
        assert probability_of(explained, *LEAK_EVENTS, data_kind="volumes") > 0.5


def explained_by(data: str, name: str) -> object:
    return observable(f"{data}: {name}", 0.5)


def test_a_leak_within_and_one_against_healthy_recordings_are_one() -> None:
    """A rise as large as the step makes is the same leak; none at all speaks against a step of that size."""
    rises = [Rise(value, 1.0, 30.0) for value in (6.0, 0.0)]
    rival = observable("volumes: zero of the flow", LEAK.chance)
    with_rise, without = (
        probability_of(
            explain([LEAK, rival], rise=LeakRise(rise, rise.log_ratio(6.0))), *LEAK_EVENTS, data_kind="volumes"
        )
        for rise in rises
    )
    assert with_rise > leak_probability(LEAK, rival) > without
    ratio = rises[0].log_ratio(6.0)
    assert ratio == pytest.approx(float(student.logpdf(0.0, 30) - student.logpdf(6.0, 30)))


def test_a_leak_from_the_start_shows_by_its_rise_alone() -> None:
    explained = explain([], rise=LeakRise(Rise(12.0, 1.0, 30.0)))
    assert probability_of(explained, *LEAK_EVENTS) > 0.95


def test_a_step_that_later_holds_contradict_is_no_leak() -> None:
    """What moves its data is another event then, and the leak does not borrow them from its other way to happen."""
    rival = observable("volumes: free air", 0.02)
    for rise, is_likely in ((Rise(0.0, 1.0, 30.0), False), (Rise(40.0, 1.0, 30.0), True)):
        explained = explain([LEAK, rival], rise=LeakRise(rise, rise.log_ratio(40.0)))
        assert (probability_of(explained, *LEAK_EVENTS, data_kind="volumes") > 0.5) == is_likely


def test_two_causes_that_the_data_cannot_separate_are_named_together() -> None:
    """A pressure that falls near the charge pressure, of a recording in which the other never comes near it."""
    falls = [observable("drift: fall of the charge pressure", 1e-8), observable("drift: drift of low p_A", 1e-8)]
    event = Case(Observed("test", observables=tuple(falls)), falls, HealthyNull(), 0.01).other_event
    assert event is not None and event.cause == "external leak or sensor fault"
    assert event.description == "the external leakage on side A or the zero of p_A"
    assert state_of("no change", event.cause).name == "maintenance required"
    clear = [falls[0], observable("drift: drift of low p_A", 1e-3)]
    event = Case(Observed("test", observables=tuple(clear)), clear, HealthyNull(), 0.01).other_event
    assert event is not None and event.cause == "external leak"
