"""The heading of a column: its name, and the unit in it."""

from __future__ import annotations

from dataclasses import dataclass

from sealscope.errors import InputError
from sealscope.units import parse_unit


@dataclass(frozen=True)
class Label:
    """A column's heading: `whole` as written, `name` without the unit, `unit` where one is given."""

    whole: str
    name: str
    unit: str | None = None

    @classmethod
    def parse(cls, text: str, unit: str | None = None) -> Label:
        """Parse `p_A [psi]`, `p_A (psi)` or `p_A / psi`; a unit given elsewhere (a row or an attribute) is `unit`."""
        whole = text.strip()
        name, bracketed = square_brackets(whole)
        if bracketed is not None:
            return cls(whole, name, bracketed if unit is None else unit)
        name, remark = _round_brackets_or_stroke(whole)
        return cls(whole, name, _unit_or_none(remark) if unit is None else unit)


def square_brackets(text: str) -> tuple[str, str | None]:
    """Split `name [unit]`, without blanks around; (text, None) for any other text."""
    begin = text.rfind("[")
    if begin < 0 or not text.endswith("]") or "]" in text[begin:-1]:
        return text, None
    return text[:begin].rstrip(), text[begin + 1 : -1].strip()


def _round_brackets_or_stroke(text: str) -> tuple[str, str | None]:
    """Split `name (unit)`, the unit with one pair of brackets at most, or `name / unit`, where this is possible first.

    Returns (text, None) for any other text.
    """
    ends: list[tuple[int, int]] = []  # where the name ends, and the unit begins
    parts = text.split("/")
    for count in (2, 1):  # `name / m/s`, `name / s`
        unit = "/".join(parts[-count:])
        end = len(text) - len(unit) - 1
        if end > 1 and text[end - 1].isspace() and unit[:1].isspace() and all(unit[1:].split("/")):
            ends.append((end - 1, end + 1))
    depth = opened = 0
    for at in range(len(text) - 1, -1, -1) if text.endswith(")") else ():
        depth += {")": 1, "(": -1}.get(text[at], 0)
        opened += text[at] == "("
        if depth == 0:
            if opened <= 2:
                ends.append((len(text[:at].rstrip()), at))
            break
    end, begin = min(ends, default=(0, 0))
    if not end:
        return text, None
    return text[:end].rstrip(), (text[begin + 1 : -1] if text[begin] == "(" else text[begin:]).strip()


def _unit_or_none(text: str | None) -> str | None:
    """Return None for the remark that round brackets may hold as well (`pressure (port A)`)."""
    if not text:
        return None
    try:
        parse_unit(text)
    except InputError:
        return None
    return text
