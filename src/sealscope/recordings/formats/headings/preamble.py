"""What a file says of its recording beside the samples: operator, machine, oil temperature, remarks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from sealscope.errors import InputError, printable
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import parse_unit, to_si

#: Most entries that are kept, and the longest name and text of each.
_MOST, _LONGEST_NAME, _LONGEST_TEXT = 40, 60, 200
_PAIR = re.compile(r"([^:=]{1,60}?)[ \t]{0,8}[:=](?!\\|//)[ \t]{0,8}(.{1,400})")
#: What loggers call the sampling rate, and the time from one sample to the next.
_STATED = [re.compile(WORDS["stated"][kind], re.IGNORECASE) for kind in ("rate", "interval")]
_ENDING = re.compile(r"(?P<name>.{1,60}?)[_ ](?P<unit>[kM]?Hz|[mun\u00b5\u03bc]?s)")
#: TwinCAT's start of an export: 100 ns since 1601.
_FILETIME = re.compile(r"(1[23]\d{16})\b")
_FROM_1601_TO_1970 = 11_644_473_600 * 10**9  # [ns]
_TEMPERATURE = re.compile(
    r"(?P<value>[-+]?\d{1,3}(?:[.,]\d{1,3})?)\s*(?P<unit>°\s?[CF]|deg\s?[CF]|[CFK]\b|℃)", re.IGNORECASE
)
_UNIT_OF_NAME = re.compile(r"[\[(]\s*([^\])]{1,6}?)\s*[\])]")
_OIL = re.compile(r"temp|oil|öl|oel|fluid|huile|olio|aceite", re.IGNORECASE)
_QUANTITY = re.compile(r"(?P<number>[+-]?\d{1,12}(?:[.,]\d{1,12})?(?:[eE][+-]?\d{1,3})?)\s*(?P<unit>\S{0,10}).*")


def stated_rate(remarks: Mapping[str, str]) -> float | None:
    """Find the sampling rate [Hz] in a file's entries, stated by a rate or an interval; None without."""
    for name, text in remarks.items():
        label = Label.parse(name)
        if label.unit is None and (ending := _ENDING.fullmatch(label.name)):  # SamplePeriod_ms
            label = Label(name, ending["name"], ending["unit"])
        matches = [pattern.fullmatch(label.name) for pattern in _STATED]
        cells = re.split(r"[;,\t]\s*", text.strip())  # one a channel, all the same
        quantity = _QUANTITY.fullmatch(cells[0] if len(set(cells)) == 1 else text.strip())
        if quantity is None or not any(matches):
            continue
        usual = "Hz" if matches[0] else "s"
        unit = label.unit or quantity["unit"].strip("\"'[]();,") or usual
        try:
            per_second = parse_unit(unit).powers == parse_unit("Hz").powers
            value = to_si(float(quantity["number"].replace(",", ".")), unit, "Hz" if per_second else "s")
        except InputError:
            value, per_second = float(quantity["number"].replace(",", ".")), bool(matches[0])
        if value > 0.0:
            return float(f"{value if per_second else 1.0 / value:.12g}")
    return None


def exported_from(remarks: Mapping[str, str]) -> np.datetime64 | None:
    """Find the stated start of a TwinCAT Scope export; None without."""
    for name, entry in remarks.items():
        match = _FILETIME.match(entry) if name.casefold().startswith(("starttime", "start time")) else None
        if match is not None:
            return np.datetime64(int(match[1]) * 100 - _FROM_1601_TO_1970, "ns")
    return None


def entries(pairs: Iterable[tuple[object, object]]) -> dict[str, str]:
    """Return name -> text of the pairs that have both, printable and cut to length; the first of a name stays."""
    kept: dict[str, str] = {}
    for name, value in pairs:
        key, text = _line(str(name), _LONGEST_NAME), _line(str(value), _LONGEST_TEXT)
        if key and text and key not in kept:
            kept[key] = text
        if len(kept) == _MOST:
            break
    return kept


def remarks_of(provenance: Mapping[str, object]) -> dict[str, str]:
    """Return the entries that a recording's provenance holds, whoever has written it."""
    remarks = provenance.get("about")
    return entries(remarks.items()) if isinstance(remarks, Mapping) else {}


def of_lines(lines: Sequence[str], delimiter: str) -> dict[str, str]:
    """Return the entries of the lines above a log's header: `Operator: N. N.`, `Oil = 40 degC`, `Date;2024-05-31`."""
    pairs: list[tuple[str, str]] = []
    for line in lines[: 4 * _MOST]:
        text = line.strip().lstrip("#%/!\" '").strip()[:500]
        if delimiter.strip() or delimiter == "\t":
            name, sign, value = text.partition(delimiter)
            if sign and name.strip() and value.strip(f" {delimiter}") and ":" not in name:
                pairs.append((name, value.strip(f" {delimiter}")))
                continue
        match = _PAIR.fullmatch(text)
        if match is not None:
            pairs.append((match[1], match[2].strip(f" {delimiter}")))
    return entries(pairs)


def _line(text: str, longest: int) -> str:
    return " ".join(printable(text[: 4 * longest], instead=" ").split()).strip("\"'")[:longest]


def stated_oil_temperature(provenance: Mapping[str, object]) -> float | None:
    """Return the oil's temperature [deg C] by a recording's provenance, None where it does not state it."""
    for name, text in remarks_of(provenance).items():
        if not _OIL.search(name):
            continue
        unit_of_name = _UNIT_OF_NAME.search(name)
        match = _TEMPERATURE.search(text if unit_of_name is None else f"{text} {unit_of_name[1]}")
        if match is None:
            continue
        value, unit = float(match["value"].replace(",", ".")), match["unit"].upper().replace("℃", "C")[-1]
        celsius = (value - 32.0) / 1.8 if unit == "F" else value - 273.15 if unit == "K" else value
        if -60.0 < celsius < 200.0:
            return celsius
    return None
