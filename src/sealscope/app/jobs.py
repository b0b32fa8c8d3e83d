"""Work in the background, one job after the other, with progress and a way to cancel it."""

from __future__ import annotations

import itertools
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from sealscope.errors import SealscopeError

_log = logging.getLogger(__name__)
#: Jobs that are remembered after their end.
_MAX_ENDED = 20


class Cancelled(Exception):  # noqa: N818 - no error
    """Ends a job that was cancelled."""


class Job:
    """A piece of work: `kind` and `subject` name it, `done` of `total` steps are done, `state` says how it goes."""

    def __init__(self, number: int, kind: str, subject: str, work: Callable[[Job], Any]) -> None:
        self.number, self.kind, self.subject, self._work = number, kind, subject, work
        self.done, self.total, self.note = 0, 0, ""
        self.state, self.error = "waiting", ""
        self._cancelled = threading.Event()

    def progress(self, done: int, total: int, note: str = "") -> None:
        """Note the progress; raise Cancelled if somebody has cancelled the job."""
        if self._cancelled.is_set():
            raise Cancelled
        self.done, self.total, self.note = done, total, note

    def cancel(self) -> None:
        """Ask the job to end at its next step."""
        self._cancelled.set()
        if self.state == "waiting":
            self.state = "cancelled"

    def run(self) -> None:
        """Do the work; an error becomes the job's `error`, in one line."""
        if self.state != "waiting":
            return
        self.state = "running"
        try:
            self._work(self)
            self.state = "done"
        except Cancelled:
            self.state = "cancelled"
        except (SealscopeError, OSError, MemoryError) as error:
            self.state, self.error = "failed", " ".join((str(error) or "out of memory").split())
        except Exception as error:  # a defect must not end the thread
            _log.debug("job %s failed", self.kind, exc_info=True)
            self.state, self.error = "failed", f"cannot {self.kind}, got {type(error).__name__}: {error}"

    def as_dict(self) -> dict[str, Any]:
        """Return the job's progress as plain values for JSON."""
        names = ("number", "kind", "subject", "done", "total", "note", "state", "error")
        return {name: getattr(self, name) for name in names}


class JobQueue:
    """A thread that runs jobs in the order of their submission; `close` cancels them."""

    def __init__(self, name: str, on_change: Callable[[], None]) -> None:
        self._on_change, self._numbers = on_change, itertools.count(1)
        self._waiting, self._jobs = deque[Job](), deque[Job](maxlen=200)
        self._wake, self._closed = threading.Condition(), False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, kind: str, subject: str, work: Callable[[Job], Any]) -> Job:
        """Append a job; `work` is called with it."""
        with self._wake:
            job = Job(next(self._numbers), kind, subject, work)
            self._waiting.append(job)
            self._jobs.append(job)
            ended = [other for other in self._jobs if other.state not in ("waiting", "running")]
            for other in ended[:-_MAX_ENDED]:
                self._jobs.remove(other)
            self._wake.notify()
        self._on_change()
        return job

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                job = self._waiting.popleft()
            self._on_change()
            job.run()
            self._on_change()

    def jobs(self) -> list[Job]:
        """List the jobs that are not forgotten, the oldest first."""
        with self._wake:
            return list(self._jobs)

    def cancel(self, number: int) -> bool:
        """Cancel the job with a number; return False if there is none."""
        job = next((job for job in self.jobs() if job.number == number), None)
        if job is not None:
            job.cancel()
            self._on_change()
        return job is not None

    def close(self) -> None:
        """Cancel all jobs and end the thread after the present step."""
        for job in self.jobs():
            job.cancel()
        with self._wake:
            self._closed = True
            self._wake.notify()
        self._thread.join(timeout=2.0)
