"""Sheets of a workbook that hold one run are joined where their clocks fit, and named where they do not."""

from __future__ import annotations

import datetime as dt
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, read

from .dialects import P_A, P_B, RATE, N, T, X

pytest.importorskip("python_calamine")
openpyxl = pytest.importorskip("openpyxl")

HEAD = ["Time [s]", "p_A [bar]", "p_B [bar]", "x [mm]"]
START = dt.datetime(2024, 5, 31, 23, 59, 59, 900000)
ROWS = [list(row) for row in zip(T.tolist(), P_A.tolist(), P_B.tolist(), X.tolist(), strict=True)]
MOMENTS = [[START + dt.timedelta(seconds=t), *row] for t, *row in ROWS]


def workbook(folder: Path, **sheets: list[list[Any]]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(folder / "log.xlsx")
    return folder / "log.xlsx"


def agrees(recording: Recording) -> None:
    assert recording.rate == RATE
    assert recording.t - recording.t[0] == pytest.approx(T, abs=1e-6)
    for name, values in (("p_A", 1e5 * P_A), ("p_B", 1e5 * P_B), ("x", 1e-3 * X)):
        assert recording[name] == pytest.approx(values, rel=1e-12), name


@pytest.mark.parametrize("times", ["seconds", "moments", "times of the day", "three sheets", "longest last"])
def test_a_run_that_goes_on_in_the_next_sheet(times: str, tmp_path: Path) -> None:
    rows, head = (MOMENTS if times == "moments" else ROWS), ["Time", *HEAD[1:]] if times != "seconds" else HEAD
    if times == "times of the day":
        noon = dt.datetime(2024, 5, 31, 12)
        rows = [[(noon + dt.timedelta(seconds=t)).time(), *row] for t, *row in ROWS]
    cuts = {"three sheets": [0, 80, 150, N], "longest last": [0, 50, N]}.get(times, [0, 120, N])
    parts = {f"Data{k}": [head, *rows[a:b]] for k, (a, b) in enumerate(pairwise(cuts))}
    recording = read(workbook(tmp_path, Info=[["Operator", "N. N."]], **parts))
    agrees(recording)
    assert any(f"sheets {', '.join(parts)} joined: the clock goes on" in line for line in recording.history)
    if times == "moments":
        assert recording.provenance["start"].startswith("2024-05-31T23:59:59.9")


@pytest.mark.parametrize("dated", [False, True])
def test_channels_of_one_clock_in_two_sheets(dated: bool, tmp_path: Path) -> None:
    rows, head = (MOMENTS, ["Time", *HEAD[1:]]) if dated else (ROWS, HEAD)
    pressures, position = (
        [[row[column] for column in columns] for row in [head, *rows]] for columns in ([0, 1, 2], [0, 3])
    )
    recording = read(workbook(tmp_path, Pressures=pressures, Position=position))
    agrees(recording)
    assert "x read from sheet Position" in recording.history
    slow = [position[0], *position[1::4], position[-1]]
    recording = read(workbook(tmp_path, Position=slow, Pressures=pressures))
    assert recording.rate == RATE
    kept = np.append(T[::4], T[-1])
    assert recording["x"] == pytest.approx(1e-3 * np.interp(T, kept, np.append(X[::4], X[-1])), abs=1e-9)
    assert any("interpolated linearly" in line for line in recording.history)


def test_sheets_whose_clocks_do_not_fit_are_named(tmp_path: Path) -> None:
    other = [HEAD, *[[t, 9.0, 9.0, 0.0] for t, *_ in ROWS[:90]]]
    recording = read(workbook(tmp_path, Run_1=[HEAD, *ROWS], Run_2=other))
    agrees(recording)
    assert "sheet Run_1 read, not Run_2" in recording.history
    assert "sheet Run_2 not joined: it begins at 0 s, Run_1 ends at 0.398 s" in recording.history
    later = [["Time", *HEAD[1:]], *[[moment + dt.timedelta(hours=1), *row] for moment, *row in MOMENTS[:90]]]
    recording = read(workbook(tmp_path, Run_1=[["Time", *HEAD[1:]], *MOMENTS], Run_2=later))
    agrees(recording)
    assert any("sheet Run_2 not joined: it begins at 2024-06-01T00:59:59.9" in line for line in recording.history), (
        recording.history
    )
    elsewhere = [["t [s]", "u [V]"], *[[9.0 + t, 1.0] for t in T.tolist()]]
    recording = read(workbook(tmp_path, Run_1=[HEAD, *ROWS], Command=elsewhere))
    assert "u" not in recording.channels
    assert "sheet Run_1 read, not Command" in recording.history


def test_the_names_of_all_sheets_are_read_by_their_words(tmp_path: Path) -> None:
    pressures = [["Zeit [s]", "Druck A [bar]", "Druck B [bar]"], *[row[:3] for row in ROWS]]
    position = [["Zeit [s]", "Weg [mm]"], *[[row[0], row[3]] for row in ROWS]]
    recording = read(workbook(tmp_path, Messung=pressures, Weg=position), map="auto")
    agrees(recording)
    assert recording.provenance["columns"] == {"p_A": "Druck A [bar]", "p_B": "Druck B [bar]", "x": "Weg [mm]"}


def test_a_map_whose_columns_stand_in_two_sheets(tmp_path: Path) -> None:
    pressures = [["Zeit [s]", "PG_1 [bar]", "PG_2 [bar]"], *[row[:3] for row in ROWS]]
    position = [["Zeit [s]", "LVDT [mm]"], *[[row[0], row[3]] for row in ROWS]]
    path = workbook(tmp_path, Messung=pressures, Weg=position)
    mapped = {"p_A": "PG_1 [bar]", "p_B": "PG_2", "x": "LVDT"}
    agrees(read(path, map=mapped))
    agrees(read(path, map={"t": "Zeit", **mapped}))
    with pytest.raises(UnreadableFile, match="must be in sheets of one time, got none for theta in Messung, Weg"):
        read(path, map={**mapped, "theta": "Encoder[deg]"})
    with pytest.raises(UnreadableFile, match="mapped to theta, must be a column, got columns Zeit"):
        read(path, map={"theta": "Encoder[deg]"})
