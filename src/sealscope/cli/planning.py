"""The command `plan`, which finds the command, load and duration of a recording that detects a leak."""

from __future__ import annotations

import json
from typing import Annotated, Literal

from typer import Option, echo

from sealscope.cli import options as opt
from sealscope.errors import InputError

_HELD = "Plan a hold test, too: the load that the cylinder holds with its valves shut ('2 kN')."
_AREA = "Area of the loaded side, '3117 mm^2': with --hold, plan the hold test alone, without a rig."
_VOLUME = "Volume of the held oil with its line, '1.2 L'. [default: half a metre of the area]"
_RESOLUTION = "Step of the position's encoder, '0.1 mm'."
_DRIFT = "Change of the oil's temperature that nobody logs, '3 K'."
_FIND = "Leak to be found, under the usual duty: '0.005 L/min'."


def plan(
    rig: opt.RigOption = "thesis",
    machine: opt.MachineOption = None,
    find: Annotated[str | None, Option(metavar="FLOW", help=_FIND)] = None,
    command: Annotated[str, Option(help="Command of the machine's usual duty.")] = "3 sin(4t)",
    load: Annotated[str, Option(help="Load of the usual duty: '500 N'.")] = "",
    hold: Annotated[str | None, Option(metavar="FORCE", help=_HELD)] = None,
    area: Annotated[str | None, Option("--area", metavar="AREA[unit]", help=_AREA)] = None,
    volume: Annotated[str | None, Option("--volume", metavar="VOLUME[unit]", help=_VOLUME)] = None,
    resolution: Annotated[str, Option("--resolution", metavar="LENGTH[unit]", help=_RESOLUTION)] = "0.1 mm",
    drift: Annotated[str, Option("--drift", metavar="KELVIN", help=_DRIFT)] = "0 K",
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
    if area is not None:
        _plan_hold_alone(hold_force, leak_flow, area, volume, resolution, drift, detection, output)
        return
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


def _plan_hold_alone(
    force: float | None, find: float | None, area: str, volume: str | None, resolution: str, drift: str,
    detection: float, output: str,
) -> None:  # fmt: skip
    """Print the plan of a hold test, by the formula of its fit, from the options of `plan`."""
    from sealscope.diagnosis.hold.plan import plan_hold
    from sealscope.diagnosis.hold.set_up import parse_set_up
    from sealscope.diagnosis.priors.hold import HOLD
    from sealscope.units import parse_quantity

    if force is None:
        raise InputError("--area needs --hold FORCE, the load of a hold test")
    set_up = parse_set_up(area, volume)
    length = set_up.volumes[0] / set_up.areas[0] if set_up.volumes else HOLD.column.unknown
    step = parse_quantity(resolution, "m", name="--resolution")
    warming = parse_quantity(drift, "K", name="--drift")
    for name, number, most, unit in (("resolution", 1e3 * step, 10.0, "mm"), ("drift", warming, 100.0, "K")):
        if not 0.0 <= number <= most:
            raise InputError(f"--{name} must be 0 to {most:g} {unit}, got {number:g} {unit}: is its unit right?")
    known = HOLD.column.stated if set_up.volumes else HOLD.column.deviation
    planned = plan_hold(
        force, set_up.areas[0], length, step, warming=warming, find=find, detection=detection, length_deviation=known
    )
    echo(json.dumps(planned.as_dict(), allow_nan=False) if output == "json" else planned.text())
