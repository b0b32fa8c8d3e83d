"""A table of named columns, whatever file it comes from, and the description that Sealscope writes beside it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, Array
from sealscope.recordings.formats.columns import ColumnMap
from sealscope.recordings.formats.headings.preamble import exported_from
from sealscope.recordings.formats.headings.split_time import joined_time
from sealscope.recordings.timebase import falling, stamps, time_base
from sealscope.units import to_si

#: Most values that one file may hold in the columns used: 2 GiB of doubles, 16 hours of 9 channels at 500 Hz.
MAX_VALUES = 2**28
#: A table up to this many bytes may be a fill value alone; a larger one at most this many times its file.
_SMALL, _EXPANSION = 2**26, 4096
_MOST_TEXTS, _WIDEST_TEXT, _MOST_TEXT = 2**22, 400, 2**29
FORMAT_VERSION = 1
#: Share of a column's cells that may hold a word, as loggers write where the input overflows.
MOST_WORDS = 0.01
#: Decides from a table's labels, and the rate that the file states where it does, which columns are read.
Choose = Callable[..., ColumnMap]


class RecordingFields(NamedTuple):
    """What a recording is made of, in the order of its arguments."""

    t: Array
    channels: dict[str, Array]
    units: dict[str, str]
    rate: float
    provenance: dict[str, Any]
    history: tuple[str, ...]


@dataclass(frozen=True)
class RawTable:
    """The chosen columns of a table, in the units of the table.

    `kind`: the format, in words; `columns`: the columns of `choice.columns`, each (n,) doubles, the time doubles or
    datetime64; `description`: what Sealscope itself wrote beside the numbers, or None; `notes`: lines for the history;
    `about`: what the file says of the recording beside the samples.
    """

    kind: str
    choice: ColumnMap
    columns: Sequence[NDArray[Any]]
    description: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict)

    def samples(self, source: Mapping[str, Any], *, rate: float | None, infer_rate: bool) -> RecordingFields:
        """Convert to SI. `source`: begins the provenance of a foreign table; `rate` [Hz]: where there is no time.

        `infer_rate`: from the time, although the description has one. Raises InputError.
        """
        choice, own = self.choice, self.description
        count = len(self.columns[0])
        if count == 0:
            raise InputError("a recording must have samples, got a header and no rows")
        notes = (*self.notes, *choice.notes)
        read = self.columns
        if choice.parts:
            read, more = self._joined()
            notes += more
        if choice.time is not None and choice.time == choice.date:
            self._check_clock(read[-1])
        if choice.time_label is not None and own is None and falling(read[-1]):
            read = [cells[::-1] for cells in read]
            notes += ("rows begin with the last sample: taken in the order of time",)
        values = {column: cells for (column, time), cells in zip(choice.columns, read, strict=True) if not time}
        channels, units = {}, {}
        for name, made in choice.channels.items():
            unit = made.unit or COUNTS
            units[name] = COUNTS if unit == COUNTS else CHANNEL_UNITS[name]
            channels[name] = to_si(made.values(values), unit, units[name], name=name)
            if channels[name] is not values[made.column]:
                channels[name].setflags(write=False)  # made here: a recording takes it as it is
        start: dict[str, Any] = {}
        if choice.time_label is None:
            rate = choice.rate if rate is None else rate
            assert rate is not None
            t = np.arange(count) / rate
        elif own is not None and not infer_rate:
            t, rate = self.columns[-1], own["rate"]
        else:
            label = choice.time_label
            t, rate, start, more = time_base(read[-1], label.unit, label.whole, choice.rate)
            notes += more
            if not start and (begin := exported_from(self.about)) is not None:
                start = {"start": str(begin)}
        if own is not None:
            return RecordingFields(t, channels, units, rate, own["provenance"], (*own["history"], *notes))
        about: dict[str, Any] = {"about": dict(self.about)} if self.about else {}
        if choice.names:
            about["columns"] = dict(choice.names)
        if choice.unused:
            about["unused"] = list(choice.unused)
        return RecordingFields(t, channels, units, rate, {**source, "format": self.kind, **start, **about}, notes)

    def _check_clock(self, time: NDArray[Any]) -> None:
        """Raise InputError where a column of dates, taken for the time, holds none with a time of the day."""
        stamps = time[~np.isnat(time)] if time.dtype.kind == "M" else time[:0]
        if (stamps == stamps.astype("datetime64[D]").astype(stamps.dtype)).all():
            whole = "" if self.choice.time_label is None else self.choice.time_label.whole
            raise InputError(
                "a recording must have a time column such as t [s] or be given a rate, "
                f"got dates alone in column {whole}"
            )

    def _joined(self) -> tuple[Sequence[NDArray[Any]], tuple[str, ...]]:
        """Return the columns with the time that several of them hold, and a line for the history."""
        choice = self.choice
        assert choice.time is not None and choice.time_label is not None
        read = dict(zip((column for column, _ in choice.columns), self.columns, strict=True))
        parts = {part: np.asarray(read[column], dtype=np.float64) for part, column in choice.parts.items()}
        time = joined_time(self.columns[-1], parts, choice.time_label.unit)
        whole = choice.time_label.whole
        if time is not None:
            return [*self.columns[:-1], time], (f"time joined from {whole} and its parts: {', '.join(parts)}",)
        if choice.time == choice.parts.get("hour"):
            raise InputError(
                f"time must be whole hours below 24, whole minutes and seconds below 60, got others in columns {whole}"
            )
        return self.columns, (f"{', '.join(parts)} beside column {whole} not used: no parts of its seconds",)


def check_size(rows: int, columns: int, place: str) -> None:
    """Raise UnreadableFile where a file holds more than `MAX_VALUES` in the columns used.

    Or more than `_EXPANSION` times its own size: no logger's samples compress so well, but a fill value can stand for
    any number of them. `place`: the file's path.
    """
    if rows * columns > MAX_VALUES:
        raise UnreadableFile(
            f"a recording must have at most {MAX_VALUES} values in the columns used (2 GiB), "
            f"got {rows} rows of {columns}: cut it into parts ({place})"
        )
    if 8 * rows * columns > max(_SMALL, _EXPANSION * Path(place).stat().st_size):
        raise UnreadableFile(
            f"a recording must hold its samples, got {rows} rows of {columns} in a file of "
            f"{Path(place).stat().st_size} bytes ({place})"
        )


def check_texts(cells: int, width: int, name: str, place: str) -> None:
    """Raise UnreadableFile where a column of texts has more than `_MOST_TEXTS` cells, or cells wider than a number.

    Or, where both are large, more than half a gigabyte together.
    """
    if cells > _MOST_TEXTS or width > _WIDEST_TEXT or cells * width > _MOST_TEXT:
        raise UnreadableFile(
            f"{name} must hold numbers, or at most {_MOST_TEXTS} texts of {_WIDEST_TEXT} bytes, got {cells} of {width} "
            f"({place})"
        )


def from_text(cells: Sequence[str], time: bool, name: str, place: str) -> NDArray[Any]:
    """Convert cells of text to doubles, or to stamps for the `time`; an empty cell is missing, and a few words are."""
    try:
        if time:
            return stamps(cells)
        values = np.array([_number(cell) for cell in cells])
    except ValueError as error:
        raise UnreadableFile(f"{name} must hold numbers, got text ({place})") from error
    words = sum(1 for cell, value in zip(cells, values, strict=True) if cell and np.isnan(value))
    if words > MOST_WORDS * len(cells):
        raise UnreadableFile(f"{name} must hold numbers, got text ({place})")
    return values


def _number(cell: str) -> float:
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        return np.nan


def description_of(rate: float, provenance: Mapping[str, Any], history: Sequence[str]) -> dict[str, Any]:
    """Return rate, provenance and history as JSON values; raise InputError where a value is none of JSON's."""
    description = {
        "format": FORMAT_VERSION,
        "rate": rate,
        "provenance": dict(provenance),
        "history": list(history),
    }
    try:
        return json.loads(json.dumps(description, default=_plain))  # type: ignore[no-any-return]
    except (TypeError, ValueError) as error:
        raise InputError(f"provenance must hold JSON values only: {error}") from None


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"got a {type(value).__name__}")


def parse_description(text: str | bytes, place: str) -> dict[str, Any]:
    """Parse the JSON text of a `description_of`; raise UnreadableFile where it is damaged."""
    try:
        parsed = json.loads(text)
        description: dict[str, Any] = {
            "rate": float(parsed["rate"]),
            "provenance": dict(parsed["provenance"]),
            "history": [str(line) for line in parsed["history"]],
            "format": int(parsed["format"]),
        }
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise UnreadableFile(f"the recording's description must be whole, got damaged JSON ({place})") from error
    version, rate = description["format"], description["rate"]
    if version > FORMAT_VERSION:
        raise UnreadableFile(f"format must be at most {FORMAT_VERSION}, got {version}: newer software ({place})")
    if not (np.isfinite(rate) and rate > 0):
        raise UnreadableFile(f"rate must be > 0 Hz, got {rate} ({place})")
    return description
