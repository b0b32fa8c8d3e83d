"""The same rows in PostgreSQL, killed or not."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from .plant import kill_often, rows_of, served, settings_in
from .test_service import LINES

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
