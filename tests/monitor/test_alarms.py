"""An alarm's life: thresholds, debounce and hysteresis, and what a person says of it."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from sealscope.diagnosis.live.estimates import BlockEstimate, WatchedLeak
from sealscope.errors import InputError
from sealscope.monitor.alarms import MARKS, AlarmJudge
from sealscope.monitor.database import tables
from sealscope.monitor.database.store import MonitorStore, StoredRows
from sealscope.monitor.outputs.events import EventLines
from sealscope.monitor.settings import WatchSettings
from sealscope.storage.plain_state import restore
from sealscope.storage.plain_values import to_plain

SETTINGS = WatchSettings(warning_lpm=0.002, error_lpm=0.01, debounce_blocks=2, return_share=0.5)
LEAK = WatchedLeak(
    10.0, 9.0, (8.0, 10.0), 0.003, (0.002, 0.004), 1e-13, 5e-13, 1e-15, 1e5, "step", "pump leak", "it rises", 50.0, 28.0
)


def through(
    judge: AlarmJudge, flows: list[float | None], leak: WatchedLeak | None = LEAK, settings: WatchSettings = SETTINGS
) -> list[str]:
    """What happens as blocks of these flows follow each other."""
    happened = []
    for number, lpm in enumerate(flows):
        interval = None if lpm is None else (lpm, lpm)
        change = judge.update(
            BlockEstimate(number, 3.0 * number, "alarm", lpm, interval, lpm, interval), leak, 1, settings, 1.0
        )
        if change is not None and change[1]:
            happened.append(change[1])
    return happened


def test_the_cause_of_an_alarm_follows_that_of_the_leak():
    judge = AlarmJudge("a")
    through(judge, [0.003, 0.003])
    check = judge.alarm.next_check
    through(judge, [0.003], replace(LEAK, cause="external leak"))
    assert judge.alarm.cause == "external leak"
    assert judge.alarm.next_check != check


def test_one_block_is_no_alarm_two_are():
    judge = AlarmJudge("a")
    assert through(judge, [0.003, 0.001, 0.003, 0.001]) == []
    assert through(judge, [0.003, 0.003]) == ["raised"]
    assert judge.alarm is not None
    assert (judge.alarm.level, judge.alarm.as_dict()["diagnostic_number"]) == ("warning", 4101)
    assert "case drain" in judge.alarm.next_check


def test_stronger_evidence_is_rarer_by_chance():
    """At the threshold it is the stated rate, then less, by the normal tail where the score is a level's."""

    def chance(test: str, score: float) -> float:
        leak = replace(LEAK, test=test, score=score, threshold=4.0)
        block, judge = BlockEstimate(1, 3.0, "alarm"), AlarmJudge("a")
        alarm, _ = judge.update(block, leak, 1, WatchSettings(debounce_blocks=1), 2.0)
        return alarm.by_chance_per_1000_h

    assert chance("step", 4.0) == chance("level", 4.0) == 2.0
    assert chance("level", 5.0) == pytest.approx(2.0 * ndtr(-5.0) / ndtr(-4.0))
    assert chance("step", 7.0) == pytest.approx(2.0 * np.exp(-1.5))  # half the score is the logarithm of an e-value
    assert chance("step", 1e4) == chance("level", 1e4) == pytest.approx(2e-9)


def test_it_returns_well_below_its_threshold():
    judge = AlarmJudge("a")
    assert through(judge, [0.003] * 3 + [0.0015] * 20) == ["raised"]
    assert through(judge, [0.0009, 0.0011, 0.0009]) == []
    assert through(judge, [0.0009]) == ["returned"]
    assert judge.alarm is not None and (judge.alarm.state, judge.alarm.active) == ("new", False)
    assert judge.alarm.status_word == 4
    assert judge.apply_mark("acknowledged", 100.0).state == "closed"
    assert judge.alarm is None


def test_what_rises_again_before_anybody_saw_it_is_the_same_alarm():
    judge = AlarmJudge("a")
    through(judge, [0.003] * 2)
    judge.apply_mark("shelved", 3.0, until=1e4)
    assert through(judge, [0.0] * 2 + [0.003] * 2) == ["returned", "raised"]
    assert judge.alarm is not None
    assert (judge.alarm.id, judge.alarm.active, judge.alarm.shelved, judge.raised) == ("a-1", True, True, 1)


def test_a_clock_that_is_set_back_shelves_no_longer():
    judge = AlarmJudge("a")
    block = BlockEstimate(1, 1e6, "alarm", 0.003, None, 0.003, None)
    for _ in range(2):
        judge.update(block, LEAK, 1, SETTINGS, 1.0)
    judge.apply_mark("shelved", 1e6, until=1e6 + 3600.0)
    shelved = [judge.update(replace(block, t=t), LEAK, 1, SETTINGS, 1.0)[0].shelved for t in (100.0, 3600.0, 3800.0)]
    assert shelved == [True, True, False]


def test_an_error_must_be_seen_again_and_becomes_a_warning_below():
    judge = AlarmJudge("a")
    through(judge, [0.003] * 2)
    assert judge.apply_mark("acknowledged", 5.0).state == "acknowledged"
    assert through(judge, [0.02] * 2) == ["error"]
    assert judge.alarm is not None
    assert (judge.alarm.state, judge.alarm.status_word) == ("new", 6)
    assert through(judge, [0.004] * 2) == ["warning"]
    judge.apply_mark("acknowledged", 50.0)
    assert through(judge, [0.0] * 2) == ["returned"]
    assert judge.alarm is None


def test_an_error_returns_without_a_limit_for_errors_as_well():
    """Settings of a restart may have none: the alarm then is a warning, or over where the leak is below that."""
    for lpm, happens in ((0.005, ["returned"]), (0.03, ["warning"])):
        judge = AlarmJudge("a")
        through(judge, [0.02] * 2)
        assert judge.alarm is not None and judge.alarm.level == "error"
        assert through(judge, [lpm] * 6, settings=WatchSettings(warning_lpm=0.01)) == happens


def test_without_litres_a_leak_is_a_warning():
    judge = AlarmJudge("a")
    assert through(judge, [None, None]) == ["raised"]
    assert judge.alarm is not None and judge.alarm.leak_lpm is None


def test_a_valid_alarm_stays_so_until_its_cause_is_over_or_repaired():
    judge = AlarmJudge("a")
    through(judge, [0.003] * 2)
    assert (judge.apply_mark("valid", 5.0).state, judge.alarm.active) == ("valid", True)
    with pytest.raises(InputError):
        judge.apply_mark("acknowledged", 6.0)
    assert through(judge, [0.02] * 2) == ["error"]
    assert (judge.alarm.state, judge.alarm.as_dict()["machine_state"]["name"]) == ("valid", "failure")
    repaired = judge.apply_mark("repaired", 20.0)
    assert (repaired.state, repaired.mark, repaired.status_word, judge.alarm) == ("closed", "repaired", 0, None)
    assert judge.over_s == 20.0
    through(judge, [0.003] * 2)
    judge.apply_mark("valid", 30.0)
    assert through(judge, [0.0] * 20, None) == []  # the detector began anew, and says nothing of the leak
    assert through(judge, [0.0] * 2) == ["returned"]
    assert (judge.alarm, judge.raised) == (None, 2)


def test_an_invalid_alarm_has_a_reason():
    judge = AlarmJudge("a")
    through(judge, [0.003] * 2)
    for reason in ("", "  "):
        with pytest.raises(InputError):
            judge.apply_mark("invalid", 5.0, reason=reason)
    assert judge.alarm.state == "new"
    invalid = judge.apply_mark("invalid", 5.0, reason="the bypass was open")
    assert (invalid.state, invalid.mark, invalid.reason) == ("invalid", "invalid", "the bypass was open")
    assert (invalid.active, judge.alarm) == (False, None)
    assert invalid.as_dict()["machine_state"]["name"] == "good"


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.001, 0.003, 0.02]), st.sampled_from(["", *MARKS]))))
def test_its_state_is_plain_and_what_is_over_is_gone(steps: list[tuple[float, str]]):
    judge, over = AlarmJudge("a"), 0
    for lpm, mark in steps:
        again = restore(AlarmJudge, json.loads(json.dumps(to_plain(judge))), "alarm")
        assert again == judge
        through(judge, [lpm])
        if judge.alarm is not None and mark:
            with suppress(InputError):
                over += judge.apply_mark(mark, 1.0, reason="why").is_over
    assert judge.raised >= over
    assert judge.alarm is None or not judge.alarm.is_over


def test_a_shelved_alarm_keeps_its_changes_to_itself(tmp_path: Path):
    store, judge, out = MonitorStore(str(tmp_path / "a.db")), AlarmJudge("a"), io.StringIO()
    lines = EventLines(store, out)

    def kept(kind: str) -> None:
        assert judge.alarm is not None
        rows = StoredRows()
        rows.add_alarm(judge.alarm, kind, judge.alarm.updated_s)
        with store.writing() as connection:
            store.write_rows(connection, rows)
        lines.deliver()

    through(judge, [0.003] * 2)
    kept("raised")
    judge.apply_mark("shelved", 3.0, until=100.0)
    kept("shelved")
    assert judge.alarm is not None and judge.alarm.status_word == 1
    assert through(judge, [0.02] * 2) == ["error"]
    kept("error")
    assert [json.loads(line)["event"] for line in out.getvalue().splitlines()] == ["raised", "shelved"]
    assert through(judge, [0.02] * 40) == []
    assert judge.alarm.updated_s == pytest.approx(117.0)
    assert judge.alarm.status_word == 6


def test_an_actuator_s_latest_events_are_shown_however_many_there_are(tmp_path: Path) -> None:
    """The page took the last 200 of the first 1000: after these nothing new was seen."""
    store = MonitorStore(f"sqlite:///{tmp_path / 'memory.db'}")
    row = {"kind": "alarm", "alarm_id": "1", "by_whom": "", "text": "", "alarm": "{}"}
    rows = [{**row, "actuator": ("press", "saw")[number % 2], "t": float(number)} for number in range(2600)]
    with store.writing() as connection:
        connection.execute(tables.events.insert(), rows)
    shown = store.last_events("saw")
    assert [event["t"] for event in shown] == [2599.0 - 2 * k for k in range(200)]
