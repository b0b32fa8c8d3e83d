"""Items carried out by processes of this machine, or by a Dask cluster; the death of one costs its item alone."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, TypeVar

from sealscope.errors import InputError, MissingExtra

Item = TypeVar("Item")
Result = TypeVar("Result")
#: Environment of a process: one thread for linear algebra, as processes run side by side, and no module from the
#: working folder, which may be hostile.
_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "PYTHONSAFEPATH"), "1"
)
#: Items handed out ahead of each worker of a cluster, so that it never waits.
_AHEAD = 4


def carried_out(
    task: Callable[[Item], Result], items: Iterable[Item], jobs: int, cluster: str | None = None
) -> Generator[tuple[Item, Result | None], None, None]:
    """Yield each item and its result as it ends: from `jobs` spawned processes, or from this one alone (1).

    `cluster`: address of a Dask scheduler, whose workers are taken instead. An item is taken from `items` when a
    process is free for it. `task` and items are pickled; `task` goes to each process once. An item whose process dies,
    by a hand or the memory's end, is tried once more after all others, alone, and has then the result None. Processes
    ignore the interrupt, and end when the generator is closed or the parent ends, however that ends. Raises what `task`
    raised; MissingExtra without Dask, InputError where no scheduler answers or a worker has another Sealscope.
    """
    if jobs == 1 and cluster is None:
        yield from ((item, task(item)) for item in items)
        return
    waiting, died, tried_again = iter(items), list[Item](), False
    idle: list[Executor] = []
    busy: dict[Future[Result], tuple[Executor, Item]] = {}
    with _processes(task, jobs) if cluster is None else _on_cluster(task, cluster) as pools:
        while True:
            for item in islice(waiting, (1 if tried_again else pools.most) - len(busy)):
                pool = idle.pop() if idle else pools.new()
                try:
                    future = pools.submit(pool, item)
                except pools.death:  # of an idle process
                    pool = pools.new()
                    future = pools.submit(pool, item)
                busy[future] = pool, item
            if not busy:
                if tried_again or not died:
                    return
                waiting, tried_again = iter(died), True
                continue
            for future in wait(busy, return_when=FIRST_COMPLETED).done:
                pool, item = busy.pop(future)
                try:
                    result = future.result()
                except pools.death:
                    if tried_again:
                        yield item, None
                    else:
                        died.append(item)
                    continue
                idle.append(pool)
                yield item, result


def in_order(jobs: int, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[Item, Result | None]]:
    """Yield results of `carried_out` in the order of the items."""
    results: dict[int, Result | None] = {}
    place = 0
    for (number, _), result in carried_out(partial(_numbered, task), enumerate(items), jobs):
        results[number] = result
        while place in results:
            yield items[place], results.pop(place)
            place += 1


class _Pools(NamedTuple):
    """Pools of workers: at most `most`, each from `new`, takes items by `submit`; a process's end raises `death`."""

    new: Callable[[], Executor]
    most: int
    submit: Callable[[Executor, Any], Future[Any]]
    death: type[Exception]


@contextmanager
def _processes(task: Callable[[Any], Any], most: int) -> Iterator[_Pools]:
    """Start processes of this machine, each a pool of its own, so that one that dies breaks no other."""
    context = get_context("spawn")
    lifeline, far_end = context.Pipe(duplex=False)
    pools: list[Executor] = []

    def new() -> Executor:
        with _worker_environment():  # a process starts with what it is given first
            pools.append(ProcessPoolExecutor(1, context, _begin, (task, lifeline)))
            pools[-1].submit(os.getpid)
        return pools[-1]

    try:
        yield _Pools(new, most, lambda pool, item: pool.submit(_carry_out, item), BrokenProcessPool)
    finally:
        far_end.close()
        lifeline.close()
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _on_cluster(task: Callable[[Any], Any], address: str) -> Iterator[_Pools]:
    """Use the workers of the Dask scheduler at `address`, which are one pool."""
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
        pool, most = client.get_executor(pure=False), _AHEAD * sum(client.nthreads().values())
        yield _Pools(lambda: pool, most, lambda pool, item: pool.submit(task, item), dask.KilledWorker)


def _numbered(task: Callable[[Item], Result], numbered: tuple[int, Item]) -> Result:
    return task(numbered[1])


#: In a worker process: what it carries out its items with.
_task: list[Callable[[Any], Any]] = []


def _begin(task: Callable[[Any], Any], lifeline: Connection[Any, Any]) -> None:
    _task[:] = [task]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _carry_out(item: Any) -> Any:
    return _task[0](item)


def _end_with(lifeline: Connection[Any, Any]) -> None:
    """End this process when the parent closes its end of the pipe, or has ended."""
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(1)


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Set `_ENVIRONMENT` for processes that start in the block, where the caller has not chosen otherwise."""
    added = {name: value for name, value in _ENVIRONMENT.items() if not os.environ.get(name)}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def cores() -> int:
    """Count the cores that this process may use."""
    return max(1, len(os.sched_getaffinity(0))) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def process_count(jobs: int | None) -> int:
    """Choose the number of processes: `jobs`, at most two a core; by default one a core."""
    return min(jobs or cores(), 2 * cores())
