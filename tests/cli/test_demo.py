"""The main job, shown once: `sealscope demo`."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

import sealscope
from sealscope.cli.app import app
from sealscope.demo import run_demo

from .conftest import Call


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def whole(shell, folder):
    """The command as a user gives it, in a process of its own."""
    return shell("sealscope", "demo", "--output", folder / "whole")


def of_few(folder):
    """The command within this process, with two healthy recordings in place of five."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sealscope.demo.N_HEALTHY", 2)
        done = CliRunner().invoke(app, ["demo", "--output", str(folder / "few")])
    return Call(done.exit_code, done.stdout, done.stderr)


@pytest.fixture(scope="module", params=["few", pytest.param("whole", marks=pytest.mark.slow)])
def first(request, folder):
    """The demo, whose files are in the folder `place` of it."""
    return of_few(folder) if request.param == "few" else request.getfixturevalue("whole")


@pytest.fixture
def place(first, request, folder):
    return folder / request.node.callspec.params["first"]


def test_the_leak_is_found_within_ten_seconds_of_the_truth(first, place):
    assert (first.status, first.err) == (0, "")
    lines = first.out.splitlines()
    assert len(lines) <= 20
    assert {"healthy.nc: no leak", "recording.nc: leak"} <= set(lines)
    assert len([line for line in lines if "L/min, between" in line]) == 1  # one figure for the leak
    said = re.search(r"^  since +([0-9.]+) s, between ([0-9.]+) s and ([0-9.]+) s$", first.out, re.MULTILINE)
    truth = re.search(r"^truth: +([0-9.]+) L/min from ([0-9.]+) s$", first.out, re.MULTILINE)
    assert float(truth[2]) == 30.0
    assert float(truth[1]) == pytest.approx(0.0042, rel=0.002)
    assert abs(float(said[1]) - float(truth[2])) <= 10.0
    assert float(said[2]) <= float(said[1]) <= float(said[3])
    for name in ("machine.toml", "recording.nc", "report.html"):
        assert str(place / name) in first.out
        assert (place / name).stat().st_size > 10_000
    names = ["healthy", "healthy.nc", "machine.healthy", "machine.toml", "recording.nc", "report.html"]
    assert sorted(path.name for path in place.glob("[!.]*")) == names


def test_the_recording_is_a_recording_that_does_not_know_the_truth(place):
    recording = sealscope.read(place / "recording.nc")
    assert recording.duration == 60.0
    assert "leak" not in str(dict(recording.provenance)).lower()
    result = sealscope.read_machine(place / "machine.toml").diagnose(recording)
    assert result.verdict == "leak"
    assert abs(result.onset_s - 30.0) <= 10.0


def test_the_page_needs_nothing_from_outside(place):
    page = (place / "report.html").read_text(encoding="utf-8")
    loads = r"<(?:script|img|iframe|link|source)\b[^>]*\b(?:src|href)\s*=\s*[\"'](?!data:|#)"
    assert not re.search(loads, page, re.IGNORECASE)
    assert not re.search(r"@import|url\(\s*[\"']?(?!data:|#)[a-z/]", page, re.IGNORECASE)
    assert not re.search(r"\bfetch\s*\(|XMLHttpRequest|\bimport\s*\(", page)
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert page.rstrip().endswith("</html>")
    assert "<svg" in page


@pytest.mark.slow
def test_a_second_run_gives_the_same_bytes_and_the_same_words(whole, folder, call):
    second = call("demo", "-o", folder / "second")
    assert second.status == 0
    assert second.out == whole.out.replace(str(folder / "whole"), str(folder / "second"))
    for name in ("recording.nc", "report.html"):
        assert (folder / "second" / name).read_bytes() == (folder / "whole" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.long
def test_another_seed_is_another_recording_with_the_same_verdict(whole, folder, call):
    other = call("demo", "-o", folder / "other", "--seed", 2)
    assert other.status == 0
    assert "recording.nc: leak" in other.out.splitlines()
    item, two = (sealscope.read(folder / name / "recording.nc") for name in ("whole", "other"))
    assert (item["p_A"] != two["p_A"]).any()
    assert (item["u"] == two["u"]).mean() > 0.9


@pytest.mark.parametrize("seed", range(4))
def test_no_two_recordings_have_the_same_noise(tmp_path, monkeypatch, seed):
    seeds = []

    def record_seed(experiment, *_):
        seeds.append(experiment.seed)
        if experiment.leaks:
            raise StopIteration  # it is the last one
        return SimpleNamespace(recording=None)

    monkeypatch.setattr("sealscope.demo.simulate_experiment", record_seed)
    with pytest.raises(StopIteration):
        run_demo(tmp_path, seed)
    assert len(set(seeds)) == len(seeds) > 2


def test_a_folder_that_cannot_be_one_is_refused_before_the_work(call, untouched, tmp_path, monkeypatch):
    (tmp_path / "taken").write_text("a file")
    untouched()

    def not_called(*_):
        raise AssertionError("simulated before the folder was looked at")

    monkeypatch.setattr("sealscope.demo.simulate_experiment", not_called)
    assert call("demo", "-o", "taken").refused() == "cannot create folder: File exists (taken)"
    assert call("demo", "-o", "taken/below").refused().endswith("(taken/below)")
