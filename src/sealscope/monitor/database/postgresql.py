"""Connections to PostgreSQL with time limits, for a server that is gone, hangs, or waits for a lock.

TCP detects a server that is gone. A server that hangs still confirms every packet: after a deadline for its answer
the connection is closed and the transaction is tried again. The server itself aborts a statement before that
deadline; otherwise each attempt would leave one more waiting process in it.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import Any

from sqlalchemy import URL, Engine, event

#: Limits for connecting, for an answer, and for the server's work on one statement [s].
CONNECT_S, ANSWER_S, STATEMENT_S = 5, 10.0, 8.0
#: Limit of the server for an idle transaction, such as that of a monitor that is gone [s].
_IDLE_S = 20.0
_DRIVERS = ("postgresql", "postgresql+psycopg", "postgresql+psycopg2")


def engine_options(url: URL) -> dict[str, Any]:
    """Build SQLAlchemy's options with the time limits for PostgreSQL; return {} for the URL of another database.

    A limit that `url` states itself is left out.
    """
    if url.drivername not in _DRIVERS:
        return {}
    keepalive = {"keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}
    server = {
        "statement_timeout": round(1000.0 * STATEMENT_S),
        "idle_in_transaction_session_timeout": round(1000.0 * _IDLE_S),
        **{f"tcp_{name}": value for name, value in keepalive.items()},
    }
    options = " ".join(f"-c {name}={value}" for name, value in server.items())
    # the server's times are in milliseconds, as is tcp_user_timeout; the others are in seconds
    limits = {**keepalive, "tcp_user_timeout": 10_000, "connect_timeout": CONNECT_S, "options": options}
    arguments = {name: value for name, value in limits.items() if name not in url.query}
    return {"pool_pre_ping": True, "pool_timeout": 5.0, "connect_args": arguments}


def limit_answers(engine: Engine) -> None:
    """Make an engine's connections raise an error if the server does not answer within `ANSWER_S` (psycopg 3 only)."""
    if engine.dialect.driver != "psycopg":
        return
    from psycopg import Connection, OperationalError

    class LimitedConnection(Connection[Any]):
        """A connection that is closed, with OperationalError, if the server does not answer for `ANSWER_S`."""

        def wait(self, gen: Any, *arguments: Any, **options: Any) -> Any:
            return super().wait(self._with_time_limit(gen), *arguments, **options)

        def _with_time_limit(self, gen: Generator[Any, Any, Any]) -> Generator[Any, Any, Any]:
            """Run `gen`, by which psycopg waits for an answer, and return its result, under the time limit.

            Psycopg resumes this generator several times a second; `ready` is false while there is no answer.
            """
            last_answer = time.monotonic()
            ready: Any = None
            while True:
                try:
                    condition = gen.send(ready)
                except StopIteration as end:
                    return end.value
                ready = yield condition
                now = time.monotonic()
                if ready:
                    last_answer = now
                elif now - last_answer > ANSWER_S:
                    gen.close()
                    self.pgconn.finish()
                    raise OperationalError(f"PostgreSQL has not answered for {ANSWER_S:g} s")

    def connect(dialect: Any, record: Any, arguments: Any, options: dict[str, Any]) -> LimitedConnection:
        """Open a limited connection instead of the driver's (SQLAlchemy's event `do_connect`)."""
        return LimitedConnection.connect(*arguments, **options)

    event.listen(engine, "do_connect", connect)
