"""Maps: formulas, units from names, columns by the last words of a name, and what a map leaves unused."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import sealscope as ss
from sealscope.cli.app import app
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, read, write
from sealscope.reporting.messages import next_steps, say

from ..refusals import refusal

COUNT, RATE = 40, 500.0
COLUMNS = np.random.default_rng(7).integers(-4000, 4000, size=(COUNT, 3)).astype(float)
NUMBERS = st.floats(-1e3, 1e3).map(lambda value: round(value, 6))


def table(folder: Path, head: str, columns: np.ndarray = COLUMNS, name: str = "log.csv") -> Path:
    """Write rows of a time [s] and these columns under a heading."""
    rows = [";".join(f"{value:.10g}" for value in (k / RATE, *row)) for k, row in enumerate(columns)]
    path = folder / name
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(a=NUMBERS, b=NUMBERS, c=NUMBERS, unit=st.sampled_from([("bar", 1e5), ("kPa", 1e3), ("Pa", 1.0)]))
def test_a_formula_is_the_affine_function_that_it_says(tmp_path: Path, a: float, b: float, c: float, unit) -> None:
    path = table(tmp_path, "t [s];ADC_1;ADC_2;ADC_3")
    one, two, _ = COLUMNS.T
    expected = (a * one + b * two / 2 - c) * unit[1]
    for text in (
        f"{a}*ADC_1 + {b}*ADC_2/2 - {c} {unit[0]}",
        f"ADC_1*{a} - ({c} - ADC_2*{b}*0.5) [{unit[0]}]",
        f"-({c}) + ({a}*#2 + 0.5*(`ADC_2`*{b})) {unit[0]}",
    ):
        pressure = read(path, map={"p_A": text})["p_A"]
        np.testing.assert_allclose(pressure, expected, rtol=1e-12, atol=1e-6 * unit[1])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2*max(ADC_1) bar", "formula"),
        ("2*abs(ADC_1, ADC_2) bar", "formula"),
        ("sqrt(-1)*ADC_1 bar", "formula"),
        ("ADC_1.real*2 bar", "ADC_1.real"),
        ("(lambda: 2)*ADC_1 bar", "formula"),
        ("ADC_1*1/0 bar", "formula"),
        ("2*3 bar", "formula"),
        ("ADC_1*1e999 bar", "formula"),
        ("(" * 300 + "ADC_1*2", "formula"),
        ("__import__('os')*ADC_1", "formula"),
        ("ADC_1**2 bar", "formula"),
        ("ADC_7*2 bar", "ADC_7"),
        ("ADC_1*2 mm", "p_A"),
        ("ADC*2 bar", "column"),
    ],
)
def test_what_is_no_formula_is_refused_in_a_line(tmp_path: Path, text: str, words: str) -> None:
    with refusal(*words.split(", ")):
        read(table(tmp_path, "t [s];ADC_1;ADC_2;ADC_3"), map={"p_A": text})


@pytest.mark.parametrize("seed", range(12))
def test_a_formula_takes_products_and_functions_with_the_units_of_its_columns(tmp_path: Path, seed: int) -> None:
    """Drawn values; angles in degrees or rad, a quotient of force and area, a speed times a direction in per cent."""
    generator = np.random.default_rng(seed)
    columns = generator.uniform(-60.0, 60.0, (COUNT, 5)) + np.array([0.0, 0.0, 70.0, 0.0, 0.0])
    force, angle, area, speed, valve = columns.T
    angle_unit, radians = [("deg", np.pi / 180.0), ("rad", 1.0)][seed % 2]
    angle *= (np.pi / 180.0) / radians
    path = table(tmp_path, f"t [s];F [kN];phi [{angle_unit}];A [mm^2];n [1/min];Ventil [%]", columns)
    length, share = generator.uniform(0.1, 2.0, 2).round(3)
    for channel, text, expected in (
        ("p_A", "abs(F)/A", np.abs(force) / area * 1e9),
        ("p_A", f"sqrt((F/A)*(F/A)*{share})", np.abs(force) / area * np.sqrt(share) * 1e9),
        ("omega", "n*Ventil/100", speed * valve / 100.0 * np.pi / 30.0),
        ("omega", f"-{share}*n*sign(Ventil)", -share * speed * np.sign(valve) * np.pi / 30.0),
        ("x", f"{length}*tan(phi)*cos(phi) m", length * np.sin(radians * angle)),
        ("theta", f"phi + {share}*phi*sin(0.5)", radians * angle * (1.0 + share * np.sin(0.5))),
    ):
        np.testing.assert_allclose(read(path, map={channel: text})[channel], expected, rtol=1e-7, err_msg=text)
    for channel, text, words in (
        ("p_A", "F*A", "p_A"),
        ("p_A", "F/A + n", "state its unit"),
        ("x", "2*sin(F) m", "angle"),
        ("omega", "n*F", "omega"),
    ):
        with refusal(words):
            read(path, map={channel: text})


def test_a_log_of_converter_counts_is_read_by_one_command(tmp_path: Path) -> None:
    """Times are numbers of milliseconds, which alone could be numbers of rows."""
    head = "time;" + ";".join(f"ADC1_Channel_{number}" for number in range(1, 13))
    rows = [[k, *(100 * number + k % 7 for number in range(1, 13))] for k in range(300)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([head, *(";".join(map(str, row)) for row in rows)]) + "\n")
    maps = ["p_A=ch2*0.0625-0.625 bar", "x=0.025*ch12 mm", "omega=ch10 rpm"]
    options = [word for text in maps for word in ("--map", text)]
    refused = CliRunner().invoke(app, ["inspect", str(path), *options])
    assert refused.exit_code == 1
    done = CliRunner().invoke(app, ["inspect", str(path), *options, "--map", "t=time ms"])
    assert done.exit_code == 0, done.output
    assert "300 samples at 1000 Hz" in done.output
    recording = read(path, map={**dict(text.split("=") for text in maps), "t": "time ms"})
    np.testing.assert_allclose(recording["p_A"], [(0.0625 * row[2] - 0.625) * 1e5 for row in rows])
    np.testing.assert_allclose(recording["x"], [0.025e-3 * row[12] for row in rows])
    np.testing.assert_allclose(recording["omega"], [row[10] * np.pi / 30 for row in rows])
    with refusal("ch3", "p_A", error=UnreadableFile):
        read(table(tmp_path, "t [s];A_ch_3;B_channel_3;C"), map={"p_A": "ch3"})


@pytest.mark.parametrize(
    ("heads", "channel", "factor"),
    [
        ("p_bottom_bar;p_rod_bar;stroke_mm", "p_A", 1e5),
        ("p_cap_psi;p_rod_psi;pos_mm", "p_A", 6894.757293168),
        ("p_cap_kPa;p_rod_kPa;xpos_mm", "p_A", 1e3),
        ("MainPaMPa;MainPbMPa;Weg_mm", "p_A", 1e6),
        ("PaBar;PbBar;MotSpd_rpm", "p_A", 1e5),
        ("motor_rpm;p_rod_bar;p_cap_bar", "omega", np.pi / 30),
        ("MotSpd_rad_s;p_rod_bar;p_cap_bar", "omega", 1.0),
        ("stroke_mm;p_rod_bar;p_cap_bar", "x", 1e-3),
        ("leak_l_min;p_rod_bar;p_cap_bar", "q_leak", 1e-3 / 60),
        ("leak_lpm;p_rod_bar;p_cap_bar", "q_leak", 1e-3 / 60),
    ],
)
def test_units_come_from_the_names(tmp_path: Path, heads: str, channel: str, factor: float) -> None:
    path = table(tmp_path, f"time_s;{heads}")
    first = COLUMNS[:, 0]
    for channel_map in ("auto", {channel: heads.split(";", maxsplit=1)[0]}):
        np.testing.assert_allclose(read(path, map=channel_map)[channel], factor * first, rtol=1e-9)


def test_a_stated_unit_goes_before_that_of_the_name(tmp_path: Path) -> None:
    path = table(tmp_path, "t [s];p_bottom_bar;p_A_bar;rod")
    assert read(path, map={"p_B": "p_bottom_bar[kPa]"})["p_B"] == pytest.approx(1e3 * COLUMNS[:, 0])
    assert read(path, map={"p_B": "2*p_bottom_bar"})["p_B"] == pytest.approx(2e5 * COLUMNS[:, 0])
    assert read(path)["p_A"] == pytest.approx(1e5 * COLUMNS[:, 1])  # its own name, before a unit
    raw = read(path, map={"p_B": "rod"})  # a word, not the length of 5 m
    assert raw.units["p_B"] == "count"
    assert [finding.channel for finding in ss.inspect(raw) if finding.code == "raw_counts"] == ["p_B"]


@pytest.mark.parametrize("suffix", [".nc", ".csv", ".parquet"])
def test_what_was_recorded_and_not_used_survives_a_round_trip(tmp_path: Path, suffix: str) -> None:
    head = "t [s];p_bottom_bar;p_tank_bar;motor_rpm;x_set_mm;oil [degC];v [mm/s];gauge"
    path = table(tmp_path, head, np.hstack([COLUMNS, COLUMNS, COLUMNS[:, :1]]))
    recording = read(path, map={"p_A": "p_bottom_bar"})
    assert recording.unused == ("p_tank_bar", "motor_rpm", "v [mm/s]")  # no set point, no temperature
    assert read(path, map={"p_A": "p_bottom_bar-0.5*p_tank_bar", "omega": "motor_rpm"}).unused == ("v [mm/s]",)
    kept = tmp_path / f"own{suffix}"
    write(recording, kept)
    assert read(kept).unused == recording.unused
    assert Recording(recording.t, recording.channels, recording.units, RATE).unused == ()


def test_a_count_of_the_rows_is_no_speed_that_was_not_used(tmp_path: Path) -> None:
    path = table(tmp_path, "t [s];n;motor_n;p_A_bar", np.hstack([np.arange(len(COLUMNS))[:, None], COLUMNS[:, :2]]))
    assert read(path, map={"p_A": "p_A_bar"}).unused == ("motor_n",)


def test_a_verdict_names_what_was_not_used(tmp_path: Path) -> None:
    path = table(tmp_path, "t [s];p_bottom;p_rod_bar;p_tank_bar")
    arguments = ["diagnose", str(path), "--map", "p_A=p_bottom", "--map", "p_B=p_rod_bar"]
    line = CliRunner().invoke(app, [*arguments, "--format", "jsonl"]).stdout
    assert json.loads(line)["unused"] == ["p_tank_bar"]
    text = CliRunner().invoke(app, arguments).stdout
    assert "p_tank_bar" in text and "state the unit" in text
    page = tmp_path / "page.html"
    done = CliRunner().invoke(app, ["report", *arguments[1:], "-o", str(page)])
    assert done.exit_code == 0, done.output
    assert "p_tank_bar" in page.read_text()


def test_signals_that_simulink_streamed_are_read_by_name(tmp_path: Path) -> None:
    path = tmp_path / "test.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for number, (name, unit) in enumerate((("<rig_Pa>", "bar"), ("<rig_Pb>", ""), ("<rig_PaFiltered>", "bar"))):
            group = file.create_group(f"#refs#/{'abc'[number]}")
            group["Name"] = np.frombuffer(name.encode("utf-16-le"), np.uint16)[:, None]
            group["Values/DataR2"] = [[float(2 - number)]]
            group["Values/CompressedTime"] = [[0.0], [0.01], [float(COUNT)]]
            group["Values/DataUnits/Value"] = np.frombuffer(unit.encode("utf-16-le"), np.uint16)
            stream = file.create_group(f"#sigstream#/{2 - number}")
            stream["#data#"] = np.frombuffer(COLUMNS[:, number].tobytes() + bytes(80), np.uint8)
            stream["#length#"], stream["#sampleSize#"] = np.uint64([COUNT]), np.uint64([8])
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    recording = read(path, map={"p_A": "Pa", "p_B": "Pb kPa"})
    assert recording.rate == 100.0
    np.testing.assert_array_equal(recording["p_A"], 1e5 * COLUMNS[:, 0])
    np.testing.assert_array_equal(recording["p_B"], 1e3 * COLUMNS[:, 1])


def test_a_twincat_export_with_names_alone_has_its_clock_and_its_start(tmp_path: Path) -> None:
    """Its last row is cut short."""
    head = "Name,crane,\nStarttime of export,133898814400300000,onsdag 23. april 2025\n\n\nName,MainPa,MainPb,MainX\n\n"
    rows = [f"{10 * k},{20 + k % 5},{5 + k % 3},0.5" for k in range(60)]
    path = tmp_path / "log.csv"
    path.write_text(head + "\n".join(rows)[:-8])
    recording = read(path, map={"p_A": "MainPa bar", "p_B": "MainPb bar"})
    assert (len(recording), recording.rate) == (60, 100.0)
    assert recording.provenance["start"].startswith("2025-04-23T11:30:40.03")
    assert recording.unused == ("MainX",)
    assert recording["p_A"][-2] == 23e5


@pytest.mark.parametrize(("head", "unit"), [("Joystick [%]", "%"), ("spool_pct", "pct"), ("Command [mA]", "mA")])
def test_a_command_in_percent_or_mA_is_a_command(tmp_path: Path, head: str, unit: str) -> None:
    recording = read(table(tmp_path, f"t [s];p_A [bar];p_B [bar];{head}"), map="auto")
    assert recording.units["u"] == "count"
    assert np.allclose(recording["u"], COLUMNS[:, 2])
    assert any(f"is a command in {unit}" in line for line in recording.history)


def test_columns_that_no_channel_is_made_of_are_named_with_the_line_to_write(tmp_path: Path) -> None:
    from sealscope.reporting.messages import format_unused_columns

    rows = np.column_stack([COLUMNS, COLUMNS])[np.arange(2000) % COUNT] + 1e3
    path = table(tmp_path, "t [s];p_A [bar];p_B [bar];p_pump_bar;p_tank_bar;Flow [l/min];Weg [mm]", rows)
    said = format_unused_columns(ss.diagnose(read(path)))
    assert said is not None
    for line in ("p_1=p_pump_bar", "p_2=p_tank_bar", "q_pump=Flow [l/min]", "x=Weg [mm]"):
        assert f"--map '{line}'" in said


def test_a_rate_is_not_blamed_where_a_column_is_not_mapped(tmp_path: Path) -> None:
    random, t = np.random.default_rng(1), np.arange(6000) / 50.0
    swing = 20 * np.tanh(8 * np.cos(2 * t))
    noise = 0.05 * random.standard_normal((2, t.size))
    columns = [t, 60 + swing + noise[0], 60 - swing + noise[1], 100 * np.sin(2 * t)]
    text = "t [s];p_A [bar];p_B [bar];Weg [mm]\n" + "\n".join(
        ";".join(f"{v:.5f}" for v in row) for row in zip(*columns, strict=True)
    )
    (tmp_path / "log.csv").write_text(text + "\n")
    reason = ss.diagnose(read(tmp_path / "log.csv")).reason
    assert "Weg [mm]: recorded, and used for no channel" in reason
    assert "250 Hz" not in reason


def test_a_channel_that_lacks_is_named_before_the_rate(tmp_path: Path) -> None:
    random, t = np.random.default_rng(1), np.arange(12000) / 100.0
    swing = 20 * np.tanh(8 * np.cos(2 * t))
    noise = 0.05 * random.standard_normal((2, t.size))
    rows = zip(t, 60 + swing + noise[0], 60 - swing + noise[1], 100 * np.sin(2 * t), strict=True)
    text = "t [s];p_A [bar];p_B [bar];x [mm]\n" + "\n".join(";".join(f"{v:.5f}" for v in row) for row in rows)
    (tmp_path / "log.csv").write_text(text + "\n")
    rig = unstated_rig().with_areas(3.7e-3, 2.2e-3, source="data sheet")
    diagnosis = ss.diagnose(read(tmp_path / "log.csv"), rig=rig)
    assert diagnosis.verdict == "cannot tell"
    assert diagnosis.reason.startswith("the volume balance needs p_A, p_B and the pump's theta or omega")
    assert next_steps(diagnosis)[0] == say("next.record")


def test_columns_that_are_not_used_are_the_first_step(tmp_path: Path) -> None:
    t = np.arange(3000) / 100.0
    rows = "\n".join(f"{v:.3f},{500 + 9 * np.sin(v):.3f},{90 - 9 * np.sin(v):.3f},{v:.3f}" for v in t)
    (tmp_path / "log.csv").write_text("t_s,pA_psi,pB_psi,x_in\n" + rows + "\n")
    diagnosis = ss.diagnose(read(tmp_path / "log.csv", map={"x": "x_in"}))
    assert "pB_psi" in diagnosis.unused
    assert next_steps(diagnosis)[0] == say("next.map")


@pytest.mark.parametrize("line", ["SamplePeriod_ms;2", "Cycle time [ms];2", "Abtastzeit_ms;2", "SampleRate_Hz;500"])
def test_the_sample_period_of_a_controller_s_heading_is_used_and_said(tmp_path: Path, line: str) -> None:
    rows = "\n".join(f"{k};{value:g};{value:g}" for k, (value, *_) in enumerate(COLUMNS))
    (tmp_path / "log.csv").write_text(f"Station;Press 4\n{line}\n\nNo;p_A [bar];p_B [bar]\n{rows}\n")
    recording = read(tmp_path / "log.csv")
    assert recording.rate == RATE
    assert "no time column: sampled at 500 Hz, as the file says" in recording.history


def test_prefixes_behind_numbers_are_powers_of_ten(tmp_path: Path) -> None:
    text = "t [s],p_A [Pa],x [m]\n" + "".join(f"{k}m,{k % 7 - 3}.5k,{170 + k}.3m\n" for k in range(1, 40))
    (tmp_path / "log.csv").write_text(text)
    recording = read(tmp_path / "log.csv")
    k = np.arange(1, 40)
    assert recording["x"] == pytest.approx((170.3 + k) * 1e-3)
    assert recording["p_A"] == pytest.approx((np.abs(k % 7 - 3) + 0.5) * np.where(k % 7 < 3, -1e3, 1e3))
    assert recording.rate == 1e3


def test_pressures_and_oil_are_shown_in_the_units_of_the_log(tmp_path: Path) -> None:
    from sealscope.reporting.overview import overview_text

    rows = np.column_stack([COLUMNS, 40.0 + 1e-3 * COLUMNS[:, :1]])
    recording = read(table(tmp_path, "t [s];p_A [psi];p_B [psi];x [mm];T_oil [degC]", rows))
    text = overview_text("log.csv", recording, ())
    low, high = rows[:, 0].min(), rows[:, 0].max()
    assert f"{low:.4g} to {high:.4g} psi" in text
    assert f"{rows[:, 3].min():.4g} to {rows[:, 3].max():.4g} degC" in text
    assert " K" not in text
    assert recording.pressure_unit == ss.diagnose(recording).pressure_unit == "psi"


def test_no_name_is_cut_in_its_middle() -> None:
    from sealscope.paragraphs import join_names

    name = "Zylinder 4 Druck Kolbenseite nach Ventil Y12 [bar]"
    assert join_names([name, "x" * 100]) == f"{name}, {'x' * 77}..."


@pytest.mark.parametrize("head", ["flow_A_Lpm", "flow_A_lpm", "Flow A [LPM]"])
def test_litres_a_minute_are_a_flow_however_they_are_written(tmp_path: Path, head: str) -> None:
    recording = read(table(tmp_path, f"t [s];p_A [bar];p_B [bar];{head}"), map="auto")
    assert recording["q_pump"] == pytest.approx(COLUMNS[:, 2] / 60e3)


def test_a_prefix_is_told_from_a_unit_by_the_column_that_has_both(tmp_path: Path) -> None:
    """Millimetres behind decimal commas: every position ends in m, as if it were metres; speeds do so where slow."""
    speeds = [f"{k / 10:.1f}".replace(".", ",") if k % 40 else "0,0m" for k in range(1, 400)]
    rows = [f"0,{k:03d};{k % 90 + 1},5m;{speed}" for k, speed in enumerate(speeds, 1)]
    (tmp_path / "log.csv").write_text("t [s];x [m];omega [1/min]\n" + "\n".join(rows) + "\n")
    recording = read(tmp_path / "log.csv")
    assert recording["x"][:3] == pytest.approx([2.5e-3, 3.5e-3, 4.5e-3])
    assert np.isfinite(recording["omega"]).all()


def test_a_time_beside_each_channel_is_no_position(tmp_path: Path) -> None:
    rows = "\n".join(f"{k / 100:.3f},{k},{k / 100 + 0.001:.3f},{k},{k / 100:.3f},{k}" for k in range(100))
    head = "X_Value,Pressure A (bar),X_Value,Pressure B (bar),X_Value,Position (mm)"
    (tmp_path / "log.csv").write_text(f"{head}\n{rows}\n")
    recording = read(tmp_path / "log.csv", map="auto")
    assert {*recording.channels} == {"p_A", "p_B", "x"}
    assert recording["p_B"][1:] == pytest.approx(1e5 * (np.arange(1, 100) - 0.1))
