"""What a person says of an alarm reaches the file of the commissioned machine."""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

import sealscope as ss
from sealscope.monitor.actuators import WatchedActuators
from sealscope.monitor.database.machine_files import record_mark
from sealscope.monitor.service import Service
from sealscope.monitor.supervisor import LimitedLines

from ..diagnosis.balance_machine import machine, step
from ..refusals import refusal
from .plant import lines_of, served, settings_in

NAME = "press 1"


def worn(G: float) -> ss.Recording:
    """A machine that passes more from second 100 on, one day in November 2023."""
    recording = machine(1, G=step(0.0, G, at=100.0), duration=130.0, rate=50.0)
    return replace(recording, t=recording.t + 1.7e9)


WORN = worn(3.0e-13)


@pytest.fixture(scope="module")
def commissioned(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Path]:
    """Files of a machine whose healthy recordings pass nothing, and as much as the worn one."""
    files = {}
    for G in (0.0, 3.0e-13):
        folder = tmp_path_factory.mktemp("healthy")
        for seed in range(11, 13):
            ss.write(machine(seed, G=G, duration=30.0, rate=50.0), folder / f"run{seed}.nc")
        files[G] = ss.write_machine(ss.commission(folder, rig="thesis"), folder / "press.toml")
    return files


def alarmed(folder: Path, file: Path, recording: ss.Recording = WORN) -> Service:
    """A monitor that has raised an alarm of an actuator whose rig is a copy of a machine's file."""
    for each_file in (file, file.with_suffix(".healthy")):
        (folder / each_file.name).write_bytes(each_file.read_bytes())
    (folder / "settings").mkdir()
    settings = settings_in(folder / "settings")
    own = [replaced(each, folder / "press.toml") for each in settings.actuator]
    return served(settings.model_copy(update={"actuator": own}), lines_of({NAME: recording}, 150))[0]


def replaced(settings, rig):
    """The settings with a machine that is watched by blocks alone, which raise an alarm within seconds."""
    changes = {"rig": str(rig), "recording_s": 0.0}
    return settings.model_copy(update=changes) if settings.name == NAME else settings


def said_by(actuators: WatchedActuators) -> str:
    event = actuators.store.last_events(NAME)[0]
    assert (event["event"], event["by"]) == ("comment", "Sealscope")
    return event["text"]


def test_the_samples_of_an_invalid_alarm_are_taught(tmp_path, commissioned):
    service = alarmed(tmp_path, commissioned[3.0e-13])
    service.actuators.apply_mark(NAME, "invalid", text="another valve", by_whom="Ada")
    assert said_by(service.actuators) == "press.toml: mark stored, samples added as healthy"
    before, after = (ss.read_machine(tmp_path / f"press.toml{end}") for end in (".bak", ""))
    assert (len(before.healthy), len(after.healthy)) == (2, 3)
    (taught,) = [own for own in after.healthy if own.file == f"{NAME}-1"]
    assert WORN.t[0] + 100.0 < taught.start_s < WORN.t[-1]
    (alarm,) = after.alarms
    assert (alarm.mark, alarm.reason, alarm.leak_lpm) == ("invalid", "another valve", None)


def test_samples_that_leak_are_not_taught_whatever_is_said(tmp_path, commissioned):
    service = alarmed(tmp_path, commissioned[0.0], worn(1.0e-11))
    service.actuators.apply_mark(NAME, "invalid", text="no oil seen")
    assert said_by(service.actuators).startswith(
        "press.toml: mark stored, samples not added: a healthy recording must not leak"
    )
    assert len(ss.read_machine(tmp_path / "press.toml").healthy) == 2


@pytest.mark.slow
def test_nothing_is_taught_from_the_onset_of_a_valid_alarm_on_until_the_repair(tmp_path, commissioned):
    file = tmp_path / "press.toml"
    service = alarmed(tmp_path, commissioned[3.0e-13])
    service.actuators.apply_mark(NAME, "valid")
    assert said_by(service.actuators) == "press.toml: mark stored"
    known = ss.read_machine(file)
    (alarm,) = known.alarms
    assert alarm.onset_s == pytest.approx(WORN.t[0] + 100.0, abs=2.0)
    assert alarm.leak_lpm == pytest.approx(0.00195, rel=0.3)
    assert f"{NAME}-1 valid {datetime.now(UTC).date()}" in str(known)

    def healthy(start: float, seed: int = 20) -> ss.Recording:
        made = {"start": datetime.fromtimestamp(start, UTC).replace(tzinfo=None).isoformat()}
        return replace(machine(seed, G=3.0e-13, duration=30.0, rate=50.0), provenance=made)

    early, late = healthy(alarm.onset_s - 3600.0), healthy(alarm.date_s + 3600.0)
    assert len(known.with_healthy(early).healthy) == 3
    with refusal("press 1-1", "valid"):
        known.with_healthy(late)
    service.actuators.apply_mark(NAME, "repaired")
    again = ss.read_machine(file).with_healthy(late)
    assert len(again.since(alarm.date_s).healthy) == 1
    with refusal("leak"):
        again.with_healthy(healthy(alarm.onset_s + 3600.0, 21))


@pytest.mark.long
@pytest.mark.slow
def test_the_last_word_on_an_alarm_counts(tmp_path, commissioned):
    """An alarm that was valid and is invalid holds no teaching up: not of its samples, nor of later recordings."""
    service = alarmed(tmp_path, commissioned[3.0e-13])
    service.actuators.apply_mark(NAME, "valid")
    service.actuators.apply_mark(NAME, "invalid", text="another valve")
    assert said_by(service.actuators) == "press.toml: mark stored, samples added as healthy"
    known = ss.read_machine(tmp_path / "press.toml")
    assert [own.mark for own in known.alarms] == ["valid", "invalid"]
    later = known.alarms[1].date_s + 120.0
    made = {"start": datetime.fromtimestamp(later, UTC).replace(tzinfo=None).isoformat()}
    late = replace(machine(20, G=3.0e-13, duration=30.0, rate=50.0), provenance=made)
    assert len(known.with_healthy(late).healthy) == 4
    again = known.alarms[0]._replace(onset_s=later - 60.0, date_s=later)
    with refusal("leak"):  # another alarm, of a database that counts from 1 again
        replace(known, alarms=(*known.alarms, again)).with_healthy(late)


@pytest.mark.slow
def test_without_samples_or_a_file_it_says_so(tmp_path, commissioned):
    service = alarmed(tmp_path, commissioned[0.0])
    service.actuators.apply_mark(NAME, "comment", text="its checkpoint takes the place of the samples")
    again = WatchedActuators([*service.actuators.settings.values()], service.store)
    again.apply_mark(NAME, "invalid", text="no oil seen")
    assert said_by(again).startswith(
        "press.toml: mark stored, samples not added: no samples of the alarm are kept: add its recording by"
    )
    (tmp_path / "gone").mkdir()
    service = alarmed(tmp_path / "gone", commissioned[0.0])
    (tmp_path / "gone" / "press.toml").write_text("[machine]\nformat = 1\n")
    service.actuators.apply_mark(NAME, "valid")
    assert said_by(service.actuators).startswith(
        "press.toml: mark not stored: machine.format must be 3, got 1: commission it anew"
    )


@pytest.mark.slow
def test_a_newline_in_the_name_of_an_alarm_makes_no_line(tmp_path, commissioned):
    service = alarmed(tmp_path, commissioned[3.0e-13])
    alarm = service.actuators._actuator(NAME).judge.alarm
    lines = str(ss.read_machine(tmp_path / "press.toml")).splitlines()
    forged = replace(alarm, id="press\n  alarm         valve-1 valid", reason="a\nb\x1b[31m\u2028c")
    assert record_mark(str(tmp_path / "press.toml"), forged, "valid", []) == "press.toml: mark stored"
    shown = str(ss.read_machine(tmp_path / "press.toml")).splitlines()
    assert len(shown) == len(lines) + 1
    assert all(line.isprintable() for line in shown)


def test_a_newline_in_a_name_makes_no_line_of_the_log():
    record = logging.LogRecord("sealscope", logging.WARNING, __file__, 1, "%s: begins anew", ("press\nforged",), None)
    assert LimitedLines().filter(record)
    assert record.getMessage() == "press\N{REPLACEMENT CHARACTER}forged: begins anew"
