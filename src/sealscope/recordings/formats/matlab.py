"""MATLAB files of any version, with mat-io: vectors, matrices, structs, tables, timetables, timeseries, Simulink logs.

A file is walked as a tree of structs and objects (`structured.tree`).
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.errors import UnreadableFile
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import stated_rate
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.netcdf import refuse_elsewhere
from sealscope.recordings.formats.structured.tree import number_of, series_in
from sealscope.recordings.formats.table import MAX_VALUES, Choose, RawTable, Series, table_of, uniform

#: Group of the streams, by which such a file is known; what refers to them.
_STREAMS, _REFERENCES = "#sigstream#", "#refs#"


def is_matlab_4(head: bytes) -> bool:
    """Return whether a file that begins with `head` is a MATLAB 4 file: five integers, and a name that ends in zero."""
    for order in "<>" if len(head) > 20 else "":
        kind, rows, columns, imaginary, length = struct.unpack(f"{order}5i", head[:20])
        machine, zero, precision, storage = kind // 1000, kind // 100 % 10, kind // 10 % 10, kind % 10
        if (
            machine == ("<>".index(order))
            and zero == 0
            and precision <= 5
            and storage <= 2
            and min(rows, columns) >= 0
            and imaginary in (0, 1)
            and 1 < length <= 64
            and head[20 : 20 + length].find(b"\0") == length - 1
        ):
            return True
    return False


def read_matlab(path: Path, choose: Choose) -> RawTable:
    """Read the chosen series of a MATLAB file; raise MissingExtra where mat-io is absent."""
    place = str(path)
    if (table := _streamed(path, choose, place)) is not None:
        return table
    matio = library("matio", "a MATLAB file", "mat-io")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on classes that have no meaning here
        for name, (shape, *_) in matio.whosmat(path).items():
            if np.prod([float(length) for length in shape]) > MAX_VALUES:
                raise UnreadableFile(f"{name} must have at most {MAX_VALUES} values, got the shape {shape} ({place})")
        _refuse_elsewhere(path, place)
        held = matio.load_from_mat(path, add_table_attrs=True)
    values = {name: value for name, value in held.items() if not name.startswith("__")}
    series = list(series_in(values))
    scalars = {name: repr(number) for name, value in values.items() if (number := number_of(value)) is not None}
    return table_of(series, choose, "MATLAB", place, rate=stated_rate(scalars))


def _streamed(path: Path, choose: Choose, place: str) -> RawTable | None:
    """Return the table of a file whose signals Simulink has streamed; None for any other file."""
    import h5py

    if not h5py.is_hdf5(path):
        return None
    with h5py.File(path, "r") as file:
        if _STREAMS not in file:
            return None
        _refuse_elsewhere(path, place)
        return table_of(list(_streamed_series(file)), choose, "MATLAB", place)


def _refuse_elsewhere(path: Path, place: str) -> None:
    """Raise UnreadableFile where a version 7.3 file, which is HDF5, refers to other files."""
    import h5py

    if not h5py.is_hdf5(path):
        return
    with h5py.File(path, "r") as file:
        folders = [file]
        while folders:
            folder = folders.pop()
            for name in folder:
                if isinstance(folder.get(name, getlink=True), h5py.ExternalLink):
                    raise UnreadableFile(f"{name} must be in the file itself, got a link to another file ({place})")
                if isinstance(folder.get(name, getlink=True), h5py.HardLink):
                    item = folder[name]
                    if isinstance(item, h5py.Group):
                        folders.append(item)
                    elif isinstance(item, h5py.Dataset):
                        refuse_elsewhere(name, item, place)


def _streamed_series(file: Any) -> Iterator[Series]:
    """Yield the signals of doubles of an open HDF5 file that has `_STREAMS`.

    `Values/DataR2` of a signal is the number of its stream, `Values/CompressedTime` first time, step and count.
    """
    import h5py

    for item in file.get(_REFERENCES, {}).values():
        values = item.get("Values") if isinstance(item, h5py.Group) else None
        if not isinstance(values, h5py.Group) or not {"DataR2", "CompressedTime"} <= set(values):
            continue
        number, times = np.ravel(values["DataR2"][()]), np.ravel(values["CompressedTime"][()])
        stream = file.get(f"{_STREAMS}/{number[0]:.0f}") if number.size == 1 else None
        if stream is None or times.size != 3 or stream["#sampleSize#"][0] != np.dtype(np.float64).itemsize:
            continue
        data, count = stream["#data#"], int(stream["#length#"][0])
        name, unit = (_utf16(item.get(path)) for path in ("Name", "Values/DataUnits/Value"))
        clock = uniform("stream", count, float(times[1]), float(times[0]))
        yield Series("", Label.parse(name.strip("<>"), unit or None), count, partial(_doubles, data, count), clock)


def _utf16(characters: Any) -> str:
    """Return a MATLAB text, which is an array of UTF-16; empty where there is none."""
    if characters is None or characters.dtype != np.uint16:
        return ""
    return np.ravel(characters[()]).tobytes().decode("utf-16-le", errors="replace")


def _doubles(data: Any, count: int) -> Array:
    return np.frombuffer(data[: count * np.dtype(np.float64).itemsize].tobytes(), dtype=np.float64, count=count)
