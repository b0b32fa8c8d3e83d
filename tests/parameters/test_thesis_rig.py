"""The packaged rig against the tables it cites."""

from __future__ import annotations

import csv
import json
import math
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from sealscope.parameters import load_rig, rig_names
from sealscope.parameters.fields import choices_of, unit_of
from sealscope.parameters.rig import declared_fields
from sealscope.units import from_si, parse_unit

DATA = Path(__file__).parents[3] / "shared" / "data"

# Table 4.1, in the units it prints, as (dotted name, value, unit)
TABLE_4_1 = [
    ("friction.F_pr", 25, "N"),
    ("cylinder.M_eq", 12.3, "kg"),
    ("friction.F_v", 300, "N s/m"),
    ("cylinder.L", 0.6, "m"),
    ("cylinder.A_A", 633, "mm^2"),
    ("cylinder.A_B", 633, "mm^2"),
    ("cylinder.V", 234, "cm^3"),
    ("friction.F_cfr", 1e-6, "N/Pa"),
    ("friction.C_c", 10, "s/m"),
    ("friction.K_brk", 3, "1"),
    ("friction.v_th", 0.01, "m/s"),
    ("pump.q_b", 4.9e-6, "m^3/rev"),
    ("fluid.K_oil", 689, "MPa"),
    ("motor.R_c", 0.73, "ohm"),
    ("motor.L_c", 3.55e-3, "H"),
    ("motor.C_e", 0.6963, "V s/rad"),
    ("motor.J_M", 0.000874, "kg m^2"),
    ("motor.C_m", 0.6963, "N m/A"),
    ("motor.B_M", 4.855e-4, "N m s/rad"),
    ("fluid.rho", 847, "kg/m^3"),
    ("line.C_d", 0.92, "1"),
    ("line.d_line", 7, "mm"),
]


@pytest.mark.parametrize(("name", "value", "unit"), TABLE_4_1)
def test_table_4_1(name: str, value: float, unit: str) -> None:
    rig = load_rig("thesis")
    stored = rig[name]
    assert isinstance(stored, float)
    assert from_si(stored, unit, unit_of(declared_fields()[name])) == pytest.approx(value, rel=1e-15)
    assert "Table 4.1" in rig.entry(name).source


def test_si_values_are_the_nearest_doubles() -> None:
    rig = load_rig("thesis")
    assert rig.cylinder.A_A == 633e-6
    assert rig.cylinder.V == 234e-6
    assert rig.fluid.K_oil == 689e6
    assert rig.line.V_1 == 44e-6
    assert rig.line.d_line == 7e-3
    assert rig.fluid.p_charge == 0.3e6


def test_motor_agrees_with_the_manufacturers_units() -> None:
    """Table 2.1: 98.615 oz-in/A, 72.975 V/krpm, 0.102 oz-in s^2 (rotor alone), electrical time constant 4.863 ms."""
    motor = load_rig("thesis").motor
    ounce_inch = 0.45359237 / 16 * 9.80665 * 0.0254
    assert motor.C_m == pytest.approx(98.615 * ounce_inch, rel=3e-4)
    assert motor.C_e == pytest.approx(72.975 / (1000 * 2 * math.pi / 60), rel=1e-3)
    assert 0.102 * ounce_inch < motor.J_M
    assert motor.L_c / motor.R_c == pytest.approx(4.863e-3, rel=1e-3)
    assert (motor.V_max, motor.i_max) == (260.0, 23.0)


def test_chapter_2() -> None:
    rig = load_rig("thesis")
    assert rig.pump.omega_max == pytest.approx(4000 * 2 * math.pi / 60, rel=1e-15)
    assert rig.sensors.theta.counts == 20_000
    assert rig.daq.bits == 14
    psi = 0.45359237 * 9.80665 / 0.0254**2
    for channel in ("p_1", "p_2", "p_A", "p_B"):
        assert getattr(rig.sensors, channel).range_hi == pytest.approx(3000 * psi, rel=1e-14)


@pytest.mark.parametrize(("channel", "d1_psi"), [("p_A", 1.23), ("p_B", 1.50)])
def test_total_white_noise_is_the_d1_rms_of_appendix_c(channel: str, d1_psi: float) -> None:
    rig = load_rig("thesis")
    transducer = getattr(rig.sensors, channel)
    volts = rig.daq.sensor_volts_hi - rig.daq.sensor_volts_lo
    step = rig.daq.step * (transducer.range_hi - transducer.range_lo) / volts
    total = math.sqrt(transducer.noise**2 + rig.sensors.common_noise**2 + step**2 / 12)
    assert from_si(total, "psi", "Pa") == pytest.approx(d1_psi, abs=1e-4)
    assert from_si(step, "psi", "Pa") == pytest.approx(0.366, abs=1e-3)


@pytest.mark.parametrize(("sheet", "d1_psi"), [("pa", 1.23), ("pb", 1.50)])
def test_the_d1_rms_is_the_sheets(sheet: str, d1_psi: float) -> None:
    path = DATA / f"appendix_c_{sheet}.csv"
    if not path.is_file():
        pytest.skip(f"the data sheet {path.name} is not here")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    column = next(name for name in rows[0] if "d1" in name and "no_leak" in name)
    assert sum(float(row[column]) for row in rows) / len(rows) == pytest.approx(d1_psi, abs=0.02)


def test_dead_volume_is_the_line_volumes_assumption() -> None:
    rig = load_rig("thesis")
    dead = rig.cylinder.V - rig.cylinder.A_A * rig.cylinder.L / 2
    assert pytest.approx(dead, abs=0.2e-6) == rig.line.V_1


def test_every_value_has_a_source_and_a_unit_of_its_dimension() -> None:
    for row in load_rig("thesis").table():
        assert row.source.strip()
        assert row.meaning
        if row.unit == "":
            assert row.value in choices_of(declared_fields()[row.name])
        elif row.unit != "bit":
            parse_unit(row.unit)


def test_table_holds_every_declared_parameter_once() -> None:
    rig = load_rig("thesis")
    rows = rig.table()
    assert [row.name for row in rows] == list(declared_fields())
    assert len({row.name for row in rows}) == len(rows) == 181
    for row in rows:
        assert row.name.endswith(row.symbol)
        value: object = rig
        for symbol in row.name.split("."):
            value = getattr(value, symbol)
        assert value == row.value


def test_every_packaged_rig_loads() -> None:
    assert "thesis" in rig_names()
    for name in rig_names():
        assert load_rig(name).table()


def test_nomenclature_names_every_parameter() -> None:
    text = (Path(__file__).parents[2] / "docs" / "nomenclature.md").read_text(encoding="utf-8")
    missing = [
        row.name
        for row in load_rig("thesis").table()
        if f"`{row.name}`" not in text and not row.name.startswith(("sensors.p_1", "sensors.p_2", "sensors.p_B"))
    ]
    assert missing == []


def test_rig_survives_json_and_pickle() -> None:
    rig = load_rig("thesis").with_overrides({"V_1": "50[cm^3]"}, source="sweep")
    again = type(rig).from_dict(json.loads(json.dumps(rig.as_dict())), place="log.nc")
    assert again == rig
    assert again.entry("V_1").source == "sweep"
    assert again.as_dict() == rig.as_dict()
    copy = pickle.loads(pickle.dumps(rig))
    assert (copy, copy.name, copy.table()) == (rig, "thesis", rig.table())


@pytest.mark.slow
def test_loading_does_not_import_what_is_heavy() -> None:
    code = (
        "import sys, sealscope.parameters as p; assert 'pydantic' not in sys.modules;"
        "p.load_rig('thesis').with_overrides({'R_c': '0.8[ohm]', 'p_A.noise': '1 psi', 'omega_per_volt': '90 rpm/V'});"
        "heavy = {'pint', 'scipy', 'numba', 'xarray', 'pywt'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_nomenclature_names_every_channel() -> None:
    from sealscope.recordings.recording import CHANNEL_UNITS

    text = (Path(__file__).parents[2] / "docs" / "nomenclature.md").read_text(encoding="utf-8")
    rows = [line for line in text.split("## Channels")[1].split("\n## ")[0].splitlines() if line.startswith("| ")]
    for channel, unit in CHANNEL_UNITS.items():
        assert any(f"`{channel}`" in row and f"| {unit} |" in row for row in rows), channel
