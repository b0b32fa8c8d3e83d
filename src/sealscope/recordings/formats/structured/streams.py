"""Signals that Simulink streamed into a MATLAB 7.3 file: names with numbers of streams of bytes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.table import Series, uniform

#: Group of the streams, by which such a file is known; what refers to them.
STREAMS, _REFERENCES = "#sigstream#", "#refs#"


def streamed_series(file: Any) -> Iterator[Series]:
    """Yield the signals of doubles of an open HDF5 file that has `STREAMS`.

    `Values/DataR2` of a signal is the number of its stream, `Values/CompressedTime` first time, step and count.
    """
    import h5py

    for item in file.get(_REFERENCES, {}).values():
        values = item.get("Values") if isinstance(item, h5py.Group) else None
        if not isinstance(values, h5py.Group) or not {"DataR2", "CompressedTime"} <= set(values):
            continue
        number, times = np.ravel(values["DataR2"][()]), np.ravel(values["CompressedTime"][()])
        stream = file.get(f"{STREAMS}/{number[0]:.0f}") if number.size == 1 else None
        if stream is None or times.size != 3 or stream["#sampleSize#"][0] != np.dtype(np.float64).itemsize:
            continue
        data, count = stream["#data#"], int(stream["#length#"][0])
        name, unit = (_text(item.get(path)) for path in ("Name", "Values/DataUnits/Value"))
        clock = uniform("stream", count, float(times[1]), float(times[0]))
        yield Series("", Label.parse(name.strip("<>"), unit or None), count, partial(_samples, data, count), clock)


def _text(characters: Any) -> str:
    """Return a MATLAB text, which is an array of UTF-16; empty where there is none."""
    if characters is None or characters.dtype != np.uint16:
        return ""
    return np.ravel(characters[()]).tobytes().decode("utf-16-le", errors="replace")


def _samples(data: Any, count: int) -> Array:
    return np.frombuffer(data[: count * np.dtype(np.float64).itemsize].tobytes(), dtype=np.float64, count=count)
