"""NetCDF and HDF5 files of others, and Parquet tables of others."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from sealscope.recordings import COUNTS, Recording, read
from sealscope.recordings.header import oil_temperature

T = np.arange(200) / 500
P = 2.5 + np.sin(4 * T)


def test_plain_hdf5_in_groups(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("rig/daq")
        group["time"], group["PG_1"], group["p_B [bar]"] = T, (1000 * P).astype(np.int16), P
        group["time"].attrs["unit"] = b"s"
        file["picture"] = np.zeros((3, 3))
    recording = read(path, map={"p_A": "PG_1"})
    assert np.array_equal(recording.t, T)
    assert recording.rate == 500
    assert np.array_equal(recording["p_A"], (1000 * P).astype(np.int16))
    assert recording.units["p_A"] == COUNTS
    assert recording["p_B"] == pytest.approx(P * 1e5, rel=1e-15)
    assert read(path, map={"p_A": "rig/daq/PG_1[bar]"}).units["p_A"] == "Pa"


def test_what_files_say_beside_the_samples_is_the_same_in_every_format(tmp_path: Path) -> None:
    pd, pa = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    said = {"Oil temperature": "45 degC", "Operator": "N. N.", "serial": 7}
    columns = {"t [s]": T.tolist(), "p_A [bar]": P.tolist()}
    (tmp_path / "log.json").write_text(json.dumps(said | columns))
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file.attrs.update(said | {"tool": np.bytes_("DAQ"), "axes": [1, 2], "_hidden": "x"})
        file["t"], file["p_A"] = T, P
        file["t"].attrs["units"], file["p_A"].attrs["units"] = "s", "bar"
    frame = pd.DataFrame(columns)
    frame.attrs.update(said)
    table = pa.table(columns).replace_schema_metadata({name: str(value) for name, value in said.items()})
    parquet.write_table(table, tmp_path / "log.parquet")
    recordings = [
        *(read(tmp_path / f"log.{suffix}") for suffix in ("json", "h5", "parquet")),
        Recording.from_pandas(frame),
    ]
    for recording in recordings:
        about = dict(recording.provenance["about"])
        assert about.pop("tool", "DAQ") == "DAQ"
        assert about == {name: str(value) for name, value in said.items()}
        assert oil_temperature(recording) == 45.0


def test_without_time_a_rate_is_needed(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["p_A"] = P
        file["p_A"].attrs["units"] = "bar"
    recording = read(path, rate=250)
    assert np.array_equal(recording.t, np.arange(200) / 250)


@pytest.mark.slow
def test_compressed_and_packed_by_xarray(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    path = tmp_path / "log.nc"
    values = P.copy()
    values[7:9] = np.nan
    stamps = np.datetime64("2024-05-31T12:00:00", "ns") + (T * 1e9).astype("timedelta64[ns]")
    data = xarray.Dataset(
        {"p_A": ("time", values, {"units": "bar"}), "p_B": ("time", P, {"units": "psi"})}, {"time": stamps}
    )
    packed = {"dtype": "int16", "scale_factor": 1e-4, "_FillValue": -32768, "zlib": True, "add_offset": 2.5}
    data.to_netcdf(path, engine="h5netcdf", encoding={"p_A": packed, "p_B": {"zlib": True, "complevel": 9}})
    recording = read(path)
    assert recording.t == pytest.approx(T, abs=1e-9)
    assert recording.rate == 500
    assert recording.provenance["start"].startswith("2024-05-31T12:00:00")
    assert np.array_equal(np.isnan(recording["p_A"]), np.isnan(values))
    assert np.nanmax(np.abs(recording["p_A"] - values * 1e5)) <= 0.5001e-4 * 1e5
    assert recording["p_B"] == pytest.approx(P * 6894.757293168361, rel=1e-15)


def test_a_recording_changed_by_a_tool_that_adds_its_line_to_the_history(tmp_path: Path) -> None:
    from sealscope.recordings import Recording, write

    path = tmp_path / "log.nc"
    write(Recording(T, {"p_A": P}, {"p_A": "Pa"}, 500.0, {}, ("made",)), path)
    with h5py.File(path, "a") as file:
        file.attrs["history"] = "Fri May 31: ncks -v p_A\n" + file.attrs["history"]
    assert read(path).history == ("Fri May 31: ncks -v p_A", '["made"]')


def test_parquet_of_others(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    stamps = np.datetime64("2024-05-31T12:00:00", "us") + (T * 1e6).astype("timedelta64[us]")
    columns = {
        "timestamp": pyarrow.array(stamps),
        "p_A [bar]": pyarrow.array([None, *P[1:].tolist()]),
        "PG_2": pyarrow.array((1000 * P).astype(np.int16)),
        "who": pyarrow.array(["x"] * T.size),
    }
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    recording = read(tmp_path / "log.parquet", map={"p_B": "PG_2"})
    assert recording.t == pytest.approx(T, abs=1e-9)
    assert np.isnan(recording["p_A"][0])
    assert recording["p_A"][1:] == pytest.approx(P[1:] * 1e5, rel=1e-15)
    assert np.array_equal(recording["p_B"], (1000 * P).astype(np.int16))
