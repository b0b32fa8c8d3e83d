"""The thesis's data sheet, found, read and refused; and the command that reproduces."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sealscope.thesis.engine.items import load_items
from sealscope.thesis.sheet import FILES, MISSING, DataSheet, find_sheet, read_sheet

from ..refusals import refusal
from .conftest import needs_sheet

WriteSheet = Callable[..., Path]


def test_where_the_sheet_is_looked_for(
    tmp_path: Path, write_sheet: WriteSheet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SEALSCOPE_SHEET", raising=False)
    assert find_sheet() is None
    with refusal("--sheet", "appendix_c_pa.csv"):
        find_sheet(tmp_path)
    write_sheet(tmp_path / "data")
    assert find_sheet() == Path("data")
    monkeypatch.setenv("SEALSCOPE_SHEET", str(tmp_path / "none"))
    with refusal("SEALSCOPE_SHEET"):
        find_sheet()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("d3_leak", "d3_lek", "d3_leak"),
        ("0.0042,8,1,50", "0.0042,8,1,25", "row 1, '8 sin(t)', 50 %"),
        ("0.0042,8,1,50.0,extra-small,1.0", "0.0042,8,1,50.0,extra-small,1.O", "'1.O'"),
        ("0.0042,8,1,50.0,extra-small,1.0", "0.0042,8,1,50.0,extra-small,-1.0", "d1_no_leak, 0"),
    ],
)
def test_a_wrong_sheet_is_refused_with_its_place(
    tmp_path: Path, write_sheet: WriteSheet, old: str, new: str, words: str
) -> None:
    folder = write_sheet(tmp_path / "sheet")
    path = folder / FILES["p_A"]
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with refusal("appendix_c_pa", *words.split(", ")):
        read_sheet(folder)


def test_a_sheet_with_a_row_missing_is_refused(tmp_path: Path, write_sheet: WriteSheet) -> None:
    folder = write_sheet(tmp_path / "sheet")
    path = folder / FILES["p_B"]
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))
    with refusal("41", "40"):
        read_sheet(folder)


@needs_sheet
def test_the_real_sheet_is_read(measured_sheet: DataSheet) -> None:
    assert measured_sheet.rms["p_A"]["d3"].shape == (41, 2)
    assert (np.diff(measured_sheet.rms["p_A"]["d3"], axis=1) < 0).sum() == 41


def command(*words: str, monkeypatch: pytest.MonkeyPatch) -> int:
    from sealscope import cli

    monkeypatch.setattr(sys, "argv", ["sealscope", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0)


def test_the_list_names_every_item(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SEALSCOPE_SHEET", raising=False)
    assert command("reproduce", "--list", monkeypatch=monkeypatch) == 0
    out = capsys.readouterr().out
    assert [line.split()[0] for line in out.splitlines() if line[0] != " "] == [one.id for one in load_items()]
    assert (MISSING in " ".join(out.split())) == any(one.needs_sheet for one in load_items())


@pytest.mark.parametrize("words", [["reproduce", "fig-3.33"], ["reproduce"], ["reproduce", "fig-3.3", "--jobs", "0"]])
def test_a_wrong_call_is_one_line_and_status_2(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(*words, monkeypatch=monkeypatch) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_one_real_figure_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command("reproduce", "fig-3.3", "-o", "out", "--jobs", "1", monkeypatch=monkeypatch) == 0
    assert "items: 1 made" in capsys.readouterr().out
    for name in ("figures/fig-3.3.svg", "figures/fig-3.3.png", "tables/fig-3.3.csv", "index.html"):
        assert (tmp_path / "out" / name).stat().st_size > 200
    assert not list((tmp_path / "out").rglob("*.part"))
    assert command("reproduce", "fig-3.3", "-o", "out", "--jobs", "1", monkeypatch=monkeypatch) == 0
    assert "items: 1 kept from before" in capsys.readouterr().out
