"""Circuits: each packaged rig names its own, and nothing but the rig reads which valve it is made of."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sealscope
from sealscope.parameters import load_rig, rig_names
from sealscope.parameters.circuit import PUMP_CIRCUIT, VALVE_CIRCUIT

SOURCE = Path(sealscope.__file__).parent
#: Most files that test which valve a rig has: the rig itself, and the live watch.
MOST_FILES = 4


@pytest.mark.parametrize("name", rig_names())
def test_a_packaged_rig_has_one_circuit(name: str) -> None:
    rig = load_rig(name)
    assert rig.circuit is (VALVE_CIRCUIT if name == "servo-valve" else PUMP_CIRCUIT)
    assert rig.circuit.pump_feeds_chambers != rig.circuit.valve_controlled


def test_circuits_have_names_of_their_own() -> None:
    assert PUMP_CIRCUIT.name != VALVE_CIRCUIT.name


def test_packages_ask_the_circuit_and_not_the_valve() -> None:
    tests_valve = re.compile(r"\bspool\s*[!=]=|\bdrive\s*[!=]=\s*\"(absent|constant-speed)")
    files = [path for path in SOURCE.rglob("*.py") if tests_valve.search(path.read_text("utf-8"))]
    assert len(files) <= MOST_FILES, files
