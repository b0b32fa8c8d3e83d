"""`sealscope trend` as a user calls it."""

from __future__ import annotations

import csv
import io
import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

import sealscope as ss

DAYS = 8


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of eight days, `day_1.csv` to `day_8.csv`; from the sixth on 0.01 L/min leak."""
    folder = tmp_path_factory.mktemp("days")
    for k in range(1, DAYS + 1):
        leak = "0.01 L/min from 0 s" if k >= 6 else None
        day = ss.simulate(duration="20 s", rate=100.0, seed=k, leak=leak, set={"pump.G_pump": 2.4e-13})
        ss.write(replace(day, provenance={**day.provenance, "start": f"2024-05-{k:02d}T08:00"}), folder / f"day_{k}.nc")
    return folder


def test_a_folder_becomes_a_few_lines(call, days: Path) -> None:
    done = call("trend", days, "--healthy", 3)
    lines = done.out.splitlines()
    assert done.status == 0 and done.err == ""
    assert lines[0] == "leak since 2024-05-06: 8 recordings, 2024-05-01 to 2024-05-08"
    rows = [line.split()[0] for line in lines[1:] if line[2] != " "]
    assert rows == ["state", "total", "leak", "healthy", "since", "growth", "limit", "event", "next"]
    assert max(map(len, lines)) <= 80
    assert all("L/min" in line for line in lines[2:5])


def test_json_and_csv_hold_every_recording(call, days: Path, tmp_path: Path) -> None:
    done = call("trend", days, "--format", "json", "-o", tmp_path / "trend.csv", "--fail-on", "leak")
    tree = json.loads(done.out)
    assert done.status == 3
    assert tree["verdict"] == "leak" and len(tree["points"]) == DAYS and tree["unit"] == "L/min"
    rows = list(csv.DictReader(io.StringIO((tmp_path / "trend.csv").read_text())))
    assert [row["file"] for row in rows] == [f"day_{k}.nc" for k in range(1, DAYS + 1)]
    assert float(rows[-1]["level [L/min]"]) == tree["points"][-1]["value"]


@pytest.mark.long
@pytest.mark.slow
def test_the_order_of_files_does_not_matter(call, days: Path) -> None:
    files = [days / f"day_{k}.nc" for k in (3, 1, 2, 8, 7, 5, 6, 4)]
    assert call("trend", *files).out == call("trend", days).out


@pytest.mark.slow
def test_what_sealscope_wrote_into_the_folder_is_skipped_and_dates_are_enough(call, days: Path, tmp_path: Path) -> None:
    for k in range(1, DAYS + 1):
        own = replace(ss.read(days / f"day_{k}.nc"), provenance={})
        ss.write(own, tmp_path / f"press_2024-05-{(k + 1) // 2:02d}_{k}.csv")
    once = call("trend", tmp_path, "-o", tmp_path / "trend.csv")
    for name in ("trend.html", "trend.json"):
        assert call("trend", tmp_path, "-o", tmp_path / name).out == once.out
    assert once.status == 0 and once.err == "" and "8 recordings, 2024-05-01" in once.out
    assert "clock" not in once.out and "not before 0" not in once.out


@pytest.mark.slow
def test_a_bad_file_is_named_and_the_others_are_in_the_trend(call, days: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text("nothing")
    done = call("trend", days, bad)
    assert done.status == 1 and "bad.csv" in done.err and done.out.startswith("leak since 2024-05-06: 8 recordings")


@pytest.mark.slow
def test_files_without_a_time_have_that_of_their_last_change(call, days: Path, tmp_path: Path) -> None:
    for k in (1, 2, 3):
        own = replace(ss.read(days / f"day_{k}.nc"), provenance={})
        ss.write(own, tmp_path / f"run_{k}.nc")
        os.utime(tmp_path / f"run_{k}.nc", times=(0.0, 1.7e9 - k * 86400.0))
    done = call("trend", tmp_path, "--format", "json")
    assert "3 of 3 files state no time" in done.err
    assert [point["file"] for point in json.loads(done.out)["points"]] == ["run_3.nc", "run_2.nc", "run_1.nc"]
    done = call("trend", tmp_path, "--every", "1d")
    assert done.status == 0 and "day 0 to day 2" in done.out


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--limit", "5 bar"), "limit must be a flow or a speed"),
        (("--every", "-1d"), "every must be > 0"),
        (("--healthy", "0"), "healthy recordings must be 1 or more"),
        (("--years", "0"), "machine-years"),
        (("-o", "trend.docx"), "a page's name must end in"),
    ],
)
def test_wrong_options_are_refused_in_a_line(call, days: Path, words: tuple[str, ...], complaint: str) -> None:
    assert complaint in call("trend", days / "day_1.nc", *words).refused()
    assert "'leak', 'no leak', 'cannot tell'" in call("trend", days / "day_1.nc", "--fail-on", "rust").err


@pytest.mark.usefixtures("rms_change_alone")
def test_diagnose_offers_the_trend_of_days_and_of_nothing_else(call, days: Path) -> None:
    files = [days / f"day_{k}.nc" for k in (1, 2, 3)]
    assert call("diagnose", *files).err == (
        "sealscope: these 3 files are ordered in time: `sealscope trend` shows how the leakage developed\n"
    )
    assert call("diagnose", *files[:2]).err == ""
    assert call("diagnose", *files, "--format", "jsonl").err == ""
    assert call("diagnose", *files, "--quiet").err == ""


@pytest.mark.slow
def test_a_machine_s_file_states_rig_and_limit(call, days: Path, tmp_path: Path) -> None:
    file, first = tmp_path / "press.toml", [days / f"day_{k}.nc" for k in (1, 2, 3)]
    assert call("commission", *first, "-o", file, "--rig", "thesis", "--limit", "3 mL/min").status == 0
    stated = call("trend", days, "--machine", file)
    options = "--rig", "thesis", "--limit", "3 mL/min"
    assert stated.status == 0 and stated.out == call("trend", days, *options, "--healthy", 3).out
    assert call("trend", days, "--machine", file, "--healthy", 1).out == call("trend", days, *options).out
    assert "--limit cannot be combined with" in call("trend", days, "--machine", file, "--limit", "5 mL/min").refused()
    assert (
        "--set cannot be combined with --machine"
        in call("plan", "--machine", file, "--set", "pump.G_pump=1e-13").refused()
    )


def test_cells_of_strangers_are_no_formulas_and_command_no_terminal(call, days: Path, tmp_path: Path) -> None:
    for k, name in enumerate(("=cmd|' !A0", "a\x1b[31m", "plain"), 1):
        (tmp_path / f"{name}.nc").write_bytes((days / f"day_{k}.nc").read_bytes())
    call("trend", tmp_path, "-o", tmp_path / "trend.csv")
    text = (tmp_path / "trend.csv").read_text()
    names = {row["file"] for row in csv.DictReader(io.StringIO(text))}
    assert names == {"'=cmd|' !A0.nc", "a\\x1b[31m.nc", "plain.nc"}
    assert "\x1b" not in text


@pytest.mark.long
@pytest.mark.slow
def test_a_link_out_of_a_folder_is_left_out(call, days: Path, tmp_path: Path, caplog) -> None:
    """What lies elsewhere on the machine is read where it is named, and shows in no text otherwise."""
    folder, secret = tmp_path / "logs", tmp_path / "secret"
    folder.mkdir()
    secret.write_text("hidden:x:0:0\n")
    for k in (1, 2):
        (folder / f"day_{k}.nc").write_bytes((days / f"day_{k}.nc").read_bytes())
    (folder / "passwd.csv").symlink_to(secret)
    (folder / "again.nc").symlink_to(folder / "gone.nc")
    machine, link = tmp_path / "m.toml", tmp_path / "link"
    link.symlink_to(folder)
    for words in (("commission", folder, "-o", machine), ("diagnose", link, "--machine", machine), ("trend", folder)):
        caplog.clear()
        done = call(*words)
        assert done.status == 0
        assert "hidden" not in done.out + done.err
        assert "passwd" not in done.out + done.err
        assert [
            text.endswith("got a link out of it, left out (%s)" % (words[1] / "passwd.csv")) for text in caplog.messages
        ] == [True]
