"""Exports of data bases, controllers and instruments are read to the channels that they hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sealscope.recordings import read

from ..refusals import mentions
from ..representatives import SLOW, few
from .dialects import RATE, N, T, deviations
from .exports import EXPORTS, POSITION, RECORDS, A, twincat
from .refusals import count_calls, refused


@pytest.mark.parametrize("name", EXPORTS)
def test_exports_are_read_to_their_last_digit(name: str, tmp_path: Path) -> None:
    dialect = EXPORTS[name]
    recording = read(dialect.write(tmp_path), **dialect.options)
    assert recording.rate == pytest.approx(RATE, rel=1e-6)
    assert len(recording) == N
    assert recording.t - recording.t[0] == pytest.approx(T, abs=1e-6)
    for channel, off in deviations(recording).items():
        assert off <= 0.5 * dialect.digit + 1e-11, channel
        assert np.isfinite(recording[channel]).all()


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ('{"t": 0, "p_A": 1}\n{"t": 1, "p_A": }\n{"t": 2, "p_A": 3}\n',
         "JSON, whole, line 2"),
        ('{"t": 0, "p_A [Pa]": 1e999}\n', "sample, finite, p_A [Pa]"),
        ('{"t": 0, "p_A [Pa]": 1%s}\n' % ("0" * 400), "sample, finite, p_A [Pa]"),
        ('{"t": 0, "p_A [Pa]": 1%s}\n' % ("0" * 9000), "JSON, plain"),
        ('{"t": 0, "p": ' + "[" * 100_000, "JSON, plain"),
        ('[{"t": 0, "p_A": {"value": 1, "unit": "bar"}}, {"t": 1, "p_A": {"value": 1, "unit": "psi"}}]',
         "p_A, bar, psi, row 2"),
        ('{"t": 0}\n3\n', "JSON, '3', row 2"),
        ('[["t", "p_A"], [0, 1, 2]]', "2, 3, row 1"),
        ("[]", "samples, JSON"),
        ('{"a": {}}', "JSON, records, columns"),
        ('{"t": [0, 1], "p_A [Pa]": [1, 2, 3]}', "p_A [Pa], 2, 3"),
        ("\n".join(f'{{"n{k}": 1}}' for k in range(2000)), "records, 1024"),
        ("[" + "[]," * 20_000, "JSON, records, columns"),
        ('{"a": "' + "x" * 3_000_000, "JSON, whole, line 1"),
        ('{"a":[' + "{}," * 400_000 + "0]}", "JSON, records, columns"),
    ],
)  # fmt: skip
def test_json_that_is_no_log(content: str, names: str, tmp_path: Path) -> None:
    path = tmp_path / "log.json"
    path.write_text(content)
    assert mentions(refused(path), "FILE", *names.split(", "))


def test_what_has_brackets_and_is_no_json_is_a_text(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = "t [s],p_A [bar]\n" + "".join(f"{k / 500},3\n" for k in range(9))
    for above in (
        "[Header]\n",
        "[2024-05-31 12:00:00] started\n",
        '["rig 3"] and [bar]\n',
        "{rig 3}\n",
        "[1] remark\n",
    ):
        path.write_text(above + rows)
        assert read(path)["p_A"].tolist() == [3e5] * 9


def test_a_record_that_the_end_of_the_file_cuts_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    for whole in ("".join(json.dumps(row) + "\n" for row in RECORDS), json.dumps(RECORDS)):
        path.write_text(whole[:-9])
        recording = read(path)
        assert len(recording) == N - 1
        assert "the last value is cut short and left out, after 199 rows" in recording.history


def test_words_and_missing_values_among_the_numbers(tmp_path: Path) -> None:
    records = [dict(row) for row in RECORDS]
    del records[3]["p_A [bar]"]
    records[4]["p_A [bar]"] = None
    records[5]["p_A [bar]"] = "OVERLOAD"
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in records).replace(repr(A[6]), "NaN", 1))
    assert np.flatnonzero(np.isnan(read(path)["p_A"])).tolist() == [3, 4, 5, 6]


def test_whole_seconds_of_a_controller_s_log_are_shared_among_its_samples(tmp_path: Path) -> None:
    """A data log of the S7-1200: a record's number, date and time in two columns, and an end that says so."""
    begin = np.datetime64("2024-05-31T23:59:50")
    rows = []
    for k in range(400):
        day, clock = str(begin + np.timedelta64(k // 10, "s")).split("T")
        rows.append(f"{k + 1},{day[5:7]}/{day[8:]}/{day[:4]},{clock},{3 + k % 5}\n")
    (tmp_path / "log.csv").write_text("Record,Date,UTC Time,p_A [bar]\n" + "".join(rows) + "//END\n")
    recording = read(tmp_path / "log.csv")
    assert recording.rate == 10.0
    assert recording.t == pytest.approx(np.arange(400) / 10, abs=0.1)
    assert recording.provenance["start"].startswith("2024-05-31T23:59:50")


def saved(folder: Path, head: str, rows: list[str]) -> Path:
    (folder / "log.csv").write_text(
        f"{head},p_A [bar]\n" + "".join(f"{row},{3 + k % 5}\n" for k, row in enumerate(rows))
    )
    return folder / "log.csv"


def test_milliseconds_that_are_no_part_of_the_seconds_are_left_out(tmp_path: Path) -> None:
    """A count since the start stands beside stamps, too: it does not begin again with the next second."""
    for many in (50, 500):
        rows = [f"12:00:{1 + int(k / 50 + 0.5):02d},{20 * k}" for k in range(many)]
        recording = read(saved(tmp_path, "Time,ms", rows))
        assert "ms not used: not parts of the seconds in column Time" in recording.history
        assert np.all(np.diff(recording.t) < 1.5)
    assert recording.rate == pytest.approx(50.0, rel=0.02)
    within = [f"{k / 50:.2f},{(k * 7) % 90}" for k in range(100)]
    recording = read(saved(tmp_path, "t [s],ms", within))
    assert recording.t == pytest.approx(np.arange(100) / 50, abs=1e-9)
    assert "ms not used: not parts of the seconds in column t [s]" in recording.history


def test_hours_minutes_and_seconds_must_be_those_of_a_clock(tmp_path: Path) -> None:
    assert refused(saved(tmp_path, "h,m,s", [f"0,{k},0" for k in range(80)])) == (
        "a time must have whole hours below 24, and whole minutes and seconds below 60, "
        "got others in columns h, m, s (FILE)"
    )
    # the time since the start in three units: that in seconds is read, as without the others
    recording = read(saved(tmp_path, "hours,minutes,seconds", [f"{k / 1.8e6},{k / 3e4},{k / 500}" for k in range(80)]))
    assert recording.t == pytest.approx(np.arange(80) / 500, abs=1e-9)
    assert recording.rate == 500.0


def test_a_row_with_an_hour_and_no_date_has_no_time(tmp_path: Path) -> None:
    rows = [f"2024,5,31,12,0,{k}" for k in range(40)]
    rows[7] = ",,,12,0,7"
    recording = read(saved(tmp_path, "year,month,day,hour,minute,second", rows))
    assert np.flatnonzero(np.isnan(recording.t)).tolist() == [7]
    assert np.nanmin(recording.t) == 0.0 and np.nanmax(recording.t) == 39.0


def test_a_column_called_date_is_the_time_where_it_holds_times_of_the_day(tmp_path: Path) -> None:
    for cells in (["1", "2", "3"], ["2024-05-31", "2024-06-01", "2024-06-02"]):
        assert "got dates alone in column data (FILE)" in refused(saved(tmp_path, "data", cells))
    assert read(saved(tmp_path, "data", ["1", "2", "3"]), map={"t": "data[s]"}).rate == 1.0


def test_a_column_called_s_that_a_map_takes_is_no_part_of_the_time(tmp_path: Path) -> None:
    path = saved(tmp_path, "h,m,s", [f"1,2,{k}" for k in range(80)])
    recording = read(path, map={"x": "s[mm]"}, rate=500)
    assert recording["x"] == pytest.approx(np.arange(80) * 1e-3)
    assert "a recording must have a time column" in refused(path, map={"x": "s[mm]"})


def test_parts_of_the_time_in_other_tables(tmp_path: Path) -> None:
    import pandas as pd

    openpyxl = pytest.importorskip("openpyxl")
    moments = pd.date_range("2024-05-31 23:59:59.9", periods=N, freq="2ms")
    frame = pd.DataFrame({"Date": moments.floor("s"), "ms": moments.microsecond // 1000, "p_A [bar]": A})
    frame.to_parquet(tmp_path / "log.parquet")
    book = openpyxl.Workbook()
    book.active.append(["Date", "Time", "ms", "p_A [bar]"])
    for moment, value in zip(moments, A, strict=True):
        whole = moment.floor("s").to_pydatetime()
        book.active.append([whole.date(), whole.time(), moment.microsecond // 1000, value])
    book.save(tmp_path / "log.xlsx")
    for name in ("log.parquet", "log.xlsx"):
        recording = read(tmp_path / name)
        assert recording.t == pytest.approx(T, abs=1e-9)
        assert recording.provenance["start"].startswith("2024-05-31T23:59:59.9")


def test_a_slower_channel_of_a_twincat_export_is_interpolated(tmp_path: Path) -> None:
    recording = read(twincat(every=2)(tmp_path))
    known = T[-2] >= T
    assert recording["x"][known] == pytest.approx(1e-3 * np.interp(T, T[::2], POSITION[::2])[known], abs=1e-9)
    assert np.isnan(recording["x"][~known]).all()
    assert "x at 250 Hz: interpolated linearly to 500 Hz" in recording.history
    assert recording.provenance["start"].startswith("2022-05-02T13:56:24.376")


def test_channels_of_one_length_whose_clocks_differ_are_not_put_beside_each_other(tmp_path: Path) -> None:
    """Columns called t, the second half an interval late: the same rows are not the same moments."""
    rows = "".join(f"{k / 100:.4f},{k},{k / 100 + 0.005:.4f},{k}\n" for k in range(100))
    (tmp_path / "log.csv").write_text("t,p_A [bar],t,p_B [bar]\n" + rows)
    recording = read(tmp_path / "log.csv")
    assert recording["p_A"] == pytest.approx(1e5 * np.arange(100))
    assert recording["p_B"][1:] == pytest.approx(1e5 * (np.arange(1, 100) - 0.5))
    # a map that names the time takes the rows as they are
    assert read(tmp_path / "log.csv", map={"t": "#1[s]"})["p_B"] == pytest.approx(1e5 * np.arange(100))


@pytest.mark.parametrize("name", ["ms", "us", "ns"])
def test_a_column_called_ms_is_no_part_of_a_clock_of_the_file(name: str, tmp_path: Path) -> None:
    rows = "".join(f"{k / 100},{k},{k / 50},{20 * k % 1000}\n" for k in range(100))
    (tmp_path / "log.csv").write_text(f"t,p_A [bar],t,{name}\n" + rows)
    recording = read(tmp_path / "log.csv")
    assert recording.t == pytest.approx(np.arange(100) / 100)
    assert f"columns not used: {name}" in recording.history


@pytest.mark.parametrize("begin", [0.2, 0.7])  # midnight is at 0.5 s
@pytest.mark.parametrize(("clock", "order"), [("23:59:59.5", "name"), ("23:59:59.5", "time"), ("12:00:00", "reversed")])
def test_times_of_day_in_a_long_table_may_pass_midnight(begin: float, clock: str, order: str, tmp_path: Path) -> None:
    """A slower channel begins before or after midnight; the values are the true times."""
    rows = []
    for name, moments in (("p_A", np.arange(400) / 100), ("x", begin + np.arange(30) / 10)):
        stamps = np.datetime64(f"2024-05-31T{clock}", "ms") + np.round(1e3 * moments).astype("m8[ms]")
        rows += [(moment, f"{str(stamp)[11:]},{name},{moment!r}\n")
                 for stamp, moment in zip(stamps, moments.tolist(), strict=True)]  # fmt: skip
    lines = [line for _, line in (rows if order == "name" else sorted(rows, reverse=order == "reversed"))]
    (tmp_path / "log.csv").write_text("Time,Name,Value\n" + "".join(lines))
    recording = read(tmp_path / "log.csv", map={"p_A": "p_A[Pa]", "x": "x[m]"})
    known = np.isfinite(recording["x"])
    assert np.count_nonzero(known) >= 289  # times at its ends may be rounded
    assert recording["x"][known] == pytest.approx(recording["p_A"][known])
    assert recording.t == pytest.approx(np.arange(400) / 100)
    assert "start" not in recording.provenance


def test_what_a_long_table_says_of_its_samples(tmp_path: Path) -> None:
    rows = [
        f"p_A [bar];{k / 50:.2f};{k};{k != 3:d}\np_B [bar];{k / 50:.2f};{'text' if k == 7 else k};1" for k in range(200)
    ]
    (tmp_path / "log.csv").write_text("Name;Time [s];Value;Validity\n" + "\n".join(rows) + "\n$RT_OFF$;4.0;0;2\n")
    recording = read(tmp_path / "log.csv")
    assert np.flatnonzero(np.isnan(recording["p_A"])).tolist() == [3]
    assert np.flatnonzero(np.isnan(recording["p_B"])).tolist() == [7]
    assert "1 value that the file calls invalid read as missing" in recording.history
    assert "long table: 401 rows of 3 names" in recording.history
    assert "must be a column, got columns p_A [bar], p_B [bar], $RT_OFF$" in refused(
        tmp_path / "log.csv", map={"x": "Weg"}
    )


def test_a_table_with_a_column_of_names_is_read_as_it_was_where_a_map_names_its_columns(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("Name,Time [s],Value\n" + "".join(f"rig 3,{k / 50},{k}\n" for k in range(99)))
    assert read(tmp_path / "log.csv", map={"p_A": "Value[bar]"})["p_A"][7] == 7e5


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("Name,Time,Value\n" + "p_A,yesterday,1\n" * 3, "sample, 'yesterday'"),
        ("Name,Time,Value\n" + "".join(f"n{k},{k},1\n" for k in range(5000)), "long table, 4096"),
        ("Name,Time,Value\n" + "p_A [Pa],3,1\n" * 9, "time, increase"),
        ("Name,Time,Value\n" + "".join(f"p_A [Pa],{k / 50},word\np_B [Pa],{k / 50},1\n" for k in range(99)),
         "p_A [Pa], text"),
        ("t,p_A [Pa],t,p_B [Pa]\n" + "0,1,,2\n1,1,,2\n", "time, column t"),
        ("t,p_A [Pa],t,p_B [Pa]\n" + "0,1,0,2\n1,1,1,2\n2,1,1,3\n", "times, p_B"),
    ],
)  # fmt: skip
def test_long_tables_and_clocks_that_are_none(content: str, names: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(content)
    assert mentions(refused(tmp_path / "log.csv"), "FILE", *names.split(", "))


def with_cells(folder: Path, **cells: str) -> Path:
    """Write a log of cells with units, some of them others."""
    rows = [f"{k / 500:.3f} s;{cells.get(f'p{k}', f'{20 + k % 3},5 bar')};{k % 7} mm" for k in range(400)]
    (folder / "log.csv").write_text("t;p_A;x\n" + "\n".join(rows).replace(".", ","))
    return folder / "log.csv"


def test_a_unit_in_the_cells_is_the_same_in_the_whole_column(tmp_path: Path) -> None:
    for cell in ("300 psi", "200 kPa", "17"):
        assert refused(with_cells(tmp_path, p9=cell)) == (
            f"a cell must be in bar, like others in its column, got '{cell}' (line 11, column p_A, FILE)"
        )
    recording = read(with_cells(tmp_path, p9="OVERLOAD", p10="", p11="0", p12="-3 bar"))
    assert recording["p_A"][8:13] == pytest.approx([22.5e5, np.nan, np.nan, 0.0, -3e5], nan_ok=True)
    assert any("1 cell without a number read as missing, first 'OVERLOAD' (line 11" in h for h in recording.history)
    path = with_cells(tmp_path)
    path.write_text(path.read_text().replace("p_A", "p_A [psi]"))
    message = "a column must have one unit, got psi in its heading and bar in its cells (column p_A [psi], FILE)"
    assert refused(path) == message


def test_a_last_cell_that_is_cut_within_its_unit_is_missing(tmp_path: Path) -> None:
    path = with_cells(tmp_path)
    path.write_text(path.read_text()[:-1])
    recording = read(path)
    assert np.flatnonzero(np.isnan(recording["x"])).tolist() == [399]


def test_cells_that_only_look_like_quantities_are_left_alone(tmp_path: Path) -> None:
    """A column that nothing reads may hold what looks like units: stage 1a, 2 h, 5 V and 3 A."""
    rows = "".join(f"{k / 500},{3 + k % 5},{k}a,{k} {'VAh'[k % 3]}\n" for k in range(99))
    (tmp_path / "log.csv").write_text("t [s],p_A [bar],stage,remark\n" + rows)
    recording = read(tmp_path / "log.csv")
    assert recording["p_A"].tolist() == [(3 + k % 5) * 1e5 for k in range(99)]
    assert "columns not used: stage, remark" in recording.history


@pytest.mark.parametrize(
    "cell", few(["1" * 60 + " bar", "1 b r" * 12, "1 " + "q" * 16, "1,2" * 20, "-" * 70 + "1"], 2, SLOW)
)
def test_no_cell_keeps_the_search_for_units_busy(cell: str, tmp_path: Path) -> None:
    text = "t [s];p_A [Pa]\n" + f"{cell};{cell}\n" * 450
    (tmp_path / "log.csv").write_text(text)
    assert count_calls(lambda: refused(tmp_path / "log.csv")) < 1000 * len(text)


@pytest.mark.slow
def test_cells_of_many_unknown_units_do_not_keep_it_busy(tmp_path: Path) -> None:
    odd = ";".join(f"{k} q{chr(97 + k % 26)}{chr(97 + k // 26 % 26)}" for k in range(65, 1000))
    text = "t [s];p_A [Pa]\n" + f"{odd}\n" * 3
    (tmp_path / "log.csv").write_text(text)
    assert count_calls(lambda: refused(tmp_path / "log.csv")) < 1000 * len(text)
