"""`sealscope plugin new`: what it writes runs, is tested, and can be built and judged."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tomllib

import pytest

import sealscope as ss
from sealscope.campaigns.plans.reader import load_plan

from ..refusals import refusal


@pytest.fixture(scope="module")
def recording():
    return ss.simulate(command="5 sin(2t)", duration="90 s", seed=1)


def test_what_is_written_is_a_detector_with_an_entry_point_and_a_plan(call, tmp_path, monkeypatch, recording):
    monkeypatch.chdir(tmp_path)
    done = call("plugin", "new", "stroke time")
    assert (done.status, done.err) == (0, "")
    place = tmp_path / "stroke-time"
    project = tomllib.loads((place / "pyproject.toml").read_text())
    entry = project["project"]["entry-points"]["sealscope.detectors"]
    assert entry == {"stroke time": "stroke_time:StrokeTime"}
    spec = importlib.util.spec_from_file_location("stroke_time", place / "stroke_time.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    detector = module.StrokeTime(ss.load_rig())
    assert detector.name == "stroke time"
    assert detector.usable(recording) is None
    assert detector.usable(recording.only(["p_A"])) == "needs p_A and p_B"
    (change,) = detector.observe(recording).observables
    assert change.chance > 0.01
    with refusal("stroke time"):
        load_plan(place / "judge.toml")  # until it is installed, no detector has its name


@pytest.mark.parametrize("name", ["Stroke", "stroke-time", "1st", "class", "a" * 61, "../x"])
def test_a_name_that_is_none_is_one_line_and_writes_nothing(call, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert "a detector's name must" in call("plugin", "new", name).refused()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_distribution_is_built_installed_and_judges(call, tmp_path, recording):
    place, target = tmp_path / "plug", tmp_path / "installed"
    call("plugin", "new", "stroke time", "-o", place)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "-q", "--no-deps", "--target", target, place], check=True, timeout=300)
    paths = os.pathsep.join(map(str, [target, *filter(None, [os.environ.get("PYTHONPATH")])]))
    environment = os.environ | {"PYTHONPATH": paths}
    ss.write(recording, tmp_path / "run.nc")
    words = [sys.executable, "-m", "sealscope", "-v", "diagnose", tmp_path / "run.nc"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120, check=True)
    assert "stroke time: cannot tell" in done.stdout
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull, place]
    subprocess.run(tests, env=environment, check=True, timeout=120, cwd=place)
