"""Headings of PLCs, spreadsheets and measurement files: rows of names among others, merged cells, groups, units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.errors import UnreadableFile

from ..representatives import SLOW, few

N = 240
#: Channel -> name in German, unit, factor to SI, and number of digits.
CHANNELS = {
    "p_A": ("Druck A", "bar", 1e5, 3),
    "p_B": ("Druck B", "bar", 1e5, 3),
    "x": ("Weg", "mm", 1e-3, 2),
    "theta": ("Winkel", "rad", 1.0, 4),
    "u": ("Sollwert", "V", 1.0, 3),
}


def draw(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw samples in the units of `CHANNELS`, rounded as in a log."""
    t = np.arange(N) / 10.0
    return {
        name: np.round(
            30.0 + generator.uniform(1, 5) * np.sin(generator.uniform(1, 3) * t) + generator.normal(0, 0.1, N), digits
        )
        for name, (_, _, _, digits) in CHANNELS.items()
    }


def check(recording: ss.Recording, samples: dict[str, np.ndarray]) -> None:
    """Check all channels of a recording against the samples that were written."""
    assert set(recording.channels) == {*samples}
    for name, values in samples.items():
        assert recording[name] == pytest.approx(values * CHANNELS[name][2], rel=1e-12)
    assert recording.rate == pytest.approx(10.0)
    assert recording.t - recording.t[0] == pytest.approx(np.arange(N) / 10.0, abs=1e-6)


UNITS = ("({})", "[{}]", "(in {})", "[in {}]", "(Einheit: {})", "[unit={}]", "in {}", "/ {}", "(IN {})")


@pytest.mark.parametrize("form", UNITS)
def test_a_unit_may_follow_a_word(form: str, tmp_path: Path) -> None:
    generator = np.random.default_rng(UNITS.index(form))
    samples = draw(generator)
    heads = ["Zeit " + form.format("ms"), *(f"{name} {form.format(unit)}" for name, unit, _, _ in CHANNELS.values())]
    rows = [[str(100 * k), *(repr(float(samples[name][k])) for name in samples)] for k in range(N)]
    (tmp_path / "log.csv").write_text("\n".join(";".join(row) for row in [heads, *rows]) + "\n")
    check(ss.read(tmp_path / "log.csv", map="auto"), samples)


def test_inches_stay_inches(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t [s],x (in),p_A (in bar)\n0,1,2\n1,2,3\n2,3,2\n")
    recording = ss.read(tmp_path / "log.csv")
    assert recording["x"].tolist() == pytest.approx([0.0254, 0.0508, 0.0762])
    assert recording["p_A"].tolist() == pytest.approx([2e5, 3e5, 2e5])


def plc_rows(generator: np.random.Generator) -> dict[str, list[str]]:
    """Draw the heading rows of a PLC, each without its first two cells."""
    n, registers = len(CHANNELS), int(generator.integers(100, 900))
    symbols = generator.random() < 0.5
    return {
        "numbers": [str(k + 1) for k in range(n)],
        "names": [name if symbols else text for name, (text, *_) in CHANNELS.items()],
        "comments": ["COM1"] * n,
        "registers": [f"DT{registers + 2 * k}" for k in range(n)],
        "modes": ["INST"] * n,
        "types": list(generator.choice(["REAL", "FLT", "DINT"], n)),
        "formats": [str(generator.choice(["%8.3f", "0.000"]))] * n,
        "empty": [""] * n,
        "units": [unit for _, unit, _, _ in CHANNELS.values()],
    }


@pytest.mark.parametrize("seed", few(range(12), 4, SLOW))
def test_names_and_units_are_found_among_the_rows_of_a_plc(seed: int, tmp_path: Path) -> None:
    """Some rows lack, and those between names and units are in any order."""
    generator = np.random.default_rng(seed)
    samples, rows = draw(generator), plc_rows(generator)
    between = [
        name for name in ("comments", "registers", "modes", "types", "formats", "empty") if generator.random() < 0.7
    ]
    order = [*(["numbers"] if generator.random() < 0.7 else []), "names", *generator.permutation(between), "units"]
    if "types" in between and generator.random() < 0.3:  # types below the units
        order = [*(name for name in order if name != "types"), "types"]
    first = ["Date", "Time"]
    lines = [",".join([*(first if k == 0 else ["", ""]), *rows[name]]) for k, name in enumerate(order)]
    stamps = [(np.datetime64("2026-03-01T10:00:00", "ms") + np.timedelta64(100 * k, "ms")).item() for k in range(N)]
    lines += [
        f"{stamp:%Y/%m/%d,%H:%M:%S}.{stamp.microsecond // 100_000},"
        + ",".join(repr(float(samples[name][k])) for name in samples)
        for k, stamp in enumerate(stamps)
    ]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    check(ss.read(tmp_path / "log.csv", map="auto"), samples)


TIMES = {
    "ts_ms": 1e3, "ts_us": 1e6, "timestamp_ns": 1e9, "ts_s": 1.0, "time_s": 1.0, "epoch": 1.0, "epoch_ms": 1e3,
    "Zeit_ms": 1e3, "timestampMs": 1e3, "unix_ms": 1e3, "TS [ms]": 1e3, "millis": 1e3, "utc_us": 1e6,
}  # fmt: skip


@pytest.mark.parametrize("heading", TIMES)
def test_epochs_are_times_in_the_unit_of_their_names(heading: str, tmp_path: Path) -> None:
    samples = draw(np.random.default_rng(3))
    ticks = [round((1790838800 + k / 10) * TIMES[heading], 1) for k in range(N)]
    cells = [f"{tick:.0f}" if TIMES[heading] > 1.0 else f"{tick:.1f}" for tick in ticks]
    rows = [f"{cells[k]}," + ",".join(repr(float(samples[name][k])) for name in samples) for k in range(N)]
    heads = ",".join([heading, *(f"{name}_{unit}" for name, (_, unit, _, _) in CHANNELS.items())])
    (tmp_path / "log.csv").write_text("\n".join([heads, *rows]) + "\n")
    recording = ss.read(tmp_path / "log.csv", map="auto")
    check(recording, samples)
    assert recording.provenance["start_epoch_s"] == pytest.approx(1790838800.0)


def write_sheet(path: Path, rows: list[list[object]], merged: list[str]) -> Path:
    openpyxl = pytest.importorskip("openpyxl")
    workbook = openpyxl.Workbook()
    for row in rows:
        workbook.active.append(row)
    for cells in merged:
        workbook.active.merge_cells(cells)
    workbook.save(path)
    return path


@pytest.mark.parametrize("n_cylinders", [1, 2])
def test_merged_headings_are_part_of_the_names(n_cylinders: int, tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    samples = draw(np.random.default_rng(n_cylinders))
    top, names, units = [None], ["Zeit"], ["s"]
    merged = []
    for number in range(1, n_cylinders + 1):
        merged.append(f"{'BE'[number - 1]}1:{'DG'[number - 1]}1")
        top += [f"Zylinder {number}", None, None]
        names, units = [*names, "Druck A", "Druck B", "Weg"], [*units, "bar", "bar", "mm"]
    top, names, units = [*top, "Antrieb", None], [*names, "Winkel", "Sollwert"], [*units, "rad", "V"]
    merged.append("EF"[0] + "1:F1" if n_cylinders == 1 else "H1:I1")
    columns = ["p_A", "p_B", "x"] * n_cylinders + ["theta", "u"]
    rows = [[k / 10, *(float(samples[name][k]) for name in columns)] for k in range(N)]
    path = write_sheet(tmp_path / "log.xlsx", [top, names, units, *rows], merged)
    chosen = {"p_A": "Zylinder 1 Druck A", "p_B": "Zylinder 1 Druck B", "x": "Zylinder 1 Weg"}
    check(ss.read(path, map={**chosen, "*": "auto"}), samples)


@pytest.mark.parametrize("seed", few(range(4), 1, SLOW))
def test_numbers_with_a_comma_as_text_are_numbers(seed: int, tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    generator = np.random.default_rng(seed)
    samples = draw(generator)
    texts = {name for name in samples if generator.random() < 0.6} | {"theta"}
    rows = [
        [
            k / 10,
            *(
                f"{samples[name][k]:.{CHANNELS[name][3]}f}".replace(".", ",")
                if name in texts
                else float(samples[name][k])
                for name in samples
            ),
        ]
        for k in range(N)
    ]
    heads = ["Zeit [s]", *(f"{name} [{unit}]" for name, (_, unit, _, _) in CHANNELS.items())]
    check(ss.read(write_sheet(tmp_path / "log.xlsx", [heads, *rows], [])), samples)


def test_a_comma_that_may_be_of_thousands_is_no_number(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine")
    rows = [[k / 10, f"{1 + k % 7},{100 + k}"] for k in range(100)]
    path = write_sheet(tmp_path / "log.xlsx", [["t [s]", "p_A [Pa]"], *rows], [])
    with pytest.raises(UnreadableFile, match="1,100"):
        ss.read(path)


def test_groups_of_a_measurement_file_are_called_by_their_names(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    samples, t = draw(np.random.default_rng(8)), np.arange(N) / 10.0
    with asammdf.MDF(version="4.10") as file:
        for number in (1, 2):
            signals = [
                asammdf.Signal(samples[name] + number - 1, t, name=name, unit=CHANNELS[name][1]) for name in samples
            ]
            file.append(signals, acq_name=f"Cylinder{number}", comment="device", common_timebase=True)
        file.save(tmp_path / "log.mf4")
    recording = ss.read(tmp_path / "log.mf4")
    check(recording, samples)
    assert any("Cylinder1" in line and "Cylinder2" in line for line in recording.history)
    other = ss.read(tmp_path / "log.mf4", map={name: f"Cylinder2/{name}" for name in samples})
    check(other, {name: values + 1 for name, values in samples.items()})


LONG = ("time,channel,value", "ts_ms,signal,value", "timestamp;tag;wert", "Zeit,Kanal,Messwert", "time,variable,value")


@pytest.mark.parametrize("heading", LONG)
@pytest.mark.parametrize("order", ["rows", "channels"])
def test_long_tables_are_pivoted(heading: str, order: str, tmp_path: Path) -> None:
    samples = draw(np.random.default_rng(LONG.index(heading)))
    mark = ";" if ";" in heading else ","
    cells = [str(1790838800000 + 100 * k) if heading.startswith("ts_ms") else f"{k / 10:.1f}" for k in range(N)]
    rows = [
        (k, place, f"{cells[k]}{mark}{name} [{CHANNELS[name][1]}]{mark}{float(samples[name][k])!r}")
        for k in range(N)
        for place, name in enumerate(samples)
    ]
    rows = sorted(rows, key=lambda row: (row[1], row[0])) if order == "channels" else rows
    (tmp_path / "log.csv").write_text("\n".join([heading, *(row[2] for row in rows)]) + "\n")
    check(ss.read(tmp_path / "log.csv", map="auto"), samples)


def test_a_long_table_of_a_logger_that_restarted_is_refused(tmp_path: Path) -> None:
    samples = draw(np.random.default_rng(2))
    rows = [
        f"{(k if k < 150 else k - 150) / 10},{name} [{CHANNELS[name][1]}],{float(samples[name][k])!r}"
        for k in (*range(150), *range(170, N))
        for name in samples
    ]
    (tmp_path / "log.csv").write_text("\n".join(["time,channel,value", *rows]) + "\n")
    with pytest.raises(UnreadableFile, match="step back"):
        ss.read(tmp_path / "log.csv", map="auto")


@pytest.mark.parametrize("start", ["2026-06-01T10:00:00", "01.06.2026 10:00", "17.5", "2026/06/01"])
def test_a_value_in_the_preamble_is_no_group_of_columns(start, tmp_path):
    """A date was put before the names of all columns: its T was taken for a temperature."""
    path = tmp_path / "log.csv"
    rows = "\n".join(f"{k / 10:.1f};{200 - k / 1e4:.4f};{96 + k % 7:.1f}" for k in range(400))
    path.write_text(f"Start;{start}\nZeit [s];Weg [mm];Druck Kolbenseite [bar]\n{rows}\n", encoding="utf-8")
    recording = ss.read(path, map="auto")
    assert {"x", "p_A"} <= set(recording.channels)
    assert not any(start in str(note) for note in recording.history)
