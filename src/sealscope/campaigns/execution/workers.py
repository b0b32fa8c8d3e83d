"""Run a task on many items in processes of this machine or on a Dask cluster, and survive processes that die."""

from __future__ import annotations

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import islice
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, TypeVar

from sealscope.errors import InputError, MissingExtra

Item = TypeVar("Item")
Result = TypeVar("Result")
#: Environment variables of a worker process. There is a process per core, so each uses one thread for linear algebra;
#: it imports no modules from the working folder, which may be hostile.
_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "PYTHONSAFEPATH"), "1"
)
#: Items queued per worker of a cluster, so that it never waits.
_QUEUED_PER_WORKER = 4


def iter_results(
    task: Callable[[Item], Result], items: Iterable[Item], jobs: int, cluster: str | None = None
) -> Generator[tuple[Item, Result | None], None, None]:
    """Run `task` on each item in several processes, and yield pairs of item and result in the order of completion.

    `jobs`: largest number of processes, 1 for this process only; `cluster`: address of a Dask scheduler whose workers
    are used instead. The next of `items` is taken only when a worker, or a place in a cluster's queue, is free. Items
    and `task` are pickled. Processes on this machine ignore the keyboard interrupt; they end with the generator or with
    the parent process.

    If a process dies, for example because memory is short, its item is run once more, alone, after all others. If it
    dies again, the result is None. Exceptions of `task` are raised here. Raises MissingExtra if a cluster is wanted and
    Dask is not installed, and InputError if no scheduler answers or a worker has another version of Sealscope.
    """
    if jobs == 1 and cluster is None:
        yield from ((item, task(item)) for item in items)
        return
    waiting = iter(items)
    lost_items: list[Item] = []  # items whose process died
    is_retry = False  # True while the lost items are run once more
    idle: list[Executor] = []
    busy: dict[Future[Result], tuple[Executor, Item]] = {}
    with _local_processes(task, jobs) if cluster is None else _cluster_workers(task, cluster) as pools:
        while True:
            max_busy = 1 if is_retry else pools.max_items
            for item in islice(waiting, max_busy - len(busy)):
                pool = idle.pop() if idle else pools.start_pool()
                try:
                    future = pools.submit(pool, item)
                except pools.death:  # the process died while idle
                    pool = pools.start_pool()
                    future = pools.submit(pool, item)
                busy[future] = pool, item
            if not busy:
                if is_retry or not lost_items:
                    return
                waiting, is_retry = iter(lost_items), True
                continue
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                pool, item = busy.pop(future)
                try:
                    result = future.result()
                except pools.death:
                    if is_retry:
                        yield item, None
                    else:
                        lost_items.append(item)
                    continue
                idle.append(pool)
                yield item, result


def iter_rows(
    results: Generator[tuple[Item, Result | None], None, None], make_lost: Callable[[Item], Result]
) -> Generator[Result, None, None]:
    """Yield the results (true values) of `iter_results`, and `make_lost(item)` for an item whose process died."""
    with closing(results):
        for item, row in results:
            yield row or make_lost(item)


def iter_results_in_order(
    jobs: int, task: Callable[[Item], Result], items: Sequence[Item]
) -> Iterator[tuple[Item, Result | None]]:
    """Run `task` on each item in `jobs` processes, and yield pairs of item and result in the order of the items.

    The result is None if the worker process died at both attempts. On Linux, a program of a single thread runs the
    first attempts in copies of itself (forks), which have all that it has imported.
    """
    next_number = 0
    if sys.platform == "linux" and threading.active_count() == 1:
        for item, result in zip(items, _iter_forked(jobs, task, items), strict=False):  # fewer if a process dies
            yield item, result
            next_number += 1
    results: dict[int, Result | None] = {}  # results not yet yielded, by number of the item
    waiting = list(enumerate(items))[next_number:]
    for (number, _), spawned in iter_results(partial(_run_numbered, task), waiting, jobs) if waiting else ():
        results[number] = spawned
        while next_number in results:
            yield items[next_number], results.pop(next_number)
            next_number += 1


def _iter_forked(jobs: int, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Run `task` on each item in `jobs` forks of this process; yield the results in order until a process dies."""
    lifeline, parent_end = Pipe(duplex=False)
    start = partial(_initialise_fork, task, lifeline, parent_end)
    with warnings.catch_warnings():  # Python warns of threads, as those of a library that are stopped before a fork
        warnings.simplefilter("ignore", DeprecationWarning)
        pool = ProcessPoolExecutor(jobs, get_context("fork"), initializer=start)
        futures = [pool.submit(_run_task, item) for item in items]  # the first one forks all processes
    try:
        with suppress(BrokenProcessPool):
            for future in futures:
                yield future.result()
    finally:
        parent_end.close()
        lifeline.close()
        pool.shutdown(wait=False, cancel_futures=True)


class _Pools(NamedTuple):
    """Access to worker processes, on this machine or on a cluster.

    `start_pool`: starts a pool of processes; `max_items`: largest number of items that run or wait in all pools;
    `submit`: gives an item to a pool and returns its future; `death`: exception of a future whose process died.
    """

    start_pool: Callable[[], Executor]
    max_items: int
    submit: Callable[[Executor, Any], Future[Any]]
    death: type[Exception]


@contextmanager
def _local_processes(task: Callable[[Any], Any], max_items: int) -> Iterator[_Pools]:
    """Provide up to `max_items` worker processes of this machine for `task`, and end them when the context ends.

    Each process is a pool of its own, because a process that dies breaks its whole pool.
    """
    context = get_context("spawn")
    lifeline, parent_end = context.Pipe(duplex=False)  # a worker ends when `parent_end` is closed
    pools: list[Executor] = []

    def start_process() -> Executor:
        """Start one worker process, as a pool of its own, with the variables `_ENVIRONMENT` unless they are set."""
        added = {name: value for name, value in _ENVIRONMENT.items() if not os.environ.get(name)}
        os.environ.update(added)
        try:  # the pool itself starts a process, too, that keeps account of semaphores
            pool = ProcessPoolExecutor(1, context, initializer=_initialise_worker, initargs=(task, lifeline))
            pools.append(pool)
            pool.submit(os.getpid)  # the first item starts the process
        finally:
            for name in added:
                os.environ.pop(name, None)
        return pool

    try:
        yield _Pools(start_process, max_items, lambda pool, item: pool.submit(_run_task, item), BrokenProcessPool)
    finally:
        parent_end.close()
        lifeline.close()
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _cluster_workers(task: Callable[[Any], Any], address: str) -> Iterator[_Pools]:
    """Provide the workers of the Dask scheduler at `address` as one pool for `task`.

    Raises MissingExtra if Dask is not installed, and InputError if the scheduler does not answer, has no workers, or a
    worker has another version of Sealscope.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtra("a cluster needs Dask: pip install 'sealscope[cluster]'") from None
    from sealscope.campaigns.cases.case import code_key

    dask: Any = distributed
    try:
        client = dask.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"--cluster must be the address of a Dask scheduler, got {address}: {error}") from None
    with client:
        if not client.nthreads():
            raise InputError(f"--cluster must have workers, got none ({address})")
        try:
            keys = set(client.run(code_key).values())
        except Exception as error:
            raise InputError(f"the cluster's workers must have Sealscope, got: {error} ({address})") from None
        if keys != {code_key()}:
            raise InputError(f"the cluster's workers must have this machine's Sealscope, got another ({address})")
        # pure=False: equal items are run each, not taken for one
        pool, max_items = client.get_executor(pure=False), _QUEUED_PER_WORKER * sum(client.nthreads().values())
        yield _Pools(lambda: pool, max_items, lambda pool, item: pool.submit(task, item), dask.KilledWorker)


def _run_numbered(task: Callable[[Item], Result], numbered_item: tuple[int, Item]) -> Result:
    """Run `task` on the item of a pair (number, item)."""
    return task(numbered_item[1])


#: The task of this worker process, as a list of one task, which `_initialise_worker` fills.
_task: list[Callable[[Any], Any]] = []


def _initialise_worker(task: Callable[[Any], Any], lifeline: Connection[Any, Any]) -> None:
    """Store this worker process's task, ignore the keyboard interrupt, and exit when the pipe `lifeline` is closed."""
    _task[:] = [task]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    threading.Thread(target=_exit_with_parent, args=(lifeline,), daemon=True).start()


def _initialise_fork(task: Callable[[Any], Any], lifeline: Connection[Any, Any], end: Connection[Any, Any]) -> None:
    """Initialise a fork as a worker, and close its copy of the parent's `end` of the pipe `lifeline`."""
    end.close()
    _initialise_worker(task, lifeline)


def _run_task(item: Any) -> Any:
    """Run the task that this worker process stored at its start on an item; return the result."""
    return _task[0](item)


def _exit_with_parent(lifeline: Connection[Any, Any]) -> None:
    """Wait until the parent process ends or closes the other end of the pipe `lifeline`, then exit this process."""
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(1)


def cores() -> int:
    """Count the processor cores that this process may use."""
    return max(1, len(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def process_count(jobs: int | None) -> int:
    """Choose the number of processes: `jobs`, but at most two per core; one per core if `jobs` is None."""
    return min(jobs or cores(), 2 * cores())
