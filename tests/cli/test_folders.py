"""The tutorial `folders` from one end to the other: logs of several loggers to a watched machine, on all surfaces."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

import sealscope as ss
from sealscope.monitor.page.site import site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import PageSettings, read_settings
from sealscope.reporting import messages

LEAK = 0.03
COLUMNS = {
    "time_s": ("t", 1.0),
    "p_bottom_bar": ("p_A", 1e-5),
    "p_rod_bar": ("p_B", 1e-5),
    "stroke_mm": ("x", 1e3),
    "motor_rpm": ("omega", 30.0 / np.pi),
}
GERMAN = dict(
    zip(("Zeit [s]", "Druck A [bar]", "Druck B [bar]", "Weg [mm]", "Drehzahl [1/min]"), COLUMNS.values(), strict=True)
)
WATCH = """
settle_s = 0.0
[[actuator]]
name = "press"
machine = "press.toml"
folder = "incoming"
"""


def write_log(path: Path, recording: ss.Recording, columns: Mapping[str, tuple[str, float]], cells: str = ",.") -> None:
    """Write a text log; `cells`: its delimiter and decimal sign."""
    delimiter, decimal = cells
    values = [(recording.t if name == "t" else recording[name]) * factor for name, factor in columns.values()]
    rows = [delimiter.join(f"{value:.7g}".replace(".", decimal) for value in row) for row in np.transpose(values)]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([delimiter.join(columns), *rows]) + "\n", encoding="utf-8")


def write_logs(folder: Path) -> None:
    """Write five healthy days as five loggers do, a healthy suspect and two that leak."""

    def run(seed: int, leak: str = "none") -> ss.Recording:
        return ss.simulate(command="3 sin(4t)", leak=leak, duration="60 s", seed=seed)

    healthy = folder / "healthy"
    write_log(healthy / "press_2026-04-01_0600.csv", run(1), COLUMNS)
    write_log(healthy / "press_2026-04-02_0600.txt", run(2), GERMAN, "\t.")
    write_log(healthy / "press_2026-04-03_0600.csv", run(3), GERMAN, ";,")
    for seed, kind in ((4, "nc"), (5, "parquet")):
        ss.write(run(seed).only(["p_A", "p_B", "x", "omega"]), healthy / f"press_2026-04-{seed:02d}_0600.{kind}")
    write_log(folder / "suspect/press_2026-04-20_0600.csv", run(20), COLUMNS)
    write_log(folder / "suspect/press_2026-04-21_0600.csv", run(21, f"{LEAK} L/min"), COLUMNS)
    write_log(folder / "suspect/press_2026-04-22_0600.csv", run(22, f"{LEAK} L/min"), COLUMNS)


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    folder = tmp_path_factory.mktemp("press")
    write_logs(folder)
    return folder


def shown_by(service: Service) -> tuple[dict, dict]:
    """Return what the page shows of the actuator, and its metrics by name."""
    page = TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")
    (row,) = page.get("/api/fleet").json()["actuators"]
    families = text_string_to_metric_families(page.get("/metrics").text)
    return row, {own.name: own.samples[0].value for own in families if own.samples}


@pytest.mark.slow
def test_from_logs_of_several_loggers_to_a_watched_machine(press, call, monkeypatch):
    monkeypatch.chdir(press)
    areas = ("--area", "633 mm^2", "--displacement", "4.9 cm^3/rev")
    commissioned = call("commission", "healthy", "--map", "auto", *areas, "-o", "press.toml")
    assert (commissioned.status, commissioned.err) == (0, "")
    assert "5 healthy" in commissioned.out or commissioned.out.count("press_2026-04-0") == 5

    # terminal and JSON
    judged = call("diagnose", "suspect", "--machine", "press.toml", "--format", "jsonl")
    healthy, first, leaking = map(json.loads, judged.out.splitlines())
    assert [day["verdict"] for day in (healthy, first, leaking)] == ["no leak", "leak", "leak"]
    low, high = leaking["leak_interval_lpm"]
    assert low <= LEAK <= high and healthy["bound_lpm"] < LEAK
    machine = ss.read_machine("press.toml")
    diagnosis = machine.diagnose("suspect/press_2026-04-22_0600.csv")
    assert diagnosis.leak_lpm == leaking["leak_lpm"]
    table = call("diagnose", "suspect", "--machine", "press.toml").out
    assert messages.format_leak_flow(diagnosis) in table and "2026-04-22" in table
    step = messages.next_steps(diagnosis)[0]
    terminal = call("diagnose", "suspect/press_2026-04-22_0600.csv", "--machine", "press.toml").out
    for words in (messages.how_much(diagnosis), messages.since(diagnosis), messages.state_text(diagnosis.state), step):
        assert words in " ".join(terminal.split())

    # pages
    page = ss.report(machine.read("suspect/press_2026-04-22_0600.csv"), "leak.html", diagnosis, rig=machine.rig)
    written = page.read_text(encoding="utf-8")
    assert messages.how_much(diagnosis) in written
    assert f'class="verdict state-{leaking["state"]["symbol"]}"' in written
    assert call("report", "suspect/press_2026-04-22_0600.csv", "--machine", "press.toml", "-o", "own.html").status == 0
    assert "<title>press: leak" in Path("own.html").read_text(encoding="utf-8")
    assert call("report", "healthy", "suspect", "--machine", "press.toml", "-o", "press.html").status == 0
    history = Path("press.html").read_text(encoding="utf-8")
    assert messages.format_leak_flow(diagnosis) in history and "<title>press:" in history

    # trend
    trend = call("trend", "healthy", "suspect", "--machine", "press.toml", "-o", "trend.html")
    assert trend.status == 0, trend.err
    drawn = Path("trend.html").read_text(encoding="utf-8")
    assert "<title>press:" in drawn and "The first 5 recordings are taken to be of a healthy machine" in drawn
    assert "2026-04-01 to 2026-04-22" in trend.out

    # watched folder and alarm, the files in any order
    Path("watch.toml").write_text(WATCH, encoding="utf-8")
    incoming = Path("incoming")
    incoming.mkdir()
    for file in sorted(Path("healthy").iterdir(), reverse=True):
        (incoming / file.name).write_bytes(file.read_bytes())
    assert call("monitor", "watch.toml", "--once").out == ""
    # one day beyond five healthy ones may be chance, two are an alarm
    suspects = [Path(f"suspect/press_2026-04-{day}_0600.csv") for day in (21, 22)]
    (incoming / suspects[0].name).write_bytes(suspects[0].read_bytes())
    assert call("monitor", "watch.toml", "--once").out == ""
    suspect = suspects[1]
    (incoming / suspect.name).write_bytes(suspect.read_bytes())
    (event,) = map(json.loads, call("monitor", "watch.toml", "--once").out.splitlines())
    alarm = event["alarm"]
    assert event["event"] == "raised"
    assert alarm["next_check"] == leaking["next_check"] == step
    figures = pytest.approx([leaking["leak_lpm"], low, high], rel=1e-9)
    assert [alarm["leak_lpm"], *alarm["leak_interval_lpm"]] == figures

    # monitor page and metrics, after a restart
    service = Service(read_settings(Path("watch.toml")), once=True)
    row, metrics = shown_by(service)
    assert row["alarm"]["id"] == alarm["id"]
    assert metrics["sealscope_leak_lpm"] == pytest.approx(row["leak_lpm"])
    assert [metrics[f"sealscope_leak_{end}_lpm"] for end in ("low", "high")] == row["leak_interval_lpm"]
    assert [row["leak_lpm"], *row["leak_interval_lpm"]] == figures
    assert row["recording"]["size"] == messages.how_much(diagnosis)
    assert row["state"]["name"] == leaking["state"]["name"] and row["state"]["action"] == step
    assert metrics["sealscope_severity"] == leaking["state"]["severity"]
    assert row["state"]["since_s"] == pytest.approx(1776751200.0, abs=86_400.0)  # of 2026-04-22, not of today

    # mark, and restart
    service.actuators.apply_mark("press", "valid", by_whom="A. B.")
    service.close()
    assert "press-1 valid" in str(ss.read_machine("press.toml"))
    again = Service(read_settings(Path("watch.toml")), once=True)
    row, _ = shown_by(again)
    again.close()
    assert row["alarm"]["state"] == "valid"
    refused = call("commission", suspect, "--add", "-o", "press.toml")
    assert refused.status != 0 and "leak" in refused.err
