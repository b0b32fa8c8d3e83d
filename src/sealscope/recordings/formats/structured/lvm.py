"""LabVIEW measurement files (.lvm): a header, then packets of samples, each with a header of its channels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.cells import parse_numbers
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_remarks
from sealscope.recordings.formats.table import Clock, RecordingFields, Series, build_fields, check_size
from sealscope.recordings.formats.text_layout import SNIFF, detect_encoding
from sealscope.recordings.formats.times.timebase import ambiguous_dates, is_day_first, parse_stamps, timedelta_seconds

#: Line that ends each header.
_END_MARK = "***End_of_Header***"


@dataclass
class _Packet:
    """A block of samples in a LabVIEW measurement file, with a header of its own."""

    head: Mapping[str, list[str]]  # rows of the header, name -> an entry for each channel
    names: list[str]  # of the columns
    rows: list[Array] = field(default_factory=list)  # samples of each row, NaN where it is shorter than others

    def entry(self, name: str, index: int) -> str:
        """Return the entry of channel `index` in the row `name` of the header; empty if there is none."""
        cells = self.head.get(name, [])
        return cells[index] if index < len(cells) else ""

    def number(self, name: str, index: int) -> float:
        """Convert the entry of channel `index` in the row `name` of the header; NaN if it is not a number."""
        try:
            return float(self.entry(name, index).replace(",", "."))
        except ValueError:
            return np.nan

    def moment(self, index: int, day_first: bool) -> np.datetime64 | None:
        """Return the time stamp of the first sample of channel `index`; None if the header does not state it."""
        day, time = self.entry("date", index), self.entry("time", index).replace(",", ".")
        seconds, _, fraction = time.partition(".")  # the fraction is cut to 9 digits, i.e. nanoseconds
        try:
            return parse_stamps([f"{day} {seconds}.{fraction[:9] or '0'}"], day_first)[0] if day else None
        except ValueError:
            return None

    def column(self, index: int) -> Array:
        """Return the samples (rows,) in a column of the packet."""
        return np.array([row[index] for row in self.rows])


def is_lvm(head: bytes) -> bool:
    """Test whether `head`, the first bytes of a file, has a line that begins with a LabVIEW header's end mark."""
    return any(f"{end}{_END_MARK}".encode(encoding) in head for end in "\n\r" for encoding in ("ascii", "utf-16-le"))


def read_lvm(path: Path, request: Request) -> RecordingFields:
    """Read the requested channels of a LabVIEW measurement file, and join packets with the same channels."""
    with path.open("rb") as file:
        encoding = detect_encoding(file.read(SNIFF)) or "cp1252"
    with path.open(encoding=encoding, errors="replace") as text:
        lines = enumerate((line.rstrip("\r\n").lstrip("\ufeff") for line in text), start=1)
        header: dict[str, str] = {}
        for _, line in lines:
            if line.startswith(_END_MARK):
                break
            name, _, value = line.partition("\t" if "\t" in line else ",")
            # the value of Decimal_Separator may be a comma, which otherwise ends a line
            header[name.strip().casefold()] = "," if value.strip("\t ") == "," else value.strip("\t, ")
        delimiter = "," if header.get("separator", "").casefold() == "comma" else "\t"
        decimal = "," if header.get("decimal_separator") == "," else "."
        packets = list(_iter_packets(lines, delimiter, decimal, str(path)))
    if not packets:
        raise InputError("a LabVIEW measurement file must have samples, got a header and no rows")
    series = _list_series(packets, header.get("x_columns", "one").casefold())
    remarks = collect_remarks((name, header[name]) for name in ("operator", "project", "description") if name in header)
    return build_fields(series, request, "LabVIEW measurement", remarks)


def _iter_packets(lines: Iterator[tuple[int, str]], delimiter: str, decimal: str, place: str) -> Iterator[_Packet]:
    """Yield the packets (segments of a measurement) of a LabVIEW file.

    `lines`: numbers and texts of the lines after the header of the file. A packet has a header that begins with
    `Channels` and ends with an end mark, a line with the names of the columns, and lines of samples. It is yielded when
    its names are known; its rows are complete when the next packet is yielded, or at the end. `delimiter` separates the
    cells, `decimal` is the decimal mark; `place` names the file in errors.
    """
    header: dict[str, list[str]] = {}
    packet: _Packet | None = None
    in_header = True
    for number, line in lines:
        cells = [cell.strip() for cell in line.split(delimiter)]
        if line.startswith(_END_MARK):
            in_header, packet = False, None
        elif not any(cells):
            continue
        elif packet is not None and cells[0].casefold() == "channels":
            header, packet, in_header = {}, None, True
        elif packet is not None:
            names = packet.names

            def format_place(index: int, number: int = number, names: Sequence[str] = names) -> str:
                """Format line, column and file of a cell; the defaults keep the values of this step of the loop."""
                return f"(line {number}, column {names[index]}, {place})"

            padded_cells = cells[: len(names)] + [""] * (len(names) - len(cells))
            values, words = parse_numbers(padded_cells, decimal, format_place)
            if words:
                raise InputError(f"a sample must be a number, got {cells[words[0]][:40]!r} {format_place(words[0])}")
            packet.rows.append(values)
            if len(packet.rows) % 2**16 == 0:  # now and then, before a long file fills the memory
                check_size(len(packet.rows), len(names))
        elif in_header:
            texts = cells[1:]
            # if each channel has a column of times, every second cell is empty
            has_time_cells = len(texts) > 2 and texts[2] and not any(texts[1::2])
            header[cells[0].casefold()] = texts[::2] if has_time_cells else texts
        else:
            packet = _Packet(header, cells[:-1] if cells[-1].casefold() == "comment" else cells)
            yield packet


def _list_series(packets: Sequence[_Packet], x_columns: str) -> list[Series]:
    """Join the samples of each channel from all packets that have the same columns as the first one.

    `x_columns`: "one" if all channels share a column of times, "multi" if each channel follows its own column of times,
    or "no" if the headers of the packets state start and step of the times; the column of times is then blank.
    """
    first, names = packets[0], packets[0].names
    time_columns = [column for column, name in enumerate(names) if name.casefold().startswith("x_value")]
    if not time_columns:
        raise InputError(f"a LabVIEW measurement file must have a column X_Value, got {', '.join(names)}")
    matching = [packet for packet in packets if packet.names == names]
    check_size(sum(len(packet.rows) for packet in matching), len(names))
    day_first = is_day_first([ambiguous_dates(day for packet in matching for day in packet.head.get("date", []))])
    offsets = _packet_offsets(matching, day_first)
    is_multi = x_columns == "multi"
    series = []
    for index, column in enumerate(column for column in range(len(names)) if column not in time_columns):
        preceding = [time_column for time_column in time_columns if time_column < column]
        time_column = preceding[-1] if is_multi and preceding else time_columns[0]
        values, times_of_packets = [], []
        for packet, offset in zip(matching, offsets, strict=True):
            samples = packet.column(column)
            if x_columns != "one":  # shorter channels end in blanks; one without samples stays
                samples = samples[: np.flatnonzero(np.isfinite(samples)).max(initial=-1) + 1 or None]
            computed_times = _compute_times(packet, index, samples.size) if x_columns == "no" else None
            values.append(samples)
            times_of_packets.append(
                offset + (packet.column(time_column)[: samples.size] if computed_times is None else computed_times)
            )
        t = np.concatenate(times_of_packets)
        label = Label.parse(names[column], first.entry("y_unit_label", index) or None)
        # with times of its own, even channels that follow one column may differ in step or length
        clock = Clock.of_times(time_column if x_columns == "one" else column, t, first.moment(index, day_first))
        series.append(Series("", label, t.size, partial(np.asarray, np.concatenate(values)), clock))
    return series


def _compute_times(packet: _Packet, index: int, count: int) -> Array:
    """Compute the times (count,) [s] of channel `index` from `X0` (by default 0) and `Delta_X` in a packet's header."""
    step = packet.number("delta_x", index)
    if not step > 0:
        raise InputError(f"Delta_X must be > 0 s, got {packet.head.get('delta_x')}")
    return np.asarray(np.nan_to_num(packet.number("x0", index)) + step * np.arange(count))


def _packet_offsets(packets: Sequence[_Packet], day_first: bool) -> list[float]:
    """Compute the time [s] from the first packet of samples to each packet, by the date stamps in the headers.

    All are 0 if a date is not known, or if the start times `X0` increase, as the times then continue by themselves.
    """
    moments = [packet.moment(0, day_first) for packet in packets]
    first_times = [packet.number("x0", 0) for packet in packets]
    known = [moment for moment in moments if moment is not None]
    if len(known) < len(packets) or all(after > before for before, after in pairwise(first_times)):
        return [0.0] * len(packets)
    return [float(timedelta_seconds(moment - known[0])) for moment in known]
