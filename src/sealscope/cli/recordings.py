"""The commands on recordings: diagnose, report, inspect, convert."""

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
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from typer import Argument, Context, Exit, Option, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError, UnreadableFile, printable

if TYPE_CHECKING:
    from sealscope.diagnosis.verdict.diagnosis import Diagnosis
    from sealscope.recordings import Recording
    from sealscope.recordings.formats.columns import ChannelMap

    #: Start [s since 1970], or None, and diagnosis of a recording.
    DatedDiagnosis = tuple[float | None, Diagnosis]

#: Levels of a leak's severity in rising order, which `--fail-on` accepts.
_LEVELS = ("monitor", "plan", "repair")
FailOn = StrEnum("FailOn", [(word.replace(" ", "_"), word) for word in (*opt.Verdict, *_LEVELS)])  # type: ignore[misc]
#: Fewer and smaller files are diagnosed in this process, as starting others takes a second or two. The size is that of
#: all files but the largest [bytes].
_MIN_PARALLEL_FILES, _MIN_PARALLEL_SIZE = 4, 2**24
#: Smallest number of files, and time between two of them [s], of a series over time.
_MIN_SERIES_FILES, _MIN_SERIES_INTERVAL = 3, 3600.0
_FAIL_ON = (
    "End with status 3 where a file has this verdict, or a leak of this level (monitor, plan, repair) against --limit "
    "or worse; repeat."
)
_PAGE = "The page (.html, .pdf) or its card (.png), or a folder for several files."
_SAVE_MAP = "Write the map into the file of --rig, for later calls."
_EVERY = (
    "Cut a long log into parts of this length (1h): TARGET is a new folder for them, of NetCDF files. A text log of "
    "any size is read in bounded memory; `sealscope trend` takes the parts."
)


class DiagnosedRecording(NamedTuple):
    """A recording and its diagnosis."""

    recording: Recording
    diagnosis: Diagnosis


@opt.with_machine_options()
def diagnose(
    context: Context,
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Recordings of any format; `-`: standard input.")],
    stated: opt.StatedMachine,  # built from the options that the decorator adds
    output: Annotated[Literal["text", "jsonl"], Option("--format", help="Text, or one JSON object a line.")] = "text",
    join: opt.JoinOption = False,
    false_alarm: opt.FalseAlarmOption = opt.FALSE_ALARM_PROBABILITY,
    quiet: Annotated[bool, Option("--quiet", "-q", help="Print the first line of each verdict only.")] = False,
    fail_on: Annotated[list[FailOn] | None, Option("--fail-on", metavar="VERDICT|LEVEL", help=_FAIL_ON)] = None,
) -> None:
    """State for each file whether oil bypasses the piston; with -v the verdicts of all methods.

    Folders are accepted if --machine is given; each recording then gets a line. The exit status is 1 if a file could
    not be read.
    """
    from sealscope.diagnosis.diagnose import check_probability

    check_probability(false_alarm)
    if output == "jsonl":
        form = "jsonl"
    elif quiet:
        form = "line"
    else:
        form = "whole" if opt.is_verbose(context) else "short"
    if stated.commissioned is not None and any(path.is_dir() for path in files):
        from sealscope.diagnosis.commissioned.machine import recordings_in

        files = recordings_in(files)
        if form != "jsonl":
            form = "table"
    work = partial(_iter_dated_diagnoses, machine=stated, joined=join, false_alarm_probability=false_alarm)
    is_piped = _reads_standard_input([*files, *stated.baseline])
    # one process: joined files are one recording; others would read each baseline again, and have no standard input
    is_serial = join or is_piped or stated.baseline or stated.commissioned or not _is_long_work(files)
    results: Iterable[tuple[str, Iterable[DatedDiagnosis | None]]]
    results = [("", work(files))] if is_serial else _diagnose_in_parallel(work, files)
    is_complete = True
    is_failure = False  # True if `--fail-on` applies to a diagnosis
    starts: list[float | None] = []
    for messages, dated_diagnoses in results:
        echo(messages, err=True, nl=False)
        for result in dated_diagnoses:
            if result is None:
                is_complete = False
                continue
            start, diagnosis = result
            is_failure |= any(_matches_fail_on(reason, diagnosis) for reason in fail_on or ())
            starts.append(start)
            opt.say(_format_diagnosis(diagnosis, form, start))
    if form in ("short", "whole") and _is_time_series(files, starts):
        opt.complain(f"these {len(files)} files are ordered in time: `sealscope trend` shows how the leakage developed")
    if not is_complete or is_failure:
        raise Exit(opt.FAILED_ON if is_failure else 1)


def _is_long_work(files: Sequence[Path]) -> bool:
    """Return True if several processes diagnose `files` sooner than this one: if they are many, or two are long."""
    if len(files) >= _MIN_PARALLEL_FILES:
        return True
    sizes = sorted(file.stat().st_size if file.is_file() else 0 for file in files)
    return sum(sizes[:-1]) >= _MIN_PARALLEL_SIZE


def _diagnose_in_parallel(
    work: Callable[[Sequence[Path]], Iterator[DatedDiagnosis | None]], files: Sequence[Path]
) -> Iterator[tuple[str, Iterable[DatedDiagnosis | None]]]:
    """Diagnose files in parallel processes; yield a pair (messages, dated diagnoses) for each file, in their order.

    `work`: `_iter_dated_diagnoses` with its options. The messages are the text that it printed on standard error.
    """
    from sealscope.campaigns.execution.workers import cores, iter_results_in_order

    task = partial(_run_collecting_messages, work)
    for file, result in iter_results_in_order(min(cores(), len(files)), task, files):
        yield result or (f"sealscope: the process that diagnosed {file} died\n", [None])


def _format_diagnosis(diagnosis: Diagnosis, form: str, start_s: float | None) -> str:
    """Format a diagnosis for printing.

    `form`: "jsonl" for a JSON object, "short" for a short text, "line" for its first line, "whole" for a text with all
    methods, or "table" for a line with the start `start_s` of the recording [s since 1970].
    """
    from sealscope.reporting.messages import diagnosis_text, short_text, table_line

    if form == "jsonl":
        return json.dumps(diagnosis.as_dict(), allow_nan=False)
    if form == "table":
        return table_line(diagnosis, start_s)
    text = diagnosis_text(diagnosis) if form == "whole" else short_text(diagnosis)
    return text.partition("\n")[0] if form == "line" else text


def _matches_fail_on(reason: str, diagnosis: Diagnosis) -> bool:
    """Return True if a diagnosis meets a `reason` to fail: a verdict, or the lowest level of severity (`--fail-on`)."""
    if reason not in _LEVELS:
        return reason == diagnosis.verdict
    return diagnosis.severity is not None and diagnosis.severity.level in _LEVELS[_LEVELS.index(reason) :]


def _is_time_series(files: Sequence[Path], starts: Sequence[float | None]) -> bool:
    """Return True if files look like recordings of one machine over time.

    There must be `_MIN_SERIES_FILES` or more, whose names differ only in numbers, and whose `starts` [s] are all known
    and lie an hour or more apart.
    """
    known = sorted(start for start in starts if start is not None)
    if len(known) < max(_MIN_SERIES_FILES, len(files)):
        return False
    patterns = {re.sub(r"\d+", "#", file.name) for file in files}
    return len(patterns) == 1 and all(later - earlier >= _MIN_SERIES_INTERVAL for earlier, later in pairwise(known))


def _reads_standard_input(files: Iterable[Path]) -> bool:
    """Return True if standard input, `-`, is among the files; raise InputError if `-` is given more than once."""
    count = sum(file == opt.STANDARD_INPUT for file in files)
    if count > 1:
        raise InputError(f"standard input (-) must be given once, got it {count} times")
    return count == 1


def _iter_diagnoses(
    files: Sequence[Path], machine: opt.StatedMachine, *, joined: bool, **settings: Any
) -> Iterator[DiagnosedRecording | None]:
    """Yield each recording with its diagnosis, or None if the file cannot be read or diagnosed.

    If a baseline, i.e. a leak-free recording for comparison, cannot be read, an additional None is yielded first, so
    that the call counts as incomplete. A file never serves as its own baseline. `joined`: True if the files are parts
    of a single recording; `settings`: further arguments of `StatedMachine.diagnose`. Raises InputError if the only
    baseline of a file is the file itself, and UnreadableFile if no baseline can be read.
    """
    baseline = machine.baseline
    for file in files:
        if baseline and all(path.resolve() == file.resolve() for path in baseline):
            raise InputError(f"a baseline must be another recording than the file itself, got {file}")
    readable = [(file, recording) for file, recording in machine.read_all(baseline) if recording is not None]
    if len(readable) < len(baseline):
        yield None
        if not readable:
            raise UnreadableFile("no baseline could be read, so nothing is diagnosed")
    for file, recording in machine.read_all(files, joined=joined):
        healthy = [other for path, other in readable if path.resolve() != file.resolve()]
        if recording is None:
            yield None
        elif baseline and not healthy:
            opt.complain(f"no other baseline than the file itself could be read, so it is not diagnosed ({file})")
            yield None
        else:
            diagnosis = opt.attempt(file, partial(machine.diagnose, recording, healthy, file, **settings))
            yield None if diagnosis is None else DiagnosedRecording(recording, diagnosis)


def _iter_dated_diagnoses(files: Sequence[Path], **options: Any) -> Iterator[DatedDiagnosis | None]:
    """Yield start and diagnosis of each recording, or None if it has none; `options`: as of `_iter_diagnoses`."""
    for result in _iter_diagnoses(files, **options):
        yield None if result is None else (_start_seconds(result), result.diagnosis)


def _start_seconds(result: DiagnosedRecording) -> float | None:
    """Find the start of a recording [s since 1970] from its content or the file's name; None if unknown."""
    from sealscope.recordings.header import start_seconds

    return start_seconds(result.recording, Path(result.diagnosis.file).name)


def _run_collecting_messages(
    work: Callable[[Sequence[Path]], Iterator[DatedDiagnosis | None]], file: Path
) -> tuple[str, list[DatedDiagnosis | None]]:
    """Diagnose a file by the function `work`; return its text on standard error, and what it yields for the file."""
    with redirect_stderr(StringIO()) as messages:
        dated_diagnoses = list(work([file]))
    return messages.getvalue(), dated_diagnoses


@opt.with_machine_options()
def report(
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Recordings to report on.")],
    output: Annotated[Path, Option("--output", "-o", help=_PAGE)],
    stated: opt.StatedMachine,  # built from the options that the decorator adds
    join: opt.JoinOption = False,
    false_alarm: opt.FalseAlarmOption = opt.FALSE_ALARM_PROBABILITY,
) -> None:
    """Diagnose each file and write a self-contained page; several pages get an index, the most severe first.

    With --machine and a folder, a single page shows all its recordings.
    """
    from sealscope.diagnosis.diagnose import check_probability
    from sealscope.reporting.index import write_index
    from sealscope.reporting.page import report as write_report
    from sealscope.reporting.template import PAGE_SUFFIXES, parse_page_path
    from sealscope.storage.folders import make_folder

    check_probability(false_alarm)
    if stated.commissioned is not None and any(path.is_dir() for path in files):
        if join:
            raise InputError("--join cannot be combined with a folder, whose recordings are judged separately")
        _report_machine(files, stated, output, false_alarm)
        return
    has_folder = (len(files) > 1 and not join) or output.is_dir()
    if has_folder and not output.is_dir() and output.suffix.lower() in PAGE_SUFFIXES:
        raise InputError(f"several pages need a folder, got the name of a page, {output}")
    input_files = {path.resolve() for path in (*files, *stated.baseline)}
    pages: dict[Path, Path] = {}
    for file in files[:1] if join else files:  # joined files have one page
        page = output / f"{file.stem}.html" if has_folder else output
        if page.resolve() in input_files:
            raise InputError(f"a page must not replace a recording, got {page}")
        if page in pages:
            raise InputError(f"pages must have names of their own, got {page} for {pages[page]} and {file}")
        if has_folder and file.stem == "index":
            raise InputError(f"a page must not replace the index of its folder, got {page} for {file}")
        pages[page] = file
    if has_folder:
        make_folder(output)
    else:
        opt.check_folder(parse_page_path(output))
    name = None if stated.commissioned is None else stated.commissioned.name
    n_results = 0
    written_pages: list[tuple[Path, Diagnosis]] = []
    for result in _iter_diagnoses(files, stated, joined=join, false_alarm_probability=false_alarm):
        n_results += 1
        if result is None:
            continue
        recording, diagnosis = result
        page = output / f"{Path(diagnosis.file).stem}.html" if has_folder else output
        write = partial(write_report, recording, page, diagnosis, rig=stated.rig, title=name)
        if opt.attempt(page, write) is not None:
            written_pages.append((page, diagnosis))
            opt.say(printable(f"{diagnosis.file}: {diagnosis.verdict} -> {page}"))
    if has_folder and written_pages:
        write_index(output / "index.html", written_pages)
    if len(written_pages) < n_results:
        raise Exit(1)


def _report_machine(files: Sequence[Path], machine: opt.StatedMachine, output: Path, false_alarm: float) -> None:
    """Write the page of a commissioned machine, with its newest verdict and all its recordings over time.

    `files`: recordings and folders of them. Raises UnreadableFile if no recording can be read and diagnosed, and ends
    with the exit status 1 if some cannot.
    """
    from sealscope.diagnosis.commissioned.machine import recordings_in
    from sealscope.paragraphs import format_count
    from sealscope.reporting.template import parse_page_path
    from sealscope.reporting.trend.history import Judged, write_history_page

    opt.check_folder(parse_page_path(output, card=False))
    paths = recordings_in(files)
    if output.resolve() in {path.resolve() for path in paths}:
        raise InputError(f"a page must not replace a recording, got {output}")
    results = list(_iter_diagnoses(paths, machine, joined=False, false_alarm_probability=false_alarm))
    entries = [
        Judged(result.diagnosis, _start_seconds(result), partial(machine.read, Path(result.diagnosis.file)))
        for result in results
        if result is not None
    ]
    if not entries:
        raise UnreadableFile("no recording could be read, so there is no page")
    n_left_out = len(results) - len(entries)
    name = "" if machine.commissioned is None else machine.commissioned.name
    write_history_page(output, entries, title=name, left_out=n_left_out)
    opt.say(f"{name}: {format_count(len(entries), 'recording')} -> {output}")
    if n_left_out:
        raise Exit(1)


def inspect(
    files: Annotated[list[Path], Argument(metavar="FILE...", help="Recordings, of any format that is read.")],
    maps: opt.MapOption = None,
    group: opt.GroupOption = None,
    rate: opt.RateOption = None,
    join: opt.JoinOption = False,
    rig: opt.AssumeOption = None,
    save_map: Annotated[bool, Option("--save-map", help=_SAVE_MAP)] = False,
) -> None:
    """Show the content of a file and its defects; columns without a map are recognised by their names."""
    from sealscope.parameters.rig import save_channel_map
    from sealscope.recordings import inspect as find_defects
    from sealscope.recordings.corrections.unsigned import restore_signs
    from sealscope.reporting.overview import overview_text

    _reads_standard_input(files)
    stated = opt.StatedMachine.from_options(maps=maps, group=group, rate=rate, rig=rig)
    if save_map and (rig is None or not stated.channel_map):
        raise InputError("--save-map needs --rig with a file, and the --map options to be saved")
    machine = stated if stated.has_map else replace(stated, channel_map="auto")
    is_complete = True
    columns: dict[str, str] | None = None  # column of each channel; `auto` is resolved by the first readable file
    for file, recording in machine.read_all(files, joined=join):
        if recording is None:
            is_complete = False
            continue
        _, unsigned = restore_signs(recording)
        opt.say(overview_text(str(file), recording, (*find_defects(recording), *unsigned)))
        if columns is None:
            columns = _resolve_map(stated.channel_map, files if join else [file], recording)
    if not is_complete:
        raise Exit(1)
    if save_map and rig is not None:
        if not columns:
            own_names = "columns with the channels' own names"
            raise InputError(f"--save-map must have a map to save, got {own_names} ({files[0]})")
        save_channel_map(rig, columns)
        opt.say(f"map saved in {rig}: later calls with --rig {rig} use it")


def _resolve_map(channel_map: ChannelMap, files: Sequence[Path], recording: Recording) -> dict[str, str]:
    """Return the column of each channel in `channel_map`; `auto` is replaced by the columns that it found by name.

    `recording`: read by this map from `files`. With `auto` the result is empty for a recording that was converted from
    another file: its provenance states that file's columns, while its own columns have the channels' names.
    """
    from sealscope.recordings.formats.columns import explicit_columns, reconstruct_map, uses_names

    stated_columns = explicit_columns(channel_map)
    if not uses_names(channel_map):
        return stated_columns
    if recording.provenance.get("file") not in [file.name for file in files]:  # a joined one states its earliest file
        return {}
    return {**reconstruct_map(recording.provenance), **stated_columns}


@opt.with_machine_options("maps", "group", "rate")
def convert(
    source: Annotated[Path, Argument(help="Recording to read.")],
    target: Annotated[Path, Argument(help="Recording to write; its suffix tells the format.")],
    stated: opt.StatedMachine,  # built from the options that the decorator adds
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
    if target.resolve() == source.resolve():
        raise InputError(f"a converted recording must not replace its source, got {target}")
    recording = stated.read(source)
    write(recording, target)
    channels = ", ".join(recording.channels)
    opt.say_wrapped(f"{target}: {len(recording)} samples at {recording.rate:g} Hz, channels {channels}")
    for finding in inspect(recording):
        opt.say_wrapped(f"{finding.severity}: {finding.text}")


def _convert_parts(source: Path, folder: Path, stated: opt.StatedMachine, every: str) -> None:
    """Write the long recording `source` as parts of the length `every`, such as 1h, to a new or empty folder."""
    from sealscope.paragraphs import format_count
    from sealscope.recordings import inspect, read_parts, write
    from sealscope.units import parse_quantity

    length = parse_quantity(every, "s", name="--every")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"with --every, TARGET must be a new or empty folder, got {folder}")
    n_parts, n_samples = 0, 0
    for part in read_parts(source, length, map=stated.channel_map or None, rate=stated.rate):
        if not n_parts:  # not before a part is read, so that an unreadable source leaves no folder
            folder.mkdir(exist_ok=True)
        n_parts += 1
        n_samples += len(part)
        file = folder / f"{source.stem}_{n_parts:04d}.nc"
        write(part, file)
        findings = "".join(f"; {finding.text}" for finding in inspect(part) if finding.severity != "note")
        opt.say_wrapped(f"{file}: {part.duration:g} s from t = {part.t[0]:g} s{findings}")
    opt.say(f"{folder}: {format_count(n_parts, 'part')}, {n_samples} samples")
