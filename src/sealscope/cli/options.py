"""Options that several commands share, and what commands do alike."""

from __future__ import annotations

import inspect
import logging
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
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
#: Exit status where a verdict is one of those that `--fail-on` names.
FAILED_ON = 3
#: Stands for standard input.
STANDARD_INPUT = Path("-")
_log = logging.getLogger(__name__)


def completing(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Return a shell's completion from these names."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return complete


def _rig_names() -> Sequence[str]:
    from sealscope.parameters import rig_names

    return rig_names()


def _overrides() -> list[str]:
    """Return names of parameters, whole or as a symbol that only one has, ready for a value."""
    from sealscope.parameters import declared_names

    names = declared_names()
    symbols = [name.rpartition(".")[2] for name in names]
    return [f"{name}=" for name in (*names, *(symbol for symbol in symbols if symbols.count(symbol) == 1))]


complete_rigs = completing(_rig_names)


def declared(name: str, *, option: str = "", several: bool = False, **shown: Any) -> Any:
    """Return the option for an argument of `Experiment.of`, with the text that is declared there."""
    text = _text_of(name) + (" Repeat for several." if several else "")
    return Option(option or f"--{name.replace('_', '-')}", help=text, **shown)


def _text_of(name: str) -> str:
    return str(Arguments.__dataclass_fields__[name].metadata["text"])


RigOption = Annotated[str, declared("rig", autocompletion=complete_rigs)]
RigArgument = Annotated[str, Argument(help=_text_of("rig"), autocompletion=complete_rigs)]
AssumeOption = Annotated[
    str | None,
    Option(
        "--rig",
        metavar="NAME|FILE",
        help="What is assumed of the machine: a rig by name, or a TOML file; by default the thesis's.",
        autocompletion=complete_rigs,
    ),
]
_AREA = "Area of the piston, '633 mm^2', which L/min rests on; twice for sides A and B."
AreaOption = Annotated[list[str] | None, Option("--area", metavar="AREA[unit]", help=_AREA)]
_DISPLACEMENT = "Displacement of the pump, '4.9 cm^3/rev', which L/min rests on where no area is stated."
DisplacementOption = Annotated[str | None, Option("--displacement", metavar="VOLUME[unit]", help=_DISPLACEMENT)]
_LIMIT = "Leak to be repaired: a flow, '5 mL/min', or a speed of creep. [default: 8 mm/min]"
LimitOption = Annotated[str | None, Option("--limit", metavar="LEAK[unit]", help=_LIMIT)]
SetOption = Annotated[
    list[str] | None,
    declared("set", several=True, metavar="NAME=VALUE[unit]", autocompletion=completing(_overrides)),
]
MapOption = Annotated[
    list[str] | None,
    Option(
        "--map",
        metavar="CHANNEL=COLUMN",
        help="Take a channel from a column, with its unit if neither the file nor the name has one: p_A=PG_1[psi], "
        "x=#4[mm], or from a formula of columns: 'p_A=ch2*0.0625-0.625 bar'; repeat. `auto`: by the columns' names, "
        "also beside others.",
    ),
]
RateOption = Annotated[float | None, Option("--rate", help="Sampling rate [Hz] of files without a time column.")]
JoinOption = Annotated[bool, Option("--join", help="The files are parts of a single run: join them by their clocks.")]
_BASELINE = "Leak-free recordings of the same machine."
BaselineOption = Annotated[list[Path] | None, Option("--baseline", metavar="FILE...", help=_BASELINE)]
_MACHINE = "The machine's file, by `sealscope commission`; it states map, rig, limit and healthy recordings."
MachineOption = Annotated[Path | None, Option("--machine", metavar="FILE", help=_MACHINE)]
FalseAlarmOption = Annotated[float, Option("--false-alarm", help="Probability of `leak` on a leak-free recording.")]
SeedOption = Annotated[int, declared("seed")]
_JOBS = "Processes; by default one a core, two a core at most."
JobsOption = Annotated[int | None, Option("--jobs", "-j", help=_JOBS)]
_FAIL_ON = "End with status 3 on this verdict; repeat."
Verdict = StrEnum("Verdict", {"leak": "leak", "no_leak": "no leak", "cannot_tell": "cannot tell"})
FailOnOption = Annotated[list[Verdict] | None, Option("--fail-on", metavar="VERDICT", help=_FAIL_ON)]
_SHEET = "Folder with the thesis's data sheet (appendix_c_pa.csv, appendix_c_pb.csv); else $SEALSCOPE_SHEET or ./data."
SheetOption = Annotated[Path | None, Option("--sheet", help=_SHEET)]


@dataclass(frozen=True)
class StatedMachine:
    """The machine as a call states it: its file (`known`), or how to read its files, its rig, limit and baseline."""

    known: CommissionedMachine | None = None
    channel_map: ChannelMap = field(default_factory=dict)
    rate: float | None = None
    rig: Rig | None = None
    limit: str | None = None
    baseline: tuple[Path, ...] = ()

    @classmethod
    def of(
        cls,
        machine: MachineOption = None,
        maps: MapOption = None,
        rate: RateOption = None,
        rig: AssumeOption = None,
        area: AreaOption = None,
        displacement: DisplacementOption = None,
        limit: LimitOption = None,
        baseline: BaselineOption = None,
    ) -> StatedMachine:
        """Read the stated machine from the options. Raise InputError for a wrong option, or one next to `--machine`."""
        from sealscope.diagnosis.verdict.severity import RepairLimit
        from sealscope.recordings.formats.columns import check_call

        if machine is not None:
            from sealscope.diagnosis.commissioned.machine_file import read_machine

            options = {"--baseline": baseline, "--map": maps, "--rate": rate, "--rig": rig}
            options |= {"--area": area, "--displacement": displacement, "--limit": limit}
            for name, value in options.items():
                if value:
                    raise InputError(f"{name} must not stand beside --machine, whose file states it")
            known = read_machine(machine)
            return cls(known, rig=known.rig, limit=known.limit)
        own_rig = _assumed_rig(rig, area, displacement)
        stated = cls(None, channel_map_of(maps), rate, own_rig, limit, tuple(baseline or ()))
        check_call(stated.channel_map, rate)
        check_call(stated._map_of_rig, rate)
        RepairLimit.of(limit)
        return stated

    @property
    def _map_of_rig(self) -> ChannelMap:
        """The map that the rig's file keeps; a `--map` stands in its place."""
        return {} if self.rig is None or self.channel_map else self.rig.channel_map

    @property
    def maps(self) -> bool:
        """Test whether the call or its rig states a map."""
        return bool(self.channel_map or self._map_of_rig)

    def read(self, file: Path) -> Recording:
        """Read a file, standard input for `-`; the rig's map is for files that have its columns."""
        if self.known is not None:
            return self.known.read(file)
        if file.is_dir():
            ways = "name its files, or state its machine by --machine"
            raise UnreadableFile(f"a recording must be a file, got a folder: {ways} ({file})")
        if file != STANDARD_INPUT:
            return self._read(file)
        with TemporaryDirectory() as folder:
            copied = Path(folder) / "standard input"
            with copied.open("wb") as copy:
                shutil.copyfileobj(sys.stdin.buffer, copy)
            try:
                return self._read(copied)
            except UnreadableFile as error:
                raise UnreadableFile(str(error).replace(str(copied), copied.name)) from error

    def _read(self, file: Path) -> Recording:
        if not self._map_of_rig:
            from sealscope.recordings import read

            return read(file, map=self.channel_map or None, rate=self.rate)
        from sealscope.diagnosis.commissioned.machine import read_of_machine

        return read_of_machine(file, self._map_of_rig, self.rate)

    def read_all(self, files: Sequence[Path], joined: bool = False) -> Iterator[tuple[Path, Recording | None]]:
        """Yield each file and its recording, or None and a line on standard error if it is unreadable.

        `joined`: the first file and the recording of all files joined instead, None where one is bad.
        """
        recordings = ((file, attempt(file, partial(self.read, file))) for file in files)
        if not joined:
            yield from recordings
            return
        from sealscope.recordings import join

        parts = [recording for _, recording in recordings]
        whole = [part for part in parts if part is not None]
        yield files[0], join(whole, names=[file.name for file in files]) if len(whole) == len(files) else None

    def diagnose(
        self, recording: Recording, baseline: Sequence[Recording], file: Path, false_alarm: float
    ) -> Diagnosis:
        """Diagnose a recording of this machine."""
        from dataclasses import replace

        from sealscope.diagnosis.diagnose import diagnose

        if self.known is not None:
            diagnosis = self.known.diagnose(recording, false_alarm_probability=false_alarm)
            return replace(diagnosis, file=str(file))
        stated: dict[str, Any] = {"rig": self.rig, "limit": self.limit, "file": file}
        return diagnose(recording, baseline, false_alarm_probability=false_alarm, **stated)


def stating(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of `StatedMachine.of`, or those of these names, in place of its parameter `stated`."""
    every = inspect.signature(StatedMachine.of, eval_str=True).parameters
    return _replace_parameter("stated", StatedMachine.of, [every[name] for name in names or every])


def simulating(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command an option for each argument of `Experiment.of` in place of its parameter `experiment`."""
    known = {"rig": RigOption, "set": SetOption, "x_0": Annotated[str, declared("x_0", option="--start-position")]}
    known |= {name: Annotated[list[str] | None, declared(name, several=True)] for name in ("leak", "fault")}
    options = []
    for argument in fields(Arguments):
        if argument.name == "drifts":  # no text says what drifts
            continue
        default = f"{argument.default:g}" if isinstance(argument.default, float) else argument.default
        kind = str | None if default is None else type(default)
        annotation = known.get(argument.name, Annotated[kind, declared(argument.name)])
        options.append(Parameter(argument.name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation))
    return _replace_parameter("experiment", _experiment, options)(command)


def _experiment(rig: str, set: Sequence[str] | None, **arguments: Any) -> Experiment:
    from sealscope.simulation.experiment import Experiment

    return Experiment.of(rig=rig_with(rig, set), **arguments)


def _replace_parameter(
    name: str, make: Callable[..., Any], options: Sequence[Parameter]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace a command's parameter `name` by options, from which `make` builds its value."""

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        command.__annotations__[name] = Any  # the type may not be loaded yet
        signature = inspect.signature(command, eval_str=True)

        @wraps(command)
        def call(**arguments: Any) -> None:
            value = make(**{option.name: arguments.pop(option.name) for option in options})
            command(**{name: value}, **arguments)

        parameters = list(signature.parameters.values())
        place = list(signature.parameters).index(name)
        parameters[place : place + 1] = options
        by_name = [parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in parameters]
        call.__signature__ = signature.replace(parameters=by_name)  # type: ignore[attr-defined]
        return call

    return decorated


def _assumed_rig(name: str | None, area: Sequence[str] | None, displacement: str | None) -> Rig | None:
    """Return the rig of `--rig` with the values of `--area` and `--displacement`, None without these options."""
    from sealscope.diagnosis.verdict.machine import unstated
    from sealscope.parameters import load_rig
    from sealscope.units import parse_quantity

    rig = None if name is None else load_rig(name)
    source, stated = "set by the call (--area, --displacement)", dict[str, float]()
    if area:
        if len(area) > 2:
            raise InputError(f"--area must be given once, or twice for sides A and B, got {len(area)} times")
        sides = [parse_quantity(text, "m^2", name="--area") for text in area]
        rig = (rig or unstated()).with_areas(sides[0], sides[-1], source=source)
    if displacement is not None:
        stated["pump.q_b"] = parse_quantity(displacement, "m^3/rev", name="--displacement")
    return rig if not stated else (rig or unstated()).with_overrides(stated, source=source)


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
        channel, column = (REST, option) if option == "auto" else split_map_option(option)
        if channel in columns and channel != REST:
            raise InputError(f"--map {channel} must be given once, got {columns[channel]} and {column}")
        columns[channel] = column
    return "auto" if set(columns) == {REST} else columns


def verbose(context: Context) -> bool:
    """Test whether the call has `-v`."""
    return bool(context.find_root().params.get("verbose"))


def say(text: str) -> None:
    """Print lines on standard output."""
    echo(printable(text, "\n"))


def say_wrapped(text: str, head: str = "") -> None:
    """Print a paragraph on standard output, beside `head`; its lines are as wide as words allow, 80 columns."""
    say(paragraph(text, head, len(head) or 2))


def complain(message: object) -> None:
    """Print one line on standard error."""
    echo(f"sealscope: {printable(str(message))}", err=True)


def attempt(file: Path, work: Callable[[], T]) -> T | None:
    """Return `work()`, or None and one line on standard error if it fails with this file."""
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
    """Refuse a file in a missing folder before the long work, and remove the remains of a killed call."""
    from sealscope.storage import atomic

    atomic.check_folder(file)
    atomic.remove_temporaries(file.parent, file.name)


def write_text(file: Path, text: str) -> None:
    """Write a text whole or not at all."""
    from sealscope.storage.atomic import atomic_write

    with atomic_write(file) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")  # a file's name


def say_jobs(jobs: int | None) -> None:
    """Complain on standard error if fewer processes start than `--jobs` asks for."""
    from sealscope.campaigns.execution.workers import process_count

    if jobs is not None and jobs > (most := process_count(jobs)):
        complain(f"--jobs {jobs}: {most} processes are started, two a core")


@contextmanager
def progress(noun: str = "") -> Iterator[Callable[[str, float], None]]:
    """Show tasks and their shares on standard error, in lines that disappear at the end.

    Without a terminal nothing is shown; of many things, `noun`, a line a minute for the log.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:  # a disabled bar may print an empty line
        yield _each_minute() if noun else lambda *_: None
        return
    columns = (BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True, speed_estimate_period=120) as bar:
        tasks: dict[str, Any] = {}

        def update(task: str, share: float) -> None:
            key = noun or task
            if key not in tasks:
                tasks[key] = bar.add_task(task, total=1.0)
            bar.update(tasks[key], completed=share, description=task)

        yield update


def _each_minute() -> Callable[[str, float], None]:
    """Make a function that prints the task and the time left, once a minute."""
    began = printed = time.monotonic()
    first: float | None = None

    def update(task: str, share: float) -> None:
        nonlocal printed, first
        now, first = time.monotonic(), share if first is None else first
        if now - printed >= 60.0 and share > first:
            printed = now
            echo(f"{task}, about {time_text((now - began) / (share - first) * (1.0 - share))} left", err=True)

    return update


@contextmanager
def counted_progress(noun: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show on standard error how many of `noun` are done, the time left and a note."""
    with progress(noun) as show:
        yield lambda done, total, note: show(
            f"{done} of {total} {noun}{', ' if note else ''}{note}", done / max(total, 1)
        )


def time_text(seconds: float) -> str:
    """Return a time as hours, minutes or seconds."""
    if seconds > 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds > 90 else f"{seconds:.0f} s"
