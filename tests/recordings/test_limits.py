"""Every size is known before it is allocated: a tiny file asks for no gigabytes."""

import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from sealscope.campaigns.plans.reader import load_plan
from sealscope.errors import UnreadableFile
from sealscope.recordings import read
from sealscope.simulation.experiment import Experiment

from ..refusals import refusal


def refused(path: Path) -> str:
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableFile) as caught:
            read(path, rate=500)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
    return str(caught.value).replace(str(path), "FILE")


def test_a_fill_value_for_samples_that_were_never_written(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("p_A", (2**27,), "f8", chunks=(2**20,), fillvalue=1.0).attrs["units"] = "Pa"
    assert path.stat().st_size < 10_000
    assert refused(path).startswith("a recording must hold its samples, got 134217728 rows of 1 in a file of ")


@pytest.mark.parametrize(("count", "kind"), [(2**23, "S10"), (2**16, "S100000")])
def test_texts_in_place_of_numbers(tmp_path: Path, count: int, kind: str) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("p_A", (count,), kind, chunks=(2**10,)).attrs["units"] = "Pa"
        file["padding"] = np.zeros(10_000)
    assert refused(path).startswith("p_A must hold numbers, or at most 4194304 texts of 400 bytes, got ")


def test_many_references_to_one_long_text(tmp_path: Path) -> None:
    """HDF5 holds texts of any length beside the data set, which refers to them: 20 000 times a megabyte in 1.3 MB."""
    path, count = tmp_path / "log.h5", 20_000
    with h5py.File(path, "w") as file:
        data = file.create_dataset("p_A", (count,), h5py.string_dtype())
        data.attrs["units"] = "Pa"
        data[0] = "1" * 1_000_000
        begin = data.id.get_offset()
    raw = bytearray(path.read_bytes())
    raw[begin : begin + 16 * count] = bytes(raw[begin : begin + 16]) * count
    path.write_bytes(raw)
    tracemalloc.start()
    try:
        with refusal("p_A", "20000", "1000000", error=UnreadableFile):
            read(path, rate=500)
        assert tracemalloc.get_traced_memory()[1] < 700e6
    finally:
        tracemalloc.stop()


def test_lists_in_place_of_numbers(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("p_A", (4,), h5py.vlen_dtype(np.float64))
        data.attrs["units"] = "Pa"
        data[0] = np.zeros(9)
    assert refused(path) == "p_A must hold texts or numbers, got lists or references (FILE)"


def test_texts_of_any_length_are_read(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["t"] = [f"2024-05-31T12:00:00.{k:03d}" for k in range(0, 900, 2)]
        file["p_A"] = np.arange(450.0)
        file["p_A"].attrs["units"] = "Pa"
    assert read(path).rate == 500.0


@pytest.mark.slow
def test_a_long_text_that_a_table_repeats(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    path = tmp_path / "log.parquet"
    texts = pyarrow.DictionaryArray.from_arrays(pyarrow.array([0] * 100_000), pyarrow.array(["1" * 1_000_000]))
    parquet.write_table(pyarrow.table({"p_A [Pa]": texts.cast(pyarrow.dictionary(pyarrow.int32(), "string"))}), path)
    schema = parquet.read_schema(path).remove_metadata()
    assert path.stat().st_size < 10_000_000
    assert "dictionary" in str(schema)
    assert refused(path).startswith("p_A [Pa] must hold numbers, got the type dictionary")
    plain = pyarrow.schema([("p_A [Pa]", pyarrow.string())])
    with parquet.ParquetWriter(path, plain, store_schema=False) as writer:
        for _ in range(4):
            writer.write_table(pyarrow.table({"p_A [Pa]": ["1" * 1_000_000] * 100}, schema=plain))
    assert path.stat().st_size < 10_000_000
    assert refused(path).startswith(
        "p_A [Pa] must hold numbers, or at most 4194304 texts of 400 bytes, got 400 of 1000000"
    )


def test_a_constant_column_that_compresses_well_is_read(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("p_A", data=np.full(2**20, 3e5), compression="gzip").attrs["units"] = "Pa"
    assert path.stat().st_size < 40_000
    assert len(read(path, rate=500)) == 2**20


def test_fill_values_are_missing_samples(tmp_path: Path) -> None:
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        file["p_A"] = np.array([1.0, -999.0, 3.0, -888.0, 5.0])
        file["p_A"].attrs["missing_value"] = [-999.0, -888.0]
        file["p_A"].attrs["units"] = "Pa"
    assert np.array_equal(read(path, rate=500)["p_A"], [1, np.nan, 3, np.nan, 5], equal_nan=True)


def test_factors_of_a_plan_do_not_multiply_without_end(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    levels = ", ".join(f'"{k} sin(4t)"' for k in range(1, 51))
    closed = ", ".join(f'"{k} %"' for k in range(50))
    mass = ", ".join(f"{0.01 + k / 1000}" for k in range(50))
    path.write_text(
        '[campaign]\nname = "big"\nduration = "6 s"\ndetectors = ["rms change"]\n'
        f"[factors]\ncommand = [{levels}]\nclosed = [{closed}]\nV_1 = [{mass}]\n[[records]]\ncount = 1\n"
    )
    with refusal("100000", "125000"):
        load_plan(path)


def test_steps_are_bounded() -> None:
    with refusal("1000000000", "2e+12", "0.001 s"):
        Experiment.of(duration=2e9, rate=0.005, error="20 Pa")
    with refusal("1000000000", "6e+12"):
        Experiment.of(duration=6.0, step=1e-12)
