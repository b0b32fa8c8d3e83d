"""Files that cannot be read as recordings: one clear line each, quickly, and never a traceback of another kind."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sealscope.errors import UnreadableFile
from sealscope.recordings import read
from sealscope.recordings.formats import table

from ..refusals import mentions, refusal
from .refusals import count_bytes, refused

GOOD = "t [s],p_A [bar],note\n0,1,a\n0.002,2,b\n0.004,3,c\n"


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("", "data, empty file"),
        ("\n  \n", "samples, empty file"),
        ("t [s],p_A [Pa]\n", "samples, t [s], p_A [Pa]"),
        (
            "p_A [Pa]\n1\n2\n3\n",
            "time, rate, p_A [Pa]",
        ),
        (
            GOOD.replace("2,b", "two,b"),
            "sample, 'two', line 3, p_A [bar]",
        ),
        (
            GOOD.replace("2,b", "1e5000,b"),
            "sample, '1e5000', line 3",
        ),
        (GOOD.replace("2,b", "1_0,b"), "sample, '1_0', line 3"),
        (GOOD.replace("0.002,2,b", "0.002"), "row, 1, line 3"),
        (GOOD.replace("2,b", "2,b,c,d"), "row, 5, line 3"),
        (
            GOOD.replace("[bar]", "[mm]"),
            "p_A, mm",
        ),
        (
            GOOD.replace("[bar]", "[wibble]"),
            "p_A, wibble",
        ),
        (GOOD.replace("[s]", "[m]"), "time, m"),
        (
            GOOD.replace("p_A", "Druck"),
            "channel, map, Druck [bar], note",
        ),
        (
            "t [s],p_A [Pa],p_A [Pa]\n0,1,2\n1,2,3\n",
            "p_A, 2, 3, #2",
        ),
        ("t [s],p_A [Pa]\n0,1\n", "time, increase"),
        ("t [s],p_A [Pa]\n3,1\n3,1\n3,1\n", "time, increase"),
        ("Date,p_A [Pa]\n5/31/24,1\n6/1/24,2\n",
         "time, rate, Date"),
        ("Timestamp,p_A [Pa]\n2024-05-31T10:00:00,1\nyesterday,2\n2024-05-31T10:00:02,3\n",
         "time, 'yesterday', line 3, Timestamp"),
        ("# sealscope: {broken\nt [s],p_A [Pa]\n0,1\n1,2\n",
         "description, JSON"),
        ('# sealscope: {"format": 99, "rate": 1, "provenance": {}, "history": []}\nt [s],p_A [Pa]\n0,1\n1,2\n',
         "format, 99"),
    ],
)  # fmt: skip
def test_text(tmp_path: Path, content: str, names: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(content)
    assert mentions(refused(path), "FILE", *names.split(", "))


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (bytes(range(256)) * 40, "other binary data"),
        (b"MATLAB 5.0 MAT-file, Platform", "a MATLAB file must be whole"),
        (b"TDSm" + bytes(40), "a TDMS file must be whole"),
        (b"MDF     4.10", "an MDF file must be whole"),
        (b"PK\x03\x04" + bytes(40), "a zip archive must be whole"),
        (b"\x1f\x8b\x08\x00" + bytes(40), "a gzip archive must be whole"),
        (b"CDF\x01" + bytes(40), "a NetCDF-3 file"),
        (b"\x89HDF\r\n\x1a\n" + bytes(40), "a NetCDF or HDF5 file must be whole"),
        (b"\x89HDF\r\n\x1a\n", "a NetCDF or HDF5 file must be whole"),
        (b"\x01\x02\x03\x04\xff" * 100, "other binary data"),
        (b"t [s],p_A [Pa]\n0,1\n1,2\n" + b"x" * 100_000, "a sample must be a number"),
        (b"x" * 100_000, "must have lines"),
    ],
)
def test_binary(tmp_path: Path, content: bytes, part: str) -> None:
    path = tmp_path / "log.nc"
    path.write_bytes(content)
    text = refused(path)
    assert part in text or "a row must have 2 cells" in text


def test_missing_file_and_folder(tmp_path: Path) -> None:
    assert refused(tmp_path / "absent.csv") == "a recording must exist, got no such file (FILE)"
    assert refused(tmp_path) == "a recording must be a file, got a folder (FILE)"


@pytest.mark.parametrize("name", ["log.csv", "log.nc", "log.h5", "log.parquet", "log"])
def test_two_gigabytes_of_nothing(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with path.open("wb") as file:
        file.truncate(2 * 1024**3)
    assert count_bytes(lambda: refused(path)) < 1e6
    assert "other binary data" in refused(path)


def test_two_gigabytes_of_nothing_after_a_header(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    with path.open("wb") as file:
        file.write(b"t [s],p_A [Pa]\n" + b"".join(b"%d,1\n" % i for i in range(20_000)))
        file.truncate(2 * 1024**3)
    assert count_bytes(lambda: refused(path)) < 100e6
    assert "got binary data (line 20002" in refused(path)


def test_too_many_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "MAX_VALUES", 100)
    path = tmp_path / "log.csv"
    path.write_text("t [s],x [m]\n" + "".join(f"{i},{i}\n" for i in range(51)))
    assert "at most 100 values" in refused(path)


def test_a_huge_hdf5_data_set_is_refused_unread(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name, unit in (("t", "s"), ("p_A", "Pa")):
            file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1024,)).attrs["units"] = unit
    assert "cut it into parts" in refused(path)


def test_hdf5_of_unequal_lengths(tmp_path: Path) -> None:
    import h5py

    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["p_A"] = np.arange(10.0), np.arange(5.0)
        file["p_A"].attrs["units"] = "Pa"
    assert refused(path) == "p_A must have as many samples as t (10), got 5 (FILE)"


def test_missing_mapped_column(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(GOOD)
    text = refused(path, map={"p_A": "PG_1"})
    assert text == "PG_1, mapped to p_A, must be a column, got columns t [s], p_A [bar], note (FILE)"
    text = refused(path, map={"x": "p_A"})
    assert text == "x must have a unit of length, such as m, got bar (FILE)"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": 0.0}, "rate, 0.0"),
        ({"rate": float("nan")}, "rate, nan"),
        ({"map": {"P_X": "a"}}, "channel"),
    ],
)
def test_wrong_calls(tmp_path: Path, options: dict[str, object], words: str) -> None:
    with refusal(*words.split(", ")) as caught:
        read(tmp_path / "log.csv", **options)  # type: ignore[arg-type]
    assert not isinstance(caught.value, UnreadableFile)


def test_a_name_that_lies_is_read_by_content_and_said(tmp_path: Path) -> None:
    path = tmp_path / "log.nc"
    path.write_text(GOOD)
    recording = read(path)
    assert recording["p_A"] == pytest.approx([1e5, 2e5, 3e5])
    assert recording.history[0] == "name ends in .nc, content is text, comma separated, utf-8"


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=300) | st.text(alphabet='t[s],p_A Pa\n0123.;\t-eN"#', max_size=200).map(str.encode))
def test_any_bytes_are_a_recording_or_one_clear_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    try:
        read(path, map={"p_A": "1"}, rate=10.0)
    except UnreadableFile as error:
        assert "\n" not in str(error)


@settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 4000), flips=st.lists(st.tuples(st.integers(0, 8000), st.integers(1, 255)), max_size=4))
def test_damaged_netcdf_is_a_recording_or_one_clear_line(
    tmp_path: Path, cut: int, flips: list[tuple[int, int]]
) -> None:
    from sealscope.recordings import Recording, write

    path = tmp_path / "log.nc"
    write(Recording(np.arange(50) / 5, {"p_A": np.ones(50)}, {"p_A": "Pa"}, 5.0), path)
    data = bytearray(path.read_bytes())
    for at, change in flips:
        data[at % len(data)] ^= change
    path.write_bytes(bytes(data[: len(data) - cut]))
    try:
        read(path)
    except UnreadableFile as error:
        assert "\n" not in str(error)
