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
) -> None:
    """Write a rig as an FMU for co-simulation: inputs command, leak, load; every parameter tunable; no Python in it."""
    from sealscope.fmu.build import write_fmu
    from sealscope.units import parse_quantity

    check_folder(output)
    variables = write_fmu(
        output,
        rig=rig_with(rig, overrides),
        fmi=version,  # type: ignore[arg-type]  # checked there
        platforms=platforms or None,
        error=parse_quantity(error, "Pa", name="error"),
        step=None if step is None else parse_quantity(step, "s", name="step"),
    )
    counts = {kind: sum(v.causality == kind for v in variables) for kind in ("input", "parameter", "output")}
    longest = next(v.start for v in variables if v.name == "step")
    typer.echo(
        f"{output}: FMI {version} for co-simulation, {counts['input']} inputs, {counts['parameter']} parameters, "
        f"{counts['output']} outputs, steps of at most {longest:.3g} s"
    )
