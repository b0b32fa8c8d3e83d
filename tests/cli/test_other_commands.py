"""`sealscope convert`, `parameters`, `report`, `--version`, and the shell's completion."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import sys
from importlib.metadata import version

import numpy as np
import pytest

import sealscope


def test_convert_round_and_back_is_the_same_to_the_bit(call, recordings, tmp_path):
    pytest.importorskip("pyarrow")
    first = sealscope.read(recordings / "healthy_1.nc")
    path = recordings / "healthy_1.nc"
    for name in ("a.csv", "b.parquet", "c.tsv", "d.h5", "e.nc"):
        done = call("convert", path, tmp_path / name)
        assert (done.status, done.err) == (0, "")
        assert " ".join(done.out.split()).startswith(f"{tmp_path / name}: 10000 samples at 500 Hz, channels u, ")
        path = tmp_path / name
    last = sealscope.read(path)
    assert last.units == first.units
    assert last.provenance == first.provenance
    for name in first.channels:
        assert np.array_equal(last[name], first[name]), name
    assert np.array_equal(last.t, first.t)


def test_convert_gives_a_foreign_log_its_names_units_and_findings(call, tmp_path):
    rows = "".join(f"{k}\t{20 + k % 9}\t5\n" for k in range(600))
    (tmp_path / "log.txt").write_text("n\tPG_1\tPG_2\n" + rows)
    words = ("--map", "p_A=PG_1[bar]", "--map", "p_B=PG_2[psi]", "--rate", "1000")
    done = call("convert", tmp_path / "log.txt", tmp_path / "log.csv", *words)
    assert (done.status, done.err) == (0, "")
    assert "channels p_A, p_B" in done.out
    assert "p_B" in done.out.splitlines()[1]  # a constant channel is said to be one
    head = next(line for line in (tmp_path / "log.csv").read_text().splitlines() if not line.startswith("#"))
    assert head.startswith("t [s],p_A [Pa],p_B [Pa]")
    assert sealscope.read(tmp_path / "log.csv")["p_A"][0] == pytest.approx(20e5)


def table_of(call, *words):
    done = call("parameters", *words)
    assert (done.status, done.err) == (0, "")
    return done.out


def test_parameters_as_a_table_csv_and_json_say_the_same(call):
    rows = json.loads(table_of(call, "--format", "json"))
    listed = list(csv.DictReader(io.StringIO(table_of(call, "--format", "csv"))))
    shown = table_of(call)
    assert len(rows) == len(listed) > 60
    for row, other in zip(rows, listed, strict=True):
        assert list(row) == ["symbol", "name", "meaning", "value", "unit", "source"]
        assert {key: str(value) for key, value in row.items()} == other
        assert row["source"].strip(), row
        assert row["meaning"].strip(), row
        assert row["name"] in shown
    assert {row["symbol"] for row in rows} >= {"q_b", "V_1", "V_2", "K_oil", "p_charge", "F_pr"}


def test_a_setting_is_listed_with_its_value_and_its_source(call):
    plain, changed = (
        {row["name"]: row for row in json.loads(table_of(call, "thesis", "--format", "json", *words))}
        for words in ((), ("--set", "V_1=60[cm^3]"))
    )
    different = [name for name in plain if plain[name] != changed[name]]
    assert different == ["line.V_1"]
    assert changed["line.V_1"]["value"] == 60e-6
    assert changed["line.V_1"]["unit"] == "m^3"
    assert changed["line.V_1"]["source"] == "set by --set"


def check_page(path, verdict):
    page = path.read_text(encoding="utf-8")
    assert page.rstrip().endswith("</html>")
    assert verdict in re.sub(r"<[^>]+>", " ", page).lower()


def test_report_for_one_file(call, recordings, tmp_path):
    done = call("report", recordings / "leak.nc", "-o", tmp_path / "page.html")
    assert (done.status, done.err) == (0, "")
    assert done.out == f"{recordings / 'leak.nc'}: leak -> {tmp_path / 'page.html'}\n"
    check_page(tmp_path / "page.html", "leak")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_report_for_several_files_makes_a_folder_and_skips_what_cannot_be_read(call, recordings, tmp_path):
    files = [recordings / "leak.nc", tmp_path / "absent.csv", recordings / "healthy_1.nc"]
    done = call("report", *files, "-o", tmp_path / "new" / "pages", "--baseline", recordings / "healthy_2.nc")
    assert done.refused(1).startswith("a recording must exist, got no such file")
    assert sorted(path.name for path in (tmp_path / "new" / "pages").iterdir()) == [
        "healthy_1.html",
        "index.html",
        "leak.html",
    ]
    check_page(tmp_path / "new" / "pages" / "leak.html", "leak")
    check_page(tmp_path / "new" / "pages" / "healthy_1.html", "no leak")
    assert len(done.out.splitlines()) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_report_of_one_file_into_a_folder(call, recordings, tmp_path):
    assert call("report", recordings / "healthy_1.nc", "-o", tmp_path).status == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["healthy_1.html", "index.html"]


def test_version_and_help(call, shell):
    assert call("--version").out == f"sealscope {version('sealscope')}\n" == shell("sealscope", "--version").out
    done = call("--help")
    assert done.status == 0
    for word in ("demo", "simulate", "diagnose", "parameters", "convert", "report"):
        assert word in done.out
        assert call(word, "-h").status == 0
    assert "--install-completion" in done.out
    assert "--show-completion" in done.out


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("sealscope dem", {"demo"}),
        ("sealscope par", {"parameters"}),
        ("sealscope simulate --rig th", {"thesis"}),
        ("sealscope parameters th", {"thesis"}),
        ("sealscope simulate --set V_", {"V_1=", "V_2="}),
        ("sealscope simulate --set line.V_", {"line.V_1=", "line.V_2="}),
        ("sealscope diagnose --base", {"--baseline"}),
        ("sealscope diagnose --format js", {"jsonl"}),
    ],
)
def test_the_shell_completes(words, offered, call, monkeypatch):
    position = len(words.split()) - 1
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(position), "_SEALSCOPE_COMPLETE": "complete_bash"}
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    done = call()
    assert offered <= set(done.out.split())
    assert done.err == ""


def test_the_shell_s_script_calls_the_command_back(call, monkeypatch):
    monkeypatch.setenv("_SEALSCOPE_COMPLETE", "source_bash")
    done = call()
    assert "complete_bash" in done.out
    assert re.search(r"^complete .* sealscope$", done.out, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_completes_with_the_script_that_is_shown(shell, tmp_path):
    """As a person presses Tab: bash evaluates what `--show-completion` prints, and calls the function it registers."""
    command = tmp_path / "sealscope"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sealscope "$@"\n')
    command.chmod(0o755)
    script = """
        eval "$(sealscope --show-completion)"
        pressed() {
            COMP_WORDS=("$@") COMP_CWORD=$(($# - 1))
            COMPREPLY=()
            $(complete -p sealscope | sed 's/.*-F \\([^ ]*\\) .*/\\1/') sealscope
            echo "${COMPREPLY[*]}"
        }
        pressed sealscope diag
        pressed sealscope simulate --rig thesis-
        pressed sealscope campaign run bench-thes
    """
    done = shell("bash", "-c", script, PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert (done.status, done.err) == (0, "")
    first, second, third = done.out.splitlines()
    assert (first, third) == ("diagnose", "bench-thesis")
    assert "thesis-calibrated" in second.split()


@pytest.mark.parametrize("kind", ["zsh", "fish"])
def test_other_shells_are_answered(kind, call, monkeypatch):
    monkeypatch.setenv("_TYPER_COMPLETE_ARGS", "sealscope dem")
    monkeypatch.setenv("_TYPER_COMPLETE_FISH_ACTION", "get-args")
    monkeypatch.setenv("_SEALSCOPE_COMPLETE", f"complete_{kind}")
    done = call()
    assert done.err == ""
    assert "demo" in done.out
    assert "diagnose" not in done.out


def test_inspect_shows_the_units_of_the_log_and_the_line_for_its_temperature(call, tmp_path):
    rows = "".join(f"{k / 500:.3f},{20 + k % 9},50,{1 + k % 7},{k * 40},{60 + k % 3}\n" for k in range(600))
    (tmp_path / "log.csv").write_text("time_s,pA_psi,pB_psi,x_in,theta_deg,return_temp_degF\n" + rows)
    done = call("inspect", tmp_path / "log.csv", "--map", "auto")
    lines = {line.split()[0]: line for line in done.out.splitlines() if line.strip()}
    assert "1 to 7 in" in lines["x"] and "0 to 23960 deg" in lines["theta"] and "20 to 28 psi" in lines["p_A"]
    assert "if it is the oil's temperature: --map 'T_oil=return_temp_degF'" in " ".join(done.out.split())
    warm = call("inspect", tmp_path / "log.csv", "--map", "auto", "--map", "T_oil=return_temp_degF")
    assert "60 to 62 degF" in warm.out and "oil's" not in warm.out


def test_inspect_shows_what_a_foreign_file_holds_and_what_is_wrong(call, tmp_path):
    rows = "".join(f"{k / 500:.3f};{20 + k % 9};5;{k % 7}\n" for k in range(600))
    (tmp_path / "log.csv").write_text("Zeit [s];Druck A [bar];PB_bar;Weg_mm\n" + rows)
    done = call("inspect", tmp_path / "log.csv", tmp_path / "none.csv")
    assert done.status == 1
    assert "must exist" in done.err
    assert "600 samples at 500 Hz, 1.2 s" in " ".join(done.out.split())
    (line,) = [line for line in done.out.splitlines() if line.split()[0] == "p_A"]
    assert "20 to 28 bar" in line
    assert "note: column Weg_mm read as x in mm" in done.out
    assert "warning: p_B: is constant at 5 bar" in done.out
    again = call("inspect", tmp_path / "log.csv", "--map", "auto", "--map", "p_B=#2")  # Druck A is p_B, so nothing p_A
    assert again.status == 0
    assert "note: column Druck A [bar] read as p_B in bar" in again.out
    assert "note: column Weg_mm read as x in mm" in again.out
    assert "columns not used: PB_bar" in again.out


@pytest.fixture
def parts(recordings, tmp_path):
    """The two halves of a run, as files."""
    whole, paths = sealscope.read(recordings / "healthy_1.nc"), [tmp_path / "part_1.csv", tmp_path / "part_2.csv"]
    half = len(whole) // 2
    sealscope.write(whole.samples(slice(0, half)), paths[0])
    sealscope.write(whole.samples(slice(half, None)), paths[1])
    return paths


def test_parts_of_a_run_are_joined(call, parts):
    done = call("inspect", "--join", *reversed(parts))
    assert (done.status, done.err) == (0, "")
    assert "10000 samples at 500 Hz, 20 s" in " ".join(done.out.split())
    assert "joined from 2 files: part_1.csv, part_2.csv" in done.out
    done = call("diagnose", "--join", parts[0], parts[0])
    assert (done.status, done.err.count("\n")) == (2, 1)
    assert "must not overlap in time" in done.err


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_joined_parts_are_diagnosed_as_the_run(call, recordings, parts):
    alone = call("diagnose", recordings / "healthy_1.nc", "--format", "jsonl").objects[0]
    joined = call("diagnose", "--join", *parts, "--format", "jsonl")
    assert [result["score"] for result in joined.objects] == [alone["score"]]
