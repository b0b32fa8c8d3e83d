"""When a recording was made: its date stamps, else date and time in its file's name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.recordings import read
from sealscope.recordings.joining import file_seconds, start_seconds
from sealscope.recordings.recording import Recording


def named(name: str, t0: float = 0.0, start: str | None = None) -> Recording:
    provenance = {"file": name} if start is None else {"file": name, "start": start}
    return Recording(t0 + np.arange(10) / 10.0, {"p_A": np.zeros(10)}, {"p_A": "Pa"}, 10.0, provenance)


@pytest.mark.parametrize(
    ("name", "start", "stamp"),
    [
        ("Base_000_2_410_9-11-2019-8-30-23_AM.txt", None, "2019-09-11T08:30:23"),
        ("Leak_000_0_303_9-10-2019-4-37-01_PM.txt", None, "2019-09-10T16:37:01"),
        ("x_9-10-2019-12-00-01_AM.txt", None, "2019-09-10T00:00:01"),
        ("rig-2026-07-01T14-05-09.csv", None, "2026-07-01T14:05:09"),
        ("20260701_140509.csv", None, "2026-07-01T14:05:09"),
        ("20260701-1405 run.csv", None, "2026-07-01T14:05:00"),
        ("20260701_140509.csv", "2026-07-02T00:00:00.5", "2026-07-02T00:00:00.500"),
        ("rig-2026-07-01.csv", None, "2026-07-01T00:00:00"),
        ("20261301_140509.csv", None, None),
        ("strokes_2019.csv", None, None),
        ("plain.csv", "5 s", None),
    ],
)
def test_start_of_a_recording(name: str, start: str | None, stamp: str | None) -> None:
    result = start_seconds(named(name, start=start))
    if stamp is None:
        assert result is None
    else:
        assert result == np.datetime64(stamp, "ms").astype(np.int64) / 1e3
        assert start_seconds(named(name, 2.0, start)) == result + 2.0


def test_a_first_sample_without_a_time_is_dated_by_the_next() -> None:
    recording = named("20260701_140509.csv", 2.0)
    for n_unknown, first in ((3, 2.0), (10, 0.0)):
        t = np.where(np.arange(10) < n_unknown, np.nan, recording.t)
        expected = start_seconds(named("20260701_140509.csv", first))
        assert start_seconds(replace(recording, t=t)) == pytest.approx(expected, abs=1e-6)


def test_counts_of_another_unit_are_no_date() -> None:
    assert start_seconds(named("20260701_140509.csv", 1.3e17)) is None


def test_a_log_in_seconds_since_1970_starts_then_whatever_its_name_says(tmp_path: Path) -> None:
    begin = 1_719_835_509.0
    log = tmp_path / "20260701_140509.csv"
    log.write_text("time [s],p_A [Pa]\n" + "".join(f"{begin + k},{3e5 + k * k % 7}\n" for k in range(20)))
    recording = read(log)
    assert start_seconds(recording) == file_seconds(recording, log) == begin
    assert start_seconds(recording.between(5.0, 10.0)) == begin + 5.0


@pytest.mark.parametrize("epoch", ["then", None, float("nan"), 12.0, 1e300])
def test_what_is_no_time_since_1970_is_not_taken_for_a_start(epoch: object) -> None:
    recording = Recording(
        np.arange(10) / 10.0, {"p_A": np.zeros(10)}, {"p_A": "Pa"}, 10.0,
        {"file": "20260701_140509.csv", "start_epoch_s": epoch},
    )  # fmt: skip
    assert start_seconds(recording) == start_seconds(named("20260701_140509.csv"))
