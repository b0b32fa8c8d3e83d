"""What the screens do is what the command line does: the machine's file, the verdicts, the replay, mended logs."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import sealscope as ss
from sealscope.app.scripts import write_script
from sealscope.app.server import replay_session
from sealscope.app.workbench import areas_of, to_point
from sealscope.cli.app import app as command_line
from sealscope.diagnosis.flow_curves import compute_flow_curves
from sealscope.errors import InputError

from .conftest import settle, tell


@pytest.fixture
def commissioned(bench, client, logs: Path):
    """The workbench after a machine was commissioned from five days and the suspect log was judged."""
    tell(client, "open", path=str(logs))
    rows = settle(bench)["rows"]
    keys = [row["key"] for row in rows if row["name"].startswith("day")]
    assert len(keys) == 5 and all(row["state"] == "read" for row in rows)
    values = {"displacement": "1,02 cm^3/rev", "limit": "15 mL/min"}
    tell(client, "machine", machine="press 7", values=values)
    tell(client, "mark", machine="press 7", files=keys, mark="healthy")
    tell(client, "commission", machine="press 7")
    settle(bench)
    suspect = next(row["key"] for row in rows if row["name"] == "suspect.csv")
    tell(client, "judge", machine="press 7", files=[suspect])
    settle(bench)
    return suspect


def run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, check=False, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_copied_commands_do_the_same(bench, client, commissioned: str) -> None:
    """The machine's file is the command line's byte for byte but its date, and the verdict is the same."""
    folder = bench.folder.folder
    written = (folder / "press 7.toml").read_text(encoding="utf-8")
    summaries = (folder / "press 7.healthy").read_bytes()
    script = write_script(bench, "healthy", "press 7", commissioned)
    elsewhere = folder.parent / "elsewhere"
    elsewhere.mkdir()
    sealscope = [sys.executable, "-m", "sealscope"]
    words = shlex.split(script["command"])
    assert words[0] == "sealscope"
    run([*sealscope, *words[1:]], elsewhere)
    undated = re.compile(r'^written = "[^"]*"$', re.MULTILINE)
    again = (elsewhere / "press 7.toml").read_text(encoding="utf-8")
    assert undated.sub("", again) == undated.sub("", written)
    assert (elsewhere / "press 7.healthy").read_bytes() == summaries
    kept = bench.folder.read().find_machine("press 7").verdicts[0]
    assert kept.verdict == "leak" and kept.leak_lpm is not None
    judged = write_script(bench, "verdict", "press 7", commissioned)
    output = run([*sealscope, *shlex.split(judged["command"])[1:], "--format", "jsonl"], folder)
    assert f'"leak_lpm": {kept.leak_lpm!r}' in output and '"verdict": "leak"' in output
    told = run([sys.executable, "-c", judged["python"]], folder)
    assert told.startswith(commissioned) and ": leak" in told


@pytest.mark.slow
def test_a_session_is_replayed_with_equal_verdicts(bench, client, commissioned: str) -> None:
    lines: list[str] = []
    assert replay_session(bench.folder.folder, lines.append)
    assert "1 verdicts, equal to those of the session" in lines[-1]
    file = bench.folder.file
    text = file.read_text(encoding="utf-8")
    file.write_text(re.sub(r"leak_lpm = [\d.e-]+", "leak_lpm = 0.5", text), encoding="utf-8")
    assert not replay_session(bench.folder.folder, lines.append)


@pytest.mark.slow
def test_opinions_reports_and_the_watch(bench, client, commissioned: str) -> None:
    tell(client, "opinion", machine="press 7", file=commissioned, opinion="confirmed")
    assert bench.folder.read().find_machine("press 7").verdicts[0].opinion == "confirmed"
    page = tell(client, "report", machine="press 7", file=commissioned)
    answer = client.get(page["address"])
    assert answer.status_code == 200 and "suspect.csv" in answer.text
    assert answer.headers["content-security-policy"].startswith("sandbox")
    watch = tell(client, "watch", machine="press 7", folder=str(Path(commissioned).parent))
    assert (bench.folder.folder / watch["file"]).read_text(encoding="utf-8").startswith("# Settings")
    learnt = client.get("/api/learnt", params={"machine": "press 7"}).json()
    assert learnt["count"] == 5 and learnt["smallest"]["lpm"] > 0
    state = client.get("/api/state").json()
    version = state["version"]
    assert client.get("/api/state", params={"since": version}).json()["rows"] == []


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_the_curves_of_the_balance_add_up(seed: int) -> None:
    """Pump flow is the sum of its parts at every sample, and the leak of a recording is in the leakage's curve."""
    draw = np.random.default_rng(seed)
    leak = draw.uniform(0.03, 0.08)
    run = ss.simulate(duration="24 s", seed=seed, leak=f"{leak:.3f} L/min from 12 s")
    curves = compute_flow_curves(run, ss.load_rig("thesis"))
    assert curves is not None and curves.states_flow
    total = np.sum(list(curves.parts.values()), axis=0)
    assert np.allclose(total, curves.delivered, atol=1e-12 * np.ptp(curves.delivered))
    flow = np.abs(np.diff(curves.parts["leakage"])) * run.rate * 60_000  # [L/min]
    first, second = flow[: len(flow) // 2 - 1000].mean(), flow[len(flow) // 2 + 1000 :].mean()
    assert first < 0.2 * leak and second == pytest.approx(leak, rel=0.25)
    assert curves.blocks[:, 2].sum() == pytest.approx(1.0)
    assert compute_flow_curves(run.only(["p_A"])) is None and compute_flow_curves(run, None, "B") is None


@pytest.mark.slow
def test_behind_a_servo_valve_each_chamber_has_curves_that_add_up() -> None:
    run = ss.simulate(rig="servo-valve", duration="20 s", seed=1)
    for side, other in ("AB", "BA"):
        curves = compute_flow_curves(run, None, side)
        assert curves is not None and curves.source == "piston"
        assert f"compression {side}" in curves.parts and f"compression {other}" not in curves.parts
        total = np.sum(list(curves.parts.values()), axis=0)
        assert np.allclose(total, curves.delivered, atol=1e-12 * np.ptp(curves.delivered))
        rest = curves.delivered - curves.parts["valve"] - curves.parts["leakage"]
        assert np.ptp(rest) < 0.02 * np.ptp(curves.delivered)


def test_a_wrong_layout_is_mended_and_previewed(bench, client, tmp_path: Path, monkeypatch) -> None:
    """A log with stamps of no known form is read after its form is stated; the lines come back unchanged."""
    rows = [f"05.06.2026 12h{k // 600:02d}m{k / 10 % 60:04.1f};{100 + k % 7},5;{50 + k % 5}" for k in range(700)]
    log = tmp_path / "odd.txt"
    log.write_text("\n".join(["Prüfstand 7", "Zeit;p_A [bar];p_B [bar]", *rows]) + "\n", encoding="utf-8")
    tell(client, "open", path=str(log))
    row = settle(bench)["rows"][0]
    assert row["state"] == "unreadable" and row["error"]
    layout = {"first_row": "3", "time_format": "%d.%m.%Y %Hh%Mm%S.%f"}
    seen = client.get("/api/preview", params={"file": row["key"], **layout}).json()
    assert seen["problem"] == "" and seen["rows"][1] == ["2026-06-05T12:00:00.100000", "101.5", "51"]
    wrong = client.get("/api/preview", params={"file": row["key"], "time_format": "%Y"}).json()
    assert "time must read %Y" in wrong["problem"]
    assert tell(client, "mend", file=row["key"], layout=layout) == {"rows": 700}
    row = settle(bench)["rows"][0]
    assert row["state"] == "read" and row["mended"] and row["rate"] == pytest.approx(10.0)
    assert log.read_text(encoding="utf-8").startswith("Prüfstand")  # the log itself is not changed
    script = write_script(bench, "logs", "", row["key"])
    target = bench.folder.path_of(row["key"])
    mended = target.read_bytes()
    target.unlink()
    monkeypatch.chdir(bench.folder.folder)
    command = CliRunner().invoke(command_line, shlex.split(script["command"])[1:], catch_exceptions=False)
    assert command.exit_code == 0 and target.read_bytes() == mended
    target.unlink()
    exec(script["python"], {})  # the lines as they are copied
    assert target.read_bytes() == mended


def test_columns_are_mapped_by_hand_and_drawn(bench, client, tmp_path: Path) -> None:
    log = tmp_path / "raw.csv"
    t = np.arange(2000) / 100
    body = [f"{a:.2f},{512 + 100 * np.sin(a):.0f},{300 + 50 * np.cos(a):.0f},word" for a in t]
    log.write_text("\n".join(["time [s],ch1,ch2,state", *body]) + "\n", encoding="utf-8")
    tell(client, "open", path=str(log))
    settle(bench)
    key = str(log)
    tell(
        client,
        "machine",
        machine="m",
        values={"map": {"p_A": "ch1*0.1-5 bar", "p_B": "ch2[kPa]"}, "bore": "63 mm", "rod": "36,5 mm"},
    )
    window = client.get(
        "/api/window", params={"file": key, "machine": "m", "table": "columns", "columns": "0,1,2"}
    ).json()
    assert window["names"] == ["ch1", "ch2", "state"] and window["lines"][2][0] is None
    assert max(window["lines"][0]) == 612
    balance = {"file": key, "machine": "m", "table": "balance", "columns": ""}
    while not (head := client.get("/api/window", params=balance).json())["complete"]:
        assert not head["error"]
    assert head["about"]["checks"] == [] and "no balance of volumes" in head["about"]["problem"]
    read = client.get("/api/channels", params={"file": key, "machine": "m"}).json()
    assert read["channels"] == ["p_A", "p_B"] and read["units"] == {"p_A": "bar", "p_B": "kPa"}
    machine = bench.folder.read().find_machine("m")
    assert machine.area == areas_of("63 mm", "36.5 mm", "B") and machine.area[0].startswith("3117")
    svg = client.get("/api/drawing", params={"machine": "m", "channels": "p_A"}).json()["svg"]
    assert 'data-channel="p_A"' in svg and "single-rod" in svg
    answer = client.get("/api/limit", params={"machine": "m", "text": "5,2 mL/min"}).json()
    assert answer["text"] == "5.2 mL/min" and answer["lpm"] == pytest.approx(0.0052)
    tell(client, "machine", machine="m", values={"displacement": "10 cm^3/rev"})
    share = client.get("/api/limit", params={"machine": "m", "text": "2 %", "rpm": "3000 rpm"}).json()
    assert share["lpm"] == pytest.approx(0.6)


@pytest.mark.parametrize(("text", "point"), [("5,2 mL/min", "5.2 mL/min"), ("1,5", "1.5"), ("1,000,000", "1,000,000")])
def test_decimal_commas(text: str, point: str) -> None:
    assert to_point(text) == point


def test_a_rod_must_be_thinner_than_the_bore() -> None:
    with pytest.raises(InputError):
        areas_of("36 mm", "63 mm", "B")


def test_groups_of_actuators_are_kept_apart(bench, client, tmp_path: Path) -> None:
    quantities = ("pA [bar]", "pB [bar]", "x [mm]")
    heading = ",".join(["t [s]", *(f"Press {number} {quantity}" for number in (1, 2) for quantity in quantities)])
    log = tmp_path / "two.csv"
    log.write_text("\n".join([heading, *(f"{k / 100},{k},{k % 7},1,{2 * k},{k % 5},2" for k in range(500))]) + "\n")
    tell(client, "open", path=str(log))
    settle(bench)
    tell(client, "machine", machine="press", values={})
    groups = client.get("/api/proposal", params={"file": str(log), "machine": "press"}).json()["groups"]
    assert len(groups) == 2
    for number, group in enumerate(groups, 1):
        tell(client, "machine", machine=f"press {number}", values={"map": {"*": "auto", "group": group}})
        read = client.get("/api/channels", params={"file": str(log), "machine": f"press {number}"}).json()
        assert read["channels"] == ["p_A", "p_B", "x"] and all(f"Press {number}" in c for c in read["columns"].values())


def test_a_hold_is_judged_as_the_command_line_does(bench, client, tmp_path: Path) -> None:
    t = np.arange(0.0, 300.0, 0.5)
    x = 200.0 - 0.02 * t + np.random.default_rng(3).normal(0, 0.01, len(t))
    rows = [f"{a:.1f},{b:.4f},{110.0 - 0.001 * a:.3f}" for a, b in zip(t, x, strict=True)]
    log = tmp_path / "held.csv"
    log.write_text("\n".join(["t [s],x [mm],p_A [bar]", *rows]) + "\n", encoding="utf-8")
    tell(client, "open", path=str(log))
    settle(bench)
    tell(client, "machine", machine="m", values={"area": ["3117 mm^2"], "hold": {"limit": "24 mm in 3 min"}})
    (result,) = client.get("/api/hold", params={"machine": "m", "file": str(log)}).json()["results"]
    (expected,) = ss.hold_test(ss.read(log), area="3117 mm^2", limit="24 mm in 3 min", file=log)
    assert result["result"] == "pass" and result["creep_mm_per_min"] == pytest.approx(1.2, abs=0.05)
    assert result["leak_lpm"] == expected.leak_lpm and len(result["curve"]["t"]) == len(result["curve"]["fit"])
    assert write_script(bench, "hold", "m", str(log))["command"].endswith("--limit '24 mm in 3 min'")
    page = tell(client, "hold-page", machine="m", file=str(log))
    assert client.get(page["address"]).status_code == 200
    answer = client.get("/api/hold", params={"machine": "m", "file": ""})
    assert answer.status_code == 400 and "collected" in answer.json()["error"]


def test_a_job_is_cancelled_and_the_next_is_done(bench) -> None:
    reached: list[int] = []

    def work(job) -> None:
        for step in range(1000):
            job.progress(step, 1000)
            reached.append(step)
            if step == 3:
                bench.work.cancel(job.number)

    first = bench.work.submit("count", "to 1000", work)
    second = bench.work.submit("count", "to 1", lambda job: job.progress(1, 1))
    third = bench.work.submit("fail", "at once", lambda job: {}[job])
    settle(bench)
    assert (first.state, second.state, third.state) == ("cancelled", "done", "failed")
    assert reached == [0, 1, 2, 3] and "KeyError" in third.error
