"""Connections to PostgreSQL that do not wait for ever: for a server that is gone, that hangs, or that waits for a lock.

A server that is gone is noticed by TCP, at both ends. One that hangs still confirms every packet: its answers have a
deadline here, after which the connection is closed and what was under way is tried again. The server itself ends a
statement before that, or else each new try would leave one more process waiting in it.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import Any

from sqlalchemy import URL, Engine, event

#: How long a connection may take, how long an answer, and how long the server may work at one statement [s].
CONNECT_S, ANSWER_S, STATEMENT_S = 5, 10.0, 8.0
#: How long the server keeps a transaction in which nothing happens, such as that of a monitor that is gone [s].
_IDLE_S = 20.0
_DRIVERS = ("postgresql", "postgresql+psycopg", "postgresql+psycopg2")


def engine_options(url: URL) -> dict[str, Any]:
    """Return the engine options of a PostgreSQL URL, {} for another; options in its query are left unchanged."""
    if url.drivername not in _DRIVERS:
        return {}
    signs = {"keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}
    server = {
        "statement_timeout": round(1000.0 * STATEMENT_S),
        "idle_in_transaction_session_timeout": round(1000.0 * _IDLE_S),
        **{f"tcp_{name}": value for name, value in signs.items()},
    }
    options = " ".join(f"-c {name}={value}" for name, value in server.items())
    limits = {**signs, "tcp_user_timeout": 10_000, "connect_timeout": CONNECT_S, "options": options}
    arguments = {name: value for name, value in limits.items() if name not in url.query}
    return {"pool_pre_ping": True, "pool_timeout": 5.0, "connect_args": arguments}


def limit_answers(engine: Engine) -> None:
    """Give each answer of PostgreSQL to an engine's connections a deadline, where the driver is psycopg 3."""
    if engine.dialect.driver != "psycopg":
        return
    from psycopg import Connection, OperationalError

    class LimitedConnection(Connection[Any]):
        """A connection, closed if the server does not answer in time."""

        def wait(self, gen: Any, *arguments: Any, **options: Any) -> Any:
            return super().wait(self._limited(gen), *arguments, **options)

        def _limited(self, gen: Generator[Any, Any, Any]) -> Generator[Any, Any, Any]:
            """Pass a driver's generator on; it is resumed several times a second, also without an answer."""
            last, ready = time.monotonic(), None
            while True:
                try:
                    condition = gen.send(ready)
                except StopIteration as end:
                    return end.value
                ready = yield condition
                now = time.monotonic()
                if ready:
                    last = now
                elif now - last > ANSWER_S:
                    gen.close()
                    self.pgconn.finish()
                    raise OperationalError(f"PostgreSQL has not answered for {ANSWER_S:g} s")

    event.listen(engine, "do_connect", lambda *call: LimitedConnection.connect(*call[2], **call[3]))
