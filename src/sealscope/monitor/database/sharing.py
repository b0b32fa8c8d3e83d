"""Several monitors over one database: which actuators are whose, by leases that lapse when a monitor is gone.

Every monitor hears every actuator. It stores the blocks of those whose lease it holds, and keeps the last ones of the
others in memory for a takeover. A lease is looked at in the very transaction that stores a block, so a monitor that was
held up and lost its lease stores nothing. Times are those of the database.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence

from sqlalchemy import Connection, delete, func, select, text, update
from sqlalchemy.exc import IntegrityError

from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.settings import ShareSettings

_log = logging.getLogger(__name__)
#: The lease of what goes out (lines, messages, posts): one monitor sends for all.
OUTPUTS = ""


class Share:
    """The share of a monitor in the `actuators` of a database, which it loses where it says nothing for `lease_s`."""

    def __init__(self, store: MonitorStore, settings: ShareSettings, actuators: Sequence[str]) -> None:
        self._store, self.name, self.lease_s = store, settings.name, settings.lease_s
        self._names = sorted({*actuators, OUTPUTS})
        self.held: frozenset[str] = frozenset()
        leases = store.tables.leases
        for actuator in self._names:
            try:
                with store.writing() as connection:
                    connection.execute(leases.insert().values(actuator=actuator, holder="", until=0.0))
            except IntegrityError:
                continue  # it is there

    def renew(self) -> tuple[frozenset[str], frozenset[str]]:
        """Renew the leases, take what is free up to a fair share, and give back what is over it.

        Return what was gained and what was lost. Raises what the database raises.
        """
        monitors, leases = self._store.tables.monitors, self._store.tables.leases
        with self._store.writing() as connection:
            now = self._now(connection)
            until = now + self.lease_s
            self._store.put(connection, monitors, [{"name": self.name, "until": until}])
            live = connection.execute(select(func.count()).where(monitors.c.until > now)).scalar() or 1
            rows = connection.execute(select(leases).where(leases.c.actuator.in_(self._names))).all()
            fair = math.ceil(len(self._names) / live)
            mine = sorted(row.actuator for row in rows if row.holder == self.name and row.until > now)
            kept = set(mine[:fair])
            for actuator in mine[fair:]:
                connection.execute(update(leases).where(leases.c.actuator == actuator).values(until=0.0))
            for row in sorted(rows, key=lambda row: row.actuator):
                if row.actuator in kept or (row.until <= now and len(kept) < fair):
                    # of two monitors that see it free the one whose update comes first has it
                    free = (leases.c.until <= now) | (leases.c.holder == self.name)
                    taken = connection.execute(
                        update(leases)
                        .where(leases.c.actuator == row.actuator, free)
                        .values(holder=self.name, until=until)
                    )
                    kept = kept | {row.actuator} if taken.rowcount == 1 else kept - {row.actuator}
        before, self.held = self.held, frozenset(kept)
        self._store.sends = OUTPUTS in kept
        gained, lost = self.held - before - {OUTPUTS}, before - self.held - {OUTPUTS}
        if gained or lost:
            _log.warning("%s: watches %d of %d actuators", self.name, len(kept - {OUTPUTS}), len(self._names) - 1)
        return gained, lost

    def holds(self, connection: Connection, actuator: str) -> bool:
        """Whether this monitor may store a block of an actuator; nobody takes its lease before the transaction ends."""
        leases = self._store.tables.leases
        query = select(leases.c.holder, leases.c.until).where(leases.c.actuator == actuator).with_for_update()
        row = connection.execute(query).first()
        return row is not None and row.holder == self.name and row.until > self._now(connection)

    def give_back(self) -> None:
        """Give everything back at once, as a monitor that ends does."""
        monitors, leases = self._store.tables.monitors, self._store.tables.leases
        with self._store.writing() as connection:
            connection.execute(update(leases).where(leases.c.holder == self.name).values(until=0.0))
            connection.execute(delete(monitors).where(monitors.c.name == self.name))
        self.held = frozenset()

    def _now(self, connection: Connection) -> float:
        """Return the clock of the database [s]: those of several machines differ."""
        if self._store.engine.dialect.name != "postgresql":
            return time.time()
        return float(connection.execute(text("select extract(epoch from clock_timestamp())")).scalar_one())
