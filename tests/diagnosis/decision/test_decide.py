"""The one decision: monotone in the leak, bounds that cover what may be, one probability, and its three words."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.decision.case import AGAINST, LEVEL, WITHIN, Case, HealthyNull
from sealscope.diagnosis.decision.decide import decide
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.inference.comparison import Rise
from sealscope.diagnosis.inference.observable import LeakMeasure, Observable, Observed
from sealscope.diagnosis.verdict.evidence import Evidence

from .cases import DRIVING, LITRES, measured_leak, observable, step

ALLOWED = 0.01
SOURCE = Path(__file__).resolve().parents[3] / "src" / "sealscope" / "diagnosis"


def report_of(leak: LeakMeasure, *rivals: Observable) -> Observed:
    """Report a leak's step as an observable, and others of the same balance beside it."""
    tests = [] if leak.step is None else [Observable.from_test("leak", "volumes", leak.step)]
    return Observed("volume balance", (*tests, *rivals), leak)


def judge_leak(
    leak: LeakMeasure, *rivals: Observable, null: HealthyNull | None = None, also: Sequence[Observable] = ()
) -> Evidence:
    report = report_of(leak, *rivals)
    return decide(report, [Observed("signals", tuple(also))], null or HealthyNull(), ALLOWED)


def case_of(leak: LeakMeasure, *rivals: Observable) -> Case:
    report = report_of(leak, *rivals)
    return Case(report, report.observables, HealthyNull(), ALLOWED)


@pytest.mark.parametrize(
    "rivals", [(), ("volumes: scale",), ("volumes: external leak A", "volumes: loss to the outside")]
)
def test_a_larger_step_is_never_less_of_a_leak(rivals: tuple[str, ...]) -> None:
    """Rivals that describe the same residual a hundred times worse."""
    leaks = []
    for size in (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 64.0):
        leak = measured_leak(step(size))
        beside = [observable(name, min(1.0, 1e2 * leak.step.chance)) for name in rivals]
        leaks.append(judge_leak(leak, *beside).verdict == "leak")
    assert leaks == sorted(leaks)
    assert leaks[-1] and not leaks[0]


@pytest.mark.parametrize("surprisals", [(), (1.0, 0.5), (3.0, 4.0, 2.0)])
def test_a_rarer_healthy_machine_asks_for_more(surprisals: tuple[float, ...]) -> None:
    null = HealthyNull({"volume balance: step": surprisals, "volumes: leak": surprisals})
    leaks = [judge_leak(measured_leak(step(size)), null=null) for size in (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)]
    verdicts = [leak.verdict == "leak" for leak in leaks]
    assert verdicts == sorted(verdicts) and verdicts[-1]
    for leak in leaks:
        assert (leak.score > leak.threshold) == (leak.chance < ALLOWED)


def test_the_onset_of_a_rise_is_stated_where_something_dates_it() -> None:
    for onset in (None, Interval(50.0, 45.0, 55.0)):
        evidence = judge_leak(measured_leak(rise=Rise(20.0, 1.0, np.inf), rise_onset=onset))
        assert evidence.verdict == "leak"
        assert evidence.onset_s == (None if onset is None else onset.value)
        assert evidence.onset_interval_s == (None if onset is None else (onset.low, onset.high))


@pytest.mark.parametrize(("rise", "begins_within"), [(4.0, True), (60.0, False)])
def test_a_rise_that_no_step_makes_is_older_than_the_recording(rise: float, begins_within: bool) -> None:
    """A step of 8 half-way raises the mean by 4; a rise of 60 was there from the start, whatever else stepped."""
    evidence = judge_leak(measured_leak(step(8.0), rise=Rise(rise, 1.0, 30.0)))
    assert evidence.verdict == "leak"
    assert (evidence.onset_s is not None) == begins_within


def test_a_noise_step_changes_neither_verdict_nor_size_nor_onset() -> None:
    """3 leaks of 60 passed for none above a tenth of them where the noise of the pressures had stepped by 4 %."""
    leak = measured_leak(step(8.0))
    alone = judge_leak(leak)
    for key in ("noise: noise of the pressures", "hum: hum of 50 Hz", "levels: zero of p_B", "duty: size of the duty"):
        beside = judge_leak(leak, also=[observable(key, 1e-60)])
        assert (beside.verdict, beside.leak_lpm, beside.onset_s) == (alone.verdict, alone.leak_lpm, alone.onset_s)
    assert alone.verdict == "leak"


@pytest.mark.parametrize("factor", [1e3, 1.0, 1e-3, 1e-6, 1e-9])
def test_a_leak_that_may_be_is_below_the_bound(factor: float) -> None:
    """Whatever competes: the verdict is `leak`, or the step is within the bound, or it has less than 5 %."""
    leak = measured_leak(step(4.0))
    rival = observable("volumes: external leak A", min(1.0, factor * leak.step.chance))
    evidence, case = judge_leak(leak, rival), case_of(leak, rival)
    (alarm,) = case.alarms
    if evidence.verdict != "leak" and case.leak_probability(alarm) > 0.05:
        assert evidence.bound_lpm is not None
        assert evidence.bound_lpm >= leak.step_flow.value * LITRES
    assert evidence.verdict == "leak" or factor < 1.0


def test_the_bound_is_no_larger_than_what_would_have_shown_where_nothing_did() -> None:
    leak = measured_leak(step(0.0))
    evidence = judge_leak(leak)
    assert evidence.verdict == "no leak"
    assert evidence.bound_lpm == pytest.approx(leak.bound_flow * LITRES)


def test_a_bound_that_nobody_could_use_is_no_verdict() -> None:
    evidence = judge_leak(measured_leak(step(0.0), bound_flow=5e-5))
    assert evidence.verdict == "cannot tell"
    assert evidence.bound_lpm == pytest.approx(5e-5 * LITRES)


@pytest.mark.parametrize(
    ("values", "names"),
    [
        ({"step": True}, (WITHIN,)),
        ({"step": True, "rise": Rise(0.0, 1.0, 20.0)}, (WITHIN, AGAINST)),
        ({"step": True, "excess": -3.0}, (WITHIN, LEVEL)),
        ({"rise": Rise(0.0, 1.0, 20.0)}, (AGAINST,)),
        ({"excess": -3.0}, (LEVEL,)),
    ],
)
def test_questions_share_the_probability(values: dict[str, object], names: tuple[str, ...]) -> None:
    given = {**values, "step": step(0.0)} if "step" in values else values
    questions = case_of(measured_leak(**given)).tests  # type: ignore[arg-type]
    assert tuple(question.name for question in questions) == names
    assert sum(question.probability for question in questions) == pytest.approx(ALLOWED)
    for question in questions:
        assert (question.score > question.threshold) == (question.chance < question.probability)


def test_a_rise_alone_is_a_leak_without_an_onset() -> None:
    evidence = judge_leak(measured_leak(step(0.0), rise=Rise(40.0, 2.0, 20.0)))
    assert (evidence.verdict, evidence.onset_s) == ("leak", None)
    assert evidence.leak_lpm == pytest.approx(40.0 * DRIVING * LITRES)
    assert [part.verdict for part in evidence.parts] == ["no leak", "leak"]


def test_a_method_judges_by_its_own_rule() -> None:
    """The thesis's calls a leak whatever else changed; weighed, friction explains it as well."""
    fall = observable("details: fall of d3 of p_A", 1e-6)
    friction = observable("levels: friction", 1e-30)
    report, signals = Observed("rms change", (fall,)), Observed("signals", (friction,))
    verdicts = {
        weigh_rivals: decide(
            report,
            [signals],
            HealthyNull(),
            ALLOWED,
            weigh_rivals,
        ).verdict
        for weigh_rivals in (True, False)
    }
    assert verdicts == {True: "cannot tell", False: "leak"}


@pytest.mark.parametrize("chance", [0.05, 0.006, 0.003, 1e-9])
def test_healthy_recordings_move_score_and_chance_alike(chance: float) -> None:
    null = HealthyNull({"details: against": [1.0, 0.2, 0.0, 0.4]})
    report = Observed("rms change", (observable("details: fall of d3 of p_A", chance, onset=None),))
    evidence = decide(report, (), null, ALLOWED, weigh_rivals=False)
    assert (evidence.score > evidence.threshold) == (evidence.chance < ALLOWED) == (evidence.verdict == "leak")


def test_a_leak_makes_the_ringing_fall() -> None:
    for way, verdict in (("fall", "leak"), ("rise", "cannot tell")):
        report = Observed("rms change", (observable(f"details: {way} of d3 of p_A", 1e-9),))
        assert decide(report, (), HealthyNull(), ALLOWED, weigh_rivals=False).verdict == verdict


def test_what_cannot_be_observed_is_said() -> None:
    evidence = decide(Observed("volume balance", lack="needs x"), (), HealthyNull(), ALLOWED)
    assert (evidence.verdict, evidence.reason, evidence.usable) == ("cannot tell", "needs x", False)


def test_what_happened_is_named_only_where_it_is_sure() -> None:
    sure = judge_leak(measured_leak(step(0.0)), also=[observable("noise: noise of the pressures", 1e-40)])
    assert (sure.verdict, sure.cause) == ("no leak", "sensor fault")
    alike = [observable("levels: friction", 1e-12), observable("levels: load", 1e-12)]
    assert judge_leak(measured_leak(step(0.0)), also=alike).cause is None


#: Files of the diagnosis that may hold a verdict's words as a constant: the types, and the one decision.
WORDS = {"leak", "no leak", "cannot tell"}
DECISION = {"verdict/evidence.py", "decision/decide.py", "decision/case.py"}
#: "leak" as the name of a term, a column, a table of texts or a prior.
NAMES = {
    "decision/decide.py",
    "inference/block_stream.py",
    "inference/blocks.py",
    "inference/comparison/recording_sums.py",
    "inference/equations/balances.py",
    "inference/equations/terms.py",
    "live/explanation.py",
    "live/watch.py",
}
#: Files that make evidence.
MAKERS = {"decision/decide.py"}


@cache
def tree_of(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def constants(path: Path) -> set[str]:
    """Collect the string constants of a file, its docstrings left out."""
    tree = tree_of(path)
    bodies = [node.body for node in ast.walk(tree) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
    texts = {id(body[0].value) for body in bodies if body and isinstance(body[0], ast.Expr)}
    found = (node for node in ast.walk(tree) if isinstance(node, ast.Constant) and id(node) not in texts)
    return {node.value for node in found if isinstance(node.value, str)}


def calls(path: Path, name: str) -> bool:
    tree = tree_of(path)
    return any(isinstance(node, ast.Call) and getattr(node.func, "id", "") == name for node in ast.walk(tree))


def test_verdicts_stand_in_one_place() -> None:
    holding = {path.relative_to(SOURCE).as_posix(): constants(path) & WORDS for path in SOURCE.rglob("*.py")}
    found = {name for name, words in holding.items() if words - ({"leak"} if name in NAMES else set())}
    assert found - DECISION == set()


def test_evidence_is_made_in_one_place() -> None:
    making = {path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if calls(path, "Evidence")}
    assert making == MAKERS


def test_scores_are_finite_for_any_chance() -> None:
    for chance in (1.0, 0.5, 1e-300, np.finfo(float).tiny):
        evidence = decide(Observed("mine", (observable("plug-in: mine", chance),)), (), HealthyNull(), ALLOWED)
        assert np.isfinite([evidence.score, evidence.threshold, evidence.chance]).all()


@pytest.mark.parametrize(
    ("likelihood_ratio", "cause"),
    [(1.0, "piston, pump or external leak"), (1e-3, "piston or pump leak")],
)
def test_the_outside_is_named_unless_the_data_exclude_it(likelihood_ratio: float, cause: str) -> None:
    """Rivals that describe the residual as well as the leak, and a thousand times worse."""
    leak = measured_leak(step(8.0))
    chance = leak.step.chance / likelihood_ratio
    outside = [observable(f"volumes: external leak {side}", chance) for side in "AB"]
    evidence = judge_leak(leak, *outside)
    assert (evidence.verdict, evidence.cause) == ("leak", cause)


@pytest.mark.parametrize(
    ("ratio", "verdict", "cause"),
    [
        (0.1, "leak", "piston or pump leak"),
        (3.0, "leak", "piston, pump or external leak"),
        (30.0, "leak", "piston, pump or external leak"),
        (1e3, "no leak", "external leak"),
    ],
)
def test_oil_that_leaks_inside_or_outside_is_a_leak_until_one_of_them_is_sure(
    ratio: float, verdict: str, cause: str
) -> None:
    """With a likelihood ratio of 30 it is outside by three to one, which is too little to exclude the piston."""
    leak = measured_leak(step(8.0))
    outside = [observable(f"volumes: external leak {side}", leak.step.chance / ratio) for side in "AB"]
    evidence = judge_leak(leak, *outside)
    assert (evidence.verdict, evidence.cause) == (verdict, cause)
