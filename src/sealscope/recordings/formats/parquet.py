"""Parquet tables, with pyarrow: units in the columns' names, our own words in the table's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import MissingExtra, UnreadableFile
from sealscope.recordings.formats.columns import Label
from sealscope.recordings.formats.table import Table, check_size, own_words, read_own_words
from sealscope.recordings.recording import Array, Recording
from sealscope.recordings.timebase import stamps

_OWN = b"sealscope"


def _pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtra("Parquet needs pyarrow: pip install 'sealscope[io]'") from error
    return pyarrow, pyarrow.parquet


@contextmanager
def open_parquet(path: Path) -> Iterator[Table]:
    """The columns of a Parquet table; raises UnreadableFile, and MissingExtra where pyarrow is absent."""
    pyarrow, parquet = _pyarrow()
    place = str(path)
    try:
        with parquet.ParquetFile(path) as file:
            schema = file.schema_arrow
            labels = [_label(schema.field(i)) for i in range(len(schema))]

            def fetch(columns: Sequence[int], time: int | None) -> tuple[list[Array], NDArray[Any] | None]:
                wanted = [*columns, time] if time is not None else list(columns)
                check_size(file.metadata.num_rows, len(wanted), place)
                table = file.read(columns=[schema.field(i).name for i in wanted])
                values = [_values(table, schema.field(i), place) for i in columns]
                return values, None if time is None else _values(table, schema.field(time), place, True)

            own = (schema.metadata or {}).get(_OWN)
            yield Table(place, "Parquet", labels, fetch, read_own_words(own, place) if own else None)
    except (OSError, pyarrow.ArrowException) as error:
        text = " ".join(str(error).split())[:160]
        raise UnreadableFile(f"a Parquet file must be whole, got: {text} ({place})") from error


def _label(field: Any) -> Label:
    metadata = field.metadata or {}
    unit = next((metadata[key].decode("utf-8", "replace") for key in (b"units", b"unit") if key in metadata), None)
    return Label.parse(field.name, unit)


def _values(table: Any, field: Any, place: str, time: bool = False) -> NDArray[Any]:
    import pyarrow

    types = pyarrow.types
    column = table.column(field.name)
    if time and types.is_timestamp(field.type):
        return np.asarray(column.cast(pyarrow.timestamp("ns", field.type.tz)).to_numpy().astype("datetime64[ns]"))
    if types.is_integer(field.type) or types.is_floating(field.type) or types.is_decimal(field.type):
        return np.asarray(column.cast(pyarrow.float64(), safe=False).to_numpy(), dtype=np.float64)
    if types.is_string(field.type) or types.is_large_string(field.type):
        cells = [cell or "" for cell in column.to_pylist()]
        try:
            return stamps(cells) if time else np.array([float(cell) if cell else np.nan for cell in cells])
        except ValueError as error:
            raise UnreadableFile(f"{field.name} must hold numbers, got text ({place})") from error
    raise UnreadableFile(f"{field.name} must hold numbers, got the type {field.type} ({place})")


def write_parquet(recording: Recording, path: Path) -> None:
    """Write columns `t [s]`, `p_A [Pa]`, ... as doubles, and rate, provenance and history in the table's metadata."""
    pyarrow, parquet = _pyarrow()
    columns = {"t [s]": recording.t}
    columns |= {f"{name} [{recording.units[name]}]": values for name, values in recording.channels.items()}
    table = pyarrow.table({name: pyarrow.array(values, from_pandas=False) for name, values in columns.items()})
    table = table.replace_schema_metadata({_OWN: json.dumps(own_words(recording)).encode()})
    parquet.write_table(table, path)
