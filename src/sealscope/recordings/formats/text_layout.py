"""The layout of a text log, found from its beginning: encoding, delimiter, decimal sign, header, units, first row."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import of_lines
from sealscope.recordings.timebase import is_stamp
from sealscope.units import parse_unit

SNIFF = 64 * 1024
OWN_MARK = "# sealscope: "
COMMENTS = ("#", "%", "//", '"#', "!")
#: What loggers write where a sample is missing, in lower case.
MISSING = frozenset(
    {"", "nan", "-", "--", "---", "na", "n/a", "#n/a", "null", "none", "-nan", "+nan", "1.#qnan", "-1.#ind", "nan(ind)"}
)
_SAMPLE_ROWS = 200
_LONGEST_NUMBER = 400
_NUMBER = {
    ".": re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
    ",": re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
}
_LOOKS = (("\t", "."), ("\t", ","), (";", "."), (";", ","), (",", "."), ("|", "."), ("|", ","), (" ", "."), (" ", ","))
_SPACED_LABEL = re.compile(r"\S+(?:\s{0,20}(?:\[[^\]]{0,40}\]|\([^)]{0,40}\)))?")
_NAMES = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", " ": "blank"}


@dataclass(frozen=True)
class Layout:
    """`delimiter`: a blank is any white space; `first_row`: index of the first data line; `own`: our JSON line."""

    encoding: str
    delimiter: str
    decimal: str
    labels: tuple[Label, ...]
    first_row: int
    own: str | None = None
    notes: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """The format, in words."""
        comma = ", decimal comma" if self.decimal == "," else ""
        return f"text, {_NAMES[self.delimiter]} separated{comma}, {self.encoding}"


def encoding_of(head: bytes) -> str | None:
    """Return the encoding of a text by its first bytes; None where they are no text."""
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
    ):
        if head.startswith(mark):
            return name
    if b"\0" in head:
        return None
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        control = sum(byte < 9 or 13 < byte < 32 for byte in head)
        return "cp1252" if control <= len(head) // 100 else None
    return "utf-8"


def cells_of(line: str, delimiter: str) -> list[str]:
    """Split one line into cells, without the quotation marks around a cell."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        import csv

        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return line.split(delimiter)


def is_number(cell: str, decimal: str) -> bool:
    """Return whether the cell is a number with this decimal sign."""
    cell = cell.strip()
    return len(cell) <= _LONGEST_NUMBER and _NUMBER[decimal].fullmatch(cell) is not None


def _is_value(cell: str, decimal: str) -> bool:
    return is_number(cell, decimal) or is_stamp(cell)


def _width(row: Sequence[str]) -> int:
    """Count the cells but the empty ones at the end."""
    width = len(row)
    while width and not row[width - 1].strip():
        width -= 1
    return width


def _look(body: Sequence[str]) -> tuple[str, str, int]:
    """Return (delimiter, decimal sign, cells a row) with which most cells of the body are values."""
    best: tuple[tuple[float, int], tuple[str, str, int]] | None = None
    for delimiter, decimal in _LOOKS:
        rows = [cells_of(line, delimiter) for line in body]
        values = [sum(_is_value(cell, decimal) for cell in row) for row in rows]
        valued = [(row, many) for row, many in zip(rows, values, strict=True) if many and len(row) > 1]
        if not valued:
            continue
        held = Counter[int]()  # values by the width of their row
        for row, many in valued:
            held[len(row)] += many
        width = max(held, key=lambda w: (held[w], w))
        if 2 * held[width] < held.total():
            continue
        present = sum(cell.strip().lower() not in MISSING for row, _ in valued for cell in row)
        share = sum(many for row, many in valued if len(row) == width) / present
        if share > 0 and (best is None or (share, width) > best[0]):
            best = (share, width), (delimiter, decimal, width)
    return best[1] if best else (",", ".", 1)


def _header_labels(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return _SPACED_LABEL.findall(line)
    return [cell.strip() for cell in cells_of(line, delimiter)]


def _unit_cells(cells: Sequence[str]) -> list[str | None] | None:
    """Return the units of a units row; None for another row: most of the cells of a units row are units."""
    units: list[str | None] = []
    known = present = 0
    for cell in cells:
        text = cell.strip().strip("[]()").strip()
        if not text or text == "-":
            units.append(None)
            continue
        present += 1
        try:
            parse_unit(text)
            known += 1
        except InputError:
            pass
        units.append(text)
    return units if present and known >= 0.6 * present else None


def _heading(lines: Sequence[str], first: int, delimiter: str, width: int, decimal: str) -> tuple[list[Label], int]:
    """Return (labels, number of rows they take) from the lines above the first data row."""

    def names(index: int, commented: bool = False) -> list[str] | None:
        if index < 0:
            return None
        line = lines[index].strip()
        if line.startswith(COMMENTS):
            if not commented:
                return None
            line = line.lstrip('#%/!" ').rstrip('"')
        cells = _header_labels(line if commented else lines[index].strip("\r\n "), delimiter)
        if cells and not cells[-1]:
            cells = cells[: max(_width(cells), min(width, len(cells)))]
        enough = abs(len(cells) - width) <= 1 or (len(cells) >= width > 1)
        return cells if enough and any(cells) and not all(_is_value(c, decimal) for c in cells if c) else None

    above = [i for i in range(first - 1, -1, -1) if lines[i].strip()]
    if not above:
        return [], 0
    row = names(above[0])
    if row is not None:
        over = names(above[1]) if len(above) > 1 else None
        units = _unit_cells(row) if over is not None else None
        if over is not None and units is not None:
            units += [None] * (len(over) - len(units))
            return [Label.parse(name, unit) for name, unit in zip(over, units, strict=False)], 2
        return [Label.parse(name) for name in row], 1
    commented = names(above[0], commented=True) if not lines[above[0]].startswith(OWN_MARK) else None
    return ([Label.parse(name) for name in commented], 1) if commented else ([], 0)


def _own_layout(lines: Sequence[str], encoding: str) -> Layout | None:
    """Return the layout of a file that Sealscope wrote, whose second line is the header; None for any other."""
    if len(lines) < 2 or not lines[0].startswith(OWN_MARK) or not lines[1].startswith("t [s]"):
        return None
    delimiter = "\t" if "\t" in lines[1] else ","
    labels = tuple(Label.parse(cell) for cell in lines[1].split(delimiter))
    return Layout(encoding, delimiter, ".", labels, 2, lines[0][len(OWN_MARK) :])


def layout_of(head: bytes, encoding: str, whole: bool, place: str) -> Layout:
    """Find the layout of a log that begins with `head`; `whole`: that is all of it. Raises UnreadableFile."""
    text = head.decode(encoding, errors="replace").lstrip("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not whole:
        if len(lines) < 2:
            raise UnreadableFile(f"a text log must have lines, got none that ends within {SNIFF} bytes ({place})")
        lines.pop()
    own = _own_layout(lines, encoding)
    if own is not None:
        return own
    content = [line for line in lines if line.strip() and not line.lstrip().startswith(COMMENTS)]
    if not content:
        raise UnreadableFile(f"a recording must have samples, got an empty file ({place})")
    body = content[max(1, min(len(content) // 2, len(content) - 20)) :][-_SAMPLE_ROWS:] or content
    delimiter, decimal, width = _look(body)
    rows = [row for row in (cells_of(line, delimiter) for line in body) if len(row) == width]
    values = [sum(_is_value(cell, decimal) for cell in row) for row in rows]
    rows = [row for row, count in zip(rows, values, strict=True) if 0 < max(values) <= 2 * count]  # no preamble
    numeric = [
        i
        for i in range(width)
        if 2 * sum(_is_value(r[i], decimal) for r in rows) > sum(r[i].strip().lower() not in MISSING for r in rows)
    ]
    first = len(lines)
    for index, line in enumerate(lines):
        if not line.strip() or line.lstrip().startswith(COMMENTS):
            continue
        cells = cells_of(line, delimiter)
        if len(cells) < min(width, (numeric or [0])[-1] + 1):
            continue
        good = [i for i in numeric if i < len(cells) and _is_value(cells[i], decimal)]
        empty = [i for i in numeric if i < len(cells) and cells[i].strip().lower() in MISSING]
        if good and 2 * (len(good) + len(empty)) > len(numeric):
            first = index
            break
    if first == len(lines):
        names = _header_labels(content[0], delimiter if width > 1 else _likely(content[0]))
        raise UnreadableFile(
            f"a recording must have samples, got no row of numbers after {', '.join(names)[:80]} ({place})"
        )
    labels, taken = _heading(lines, first, delimiter, width, decimal)
    notes: list[str] = []
    if not labels:
        labels = [Label(str(i + 1), str(i + 1)) for i in range(width)]
        notes.append("no header: columns are called by their number, from 1")
    above = [line for line in lines[:first] if line.strip()]
    remarks = above[: len(above) - taken]
    about = of_lines(remarks, delimiter)
    plain = [line for line in remarks if not line.startswith(COMMENTS)]
    unused = len(plain) - len(of_lines(plain, delimiter))
    if unused > 0:
        notes.append(f"{counted(unused, 'line')} before the header not used")
    return Layout(encoding, delimiter, decimal, tuple(labels), first, None, tuple(notes), about)


def _likely(line: str) -> str:
    return max("\t;,|", key=line.count) if any(sign in line for sign in "\t;,|") else " "
