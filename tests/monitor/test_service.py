"""The service: what comes in is stored once, alarms go out, and a restart or an error changes no row."""

from __future__ import annotations

import io
import json
import math
import os
import sqlite3
import threading
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import DataError, OperationalError

from sealscope.diagnosis.live.estimates import BlockEstimate, WatchedLeak
from sealscope.diagnosis.live.watch import STATE_VERSION
from sealscope.monitor.alarms import AlarmJudge
from sealscope.monitor.database.store import MonitorStore, StoredRows
from sealscope.monitor.outputs.prometheus import format_metrics
from sealscope.monitor.service import Service
from sealscope.monitor.settings import WatchSettings, read_settings, template
from sealscope.monitor.sources.source_block import compute_digest

from ..diagnosis.balance_machine import machine
from ..refusals import refusal
from .plant import LINES, WORN, kill_often, lines_of, moved, rows_of, served, settings_in, until, write_files


def test_a_leak_becomes_one_alarm_with_litres_per_minute(undisturbed_run):
    rows, out = undisturbed_run
    events = [json.loads(line) for line in out.splitlines()]
    assert [event["event"] for event in events] == ["raised"]
    alarm = events[0]["alarm"]
    assert alarm["actuator"] == "press 1"
    assert (alarm["level"], alarm["state"], alarm["diagnostic_number"]) == ("warning", "new", 4101)
    assert alarm["onset_s"] == pytest.approx(100.0, abs=2.0)
    low, high = alarm["leak_interval_lpm"]
    assert low < 0.00195 < high
    assert "hold a load" in alarm["next_check"]
    assert len(rows["alarms"]) == 1
    assert {row[0] for row in rows["estimates"]} == {"press 1", "press 2"}
    assert len(rows["estimates"]) == 2 * 44


def test_what_is_replayed_is_known(undisturbed, undisturbed_run, tmp_path):
    settings = settings_in(tmp_path)
    served(settings, LINES[: len(LINES) // 2])  # the cut goes through a line, which holds no block
    service, out = served(settings, LINES)
    assert rows_of(settings.database) == undisturbed
    assert service.actuators.counters["blocks stored already"] > 20
    _, again = served(settings, LINES)
    assert rows_of(settings.database) == undisturbed
    assert (out, again) == (undisturbed_run[1], "")


@pytest.mark.slow
def test_kills_at_random_instants_change_no_row(undisturbed, tmp_path):
    settings = settings_in(tmp_path)
    lines = tmp_path / "lines.jsonl"
    lines.write_bytes(LINES)
    assert kill_often(settings, lines, 2, seed=1) == 2
    assert rows_of(settings.database) == undisturbed


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, *(pytest.param(seed, marks=pytest.mark.long) for seed in (4, 5))])
def test_many_kills_change_no_row(undisturbed, tmp_path, seed):
    settings = settings_in(tmp_path)
    lines = tmp_path / "lines.jsonl"
    lines.write_bytes(LINES)
    assert kill_often(settings, lines, 5, seed=seed) == 5
    assert rows_of(settings.database) == undisturbed


@pytest.mark.slow
@pytest.mark.parametrize("together", [1, 3])
def test_errors_of_the_database_change_no_row(undisturbed, tmp_path, monkeypatch, together):
    """Every tenth write fails after the detector has taken the block."""
    settings = settings_in(tmp_path)
    keep, calls = MonitorStore.write_rows, iter(range(10_000))

    def failing(self: MonitorStore, *arguments: Any) -> None:
        keep(self, *arguments)
        if next(calls) % 10 == 7:
            raise OperationalError("insert", {}, sqlite3.OperationalError("database or disk is full"))

    monkeypatch.setattr(MonitorStore, "write_rows", failing)
    monkeypatch.setattr("sealscope.monitor.service._MAX_TRANSACTION_BLOCKS", together)
    service, _ = served(settings, LINES)
    assert rows_of(settings.database) == undisturbed
    assert service.actuators.counters["waits for the database"] > 5 / together


@pytest.mark.parametrize(
    "error",
    [
        pytest.param(ValueError("no such thing"), marks=[pytest.mark.slow, pytest.mark.long]),
        DataError("insert", {}, ValueError("NUL")),
    ],
)
def test_a_block_that_raises_an_error_is_dropped_and_the_others_go_on(tmp_path, monkeypatch, caplog, error):
    keep, bad = MonitorStore.insert_blocks, compute_digest(LINES.splitlines()[14])

    def failing(self: MonitorStore, connection: Any, blocks: list[tuple[str, str, int]]) -> None:
        if any(identity == bad for _, identity, _ in blocks):
            raise error
        keep(self, connection, blocks)

    monkeypatch.setattr(MonitorStore, "insert_blocks", failing)
    service, _ = served(settings_in(tmp_path), LINES)
    assert service.actuators.counters == {"blocks that raised an error": 1}
    assert len(rows_of(service.settings.database)["blocks"]) == len(LINES.splitlines()) - 1
    assert "is dropped" in caplog.text


@pytest.mark.slow
def test_files_that_appear_are_read_once_and_in_order(tmp_path):
    write_files(tmp_path / "press 3", WORN, 65.0)
    more = '[[actuator]]\nname = "press 3"\nfolder = "press 3"\npattern = "*.csv"'
    settings = settings_in(tmp_path, more)
    _, out = served(settings)
    events = [json.loads(line) for line in out.splitlines()]
    assert [(event["event"], event["alarm"]["actuator"]) for event in events] == [("raised", "press 3")]
    before = rows_of(settings.database)
    assert len(before["blocks"]) == 2
    _, again = served(settings)
    assert again == ""
    assert rows_of(settings.database) == before


def test_a_file_that_is_being_written_is_waited_for(tmp_path):
    write_files(tmp_path / "press 3", WORN, 200.0)
    (file,) = (tmp_path / "press 3").iterdir()
    whole = file.read_bytes()
    more = '[[actuator]]\nname = "press 3"\nfolder = "press 3"\n'
    settings = settings_in(tmp_path, more).model_copy(update={"lines": False, "settle_s": 0.4})
    from sealscope.monitor.sources.folder import WatchedFolder

    folder = WatchedFolder(settings.actuator[-1], 0.4, lambda name, identity: False)
    for share in (0.2, 0.5, 1.0):
        file.write_bytes(whole[: int(share * len(whole))])
        os.utime(file)
        assert list(folder.blocks()) == []
    (file.parent / "next.csv.part").write_bytes(whole)
    time.sleep(0.5)
    (block,) = folder.blocks()
    assert block.samples is not None
    assert len(block.samples) == len(WORN)
    assert list(folder.blocks()) == []
    assert settings.settle_s == 0.4


def test_the_oil_s_temperature_stands_beside_the_estimates(taken):
    """The last one that was told, until the next; nothing where none is."""
    service, _ = served(taken)
    rows = list(service.store.estimates())
    oil = [row["oil_celsius"] for row in rows if row["actuator"] == "press 2"]
    assert {round(value, 9) for value in oil} == {40.0, 41.0, 42.0, 43.0, 44.0}
    assert oil == sorted(oil)
    assert {row["oil_celsius"] for row in rows if row["actuator"] == "press 1"} == {None}
    shown = service.actuators.summaries()
    assert shown["press 2"]["oil_celsius"] == pytest.approx(44.0)
    assert 'sealscope_oil_temperature_celsius{actuator="press 2"} 44' in format_metrics(shown, {})
    assert [row["oil_celsius"] for row in service.store.history("press 2")] == pytest.approx(oil)


def test_marks_are_kept_and_act(taken):
    service, _ = served(taken)
    with refusal("acknowledged", "none"):
        service.actuators.apply_mark("press 2", "acknowledged")
    assert service.actuators.apply_mark("press 1", "acknowledged", by_whom="Ada").state == "acknowledged"
    with refusal("acknowledged"):
        service.actuators.apply_mark("press 1", "acknowledged")
    service.actuators.apply_mark("press 1", "comment", text="<b>seal ordered</b>")
    assert service.actuators.apply_mark("press 1", "shelved").shelved_until_s > 8 * 3600.0
    assert service.actuators.apply_mark("press 1", "repaired").state == "closed"
    again = Service(taken, once=True)
    again.close()
    assert again.actuators.summaries()["press 1"]["alarm"] is None
    kinds = [event["event"] for _, event in again.store.events_since(0)]
    assert kinds == ["raised", "acknowledged", "comment", "shelved", "repaired"]
    _, after = again.actuators.store.checkpoint("press 1")
    assert after["watch"]["baseline_version"] == 2


def test_a_state_of_another_version_begins_a_new_baseline(taken, caplog):
    """After an update estimates stay, their numbers go on, and the log says why the actuator learns anew."""
    service, _ = served(taken)
    before = [row for row in rows_of(taken.database)["estimates"] if row[0] == "press 1"]
    learned_with, state = service.store.checkpoint("press 1")
    state["watch"] = {"version": 1, "baseline_version": 3, "what it was": []}
    rows = StoredRows()
    rows.add_checkpoint("press 1", learned_with, state, first_kept=10_000)
    with service.store.writing() as connection:
        service.store.write_rows(connection, rows)
    again = Service(taken, once=True)
    again.close()
    assert f"press 1: starts anew, as its state has version 1, not {STATE_VERSION}" in caplog.text
    _, state = again.store.checkpoint("press 1")
    pending = again.store.pending("press 1")
    assert (state["watch"]["version"], state["watch"]["baseline_version"], pending) == (STATE_VERSION, 4, [])
    assert state["watch"]["blocks"] == max(row[1] for row in before)
    assert [row for row in rows_of(taken.database)["estimates"] if row[0] == "press 1"] == before


@pytest.mark.slow
def test_other_settings_begin_a_new_baseline(taken, tmp_path):
    file = tmp_path / "monitor.toml"
    file.write_text(file.read_text().replace("0.02", "0.03"))
    service, _ = served(read_settings(file))
    _, state = service.store.checkpoint("press 1")
    assert (state["watch"]["baseline_version"], state["watch"]["blocks"]) == (2, 44)


@pytest.mark.slow
@pytest.mark.long
def test_another_rig_under_the_same_name_begins_a_new_baseline(tmp_path, caplog):
    """What counts is what the file states, not its name: the same values elsewhere are the same machine."""
    settings = settings_in(tmp_path)
    press, moved_to = tmp_path / "press.toml", tmp_path / "settings" / "renamed.toml"
    moved_to.parent.mkdir()

    def watched(rig: Path, lines: bytes = b"") -> dict[str, Any]:
        own = [actuator.model_copy(update={"rig": str(rig)}) for actuator in settings.actuator]
        service, _ = served(settings.model_copy(update={"actuator": own}), lines)
        return service.store.checkpoint("press 2")[1]["watch"]

    text = (files("sealscope.parameters") / "rigs" / "thesis.toml").read_text()
    for place in (press, moved_to):
        place.write_text(text)
    assert watched(press, LINES)["baseline"] is not None
    assert (watched(moved_to)["baseline_version"], caplog.text) == (1, "")
    assert "q_b = { value = 4.9e-6" in text
    moved_to.write_text(text.replace("q_b = { value = 4.9e-6", "q_b = { value = 9.8e-6"))
    again = watched(moved_to)
    assert (again["baseline_version"], again["baseline"]) == (2, None)
    assert "press 2: its rig or learn_hours are others than it learned with" in caplog.text


@pytest.mark.slow
@pytest.mark.long
def test_a_leak_is_not_over_because_the_detector_begins_anew(tmp_path):
    settings = settings_in(tmp_path)
    served(settings, LINES)
    own = [actuator.model_copy(update={"learn_hours": 0.01}) for actuator in settings.actuator]
    later = moved(machine(3, G=3.0e-13, duration=60.0, rate=50.0), 130.0)
    service, _ = served(settings.model_copy(update={"actuator": own}), lines_of({"press 1": later}, 150))
    assert service.actuators.summaries()["press 1"]["baseline"]["version"] == 2
    assert [event["event"] for _, event in service.store.events_since(0)] == ["raised"]
    assert service.actuators.summaries()["press 1"]["state"]["name"] == "maintenance required"


def test_a_clock_that_is_set_back_hides_nothing_that_is_new(tmp_path):
    store = MonitorStore(str(tmp_path / "monitor.db"))
    rows, judge = StoredRows(), AlarmJudge("a")
    for number, t in enumerate([9e5, 9e5 + 3.0, 0.0, 3.0], 1):
        rows.add_estimates("a", [BlockEstimate(number, t, "alarm", 0.003, None, 0.003, None)], None)
    sizes = 1e-13, 5e-13, 1e-15, 1e5
    leak = WatchedLeak(10.0, 9.0, (8.0, 10.0), 0.003, (0.002, 0.004), *sizes, "step", "leak", "", 50.0, 28.0)
    for t in (9e5, 3.0):
        block = BlockEstimate(1, t, "alarm", 0.003, None, 0.003, None)
        alarm, _ = judge.update(block, leak, 1, WatchSettings(debounce_blocks=1), 1.0)
        rows.add_alarm(alarm, "raised", t)
        rows.add_alarm(judge.apply_mark("repaired", t), "repaired", t)
    store.commit_rows(rows)
    assert [row["t"] for row in store.history("a", seconds=60.0)] == [0.0, 3.0]
    assert [alarm["id"] for alarm in store.alarms()] == ["a-2", "a-1"]


@pytest.mark.slow
def test_a_restart_with_other_thresholds_changes_nothing_that_was_said(tmp_path):
    """A leak below the threshold is announced when the threshold is lowered: by the next block, and as raised."""
    settings = settings_in(tmp_path)
    lines = LINES.splitlines(keepends=True)
    strict = [own.model_copy(update={"warning_lpm": 10.0, "error_lpm": 20.0}) for own in settings.actuator]
    served(settings.model_copy(update={"actuator": strict}), b"".join(lines[:-10]))
    service, _ = served(settings)
    assert service.actuators.summaries()["press 1"]["alarm"] is None
    assert service.store.alarms() == []
    service, _ = served(settings, b"".join(lines))
    assert service.actuators.summaries()["press 1"]["alarm"] == service.store.alarms()[0]["id"]
    assert [event["event"] for _, event in service.store.events_since(0)] == ["raised"]


@pytest.mark.slow
def test_a_fleet_shares_its_budget_and_keeps_its_baselines(tmp_path):
    """Another rate, as where an actuator is added to a budget, moves thresholds only."""
    settings = settings_in(tmp_path)
    service, _ = served(settings, LINES)
    shown = service.actuators.summaries()
    assert shown["press 1"]["baseline"] is not None
    file = tmp_path / "monitor.toml"
    file.write_text("fleet_false_alarms_per_1000_h = 0.002\n" + file.read_text())
    again = Service(read_settings(file), once=True)
    again.close()
    assert again.actuators.false_alarms_per_1000_h == pytest.approx(0.002)
    _, state = again.store.checkpoint("press 1")
    pending = again.store.pending("press 1")
    assert (state["watch"]["false_alarms_per_1000_h"], pending) == (0.001, [])
    assert "oil_celsius" in next(again.store.estimates())
    assert len(shown) == 2
    assert again.actuators.summaries() == shown
    assert [alarm["state"] for alarm in again.store.alarms(open_only=True)] == ["new"]
    assert again.actuators.apply_mark("press 1", "valid").state == "valid"


def test_all_may_be_kept(tmp_path):
    settings = settings_in(tmp_path).model_copy(update={"keep_days": math.inf})
    service, _ = served(settings, b"".join(LINES.splitlines(keepends=True)[:20]))
    assert len(rows_of(service.settings.database)["estimates"]) > 0


@pytest.mark.slow
def test_old_estimates_and_identities_are_forgotten(tmp_path, monkeypatch):
    monkeypatch.setattr("sealscope.monitor.actuators.MAX_IDENTITIES", 20)
    settings = settings_in(tmp_path).model_copy(update={"keep_days": 60.0 / 86_400.0})
    served(settings, LINES)
    rows = rows_of(settings.database)
    for name in ("press 1", "press 2"):
        numbers = [row[1] for row in rows["estimates"] if row[0] == name]
        assert numbers == list(range(min(numbers), 45))
        assert 19 <= len(numbers) <= 19 + 16 + 1
        assert 20 <= sum(row[0] == name for row in rows["blocks"]) < 20 + 16
    assert len(rows["alarms"]) == 1


def test_one_monitor_at_a_time(tmp_path):
    settings = settings_in(tmp_path)
    first = Service(settings, once=True)
    with refusal("monitor"):
        Service(settings)
    first.close()


def test_the_commented_file_is_valid(tmp_path):
    file = tmp_path / "monitor.toml"
    file.write_text(template(), encoding="utf-8")
    settings = read_settings(file)
    assert settings.actuator[0].folder == tmp_path / "press 1"
    uncommented = "\n".join(line[2:] if line.startswith("# simulate") else line for line in template().splitlines())
    file.write_text(uncommented, encoding="utf-8")
    (actuator,) = read_settings(file).actuator
    assert actuator.simulate is not None
    assert actuator.simulate.speed == 20.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("lines = true", "lines = 3"), "lines"),
        (("learn_hours = 0.02", "learn_hours = -1"), "learn_hours"),
        (("error_lpm", "eror_lpm"), "eror_lpm"),
        (
            ("[defaults]", "fleet_false_alarms_per_1000_h = 1\n[defaults]\nfalse_alarms_per_1000_h = 2"),
            "false_alarms_per_1000_h, fleet_false_alarms_per_1000_h",
        ),
        (('name = "press 2"', 'name = "press 1"'), "'press 1'"),
        (('name = "press 2"', 'name = "press 2"\ntopic = "a"'), "[mqtt]"),
        (("[defaults]", '[page]\nhost = "0.0.0.0"\n[defaults]'), "page.token_file"),
        (("[defaults]", "[defaults"), "TOML"),
    ],
)
def test_wrong_settings_are_one_clear_line(tmp_path: Path, change: tuple[str, str], words: str):
    settings_in(tmp_path)
    file = tmp_path / "monitor.toml"
    file.write_text(file.read_text().replace(*change))
    with refusal(*words.split(", "), str(file)):
        read_settings(file)


DEVICE = '[[actuator]]\nname = "{}"\nsparkplug = "{}"\n'
NODES = '[[actuator]]\nname = "press 3"\nnodes = {{ {} = "i=1" }}\n{}\n'
SERVER = '[opcua]\nurl = "opc.tcp://localhost:4840"\n'


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("[sparkplug]\n", "[mqtt]"),
        (DEVICE.format("a", "g/n") + DEVICE.format("b", "g/n") + "[mqtt]\n", "'g/n'"),
        (DEVICE.format("a", "Sealscope/monitor/x") + "[mqtt]\n[sparkplug]\n", "nodes"),
        (DEVICE.format("a/1", "g/n") + DEVICE.format("a#1", "g/m") + "[mqtt]\n[sparkplug]\n", "names"),
        *((DEVICE.format("a", path) + "[mqtt]\n", "sparkplug") for path in ("g", "g/+/d", "g//d", "g/n/d/e")),
        (NODES.format("x", "rate = 50.0"), "'press 3', [opcua]"),
        (NODES.format("x", "") + SERVER, "[opcua], rate"),
        (NODES.format("valve", "rate = 50.0") + SERVER, "nodes, x, theta"),
        ('[opcua]\nurl = "opc.tcp://user:secret@localhost"\n', "opcua.url"),
        (NODES.format("theta", "rate = 50.0") + SERVER, "'press 3', p_A and p_B, theta"),
        *(
            (f'[webhook]\nurl = "{url}"\n', "webhook.url")
            for url in ("ftp://host/x", "http://user:password@host/", "file:///etc/passwd", "host")
        ),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(tmp_path: Path, more: str, words: str):
    with refusal(*words.split(", ")):
        settings_in(tmp_path, more)


def test_a_table_of_leases_is_refused(tmp_path: Path):
    with refusal("share"):
        settings_in(tmp_path, '[share]\nname = "a"\n', "postgresql://nowhere/monitor")


def test_settings_that_nobody_edited_complain_once(tmp_path, monkeypatch, caplog):
    """The folder of the template's actuator is not there: one line, however often it is looked for."""
    monkeypatch.setattr("sealscope.monitor.sources.folder._LOOK_S", 0.05)
    file = tmp_path / "monitor.toml"
    file.write_text(template().replace("8765", "0"), encoding="utf-8")
    service = Service(read_settings(file), stdin=io.BytesIO())
    running = threading.Thread(target=service.run)
    running.start()
    until(service.supervisor.outages)
    time.sleep(0.4)  # longer than between two looks at the folder
    service.stop()
    running.join()
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert service.summaries()["press 1"]["state"]["condition"] == "no data"
