"""The heading of a column: its name, and the unit in it."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.units import parse_unit, same_dimension

#: Brackets as they are typed between Chinese or Japanese signs.
_WIDE = str.maketrans("\uff08\uff09\uff3b\uff3d\u3010\u3011", "()[][]")
#: `Druck in bar`, `p_A/bar`, `p_A, bar`: what stands behind is a unit where a channel may have it.
_BEHIND = re.compile(r"(?P<name>.{1,80}?)(?:\s+in\s+|\s*/|\s*,\s+)(?P<unit>\S{1,20})")


@dataclass(frozen=True)
class Label:
    """A column's heading: `whole` as written, `name` without the unit, `unit` where one is given.

    `called`: the column's own name, where `name` is what a user has typed for its channel.
    """

    whole: str
    name: str
    unit: str | None = None
    called: str = ""

    @classmethod
    def parse(cls, text: str, unit: str | None = None) -> Label:
        """Parse `p_A [psi]`, `p_A (psi)`, `p_A / psi` or `p_A in psi`; a unit given elsewhere (a row) is `unit`."""
        whole = text.strip().translate(_WIDE)
        name, bracketed = square_brackets(whole)
        if bracketed is not None:
            return cls(whole, name, bracketed if unit is None else unit)
        name, remark = _round_brackets_or_stroke(whole)
        behind = _BEHIND.fullmatch(whole) if unit is None and remark is None else None
        if behind and any(same_dimension(behind["unit"], known) for known in (*CHANNEL_UNITS.values(), "s")):
            return cls(whole, behind["name"].rstrip(), behind["unit"])
        if unit is None and remark and is_unit(remark):  # round brackets may hold a remark: `pressure (port A)`
            unit = remark
        return cls(whole, name, unit)


def is_unit(text: str) -> bool:
    """Test whether a text is a known unit."""
    try:
        parse_unit(text)
    except InputError:
        return False
    return True


def square_brackets(text: str) -> tuple[str, str | None]:
    """Split `name [unit]`, without blanks around; (text, None) for any other text."""
    begin = text.rfind("[")
    if begin < 0 or not text.endswith("]") or "]" in text[begin:-1]:
        return text, None
    return text[:begin].rstrip(), text[begin + 1 : -1].strip()


def _round_brackets_or_stroke(text: str) -> tuple[str, str | None]:
    """Split `name (unit)`, or `name / unit`, where this is possible first; (text, None) for any other text."""
    ends: list[tuple[int, int]] = []  # where the name ends, and the unit begins
    parts = text.split("/")
    for count in (2, 1):  # `name / m/s`, `name / s`
        unit = "/".join(parts[-count:])
        end = len(text) - len(unit) - 1
        if end > 1 and text[end - 1].isspace() and unit[:1].isspace() and all(unit[1:].split("/")):
            ends.append((end - 1, end + 1))
    depth = opened = 0
    for index in range(len(text) - 1, -1, -1) if text.endswith(")") else ():
        depth += {")": 1, "(": -1}.get(text[index], 0)
        opened += text[index] == "("
        if depth == 0:
            if opened <= 2:
                ends.append((len(text[:index].rstrip()), index))
            break
    end, begin = min(ends, default=(0, 0))
    if not end:
        return text, None
    return text[:end].rstrip(), (text[begin + 1 : -1] if text[begin] == "(" else text[begin:]).strip()
