"""The commands `campaign run`, `campaign status` and `campaign report`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option, Typer, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.campaigns.cases.recordings import ProgressCallback
    from sealscope.campaigns.execution.store import CampaignProgress
    from sealscope.campaigns.plans.model import AnyPlan

campaign = Typer(
    name="campaign",
    help="Measure what detectors find, at what false-alarm rate, over many simulated or measured records.",
    no_args_is_help=True,
)


def _packaged_plans() -> Sequence[str]:
    """List the names of the packaged plans, for completion by the shell."""
    from sealscope.campaigns.plans.reader import plan_names

    return plan_names()


PlanArgument = Annotated[
    str,
    Argument(metavar="PLAN", help="Plan by name, or a TOML file.", autocompletion=opt.make_completion(_packaged_plans)),
]
_FOLDER = "Folder of the campaign; by default sealscope-campaigns/NAME."
FolderOption = Annotated[Path | None, Option("--output", "-o", help=_FOLDER)]
_DATA = "Folder of the recordings, for plans over recordings."
DataOption = Annotated[Path | None, Option("--data", help=_DATA)]
_CLUSTER = "A Dask scheduler, e.g. tcp://host:8786."
_TRUST = "Run the controllers that the plan names (FILE.py:NAME): read them first."


@campaign.command()
def run(
    plan: PlanArgument,
    folder: FolderOption = None,
    jobs: opt.JobsOption = None,
    cluster: Annotated[str | None, Option("--cluster", metavar="ADDRESS", help=_CLUSTER)] = None,
    retry: Annotated[bool, Option("--retry", help="Carry failed records out again.")] = False,
    trust: Annotated[bool, Option("--trust", help=_TRUST)] = False,
    data: DataOption = None,
) -> None:
    """Run the missing records of a plan, then report.

    After an interruption the same call continues. The exit status is 1 if a record failed.
    """
    from sealscope.campaigns.execution.run import run as carry_out
    from sealscope.campaigns.plans.model import SimulatedPlan
    from sealscope.campaigns.plans.reader import load_plan

    loaded_plan = load_plan(plan)
    target = _campaign_folder(loaded_plan, folder)
    if not isinstance(loaded_plan, SimulatedPlan):  # a plan over recordings, which are only judged
        if _write_report(loaded_plan, target, data):
            raise Exit(1)
        return
    opt.say_jobs(jobs)
    with _show_progress() as progress:
        state = carry_out(loaded_plan, target, jobs=jobs, cluster=cluster, retry=retry, progress=progress, trust=trust)
    echo(_format_progress(state))
    _write_report(loaded_plan, target, data)
    if state.failed:
        raise Exit(1)


@campaign.command()
def status(plan: PlanArgument, folder: FolderOption = None) -> None:
    """Print the progress of a campaign and the computing time left."""
    from sealscope.campaigns.execution.store import read_progress
    from sealscope.campaigns.plans.model import SimulatedPlan
    from sealscope.campaigns.plans.reader import load_plan

    loaded_plan = load_plan(plan)
    if isinstance(loaded_plan, SimulatedPlan):
        echo(_format_progress(read_progress(loaded_plan, _campaign_folder(loaded_plan, folder))))
    else:
        echo("a campaign over recordings simulates nothing: `campaign report` judges its records")


@campaign.command()
def report(plan: PlanArgument, folder: FolderOption = None, data: DataOption = None) -> None:
    """Judge the records of a plan that are done so far, and write the tables and the page."""
    from sealscope.campaigns.plans.reader import load_plan

    loaded_plan = load_plan(plan)
    _write_report(loaded_plan, _campaign_folder(loaded_plan, folder), data)


def _campaign_folder(plan: AnyPlan, stated: Path | None) -> Path:
    """Choose the folder of a campaign: `stated` or, if that is None, `sealscope-campaigns/NAME`.

    Raises InputError if this default is a symbolic link or in one, which could lead to a folder of someone else.
    """
    if stated is not None:
        return stated
    folder = Path("sealscope-campaigns") / plan.name
    for part in (folder.parent, folder):
        if part.is_symlink():
            raise InputError(f"the default folder must not be a link, got one ({part}); name a folder with --output")
    return folder


def _format_progress(state: CampaignProgress) -> str:
    """Format the numbers of records done and failed, the processor time of a record, and that of all remaining ones."""
    text = f"records: {state.done} of {state.records} done"
    if state.failed:
        text += f", {state.failed} of them failed"
    if state.seconds is not None:
        text += f"; {state.seconds:.2f} s of one core each"
        remaining_s = (state.records - state.done) * state.seconds
        if remaining_s:
            text += f", about {opt.format_duration(remaining_s)} of one core left"
    return text


@contextmanager
def _show_progress() -> Iterator[ProgressCallback]:
    """Show a campaign's progress on standard error; yield a function of the numbers of records (done, all, failed)."""
    with opt.counted_progress("records") as update:
        yield lambda done, total, failures: update(done, total, f"{failures} failed" if failures else "")


def _write_report(plan: AnyPlan, folder: Path, data: Path | None) -> int:
    """Judge a campaign, write its tables and its page, print its main table; return the number of failed records.

    `folder`: the campaign's folder, with the results of a simulated plan, into which the files are written; `data`:
    folder of the recordings, None for a simulated plan.
    """
    from sealscope.campaigns.plans.model import SimulatedPlan
    from sealscope.campaigns.results import judge_recorded_campaign, judge_simulated_campaign, write_result
    from sealscope.reporting.campaign.page import PAGE, campaign_text, write_campaign_page

    if isinstance(plan, SimulatedPlan):
        result = judge_simulated_campaign(plan, folder)
    elif data is None:
        raise InputError("the plan needs recordings: give their folder with --data")
    elif not data.is_dir():
        raise InputError(f"--data must be the folder of recordings, got {data}")
    elif data.resolve() == folder.resolve():  # a table might replace a recording, or be read as one
        raise InputError(f"--output must be another folder than --data, got {folder} for both")
    else:
        with _show_progress() as progress:
            result = judge_recorded_campaign(plan, data, progress)
    files = write_result(result, folder)
    write_campaign_page(result, folder / PAGE, [path.name for path in files])
    echo(campaign_text(result))
    for row in result.judgement.failed[:5]:
        opt.complain(f"record {row.id} failed: {row.error}")
    echo(f"tables: {folder}\npage:   {folder / PAGE}")
    return len(result.judgement.failed)
