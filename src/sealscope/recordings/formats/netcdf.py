"""NetCDF-4 and other HDF5: Sealscope's own recordings, and foreign files with one-dimensional data sets."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import UnreadableFile
from sealscope.recordings.formats.columns import Label
from sealscope.recordings.formats.table import FORMAT_VERSION, Table, check_size, own_words, read_own_words
from sealscope.recordings.recording import Array, Recording
from sealscope.recordings.timebase import stamps

_OWN = "sealscope_format"
_LONG_NAMES = {
    "t": "time",
    "u": "command",
    "omega": "motor speed",
    "theta": "motor angle",
    "x": "piston position",
    "p_1": "pressure at pump port 1",
    "p_2": "pressure at pump port 2",
    "p_A": "pressure in chamber A",
    "p_B": "pressure in chamber B",
    "q_leak": "leakage flow",
}
_ORDER = {name: place for place, name in enumerate(_LONG_NAMES)}


@contextmanager
def open_hdf5(path: Path) -> Iterator[Table]:
    """The one-dimensional data sets of a NetCDF-4 or HDF5 file, in all its groups; raises UnreadableFile."""
    import h5py

    place = str(path)
    try:
        with h5py.File(path, "r") as file:
            names: list[str] = []
            file.visititems(lambda name, item: names.append(name) if _is_series(item) else None)
            names.sort(key=lambda name: (name.count("/"), _ORDER.get(name, len(_ORDER)), name))
            labels = [_label(name, file[name]) for name in names]

            def fetch(columns: Sequence[int], time: int | None) -> tuple[list[Array], NDArray[Any] | None]:
                wanted = [*columns, time] if time is not None else list(columns)
                _check_lengths([(labels[i].whole, file[names[i]].shape[0]) for i in reversed(wanted)], place)
                check_size(file[names[wanted[0]]].shape[0], len(wanted), place)
                values = [_values(file[names[i]], labels[i].whole, place) for i in columns]
                return values, None if time is None else _values(file[names[time]], labels[time].whole, place, True)

            own = _own(file, place)
            yield Table(place, "NetCDF" if "_NCProperties" in file.attrs else "HDF5", labels, fetch, own)
    except (OSError, RuntimeError, KeyError) as error:
        text = " ".join(str(error).split())[:160]
        raise UnreadableFile(f"a NetCDF or HDF5 file must be whole, got: {text} ({place})") from error


def _is_series(item: Any) -> bool:
    import h5py

    if not isinstance(item, h5py.Dataset) or item.ndim != 1:
        return False
    remark = item.attrs.get("NAME", b"")
    return not (isinstance(remark, bytes) and remark.startswith(b"This is a netCDF dimension but not"))


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


def _check_lengths(lengths: Sequence[tuple[str, int]], place: str) -> None:
    first, count = lengths[0]
    for name, length in lengths[1:]:
        if length != count:
            raise UnreadableFile(f"{name} must have as many samples as {first} ({count}), got {length} ({place})")


def _values(data: Any, name: str, place: str, time: bool = False) -> NDArray[Any]:
    """A data set as doubles (or, for time, stamps), with the scale, offset and fill value of the CF conventions."""
    if data.dtype.kind in "OSU":
        cells = [_text(cell) or "" for cell in data[...]]
        try:
            return stamps(cells) if time else np.array([float(cell) for cell in cells])
        except ValueError as error:
            raise UnreadableFile(f"{name} must hold numbers, got text ({place})") from error
    if data.dtype.kind not in "fiub":
        raise UnreadableFile(f"{name} must hold numbers, got the type {data.dtype} ({place})")
    raw = data[...]
    values = np.asarray(raw, dtype=np.float64)
    missing = np.zeros(raw.shape, dtype=bool)
    for key in ("_FillValue", "missing_value"):
        if key in data.attrs:
            missing |= np.isin(raw, np.asarray(data.attrs[key]).reshape(-1).astype(raw.dtype))
    for key, change in (("scale_factor", np.multiply), ("add_offset", np.add)):
        if key in data.attrs:
            values = change(values, _number(data.attrs[key]))
    if missing.any():
        values = np.where(missing, np.nan, values)
    return values


def _own(file: Any, place: str) -> dict[str, Any] | None:
    if _OWN not in file.attrs:
        return None
    try:
        history = _text(file.attrs["history"]) or "[]"
        try:
            lines = json.loads(history)
        except ValueError:  # another tool has added its own line, as the CF conventions ask
            lines = history.splitlines()
        words = {
            "format": int(_number(file.attrs[_OWN])),
            "rate": _number(file.attrs["rate"]),
            "provenance": json.loads(_text(file.attrs["provenance"]) or "{}"),
            "history": lines,
        }
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise UnreadableFile(f"the recording's description must be whole, got damaged attributes ({place})") from error
    return read_own_words(json.dumps(words), place)


def write_netcdf(recording: Recording, path: Path) -> None:
    """Write NetCDF-4 (an HDF5 file): dimension `t`, one variable a channel with `units`; doubles, to the bit.

    `rate` is an attribute; `provenance` and `history` are one JSON text each, as NetCDF has no nested values.
    """
    import h5netcdf

    words = own_words(recording)
    with h5netcdf.File(path, "w") as file:
        file.attrs["Conventions"] = "CF-1.11"
        file.attrs["title"] = "Sealscope recording"
        file.attrs[_OWN] = FORMAT_VERSION
        file.attrs["rate"] = recording.rate
        file.attrs["provenance"] = json.dumps(words["provenance"])
        file.attrs["history"] = json.dumps(words["history"])
        file.dimensions = {"t": len(recording)}
        units = {"t": "s", **recording.units}
        for name, values in {"t": recording.t, **recording.channels}.items():
            variable = file.create_variable(name, ("t",), np.float64, data=values)
            variable.attrs["units"] = units[name]
            variable.attrs["long_name"] = _LONG_NAMES[name]
