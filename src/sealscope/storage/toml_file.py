"""Read TOML: a file from outside, bounded and with errors of one line, or a package's priors."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from sealscope.errors import InputError
from sealscope.storage.opening import open_regular
from sealscope.storage.plain_values import LARGEST_WHOLE, as_type

_T = TypeVar("_T")
#: Largest file read [bytes]; what is larger is no file of settings.
LARGEST = 1_000_000
#: Most dots in a key: tomllib takes a time that goes with their square. What stands between keys.
_MOST_DOTS = 30
_NO_KEY = re.compile(r"[^\w.\"'\s-]+|\n")


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
    if len(data) > largest:
        raise InputError(f"{what} must be at most {largest} bytes, got more ({place})")
    try:
        text = data.decode("utf-8-sig")
        if any(part.count(".") > _MOST_DOTS for part in _NO_KEY.split(text)):
            raise ValueError(f"a dotted key must have at most {_MOST_DOTS} dots")
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


def _check_whole_numbers(value: Any) -> None:
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        raise ValueError("a whole number must be at most 2^53 in size")
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_whole_numbers(inner)
