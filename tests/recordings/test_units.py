"""Units: known values, agreement with pint, dimensions kept apart, and texts from outside."""

import contextlib
import functools
import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.units import LITRE_PER_MINUTE, from_si, parse_quantity, same_dimension, to_si

from ..refusals import refusal

KNOWN = [
    ("234 cm^3", "m^3", 2.34e-4),
    ("2[L/min]", "m^3/s", 2 / 60000),
    ("2 l/min", "m^3/s", 2 / 60000),
    ("4.2 mL/min", "m^3/s", 7e-8),
    ("3000 psi", "Pa", 3000 * 0.45359237 * 9.80665 / 0.0254**2),
    ("2.5 bar", "Pa", 2.5e5),
    ("0.25 MPa", "Pa", 2.5e5),
    ("1.01325 bara", "Pa", 0.0),
    ("0 psi(a)", "Pa", -101325.0),
    ("3 bar(g)", "Pa", 3e5),
    ("7 mm", "m", 7e-3),
    ("100 rpm/V", "rad/s/V", 100 * 2 * math.pi / 60),
    ("100 rpm/V", "rad/(s V)", 100 * 2 * math.pi / 60),
    ("4.9 cm3/rev", "m^3/rev", 4.9e-6),
    ("25 %", "1", 0.25),
    ("180 deg", "rad", math.pi),
    ("3.55 mH", "H", 3.55e-3),
    ("20000 counts/rev", "count/rev", 20000.0),
    ("300 N·s/m", "N s/m", 300.0),
    ("20 °C", "K", 293.15),
    ("5", "Pa", 5.0),
    ("-1.5e-3 m", "m", -1.5e-3),
    ("0.98 N m/A", "N m/A", 0.98),
    ("1 m^3/s/Pa^0.5", "m^3/(s Pa^0.5)", 1.0),
]


@pytest.mark.parametrize(("text", "si_unit", "expected"), KNOWN)
def test_known_values(text: str, si_unit: str, expected: float) -> None:
    assert parse_quantity(text, si_unit) == pytest.approx(expected, rel=4e-16, abs=1e-22)


def test_a_decimal_is_rounded_once() -> None:
    assert parse_quantity("234 cm^3", "m^3") == 2.34e-4
    assert to_si(4.9, "cm^3/rev", "m^3/rev") == 4.9e-6
    assert to_si(633, "mm^2", "m^2") == 633e-6


@functools.cache
def pint_registry():
    import pint

    return pint.UnitRegistry()


@pytest.mark.parametrize(
    ("unit", "si_unit", "pint_unit"),
    [
        ("psi", "Pa", "psi"),
        ("lpm", "m^3/s", "L/min"),
        ("rpm", "rad/s", "rpm"),
        ("cm^3/rev", "m^3/rev", "cm**3/revolution"),
        ("kHz", "Hz", "kHz"),
        ("inHg", "Pa", "inHg"),
        ("gallon/min", "m^3/s", "gallon/min"),
        ("lbf", "N", "lbf"),
    ],
)
def test_agrees_with_pint(unit: str, si_unit: str, pint_unit: str) -> None:
    registry = pint_registry()
    target = {"m^3/rev": "m**3/revolution"}.get(si_unit, si_unit)
    expected = registry.Quantity(3.7, pint_unit).to(target).magnitude
    assert to_si(3.7, unit, si_unit) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "si_unit", "names"),
    [
        ("2 Hz", "rad/s", "q, Hz, rig.toml"),
        ("2 mm", "Pa", "q, mm, rig.toml"),
        ("2 counts", "Pa", "q, counts, rig.toml"),
        ("4 cm^3", "m^3/rev", "q, cm^3, rig.toml"),
        ("3 furlongz", "m", "q, furlongz, rig.toml"),
        ("3 Pa", "1", "q, Pa, rig.toml"),
        ("1e5000", "Pa", "q, 1e5000, rig.toml"),
        ("1e308 MPa", "Pa", "q, 1e308 MPa, rig.toml"),
        ("nan", "Pa", "q, nan, rig.toml"),
        ("soft", "Pa", "q, 'soft', rig.toml"),
        ("", "Pa", "q, '', rig.toml"),
        ("3 (m", "m", "q, (m, rig.toml"),
        ("3 dBm", "W", "q, dBm, rig.toml"),
    ],
)
def test_one_clear_line(text: str, si_unit: str, names: str) -> None:
    with refusal(*names.split(", ")):
        parse_quantity(text, si_unit, name="q", place="rig.toml")


@pytest.mark.parametrize(
    "text", ["9**9**9**9 m", "m^99999999", "1e-999999999 psi", "((((((m", "1 " + "m " * 500, "1e999999999 psi"]
)
def test_hostile_texts_end_at_once(text: str) -> None:
    try:
        assert parse_quantity(text, "Pa") == 0.0
    except InputError as error:
        assert "\n" not in str(error)


@settings(deadline=None)
@given(st.text(max_size=30))
def test_any_text_is_a_number_or_an_input_error(text: str) -> None:
    with contextlib.suppress(InputError):
        assert math.isfinite(parse_quantity(text, "1"))


@given(
    st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=20),
    st.sampled_from([("psi", "Pa"), ("mm", "m"), ("rpm", "rad/s"), ("degC", "K"), ("deg", "rad"), ("mL/min", "m^3/s")]),
)
def test_there_and_back(values: list[float], units: tuple[str, str]) -> None:
    unit, si_unit = units
    there = to_si(values, unit, si_unit)
    assert np.allclose(from_si(there, unit, si_unit), values, rtol=1e-14, atol=1e-12)
    # one number and an array agree to the last places
    assert to_si(values[0], unit, si_unit) == pytest.approx(float(there[0]), rel=1e-15, abs=1e-300)


def test_dimensions() -> None:
    assert same_dimension("psi", "Pa")
    assert same_dimension("rpm", "rad/s")
    assert not same_dimension("Hz", "rad/s")
    assert not same_dimension("nonsense!", "Pa")


def test_the_units_of_hydraulics_need_no_pint() -> None:
    code = (
        "import sys; from sealscope.units import parse_quantity as q\n"
        "q('3 psi','Pa'), q('2 L/min','m^3/s'), q('1 rpm/V','rad/(s V)'), q('2 N s/m','N s/m'), q('4 degC','K')\n"
        "sys.exit('pint' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("value", [3, 3.0, np.float64(3.0), np.int64(3), "3", "3 s", "0.05[min]", "3000[ms]"])
def test_a_quantity_may_be_a_number_or_a_text(value):
    assert parse_quantity(value, "s") == 3.0


@pytest.mark.parametrize("value", [None, True, [3.0], 3 + 0j, "three"])
def test_what_is_no_quantity_is_refused_by_name(value):
    with refusal("duration"):
        parse_quantity(value, "s", name="duration")


def test_a_litre_per_minute_is_that_of_the_units():
    assert parse_quantity("1[L/min]", "m^3/s") == LITRE_PER_MINUTE
