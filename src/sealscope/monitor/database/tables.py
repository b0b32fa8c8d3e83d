"""The tables of the monitor's database."""

from __future__ import annotations

from typing import Any, Literal

from sqlalchemy import Column, Float, Index, Integer, LargeBinary, MetaData, String, Table, Text
from sqlalchemy.types import TypeEngine

metadata = MetaData()
#: Version of the tables, kept in `facts`.
SCHEMA = 4
#: Numbers in the row of an estimate.
FIGURES = (
    *("total_lpm", "total_low_lpm", "total_high_lpm"),
    *("leak_lpm", "leak_low_lpm", "leak_high_lpm", "oil_celsius"),
)
_TYPES: dict[str, TypeEngine[Any]] = {"text": Text(), "int": Integer(), "double": Float(53), "bytes": LargeBinary()}


def _table(name: str, columns: str, *indexes: Index) -> Table:
    """Define a table from a text that lists its columns, separated by commas.

    Each column is written as name, type (``text``, ``int``, ``double``, ``bytes``, or the length of a text), and any
    roles: ``key`` (primary key), ``counted`` (a running number as the key), ``indexed``, ``null`` (may be missing).
    """
    table_columns: list[Column[Any]] = []
    for column, kind, *roles in map(str.split, columns.split(",")):
        datatype = _TYPES[kind] if kind in _TYPES else String(int(kind))
        key, null, index = "key" in roles or "counted" in roles, "null" in roles, "indexed" in roles
        auto: Literal["auto"] | bool = "auto" if "counted" in roles else False
        table_columns.append(Column(column, datatype, primary_key=key, autoincrement=auto, nullable=null, index=index))
    return Table(name, metadata, *table_columns, *indexes)


#: Single values by name: the version of the tables, and the numbers of `MonitorStore.write_position`.
facts = _table("facts", "name 40 key, value text")
#: Blocks that are stored, by identity.
_block_order = Index("blocks_in_order", "actuator", "number")
blocks = _table("blocks", "actuator 120 key, identity 120 key, number int", _block_order)
#: Samples since the checkpoint, which a restart judges again, and those of a stream's recording that has not ended.
pending = _table("pending", "actuator 120 key, number int key, samples bytes")
#: State of the detector and of the alarm at the checkpoint, in JSON.
actuators = _table("actuators", "actuator 120 key, settings text, checkpoint text")
#: Summary of each actuator; separate from the state, because rows are written whole and a state is large.
summaries = _table("summaries", "actuator 120 key, summary text")
_FIGURES = ", ".join(f"{name} double null" for name in FIGURES)
#: The index finds the estimates of a span of time.
_estimates_by_time = Index("estimates_by_time", "actuator", "t")
estimates = _table(
    "estimates", f"actuator 120 key, number int key, t double, status 160, {_FIGURES}", _estimates_by_time
)
alarms = _table("alarms", "id 160 key, actuator 120 indexed, state 20 indexed, alarm text")
#: Changes of alarms and comments of persons, in order; each output stores the number of the last one it delivered.
events = _table(
    "events",
    "number int counted, actuator 120 indexed, t double, kind 20, alarm_id 160, by_whom 80, text text, alarm text",
)
#: The last messages and files that were refused: when [s], why, their size, and their first bytes.
refused = _table("refused", "number int counted, at double, reason 120, message text, size int, beginning bytes")
#: Messages whose decoding has begun and not ended: reader, digest of the message, and number of attempts.
decodings = _table("decodings", "reader 240 key, digest 40 key, attempts int")
