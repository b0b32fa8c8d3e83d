"""The command `commission`."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from sealscope.cli.options import (
    AreaOption,
    AssumeOption,
    DisplacementOption,
    LimitOption,
    MapOption,
    RateOption,
    StatedMachine,
    check_folder,
    say,
)
from sealscope.errors import InputError


def commission(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Healthy recordings of the machine, or a folder of them.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The machine's file to write (.toml).")],
    rig: AssumeOption = None,
    area: AreaOption = None,
    displacement: DisplacementOption = None,
    maps: MapOption = None,
    rate: RateOption = None,
    limit: LimitOption = None,
    add: Annotated[
        bool,
        typer.Option(
            "--add", help="Add recordings that are confirmed healthy to the machine's file; the old one is kept (.bak)."
        ),
    ] = False,
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="DATE", help="With --add: forget recordings before DATE, as after a repair."),
    ] = None,
) -> None:
    """Learn a machine from healthy recordings, once: its terms, sensors, scatter, and the smallest leak it will show.

    `diagnose`, `trend`, `report` and `monitor` take the file by --machine.
    """
    from sealscope.diagnosis.commissioned.machine import JudgedAlarm, checksum_of, recordings_in
    from sealscope.diagnosis.commissioned.machine import commission as commissioned
    from sealscope.diagnosis.commissioned.machine_file import load_machine, write_machine

    if output.suffix.lower() != ".toml":
        raise InputError(f"a machine's file must end in .toml, got {output}")
    if since is not None and not add:
        raise InputError("--since must stand with --add, for a machine that is known")
    check_folder(output)
    if add:
        stated = {"--rig": rig, "--area": area, "--displacement": displacement, "--map": maps, "--rate": rate}
        for name, value in {**stated, "--limit": limit}.items():
            if value:
                raise InputError(f"{name} must not stand beside --add: the machine's file states it")
        machine = load_machine(output)
        if since is not None:
            repair = JudgedAlarm("", "repaired", _date(since), _date(since))
            machine = replace(machine, alarms=(*machine.alarms, repair))
        for path in recordings_in(files):
            machine = machine.with_healthy(machine.read(path), file=path.name, checksum=checksum_of(path))
        if since is not None:
            machine = machine.since(_date(since))
    else:
        if output.exists():
            raise InputError(f"a machine's file must be new, got {output}, which exists; --add adds recordings to it")
        own = StatedMachine.of(None, maps, rate, rig, area, displacement, limit)
        columns = own.channel_map or None
        machine = commissioned(files, rig=own.rig, map=columns, rate=rate, limit=limit, name=output.stem)
    write_machine(machine, output)
    say(f"{output}:\n{machine}")


def _date(text: str) -> float:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--since must be a date such as 2026-11-25, got {text!r}") from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
