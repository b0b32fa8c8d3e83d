"""The commands that look at recordings: diagnose, report, inspect, convert."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import replace
from enum import StrEnum
from functools import partial
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Context, Exit, Option, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError, UnreadableFile

if TYPE_CHECKING:
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.recordings import Recording

    Judged = tuple[Recording, Diagnosis]
    Dated = tuple[float | None, Diagnosis]

#: Levels of a leak, the worst last; what `--fail-on` names.
_LEVELS = ("monitor", "plan", "repair")
FailOn = StrEnum("FailOn", [(word.replace(" ", "_"), word) for word in (*opt.Verdict, *_LEVELS)])  # type: ignore[misc]
#: Fewer files are diagnosed one after the other: processes take a second or two to start.
_FEWEST_SIDE_BY_SIDE = 4
#: Fewest files, and time between two of them [s], from which on they may be a machine's over time.
_FEWEST_IN_TIME, _APART_IN_TIME = 3, 3600.0
_FAIL_ON = (
    "End with status 3 where a file has this verdict, or a leak of this level (monitor, plan, repair) against --limit "
    "or worse; repeat."
)
_EVERY = (
    "Cut a long log into parts of this length (1h): TARGET is a new folder for them, of NetCDF files. A text log of "
    "any size is read in bounded memory; `sealscope trend` takes the parts."
)


@opt.stating()
def diagnose(
    context: Context,
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Recordings of any format; `-`: standard input.")],
    stated: opt.StatedMachine,
    output: Annotated[Literal["text", "jsonl"], Option("--format", help="Text, or one JSON object a line.")] = "text",
    join: opt.JoinOption = False,
    false_alarm: opt.FalseAlarmOption = 0.01,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Print the first line of each verdict only.")] = False,
    fail_on: Annotated[list[FailOn] | None, Option("--fail-on", metavar="VERDICT|LEVEL", help=_FAIL_ON)] = None,
) -> None:
    """State for each file whether oil bypasses the piston; with -v by every method.

    With --machine also of folders, a line a recording. Exit status 1 where a file could not be read.
    """
    from sealscope.diagnosis.diagnose import check_probability

    check_probability(false_alarm)
    form = "jsonl" if output == "jsonl" else "line" if quiet else "whole" if opt.verbose(context) else "short"
    if stated.known is not None and any(path.is_dir() for path in files):
        from sealscope.diagnosis.commissioned.machine import recordings_in

        files = recordings_in(files)
        form = form if form == "jsonl" else "table"
    work = partial(_date_diagnoses, machine=stated, joined=join, false_alarm=false_alarm)
    piped = _check_standard_input([*files, *stated.baseline])
    # what a baseline costs is spent once, and standard input is this process's
    alone = join or piped or stated.baseline or stated.known or len(files) < _FEWEST_SIDE_BY_SIDE
    results: Iterable[tuple[str, Iterable[Dated | None]]] = [("", work(files))] if alone else _side_by_side(work, files)
    complete, failed = True, False
    starts: list[float | None] = []
    for complaints, judged in results:
        echo(complaints, err=True, nl=False)
        for result in judged:
            if result is None:
                complete = False
                continue
            start, diagnosis = result
            failed |= any(_fails(reason, diagnosis) for reason in fail_on or ())
            starts.append(start)
            opt.say(_text(diagnosis, form, start))
    if form in ("short", "whole") and _in_time(files, starts):
        opt.complain(f"these {len(files)} files are ordered in time: `sealscope trend` shows how the leakage went")
    if not complete or failed:
        raise Exit(opt.FAILED_ON if failed else 1)


def _side_by_side(
    work: Callable[[Sequence[Path]], Iterator[Dated | None]], files: Sequence[Path]
) -> Iterator[tuple[str, Iterable[Dated | None]]]:
    """Yield what is said of each file on standard error, and its results, from a process a core."""
    from sealscope.campaigns.execution.workers import cores, in_order

    jobs = min(cores(), len(files))
    if jobs == 1:
        yield "", work(files)
        return
    for part, result in in_order(jobs, partial(_collect_messages, work), [[file] for file in files]):
        yield result or (f"sealscope: the process that diagnosed {part[0]} died\n", [None])


def _text(diagnosis: Diagnosis, form: str, start_s: float | None) -> str:
    """Format a diagnosis for printing, in one of the forms jsonl, whole, short, line and table."""
    from sealscope.reporting.messages import diagnosis_text, short_text, table_line

    if form == "jsonl":
        return json.dumps(diagnosis.as_dict(), allow_nan=False)
    if form == "table":
        return table_line(diagnosis, start_s)
    text = diagnosis_text(diagnosis) if form == "whole" else short_text(diagnosis)
    return text.partition("\n")[0] if form == "line" else text


def _fails(reason: str, diagnosis: Diagnosis) -> bool:
    """Test whether the verdict is the one of `--fail-on`, or the leak has its level or a worse one."""
    level = None if diagnosis.severity is None else diagnosis.severity.level
    return reason == diagnosis.verdict or (reason in _LEVELS and level in _LEVELS[_LEVELS.index(reason) :])


def _in_time(files: Sequence[Path], starts: Sequence[float | None]) -> bool:
    """Test whether files have names of one kind and were recorded in turn, an hour or more apart."""
    known = sorted(start for start in starts if start is not None)
    if len(known) < max(_FEWEST_IN_TIME, len(files)):
        return False
    kinds = {re.sub(r"\d+", "#", file.name) for file in files}
    return len(kinds) == 1 and all(late - early >= _APART_IN_TIME for early, late in pairwise(known))


def _check_standard_input(files: Iterable[Path]) -> bool:
    """Test whether standard input is among the files. Raise InputError if it is there more than once."""
    count = sum(file == opt.STANDARD_INPUT for file in files)
    if count > 1:
        raise InputError(f"standard input (-) must be given once, got it {count} times")
    return count == 1


def _diagnoses(
    files: Sequence[Path], machine: opt.StatedMachine, joined: bool, false_alarm: float
) -> Iterator[Judged | None]:
    """Yield recording and diagnosis of each file, None for one that cannot be read; no file is its own baseline."""
    baseline = machine.baseline
    for file in files if baseline else ():
        if all(path.resolve() == file.resolve() for path in baseline):
            raise InputError(f"a baseline must be another recording than the file itself, got {file}")
    known = [(file, recording) for file, recording in machine.read_all(baseline) if recording is not None]
    if len(known) < len(baseline):
        yield None
        if not known:
            raise UnreadableFile("no baseline could be read, so nothing is diagnosed")
    for file, recording in machine.read_all(files, joined):
        healthy = [other for path, other in known if path.resolve() != file.resolve()]
        if recording is None:
            yield None
        elif baseline and not healthy:
            opt.complain(f"no other baseline than the file itself could be read, so it is not diagnosed ({file})")
            yield None
        else:
            diagnosis = opt.attempt(file, partial(machine.diagnose, recording, healthy, file, false_alarm))
            yield None if diagnosis is None else (recording, diagnosis)


def _date_diagnoses(files: Sequence[Path], **options: Any) -> Iterator[Dated | None]:
    """Yield when each recording began [s since 1970] and its diagnosis; None and `options` as of `_diagnoses`."""
    for result in _diagnoses(files, **options):
        yield None if result is None else (_began(result), result[1])


def _began(result: Judged) -> float | None:
    """Return when a recording of a file began [s since 1970], None of standard input without a date."""
    from sealscope.recordings.joining import file_seconds, start_seconds

    recording, path = result[0], Path(result[1].file)
    return file_seconds(recording, path) if path.is_file() else start_seconds(recording, path.name)


def _collect_messages(
    work: Callable[[Sequence[Path]], Iterator[Dated | None]], files: Sequence[Path]
) -> tuple[str, list[Dated | None]]:
    """Run the work. Return its messages on standard error, and its results."""
    with redirect_stderr(StringIO()) as complaints:
        dated = list(work(files))
    return complaints.getvalue(), dated


@opt.stating()
def report(
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Recordings to report on.")],
    output: Annotated[
        Path,
        Option("--output", "-o", help="The page (.html, .pdf) or its card (.png), or a folder for several files."),
    ],
    stated: opt.StatedMachine,
    join: opt.JoinOption = False,
    false_alarm: opt.FalseAlarmOption = 0.01,
) -> None:
    """Diagnose each file and write a self-contained page of it; a folder gets an index, the most severe first.

    With --machine also of a folder: a single page of all its recordings.
    """
    from sealscope.diagnosis.diagnose import check_probability
    from sealscope.reporting.index import write_index
    from sealscope.reporting.page import report as write_report
    from sealscope.reporting.template import check_page
    from sealscope.storage.folders import make_folder

    check_probability(false_alarm)
    if stated.known is not None and any(path.is_dir() for path in files):
        if join:
            raise InputError("--join must not stand beside a folder, whose recordings are judged each for itself")
        _report_machine(files, stated, output, false_alarm)
        return
    several = (len(files) > 1 and not join) or output.is_dir()
    read_too = {path.resolve() for path in (*files, *stated.baseline)}
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
        opt.check_folder(check_page(output))
    results, name = 0, None if stated.known is None else stated.known.name
    written: list[tuple[Path, Diagnosis]] = []
    for result in _diagnoses(files, stated, join, false_alarm):
        results += 1
        page = output if result is None or not several else output / f"{Path(result[1].file).stem}.html"
        if result is None:
            continue
        write = partial(write_report, result[0], page, result[1], rig=stated.rig, title=name)
        if opt.attempt(page, write) is not None:
            written.append((page, result[1]))
            opt.say(f"{result[1].file}: {result[1].verdict} -> {page}")
    if several and written:
        write_index(output / "index.html", written)
    if len(written) < results:
        raise Exit(1)


def _report_machine(files: Sequence[Path], machine: opt.StatedMachine, output: Path, false_alarm: float) -> None:
    """Write the page of a commissioned machine: the recordings of a folder over time, the newest verdict first."""
    from sealscope.diagnosis.commissioned.machine import recordings_in
    from sealscope.recordings.formats.columns import counted
    from sealscope.reporting.template import check_page
    from sealscope.reporting.trend.history import Judged, write_history_page

    opt.check_folder(check_page(output, card=False))
    paths = recordings_in(files)
    if output.resolve() in {path.resolve() for path in paths}:
        raise InputError(f"a page must not replace a recording, got {output}")
    results = list(_diagnoses(paths, machine, False, false_alarm))
    judged = [
        Judged(result[1], _began(result), partial(machine.read, Path(result[1].file)))
        for result in results
        if result is not None
    ]
    if not judged:
        raise UnreadableFile("no recording could be read, so there is no page")
    left_out, name = len(results) - len(judged), "" if machine.known is None else machine.known.name
    write_history_page(output, judged, title=name, left_out=left_out)
    opt.say(f"{name}: {counted(len(judged), 'recording')} -> {output}")
    if left_out:
        raise Exit(1)


def inspect(
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Recordings, of any format that is read.")],
    maps: opt.MapOption = None,
    rate: opt.RateOption = None,
    join: opt.JoinOption = False,
    rig: opt.AssumeOption = None,
    save_map: Annotated[
        bool, Option("--save-map", help="Write the map into the file of --rig, for later calls.")
    ] = False,
) -> None:
    """Show what a file holds and what is wrong with it; columns without a map are taken by their names."""
    from sealscope.parameters.load import save_channel_map
    from sealscope.recordings import inspect as inspected
    from sealscope.recordings.formats.columns import by_names, map_taken, stated_columns
    from sealscope.reporting.overview import overview_text

    _check_standard_input(files)
    stated = opt.StatedMachine.of(None, maps, rate, rig)
    saved = stated.channel_map
    if save_map and (rig is None or not saved):
        raise InputError("--save-map must stand with --rig and its file, and with the --map options to be saved")
    complete, reading = True, stated if stated.maps else replace(stated, channel_map="auto")
    for file, recording in reading.read_all(files, join):
        if recording is None:
            complete = False
            continue
        opt.say(overview_text(str(file), recording, inspected(recording)))
        if by_names(saved):  # a recording of our own states the columns of the file that it was made from
            same_file = recording.provenance.get("file") == file.name
            saved = {**map_taken(recording.provenance), **stated_columns(saved)} if same_file else {}
    if not complete:
        raise Exit(1)
    if save_map and rig is not None and not by_names(saved):
        if not saved:
            own_names = "columns with the channels' own names"
            raise InputError(f"--save-map must have a map to save, got {own_names} ({files[0]})")
        save_channel_map(rig, stated_columns(saved))
        opt.say(f"map saved in {rig}: later calls with --rig {rig} use it")


@opt.stating("maps", "rate")
def convert(
    source: Annotated[Path, Argument(help="Recording to read.")],
    target: Annotated[Path, Argument(help="Recording to write; its suffix tells the format.")],
    stated: opt.StatedMachine,
    every: Annotated[str | None, Option("--every", metavar="TIME", help=_EVERY)] = None,
) -> None:
    """Rewrite a recording in another format, with Sealscope's channel names and units."""
    from sealscope.recordings import inspect, write
    from sealscope.recordings.files import check_target

    if every is not None:
        _convert_parts(source, target, stated, every)
        return
    check_target(target)
    opt.check_folder(target)
    recording = stated.read(source)
    write(recording, target)
    channels = ", ".join(recording.channels)
    opt.say_wrapped(f"{target}: {len(recording)} samples at {recording.rate:g} Hz, channels {channels}")
    for finding in inspect(recording):
        opt.say_wrapped(f"{finding.severity}: {finding.text}")


def _convert_parts(source: Path, folder: Path, stated: opt.StatedMachine, every: str) -> None:
    """Write the parts of a long recording into a new folder; each file is whole or absent."""
    from sealscope.recordings import inspect, read_parts, write
    from sealscope.recordings.formats.columns import counted
    from sealscope.units import parse_quantity

    length = parse_quantity(every, "s", name="--every")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"with --every, TARGET must be a new or empty folder, got {folder}")
    count, samples = 0, 0
    for part in read_parts(source, length, map=stated.channel_map or None, rate=stated.rate):
        if not count:
            folder.mkdir(exist_ok=True)
        count, samples = count + 1, samples + len(part)
        file = folder / f"{source.stem}_{count:04d}.nc"
        write(part, file)
        findings = "".join(f"; {finding.text}" for finding in inspect(part) if finding.severity != "note")
        opt.say_wrapped(f"{file}: {part.duration:g} s from t = {part.t[0]:g} s{findings}")
    opt.say(f"{folder}: {counted(count, 'part')}, {samples} samples")
