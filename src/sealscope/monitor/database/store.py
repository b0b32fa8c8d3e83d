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
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sqlalchemy as sa
from sqlalchemy import bindparam, func, select
from sqlalchemy.exc import DataError, DBAPIError, IntegrityError, ProgrammingError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from sealscope.diagnosis.live.estimates import BlockEstimate
from sealscope.errors import InputError
from sealscope.monitor.alarms import Alarm
from sealscope.monitor.database import tables
from sealscope.monitor.database.postgresql import engine_options, limit_answers
from sealscope.monitor.verdicts import RecordingVerdict
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import restored

#: Identities of blocks that are kept for each actuator: more than a day of messages of 1 s.
KEPT_IDENTITIES = 100_000
#: Refused messages that are kept, the last ones.
KEPT_REFUSED = 1000
#: How often the tables are tried to be made where several monitors begin at once.
_ATTEMPTS = 10


@dataclass
class StoredRows:
    """Rows that a transaction adds to the tables beside the blocks themselves, gathered to be stored at once.

    `estimates`, `pending`, `events`: new ones; `alarms` by id, `actuators` (their checkpoints) and `summaries` by
    actuator: changed ones; `old`: by actuator the numbers up to which blocks and estimates are deleted.
    """

    estimates: list[dict[str, Any]] = field(default_factory=list)
    pending: list[dict[str, Any]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    alarms: dict[str, dict[str, Any]] = field(default_factory=dict)
    actuators: dict[str, dict[str, Any]] = field(default_factory=dict)
    summaries: dict[str, dict[str, Any]] = field(default_factory=dict)
    old: dict[str, tuple[int, int]] = field(default_factory=dict)

    def add_estimates(self, actuator: str, estimates: Iterable[BlockEstimate], oil_celsius: float | None) -> None:
        """Add the estimates of a block, and the oil's temperature then."""
        for estimate in estimates:
            total, leak = estimate.total_interval_lpm or (None, None), estimate.leak_interval_lpm or (None, None)
            figures = (estimate.total_lpm, *total, estimate.leak_lpm, *leak, oil_celsius)
            row = {"actuator": actuator, "number": estimate.number, "t": estimate.t, "status": estimate.status[:160]}
            self.estimates.append({**row, **dict(zip(tables.FIGURES, figures, strict=True))})

    def add_pending(
        self, actuator: str, number: int, samples: Recording, follows: bool, verdict: RecordingVerdict | None = None
    ) -> None:
        """Add samples that a restart goes through once more after the checkpoint, with the verdict on them."""
        self.pending.append({"actuator": actuator, "number": number, "samples": _pack(samples, follows, verdict)})

    def add_alarm(self, alarm: Alarm, kind: str, t: float, by_whom: str = "", text: str = "") -> None:
        """Add an alarm in its present state, and the event or the person's remark if `kind` is not empty."""
        actuator, plain = {"actuator": alarm.actuator}, json.dumps(alarm.plain())
        self.alarms[alarm.id] = {**actuator, "id": alarm.id, "state": alarm.state, "alarm": plain}
        if kind:
            entry = {"kind": kind, "by_whom": by_whom, "text": text}
            self.events.append({**actuator, **entry, "t": t, "alarm_id": alarm.id, "alarm": plain})

    def add_checkpoint(self, actuator: str, settings: str, state: dict[str, Any]) -> None:
        """Add the state of an actuator, which takes the place of the samples since the last one."""
        self.pending = [row for row in self.pending if row["actuator"] != actuator]
        plain = json.dumps(state, allow_nan=False)
        self.actuators[actuator] = {"actuator": actuator, "settings": settings, "checkpoint": plain}

    def add_summary(self, actuator: str, summary: dict[str, Any]) -> None:
        """Add what an actuator shows."""
        import orjson

        self.summaries[actuator] = {
            "actuator": actuator,
            "summary": orjson.dumps(summary, option=orjson.OPT_SERIALIZE_NUMPY).decode(),
        }


class StoredSamples(NamedTuple):
    """Samples of a block, whether they follow those before, and the verdict on the recording that they are."""

    samples: Recording
    follows: bool
    verdict: RecordingVerdict | None


class MonitorStore:
    """The database of a monitor, `database` a file of SQLite or a URL; raises InputError where it cannot be opened."""

    def __init__(self, database: str) -> None:
        self.tables = tables
        is_file = "://" not in database
        # of the threads here one at a time writes to a file, which SQLite would let wait and then refuse
        self._writing_lock: AbstractContextManager[object] = threading.RLock() if is_file else nullcontext()
        url = f"sqlite:///{Path(database)}" if is_file else database
        try:
            self.engine = sa.create_engine(url, **engine_options(sa.make_url(url)))
            limit_answers(self.engine)
            if self.engine.dialect.name == "sqlite":
                sa.event.listen(self.engine, "connect", _prepare_sqlite)
            known = self._prepare_tables(_ATTEMPTS)
        except (SQLAlchemyError, ImportError, ValueError) as error:
            reason = str(getattr(error, "orig", None) or error).splitlines()[0]
            raise InputError(f"the monitor's database must be a file of SQLite or a URL, got: {reason}") from None
        if known != str(tables.SCHEMA):
            raise InputError(f"the monitor's database must have version {tables.SCHEMA}, got {known} ({database})")

    def _prepare_tables(self, attempts: int) -> str:
        """Make the tables where they are missing, and return their version."""
        facts = tables.facts
        try:
            with self.engine.begin() as connection:
                tables.metadata.create_all(connection)
                known = connection.execute(select(facts.c.value).where(facts.c.name == "schema")).scalar()
                if known is None:
                    connection.execute(facts.insert().values(name="schema", value=str(tables.SCHEMA)))
        except (IntegrityError, ProgrammingError):
            if attempts == 1:
                raise
            time.sleep(0.2)  # another monitor makes the tables at this moment
            return self._prepare_tables(attempts - 1)
        return str(known or tables.SCHEMA)

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Return a connection whose changes are kept together when the block ends well."""
        with self._writing_lock, self.engine.begin() as connection:
            yield connection

    @contextmanager
    def _begin_notes(self) -> Iterator[sa.Connection]:
        """Return a connection for changes that the death of this process leaves, a loss of power perhaps not."""
        is_file = self.engine.dialect.name == "sqlite"
        with self._writing_lock, self.engine.connect() as connection:
            if is_file:
                connection.exec_driver_sql("PRAGMA synchronous=NORMAL")
                connection.commit()
            try:
                with connection.begin():
                    if self.engine.dialect.name == "postgresql":
                        connection.execute(sa.text("set local synchronous_commit to off"))
                    yield connection
            finally:
                if is_file:
                    connection.exec_driver_sql("PRAGMA synchronous=FULL")
                    connection.commit()

    def _rows(self, query: Any) -> Sequence[sa.Row[Any]]:
        with self.engine.connect() as connection:
            return connection.execute(query).all()

    def _value(self, query: Any) -> int:
        """Return the number that a query gives, 0 for none."""
        with self.engine.connect() as connection:
            return int(connection.execute(query).scalar() or 0)

    def select_stored(self, blocks: Iterable[tuple[str, str]]) -> set[tuple[str, str]]:
        """Select the stored ones among blocks, each an actuator and an identity."""
        # a query for each: SQLite goes through the whole table for a list of pairs
        columns = tables.blocks.c
        query = select(columns.number).where(
            columns.actuator == bindparam("of"), columns.identity == bindparam("identity")
        )
        with self.engine.connect() as connection:
            return {
                (actuator, identity)
                for actuator, identity in blocks
                if connection.execute(query, {"of": actuator, "identity": identity}).first() is not None
            }

    def is_known(self, actuator: str, identity: str) -> bool:
        """Test whether a block is stored."""
        return bool(self.select_stored([(actuator, identity)]))

    def keep_blocks(self, connection: sa.Connection, blocks: Iterable[tuple[str, str, int]]) -> None:
        """Store blocks: actuator, identity, and number among those of the actuator.

        Raises IntegrityError, and the transaction is over, where one of them is stored already.
        """
        names = ("actuator", "identity", "number")
        connection.execute(tables.blocks.insert(), [dict(zip(names, block, strict=True)) for block in blocks])

    def keep_rows(self, connection: sa.Connection, rows: StoredRows) -> None:
        """Store rows, each table's at once."""
        actuator = bindparam("of", type_=sa.String)
        if rows.actuators:
            before = tables.pending.delete().where(tables.pending.c.actuator == actuator)
            connection.execute(before, [{"of": name} for name in rows.actuators])
        if rows.events and self.engine.dialect.name == "postgresql":
            # events become known in the order of their numbers: an output that is past one never looks back
            connection.execute(sa.text("lock table events in exclusive mode"))
        for new in (tables.estimates, tables.pending, tables.events):
            if values := getattr(rows, new.name):
                connection.execute(new.insert(), values)
        for changed in (tables.actuators, tables.summaries, tables.alarms):
            self.upsert(connection, changed, [*getattr(rows, changed.name).values()])
        for place, table in enumerate((tables.blocks, tables.estimates)):
            old = [{"of": name, "last": numbers[place]} for name, numbers in rows.old.items() if numbers[place] > 0]
            if old:
                chosen = (table.c.actuator == actuator) & (table.c.number <= bindparam("last"))
                connection.execute(table.delete().where(chosen), old)

    def keep(self, rows: StoredRows) -> None:
        """Store rows in a transaction of their own."""
        with self.writing() as connection:
            self.keep_rows(connection, rows)

    def upsert(self, connection: sa.Connection, table: sa.Table, rows: list[dict[str, Any]]) -> None:
        """Change rows of a table by its primary key, or insert the missing ones."""
        if not rows:
            return
        key = table.primary_key.columns.keys()
        chosen = [table.c[name] == bindparam(f"of_{name}") for name in key]
        values = [{f"of_{name}" if name in key else name: value for name, value in row.items()} for row in rows]
        if connection.execute(table.update().where(*chosen), values).rowcount < len(rows):
            if len(rows) == 1:
                connection.execute(table.insert(), rows)
            else:
                for row in rows:
                    self.upsert(connection, table, [row])

    def keep_refused(self, rows: Sequence[dict[str, Any]]) -> None:
        """Store refused messages in a transaction of their own, and keep the last `KEPT_REFUSED`."""
        table, columns = tables.refused, tables.refused.c
        with self.writing() as connection:
            connection.execute(table.insert(), rows[-KEPT_REFUSED:])
            last = int(connection.execute(select(func.max(columns.number))).scalar() or 0)
            connection.execute(table.delete().where(columns.number <= last - KEPT_REFUSED))

    def refused(self, most: int = KEPT_REFUSED) -> list[dict[str, Any]]:
        """Return the refused messages and files, the last one first."""
        rows = self._rows(select(tables.refused).order_by(tables.refused.c.number.desc()).limit(most))
        return [dict(row._mapping) for row in rows]

    def begin_decoding(self, reader: str, digest: str) -> int:
        """Note the start of decoding a message; return the number of earlier starts without an end."""
        table, columns = tables.decodings, tables.decodings.c
        before = select(columns.attempts).where(columns.reader == reader, columns.digest == digest)
        with self._begin_notes() as connection:
            attempts = int(connection.execute(before).scalar() or 0)
            self.upsert(connection, table, [{"reader": reader, "digest": digest, "attempts": attempts + 1}])
        return attempts

    def end_decoding(self, reader: str, digest: str) -> None:
        """Forget that a reader began to decode a message."""
        columns = tables.decodings.c
        with self._begin_notes() as connection:
            connection.execute(tables.decodings.delete().where(columns.reader == reader, columns.digest == digest))

    def last_number(self, table: sa.Table, actuator: str) -> int:
        """Return the number of an actuator's last row of a table, `tables.blocks` or `tables.estimates`."""
        return self._value(select(func.max(table.c.number)).where(table.c.actuator == actuator))

    def checkpoint(self, actuator: str) -> tuple[str, dict[str, Any], list[StoredSamples]] | None:
        """Return the settings and state of the checkpoint and the samples since, None without a checkpoint."""
        states, pending = tables.actuators, tables.pending
        samples = select(pending.c.samples).where(pending.c.actuator == actuator).order_by(pending.c.number)
        with self.engine.connect() as connection:
            row = connection.execute(select(states).where(states.c.actuator == actuator)).first()
            blocks = [_unpack(data) for (data,) in connection.execute(samples)]
        return None if row is None else (row.settings, json.loads(row.checkpoint), blocks)

    def last_samples(self, actuator: str) -> list[Recording]:
        """Return the samples of an actuator since its last checkpoint."""
        return [stored.samples for stored in (self.checkpoint(actuator) or ("", {}, []))[2]]

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Return the last summary of each actuator."""
        return {row.actuator: json.loads(row.summary) for row in self._rows(select(tables.summaries))}

    def alarms(self, *, open_only: bool = False, actuator: str | None = None) -> list[dict[str, Any]]:
        """Return alarms as plain values, by actuator, the latest first, whatever its clock said."""
        columns = tables.alarms.c
        query = select(columns.alarm)
        if open_only:
            query = query.where(columns.state.not_in(("closed", "invalid")))
        if actuator is not None:
            query = query.where(columns.actuator == actuator)
        values = [json.loads(text) for (text,) in self._rows(query)]
        return sorted(values, key=lambda alarm: (alarm["actuator"], -int(alarm["id"].rpartition("-")[2])))

    def events_since(self, number: int, most: int = 1000) -> list[tuple[int, dict[str, Any]]]:
        """Return events beyond a number with their own numbers, in their order."""
        columns = tables.events.c
        rows = self._rows(select(tables.events).where(columns.number > number).order_by(columns.number).limit(most))
        return [(row.number, _event(row)) for row in rows]

    def last_events(self, actuator: str, most: int = 200) -> list[dict[str, Any]]:
        """Return the latest events of an actuator, the last one first."""
        columns = tables.events.c
        query = select(tables.events).where(columns.actuator == actuator).order_by(columns.number.desc()).limit(most)
        return [_event(row) for row in self._rows(query)]

    def course(self, actuator: str, most: int = 600, seconds: float | None = None) -> list[dict[str, Any]]:
        """Return the estimates of an actuator, means of successive ones where there are more than `most`.

        `seconds`: only the last of them, by the clock of the newest one, which may have been set back.
        """
        columns = tables.estimates.c
        chosen = columns.actuator == actuator
        if seconds is not None:
            newest = select(columns.t).where(chosen).order_by(columns.number.desc()).limit(1).scalar_subquery()
            chosen &= columns.t.between(newest - seconds, newest)
        every = max(1, -(-self._value(select(func.count()).where(chosen)) // most))
        group = columns.number - columns.number % every
        query = select(*(func.avg(columns[name]).label(name) for name in ("t", *tables.FIGURES)))
        return [dict(row._mapping) for row in self._rows(query.where(chosen).group_by(group).order_by(group))]

    def estimates(self) -> Iterator[dict[str, Any]]:
        """Yield the estimates that are kept, by actuator in their order."""
        query = select(tables.estimates).order_by(tables.estimates.c.actuator, tables.estimates.c.number)
        with self.engine.connect() as connection:
            for row in connection.execution_options(yield_per=10_000).execute(query):
                yield dict(row._mapping)

    def position(self, name: str) -> int:
        """Return the number of the last event that an output has passed on."""
        return self._value(select(tables.facts.c.value).where(tables.facts.c.name == name))

    def keep_position(self, name: str, number: int) -> None:
        """Store how far an output is."""
        with self.writing() as connection:
            self.upsert(connection, tables.facts, [{"name": name, "value": str(number)}])

    def pass_on(self, output: str, send: Callable[[dict[str, Any]], bool]) -> None:
        """Hand events to `send` in their order until it returns False, and store how far the output is after each."""
        for number, event in self.events_since(self.position(output)):
            if not send(event):
                return
            self.keep_position(output, number)


def outage_reason(error: BaseException) -> str | None:
    """Give the reason in one line if the database does not answer or write; None for an error of another kind.

    Values that it cannot hold are another kind: they would be refused again.
    """
    if isinstance(error, PoolTimeout):
        return "every connection to the database is in use"
    if not isinstance(error, DBAPIError) or isinstance(error, DataError):
        return None
    return " ".join(str(error.orig).split())[:200]


def _pack(samples: Recording, follows: bool, verdict: RecordingVerdict | None) -> bytes:
    """Return samples as one line of JSON and their numbers, little endian, the clock first."""
    head = _head(tuple((name, samples.units[name]) for name in samples.channels), samples.rate, follows)
    if verdict is not None:
        head = json.dumps({**json.loads(head), "verdict": vars(verdict)}).encode() + b"\n"
    return head + np.array([samples.t, *samples.channels.values()], dtype="<f8").tobytes()


@lru_cache(maxsize=64)
def _head(units: tuple[tuple[str, str], ...], rate: float, follows: bool) -> bytes:
    return json.dumps({"units": dict(units), "rate": rate, "follows": follows}).encode() + b"\n"


def _unpack(data: bytes) -> StoredSamples:
    """Unpack samples from the bytes of `_pack`."""
    line, _, numbers = data.partition(b"\n")
    head = json.loads(line)
    t, *channels = np.frombuffer(numbers, dtype="<f8").reshape(1 + len(head["units"]), -1)
    samples = Recording(t, dict(zip(head["units"], channels, strict=True)), head["units"], head["rate"])
    verdict = head.get("verdict")
    return StoredSamples(
        samples, head["follows"], None if verdict is None else restored(RecordingVerdict, verdict, "verdict")
    )


def _event(row: Any) -> dict[str, Any]:
    values = {"number": row.number, "event": row.kind, "t": row._mapping["t"], "by": row.by_whom, "text": row.text}
    return {**values, "alarm": json.loads(row.alarm)}


def _prepare_sqlite(connection: Any, record: object) -> None:
    # a page holds a second of samples, and the cache all that a transaction writes
    settings = "page_size=16384", "cache_size=-32000", "busy_timeout=5000", "foreign_keys=ON"
    for setting in (*settings, "journal_mode=WAL", "synchronous=FULL"):
        connection.execute(f"PRAGMA {setting}")
