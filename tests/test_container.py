"""The Containerfile, read as its builder reads it; `.ci/containerfile.py` carries its commands out."""

from __future__ import annotations

import json
import re
import tomllib
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def checker(name="containerfile"):
    spec = spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


STEPS = checker().instructions((ROOT / "Containerfile").read_text(encoding="utf-8"))


def test_lines_are_joined_and_comments_left_out():
    text = '# a\nFROM x\n\nRUN one \\\n  # within\n  && two\ncmd ["a"]\n'
    assert checker().instructions(text) == [("FROM", "x"), ("RUN", "one    && two"), ("CMD", '["a"]')]


def test_the_image_has_a_supported_python_and_extras_that_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert STEPS[0][0] == "FROM"
    version = checker().python_of(STEPS[0][1])
    assert f"Programming Language :: Python :: {version}" in project["classifiers"]
    install = next(text for kind, text in STEPS if kind == "RUN" and "pip install" in text)
    extras = re.search(r"\[(.*)\]", install)[1].split(",")
    assert {"serve", "mqtt"} <= set(extras) <= set(project["optional-dependencies"])


def test_what_is_copied_is_there_and_is_all_that_the_build_reads():
    copied = {name for kind, text in STEPS if kind == "COPY" for name in text.split()[:-1]}
    assert all((ROOT / name).exists() for name in copied)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {"pyproject.toml", "src", project["readme"], *project["license-files"]} == copied


def test_it_runs_the_command_as_a_user_without_rights():
    kinds = dict(STEPS)
    assert json.loads(kinds["ENTRYPOINT"]) == ["sealscope"]
    assert json.loads(kinds["CMD"]) == ["demo"]
    assert kinds["USER"] == "sealscope"
    order = [kind for kind, _ in STEPS]
    assert order.index("USER") < order.index("ENTRYPOINT")


def test_on_arm64_the_image_has_all_but_what_has_no_wheel_there(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / ".ci"))
    names = {re.match(r"[\w.-]+", line)[0] for line in checker("arm64").requirements()}
    assert {"numba", "scipy", "paho-mqtt", "psycopg", "SQLAlchemy", "pyarrow"} <= names
    assert "mat-io" not in names
