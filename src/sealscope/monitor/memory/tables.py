"""The tables of the monitor's database."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Column, Float, Index, Integer, LargeBinary, MetaData, String, Table, Text
from sqlalchemy.types import TypeEngine

metadata = MetaData()
#: Version of the tables, kept in `facts`.
SCHEMA = 4
#: Figures of an estimate.
FIGURES = (
    *("total_lpm", "total_low_lpm", "total_high_lpm"),
    *("leak_lpm", "leak_low_lpm", "leak_high_lpm", "oil_celsius"),
)


def _key(name: str, kind: TypeEngine[Any]) -> Column[Any]:
    return Column(name, kind, primary_key=True, autoincrement=False)


def _stated(name: str, kind: TypeEngine[Any], *, index: bool = False) -> Column[Any]:
    return Column(name, kind, nullable=False, index=index)


_Name, _Long, _Double = String(120), String(160), Float(53)
facts = Table("facts", metadata, _key("name", String(40)), _stated("value", Text()))
#: Blocks that are stored, by identity.
blocks = Table(
    "blocks",
    metadata,
    *(_key("actuator", _Name), _key("identity", _Name), _stated("number", Integer())),
    Index("blocks_in_order", "actuator", "number"),
)
#: Samples since the checkpoint, which a restart goes through once more.
pending = Table(
    "pending", metadata, _key("actuator", _Name), _key("number", Integer()), _stated("samples", LargeBinary())
)
#: State of the detector and of the alarm, as of the checkpoint, in JSON.
actuators = Table(
    "actuators", metadata, _key("actuator", _Name), _stated("settings", Text()), _stated("checkpoint", Text())
)
#: What each actuator shows now: a row of its own, for one is written whole, and a state is large.
summaries = Table("summaries", metadata, _key("actuator", _Name), _stated("summary", Text()))
estimates = Table(
    "estimates",
    metadata,
    *(_key("actuator", _Name), _key("number", Integer()), _stated("t", _Double), _stated("status", _Long)),
    *(Column(name, _Double) for name in FIGURES),
)
alarms = Table(
    "alarms",
    metadata,
    *(_key("id", _Long), _stated("actuator", _Name, index=True), _stated("state", String(20), index=True)),
    _stated("alarm", Text()),
)
#: What happened to alarms, and what persons said of them, in order; outputs keep how far they are.
events = Table(
    "events",
    metadata,
    *(Column("number", Integer, primary_key=True), _stated("actuator", _Name, index=True), _stated("t", _Double)),
    *(_stated("kind", String(20)), _stated("alarm_id", _Long), _stated("by_whom", String(80))),
    *(_stated("text", Text()), _stated("alarm", Text())),
)
#: The last messages and files that could not be taken: when [s], from where, why, their size and how they begin.
refused = Table(
    "refused",
    metadata,
    *(Column("number", Integer, primary_key=True), _stated("at", _Double), _stated("reason", _Name)),
    *(_stated("message", Text()), _stated("size", Integer()), _stated("beginning", LargeBinary())),
)
#: Monitors that share the database, and whose each actuator is, until when [s].
monitors = Table("monitors", metadata, _key("name", _Name), _stated("until", _Double))
leases = Table("leases", metadata, _key("actuator", _Name), _stated("holder", _Name), _stated("until", _Double))
