"""The command `commission`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from sealscope.cli.options import StatedMachine, check_folder, say, with_machine_options
from sealscope.errors import InputError

_FILES = "Healthy recordings of the machine, or a folder of them; or results of `hold --format jsonl`."
_ADD = "Add recordings that are confirmed healthy to the machine's file; the old one is kept (.bak)."
_KEEP = "Keep recordings that look leaking compared with the others; else they are left out."
_SINCE = "With --add: forget recordings before DATE, as after a repair."


@with_machine_options("rig", "area", "displacement", "maps", "group", "rate", "limit")
def commission(
    files: Annotated[list[Path], Argument(metavar="FILE...", help=_FILES)],
    output: Annotated[Path, Option("--output", "-o", help="The machine's file to write (.toml).")],
    stated: StatedMachine,  # built from the options that the decorator adds
    add: Annotated[bool, Option("--add", help=_ADD)] = False,
    keep: Annotated[bool, Option("--keep", help=_KEEP)] = False,
    since: Annotated[str | None, Option("--since", metavar="DATE", help=_SINCE)] = None,
) -> None:
    """Learn a machine once from healthy recordings: its model terms, sensors, scatter and smallest detectable leak.

    `diagnose`, `trend`, `report` and `monitor` use the file with --machine.
    """
    from sealscope.diagnosis.commissioned.machine import CommissionedMachine, JudgedAlarm, recordings_in
    from sealscope.diagnosis.commissioned.machine import commission as learn_machine
    from sealscope.diagnosis.commissioned.machine_file import update_machine, write_machine
    from sealscope.diagnosis.hold.recorded_holds import is_hold_results

    if output.suffix.lower() != ".toml":
        raise InputError(f"a machine's file must end in .toml, got {output}")
    if since is not None and not add:
        raise InputError("--since needs --add: it drops recordings from the file of a known machine")
    check_folder(output)
    if add:
        if keep:
            raise InputError("--keep cannot be combined with --add: added recordings are confirmed healthy")
        if stated != StatedMachine():
            raise InputError(
                "--rig, --area and other options of the machine cannot be combined with --add: its file states them"
            )
        repair_s = None if since is None else _parse_date(since)
        paths = recordings_in(files)

        def add_recordings(machine: CommissionedMachine) -> CommissionedMachine:
            """Add the files to the healthy recordings of a machine; after a repair, note it and drop earlier ones."""
            if repair_s is not None:
                # before recordings are added: none is taken from the time of a confirmed leak, which the mark ends
                repair_mark = JudgedAlarm(alarm="", mark="repaired", date_s=repair_s, onset_s=repair_s)
                machine = replace(machine, alarms=(*machine.alarms, repair_mark))
            for path in paths:
                if is_hold_results(path):
                    machine = machine.with_holds(path)
                else:
                    machine = machine.with_healthy(machine.read(path), file=path.name)
            undated = [recording.file for recording in machine.healthy if recording.start_s is None]
            if repair_s is not None and (lost := [path.name for path in paths if path.name in undated]):
                raise InputError(f"a recording added with --since must have a date, got none of {lost[0]}")
            return machine if repair_s is None else machine.since(repair_s)

        machine = update_machine(output, add_recordings)
    else:
        if output.exists():
            raise InputError(f"a machine's file must be new, got {output}, which exists; --add adds recordings to it")
        machine = learn_machine(
            files, rig=stated.rig, map=stated.channel_map or None, rate=stated.rate, limit=stated.limit,
            name=output.stem, keep=keep,
        )  # fmt: skip
        write_machine(machine, output)
    say(f"{output}:\n{machine}")


def _parse_date(text: str) -> float:
    """Parse the date of `--since` to seconds since 1970; it is in UTC unless it states a time zone."""
    from sealscope.diagnosis.commissioned.machine_file import parse_moment

    try:
        return parse_moment(text)
    except ValueError:
        raise InputError(f"--since must be a date such as 2026-11-25, got {text!r}") from None
