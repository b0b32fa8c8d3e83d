"""The command line: translation from words to calls, nothing else."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sealscope.errors import InputError, MissingExtra, SealscopeError, UnreadableFile

if TYPE_CHECKING:
    from sealscope.diagnosis.verdict import Diagnosis
    from sealscope.parameters import Rig
    from sealscope.recordings import Recording
    from sealscope.simulation.simulate import Progress

_WRONG_CALL, _INTERRUPTED = 2, 130

app = typer.Typer(
    name="sealscope",
    help="Find internal leakage in electro-hydrostatic actuators: simulate the rig, read recordings, diagnose them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class TextFormat(StrEnum):
    """How verdicts are printed."""

    text = "text"
    jsonl = "jsonl"


class TableFormat(StrEnum):
    """How tables are printed."""

    table = "table"
    csv = "csv"
    json = "json"


def _rigs(incomplete: str) -> list[str]:
    from sealscope.parameters import rig_names

    return [name for name in rig_names() if name.startswith(incomplete)]


def _settings(incomplete: str) -> list[str]:
    from sealscope.parameters import declared_names

    return [f"{name}=" for name in declared_names() if name.startswith(incomplete)]


RigOption = Annotated[
    str, typer.Option("--rig", help="Rig by name, or the path of a rig's TOML file.", autocompletion=_rigs)
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE[unit]", help="Override a parameter; repeat.", autocompletion=_settings),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map", metavar="CHANNEL=COLUMN", help="Take a channel from a foreign column, e.g. p_A=PG_1[psi]; repeat."
    ),
]
RateOption = Annotated[float | None, typer.Option("--rate", help="Sampling rate [Hz] of files without a time column.")]
BaselineOption = Annotated[
    list[Path] | None, typer.Option("--baseline", metavar="FILE...", help="Leak-free recordings of the same machine.")
]
FalseAlarmOption = Annotated[
    float, typer.Option("--false-alarm", help="Probability of `leak` on a leak-free recording.")
]
SeedOption = Annotated[int, typer.Option("--seed", help="Seed of the instruments' noise.")]


@contextmanager
def _progress() -> Iterator[Progress]:
    """A progress line on standard error, gone when done; silent where nobody looks."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def told(words: str, share: float) -> None:
            if words not in tasks:
                tasks[words] = bar.add_task(words, total=1.0)
            bar.update(tasks[words], completed=share)

        yield told


def _complain(words: object) -> None:
    """One line on standard error, whatever characters a file's name or header brought."""
    printable = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(words))
    typer.echo(f"sealscope: {printable}", err=True)


def _rig(name: str, settings: Sequence[str] | None) -> Rig:
    from sealscope.parameters import load_rig, parse_settings

    rig = load_rig(name)
    return rig.with_values(parse_settings(list(settings)), source="set by --set") if settings else rig


def _channel_map(options: Sequence[str] | None) -> dict[str, str]:
    from sealscope.recordings import split_map_option

    found: dict[str, str] = {}
    for option in options or ():
        channel, column = split_map_option(option)
        if channel in found:
            raise InputError(f"--map {channel} must be given once, got {found[channel]} and {column}")
        found[channel] = column
    return found


def _read_all(
    files: Sequence[Path], channel_map: dict[str, str], rate: float | None
) -> Iterator[tuple[Path, Recording | None]]:
    """Each file and its recording; None, with one line on standard error, where it cannot be read."""
    from sealscope.recordings import read

    for file in files:
        try:
            yield file, read(file, channel_map=channel_map or None, rate=rate)
        except (UnreadableFile, MissingExtra) as error:
            _complain(error)
            yield file, None


def _diagnoses(
    files: Sequence[Path],
    baseline: Sequence[Path],
    maps: Sequence[str] | None,
    rate: float | None,
    false_alarm: float,
) -> Iterator[tuple[Recording, Diagnosis] | None]:
    """Recording and diagnosis of each file, None for one that cannot be read; a file is never its own baseline."""
    from sealscope.diagnosis.diagnose import check_probability, diagnose

    check_probability(false_alarm)
    channel_map = _channel_map(maps)
    for file in files if baseline else ():
        if all(path.resolve() == file.resolve() for path in baseline):
            raise InputError(f"a baseline must be another recording than the file itself, got {file}")
    known = [(file, recording) for file, recording in _read_all(baseline, channel_map, rate) if recording is not None]
    if len(known) < len(baseline):
        yield None
        if not known:
            raise UnreadableFile("no baseline could be read, so nothing is diagnosed")
    for file, recording in _read_all(files, channel_map, rate):
        if recording is None:
            yield None
            continue
        others = [one for path, one in known if path.resolve() != file.resolve()]
        if baseline and not others:
            _complain(f"no other baseline than the file itself could be read, so it is not diagnosed ({file})")
            yield None
            continue
        yield recording, diagnose(recording, others, false_alarm_probability=false_alarm, file=str(file))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"a folder to write into must be one or become one, got: {error.strerror} ({folder})"
        ) from None


def _check_folder(file: Path) -> None:
    """Refuse a file whose folder is not there before the long work, not after it."""
    if not file.parent.is_dir():
        raise InputError(f"the folder of a file to write must exist, got {file.parent} ({file})")


@app.command()
def diagnose(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Recordings: CSV or text, NetCDF, HDF5, Parquet.")
    ],
    baseline: BaselineOption = None,
    output: Annotated[TextFormat, typer.Option("--format", help="Text, or one JSON object a line.")] = TextFormat.text,
    maps: MapOption = None,
    rate: RateOption = None,
    false_alarm: FalseAlarmOption = 0.01,
) -> None:
    """Say for each file whether oil bypasses the piston. Exit status 1 where a file could not be read."""
    from sealscope.reporting import diagnosis_text

    complete = True
    for found in _diagnoses(files, baseline or [], maps, rate, false_alarm):
        if found is None:
            complete = False
        elif output is TextFormat.jsonl:
            typer.echo(json.dumps(found[1].as_dict(), allow_nan=False))
        else:
            typer.echo(diagnosis_text(found[1]))
    if not complete:
        raise typer.Exit(1)


@app.command()
def report(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings to report on.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The page, or a folder when there are several files.")],
    baseline: BaselineOption = None,
    maps: MapOption = None,
    rate: RateOption = None,
    false_alarm: FalseAlarmOption = 0.01,
) -> None:
    """Diagnose each file and write a self-contained HTML page of it."""
    from sealscope.reporting import write_page

    several = len(files) > 1 or output.is_dir()
    read_too = {path.resolve() for path in (*files, *(baseline or ()))}
    pages: dict[Path, Path] = {}
    for file in files:
        page = output / f"{file.stem}.html" if several else output
        if page.resolve() in read_too:
            raise InputError(f"a page must not replace a recording, got {page}")
        if page in pages:
            raise InputError(f"pages must have names of their own, got {page} for {pages[page]} and {file}")
        pages[page] = file
    if several:
        _make_folder(output)
    else:
        _check_folder(output)
    complete = True
    for found in _diagnoses(files, baseline or [], maps, rate, false_alarm):
        if found is None:
            complete = False
            continue
        recording, diagnosis = found
        page = output / f"{Path(diagnosis.file).stem}.html" if several else output
        write_page(page, recording, diagnosis)
        typer.echo(f"{diagnosis.file}: {diagnosis.verdict} -> {page}")
    if not complete:
        raise typer.Exit(1)


@app.command()
def simulate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Recording to write (.nc, .h5, .csv, .parquet).")],
    rig: RigOption = "thesis",
    command: Annotated[
        str, typer.Option("--command", help="Command, e.g. '3 sin(4t)', 'chirp 3 from 0.1 Hz to 5 Hz over 60 s'.")
    ] = "3 sin(4t)",
    leak: Annotated[
        list[str] | None, typer.Option("--leak", help="Leak, e.g. '0.0042 L/min from 90 s'; repeat to combine.")
    ] = None,
    duration: Annotated[str, typer.Option("--duration", help="Length [s].")] = "180",
    start: Annotated[
        str, typer.Option("--start-position", help="Piston position at the start, from mid-stroke [m].")
    ] = "0",
    seed: SeedOption = 0,
    settings: SetOption = None,
    method: Annotated[str, typer.Option("--method", help="auto, rk4 or imex.")] = "auto",
    step: Annotated[str | None, typer.Option("--step", help="Largest step of the solver [s].")] = None,
    prove: Annotated[
        bool, typer.Option("--prove", help="Halve the step and report how far everything moves; fail if too far.")
    ] = False,
    allow_unresolved: Annotated[
        bool, typer.Option("--allow-unresolved", help="Let an unstable or unresolved run through, marked.")
    ] = False,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="Write what was put in (leaks, onset) to this JSON file.")
    ] = None,
) -> None:
    """Simulate the rig and record it as its instruments would."""
    from sealscope.recordings import write
    from sealscope.recordings.files import check_target
    from sealscope.simulation.experiment import make_experiment
    from sealscope.simulation.proof import prove as prove_run
    from sealscope.simulation.simulate import run, write_truth
    from sealscope.units import parse_quantity

    check_target(output)
    if truth is not None:
        _check_folder(truth)
        if truth.resolve() == output.resolve():
            raise InputError(f"recording and truth must be two files, got {output} for both")
    experiment = make_experiment(
        rig=_rig(rig, settings),
        command=command,
        leak=leak,
        duration=parse_quantity(duration, "s"),
        x_0=parse_quantity(start, "m"),
        seed=seed,
        method=method,
        step=None if step is None else parse_quantity(step, "s"),
        allow_unresolved=allow_unresolved,
    )
    with _progress() as told:
        proof = prove_run(experiment, told) if prove else None
        made = run(experiment, told)
    write(made.recording, output)
    if truth is not None:
        write_truth(made.truth, truth)
    if proof is not None:
        typer.echo(proof.text())
    solver = made.recording.provenance["solver"]
    typer.echo(
        f"{output}: {len(made.recording)} samples at {experiment.rate:g} Hz, {experiment.command} "
        f"({solver['method']}, h = {solver['step_s']:.3g} s)"
    )
    for one in made.truth.leaks:
        typer.echo(f"leak: {one}")
    if made.truth.leaks:
        typer.echo(f"mean leak while open: {made.truth.mean_leak_lpm:.5g} L/min")


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(help="Recording to read.")],
    target: Annotated[Path, typer.Argument(help="Recording to write; its suffix tells the format.")],
    maps: MapOption = None,
    rate: RateOption = None,
) -> None:
    """Rewrite a recording in another format, with Sealscope's channel names and units."""
    from sealscope.recordings import inspect, read, write
    from sealscope.recordings.files import check_target

    check_target(target)
    recording = read(source, channel_map=_channel_map(maps) or None, rate=rate)
    write(recording, target)
    typer.echo(f"{target}: {len(recording)} samples at {recording.rate:g} Hz, channels {', '.join(recording.channels)}")
    for finding in inspect(recording):
        typer.echo(f"{finding.severity}: {finding.text}")


@app.command()
def parameters(
    rig: Annotated[
        str, typer.Argument(help="Rig by name, or the path of a rig's TOML file.", autocompletion=_rigs)
    ] = "thesis",
    settings: SetOption = None,
    output: Annotated[TableFormat, typer.Option("--format", help="Table, CSV or JSON.")] = TableFormat.table,
) -> None:
    """List a rig's parameters: symbol, name, value, unit and source."""
    loaded = _rig(rig, settings)
    columns = ("symbol", "name", "meaning", "value", "unit", "source")
    rows = [{column: getattr(row, column) for column in columns} for row in loaded.table()]
    if output is TableFormat.json:
        typer.echo(json.dumps(rows, indent=1))
    elif output is TableFormat.csv:
        writer = csv.DictWriter(sys.stdout, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    else:
        from rich.console import Console
        from rich.table import Table

        console = Console(width=None if sys.stdout.isatty() else 240)
        table = Table(*columns, title=f"{loaded.name}: {loaded.title}", row_styles=("", "dim"))
        for row in rows:
            value = row["value"]
            table.add_row(
                *(f"{row[c]:.6g}" if c == "value" and isinstance(value, float) else str(row[c]) for c in columns)
            )
        console.print(table)


@app.command()
def demo(
    folder: Annotated[Path, typer.Option("--output", "-o", help="Folder for the recording and the page.")] = Path(
        "sealscope-demo"
    ),
    seed: SeedOption = 1,
) -> None:
    """Simulate 180 s with a leak of 0.0042 L/min from second 90, record it, diagnose the recording, write the page."""
    from sealscope.demo import run_demo
    from sealscope.reporting import diagnosis_text

    _make_folder(folder)
    with _progress() as told:
        made = run_demo(folder, seed, told)
    typer.echo(diagnosis_text(made.diagnosis))
    typer.echo(f"truth:     {made.truth.mean_leak_lpm:.4f} L/min from {made.truth.onset_s:.1f} s")
    typer.echo(f"recording: {made.recording}")
    typer.echo(f"page:      {made.page}")


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        from sealscope import __version__

        typer.echo(f"sealscope {__version__}")
        raise typer.Exit


def spread_baselines(arguments: Sequence[str]) -> list[str]:
    """Give every file after `--baseline` an option of its own, so that `FILE... --baseline FILE...` works with a
    shell's wildcards.

    All words after `--baseline` up to the next option belong to it; but where no other word could be a FILE, only the
    first one does.
    """
    if not arguments or arguments[0] not in ("diagnose", "report"):
        return list(arguments)
    takes_value = {"--format", "--map", "--rate", "--false-alarm", "--output", "-o"}
    groups: list[list[str]] = []
    plain: list[str] = []
    index, files = 1, 0
    while index < len(arguments):
        word = arguments[index]
        index += 1
        if word == "--":
            rest = list(arguments[index:])
            files += len(rest)
            plain += ["--", *rest]
            break
        if word == "--baseline":
            group = []
            while index < len(arguments) and not arguments[index].startswith("-"):
                group.append(arguments[index])
                index += 1
            groups.append(group)
        else:
            plain.append(word)
            if word in takes_value and index < len(arguments):
                plain.append(arguments[index])
                index += 1
            elif not word.startswith("-"):
                files += 1
    if not all(groups):
        raise InputError("--baseline must be followed by one file or more, got none")
    options = [word for group in groups for name in (group if files else group[:1]) for word in ("--baseline", name)]
    left = [] if files else [name for group in groups for name in group[1:]]
    return [arguments[0], *options, *left, *plain]


def main() -> None:
    """Run the command line; every error a caller can act on is one line on standard error and a status, never a
    traceback."""
    # typer brings click along or holds a copy of its own, by version: the class is wherever BadParameter's base is
    wrong_call: type[Any] = sys.modules[typer.BadParameter.__module__].ClickException
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal without the character shows its code instead
            stream.reconfigure(errors="backslashreplace")
    try:
        status = app(spread_baselines(sys.argv[1:]), prog_name="sealscope", standalone_mode=False)
        sys.stdout.flush()
    except typer.Exit as error:
        status = error.exit_code
    except wrong_call as error:
        error.show()
        status = _WRONG_CALL
    except (typer.Abort, KeyboardInterrupt):
        status = _INTERRUPTED
    except BrokenPipeError:
        status = 1
    except SealscopeError as error:
        _complain(error)
        status = _WRONG_CALL if isinstance(error, InputError) and not isinstance(error, UnreadableFile) else 1
    except (OSError, MemoryError) as error:
        _complain(str(error) or "out of memory")
        status = 1
    if status == _INTERRUPTED:  # typer may have turned the interrupt into this status
        _complain("interrupted")
    _let_go_of_output()
    sys.exit(status if isinstance(status, int) else 0)


def _let_go_of_output() -> None:
    """Flush standard output; where nobody takes it any more, send the rest nowhere, so that Python's own flush at its
    end is silent."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
