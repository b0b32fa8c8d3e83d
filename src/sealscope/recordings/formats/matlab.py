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

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.netcdf import refuse_elsewhere
from sealscope.recordings.formats.structured.tree import entry_of, series_in
from sealscope.recordings.formats.table import MAX_VALUES, RecordingFields, Series, table_of, uniform

#: Group of the streams, by which such a file is known; what refers to them.
_STREAMS, _REFERENCES = "#sigstream#", "#refs#"


def is_matlab_4(head: bytes) -> bool:
    """Test whether a file that begins with `head` is a MATLAB 4 file: five integers, and a name ending in zero."""
    for machine, order in enumerate("<>" if len(head) > 20 else ""):
        kind, rows, columns, imaginary, length = struct.unpack(f"{order}5i", head[:20])
        if (
            kind // 1000 == machine
            and kind // 100 % 10 == 0
            and kind // 10 % 10 <= 5  # precision
            and kind % 10 <= 2  # storage
            and min(rows, columns) >= 0
            and imaginary in (0, 1)
            and 1 < length <= 64
            and head[20 : 20 + length].find(b"\0") == length - 1
        ):
            return True
    return False


def read_matlab(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted series of a MATLAB file; raise MissingExtra where mat-io is absent."""
    import h5py

    size = path.stat().st_size
    if h5py.is_hdf5(path):  # version 7.3
        with h5py.File(path, "r") as file:
            _refuse_elsewhere(file)
            if _STREAMS in file:
                return table_of(list(_streamed_series(file)), request, "MATLAB", size=size)
    matio = library("matio", "a MATLAB file", "mat-io")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on classes that have no meaning here
        for name, (shape, *_) in matio.whosmat(path).items():
            if np.prod([float(length) for length in shape]) > MAX_VALUES:
                raise InputError(f"{name} must have at most {MAX_VALUES} values, got the shape {shape}")
        held = matio.load_from_mat(path, add_table_attrs=True)
    values = {name: value for name, value in held.items() if not name.startswith("__")}
    remarks = entries((name, entry_of(value)) for name, value in values.items())
    return table_of(list(series_in(values)), request, "MATLAB", remarks, stated_rate(remarks), size=size)


def _refuse_elsewhere(file: Any) -> None:
    """Raise InputError where an HDF5 file refers to other files."""
    import h5py

    folders = [file]
    while folders:
        folder = folders.pop()
        for name in folder:
            link = folder.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise InputError(f"{name} must be in the file itself, got a link to another file")
            item = folder[name] if isinstance(link, h5py.HardLink) else None
            if isinstance(item, h5py.Group):
                folders.append(item)
            elif isinstance(item, h5py.Dataset):
                refuse_elsewhere(name, item)


def _streamed_series(file: Any) -> Iterator[Series]:
    """Yield the signals of doubles; `CompressedTime` holds first time, step and count, `DataR2` the stream's number."""
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
