"""From a table of named columns, whatever file it came from, to a Recording."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats.columns import Label, plan
from sealscope.recordings.recording import CHANNEL_UNITS, COUNTS, Array, Recording
from sealscope.recordings.timebase import time_base
from sealscope.units import to_si

#: Most values that one file may hold in the columns used: 2 GiB of doubles, 16 hours of 9 channels at 500 Hz.
MAX_VALUES = 2**28
FORMAT_VERSION = 1


@dataclass(frozen=True)
class Table:
    """Named columns of a file that is open.

    `fetch(columns, time)` gives the channels' columns as doubles, in order, and the time column, if asked for, as
    doubles or datetime64. `own`: what Sealscope itself wrote beside the numbers, or None.
    """

    place: str
    kind: str
    labels: Sequence[Label]
    fetch: Callable[[Sequence[int], int | None], tuple[list[Array], NDArray[Any] | None]]
    own: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()


def check_size(rows: int, columns: int, place: str) -> None:
    """Raises UnreadableFile where a file holds more than `MAX_VALUES` in the columns used."""
    if rows * columns > MAX_VALUES:
        raise UnreadableFile(
            f"a recording must have at most {MAX_VALUES} values in the columns used (2 GiB), "
            f"got {rows} rows of {columns}: cut it into parts ({place})"
        )


def own_words(recording: Recording) -> dict[str, Any]:
    """Rate, provenance and history as JSON values; raises InputError where a value is none of JSON's."""
    words = {
        "format": FORMAT_VERSION,
        "rate": recording.rate,
        "provenance": dict(recording.provenance),
        "history": list(recording.history),
    }
    try:
        return json.loads(json.dumps(words, default=_plain))  # type: ignore[no-any-return]
    except (TypeError, ValueError) as error:
        raise InputError(f"provenance must hold JSON values only: {error}") from None


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"got a {type(value).__name__}")


def read_own_words(text: str | bytes, place: str) -> dict[str, Any]:
    """The inverse of `own_words` from JSON text; raises UnreadableFile where it is damaged."""
    try:
        words = json.loads(text)
        own: dict[str, Any] = {
            "rate": float(words["rate"]),
            "provenance": dict(words["provenance"]),
            "history": [str(line) for line in words["history"]],
            "format": int(words["format"]),
        }
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise UnreadableFile(f"the recording's description must be whole, got damaged JSON ({place})") from error
    if own["format"] > FORMAT_VERSION:
        raise UnreadableFile(f"format must be at most {FORMAT_VERSION}, got {own['format']}: newer software ({place})")
    if not (np.isfinite(own["rate"]) and own["rate"] > 0):
        raise UnreadableFile(f"rate must be > 0 Hz, got {own['rate']} ({place})")
    return own


def check_writable(recording: Recording) -> None:
    """Raises InputError where a recording could not be read back as it is."""
    if len(recording) == 0 or not recording.channels:
        raise InputError("a recording to write must hold at least one sample of one channel")
    for name, unit in recording.units.items():
        if name not in CHANNEL_UNITS:
            raise InputError(f"a channel to write must be one of {', '.join(CHANNEL_UNITS)}, got {name}")
        if unit not in (CHANNEL_UNITS[name], COUNTS):
            raise InputError(f"channel {name} must be in {CHANNEL_UNITS[name]} or {COUNTS} to be written, got {unit}")


def recording_of(table: Table, channel_map: Mapping[str, str], rate: float | None) -> Recording:
    """The recording that `table` holds; raises UnreadableFile."""
    chosen = plan(table.labels, channel_map, rate, table.place)
    columns = chosen.columns
    values, time_values = table.fetch(columns, chosen.time)
    count = len(values[0])
    if count == 0:
        raise UnreadableFile(f"a recording must have samples, got a header and no rows ({table.place})")
    at = {column: i for i, column in enumerate(columns)}
    channels, units = {}, {}
    for name, (column, unit) in chosen.channels.items():
        si_unit = COUNTS if unit == COUNTS else CHANNEL_UNITS[name]
        channels[name] = to_si(values[at[column]], unit, si_unit, name=name, place=table.place)
        units[name] = si_unit
    notes = [*table.notes, *chosen.notes]
    start: dict[str, Any] = {}
    if chosen.time is None or time_values is None:
        assert rate is not None
        t = np.arange(count) / rate
    elif table.own is not None and not channel_map:
        t, rate = time_values, table.own["rate"]
    else:
        name = table.labels[chosen.time].whole
        t, rate, start, more = time_base(time_values, chosen.time_unit, name, table.place)
        notes += more
    if table.own is not None:
        return Recording(t, channels, units, rate, table.own["provenance"], (*table.own["history"], *notes))
    provenance = {"file": Path(table.place).name, "format": table.kind, **start}
    return Recording(t, channels, units, rate, provenance, tuple(notes))
