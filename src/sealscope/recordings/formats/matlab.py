"""MATLAB files of any version, with mat-io: vectors, matrices, structs, tables, timetables, timeseries, Simulink logs.

A file is read as a tree of structs and objects (`structured.tree`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_remarks, stated_rate
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.formats.netcdf import check_internal
from sealscope.recordings.formats.structured.tree import format_remark, iter_series
from sealscope.recordings.formats.table import MAX_VALUES, RecordingFields, Series, build_fields, uniform_clock

#: HDF5 groups of a file of signal streams: the streams, and the references to them.
_STREAMS, _REFERENCES = "#sigstream#", "#refs#"


def is_matlab_4(head: bytes) -> bool:
    """Test whether a file begins with five integers and a variable's name, ended by a zero byte, as in MATLAB 4."""
    for byte_order, order_sign in enumerate("<>" if len(head) > 20 else ""):  # little and big endian
        type_code, rows, columns, imaginary, name_length = struct.unpack(f"{order_sign}5i", head[:20])
        if (  # the decimal digits of the type code
            type_code // 1000 == byte_order
            and type_code // 100 % 10 == 0  # reserved
            and type_code // 10 % 10 <= 5  # precision
            and type_code % 10 <= 2  # storage
            and min(rows, columns) >= 0
            and imaginary in (0, 1)
            and 1 < name_length <= 64
            and head[20 : 20 + name_length].find(b"\0") == name_length - 1
        ):
            return True
    return False


def read_matlab(path: Path, request: Request) -> RecordingFields:
    """Read the requested columns of a MATLAB file to the fields of a recording; raise MissingExtra without mat-io.

    A file of signal streams (`_read_streams`) needs no mat-io. Raises InputError if a variable has more than
    `MAX_VALUES` values, or if the file refers to other files.
    """
    import h5py

    size = path.stat().st_size
    if h5py.is_hdf5(path):  # version 7.3
        with h5py.File(path, "r") as file:
            _check_links(file)
            if _STREAMS in file:
                return build_fields(list(_read_streams(file)), request, "MATLAB", size=size)
    matio = import_library("matio", "a MATLAB file", "mat-io")
    for name, (shape, *_) in matio.whosmat(path).items():
        if np.prod([float(length) for length in shape]) > MAX_VALUES:
            raise InputError(f"{name} must have at most {MAX_VALUES} values, got the shape {shape}")
    variables = matio.load_from_mat(path, add_table_attrs=True)
    values = {name: value for name, value in variables.items() if not name.startswith("__")}
    remarks = collect_remarks((name, format_remark(value)) for name, value in values.items())
    return build_fields(list(iter_series(values)), request, "MATLAB", remarks, stated_rate(remarks), size=size)


def _check_links(file: Any) -> None:
    """Raise InputError if an HDF5 file refers to other files."""
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
                check_internal(name, item)


def _read_streams(file: Any) -> Iterator[Series]:
    """Yield the signals of an open HDF5 file that stores the samples of each signal as a stream of doubles.

    Each signal has `CompressedTime` (first time, step, number of samples) and `DataR2` (the number of its stream).
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
        name, unit = (_decode_utf16(item.get(path)) for path in ("Name", "Values/DataUnits/Value"))
        clock = uniform_clock("stream", count, step=float(times[1]), first=float(times[0]))
        yield Series("", Label.parse(name.strip("<>"), unit or None), count, partial(_read_doubles, data, count), clock)


def _decode_utf16(characters: Any) -> str:
    """Decode a MATLAB text, an array of UTF-16 code units; empty for None and for any other array."""
    if characters is None or characters.dtype != np.uint16:
        return ""
    return np.ravel(characters[()]).tobytes().decode("utf-16-le", errors="replace")


def _read_doubles(data: Any, count: int) -> Array:
    """Read the first `count` doubles (count,) from `data`, an HDF5 data set of bytes."""
    return np.frombuffer(data[: count * np.dtype(np.float64).itemsize].tobytes(), dtype=np.float64, count=count)
