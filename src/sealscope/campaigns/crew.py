"""Who carries the cases out: processes of this machine, or the workers of a Dask scheduler; the rows are the same."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sealscope.campaigns.cases import Case
from sealscope.campaigns.plan import Plan
from sealscope.campaigns.work import Row, failed, work
from sealscope.errors import InputError, MissingExtra

#: Carries out one case.
Task = Callable[[Plan, Case, "Path | None"], Row]
_SINGLE = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Cases handed out ahead of each worker, so that it never waits.
_AHEAD = 2
_DASK_AHEAD = 4


def alone(plan: Plan, cases: Sequence[Case], keep: Path | None = None, task: Task = work) -> Iterator[Row]:
    """The cases one after the other, in this process."""
    for case in cases:
        yield task(plan, case, keep)


def together(
    plan: Plan, cases: Sequence[Case], jobs: int, keep: Path | None = None, task: Task = work
) -> Iterator[Row]:
    """The cases in `jobs` processes, each row as it is ready.

    A process that dies costs no other case: those that were handed out are tried again one at a time, and the one
    that kills its process is a failed row. Leaving the iterator early ends the processes.
    """
    waiting = list(reversed(cases))
    while waiting:
        lost: list[Case] = []
        yield from _pool(plan, waiting, jobs, keep, task, lost)
        for case in lost:
            again: list[Case] = []
            yield from _pool(plan, [case], 1, keep, task, again)
            if again:
                yield failed(case, "the process that carried it out died")


def _pool(plan: Plan, waiting: list[Case], jobs: int, keep: Path | None, task: Task, lost: list[Case]) -> Iterator[Row]:
    """Rows of the cases taken off the end of `waiting`, until none is left or a process has died; then `lost` holds
    those that were handed out."""
    context = multiprocessing.get_context("spawn")
    with one_thread_each():
        pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin, initargs=(plan, keep, task))
        handed: dict[Future[Row], Case] = {}
        try:
            while waiting or handed:
                while waiting and len(handed) < jobs * _AHEAD:
                    handed[pool.submit(_carry_out, waiting[-1])] = waiting[-1]
                    waiting.pop()
                done, _ = wait(handed, return_when=FIRST_COMPLETED)
                for future in done:
                    row = future.result()
                    del handed[future]
                    yield row
        except BrokenProcessPool:
            for future, case in handed.items():  # those that ended before the death have their row
                if future.done() and not future.cancelled() and future.exception() is None:
                    yield future.result()
                else:
                    lost.append(case)
        finally:
            processes = list((getattr(pool, "_processes", None) or {}).values())
            pool.shutdown(wait=not handed, cancel_futures=True)
            if handed:
                for process in processes:
                    process.terminate()


#: What a process of the pool carries out its cases with.
_mine: list[tuple[Plan, Path | None, Task]] = []


def _carry_out(case: Case) -> Row:
    plan, keep, task = _mine[0]
    return task(plan, case, keep)


def _begin(plan: Plan, keep: Path | None, task: Task) -> None:
    """In a new process: leave the interrupt to the parent, and end when the parent does."""
    _mine[:] = [(plan, keep, task)]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let new processes keep to one thread for linear algebra: the processes are the parallelism."""
    before = {name: os.environ.get(name) for name in _SINGLE}
    os.environ.update({name: "1" for name, value in before.items() if value is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def on_cluster(
    plan: Plan, cases: Sequence[Case], address: str, keep: Path | None = None, task: Task = work
) -> Iterator[Row]:
    """The cases on the workers of the Dask scheduler at `address` (`tcp://host:8786`), each row as it is ready.

    The workers need the same Sealscope, and the folder where recordings are kept. Raises MissingExtra without Dask,
    InputError where no scheduler answers.
    """
    try:
        import distributed
    except ImportError:
        raise MissingExtra("a cluster needs Dask: pip install 'sealscope[cluster]'") from None
    dask: Any = distributed
    try:
        client = dask.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"--cluster must be the address of a Dask scheduler, got {address}: {error}") from None
    with client:
        _same_code(client, address)
        shared = client.scatter(plan, broadcast=True)
        left = iter(cases)
        by_key: dict[str, Case] = {}

        def hand(case: Case) -> Any:
            by_key[f"case-{case.id}"] = case
            return client.submit(task, shared, case, keep, key=f"case-{case.id}", pure=False, retries=1)

        width = _DASK_AHEAD * max(1, sum(client.nthreads().values()))
        first = [hand(case) for _, case in zip(range(width), left, strict=False)]
        ready = dask.as_completed(first, loop=client.loop)
        for future in ready:
            case = by_key.pop(future.key)
            wrong = future.exception()
            yield future.result() if wrong is None else failed(case, f"a worker failed: {wrong}".splitlines()[0])
            future.release()
            following = next(left, None)
            if following is not None:
                ready.add(hand(following))


def _same_code(client: Any, address: str) -> None:
    """Refuse workers that would make other rows."""
    from sealscope.campaigns.cases import code_key

    if not client.nthreads():
        raise InputError(f"--cluster must have workers, got none ({address})")
    try:
        theirs = client.run(code_key)
    except Exception as error:
        raise InputError(
            f"the cluster's workers must have Sealscope, got: {error} ({address})".splitlines()[0]
        ) from None
    if any(key != code_key() for key in theirs.values()):
        raise InputError(f"the cluster's workers must have the same Sealscope as this machine, got another ({address})")
