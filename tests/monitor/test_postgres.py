"""The same rows in PostgreSQL, killed or not."""

from __future__ import annotations

import io
import json
import os
import shutil
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient

from sealscope.diagnosis.live.estimates import BlockEstimate
from sealscope.monitor.alarms import AlarmJudge
from sealscope.monitor.database.store import MonitorStore, StoredRows, outage_reason
from sealscope.monitor.database.tables import metadata
from sealscope.monitor.page.site import site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import PageSettings, WatchSettings

from ..refusals import mentions
from .plant import LINES, kill_often, rows_of, served, settings_in, until
from .servers import NO_POSTGRESQL, PostgreSQL
from .test_alarms import LEAK

pytestmark = [pytest.mark.slow, pytest.mark.skipif(NO_POSTGRESQL is not None, reason=NO_POSTGRESQL or "")]


@pytest.fixture(scope="module")
def server() -> Iterator[PostgreSQL]:
    pytest.importorskip("psycopg", reason="psycopg is not installed")
    folder = tempfile.mkdtemp(prefix="sealscope-pg-")
    server = PostgreSQL(folder)
    yield server
    server.stop()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def url(server: PostgreSQL) -> str:
    return server.url


def test_kills_change_no_row_in_postgresql(undisturbed, url: str, tmp_path: Path):
    settings = settings_in(tmp_path, database=url)
    lines = tmp_path / "lines.jsonl"
    lines.write_bytes(LINES)
    assert kill_often(settings, lines, 6, seed=9) == 6
    assert rows_of(url) == undisturbed
    served(settings, LINES)
    assert rows_of(url) == undisturbed


def test_an_event_that_is_stored_late_goes_out(url: str):
    """Of two transactions at once the one that began first may end last: its events must not be passed over."""
    stores = [MonitorStore(url) for _ in range(2)]
    passed = []

    def keep(store: MonitorStore, name: str, *, wait: bool) -> None:
        rows, judge = StoredRows(), AlarmJudge(name)
        block = BlockEstimate(1, 3.0, "alarm", 0.003, None, 0.003, None)
        rows.add_alarm(judge.update(block, LEAK, 1, WatchSettings(debounce_blocks=1), 1.0)[0], "raised", 3.0)
        with store.writing() as connection:
            store.write_rows(connection, rows)
            if wait:
                begun.set()
                time.sleep(1.0)

    def pass_on() -> None:
        stores[0].deliver("lines", lambda event: passed.append(event["alarm"]["actuator"]) or True)

    stores[0].write_position("lines", max([number for number, _ in stores[0].events_since(0)], default=0))
    begun = threading.Event()
    late = threading.Thread(target=keep, args=(stores[0], "late"), kwargs={"wait": True})
    late.start()
    begun.wait()
    keep(stores[1], "early", wait=False)
    pass_on()
    late.join()
    pass_on()
    assert passed == ["late", "early"]


def test_while_postgresql_is_away_the_page_says_so_and_nothing_is_lost(undisturbed, server: PostgreSQL, tmp_path: Path):
    engine = create_engine(server.url)
    metadata.drop_all(engine)
    engine.dispose()
    settings = settings_in(tmp_path, "[page]\nport = 0\n", database=server.url)
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as stream, os.fdopen(writing, "wb", buffering=0) as wire:
        service = Service(settings, stdin=stream, stdout=io.StringIO())
        thread = threading.Thread(target=service.run)
        thread.start()
        assert service.page is not None

        def asked(address: str) -> tuple[int, str]:
            try:
                with urllib.request.urlopen(service.page.address + address, timeout=20.0) as answer:
                    return int(answer.status), answer.read().decode()
            except urllib.error.HTTPError as error:
                return error.code, error.read().decode()

        lines = LINES.splitlines(keepends=True)
        try:
            for line in lines[: len(lines) // 2]:
                wire.write(line)
            assert asked("api/fleet")[0] == asked("metrics")[0] == 200
            server.stop()
            try:
                for line in lines[len(lines) // 2 :]:
                    wire.write(line)
                for address in ("api/fleet", "api/actuator?name=press%201"):
                    status, text_ = asked(address)
                    assert status == 503
                    assert json.loads(text_)["error"].startswith("the database does not answer: ")
                    assert [outage["part"] for outage in json.loads(text_)["outages"]] == ["database"]
                status, text_ = asked("metrics")
                assert (status, text_[:31]) == (503, "# the database does not answer:")
                assert 'sealscope_reached{part="database"} 0.0' in text_
                time.sleep(2.0)
                assert asked("metrics")[0] == 503
            finally:
                server.start()
            reached = 'sealscope_reached{part="database"} 1.0'
            until(lambda: reached in asked("metrics")[1] and len(rows_of(server.url)["blocks"]) >= len(lines))
            status, text_ = asked("metrics")
            assert status == 200
            assert reached in text_
            assert service.queue_load().n_blocks == 0
            assert 'sealscope_outages_total{part="database"} 1.0' in text_
        finally:
            service.stop()
            wire.close()
            thread.join()
    ours, theirs = rows_of(server.url), undisturbed
    for table in theirs:
        assert ours[table] == theirs[table], table


def test_a_postgresql_that_hangs_is_said_and_costs_nothing(
    undisturbed, server: PostgreSQL, tmp_path: Path, monkeypatch, caplog
):
    """Its processes are stopped: connections are accepted, packets confirmed, and nothing is answered."""
    monkeypatch.setattr("sealscope.monitor.database.postgresql.ANSWER_S", 1.0)
    monkeypatch.setattr("sealscope.monitor.database.postgresql.CONNECT_S", 2)
    engine = create_engine(server.url)
    metadata.drop_all(engine)
    engine.dispose()
    settings = settings_in(tmp_path, database=server.url)
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as stream, os.fdopen(writing, "wb", buffering=0) as wire:
        service = Service(settings, stdin=stream, stdout=io.StringIO())
        page = TestClient(
            site(service.actuators, PageSettings(), None, service.queue_load), base_url="http://localhost"
        )
        thread = threading.Thread(target=service.run)
        thread.start()
        lines = LINES.splitlines(keepends=True)
        try:
            wire.write(b"".join(lines[:10]))
            until(lambda: service.queue_load().n_blocks == 0 and page.get("/metrics").status_code == 200)
            before = service.store.engine.connect()
            server.hang()
            try:
                wire.write(b"".join(lines[10:]))
                until(lambda: bool(service.supervisor.outages()))
                (outage,) = service.supervisor.outages()
                assert outage["part"] == "database"
                assert outage["reason"] in ("connection timeout expired", "PostgreSQL has not answered for 1 s")
                with pytest.raises(OperationalError) as caught:
                    before.execute(text("select 1"))
                assert mentions(str(caught.value.orig), "1 s")
                answer = page.get("/api/fleet")
                assert answer.status_code == 503
                assert answer.json()["error"].startswith("the database does not answer: ")
                assert answer.json()["waiting"] > 0
                assert page.get("/metrics").status_code == 503
            finally:
                server.go_on()
            until(lambda: not service.supervisor.outages() and service.queue_load().n_blocks == 0)
        finally:
            wire.close()
            thread.join()
            before.close()
    assert service.supervisor.outage_totals()["database"][0]
    assert "the database is not reached: " in caplog.text
    ours, theirs = rows_of(server.url), undisturbed
    for table in theirs:
        assert ours[table] == theirs[table], table


def test_a_statement_that_waits_for_a_lock_is_ended_by_the_server(server: PostgreSQL, monkeypatch):
    """Else each new try would leave a process that waits in the server."""
    monkeypatch.setattr("sealscope.monitor.database.postgresql.STATEMENT_S", 0.3)
    store = MonitorStore(server.url)
    other = create_engine(server.url)
    try:
        with other.connect() as connection:
            connection.execute(text("lock table facts in access exclusive mode"))
            with pytest.raises(OperationalError, match="statement timeout") as raised:
                store.position("nobody")
            assert outage_reason(raised.value) == "canceling statement due to statement timeout"
        assert store.position("nobody") == 0
    finally:
        store.engine.dispose()
        other.dispose()
