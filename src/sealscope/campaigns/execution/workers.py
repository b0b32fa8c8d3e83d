"""Worker processes of this machine; the death of one costs the item that it carried out and no other."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
#: Environment of a process: one thread for linear algebra, as processes run side by side, and no module from the
#: working folder, which may be a stranger's.
_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "PYTHONSAFEPATH"), "1"
)


class Workers(Generic[Item, Result]):
    """Up to `jobs` spawned processes that carry out `task(item)`, one item each at a time.

    `task` and items are pickled; `task` goes to each process once. Every process is an executor of its own, so that
    one that dies breaks no other and the item it had is known. Processes ignore the interrupt, and end when the block
    ends or the parent does, however that ends.
    """

    def __init__(self, jobs: int, task: Callable[[Item], Result]) -> None:
        self._jobs, self._task = jobs, task
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[Result], tuple[ProcessPoolExecutor, Item]] = {}
        self._lifeline, self._held = get_context("spawn").Pipe(duplex=False)

    def __enter__(self) -> Workers[Item, Result]:
        return self

    @property
    def items(self) -> list[Item]:
        """The items in work."""
        return [item for _, item in self._busy.values()]

    @property
    def free(self) -> bool:
        """Whether another item can begin."""
        return len(self._busy) < self._jobs

    def begin(self, item: Item) -> None:
        """Begin an item in an idle process, or in a new one."""
        with _worker_environment():  # a process starts with its first item
            pool = self._idle.pop() if self._idle else self._new_process()
            self._busy[pool.submit(_carry_out, item)] = pool, item

    def ended(self) -> list[tuple[Item, Result | None]]:
        """Wait until an item ends, and return those that have with their results, None where the process died.

        Raises what `task` raised.
        """
        results: list[tuple[Item, Result | None]] = []
        for future in wait(self._busy, return_when=FIRST_COMPLETED).done:
            pool, item = self._busy.pop(future)
            try:
                results.append((item, future.result()))
                self._idle.append(pool)
            except BrokenProcessPool:
                results.append((item, None))
        return results

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.close()
        self._lifeline.close()
        for pool in (*self._idle, *(pool for pool, _ in self._busy.values())):
            pool.shutdown(wait=False, cancel_futures=True)

    def _new_process(self) -> ProcessPoolExecutor:
        context = get_context("spawn")
        return ProcessPoolExecutor(1, mp_context=context, initializer=_begin, initargs=(self._task, self._lifeline))


#: In a worker process: what it carries out its items with.
_task: list[Callable[[Any], Any]] = []


def _begin(task: Callable[[Any], Any], lifeline: Connection[Any, Any]) -> None:
    _task[:] = [task]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _carry_out(item: Any) -> Any:
    return _task[0](item)


def _end_with(lifeline: Connection[Any, Any]) -> None:
    """End this process when the parent closes its end of the pipe, or is gone."""
    with suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(1)


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Give processes that start in the block `_ENVIRONMENT`, where the caller has not chosen otherwise."""
    added = {name: value for name, value in _ENVIRONMENT.items() if not os.environ.get(name)}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def most_processes() -> int:
    """Return how many processes are started at most, whatever is asked for: two a core."""
    return 2 * cores()


def process_count(asked: int | None) -> int:
    """Return how many processes to start: as many as asked for, at most two a core; by default one a core."""
    return min(asked or cores(), most_processes())


def in_order(jobs: int, task: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[Item, Result | None]]:
    """Yield each item and its result in the order given, as soon as it and all before it are there.

    The result is None where the process died that carried the item out. Raises what `task` raised.
    """
    waiting = deque(enumerate(items))
    results: dict[int, Result | None] = {}
    place = 0
    with Workers(jobs, partial(_numbered, task)) as workers:
        while place < len(items):
            while waiting and workers.free:
                workers.begin(waiting.popleft())
            for (number, _), result in workers.ended():
                results[number] = result
            while place in results:
                yield items[place], results.pop(place)
                place += 1


def _numbered(task: Callable[[Item], Result], numbered: tuple[int, Item]) -> Result:
    return task(numbered[1])
