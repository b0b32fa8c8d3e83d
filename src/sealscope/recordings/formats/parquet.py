"""Parquet tables, with pyarrow: units in the columns' names, Sealscope's description in the table's metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import UnreadableFile
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import Choose, RawTable, check_size, check_texts, from_text, parse_description

_OWN = b"sealscope"


def _pyarrow() -> tuple[Any, Any]:
    return library("pyarrow", "Parquet", "pyarrow"), library("pyarrow.parquet", "Parquet", "pyarrow")


def read_parquet(path: Path, choose: Choose) -> RawTable:
    """Read the chosen columns of a Parquet table; raise MissingExtra where pyarrow is absent."""
    _, parquet = _pyarrow()
    place = str(path)
    with path.open("rb") as opened:
        if opened.read(6) == b"ARROW1":
            return _read_feather(path, choose)
    with parquet.ParquetFile(path) as file:
        schema = file.schema_arrow
        choice = choose([_label(field) for field in schema])
        fields = [schema.field(column) for column, _ in choice.columns]
        check_size(file.metadata.num_rows, len(fields), place)
        texts = [field.name for field in fields if _is_text(field)]
        for name in texts:
            check_texts(file.metadata.num_rows, 1, name, place)
    with parquet.ParquetFile(path, read_dictionary=texts) as file:  # a text that repeats is held but once
        table = file.read(columns=[field.name for field in fields])
        columns = [
            _values(table.column(field.name), field, time, place)
            for (_, time), field in zip(choice.columns, fields, strict=True)
        ]
        own = (schema.metadata or {}).get(_OWN)
    return RawTable("Parquet", choice, columns, parse_description(own, place) if own else None)


def _read_feather(path: Path, choose: Choose) -> RawTable:
    """Read the chosen columns of a Feather file, as Arrow writes tables beside Parquet."""
    place = str(path)
    table = library("pyarrow.feather", "Feather", "pyarrow").read_table(path)
    choice = choose([_label(field) for field in table.schema])
    fields = [table.schema.field(column) for column, _ in choice.columns]
    check_size(table.num_rows, len(fields), place)
    columns = [
        _values(table.column(column), field, time, place)
        for (column, time), field in zip(choice.columns, fields, strict=True)
    ]
    return RawTable("Feather", choice, columns)


def _label(field: Any) -> Label:
    metadata = field.metadata or {}
    unit = next((metadata[key].decode("utf-8", "replace") for key in (b"units", b"unit") if key in metadata), None)
    if field.name.startswith("__index_level_") and _is_moment(field):  # the index of a data frame, without a name
        return Label(field.name, "time", "s")
    return Label.parse(field.name, "s" if _is_moment(field) else unit)


def _is_moment(field: Any) -> bool:
    import pyarrow

    return bool(pyarrow.types.is_timestamp(field.type) or pyarrow.types.is_duration(field.type))


def _is_text(field: Any) -> bool:
    import pyarrow

    return bool(pyarrow.types.is_string(field.type) or pyarrow.types.is_large_string(field.type))


def _widest(column: Any) -> int:
    """Return the length [bytes] of the longest text of a column that is coded by a dictionary or plain."""
    import pyarrow
    from pyarrow import compute

    chunks = [chunk.dictionary if isinstance(chunk, pyarrow.DictionaryArray) else chunk for chunk in column.chunks]
    return max((compute.max(compute.binary_length(chunk)).as_py() or 0 for chunk in chunks), default=0)


def _values(column: Any, field: Any, time: bool, place: str) -> NDArray[Any]:
    import pyarrow

    types = pyarrow.types
    if time and types.is_timestamp(field.type):
        return np.asarray(column.cast(pyarrow.timestamp("ns", field.type.tz)).to_numpy().astype("datetime64[ns]"))
    if time and types.is_duration(field.type):
        nanoseconds = column.cast(pyarrow.duration("ns")).cast(pyarrow.int64())
        return np.asarray(nanoseconds.cast(pyarrow.float64(), safe=False).to_numpy(), dtype=np.float64) / 1e9
    if types.is_integer(field.type) or types.is_floating(field.type) or types.is_decimal(field.type):
        return np.asarray(column.cast(pyarrow.float64(), safe=False).to_numpy(), dtype=np.float64)
    if _is_text(field):
        check_texts(len(column), _widest(column), field.name, place)
        return from_text([cell or "" for cell in column.to_pylist()], time, field.name, place)
    raise UnreadableFile(f"{field.name} must hold numbers, got the type {field.type} ({place})")


def write_parquet(
    path: Path, values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]
) -> None:
    """Write columns `t [s]`, `p_A [Pa]`, ... as doubles, and the description in the table's metadata."""
    pyarrow, parquet = _pyarrow()
    columns = {f"{name} [{units[name]}]": pyarrow.array(series, from_pandas=False) for name, series in values.items()}
    table = pyarrow.table(columns)
    parquet.write_table(table.replace_schema_metadata({_OWN: json.dumps(description).encode()}), path)
