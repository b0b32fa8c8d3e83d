"""Files and rows that are damaged, removed or away for a while: nothing acknowledged is dropped, and each is said."""

from __future__ import annotations

import io
import os
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient

import sealscope as ss
from sealscope.monitor.actuators import LOST_TRANSACTIONS
from sealscope.monitor.database import tables
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.page.site import site
from sealscope.monitor.service import Service
from sealscope.monitor.settings import PageSettings, read_settings
from sealscope.monitor.sources.source_block import decode_message

from ..diagnosis.balance_machine import machine
from .plant import HEALTHY, LINES, WORN, lines_of, rows_of, served, settings_in, until

PART = "machine's file press.toml"


class Sender:
    """Sends lines to a service one after another, and waits for what was sent to be stored."""

    def __init__(self, service: Service) -> None:
        self.service, self.n_sent, self.n_stored = service, 0, 0

    def _count(self) -> None:
        self.n_stored += 1

    def send(self, line: bytes) -> None:
        self.n_sent += 1
        self.service.submit(replace(decode_message(line), done=self._count))

    def wait(self) -> None:
        until(lambda: self.n_stored == self.n_sent, 30.0)


# The machine's file


def unreadable(path: Path) -> None:
    path.write_text("[machine\nname =")


def replaced(path: Path) -> None:
    path.write_bytes(os.urandom(4000))


def removed(path: Path) -> None:
    path.unlink()


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def without_summaries(path: Path) -> None:
    path.with_suffix(".healthy").unlink()


FAULTS: tuple[Callable[[Path], None], ...] = (unreadable, replaced, removed, a_folder, without_summaries)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_machine_s_file_that_is_away_costs_no_block(
    fault: Callable[[Path], None], commissioned, tmp_path, monkeypatch
):
    """While it cannot be read the database has hiccups at random: every block is stored, and the file is an outage."""
    random = np.random.default_rng(FAULTS.index(fault))
    good, rig = tmp_path / "good", tmp_path / "press.toml"
    good.mkdir()
    for suffix in (".toml", ".healthy"):
        shutil.copy(Path(commissioned).with_suffix(suffix), good / f"press{suffix}")
        shutil.copy(Path(commissioned).with_suffix(suffix), tmp_path / f"press{suffix}")
    settings_file = tmp_path / "monitor.toml"
    settings_file.write_text(
        'database = "monitor.db"\nlines = true\n[[actuator]]\nname = "press 1"\n'
        f'machine = "press.toml"\nrecording_s = {60.0 if fault is unreadable else 180.0}\n'
    )
    service = Service(read_settings(settings_file), once=True, stdin=io.BytesIO(), stdout=io.StringIO())
    samples = machine(11, rate=100.0, duration=70.0)
    part_of = [samples.samples(slice(k, k + 100)) for k in range(0, len(samples), 100)]
    lines = [lines_of({"press 1": part}, 100) for part in part_of]
    plain_upsert, failures = MonitorStore.upsert, [0]

    def upsert(store: MonitorStore, *arguments: Any) -> None:
        if failures[0] < 6 and random.random() < 0.3:
            failures[0] += 1
            raise OperationalError("update", {}, sqlite3.OperationalError("database is locked"))
        plain_upsert(store, *arguments)

    def submit(service: Any) -> None:
        sender = Sender(service)
        for k, line in enumerate(lines):
            if k == 20:
                sender.wait()
                fault(rig)
                monkeypatch.setattr(MonitorStore, "upsert", upsert)
            sender.send(line)
            if k % 10 == 9:
                sender.wait()
            if k == 60:
                outages.extend(service.supervisor.outages())
                if rig.is_dir():
                    rig.rmdir()
                for suffix in (".toml", ".healthy"):
                    shutil.copy(good / f"press{suffix}", tmp_path / f"press{suffix}")

    outages: list[dict[str, Any]] = []
    monkeypatch.setattr("sealscope.monitor.actuators._RETRY_S", 0.1)
    service._extra_sources.append(submit)
    service.run()
    assert failures[0] >= 1
    assert len(rows_of(service.settings.database)["blocks"]) == len(lines)
    assert "blocks that raised an error" not in service.actuators.counters
    assert [outage["part"] for outage in outages if outage["part"] != "database"] == [PART]
    assert "the machine read before stays" in next(each["reason"] for each in outages if each["part"] == PART)
    service.actuators.process_blocks([])
    assert [outage["part"] for outage in service.supervisor.outages()] == []


# Rows of the database

DAMAGES = ("{", "[]", "", "null", '{"watch": 3}', "\x00\xff", '{"watch": {"version": 22}}', "1e999")


def change(database: str, statement: str, *values: Any) -> None:
    with sqlite3.connect(database) as connection:
        assert connection.execute(statement, values).rowcount >= 1
    connection.close()


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 12))])
def test_a_damaged_row_concerns_one_actuator(seed: int, taken, caplog):
    """With whatever in a row of one actuator, the monitor starts, in one line, and the other one is as before."""
    random, before = np.random.default_rng(seed), rows_of(taken.database)
    table, column = [
        ("actuators", "checkpoint"),
        ("pending", "samples"),
        ("summaries", "summary"),
        ("alarms", "alarm"),
    ][seed % 4]
    damage = DAMAGES[random.integers(len(DAMAGES))]
    if seed % 4 == 0 and random.random() < 0.5:  # whole JSON, a part of which is cut or exchanged
        text = dict((row[0], row[2]) for row in before["actuators"])["press 1"]
        cut = int(random.integers(1, len(text)))
        damage = text[:cut] if random.random() < 0.5 else text[:cut] + "9" + text[cut + 1 :]
    change(taken.database, f"update {table} set {column} = ? where actuator = 'press 1'", damage)
    caplog.clear()
    service = Service(taken, once=True, stdin=io.BytesIO(), stdout=io.StringIO())
    errors = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    page = TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")
    assert page.get("/api/fleet").status_code == page.get("/metrics").status_code == 200
    for name in ("press 1", "press 2"):
        assert page.get(f"/api/actuator?name={name}").status_code in (200, 404)
    assert all("press 1" in line and "\n" not in line for line in errors)
    assert errors or table in ("summaries", "alarms") or damage.startswith("{")
    after = rows_of(taken.database)
    for name in ("estimates", "blocks", "actuators", "summaries"):
        assert [row for row in after[name] if row[0] == "press 2"] == [
            row for row in before[name] if row[0] == "press 2"
        ]
    # it goes on: further samples are stored under further numbers, and another alarm is another one
    service.close()
    later = Service(
        taken, once=True, stdin=io.BytesIO(lines_of({"press 1": moved_on(WORN)}, 150)), stdout=io.StringIO()
    )
    later.run()
    rows = rows_of(taken.database)
    assert len(rows["blocks"]) == len(before["blocks"]) + 44
    assert len(rows["estimates"]) > len(before["estimates"])
    assert {row[0] for row in before["alarms"]} <= {row[0] for row in rows["alarms"]}


def moved_on(samples: ss.Recording) -> ss.Recording:
    return ss.Recording(samples.t + 200.0, samples.channels, samples.units, samples.rate)


def test_an_actuator_that_begins_anew_keeps_its_open_alarm(taken, caplog):
    before = MonitorStore(taken.database).alarms()
    change(taken.database, "update actuators set checkpoint = '[]' where actuator = 'press 1'")
    service = Service(taken, once=True, stdin=io.BytesIO(), stdout=io.StringIO())
    assert (
        "press 1: begins anew, as its stored state is damaged: ValueError: it must be a mapping, got list"
        in caplog.text
    )
    assert service.store.alarms() == before
    alarm = service.actuators.apply_mark("press 1", "acknowledged")
    assert (alarm.id, alarm.state) == (before[0]["id"], "acknowledged")
    service.close()


# Files of SQLite


def killed_after(settings: Any, lines: bytes) -> None:
    """Run a monitor over lines in a process that dies before it can close its database."""
    child = os.fork()
    if child == 0:
        service = Service(settings, once=True, stdin=io.BytesIO(lines), stdout=io.StringIO())
        service.close = lambda: os._exit(9)  # type: ignore[method-assign]
        service.run()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@pytest.mark.parametrize("loss", ["wal", *(pytest.param(loss, marks=pytest.mark.slow) for loss in ("copy", "none"))])
def test_transactions_that_are_gone_are_said_at_the_next_start(loss: str, tmp_path, caplog):
    """The file -wal is deleted after a crash, or the database is an older copy; a mere crash loses nothing."""
    settings, lines = settings_in(tmp_path), LINES.splitlines(keepends=True)
    killed_after(settings, b"".join(lines[:20]))
    files = [Path(settings.database + suffix) for suffix in ("", "-wal", "-shm")]
    copies = {file: file.read_bytes() for file in files}
    killed_after(settings, b"".join(lines[:40]))
    if loss == "wal":
        assert files[1].stat().st_size > 0
        files[1].unlink()
    elif loss == "copy":
        for file, data in copies.items():
            file.write_bytes(data)
    service, _ = served(settings)
    n_lost = service.actuators.counters.get(LOST_TRANSACTIONS, 0)
    assert (n_lost > 0) == (loss != "none") == ("lacks the last" in caplog.text)
    caplog.clear()
    service, _ = served(settings, b"".join(lines))  # it is said once; what comes again is stored
    assert LOST_TRANSACTIONS not in service.actuators.counters
    assert len(rows_of(settings.database)["blocks"]) == len(lines)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_wal_removed_from_a_running_monitor_costs_nothing(seed: int, undisturbed, tmp_path, caplog):
    random, settings = np.random.default_rng(seed), settings_in(tmp_path)
    service = Service(settings, once=True, stdin=io.BytesIO(), stdout=io.StringIO())
    lines, wal = LINES.splitlines(), Path(settings.database + "-wal")
    removals = set(random.choice(np.arange(10, len(lines)), 3, replace=False).tolist())

    def submit(service: Any) -> None:
        sender = Sender(service)
        for k, line in enumerate(lines):
            if k in removals:
                sender.wait()
                wal.unlink()
            sender.send(line)

    service._extra_sources.append(submit)
    service.run()
    service.store.engine.dispose()
    assert caplog.text.count("was removed while the monitor runs") == 3
    assert rows_of(settings.database) == undisturbed
    with sqlite3.connect(settings.database) as connection:
        assert connection.execute("pragma integrity_check").fetchone() == ("ok",)
    connection.close()


def test_a_database_that_is_replaced_under_a_monitor_is_an_outage(tmp_path):
    """Blocks wait; they are stored when the file is back."""
    settings = settings_in(tmp_path)
    waits = [lambda service: service.stopping.wait()]
    service = Service(settings, stdin=io.BytesIO(), stdout=io.StringIO(), sources=waits)
    thread = threading.Thread(target=service.run, daemon=True)
    thread.start()
    (first, second, *_), sender = LINES.splitlines(), Sender(service)
    sender.send(first)
    sender.wait()
    database, aside = Path(settings.database), tmp_path / "aside.db"
    database.rename(aside)
    sender.send(second)
    until(service.supervisor.outages, 10.0)
    (outage,) = service.supervisor.outages()
    assert outage["part"] == "database" and "was removed or replaced while the monitor runs" in outage["reason"]
    assert (sender.n_stored, service.queue_load().n_blocks) == (1, 1)
    aside.rename(database)
    sender.wait()
    service.stop()
    thread.join()
    assert len(rows_of(settings.database)["blocks"]) == 2


# Queries of the page


def filled(database: str, count: int, seed: int = 0) -> tuple[MonitorStore, np.ndarray]:
    """A database of so many estimates, some of which have no flow; also their times and total flows (n, 2)."""
    random, store = np.random.default_rng(seed), MonitorStore(database)
    t = 1.7e9 + np.cumsum(random.uniform(2.0, 4.0, count))
    total = random.standard_normal(count) + np.sin(np.arange(count) / count * 9.0)
    rows = [
        {"actuator": "press 1", "number": k + 1, "t": t[k], "status": "watched", "total_lpm": total[k]}
        for k in range(count)
    ]
    with store.writing() as connection:
        for first in range(0, count, 20_000):
            connection.execute(tables.estimates.insert(), rows[first : first + 20_000])
    return store, np.column_stack([t, total])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_a_history_is_the_mean_of_each_of_its_groups(seed: int, tmp_path):
    """Of a short history each estimate counts; of a long one evenly many, and the mean is within their scatter."""
    random = np.random.default_rng(seed)
    store, values = filled(str(tmp_path / "m.db"), 45_000, seed)
    for seconds in (None, *random.uniform(60.0, 1.4e5, 4)):
        chosen = values if seconds is None else values[values[:, 0] >= values[-1, 0] - seconds]
        rows = store.history("press 1", seconds=seconds)
        size = -(-len(chosen) // 600)
        numbers = np.arange(len(values) - len(chosen) + 1, len(values) + 1)
        groups = np.split(chosen, np.flatnonzero(np.diff(numbers - numbers % size)) + 1)
        assert abs(len(rows) - len(groups)) <= 1 and len(rows) <= 602
        for row, group in zip(rows, groups, strict=False):
            is_whole = size <= 32
            tolerance = 1e-9 if is_whole else 6.0 / np.sqrt(min(len(group), 16))
            assert row["total_lpm"] == pytest.approx(group[:, 1].mean(), abs=tolerance)
            assert row["t"] == pytest.approx(
                group[:, 0].mean(), abs=1e-3 if is_whole else 0.2 * np.ptp(group[:, 0]) + 9.0
            )
    store.engine.dispose()


@pytest.mark.slow
def test_a_month_is_answered_in_a_fraction_of_a_second(tmp_path):
    store, _ = filled(str(tmp_path / "m.db"), 864_000)
    costs = []
    for hours in (1.0, 24.0, 720.0, None):
        start = time.process_time()
        store.history("press 1", seconds=None if hours is None else 3600.0 * hours)
        costs.append(time.process_time() - start)
    assert max(costs) < 0.3, costs
    store.engine.dispose()


def test_many_queries_at_once_leave_storage_its_connection(taken, monkeypatch):
    """Thirty visitors wait for slow queries: storage goes on, no outage is said, and who waits too long is told so."""
    service = Service(taken, once=True, stdin=io.BytesIO(), stdout=io.StringIO())
    page = TestClient(site(service.actuators, PageSettings(), None), base_url="http://localhost")
    n_running, most, release = [0], [0], threading.Event()
    plain, lock = MonitorStore.history, threading.Lock()

    def history(store: MonitorStore, *arguments: Any, **options: Any) -> Any:
        with store._page_engine.connect(), lock:
            n_running[0] += 1
            most[0] = max(most[0], n_running[0])
        with store._page_engine.connect():
            release.wait(20.0)
        with lock:
            n_running[0] -= 1
        return plain(store, *arguments, **options)

    monkeypatch.setattr(MonitorStore, "history", history)
    monkeypatch.setattr("sealscope.monitor.page.site.QUERY_WAIT_S", 0.5)
    answers: list[int] = []
    threads = [
        threading.Thread(target=lambda: answers.append(page.get("/api/actuator?name=press 1").status_code))
        for _ in range(30)
    ]
    for thread in threads:
        thread.start()
    until(lambda: len(answers) >= 20)
    before = len(rows_of(taken.database)["blocks"])
    lines = lines_of({"press 2": moved_on(HEALTHY.between(0.0, 9.0))}, 150).splitlines()
    service.actuators.process_blocks([decode_message(line) for line in lines])
    assert len(rows_of(taken.database)["blocks"]) == before + len(lines)
    release.set()
    for thread in threads:
        thread.join()
    assert service.supervisor.outages() == []
    assert set(answers) == {200, 503} and answers.count(200) >= 4
    assert most[0] <= 4
    service.close()
