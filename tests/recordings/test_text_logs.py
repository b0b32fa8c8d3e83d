"""Logs of other people's loggers: delimiters, decimals, headers, units, encodings, time columns, maps."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from sealscope.errors import UnreadableFile
from sealscope.recordings import COUNTS, inspect, read, split_map_option
from sealscope.recordings.formats.headings.preamble import parse_remarks
from sealscope.recordings.header import oil_temperature

from ..refusals import refusal

T = [0.0, 0.002, 0.004, 0.006]
P = [2.5, 2.25, -2.125, 2e-3]
BAR = np.array(P) * 1e5


def saved(folder: Path, text: str | bytes, name: str = "log.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


def body(delimiter: str, decimal: str = ".", newline: str = "\n") -> str:
    rows = [f"{t:.3f}{delimiter}{p!r}" for t, p in zip(T, P, strict=True)]
    return newline.join(rows).replace(".", decimal) + newline


LAYOUTS = {
    "blanks, decimal comma": "t[s] p_A[bar]\n" + body("  ", ","),
    "bar": "t [s]|p_A [bar]\n" + body("|"),
    "comma and blank": "t [s], p_A [bar]\n" + body(", "),
    "units over a stroke": "Zeit / s;p_A / bar\n" + body(";", ","),
    "units row in brackets": "Time\tp_A\n[s]\t[bar]\n" + body("\t"),
    "other case": "Time [s],P_a [BAR]\n" + body(","),
    "quoted": '"t [s]","p_A [bar]"\n' + "".join(f'"{t}","{p!r}"\n' for t, p in zip(T, P, strict=True)),
    "no last line end": ("t [s],p_A [bar]\n" + body(",")).rstrip(),
    "comments": "# made by a logger, on Monday\n% rig 3\n\nt [s],p_A [bar]\n" + body(","),
    "comment within": "t [s],p_A [bar]\n" + body(",").replace("\n", "\n# pause\n", 1),
    "blank lines within": "t [s],p_A [bar]\n" + body(",").replace("\n", "\n\n", 2),
    "preamble, units row": "DAQ export\nDate;2024-05-31\n\nTime;p_A;note\ns;bar;\n"
    + body(";", ",").replace("\n", ";\n"),
    "time without unit": "time,p_A [bar]\n" + body(","),
    "text beside": "who,t [s],p_A [bar],remark\n" + "".join(f"N,{t},{p!r},a b\n" for t, p in zip(T, P, strict=True)),
    "rows end in a separator": "t [s],p_A [bar]\n" + body(",").replace("\n", ",\n"),
    "columns left out of the rows": "t [s],p_A [bar],Comment,Event\n" + body(","),
    "empty columns at the end": "t [s],p_A [bar],,\n" + body(",").replace("\n", ",,\n"),
    "padded numbers": "t [s],p_A [bar]\n" + "".join(f"  {t} ,  {p!r} \n" for t, p in zip(T, P, strict=True)),
    "Fortran exponents": "t [s],p_A [bar]\n"
    + "".join(f"{t},{p!r}D+00\n" for t, p in zip(T[:3], P, strict=False))
    + "0.006,2D-3\n",
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts(tmp_path: Path, name: str) -> None:
    recording = read(saved(tmp_path, LAYOUTS[name]))
    assert np.allclose(recording.t, T, rtol=1e-15)
    assert recording["p_A"] == pytest.approx(BAR, rel=1e-14)
    assert recording.units["p_A"] == "Pa"
    assert recording.rate == 500.0
    assert recording.provenance["file"] == "log.csv"


def test_other_channels_and_units(tmp_path: Path) -> None:
    text = "t [s],x [mm],omega [rpm],q_leak [L/min],u [mV],theta [deg]\n0,1,60,6,2000,180\n0.1,2,120,12,4000,360\n"
    recording = read(saved(tmp_path, text))
    assert recording["x"] == pytest.approx([1e-3, 2e-3])
    assert recording["omega"] == pytest.approx([2 * np.pi, 4 * np.pi])
    assert recording["q_leak"] == pytest.approx([1e-4, 2e-4])
    assert recording["u"] == pytest.approx([2, 4])
    assert recording["theta"] == pytest.approx([np.pi, 2 * np.pi])
    assert recording.rate == 10.0


def test_map_and_rate(tmp_path: Path) -> None:
    path = saved(tmp_path, "Time\tPG_1\tPG_2\tname\n1\t10\t20\ta\n2\t11\t21\tb\n3\t12\t22\t\n", "log.txt")
    recording = read(path, map={"p_A": "PG_1", "p_B": "PG_2[psi]"}, rate=1000)
    assert np.array_equal(recording["p_A"], [10, 11, 12])
    assert recording.units["p_A"] == COUNTS
    assert recording["p_B"] == pytest.approx(np.array([20, 21, 22]) * 6894.757293168361, rel=1e-15)
    assert np.array_equal(recording.t, [0, 0.001, 0.002])
    assert any("Time not used: the rate was given as 1000 Hz" in line for line in recording.history)
    assert any("raw counts" in line for line in recording.history)
    with refusal("rows 1, 2", error=UnreadableFile):
        read(path, map={"p_A": "PG_1"})


def test_mapped_column_comes_before_the_namesake(tmp_path: Path) -> None:
    path = saved(tmp_path, "t [s],p_A [bar],true p_A [bar]\n0,1,5\n1,2,6\n")
    assert read(path, map={"p_A": "true p_A"})["p_A"] == pytest.approx([5e5, 6e5])


def test_epoch_and_stamps(tmp_path: Path) -> None:
    lines = [1717151400.000 + 0.5 * i for i in range(4)]
    for factor, name in ((1, "time"), (1, "time [s]"), (1000, "time"), (1000, "time [ms]")):
        text = f"{name},p_A [bar]\n" + "".join(f"{factor * s:.3f},1\n" for s in lines)
        recording = read(saved(tmp_path, text))
        assert recording.t == pytest.approx([0, 0.5, 1, 1.5], abs=1e-6)
        assert recording.rate == 2.0
        assert recording.provenance["start_epoch_s"] == pytest.approx(lines[0])


@pytest.mark.parametrize(
    "form",
    [
        "2024-05-31T12:00:0{}.{}00",
        "2024-05-31 12:00:0{}.{}",
        "2024-05-31 12:00:0{},{}00",
        "31.05.2024 12:00:0{}.{}",
        "2024-05-31T12:00:0{}.{}Z",
        "12:00:0{}.{}",
    ],
)
def test_stamps(tmp_path: Path, form: str) -> None:
    text = "Timestamp;p_A [bar]\n" + "".join(form.format(i // 2, 5 * (i % 2)) + ";1\n" for i in range(6))
    recording = read(saved(tmp_path, text))
    assert recording.t == pytest.approx(np.arange(6) / 2, abs=1e-12)
    assert recording.rate == 2.0
    if ":0" in form and "2024" in form:
        assert recording.provenance["start"].startswith("2024-05-31T12:00:00")


def test_missing_cells_become_nan(tmp_path: Path) -> None:
    text = "t [s],p_A [bar],p_B [bar]\n0,1,1\n1,,NaN\n2,-,n/a\n3,4,4\n"
    recording = read(saved(tmp_path, text))
    assert np.array_equal(recording["p_A"], [1e5, np.nan, np.nan, 4e5], equal_nan=True)
    assert np.array_equal(recording["p_B"], [1e5, np.nan, np.nan, 4e5], equal_nan=True)


def test_a_cut_last_line_is_missing(tmp_path: Path) -> None:
    recording = read(saved(tmp_path, "t [s],p_A [bar],p_B [bar]\n0,1,1\n1,2,2\n2,3,3\n3,4"))
    assert np.array_equal(recording["p_A"], [1e5, 2e5, 3e5, np.nan], equal_nan=True)


@pytest.mark.parametrize("end", ["\n", "\r"])
@pytest.mark.parametrize(("last", "value"), [("3,4", np.nan), ("3,4\r# the e", 4e5)])
def test_only_the_line_that_the_end_of_the_file_cuts_may_be_incomplete(
    tmp_path: Path, end: str, last: str, value: float
) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(f"t [s],p_A [bar],row\n0,1,1\n1,2,2\n2,3,3\n{last}".replace("\n", end).encode())
    assert np.array_equal(read(path)["p_A"], [1e5, 2e5, 3e5, value], equal_nan=True)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    delimiter=st.sampled_from([",", ";", "\t", "  ", "|"]),
    comma=st.booleans(),
    values=st.lists(st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3), min_size=2, max_size=30),
    units_row=st.booleans(),
    preamble=st.lists(st.sampled_from(["Rig", "Operator: N. N.", "Rate = 500 Hz", "# remark"]), max_size=3),
)
@example("  ", False, [[0.0] * 3] * 2, False, ["Rig", "Rate = 500 Hz", "Rate = 500 Hz"])
def test_any_layout_gives_the_same_numbers(
    tmp_path: Path, delimiter: str, comma: bool, values: list[list[float]], units_row: bool, preamble: list[str]
) -> None:
    comma = comma and delimiter != ","
    units_row = units_row and delimiter != "  "
    if units_row:
        head = [delimiter.join(["t", "p_A", "p_B"]), delimiter.join(["s", "Pa", "Pa"])]
    else:
        head = [delimiter.join(["t [s]", "p_A [Pa]", "p_B [Pa]"])]
    rows = [delimiter.join(map(repr, [float(i), *row[1:]])) for i, row in enumerate(values)]
    if comma:
        rows = [row.replace(".", ",") for row in rows]
    recording = read(saved(tmp_path, "\n".join([*preamble, *head, *rows]) + "\n"))
    assert np.array_equal(recording["p_A"], [row[1] for row in values])
    assert np.array_equal(recording["p_B"], [row[2] for row in values])


@pytest.mark.parametrize("stamp_digits", [3, 4, 6])
@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0, 1000.0, 1024.0, 4096.0])
def test_rate_from_rounded_stamps(tmp_path: Path, rate: float, stamp_digits: int) -> None:
    if rate > 1000 and stamp_digits == 3:
        pytest.skip("stamps coarser than the step tell the rate only on average")
    rows = "".join(f"{i / rate:.{stamp_digits}f},{i}\n" for i in range(2500))
    assert read(saved(tmp_path, "t [s],x [m]\n" + rows)).rate == rate


def test_split_map_option() -> None:
    assert split_map_option("p_A=PG_1") == ("p_A", "PG_1")
    assert split_map_option(" p_A = Druck A [bar] ") == ("p_A", "Druck A [bar]")
    for wrong in ("p_A", "=PG_1", "p_A="):
        with refusal("CHANNEL=COLUMN", wrong):
            split_map_option(wrong)
    with refusal("pA", "p_A"):
        split_map_option("pA=PG_1")


@pytest.mark.parametrize(
    ("stamps", "start"),
    [
        (("5/31/2024 11:59:59.999 PM", "6/1/2024 12:00:00.001 AM"), "2024-05-31T23:59:59.999"),
        (("5/31/2024 12:00:00.000 pm", "5/31/2024 12:00:00.002 pm"), "2024-05-31T12:00:00"),
        (("5/31/2024 1:30:00.000 p.m.", "5/31/2024 1:30:00.002 p.m."), "2024-05-31T13:30:00"),
        (("5/31/2024 12:30:00.000 A.M.", "5/31/2024 12:30:00.002 A.M."), "2024-05-31T00:30:00"),
        (("05-12-2024 23:59:59.999", "05-13-2024 00:00:00.001"), "2024-05-12T23:59:59.999"),
        (("12-05-2024 23:59:59.999", "13-05-2024 00:00:00.001"), "2024-05-12T23:59:59.999"),
        (("05-12-2024 08:00:00.000", "05-12-2024 08:00:00.002"), "2024-12-05T08:00:00"),
        (("05/12/2024 08:00:00.000", "05/12/2024 08:00:00.002"), "2024-05-12T08:00:00"),
        (("31/05/2024 08:00:00.000", "31/05/2024 08:00:00.002"), "2024-05-31T08:00:00"),
        (("2024/05/31 08:00:00.000", "2024/05/31 08:00:00.002"), "2024-05-31T08:00:00"),
    ],
)
def test_dates_of_either_order(tmp_path: Path, stamps: tuple[str, str], start: str) -> None:
    text = "timestamp,p_A [bar]\n" + "".join(f"{stamp},{3 + i}\n" for i, stamp in enumerate(stamps))
    recording = read(saved(tmp_path, text))
    assert recording.t == pytest.approx([0, 0.002], abs=1e-12)
    assert recording.provenance["start"] == start
    told = any("none has a number over 12" in line for line in recording.history)
    assert told == (start in ("2024-12-05T08:00:00", "2024-05-12T08:00:00"))


@pytest.mark.parametrize(("form", "step"), [("%M:%S.0", 1), ("%H:%M:%S", 30)])
def test_a_clock_without_a_date_goes_on_however_often_it_begins_again(form: str, step: int, tmp_path: Path) -> None:
    seconds = 3000 + step * np.arange(3 * 3600 if step == 1 else 9000)
    rows = "".join(f"{time.strftime(form, time.gmtime(second))};1\n" for second in seconds.tolist())
    recording = read(saved(tmp_path, "Time;p_A [bar]\n" + rows))
    assert np.array_equal(recording.t, seconds - 3000.0)


@pytest.mark.parametrize(("rate", "step"), [(500.0, 1.0), (333.25, 1.0), (100.0, 0.05)])
def test_stamps_that_samples_share(tmp_path: Path, rate: float, step: float) -> None:
    n = 4000
    t = 0.3 + np.arange(n) / rate
    coarse = np.floor(t / step + 1e-9) * step
    rows = "".join(f"{time:.2f},{i % 7}\n" for i, time in enumerate(coarse))
    recording = read(saved(tmp_path, "t [s],p_A [bar]\n" + rows))
    assert recording.rate == pytest.approx(rate, rel=1e-3)
    assert recording.t == pytest.approx(t, abs=2.0 / rate + 5e-4 * t[-1])
    assert any(f"in steps of {step:g} s" in line for line in recording.history)


def test_a_clock_that_stands_still_is_no_coarse_clock(tmp_path: Path) -> None:
    t = np.concatenate((np.arange(100) / 500, np.full(300, 0.2), 0.2 + np.arange(1, 100) / 500))
    rows = "".join(f"{time:.3f},{i % 7}\n" for i, time in enumerate(t))
    recording = read(saved(tmp_path, "t [s],p_A [bar]\n" + rows))
    assert any(finding.code == "duplicated_time" for finding in inspect(recording))


def test_a_few_words_among_many_numbers_are_missing_samples(tmp_path: Path) -> None:
    rows = [f"{i / 500:.3f},{3 + i % 5}" for i in range(1000)]
    rows[500] = "1.000,OVERLOAD"
    rows[600] = "1.200,#VALUE!"
    recording = read(saved(tmp_path, "t [s],p_A [bar]\n" + "\n".join(rows) + "\n"))
    assert np.flatnonzero(np.isnan(recording["p_A"])).tolist() == [500, 600]
    assert any("2 cells without a number read as missing, first 'OVERLOAD' (line 502" in h for h in recording.history)
    rows[700:720] = [f"{i / 500:.3f},OVERLOAD" for i in range(700, 720)]
    with refusal("'OVERLOAD'", "line 502", error=UnreadableFile):
        read(saved(tmp_path, "t [s],p_A [bar]\n" + "\n".join(rows) + "\n"))


def test_columns_by_number(tmp_path: Path) -> None:
    path = saved(tmp_path, "t [s],P [bar],P [bar]\n0,1,2\n1,2,3\n2,1,3\n")
    recording = read(path, map={"p_A": "#2", "p_B": "#3"})
    assert recording["p_B"].tolist() == [2e5, 3e5, 3e5]
    with refusal("#4", "p_A", error=UnreadableFile):
        read(path, map={"p_A": "#4"})


def test_what_stands_above_the_header_is_kept(tmp_path: Path) -> None:
    text = "Test bench 4\nOperator: N. N.\nOil temperature = 41 degC\nMachine;EHA 7;;\n# Remark: seal new\n"
    recording = read(saved(tmp_path, text + "t [s];p_A [bar]\n" + body(";")))
    assert recording.provenance["about"] == {
        "Operator": "N. N.",
        "Oil temperature": "41 degC",
        "Machine": "EHA 7",
        "Remark": "seal new",
    }
    assert "1 line before the header not used" in recording.history


@pytest.mark.parametrize(
    ("remarks", "expected"),
    [
        ("Ambient temperature: 21 degC\nOil temperature: 45 degC\n", 45.0),
        ("Temperature: 21 degC\nHydraulic fluid temp.: 45 degC\n", 45.0),
        ("Temp_degF: 104\n", 40.0),
        ("Ambient temperature: 21 degC\n", None),
        ("Template: 300 K\n", None),
        ("Boiler: 80 °C\n", None),
        ("12: 20 C\n", None),
        ("Oil temperature: 480 K\n", None),
    ],
)
def test_the_oil_s_temperature_is_taken_from_no_other_remark(
    tmp_path: Path, remarks: str, expected: float | None
) -> None:
    recording = read(saved(tmp_path, remarks + "t [s];p_A [bar]\n" + body(";")))
    assert recording.remarks
    assert oil_temperature(recording) == (None if expected is None else pytest.approx(expected))


@settings(max_examples=30)
@given(st.lists(st.text(max_size=600), max_size=60), st.sampled_from([",", ";", "\t", " ", "|"]))
def test_any_lines_above_the_header_give_short_printable_entries(lines: list[str], delimiter: str) -> None:
    about = parse_remarks(lines, delimiter)
    assert len(about) <= 40
    for name, value in about.items():
        assert 0 < len(name) <= 60 and 0 < len(value) <= 200
        assert (name + value).isprintable()


@pytest.mark.parametrize("change", ["plain", "decimal comma", "windows", "words", "missing", "comment", "cut", "wide"])
def test_blocks_of_plain_numbers_are_read_as_other_blocks_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    """Bit for bit, whatever stands in some of the blocks."""
    pytest.importorskip("pyarrow")
    random = np.random.default_rng(3)
    rows = [f"{i / 500};{value!r};{i}" for i, value in enumerate((1e4 * random.standard_normal(4000)).tolist())]
    if change in ("words", "missing", "comment", "wide"):
        rows[2500] = {"words": "5.0;OVERLOAD;1", "missing": "5.0;;1", "comment": "# pause"}.get(
            change, rows[2500] + ";"
        )
    content = "t [s];p_A [Pa];row\n" + "\n".join(rows) + ("" if change == "cut" else "\n")
    content = {"decimal comma": content.replace(".", ","), "windows": content.replace("\n", "\r\n")}.get(
        change, content
    )
    path = saved(tmp_path, content[:-6] if change == "cut" else content)
    monkeypatch.setattr("sealscope.recordings.formats.text._CHUNK", 16 * 1024)
    recordings = []
    for large in (0, 2**40):
        monkeypatch.setattr("sealscope.recordings.formats.text._MIN_ARROW_SIZE", large)
        recordings.append(read(path))
    fast, slow = recordings
    assert np.array_equal(fast.t, slow.t)
    assert np.array_equal(fast["p_A"], slow["p_A"], equal_nan=True)
    assert (fast.history, fast.rate) == (slow.history, slow.rate)
