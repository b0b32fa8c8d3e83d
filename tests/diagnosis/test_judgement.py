"""One verdict from many: who judges, and what is said where others differ."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import pytest

from sealscope.diagnosis.inference.other_steps.step import OtherStep
from sealscope.diagnosis.judgement import ORDER, combined, deciding
from sealscope.diagnosis.verdict.evidence import RMS_CHANGE, Evidence

LEAK = Evidence("leak", "it leaks", 9.0, 3.0, onset_s=40.0)
NONE = Evidence("no leak", "it does not", 1.0, 3.0)
UNFIT = Evidence("cannot tell", "the model does not fit")
UNUSABLE = Evidence("cannot tell", "needs x", usable=False)
FRICTION = OtherStep("friction change", "the pressures step as of friction", 100.0, 40.0, 5.0)
BALANCE, RESPONSE = ORDER[0], "pressure response"


def of(**evidences: Evidence) -> list[Evidence]:
    return [replace(own, detector=name.replace("_", " ")) for name, own in evidences.items()]


def test_the_first_with_a_verdict_judges_in_any_order() -> None:
    evidences = of(rms_change=LEAK, pressure_response=LEAK, volume_balance=NONE, my_own=LEAK)
    for turn in permutations(evidences):
        verdict = combined(turn)
        assert (verdict.detector, verdict.verdict, verdict.score) == (BALANCE, "no leak", 1.0)
        assert [own.detector for own in verdict.parts] == [BALANCE, RESPONSE, "my own", RMS_CHANGE]
    assert combined(of(volume_balance=UNFIT, pressure_response=LEAK, rms_change=NONE)).detector == RESPONSE


@pytest.mark.parametrize("own", [LEAK, NONE, replace(NONE, cause="air in the oil")])
def test_nothing_changes_what_a_balance_says(own: Evidence) -> None:
    evidences = of(volume_balance=own, pressure_response=LEAK, rms_change=LEAK)
    verdict = combined(evidences, None if own is NONE else FRICTION)
    assert (verdict.verdict, verdict.cause, verdict.score) == (own.verdict, own.cause, own.score)


def test_what_stepped_beside_is_the_cause_where_nothing_leaks() -> None:
    assert combined(of(volume_balance=NONE), FRICTION).cause == "friction change"
    assert combined(of(volume_balance=LEAK), FRICTION).cause is None


def test_the_change_of_rms_judges_only_where_no_other_can() -> None:
    assert deciding(of(volume_balance=UNFIT, rms_change=LEAK)) is None
    alone = of(volume_balance=UNUSABLE, rms_change=LEAK)
    assert (combined(alone).verdict, combined(alone).onset_s) == ("leak", 40.0)
    doubted = combined(alone, FRICTION)
    assert (doubted.verdict, doubted.cause, doubted.onset_s) == ("cannot tell", "friction change", None)
    assert combined(of(rms_change=NONE)).verdict == "no leak"


def test_no_leak_needs_the_whole_recording_and_the_baseline_that_was_asked_for() -> None:
    assert combined(of(volume_balance=NONE), refusal="another machine").verdict == "cannot tell"
    assert combined(of(volume_balance=LEAK), refusal="another machine").verdict == "leak"
    assert combined(of(volume_balance=replace(NONE, share=0.9))).verdict == "cannot tell"
    assert combined(of(volume_balance=replace(LEAK, share=0.9))).verdict == "leak"


def test_nobody_judges() -> None:
    assert combined([]).verdict == "cannot tell"
    assert combined(of(volume_balance=UNUSABLE, rms_change=replace(UNUSABLE, reason="needs p_A"))).reason == "needs p_A"
    assert combined(of(volume_balance=UNFIT, rms_change=NONE)).reason == UNFIT.reason
