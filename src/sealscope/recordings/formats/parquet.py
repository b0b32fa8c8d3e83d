"""Parquet and Feather tables, with pyarrow: units in the columns' names, our description in the table's metadata."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import Array
from sealscope.recordings.formats.columns import Wanted
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import entries, stated_rate
from sealscope.recordings.formats.libraries import library
from sealscope.recordings.formats.table import RecordingFields, Series, check_texts, parse_description, table_of

_OWN = b"sealscope"


def read_parquet(path: Path, request: Wanted) -> RecordingFields:
    """Read the wanted columns of a Parquet or Feather table; raise MissingExtra where pyarrow is absent."""
    library("pyarrow", "Parquet", "pyarrow")
    with path.open("rb") as opened:
        feather = opened.read(6) == b"ARROW1"
    if feather:
        table = library("pyarrow.feather", "Feather", "pyarrow").read_table(path)
        remarks = _read_remarks(table.schema)
        series = _series(table.schema, table.column, len(table))
        return table_of(series, request, "Feather", remarks, stated_rate(remarks))
    parquet = library("pyarrow.parquet", "Parquet", "pyarrow")
    with parquet.ParquetFile(path) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows

    def column(number: int) -> Any:
        name = schema.field(number).name
        texts = [name] if _is_text(schema.field(number)) else []
        with parquet.ParquetFile(path, read_dictionary=texts) as file:  # a text that repeats is held but once
            return file.read(columns=[name]).column(name)

    encoded = (schema.metadata or {}).get(_OWN)
    description, remarks = parse_description(encoded) if encoded else None, _read_remarks(schema)
    series, size = _series(schema, column, rows), path.stat().st_size
    return table_of(series, request, "Parquet", remarks, stated_rate(remarks), description=description, size=size)


def _read_remarks(schema: Any) -> dict[str, str]:
    """Return the entries that a table has beside its columns, without those that libraries write for themselves."""
    pairs = ((name.decode(errors="replace"), text) for name, text in (schema.metadata or {}).items())
    return entries((name, text.decode(errors="replace")) for name, text in pairs if text[:1] not in b"{")


def _series(schema: Any, column: Callable[[int], Any], rows: int) -> list[Series]:
    """Return the series of a table; `column`: reads one by its number."""
    series = []
    for number, field in enumerate(schema):
        metadata = field.metadata or {}
        unit = next((metadata[key].decode("utf-8", "replace") for key in (b"units", b"unit") if key in metadata), None)
        moment = str(field.type).startswith(("timestamp", "duration"))
        label = Label.parse(field.name, "s" if moment else unit)
        if field.name.startswith("__index_level_") and moment:  # the index of a data frame, without a name
            label = Label(field.name, "time", "s")
        series.append(Series("", label, rows, partial(_values, partial(column, number), field, rows)))
    return series


def _is_text(field: Any) -> bool:
    return str(field.type) in ("string", "large_string")


def _values(column: Callable[[], Any], field: Any, rows: int) -> NDArray[Any]:
    import pyarrow
    from pyarrow import compute, types

    if _is_text(field):
        check_texts(rows, 1, field.name)
        cells = column()
        chunks = [chunk.dictionary if isinstance(chunk, pyarrow.DictionaryArray) else chunk for chunk in cells.chunks]
        widest = max((compute.max(compute.binary_length(chunk)).as_py() or 0 for chunk in chunks), default=0)
        check_texts(rows, widest, field.name)
        return np.array([cell or "" for cell in cells.to_pylist()], dtype=object)
    if types.is_timestamp(field.type):
        moments = column().cast(pyarrow.timestamp("ns", field.type.tz)).to_numpy()
        return np.asarray(moments.astype("datetime64[ns]"))
    if types.is_duration(field.type):
        return np.asarray(column().cast(pyarrow.duration("ns")).to_numpy())
    if types.is_integer(field.type) or types.is_floating(field.type) or types.is_decimal(field.type):
        return np.asarray(column().cast(pyarrow.float64(), safe=False).to_numpy(), dtype=np.float64)
    raise InputError(f"{field.name} must hold numbers, got the type {field.type}")


def write_parquet(
    path: Path, values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]
) -> None:
    """Write columns `t [s]`, `p_A [Pa]`, ... as doubles, and the description in the table's metadata."""
    pyarrow = library("pyarrow", "Parquet", "pyarrow")
    columns = {f"{name} [{units[name]}]": pyarrow.array(series, from_pandas=False) for name, series in values.items()}
    table = pyarrow.table(columns).replace_schema_metadata({_OWN: json.dumps(description).encode()})
    library("pyarrow.parquet", "Parquet", "pyarrow").write_table(table, path)
