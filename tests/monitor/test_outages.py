"""What the monitor does not reach is said on page, log and metrics, and costs nothing that a source keeps."""

from __future__ import annotations

import io
import json
import sqlite3
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.testclient import TestClient

from sealscope.monitor.bounded_queue import BoundedQueue, QueueLoad
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.page.site import site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import MonitorSettings, PageSettings
from sealscope.monitor.sources.source_block import SourceBlock
from sealscope.monitor.supervisor import BROKER, DATABASE, Supervisor

from ..representatives import few
from .plant import LINES, rows_of, served, settings_in, until

REACHED = dict.fromkeys(
    ("broker", "standard input", "standard output", "storage", "picture of samples", "acknowledgements"), 1.0
)
REASON = "connection to server at 10.0.0.9 failed: Connection refused"


def test_an_outage_is_said_once_and_measured(caplog):
    changes: list[int] = []
    supervisor = Supervisor(on_change=lambda: changes.append(1))
    database, broker = (supervisor.part(name) for name in (DATABASE, BROKER))
    database.end_outage()
    assert supervisor.outages() == [] == changes
    broker.begin_outage("gone\nwith the wind")
    broker.begin_outage("still gone")
    (outage,) = supervisor.outages()
    assert (outage["part"], outage["reason"]) == ("broker", "gone")
    reached, number, seconds = supervisor.outage_totals()["broker"]
    assert (reached, number, seconds >= 0.0) == (False, 1, True)
    broker.end_outage()
    broker.end_outage()
    broker.begin_outage("again")
    assert supervisor.outage_totals()["broker"][:2] == (False, 2)
    assert supervisor.outage_totals()["database"] == (True, 0, 0.0)
    assert len(changes) == 3
    assert [record.message[:30] for record in caplog.records] == [
        "the broker is not reached: gon",
        "the broker is reached again af",
        "the broker is not reached: aga",
    ]


def test_a_queue_holds_so_many_and_so_many_bytes():
    queue: BoundedQueue[int] = BoundedQueue(3, 100)
    assert queue.put(1, 5000)  # larger than all, but alone
    assert not queue.put(2, 1)
    assert queue.pop(9, 0.0) == [1]
    assert [queue.put(k, 40) for k in range(3)] == [True, True, False]
    assert queue.put(9, 40, always=True)
    assert queue.size() == (3, 120)
    assert not queue.put(3, 0, 0.01)
    assert queue.pop(2, 0.0) == [0, 1]
    assert queue.put(3, 10)
    assert queue.pop(9, 0.0) == [9, 3]
    assert queue.pop(9, 0.01) == []
    threading.Timer(0.05, lambda: queue.put(4, 1)).start()
    assert queue.pop(1, 5.0) == [4]


@pytest.fixture
def service(taken: MonitorSettings) -> Iterator[Service]:
    service, _ = served(taken, LINES.splitlines()[0])  # which it knows
    service.supervisor.part(BROKER)
    yield service
    service.store.engine.dispose()


def metrics(page: TestClient) -> tuple[int, dict[str, dict[str, float]]]:
    """Status of /metrics, and its values by family and by part or reason."""
    answer = page.get("/metrics")
    families = text_string_to_metric_families(answer.text)
    return answer.status_code, {
        family.name: {next(iter(sample.labels.values()), ""): sample.value for sample in family.samples}
        for family in families
    }


@pytest.mark.parametrize(
    ("error", "reason"),
    few(
        [
            (OperationalError("select", {}, ConnectionError(REASON)), REASON),
            (PoolTimeout("QueuePool limit"), "every connection to the database is in use"),
        ],
        1,
    ),
)
def test_without_the_database_the_page_answers_503_in_words(service, monkeypatch, error, reason):
    page = TestClient(
        site(service.actuators, PageSettings(), None, lambda: QueueLoad(7, 900, 3)), base_url="http://localhost"
    )
    status, before = metrics(page)
    assert (status, before["sealscope_reached"]) == (200, {**REACHED, "database": 1.0})

    def fails(*_: Any, **__: Any) -> Any:
        raise error

    for name in ("summaries", "writing", "checkpoint"):
        monkeypatch.setattr(MonitorStore, name, fails)
    for address in ("/api/fleet", "/api/actuator?name=press 1"):
        answer = page.get(address)
        assert (answer.status_code, answer.headers["retry-after"]) == (503, "5")
        assert answer.json()["error"] == f"the database does not answer: {reason}"
        assert answer.json()["waiting"] == 7
        assert [(each["part"], each["reason"]) for each in answer.json()["outages"]] == [("database", reason)]
        assert answer.headers["content-security-policy"].startswith("default-src 'none'")
    answer = page.post("/api/mark?name=press 1", json={"mark": "acknowledged"}, headers={"X-Sealscope": "mark"})
    assert (answer.status_code, answer.json()["error"]) == (503, f"the database does not answer: {reason}")
    assert page.get("/metrics").text.startswith(f"# the database does not answer: {reason}\n")
    status, during = metrics(page)
    assert (status, during["sealscope_reached"]) == (503, {**REACHED, "database": 0.0})
    assert (during["sealscope_waiting_blocks"], during["sealscope_waiting_bytes"]) == ({"": 7.0}, {"": 900.0})
    assert page.get("/").status_code == 200

    monkeypatch.undo()
    service._write_events()  # as the running service does twice a second
    status, after = metrics(page)
    assert (status, after["sealscope_reached"], after["sealscope_outages"]["database"]) == (
        200,
        {**REACHED, "database": 1.0},
        1.0,
    )
    assert page.get("/api/fleet").json()["outages"] == []
    mark = page.post("/api/mark?name=press 1", json={"mark": "acknowledged"}, headers={"X-Sealscope": "mark"})
    assert mark.status_code == 200  # what failed meanwhile changed nothing


def test_errors_of_another_kind_are_no_outage(service, monkeypatch):
    page = TestClient(
        site(service.actuators, PageSettings(), None), base_url="http://localhost", raise_server_exceptions=False
    )

    def fails(*_: Any) -> Any:
        raise KeyError("no such thing")

    monkeypatch.setattr(MonitorStore, "summaries", fails)
    assert page.get("/api/fleet").status_code == 500
    assert service.supervisor.outages() == []


def test_a_full_queue_makes_its_source_wait_and_says_so(undisturbed, tmp_path, monkeypatch, caplog):
    """The database is locked for longer than a source waits in silence; nothing is lost."""
    monkeypatch.setattr("sealscope.monitor.service._QUEUE_BLOCKS", 4)
    monkeypatch.setattr("sealscope.monitor.service._LONG_WAIT_S", 0.2)
    caplog.clear()  # on a busy machine its source may have waited, too
    settings = settings_in(tmp_path)
    service = Service(settings, once=True, stdin=io.BytesIO(LINES), stdout=io.StringIO())
    other = sqlite3.connect(settings.database, isolation_level=None, check_same_thread=False)
    other.execute("begin immediate")
    with service.store.engine.connect() as connection:
        connection.connection.driver_connection.execute("pragma busy_timeout=10")
    thread = threading.Thread(target=service.run)
    thread.start()
    try:
        page = TestClient(
            site(service.actuators, PageSettings(), None, service.queue_load), base_url="http://localhost"
        )
        until(lambda: any("a source waits" in record.message for record in caplog.records))
        assert service.queue_load().n_blocks > 4  # those in the queue, and those that are being stored
        until(lambda: page.get("/api/fleet").json()["outages"])
        (outage,) = page.get("/api/fleet").json()["outages"]
        assert (outage["part"], outage["reason"]) == ("database", "database is locked")
        assert metrics(page)[1]["sealscope_reached"]["database"] == 0.0
    finally:
        other.execute("rollback")
        thread.join(60.0)
    assert service.supervisor.outage_totals()["database"][:2] == (True, 1)
    assert service.queue_load().n_waits > 0
    assert rows_of(settings.database) == undisturbed


def test_a_source_is_no_longer_than_the_service(tmp_path):
    """A source that waits for room ends with the service."""
    service = Service(settings_in(tmp_path), once=True, stdin=io.BytesIO(), stdout=io.StringIO())
    thread = threading.Thread(target=lambda: [service.submit(SourceBlock("press 1", str(k), None)) for k in range(600)])
    thread.start()
    thread.join(0.3)
    assert thread.is_alive()
    service.stop()
    thread.join(60.0)
    assert not thread.is_alive()
    service.close()
    assert json.loads(json.dumps(service.supervisor.outages())) == []
