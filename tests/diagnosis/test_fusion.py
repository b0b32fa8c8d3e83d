"""One verdict from many: who judges, what others lend, what is said where they differ."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.evidence import Cause, Evidence, LeakCourse, MethodResult, Verdict
from sealscope.diagnosis.verdict.fusion import ORDER, Said, alarmed, fuse, passes
from sealscope.diagnosis.verdict.next_check import next_check

LEAK = Evidence("leak", "it leaks", 9.0, 3.0)
NONE = Evidence("no leak", "it does not", 1.0, 3.0)
UNFIT = Evidence("cannot tell", "the model does not fit")
DRIFT = Evidence("cannot tell", "a drift and a leak look alike", 9.0, 3.0)
COURSE = LeakCourse(np.arange(3.0), np.ones(3), np.zeros(3), np.full(3, 2.0))
BALANCE, MODEL, OBSERVER, RMS = ORDER


def fused(**said: Evidence):  # type: ignore[no-untyped-def]
    """Of detectors named by keyword, `_` for a blank, in the order given."""
    return fuse([Said(name.replace("_", " "), one) for name, one in said.items()])


def test_the_most_specific_with_a_verdict_judges_whatever_the_order() -> None:
    said = [Said(RMS, LEAK), Said("my own", LEAK), Said(OBSERVER, LEAK), Said(BALANCE, NONE), Said(MODEL, LEAK)]
    for turn in (said, said[::-1]):
        found = fuse(turn)
        assert (found.judge, found.evidence.verdict, found.evidence.score) == (BALANCE, "no leak", 1.0)
        assert [one.name for one in found.methods][:4] == [BALANCE, MODEL, OBSERVER, RMS]
    assert fused(my_own=LEAK, rms_change=UNFIT).judge == "my own"


def test_the_word_is_passed_where_nothing_was_seen_and_kept_where_something_was() -> None:
    assert fused(volume_balance=UNFIT, rms_change=LEAK).judge == RMS
    kept = fused(volume_balance=DRIFT, rms_change=LEAK)
    assert (kept.judge, kept.evidence.verdict) == (BALANCE, "cannot tell")
    named = replace(UNFIT, cause="sensor fault")
    assert fused(volume_balance=named, rms_change=LEAK).evidence.cause == "sensor fault"
    assert passes(UNFIT)
    assert passes(replace(DRIFT, score=2.0))
    assert not passes(NONE)
    assert alarmed(DRIFT)


def test_a_detector_that_could_not_look_is_told_and_never_judges() -> None:
    found = fuse([Said(BALANCE, Evidence("cannot tell", "needs theta"), usable=False), Said(RMS, NONE)])
    assert (found.judge, found.evidence.reason) == (RMS, "it does not")
    assert MethodResult(BALANCE, None, None, "cannot tell", "needs theta") in found.methods


def test_nobody_judges() -> None:
    needs = [Said(name, Evidence("cannot tell", f"{name} needs more"), usable=False) for name in ORDER]
    assert fuse(needs).judge is None
    assert fuse(needs).evidence == Evidence("cannot tell", "rms change needs more")
    both = fused(volume_balance=UNFIT, rms_change=Evidence("cannot tell", "too short"))
    assert both.evidence.reason == "volume balance: the model does not fit; rms change: too short"
    assert fused(rms_change=UNFIT).evidence == UNFIT
    assert fuse([]).evidence.verdict == "cannot tell"


def test_a_leak_gets_from_others_what_the_judge_lacks() -> None:
    timed = replace(LEAK, onset_s=90.0, onset_interval_s=(88.0, 92.0))
    sized = replace(LEAK, leak_lpm=0.004, leak_interval_lpm=(0.003, 0.005), course=COURSE)
    found = fused(pressure_model=LEAK, observer=sized, rms_change=timed).evidence
    assert (found.onset_s, found.onset_interval_s) == (90.0, (88.0, 92.0))
    assert (found.leak_lpm, found.leak_interval_lpm, found.course) == (0.004, (0.003, 0.005), COURSE)
    assert found.reason == "it leaks; onset from rms change; L/min from observer"
    assert (found.score, found.threshold) == (LEAK.score, LEAK.threshold)
    own = replace(timed, onset_s=70.0, onset_interval_s=None)
    assert fused(volume_balance=own, rms_change=timed).evidence.onset_interval_s is None  # not another's interval
    disagreeing = replace(NONE, leak_lpm=0.001, onset_s=3.0)
    assert fused(pressure_model=LEAK, rms_change=disagreeing).evidence.leak_lpm is None


def test_no_leak_keeps_its_own_bound_and_dates_nothing() -> None:
    bound = replace(NONE, leak_lpm=1e-5, leak_interval_lpm=(-1e-4, 1e-4), onset_s=5.0, onset_interval_s=(4.0, 6.0))
    found = fused(volume_balance=bound, rms_change=replace(LEAK, onset_s=90.0, leak_lpm=0.1)).evidence
    assert (found.leak_lpm, found.onset_s, found.onset_interval_s) == (1e-5, None, None)


def test_disagreement_is_said() -> None:
    assert fused(volume_balance=LEAK, rms_change=NONE).evidence.reason == (
        "it leaks; rms change sees no leak (score 1, threshold 3)"
    )
    assert "rms change sees a change like a leak's" in fused(volume_balance=NONE, rms_change=LEAK).evidence.reason
    rubbing = replace(NONE, cause="friction change", score=5.0)
    found = fused(volume_balance=NONE, pressure_model=rubbing, rms_change=LEAK).evidence
    assert (found.verdict, found.cause) == ("no leak", "friction change")
    assert "pressure model takes the change for friction change" in found.reason
    leaking = fused(volume_balance=LEAK, pressure_model=rubbing).evidence
    assert (leaking.verdict, leaking.cause) == ("leak", None)  # the judge's word stands
    assert fused(volume_balance=LEAK, rms_change=LEAK).evidence.reason == "it leaks"


EVIDENCE = st.builds(
    Evidence,
    st.sampled_from(get_args(Verdict)),
    st.just("why"),
    st.none() | st.floats(-10, 10),
    st.none() | st.floats(-10, 10),
    st.none() | st.floats(0, 180),
    leak_lpm=st.none() | st.floats(0, 1),
    cause=st.none() | st.sampled_from(get_args(Cause)),
)
NAMES = st.lists(st.sampled_from([*ORDER, "mine", "yours"]), unique=True, max_size=6)


@given(data=st.data())
def test_the_verdict_is_one_detector_s_own(data: st.DataObject) -> None:
    """Whatever the evidence: verdict, score and threshold are the judge's, so that the rate is; one line; all told."""
    said = [Said(name, data.draw(EVIDENCE), data.draw(st.booleans())) for name in data.draw(NAMES)]
    found = fuse(said)
    assert "\n" not in found.evidence.reason
    assert sorted(one.name for one in found.methods) == sorted(one.name for one in said)
    if found.judge is None:
        assert found.evidence.verdict == "cannot tell"
        assert all(passes(one.evidence) for one in said if one.usable)
        return
    judge = next(one for one in said if one.name == found.judge)
    for name in ("verdict", "score", "threshold"):
        assert getattr(found.evidence, name) == getattr(judge.evidence, name)
    assert found.methods[0].name == found.judge
    if found.evidence.verdict != "leak":
        assert found.evidence.onset_s is None


def test_all_detectors_together_on_the_thesis_s_smallest_leak(records) -> None:  # type: ignore[no-untyped-def]
    """0.0042 L/min from second 90 is found and dated; without it there is none. Seen through any channels."""
    for names, seeds in ((None, range(2)), (["u", "p_A", "p_B"], range(1))):
        for seed in seeds:
            leaky = records(seed, leak="0.0042 L/min from 90 s", throttled=True)
            found = diagnose(leaky if names is None else leaky.only(names))
            assert found.verdict == "leak", found.reason
            assert found.cause in ("piston leak", "piston or pump leak"), found.reason
            assert found.onset_s == pytest.approx(90.0, abs=10.0)
            sound = records(seed + 50, throttled=True)
            free = diagnose(sound if names is None else sound.only(names))
            assert free.verdict != "leak", free.reason


@pytest.mark.parametrize("cause", get_args(Cause))
def test_every_cause_has_its_check(cause: Cause) -> None:
    texts = {next_check("no leak", one) for one in get_args(Cause)}
    assert len(texts) == len(get_args(Cause))
    assert "\n" not in next_check("leak", cause)
    assert len({next_check(verdict, None) for verdict in get_args(Verdict)}) == 3
