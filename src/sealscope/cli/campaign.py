"""The commands that measure: campaign run, status and report."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sealscope.cli.options import JobsOption, complain, say_jobs
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.campaigns.cases.recordings import ProgressCallback
    from sealscope.campaigns.execution.store import CampaignProgress
    from sealscope.campaigns.held_out.classifiers import MeasuredSamples
    from sealscope.campaigns.plans.model import AnyPlan
    from sealscope.campaigns.results import CampaignResult

campaign = typer.Typer(
    name="campaign",
    help="Measure what detectors find, at what false-alarm rate, over many simulated or measured records.",
    no_args_is_help=True,
)


def complete_plans(incomplete: str) -> list[str]:
    """Return the names of packaged plans that begin so."""
    from sealscope.campaigns.plans.reader import plan_names

    return [name for name in plan_names() if name.startswith(incomplete)]


PlanArgument = Annotated[
    str, typer.Argument(metavar="PLAN", help="Plan by name, or a TOML file.", autocompletion=complete_plans)
]
FolderOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Folder of the campaign; by default sealscope-campaigns/NAME."),
]
SheetOption = Annotated[
    Path | None,
    typer.Option(
        "--sheet",
        help="Folder with the thesis's data sheet (appendix_c_pa.csv, appendix_c_pb.csv), for plans over it; else "
        "$SEALSCOPE_SHEET or ./data.",
    ),
]

DataOption = Annotated[
    Path | None, typer.Option("--data", help="Folder of the measured data, for plans over recordings or data sets.")
]


@campaign.command()
def run(
    plan: PlanArgument,
    folder: FolderOption = None,
    jobs: JobsOption = None,
    cluster: Annotated[
        str | None, typer.Option("--cluster", metavar="ADDRESS", help="A Dask scheduler, e.g. tcp://host:8786.")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Carry failed records out again.")] = False,
    batch: Annotated[
        bool, typer.Option("--batch", help="Simulate side by side; for detectors of the details' RMS on both sides.")
    ] = False,
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Run the controllers that the plan leads to (FILE.py:NAME): read them first."),
    ] = False,
    sheet: SheetOption = None,
    data: DataOption = None,
) -> None:
    """Carry out what is missing of a plan, then report.

    Interrupted, the same call continues. Exit status 1 where a record failed.
    """
    from sealscope.campaigns.execution.run import run as carry_out
    from sealscope.campaigns.plans.model import SimulatedPlan
    from sealscope.campaigns.plans.reader import load_plan

    loaded = load_plan(plan)
    place = _folder(loaded, folder)
    if batch and not isinstance(loaded, SimulatedPlan):
        raise InputError(f"a plan in batches must simulate its records; run it without --batch ({loaded.place})")
    if isinstance(loaded, SimulatedPlan):
        say_jobs(jobs)
        with progress_bar() as progress:
            state = carry_out(
                loaded, place, jobs=jobs, cluster=cluster, retry=retry, progress=progress, batch=batch, trust=trust,
            )  # fmt: skip
        typer.echo(_progress_text(state))
    _report(loaded, place, sheet, data)
    if isinstance(loaded, SimulatedPlan) and state.failed:
        raise typer.Exit(1)


@campaign.command()
def status(plan: PlanArgument, folder: FolderOption = None) -> None:
    """Say how far a campaign is, and what is left."""
    from sealscope.campaigns.execution.store import progress_of
    from sealscope.campaigns.plans.model import SimulatedPlan
    from sealscope.campaigns.plans.reader import load_plan

    loaded = load_plan(plan)
    if not isinstance(loaded, SimulatedPlan):
        typer.echo("a campaign over measured data has nothing to wait for; report it")
        return
    typer.echo(_progress_text(progress_of(loaded, _folder(loaded, folder))))


@campaign.command()
def report(plan: PlanArgument, folder: FolderOption = None, sheet: SheetOption = None, data: DataOption = None) -> None:
    """Judge the rows that are there; write tables and page."""
    from sealscope.campaigns.plans.reader import load_plan

    loaded = load_plan(plan)
    _report(loaded, _folder(loaded, folder), sheet, data)


def _folder(plan: AnyPlan, given: Path | None) -> Path:
    """Return the campaign's folder; InputError where the default one is a link that a stranger may have left here."""
    if given is not None:
        return given
    folder = Path("sealscope-campaigns") / plan.name
    for part in (folder.parent, folder):
        if part.is_symlink():
            raise InputError(f"the default folder must not be a link, got one ({part}); name a folder with --output")
    return folder


def _progress_text(state: CampaignProgress) -> str:
    text = f"records: {state.done} of {state.records} done"
    if state.failed:
        text += f", {state.failed} of them failed"
    if state.seconds is not None:
        left = (state.records - state.done) * state.seconds
        text += f"; {state.seconds:.2f} s of one core each"
        text += f", about {_time_text(left)} of one core left" if left else ""
    return text


def _time_text(seconds: float) -> str:
    if seconds > 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"


@contextmanager
def progress_bar() -> Iterator[ProgressCallback]:
    """Show records, failures and time left on standard error; without a terminal a line a minute, for the log."""
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
    if not console.is_terminal:
        yield _ProgressLines()
        return
    columns = (
        TextColumn("records"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), TextColumn("{task.description}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True, speed_estimate_period=120) as bar:
        task = bar.add_task("", total=None)

        def update(done: int, total: int, failures: int) -> None:
            bar.update(task, completed=done, total=total, description=f"{failures} failed" if failures else "")

        yield update


class _ProgressLines:
    """Progress without a terminal: a line a minute."""

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
        typer.echo(f"{done} of {total} records{failed}, about {_time_text(left)} left", err=True)


def _report(plan: AnyPlan, folder: Path, sheet: Path | None, data: Path | None) -> None:
    from sealscope.campaigns.results import write_result
    from sealscope.reporting.campaign.page import PAGE, campaign_text, write_campaign_page

    result = _result(plan, folder, sheet, data)
    files = write_result(result, folder)
    write_campaign_page(result, folder / PAGE, [path.name for path in files])
    typer.echo(campaign_text(result))
    for row in result.judgement.failed[:5]:
        complain(f"record {row.id} failed: {row.error}")
    typer.echo(f"tables: {folder}")
    typer.echo(f"page:   {folder / PAGE}")


def _result(plan: AnyPlan, folder: Path, sheet: Path | None, data: Path | None) -> CampaignResult:
    """Return the plan's result: from the rows in its folder, or from the measured data that it is about."""
    from sealscope.campaigns.held_out.data_sets import hydraulic_samples, needs_folder
    from sealscope.campaigns.plans.model import RecordedPlan, SimulatedPlan
    from sealscope.campaigns.results import held_out_result, recorded_result, simulated_result

    if isinstance(plan, SimulatedPlan):
        return simulated_result(plan, folder)
    if isinstance(plan, RecordedPlan):
        with progress_bar() as progress:
            return recorded_result(plan, needs_folder(data, "recordings"), progress)
    if plan.data == "hydraulic":
        return held_out_result(plan, hydraulic_samples(needs_folder(data, "the hydraulic data set")))
    return held_out_result(plan, _sheet_samples(sheet))


def _sheet_samples(folder: Path | None) -> MeasuredSamples:
    """Return the thesis's data sheet as samples; raise InputError where there is none."""
    from sealscope.thesis.claims.evidence import samples_of
    from sealscope.thesis.sheet import MISSING, find_sheet, read_sheet

    path = find_sheet(folder)
    if path is None:
        raise InputError(MISSING)
    return samples_of(read_sheet(path)[0])
