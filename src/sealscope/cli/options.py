"""Options that several commands share, and the functions that build, print and write for them."""

from __future__ import annotations

import inspect
import logging
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import partial, wraps
from inspect import Parameter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from typer import Argument, Context, Option, echo

from sealscope.errors import InputError, SealscopeError, UnreadableFile, printable
from sealscope.paragraphs import paragraph
from sealscope.simulation.arguments import Arguments

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.parameters import Rig
    from sealscope.recordings import Recording
    from sealscope.recordings.formats.columns import ChannelMap
    from sealscope.simulation.experiment import Experiment

T = TypeVar("T")
#: Exit status if a verdict is among those of `--fail-on`.
FAILED_ON = 3
#: Name of standard input in place of a file.
STANDARD_INPUT = Path("-")
#: Help text of each argument of `Experiment.of`.
_ARGUMENT_TEXTS: dict[str, str] = {argument.name: argument.metadata["text"] for argument in fields(Arguments)}
_log = logging.getLogger(__name__)


def make_completion(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Build a function that completes a partly typed name for the shell; `names`: function that returns all names."""

    def complete(incomplete: str) -> list[str]:
        """List the names that begin with the typed text; typer requires the name `incomplete`."""
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def _rig_names() -> Sequence[str]:
    """List the names of the packaged rigs."""
    from sealscope.parameters import rig_names

    return rig_names()


def _override_names() -> list[str]:
    """List each parameter's dotted name, and its symbol if that is unique, with "=" appended, for completion."""
    from sealscope.parameters import declared_names

    names = declared_names()
    symbols = [name.rpartition(".")[2] for name in names]
    unique_symbols = [symbol for symbol in symbols if symbols.count(symbol) == 1]
    return [f"{name}=" for name in (*names, *unique_symbols)]


complete_rigs = make_completion(_rig_names)


def declared_option(name: str, *, option: str = "", several: bool = False, **settings: Any) -> Any:
    """Build the command-line option for an argument of `Experiment.of`, with the help text declared in `Arguments`.

    `option`: flag, by default from `name`; `several`: True if repeatable; `settings`: arguments of `typer.Option`.
    """
    text = _ARGUMENT_TEXTS[name] + (" Repeat for several." if several else "")
    return Option(option or f"--{name.replace('_', '-')}", help=text, **settings)


RigOption = Annotated[str, declared_option("rig", autocompletion=complete_rigs)]
RigArgument = Annotated[str, Argument(help=_ARGUMENT_TEXTS["rig"], autocompletion=complete_rigs)]
_ASSUMED = "What is assumed of the machine: a rig by name, or a TOML file; by default the thesis's."
AssumeOption = Annotated[str | None, Option("--rig", metavar="NAME|FILE", help=_ASSUMED, autocompletion=complete_rigs)]
_AREA = "Area of the piston, '633 mm^2', from which L/min is computed; twice for sides A and B."
AreaOption = Annotated[list[str] | None, Option("--area", metavar="AREA[unit]", help=_AREA)]
_DISPLACEMENT = "Displacement of the pump, '4.9 cm^3/rev', from which L/min is computed if no area is stated."
DisplacementOption = Annotated[str | None, Option("--displacement", metavar="VOLUME[unit]", help=_DISPLACEMENT)]
_LIMIT = "Leak to be repaired: a flow, '5 mL/min', or a speed of creep. [default: 8 mm/min]"
LimitOption = Annotated[str | None, Option("--limit", metavar="LEAK[unit]", help=_LIMIT)]
SetOption = Annotated[
    list[str] | None,
    declared_option("set", several=True, metavar="NAME=VALUE[unit]", autocompletion=make_completion(_override_names)),
]
_MAP = (
    "Take a channel from a column, with its unit if neither the file nor the name has one: p_A=PG_1[psi], x=#4[mm], or "
    "from a formula of columns: 'p_A=ch2*0.0625-0.625 bar'; repeat. `auto`: by the columns' names, also beside others."
)
MapOption = Annotated[list[str] | None, Option("--map", metavar="CHANNEL=COLUMN", help=_MAP)]
_GROUP = "Which of several actuators of the file to read, by its words in the headings: boom, 'cylinder 2', left."
GroupOption = Annotated[str | None, Option("--group", metavar="WORDS", help=_GROUP)]
RateOption = Annotated[float | None, Option("--rate", help="Sampling rate [Hz] of files without a time column.")]
JoinOption = Annotated[bool, Option("--join", help="The files are parts of a single run: join them by their clocks.")]
_BASELINE = "Leak-free recordings of the same machine."
BaselineOption = Annotated[list[Path] | None, Option("--baseline", metavar="FILE...", help=_BASELINE)]
_MACHINE = (
    "The machine's file, by `sealscope commission`; it states map, rig, limit and healthy recordings. --map adds to it."
)
MachineOption = Annotated[Path | None, Option("--machine", metavar="FILE", help=_MACHINE)]
#: Default of `--false-alarm`, equal to `FALSE_ALARM_PROBABILITY` of `diagnose`, whose import would slow down the help.
FALSE_ALARM_PROBABILITY = 0.01
FalseAlarmOption = Annotated[float, Option("--false-alarm", help="Probability of `leak` on a leak-free recording.")]
SeedOption = Annotated[int, declared_option("seed")]
_JOBS = "Processes; by default one a core, two a core at most."
JobsOption = Annotated[int | None, Option("--jobs", "-j", help=_JOBS)]
_FAIL_ON = "End with status 3 on this verdict; repeat."
Verdict = StrEnum("Verdict", {"leak": "leak", "no_leak": "no leak", "cannot_tell": "cannot tell"})
FailOnOption = Annotated[list[Verdict] | None, Option("--fail-on", metavar="VERDICT", help=_FAIL_ON)]
_SHEET = "Folder with the thesis's data sheet (appendix_c_pa.csv, appendix_c_pb.csv); else $SEALSCOPE_SHEET or ./data."
SheetOption = Annotated[Path | None, Option("--sheet", help=_SHEET)]


@dataclass(frozen=True)
class StatedMachine:
    """The machine that the options of a call describe, and the way to read its files.

    - `commissioned`: the machine of the option `--machine`, which determines everything else; `channel_map` adds to its
      own
    - `channel_map`, `rate`: columns of the channels and sampling rate [Hz] for reading files
    - `rig`: known or assumed parameters of the machine
    - `limit`: leak from which the machine must be repaired, as text such as "5 mL/min"
    - `baseline`: leak-free recordings of the machine
    """

    commissioned: CommissionedMachine | None = None
    channel_map: ChannelMap = field(default_factory=dict)
    rate: float | None = None
    rig: Rig | None = None
    limit: str | None = None
    baseline: tuple[Path, ...] = ()

    @classmethod
    def from_options(
        cls,
        machine: MachineOption = None,
        maps: MapOption = None,
        group: GroupOption = None,
        rate: RateOption = None,
        rig: AssumeOption = None,
        area: AreaOption = None,
        displacement: DisplacementOption = None,
        limit: LimitOption = None,
        baseline: BaselineOption = None,
    ) -> StatedMachine:
        """Build the machine from the values of a command's options, which the types of the parameters declare.

        Raises InputError for an invalid option, and for another option than `maps` together with `machine`: maps add to
        that in the machine's file.
        """
        from sealscope.diagnosis.verdict.machine_sizes import build_stated_rig
        from sealscope.diagnosis.verdict.severity import RepairLimit
        from sealscope.recordings.formats.columns import check_request

        if machine is not None:
            from sealscope.diagnosis.commissioned.machine_file import read_machine

            options: dict[str, object] = {"--baseline": baseline, "--rate": rate, "--rig": rig}
            options |= {"--area": area, "--displacement": displacement, "--limit": limit}
            for name, value in options.items():
                if value is not None and value != []:  # []: a repeatable option that the call does not have
                    raise InputError(f"{name} cannot be combined with --machine, whose file states it")
            known_machine = read_machine(machine)
            added_map = parse_channel_map(maps, group)
            check_request(added_map, None)
            return cls(known_machine, added_map, rig=known_machine.rig, limit=known_machine.limit)
        stated_machine = cls(
            rig=build_stated_rig(rig, area, displacement), channel_map=parse_channel_map(maps, group), rate=rate,
            limit=limit, baseline=tuple(baseline or ()),
        )  # fmt: skip
        check_request(stated_machine.channel_map, rate)
        check_request(stated_machine._rig_map, rate)
        RepairLimit.parse(limit)  # raises if invalid
        return stated_machine

    @property
    def _rig_map(self) -> ChannelMap:
        """Channel map in the rig's file; empty without a rig or if `--map` is used, which replaces it."""
        from sealscope.recordings.formats.columns import GROUP

        has_own_map = isinstance(self.channel_map, str) or self.channel_map.keys() - {GROUP}
        return {} if self.rig is None or has_own_map else self.rig.channel_map

    @property
    def has_map(self) -> bool:
        """True if the options of the call, or the file of the rig, state the columns of channels."""
        return bool(self.channel_map or self._rig_map)

    def read(self, file: Path) -> Recording:
        """Read the recording in a file, or on standard input for the file `-`.

        With --machine, folders have been replaced by their files; without it, a folder raises UnreadableFile.
        """
        if self.commissioned is None and file.is_dir():
            remedy = "name its files, or state its machine by --machine"
            raise UnreadableFile(f"a recording must be a file, got a folder: {remedy} ({file})")
        if file != STANDARD_INPUT:
            return self._read(file)
        with TemporaryDirectory() as folder:  # readers need a file
            path = Path(folder) / "standard input"
            with path.open("wb") as copy:
                shutil.copyfileobj(sys.stdin.buffer, copy)
            try:
                return self._read(path)
            except UnreadableFile as error:
                raise UnreadableFile(str(error).replace(str(path), path.name)) from error

    def _read(self, file: Path) -> Recording:
        """Read the recording in a file by the channel map of the machine, of the call or, if it fits, of the rig."""
        if self.commissioned is not None:
            return self.commissioned.read(file, map=self.channel_map or None)
        if not self._rig_map:
            from sealscope.recordings import read

            return read(file, map=self.channel_map or None, rate=self.rate)
        from sealscope.diagnosis.commissioned.machine import read_by_map

        return read_by_map(file, self._rig_map, self.rate, self.channel_map)

    def read_all(self, files: Sequence[Path], *, joined: bool = False) -> Iterator[tuple[Path, Recording | None]]:
        """Yield each file with its recording, or with None after a message on standard error if it is unreadable.

        `joined`: the files are parts of a single recording, so only the first is yielded, with the joined recording or,
        if a part is unreadable, None.
        """
        recordings = ((file, attempt(file, partial(self.read, file))) for file in files)
        if not joined:
            yield from recordings
            return
        from sealscope.recordings import join

        parts = [recording for _, recording in recordings if recording is not None]
        is_complete = len(parts) == len(files)  # no part is unreadable
        yield files[0], join(parts, names=[file.name for file in files]) if is_complete else None

    def diagnose(self, recording: Recording, baseline: Sequence[Recording], file: Path, **settings: Any) -> Diagnosis:
        """Diagnose a recording, compared with the healthy recordings in the machine's file or, without one, `baseline`.

        `file`: name in the diagnosis; `settings`: more arguments of `diagnose`.
        """
        from sealscope.diagnosis.diagnose import diagnose

        if self.commissioned is not None:
            return replace(self.commissioned.diagnose(recording, **settings), file=str(file))
        return diagnose(recording, baseline, rig=self.rig, limit=self.limit, file=file, **settings)


def with_machine_options(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Build a decorator that replaces the parameter `stated` of a command, a `StatedMachine`, by options of a machine.

    `names`: the options, as names of parameters of `StatedMachine.from_options`; by default all.
    """
    options = inspect.signature(StatedMachine.from_options, eval_str=True).parameters
    return _replace_parameter("stated", StatedMachine.from_options, [options[name] for name in names or options])


def with_experiment_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter `experiment` of a command by an option for each argument of `Experiment.of`."""
    special_options = {  # those with completion, with a flag of another name, or repeatable
        "rig": RigOption,
        "set": SetOption,
        "x_0": Annotated[str, declared_option("x_0", option="--start-position")],
        "leak": Annotated[list[str] | None, declared_option("leak", several=True)],
        "fault": Annotated[list[str] | None, declared_option("fault", several=True)],
    }
    options = []
    for argument in fields(Arguments):
        if argument.name == "drifts":  # cannot be written as text
            continue
        # a number may be given with a unit, so its option is a text
        default = f"{argument.default:g}" if isinstance(argument.default, float) else argument.default
        kind = str | None if default is None else type(default)
        annotation = special_options.get(argument.name, Annotated[kind, declared_option(argument.name)])
        options.append(Parameter(argument.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation))
    return _replace_parameter("experiment", _build_experiment, options)(command)


def _build_experiment(rig: str, set: Sequence[str] | None, **arguments: Any) -> Experiment:
    """Build an experiment from a call's options: `rig`, changed by `set`, and other `arguments` of `Experiment.of`."""
    from sealscope.simulation.experiment import Experiment

    return Experiment.of(rig=load_rig_with(rig, set), **arguments)


def _replace_parameter(
    name: str, make: Callable[..., Any], options: Sequence[Parameter]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Build a decorator that replaces the parameter `name` of a command by options.

    `make`: function that builds the parameter's value from the values of the options, its keyword arguments.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        """Wrap the command with a signature that has the options in place of the parameter."""
        command.__annotations__[name] = Any  # its type may be imported for type checking only
        signature = inspect.signature(command, eval_str=True)

        @wraps(command)
        def call(**arguments: Any) -> None:
            """Build the parameter's value from the options, and call the command with it."""
            value = make(**{option.name: arguments.pop(option.name) for option in options})
            command(**{name: value}, **arguments)

        parameters = list(signature.parameters.values())
        index = list(signature.parameters).index(name)
        parameters[index : index + 1] = options
        # keyword-only: a required option may then follow one with a default
        keyword_only = [parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in parameters]
        call.__signature__ = signature.replace(parameters=keyword_only)  # type: ignore[attr-defined]
        return call

    return decorate


def load_rig_with(name: str, overrides: Sequence[str] | None) -> Rig:
    """Load a rig by its name or file, changed by `overrides`, the options `--set NAME=VALUE[unit]`."""
    from sealscope.parameters import load_rig, parse_overrides

    rig = load_rig(name)
    return rig.with_overrides(parse_overrides(overrides), source="set by --set") if overrides else rig


def parse_channel_map(options: Sequence[str] | None, group: str | None = None) -> ChannelMap:
    """Parse the `--map` options and `--group` to a channel map, which states the column of each channel.

    An option is `CHANNEL=COLUMN`, such as `p_A=PG_1[psi]`, or `auto`, to find other channels by their columns' names.
    `auto` alone gives "auto". Raises InputError for another form, or for a channel that is unknown or given twice.
    """
    from sealscope.recordings import split_map_option
    from sealscope.recordings.formats.columns import GROUP, REST

    columns: dict[str, str] = {}
    for option in options or ():
        channel, column = (REST, option) if option == "auto" else split_map_option(option)
        if channel in columns and channel != REST:
            raise InputError(f"--map {channel} must be given once, got {columns[channel]} and {column}")
        columns[channel] = column
    if group is not None:
        columns[GROUP] = group
    return "auto" if set(columns) == {REST} else columns


def is_verbose(context: Context) -> bool:
    """Return True if the call has the option `-v`."""
    return bool(context.find_root().params.get("verbose"))


def say(text: str) -> None:
    """Print lines on standard output, with control characters replaced."""
    echo(printable(text, "\n"))


def say_wrapped(text: str, head: str = "") -> None:
    """Print `head` and a paragraph on standard output, wrapped at 80 columns, with later lines indented."""
    say(paragraph(text, head, indent=len(head) or 2))


def complain(message: object) -> None:
    """Print an error or a warning as one line on standard error."""
    echo(f"sealscope: {printable(str(message))}", err=True)


def attempt(file: Path, work: Callable[[], T]) -> T | None:
    """Return the result of `work`; if it fails, print a message about `file` on standard error and return None."""
    try:
        return work()
    except SealscopeError as error:
        complain(error if str(file) in str(error) else f"{error} ({file})")
    except MemoryError:
        complain(f"too little memory ({file})")
    except Exception as error:  # a defect of the program must not prevent the results of other files
        _log.debug("cannot handle %s", file, exc_info=True)
        complain(f"cannot handle {file}, got {type(error).__name__}: {error} (-v says where)")
    return None


def check_folder(file: Path) -> None:
    """Check that the folder of the file to write exists; also remove temporary files that interrupted calls left."""
    from sealscope.storage import atomic

    atomic.check_folder(file)
    atomic.remove_temporaries(file.parent, file.name)


def write_text(file: Path, text: str) -> None:
    """Write a text file atomically: whole or not at all."""
    from sealscope.storage.atomic import atomic_write

    with atomic_write(file) as temporary:
        # the name of a file in the text may contain bytes that are no UTF-8
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


def say_jobs(jobs: int | None) -> None:
    """Warn on standard error if fewer processes will be started than the option `--jobs` requests."""
    from sealscope.campaigns.execution.workers import process_count

    if jobs is not None and jobs > (n_processes := process_count(jobs)):
        complain(f"--jobs {jobs}: {n_processes} processes are started, two a core")


@contextmanager
def progress(noun: str = "") -> Iterator[Callable[[str, float], None]]:
    """Show progress bars on standard error within the `with` block; yield a function of (task, fraction done).

    Each task, a text, has a bar; if `noun`, the name of counted things, is given, all tasks share one. If standard
    error is not a terminal, there are no bars; with a `noun` a line is printed once a minute instead.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:  # a disabled bar may print an empty line
        yield _minute_reporter() if noun else lambda *_: None
        return
    columns = (BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True, speed_estimate_period=120) as bar:
        tasks: dict[str, Any] = {}

        def update(task: str, fraction: float) -> None:
            """Show the completed fraction (0 to 1) of a task in its progress bar."""
            key = noun or task  # with a `noun` all tasks share one bar
            if key not in tasks:
                tasks[key] = bar.add_task(task, total=1.0)
            bar.update(tasks[key], completed=fraction, description=task)

        yield update


def _minute_reporter() -> Callable[[str, float], None]:
    """Build a function of (task, fraction done) that prints the task and the time left, at most once a minute."""
    start = last_print = time.monotonic()
    start_fraction: float | None = None

    def update(task: str, fraction: float) -> None:
        """Print the task and the time left, estimated from the fraction done, at most once a minute."""
        nonlocal last_print, start_fraction
        now = time.monotonic()
        if start_fraction is None:  # an earlier call may have done this fraction: it took none of the time
            start_fraction = fraction
        if now - last_print >= 60.0 and fraction > start_fraction:
            last_print = now
            seconds_per_fraction = (now - start) / (fraction - start_fraction)
            remaining_s = seconds_per_fraction * (1.0 - fraction)
            echo(f"{task}, about {format_duration(remaining_s)} left", err=True)

    return update


@contextmanager
def counted_progress(noun: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show the number of things done and the time left, on standard error; yield a function of (done, total, note).

    `noun`: name of the things, in the plural; `note`: further text to show, "" for none.
    """
    with progress(noun) as show:

        def update(done: int, total: int, note: str) -> None:
            """Show that `done` of `total` things are done."""
            suffix = f", {note}" if note else ""
            show(f"{done} of {total} {noun}{suffix}", done / max(total, 1))

        yield update


def format_duration(seconds: float) -> str:
    """Format a duration [s]: in hours above 90 minutes, in minutes above 90 seconds, else in seconds."""
    if seconds > 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
