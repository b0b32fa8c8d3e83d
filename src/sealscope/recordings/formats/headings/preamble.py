"""Remarks on a recording in the header of its file, such as operator and machine, and the sampling rate in them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from sealscope.errors import InputError, printable
from sealscope.recordings.formats.headings.labels import WORDS, Label
from sealscope.units import parse_unit, to_si

#: Most remarks that are read, and the longest name and text of each.
_MAX_REMARKS, _MAX_NAME, _MAX_TEXT = 40, 60, 200
_PAIR = re.compile(r"([^:=]{1,60}?)[ \t]{0,8}[:=](?!\\|//)[ \t]{0,8}(.{1,400})")
#: Names of the sampling rate, and of the sampling interval.
_STATED_NAMES = [re.compile(WORDS["stated"][kind], re.IGNORECASE) for kind in ("rate", "interval")]
_ENDING = re.compile(r"(?P<name>.{1,60}?)[_ ](?P<unit>[kM]?Hz|[mun\u00b5\u03bc]?s)")
#: TwinCAT's start of an export: 100 ns since 1601.
_FILETIME = re.compile(r"(1[23]\d{16})\b")
_FROM_1601_TO_1970 = 11_644_473_600 * 10**9  # [ns]
_QUANTITY = re.compile(r"(?P<number>[+-]?\d{1,12}(?:[.,]\d{1,12})?(?:[eE][+-]?\d{1,3})?)\s*(?P<unit>\S{0,10}).*")


def stated_rate(remarks: Mapping[str, str]) -> float | None:
    """Find the sampling rate [Hz] in the remarks of a file; None if they state neither a rate nor an interval.

    The unit may stand after the number or in the remark's name; without a unit, the number is in Hz or s.
    """
    for name, text in remarks.items():
        label = Label.parse(name)
        if label.unit is None and (ending := _ENDING.fullmatch(label.name)):  # SamplePeriod_ms
            label = Label(name, ending["name"], ending["unit"])
        is_rate, is_interval = (pattern.fullmatch(label.name) is not None for pattern in _STATED_NAMES)
        cells = re.split(r"[;,\t]\s*", text.strip())  # some loggers repeat it for each channel
        quantity = _QUANTITY.fullmatch(cells[0] if len(set(cells)) == 1 else text.strip())
        if quantity is None or not (is_rate or is_interval):
            continue
        default_unit = "Hz" if is_rate else "s"
        unit = label.unit or quantity["unit"].strip("\"'[]();,") or default_unit
        value = float(quantity["number"].replace(",", "."))
        with suppress(InputError):  # a number in an unknown unit is taken as Hz or s
            in_hertz = parse_unit(unit).powers == parse_unit("Hz").powers  # an interval may be stated as a rate
            value, is_rate = to_si(value, unit, "Hz" if in_hertz else "s"), in_hertz
        if value > 0.0:
            return float(f"{value if is_rate else 1.0 / value:.12g}")  # without rounding errors in the last digits
    return None


def scope_start(remarks: Mapping[str, str]) -> np.datetime64 | None:
    """Find the start time of a TwinCAT Scope export in the remarks of its header; None if it is not stated."""
    for name, entry in remarks.items():
        match = _FILETIME.match(entry) if name.casefold().startswith(("starttime", "start time")) else None
        if match is not None:
            return np.datetime64(int(match[1]) * 100 - _FROM_1601_TO_1970, "ns")  # counted in 100 ns from 1601
    return None


def collect_remarks(pairs: Iterable[tuple[object, object]]) -> dict[str, str]:
    """Collect up to `_MAX_REMARKS` pairs of name and text, both made printable and shortened.

    Of several pairs with one name the first is kept; pairs with an empty name or text are skipped.
    """
    remarks: dict[str, str] = {}
    for name, value in pairs:
        key, text = _clean_text(str(name), _MAX_NAME), _clean_text(str(value), _MAX_TEXT)
        if key and text and key not in remarks:
            remarks[key] = text
        if len(remarks) == _MAX_REMARKS:
            break
    return remarks


def collect_attributes(attributes: Mapping[Any, object]) -> dict[str, str]:
    """Collect the attributes of a file that are texts or numbers as remarks on the recording, name -> text."""
    return collect_remarks(pair for pair in attributes.items() if isinstance(pair[1], str | int | float))


def parse_remarks(lines: Sequence[str], delimiter: str) -> dict[str, str]:
    """Parse the remarks above a log's heading, such as `Operator: N. N.`, `Oil = 40 degC` or `Date;2024-05-31`.

    Returns name -> text. Only the first 4 * `_MAX_REMARKS` of the `lines`, and 500 characters of each, are read.
    `delimiter`: separator of the log's cells, which may also separate the name of a remark from its text.
    """
    pairs: list[tuple[str, str]] = []
    for line in lines[: 4 * _MAX_REMARKS]:
        text = line.strip().lstrip("#%/!\" '").strip()[:500]
        if delimiter.strip() or delimiter == "\t":  # not a blank, which a name of two words contains, too
            name, separator, value = text.partition(delimiter)
            # a name with a colon ends there: `Operator: A, B`
            if separator and name.strip() and value.strip(f" {delimiter}") and ":" not in name:
                pairs.append((name, value.strip(f" {delimiter}")))
                continue
        match = _PAIR.fullmatch(text)
        if match is not None:
            pairs.append((match[1], match[2].strip(f" {delimiter}")))
    return collect_remarks(pairs)


def _clean_text(text: str, max_length: int) -> str:
    """Make a text printable, on one line, at most `max_length` characters long and without outer quotation marks."""
    return " ".join(printable(text[: 4 * max_length], instead=" ").split()).strip("\"'")[:max_length]
