"""A folder is watched by the machine's file alone, on one clock, with the figures of a diagnosis."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

import sealscope as ss
from sealscope.diagnosis.commissioned.watched import is_remeasured, load_watched
from sealscope.diagnosis.live.watch import Watch, watch
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.diagnosis.verdict.severity import state_of
from sealscope.errors import InputError
from sealscope.monitor.alarms import AlarmJudge
from sealscope.monitor.outputs.prometheus import format_metrics
from sealscope.monitor.page.site import PageServer, site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import PageSettings, WatchSettings, read_settings
from sealscope.monitor.sources import folder as folder_module
from sealscope.monitor.sources.folder import WatchedFolder
from sealscope.monitor.sources.source_block import SourceBlock, decode_message
from sealscope.monitor.supervisor import PartAway
from sealscope.monitor.verdicts import RecordingVerdict
from sealscope.reporting import messages

from ..diagnosis.balance_machine import machine, step
from ..diagnosis.test_hold_test import AREAS, RIG, date_holds, write_results
from ..refusals import refusal
from .plant import MAP, log, served

APRIL = datetime(2026, 4, 1, tzinfo=UTC).timestamp()
LEAK, LARGE = 3.0e-13, 3.0e-12


def watching(folder: Path, machine_file: Path, more: str = ""):
    settings = folder / "watch.toml"
    settings.write_text(
        f'database = "monitor.db"\nsettle_s = 0.0\n[[actuator]]\nname = "press"\nrig = "{machine_file}"\n'
        f'folder = "incoming"\nlearn_hours = 0.02\n{more}',
        encoding="utf-8",
    )
    return read_settings(settings)


def test_the_machines_file_states_rate_map_and_limit(commissioned, tmp_path):
    (actuator,) = watching(tmp_path, commissioned).actuator
    assert (actuator.rate, actuator.map, actuator.error_lpm) == (100.0, MAP, pytest.approx(0.02))
    (actuator,) = watching(tmp_path, commissioned, "rate = 50.0\nerror_lpm = 1.0\n").actuator
    assert (actuator.rate, actuator.error_lpm) == (50.0, 1.0)


def test_a_machine_is_stated_by_its_own_word(commissioned, tmp_path):
    (actuator,) = stream_settings(tmp_path, f'machine = "{commissioned}"').actuator
    assert (actuator.rig, actuator.rate) == (str(commissioned), 100.0)
    (tmp_path / "rig.toml").write_text((Path(ss.__file__).parent / "parameters/rigs/thesis.toml").read_text("utf-8"))
    with refusal("machine", "rig"):
        stream_settings(tmp_path, 'machine = "rig.toml"')
    for name in ("press", "thesis"):  # never the name of a packaged rig
        with refusal("machine", ".toml", name):
            stream_settings(tmp_path, f'machine = "{name}"')
    with pytest.raises(InputError, match="must be readable, got: No such file"):
        stream_settings(tmp_path, 'machine = "absent.toml"')


@pytest.mark.long
@pytest.mark.slow
def test_a_machine_of_areas_alone_is_watched_in_the_litres_of_a_diagnosis(commissioned, tmp_path):
    """Its logs have no time column, and its pump was guessed: 7.0 in place of 4.9 cm^3/rev."""
    settings = watching(tmp_path, commissioned)
    worn = machine(9, G=step(0.0, LEAK, at=150.0), rate=100.0, duration=240.0)
    path = log(tmp_path / "incoming/run_2026-04-01_0600.csv", worn)
    service, out = served(settings)
    (event,) = [json.loads(line) for line in out.splitlines()]
    diagnosis = ss.read_machine(commissioned).diagnose(path)
    summary = service.summaries()["press"]
    assert event["alarm"]["leak_lpm"] == summary["leak_lpm"] == same(diagnosis.leak_lpm)
    assert event["alarm"]["onset_s"] == pytest.approx(APRIL + 6.0 * 3600.0 + diagnosis.onset_s)
    assert summary["why_no_litres"] == ""
    course = [row["leak_lpm"] for row in service.store.history("press")]
    assert course[0] is None and course[-1] == same(diagnosis.leak_lpm)


def test_results_of_hold_tests_are_judged_by_their_trend(tmp_path):
    healthy, factors = [1.0, 1.02, 0.98], [1.0, 1.02, 0.98, 2.0, 3.0, 4.0, 5.0, 6.0]
    boom = ss.commission(write_results(tmp_path / "healthy.jsonl", date_holds(healthy, [1, 2, 3])), rig=RIG)
    ss.write_machine(replace(boom, limit="6 mL/min"), tmp_path / "boom.toml")
    (tmp_path / "incoming").mkdir()
    holds = date_holds(factors, range(1, 9))
    path = write_results(tmp_path / "incoming/holds.jsonl", holds)
    service, _ = served(watching(tmp_path, tmp_path / "boom.toml"))
    summary, (last,) = service.summaries()["press"], ss.hold_test(holds[-1], area=AREAS)
    verdict = summary["recording"]
    assert verdict["verdict"] == "leak" and "a month" in verdict["reason"] and "reached" in verdict["reason"]
    assert summary["total_lpm"] == pytest.approx(last.leak_lpm, rel=0.1)
    path.write_text(path.read_text().replace('"start": "2024', '"start": null, "was": "2024'))
    again, _ = served(watching(tmp_path, tmp_path / "boom.toml"))
    (refused,) = again.store.refused()
    assert "dates" in refused["message"]


def same(figures):
    """The same to the rounding of the linear algebra, whose threads may be others."""
    return pytest.approx(figures, rel=1e-9)


def surfaces(service, out: str, diagnosis):
    """Compare the alarm, page, metrics and what a broker gets with a diagnosis; return the event and the page's row."""
    (event,) = [json.loads(line) for line in out.splitlines()]
    page = TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")
    (row,) = page.get("/api/fleet").json()["actuators"]
    families = text_string_to_metric_families(page.get("/metrics").text)
    metrics = {family.name: family.samples[0].value for family in families if family.samples}
    figures = [diagnosis.leak_lpm, *diagnosis.leak_interval_lpm]
    assert event["event"] == "raised"
    for shown in (event["alarm"], row):
        assert [shown["leak_lpm"], *shown["leak_interval_lpm"]] == same(figures)
    assert [metrics[f"sealscope_leak_{end}lpm"] for end in ("", "low_", "high_")] == same(figures)
    assert metrics["sealscope_severity"] == diagnosis.state.severity
    for shown in (row["state"], event["alarm"]["machine_state"]):
        assert (shown["name"], shown["condition"]) == (diagnosis.state.name, diagnosis.state.condition)
        assert (shown["cause"], shown["severity"]) == (diagnosis.cause, diagnosis.state.severity)
    assert row["state"]["action"] == event["alarm"]["next_check"] == diagnosis.next_check
    assert row["recording"]["reason"] == diagnosis.reason and diagnosis.reason in event["alarm"]["evidence"]
    assert row["recording"]["size"] == messages.how_much(diagnosis)
    return event, row


@pytest.mark.long
@pytest.mark.slow
def test_a_leak_from_the_first_sample_of_the_first_file_is_what_diagnose_says(commissioned, tmp_path):
    settings = watching(tmp_path, commissioned)
    worn = machine(9, G=step(0.0, LARGE, at=0.0), rate=100.0, duration=60.0)
    path = log(tmp_path / "incoming/run_2026-04-01_0600.csv", worn)
    diagnosis = ss.read_machine(commissioned).diagnose(path)
    assert (diagnosis.verdict, diagnosis.onset_s) == ("leak", None)
    service, out = served(settings)
    event, row = surfaces(service, out, diagnosis)
    start = APRIL + 6.0 * 3600.0
    assert event["alarm"]["onset_s"] == row["state"]["since_s"] == pytest.approx(start, abs=0.1)
    again, _ = served(settings)  # restarted, it says the same
    assert again.summaries()["press"] == service.summaries()["press"]


@pytest.mark.slow
def test_the_bound_of_a_healthy_recording_is_that_of_diagnose_and_ends_the_alarm(commissioned, tmp_path):
    settings = watching(tmp_path, commissioned)
    log(
        tmp_path / "incoming/run_2026-04-01_0600.csv",
        machine(9, G=step(0.0, LARGE, at=0.0), rate=100.0, duration=60.0),
    )
    path = log(tmp_path / "incoming/run_2026-04-02_0600.csv", machine(12, rate=100.0, duration=60.0))
    diagnosis = ss.read_machine(commissioned).diagnose(path)
    assert diagnosis.verdict == "no leak"
    service, out = served(settings)
    assert [json.loads(line)["event"] for line in out.splitlines()] == ["raised", "returned"]
    summary = service.summaries()["press"]
    assert summary["leak_lpm"] is None
    assert summary["bound_lpm"] == same(diagnosis.bound_lpm)
    assert summary["total_lpm"] == same(diagnosis.total_leakage.lpm)
    assert (summary["state"]["name"], summary["status"]) == (diagnosis.state.name, diagnosis.summary)
    assert f'sealscope_bound_lpm{{actuator="press"}} {summary["bound_lpm"]!r}' in format_metrics(
        service.summaries(), {}
    )


@pytest.mark.slow
@pytest.mark.parametrize("mark", ["invalid", pytest.param("repaired", marks=pytest.mark.long)])
def test_a_mark_that_ends_an_alarm_leaves_no_figures_and_the_next_recording_is_judged(commissioned, tmp_path, mark):
    (tmp_path / "press.toml").write_bytes(commissioned.read_bytes())
    (tmp_path / "press.healthy").write_bytes(commissioned.with_suffix(".healthy").read_bytes())
    settings, worn = watching(tmp_path, tmp_path / "press.toml"), machine(9, G=step(0.0, LARGE, at=0.0), rate=100.0)
    log(tmp_path / "incoming/run_2026-04-01_0600.csv", worn)
    service, _ = served(settings)
    service.actuators.apply_mark("press", mark, text="no oil seen")
    summary = service.summaries()["press"]
    assert (summary["status"], summary["leak_lpm"], summary["total_lpm"]) == (f"marked {mark}", None, None)
    assert (summary["state"]["name"], summary["alarm"]) == ("good", None)
    log(tmp_path / "incoming/run_2026-04-02_0600.csv", machine(10, G=step(0.0, LARGE, at=0.0), rate=100.0))
    again, out = served(settings)
    assert [json.loads(line)["alarm"]["id"] for line in out.splitlines()][-1] == "press-2"
    assert again.summaries()["press"]["state"]["condition"] == "leak"


def verdict(verdict="leak", chance=None, **more) -> RecordingVerdict:
    state = state_of(verdict, "piston leak" if verdict == "leak" else None).as_dict()
    words = {"file": "run.csv", "summary": verdict, "size": "", "reason": "", "cause": ""}
    times = {"start_s": 0.0, "end_s": 60.0, **more}
    return RecordingVerdict(verdict=verdict, state=state, chance=chance, **words, **times)


def test_an_alarm_needs_evidence_as_rare_as_the_stated_rate_or_a_second_recording():
    """A minute that one healthy recording in 100 looks like is no alarm at one in 1000 h; two in turn are."""
    judge, settings, likely = AlarmJudge("press"), WatchSettings(), verdict(chance=0.01)
    assert judge.update_from_verdict(likely, None, 1, settings) is None
    assert judge.update_from_verdict(likely, verdict("no leak"), 1, settings) is None
    alarm, event = judge.update_from_verdict(likely, likely, 1, settings)
    assert event == "raised" and alarm.by_chance_per_1000_h == pytest.approx(600.0)
    assert judge.update_from_verdict(verdict("cannot tell"), likely, 1, settings) is None
    assert AlarmJudge("press").update_from_verdict(verdict(chance=1e-4), None, 1, settings)[1] == "raised"
    assert AlarmJudge("press").update_from_verdict(likely, None, 1, WatchSettings(false_alarms_per_1000_h=700.0))


def test_what_leaks_from_the_first_sample_began_after_the_last_healthy_recording():
    healthy, worn = verdict("no leak"), verdict(start_s=500.0, end_s=560.0)
    alarm, _ = AlarmJudge("press").update_from_verdict(worn, healthy, 1, WatchSettings())
    assert (alarm.onset_s, alarm.onset_interval_s) == (500.0, (60.0, 500.0))


@pytest.mark.slow
def test_recordings_that_cannot_tell_are_watched_block_by_block(commissioned, tmp_path):
    """As of a logger that begins a file every 10 s; a recording without a leak takes the blocks' leak back."""
    service = Service(watching(tmp_path, commissioned), once=True)
    worn = machine(9, G=step(0.0, LEAK, at=120.0), rate=100.0, duration=170.0)

    def take(number: int, said: str) -> dict:
        part = worn.between(10.0 * number, 10.0 * (number + 1))
        times = {"start_s": float(part.t[0]), "end_s": float(part.t[-1])}
        judged = replace(verdict(said, **times), bound_lpm=1e-9)
        block = SourceBlock("press", str(number), part, follows=number > 0, verdict=judged)
        service.actuators.process_blocks([block])
        return service.summaries()["press"]

    for number in range(16):
        summary = take(number, "cannot tell")
    alarm = service.store.alarms()[0]
    assert (alarm["state"], alarm["onset_s"]) == ("new", pytest.approx(120.0, abs=4.0))
    assert summary["leak_lpm"] == alarm["leak_lpm"] and summary["state"]["condition"] == "leak"
    assert summary["bound_lpm"] is None  # of the recording alone, below the leak that the blocks show
    healthy = take(16, "no leak")
    assert (healthy["leak_lpm"], healthy["bound_lpm"]) == (None, 1e-9)
    assert service.store.alarms()[0]["returned_s"] == pytest.approx(170.0, abs=0.1)
    service.close()


def test_a_recording_whose_judging_raises_an_error_is_watched_by_its_blocks(
    commissioned, tmp_path, monkeypatch, caplog
):
    def fail(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError("of a plug-in")

    monkeypatch.setattr(folder_module, "judge_recording", fail)
    folder = folder_of(tmp_path, commissioned)
    log(tmp_path / "incoming/run_2026-04-01_0600.csv", machine(12, rate=100.0, duration=20.0))
    (block,) = folder.blocks()
    assert block.samples is not None and block.verdict is None
    assert "is not judged as a whole: ZeroDivisionError" in caplog.text


@pytest.mark.slow
def test_a_machines_file_that_cannot_be_read_holds_its_recordings_up(commissioned, tmp_path):
    """None is lost: it is judged as soon as the file is whole again."""
    (tmp_path / "press.toml").write_bytes(commissioned.read_bytes())
    (tmp_path / "press.healthy").write_bytes(commissioned.with_suffix(".healthy").read_bytes())
    folder = folder_of(tmp_path, tmp_path / "press.toml")
    log(tmp_path / "incoming/run_2026-04-01_0600.csv", machine(12, rate=100.0, duration=20.0))
    (tmp_path / "press.healthy").rename(tmp_path / "away.healthy")
    with refusal("press.healthy", error=PartAway):
        list(folder.blocks())
    (tmp_path / "away.healthy").rename(tmp_path / "press.healthy")
    (block,) = folder.blocks()
    assert block.verdict is not None and block.verdict.file == "run_2026-04-01_0600.csv"


def test_the_displacement_is_measured_beside_the_stated_areas(commissioned):
    rig = load_watched(str(commissioned)).rig
    assert rig.pump.q_b == pytest.approx(4.9e-6, rel=0.03)
    assert rig.states("pump.q_b")
    assert is_remeasured(rig, rig.with_overrides({"pump.q_b": 1.01 * rig.pump.q_b}))
    assert not is_remeasured(rig, rig.with_overrides({"pump.q_b": 2.0 * rig.pump.q_b}))


@pytest.mark.slow
def test_an_alarm_without_litres_says_why():
    rig = unstated_rig()
    live = watch(rig, learn_hours=0.02)
    live.update(machine(9, G=step(0.0, LEAK, at=100.0), rate=100.0, duration=140.0))
    assert live.leak is not None and live.leak.leak_lpm is None
    assert "L/min is not stated" in live.leak.reason


def folder_of(tmp_path, commissioned) -> WatchedFolder:
    (actuator,) = watching(tmp_path, commissioned).actuator
    return WatchedFolder(actuator, 0.0, lambda name, identity: False)


def starts(blocks) -> list[float]:
    return [
        float(block.samples.t[0]) for block in blocks if isinstance(block, SourceBlock) and block.samples is not None
    ]


def test_files_are_taken_in_the_order_of_their_recordings(commissioned, tmp_path, monkeypatch):
    """Copied at once, in any order, they have the times in their names; one that comes too late is named."""
    folder, healthy = folder_of(tmp_path, commissioned), machine(4, rate=100.0, duration=20.0)
    monkeypatch.setattr(folder_module, "judge_recording", lambda *_, **__: verdict("no leak"))
    for k, day in enumerate((3, 1, 2)):
        path = log(tmp_path / f"incoming/run_2026-04-{day:02d}_0600.csv", healthy)
        os.utime(path, times=(0.0, 1.7e9 + k))
    hours = [APRIL + (24.0 * day + 6.0) * 3600.0 for day in range(3)]
    assert starts(folder.blocks()) == pytest.approx(hours)
    log(tmp_path / "incoming/run_2026-04-02_0700.csv", healthy)
    refused, empty = folder.blocks()
    assert "2026-04-02 07:00:00 after 2026-04-03 06:00:00" in str(refused)
    assert empty.samples is None
    assert list(folder.blocks()) == []


@pytest.mark.long
@pytest.mark.slow
def test_recordings_of_a_day_without_a_time_of_day_follow_each_other(commissioned, tmp_path):
    folder, healthy = folder_of(tmp_path, commissioned), machine(4, rate=100.0, duration=20.0)
    for part in "abc":
        log(tmp_path / f"incoming/run_2026-04-01_{part}.csv", healthy)
    assert starts(folder.blocks()) == pytest.approx([APRIL, APRIL + 20.99, APRIL + 41.98], abs=0.1)


def test_a_file_without_a_date_ends_at_its_last_change(commissioned, tmp_path, monkeypatch):
    monkeypatch.setattr(folder_module, "judge_recording", lambda *_, **__: verdict("no leak"))
    path = log(tmp_path / "incoming/run.csv", machine(4, rate=100.0, duration=20.0))
    os.utime(path, times=(0.0, APRIL))
    (first,) = starts(folder_of(tmp_path, commissioned).blocks())
    assert first == pytest.approx(APRIL - 19.99, abs=0.05)


def test_long_names_that_differ_at_their_end_are_files_of_their_own(commissioned, tmp_path, monkeypatch):
    """Of one size and unpacked in one second; bytes that are no text make a name longer still."""
    monkeypatch.setattr(folder_module, "judge_recording", lambda *_, **__: verdict("no leak"))
    folder, healthy = folder_of(tmp_path, commissioned), machine(4, rate=100.0, duration=20.0)
    for day in (1, 2):
        path = log(
            tmp_path / f"incoming/{os.fsdecode(b'press_' + 20 * bytes([228]))}{'e' * 40}_2026-04-0{day}.csv", healthy
        )
        os.utime(path, times=(0.0, APRIL))
    identities = [block.identity for block in folder.blocks()]
    assert len(set(identities)) == 2
    assert max(map(len, identities)) <= 120


def test_after_a_restart_older_recordings_are_refused(commissioned, tmp_path):
    settings, healthy = watching(tmp_path, commissioned), machine(4, rate=100.0, duration=40.0)
    log(tmp_path / "incoming/run_2026-04-03_0600.csv", healthy)
    served(settings)
    log(tmp_path / "incoming/run_2026-04-02_0600.csv", healthy)
    service, _ = served(settings)
    assert service.actuators.counters == {"files that could not be read": 1}
    assert service.summaries()["press"]["t"] == pytest.approx(APRIL + 54.0 * 3600.0 + 40.0, abs=5.0)


@pytest.mark.slow
def test_the_headline_is_the_mean_over_the_cycles_seen(commissioned):
    live = watch(load_watched(str(commissioned)).rig, learn_hours=0.02)
    worn = machine(9, G=step(0.0, LEAK, at=100.0), rate=100.0, duration=240.0)
    shown = [(own, live.with_cycle_means(own)) for own, leak in live.each(worn) if leak is not None and own.t > 160.0]
    blocks, means = (np.array([own.leak_lpm for own in kind]) for kind in zip(*shown, strict=True))
    mean, truth = shown[-1][1], LEAK * float(np.abs(worn["p_A"] - worn["p_B"])[worn.t > 150.0].mean()) * 6e4
    assert means.std() < 0.5 * blocks.std()
    assert mean.leak_interval_lpm[0] <= truth <= mean.leak_interval_lpm[1]
    assert mean.total_interval_lpm[0] < mean.total_lpm < mean.total_interval_lpm[1]


def test_metrics_carry_the_interval():
    text = format_metrics({"press": {"leak_lpm": 1.4, "leak_interval_lpm": [1.2, 1.6]}}, {})
    values = {own.name: own.samples[0].value for own in text_string_to_metric_families(text)}
    assert [values[f"sealscope_leak_{end}lpm"] for end in ("", "low_", "high_")] == [1.4, 1.2, 1.6]


def stream_settings(folder: Path, lines: str):
    file = folder / "stream.toml"
    head = 'lines = true\n[mqtt]\n[opcua]\nurl = "opc.tcp://localhost:4840"\n[[actuator]]\nname = "press"\n'
    file.write_text(head + lines, encoding="utf-8")
    return read_settings(file)


def test_units_of_a_plants_signals_are_those_of_the_machines_file(commissioned, tmp_path):
    """Its map has a heading with a unit, `angle [rad]`; what the table states comes first."""
    nodes = "\n".join(f'nodes.{name} = "ns=2;s={name}"' for name in ("p_A", "p_B", "x", "theta"))
    rig = f'rig = "{commissioned}"\n'
    (actuator,) = stream_settings(tmp_path, rig + nodes).actuator
    assert (actuator.units, actuator.rate) == ({"theta": "rad"}, 100.0)
    (actuator,) = stream_settings(tmp_path, f'{rig}{nodes}\nunits = {{ theta = "deg", p_A = "bar" }}').actuator
    assert actuator.units == {"theta": "deg", "p_A": "bar"}
    (actuator,) = stream_settings(tmp_path, rig).actuator
    assert actuator.units == {}  # a message is in SI or says otherwise


def test_units_of_the_table_hold_for_every_stream_that_names_none(tmp_path):
    (actuator,) = stream_settings(tmp_path, 'units = { p_A = "bar" }').actuator
    units_of = {"press": actuator.units}
    message = {"actuator": "press", "t": 0.0, "rate": 50, "p_A": [1.0], "p_B": [1e5]}
    (p_a, p_b) = decode_message(json.dumps(message).encode(), units_of=units_of).samples.channels.values()
    assert (p_a[0], p_b[0]) == (1e5, 1e5)
    stated = decode_message(json.dumps({**message, "units": {"p_A": "MPa"}}).encode(), units_of=units_of)
    assert stated.samples["p_A"][0] == 1e6
    for lines, names in (
        ('units = { p_A = "mm" }', ("units.p_A", "mm")),
        ('units = { pressure = "bar" }', ("units", "pressure")),
        ('folder = "incoming"\nunits = { p_A = "bar" }', ("units", "files")),
    ):
        with refusal(*names):
            stream_settings(tmp_path, lines)


def test_a_stream_begins_with_the_level_of_the_healthy_recordings(commissioned):
    """What leaks from the first sample on shows against them alone, in litres, also after a restart."""
    known = load_watched(str(commissioned))
    worn, fresh = (machine(9, G=step(0.0, G, at=0.0), rate=100.0, duration=120.0) for G in (LARGE, 0.0))
    leaks: dict[str, object] = {}
    for name, healthy in (("with", known.healthy), ("without", None)):
        live = watch(known.rig, healthy=healthy)
        live.update(worn.between(0.0, 50.0))
        live = Watch.from_state(json.loads(json.dumps(live.state())))
        live.update(worn.between(50.0, 120.0))
        leaks[name] = live.leak
    assert leaks["without"] is None
    assert leaks["with"].test == "level" and "healthy recordings" in leaks["with"].reason
    low, high = leaks["with"].leak_interval_lpm
    assert low <= LARGE * float(np.abs(worn["p_A"] - worn["p_B"]).mean()) * 6e4 <= high
    live = watch(known.rig, healthy=known.healthy)
    live.update(fresh)
    assert live.leak is None
    live.update(worn, follows=False)
    assert live.leak is not None
    live.dismiss()  # a person found none
    live.update(worn, follows=False)
    assert live.leak is None


#: Elements beyond the window's edges, or whose text is wider than they are.
CUT = """() => [...document.querySelectorAll("body *")].filter((part) => {
  if (part.closest("svg") || part.closest(".u-over") || part.tagName === "SCRIPT") return false;
  const box = part.getBoundingClientRect();
  if (!box.width || !box.height) return false;
  const isText = !part.children.length && getComputedStyle(part).display !== "inline";
  const wide = isText && part.scrollWidth > part.clientWidth + 1;
  return wide || box.left < -1 || box.right > document.documentElement.clientWidth + 1;
}).map((part) => `${part.tagName} ${part.id} ${part.textContent.slice(0, 60)}`)"""


@pytest.mark.slow
def test_the_page_of_judged_recordings_in_a_browser(commissioned, tmp_path):
    """Headline, size and reason are those of diagnose; an alarm that is over says so; nothing is cut at 400 px."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    browser_path = shutil.which("chromium")
    if browser_path is None:
        pytest.skip("chromium is not installed")
    settings, worn = watching(tmp_path, commissioned), machine(9, G=step(0.0, LARGE, at=0.0), rate=100.0, duration=60.0)
    log(tmp_path / "incoming/run_2026-04-01_0600.csv", worn)
    log(tmp_path / "incoming/run_2026-04-02_0600.csv", machine(12, rate=100.0, duration=60.0))
    service, _ = served(settings)
    recording = service.summaries()["press"]["recording"]
    server = PageServer(service.actuators, PageSettings(port=0))
    try:
        with playwright.sync_playwright() as player:
            browser = player.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
            for width in (400, 1280):
                size = {"width": width, "height": 900}
                view = browser.new_page(viewport=size, timezone_id="America/New_York")
                view.goto(server.address)
                view.wait_for_selector("#alarm:not([hidden])")
                line = view.text_content("#state") or ""
                assert f"{recording['summary']}: {recording['size']}" in line
                assert recording["reason"] in (view.text_content("#now") or "")
                assert f"alarm new, over; {recording['summary']}" in (view.text_content("#fleet .state") or "")
                assert f"< {diagnosed_bound(service)} L/min" in (view.text_content("#fleet .figure") or "")
                assert "2026-04-01 06:00:00" in (view.text_content("#alarm-facts") or "")  # the logger's clock
                assert view.locator("#live-charts").is_hidden()  # no samples are kept of files
                assert view.evaluate("document.documentElement.scrollWidth") <= width
                assert view.evaluate(CUT) == []
                view.close()
            browser.close()
    finally:
        server.close()
        service.actuators.closed = False


def diagnosed_bound(service) -> str:
    return f"{service.summaries()['press']['bound_lpm']:.2g}"
