"""What is written reads back as the same recording, to the bit, in every format; nothing half-written stays."""

import copy
import os
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sealscope.errors import InputError, MissingExtra
from sealscope.recordings import CHANNEL_UNITS, COUNTS, Recording, read, write
from sealscope.recordings.motion import find_cycle
from sealscope.recordings.subprocesses import CrashedSubprocessError, run_in_subprocess

from ..refusals import refusal

FORMATS = ["nc", "csv", "tsv", "parquet"]
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    count = draw(st.integers(1, 40))
    numbers = hnp.arrays(np.float64, count, elements=st.floats(allow_nan=True, allow_infinity=False, width=64))
    names = draw(st.lists(st.sampled_from(list(CHANNEL_UNITS)), min_size=1, unique=True))
    return Recording(
        t=draw(hnp.arrays(np.float64, count, elements=st.floats(allow_nan=False, allow_infinity=False))),
        channels={name: draw(numbers) for name in names},
        units={name: draw(st.sampled_from([CHANNEL_UNITS[name], COUNTS])) for name in names},
        rate=draw(st.floats(1e-3, 1e9)),
        provenance=draw(st.dictionaries(st.text(), json_values, max_size=4)),
        history=tuple(draw(st.lists(st.text(), max_size=3))),
    )


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and bool(np.all((a.view(np.int64) == b.view(np.int64)) | (np.isnan(a) & np.isnan(b))))


def assert_same(a: Recording, b: Recording) -> None:
    assert set(a.channels) == set(b.channels)
    assert same_bits(a.t, b.t)
    for name in a.channels:
        assert same_bits(a[name], b[name]), name
    assert dict(a.units) == dict(b.units)
    assert a.rate == b.rate
    assert dict(a.provenance) == dict(b.provenance)
    assert a.history == b.history


def test_marks_of_other_formats_within_our_own_are_text(tmp_path: Path) -> None:
    made = Recording([0.0, 0.1], {"u": [0.0, 1.0]}, {"u": "V"}, 10.0, history=("***End_of_Header***", "TDSm", "MDF"))
    write(made, tmp_path / "log.csv")
    assert_same(read(tmp_path / "log.csv"), made)


@pytest.mark.parametrize("suffix", FORMATS)
@settings(deadline=None, max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(recording=recordings())
def test_exact(tmp_path: Path, suffix: str, recording: Recording) -> None:
    path = tmp_path / f"log.{suffix}"
    write(recording, path)
    assert_same(read(path), recording)


def plain(count: int = 600) -> Recording:
    t = np.arange(count) / 500
    p = 3e5 + 1e4 * np.sin(4 * t)
    return Recording(t, {"p_A": p, "x": 0.01 * np.cos(4 * t)}, CHANNEL_UNITS, 500.0, {"by": "test"}, ("made",))


def test_a_recording_is_pickled_and_copied_whole() -> None:
    made = replace(plain(), bridged=np.arange(600) < 3)
    find_cycle(made)  # what is known of it by then is not part of it
    for other in (pickle.loads(pickle.dumps(made)), copy.deepcopy(made)):
        assert_same(other, made)
        assert np.array_equal(other.bridged, made.bridged)
        assert not any(values.flags.writeable for values in (other.t, other.bridged, *other.channels.values()))
        assert find_cycle(other) == find_cycle(made)


@pytest.mark.parametrize("suffix", ["nc4", "h5", "hdf5", "txt", "pq"])
def test_other_suffixes_of_these_formats(tmp_path: Path, suffix: str) -> None:
    write(plain(), tmp_path / f"log.{suffix}")
    assert_same(read(tmp_path / f"log.{suffix}"), plain())


def test_long_provenance(tmp_path: Path) -> None:
    long = Recording(
        np.arange(3) / 5, {"p_A": np.ones(3)}, {"p_A": "Pa"}, 5.0, {"table": list(range(60_000))}, ("x" * 9,)
    )
    for suffix in ("csv", "nc", "parquet"):
        write(long, tmp_path / f"log.{suffix}")
        assert_same(read(tmp_path / f"log.{suffix}"), long)


def test_numpy_values_in_provenance_become_plain_ones(tmp_path: Path) -> None:
    recording = Recording([0, 1], {"x": [1, 2]}, {"x": "m"}, 1.0, {"seed": np.int64(3), "gain": np.array([1.5])})
    write(recording, tmp_path / "a.nc")
    assert dict(read(tmp_path / "a.nc").provenance) == {"seed": 3, "gain": [1.5]}


@pytest.mark.parametrize("suffix", ["nc", "csv", "parquet"])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"log.{suffix}"
    write(plain(), path)
    before = path.read_bytes()

    class DiskFullError(OSError):
        pass

    def fail(*args: object, **kwargs: object) -> None:
        Path(str(args[0])).write_bytes(b"half a rec")
        raise DiskFullError(28, "No space left on device")

    module = {"nc": "netcdf", "csv": "text"}.get(suffix, suffix)
    monkeypatch.setattr(f"sealscope.recordings.formats.{module}.write_{module}", fail)
    with pytest.raises(InputError, match="No space left on device"):
        write(plain(), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("recording", "name", "words"),
    [
        (plain(), "log.xlsx", ".nc, .csv"),
        (plain(), "log", ".nc, .csv"),
        (plain(), "absent/log.csv", "folder"),
        (plain(0), "log.nc", "sample"),
        (Recording([0, 1], {"load": [1, 2]}, {"load": "N"}, 1.0), "log.csv", "channel"),
        (Recording([0, 1], {"p_A": [1, 2]}, {"p_A": "psi"}, 1.0), "log.csv", "Pa, count"),
        (Recording([0, 1], {"p_A": [1, np.inf]}, {"p_A": "Pa"}, 1.0), "log.csv", "finite"),
        (Recording([0, 1], {"p_A": [1, 2]}, {"p_A": "Pa"}, 1.0, {"o": object()}), "log.nc", "JSON"),
    ],
)
def test_refused_before_anything_is_written(tmp_path: Path, recording: Recording, name: str, words: str) -> None:
    with refusal(*words.split(", ")):
        write(recording, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_parquet_without_pyarrow_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with refusal("sealscope[io]", error=MissingExtra):
        write(plain(), tmp_path / "log.parquet")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_foreign_parquet_without_pyarrow_names_the_extra(tmp_path: Path) -> None:
    (tmp_path / "foreign.parquet").write_bytes(b"PAR1 and more")
    run_in_subprocess(exec, "__import__('sys').modules['pyarrow'] = None", limit=10.0)
    try:
        with refusal("sealscope[io]", error=MissingExtra):
            read(tmp_path / "foreign.parquet")
    finally:
        with pytest.raises(CrashedSubprocessError):
            run_in_subprocess(os.abort, limit=10.0)
    assert [entry.name for entry in tmp_path.iterdir()] == ["foreign.parquet"]
