"""The tables of the monitor's database."""

from __future__ import annotations

from sqlalchemy import Column, Float, Index, Integer, LargeBinary, MetaData, String, Table, Text

metadata = MetaData()
#: Version of the tables, kept in `facts`.
SCHEMA = 3

facts = Table("facts", metadata, Column("name", String(40), primary_key=True), Column("value", Text, nullable=False))
#: Blocks that are stored, by identity.
blocks = Table(
    "blocks",
    metadata,
    Column("actuator", String(120), primary_key=True),
    Column("identity", String(120), primary_key=True),
    Column("number", Integer, nullable=False),
    Index("blocks_in_order", "actuator", "number"),
)
#: Samples since the checkpoint, which a restart goes through once more.
pending = Table(
    "pending",
    metadata,
    Column("actuator", String(120), primary_key=True),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("samples", LargeBinary, nullable=False),
)
#: State of the detector and of the alarm, as of the checkpoint, in JSON.
actuators = Table(
    "actuators",
    metadata,
    Column("actuator", String(120), primary_key=True),
    Column("settings", Text, nullable=False),
    Column("checkpoint", Text, nullable=False),
)
#: What each actuator shows now: a row of its own, for one is written whole, and a state is large.
summaries = Table(
    "summaries",
    metadata,
    Column("actuator", String(120), primary_key=True),
    Column("summary", Text, nullable=False),
)
estimates = Table(
    "estimates",
    metadata,
    Column("actuator", String(120), primary_key=True),
    Column("number", Integer, primary_key=True, autoincrement=False),
    Column("t", Float(53), nullable=False),
    Column("status", String(160), nullable=False),
    Column("total_lpm", Float(53)),
    Column("total_low_lpm", Float(53)),
    Column("total_high_lpm", Float(53)),
    Column("leak_lpm", Float(53)),
    Column("leak_low_lpm", Float(53)),
    Column("leak_high_lpm", Float(53)),
    Column("oil_celsius", Float(53)),
)
alarms = Table(
    "alarms",
    metadata,
    Column("id", String(160), primary_key=True),
    Column("actuator", String(120), nullable=False, index=True),
    Column("state", String(20), nullable=False, index=True),
    Column("alarm", Text, nullable=False),
)
#: What happened to alarms, and what persons said of them, in order; outputs keep how far they are.
events = Table(
    "events",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("actuator", String(120), nullable=False, index=True),
    Column("t", Float(53), nullable=False),
    Column("kind", String(20), nullable=False),
    Column("alarm_id", String(160), nullable=False),
    Column("by_whom", String(80), nullable=False),
    Column("text", Text, nullable=False),
    Column("alarm", Text, nullable=False),
)
#: The last messages and files that could not be taken: when [s], from where, why, their size and how they begin.
refused = Table(
    "refused",
    metadata,
    Column("number", Integer, primary_key=True),
    Column("at", Float(53), nullable=False),
    Column("reason", String(120), nullable=False),
    Column("message", Text, nullable=False),
    Column("size", Integer, nullable=False),
    Column("beginning", LargeBinary, nullable=False),
)
#: Monitors that share the database, and whose each actuator is, until when [s].
monitors = Table(
    "monitors", metadata, Column("name", String(120), primary_key=True), Column("until", Float(53), nullable=False)
)
leases = Table(
    "leases",
    metadata,
    Column("actuator", String(120), primary_key=True),
    Column("holder", String(120), nullable=False),
    Column("until", Float(53), nullable=False),
)
