"""What a unit's description says: variables, units, what is refused."""

from __future__ import annotations

import os
import re
import sys
import zipfile
from xml.etree import ElementTree

import pytest

from sealscope.emit.compiler import Compiler, find_compiler
from sealscope.fmu import build
from sealscope.fmu.description import base_units, format_description
from sealscope.fmu.variables import REFERENCES, VALUES, variables
from sealscope.parameters import load_rig

from ..refusals import refusal


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("Pa", {"kg": "1", "m": "-1", "s": "-2"}),
        ("m^3/(s Pa)", {"m": "4", "s": "1", "kg": "-1"}),
        ("m^3/(s Pa^0.5)", None),  # half powers have no form in FMI
        ("L/min", {"m": "3", "s": "-1", "factor": repr(1e-3 / 60.0)}),
        ("rad/s", {"rad": "1", "s": "-1"}),
    ],
)
def test_units_are_written_as_powers_of_base_units(unit, expected):
    assert base_units(unit) == expected


@pytest.mark.parametrize("name", ["thesis", "single-rod-eha"])
def test_every_parameter_that_a_law_takes_is_tunable_unless_it_is_absent(name):
    rig = load_rig(name)
    listed = {v.name: v for v in variables(rig, 1e-3)}
    for symbol, value in zip(VALUES, range(len(VALUES)), strict=True):
        if symbol in listed:
            assert listed[symbol].reference == REFERENCES["value"] + value
            assert listed[symbol].start == rig[symbol]
            assert listed[symbol].unit
    assert {"pump.q_b", "cylinder.A_A", "friction.F_v", "line.C_d", "fluid.rho"} <= set(listed)
    assert ("makeup.G_relief" in listed) == (rig["makeup.G_relief"] > 0)  # a law that the rig does without


@pytest.mark.parametrize(("version", "tag"), [(2, "ScalarVariable"), (3, "Float64")])
def test_references_and_names_are_unique_and_outputs_are_listed(version, tag):
    listed = tuple(variables(load_rig("thesis"), 1e-3))
    root = ElementTree.fromstring(format_description(version, "eha", "token", "words", listed, ["unit.c"]))
    held = list(root.iter(tag))
    assert len({v.get("name") for v in held}) == len(held)
    assert len({v.get("valueReference") for v in held}) == len(held)
    outputs = [v.name for v in listed if v.causality == "output"]
    assert len(list(root.iter("InitialUnknown")) or list(root.find("ModelStructure/InitialUnknowns"))) == len(outputs)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"path": "eha.zip"}, ".fmu, eha.zip"),
        ({"fmi": 1}, "fmi, 1"),
        ({"platforms": ["amiga"]}, "platform, 'amiga'"),
        ({"platforms": ["macos-arm"]}, "platform, 'macos-arm'"),
        ({"step": 0.0}, "step, 0.0"),
        ({"step": float("inf")}, "step, inf"),
        (
            {"rig": "servo-valve"},
            "unit, servo-valve",
        ),
    ],
)
def test_wrong_options_are_one_line_and_write_nothing(tmp_path, monkeypatch, options, names):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(build, "find_compiler", lambda: Compiler([sys.executable], cross_compiles=True))
    with refusal(*names.split(", ")):
        build.write_fmu(**{"path": "eha.fmu"} | options)
    assert list(tmp_path.iterdir()) == []


def test_without_a_compiler_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with refusal("sealscope[fmu]"):
        find_compiler()


@pytest.mark.parametrize("version", [2, 3])
def test_a_unit_of_sources_needs_no_compiler(tmp_path, monkeypatch, version):
    def refuse():
        raise AssertionError("no compiler is to be sought")

    monkeypatch.setattr(build, "find_compiler", refuse)
    monkeypatch.setattr(build, "fmi_headers", lambda: tmp_path)
    build.write_fmu(tmp_path / "eha.fmu", fmi=version, step=1e-3, platforms=["source"])
    with zipfile.ZipFile(tmp_path / "eha.fmu") as archive:
        names = set(archive.namelist())
        description = archive.read("modelDescription.xml" if version == 2 else "sources/buildDescription.xml").decode()
        laws = archive.read("sources/rig.c").decode()
    assert not any(name.startswith("binaries/") for name in names)
    listed = re.findall(r'<(?:Source)?File name="(.*?)"/>', description)
    assert {f"sources/{name}" for name in listed} == {name for name in names if name.endswith(".c")}
    assert "void sealscope_advance(" in laws


@pytest.mark.skipif(os.name != "posix", reason="the compilers are scripts of a shell")
@pytest.mark.parametrize(
    ("script", "names"),
    [
        ("#!/bin/sh\nexec sleep 60\n", "within 0.2 s"),
        ("no program", "Exec format error"),
        ("#!/bin/sh\nexit 0\n", "status 0"),
        ("#!/bin/sh\nprintf 'one\\ntwo \\377' >&2; exit 1\n", "one two"),
    ],
)
def test_a_compiler_that_builds_nothing_is_one_line(tmp_path, monkeypatch, script, names):
    compiler = tmp_path / "cc"
    compiler.write_text(script)
    compiler.chmod(0o755)
    monkeypatch.setattr(build, "find_compiler", lambda: Compiler([str(compiler)], cross_compiles=False))
    monkeypatch.setattr(build, "fmi_headers", lambda: tmp_path)
    monkeypatch.setattr(build, "_COMPILE_TIMEOUT", 0.2 if "sleep" in script else 60.0)
    unit = build.MockUp("words", {}, (), (), n_inputs=1, n_results=1, n_states=1, step=1e-3, failures={})
    with refusal("C compiler", compiler, "linux", names):
        unit.write(tmp_path / "eha.fmu", 2, ["linux"])
    assert list(tmp_path.iterdir()) == [compiler]
