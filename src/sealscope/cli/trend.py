"""The command that follows a machine over its recordings: trend."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sealscope.cli.options import (
    FAILED_ON,
    AreaOption,
    AssumeOption,
    DisplacementOption,
    LimitOption,
    MachineOption,
    MapOption,
    RateOption,
    assumed_rig,
    attempt,
    channel_map_of,
    check_folder,
    progress,
    refuse_beside_machine,
    say,
)
from sealscope.errors import InputError, UnreadableFile

if TYPE_CHECKING:
    from sealscope.diagnosis.trend.reading import LeakReading
    from sealscope.parameters import Rig
    from sealscope.recordings.recording import Recording


class TrendFormat(StrEnum):
    """How a trend is printed."""

    text = "text"
    json = "json"
    csv = "csv"


def _readings(
    files: Sequence[Path], reader: Callable[[Path], Recording], rig: Rig | None
) -> Iterator[LeakReading | None]:
    """Yield what each file states of the leakage, None for one that cannot be read."""
    from sealscope.diagnosis.trend.reading import reading_of

    with progress() as update:
        for k, file in enumerate(files):
            recording = attempt(file, partial(reader, file))
            reading = None
            if recording is not None:
                reading = attempt(file, partial(reading_of, recording, rig, file.name))
            yield reading
            update("recordings", (k + 1) / len(files))


def trend(
    context: typer.Context,
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Recordings of a single machine, or a folder of them.")
    ],
    output_format: Annotated[
        TrendFormat, typer.Option("--format", help="Text, one JSON object, or a table.")
    ] = TrendFormat.text,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Also write a page (.html, .pdf), or .json, or .csv.")
    ] = None,
    healthy: Annotated[
        int, typer.Option("--healthy", help="How many of the first recordings are known to be of a healthy machine.")
    ] = 1,
    limit: LimitOption = None,
    years: Annotated[
        float, typer.Option("--years", help="Machine-years in which a healthy machine has one false alarm.")
    ] = 10.0,
    every: Annotated[
        str | None,
        typer.Option(
            "--every", metavar="TIME", help="Time from one recording to the next (1d, 12h), of files that state none."
        ),
    ] = None,
    maps: MapOption = None,
    rate: RateOption = None,
    machine: MachineOption = None,
    rig: AssumeOption = None,
    area: AreaOption = None,
    displacement: DisplacementOption = None,
    fail_on: Annotated[
        list[str] | None, typer.Option("--fail-on", help="End with status 3 on this verdict; repeat.")
    ] = None,
) -> None:
    """Follow a machine over its recordings: L/min, change, growth, and when it reaches the limit.

    Exit status 1 where a file could not be read.
    """
    from sealscope.diagnosis.commissioned.machine import recordings_in
    from sealscope.diagnosis.commissioned.machine_file import load_machine
    from sealscope.diagnosis.trend.trend import trend_of
    from sealscope.diagnosis.verdict.severity import RepairLimit
    from sealscope.recordings import read
    from sealscope.recordings.formats.columns import check_call
    from sealscope.reporting.trend.page import write_trend_page
    from sealscope.reporting.trend.text import trend_csv, trend_text
    from sealscope.units import parse_quantity

    if wrong := [verdict for verdict in fail_on or () if verdict not in ("leak", "no leak", "cannot tell")]:
        raise InputError(f"--fail-on must be leak, no leak or cannot tell, got {wrong[0]!r}")
    if machine is not None:
        refuse_beside_machine(None, maps, rate, rig, area, displacement, limit)
        known = load_machine(machine)
        reader, assumed, limit = known.read, known.rig, known.limit
    else:
        reader = partial(read, map=channel_map_of(maps) or None, rate=rate)
        assumed = assumed_rig(rig, area, displacement)
    check_call(channel_map_of(maps), rate)
    RepairLimit.of(limit)
    spacing = None if every is None else parse_quantity(every, "s", name="--every")
    if output is not None:
        _check_output(output, files)
    paths = recordings_in(files)
    read_each = list(_readings(paths, reader, assumed))
    readings = [reading for reading in read_each if reading is not None]
    if not readings:
        raise UnreadableFile("no recording could be read, so there is no trend")
    result = trend_of(readings, healthy=healthy, limit=limit, years=years, every=spacing)
    whole = bool(context.find_root().params.get("verbose"))
    texts = {
        "text": lambda: trend_text(result, whole=whole),
        "json": lambda: json.dumps(result.as_dict(), allow_nan=False, indent=1),
        "csv": lambda: trend_csv(result).rstrip("\n"),
    }
    say(texts[output_format.value]())
    if output is not None:
        kind = output.suffix[1:].lower()
        if kind in texts:
            _write(output, texts[kind]() + "\n")
        else:
            write_trend_page(output, result, title=files[0].resolve().name if files[0].is_dir() else "")
    failed = result.verdict in (fail_on or ())
    if failed or len(readings) < len(read_each):
        raise typer.Exit(FAILED_ON if failed else 1)


def _check_output(output: Path, files: Sequence[Path]) -> None:
    if output.suffix.lower() not in (".json", ".csv"):
        from sealscope.reporting.template import check_page

        check_page(output, card=False)
    if output.resolve() in {file.resolve() for file in files}:
        raise InputError(f"a trend must not replace a recording, got {output}")
    check_folder(output)


def _write(output: Path, text: str) -> None:
    from sealscope.storage.atomic import atomic_write

    with atomic_write(output) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")  # a file's name
