"""The command that reproduces the thesis."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sealscope.cli.options import JobsOption, complain, say_jobs

if TYPE_CHECKING:
    from sealscope.thesis.engine.build import Progress


def complete_items(incomplete: str) -> list[str]:
    """Complete the id of an item."""
    from sealscope.thesis.engine.items import collect

    items = collect()
    groups = ["all", *(f"chapter-{number}" for number in sorted({item.chapter for item in items}))]
    return [name for name in (*groups, *(item.id for item in items)) if name.startswith(incomplete)]


def reproduce(
    ids: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ID...]",
            help="What to reproduce: ids such as fig-5.58, all, chapter-4, or wildcards such as 'fig-5.*'.",
            autocompletion=complete_items,
        ),
    ] = None,
    listing: Annotated[bool, typer.Option("--list", help="List what there is, and what it needs.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter simulations.")] = False,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the results; a second call goes on there.")
    ] = Path("sealscope-thesis"),
    sheet: Annotated[
        Path | None,
        typer.Option(
            "--sheet",
            help="Folder with the thesis's data sheet (appendix_c_pa.csv, appendix_c_pb.csv); else $SEALSCOPE_SHEET or "
            "./data.",
        ),
    ] = None,
    jobs: JobsOption = None,
) -> None:
    """Make the thesis's tables and figures anew, with a verdict on each claim. Exit status 1 where one failed."""
    if listing:
        _list(ids or ["all"], sheet)
        return
    from sealscope.errors import InputError
    from sealscope.reporting.thesis.files import publish
    from sealscope.reporting.thesis.page import write_thesis_page
    from sealscope.reporting.thesis.plots import require_drawing
    from sealscope.thesis.engine.build import reproduce as build
    from sealscope.thesis.sheet import MISSING

    if not ids:
        raise InputError("an item must be named: an id, chapter-N or all (sealscope reproduce --list)")
    require_drawing()
    say_jobs(jobs)
    with _progress() as progress:
        made = build(ids, output, quick=quick, jobs=jobs, sheet=sheet, publish=publish, progress=progress)
    statuses = made.statuses.values()
    products = ((status, (made.products(status.item.id) or ()) if status.available else ()) for status in statuses)
    page = write_thesis_page(output, products, quick=quick, sheet=made.sheet is not None)
    for status in statuses:
        if status.state == "failed":
            complain(f"{status.item.id} failed: {status.reason}")
    counts = Counter(status.state for status in statuses)
    shown = {"made": counts["made"], "kept from before": counts["kept"], "failed": counts["failed"]}
    typer.echo("items: " + ", ".join(f"{count} {state}" for state, count in shown.items() if count))
    if counts["left out"]:
        typer.echo(f"left out: {counts['left out']} ({MISSING})")
    typer.echo(f"page:  {page}")
    if counts["failed"]:
        raise typer.Exit(1)


def _list(patterns: Sequence[str], sheet: Path | None) -> None:
    from sealscope.thesis.engine.items import collect, select_items
    from sealscope.thesis.sheet import MISSING, find_sheet

    given = find_sheet(sheet) is not None
    items = select_items(collect(), patterns)
    width = max(len(item.id) for item in items)
    for item in items:
        note = f"  ({MISSING})" if item.needs_sheet and not given else ""
        typer.echo(f"{item.id:<{width}}  {item.kind:<6}  {item.title}{note}")


@contextmanager
def _progress() -> Iterator[Progress]:
    """Show one bar on standard error with the items in work and the time left; nothing where it is no terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:  # a disabled bar prints an empty line in some versions of the library
        yield lambda ended, total, in_work: None
        return
    columns = (
        BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)

        def update(ended: int, total: int, in_work: Sequence[str]) -> None:
            bar.update(task, completed=ended, total=total, description=", ".join(in_work))

        yield update
