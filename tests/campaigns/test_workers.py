"""Worker processes: every item has its result, and a process that dies loses its own item alone."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import time
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

from sealscope.campaigns.execution.workers import iter_results, iter_results_in_order

from ..waiting import until


@pytest.fixture
def die_on(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return import_module("dying_task").die_on


def test_a_process_that_dies_loses_its_own_item_alone(die_on):
    results = dict(iter_results(partial(die_on, 3), range(8), 2))
    assert results == {item: None if item == 3 else item for item in range(8)}


def test_results_come_in_order_where_a_fork_dies(die_on):
    results = iter_results_in_order(2, partial(die_on, 3), list(range(6)))
    assert list(results) == [(item, None if item == 3 else item) for item in range(6)]
    until(lambda: not multiprocessing.active_children())


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills as POSIX does")
def test_a_process_that_dies_idle_loses_nothing():
    others = {child.pid for child in multiprocessing.active_children()}
    ended = iter_results(math.sqrt, (float(number) for number in range(6)), 2)
    results = dict([next(ended)])
    for child in multiprocessing.active_children():
        if child.pid not in others:
            os.kill(child.pid, signal.SIGKILL)
            child.join()
    time.sleep(0.5)  # until the parent knows
    assert results | dict(ended) == {float(number): math.sqrt(number) for number in range(6)}


@pytest.mark.slow
def test_what_a_task_raises_is_raised():
    with pytest.raises(ValueError, match="math domain error"):
        list(iter_results(math.sqrt, [4.0, -1.0], 2))


@pytest.fixture
def cluster(request):
    """Two workers of Dask, in threads or in processes of their own, of which the death of one counts at once."""
    distributed, dask = pytest.importorskip("distributed"), pytest.importorskip("dask")
    alike = {"dashboard_address": None, "silence_logs": 50, "processes": request.param}
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, **alike) as opened,
    ):
        yield opened.scheduler_address


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [False], indirect=True, ids=["threads"])
def test_what_a_task_raises_on_a_cluster_is_raised(cluster):
    with pytest.raises(ValueError, match="math domain error"):
        list(iter_results(math.sqrt, [4.0, -1.0], 1, cluster))


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [True], indirect=True, ids=["processes"])
def test_a_worker_that_dies_loses_its_own_item_alone(die_on, cluster):
    results = dict(iter_results(partial(die_on, 3), range(8), 1, cluster))
    assert results == {item: None if item == 3 else item for item in range(8)}


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="looks at processes in /proc")
def test_closing_ends_processes_at_work():
    def alive():
        return {child.pid for child in multiprocessing.active_children()}

    others = alive()
    ended = iter_results(time.sleep, [0.0, 600.0], 2)
    next(ended)
    (*_, pid) = alive() - others
    assert Path(f"/proc/{pid}").is_dir()
    ended.close()
    until(lambda: not alive() - others)
