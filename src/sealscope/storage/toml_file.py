"""Read TOML: a file from outside, bounded and with errors of one line, or a package's priors."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

from sealscope.errors import InputError
from sealscope.storage.opening import open_regular
from sealscope.storage.plain_values import LARGEST_WHOLE, as_type

_T = TypeVar("_T")
#: Largest file read [bytes]; what is larger is no file of settings.
LARGEST = 1_000_000
#: Most dots in a key: tomllib takes a time that goes with their square. What keys consist of.
_MOST_DOTS = 30
_KEYS = re.compile(r"[\w.\"' \t\r-]+")
#: Bytes that tomllib and the checks take for a table, for an element of an array of tables, for a key's value, and for
#: a value in an array; how many may be taken in all, and how many times those of the text.
_TABLE, _ROW, _ENTRY, _VALUE, _MEMORY, _SHARE = 900, 60, 110, 70, 2_000_000, 6
_HEADER, _INNER_KEY = re.compile(r"\s*\[[^\[\],]*\]\s*(?:#.*)?\n?"), re.compile(r"[{,]([^{},=]*)=")


def read_toml(path: Path, what: str, place: str, largest: int = LARGEST) -> dict[str, Any]:
    """Read the tables of the TOML file `path`; its kind `what` ("a rig file") and its `place` stand in the errors.

    Raises InputError where it cannot be read, has more than `largest` bytes, is not UTF-8 or not TOML, or holds a whole
    number beyond 2^53, which doubles do not hold, or a key of more than 30 dots.
    """
    try:
        with open_regular(path, what) as file:
            data = file.read(largest + 1)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{what} must be readable, got: {reason} ({place})") from None
    return parse_toml(data, what, place, largest)


def parse_toml(data: bytes, what: str, place: str, largest: int = LARGEST) -> dict[str, Any]:
    """Return the tables of the bytes of a TOML file; errors and limits as `read_toml` has them."""
    if len(data) > largest:
        raise InputError(f"{what} must be at most {largest} bytes, got more ({place})")
    try:
        text = data.decode("utf-8-sig")
        if any(part[0].count(".") > _MOST_DOTS for part in _KEYS.finditer(text)):
            raise ValueError(f"a dotted key must have at most {_MOST_DOTS} dots")
        if (memory := _count_memory(text)) > max(_MEMORY, _SHARE * len(data)):
            raise ValueError(f"{len(data)} bytes of text must hold fewer tables and values, got some {memory} bytes")
        tree = tomllib.loads(text)
        _check_whole_numbers(tree)
    except UnicodeDecodeError as error:
        raise InputError(f"{what} must be UTF-8 text, got byte {data[error.start]:#04x} ({place})") from None
    except (ValueError, RecursionError) as error:  # tomllib lets errors of dates and of very long numbers through
        raise InputError(f"{what} must be TOML: {str(error).splitlines()[0]} ({place})") from None
    return tree


def read_model(
    tree: Mapping[str, Any], kind: type[_T], place: str, named: Callable[[str], str] = str, context: Any = None
) -> _T:
    """Read the tables of a TOML file as the model or dataclass `kind` (`plain_values.as_type`).

    Raises InputError that names the entry, the rule, the value and the `place`.
    """
    try:
        return as_type(kind, tree, named, context)
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None


@cache
def priors_of(package: str) -> Mapping[str, Mapping[str, Any]]:
    """Read the values of a package's `priors.toml` by table and name; each states its unit and source.

    Raises KeyError where a row lacks unit or source.
    """
    tables = tomllib.loads((files(package) / "priors.toml").read_text("utf-8"))
    return {
        table: {name: (row["value"], row["unit"], row["source"])[0] for name, row in rows.items()}
        for table, rows in tables.items()
    }


def _count_memory(text: str) -> int:
    """Return about how many bytes the tables and values of a text take, at most, without parsing it."""
    tables = rows = 0
    for line in StringIO(text):
        if line.lstrip().startswith("[["):
            rows, tables = rows + 1, tables + line.count(".")
        elif _HEADER.fullmatch(line):
            tables += 1 + line.count(".")
        else:
            tables += line.partition("=")[0].count(".") + line.count("{")
            tables += sum(key[1].count(".") for key in _INNER_KEY.finditer(line))
    return _TABLE * tables + _ROW * rows + _ENTRY * text.count("=") + _VALUE * (text.count(",") + text.count("["))


def _check_whole_numbers(value: Any) -> None:
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        raise ValueError("a whole number must be at most 2^53 in size")
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_whole_numbers(inner)
