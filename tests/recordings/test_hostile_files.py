"""Files that are broken or made to do harm: refused by one line, quickly; nothing is read that was not given."""

import logging
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sealscope.errors import UnreadableFile
from sealscope.recordings import Recording, inspect, read, write
from sealscope.units import to_si

from .refusals import count_calls, refused

T = np.arange(900) / 500
P = 3e5 + 1e4 * np.sin(4 * T)


def quoted(remarks: list[str]) -> str:
    return "t [s],p_A [Pa],remark\n" + "".join(f"{t},{float(p)!r},{r}\n" for t, p, r in zip(T, P, remarks, strict=True))


@pytest.mark.parametrize("line", [1, 400, 899])
@pytest.mark.parametrize("closed", [None, 898, 899])
def test_an_open_quotation_mark_swallows_no_rows(tmp_path: Path, line: int, closed: int | None) -> None:
    path, remarks = tmp_path / "log.csv", ["ok"] * 900
    remarks[line] = '"ok'
    if closed is not None and closed > line:
        remarks[closed] = 'ok"'
    path.write_text(quoted(remarks))
    message = f"a quotation mark must be closed on its line, got an open one (line {line + 2}, FILE)"
    assert refused(path) == message


def test_closed_quotation_marks_and_those_within_a_cell_are_text(tmp_path: Path) -> None:
    path, remarks = tmp_path / "log.csv", ["ok"] * 900
    remarks[3:7] = ['"a, b"', '1/4" hose', '"he said ""stop"" "', ""]
    path.write_text(quoted(remarks))
    assert np.array_equal(read(path)["p_A"], P)


def test_a_quoted_cell_that_the_end_of_the_file_cuts_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t [s],p_A [Pa],p_B [Pa]\n" + "".join(f'"{t}","1","2"\n' for t in T[:5]) + '"0.01","1","2')
    assert np.array_equal(read(path)["p_B"], [2, 2, 2, 2, 2, np.nan], equal_nan=True)


def test_hdf5_in_other_files_is_refused_by_name(tmp_path: Path) -> None:
    secret, path = tmp_path / "secret", tmp_path / "log.h5"
    secret.write_bytes(P.tobytes())
    with h5py.File(tmp_path / "source.h5", "w") as source:
        source["p"] = P
    layout = h5py.VirtualLayout(shape=P.shape, dtype="f8")
    layout[:] = h5py.VirtualSource(str(tmp_path / "source.h5"), "p", shape=P.shape)
    with h5py.File(path, "w") as file:
        file["t"] = T
        file["u"] = P
        file.create_dataset("p_A", P.shape, "f8", external=[(str(secret), 0, P.nbytes)])
        file.create_virtual_dataset("p_B", layout)
        file["x"] = h5py.ExternalLink(str(tmp_path / "source.h5"), "p")
        file["t"].attrs["units"] = "s"
        for name, unit in (("p_A", "Pa"), ("p_B", "Pa"), ("u", "V")):
            file[name].attrs["units"] = unit
    assert refused(path) == "p_A must have its samples in the file itself, got external storage (FILE)"
    with h5py.File(path, "a") as file:
        del file["p_A"]
    assert refused(path) == "p_B must have its samples in the file itself, got a virtual data set (FILE)"
    with h5py.File(path, "a") as file:
        del file["p_B"]
    assert set(read(path).channels) == {"u"}


@pytest.mark.parametrize("name", ["log.csv", "log.h5", "log.parquet"])
@pytest.mark.parametrize("error", [ValueError, TypeError, IndexError, AssertionError, RecursionError, ArithmeticError])
def test_whatever_a_format_library_raises_names_the_file(
    tmp_path: Path,
    name: str,
    error: type[Exception],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / name
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    write(Recording(T, {"p_A": P}, {"p_A": "Pa"}, 500.0), path)
    module = {"log.csv": "text", "log.h5": "netcdf", "log.parquet": "parquet"}[name]
    inner = {"text": "_Log._iter_line_blocks", "netcdf": "_read_values", "parquet": "_read_values"}[module]

    def fail(*args: object) -> None:
        raise error("odd\nthing")

    monkeypatch.setattr(f"sealscope.recordings.formats.{module}.{inner}", fail)
    monkeypatch.setattr("sealscope.recordings.files.run_on_file", lambda work, *arguments, **limits: work(*arguments))
    kind = {"text": "text", "netcdf": "NetCDF or HDF5", "parquet": "Parquet"}[module]
    with caplog.at_level(logging.DEBUG, "sealscope"):
        assert refused(path) == f"a {kind} file must be whole, got: odd thing (FILE)"
    assert caplog.records[-1].exc_info[0] is error


@pytest.mark.parametrize(
    "value", [np.array([]), "text", b"\xff", np.array([[1.0, 2.0]]), np.nan, 1e300, h5py.Empty("f8")]
)
@pytest.mark.parametrize("key", ["scale_factor", "add_offset", "_FillValue", "missing_value", "units", "NAME"])
def test_attributes_of_any_kind(tmp_path: Path, key: str, value: object) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["p_A"] = T, P
        file["t"].attrs["units"], file["p_A"].attrs["units"] = "s", "Pa"
        file["p_A"].attrs[key] = value
    try:
        inspect(read(path))
    except UnreadableFile as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)


SLOW = {
    "a cell of blanks": "t [s],p_A [Pa]\n0,1\n1," + " " * 60_000 + "x\n2,3\n",
    "many cells of blanks": "t [s],p_A [Pa]\n" + ("0,1\n1," + " " * 900 + "x\n") * 60,
    "nearly stamps": "t [s],p_A [Pa]\n" + ("2024-01-01 " + " " * 900 + ",1\n") * 60,
    "many unknown units": "t,p_A," + ",".join(f"a{i}" for i in range(250)) + "\ns,Pa,"
    + ",".join(f"q{i}" for i in range(250)) + "\n" + ("1" + ",1" * 251 + "\n") * 3,
    "square brackets": "t [s],p_A " + "[" * 60_000 + "\n0,1\n1,2\n",
    "round brackets": "t [s],p_A " + "(" * 30_000 + ")" * 30_000 + "\n0,1\n1,2\n",
    "blanks in a heading": "t [s],p_A" + " " * 60_000 + "x\n0,1\n1,2\n",
    "strokes": "t [s],p_A" + " / " * 20_000 + "x\n0,1\n1,2\n",
    "headings between blanks": "a [a " * 2_000 + "\n0 1\n1 2\n",
    "digits": "t [s],p_A [Pa]\n0," + "1" * 60_000 + "x\n1,2\n",
    "nested powers": "t [s],p_A [" + "(" * 30 + "mPa^9" + ")^9" * 30 + "]\n0,1\n1,2\n",
    "a long origin of time": "t [s since " + " " * 30_000 + "x],p_A [Pa]\n0,1\n1,2\n",
    "delimiters": "," * 60_000 + "\n" + "," * 60_000,
    "open quotation marks": "t [s],p_A [Pa]\n" + '0,"1\n' * 10_000,
}  # fmt: skip
#: Texts that take a second or more.
LONG = ("headings between blanks", "delimiters")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in ("headings between blanks", "delimiters") else name
        for name in SLOW
    ],
)
def test_the_work_goes_with_the_length_of_a_text(tmp_path: Path, name: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(SLOW[name])
    assert count_calls(lambda: refused(path)) < 1000 * len(SLOW[name])


@pytest.mark.parametrize(
    ("heading", "unit"),
    [("p [psi]", "psi"), ("p(bar)", "bar"), ("p / bar", "bar"), ("p/bar", "bar"), ("p (N/(m m))", "Pa"),
     ("[kPa]", "kPa"), ("p (port A)", "count"), ("p ()", "count"), ("p (a (b) (c))", "count")],
)  # fmt: skip
def test_headings(tmp_path: Path, heading: str, unit: str) -> None:
    (tmp_path / "log.csv").write_text(f"t [s],{heading}\n0,1\n1,2\n2,3\n")
    assert read(tmp_path / "log.csv", map={"p_A": "#2"})["p_A"][0] == to_si(
        1.0, unit, "count" if unit == "count" else "Pa"
    )


@settings(deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(alphabet='t[s]p_A Pa,;\t0123.\n\n-eE"()/ ', max_size=200))
def test_any_text_is_a_recording_that_can_be_inspected_or_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t [s],p_A [Pa]\n" + text)
    try:
        inspect(read(path))
    except UnreadableFile as error:
        assert "\n" not in str(error)
