"""The layout of a text log, found from its beginning: encoding, delimiter, decimal sign, header, units, first row."""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, chain, islice, repeat

from sealscope.errors import UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.formats.columns import counted
from sealscope.recordings.formats.headings.described import described, scope_heading
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import of_lines, stated_rate
from sealscope.recordings.formats.headings.proposal import knows, measures
from sealscope.recordings.formats.headings.quantities import is_unit, units_in, with_units, without_units
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.recordings.formats.timebase import is_stamp

SNIFF = 64 * 1024
OWN_MARK = "# sealscope: "
COMMENTS = ("#", "%", "//", '"#', "!")
#: What loggers write where a sample is missing, in lower case.
MISSING = frozenset({"", *WORDS["missing"]})
_SAMPLE_ROWS = 100
_LONGEST_NUMBER = 400
_NUMBER = {
    ".": re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
    ",": re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eEdD][+-]?\d+)?|[+-]?inf(?:inity)?", re.IGNORECASE),
}
#: Numbers with a sign between their thousands, the same all through.
_GROUPED = {
    ".": re.compile(r"[+-]?[1-9]\d{0,2}(?P<sign>[,'\u2019 \u00a0\u202f])\d{3}(?:(?P=sign)\d{3})*(?:\.\d*)?"),
    ",": re.compile(r"[+-]?[1-9]\d{0,2}(?P<sign>[.'\u2019 \u00a0\u202f])\d{3}(?:(?P=sign)\d{3})*(?:,\d*)?"),
}
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
    `cell_units`: column -> the unit that stands behind each of its numbers.
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


def is_number(cell: str, decimal: str) -> bool:
    """Return whether the cell is a number with this decimal sign."""
    cell = cell.strip()
    return (
        len(cell) <= _LONGEST_NUMBER
        and (_NUMBER[decimal].fullmatch(cell) or _GROUPED[decimal].fullmatch(cell)) is not None
    )


def ungrouped(cell: str, decimal: str) -> str:
    """Return a number's text without the signs between its thousands; any other text as it is."""
    match = _GROUPED[decimal].fullmatch(cell)
    return cell if match is None else cell.replace(match["sign"], "")


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
    best: tuple[tuple[float, float, bool, int], tuple[str, str, int]] | None = None
    text = "\n".join(body)
    blank = any(sign in text for sign in " \t\v\f")
    for delimiter, decimal in _LOOKS:
        if delimiter not in text and not (delimiter == " " and blank):
            continue
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
        grouped = sum(_GROUPED[decimal].fullmatch(cell.strip()) is not None for row, _ in valued for cell in row)
        rank = share, -grouped / present, delimiter != " ", width  # thousands where nothing plainer fits
        if share > 0 and (best is None or rank > best[0]):
            best = rank, (delimiter, decimal, width)
    return best[1] if best else (",", ".", 1)


def _header_labels(line: str, delimiter: str, width: int = 0) -> list[str]:
    if delimiter == " ":
        labels = _SPACED_LABEL.findall(line)
        apart = re.split(r"\s{2,}|\t", line.strip())  # names with a blank, in columns that two part
        return apart if len(labels) != width == len(apart) else labels
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
        return cells if enough and any(cells) and not all(_is_value(c, decimal) for c in cells if c) else None

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
        labels, taken = _keyed(rows) or _stacked(rows)
        own = [
            line for line, row in zip(above, rows, strict=False) if row[0].strip().casefold() in WORDS["row"]["label"]
        ]
        return described(labels, [cells_of(line, delimiter) for line in [*own, *above[taken:]][::-1]]), taken
    if above[0].startswith(COMMENTS) and not above[0].startswith(OWN_MARK):
        commented = names(above[0].lstrip('#%/!" ').rstrip('"'))
        return ([Label.parse(name) for name in commented], 1) if commented else ([], 0)
    return [], 0


def _keyed(rows: Sequence[Sequence[str]]) -> tuple[list[Label], int] | None:
    """Return (labels, rows taken) of a heading whose rows say what they hold: `Name`, `Unit`; None for any other.

    `rows`: the lowest first.
    """
    keys = [row[0].strip().rstrip(":").casefold() for row in rows]
    at = next((i for i, key in enumerate(keys) if key in WORDS["row"]["name"] and _width(rows[i]) > 1), None)
    unit = next((i for i, key in enumerate(keys) if key in WORDS["row"]["unit"]), None)
    if at is None or unit is None:
        return None
    texts = [rows[0][0] if _width(rows[0]) == 1 else rows[at][0], *rows[at][1:]]  # a name of the first column alone
    units = chain([None], _unit_cells(rows[unit][1:]) or [], repeat(None))
    return [Label.parse(name, given) for name, given in zip(texts, units, strict=False)], max(at, unit) + 1


def _stacked(rows: Sequence[Sequence[str]]) -> tuple[list[Label], int]:
    """Return (labels, rows taken) of a heading of names, with units below or above them, and groups over them.

    Rows that say the same of every column (`REAL`, a ruler) are passed over. `rows`: the lowest first.
    """
    skipped = next((i for i, row in enumerate(rows[:-1]) if not _tells_nothing(row)), len(rows) - 1)
    row, *over = rows[skipped:]
    texts, taken = list(row), skipped + 1
    units = (_numbered_units(row) or _unit_cells(row)) if over else None
    if units is not None:
        texts, over, taken = list(over[0]), over[1:], taken + 1
    elif over and (units := _unit_cells(over[0])) is not None and None not in units and len(units) == len(row) > 1:
        over, taken = over[1:], taken + 1
    else:
        units = []
    known = {name.casefold() for name in CHANNEL_UNITS}
    if over and not any(Label.parse(text).name.casefold() in known for text in texts) and any(map(measures, over[0])):
        groups = accumulate(chain(over[0], repeat("")), lambda before, cell: cell.strip() or before, initial="")
        texts = [f"{group} {text}".strip() for text, group in zip(texts, islice(groups, 1, None), strict=False)]
        taken += 1
    return [Label.parse(name, unit) for name, unit in zip(texts, chain(units, repeat(None)), strict=False)], taken


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


def _own_layout(lines: Sequence[str], encoding: str) -> Layout | None:
    """Return the layout of a file that Sealscope wrote, whose second line is the header; None for any other."""
    if len(lines) < 2 or not lines[0].startswith(OWN_MARK) or not lines[1].startswith("t [s]"):
        return None
    delimiter = "\t" if "\t" in lines[1] else ","
    labels = tuple(Label.parse(cell) for cell in lines[1].split(delimiter))
    return Layout(encoding, delimiter, ".", labels, 2, lines[0][len(OWN_MARK) :])


def layout_of(head: bytes, encoding: str, whole: bool, place: str) -> Layout:
    """Return the layout of a log that begins with `head`; raise UnreadableFile where it has no row of numbers.

    `whole`: the head is all of the log.
    """
    text = head.decode(encoding, errors="replace").lstrip("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not whole:
        if len(lines) < 2:
            raise UnreadableFile(f"a text log must have lines, got none that ends within {SNIFF} bytes ({place})")
        lines.pop()
    if (own := _own_layout(lines, encoding)) is not None:
        return own
    content = [line for line in lines if _is_content(line)]
    if not content:
        raise UnreadableFile(f"a recording must have samples, got an empty file ({place})")
    body = content[max(1, min(len(content) // 2, len(content) - 20)) :][-_SAMPLE_ROWS:] or content
    written, cell_units = lines, _units_in_cells(body)
    if cell_units:
        spelt = list(cell_units.values())
        lines, body = ([without_units(line, spelt) for line in part] for part in (lines, body))
    delimiter, decimal, width = _look(body)
    first = _first_row(lines, body, delimiter, decimal, width)
    if first is None:
        _refuse_markup(content[0], place)
        names = _header_labels(content[0], delimiter if width > 1 else _likely(content[0]))
        raise UnreadableFile(
            f"a recording must have samples, got no row of numbers after {', '.join(names)[:80]} ({place})"
        )
    labels, taken = _heading(lines, first, delimiter, width, decimal)
    notes: list[str] = []
    if not labels:
        labels = [Label(str(i + 1), str(i + 1)) for i in range(width)]
        notes.append("no header: columns are called by their number, from 1")
    if cell_units:
        labels = with_units(labels, cell_units, place)
    above = [line for line in written[:first] if line.strip()]
    remarks = above[: len(above) - taken]
    plain = [line for line in remarks if not line.startswith(COMMENTS)]
    unused = len(plain) - len(of_lines(plain, delimiter))
    if unused > 0:
        notes.append(f"{counted(unused, 'line')} before the header not used")
    return Layout(
        encoding,
        delimiter,
        decimal,
        tuple(labels),
        first,
        None,
        tuple(notes),
        of_lines(remarks, delimiter),
        frozenset(line.strip() for line in above),
        stated_rate(of_lines(above, delimiter)),
        cell_units,
    )


def _is_content(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _first_row(lines: Sequence[str], body: Sequence[str], delimiter: str, decimal: str, width: int) -> int | None:
    """Return the index of the first line of samples, by the columns of the `body` that hold numbers."""

    def missing(cell: str) -> bool:
        return cell.strip().lower() in MISSING

    rows = [row for row in (cells_of(line, delimiter) for line in body) if len(row) == width]
    values = [[_is_value(cell, decimal) for cell in row] for row in rows]
    most = max(map(sum, values), default=0)
    full = [k for k, row in enumerate(values) if 0 < most <= 2 * sum(row)]  # no preamble
    rows, values = [rows[k] for k in full], [values[k] for k in full]
    numeric = [i for i in range(width) if 2 * sum(row[i] for row in values) > sum(not missing(row[i]) for row in rows)]
    worded = any(not own[0] and not missing(row[0]) for row, own in zip(rows, values, strict=True))
    for index, line in enumerate(lines):
        cells = cells_of(line, delimiter) if _is_content(line) else []
        if len(cells) < max(1, min(width, (numeric or [0])[-1] + 1)):
            continue
        if not worded and not (_is_value(cells[0], decimal) or missing(cells[0])):
            continue  # a row that says what it holds, such as `SampleRate,500,500`
        good = sum(i < len(cells) and _is_value(cells[i], decimal) for i in numeric)
        empty = sum(i < len(cells) and missing(cells[i]) for i in numeric)
        if good and 2 * (good + empty) > len(numeric):
            return index
    return None


def _units_in_cells(body: Sequence[str]) -> dict[int, str]:
    """Return column -> unit of the columns whose cells hold it beside their number, by the delimiter with most such."""
    if not any(map(_QUANTITY.search, body)):
        return {}
    tried = [
        units_in(
            [cells_of(line, delimiter) for line in body], lambda cell: _is_value(cell, ".") or _is_value(cell, ",")
        )
        for delimiter in ("\t", ";", "|", ",")
    ]
    return max(tried, key=len)


def _refuse_markup(line: str, place: str) -> None:
    """Raise UnreadableFile for texts that are no tables."""
    kind = {"{": "JSON", "[": "JSON", "<": "XML or HTML"}.get(line.lstrip()[:1])
    if kind is not None:
        raise UnreadableFile(f"a recording must be a table, got {kind}: export it as CSV ({place})")


def _likely(line: str) -> str:
    return max("\t;,|", key=line.count) if any(sign in line for sign in "\t;,|") else " "
