"""The monitor's database: each change is one transaction, written atomically.

SQLite in WAL mode with full synchronisation, or any database that SQLAlchemy knows, by URL.
"""

from __future__ import annotations

import itertools
import json
import logging
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
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
from sealscope.monitor.database.sqlite_files import FilesReplaced, SqliteFiles
from sealscope.monitor.supervisor import describe_error
from sealscope.monitor.verdicts import RecordingVerdict
from sealscope.recordings.recording import Recording
from sealscope.storage.plain_state import restore

_log = logging.getLogger(__name__)
#: Number of block identities that are stored for each actuator: more than a day of messages of 1 s each.
MAX_IDENTITIES = 100_000
#: Number of refused messages that are stored, the newest ones.
MAX_REFUSED = 1000
#: Attempts to create the tables, as several monitors may start at once.
_ATTEMPTS = 10
#: Queries of the page at a time, at most; connections for them and for outputs; longest wait for one [s].
MAX_QUERIES, _N_READERS, QUERY_WAIT_S = 4, 8, 5.0
#: Most estimates that are averaged to one row of a history: of more, every second one, every third one and so on.
_MAX_AVERAGED = 32
#: What each alarm and each summary of an actuator has; a row without it is damaged.
_ALARM_KEYS = ("id", "actuator", "level", "state", "raised_s", "onset_s", "baseline")
_SUMMARY_KEYS = ("t", "status", "by", "blocks", "counters", "total_lpm", "leak_lpm", "leak_interval_lpm", "status_word")
#: Name of the number of transactions in the table `facts`.
_TRANSACTIONS = "transactions"


class StoredSamples(NamedTuple):
    """Samples of a stored block."""

    number: int  # running number among all blocks of the actuator
    samples: Recording
    follows: bool  # False after a gap
    verdict: RecordingVerdict | None  # on the recording that ends with the samples


@dataclass
class StoredRows:
    """The rows that one transaction writes to the tables of the database, besides the blocks' identities."""

    # rows to insert
    new: dict[sa.Table, list[dict[str, Any]]] = field(default_factory=lambda: defaultdict(list))
    # by primary key: rows that are new or replace stored ones
    current: dict[sa.Table, dict[str, dict[str, Any]]] = field(default_factory=lambda: defaultdict(dict))
    # by actuator: the running number up to which rows are deleted
    old: dict[sa.Table, dict[str, int]] = field(default_factory=lambda: defaultdict(dict))

    def add_estimates(self, actuator: str, estimates: Iterable[BlockEstimate], oil_celsius: float | None) -> None:
        """Add the leakage estimates of an actuator's blocks, with the oil temperature [deg C], None if unknown."""
        for estimate in estimates:
            total_ends = estimate.total_interval_lpm or (None, None)
            leak_ends = estimate.leak_interval_lpm or (None, None)
            figures = (estimate.total_lpm, *total_ends, estimate.leak_lpm, *leak_ends, oil_celsius)
            status = estimate.status[:160]  # the length of the column
            row = {"actuator": actuator, "number": estimate.number, "t": estimate.t, "status": status}
            self.new[tables.estimates].append({**row, **dict(zip(tables.FIGURES, figures, strict=True))})

    def add_pending(self, actuator: str, block: StoredSamples) -> None:
        """Add samples that a restart must judge again, or collect again for a recording that has not ended."""
        row = {"actuator": actuator, "number": block.number, "samples": _pack_samples(block)}
        self.new[tables.pending].append(row)

    def add_alarm(self, alarm: Alarm, kind: str, t: float, by_whom: str = "", text: str = "") -> None:
        """Add the row of an alarm in its present state, and that of the event that changed it at the time `t` [s].

        `kind`: kind of event, "" to store none; `by_whom`, `text`: person who caused the event, and comment, or "".
        """
        plain = json.dumps(alarm.as_dict())
        row = {"actuator": alarm.actuator, "id": alarm.id, "state": alarm.state, "alarm": plain}
        self.current[tables.alarms][alarm.id] = row
        if kind:
            event = {"actuator": alarm.actuator, "kind": kind, "by_whom": by_whom, "text": text}
            self.new[tables.events].append({**event, "t": t, "alarm_id": alarm.id, "alarm": plain})

    def add_checkpoint(self, actuator: str, settings: str, state: dict[str, Any], first_kept: int) -> None:
        """Add settings (JSON) and state of an actuator; drop its pending samples before block number `first_kept`.

        The state includes the effect of all pending samples. Those kept belong to a recording that has not ended: a
        restart collects them again for it, but does not judge them again (`n_stored` of the state).
        """
        pending = self.new[tables.pending]
        pending[:] = [row for row in pending if row["actuator"] != actuator or row["number"] >= first_kept]
        self.old[tables.pending][actuator] = first_kept - 1
        plain = json.dumps(state, allow_nan=False)
        self.current[tables.actuators][actuator] = {"actuator": actuator, "settings": settings, "checkpoint": plain}

    def add_summary(self, actuator: str, summary: dict[str, Any]) -> None:
        """Add the summary of an actuator, which the page and other outputs show."""
        import orjson

        plain = orjson.dumps(summary, option=orjson.OPT_SERIALIZE_NUMPY).decode()
        self.current[tables.summaries][actuator] = {"actuator": actuator, "summary": plain}


class MonitorStore:
    """The database of a monitor, from which outputs and the page read."""

    def __init__(self, database: str) -> None:
        """Open the database, a file of SQLite or a URL, and create missing tables; raise InputError if that fails."""
        is_file = "://" not in database
        # one thread writes at a time: SQLite would make the others wait, and then fail
        self._writing_lock: AbstractContextManager[object] = threading.RLock() if is_file else nullcontext()
        url = f"sqlite:///{Path(database)}" if is_file else database
        #: Transactions that the database has lost since its last monitor, because of a removed or replaced file.
        self.n_lost = self._n_transactions = 0
        is_new = is_file and not Path(database).exists()
        self._files: SqliteFiles | None = None
        self._reported_rows = set[tuple[str, Any]]()  # damaged rows that are logged already
        try:
            # the page has connections of its own, so that storage never waits for one
            limits = {"pool_size": _N_READERS, "max_overflow": 0, "pool_timeout": QUERY_WAIT_S}
            self.engine, self._page_engine = _create_engine(url), _create_engine(url, **limits)
            version = self._prepare_tables()
            if is_file:
                self._files = SqliteFiles(Path(database))
                self._find_lost_transactions(self._files, is_new=is_new)
        except (SQLAlchemyError, ImportError, ValueError) as error:
            reason = str(getattr(error, "orig", None) or error).splitlines()[0]
            raise InputError(f"the monitor's database must be a file of SQLite or a URL, got: {reason}") from None
        if version != str(tables.SCHEMA):
            raise InputError(f"the monitor's database must have version {tables.SCHEMA}, got {version} ({database})")

    def _prepare_tables(self) -> str:
        """Create missing tables, and return the version of the database's schema, which the table `facts` stores."""
        facts = tables.facts
        for attempt in itertools.count(1):
            try:
                with self.engine.begin() as connection:
                    tables.metadata.create_all(connection)
                    for index in tables.estimates.indexes:  # a database of an earlier version lacks it
                        index.create(connection, checkfirst=True)
                    version = connection.execute(select(facts.c.value).where(facts.c.name == "schema")).scalar()
                    if version is None:
                        connection.execute(facts.insert().values(name="schema", value=str(tables.SCHEMA)))
                break
            except (IntegrityError, ProgrammingError):
                if attempt == _ATTEMPTS:
                    raise
                time.sleep(0.2)  # another monitor is creating the tables
        return str(version or tables.SCHEMA)

    def _find_lost_transactions(self, files: SqliteFiles, *, is_new: bool) -> None:
        """Compare the number of transactions in the database with that beside it, and log how many are missing.

        `is_new`: True if there was no database: somebody has removed it to begin anew.
        """
        self._n_transactions, expected = self.position(_TRANSACTIONS), files.stored_count()
        self.n_lost = 0 if is_new else max(0, expected - self._n_transactions)
        if self.n_lost:
            _log.error(
                "%s lacks the last %d transactions of its monitor: its file -wal was removed, or it was replaced",
                files.path.name,
                self.n_lost,
            )
        if expected != self._n_transactions:
            files.store_count(self._n_transactions)

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """Open a transaction for changes, which an error rolls back.

        Raises FilesReplaced if the file of a SQLite database was removed or replaced.
        """
        files = self._files
        with self._writing_lock:
            if files is not None:
                files.check_database()
                if files.is_wal_lost():
                    self._save_removed_wal(files)
            with self.engine.begin() as connection:
                yield connection
                if files is not None:
                    row = {"name": _TRANSACTIONS, "value": str(self._n_transactions + 1)}
                    self.upsert(connection, tables.facts, [row])
            if files is not None:
                self._n_transactions += 1
                files.store_count(self._n_transactions)
                files.note_wal()

    def _save_removed_wal(self, files: SqliteFiles) -> None:
        """Move the transactions of a removed file `-wal`, which open connections still reach, to the database."""
        _log.error("%s-wal was removed while the monitor runs: its transactions are saved", files.path.name)
        with self.engine.connect() as connection:  # an open one, by the pool: it was not closed since the removal
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        for engine in (self.engine, self._page_engine):  # new connections make a new file
            engine.dispose()

    @contextmanager
    def _begin_relaxed_transaction(self) -> Iterator[sa.Connection]:
        """Open a faster transaction, whose changes survive a crash of this process but perhaps not a power failure."""
        is_file = self.engine.dialect.name == "sqlite"
        with self._writing_lock, self.engine.connect() as connection:
            if is_file:
                connection.exec_driver_sql("PRAGMA synchronous=NORMAL")
                connection.commit()  # ends the transaction that SQLAlchemy begins with each statement
            try:
                with connection.begin():
                    if self.engine.dialect.name == "postgresql":
                        connection.execute(sa.text("set local synchronous_commit to off"))
                    yield connection
            finally:
                if is_file:
                    connection.exec_driver_sql("PRAGMA synchronous=FULL")
                    connection.commit()

    def _rows(self, query: Any, *, by_page: bool = False) -> Sequence[sa.Row[Any]]:
        """Execute a query; `by_page`: by one of the connections of the page, of which there are few."""
        with (self._page_engine if by_page else self.engine).connect() as connection:
            return connection.execute(query).all()

    def _parse_row(self, table: sa.Table, key: Any, parse: Callable[[], Any]) -> Any:
        """Return the result of `parse` for a row; log a row that is damaged, once, and return None for it.

        `key`: text by which the row is named.
        """
        try:
            return parse()
        except Exception as error:  # a damaged row may hold anything
            if (table.name, key) not in self._reported_rows:
                self._reported_rows.add((table.name, key))
                _log.error("a row of the table %s is damaged: %s (%s)", table.name, key, describe_error(error))
            return None

    def _value(self, query: Any) -> int:
        """Execute a query for a single number; return 0 if it gives none."""
        with self.engine.connect() as connection:
            return int(connection.execute(query).scalar() or 0)

    def select_stored(self, blocks: Iterable[tuple[str, str]]) -> set[tuple[str, str]]:
        """Select the blocks that are stored already from `blocks`, given as pairs (actuator, identity)."""
        # one query per block: SQLite scans the whole table for a list of pairs
        columns = tables.blocks.c
        is_block = (columns.actuator == bindparam("name")) & (columns.identity == bindparam("identity"))
        query = select(columns.number).where(is_block)
        with self.engine.connect() as connection:
            return {
                (actuator, identity)
                for actuator, identity in blocks
                if connection.execute(query, {"name": actuator, "identity": identity}).first() is not None
            }

    def is_known(self, actuator: str, identity: str) -> bool:
        """Return True if the block of an actuator with this identity is stored already."""
        return bool(self.select_stored([(actuator, identity)]))

    def insert_blocks(self, connection: sa.Connection, blocks: Iterable[tuple[str, str, int]]) -> None:
        """Store the identities of blocks, each given as (actuator, identity, running number for this actuator).

        Raises IntegrityError if one of the blocks is stored already.
        """
        names = ("actuator", "identity", "number")
        connection.execute(tables.blocks.insert(), [dict(zip(names, block, strict=True)) for block in blocks])

    def write_rows(self, connection: sa.Connection, rows: StoredRows) -> None:
        """Write rows to their tables within the transaction of `connection`, and delete old ones (`StoredRows`)."""
        if tables.events in rows.new and self.engine.dialect.name == "postgresql":
            # events are committed in the order of their numbers: otherwise an output could miss a smaller number
            connection.execute(sa.text("lock table events in exclusive mode"))
        for table, new_rows in rows.new.items():
            if new_rows:
                connection.execute(table.insert(), new_rows)
        for table, rows_by_key in rows.current.items():
            self.upsert(connection, table, [*rows_by_key.values()])
        for table, last_numbers in rows.old.items():  # the running numbers begin at 1
            if parameters := [{"name": name, "last": last} for name, last in last_numbers.items() if last > 0]:
                is_actuator = table.c.actuator == bindparam("name", type_=sa.String)
                connection.execute(table.delete().where(is_actuator, table.c.number <= bindparam("last")), parameters)

    def commit_rows(self, rows: StoredRows) -> None:
        """Write rows in a separate transaction (`write_rows`)."""
        with self.writing() as connection:
            self.write_rows(connection, rows)

    def upsert(self, connection: sa.Connection, table: sa.Table, rows: list[dict[str, Any]]) -> None:
        """Write rows to a table: update the stored rows with the same primary keys, and insert the missing ones."""
        if not rows:
            return
        key = table.primary_key.columns.keys()
        # SQLAlchemy takes a parameter with the name of a column as its new value: the values of the key get a prefix
        is_row = [table.c[name] == bindparam(f"of_{name}") for name in key]
        values = [{f"of_{name}" if name in key else name: value for name, value in row.items()} for row in rows]
        if connection.execute(table.update().where(*is_row), values).rowcount < len(rows):
            if len(rows) == 1:
                connection.execute(table.insert(), rows)
            else:  # it is not known which rows are missing: try each
                for row in rows:
                    self.upsert(connection, table, [row])

    def write_refused(self, rows: Sequence[dict[str, Any]]) -> None:
        """Store refused messages in a separate transaction, and delete all but the newest `MAX_REFUSED`."""
        table, columns = tables.refused, tables.refused.c
        with self.writing() as connection:
            connection.execute(table.insert(), rows[-MAX_REFUSED:])
            last = int(connection.execute(select(func.max(columns.number))).scalar() or 0)
            connection.execute(table.delete().where(columns.number <= last - MAX_REFUSED))

    def refused(self) -> list[dict[str, Any]]:
        """Read the refused messages and files, newest first."""
        rows = self._rows(select(tables.refused).order_by(tables.refused.c.number.desc()))
        return [dict(row._mapping) for row in rows]

    def begin_decoding(self, reader: str, digest: str) -> int:
        """Store that a `reader` (MQTT client) begins to decode a message; return the number of earlier attempts.

        `digest`: hash of the message. An attempt that ends is not counted (`end_decoding`): the earlier ones crashed
        the process.
        """
        table, columns = tables.decodings, tables.decodings.c
        query = select(columns.attempts).where(columns.reader == reader, columns.digest == digest)
        with self._begin_relaxed_transaction() as connection:
            n_before = int(connection.execute(query).scalar() or 0)
            self.upsert(connection, table, [{"reader": reader, "digest": digest, "attempts": n_before + 1}])
        return n_before

    def end_decoding(self, reader: str, digest: str) -> None:
        """Delete the record that the MQTT client `reader` is decoding the message with the hash `digest`."""
        columns = tables.decodings.c
        with self._begin_relaxed_transaction() as connection:
            connection.execute(tables.decodings.delete().where(columns.reader == reader, columns.digest == digest))

    def last_number(self, table: sa.Table, actuator: str) -> int:
        """Read the highest running number of an actuator's rows in `table` (`blocks` or `estimates`), 0 for no rows."""
        return self._value(select(func.max(table.c.number)).where(table.c.actuator == actuator))

    def checkpoint(self, actuator: str) -> tuple[str, dict[str, Any]] | None:
        """Read settings (JSON) and state of an actuator at its last checkpoint; return None if there is none.

        Raises ValueError if the row is damaged.
        """
        rows = self._rows(select(tables.actuators).where(tables.actuators.c.actuator == actuator))
        return (rows[0].settings, _parse_table(rows[0].checkpoint)) if rows else None

    def pending(self, actuator: str, *, by_page: bool = False) -> list[StoredSamples]:
        """Read the pending samples of an actuator in the order of their blocks.

        They arrived after the last checkpoint, or before it and belong to a recording that has not ended.
        """
        columns = tables.pending.c
        query = select(columns.number, columns.samples).where(columns.actuator == actuator).order_by(columns.number)
        blocks: list[StoredSamples] = []
        follows = True  # False after a damaged row
        for row in self._rows(query, by_page=by_page):
            parse = partial(_unpack_samples, row.number, row.samples)
            block = self._parse_row(tables.pending, f"of {actuator}", parse)
            if block is not None:
                blocks.append(block if follows else block._replace(follows=False))
            follows = block is not None
        return blocks

    def last_samples(self, actuator: str) -> list[Recording]:
        """Read the pending samples of an actuator, one recording for each block."""
        return [block.samples for block in self.pending(actuator, by_page=True)]

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Read the last summary of each actuator, by name."""
        rows = self._rows(select(tables.summaries), by_page=True)
        parsed = (
            (
                row.actuator,
                self._parse_row(tables.summaries, row.actuator, partial(_parse_table, row.summary, _SUMMARY_KEYS)),
            )
            for row in rows
        )
        return {actuator: summary for actuator, summary in parsed if summary is not None}

    def alarms(self, *, open_only: bool = False, actuator: str | None = None) -> list[dict[str, Any]]:
        """Read alarms as plain values, sorted by actuator, and for each actuator with the latest alarm first.

        `open_only`: leave out closed and invalid alarms; `actuator`: read only the alarms of this actuator.
        """
        columns = tables.alarms.c
        query = select(columns.id, columns.alarm)
        if open_only:
            query = query.where(columns.state.not_in(("closed", "invalid")))
        if actuator is not None:
            query = query.where(columns.actuator == actuator)
        rows = self._rows(query, by_page=True)
        parsed = (self._parse_row(tables.alarms, row.id, partial(_parse_table, row.alarm, _ALARM_KEYS)) for row in rows)
        values = [alarm for alarm in parsed if alarm is not None]
        return sorted(values, key=lambda alarm: (alarm["actuator"], -alarm_number(alarm["id"])))

    def last_alarm_number(self, actuator: str) -> int:
        """Read the highest running number of an actuator's alarms, 0 if there is none."""
        columns = tables.alarms.c
        rows = self._rows(select(columns.id).where(columns.actuator == actuator))
        return max((alarm_number(row.id) for row in rows), default=0)

    def events_since(self, number: int) -> list[tuple[int, dict[str, Any]]]:
        """Read up to 1000 events with a running number above `number`, as pairs (number, event) in order."""
        columns = tables.events.c
        query = select(tables.events).where(columns.number > number).order_by(columns.number).limit(1000)
        return self._parse_events(self._rows(query), (*_ALARM_KEYS, "shelved"))

    def _parse_events(self, rows: Iterable[sa.Row[Any]], keys: Iterable[str] = ()) -> list[tuple[int, dict[str, Any]]]:
        """Convert rows of `events` to pairs (number, event); leave out damaged ones, or without `keys` of the alarm."""
        parsed = (
            (row.number, self._parse_row(tables.events, row.number, partial(_event_from_row, row, keys)))
            for row in rows
        )
        return [(number, event) for number, event in parsed if event is not None]

    def last_events(self, actuator: str) -> list[dict[str, Any]]:
        """Read the latest 200 events of an actuator, newest first."""
        columns = tables.events.c
        query = select(tables.events).where(columns.actuator == actuator).order_by(columns.number.desc()).limit(200)
        return [event for _, event in self._parse_events(self._rows(query, by_page=True))]

    def history(self, actuator: str, max_rows: int = 600, seconds: float | None = None) -> list[dict[str, Any]]:
        """Read the history of an actuator's estimates in order of time, averaged to at most about `max_rows` rows.

        Each row has the mean time `t` [s] and `FIGURES` of a group of successive estimates, of which at most
        `_MAX_AVERAGED`, evenly spread, are read: the work does not grow with the length of the history. `seconds` [s]:
        length of the history up to the last estimate, None for all.
        """
        columns = tables.estimates.c
        ends = select(columns.number, columns.t).where(columns.actuator == actuator).limit(1)
        last = self._rows(ends.order_by(columns.number.desc()), by_page=True)
        if not last:
            return []
        stop, last_t = last[0].number, last[0]._mapping["t"]  # `row.t` would be a method of SQLAlchemy's rows
        is_chosen = columns.actuator == actuator
        if seconds is None:
            first = self._rows(ends.order_by(columns.number), by_page=True)
        else:
            is_chosen &= columns.t.between(last_t - seconds, last_t)
            first = self._rows(ends.where(is_chosen).order_by(columns.t), by_page=True)
        start = first[0].number if first else stop
        n_averaged = max(1, -(-(stop - start + 1) // max_rows))  # estimates per row, rounded up
        group = columns.number - columns.number % n_averaged  # first running number in the group of an estimate
        query = select(*(func.avg(columns[name]).label(name) for name in ("t", *tables.FIGURES)))
        step = -(-n_averaged // _MAX_AVERAGED)
        if step == 1:
            query = query.where(is_chosen, columns.number.between(start, stop))
        else:  # every so many estimates: each is found by its number
            numbers = select(sa.literal(start).label("number")).cte("numbers", recursive=True)
            numbers = numbers.union_all(select(numbers.c.number + step).where(numbers.c.number + step <= stop))
            query = query.select_from(numbers).join(tables.estimates, is_chosen & (columns.number == numbers.c.number))
        rows = self._rows(query.group_by(group).order_by(group), by_page=True)
        return [dict(row._mapping) for row in rows]

    def estimates(self) -> Iterator[dict[str, Any]]:
        """Yield all stored estimates, sorted by actuator and running number."""
        query = select(tables.estimates).order_by(tables.estimates.c.actuator, tables.estimates.c.number)
        with self.engine.connect() as connection:
            for row in connection.execution_options(yield_per=10_000).execute(query):
                yield dict(row._mapping)

    def position(self, name: str) -> int:
        """Read the number that `write_position` stored under `name`; return 0 if there is none."""
        return self._value(select(tables.facts.c.value).where(tables.facts.c.name == name))

    def write_position(self, name: str, number: int) -> None:
        """Store a number under `name`, such as the number of the last alarm event that an output has delivered."""
        with self.writing() as connection:
            self.upsert(connection, tables.facts, [{"name": name, "value": str(number)}])

    def deliver(self, output: str, send: Callable[[dict[str, Any]], bool]) -> None:
        """Send the events that an output has not sent yet, in order, by `send`; store the number of the last one sent.

        If `send` returns False, the next call tries this event again.
        """
        for number, event in self.events_since(self.position(output)):
            if not send(event):
                return
            self.write_position(output, number)


def outage_reason(error: BaseException) -> str | None:
    """Describe in one line the database outage that an error reports; return None for an error of another kind.

    After an outage the monitor writes the same rows again; after an error of another kind it drops them. All errors of
    the driver but DataError count as an outage: drivers report a lost connection, a full or read-only database and a
    missing right by different classes, and may accept the rows later. A DataError concerns the rows themselves, which
    would be refused again.
    """
    if isinstance(error, PoolTimeout):
        return "every connection to the database is in use"
    if isinstance(error, FilesReplaced):
        return str(error)
    if not isinstance(error, DBAPIError) or isinstance(error, DataError):
        return None
    return " ".join(str(error.orig).split())[:200]


def alarm_number(alarm_id: str) -> int:
    """Return the running number of an alarm, with which its id ends after a hyphen."""
    return int(alarm_id.rpartition("-")[2])


def _create_engine(url: str, **options: Any) -> sa.Engine:
    """Create an engine for the database at `url`, with `options` of its pool of connections."""
    engine = sa.create_engine(url, **{**engine_options(sa.make_url(url)), **options})
    limit_answers(engine)
    if engine.dialect.name == "sqlite":
        sa.event.listen(engine, "connect", _prepare_sqlite)
    return engine


def _parse_table(text: str, keys: Iterable[str] = ()) -> dict[str, Any]:
    """Parse JSON to a mapping that has the `keys`; raise ValueError for anything else."""
    values = json.loads(text)
    if not isinstance(values, dict):
        raise ValueError(f"it must be a mapping, got {type(values).__name__}")
    if missing_keys := sorted({*keys} - values.keys()):
        raise ValueError(f"it must have {', '.join(missing_keys)}")
    return values


def _pack_samples(block: StoredSamples) -> bytes:
    """Pack samples as bytes: a line of JSON, then the times and all channels as little-endian doubles."""
    samples = block.samples
    units = {name: samples.units[name] for name in samples.channels}
    header: dict[str, Any] = {"units": units, "rate": samples.rate, "follows": block.follows}
    if block.verdict is not None:
        header["verdict"] = vars(block.verdict)
    numbers = np.array([samples.t, *samples.channels.values()], dtype="<f8")
    return json.dumps(header).encode() + b"\n" + numbers.tobytes()


def _unpack_samples(number: int, data: bytes) -> StoredSamples:
    """Unpack the bytes that `_pack_samples` made; `number`: running number of the block."""
    line, _, numbers = data.partition(b"\n")
    header = json.loads(line)
    t, *channels = np.frombuffer(numbers, dtype="<f8").reshape(1 + len(header["units"]), -1)
    samples = Recording(t, dict(zip(header["units"], channels, strict=True)), header["units"], header["rate"])
    verdict = header.get("verdict")
    stored_verdict = None if verdict is None else restore(RecordingVerdict, verdict, "verdict")
    return StoredSamples(number, samples, header["follows"], stored_verdict)


def _event_from_row(row: Any, keys: Iterable[str]) -> dict[str, Any]:
    """Convert a row of `events` to plain values: the event, and the alarm after it, which must have the `keys`."""
    # `row.t` would be a method of SQLAlchemy's rows
    values = {"number": row.number, "event": row.kind, "t": row._mapping["t"], "by": row.by_whom, "text": row.text}
    return {**values, "alarm": _parse_table(row.alarm, keys)}


def _prepare_sqlite(connection: Any, record: object) -> None:
    """Set the options of a new connection to SQLite; called by SQLAlchemy, whose second argument is not used."""
    # a page has room for a second of samples, the cache for all pages of a transaction
    settings = "page_size=16384", "cache_size=-32000", "busy_timeout=5000", "foreign_keys=ON"
    for setting in (*settings, "journal_mode=WAL", "synchronous=FULL"):
        connection.execute(f"PRAGMA {setting}")
