"""The command that plans a recording: which command, load and duration find a leak, before anyone measures."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Annotated

import typer

from sealscope.cli.options import MachineOption, RigOption, SetOption, progress, rig_with


class PlanFormat(StrEnum):
    """How a plan is printed."""

    text = "text"
    json = "json"


def plan(
    rig: RigOption = "thesis",
    machine: MachineOption = None,
    find: Annotated[
        str | None,
        typer.Option("--find", metavar="FLOW", help="Leak to be found, under the usual duty: '0.005 L/min'."),
    ] = None,
    command: Annotated[str, typer.Option("--command", help="Command of the machine's usual duty.")] = "3 sin(4t)",
    load: Annotated[str, typer.Option("--load", help="Load of the usual duty: '500 N'.")] = "",
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Probability of an alarm on a leak-free recording.")
    ] = 0.01,
    detection: Annotated[
        float, typer.Option("--detection", help="Probability with which the leak is to be found.")
    ] = 0.9,
    overrides: SetOption = None,
    output: Annotated[PlanFormat, typer.Option("--format", help="Text, or one JSON object.")] = PlanFormat.text,
) -> None:
    """Plan the recording that finds a leak: command, load and duration, and whether it tells piston from pump.

    From the information of simulated leak-free recordings, by the test that diagnose judges with.
    """
    from sealscope.campaigns.smallest import PlannedDuty, plan_recording
    from sealscope.diagnosis.commissioned.machine_file import load_machine
    from sealscope.diagnosis.diagnose import check_probability
    from sealscope.errors import InputError
    from sealscope.units import parse_quantity

    check_probability(false_alarm)
    if not 0.5 <= detection < 1.0:
        raise InputError(f"--detection must be 0.5 to below 1, got {detection:g}")
    wanted = None if find is None else parse_quantity(find, "m^3/s", name="--find")
    if wanted is not None and not wanted > 0.0:
        raise InputError(f"--find must be a flow > 0, got {find}")
    known = rig_with(rig, overrides)
    if machine is not None:
        commissioned = load_machine(machine)
        if overrides:
            raise InputError(f"--set must not stand beside --machine, whose file states the rig ({machine})")
        if commissioned.rig is None or not commissioned.rig.states("cylinder.M_eq"):
            smallest = commissioned.summary.smallest
            shown = "" if smallest is None else f"; another recording like the healthy ones shows {smallest}"
            raise InputError(f"a plan simulates a machine: commission it by --rig ({machine}){shown}")
        known = commissioned.rig
    with progress() as update:
        planned = plan_recording(
            known,
            wanted,
            usual=PlannedDuty(command, load),
            false_alarm=false_alarm,
            detection=detection,
            progress=update,
        )
    typer.echo(json.dumps(planned.as_dict(), allow_nan=False) if output is PlanFormat.json else planned.text())
