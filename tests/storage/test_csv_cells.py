"""Cells of tables that name what came from outside are no formulas, and command no terminal."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from sealscope.storage.csv_file import guard_cell, write_csv


@pytest.mark.parametrize("cell", ["=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1"])
def test_a_formula_becomes_a_text(cell):
    assert guard_cell(cell).startswith("'")


@pytest.mark.parametrize("cell", [-1.5, None, 3, "-1.5", "+2e-3", "-", "run.nc", "a = b", "two\nlines", "Stra\u00dfe"])
def test_numbers_and_plain_texts_stay(cell):
    assert guard_cell(cell) == cell


def test_what_a_terminal_would_obey_is_escaped(tmp_path: Path):
    path = tmp_path / "table.csv"
    write_csv(path, ["name", "x"], [{"name": "a\x1b[31m\u202eb", "x": 1.0}, {"name": "=cmd", "x": -1.0}])
    text = path.read_text("utf-8")
    assert "\x1b" not in text
    assert list(csv.reader(text.splitlines()))[1:] == [["a\\x1b[31m\\u202eb", "1.0"], ["'=cmd", "-1.0"]]
