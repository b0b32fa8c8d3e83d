"""The monitor's database: what is written is written in one transaction, whole or not at all.

SQLite in WAL mode with full synchronisation, or any database that SQLAlchemy knows, by URL.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa
from sqlalchemy import bindparam, func, select
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, ProgrammingError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from sealscope.errors import InputError
from sealscope.monitor.alarms import Alarm
from sealscope.monitor.memory import tables
from sealscope.monitor.memory.postgresql import engine_options, limit_answers
from sealscope.monitor.stream.estimates import BlockEstimate
from sealscope.recordings.recording import Recording

#: Blocks of samples between two checkpoints, and their bytes.
PENDING_BLOCKS, PENDING_BYTES = 16, 400_000
#: Identities of blocks that are kept for each actuator: more than a day of messages of 1 s.
KEPT_IDENTITIES = 100_000
#: Refused messages that are kept, the last ones.
KEPT_REFUSED = 1000
#: How often the tables are tried to be made where several monitors begin at once.
_ATTEMPTS = 10


@dataclass
class StoredRows:
    """Rows that a transaction adds to the tables beside the blocks themselves, gathered to be stored at once.

    By actuator: `checkpoints`, settings and state; `summaries`; and `old`, the numbers up to which blocks and estimates
    are deleted.
    """

    estimates: list[dict[str, Any]] = field(default_factory=list)
    pending: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    alarms: dict[str, Alarm] = field(default_factory=dict)
    checkpoints: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    summaries: dict[str, dict[str, Any]] = field(default_factory=dict)
    old: dict[str, tuple[int, int]] = field(default_factory=dict)

    def add_estimates(self, actuator: str, estimates: Iterable[BlockEstimate], oil_celsius: float | None) -> None:
        """Add the estimates of a block, and the oil's temperature then."""
        for each in estimates:
            total, leak = each.total_interval_lpm or (None, None), each.leak_interval_lpm or (None, None)
            figures = (each.total_lpm, *total, each.leak_lpm, *leak, oil_celsius)
            row = {"actuator": actuator, "number": each.number, "t": each.t, "status": each.status[:160]}
            self.estimates.append({**row, **dict(zip(tables.FIGURES, figures, strict=True))})

    def add_pending(self, actuator: str, number: int, samples: Recording, follows: bool) -> None:
        """Add samples that a restart goes through once more after the checkpoint."""
        self.pending.append({"actuator": actuator, "number": number, "samples": _packed(samples, follows)})

    def add_alarm(self, alarm: Alarm, kind: str, t: float, by_whom: str = "", text: str = "") -> None:
        """Add an alarm as it is now, and what happened to it, or what a person said of it, unless `kind` is empty."""
        self.alarms[alarm.id] = alarm
        if kind:
            own = {"actuator": alarm.actuator, "alarm_id": alarm.id, "alarm": json.dumps(alarm.plain())}
            self.events.append({"t": t, "kind": kind, "by_whom": by_whom, "text": text, **own})

    def add_checkpoint(self, actuator: str, settings: str, state: dict[str, Any]) -> None:
        """Add the state of an actuator, which takes the place of the samples since the last one."""
        self.pending = [row for row in self.pending if row["actuator"] != actuator]
        self.checkpoints[actuator] = settings, state


class MonitorStore:
    """The database of a monitor, `database` a file of SQLite or a URL; raises InputError where it cannot be opened."""

    def __init__(self, database: str) -> None:
        self.tables = tables
        self.sends = True  # False while another monitor that shares the database sends for all
        is_file = "://" not in database
        # of the threads here one at a time writes to a file, which SQLite would let wait and then refuse
        self._writing_lock: AbstractContextManager[object] = threading.RLock() if is_file else nullcontext()
        url = f"sqlite:///{Path(database)}" if is_file else database
        try:
            self.engine = sa.create_engine(url, **engine_options(sa.make_url(url)))
            limit_answers(self.engine)
            if self.engine.dialect.name == "sqlite":
                sa.event.listen(self.engine, "connect", _prepare_sqlite)
            for attempt in range(_ATTEMPTS):
                try:
                    known = self._prepared()
                    break
                except (IntegrityError, ProgrammingError):
                    if attempt == _ATTEMPTS - 1:
                        raise
                    time.sleep(0.2)  # another monitor makes the tables at this moment
        except (SQLAlchemyError, ImportError, ValueError) as error:
            reason = str(getattr(error, "orig", None) or error).splitlines()[0]
            raise InputError(f"the monitor's database must be a file of SQLite or a URL, got: {reason}") from None
        if known not in (None, str(tables.SCHEMA)):
            raise InputError(f"the monitor's database must have version {tables.SCHEMA}, got {known} ({database})")

    def _prepared(self) -> str | None:
        """Make the tables where they are missing, and return the version of those that were there."""
        facts = tables.facts
        with self.engine.begin() as connection:
            tables.metadata.create_all(connection)
            known = connection.execute(select(facts.c.value).where(facts.c.name == "schema")).scalar()
            if known is None:
                connection.execute(facts.insert().values(name="schema", value=str(tables.SCHEMA)))
        return None if known is None else str(known)

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Return a connection whose changes are kept together when the block ends well."""
        with self._writing_lock, self.engine.begin() as connection:
            yield connection

    def _rows(self, query: Any) -> Sequence[sa.Row[Any]]:
        with self.engine.connect() as connection:
            return connection.execute(query).all()

    def _value(self, query: Any) -> int:
        """Return the number that a query gives, 0 for none."""
        with self.engine.connect() as connection:
            return int(connection.execute(query).scalar() or 0)

    def known(self, blocks: Iterable[tuple[str, str]]) -> set[tuple[str, str]]:
        """Return which of some blocks are stored; a block is an actuator and an identity."""
        # a query for each: SQLite goes through the whole table for a list of pairs
        table = tables.blocks
        chosen = (table.c.actuator == bindparam("of")) & (table.c.identity == bindparam("identity"))
        query = select(table.c.number).where(chosen)
        with self.engine.connect() as connection:
            rows = {
                block: connection.execute(query, {"of": block[0], "identity": block[1]}).first() for block in blocks
            }
        return {block for block, row in rows.items() if row is not None}

    def is_known(self, actuator: str, identity: str) -> bool:
        """Return whether a block is stored."""
        return bool(self.known([(actuator, identity)]))

    def keep_blocks(self, connection: sa.Connection, blocks: Iterable[tuple[str, str, int]]) -> None:
        """Store blocks: actuator, identity, and number among those of the actuator.

        Raises IntegrityError, and the transaction is over, where one of them is stored already.
        """
        names = ("actuator", "identity", "number")
        connection.execute(tables.blocks.insert(), [dict(zip(names, block, strict=True)) for block in blocks])

    def keep_rows(self, connection: sa.Connection, rows: StoredRows) -> None:
        """Store rows, each table's at once."""
        of = bindparam("of", type_=sa.String)
        states = [
            {"actuator": name, "settings": settings, "checkpoint": json.dumps(state, allow_nan=False)}
            for name, (settings, state) in rows.checkpoints.items()
        ]
        if states:
            before = tables.pending.delete().where(tables.pending.c.actuator == of)
            connection.execute(before, [{"of": row["actuator"]} for row in states])
        for name in ("estimates", "pending", "events"):
            if values := getattr(rows, name):
                connection.execute(getattr(tables, name).insert(), values)
        shown = [{"actuator": name, "summary": json.dumps(summary)} for name, summary in rows.summaries.items()]
        alarms = [
            {"id": each.id, "actuator": each.actuator, "state": each.state, "alarm": json.dumps(each.plain())}
            for each in rows.alarms.values()
        ]
        for table, changed in ((tables.actuators, states), (tables.summaries, shown), (tables.alarms, alarms)):
            self.put(connection, table, changed)
        for table, place in ((tables.blocks, 0), (tables.estimates, 1)):
            old = [{"of": name, "last": numbers[place]} for name, numbers in rows.old.items() if numbers[place] > 0]
            if old:
                chosen = (table.c.actuator == of) & (table.c.number <= bindparam("last"))
                connection.execute(table.delete().where(chosen), old)

    def put(self, connection: sa.Connection, table: sa.Table, rows: list[dict[str, Any]]) -> None:
        """Change rows of a table by its primary key, or insert those that are missing."""
        if not rows:
            return
        key = table.primary_key.columns.keys()
        chosen = [table.c[name] == bindparam(f"of_{name}") for name in key]
        values = [{f"of_{name}" if name in key else name: value for name, value in row.items()} for row in rows]
        changed = connection.execute(table.update().where(*chosen), values)
        if changed.rowcount == len(rows):
            return
        if len(rows) == 1:
            connection.execute(table.insert(), rows)
        else:
            for row in rows:
                self.put(connection, table, [row])

    def keep_refused(self, rows: Sequence[dict[str, Any]]) -> None:
        """Store what was refused, `KEPT_REFUSED` at most with those before, in a transaction of its own."""
        table = tables.refused
        with self.writing() as connection:
            connection.execute(table.insert(), rows[-KEPT_REFUSED:])
            last = int(connection.execute(select(func.max(table.c.number))).scalar() or 0)
            connection.execute(table.delete().where(table.c.number <= last - KEPT_REFUSED))

    def refused(self, most: int = KEPT_REFUSED) -> list[dict[str, Any]]:
        """Return what was refused, the last one first."""
        table = tables.refused
        return [dict(row._mapping) for row in self._rows(select(table).order_by(table.c.number.desc()).limit(most))]

    def last_number(self, table: sa.Table, actuator: str) -> int:
        """Return the number of an actuator's last row of a table, `tables.blocks` or `tables.estimates`."""
        return self._value(select(func.max(table.c.number)).where(table.c.actuator == actuator))

    def checkpoint(self, actuator: str) -> tuple[str, dict[str, Any], list[tuple[Recording, bool]]] | None:
        """Return settings and state as of the checkpoint, and the samples since then; None where there is none."""
        states = tables.actuators
        with self.engine.connect() as connection:
            row = connection.execute(select(states).where(states.c.actuator == actuator)).first()
            samples = self._pending(connection, actuator)
        return None if row is None else (row.settings, json.loads(row.checkpoint), samples)

    @staticmethod
    def _pending(connection: sa.Connection, actuator: str) -> list[tuple[Recording, bool]]:
        pending = tables.pending
        query = select(pending.c.samples).where(pending.c.actuator == actuator).order_by(pending.c.number)
        return [_unpacked(data) for (data,) in connection.execute(query)]

    def last_samples(self, actuator: str) -> list[Recording]:
        """Return the samples of an actuator since its last checkpoint."""
        with self.engine.connect() as connection:
            return [samples for samples, _ in self._pending(connection, actuator)]

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Return what each actuator showed last."""
        return {row.actuator: json.loads(row.summary) for row in self._rows(select(tables.summaries))}

    def alarms(self, *, open_only: bool = False, actuator: str | None = None) -> list[dict[str, Any]]:
        """Return alarms as plain values, the latest first."""
        alarms = tables.alarms
        query = select(alarms.c.alarm)
        if open_only:
            query = query.where(alarms.c.state.not_in(("closed", "invalid")))
        if actuator is not None:
            query = query.where(alarms.c.actuator == actuator)
        values = [json.loads(text) for (text,) in self._rows(query)]
        return sorted(values, key=lambda alarm: -float(alarm["raised_s"]))

    def events_since(self, number: int, most: int = 1000) -> list[tuple[int, dict[str, Any]]]:
        """Return events beyond a number with their own numbers, in their order."""
        events = tables.events
        query = select(events).where(events.c.number > number).order_by(events.c.number).limit(most)
        return [(row.number, _event(row)) for row in self._rows(query)]

    def last_events(self, actuator: str, most: int = 200) -> list[dict[str, Any]]:
        """Return the latest events of an actuator, the last one first."""
        events = tables.events
        query = select(events).where(events.c.actuator == actuator).order_by(events.c.number.desc()).limit(most)
        return [_event(row) for row in self._rows(query)]

    def course(self, actuator: str, most: int = 600, seconds: float | None = None) -> list[dict[str, Any]]:
        """Return the estimates of an actuator, means of successive ones where there are more than `most`.

        `seconds`: only the last of them.
        """
        estimates = tables.estimates
        chosen = estimates.c.actuator == actuator
        if seconds is not None:
            chosen &= estimates.c.t >= select(func.max(estimates.c.t)).where(chosen).scalar_subquery() - seconds
        every = max(1, -(-self._value(select(func.count()).where(chosen)) // most))
        group = estimates.c.number - estimates.c.number % every
        columns = [func.avg(estimates.c[name]).label(name) for name in ("t", *tables.FIGURES)]
        query = select(*columns).where(chosen).group_by(group).order_by(group)
        return [dict(row._mapping) for row in self._rows(query)]

    def estimates(self) -> Iterator[dict[str, Any]]:
        """Yield the estimates that are kept, by actuator in their order."""
        table = tables.estimates
        query = select(table).order_by(table.c.actuator, table.c.number)
        with self.engine.connect() as connection:
            for row in connection.execution_options(yield_per=10_000).execute(query):
                yield dict(row._mapping)

    def position(self, name: str) -> int:
        """Return the number of the last event that an output has passed on."""
        return self._value(select(tables.facts.c.value).where(tables.facts.c.name == name))

    def keep_position(self, name: str, number: int) -> None:
        """Store how far an output is."""
        with self.writing() as connection:
            self.put(connection, tables.facts, [{"name": name, "value": str(number)}])

    def pass_on(self, output: str, send: Callable[[dict[str, Any]], bool]) -> None:
        """Hand events to `send` in their order until it returns False, and store how far the output is after each."""
        for number, event in self.events_since(self.position(output)) if self.sends else ():
            if not send(event):
                return
            self.keep_position(output, number)


def away(error: BaseException) -> str | None:
    """Return in one line why the database does not answer or does not write, None for an error of another kind.

    Values that it cannot hold are another kind: they would be refused again.
    """
    if isinstance(error, PoolTimeout):
        return "every connection to the database is in use"
    if not isinstance(error, DBAPIError) or isinstance(error, DataError):
        return None
    return " ".join(str(error.orig).split())[:200]


def _packed(samples: Recording, follows: bool) -> bytes:
    """Return samples as one line of JSON and their numbers, little endian, the clock first."""
    units = {name: samples.units[name] for name in samples.channels}
    head = json.dumps({"units": units, "rate": samples.rate, "follows": follows})
    return head.encode() + b"\n" + np.array([samples.t, *samples.channels.values()], dtype="<f8").tobytes()


def _unpacked(data: bytes) -> tuple[Recording, bool]:
    """Return the samples that `_packed` made bytes of, and whether they follow those before."""
    line, _, numbers = data.partition(b"\n")
    head = json.loads(line)
    t, *channels = np.frombuffer(numbers, dtype="<f8").reshape(1 + len(head["units"]), -1)
    return Recording(t, dict(zip(head["units"], channels, strict=True)), head["units"], head["rate"]), head["follows"]


def _event(row: Any) -> dict[str, Any]:
    alarm = json.loads(row.alarm)
    values = {"number": row.number, "event": row.kind, "t": row._mapping["t"], "by": row.by_whom, "text": row.text}
    return {**values, "alarm": alarm}


def _prepare_sqlite(connection: Any, record: object) -> None:
    cursor = connection.cursor()
    for setting in ("journal_mode=WAL", "synchronous=FULL", "busy_timeout=5000", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {setting}")
    cursor.close()
