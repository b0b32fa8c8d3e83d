"""Data frames and data sets: what the files hold, and back."""

import sys

import numpy as np
import pytest

import sealscope as ss
from sealscope.errors import InputError, MissingExtra, UnreadableFile
from sealscope.recordings import COUNTS, Recording

from ..refusals import refusal

pandas = pytest.importorskip("pandas")
RATE = 500.0


def plain(count: int = 600) -> Recording:
    t = np.arange(count) / RATE
    p = 3e5 + 1e4 * np.sin(4 * t)
    p[7:8] = np.nan
    units = {"p_A": "Pa", "x": "m", "p_B": COUNTS}
    return Recording(t, {"p_A": p, "x": 0.01 * np.cos(4 * t), "p_B": p}, units, RATE, {"by": ["test"]}, ("made",))


def assert_same(a: Recording, b: Recording) -> None:
    assert np.array_equal(a.t, b.t)
    assert list(a.channels) == list(b.channels)
    for name in a.channels:
        assert np.array_equal(a[name], b[name], equal_nan=True)
    assert (a.units, a.rate, a.provenance, a.history) == (b.units, b.rate, b.provenance, b.history)


def test_a_frame_has_the_names_of_the_files_and_reads_back() -> None:
    frame = plain().to_pandas()
    assert frame.index.name == "t [s]"
    assert list(frame.columns) == ["p_A [Pa]", "x [m]", "p_B [count]"]
    assert frame.attrs["units"] == {"t [s]": "s", "p_A [Pa]": "Pa", "x [m]": "m", "p_B [count]": "count"}
    assert_same(Recording.from_pandas(frame), plain())
    frame.iloc[:, 0] = 0.0  # a copy
    assert plain()["p_A"][0] != 0.0


def test_a_rate_is_kept_unless_the_stamps_contradict_it() -> None:
    odd = Recording(np.arange(50) / 499.123456789, {"x": np.arange(50)}, {"x": "m"}, 499.123456789)
    assert Recording.from_pandas(odd.to_pandas()).rate == 499.123456789
    halved = Recording.from_pandas(plain().to_pandas().iloc[::2])
    assert (halved.rate, halved.history) == (250.0, ("made",))
    assert Recording.from_pandas(plain().to_pandas(), rate=100.0).rate == 100.0


@pytest.mark.parametrize("tz", [None, "Europe/Berlin"])
def test_indices_of_time(tz: str | None) -> None:
    p = np.array([1.0, 2.0, 1.0, 3.0])
    expected = [0.0, 0.5, 1.0, 1.5]
    dates = pandas.date_range("2024-05-31 12:00", periods=4, freq="500ms", tz=tz)
    for index in (
        pandas.Index(expected),
        pandas.Index(1000 * np.array(expected), name="time [ms]"),
        dates,
        dates.rename("when"),
        pandas.to_timedelta(expected, unit="s"),
    ):
        options = {"map": {"t": "when"}} if index.name == "when" else {}
        recording = Recording.from_pandas(pandas.DataFrame({"p_A [bar]": p}, index=index), **options)
        assert recording.t == pytest.approx(expected, abs=1e-12)
        assert recording.rate == 2.0
        assert recording["p_A"] == pytest.approx(p * 1e5)
    assert (
        Recording.from_pandas(pandas.DataFrame({"p_A [bar]": p}, index=dates))
        .provenance["start"]
        .startswith("2024-05-31T1")
    )


def test_units_from_attributes_and_columns_of_other_kinds() -> None:
    frame = pandas.DataFrame(
        {
            "t": [0.0, 0.1, 0.2],
            "p_A": pandas.array([1, None, 3], dtype="Int64"),
            "p_B": ["1", "", "2.5"],
            "x": np.float32([1, 2, 3]),
            "remark": ["<b>", "b", None],
        }
    )
    frame.attrs["units"] = {"p_A": "bar", "p_B": "psi", "t": "s"}
    frame["x"].attrs["units"] = "mm"  # pandas keeps the attributes of a column on some versions only
    frame.attrs["units"]["x"] = "mm"
    recording = Recording.from_pandas(frame)
    assert recording.rate == 10.0
    assert np.array_equal(recording["p_A"], [1e5, np.nan, 3e5], equal_nan=True)
    assert recording["p_B"][2] == pytest.approx(2.5 * 6894.757293168361)
    assert recording["x"] == pytest.approx([1e-3, 2e-3, 3e-3])
    assert recording.provenance == {"format": "pandas", "log_units": {"p_A": "bar", "p_B": "psi", "x": "mm"}}
    assert recording.history == ("columns not used: remark",)


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        ({"p_A [Pa]": [1.0, 2.0]}, {}, "a recording must have a time column such as t [s] or be given a rate"),
        ({"load": [1.0]}, {"rate": 1.0}, "a recording must have a channel"),
        ({"p_A [mm]": [1.0]}, {"rate": 1.0}, "p_A must have a unit of pressure, such as Pa, got mm"),
        ({"p_A [Pa]": ["a"]}, {"rate": 1.0}, "p_A [Pa] must hold numbers, got text (data frame)"),
        ({"p_A [Pa]": [1j]}, {"rate": 1.0}, "p_A [Pa] must hold numbers, got the type complex128 (data frame)"),
        ({"p_A [Pa]": []}, {"rate": 1.0}, "a recording must have samples"),
        ({"p_A [Pa]": [1.0]}, {"rate": 0.0}, "rate must be > 0 Hz, got 0.0"),
        ({"p_A [Pa]": [1.0]}, {"map": {"p_C": "a"}}, "a mapped channel must be one of"),
        ({"p_A [Pa]": [1.0]}, {"rat": 1.0}, "Recording.from_pandas has no argument 'rat'; did you mean 'rate'?"),
    ],
)  # fmt: skip
def test_frames_that_are_no_recordings(columns: dict, options: dict, message: str) -> None:
    with pytest.raises(InputError) as refused:
        Recording.from_pandas(pandas.DataFrame(columns), **options)
    assert str(refused.value).startswith(message)
    assert not isinstance(refused.value, UnreadableFile)
    with refusal("frame", "dict"):
        Recording.from_pandas(columns)


def test_a_data_set_is_what_the_netcdf_file_holds(tmp_path) -> None:
    xarray = pytest.importorskip("xarray")
    data = plain().to_xarray()
    assert isinstance(data, xarray.Dataset)
    assert data["p_A"].dims == ("t",)
    assert data["p_A"].attrs == {"units": "Pa", "long_name": "pressure in chamber A"}
    assert data["t"].attrs["units"] == "s"
    assert data.attrs["rate"] == RATE
    data.to_netcdf(tmp_path / "set.nc", engine="h5netcdf")
    assert_same(ss.read(tmp_path / "set.nc").only(["p_A", "x", "p_B"]), plain())
    ss.write(plain(), tmp_path / "file.nc")
    with xarray.open_dataset(tmp_path / "file.nc", engine="h5netcdf") as read:
        assert read.equals(data)
        assert read.attrs == data.attrs


def test_without_the_libraries_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for library, call in (
        ("pandas", plain().to_pandas),
        ("xarray", plain().to_xarray),
        ("pandas", lambda: Recording.from_pandas({})),
    ):
        monkeypatch.setitem(sys.modules, library, None)
        with refusal("sealscope[io]", error=MissingExtra):
            call()


def test_the_page_of_a_notebook_is_escaped() -> None:
    hostile = Recording([0, 1], {"<script>x": [1, np.nan]}, {"<script>x": "<b>&"}, 1.0)
    page = hostile._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;x" in page
    assert "&lt;b&gt;&amp;" in page
    assert page.count("<td>1</td>") == 4  # least, mean, most, missing
    assert Recording([0.0], {"x": [np.nan]}, {"x": "m"}, 1.0)._repr_html_().count("<td></td>") == 3
