"""Detect the layout of a text log: encoding, delimiter, decimal separator, heading, units, first row of samples."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, chain, compress, islice, pairwise, product, repeat

from sealscope.errors import InputError
from sealscope.paragraphs import format_count
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.formats.cells import (
    add_units,
    expand_prefixes,
    find_cell_units,
    has_prefixes,
    is_grouped,
    is_missing,
    is_value,
    remove_units,
)
from sealscope.recordings.formats.headings.descriptions import apply_descriptions, parse_scope_heading, split_pairs
from sealscope.recordings.formats.headings.labels import (
    WORDS,
    Label,
    has_known_word,
    is_quantity,
    is_unit,
    strip_word_before,
)
from sealscope.recordings.formats.headings.preamble import parse_remarks, stated_rate

SNIFF = 64 * 1024  # bytes at the beginning of a file from which its format and layout are detected
#: Beginning of the first line of logs written by Sealscope, before their description in JSON.
DESCRIPTION_MARK = "# sealscope: "
COMMENTS = ("#", "%", "//", '"#', "!")
_N_ROWS = 100  # rows from which the dialect is detected
#: Delimiters, each with the decimal separator of the dialect to try.
_DIALECTS = (*product("\t;", ".,"), (",", "."), *product("|", ".,"), (",", ","), *product(" ", ".,"))
#: A digit and a letter after it, which may begin a unit or be an SI prefix, but not the exponent of the number.
_QUANTITY = re.compile(r"\d[ \u00a0\u202f]{0,2}(?![eEdDT][+-]?\d)(?:[^\W\d_]|[%\u00b0])")
#: A number, date or time, which names nothing, such as the start in a preamble.
_VALUE = re.compile(r"[+-]?\d[-+\d.,:/TZ ]*")
_RULER = re.compile(r"[-=_:+]{1,80}")
_MAX_HEADING = 12  # most lines of a heading
_SPACED_LABEL = re.compile(r"\S+(?:\s{0,20}(?:\[[^\]]{0,40}\]|\([^)]{0,40}\)))?")
_DELIMITER_NAMES = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", " ": "blank"}


@dataclass(frozen=True)
class Layout:
    """The layout of a text log."""

    encoding: str
    delimiter: str  # separator of cells, where a blank stands for any white space
    decimal: str  # decimal separator
    labels: tuple[Label, ...]  # headings of the columns
    first_row: int  # index of the first line of samples
    description: str | None = None  # JSON written by Sealscope
    notes: tuple[str, ...] = ()  # lines for the history
    remarks: Mapping[str, str] = field(default_factory=dict)  # entries above the heading, name -> text
    lines_above: frozenset[str] = frozenset()  # lines above the first row, which some loggers repeat among the samples
    rate: float | None = None  # sampling rate [Hz] stated in these lines
    cell_units: Mapping[int, str] = field(default_factory=dict)  # column -> unit after each of its numbers
    prefixed: bool = False  # True if numbers end in SI prefixes

    @property
    def kind(self) -> str:
        """The layout in words, such as "text, comma separated, utf-8"."""
        comma = ", decimal comma" if self.decimal == "," else ""
        return f"text, {_DELIMITER_NAMES[self.delimiter]} separated{comma}, {self.encoding}"


def detect_encoding(head: bytes) -> str | None:
    """Detect the encoding of a text from the first bytes of its file; None if they are not text.

    The first that fits is chosen of these: the encoding of a byte order mark, UTF-16, UTF-8, gb18030 or Shift-JIS if
    the text has a known word, and cp1252 if control characters are rare.
    """
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
    ):
        if head.startswith(mark):
            return name
    if b"\0" in head:  # in UTF-16 without a mark every second byte of Latin text is 0
        n_pairs = max(len(head) // 2, 1)
        names = [name for i, name in enumerate(("utf-16-be", "utf-16-le")) if head[i::2].count(0) / n_pairs > 0.8]
        return names[0] if len(names) == 1 else None
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)  # incremental, as the last character may be cut
    except UnicodeDecodeError:
        for name in ("gb18030", "shift_jis"):
            try:
                if has_known_word(codecs.getincrementaldecoder(name)().decode(head)):
                    return name
            except UnicodeDecodeError:
                continue
        n_control = sum(byte < 9 or 13 < byte < 32 for byte in head)
        return "cp1252" if n_control <= len(head) // 100 else None
    return "utf-8"


def split_at_blanks(line: str) -> list[str]:
    """Split a line at blanks and tabs, but not at narrow blanks, which separate thousands."""
    return line.split() if line.isascii() else re.findall(r"[^ \t\v\f]+", line)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells at the `delimiter`, or at blanks and tabs if this is a blank.

    Other delimiters do not count within quotation marks, which are removed.
    """
    if delimiter == " ":
        return split_at_blanks(line)
    if '"' in line:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return line.split(delimiter)


def _used_width(row: Sequence[str]) -> int:
    """Count the cells of a row without the empty cells at its end."""
    return max((i for i, cell in enumerate(row, 1) if cell.strip()), default=0)


def _detect_dialect(body: Sequence[str]) -> tuple[str, str, int]:
    """Detect (delimiter, decimal separator, number of cells in a row) from lines of a log; (",", ".", 1) if unclear.

    Each pair of separators in `_DIALECTS` is tried. Its table consists of the rows of one width, namely the width with
    most values (numbers and time stamps), and must contain at least half of all values. A pair's rank is the number of
    values in its table over the number of cells, except missing ones, in all rows with a value.
    """
    ranks: dict[tuple[str, str, int], tuple[float, float, bool, int]] = {}
    text = "\n".join(body)
    for delimiter, decimal in _DIALECTS:
        if delimiter not in text and not (delimiter == " " and any(sign in text for sign in "\t\v\f")):
            continue
        rows = [row for row in (split_cells(line, delimiter) for line in body) if len(row) > 1]
        n_values = Counter[int]()  # by width of the row
        cells: list[str] = []  # of rows with a value
        for row in rows:
            count = sum(is_value(cell, decimal) for cell in row)
            n_values[len(row)] += count
            cells += row if count else []
        width = max(n_values, key=lambda row_width: (n_values[row_width], row_width), default=0)
        if cells and 2 * n_values[width] >= n_values.total():
            n_present = sum(not is_missing(cell) for cell in cells)
            n_grouped = sum(is_grouped(cell, decimal) for cell in cells)  # prefer dialects without separated thousands
            # later numbers decide only if the earlier ones are equal
            rank = n_values[width] / n_present, -n_grouped / n_present, delimiter != " ", width
            ranks[delimiter, decimal, width] = rank
    return max(ranks, key=ranks.__getitem__, default=(",", ".", 1))


def _split_heading(line: str, delimiter: str, width: int = 0) -> list[str]:
    """Split the heading line of a log into the names of columns.

    If the `delimiter` is a blank, a unit in brackets stays with its name. If this does not give `width` names (0: not
    known), but a split at tabs and at two or more blanks does, this split is used.
    """
    if delimiter == " ":
        names = _SPACED_LABEL.findall(line)
        names_with_blanks = re.split(r"\s{2,}|\t", line.strip())
        return names_with_blanks if len(names) != width and len(names_with_blanks) == width else names
    return [cell.strip() for cell in split_cells(line, delimiter)]


def _parse_unit_row(cells: Sequence[str]) -> list[str | None] | None:
    """Parse a row of units, with None for an empty cell; return None if none, or under 60 %, of them are known."""
    texts = [strip_word_before(cell.strip().strip("[]()<>'").strip()) for cell in cells]
    units = [text if text and text != "-" else None for text in texts]
    n_known = sum(unit is not None and is_unit(unit) for unit in units)
    return units if n_known and n_known >= 0.6 * sum(unit is not None for unit in units) else None


def _parse_heading(
    lines: Sequence[str], first_row: int, delimiter: str, width: int, decimal: str
) -> tuple[list[Label], int]:
    """Parse the heading of a log: rows of names and units above the line `first_row` of `lines`, or names in a comment.

    `width`: number of cells in a row of samples; `delimiter`, `decimal`: separators of cells and of decimals. Returns
    (labels of the columns, number of heading lines); ([], 0) if there is no heading.
    """

    def split_names(line: str) -> list[str] | None:
        """Split a heading line into names of columns; None if they do not fit the number of columns, or are values."""
        cells = _split_heading(line, delimiter, width)
        if cells and not cells[-1]:  # drop empty cells at the end, beyond the width
            cells = cells[: max(_used_width(cells), min(width, len(cells)))]
        # rows may end in a separator, or leave out the last columns; above a single column, more cells are a title's
        fits_width = abs(len(cells) - width) <= 1 or (len(cells) >= width > 1)
        names = [cell for cell in cells if cell]
        is_text = not all(is_value(name, decimal) for name in names)
        # an empty row between others, or formats of numbers such as 0.000
        is_ruler = len(cells) > 1 and (not names or len({*names}) == 1 < len(names))
        return cells if fits_width and ((names and is_text) or is_ruler) else None

    # from the lowest line up
    lines_above = [line.strip("\r\n ") for line in lines[first_row - 1 :: -1] if line.strip()] if first_row else []
    if not lines_above:
        return [], 0
    if (scope_heading := parse_scope_heading(lines[:first_row], delimiter)) is not None:
        return scope_heading
    rows: list[list[str]] = []
    for line in lines_above[:_MAX_HEADING]:
        if line.startswith(COMMENTS) or (row := split_names(line)) is None:
            break
        rows.append(row)
    if rows:
        labels, n_lines = _parse_keyed_rows(rows) or _parse_stacked_rows(rows)
        # descriptions of the columns may be in a row of labels, or in a table above the heading
        is_label_row = [row[0].strip().casefold() in WORDS["row"]["label"] for row in rows]
        description_lines = [*compress(lines_above, is_label_row), *lines_above[n_lines:]][::-1]  # from the top down
        return apply_descriptions(labels, [split_cells(line, delimiter) for line in description_lines]), n_lines
    if lines_above[0].startswith(COMMENTS) and not lines_above[0].startswith(DESCRIPTION_MARK):
        names_in_comment = split_names(lines_above[0].lstrip('#%/!" ').rstrip('"'))
        return ([Label.parse(name) for name in names_in_comment], 1) if names_in_comment else ([], 0)
    return [], 0


def _parse_keyed_rows(rows: Sequence[Sequence[str]]) -> tuple[list[Label], int] | None:
    """Parse heading rows, the lowest first, that begin with the keys `Name`, `Unit` or similar; None for other rows.

    Returns the labels of the columns, and the number of heading rows. The first column, which has no unit, is named by
    its key (`Name`), or by the lowest row if that has a single cell.
    """
    keys = [row[0].strip().rstrip(":").casefold() for row in rows]
    name_row = next((i for i, key in enumerate(keys) if key in WORDS["row"]["name"] and _used_width(rows[i]) > 1), None)
    unit_row = next((i for i, key in enumerate(keys) if key in WORDS["row"]["unit"]), None)
    if name_row is None or unit_row is None:
        return None
    # the lowest row may be the name of the first column, on a line of its own
    first_name = rows[0][0] if _used_width(rows[0]) == 1 else rows[name_row][0]
    names = [first_name, *rows[name_row][1:]]
    units = chain([None], _parse_unit_row(rows[unit_row][1:]) or [], repeat(None))
    labels = [Label.parse(name, unit) for name, unit in zip(names, units, strict=False)]
    return labels, max(name_row, unit_row) + 1


def _parse_stacked_rows(rows: Sequence[Sequence[str]]) -> tuple[list[Label], int]:
    """Parse heading rows without keys, from the lowest up: a row of names, and possibly other rows.

    Rulers such as `----` may stand below the names, units below or above them, and names of groups of columns on top;
    the name of a group is put before the names of its columns. Returns (labels of the columns, number of rows).
    """
    n_rulers = next((i for i, row in enumerate(rows[:-1]) if not (_is_ruler(row) or _is_type_row(row))), len(rows) - 1)
    row, *rows_above = rows[n_rulers:]
    names = list(row)
    n_rows = n_rulers + 1
    units = (_parse_graphtec_units(row) or _parse_unit_row(row)) if rows_above else None
    if units is not None:  # units below the names
        index = _find_name_row(rows_above)
        names, n_rows = _fill_names(rows_above[index], rows_above[index + 1 :]), n_rows + index + 1
        rows_above = rows_above[index + 1 :]
        if index:  # the other rows say other things of the columns
            n_rows, rows_above = n_rows + len(rows_above), []
    elif (
        rows_above
        and (units := _parse_unit_row(rows_above[0])) is not None
        and None not in units
        and len(units) == len(row) > 1
    ):  # units above the names, one for each; others may be names of groups
        rows_above, n_rows = rows_above[1:], n_rows + 1
    else:
        units = []
    while rows_above and (grouped_names := _prefix_groups(names, rows_above[0])) is not None:
        names, rows_above, n_rows = grouped_names, rows_above[1:], n_rows + 1
    labels = [Label.parse(name, unit) for name, unit in zip(names, chain(units, repeat(None)), strict=False)]
    return split_pairs(labels), n_rows


def _find_name_row(rows: Sequence[Sequence[str]]) -> int:
    """Find the row of names among the heading rows above the units, the lowest first; return its index.

    It is the lowest row, unless that names no quantity, as registers, comments or a row with one text in all cells, and
    another row that fills the same columns names some. Of several such rows, the one that names most is chosen, and of
    equal ones the highest.
    """
    filled = [{column for column, cell in enumerate(row) if cell.strip()} for row in rows]
    n_named = [0 if _is_ruler(row) or _is_type_row(row) else sum(map(_names_quantity, row)) for row in rows]
    if n_named[0]:
        return 0
    candidates = [i for i in range(len(rows)) if n_named[i] and filled[i] >= filled[0]]
    return max(candidates, key=lambda i: (n_named[i], i), default=0)


def _names_quantity(cell: str) -> bool:
    """Test whether a cell of a heading is the name of a channel or of a quantity."""
    name = Label.parse(cell).name
    return name.casefold() in {channel.casefold() for channel in CHANNEL_UNITS} or (len(name) > 1 and is_quantity(cell))


def _is_type_row(row: Sequence[str]) -> bool:
    """Test whether all cells of a row are names of data types, as in the heading of a PLC."""
    cells = [cell.strip().casefold() for cell in row if cell.strip()]
    return bool(cells) and all(cell in WORDS["row"]["type"] for cell in cells)


def _fill_names(names: Sequence[str], rows_above: Sequence[Sequence[str]]) -> list[str]:
    """Fill empty names of columns by the lowest text above them, such as `Date` in another row of a PLC's heading."""
    result = list(names)
    for row in rows_above:
        n_missing = len(result) - len(row)
        above = [*row, *[""] * max(n_missing, 0)]
        result = [name if name.strip() else cell for name, cell in zip(result, above, strict=False)]
    return result


def _prefix_groups(names: Sequence[str], row: Sequence[str]) -> list[str] | None:
    """Put the names of groups of columns, in the row above their names, before these; None if the row has no groups.

    A group is named above its first column only, or above each of its columns. The row has groups if it tells columns
    of the same name apart. It also has groups if no column is called as a channel, and either one of its cells is a
    quantity, or groups are named above each of their columns, but not above the first one, the time.
    """
    cells = [cell.strip() for cell in row]
    filled = [cell for cell in cells if cell]
    channel_names = {name.casefold() for name in CHANNEL_UNITS}
    groups = [*accumulate(cells, lambda group, cell: cell or group, initial="")][1:]
    groups += groups[-1:] * (len(names) - len(groups))
    repeated = [a for a, b in pairwise(cells) if a and a == b]
    if repeated and len(filled) > len({*filled}):  # named above each of its columns
        groups = [*cells, *[""] * (len(names) - len(cells))]
    pairs = [(group, name) for group, name in zip(groups, names, strict=False) if name]
    n_pairs, n_names = len({*pairs}), len({name for _, name in pairs})
    has_channels = any(Label.parse(text).name.casefold() in channel_names for text in names)
    has_quantity = any(is_quantity(cell) and not _VALUE.fullmatch(cell) for cell in cells) and not has_channels
    tells_apart = n_pairs == len(pairs) > n_names
    is_above_each = bool(repeated) and not has_channels and cells[0] in ("", names[0])  # the time is in no group
    if not filled or not (has_quantity or tells_apart or is_above_each):
        return None
    return [
        name if name == group or (tells_apart and not group) else f"{group} {name}".strip()
        for name, group in zip(names, groups, strict=False)
    ]


def _parse_graphtec_units(row: Sequence[str]) -> list[str | None] | None:
    """Parse the row of units that Graphtec loggers write, `NO.,Time,ms,V,...`; return None for any other row."""
    cells = [cell.strip() for cell in row]
    if [cell.casefold() for cell in cells[:3]] != ["no.", "time", "ms"]:
        return None
    return [cell if column > 1 and is_unit(cell) else None for column, cell in enumerate(cells)]


def _is_ruler(row: Sequence[str]) -> bool:
    """Test whether a row is a ruler such as `----`, or has the same text, which is not a unit, in all its cells."""
    cells = [cell.strip() for cell in row if cell.strip()]
    is_repeated = len(set(cells)) == 1 < len(cells) and _parse_unit_row(cells) is None
    return is_repeated or all(_RULER.fullmatch(cell) for cell in cells)


def detect_layout(head: bytes, encoding: str, place: str, *, is_complete: bool) -> Layout:
    """Detect the layout of a text log from its beginning `head`, which may be the whole log (`is_complete`).

    `place`: the file in messages. Raises InputError for a text without rows of numbers.
    """
    text = head.decode(encoding, errors="replace").lstrip("\ufeff")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not is_complete:  # the last line may be cut
        if len(lines) < 2:
            raise InputError(f"a text log must have lines, got none that ends within {SNIFF} bytes")
        lines.pop()
    if len(lines) > 1 and lines[0].startswith(DESCRIPTION_MARK) and lines[1].startswith("t [s]"):
        delimiter = "\t" if "\t" in lines[1] else ","
        channel_labels = tuple(Label.parse(cell) for cell in lines[1].split(delimiter))
        description = lines[0].removeprefix(DESCRIPTION_MARK)
        return Layout(encoding, delimiter, ".", channel_labels, first_row=2, description=description)
    content = [line for line in lines if _is_content(line)]
    if not content:
        raise InputError("a recording must have samples, got an empty file")
    # rows for the detection: the second half, or the last 20 if these are more, as remarks and a heading come first
    rows = content[max(1, min(len(content) // 2, len(content) - 20)) :] or content
    body = rows[-_N_ROWS:]
    original_lines = lines
    if prefixed := any(map(has_prefixes, _iter_splits(rows))):
        body = [expand_prefixes(line) for line in body]
        lines = [_expand_sample_prefixes(line) for line in lines]
    # by the delimiter that gives most columns with units, as the dialect is found only after the units are removed
    cell_units = {} if prefixed else max(map(find_cell_units, _iter_splits(body)), key=len, default={})
    if cell_units:
        lines, body = ([remove_units(line, cell_units.values()) for line in part] for part in (lines, body))
    delimiter, decimal, width = _detect_dialect(body)
    first_row = _find_first_row(lines, body, delimiter, decimal, width)
    if first_row is None:
        raise _no_rows_error(content[0], delimiter if width > 1 else None)
    labels, n_heading = _parse_heading(lines, first_row, delimiter, width, decimal)
    notes: list[str] = []
    if not labels:
        labels = [Label(str(i + 1), str(i + 1)) for i in range(width)]
        notes.append("no header: columns are called by their number, from 1")
    if cell_units:
        labels = add_units(labels, cell_units, place)
    lines_above = [line for line in original_lines[:first_row] if line.strip()]
    lines_before_heading = lines_above[: len(lines_above) - n_heading]
    uncommented = [line for line in lines_before_heading if not line.startswith(COMMENTS)]
    n_unused = len(uncommented) - len(parse_remarks(uncommented, delimiter))
    if n_unused > 0:
        notes.append(f"{format_count(n_unused, 'line')} before the header not used")
    notes += ["numbers such as 170.3m read with their prefix, as 0.1703"] if prefixed else []
    return Layout(
        encoding, delimiter, decimal, tuple(labels), first_row, notes=tuple(notes),
        remarks=parse_remarks(lines_before_heading, delimiter),
        lines_above=frozenset(line.strip() for line in lines_above),
        rate=stated_rate(parse_remarks(lines_above, delimiter)), cell_units=cell_units, prefixed=prefixed,
    )  # fmt: skip


def _no_rows_error(line: str, delimiter: str | None) -> InputError:
    """Build the InputError for a text without rows of numbers, given its first line and its delimiter, if known."""
    kind = {"{": "JSON", "[": "JSON", "<": "XML or HTML"}.get(line.lstrip()[:1])
    if kind is not None:
        return InputError(f"a recording must be a table, got {kind}: export it as CSV")
    likely = max("\t;,|", key=line.count) if any(character in line for character in "\t;,|") else " "
    names = ", ".join(_split_heading(line, delimiter or likely))
    return InputError(f"a recording must have samples, got no row of numbers after {names[:80]}")


def _is_content(line: str) -> bool:
    """Test whether a line is neither blank nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _find_first_row(lines: Sequence[str], body: Sequence[str], delimiter: str, decimal: str, width: int) -> int | None:
    """Find the index of the first line with samples in over half of the numeric columns; None if there is none.

    `body`: lines of samples that show which columns are numeric; `width`: number of cells in a row. Missing cells count
    as samples, but a row needs at least one number or time stamp.
    """
    rows = [row for row in (split_cells(line, delimiter) for line in body) if len(row) == width]
    is_value_cell = [[is_value(cell, decimal) for cell in row] for row in rows]
    max_values = max(map(sum, is_value_cell), default=0)
    # rows with fewer than half as many values may belong to the lines above the samples
    has_samples = [0 < max_values <= 2 * sum(row) for row in is_value_cell]
    rows, is_value_cell = [*compress(rows, has_samples)], [*compress(is_value_cell, has_samples)]
    numeric_columns = [
        i
        for i in range(width)
        if 2 * sum(row[i] for row in is_value_cell) > sum(not is_missing(row[i]) for row in rows)
    ]
    # True if some rows of samples begin with a word, such as the name of a state
    may_begin_with_word = any(
        not flags[0] and not is_missing(row[0]) for row, flags in zip(rows, is_value_cell, strict=True)
    )
    min_cells = max(1, min(width, (numeric_columns or [0])[-1] + 1))  # up to the last numeric column

    def is_sample(cells: Sequence[str]) -> bool:
        """Test whether the cells of a line are those of samples."""
        if len(cells) < min_cells or not (may_begin_with_word or is_value(cells[0], decimal) or is_missing(cells[0])):
            return False  # such as a row `SampleRate,500,500` above the samples
        n_values = sum(i < len(cells) and is_value(cells[i], decimal) for i in numeric_columns)
        n_missing = sum(i < len(cells) and is_missing(cells[i]) for i in numeric_columns)
        return bool(n_values) and 2 * (n_values + n_missing) > len(numeric_columns)

    for index, line in enumerate(lines):
        cells = split_cells(line, delimiter) if _is_content(line) else []
        if is_sample(cells):
            texts = [cell for cell in cells if cell.strip()]
            next_line = next(filter(_is_content, islice(lines, index + 1, None)), None)
            is_format = len({*texts}) == 1 < len(texts) and next_line is not None
            if not is_format or is_sample(split_cells(next_line or "", delimiter)):
                return index  # not a row of formats, such as 0.000, above that of units
    return None


def _expand_sample_prefixes(line: str) -> str:
    """Replace the SI prefixes of numbers in a line, `2.5k` by `2.5e3`, if most of its cells are numbers then."""
    expanded = expand_prefixes(line)
    cells = re.split(r"[;,|\t]", expanded)
    return expanded if 2 * sum(is_value(cell, ".") for cell in cells) > len(cells) else line


def _iter_splits(lines: Sequence[str]) -> Iterator[list[list[str]]]:
    """Yield the cells of all `lines` once for each usual delimiter; nothing if no number has a unit or SI prefix."""
    if any(map(_QUANTITY.search, lines)):  # most logs have no such number, and need not be split
        yield from ([split_cells(line, delimiter) for line in lines] for delimiter in "\t;|,")
