"""NetCDF-4 and other HDF5 files: recordings written by Sealscope, and foreign ones with one-dimensional data sets."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import LONG_NAMES, Array
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_remarks, stated_rate
from sealscope.recordings.formats.structured.tree import format_remark
from sealscope.recordings.formats.table import (
    FORMAT_VERSION,
    RecordingFields,
    Series,
    build_fields,
    check_texts,
    parse_description,
)

_MAX_FILLS = 16  # most fill values of a data set: the CF conventions have one, a few tools write two
#: Most bytes, and most texts, that are read at a time from a data set of texts.
_CHUNK_BYTES, _CHUNK_TEXTS = 500_000_000, 4096
#: Attribute of files written by Sealscope: the version of their format.
FORMAT_ATTRIBUTE = "sealscope_format"
_CHANNEL_ORDER = {name: place for place, name in enumerate(LONG_NAMES)}


def read_netcdf(path: Path, request: Request) -> RecordingFields:
    """Read the requested one-dimensional data sets, or fields of records, of a NetCDF-4 or HDF5 file."""
    import h5py

    size = path.stat().st_size
    with h5py.File(path, "r") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if _is_series(item) else None)
        # outer groups first, channels in their usual order
        names.sort(key=lambda name: (name.count("/"), _CHANNEL_ORDER.get(name, len(_CHANNEL_ORDER)), name))
        series = []
        for name in names:
            data = file[name]
            group, _, leaf = name.rpartition("/")
            if not data.dtype.names:  # not a data set of records
                read_values = partial(_read_values, data, name, size)
                series.append(Series(group, _parse_label(leaf, data), data.size, read_values))
                continue
            series += [
                Series(name, Label.parse(field), data.size, partial(_read_field, data, name, field))
                for field in data.dtype.names
                if data.dtype[field].kind in "fiub"
            ]
        description = _read_description(file) if FORMAT_ATTRIBUTE in file.attrs else None
        remarks = collect_remarks(
            (name, format_remark(_decode_text(value) or value))
            for name, value in file.attrs.items()
            if description is None and not name.startswith("_")
        )
        kind = "NetCDF" if "_NCProperties" in file.attrs else "HDF5"
        return build_fields(series, request, kind, remarks, stated_rate(remarks), description=description, size=size)


def _read_field(data: Any, name: str, field: str) -> NDArray[Any]:
    """Read a field of `data`, the data set of records called `name`, as doubles (n,)."""
    check_internal(name, data)
    return np.asarray(data[field], dtype=np.float64)


def _is_series(item: Any) -> bool:
    """Test whether an item is a one-dimensional data set of samples, not NetCDF's placeholder of a dimension."""
    import h5py

    if not isinstance(item, h5py.Dataset) or item.ndim != 1:
        return False
    remark = item.attrs.get("NAME", b"")
    return not (isinstance(remark, bytes) and remark.startswith(b"This is a netCDF dimension but not"))


def check_internal(name: str, data: Any) -> None:
    """Raise InputError if the samples of the data set `name` are stored in other files."""
    if data.external or data.is_virtual:
        storage = "external storage" if data.external else "a virtual data set"
        raise InputError(f"{name} must have its samples in the file itself, got {storage}")


def _decode_text(value: Any) -> str | None:
    """Decode a single text: a str, UTF-8 bytes, or an array with one of these; None for any other value."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace").rstrip("\0")
    return value if isinstance(value, str) else None


def _first_number(value: Any) -> float:
    """Return the first number of an attribute, which may be an array."""
    return float(np.asarray(value).reshape(-1)[0])


def _parse_label(name: str, data: Any) -> Label:
    """Make the heading of the data set `name` from its name and its attribute `units` or `unit`."""
    unit = next(
        (_decode_text(data.attrs[key]) for key in ("units", "unit", "Units", "Unit") if key in data.attrs), None
    )
    label = Label.parse(name, unit)
    return Label(name, label.name, label.unit)  # `whole` is the exact name in the file


def _read_values(data: Any, name: str, file_size: int) -> NDArray[Any]:
    """Read the data set `name` as texts (n,), or as doubles (n,) by the scale, offset and fill values of CF files.

    Raises InputError for other types, and for samples in other files. `file_size` [bytes]: see `_read_texts`.
    """
    check_internal(name, data)
    if data.dtype.kind in "OSU":
        return np.array(_read_texts(data, name, file_size), dtype=object)
    if data.dtype.kind not in "fiub":
        raise InputError(f"{name} must hold numbers, got the type {data.dtype}")
    raw = data[...]
    values = np.array(raw, dtype=np.float64)
    missing = np.zeros(raw.shape, dtype=bool)
    for key in ("_FillValue", "missing_value"):
        if key in data.attrs:
            fills = np.asarray(data.attrs[key]).reshape(-1).astype(raw.dtype)
            missing |= np.isin(raw, fills[:_MAX_FILLS])
    for key, operation in (("scale_factor", np.multiply), ("add_offset", np.add)):
        if key in data.attrs:
            values = operation(values, _first_number(data.attrs[key]))
    values[missing] = np.nan
    return values


def _read_texts(data: Any, name: str, file_size: int) -> list[str]:
    """Read the data set `name` of texts (n,), in chunks if the lengths of the texts vary.

    Chunks bound the memory, as many cells may refer to the same text, which may be as long as the file of `file_size`
    [bytes]. Raises InputError for too many or too long texts, and for cells that are lists or references.
    """
    import h5py

    check_texts(data.size, data.dtype.itemsize, name)
    if data.dtype.kind == "O" and h5py.check_string_dtype(data.dtype) is None:
        raise InputError(f"{name} must hold texts or numbers, got lists or references")
    if data.dtype.kind != "O":
        return [_decode_text(cell) or "" for cell in data[...]]
    n_texts = min(max(_CHUNK_BYTES // file_size, 1), _CHUNK_TEXTS)
    cells: list[str] = []
    for start in range(0, data.size, n_texts):
        part = data[start : start + n_texts]
        check_texts(data.size, max(len(cell) if isinstance(cell, bytes | str) else 0 for cell in part), name)
        cells += [_decode_text(cell) or "" for cell in part]
    return cells


def _read_description(file: Any) -> dict[str, Any]:
    """Read the description of a recording that Sealscope has written: rate, provenance and history."""
    history, provenance = (_decode_text(file.attrs[name]) for name in ("history", "provenance"))
    header = {"format": _first_number(file.attrs[FORMAT_ATTRIBUTE]), "rate": _first_number(file.attrs["rate"])}
    try:
        lines = json.loads(history or "[]")
    except ValueError:  # other tools add plain lines, as the CF conventions ask
        lines = (history or "").splitlines()
    return parse_description({**header, "provenance": json.loads(provenance or "{}"), "history": lines})


def make_attributes(description: Mapping[str, Any]) -> dict[str, Any]:
    """Make the global attributes of a NetCDF file from a description; nested values become JSON texts."""
    return {
        "Conventions": "CF-1.11",
        "title": "Sealscope recording",
        FORMAT_ATTRIBUTE: FORMAT_VERSION,
        "rate": description["rate"],
        "provenance": json.dumps(description["provenance"]),
        "history": json.dumps(description["history"]),
    }


def write_netcdf(
    path: Path, values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]
) -> None:
    """Write the content of `Recording.series` as a NetCDF-4 file without loss of precision.

    The file is made in memory first, because libhdf5 aborts the process if the disk is full.
    """
    import h5netcdf

    content = BytesIO()
    with h5netcdf.File(content, "w") as file:
        file.attrs.update(make_attributes(description))
        file.dimensions = {"t": len(values["t"])}
        for name, series in values.items():
            variable = file.create_variable(name, ("t",), np.float64, data=series)
            variable.attrs["units"] = units[name]
            variable.attrs["long_name"] = LONG_NAMES[name]
    with path.open("wb") as target, content.getbuffer() as view:
        target.write(view)
