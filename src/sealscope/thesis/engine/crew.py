"""Work through items that need one another in a few processes, and survive the death of any of them."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from sealscope.campaigns.execution.workers import one_thread_each
from sealscope.thesis.engine.bench import Bench, Job
from sealscope.thesis.engine.items import Entry

#: Told the entry that has just ended (None at the start) and the ids in work.
Told = Callable[[Entry | None, Sequence[str]], None]


def alone(
    job: Job, order: Sequence[str], needs: Mapping[str, Sequence[str]], told: Told
) -> Generator[Entry, None, None]:
    """The items of `order` one after the other, in this process."""
    bench = Bench(job)
    broken: set[str] = set()
    for name in order:
        told(None, (name,))
        entry = _blocked(bench, name, needs, broken) or bench.work(name)
        if entry.state == "failed":
            broken.add(name)
        told(entry, ())
        yield entry


def together(
    job: Job, order: Sequence[str], needs: Mapping[str, Sequence[str]], told: Told, jobs: int
) -> Generator[Entry, None, None]:
    """The items of `order` in `jobs` processes, each as soon as those of its `needs` that are in the order have ended.

    A process that dies takes its item with it, no more; leaving the iterator early ends them all.
    """
    bench = Bench(job)
    waiting, broken = list(order), set[str]()
    crew: list[_Worker] = []
    try:
        while waiting or any(worker.item for worker in crew):
            unfinished = {*waiting, *(worker.item for worker in crew)}
            for name in [n for n in waiting if any(needed in broken for needed in needs[n])]:
                waiting.remove(name)
                broken.add(name)
                entry = _blocked(bench, name, needs, broken) or Entry(bench.items[name], "failed")
                told(entry, [worker.item for worker in crew if worker.item])
                yield entry
            ready = [n for n in waiting if not unfinished.intersection(needs[n])]
            for name in ready:
                worker = next((w for w in crew if not w.item), None)
                if worker is None and len(crew) < jobs:
                    crew.append(worker := _Worker(job))
                if worker is None:
                    break
                waiting.remove(name)
                worker.begin(name)
            told(None, [worker.item for worker in crew if worker.item])
            busy = [worker for worker in crew if worker.item]
            if not busy:
                continue
            wait([worker.pipe for worker in busy] + [worker.process.sentinel for worker in busy])
            for worker in busy:
                ended = worker.ended(bench)
                if ended is None:
                    continue
                if not worker.process.is_alive():
                    crew.remove(worker)
                if ended.state == "failed":
                    broken.add(ended.item.id)
                told(ended, [w.item for w in crew if w.item])
                yield ended
    finally:
        for worker in crew:
            worker.end()


def _blocked(bench: Bench, name: str, needs: Mapping[str, Sequence[str]], broken: set[str]) -> Entry | None:
    failed = [needed for needed in needs[name] if needed in broken]
    return Entry(bench.items[name], "failed", f"needs {failed[0]}, which failed") if failed else None


class _Worker:
    """A process that makes one item at a time."""

    def __init__(self, job: Job) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.item = ""
        self.process = context.Process(target=_serve, args=(job, theirs), daemon=True)
        with one_thread_each():
            self.process.start()
        theirs.close()

    def begin(self, name: str) -> None:
        self.item = name
        with suppress(OSError):  # where it is dead already, `ended` tells
            self.pipe.send(name)

    def ended(self, bench: Bench) -> Entry | None:
        """The entry of the item in work, None while it goes on."""
        name, entry = self.item, None
        try:
            if self.pipe.poll():
                entry = self.pipe.recv()
            elif not self.process.is_alive() and not self.pipe.poll():
                entry = self._lost(bench, name)
        except (EOFError, OSError):
            self.process.join(1.0)
            entry = self._lost(bench, name)
        if entry is not None:
            self.item = ""
        return entry

    def _lost(self, bench: Bench, name: str) -> Entry:
        self.process.join(1.0)
        return Entry(bench.items[name], "failed", f"its process ended with status {self.process.exitcode}")

    def end(self) -> None:
        self.process.terminate()
        self.process.join(5.0)
        if self.process.is_alive():
            self.process.kill()
        self.pipe.close()


def _serve(job: Job, pipe: Connection[Any, Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    bench = Bench(job)
    while True:
        try:
            name = pipe.recv()
        except EOFError:
            return
        pipe.send(bench.work(name))
