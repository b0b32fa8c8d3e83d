"""`sealscope monitor`: its file of settings, and its complaints."""

from __future__ import annotations

import json
import sqlite3

import numpy as np
import pytest

import sealscope as ss
from sealscope.monitor.database.store import MonitorStore

from ..diagnosis.balance_machine import machine, step
from ..monitor.plant import write_files


@pytest.mark.slow
def test_files_of_a_folder_end_in_one_alarm(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_files(tmp_path / "press 1", machine(1, G=step(0.0, 3.0e-13, at=100.0), duration=130.0, rate=50.0), 130.0)
    first = call("monitor", "init")
    assert (first.status, first.out) == (0, "monitor.toml: written; sealscope monitor monitor.toml\n")
    file = tmp_path / "monitor.toml"
    file.write_text(file.read_text().replace("learn_hours = 8.0 ", "learn_hours = 0.02"))
    again = call("monitor", "monitor.toml", "--once")
    assert (again.status, again.err) == (0, "")
    (event,) = [json.loads(line) for line in again.out.splitlines()]
    assert (event["event"], event["alarm"]["actuator"]) == ("raised", "press 1")
    assert (tmp_path / "monitor.db").exists()


@pytest.mark.slow
def test_a_machine_s_file_beside_the_settings_says_how_its_logs_are_read(call, tmp_path):
    """Wherever the monitor is started: a log with headers of its own is taken in by the machine's file alone."""
    logs = tmp_path / "logs"
    logs.mkdir()
    run = ss.simulate(command="3 sin(4t)", duration="20 s", seed=1)
    rows = np.column_stack([run.t, run["p_A"] / 1e5, run["p_B"] / 1e5, run["x"] * 1e3, run["omega"] * 30.0 / np.pi])
    header = "time_s,p_bottom_bar,p_rod_bar,stroke_mm,motor_rpm"
    np.savetxt(logs / "press.csv", rows, "%.9g", ",", header=header, comments="")
    ss.write_machine(ss.commission(logs, rig="thesis", map="auto"), tmp_path / "press.toml")
    file = tmp_path / "monitor.toml"
    file.write_text('[[actuator]]\nname = "press"\nfolder = "logs"\nrig = "press.toml"\n')
    done = call("monitor", file, "--once")
    assert (done.status, done.err) == (0, "")
    with sqlite3.connect(tmp_path / "monitor.db") as database:
        assert database.execute("SELECT count(*) FROM refused").fetchone() == (0,)
    assert ss.load_rig(tmp_path / "press.toml").channel_map == {"*": "auto"}


def test_what_exists_is_not_overwritten(call, tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("mine")
    assert "must not exist yet" in call("monitor", "init", "-o", file).refused()
    assert file.read_text() == "mine"


def test_wrong_settings_are_one_line(call, tmp_path):
    file = tmp_path / "monitor.toml"
    assert "must be readable" in call("monitor", file).refused()
    file.write_text("[[actuator]]\nname = 3\n")
    assert call("monitor", file).refused().startswith("actuator[1].name must be a valid string, got 3")
    file.write_text('database = "nowhere/monitor.db"\n[[actuator]]\nname = "a"\n')
    assert "nowhere" in call("monitor", file, "--once").refused()


def test_a_dashboard_and_labelled_data_are_written(call, tmp_path):
    done = call("monitor", "dashboard", "-o", tmp_path / "grafana.json")
    assert (done.status, done.err) == (0, "")
    assert json.loads((tmp_path / "grafana.json").read_text())["panels"]
    settings = tmp_path / "monitor.toml"
    call("monitor", "init", "-o", settings)
    words = ("monitor", "export", settings, "-o", tmp_path / "labels")
    assert f"database must exist, got none ({tmp_path / 'monitor.db'})" in call(*words).refused()
    assert not (tmp_path / "monitor.db").exists()
    MonitorStore(str(tmp_path / "monitor.db"))
    done = call(*words)
    assert (done.status, done.out) == (0, f"{tmp_path / 'labels'}: 0 alarms, 0 estimates\n")
    assert (tmp_path / "labels" / "estimates.csv").read_text().startswith("actuator,t,status")
