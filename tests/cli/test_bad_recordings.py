"""Files that are no recordings, or broken ones: one clear line, the right status, nothing left behind."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

HEAD = "t [s],p_A [Pa],p_B [Pa]\n"


def rows(t, p_A, p_B) -> str:
    return "".join(f"{a:.3f},{b:.1f},{c:.1f}\n" for a, b, c in zip(t, p_A, p_B, strict=True))


def pressures(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n,) time at 500 Hz and the two chambers of a sinusoidal duty with noise."""
    random, t = np.random.default_rng(5), np.arange(n) / 500
    moved = 6e4 * np.sin(4 * t)
    return t, 2e5 + moved + 8e3 * random.normal(size=n), 2e5 - moved + 8e3 * random.normal(size=n)


def make(kind: str, path: Path) -> None:
    """Write the broken file of that kind."""
    t, p_A, p_B = pressures(200)
    texts = {
        "empty": "",
        "header only": HEAD,
        "one column": "p_A [Pa]\n1\n2\n3\n",
        "text in numbers": HEAD + re.sub(r"(0\.1\d\d),", r"\1,high ", rows(t, p_A, p_B)),
        "standing time": HEAD + rows(0.0 * t, p_A, p_B),
        "wrong unit": HEAD.replace("p_B [Pa]", "p_B [mm]") + rows(t, p_A, p_B),
        "unknown unit": HEAD.replace("p_B [Pa]", "p_B [wibble]") + rows(t, p_A, p_B),
    }
    if kind == "binary":
        path.write_bytes(np.random.default_rng(0).bytes(5000))
    elif kind == "2 GB of nothing":
        with path.open("wb") as file:
            file.truncate(2 * 1024**3)
    elif kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_text(texts[kind])


UNREADABLE = {
    "empty": "a recording must hold data, got an empty file",
    "header only": "a recording must have samples, got no row of numbers after t [s], p_A [Pa], p_B [Pa]",
    "one column": "a recording must have a time column such as t [s] or be given a rate",
    "text in numbers": "a sample must be a number, got 'high ",
    "standing time": "time must increase between some samples",
    "wrong unit": "p_B must have a unit of pressure, such as Pa, got mm",
    "unknown unit": "p_B must have a unit of pressure, such as Pa, got wibble",
    "2 GB of nothing": "a recording must be text, NetCDF, HDF5 or Parquet, got other binary data",
    "binary": "a recording must be text, NetCDF, HDF5 or Parquet, got other binary data",
    "folder": "a recording must be a file, got a folder",
    "missing": "a recording must exist, got no such file",
}


@pytest.mark.parametrize("kind", UNREADABLE)
def test_what_cannot_be_read(kind, call, untouched, tmp_path):
    make(kind, tmp_path / "log.csv")
    untouched()
    calls = (
        call("diagnose", "log.csv"),
        call("diagnose", "log.csv", "--format", "jsonl"),
        call("report", "log.csv", "-o", "page.html"),
        call("convert", "log.csv", "log.nc"),
        call("simulate", "-o", "run.nc", "--duration", "1", "--command", "file log.csv"),
    )
    for done in calls:
        complaint = done.refused(1)
        assert complaint.startswith(UNREADABLE[kind])
        assert "log.csv)" in complaint
        assert done.out == ""


@pytest.mark.slow
def test_what_cannot_be_read_in_a_process_of_its_own(shell, untouched, tmp_path):
    make("2 GB of nothing", tmp_path / "log.csv")
    untouched()
    done = shell("sealscope", "diagnose", "log.csv")
    assert done.refused(1).startswith(UNREADABLE["2 GB of nothing"])
    assert done.out == ""


@pytest.mark.slow
def test_each_bad_file_among_good_ones_has_its_line(call, recordings, tmp_path, untouched):
    kinds = ("wrong unit", "binary")
    for kind in kinds:
        make(kind, tmp_path / f"{kind}.csv")
    untouched()
    files = ["wrong unit.csv", recordings / "healthy_1.nc", "binary.csv"]
    done = call("diagnose", *files, "--format", "jsonl")
    assert done.status == 1
    assert [item["verdict"] for item in done.objects] == ["no leak"]
    lines = done.err.splitlines()
    assert len(lines) == len(kinds)
    for kind, line in zip(kinds, lines, strict=True):
        assert line.startswith(f"sealscope: {UNREADABLE[kind]}")
        assert line.endswith(f"({kind}.csv)")


def diagnosed(call, path: Path, *options: str):
    """The one verdict on a file that must be readable."""
    done = call("diagnose", path, "--format", "jsonl", *options)
    assert (done.status, done.err) == (0, "")
    (result,) = done.objects
    return result


def findings(result) -> dict[str, dict]:
    return {item["code"]: item for item in result["quality"]}


def test_runs_of_nan_are_named_and_what_is_whole_is_analysed(call, tmp_path):
    t, p_A, p_B = pressures(30_000)
    p_A[2000:2400] = np.nan
    p_A[28_000] = np.nan
    (tmp_path / "log.csv").write_text(HEAD + rows(t, p_A, p_B))
    result = diagnosed(call, tmp_path / "log.csv")
    quality = findings(result)
    assert (quality["missing"]["channel"], quality["missing"]["count"]) == ("p_A", 401)
    assert quality["missing"]["first_t"] == pytest.approx(4.0)
    assert quality["gaps_bridged"]["count"] == 401
    assert result["verdict"] != "leak"


def test_of_a_recording_that_is_cut_in_two_the_rest_may_hide_a_leak(call, tmp_path):
    t, p_A, p_B = pressures(30_000)
    p_A[20_000:24_000] = np.nan
    (tmp_path / "log.csv").write_text(HEAD + rows(t, p_A, p_B))
    result = diagnosed(call, tmp_path / "log.csv")
    assert findings(result)["gaps_bridged"]["count"] == 4000
    assert result["verdict"] == "cannot tell"
    assert result["evidence"]["share"] == pytest.approx(26 / 30, abs=0.05)


@pytest.mark.parametrize("whole", [0, 1, 100])
def test_hardly_any_number_between_the_nans(call, tmp_path, whole):
    t, p_A, p_B = pressures(3000)
    p_A[whole:] = np.nan
    (tmp_path / "log.csv").write_text(HEAD + rows(t, p_A, p_B))
    result = diagnosed(call, tmp_path / "log.csv")
    assert result["verdict"] == "cannot tell"
    assert findings(result)["missing"]["count"] == 3000 - whole


def test_time_that_goes_back_for_a_while_is_named(call, tmp_path):
    t, p_A, p_B = pressures(30_000)
    t[2000:2050] = t[2000:2050][::-1].copy()
    (tmp_path / "log.csv").write_text(HEAD + rows(t, p_A, p_B))
    result = diagnosed(call, tmp_path / "log.csv")
    quality = findings(result)
    assert quality["rows_sorted"]["count"] == 49
    assert "gaps_bridged" not in quality
    assert result["verdict"] in ("no leak", "cannot tell")


@pytest.mark.parametrize("samples", [2, 30, 230])
def test_a_file_of_few_samples_gets_the_verdict_that_it_is_too_short(call, tmp_path, samples):
    (tmp_path / "log.csv").write_text(HEAD + rows(*pressures(samples)))
    result = diagnosed(call, tmp_path / "log.csv")
    assert result["verdict"] == "cannot tell"
    assert str(samples) in result["reason"] or "too short" in result["reason"]
    assert result["score"] is None
    report = call("report", tmp_path / "log.csv", "-o", tmp_path / "page.html")
    assert report.status == 0
    assert "cannot tell" in (tmp_path / "page.html").read_text(encoding="utf-8").lower()


def test_one_column_with_a_rate_is_a_recording(call, tmp_path):
    (tmp_path / "log.csv").write_text("p_A [Pa]\n" + "".join(f"{v:.1f}\n" for v in pressures(500)[1]))
    assert diagnosed(call, tmp_path / "log.csv", "--rate", "500")["verdict"] == "cannot tell"


def test_channels_that_say_nothing_about_the_piston(call, tmp_path):
    t, p_A, p_B = pressures(2000)
    (tmp_path / "log.csv").write_text(HEAD.replace("p_A", "p_1").replace("p_B", "p_2") + rows(t, p_A, p_B))
    result = diagnosed(call, tmp_path / "log.csv")
    assert result["verdict"] == "cannot tell"
    assert "p_A or p_B" in result["reason"]


def test_a_name_with_a_line_break_is_still_one_line(call, tmp_path):
    assert "two\N{REPLACEMENT CHARACTER}lines.csv" in call("diagnose", tmp_path / "two\nlines.csv").refused(1)


@pytest.mark.slow
def test_names_beyond_the_terminal_s_characters(shell, tmp_path):
    path = tmp_path / "cylinder \N{SNOWMAN}.csv"
    path.write_text(HEAD + rows(*pressures(400)))
    done = shell("sealscope", "diagnose", path, f"{path}.gone", PYTHONIOENCODING="latin-1")
    assert "\\u2603.csv.gone" in done.refused(1)
    assert "\\u2603.csv: cannot tell" in done.out
