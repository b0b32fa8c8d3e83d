"""Worker processes: every item has its result, and a process that dies loses its own item alone."""

from __future__ import annotations

import math
import time
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from sealscope.campaigns.execution.workers import Workers


def carried_out(workers, items):
    """Item -> result of all items, as many at a time as the workers take."""
    waiting, results = list(items), {}
    while waiting or workers.items:
        while waiting and workers.free:
            workers.begin(waiting.pop(0))
        results.update(workers.ended())
    return results


@pytest.fixture
def die_on(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return import_module("dying_task").die_on


def test_a_process_that_dies_loses_its_own_item_alone(die_on):
    with Workers(2, partial(die_on, 3)) as workers:
        assert carried_out(workers, range(8)) == {item: None if item == 3 else item for item in range(8)}


def test_what_a_task_raises_is_raised():
    with Workers(2, math.sqrt) as workers, pytest.raises(ValueError, match="math domain error"):
        carried_out(workers, [4.0, -1.0])


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="looks at processes in /proc")
def test_leaving_the_block_ends_processes_at_work(die_on, tmp_path):
    began = time.monotonic()
    with Workers(1, partial(time.sleep)) as workers:
        workers.begin(600.0)
        (pool,) = (pool for pool, _ in workers._busy.values())
        (pid,) = pool._processes
        assert Path(f"/proc/{pid}").is_dir()
    while Path(f"/proc/{pid}").is_dir() and time.monotonic() < began + 60:
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").is_dir()
