"""How far a campaign is, for people and for logs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from sealscope.campaigns.cases.recordings import ProgressCallback


def span(seconds: float) -> str:
    """A time in hours, minutes or seconds."""
    return (
        f"{seconds / 3600:.1f} h"
        if seconds > 5400
        else f"{seconds / 60:.0f} min"
        if seconds > 90
        else f"{seconds:.0f} s"
    )


@contextmanager
def bar() -> Iterator[ProgressCallback]:
    """One bar on standard error with the records, failures and the time left; without a terminal a line a minute."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as RichProgress

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines()
        return
    columns = (
        TextColumn("records"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.description}"),
    )  # fmt: skip
    with RichProgress(*columns, console=console, transient=True, speed_estimate_period=120) as shown:
        task = shown.add_task("", total=None)

        def told(done: int, total: int, failures: int) -> None:
            shown.update(task, completed=done, total=total, description=f"{failures} failed" if failures else "")

        yield told


class _Lines:
    """Progress where nobody watches: a line a minute, for the log."""

    def __init__(self) -> None:
        self.began, self.last, self.first = time.monotonic(), time.monotonic(), -1

    def __call__(self, done: int, total: int, failures: int) -> None:
        now = time.monotonic()
        self.first = done if self.first < 0 else self.first
        if now - self.last < 60.0 or done == self.first:
            return
        self.last = now
        left = (now - self.began) / (done - self.first) * (total - done)
        failed = f", {failures} failed" if failures else ""
        typer.echo(f"{done} of {total} records{failed}, about {span(left)} left", err=True)
