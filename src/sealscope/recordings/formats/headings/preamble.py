"""What a file says of its recording beside the samples: operator, machine, oil temperature, remarks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

#: Most entries that are kept, and the longest name and text of each.
_MOST, _LONGEST_NAME, _LONGEST_TEXT = 40, 60, 200
_PAIR = re.compile(r"([^:=]{1,60}?)[ \t]{0,8}[:=](?!\\|//)[ \t]{0,8}(.{1,400})")


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
    about = provenance.get("about")
    return entries(about.items()) if isinstance(about, Mapping) else {}


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
    printable = "".join(sign if sign.isprintable() else " " for sign in text[: 4 * longest])
    return " ".join(printable.split()).strip("\"'")[:longest]
