"""A long recording read part by part: the same samples as read whole, in memory that does not grow with the file."""

from __future__ import annotations

import gzip
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sealscope as ss
from sealscope.errors import UnreadableFile
from sealscope.recordings import join
from sealscope.recordings.formats import text

from ..refusals import refusal
from ..representatives import few

RATE = 500.0


def rows(count: int, *, stamps: bool) -> str:
    t = np.arange(count) / RATE
    clock = np.datetime64("2026-05-31T23:59:50", "ms") + np.round(1e3 * t).astype("timedelta64[ms]")
    p_A, p_B = 300 + 60 * np.sin(4 * t), 300 - 60 * np.sin(4 * t)
    times = clock.astype(str) if stamps else [f"{value:.3f}" for value in t]
    return "".join(f"{a},{b:.4f},{c:.4f}\n" for a, b, c in zip(times, p_A, p_B, strict=True))


def log(folder: Path, count: int, *, stamps: bool = False) -> Path:
    path = folder / "long.csv"
    path.write_text(f"{'Timestamp' if stamps else 't [s]'},p_A [kPa],p_B [kPa]\n" + rows(count, stamps=stamps))
    return path


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(every=st.floats(0.004, 20.0), stamps=st.booleans(), chunk=st.integers(200, 40_000))
def test_parts_are_the_whole(every: float, stamps: bool, chunk: int, tmp_path: Path) -> None:
    path = log(tmp_path, 3000, stamps=stamps)
    whole = ss.read(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text, "_CHUNK", chunk)
        parts = list(ss.read_parts(path, every))
    size = max(1, round(every * RATE))
    assert [len(part) for part in parts[:-1]] == [size] * (len(parts) - 1)
    for name in ("p_A", "p_B"):
        assert np.array_equal(np.concatenate([part[name] for part in parts]), whole[name])
    assert all(part.rate == RATE or len(part) < 3 for part in parts)
    if not stamps:
        assert np.array_equal(np.concatenate([part.t for part in parts]), whole.t)
    else:
        begins = [np.datetime64(part.provenance["start"]) - np.datetime64(whole.provenance["start"]) for part in parts]
        assert [begin / np.timedelta64(1, "ms") for begin in begins] == [2.0 * size * k for k in range(len(parts))]


def moments(count: int) -> np.ndarray:
    return np.datetime64("2024-06-12T23:59:57", "ms") + (10 * np.arange(count)).astype("m8[ms]")


#: Times of samples at 100 Hz, as files hold them.
TIMES: dict[str, Callable[[int], list[str]]] = {
    "seconds": lambda count: [f"{k / 100}" for k in range(count)],
    "coarse": lambda count: [f"{k // 10 / 10}" for k in range(count)],
    "epoch": lambda count: [f"{1717151400000 + 10 * k}" for k in range(count)],
    "share of the day": lambda count: [repr(0.3 + k / 8_640_000) for k in range(count)],
    "days": lambda count: [repr(45_000 + k / 8_640_000) for k in range(count)],
    "date": lambda count: [time.item().strftime("%d/%m/%Y %H:%M:%S.%f") for time in moments(count)],
    "time of the day": lambda count: [str(time)[11:] for time in moments(count)],
    "minutes": lambda count: [str(time)[14:] for time in moments(count)],
    "last sample first": lambda count: [f"{k / 100}" for k in range(count)][::-1],
}


@pytest.mark.parametrize("form", TIMES)
@pytest.mark.parametrize("every", few([0.3, 2.5, 5.0]))
def test_what_is_decided_of_the_time_holds_for_all_parts(form: str, every: float, tmp_path: Path) -> None:
    """The last part has one sample; a word stands in a part of 30 samples, 1 % of the log at most."""
    path = tmp_path / "log.csv"
    path.write_text(
        "Time;p_A [bar]\n"
        + "".join(f"{time};{'OVERLOAD' if k == 40 else k % 7}\n" for k, time in enumerate(TIMES[form](1001)))
    )
    whole, parts = ss.read(path), list(ss.read_parts(path, every))
    assert len(parts) == (1 if form == "last sample first" else 1 + 1000 // round(100 * every))
    joined = join(parts) if len(parts) > 1 else parts[0]
    assert joined.rate == whole.rate
    assert joined.t == pytest.approx(whole.t, abs=1e-5)
    assert np.array_equal(joined["p_A"], whole["p_A"], equal_nan=True)


def test_a_part_names_no_word_of_an_earlier_part(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    words = {40: "FIRST", 60: "SECOND", 140: "THIRD"}
    path.write_text("t [s];p_A [bar]\n" + "".join(f"{k / 100};{words.get(k, 1)}\n" for k in range(1000)))
    notes = ["; ".join(line for line in part.history if "read as missing" in line) for part in ss.read_parts(path, 0.5)]
    assert "1 cell" in notes[0] and "'FIRST' (line 42" in notes[0]
    assert [note for note in notes[1:] if note] == ["column p_A [bar]: 1 cell without a number read as missing"] * 2


@pytest.mark.parametrize("suffix", [".nc", ".parquet", ".csv.gz"])
def test_other_formats_are_cut_the_same(suffix: str, tmp_path: Path) -> None:
    plain = log(tmp_path, 1000)
    path = tmp_path / f"other{suffix}"
    if suffix == ".csv.gz":
        path.write_bytes(gzip.compress(plain.read_bytes()))
    else:
        ss.write(ss.read(plain), path)
    ours, theirs = list(ss.read_parts(plain, 0.7)), list(ss.read_parts(path, 0.7))
    assert [len(part) for part in theirs] == [350, 350, 300]
    for a, b in zip(ours, theirs, strict=True):
        assert np.array_equal(a["p_B"], b["p_B"])


def test_memory_does_not_grow_with_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "_CHUNK", 40_000)
    peaks = []
    for count in (20_000, 80_000):
        path = log(tmp_path, count)
        next(ss.read_parts(path, 4.0))  # what is imported meanwhile does not count
        tracemalloc.start()
        assert sum(len(part) for part in ss.read_parts(path, 4.0)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0], peaks


def test_a_bad_row_names_its_line_after_the_parts_before_it(tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text("t [s],p_A [kPa],p_B [kPa]\n" + rows(700, stamps=False) + "1.4,inf,300\n")
    parts = []
    with refusal("'inf'", "line 702", error=UnreadableFile):
        parts.extend(ss.read_parts(path, 1.0))
    empty = tmp_path / "empty.csv"
    empty.write_text("t [s],p_A [kPa],p_B [kPa]\n")
    with refusal("samples", error=UnreadableFile):
        list(ss.read_parts(empty, 1.0))
    for every in (0.0, float("inf"), float("nan")):
        with refusal("every", "0 s"):
            ss.read_parts(path, every)
