"""LabVIEW measurement files (.lvm): a header, then packets of samples, each with a header of its channels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from sealscope.errors import UnreadableFile
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries
from sealscope.recordings.formats.series import Clock, Series, table_of
from sealscope.recordings.formats.table import Choose, RawTable, check_size
from sealscope.recordings.formats.text_layout import MISSING, SNIFF, encoding_of

#: What ends each header of the format.
END = "***End_of_Header***"
_DELIMITERS = {"tab": "\t", "comma": ","}


@dataclass(frozen=True)
class _Packet:
    """`head`: rows of the channels' header; `names`: of the columns; `rows`: cells; `line`: number of the first."""

    head: dict[str, list[str]]
    names: list[str]
    rows: list[list[str]]
    line: int


def is_lvm(head: bytes) -> bool:
    """Return whether a file that begins with `head` is a LabVIEW measurement file: the mark begins a line."""
    return any(f"{end}{END}".encode(encoding) in head for end in "\n\r" for encoding in ("ascii", "utf-16-le"))


def read_lvm(path: Path, choose: Choose) -> RawTable:
    """Read the chosen channels of a LabVIEW measurement file; packets of the same channels follow each other."""
    place = str(path)
    with path.open("rb") as file:
        encoding = encoding_of(file.read(SNIFF)) or "cp1252"
    with path.open(encoding=encoding, errors="replace") as text:
        lines = (line.rstrip("\r\n").lstrip("\ufeff") for line in text)
        delimiter, header, first = _file_header(lines)
        comma = header.get("decimal_separator", ".") == ","
        packets = list(_packets(lines, delimiter, first, place))
    if not packets:
        raise UnreadableFile(f"a LabVIEW measurement file must have samples, got a header and no rows ({place})")
    multiple = header.get("x_columns", "one").casefold() == "multi"
    given = header.get("x_columns", "one").casefold() != "no"
    channels = _channels(packets, multiple, given, comma, place)
    check_size(sum(len(packet.rows) for packet in packets), len(channels), place)
    about = entries((name, header[name]) for name in ("operator", "project", "description") if name in header)
    return table_of(channels, choose, "LabVIEW measurement", place, about)


def _file_header(lines: Iterator[str]) -> tuple[str, dict[str, str], int]:
    """Return the delimiter, the entries of the file's header by name in lower case, and the number of its last line."""
    entries: dict[str, str] = {}
    delimiter = "\t"
    count = 0
    for line in lines:
        count += 1
        if line.startswith(END):
            break
        name, _, value = line.replace(",", "\t", 1).partition("\t") if "\t" not in line else line.partition("\t")
        entries[name.strip().casefold()] = value.strip("\t, ") if value.strip("\t ") != "," else ","
        if name.strip().casefold() == "separator":
            delimiter = _DELIMITERS.get(value.strip().casefold(), "\t")
    return delimiter, entries, count


def _packets(lines: Iterator[str], delimiter: str, above: int, place: str) -> Iterator[_Packet]:
    """Yield the packets after the file's header of `above` lines."""
    head: dict[str, list[str]] = {}
    packet: _Packet | None = None
    in_head = True
    for number, line in enumerate(lines, start=above + 1):
        cells = [cell.strip() for cell in line.split(delimiter)]
        if line.startswith(END):
            in_head = False
            packet = None
        elif not any(cells):
            continue
        elif not in_head and packet is None:
            packet = _Packet(head, cells, [], number + 1)
        elif packet is not None and cells[0].casefold() == "channels":
            yield packet
            head, packet, in_head = {"channels": cells[1:]}, None, True
        elif packet is not None:
            packet.rows.append(cells)
            if len(packet.rows) % 2**16 == 0:
                check_size(len(packet.rows), len(packet.names), place)
        else:
            head[cells[0].casefold()] = _of_channels(cells[1:])
    if packet is not None:
        yield packet


def _of_channels(cells: list[str]) -> list[str]:
    """Return a header's cells, one a channel: where each has a time of its own, every second one is empty."""
    return cells[::2] if len(cells) > 2 and cells[2] and not any(cells[1::2]) else cells


def _channels(packets: Sequence[_Packet], multiple: bool, given: bool, comma: bool, place: str) -> list[Series]:
    """Return a series a channel, of all packets that have its columns."""
    names = packets[0].names
    if names[-1].casefold() == "comment":
        names = names[:-1]
    times = [column for column, name in enumerate(names) if name.casefold().startswith("x_value")]
    if not times:
        raise UnreadableFile(f"a LabVIEW measurement file must have a column X_Value, got {', '.join(names)} ({place})")
    columns = [column for column in range(len(names)) if column not in times]
    same = [packet for packet in packets if packet.names[: len(names)] == names]
    begins = _begins(same)
    series = []
    for index, column in enumerate(columns):
        time = max((before for before in times if before < column), default=times[0]) if multiple else times[0]
        values = [_numbers(packet, column, comma, place) for packet in same]
        # a channel with a time of its own ends in blanks where others go on
        kept = [_last(part) if multiple else part.size for part in values]
        values = [part[:count] for part, count in zip(values, kept, strict=True)]
        seconds = [
            begin
            + (_numbers(packet, time, comma, place)[:count] if given else _uniform(packet, index, count, comma, place))
            for packet, begin, count in zip(same, begins, kept, strict=True)
        ]
        joined, t = np.concatenate(values), np.concatenate(seconds)
        units = same[0].head.get("y_unit_label", [])
        unit = units[index] if index < len(units) and units[index] else None
        clock = Clock(time, partial(np.asarray, t), _moment(same[0], index))
        series.append(Series("", Label.parse(names[column], unit), t.size, partial(np.asarray, joined), clock))
    return series


def _last(values: Array) -> int:
    known = np.flatnonzero(np.isfinite(values))
    return int(known[-1]) + 1 if known.size else 0


def _begins(packets: Sequence[_Packet]) -> list[float]:
    """Return what is added to the times of each packet [s]: 0 where their first times grow, else by their stamps."""
    first = [_value(packet.head.get("x0", []), 0) for packet in packets]
    stamps = [_moment(packet, 0) for packet in packets]
    start = stamps[0]
    if start is None or None in stamps or all(after > before for before, after in pairwise(first)):
        return [0.0] * len(packets)
    return [float((moment - start) / np.timedelta64(1, "ns")) / 1e9 for moment in stamps if moment is not None]


def _value(cells: Sequence[str], index: int) -> float:
    try:
        return float(cells[index].replace(",", "."))
    except (IndexError, ValueError):
        return math.nan


def _uniform(packet: _Packet, index: int, count: int, comma: bool, place: str) -> Array:
    step, first = _value(packet.head.get("delta_x", []), index), _value(packet.head.get("x0", []), index)
    if not step > 0:
        raise UnreadableFile(f"Delta_X must be > 0 s, got {packet.head.get('delta_x', ['none'])[:4]} ({place})")
    return (0.0 if math.isnan(first) else first) + step * np.arange(count, dtype=np.float64)


def _moment(packet: _Packet, index: int) -> np.datetime64 | None:
    dates, clocks = packet.head.get("date", []), packet.head.get("time", [])
    if index >= len(dates) or index >= len(clocks):
        return None
    seconds, _, fraction = clocks[index].replace(",", ".").partition(".")
    try:
        return np.datetime64(f"{dates[index].replace('/', '-')}T{seconds}.{fraction[:9] or '0'}", "ns")
    except ValueError:
        return None


def _numbers(packet: _Packet, column: int, comma: bool, place: str) -> Array:
    values = np.full(len(packet.rows), np.nan)
    for index, row in enumerate(packet.rows):
        cell = row[column] if column < len(row) else ""
        if cell.casefold() in MISSING:
            continue
        try:
            values[index] = float(cell.replace(",", ".") if comma else cell)
        except ValueError:
            where = f"line {packet.line + index}, column {packet.names[column]}, {place}"
            raise UnreadableFile(f"a sample must be a number, got {cell[:40]!r} ({where})") from None
    return values
