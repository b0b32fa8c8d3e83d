"""Parts of the monitor that raise errors: an outage with its place, and a new start after a growing pause."""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from sealscope.errors import InputError
from sealscope.monitor.database.store import outage_reason
from sealscope.monitor.service import Service
from sealscope.monitor.sources.source_block import BlockReceiver, decode_message
from sealscope.monitor.supervisor import DATABASE, LimitedLines, PartAway, Supervisor
from sealscope.units import to_si

from .plant import LINES, Rows, rows_of, served, settings_in, until

FEW = b"\n".join(LINES.splitlines()[:40]) + b"\n"


class Panic(BaseException):
    """What an extension in Rust raises: no Exception."""


@pytest.mark.parametrize("error", [KeyError("no such thing"), RecursionError(), SystemExit(3), Panic("unwrap")])
def test_a_part_that_fails_is_an_outage_and_starts_again(monkeypatch, caplog, error):
    monkeypatch.setattr("sealscope.monitor.supervisor.FIRST_PAUSE_S", 0.03)
    monkeypatch.setattr("sealscope.monitor.supervisor._WORKING_S", 0.3)
    supervised = Supervisor(outage_reason)
    stopping = supervised.stopping
    wait, pauses, starts = stopping.wait, list[float](), list[str]()

    def note_pause(seconds: float | None = None) -> bool:
        if seconds is not None:
            pauses.append(seconds)
        return wait(seconds)

    monkeypatch.setattr(stopping, "wait", note_pause)

    def work() -> None:
        starts.append("decoder")
        if len(starts) <= 3:
            raise error
        wait()

    thread = supervised.start("decoder", work)
    try:
        assert supervised.outage_totals()["decoder"] == (True, 0, 0.0) or starts
        until(supervised.outages, 5.0)
        (outage,) = supervised.outages()
        assert outage["part"] == "decoder"
        assert type(error).__name__ in outage["reason"]
        until(lambda: len(starts) == 4 and supervised.outage_totals()["decoder"][0], 10.0)
        assert len(pauses) >= 3  # and each is what is left of 0.03, 0.06, 0.12 s
        assert all(pause <= most for pause, most in zip(pauses, (0.03, 0.06, 0.12), strict=False)), pauses
        assert supervised.outage_totals()["decoder"][1] == 1
        assert len([record for record in caplog.records if record.levelno == logging.ERROR]) == 1
    finally:
        stopping.set()
        thread.join(5.0)
    assert not thread.is_alive()


def test_the_place_of_an_error_is_that_in_this_package():
    supervised = Supervisor(outage_reason)
    with pytest.raises(InputError):
        to_si([1.0], "furlong^2", "m", name="x")
    supervised.part("source").attempt(lambda: to_si([1.0], "furlong^2", "m", name="x"))
    (outage,) = supervised.outages()
    assert "units.py, line " in outage["reason"]


def test_what_is_away_is_no_error_of_the_part():
    supervised = Supervisor(outage_reason)
    part = supervised.part("folder")

    def fails(error: Exception) -> bool:
        def work() -> None:
            raise error

        return part.attempt(work, at_once=True)

    assert not fails(PartAway("no such folder"))
    assert [(each["part"], each["reason"]) for each in supervised.outages()] == [("folder", "no such folder")]
    assert part.attempt(lambda: None, at_once=True)
    assert supervised.outages() == []
    assert not fails(OperationalError("select", {}, ConnectionError("refused")))
    assert [(each["part"], each["reason"]) for each in supervised.outages()] == [(DATABASE, "refused")]
    assert not part.attempt(lambda: None)  # it pauses


def test_a_step_is_taken_at_the_end_though_its_part_pauses():
    supervised, steps = Supervisor(outage_reason), []

    def step() -> None:
        steps.append(1)
        raise OSError("full")

    thread = supervised.repeat("output", step, 0.01, last=step)
    until(lambda: steps, 5.0)
    supervised.stopping.set()
    thread.join(5.0)
    assert len(steps) >= 2


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Rows:
    """What a monitor stores of the lines if nothing fails."""
    settings = settings_in(tmp_path_factory.mktemp("plain"))
    served(settings, FEW)
    return rows_of(settings.database)


def test_a_source_that_ends_in_an_error_starts_again_and_the_others_go_on(plain, tmp_path, monkeypatch):
    monkeypatch.setattr("sealscope.monitor.supervisor.FIRST_PAUSE_S", 0.05)
    left = iter(FEW.splitlines())
    starts: list[int] = []

    def source(receiver: BlockReceiver) -> None:
        starts.append(1)
        for line in left:
            receiver.submit(decode_message(line))
            if len(starts) < 3:
                raise ZeroDivisionError("a part that nobody foresaw")

    service = Service(settings_in(tmp_path), stdin=io.BytesIO(b"\n".join(FEW.splitlines()[:9])), sources=[source])
    service.run()
    assert len(starts) == 3
    assert rows_of(service.settings.database) == plain
    assert service.supervisor.outage_totals()["source 1"][1] == 1
    service.store.engine.dispose()


def test_an_error_while_blocks_are_at_hand_loses_and_repeats_none(plain, tmp_path, monkeypatch):
    """The storage raises something that nobody foresaw, before and after the database has them."""
    monkeypatch.setattr("sealscope.monitor.supervisor.FIRST_PAUSE_S", 0.05)
    store, calls = Service._store, iter(range(1000))

    def failing(self: Service, blocks: Any, write: Any) -> None:
        number = next(calls)
        if number == 0:
            raise Panic("before")
        store(self, blocks, write)
        if number == 2:
            raise Panic("after")

    monkeypatch.setattr(Service, "_store", failing)
    service, _ = served(settings_in(tmp_path), FEW)
    assert service.supervisor.outage_totals()["storage"][1] >= 1
    assert rows_of(service.settings.database) == plain


def test_the_log_gets_so_many_lines_a_minute_from_one_place(monkeypatch):
    lines = LimitedLines()
    clock = [0.0]
    monkeypatch.setattr("sealscope.monitor.supervisor.time.monotonic", lambda: clock[0])

    def passed(name: str, count: int, line: int = 1) -> list[str]:
        records = [logging.LogRecord(name, 30, "x.py", line, "trouble %d", (k,), None) for k in range(count)]
        return [record.getMessage() for record in records if lines.filter(record)]

    assert len(passed("asyncio", 500)) == 10
    assert len(passed("asyncio", 3, line=2)) == 3  # another place
    assert len(passed("sealscope.monitor", 500)) == 300
    clock[0] = 61.0
    assert passed("asyncio", 1) == ["trouble 0 (490 lines like it were left out)"]


def test_refused_messages_are_kept_up_to_a_limit(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("sealscope.monitor.database.store.MAX_REFUSED", 20)
    odd = b'{"t": "now \\u0000 \\ud800", "x": "' + b"x" * 9000 + b'"}'
    bad = [b"{", odd, *(b"[%d]" % k for k in range(40)), odd]
    service, _ = served(settings_in(tmp_path), b"\n".join(bad) + b"\n" + FEW)
    kept = service.store.refused()
    assert len(kept) == 20
    assert (kept[0]["size"], kept[0]["beginning"]) == (len(odd), odd[:4000])
    assert [row["beginning"] for row in kept[1:]] == [b"[%d]" % k for k in range(39, 20, -1)]
    assert sum(service.actuators.counters.values()) == len(bad)
