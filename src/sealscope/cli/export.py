"""The command `export`, which writes the estimator of a machine's stream for a controller."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from sealscope.cli.options import say
from sealscope.errors import InputError

_LANGUAGE = "c: C99; st: Structured Text (IEC 61131-3) as .st, PLCopen XML and .scl."
_RATE = "Samples a second of the controller, '100 Hz'; by default those of the healthy recordings."
_FLOW = "Channel of the pump's flow: theta, omega or q_pump; by default that of the healthy recordings."
_LEARN = "Healthy recording from which the program begins to know the machine; repeat."


def export(
    language: Annotated[str, Argument(help=_LANGUAGE)],
    output: Annotated[Path, Option("--output", "-o", help="Folder to write into.")],
    machine: Annotated[Path | None, Option(help="File of a commissioned machine (.toml).")] = None,
    rig: Annotated[str | None, Option(help="Without --machine: name or file of a rig (thesis).")] = None,
    rate: Annotated[str | None, Option(help=_RATE)] = None,
    flow: Annotated[str | None, Option(help=_FLOW)] = None,
    alarms: Annotated[float, Option("--false-alarms", help="False alarms in 1000 h of a healthy machine.")] = 1.0,
    learn: Annotated[list[Path] | None, Option(metavar="FILE", help=_LEARN)] = None,
    precision: Annotated[str, Option(help="Of C's real numbers: double or single (with --learn).")] = "double",
    prefix: Annotated[str, Option(help="Beginning of all names.")] = "leak",
) -> None:
    """Write the estimator of a machine's leakage, with alarm, for a controller or PLC.

    It estimates leakage and leak in m^3/s with 95 % intervals from chamber pressures, the pump's flow and the position.
    """
    from sealscope.diagnosis.commissioned.machine_file import read_machine
    from sealscope.diagnosis.commissioned.watched import measured_rig
    from sealscope.emit.export import controller_inputs, export_controller
    from sealscope.parameters import load_rig
    from sealscope.recordings import read
    from sealscope.units import parse_quantity

    if machine is not None and rig is not None:
        raise InputError("--rig cannot be combined with --machine, whose file states the sizes")
    known = None if machine is None else read_machine(machine)
    sizes = load_rig(rig or "thesis") if known is None else measured_rig(known)
    paths = learn or []
    recordings = [read(path, map="auto") if known is None else known.read(path) for path in paths]
    learned_rate, learned_flow = None, None
    if known is not None and known.healthy and not paths:
        learned_rate, learned_flow = controller_inputs(known.healthy[-1])
    written = export_controller(
        output,
        language=language,  # type: ignore[arg-type]
        rig=sizes,
        rate=learned_rate if rate is None else parse_quantity(rate, "Hz", name="rate"),
        flow=flow or learned_flow,
        false_alarms_per_1000_h=alarms,
        learn=recordings,
        precision=precision,  # type: ignore[arg-type]
        prefix=prefix,
        origin="" if machine is None else machine.name,
    )
    names = ", ".join(path.name for path in written.files)
    lines = [
        f"{output}: {names}",
        f"{written.rate:g} Hz, state {written.state_bytes} bytes, {written.parts_a_sample} parts a sample",
    ]
    if paths:
        lines.append(f"learned from {written.learned_blocks} blocks, recordings: {len(paths)}")
    if written.single_error is not None:
        lines.append(f"single precision errs by at most {written.single_error:.2g} standard deviations of a block")
    say("\n".join(lines))
