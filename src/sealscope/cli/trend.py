"""The command `trend`, which shows a machine over its recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Context, Exit, Option

from sealscope.cli import options as opt
from sealscope.errors import InputError, UnreadableFile

if TYPE_CHECKING:
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine
    from sealscope.diagnosis.trend.reading import LeakReading

_FILES = "Recordings of a single machine, or a folder of them; or results of `hold --format jsonl`."
_OUTPUT = "Also write a page (.html, .pdf), or .json, or .csv."
_HEALTHY = "How many of the first recordings are known to be healthy; by default those that --machine knows."
_YEARS = "Machine-years in which a healthy machine has one false alarm."
_EVERY = "Time from one recording to the next (1d, 12h), of files that state none."


@opt.with_machine_options("machine", "maps", "group", "rate", "rig", "area", "displacement", "limit")
def trend(
    context: Context,
    files: Annotated[list[Path], Argument(metavar="FILE...", help=_FILES)],
    stated: opt.StatedMachine,  # built from the options that the decorator adds
    form: Annotated[Literal["text", "json", "csv"], Option("--format", help="Text, a JSON object, a table.")] = "text",
    output: Annotated[Path | None, Option("--output", "-o", help=_OUTPUT)] = None,
    healthy: Annotated[int | None, Option(help=_HEALTHY)] = None,
    years: Annotated[float, Option(help=_YEARS)] = 10.0,
    every: Annotated[str | None, Option(metavar="TIME", help=_EVERY)] = None,
    fail_on: opt.FailOnOption = None,
) -> None:
    """Show a machine over its recordings: L/min, change, growth, and the date at which it reaches the limit.

    The exit status is 1 if a file could not be read.
    """
    from sealscope.diagnosis.commissioned.machine import recordings_in
    from sealscope.diagnosis.hold.recorded_holds import is_hold_results, read_hold_results
    from sealscope.diagnosis.trend.machine_trend import trend as trend_of
    from sealscope.diagnosis.trend.reading import estimate_reading, hold_reading
    from sealscope.diagnosis.verdict.diagnosis import find_machine_name
    from sealscope.recordings.header import file_seconds
    from sealscope.reporting.trend.page import write_trend_page
    from sealscope.reporting.trend.text import trend_csv, trend_text
    from sealscope.units import parse_quantity

    spacing = None if every is None else parse_quantity(every, "s", name="--every")
    paths = recordings_in(files)
    if output is not None:
        _check_output(output, paths)
    readings: list[LeakReading] = []
    n_undated = n_failed = 0
    name = "" if stated.commissioned is None else stated.commissioned.name
    results = [path for path in paths if is_hold_results(path)]
    for path in results:
        holds = opt.attempt(path, partial(read_hold_results, path))
        n_failed += holds is None
        readings += map(hold_reading, holds or ())
    with opt.progress() as update:
        for k, (file, recording) in enumerate(stated.read_all([path for path in paths if path not in results])):
            n_readings = len(readings)
            if recording is not None:
                name = name or find_machine_name(recording.remarks) or ""
                reading = opt.attempt(file, partial(estimate_reading, recording, stated.rig, file.name))
                if reading is not None and reading.start is None and spacing is None:
                    reading = replace(reading, start=file_seconds(recording, file))
                    n_undated += 1
                if reading is not None:
                    readings.append(reading)
            n_failed += len(readings) == n_readings
            update("recordings", (k + 1) / len(paths))
    if n_undated:
        opt.complain(f"{n_undated} of {len(paths)} files state no time: that of their last change is taken (--every)")
    if not readings:
        raise UnreadableFile("no recording could be read, so there is no trend")
    if healthy is None:
        n_known = 0 if stated.commissioned is None else _count_known(readings, stated.commissioned)
        healthy = max(1, n_known)  # the first recording is always taken as healthy
    result = trend_of(readings, healthy=healthy, limit=stated.limit, years=years, every=spacing)
    formatters = {
        "text": lambda: trend_text(result, whole=opt.is_verbose(context)),
        "json": lambda: json.dumps(result.as_dict(), allow_nan=False, indent=1),
        "csv": lambda: trend_csv(result).rstrip("\n"),
    }
    opt.say(formatters[form]())
    if output is not None:
        kind = output.suffix[1:].lower()
        if kind in formatters:
            opt.write_text(output, formatters[kind]() + "\n")
        else:
            write_trend_page(output, result, title=name)
    is_failure = result.verdict in (fail_on or ())
    if is_failure or n_failed:
        raise Exit(opt.FAILED_ON if is_failure else 1)


def _count_known(readings: Sequence[LeakReading], machine: CommissionedMachine) -> int:
    """Count the first `readings`, in the order of their dates, whose recordings the machine's file lists as healthy.

    Recordings without a date come first, and copies count once.
    """
    known = {recording.digest for recording in machine.healthy}
    by_date = sorted(readings, key=lambda reading: -math.inf if reading.start is None else reading.start)
    return len({reading.digest for reading in takewhile(lambda reading: reading.digest in known, by_date)})


def _check_output(output: Path, files: Sequence[Path]) -> None:
    """Check that a trend can be written to `output` and replaces none of the `files`, or raise InputError."""
    from sealscope.reporting.template import parse_page_path

    if output.suffix.lower() not in (".json", ".csv"):
        parse_page_path(output, card=False)
    if output.resolve() in {file.resolve() for file in files}:
        raise InputError(f"a trend must not replace a recording, got {output}")
    opt.check_folder(output)
