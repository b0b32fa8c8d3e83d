"""NetCDF-4 and other HDF5: Sealscope's own recordings, and foreign files with one-dimensional data sets."""

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
from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.structured.tree import entry_of
from sealscope.recordings.formats.table import (
    FORMAT_VERSION,
    RecordingFields,
    Series,
    check_texts,
    parse_description,
    table_of,
)

#: Most values that stand for a missing sample: the CF conventions know one, a few tools write two.
_MOST_FILLS = 16
#: Bytes of texts of any length that are read together at most, and their number.
_READ_AT_ONCE, _MOST_AT_ONCE = 500_000_000, 4096
#: Attribute that marks a file of our own.
OWN = "sealscope_format"
_ORDER = {name: place for place, name in enumerate(LONG_NAMES)}


def read_netcdf(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted one-dimensional data sets, and fields of tables, of all groups of a NetCDF-4 or HDF5 file."""
    import h5py

    size = path.stat().st_size
    with h5py.File(path, "r") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if _is_series(item) else None)
        names.sort(key=lambda name: (name.count("/"), _ORDER.get(name, len(_ORDER)), name))
        series = []
        for name in names:
            data = file[name]
            group, _, leaf = name.rpartition("/")
            if not data.dtype.names:
                series.append(Series(group, _label(leaf, data), data.size, partial(_values, data, name, size)))
                continue
            series += [
                Series(name, Label.parse(field), data.size, partial(_field, data, name, field))
                for field in data.dtype.names
                if data.dtype[field].kind in "fiub"
            ]
        description = _description(file) if OWN in file.attrs else None
        file_attributes = (
            {} if description else {name: value for name, value in file.attrs.items() if not name.startswith("_")}
        )
        remarks = entries((name, entry_of(_text(value) or value)) for name, value in file_attributes.items())
        kind = "NetCDF" if "_NCProperties" in file.attrs else "HDF5"
        return table_of(series, request, kind, remarks, stated_rate(remarks), description=description, size=size)


def _field(data: Any, name: str, field: str) -> NDArray[Any]:
    refuse_elsewhere(name, data)
    return np.asarray(data[field], dtype=np.float64)


def _is_series(item: Any) -> bool:
    import h5py

    if not isinstance(item, h5py.Dataset) or item.ndim != 1:
        return False
    remark = item.attrs.get("NAME", b"")
    return not (isinstance(remark, bytes) and remark.startswith(b"This is a netCDF dimension but not"))


def refuse_elsewhere(name: str, data: Any) -> None:
    """Raise InputError for a data set whose samples are in other files, which nobody has given to be read."""
    if data.external or data.is_virtual:
        what = "external storage" if data.external else "a virtual data set"
        raise InputError(f"{name} must have its samples in the file itself, got {what}")


def _text(value: Any) -> str | None:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace").rstrip("\0")
    return value if isinstance(value, str) else None


def _number(value: Any) -> float:
    return float(np.asarray(value).reshape(-1)[0])


def _label(name: str, data: Any) -> Label:
    unit = next((_text(data.attrs[key]) for key in ("units", "unit", "Units", "Unit") if key in data.attrs), None)
    label = Label.parse(name.rpartition("/")[2], unit)
    return Label(name, label.name, label.unit)


def _values(data: Any, name: str, size: int) -> NDArray[Any]:
    """Read a data set as doubles, with scale, offset and fill value of the CF conventions, or as texts."""
    refuse_elsewhere(name, data)
    if data.dtype.kind in "OSU":
        return np.array(_texts(data, name, size), dtype=object)
    if data.dtype.kind not in "fiub":
        raise InputError(f"{name} must hold numbers, got the type {data.dtype}")
    raw = data[...]
    values = np.array(raw, dtype=np.float64)
    missing = np.zeros(raw.shape, dtype=bool)
    for key in ("_FillValue", "missing_value"):
        if key in data.attrs:
            fills = np.asarray(data.attrs[key]).reshape(-1).astype(raw.dtype)
            missing |= np.isin(raw, fills[:_MOST_FILLS])
    for key, change in (("scale_factor", np.multiply), ("add_offset", np.add)):
        if key in data.attrs:
            values = change(values, _number(data.attrs[key]))
    values[missing] = np.nan
    return values


def _texts(data: Any, name: str, size: int) -> list[str]:
    """Return the cells of texts, a few at a time: any number of them may refer to one text as long as the file."""
    import h5py

    check_texts(data.size, data.dtype.itemsize, name)
    if data.dtype.kind == "O" and h5py.check_string_dtype(data.dtype) is None:
        raise InputError(f"{name} must hold numbers, got lists or references")
    if data.dtype.kind != "O":
        return [_text(cell) or "" for cell in data[...]]
    at_once = min(max(_READ_AT_ONCE // size, 1), _MOST_AT_ONCE)
    cells: list[str] = []
    for start in range(0, data.size, at_once):
        part = data[start : start + at_once]
        check_texts(data.size, max(len(cell) if isinstance(cell, bytes | str) else 0 for cell in part), name)
        cells += [_text(cell) or "" for cell in part]
    return cells


def _description(file: Any) -> dict[str, Any]:
    history, provenance = (_text(file.attrs[name]) for name in ("history", "provenance"))
    header = {"format": _number(file.attrs[OWN]), "rate": _number(file.attrs["rate"])}
    try:
        lines = json.loads(history or "[]")
    except ValueError:  # another tool has added its own line, as the CF conventions ask
        lines = (history or "").splitlines()
    return parse_description({**header, "provenance": json.loads(provenance or "{}"), "history": lines})


def attributes(description: Mapping[str, Any]) -> dict[str, Any]:
    """Return the global attributes; `provenance` and `history` are JSON texts, as NetCDF has no nested values."""
    return {
        "Conventions": "CF-1.11",
        "title": "Sealscope recording",
        OWN: FORMAT_VERSION,
        "rate": description["rate"],
        "provenance": json.dumps(description["provenance"]),
        "history": json.dumps(description["history"]),
    }


def write_netcdf(
    path: Path, values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]
) -> None:
    """Write NetCDF-4, to the bit; made in memory first, as libhdf5 ends the process where a disk is full."""
    import h5netcdf

    content = BytesIO()
    with h5netcdf.File(content, "w") as file:
        file.attrs.update(attributes(description))
        file.dimensions = {"t": len(values["t"])}
        for name, series in values.items():
            variable = file.create_variable(name, ("t",), np.float64, data=series)
            variable.attrs["units"] = units[name]
            variable.attrs["long_name"] = LONG_NAMES[name]
    with path.open("wb") as target, content.getbuffer() as view:
        target.write(view)
