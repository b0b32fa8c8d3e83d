"""Options that several commands share, and the progress line."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from sealscope.errors import InputError, SealscopeError

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.recordings.formats.columns import ChannelMap
    from sealscope.simulation.simulate import Progress


T = TypeVar("T")
#: Exit status where a verdict is one of those that `--fail-on` names.
FAILED_ON = 3
_log = logging.getLogger(__name__)


def complete_rigs(incomplete: str) -> list[str]:
    """Names of packaged rigs that begin so."""
    from sealscope.parameters import rig_names

    return [name for name in rig_names() if name.startswith(incomplete)]


def complete_overrides(incomplete: str) -> list[str]:
    """Names of parameters that begin so, whole or as a symbol that only one has, ready for a value."""
    from sealscope.parameters import declared_names

    names = declared_names()
    symbols = [name.rpartition(".")[2] for name in names]
    unique = [symbol for symbol in symbols if symbols.count(symbol) == 1]
    return [f"{name}=" for name in (*names, *unique) if name.startswith(incomplete)]


RigOption = Annotated[
    str, typer.Option("--rig", help="Rig by name, or the path of a rig's TOML file.", autocompletion=complete_rigs)
]
AssumeOption = Annotated[
    str | None,
    typer.Option(
        "--rig",
        metavar="NAME|FILE",
        help="What the detectors may assume of the machine: a rig by name, or a TOML file; by default the thesis's.",
        autocompletion=complete_rigs,
    ),
]
AreaOption = Annotated[
    list[str] | None,
    typer.Option(
        "--area",
        metavar="AREA[unit]",
        help="Area of the piston, e.g. '633 mm^2', which L/min rests on; twice for sides A and B.",
    ),
]
DisplacementOption = Annotated[
    str | None,
    typer.Option(
        "--displacement",
        metavar="VOLUME[unit]",
        help="Displacement of the pump, e.g. '4.9 cm^3/rev', which L/min rests on where no area is stated.",
    ),
]
LimitOption = Annotated[
    str | None,
    typer.Option(
        "--limit",
        metavar="LEAK[unit]",
        help="Leak from which the machine is to be repaired: a flow, '5 mL/min', or a speed of creep. "
        "[default: 8 mm/min]",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE[unit]", help="Override a parameter; repeat.", autocompletion=complete_overrides
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        metavar="CHANNEL=COLUMN",
        help="Take a channel from a foreign column, with its unit if neither the file nor the name has one: "
        "p_A=PG_1[psi], x=#4[mm], or from a formula of columns: 'p_A=ch2*0.0625-0.625 bar'; repeat. `auto`: what the "
        "columns' names tell, also beside others.",
    ),
]
RateOption = Annotated[float | None, typer.Option("--rate", help="Sampling rate [Hz] of files without a time column.")]
JoinOption = Annotated[
    bool, typer.Option("--join", help="The files are parts of a single run: join them by their clocks.")
]
BaselineOption = Annotated[
    list[Path] | None, typer.Option("--baseline", metavar="FILE...", help="Leak-free recordings of the same machine.")
]
MachineOption = Annotated[
    Path | None,
    typer.Option(
        "--machine",
        metavar="FILE",
        help="The machine's file, by `sealscope commission`: map, rig, limit and healthy recordings are its.",
    ),
]
FalseAlarmOption = Annotated[
    float, typer.Option("--false-alarm", help="Probability of `leak` on a leak-free recording.")
]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of the instruments' noise.")]


JobsOption = Annotated[
    int | None, typer.Option("--jobs", "-j", help="Processes; by default one a core, two a core at most.")
]


def say_jobs(jobs: int | None) -> None:
    """Say so on standard error where fewer processes are started than `--jobs` asks for."""
    from sealscope.campaigns.execution.workers import process_count

    if jobs is not None and jobs > (most := process_count(jobs)):
        complain(f"--jobs {jobs}: {most} processes are started, two a core")


@contextmanager
def progress() -> Iterator[Progress]:
    """Return a progress line on standard error, gone when done; silent where nobody looks."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:  # a disabled bar prints an empty line in some versions of the library
        yield lambda task, share: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def update(task: str, share: float) -> None:
            if task not in tasks:
                tasks[task] = bar.add_task(task, total=1.0)
            bar.update(tasks[task], completed=share)

        yield update


def assumed_rig(name: str | None, area: Sequence[str] | None = None, displacement: str | None = None) -> Rig | None:
    """Return the rig of `--rig` that detectors may assume, with what `--area` and `--displacement` state.

    None where none of them is given.
    """
    from sealscope.diagnosis.verdict.machine import unstated
    from sealscope.parameters import load_rig
    from sealscope.units import parse_quantity

    rig = None if name is None else load_rig(name)
    stated: dict[str, float] = {}
    if area:
        if len(area) > 2:
            raise InputError(f"--area must be given once, or twice for sides A and B, got {len(area)} times")
        sides = [parse_quantity(text, "m^2", name="--area") for text in area]
        stated |= {"cylinder.A_A": sides[0], "cylinder.A_B": sides[-1]}
    if displacement is not None:
        stated["pump.q_b"] = parse_quantity(displacement, "m^3/rev", name="--displacement")
    if not stated:
        return rig
    return (rig or unstated()).with_overrides(stated, source="set by the call (--area, --displacement)")


def refuse_beside_machine(*options: object) -> None:
    """Raise InputError where what a machine's file states is stated by the call, too.

    `options`: those of --baseline, --map, --rate, --rig, --area, --displacement and --limit.
    """
    names = ("--baseline", "--map", "--rate", "--rig", "--area", "--displacement", "--limit")
    for name, value in zip(names, options, strict=True):
        if value:
            raise InputError(f"{name} must not stand beside --machine, whose file states it")


def rig_with(name: str, overrides: Sequence[str] | None) -> Rig:
    """Return the rig of that name or file with the values of `--set`."""
    from sealscope.parameters import load_rig, parse_overrides

    rig = load_rig(name)
    return rig.with_overrides(parse_overrides(overrides), source="set by --set") if overrides else rig


def channel_map_of(options: Sequence[str] | None) -> ChannelMap:
    """Channel -> column of the `--map` options, the rest by names with `auto`; InputError for a channel given twice."""
    from sealscope.recordings import split_map_option
    from sealscope.recordings.formats.columns import REST

    columns: dict[str, str] = {}
    for option in options or ():
        if option == "auto":
            columns[REST] = option
            continue
        channel, column = split_map_option(option)
        if channel in columns:
            raise InputError(f"--map {channel} must be given once, got {columns[channel]} and {column}")
        columns[channel] = column
    return "auto" if set(columns) == {REST} else columns


def printable(text: str, kept: str = "") -> str:
    """Return a text without what a terminal would obey, whatever a file's name or header brought; `kept` stays."""
    return "".join(c if c.isprintable() or c in kept else "\N{REPLACEMENT CHARACTER}" for c in text)


def say(text: str) -> None:
    """Print lines on standard output."""
    typer.echo(printable(text, "\n"))


def complain(message: object) -> None:
    """Print one line on standard error."""
    typer.echo(f"sealscope: {printable(str(message))}", err=True)


def attempt(file: Path, work: Callable[[], T]) -> T | None:
    """Return `work()`; None, with one line on standard error, where it fails with this file: the others go on."""
    try:
        return work()
    except SealscopeError as error:
        complain(error if str(file) in str(error) else f"{error} ({file})")
    except MemoryError:
        complain(f"too little memory ({file})")
    except Exception as error:  # a defect of the program; the other files have their results yet
        _log.debug("cannot handle %s", file, exc_info=True)
        complain(f"cannot handle {file}, got {type(error).__name__}: {error} (-v says where)")
    return None


def check_folder(file: Path) -> None:
    """Refuse a file whose folder is not there before the long work, not after it; remove what a killed call left."""
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")
    from sealscope.storage.atomic import remove_temporaries

    remove_temporaries(file.parent, file.name)
