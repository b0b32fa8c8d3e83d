"""The heading of a column: its name and its unit."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.units import parse_unit, same_dimension


def _split_lists(tree: Any) -> Any:
    """Convert the comma-separated texts in nested tables, at any depth, to tuples of words."""
    if isinstance(tree, str):
        return tuple(tree.replace("\n", "").split(", "))
    return {key: _split_lists(value) for key, value in tree.items()}


_tree = tomllib.loads(files(__package__).joinpath("words.toml").read_text(encoding="utf-8"))
#: Meaning, or table of meanings -> words; the entries of `time`, `channel` and `stated` stay texts.
WORDS: dict[str, Any] = {**_split_lists(_tree), **{name: _tree[name] for name in ("time", "channel", "stated")}}


#: Full-width brackets of Chinese and Japanese text -> brackets.
_WIDE_BRACKETS = str.maketrans("\uff08\uff09\uff3b\uff3d\u3010\u3011", "()[][]")
#: `Druck in bar`, `p_A/bar`, `p_A, bar`: the last word is the unit if a channel can have it.
_TRAILING_UNIT = re.compile(r"(?P<name>.{1,80}?)(?:\s+in\s+|\s*/|\s*,\s+)(?P<unit>\S{1,20})")

#: `Drehzahl_U/min`, `Flow l/min`: a unit that contains a slash itself.
_JOINED_UNIT = re.compile(r"(?P<name>.{1,80}?)[_\s]+(?P<unit>[^\s_/]{1,10}/[^\s_/]{1,10})")

#: `in bar`, `Einheit: bar`: a unit and a word before it.
_UNIT_AFTER_WORD = re.compile(
    rf"(?:{'|'.join(WORDS['before']['unit'])})(?:\s*[:=]\s*|\s+)(?P<unit>\S.{{0,20}})", re.IGNORECASE
)


@dataclass(frozen=True)
class Label:
    """Heading of a column of a table."""

    whole: str  # the heading as written
    name: str  # the heading without the unit, or a remark in brackets at its end
    unit: str | None = None
    called: str = ""  # the logger's name of the column if `name` is the description that the user has entered

    @classmethod
    def parse(cls, text: str, unit: str | None = None) -> Label:
        """Parse a heading such as `p_A [psi]`, `p_A / psi` or `p_A in psi`; `unit` overrides that in the heading."""
        whole = text.strip().translate(_WIDE_BRACKETS)
        name, bracket_text = split_square_brackets(whole)
        if bracket_text is not None:
            return cls(whole, name, strip_word_before(bracket_text) if unit is None else unit)
        name, remark = _split_brackets_or_slash(whole)
        if unit is None and remark is None:
            usual_units = (*CHANNEL_UNITS.values(), "s", "m/s", "1/s")
            for pattern in (_JOINED_UNIT, _TRAILING_UNIT):
                match = pattern.fullmatch(whole)
                if match and any(same_dimension(match["unit"], usual) for usual in usual_units):
                    return cls(whole, match["name"].rstrip(), match["unit"])
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


def strip_word_before(text: str) -> str:
    """Remove the word before a unit, as in `in bar` or `Einheit: bar`; return any other text as it is."""
    match = _UNIT_AFTER_WORD.fullmatch(text.strip())
    return match["unit"] if match is not None and is_unit(match["unit"]) else text


def split_square_brackets(text: str) -> tuple[str, str | None]:
    """Split `name [unit]` into name and unit; return (text, None) for any other text."""
    begin = text.rfind("[")
    if begin < 0 or not text.endswith("]") or "]" in text[begin:-1]:
        return text, None
    return text[:begin].rstrip(), text[begin + 1 : -1].strip()


def _split_brackets_or_slash(text: str) -> tuple[str, str | None]:
    """Split `name (unit)` or `name / unit` into name and unit; return (text, None) for any other text.

    Of several possible splits, one with a known unit is preferred, and of these that with the shortest name.
    """
    splits: list[tuple[str, str]] = []  # name and unit
    parts = text.split("/")
    for count in (2, 1):  # `name / m/s`, `name / s`
        unit = "/".join(parts[-count:])
        end = len(text) - len(unit) - 1  # position of the slash, which must have blanks on both sides
        if end > 1 and text[end - 1].isspace() and unit[:1].isspace() and all(unit[1:].split("/")):
            splits.append((text[: end - 1].rstrip(), unit.strip()))
    depth = n_opened = 0
    for index in range(len(text) - 1, -1, -1) if text.endswith(")") else ():
        depth += {")": 1, "(": -1}.get(text[index], 0)
        n_opened += text[index] == "("
        if depth == 0:
            if n_opened <= 2:  # `name (m/(s V))`; deeper brackets do not contain a unit
                splits.append((text[:index].rstrip(), text[index + 1 : -1].strip()))
            break
    splits = [(name, strip_word_before(unit)) for name, unit in splits if name]
    return min(splits, key=lambda split: (not is_unit(split[1]), len(split[0])), default=(text, None))
