"""The command `reproduce`, which reproduces the thesis's tables and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError


def _item_names() -> list[str]:
    """List all names that `reproduce` accepts, for completion: tables and figures, chapters and `all`."""
    from sealscope.thesis.engine.items import load_items

    items = load_items()
    groups = [f"chapter-{number}" for number in sorted({item.chapter for item in items})]
    return ["all", *groups, *(item.id for item in items)]


_complete_items = opt.make_completion(_item_names)
_OUTPUT = "Folder of the results; a later call resumes there."
_ID = "What to reproduce: ids such as fig-5.58, all, chapter-4, or wildcards such as 'fig-5.*'."


def reproduce(
    ids: Annotated[list[str] | None, Argument(metavar="[ID...]", help=_ID, autocompletion=_complete_items)] = None,
    listing: Annotated[bool, Option("--list", help="List the items, and what each needs.")] = False,
    quick: Annotated[bool, Option("--quick", help="Fewer and shorter simulations.")] = False,
    output: Annotated[Path, Option("--output", "-o", help=_OUTPUT)] = Path("sealscope-thesis"),
    sheet: opt.SheetOption = None,
    jobs: opt.JobsOption = None,
) -> None:
    """Reproduce the thesis's tables and figures, with a verdict on each claim.

    The exit status is 1 if a table or figure could not be made.
    """
    if listing:
        _list_items(ids or ["all"], sheet)
        return
    from sealscope.thesis.engine.build import reproduce as build
    from sealscope.thesis.pages.files import publish
    from sealscope.thesis.pages.page import write_thesis_page
    from sealscope.thesis.pages.plots import require_drawing
    from sealscope.thesis.sheet import MISSING, find_sheet

    if not ids:
        raise InputError("an item must be named: an id, chapter-N or all (sealscope reproduce --list)")
    require_drawing()
    opt.say_jobs(jobs)
    with opt.counted_progress("items") as update:
        status_by_id = build(
            ids, output, quick=quick, jobs=jobs, sheet=sheet, publish=publish,
            progress=lambda n_done, total, in_work: update(n_done, total, ", ".join(in_work)),
        )  # fmt: skip
    statuses = list(status_by_id.values())
    page = write_thesis_page(output, statuses, quick=quick, sheet=find_sheet(sheet) is not None)
    for status in statuses:
        if status.state == "failed":
            opt.complain(f"{status.item.id} failed: {status.reason}")
    counts = Counter(status.state for status in statuses)
    count_by_label = {"made": counts["made"], "kept from before": counts["kept"], "failed": counts["failed"]}
    echo("items: " + ", ".join(f"{count} {label}" for label, count in count_by_label.items() if count))
    if counts["left out"]:
        echo(f"left out: {counts['left out']} ({MISSING})")
    echo(f"page:  {page}")
    if counts["failed"]:
        raise Exit(1)


def _list_items(patterns: Sequence[str], sheet: Path | None) -> None:
    """Print ids and titles of the items that match `patterns`; mark those that need the data sheet if it is missing.

    `sheet`: folder of the data sheet, None for the default places (`find_sheet`).
    """
    from sealscope.thesis.engine.items import load_items, select_items
    from sealscope.thesis.sheet import MISSING, find_sheet

    has_sheet = find_sheet(sheet) is not None
    items = select_items(load_items(), patterns)
    width = max(len(item.id) for item in items)
    for item in items:
        head = f"{item.id:<{width}}  {item.kind:<6}  "
        note = f" ({MISSING})" if item.needs_sheet and not has_sheet else ""
        opt.say_wrapped(f"{item.title}{note}", head)
