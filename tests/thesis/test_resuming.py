"""Reproductions that are broken off, fail or lose a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.reproduce import Outcome, reproduce


def item(name: str, make: str, *needs: str, needs_sheet: bool = False) -> Item:
    return Item(name, 4, "table", f"Item {name}", f"fakes.chapter:{make}", needs=needs, needs_sheet=needs_sheet)


def worked(tmp_path: Path) -> list[str]:
    """Which items were made, in order."""
    log = tmp_path / "log"
    return log.read_text().split() if log.exists() else []


def states(outcome: Outcome) -> dict[str, str]:
    return {entry.item.id: entry.state for entry in outcome.entries}


def test_an_interrupt_leaves_what_was_finished(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "table"), item("t-2", "interrupted"), item("t-3", "table"))
    with pytest.raises(KeyboardInterrupt):
        reproduce(["all"], "out", registry=items, jobs=1)
    assert worked(tmp_path) == ["t-1"]
    (tmp_path / "log.go").touch()
    assert states(reproduce(["all"], "out", registry=items, jobs=1)) == {"t-1": "kept", "t-2": "made", "t-3": "made"}
    assert worked(tmp_path) == ["t-1", "t-2", "t-3"]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT] if hasattr(signal, "SIGKILL") else [])
def test_a_killed_call_is_taken_up_where_it_stopped(fakes: Path, tmp_path: Path, how: int) -> None:
    names = [f"t-{number}" for number in range(8)]
    script = tmp_path / "call.py"
    script.write_text(
        "from sealscope.thesis.engine.items import Item\nfrom sealscope.thesis.engine.reproduce import reproduce\n"
        "if __name__ == '__main__':\n"
        f"    items = tuple(Item(n, 4, 'table', 'Item ' + n, 'fakes.chapter:slow') for n in {names!r})\n"
        "    reproduce(['all'], 'out', registry=items, jobs=2)\n"
    )
    paths = os.pathsep.join([str(fakes.parent.parent), *sys.path])
    call = subprocess.Popen(
        [sys.executable, str(script)], env={**os.environ, "PYTHONPATH": paths}, cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    end = time.monotonic() + 60
    while len(list((tmp_path / "out" / "kept" / "drawn").glob("*.json"))) < 3 and time.monotonic() < end:
        assert call.poll() is None
        time.sleep(0.02)
    call.send_signal(how)
    call.wait(20)
    time.sleep(1.0)  # workers of a killed parent end with the item they are at
    finished = {path.stem for path in (tmp_path / "out" / "kept" / "drawn").glob("*.json")}
    assert 3 <= len(finished) < 8
    again = reproduce(["all"], "out", registry=tuple(item(name, "slow") for name in names), jobs=2)
    assert {name for name, state in states(again).items() if state == "kept"} == finished
    assert {name for name, state in states(again).items() if state == "made"} == set(names) - finished


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failure_is_told_and_the_others_go_on(fakes: Path, tmp_path: Path, jobs: int) -> None:
    items = (item("t-0", "broken"), item("t-1", "table"), item("t-2", "doubled", "t-0"), item("t-3", "doubled", "t-1"))
    outcome = reproduce(["all"], "out", registry=items, jobs=jobs)
    assert states(outcome) == {"t-0": "failed", "t-1": "made", "t-2": "failed", "t-3": "made"}
    assert outcome.entries[0].reason == "RuntimeError: no such curve"
    assert outcome.entries[2].reason == "needs t-0, which failed"
    assert "second line" in (tmp_path / "out" / "kept" / "failed" / "t-0.txt").read_text()


def test_a_process_that_dies_takes_only_its_item(fakes: Path, tmp_path: Path) -> None:
    items = (item("t-1", "dies"), *(item(f"t-{number}", "table") for number in range(2, 6)))
    outcome = reproduce(["all"], "out", registry=items, jobs=2)
    assert states(outcome) == {"t-1": "failed", "t-2": "made", "t-3": "made", "t-4": "made", "t-5": "made"}
    assert outcome.entries[0].reason == "its process ended with status 3"
