"""When a recording was made: its date stamps, else date and time in its file's name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.recordings import read
from sealscope.recordings.header import file_seconds, start_seconds
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
        ("20260701_140509.csv", "2026-07-02T00:00:00.5Z", "2026-07-02T00:00:00.500"),
        ("20260701_140509.csv", "2026-07-02T02:00:00+02:00", "2026-07-02T00:00:00"),
        ("rig-2026-07-01.csv", None, "2026-07-01T00:00:00"),
        ("20261301_140509.csv", None, None),
        ("strokes_2019.csv", None, None),
        ("plain.csv", "5 s", None),
        ("rudder_14-03-2026_07-28.txt", None, "2026-03-14T07:28:00"),
        ("rudder_04.03.2026_0728.txt", None, "2026-03-04T07:28:00"),
        ("rudder_04-03-2026_07-28.txt", None, None),  # 4 March, 3 April, and no 28 July
        ("rudder_03-03-2026_07-28.txt", None, "2026-03-03T07:28:00"),
        ("rig-2026-07-01T14-05-09.csv", "2026-07-01", "2026-07-01T14:05:09"),
        ("rig-2026-07-02T14-05-09.csv", "2026-07-01", "2026-07-01T00:00:00"),
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


def write_log(file: Path, preamble: str = "", times: str = "t [s]\n0\n1\n2\n3") -> Path:
    heading, *cells = times.splitlines()
    rows = "".join(f"{cell},{k * k % 7}\n" for k, cell in enumerate(cells))
    file.write_text(f"{preamble}{heading},p_A [bar]\n{rows}")
    return file


def iso_start(file: Path) -> str | None:
    seconds = start_seconds(read(file))
    return None if seconds is None else str(np.datetime64(int(seconds), "s"))


def test_names_beside_a_file_tell_whether_its_date_begins_with_the_day(tmp_path: Path) -> None:
    logs = [write_log(tmp_path / f"rig_{date}_07-28.csv") for date in ("04-03-2026", "05-03-2026")]
    assert iso_start(logs[0]) is None
    assert "rig_04-03-2026_07-28.csv" in read(logs[0]).history[-1]
    write_log(tmp_path / "13-03-2026.csv")  # another name
    assert iso_start(logs[0]) is None
    write_log(tmp_path / "rig_13-03-2026_07-28.csv")
    assert [iso_start(log) for log in logs] == ["2026-03-04T07:28:00", "2026-03-05T07:28:00"]
    # every field joined by the same mark: 2026-07-28 is no date of the others
    logs = [
        write_log(tmp_path / f"all-{date}-07-{minute}.csv") for date, minute in (("04-03-2026", 28), ("13-03-2026", 41))
    ]
    assert iso_start(logs[0]) == "2026-03-04T07:28:00"


@pytest.mark.parametrize(
    ("preamble", "name", "start"),
    [
        ("Beginn: 04.03.2026 07:28:00\n", "rig_05-03-2026_09-00.csv", "2026-03-04T07:28:00"),
        ("Datum: 04/03/2026\nUhrzeit: 07:28:00\n", "rig.csv", "2026-03-04T07:28:00"),
        ("Date: 2026-03-04\n", "rig_20260304_0728.csv", "2026-03-04T07:28:00"),
        ("Date: 2026-03-04\n", "rig.csv", "2026-03-04T00:00:00"),
        ("Start time: 04/03/2026 07:28:00\n", "rig.csv", None),
        ("Start time: 04/13/2026 07:28:00\n", "rig.csv", "2026-04-13T07:28:00"),
        ("Start time: 04/03/2026 07:28:00\n", "rig_20260304.csv", "2026-03-04T07:28:00"),
        ("Calibration date: 04.03.2020\nTime: 07:28\n", "rig.csv", None),
    ],
)
def test_a_preamble_states_the_start(tmp_path: Path, preamble: str, name: str, start: str | None) -> None:
    assert iso_start(write_log(tmp_path / name, preamble)) == start


def test_a_preambles_date_completes_times_of_the_day(tmp_path: Path) -> None:
    stamps = "Time\n23:59:58\n23:59:59\n00:00:00\n00:00:01"
    assert iso_start(write_log(tmp_path / "rig.csv", "Date:,2026-03-04\n", stamps)) == "2026-03-04T23:59:58"


@pytest.mark.parametrize(
    "form", ["Start: {}/03/2026 07:28:00\n|t [s]\n0\n1\n2\n3", "|Time\n" + "{}/03/2026 07:28:00\n" * 4]
)
def test_logs_beside_a_log_tell_whether_its_dates_begin_with_the_day(tmp_path: Path, form: str) -> None:
    def write(day: int) -> Path:
        preamble, times = form.format(*[f"{day:02d}"] * form.count("{}")).split("|")
        return write_log(tmp_path / f"rig_{day}.csv", preamble, times.replace(":00\n", ":0{}\n").format(*range(4)))

    log = write(4)
    assert iso_start(log) != "2026-03-04T07:28:00"
    write(13)
    assert iso_start(log) == "2026-03-04T07:28:00"
    log.rename(log.with_name("2026-03-04 rig.csv"))  # no log beside it has such a name, which tells as much
    assert iso_start(log.with_name("2026-03-04 rig.csv")) == "2026-03-04T07:28:00"
