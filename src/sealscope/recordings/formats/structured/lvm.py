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
from sealscope.recordings.formats.cells import numbers
from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries
from sealscope.recordings.formats.table import Clock, RecordingFields, Series, check_size, table_of
from sealscope.recordings.formats.text_layout import SNIFF, encoding_of
from sealscope.recordings.formats.timebase import day_before_month, either_dates, stamps

#: What ends each header of the format.
_END = "***End_of_Header***"


@dataclass
class _Packet:
    """`head`: rows of the channels' header; `names`: of the columns; `rows`: samples, NaN where a row is shorter."""

    head: Mapping[str, list[str]]
    names: list[str]
    rows: list[Array] = field(default_factory=list)

    def entry(self, name: str, index: int) -> str:
        """Return a channel's entry of the header; empty where there is none."""
        cells = self.head.get(name, [])
        return cells[index] if index < len(cells) else ""

    def number(self, name: str, index: int) -> float:
        try:
            return float(self.entry(name, index).replace(",", "."))
        except ValueError:
            return np.nan

    def moment(self, index: int, day_first: bool) -> np.datetime64 | None:
        """Return when a channel's first sample was taken; None where the header does not say."""
        day, time = self.entry("date", index), self.entry("time", index).replace(",", ".")
        seconds, _, fraction = time.partition(".")
        try:
            return stamps([f"{day} {seconds}.{fraction[:9] or '0'}"], day_first)[0] if day else None
        except ValueError:
            return None

    def column(self, index: int) -> Array:
        return np.array([row[index] for row in self.rows])


def is_lvm(head: bytes) -> bool:
    """Test whether a file that begins with `head` is a LabVIEW measurement file: the mark begins a line."""
    return any(f"{end}{_END}".encode(encoding) in head for end in "\n\r" for encoding in ("ascii", "utf-16-le"))


def read_lvm(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted channels of a LabVIEW measurement file; packets of the same channels follow each other."""
    with path.open("rb") as file:
        encoding = encoding_of(file.read(SNIFF)) or "cp1252"
    with path.open(encoding=encoding, errors="replace") as text:
        lines = enumerate((line.rstrip("\r\n").lstrip("\ufeff") for line in text), start=1)
        header: dict[str, str] = {}
        for _, line in lines:
            if line.startswith(_END):
                break
            name, _, value = line.partition("\t" if "\t" in line else ",")
            header[name.strip().casefold()] = "," if value.strip("\t ") == "," else value.strip("\t, ")
        delimiter = "," if header.get("separator", "").casefold() == "comma" else "\t"
        decimal = "," if header.get("decimal_separator") == "," else "."
        packets = list(_packets(lines, delimiter, decimal, str(path)))
    if not packets:
        raise InputError("a LabVIEW measurement file must have samples, got a header and no rows")
    series = _series(packets, header.get("x_columns", "one").casefold())
    remarks = entries((name, header[name]) for name in ("operator", "project", "description") if name in header)
    return table_of(series, request, "LabVIEW measurement", remarks)


def _packets(lines: Iterator[tuple[int, str]], delimiter: str, decimal: str, place: str) -> Iterator[_Packet]:
    head: dict[str, list[str]] = {}
    packet: _Packet | None = None
    in_head = True
    for number, line in lines:
        cells = [cell.strip() for cell in line.split(delimiter)]
        if line.startswith(_END):
            in_head, packet = False, None
        elif not any(cells):
            continue
        elif packet is not None and cells[0].casefold() == "channels":
            head, packet, in_head = {}, None, True
        elif packet is not None:
            names = packet.names

            def where(index: int, number: int = number, names: Sequence[str] = names) -> str:
                return f"(line {number}, column {names[index]}, {place})"

            values, words = numbers(cells[: len(names)] + [""] * (len(names) - len(cells)), decimal, where)
            if words:
                raise InputError(f"a sample must be a number, got {cells[words[0]][:40]!r} {where(words[0])}")
            packet.rows.append(values)
            if len(packet.rows) % 2**16 == 0:
                check_size(len(packet.rows), len(names))
        elif in_head:
            texts = cells[1:]  # every second cell is empty where each channel has a time
            head[cells[0].casefold()] = texts[::2] if len(texts) > 2 and texts[2] and not any(texts[1::2]) else texts
        else:
            packet = _Packet(head, cells[:-1] if cells[-1].casefold() == "comment" else cells)
            yield packet


def _series(packets: Sequence[_Packet], x_columns: str) -> list[Series]:
    """Return a series a channel, of all packets that have its columns; `x_columns`: one, multi or no."""
    first, names = packets[0], packets[0].names
    times = [column for column, name in enumerate(names) if name.casefold().startswith("x_value")]
    if not times:
        raise InputError(f"a LabVIEW measurement file must have a column X_Value, got {', '.join(names)}")
    same = [packet for packet in packets if packet.names == names]
    check_size(sum(len(packet.rows) for packet in same), len(names))
    day_first = day_before_month([either_dates(day for packet in same for day in packet.head.get("date", []))])
    begins = _begins(same, day_first)
    multiple, series = x_columns == "multi", []
    for index, column in enumerate(column for column in range(len(names)) if column not in times):
        time = max((before for before in times if before < column), default=times[0]) if multiple else times[0]
        values, seconds = [], []
        for packet, begin in zip(same, begins, strict=True):
            samples = packet.column(column)
            if multiple:  # it ends in blanks where others go on
                samples = samples[: np.flatnonzero(np.isfinite(samples)).max(initial=-1) + 1]
            own_times = packet.column(time)[: samples.size]
            if x_columns == "no":
                step = packet.number("delta_x", index)
                if not step > 0:
                    raise InputError(f"Delta_X must be > 0 s, got {packet.head.get('delta_x')}")
                own_times = np.nan_to_num(packet.number("x0", index)) + step * np.arange(samples.size)
            values.append(samples)
            seconds.append(begin + own_times)
        joined, t = np.concatenate(values), np.concatenate(seconds)
        label = Label.parse(names[column], first.entry("y_unit_label", index) or None)
        clock = Clock(time, partial(lambda *reading: reading, t, first.moment(index, day_first)))
        series.append(Series("", label, t.size, partial(np.asarray, joined), clock))
    return series


def _begins(packets: Sequence[_Packet], day_first: bool) -> list[float]:
    """Compute the offset of each packet's times [s]: 0 if they go on from packet to packet or a moment is unknown."""
    moments = [packet.moment(0, day_first) for packet in packets]
    firsts = [packet.number("x0", 0) for packet in packets]
    known = [moment for moment in moments if moment is not None]
    if len(known) < len(packets) or all(after > before for before, after in pairwise(firsts)):
        return [0.0] * len(packets)
    return [float((moment - known[0]) / np.timedelta64(1, "ns")) / 1e9 for moment in known]
