"""Read and write TOML files: those of others, with limits and errors of one line, and the priors of a package."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Collection, Mapping
from importlib.resources import files
from io import StringIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

from sealscope.errors import InputError
from sealscope.storage.opening import open_regular
from sealscope.storage.plain_values import MAX_WHOLE, convert_type

_T = TypeVar("_T")
#: Largest file that is read [bytes].
_MAX_SIZE = 1_000_000
#: Most dots in a key, as tomllib's time grows with their square.
_MAX_DOTS = 30
#: A piece of text that may be a key.
_KEY = re.compile(r"[\w.\"' \t\r-]+")
#: Memory [bytes] for a table, an element of an array of tables, a key's value, and a value in an array.
_TABLE, _ROW, _ENTRY, _VALUE = 900, 60, 110, 70
#: Most memory of a parsed file [bytes], and relative to the file's size; the larger limit applies.
_MAX_MEMORY, _MEMORY_RATIO = 2_000_000, 6
#: A line with the header of a table, and a key of an inline table.
_HEADER, _INNER_KEY = re.compile(r"\s*\[[^\[\],]*\]\s*(?:#.*)?\n?"), re.compile(r"[{,]([^{},=]*)=")


def read_toml(path: Path, what: str, place: str) -> dict[str, Any]:
    """Read the TOML file at `path`, as `parse_toml` does; raise InputError if it cannot be read."""
    try:
        with open_regular(path, what) as file:
            data = file.read(_MAX_SIZE + 1)
    except InputError:  # is a ValueError, with a complete message
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{what} must be readable, got: {reason} ({place})") from None
    return parse_toml(data, what, place)


def parse_toml(data: bytes, what: str, place: str) -> dict[str, Any]:
    """Parse the content `data` of a TOML file; `what` ("a rig file") and `place` name the file in error messages.

    Raises InputError if the content is larger than `_MAX_SIZE`, is not UTF-8 or not TOML, has a whole number over 2^53
    or a key with more than 30 dots, or would take too much memory.
    """
    if len(data) > _MAX_SIZE:
        raise InputError(f"{what} must be at most {_MAX_SIZE} bytes, got more ({place})")
    try:
        text = data.decode("utf-8-sig")
        if any(key[0].count(".") > _MAX_DOTS for key in _KEY.finditer(text)):
            raise ValueError(f"a dotted key must have at most {_MAX_DOTS} dots")
        max_memory = max(_MAX_MEMORY, _MEMORY_RATIO * len(data))
        if (memory := _estimate_memory(text)) > max_memory:
            raise ValueError(f"its tables must take at most {max_memory} bytes of memory, got about {memory} bytes")
        tree = tomllib.loads(text)
        _check_whole_numbers(tree)
    except UnicodeDecodeError as error:
        raise InputError(f"{what} must be UTF-8 text, got byte {data[error.start]:#04x} ({place})") from None
    except (ValueError, RecursionError) as error:  # tomllib: ValueError also for wrong dates and very long numbers
        raise InputError(f"{what} must be TOML: {str(error).splitlines()[0]} ({place})") from None
    return tree


def read_model(
    tree: Mapping[str, Any], kind: type[_T], place: str, entry_name: Callable[[str], str] = str, context: Any = None
) -> _T:
    """Convert the tables `tree` of the file `place` by `convert_type`; raise InputError if they do not fit."""
    try:
        return convert_type(kind, tree, entry_name, context)
    except ValueError as error:
        raise InputError(f"{error} ({place})") from None


@dataclass_transform(kw_only_default=True, frozen_default=True)
class PriorTable:
    """A read-only table of priors, the assumed or published numbers that a `priors.toml` states with their sources.

    A subclass annotates its keys, and gives a default for each optional one. Type checkers treat it as a frozen
    dataclass; a real one would take ten times longer to create at import.
    """

    def __init__(self, **values: Any) -> None:
        vars(self).update(values)  # as `__setattr__` refuses all changes

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a table of priors is frozen, got {name} = {value!r}")


def read_priors(package: str, kind: type[_T]) -> _T:
    """Read the `priors.toml` of a package, its assumed numbers, as an object of the class `kind`.

    The fields of `kind` are the tables of the file. Each is a `PriorTable` or a mapping, with numbers and tuples of
    numbers as values. In the file each key must have value, unit and source; the value is returned in that unit. Raises
    InputError, which names file, table and key, if a rule is broken.
    """
    place = f"{package.replace('.', '/')}/priors.toml"
    tables = tomllib.loads((files(package) / "priors.toml").read_text("utf-8"))
    kinds = get_type_hints(kind)
    _check_keys(tables, kinds, (), f"tables of {place}")
    return kind(**{name: _parse_table(rows, kinds[name], f"{place} [{name}]") for name, rows in tables.items()})


def _parse_table(rows: Mapping[str, Any], kind: Any, place: str) -> Any:
    """Convert a table of priors, with {value, unit, source} by key, to the type `kind`, a `PriorTable` or a mapping."""
    is_mapping = get_origin(kind) is not None  # such as Mapping[str, float]
    optional: tuple[str, ...] = ()
    if is_mapping:
        key_kind, value_kind = get_args(kind)
        # a Literal states the keys that the table must have; otherwise any keys are permitted
        kinds = dict.fromkeys(get_args(key_kind) if get_origin(key_kind) is Literal else rows, value_kind)
    else:
        kinds = get_type_hints(kind)
        optional = tuple(name for name in kinds if hasattr(kind, name))  # keys with a default
    _check_keys(rows, kinds, optional, f"keys of {place}")
    values = {}
    for name, row in rows.items():
        if not isinstance(row, dict) or set(row) != {"value", "unit", "source"} or not (row["unit"] and row["source"]):
            raise InputError(f"{place} {name} must have value, unit and source, got {row!r}")
        values[name] = _parse_value(row["value"], kinds[name], f"{place} {name}")
    return MappingProxyType(values) if is_mapping else kind(**values)


def _parse_value(value: Any, kind: Any, place: str) -> Any:
    """Convert the value of a prior to `kind`: int, float, or a tuple of them; raise InputError if it does not fit."""
    if get_origin(kind) is tuple:
        item_kind, *rest = get_args(kind)
        has_any_length = Ellipsis in rest  # tuple[float, ...]
        if not isinstance(value, list) or not (has_any_length or len(value) == 1 + len(rest)):
            raise InputError(f"{place} must be a list that fits {kind}, got {value!r}")
        return tuple(_parse_value(item, item_kind, place) for item in value)
    if isinstance(value, bool) or not isinstance(value, int if kind is int else (int, float)):
        raise InputError(f"{place} must be {'a whole number' if kind is int else 'a number'}, got {value!r}")
    return int(value) if kind is int else float(value)  # a float also where `kind` is `float | None`


def _check_keys(keys: Collection[str], names: Collection[str], optional: Collection[str], place: str) -> None:
    """Check that the `keys` of a table are `names`, of which `optional` may be missing; raise InputError otherwise."""
    for name in keys:
        if name not in names:
            raise InputError(f"{place} must be {', '.join(names)}, got {name!r}")
    for name in names:
        if name not in keys and name not in optional:
            raise InputError(f"{place} must be {', '.join(names)}, got none called {name!r}")


def format_tables(tree: Mapping[str, Any], path: str = "", heading: str = "") -> list[str]:
    """Format a table as lines of TOML: first plain values, then inner tables; None and empty tables are not written.

    `path` is the table's dotted name, "" for the whole file. In the file a list of tables becomes an array of tables;
    in a table, an inner table of plain values only takes one line. `heading` is the line before the table's values.
    """
    lines, inner_lines = list[str](), list[str]()
    for name, value in tree.items():
        inner_path = f"{path}.{_format_key(name)}" if path else _format_key(name)
        is_table = isinstance(value, Mapping)
        is_plain = is_table and all(isinstance(member, str | float | int | None) for member in value.values())
        is_inline = is_plain and bool(path) and len(value) > 0
        if is_table and not is_inline:
            inner_lines += format_tables(value, inner_path, f"[{inner_path}]")
        elif isinstance(value, list) and not path and all(isinstance(row, Mapping) for row in value):
            inner_lines += [line for row in value for line in format_tables(row, inner_path, f"[[{inner_path}]]")]
        elif value is not None:
            lines.append(f"{_format_key(name)} = {_format_value(value)}")
    return [*(["", heading, *lines] if lines else []), *inner_lines]


def _format_key(name: str) -> str:
    """Format a key for TOML, in quotes if TOML requires them."""
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _format_value(name)


def _format_value(value: Any) -> str:
    """Format a plain value as TOML; entries of a table that are None are left out."""
    if hasattr(value, "tolist"):  # an array of numpy
        value = value.tolist()
    if isinstance(value, Mapping):
        members = (f"{_format_key(name)} = {_format_value(item)}" for name, item in value.items() if item is not None)
        return "{ " + ", ".join(members) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_format_value, value)) + "]"
    if isinstance(value, float):  # as TOML, unlike JSON, has nan and inf
        return repr(value)
    if isinstance(value, str):  # names of files may contain bytes that are not UTF-8
        value = value.encode("utf-8", "backslashreplace").decode()
    return json.dumps(value, ensure_ascii=False, default=str).replace("\x7f", "\\u007f")  # TOML forbids a bare DEL


def _estimate_memory(text: str) -> int:
    """Estimate an upper limit of the memory [bytes] that a TOML text will take once it is parsed.

    Tables, elements of arrays of tables (`n_rows`), keys and values are counted by the punctuation of the text.
    """
    n_tables = n_rows = 0  # a dotted key makes a table for each dot
    for line in StringIO(text):
        if line.lstrip().startswith("[["):  # an element of an array of tables
            n_rows, n_tables = n_rows + 1, n_tables + line.count(".")
        elif _HEADER.fullmatch(line):  # the header of a table
            n_tables += 1 + line.count(".")
        else:  # a key and its value
            n_tables += line.partition("=")[0].count(".") + line.count("{")
            n_tables += sum(key[1].count(".") for key in _INNER_KEY.finditer(line))
    return _TABLE * n_tables + _ROW * n_rows + _ENTRY * text.count("=") + _VALUE * (text.count(",") + text.count("["))


def _check_whole_numbers(value: Any) -> None:
    """Check that no whole number in a value, or in its tables and arrays, exceeds 2^53; raise ValueError otherwise."""
    if isinstance(value, int) and abs(value) > MAX_WHOLE:
        raise ValueError("a whole number must be at most 2^53 in size")
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for inner in items:
        _check_whole_numbers(inner)
