"""The command `plan`, which finds the command, load and duration of a recording that detects a leak."""

from __future__ import annotations

import json
from typing import Annotated, Literal

from typer import Option, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError

_HELD = "Plan a locked hold, too: the load that the cylinder holds with its valves shut ('2 kN')."
_FIND = "Leak to be found, under the usual duty: '0.005 L/min'."


def plan(
    rig: opt.RigOption = "thesis",
    machine: opt.MachineOption = None,
    find: Annotated[str | None, Option(metavar="FLOW", help=_FIND)] = None,
    command: Annotated[str, Option(help="Command of the machine's usual duty.")] = "3 sin(4t)",
    load: Annotated[str, Option(help="Load of the usual duty: '500 N'.")] = "",
    hold: Annotated[str | None, Option(metavar="FORCE", help=_HELD)] = None,
    false_alarm: opt.FalseAlarmOption = opt.FALSE_ALARM_PROBABILITY,
    detection: Annotated[float, Option(help="Probability with which the leak is to be found.")] = 0.9,
    overrides: opt.SetOption = None,
    output: Annotated[Literal["text", "json"], Option("--format", help="Text, or one JSON object.")] = "text",
) -> None:
    """Plan the recording that finds a leak: its command, load and duration.

    The plan also says whether the recording tells a leak of the piston from one of the pump. It uses simulated
    leak-free recordings and the statistical test of diagnose.
    """
    from sealscope.campaigns.smallest import PlannedDuty, plan_recording
    from sealscope.diagnosis.commissioned.machine_file import read_machine
    from sealscope.diagnosis.diagnose import check_probability
    from sealscope.units import parse_quantity

    check_probability(false_alarm)
    if not 0.5 <= detection < 1.0:
        raise InputError(f"--detection must be 0.5 to below 1, got {detection:g}")
    leak_flow = None if find is None else parse_quantity(find, "m^3/s", name="--find")
    if leak_flow is not None and not leak_flow > 0.0:
        raise InputError(f"--find must be a flow > 0, got {find}")
    hold_force = None if hold is None else parse_quantity(hold, "N", name="--hold")
    if hold_force is not None and not hold_force > 0.0:
        raise InputError(f"--hold must be a force > 0, got {hold}")
    planned_rig = opt.load_rig_with(rig, overrides)
    if machine is not None:
        commissioned_machine = read_machine(machine)
        if overrides:
            raise InputError(f"--set cannot be combined with --machine, whose file states the rig ({machine})")
        # the mass shows whether a whole rig was stated, as nobody states the mass alone
        if commissioned_machine.rig is None or not commissioned_machine.rig.states("cylinder.M_eq"):
            smallest = commissioned_machine.summary.smallest
            hint = "" if smallest is None else f"; another recording like the healthy ones shows {smallest}"
            raise InputError(f"a plan simulates the machine, so it must be commissioned with --rig ({machine}){hint}")
        planned_rig = commissioned_machine.rig
    with opt.progress() as update:
        recording_plan = plan_recording(
            planned_rig, leak_flow, usual=PlannedDuty(command, load), held=hold_force, false_alarm=false_alarm,
            detection=detection, progress=update,
        )  # fmt: skip
    echo(json.dumps(recording_plan.as_dict(), allow_nan=False) if output == "json" else recording_plan.text())
