"""The command that writes a rig as a functional mock-up unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sealscope.cli.options import RigOption, SetOption, check_folder, rig_with


def fmu(
    output: Annotated[Path, typer.Option("--output", "-o", help="Unit to write (.fmu).")],
    rig: RigOption = "thesis",
    overrides: SetOption = None,
    version: Annotated[int, typer.Option("--fmi", help="Version of the interface, 2 or 3.")] = 2,
    platforms: Annotated[
        list[str] | None,
        typer.Option(
            "--platform",
            help="System it shall run on: linux, windows, macos; FMI 3 also macos-arm, linux-arm; repeat. By default "
            "this one; others need the extra `fmu`.",
        ),
    ] = None,
    error: Annotated[
        str, typer.Option("--error", help="Error that a pressure may have, by which the solver's step is chosen.")
    ] = "1[Pa]",
    step: Annotated[str | None, typer.Option("--step", help="Longest step of the solver [s] instead.")] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            "--sensor",
            help="Write a soft sensor of leakage instead: volume, which reads the chamber pressures, the pump's angle "
            "and the piston's position.",
        ),
    ] = None,
    rate: Annotated[str | None, typer.Option("--rate", help="Sampling rate of the soft sensor (500 Hz).")] = None,
) -> None:
    """Write a rig as an FMU for co-simulation, or a soft sensor of its leakage; no Python in it.

    The rig has the inputs command, leak and load, and every parameter can be tuned. The soft sensor takes readings and
    gives the leakage in m^3/s with its 95 % interval.
    """
    from sealscope.errors import InputError
    from sealscope.fmu.build import write_fmu, write_sensor_fmu
    from sealscope.units import parse_quantity

    check_folder(output)
    machine = rig_with(rig, overrides)
    if sensor is None:
        if rate is not None:
            raise InputError("--rate is of a soft sensor, got it without --sensor")
        variables = write_fmu(
            output,
            rig=machine,
            fmi=version,  # type: ignore[arg-type]  # checked there
            platforms=platforms or None,
            error=parse_quantity(error, "Pa", name="error"),
            step=None if step is None else parse_quantity(step, "s", name="step"),
        )
        takes = f"steps of at most {next(v.start for v in variables if v.name == 'step'):.3g} s"
    else:
        if step is not None:
            raise InputError("--step is of a rig's solver, got it with --sensor")
        hertz = 500.0 if rate is None else parse_quantity(rate, "Hz", name="rate")
        variables = write_sensor_fmu(
            output,
            sensor=sensor,  # type: ignore[arg-type]  # checked there
            rig=machine,
            rate=hertz,
            fmi=version,  # type: ignore[arg-type]
            platforms=platforms or None,
        )
        takes = f"samples at {hertz:g} Hz"
    counts = {kind: sum(v.causality == kind for v in variables) for kind in ("input", "parameter", "output")}
    typer.echo(
        f"{output}: FMI {version} for co-simulation, {counts['input']} inputs, {counts['parameter']} parameters, "
        f"{counts['output']} outputs, {takes}"
    )
