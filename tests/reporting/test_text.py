"""The sentences of page and terminal."""

from __future__ import annotations

import pytest

from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.verdict.severity import state_of
from sealscope.recordings.quality import Finding
from sealscope.reporting import messages
from sealscope.reporting.messages import diagnosis_text

from ..wording import says


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (0, "0"),
        (0.0042, "0.0042"),
        (0.0099999, "0.01"),
        (-3.14159, "−3.14"),
        (8123.4, "8123"),
        (123456.0, "123456"),
        (1e-9, "1e−09"),
    ],
)
def test_numbers_are_short_and_without_needless_exponents(value, shown):
    assert messages.number(value) == shown


def test_times_beyond_an_hour_are_shown_as_a_clock_too():
    assert messages.clock(91.26) == "91.3 s"
    assert messages.clock(7325.0) == "7325.0 s (2:02:05)"
    assert messages.clock(0.06) == "0.06 s"
    assert messages.clock(None) == "–"


def test_a_leak_in_words(make_diagnosis):
    text = diagnosis_text(make_diagnosis())
    first, *rest = text.splitlines()
    flat = " ".join(" ".join(rest).split())
    assert first == "bench/log_17.csv: leak"
    assert says(flat, "since.interval", onset="20.4 s", low="18.5 s", high="21.8 s")
    assert says(flat, "how_much.interval", leak="0.00421", low="0.0031", high="0.0057")
    assert says(flat, "how_sure.score", odds="", score="5.44", relation="over", threshold="3.22")
    assert says(flat, "how_sure.share", share="0.1 % (1 in 1000)")
    assert "details: leak (score 5.44, threshold 3.22)" in flat
    assert says(flat, "next.rule_out", faults="clipped (p_1)")
    assert max(map(len, text.splitlines())) <= 100


def test_no_leak_claims_no_onset_and_no_flow(make_diagnosis):
    text = diagnosis_text(make_diagnosis(verdict="no leak", score=1.5, onset_s=None, leak_lpm=None, quality=()))
    assert "since" not in text and "L/min" not in text
    assert "not over the threshold" in text and "baseline" in text


def test_no_leak_says_how_large_one_could_be(make_diagnosis):
    bound = {"verdict": "no leak", "score": 1.5, "onset_s": None, "leak_lpm": None, "bound_lpm": 1e-4}
    assert messages.how_much(make_diagnosis(**bound)) == "none above 0.0001 L/min (95 % bound)"


def test_a_different_cause_is_stated_with_what_to_check(make_diagnosis):
    check = state_of("no change", "friction change").action
    result = make_diagnosis(
        verdict="no leak", score=1.5, onset_s=None, leak_lpm=None, cause="friction change", quality=()
    )
    text = " ".join(diagnosis_text(result).split())
    assert "cause friction change" in text
    assert f"next {check}" in text
    assert messages.headline(result) == "Friction change (no leak across the piston)"
    leak = make_diagnosis(cause="piston leak", quality=())
    assert messages.headline(leak) == "Leak: oil bypasses the piston"
    assert messages.next_steps(leak)[0] == state_of("leak", "piston leak").action
    assert messages.next_steps(make_diagnosis(cause="friction change", quality=()))[0] != check


def test_a_method_without_a_score_says_why(no_verdict, make_diagnosis):
    balance = Evidence("cannot tell", "needs theta", detector="volume balance")
    text = diagnosis_text(make_diagnosis(parts=(balance,)))
    assert "volume balance: cannot tell (needs theta)" in text


def test_a_leak_since_before_the_recording_and_of_unknown_size(make_diagnosis):
    text = diagnosis_text(make_diagnosis(onset_s=None, onset_interval_s=None, leak_lpm=None, leak_interval_lpm=None))
    assert says(text, "since.whole") and says(text, "how_much.channels")
    refused = make_diagnosis(leak_lpm=None, leak_interval_lpm=None, refuses=frozenset({"leak_lpm"}))
    assert messages.how_much(refused) == messages.say("how_much.reason")


def test_all_that_may_be_none_may_be_none(no_verdict):
    text = diagnosis_text(no_verdict)
    assert text.startswith("bench/log_17.csv: cannot tell")
    assert says(text, "how_sure.no_score") and "None" not in text and "nan" not in text


def test_control_characters_of_a_file_name_do_not_reach_the_terminal(make_diagnosis):
    text = diagnosis_text(make_diagnosis(file="a\x1b[31m\nb.csv", reason="bad\x07"))
    assert "\x1b" not in text and "\x07" not in text
    assert text.splitlines()[0].endswith("b.csv: leak")


@pytest.mark.parametrize(
    ("p", "shown"), [(0.05, "5 % (1 in 20)"), (1e-5, "0.001 % (1 in 100000)"), (0.4, "(1 in 2.5)")]
)
def test_false_alarm_rates_in_words(make_diagnosis, p, shown):
    assert shown in messages.false_alarms(make_diagnosis(false_alarm_probability=p))


def test_a_healthy_recording_left_out_as_its_own_baseline_is_no_fault_of_its_data(make_diagnosis):
    """Each file of the healthy folder is judged against the others."""
    left_out = Finding("baseline_left_out", "warning", None, 1, None, "1 of 7 baseline recordings is left out")
    healthy = {"verdict": "no leak", "score": 1.5, "onset_s": None, "leak_lpm": None}
    with_it, without = (make_diagnosis(**healthy, quality=quality) for quality in ((left_out,), ()))
    assert messages.next_steps(with_it) == messages.next_steps(without)
