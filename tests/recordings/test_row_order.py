"""Clocks that wrap, are set or begin anew: the rows are read in the order of time, and a finding says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.recordings import Recording, inspect
from sealscope.recordings.corrections.samples import correct_samples
from sealscope.recordings.formats.times.row_order import order_rows

from ..representatives import SLOW, few

RATE = 50.0
#: Rows of the log, which lasts two minutes.
N = 6000


@cache
def machine() -> Recording:
    """Simulate a machine that begins to leak after a minute, recorded at 50 Hz."""
    whole = ss.simulate(command="5 sin(2t)", duration="2 min", seed=7, leak="0.02 L/min from 60 s")
    channels = {name: whole[name][::10][:N] for name in ("p_A", "p_B", "x", "theta", "u")}
    return Recording(np.arange(N) / RATE, channels, {name: whole.units[name] for name in channels}, RATE)


def stamp(seconds: np.ndarray, form: str, start: str = "1970-01-01") -> list[str]:
    """Format times [s] after a moment, to a hundredth of a second, without AM and PM for the hours of `%I`."""
    stamps = np.datetime64(start, "us") + np.round(seconds * 1e6).astype("timedelta64[us]")
    return [moment.strftime(form)[:-4] for moment in stamps.tolist()]


def count(seconds: np.ndarray, begin: float, tick: float, bits: int, signed: bool = False) -> list[str]:
    """Count ticks [s] from `begin` on, in so many bits."""
    ticks = np.round((seconds + begin) / tick).astype(np.int64) % 2**bits
    return [str(value) for value in (np.where(ticks >= 2 ** (bits - 1), ticks - 2**bits, ticks) if signed else ticks)]


@dataclass(frozen=True)
class Clock:
    """A time column: its heading, its cells for the true times, and the code of the finding on it."""

    heading: str
    cells: Callable[[np.ndarray, float], list[str]]  # (true times, seconds from the first row to the wrap)
    code: str = "clock_wrapped"


def counter(heading: str, tick: float, bits: int, signed: bool = False) -> Clock:
    """Make a counter that wraps a number of seconds after the first row."""
    size = 2.0 ** (bits - signed) * tick
    return Clock(heading, lambda t, wrap: count(t, size - wrap, tick, bits, signed))


def clock(form: str, end: str, code: str = "clock_wrapped") -> Clock:
    """Make a clock that shows the moment `end` a number of seconds after the first row."""
    return Clock("Time", lambda t, wrap: stamp(t - wrap, form, end), code)


CLOCKS = {
    "12 hours, 1 o'clock": clock("%I:%M:%S.%f", "1970-01-01T13:00:00"),
    "32 bits of us": counter("t [us]", 1e-6, 32),
    "16 bits of ms": counter("t [ms]", 1e-3, 16),
    "24 hours": clock("%H:%M:%S.%f", "1970-01-02"),
    "12 hours, noon": clock("%I:%M:%S.%f", "1970-01-01T12:00:00", ""),
    "12 hours with dates, 1 o'clock": clock("%Y-%m-%d %I:%M:%S.%f", "2024-05-31T13:00:00"),
    "12 hours with dates, midnight": clock("%Y-%m-%d %I:%M:%S.%f", "2024-06-01T00:00:00"),
    "minutes and seconds": clock("%M:%S.%f", "1970-01-01T05:00:00"),
    "a date that stays": Clock(
        "Date,Time", lambda t, wrap: [f"2024-05-31,{cell}" for cell in stamp(t - wrap, "%H:%M:%S.%f", "1970-01-02")]
    ),
    "seconds of the day": Clock("t [s]", lambda t, wrap: [f"{value % 86400:.2f}" for value in t + 86400 - wrap]),
    "31 bits of us": counter("t [us]", 1e-6, 31),
    "32 signed bits of us": counter("t [us]", 1e-6, 32, signed=True),
    "32 bits of ms": counter("t [ms]", 1e-3, 32),
    "16 signed bits of ms": counter("t [ms]", 1e-3, 16, signed=True),
    "32 bits of 100 ns": Clock(
        "t [us]", lambda t, wrap: [f"{int(cell) / 10:.1f}" for cell in count(t, 2**32 * 1e-7 - wrap, 1e-7, 32)]
    ),
}


def write(path: Path, heading: str, cells: list[str], rows: np.ndarray | None = None) -> Path:
    """Write the machine's samples in a log with these cells of the time, in the order of `rows`."""
    recording = machine()
    rows = np.arange(N) if rows is None else rows
    samples = zip(
        *((recording["p_A"] / 1e5).tolist(), (recording["p_B"] / 1e5).tolist(), (recording["x"] * 1e3).tolist()),
        *(recording["theta"].tolist(), recording["u"].tolist()),
        strict=True,
    )
    lines = [",".join([cell, *map("{:.5g}".format, values)]) for cell, values in zip(cells, samples, strict=True)]
    text = [f"{heading},p_A [bar],p_B [bar],x [mm],theta [rad],u [V]", *(lines[row] for row in rows.tolist())]
    path.write_text("\n".join(text) + "\n")
    return path


def codes(recording: Recording) -> list[str]:
    """List the codes of the findings on the time."""
    return [finding.code for finding in inspect(recording) if finding.channel is None]


@pytest.mark.parametrize("name", few(CLOCKS, 4, SLOW))
@pytest.mark.parametrize("seed", few(range(6), 1, SLOW))
def test_a_clock_that_wraps_is_unwrapped(name: str, seed: int, tmp_path: Path) -> None:
    """The wrap is at a random time, and the log lacks some rows."""
    generator = np.random.default_rng([seed, list(CLOCKS).index(name)])
    entry, t = CLOCKS[name], machine().t
    rows = np.flatnonzero(generator.random(N) > 1e-3)
    cells = entry.cells(t, float(generator.uniform(1.0, 59.0)))
    recording = ss.read(write(tmp_path / "log.csv", entry.heading, cells, rows))
    assert recording.t - recording.t[0] == pytest.approx(t[rows] - t[rows[0]], abs=6e-3)
    assert recording["p_A"] == pytest.approx(machine()["p_A"][rows], rel=1e-4)
    assert (entry.code in codes(recording)) == bool(entry.code)
    assert "reversed_time" not in codes(recording)


@pytest.mark.parametrize("name", ["16 bits of ms", "24 hours", "32 bits of us"])
def test_parts_of_a_long_log_go_on_after_a_wrap(name: str, tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", CLOCKS[name].heading, CLOCKS[name].cells(machine().t, 30.0))
    whole, parts = ss.read(path), [*ss.read_parts(path, 7.0)]
    assert np.concatenate([part.t for part in parts]) == pytest.approx(whole.t, abs=1e-5)


def epoch(t: np.ndarray) -> list[str]:
    return [f"{1717151400 + value:.2f}" for value in t]


def seconds(t: np.ndarray) -> list[str]:
    return [f"{value:.2f}" for value in t]


@dataclass(frozen=True)
class Break:
    """A log whose clock was set, or whose rows are in another order: what is written, and what must be found."""

    code: str
    make: Callable[[np.ndarray, int], tuple[list[str], np.ndarray]]  # (times, row) -> cells of all rows, rows written
    error: float = 1e-2  # largest error of the times that are read [s]


def twice(t: np.ndarray, row: int) -> tuple[list[str], np.ndarray]:
    """Write a buffer of 150 rows twice."""
    return epoch(t), np.insert(np.arange(N), row, np.arange(row - 150, row))


def late(t: np.ndarray, row: int) -> tuple[list[str], np.ndarray]:
    """Write every hundredth row two rows late."""
    order = np.arange(N, dtype=np.float64)
    order[50::100] += 2.5
    return epoch(t), np.argsort(order)


BREAKS = {
    "set back by 2 s": Break("clock_set", lambda t, row: (epoch(t - 2.0 * (np.arange(N) >= row)), np.arange(N))),
    "set back by an hour": Break("clock_set", lambda t, row: (epoch(t - 3600.0 * (np.arange(N) >= row)), np.arange(N))),
    "set from 2000 on": Break("clock_set", lambda t, row: (epoch(t - 7e8 * (np.arange(N) < row)), np.arange(N))),
    "stamps that are back for a while": Break(
        "clock_set", lambda t, row: (epoch(t - 30.0 * (np.arange(N) // 700 % 2)), np.arange(N))
    ),
    "stamps that are ahead for a while": Break(
        "clock_set", lambda t, row: (epoch(t + 30.0 * (np.arange(N) // 700 % 2)), np.arange(N))
    ),
    "restart after a second": Break(
        "clock_restarted",
        lambda t, row: (
            seconds(np.where(np.arange(N) < row, t, t - t[row] - 1.0)),
            np.delete(np.arange(N), slice(row, row + 50)),
        ),
        error=0.05,
    ),
    "written twice": Break("rows_written_twice", twice),
    "late rows": Break("rows_sorted", late),
    "a ring buffer": Break("rows_sorted", lambda t, row: (epoch(t), np.roll(np.arange(N), row))),
    "wrong stamps": Break(
        "wrong_times", lambda t, row: (epoch(np.where(np.arange(N) % 700 == 300, t + 500.0, t)), np.arange(N))
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BREAKS)
@pytest.mark.parametrize("seed", few(range(6), 1, SLOW))
def test_rows_are_read_in_the_order_of_time(name: str, seed: int, tmp_path: Path) -> None:
    """The clock is set, or the logger restarts, at a random row; no row is lost."""
    entry = BREAKS[name]
    generator = np.random.default_rng([seed, list(BREAKS).index(name)])
    cells, rows = entry.make(machine().t, int(generator.integers(500, 5500)))
    recording = ss.read(write(tmp_path / "log.csv", "t [s]", cells, rows))
    rows = np.unique(rows)
    assert recording["x"] == pytest.approx(machine()["x"][rows], abs=1e-6)
    assert recording.t - recording.t[0] == pytest.approx(machine().t[rows], abs=entry.error)
    assert entry.code in codes(recording)
    assert recording.rate == RATE
    corrected = correct_samples(recording)
    assert corrected.used_fraction == pytest.approx(rows.size / N, abs=0.01)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".nc"])
def test_a_recording_made_elsewhere_is_ordered_before_it_is_judged(suffix: str, tmp_path: Path) -> None:
    """What Sealscope has written is read as it is, with times that step back, and its rows are ordered then."""
    restarted = replace(machine(), t=machine().t - 60.0 * (np.arange(N) >= 3000))
    ss.write(restarted, tmp_path / f"log{suffix}")
    recording = ss.read(tmp_path / f"log{suffix}")
    assert np.array_equal(recording.t, restarted.t)
    corrected = correct_samples(recording)
    assert len(corrected.recording) >= N
    assert corrected.used_fraction == 1.0
    assert {"clock_set", "clock_restarted"} & {finding.code for finding in corrected.findings}


def parquet(path: Path, columns: dict[str, np.ndarray]) -> Path:
    from pyarrow import parquet, table

    parquet.write_table(table(columns), path / "log.parquet")
    return path / "log.parquet"


def matlab(path: Path, columns: dict[str, np.ndarray]) -> Path:
    from scipy.io import savemat

    savemat(path / "log.mat", {name.replace(" ", "_").strip("]").replace("[", ""): v for name, v in columns.items()})
    return path / "log.mat"


def hdf5(path: Path, columns: dict[str, np.ndarray]) -> Path:
    import h5py

    with h5py.File(path / "log.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
    return path / "log.h5"


def tdms(path: Path, columns: dict[str, np.ndarray]) -> Path:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(str(path / "log.tdms")) as writer:
        writer.write_segment([ChannelObject("rig", name, values) for name, values in columns.items()])
    return path / "log.tdms"


def json_lines(path: Path, columns: dict[str, np.ndarray]) -> Path:
    import json

    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [json.dumps(dict(zip(columns, row, strict=True))) for row in rows]
    (path / "log.jsonl").write_text("\n".join(lines))
    return path / "log.jsonl"


@pytest.mark.parametrize("form", few([parquet, tdms, hdf5, matlab, json_lines], 2, SLOW))
@pytest.mark.parametrize("kind", ["clock_wrapped", "clock_restarted", "rows_written_twice"])
def test_all_formats_are_ordered_alike(
    form: Callable[[Path, dict[str, np.ndarray]], Path], kind: str, tmp_path: Path
) -> None:
    pytest.importorskip({"tdms": "nptdms", "parquet": "pyarrow"}.get(form.__name__, "numpy"))
    recording, rows = machine(), np.arange(N)
    ticks = np.round(recording.t * 1e6).astype(np.int64)
    if kind == "clock_wrapped":
        ticks = (ticks + 2**32 - 30_000_000) % 2**32
    elif kind == "clock_restarted":
        ticks, rows = np.where(rows < 3000, ticks, ticks - 61_000_000), np.delete(rows, slice(3000, 3050))
    else:
        rows = np.insert(rows, 3000, np.arange(2900, 3000))
    columns = {"t [us]": ticks.astype(np.float64), "p_A [bar]": recording["p_A"] / 1e5, "x [mm]": recording["x"] * 1e3}
    read = ss.read(form(tmp_path, {name: values[rows] for name, values in columns.items()}))
    assert codes(read) == [kind]
    assert read["x"] == pytest.approx(recording["x"][np.unique(rows)])
    assert read.t - read.t[0] == pytest.approx(recording.t[np.unique(rows)], abs=0.05)


def test_rows_without_any_order_are_counted() -> None:
    """Rows in a random order, each second of them from another run, are no recording."""
    generator = np.random.default_rng(3)
    t = np.where(np.arange(N) % 2, machine().t, generator.permutation(machine().t) + 0.007)
    corrected = correct_samples(replace(machine(), t=t))
    left_out = next(finding for finding in corrected.findings if finding.code == "rows_left_out")
    assert left_out.severity == "warning"
    assert corrected.used_fraction <= 1.0 - left_out.count / N
    assert left_out.count > 0.9 * N


def test_rows_in_order_stay_as_they_are() -> None:
    """Repeated stamps, missing stamps and gaps are no steps back."""
    generator = np.random.default_rng(5)
    for _ in range(20):
        t = np.cumsum(generator.choice([0.0, 0.02, 0.5], 400))
        t[generator.random(400) < 0.02] = np.nan
        ordered = order_rows(t, [t, t])
        assert ordered.t is t
        assert (ordered.rows, ordered.events, ordered.breaks) == (None, (), ())


@pytest.mark.parametrize("name", few(["restart after a second", "12 hours, 1 o'clock", "set back by an hour"], 1, SLOW))
@pytest.mark.parametrize("seed", few(range(4), 1, SLOW))
def test_the_leak_is_found_by_any_clock(name: str, seed: int, tmp_path: Path) -> None:
    """The clock changes at a random time; the leak of 0.02 L/min begins after 60 s."""
    generator = np.random.default_rng([9, seed])
    if name in CLOCKS:
        heading, cells, rows = CLOCKS[name].heading, CLOCKS[name].cells(machine().t, generator.uniform(5, 55)), None
    else:
        heading, (cells, rows) = "t [s]", BREAKS[name].make(machine().t, int(generator.integers(500, 5500)))
    diagnosis = ss.diagnose(ss.read(write(tmp_path / "log.csv", heading, cells, rows)), rig="thesis")
    assert diagnosis.verdict == "leak", diagnosis.reason
    assert diagnosis.onset_s == pytest.approx(60.0, abs=4.0)
    assert diagnosis.leak_lpm == pytest.approx(0.02, rel=0.2)
