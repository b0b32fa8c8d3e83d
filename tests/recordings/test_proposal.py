"""Maps proposed from the names of foreign columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealscope.errors import UnreadableFile
from sealscope.recordings import read
from sealscope.recordings.formats.headings.labels import Label, proposed_map, split_unit
from sealscope.recordings.quality import describe_missing_chambers

from ..refusals import refusal


@pytest.mark.parametrize(
    ("heads", "expected"),
    [
        (
            "Zeit [s];Druck A [bar];Druck B [bar];Weg_mm;Drehzahl [1/min];Öldruck [bar]",
            {
                "t": "Zeit [s]",
                "p_A": "Druck A [bar]",
                "p_B": "Druck B [bar]",
                "x": "Weg_mm[mm]",
                "omega": "Drehzahl [1/min][rpm]",
            },
        ),
        ("Time;PA_bar;PB_bar;Cmd_V", {"t": "Time", "p_A": "PA_bar[bar]", "p_B": "PB_bar[bar]", "u": "Cmd_V[V]"}),
        ("time;Cyl_P_Cap;Cyl_P_Rod", {"t": "time", "p_A": "Cyl_P_Cap", "p_B": "Cyl_P_Rod"}),
        (
            "Temps [s];Pression tige [bar];Pression fond [bar];Course [mm]",
            {"t": "Temps [s]", "p_A": "Pression fond [bar]", "p_B": "Pression tige [bar]", "x": "Course [mm]"},
        ),
        (
            "时间 [s];无杆腔压力 [MPa];有杆腔压力 [MPa]",
            {"t": "时间 [s]", "p_A": "无杆腔压力 [MPa]", "p_B": "有杆腔压力 [MPa]"},
        ),
        (
            "Zeit [s];Druck A [bar];Druck B [bar];Weg Ist [mm];Weg Soll [mm]",
            {"t": "Zeit [s]", "p_A": "Druck A [bar]", "p_B": "Druck B [bar]", "x": "Weg Ist [mm]"},
        ),
        (
            "t;Pressure A [bar];Pressure A filtered [bar];Pressure B [bar];Position setpoint [mm];u cmd [V]",
            {"t": "t", "p_A": "Pressure A [bar]", "p_B": "Pressure B [bar]", "u": "u cmd [V]"},
        ),
        (
            "t [s];Druck A [bar];Druck B [bar];Weg [mm];Öltemperatur [°C];Temperatur Tank [°C]",
            {
                "t": "t [s]",
                "p_A": "Druck A [bar]",
                "p_B": "Druck B [bar]",
                "x": "Weg [mm]",
                "T_oil": "Öltemperatur [°C]",
            },
        ),
        (
            "t;PT101 [bar];Druck A [bar];Druck B [bar];TT101 [°C]",
            {"t": "t", "p_A": "Druck A [bar]", "p_B": "Druck B [bar]", "T_oil": "TT101 [°C]"},
        ),
        (
            "t;Druck A [bar];Druck B [bar];Temp 1 [°C];oil temp [°C]",
            {"t": "t", "p_A": "Druck A [bar]", "p_B": "Druck B [bar]", "T_oil": "oil temp [°C]"},
        ),
        (
            "t;Druck A [bar];Druck B [bar];Temp 1 [°C];Temp 2 [°C];motor temperature [°C]",
            {"t": "t", "p_A": "Druck A [bar]", "p_B": "Druck B [bar]"},
        ),
        # a drive follows the speed that is set, but a measured speed is better
        (
            "t;PA_bar;PB_bar;n_cmd_rpm",
            {"t": "t", "p_A": "PA_bar[bar]", "p_B": "PB_bar[bar]", "omega": "n_cmd_rpm[rpm]"},
        ),
        (
            "t;PA_bar;PB_bar;n_cmd_rpm;n_act_rpm",
            {"t": "t", "p_A": "PA_bar[bar]", "p_B": "PB_bar[bar]", "omega": "n_act_rpm[rpm]"},
        ),
        ("t;PG_1;PG_2;PG_tank", {"p_A": "PG_1", "p_B": "PG_2", "t": "t"}),
        (
            "s;pump pressure 1 [psi];pump pressure 2 [psi];Pressure A (psi);Pressure B (psi)",
            {
                "p_1": "pump pressure 1 [psi]",
                "p_2": "pump pressure 2 [psi]",
                "p_A": "Pressure A (psi)",
                "p_B": "Pressure B (psi)",
            },
        ),
        (
            "t [s];p_A [bar];p_B [bar];Kolbenweg [mm];Stellsignal [V]",
            {"x": "Kolbenweg [mm]", "t": "t [s]", "u": "Stellsignal [V]"},
        ),
        (
            "Zeit [s];Kolbenseitendruck [bar];Stangenraumdruck [bar];Kolbenweg [mm];Pumpendrehzahl [1/min]",
            {
                "t": "Zeit [s]",
                "p_A": "Kolbenseitendruck [bar]",
                "p_B": "Stangenraumdruck [bar]",
                "x": "Kolbenweg [mm]",
                "omega": "Pumpendrehzahl [1/min][rpm]",
            },
        ),
        (
            "time_s;p_A_bar;p_B_bar;x_mm;p_pump_bar;p_tank_bar;spool_pct;flow_A_lpm",
            {
                "t": "time_s[s]",
                "p_A": "p_A_bar[bar]",
                "p_B": "p_B_bar[bar]",
                "x": "x_mm[mm]",
                "p_1": "p_pump_bar[bar]",
                "p_2": "p_tank_bar[bar]",
                "u": "spool_pct[pct]",
                "q_pump": "flow_A_lpm[lpm]",
            },
        ),
        (
            "Zeit [s];Druck A [bar];Druck B [bar];Joystick [%];Schieber [mm];Volumenstrom A [l/min]",
            {
                "t": "Zeit [s]",
                "p_A": "Druck A [bar]",
                "p_B": "Druck B [bar]",
                "u": "Joystick [%]",
                "q_pump": "Volumenstrom A [l/min]",
            },
        ),
        (
            "t [s];Pressure A [bar];Pressure B [bar];Valve command [mA];Spool [%];Flow [L/min];Pump speed [rpm];p_tank",
            {
                "t": "t [s]",
                "p_A": "Pressure A [bar]",
                "p_B": "Pressure B [bar]",
                "u": "Valve command [mA]",
                "omega": "Pump speed [rpm]",
            },
        ),
        (
            "GMT;Opening side pressure [barg];Spring side pressure [barg];Stem travel [mm]",
            {
                "t": "GMT",
                "p_A": "Opening side pressure [barg]",
                "p_B": "Spring side pressure [barg]",
                "x": "Stem travel [mm]",
            },
        ),
        (
            "stamp;Druck Schließseite [bar];Druck Öffnungsseite [bar]",
            {"t": "stamp", "p_A": "Druck Öffnungsseite [bar]", "p_B": "Druck Schließseite [bar]"},
        ),
        # neither an opening pressure, nor a side without the other; letters come first
        ("t [s];Opening pressure [bar];Closing pressure [bar]", {}),
        ("t [s];Opening side pressure [bar];Supply side pressure [bar]", {}),
        (
            "t [s];Spring side pressure A [bar];Opening side pressure B [bar]",
            {"t": "t [s]", "p_A": "Spring side pressure A [bar]", "p_B": "Opening side pressure B [bar]"},
        ),
    ],
)
def test_names_of_loggers(heads: str, expected: dict[str, str]) -> None:
    assert proposed_map([Label.parse(head) for head in heads.split(";")]) == expected


def test_what_two_columns_could_be_is_not_guessed() -> None:
    labels = [Label.parse(head) for head in ("t [s]", "Druck A vorn [bar]", "Druck A hinten [bar]", "Druck B [bar]")]
    assert "p_A" not in proposed_map(labels)


def test_the_error_prints_the_map_and_auto_takes_it(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("Zeit [s];Druck A [bar];PB_bar\n0;1;2\n0,002;2;3\n0,004;1;2\n")
    with refusal("p_A=Druck A [bar]", "p_B=PB_bar[", error=UnreadableFile):
        read(path)
    recording = read(path, map="auto")
    assert recording["p_B"].tolist() == [2e5, 3e5, 2e5]
    assert "column PB_bar read as p_B in bar" in recording.history
    with refusal("map", "'guess'"):
        read(path, map="guess")  # type: ignore[arg-type]


def test_errors_say_which_option_names_a_column(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("Recorder,A side pressure [bar],B side pressure [bar]\n0,1,2\n1,2,3\n3,1,2\n")
    with refusal("--map t=COLUMN", "p_A=A side pressure [bar]", error=UnreadableFile):
        read(path, map="auto")
    path.write_text("t [s],Left pressure [bar],Stroke [mm]\n" + "".join(f"{k},{k % 7},{k % 5}\n" for k in range(400)))
    assert "--map 'p_A=Left pressure [bar]'" in str(describe_missing_chambers(read(path, map="auto")))


@given(st.lists(st.text(max_size=100), max_size=8))
def test_any_names_give_a_map_of_these_columns(names: list[str]) -> None:
    labels = [Label.parse(name) for name in names]
    for column in proposed_map(labels).values():
        assert any(column.startswith(label.whole) for label in labels)


@pytest.mark.parametrize(
    ("heading", "parts"),
    [
        ("p_min", ("p_min", None)),  # a least pressure, not minutes
        ("p_d", ("p_d", None)),  # a demand, not days
        ("x_s", ("x_s", None)),
        ("time_min", ("time", "min")),
        ("time_d", ("time", "d")),
        ("p_bar", ("p", "bar")),
    ],
)
def test_an_ending_that_may_be_no_unit_is_one_behind_a_word_of_its_kind(heading, parts):
    assert split_unit(heading) == parts


@pytest.mark.parametrize(
    ("heading", "parts"),
    [
        ("Pump / side (bar)", ("Pump / side", "bar")),
        ("Pressure A / bar", ("Pressure A", "bar")),
        ("v / m/s", ("v", "m/s")),
        ("gain (m/(s V))", ("gain", "m/(s V)")),
        ("pressure (port A)", ("pressure", None)),
        ("Drehzahl_Pumpe_U/min", ("Drehzahl_Pumpe", "U/min")),
        ("Flow l/min", ("Flow", "l/min")),
        ("p_A/bar", ("p_A", "bar")),
    ],
)
def test_of_two_endings_the_known_unit_is_the_unit(heading, parts):
    label = Label.parse(heading)
    assert (label.name, label.unit) == parts


def test_the_oil_s_temperature_is_found_in_any_order_of_words_and_with_any_unit(tmp_path: Path) -> None:
    """Words, order, joints and units are drawn; without a unit the numbers are deg C, which the history says."""
    generator = np.random.default_rng(88)
    kelvin = {"degC": 273.15 + 40.0, "C": 273.15 + 40.0, "°C": 273.15 + 40.0, "degF": (40.0 + 459.67) / 1.8, "K": 40.0}
    oils, temperatures = (
        ("oil", "oel", "Öl", "ÖL", "Oil", "fluid", "huile", "Hydrauliköl"),
        ("T", "Temp", "temperature"),
    )
    for _ in range(60):
        words = [str(generator.choice(oils)), str(generator.choice(temperatures))]
        joint = str(generator.choice(["", "_", " ", ".", "-"]))
        name = joint.join(words[:: int(generator.choice([1, -1]))])
        unit = str(generator.choice(["", *kelvin]))
        heading = name if not unit else f"{name} [{unit}]" if generator.random() < 0.5 else f"{name}_{unit}"
        (tmp_path / "log.csv").write_text(f"t [s],Druck A [bar],Druck B [bar],{heading}\n0,3,4,40\n0.1,3,4,40\n")
        recording = read(tmp_path / "log.csv", map="auto")
        assert recording.channels.keys() == {"p_A", "p_B", "T_oil"}, heading
        assert recording["T_oil"][0] == pytest.approx(kelvin[unit or "degC"]), heading
        assert any("taken as °C" in line for line in recording.history) == (not unit)


@pytest.mark.parametrize(
    "heading",
    ["T", "T_mot [°C]", "Ambient temp_C", "oil level [%]", "oil pressure [bar]", "toilet", "tol_C", "T_water"],
)
def test_what_is_no_oil_temperature_is_none(heading: str) -> None:
    labels = [Label.parse(name) for name in ("Druck A [bar]", "Druck B [bar]", heading)]
    assert "T_oil" not in proposed_map(labels)
