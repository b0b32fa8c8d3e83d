"""The command that shows a machine over its recordings: trend."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Context, Exit, Option

from sealscope.cli import options as opt
from sealscope.errors import InputError, UnreadableFile

_FILES = "Recordings of a single machine, or a folder of them."
_OUTPUT = "Also write a page (.html, .pdf), or .json, or .csv."
_HEALTHY = "How many of the first recordings are known to be of a healthy machine."
_YEARS = "Machine-years in which a healthy machine has one false alarm."
_EVERY = "Time from one recording to the next (1d, 12h), of files that state none."


@opt.stating("machine", "maps", "rate", "rig", "area", "displacement", "limit")
def trend(
    context: Context,
    files: Annotated[list[Path], Argument(metavar="FILE...", help=_FILES)],
    stated: opt.StatedMachine,
    form: Annotated[Literal["text", "json", "csv"], Option("--format", help="Text, a JSON object, a table.")] = "text",
    output: Annotated[Path | None, Option("--output", "-o", help=_OUTPUT)] = None,
    healthy: Annotated[int, Option(help=_HEALTHY)] = 1,
    years: Annotated[float, Option(help=_YEARS)] = 10.0,
    every: Annotated[str | None, Option(metavar="TIME", help=_EVERY)] = None,
    fail_on: opt.FailOnOption = None,
) -> None:
    """Show a machine over its recordings: L/min, change, growth, and when it reaches the limit.

    Exit status 1 where a file could not be read.
    """
    from sealscope.diagnosis.commissioned.machine import recordings_in
    from sealscope.diagnosis.trend.reading import reading_of
    from sealscope.diagnosis.trend.trend import trend as trend_of
    from sealscope.diagnosis.verdict.diagnosis import machine_name_of
    from sealscope.recordings.formats.headings.preamble import remarks_of
    from sealscope.recordings.joining import file_seconds
    from sealscope.reporting.trend.page import write_trend_page
    from sealscope.reporting.trend.text import trend_csv, trend_text
    from sealscope.units import parse_quantity

    spacing = None if every is None else parse_quantity(every, "s", name="--every")
    if output is not None:
        _check_output(output, files)
    paths, readings, undated = recordings_in(files), [], 0
    name = "" if stated.known is None else stated.known.name
    with opt.progress() as update:
        for k, (file, recording) in enumerate(stated.read_all(paths)):
            if recording is not None:
                name = name or machine_name_of(remarks_of(recording.provenance)) or ""
                reading = opt.attempt(file, partial(reading_of, recording, stated.rig, file.name))
                if reading is not None and reading.start is None and spacing is None:
                    reading, undated = replace(reading, start=file_seconds(recording, file)), undated + 1
                readings += [] if reading is None else [reading]
            update("recordings", (k + 1) / len(paths))
    if undated:
        opt.complain(f"{undated} of {len(paths)} files state no time: that of their last change is taken (--every)")
    if not readings:
        raise UnreadableFile("no recording could be read, so there is no trend")
    result = trend_of(readings, healthy=healthy, limit=stated.limit, years=years, every=spacing)
    texts = {
        "text": lambda: trend_text(result, whole=opt.verbose(context)),
        "json": lambda: json.dumps(result.as_dict(), allow_nan=False, indent=1),
        "csv": lambda: trend_csv(result).rstrip("\n"),
    }
    opt.say(texts[form]())
    if output is not None:
        kind = output.suffix[1:].lower()
        if kind in texts:
            opt.write_text(output, texts[kind]() + "\n")
        else:
            write_trend_page(output, result, title=name)
    failed = result.verdict in (fail_on or ())
    if failed or len(readings) < len(paths):
        raise Exit(opt.FAILED_ON if failed else 1)


def _check_output(output: Path, files: Sequence[Path]) -> None:
    from sealscope.reporting.template import check_page

    if output.suffix.lower() not in (".json", ".csv"):
        check_page(output, card=False)
    if output.resolve() in {file.resolve() for file in files}:
        raise InputError(f"a trend must not replace a recording, got {output}")
    opt.check_folder(output)
