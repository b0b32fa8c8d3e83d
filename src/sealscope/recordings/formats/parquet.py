"""Parquet and Feather tables, with pyarrow: units are in the names or the metadata of columns.

Sealscope writes Parquet only, with the description of the recording in the metadata of the table.
"""

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
from sealscope.recordings.formats.columns import Request
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import collect_remarks, stated_rate
from sealscope.recordings.formats.libraries import import_library
from sealscope.recordings.formats.table import RecordingFields, Series, build_fields, check_texts, parse_description

#: Metadata key of the description that `write_parquet` writes.
_DESCRIPTION_KEY = b"sealscope"


def read_parquet(path: Path, request: Request) -> RecordingFields:
    """Read the requested columns of a Parquet or Feather table; raise MissingExtra without pyarrow.

    A Feather table has no description by Sealscope. It is read as a whole, so a check of its size would come too late.
    """
    import_library("pyarrow", "Parquet", "pyarrow")
    with path.open("rb") as beginning:
        is_feather = beginning.read(6) == b"ARROW1"
    if is_feather:
        table = import_library("pyarrow.feather", "Feather", "pyarrow").read_table(path)
        remarks = _read_remarks(table.schema)
        series = _list_series(table.schema, table.column, len(table))
        return build_fields(series, request, "Feather", remarks, stated_rate(remarks))
    parquet = import_library("pyarrow.parquet", "Parquet", "pyarrow")
    with parquet.ParquetFile(path) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows

    def read_column(number: int) -> Any:
        """Read a column of the table by its number; reopens the file, as `read_dictionary` is an option of opening."""
        name = schema.field(number).name
        texts = [name] if _is_text(schema.field(number)) else []
        with parquet.ParquetFile(path, read_dictionary=texts) as file:  # stores repeated texts once
            return file.read(columns=[name]).column(name)

    encoded = (schema.metadata or {}).get(_DESCRIPTION_KEY)
    description = parse_description(encoded) if encoded else None
    remarks = _read_remarks(schema)
    series = _list_series(schema, read_column, rows)
    size = path.stat().st_size
    return build_fields(series, request, "Parquet", remarks, stated_rate(remarks), description=description, size=size)


def _read_remarks(schema: Any) -> dict[str, str]:
    """Read the remarks in a table's metadata, without empty texts and the JSON that libraries write for themselves."""
    pairs = ((name.decode(errors="replace"), text) for name, text in (schema.metadata or {}).items())
    return collect_remarks(
        (name, text.decode(errors="replace")) for name, text in pairs if text and not text.startswith(b"{")
    )


def _list_series(schema: Any, read_column: Callable[[int], Any], n_rows: int) -> list[Series]:
    """List the columns of a pyarrow schema as series of `n_rows`, which `read_column` reads by number when needed."""
    series = []
    for number, field in enumerate(schema):
        metadata = field.metadata or {}
        unit = next((metadata[key].decode("utf-8", "replace") for key in (b"units", b"unit") if key in metadata), None)
        is_time = str(field.type).startswith(("timestamp", "duration"))
        label = Label.parse(field.name, "s" if is_time else unit)
        if field.name.startswith("__index_level_") and is_time:  # the index of a data frame, without a name
            label = Label(field.name, "time", "s")
        read_values = partial(_read_values, partial(read_column, number), field, n_rows)
        series.append(Series(group="", label=label, count=n_rows, values=read_values))
    return series


def _is_text(field: Any) -> bool:
    """Test whether a column in pyarrow's schema has a text type."""
    return str(field.type) in ("string", "large_string")


def _read_values(read_column: Callable[[], Any], field: Any, n_rows: int) -> NDArray[Any]:
    """Read the column `field` as doubles, datetime64, timedelta64 or texts (n,); raise InputError for other types."""
    import pyarrow
    from pyarrow import compute, types

    if _is_text(field):
        check_texts(n_rows, width=1, name=field.name)  # refuses too many texts before they are read
        cells = read_column()
        chunks = [chunk.dictionary if isinstance(chunk, pyarrow.DictionaryArray) else chunk for chunk in cells.chunks]
        max_width = max((compute.max(compute.binary_length(chunk)).as_py() or 0 for chunk in chunks), default=0)
        check_texts(n_rows, max_width, field.name)
        return np.array([cell or "" for cell in cells.to_pylist()], dtype=object)
    if types.is_timestamp(field.type):
        moments = read_column().cast(pyarrow.timestamp("ns", field.type.tz)).to_numpy()
        return np.asarray(moments.astype("datetime64[ns]"))
    if types.is_duration(field.type):
        return np.asarray(read_column().cast(pyarrow.duration("ns")).to_numpy())
    if types.is_integer(field.type) or types.is_floating(field.type) or types.is_decimal(field.type):
        # safe=False: integers that no double can hold are rounded, not refused
        return np.asarray(read_column().cast(pyarrow.float64(), safe=False).to_numpy(), dtype=np.float64)
    raise InputError(f"{field.name} must hold numbers, got the type {field.type}")


def write_parquet(
    path: Path, values: Mapping[str, Array], units: Mapping[str, str], description: Mapping[str, Any]
) -> None:
    """Write the content of `Recording.series` as Parquet columns `t [s]`, `p_A [Pa]`, ... of doubles."""
    pyarrow = import_library("pyarrow", "Parquet", "pyarrow")
    columns = {f"{name} [{units[name]}]": pyarrow.array(series, from_pandas=False) for name, series in values.items()}
    table = pyarrow.table(columns).replace_schema_metadata({_DESCRIPTION_KEY: json.dumps(description).encode()})
    import_library("pyarrow.parquet", "Parquet", "pyarrow").write_table(table, path)
