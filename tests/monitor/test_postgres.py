"""The same rows in PostgreSQL, killed or not."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from sealscope.errors import InputError
from sealscope.monitor.memory.tables import metadata
from sealscope.monitor.service import Service

from .plant import kill_often, lines_of, rows_of, served, settings_in
from .test_service import LINES, SOUND, WORN

BINARIES = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
ROOT = os.geteuid() == 0
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BINARIES, reason="PostgreSQL is not installed"),
    pytest.mark.skipif(ROOT and shutil.which("runuser") is None, reason="PostgreSQL does not run as root"),
]


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    pytest.importorskip("psycopg", reason="psycopg is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    folder = tempfile.mkdtemp(prefix="sealscope-pg-")
    as_user = ["runuser", "-u", "postgres", "--"] if ROOT else []
    if ROOT:
        shutil.chown(folder, "postgres")

    def call(*words: str) -> None:
        subprocess.run([*as_user, *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd="/")

    data, control = f"{folder}/data", str(BINARIES[0] / "pg_ctl")
    call(str(BINARIES[0] / "initdb"), "-D", data, "-A", "trust", "-U", "monitor", "-E", "UTF8", "--no-sync")
    call(control, "-D", data, "-w", "-l", f"{folder}/log", "-o", f"-p {port} -h 127.0.0.1 -k {folder}", "start")
    yield f"postgresql+psycopg://monitor@127.0.0.1:{port}/postgres"
    call(control, "-D", data, "-m", "immediate", "stop")
    shutil.rmtree(folder, ignore_errors=True)


def test_kills_change_no_row_in_postgresql(url: str, tmp_path: Path):
    plain = tmp_path / "plain"
    plain.mkdir()
    served(settings_in(plain), LINES)
    settings = settings_in(tmp_path, database=url)
    lines = tmp_path / "lines.jsonl"
    lines.write_bytes(LINES)
    assert kill_often(settings, lines, 6, seed=9) == 6
    assert rows_of(url) == rows_of(str(plain / "monitor.db"))
    served(settings, LINES)
    assert rows_of(url) == rows_of(str(plain / "monitor.db"))


SHARED = '\n[share]\nname = "{name}"\nlease_s = 2.0\n'
FOUR = {"press 1": WORN, "press 2": SOUND, "press 3": SOUND, "press 4": WORN}


def test_three_monitors_share_the_actuators_and_take_over_those_of_a_killed_one(url: str, tmp_path: Path):
    more = '[[actuator]]\nname = "press 3"\n[[actuator]]\nname = "press 4"\n'
    lines = lines_of(FOUR, 150).splitlines(keepends=True)
    plain = tmp_path / "plain"
    plain.mkdir()
    served(settings_in(plain, more), b"".join(lines))
    engine = create_engine(url)
    metadata.drop_all(engine)
    children, writers = {}, {}
    for name in ("a", "b", "c"):
        folder = tmp_path / name
        folder.mkdir()
        settings = settings_in(folder, more + SHARED.format(name=name), database=url)
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                os.close(writing)
                for other in writers.values():
                    os.close(other)
                with os.fdopen(reading, "rb") as stream, Path(folder / "out.jsonl").open("w") as out:
                    Service(settings, once=True, stdin=stream, stdout=out).run()
                status = 0
            finally:
                os._exit(status)
        os.close(reading)
        children[name], writers[name] = child, writing
    killed, holder = "", "select actuator, holder from leases where until > extract(epoch from clock_timestamp())"
    time.sleep(3.0)  # until each has its share
    for k, line in enumerate(lines):
        for name, writing in writers.items():
            if name != killed:
                os.write(writing, line)
        time.sleep(10.0 / len(lines))
        if k == len(lines) // 2:
            with engine.connect() as connection:
                held = {row.actuator: row.holder for row in connection.execute(text(holder))}
            assert set(held) == {"", *FOUR}
            assert len(set(held.values())) == 3
            killed = held["press 1"]
            os.kill(children[killed], signal.SIGKILL)
            since = time.monotonic()
    while time.monotonic() - since < 30.0:  # asked: taken over within 30 s
        with engine.connect() as connection:
            held = {row.actuator: row.holder for row in connection.execute(text(holder))}
        if set(held) == {"", *FOUR} and killed not in held.values():
            break
        time.sleep(0.2)
    else:
        raise AssertionError(f"not taken over: {held}")
    time.sleep(3.0)
    for name, writing in writers.items():
        os.close(writing)
        if name != killed:
            assert os.waitstatus_to_exitcode(os.waitpid(children[name], 0)[1]) == 0
    os.waitpid(children[killed], 0)
    ours, theirs = rows_of(url), rows_of(str(plain / "monitor.db"))
    for table in ("estimates", "alarms", "events", "blocks"):
        assert ours[table] == theirs[table], table
    said = [line for name in children for line in (tmp_path / name / "out.jsonl").read_text().splitlines()]
    events = sorted({json.loads(line)["number"] for line in said})
    assert len(events) == len(theirs["events"])  # none is left out; the last before the kill may come twice
    engine.dispose()


def test_monitors_that_share_a_file_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="monitors that share actuators need a database by URL"):
        settings_in(tmp_path, SHARED.format(name="a"))
