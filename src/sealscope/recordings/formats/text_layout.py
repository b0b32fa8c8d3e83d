"""The layout of a text log, found from its beginning: encoding, delimiter, decimal sign, header, units, first row."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, chain, islice, repeat

from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.formats.cells import (
    has_prefixes,
    is_grouped,
    is_missing,
    is_value,
    units_behind,
    with_exponents,
    with_units,
    without_units,
)
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.formats.headings.described import described, scope_heading, x_y_pairs
from sealscope.recordings.formats.headings.labels import Label, is_unit
from sealscope.recordings.formats.headings.preamble import of_lines, stated_rate
from sealscope.recordings.formats.headings.proposal import knows, measures
from sealscope.recordings.formats.headings.words import WORDS

SNIFF = 64 * 1024
OWN_MARK = "# sealscope: "
COMMENTS = ("#", "%", "//", '"#', "!")
_SAMPLE_ROWS = 100
_LOOKS = (
    ("\t", "."), ("\t", ","), (";", "."), (";", ","), (",", "."), ("|", "."), ("|", ","), (",", ","), (" ", "."),
    (" ", ","),
)  # fmt: skip
#: A number, and what may be its unit, in one cell.
_QUANTITY = re.compile(r"\d[ \u00a0\u202f]{0,2}(?![eEdDT][+-]?\d)(?:[^\W\d_]|[%\u00b0])")
_RULER = re.compile(r"[-=_:+]{1,80}")
#: Most lines above the samples that are looked at for names and units.
_DEEPEST_HEADING = 12
_SPACED_LABEL = re.compile(r"\S+(?:\s{0,20}(?:\[[^\]]{0,40}\]|\([^)]{0,40}\)))?")
_NAMES = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", " ": "blank"}


@dataclass(frozen=True)
class Layout:
    """`delimiter`: a blank is any white space; `first_row`: index of the first data line; `own`: our JSON line.

    `above`: the lines above the first row, which some loggers repeat further down; `rate`: what they say of it [Hz];
    `cell_units`: column -> the unit that stands behind each of its numbers; `prefixed`: numbers end in prefixes of
    powers of ten.
    """

    encoding: str
    delimiter: str
    decimal: str
    labels: tuple[Label, ...]
    first_row: int
    own: str | None = None
    notes: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict)
    above: frozenset[str] = frozenset()
    rate: float | None = None
    cell_units: Mapping[int, str] = field(default_factory=dict)
    prefixed: bool = False

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
    if b"\0" in head:  # UTF-16 without a mark has a zero beside every Latin sign
        zeros = [head[begin::2].count(0) / max(len(head) // 2, 1) for begin in (0, 1)]
        names = [name for name, share in zip(("utf-16-be", "utf-16-le"), zeros, strict=True) if share > 0.8]
        return names[0] if len(names) == 1 else None
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        for name in ("gb18030", "shift_jis"):
            try:
                if knows(codecs.getincrementaldecoder(name)().decode(head)):
                    return name
            except UnicodeDecodeError:
                continue
        control = sum(byte < 9 or 13 < byte < 32 for byte in head)
        return "cp1252" if control <= len(head) // 100 else None
    return "utf-8"


def blank_cells(line: str) -> list[str]:
    """Split one line at its blanks and tabs, and not at the narrow blanks that stand between thousands."""
    return line.split() if line.isascii() else re.findall(r"[^ \t\v\f]+", line)


def cells_of(line: str, delimiter: str) -> list[str]:
    """Split one line into cells, without the quotation marks around a cell."""
    if delimiter == " ":
        return blank_cells(line)
    if '"' in line:
        import csv

        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return line.split(delimiter)


def _width(row: Sequence[str]) -> int:
    """Count the cells but the empty ones at the end."""
    width = len(row)
    while width and not row[width - 1].strip():
        width -= 1
    return width


def _look(body: Sequence[str]) -> tuple[str, str, int]:
    """Return (delimiter, decimal sign, cells a row) with which most cells of the body are values."""
    ranks: dict[tuple[str, str, int], tuple[float, float, bool, int]] = {}
    text = "\n".join(body)
    for delimiter, decimal in _LOOKS:
        if delimiter not in text and not (delimiter == " " and any(sign in text for sign in "\t\v\f")):
            continue
        valued = [
            (row, many)
            for row in (cells_of(line, delimiter) for line in body)
            if len(row) > 1 and (many := sum(is_value(cell, decimal) for cell in row))
        ]
        held = Counter[int]()  # values by the width of their row
        for row, many in valued:
            held[len(row)] += many
        width = max(held, key=lambda w: (held[w], w), default=0)
        if valued and 2 * held[width] >= held.total():
            cells = [cell for row, _ in valued for cell in row]
            present = sum(not is_missing(cell) for cell in cells)
            grouped = sum(is_grouped(cell, decimal) for cell in cells)  # thousands where nothing plainer fits
            ranks[delimiter, decimal, width] = held[width] / present, -grouped / present, delimiter != " ", width
    return max(ranks, key=ranks.__getitem__, default=(",", ".", 1))


def _header_labels(line: str, delimiter: str, width: int = 0) -> list[str]:
    if delimiter == " ":
        labels = _SPACED_LABEL.findall(line)
        columns = re.split(r"\s{2,}|\t", line.strip())  # names with a blank, in columns that two part
        return columns if len(labels) != width == len(columns) else labels
    return [cell.strip() for cell in cells_of(line, delimiter)]


def _unit_cells(cells: Sequence[str]) -> list[str | None] | None:
    """Return the units of a units row; None for another row: most of the cells of a units row are units."""
    texts = [cell.strip().strip("[]()<>'").strip() for cell in cells]
    units = [text if text and text != "-" else None for text in texts]
    known = sum(unit is not None and is_unit(unit) for unit in units)
    return units if known and known >= 0.6 * sum(unit is not None for unit in units) else None


def _heading(lines: Sequence[str], first: int, delimiter: str, width: int, decimal: str) -> tuple[list[Label], int]:
    """Return (labels, number of rows they take) from the lines above the first data row."""

    def names(line: str) -> list[str] | None:
        cells = _header_labels(line, delimiter, width)
        if cells and not cells[-1]:
            cells = cells[: max(_width(cells), min(width, len(cells)))]
        enough = abs(len(cells) - width) <= 1 or (len(cells) >= width > 1)
        return cells if enough and any(cells) and not all(is_value(c, decimal) for c in cells if c) else None

    above = [line.strip("\r\n ") for line in lines[first - 1 :: -1] if line.strip()] if first else []
    if not above:
        return [], 0
    if (scope := scope_heading(lines[:first], delimiter)) is not None:
        return scope
    rows: list[list[str]] = []
    for line in above[:_DEEPEST_HEADING]:
        row = None if line.startswith(COMMENTS) else names(line)
        if row is None:
            break
        rows.append(row)
    if rows:
        labels, depth = _keyed(rows) or _stacked(rows)
        label_lines = [
            line for line, row in zip(above, rows, strict=False) if row[0].strip().casefold() in WORDS["row"]["label"]
        ]
        return described(labels, [cells_of(line, delimiter) for line in [*label_lines, *above[depth:]][::-1]]), depth
    if above[0].startswith(COMMENTS) and not above[0].startswith(OWN_MARK):
        commented = names(above[0].lstrip('#%/!" ').rstrip('"'))
        return ([Label.parse(name) for name in commented], 1) if commented else ([], 0)
    return [], 0


def _keyed(rows: Sequence[Sequence[str]]) -> tuple[list[Label], int] | None:
    """Return (labels, rows taken) where rows, lowest first, say what they hold: `Name`, `Unit`; else None."""
    keys = [row[0].strip().rstrip(":").casefold() for row in rows]
    heading = next((i for i, key in enumerate(keys) if key in WORDS["row"]["name"] and _width(rows[i]) > 1), None)
    unit = next((i for i, key in enumerate(keys) if key in WORDS["row"]["unit"]), None)
    if heading is None or unit is None:
        return None
    # a name of the first column alone
    texts = [rows[0][0] if _width(rows[0]) == 1 else rows[heading][0], *rows[heading][1:]]
    units = chain([None], _unit_cells(rows[unit][1:]) or [], repeat(None))
    return [Label.parse(name, unit_text) for name, unit_text in zip(texts, units, strict=False)], max(heading, unit) + 1


def _stacked(rows: Sequence[Sequence[str]]) -> tuple[list[Label], int]:
    """Return (labels, rows taken) of rows, lowest first: names, units below or above, groups over them, rulers."""
    skipped = next((i for i, row in enumerate(rows[:-1]) if not _tells_nothing(row)), len(rows) - 1)
    row, *over = rows[skipped:]
    texts, depth = list(row), skipped + 1
    units = (_numbered_units(row) or _unit_cells(row)) if over else None
    if units is not None:
        texts, over, depth = list(over[0]), over[1:], depth + 1
    elif over and (units := _unit_cells(over[0])) is not None and None not in units and len(units) == len(row) > 1:
        over, depth = over[1:], depth + 1
    else:
        units = []
    known = {name.casefold() for name in CHANNEL_UNITS}
    if over and not any(Label.parse(text).name.casefold() in known for text in texts) and any(map(measures, over[0])):
        groups = accumulate(chain(over[0], repeat("")), lambda before, cell: cell.strip() or before, initial="")
        texts = [f"{group} {text}".strip() for text, group in zip(texts, islice(groups, 1, None), strict=False)]
        depth += 1
    labels = [Label.parse(name, unit) for name, unit in zip(texts, chain(units, repeat(None)), strict=False)]
    return x_y_pairs(labels), depth


def _numbered_units(row: Sequence[str]) -> list[str | None] | None:
    """Return the units of Graphtec's row `NO.,Time,ms,V,...`, whose other cells are none; None for any other row."""
    cells = [cell.strip() for cell in row]
    if [cell.casefold() for cell in cells[:3]] != ["no.", "time", "ms"]:
        return None
    return [cell if column > 1 and is_unit(cell) else None for column, cell in enumerate(cells)]


def _tells_nothing(row: Sequence[str]) -> bool:
    cells = [cell.strip() for cell in row if cell.strip()]
    same = len(set(cells)) == 1 < len(cells) and _unit_cells(cells) is None
    return same or all(_RULER.fullmatch(cell) for cell in cells)


def layout_of(head: bytes, encoding: str, whole: bool, place: str) -> Layout:
    """Return the layout of a log that begins with `head`, or is it as a `whole`; refuse one without numbers."""
    text = head.decode(encoding, errors="replace").lstrip("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not whole:
        if len(lines) < 2:
            raise InputError(f"a text log must have lines, got none that ends within {SNIFF} bytes")
        lines.pop()
    if len(lines) > 1 and lines[0].startswith(OWN_MARK) and lines[1].startswith("t [s]"):
        delimiter = "\t" if "\t" in lines[1] else ","
        own_labels = tuple(Label.parse(cell) for cell in lines[1].split(delimiter))
        return Layout(encoding, delimiter, ".", own_labels, 2, lines[0][len(OWN_MARK) :])
    content = [line for line in lines if _is_content(line)]
    if not content:
        raise InputError("a recording must have samples, got an empty file")
    body = content[max(1, min(len(content) // 2, len(content) - 20)) :][-_SAMPLE_ROWS:] or content
    written = lines
    if prefixed := _has_prefixes(body):
        body = [with_exponents(line) for line in body]
        lines = [_exponents_of_samples(line) for line in lines]
    cell_units = {} if prefixed else _units_in_cells(body)
    if cell_units:
        lines, body = ([without_units(line, cell_units.values()) for line in part] for part in (lines, body))
    delimiter, decimal, width = _look(body)
    first = _first_row(lines, body, delimiter, decimal, width)
    if first is None:
        kind = {"{": "JSON", "[": "JSON", "<": "XML or HTML"}.get(content[0].lstrip()[:1])
        if kind is not None:
            raise InputError(f"a recording must be a table, got {kind}: export it as CSV")
        likely = max("\t;,|", key=content[0].count) if any(sign in content[0] for sign in "\t;,|") else " "
        names = _header_labels(content[0], delimiter if width > 1 else likely)
        raise InputError(f"a recording must have samples, got no row of numbers after {', '.join(names)[:80]}")
    labels, depth = _heading(lines, first, delimiter, width, decimal)
    notes: list[str] = []
    if not labels:
        labels = [Label(str(i + 1), str(i + 1)) for i in range(width)]
        notes.append("no header: columns are called by their number, from 1")
    if cell_units:
        labels = with_units(labels, cell_units, place)
    above = [line for line in written[:first] if line.strip()]
    remarks = above[: len(above) - depth]
    plain = [line for line in remarks if not line.startswith(COMMENTS)]
    unused = len(plain) - len(of_lines(plain, delimiter))
    if unused > 0:
        notes.append(f"{counted(unused, 'line')} before the header not used")
    notes += ["numbers such as 170.3m read with their prefix, as 0.1703"] if prefixed else []
    return Layout(
        encoding,
        delimiter,
        decimal,
        tuple(labels),
        first,
        notes=tuple(notes),
        about=of_lines(remarks, delimiter),
        above=frozenset(line.strip() for line in above),
        rate=stated_rate(of_lines(above, delimiter)),
        cell_units=cell_units,
        prefixed=prefixed,
    )


def _is_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _first_row(lines: Sequence[str], body: Sequence[str], delimiter: str, decimal: str, width: int) -> int | None:
    """Return the index of the first line of samples, by the columns of the `body` that hold numbers."""
    rows = [row for row in (cells_of(line, delimiter) for line in body) if len(row) == width]
    values = [[is_value(cell, decimal) for cell in row] for row in rows]
    most = max(map(sum, values), default=0)
    full = [k for k, row in enumerate(values) if 0 < most <= 2 * sum(row)]  # no preamble
    rows, values = [rows[k] for k in full], [values[k] for k in full]
    numeric = [
        i for i in range(width) if 2 * sum(row[i] for row in values) > sum(not is_missing(row[i]) for row in rows)
    ]
    worded = any(not numbers[0] and not is_missing(row[0]) for row, numbers in zip(rows, values, strict=True))
    least = max(1, min(width, (numeric or [0])[-1] + 1))
    for index, line in enumerate(lines):
        cells = cells_of(line, delimiter) if _is_content(line) else []
        if len(cells) < least or not (worded or is_value(cells[0], decimal) or is_missing(cells[0])):
            continue  # also a row that says what it holds, such as `SampleRate,500,500`
        good = sum(i < len(cells) and is_value(cells[i], decimal) for i in numeric)
        empty = sum(i < len(cells) and is_missing(cells[i]) for i in numeric)
        if good and 2 * (good + empty) > len(numeric):
            return index
    return None


def _has_prefixes(body: Sequence[str]) -> bool:
    """Test whether the numbers of a log end in prefixes of powers of ten, by any delimiter."""
    return any(map(_QUANTITY.search, body)) and any(
        has_prefixes([cells_of(line, sign) for line in body]) for sign in "\t;|,"
    )


def _exponents_of_samples(line: str) -> str:
    """Return a line with exponents for the prefixes behind its numbers, where most of its cells are numbers."""
    changed = with_exponents(line)
    cells = re.split(r"[;,|\t]", changed)
    return changed if 2 * sum(is_value(cell, ".") for cell in cells) > len(cells) else line


def _units_in_cells(body: Sequence[str]) -> dict[int, str]:
    """Return column -> unit of the columns whose cells hold it beside their number, by the delimiter with most such."""
    if not any(map(_QUANTITY.search, body)):
        return {}
    return max((units_behind([cells_of(line, sign) for line in body]) for sign in "\t;|,"), key=len)
