"""The commands that look at recordings: diagnose, report, inspect, convert."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from io import StringIO
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from sealscope.cli.options import (
    FAILED_ON,
    AreaOption,
    AssumeOption,
    BaselineOption,
    DisplacementOption,
    FalseAlarmOption,
    JoinOption,
    LimitOption,
    MachineOption,
    MapOption,
    RateOption,
    assumed_rig,
    attempt,
    channel_map_of,
    check_folder,
    complain,
    refuse_beside_machine,
    say,
)
from sealscope.errors import InputError, UnreadableFile

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.parameters import Rig
    from sealscope.recordings import Recording
    from sealscope.recordings.formats.columns import ChannelMap


#: Stands for standard input.
STANDARD_INPUT = Path("-")
#: Fewer files are diagnosed one after the other: processes take a second or two to start.
_FEWEST_SIDE_BY_SIDE = 4


#: Levels of severity, each with those that are worse.
_OR_WORSE = {"follow": ("follow", "plan", "repair"), "plan": ("plan", "repair"), "repair": ("repair",)}


class FailOn(StrEnum):
    """Verdicts and levels of severity, as `--fail-on` names them."""

    leak = "leak"
    no_leak = "no leak"
    cannot_tell = "cannot tell"
    follow = "follow"
    plan = "plan"
    repair = "repair"

    def holds(self, verdict: str, level: str | None) -> bool:
        """Return whether a verdict is this one, or a leak's level this one or a worse one."""
        return verdict == self.value or level in _OR_WORSE.get(self.value, ())


class TextFormat(StrEnum):
    """How verdicts are printed."""

    text = "text"
    jsonl = "jsonl"


@dataclass(frozen=True)
class _Reading:
    """How files are read: channel -> column of the call, rate, and the map beside the machine's rig."""

    channel_map: ChannelMap
    rate: float | None
    beside_rig: ChannelMap = field(default_factory=dict)

    @classmethod
    def of(cls, maps: Sequence[str] | None, rate: float | None, rig: Rig | None) -> _Reading:
        """Return what the options state; a `--map` stands in place of the rig's own map."""
        from sealscope.recordings.formats.columns import check_call

        own = channel_map_of(maps)
        beside = {} if rig is None or own else rig.channel_map
        check_call(own, rate)
        check_call(beside, rate)
        return cls(own, rate, beside)

    def read(self, file: Path) -> Recording:
        """Read a file, standard input for `-`; the rig's map is for files that have its columns."""
        if file.is_dir():
            raise UnreadableFile(
                f"a recording must be a file, got a folder: name its files, or state its machine by --machine ({file})"
            )
        if file != STANDARD_INPUT:
            return self._read(file)
        with TemporaryDirectory() as folder:
            kept = Path(folder) / "standard input"
            with kept.open("wb") as copy:
                shutil.copyfileobj(sys.stdin.buffer, copy)
            try:
                return self._read(kept)
            except UnreadableFile as error:
                raise UnreadableFile(str(error).replace(str(kept), kept.name)) from error

    def _read(self, file: Path) -> Recording:
        if not self.beside_rig:
            from sealscope.recordings import read

            return read(file, map=self.channel_map or None, rate=self.rate)
        from sealscope.diagnosis.commissioned.machine import read_of_machine

        return read_of_machine(file, self.beside_rig, self.rate)


def _check_standard_input(files: Iterable[Path]) -> bool:
    """Return whether standard input is among the files; raise InputError where it is so more than once."""
    count = sum(file == STANDARD_INPUT for file in files)
    if count > 1:
        raise InputError(f"standard input (-) must be given once, got it {count} times")
    return count == 1


def _read_all(
    files: Sequence[Path], reading: _Reading | CommissionedMachine
) -> Iterator[tuple[Path, Recording | None]]:
    """Yield each file and its recording; None, with one line on standard error, where it cannot be read."""
    for file in files:
        yield file, attempt(file, partial(reading.read, file))


def _read_parts(
    files: Sequence[Path], reading: _Reading | CommissionedMachine, join_them: bool
) -> Iterator[tuple[Path, Recording | None]]:
    """Yield what `_read_all` does; or the first file and the recording of all files joined, None where one is bad."""
    if not join_them:
        yield from _read_all(files, reading)
        return
    from sealscope.recordings import join

    parts = [recording for _, recording in _read_all(files, reading)]
    whole = [part for part in parts if part is not None]
    yield files[0], join(whole, names=[file.name for file in files]) if len(whole) == len(files) else None


def _diagnoses(
    files: Sequence[Path],
    join_them: bool,
    baseline: Sequence[Path],
    maps: Sequence[str] | None,
    rate: float | None,
    false_alarm: float,
    rig: Rig | None,
    limit: str | None = None,
    quick: bool = False,
    machine: Path | None = None,
) -> Iterator[tuple[Recording, Diagnosis] | None]:
    """Yield recording and diagnosis of each file, None for one that cannot be read; no file is its own baseline.

    `machine`: file of a commissioned machine, in place of baseline, map, rate, rig and limit.
    """
    from sealscope.diagnosis.diagnose import check_probability, diagnose
    from sealscope.diagnosis.verdict.severity import RepairLimit

    check_probability(false_alarm)
    if machine is not None:
        yield from _by_machine(files, join_them, machine, false_alarm, quick)
        return
    RepairLimit.of(limit)
    reading = _Reading.of(maps, rate, rig)
    for file in files if baseline else ():
        if all(path.resolve() == file.resolve() for path in baseline):
            raise InputError(f"a baseline must be another recording than the file itself, got {file}")
    known = [(file, recording) for file, recording in _read_all(baseline, reading) if recording is not None]
    if len(known) < len(baseline):
        yield None
        if not known:
            raise UnreadableFile("no baseline could be read, so nothing is diagnosed")
    for file, recording in _read_parts(files, reading, join_them):
        if recording is None:
            yield None
            continue
        others = [other for path, other in known if path.resolve() != file.resolve()]
        if baseline and not others:
            complain(f"no other baseline than the file itself could be read, so it is not diagnosed ({file})")
            yield None
            continue
        work = partial(
            diagnose,
            recording,
            others,
            false_alarm_probability=false_alarm,
            rig=rig,
            limit=limit,
            quick=quick,
            file=file,
        )
        diagnosis = attempt(file, work)
        yield None if diagnosis is None else (recording, diagnosis)


def _by_machine(
    files: Sequence[Path], join_them: bool, machine: Path, false_alarm: float, quick: bool
) -> Iterator[tuple[Recording, Diagnosis] | None]:
    """Yield recording and diagnosis of each file against a commissioned machine, None for one that cannot be read."""
    from sealscope.diagnosis.commissioned.machine_file import load_machine

    known = load_machine(machine)
    for file, recording in _read_parts(files, known, join_them):
        if recording is None:
            yield None
            continue
        work = partial(known.diagnose, recording, false_alarm_probability=false_alarm, quick=quick)
        diagnosis = attempt(file, work)
        yield None if diagnosis is None else (recording, replace(diagnosis, file=str(file)))


def diagnose(
    context: typer.Context,
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Recordings, of any format; `-` is standard input. With --machine also folders: a line a recording.",
        ),
    ],
    baseline: BaselineOption = None,
    output: Annotated[TextFormat, typer.Option("--format", help="Text, or one JSON object a line.")] = TextFormat.text,
    maps: MapOption = None,
    rate: RateOption = None,
    join: JoinOption = False,
    false_alarm: FalseAlarmOption = 0.01,
    rig: AssumeOption = None,
    area: AreaOption = None,
    displacement: DisplacementOption = None,
    limit: LimitOption = None,
    machine: MachineOption = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Stop at the first method that has a verdict, the most specific first.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the first line of each verdict only.")] = False,
    fail_on: Annotated[
        list[FailOn] | None,
        typer.Option(
            "--fail-on",
            help="End with status 3 where a file has this verdict, or a leak of this level against --limit or a worse "
            "one; repeat.",
        ),
    ] = None,
) -> None:
    """Say for each file whether oil bypasses the piston; with -v by every method.

    Exit status 1 where a file could not be read.
    """
    from sealscope.campaigns.execution.workers import cores, in_order

    whole = bool(context.find_root().params.get("verbose"))
    form = "jsonl" if output is TextFormat.jsonl else "line" if quiet else "whole" if whole else "short"
    complete, failed = True, False
    if machine is not None:
        refuse_beside_machine(baseline, maps, rate, rig, area, displacement, limit)
        if any(path.is_dir() for path in files):
            from sealscope.diagnosis.commissioned.machine import recordings_in

            files = recordings_in(files)
            form = form if form == "jsonl" else "table"
    task = partial(
        _verdicts,
        form=form,
        join_them=join,
        baseline=baseline or [],
        maps=maps,
        rate=rate,
        false_alarm=false_alarm,
        rig=assumed_rig(rig, area, displacement),
        limit=limit,
        quick=quick,
        machine=machine,
    )
    jobs = min(cores(), len(files))
    piped = _check_standard_input([*files, *(baseline or ())])
    # what a baseline costs is spent once, and standard input is this process's
    if join or piped or baseline or machine or jobs == 1 or len(files) < _FEWEST_SIDE_BY_SIDE:
        said: Iterator[tuple[str, Sequence[SaidOfFile | None]]] = (("", [verdict]) for verdict in task(files))
    else:
        said = (
            result or (f"sealscope: the process that diagnosed {part[0]} died\n", [None])
            for part, result in in_order(jobs, partial(_aside, task), [[file] for file in files])
        )
    starts: list[float | None] = []
    for complaints, verdicts in said:
        typer.echo(complaints, err=True, nl=False)
        for verdict in verdicts:
            if verdict is None:
                complete = False
            else:
                failed |= any(reason.holds(verdict.verdict, verdict.level) for reason in fail_on or ())
                starts.append(verdict.start)
                say(verdict.text)
    if form in ("short", "whole") and _in_time(files, starts):
        complain(f"these {len(files)} files follow one another in time: `sealscope trend` shows how the leakage went")
    if not complete or failed:
        raise typer.Exit(FAILED_ON if failed else 1)


#: Fewest files, and time between two of them [s], from which on they may be a machine's over time.
_FEWEST_IN_TIME, _APART_IN_TIME = 3, 3600.0


def _in_time(files: Sequence[Path], starts: Sequence[float | None]) -> bool:
    """Return whether files with names of one kind were recorded one after another, an hour apart or more."""
    known = sorted(start for start in starts if start is not None)
    if len(known) < max(_FEWEST_IN_TIME, len(files)):
        return False
    kinds = {re.sub(r"\d+", "#", file.name) for file in files}
    return len(kinds) == 1 and all(late - early >= _APART_IN_TIME for early, late in pairwise(known))


class SaidOfFile(NamedTuple):
    """Verdict on a file, its level of severity, what is printed, and when it was recorded [s since 1970], or None."""

    verdict: str
    level: str | None
    text: str
    start: float | None


def _verdicts(files: Sequence[Path], form: str, **options: Any) -> Iterator[SaidOfFile | None]:
    """Yield each file's verdict and what is printed of it in a `form`: jsonl, whole, short, line or table.

    None for a file that cannot be read; `options` of `_diagnoses`.
    """
    from sealscope.recordings.joining import start_seconds
    from sealscope.reporting import diagnosis_text, short_text
    from sealscope.reporting.messages import table_line

    for result in _diagnoses(files, **options):
        if result is None:
            yield None
            continue
        diagnosis = result[1]
        if form == "jsonl":
            text = json.dumps(diagnosis.as_dict(), allow_nan=False)
        else:
            text = diagnosis_text(diagnosis) if form == "whole" else short_text(diagnosis)
        if form == "table":
            text = table_line(diagnosis, start_seconds(result[0]))
        text = text.partition("\n")[0] if form == "line" else text
        level = None if diagnosis.severity is None else diagnosis.severity.level
        yield SaidOfFile(diagnosis.verdict, level, text, start_seconds(result[0]))


def _aside(
    task: Callable[[Sequence[Path]], Iterator[SaidOfFile | None]], files: Sequence[Path]
) -> tuple[str, list[SaidOfFile | None]]:
    """Return what a task says on standard error, and what it yields."""
    with redirect_stderr(StringIO()) as complaints:
        verdicts = list(task(files))
    return complaints.getvalue(), verdicts


def report(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="Recordings to report on; with --machine also a folder: one page of all of them."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="The page (.html, .pdf) or its card (.png), or a folder where there are several files.",
        ),
    ],
    baseline: BaselineOption = None,
    maps: MapOption = None,
    rate: RateOption = None,
    join: JoinOption = False,
    false_alarm: FalseAlarmOption = 0.01,
    rig: AssumeOption = None,
    area: AreaOption = None,
    displacement: DisplacementOption = None,
    limit: LimitOption = None,
    machine: MachineOption = None,
) -> None:
    """Diagnose each file and write a self-contained page of it; a folder gets an index, the most severe first."""
    from sealscope.reporting import write_index, write_page
    from sealscope.reporting.template import check_page
    from sealscope.storage.folders import make_folder

    if machine is not None:
        refuse_beside_machine(baseline, maps, rate, rig, area, displacement, limit)
        if any(path.is_dir() for path in files):
            if join:
                raise InputError("--join must not stand beside a folder, whose recordings are judged each for itself")
            _report_machine(files, machine, output, false_alarm)
            return
    several = (len(files) > 1 and not join) or output.is_dir()
    read_too = {path.resolve() for path in (*files, *(baseline or ()))}
    pages: dict[Path, Path] = {}
    for file in files[:1] if join else files:
        page = output / f"{file.stem}.html" if several else output
        if page.resolve() in read_too:
            raise InputError(f"a page must not replace a recording, got {page}")
        if page in pages:
            raise InputError(f"pages must have names of their own, got {page} for {pages[page]} and {file}")
        if several and file.stem == "index":
            raise InputError(f"a page must not replace the index of its folder, got {page} for {file}")
        pages[page] = file
    if several:
        make_folder(output)
    else:
        check_folder(check_page(output))
    complete = True
    written: list[tuple[Path, Diagnosis]] = []
    assumed = assumed_rig(rig, area, displacement)
    for result in _diagnoses(files, join, baseline or [], maps, rate, false_alarm, assumed, limit, machine=machine):
        if result is None:
            complete = False
            continue
        recording, diagnosis = result
        page = output / f"{Path(diagnosis.file).stem}.html" if several else output
        if attempt(page, partial(write_page, page, recording, diagnosis, rig=assumed)) is None:
            complete = False
            continue
        written.append((page, diagnosis))
        say(f"{diagnosis.file}: {diagnosis.verdict} -> {page}")
    if several and written:
        write_index(output / "index.html", written)
    if not complete:
        raise typer.Exit(1)


def _report_machine(files: Sequence[Path], machine: Path, output: Path, false_alarm: float) -> None:
    """Write the page of a commissioned machine: the recordings of a folder over time, the newest verdict first."""
    from sealscope.diagnosis.commissioned.machine import recordings_in
    from sealscope.diagnosis.commissioned.machine_file import load_machine
    from sealscope.recordings.formats.columns import counted
    from sealscope.recordings.joining import start_seconds
    from sealscope.reporting.template import check_page
    from sealscope.reporting.trend.history import Judged, write_history_page

    check_folder(check_page(output, card=False))
    paths = recordings_in(files)
    if output.resolve() in {path.resolve() for path in paths}:
        raise InputError(f"a page must not replace a recording, got {output}")
    known = load_machine(machine)
    results = [
        None if own is None else Judged(own[1], start_seconds(own[0], own[1].file), partial(known.read, own[1].file))
        for own in _diagnoses(paths, False, [], None, None, false_alarm, None, machine=machine)
    ]
    judged = [result for result in results if result is not None]
    if not judged:
        raise UnreadableFile("no recording could be read, so there is no page")
    left_out = len(results) - len(judged)
    write_history_page(output, judged, title=known.name, left_out=left_out)
    say(f"{known.name}: {counted(len(judged), 'recording')} -> {output}")
    if left_out:
        raise typer.Exit(1)


def inspect(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings, of any format that is read.")],
    maps: MapOption = None,
    rate: RateOption = None,
    join: JoinOption = False,
    rig: AssumeOption = None,
    save_map: Annotated[
        bool, typer.Option("--save-map", help="Keep the map in the file of --rig, for later calls with that rig.")
    ] = False,
) -> None:
    """Show what a file holds and what is wrong with it; columns without a map are taken by their names."""
    from sealscope.parameters.load import save_channel_map
    from sealscope.recordings import inspect as inspected
    from sealscope.recordings.formats.columns import by_names, map_taken, stated_columns
    from sealscope.reporting import overview_text

    complete = True
    _check_standard_input(files)
    reading = _Reading.of(maps, rate, assumed_rig(rig))
    if save_map and (rig is None or not reading.channel_map):
        raise InputError("--save-map must stand with --rig and its file, and with the --map options to be kept")
    kept = reading.channel_map
    if not (reading.channel_map or reading.beside_rig):
        reading = replace(reading, channel_map="auto")
    for file, recording in _read_parts(files, reading, join):
        if recording is None:
            complete = False
        else:
            say(overview_text(str(file), recording, inspected(recording)))
            if by_names(kept):  # a recording of our own keeps the columns of the file that it was made from
                own = recording.provenance.get("file") == file.name
                kept = {**map_taken(recording.provenance), **stated_columns(kept)} if own else {}
    if not complete:
        raise typer.Exit(1)
    if save_map and rig is not None and not by_names(kept):
        if not kept:
            raise InputError(
                f"--save-map must have a map to keep, got columns with the channels' own names ({files[0]})"
            )
        save_channel_map(rig, stated_columns(kept))
        say(f"map kept in {rig}: later calls with --rig {rig} find it")


def convert(
    source: Annotated[Path, typer.Argument(help="Recording to read.")],
    target: Annotated[Path, typer.Argument(help="Recording to write; its suffix tells the format.")],
    maps: MapOption = None,
    rate: RateOption = None,
    every: Annotated[
        str | None,
        typer.Option(
            "--every",
            metavar="TIME",
            help="Cut a long log into parts of this length (1h): TARGET is a folder, made for them, of NetCDF files. "
            "A text log of any size is read in bounded memory; `sealscope trend` follows the parts.",
        ),
    ] = None,
) -> None:
    """Rewrite a recording in another format, with Sealscope's channel names and units."""
    from sealscope.recordings import inspect, write
    from sealscope.recordings.files import check_target

    if every is not None:
        _convert_parts(source, target, _Reading.of(maps, rate, None), every)
        return
    check_target(target)
    check_folder(target)
    recording = _Reading.of(maps, rate, None).read(source)
    write(recording, target)
    say(f"{target}: {len(recording)} samples at {recording.rate:g} Hz, channels {', '.join(recording.channels)}")
    for finding in inspect(recording):
        say(f"{finding.severity}: {finding.text}")


def _convert_parts(source: Path, folder: Path, reading: _Reading, every: str) -> None:
    """Write the parts of a long recording into a new folder; each file is whole or absent."""
    from sealscope.recordings import inspect, read_parts, write
    from sealscope.recordings.formats.columns import counted
    from sealscope.units import parse_quantity

    length = parse_quantity(every, "s", name="--every")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"with --every, TARGET must be a new or empty folder, got {folder}")
    count, samples = 0, 0
    for part in read_parts(source, length, map=reading.channel_map or None, rate=reading.rate):
        if not count:
            folder.mkdir(exist_ok=True)
        count, samples = count + 1, samples + len(part)
        file = folder / f"{source.stem}_{count:04d}.nc"
        write(part, file)
        findings = "".join(f"; {finding.text}" for finding in inspect(part) if finding.severity != "note")
        say(f"{file}: {part.duration:g} s from t = {part.t[0]:g} s{findings}")
    say(f"{folder}: {counted(count, 'part')}, {samples} samples")
