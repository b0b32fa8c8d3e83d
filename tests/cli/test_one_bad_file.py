"""A batch with bad files: each gets its line, the others their results, and the status says that some failed."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from urllib.parse import unquote_to_bytes

import pytest

from ..recordings.test_packed_files import rows, workbook


@pytest.fixture
def batch(recordings: Path, tmp_path: Path) -> Path:
    """A folder with good.nc, bad.nc (cut off) and other.nc."""
    for name in ("good.nc", "other.nc"):
        shutil.copy(recordings / "healthy_1.nc", tmp_path / name)
    (tmp_path / "bad.nc").write_bytes((recordings / "healthy_1.nc").read_bytes()[:5000])
    return tmp_path


def fail_on(name: str, module: str, function: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a function raise where it handles the file `name`."""
    from importlib import import_module

    inner = getattr(import_module(module), function)

    def failing(*arguments, **options):
        if str(options.get("file", "")).endswith(name):
            raise ZeroDivisionError("deep\ninside")
        return inner(*arguments, **options)

    monkeypatch.setattr(f"{module}.{function}", failing)


def test_diagnose_goes_on_after_a_defect(batch, call, monkeypatch):
    fail_on("good.nc", "sealscope.diagnosis.diagnose", "diagnose", monkeypatch)
    done = call("diagnose", "--format", "jsonl", *(batch / name for name in ("good.nc", "bad.nc", "other.nc")))
    assert done.status == 1
    assert [Path(json.loads(line)["file"]).name for line in done.out.splitlines()] == ["other.nc"]
    first, second = done.err.splitlines()
    assert first.startswith(f"sealscope: cannot handle {batch / 'good.nc'}, got ZeroDivisionError: deep")
    assert "must be whole" in second


@pytest.mark.slow
def test_diagnose_goes_on_after_a_workbook_that_ends_its_reader(batch, call):
    pytest.importorskip("python_calamine")
    workbook(batch / "corner.xlsx", [rows([("A1", 1), ("XFD1048576", 2)])])
    done = call("diagnose", "--format", "jsonl", *(batch / name for name in ("good.nc", "corner.xlsx", "other.nc")))
    assert [Path(line["file"]).name for line in done.objects] == ["good.nc", "other.nc"]
    assert str(batch / "corner.xlsx") in done.refused(1)


@pytest.mark.usefixtures("verbose")
def test_the_original_error_is_logged_on_demand(batch, call):
    quiet = call("diagnose", batch / "bad.nc")
    assert "Traceback" not in quiet.err
    for words in (("-v", "diagnose"), ("diagnose", "--verbose")):
        loud = call(*words, batch / "bad.nc")
        assert (loud.status, loud.out) == (1, "")
        assert "Traceback" in loud.err
        assert "h5py" in loud.err
        assert loud.err.splitlines()[-1] == quiet.err.splitlines()[-1]


@pytest.mark.slow
def test_report_goes_on_after_a_page_that_cannot_be_written(batch, call):
    (batch / "pages" / "good.html").mkdir(parents=True)
    done = call("report", "-o", batch / "pages", batch / "good.nc", batch / "other.nc")
    assert done.status == 1
    assert (batch / "pages" / "other.html").stat().st_size > 10_000
    assert done.err.splitlines() == [
        f"sealscope: a file to write must not be a folder, got {batch / 'pages' / 'good.html'}"
    ]


def test_a_campaign_over_recordings_goes_on(batch, call, monkeypatch, tmp_path):
    from sealscope.campaigns.cases import recordings as module
    from sealscope.campaigns.plans.reader import load_plan

    (tmp_path / "plan.toml").write_text(
        '[campaign]\nname = "some"\ndetectors = ["sign rule: d3 of p_A fell"]\n[recordings]\n'
        '[[recordings.sets]]\nfiles = "*.nc"\n'
    )

    done = call("campaign", "run", tmp_path / "plan.toml", "--data", batch, "-o", tmp_path / "rows")
    assert done.status == 1
    assert "bad.nc" in done.err

    def failing(*arguments):
        raise IndexError("deep")

    monkeypatch.setattr(module, "judge_record", failing)
    rows = module.judge_recordings(load_plan(tmp_path / "plan.toml"), batch)
    assert len(rows) == 3
    assert sum(row.error == "IndexError: deep" for row in rows) == 2


ODD = os.fsdecode(b"odd\xff\x1b[31m.nc")


@pytest.mark.slow
def test_odd_names_of_files_in_an_index_and_a_trend(batch, call, recordings):
    """A link of the index leads to the page, whose name is bytes."""
    odd = [os.fsdecode(b"l\xe4rm \x1b[31m%d.nc" % number) for number in (1, 2)]
    for number, name in enumerate(odd, 1):
        shutil.copy(recordings / f"healthy_{number}.nc", batch / name)
    files = [batch / name for name in odd]
    done = call("report", "-o", batch / "pages", *files)
    assert (done.status, done.err) == (0, "")
    index = (batch / "pages" / "index.html").read_bytes()
    links = re.findall(rb'href="(l[^"]*)"', index)
    assert {unquote_to_bytes(link) for link in links} == {os.fsencode(Path(name).stem) + b".html" for name in odd}
    assert all((batch / "pages" / os.fsdecode(unquote_to_bytes(link))).is_file() for link in links)
    assert b"\x1b" not in index
    for suffix in ("csv", "json", "html"):
        done = call("trend", *files, "--every", "1d", "-o", batch / f"trend.{suffix}")
        assert (done.status, done.err) == (0, "")
        text = (batch / f"trend.{suffix}").read_text(encoding="utf-8")
        assert "rm " in text
        assert "\x1b" not in text or suffix == "csv"


@pytest.mark.slow
def test_odd_names_of_files(batch, shell, call):
    """Bytes that are no UTF-8, and a terminal's escape."""
    shutil.copy(batch / "good.nc", batch / ODD)
    done = call("report", "-o", batch / "page.html", batch / ODD)
    assert (done.status, done.err) == (0, "")
    assert "\x1b" not in done.out
    assert "odd" in (batch / "page.html").read_text(encoding="utf-8")
    done = shell("sealscope", "diagnose", batch / ODD)
    assert (done.status, done.err) == (0, "")
    assert "\x1b" not in done.out
