"""Circuits: each packaged rig names its own, and nothing but the rig reads which valve it is made of."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

import sealscope
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.parameters import load_rig, rig_names
from sealscope.parameters.parts import CIRCUITS, PUMP_CIRCUIT, VALVE_CIRCUIT, check_circuit_property
from sealscope.parameters.rig import declared_names
from sealscope.physics.rig import rig_numbers
from sealscope.recordings.channels import CHANNEL_UNITS

from ..refusals import refusal

ROOT, SOURCE = Path(__file__).resolve().parents[2], Path(sealscope.__file__).parent


@pytest.mark.parametrize("name", rig_names())
def test_a_packaged_rig_has_one_circuit(name: str) -> None:
    rig = load_rig(name)
    assert rig.circuit is (VALVE_CIRCUIT if name == "servo-valve" else PUMP_CIRCUIT)
    assert rig.circuit.pump_feeds_chambers != rig.circuit.valve_controlled


def test_circuits_have_names_and_choices_of_their_own() -> None:
    assert len({circuit.name for circuit in CIRCUITS}) == len(CIRCUITS)
    assert len({(circuit.parameter, circuit.value) for circuit in CIRCUITS}) == len(CIRCUITS)


def test_a_circuit_names_what_others_have() -> None:
    """Parameters and their values; channels; a size of `priors.toml`."""
    rig = load_rig("thesis")
    for circuit in CIRCUITS:
        for name, value in {circuit.parameter: circuit.value, **circuit.required}.items():
            part, _, symbol = name.partition(".")
            assert value in get_args(type(getattr(rig, part)).model_fields[symbol].annotation)
        assert all(name in declared_names() for name in circuit.size_parameters)
        assert {name for way in circuit.watched_by for name in way} <= set(CHANNEL_UNITS)
        assert 0 < getattr(INFERENCE.size, circuit.flow_size) < 1


def test_the_monitor_s_page_lists_the_channels_of_every_circuit() -> None:
    rows = [
        line for line in (ROOT / "docs" / "monitor.md").read_text(encoding="utf-8").splitlines() if line[:3] == "| `"
    ]
    listed = [set(re.findall(r"`(\w+)`", row.split("|")[1])) for row in rows]
    for circuit in CIRCUITS:
        assert all(any(set(way) <= channels for channels in listed) for way in circuit.watched_by)


def test_a_circuit_without_a_property_is_refused_with_those_that_have_it() -> None:
    check_circuit_property("a unit", "rig", PUMP_CIRCUIT, "pump_feeds_chambers")
    with refusal("a unit", "valve.spool = absent", "worn", "valve.spool = present"):
        check_circuit_property("a unit", "worn", VALVE_CIRCUIT, "pump_feeds_chambers")


def test_a_circuit_without_laws_is_not_simulated_by_those_of_another(monkeypatch: pytest.MonkeyPatch) -> None:
    tandem = PUMP_CIRCUIT._replace(name="tandem", parameter="makeup.check_valves", value="present", simulated=False)
    monkeypatch.setattr("sealscope.parameters.rig.CIRCUITS", (tandem, *CIRCUITS))
    rig = load_rig("thesis-closed-loop")
    assert rig.circuit is tandem
    with refusal("a simulation", rig.name, "tandem", "valve.spool = absent"):
        rig_numbers(rig)


def test_laws_alone_ask_which_valve_a_circuit_has() -> None:
    """Elsewhere a property of the circuit answers, so that a further circuit changes nothing there."""
    users = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        if ".valve_controlled" in path.read_text("utf-8")
    }
    drawn = {"reporting/schematic.py", "thesis/chapters/chapter6.py"}
    assert users == drawn | {"physics/rig.py", "physics/standstill.py"}


def test_packages_ask_the_circuit_and_not_the_valve() -> None:
    tests_valve = re.compile(r"\bspool\s*[!=]=|\bdrive\s*[!=]=\s*\"(absent|constant-speed)")
    files = [path.relative_to(SOURCE) for path in SOURCE.rglob("*.py") if tests_valve.search(path.read_text("utf-8"))]
    assert files == [Path("parameters/rig.py")]
