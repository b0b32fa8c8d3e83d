"""The command `hold`: a load that shut valves hold, judged by how it sinks."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Exit, Option

from sealscope.cli import options as opt
from sealscope.errors import InputError

if TYPE_CHECKING:
    from sealscope.diagnosis.hold.result import HoldResult

_FILES = "Logs of held loads: position, pressures or both; none with --collected."
_AREA = "Area of the piston, '3117 mm^2'; twice for sides A and B."
_VOLUME = "Volume of the held oil with its line, '1.2 L'; twice for A and B. [default: assumed]"
_LIMIT = "Largest creep or leak: '24 mm in 3 min', '15 mL/min', 'NAME: 0.3 mL/min at 200 bar'."
_OIL = "Oil that is not logged: '45 degC falling', 'rising' or 'steady'."
_AT = "Pressure to which the leak is converted, '200 bar'."
_COLLECTED = "Oil collected at the port of the unloaded side: '12 mL in 10 min'."
_VALVE = "Sides with a load-holding valve: A, B, 'A,B' or none. [default: not known]"
_LOADED = "Side that carries the load: A or B. [default: by the pressures, or by the motion]"
_CAPPED = "Sides whose port is capped at the cylinder: A, B, 'A,B' or none."


@opt.with_machine_options("maps", "group", "rate")
def hold(
    stated: opt.StatedMachine,  # built from the options that the decorator adds
    files: Annotated[list[Path] | None, Argument(metavar="FILE...", help=_FILES)] = None,
    area: Annotated[list[str] | None, Option("--area", metavar="AREA[unit]", help=_AREA)] = None,
    volume: Annotated[list[str] | None, Option("--volume", metavar="VOLUME[unit]", help=_VOLUME)] = None,
    limit: Annotated[str | None, Option("--limit", metavar="TEXT", help=_LIMIT)] = None,
    oil: Annotated[str | None, Option("--oil", metavar="TEXT", help=_OIL)] = None,
    reference: Annotated[str | None, Option("--at", metavar="PRESSURE[unit]", help=_AT)] = None,
    collected: Annotated[str | None, Option("--collected", metavar="TEXT", help=_COLLECTED)] = None,
    valve: Annotated[str | None, Option("--valve", metavar="SIDES", help=_VALVE)] = None,
    capped: Annotated[str | None, Option("--capped", metavar="SIDES", help=_CAPPED)] = None,
    loaded: Annotated[str | None, Option("--loaded", metavar="SIDE", help=_LOADED)] = None,
    start: Annotated[str | None, Option("--from", metavar="TIME", help="Start of the hold. [default: found]")] = None,
    end: Annotated[str | None, Option("--until", metavar="TIME", help="End of the hold. [default: found]")] = None,
    form: Annotated[Literal["text", "jsonl"], Option("--format", help="Text, or one JSON object a hold.")] = "text",
    output: Annotated[Path | None, Option("--output", "-o", help="Also write a page (.html, .pdf).")] = None,
) -> None:
    """Judge a held load: how fast it sinks, L/min past seal or valve, pass or fail against a limit.

    It needs no motion, pump or healthy recordings: shut the valves, hold a load for some minutes, log its position. The
    exit status is 1 if a file could not be judged.
    """
    from sealscope.diagnosis.hold.hold_test import hold_test
    from sealscope.diagnosis.hold.set_up import parse_set_up
    from sealscope.reporting.hold import hold_text, write_hold_page
    from sealscope.reporting.template import parse_page_path

    settings: dict[str, Any] = {
        "area": area or None, "volume": volume or None, "limit": limit, "oil": oil, "reference": reference,
        "collected": collected, "valve": valve, "capped": capped, "loaded": loaded, "start": start, "end": end,
    }  # fmt: skip
    parse_set_up(**settings)  # a wrong option is an error of the call, not of its first file
    if not files and collected is None:
        raise InputError("hold must have a file, or --collected 'VOLUME in TIME'")
    if output is not None:
        opt.check_folder(parse_page_path(output, card=False))
        if output.resolve() in {file.resolve() for file in files or ()}:
            raise InputError(f"a page must not replace a recording, got {output}")
    results: list[HoldResult] = []
    n_failed = 0
    if not files:
        results += hold_test(**settings)
    machine = stated if stated.has_map else opt.StatedMachine(channel_map="auto", rate=stated.rate)
    for file, recording in machine.read_all(files or []):
        work = partial(hold_test, recording, file=str(file), **settings)
        judged = None if recording is None else opt.attempt(file, work)
        n_failed += judged is None
        results += judged or ()
    for result in results:
        opt.say(json.dumps(result.as_dict(), allow_nan=False) if form == "jsonl" else hold_text(result))
    if output is not None and results:
        write_hold_page(results, output)
    if n_failed:
        raise Exit(1)
