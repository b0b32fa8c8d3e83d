"""The commands on rigs: list the packaged ones, write a file for another machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sealscope.cli.options import check_folder
from sealscope.errors import InputError

rigs = typer.Typer(name="rigs", help="List the packaged rigs; `rigs new` writes a file for another machine.")


@rigs.callback(invoke_without_command=True)
def list_rigs(context: typer.Context) -> None:
    """List the packaged rigs; `rigs new` writes a file for another machine."""
    if context.invoked_subcommand is not None:
        return
    from sealscope.parameters import load_rig, rig_names

    width = max(map(len, rig_names()))
    for name in rig_names():
        typer.echo(f"{name:<{width}}  {load_rig(name).title}")


@rigs.command()
def new(
    name: Annotated[str, typer.Argument(help="Name of the rig; the file is NAME.toml unless `-o` says otherwise.")],
    area_A: Annotated[
        str, typer.Option("--area-A", help="Piston area on side A.", prompt="Piston area on side A [mm^2]")
    ],
    area_B: Annotated[
        str,
        typer.Option(
            "--area-B", help="Piston area on side B: with the rod, if there is one.", prompt="... on side B [mm^2]"
        ),
    ],
    stroke: Annotated[str, typer.Option("--stroke", help="Stroke.", prompt="Stroke [mm]")],
    displacement: Annotated[
        str,
        typer.Option("--displacement", help="Displacement of the pump.", prompt="Displacement of the pump [cm^3/rev]"),
    ],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write (.toml).")] = None,
) -> None:
    """Write a commented rig file from areas, stroke and displacement.

    A number without a unit is in mm^2, mm or cm^3/rev.
    """
    from sealscope.parameters import load_rig
    from sealscope.parameters.new_rig import rig_text
    from sealscope.storage.atomic import atomic_write
    from sealscope.units import parse_quantity

    def si(text: str, si_unit: str, usual: str, option: str) -> float:
        try:
            float(text)
        except ValueError:
            return parse_quantity(text, si_unit, name=option)
        return parse_quantity(f"{text}[{usual}]", si_unit, name=option)

    text = rig_text(
        name,
        si(area_A, "m^2", "mm^2", "--area-A"),
        si(area_B, "m^2", "mm^2", "--area-B"),
        si(stroke, "m", "mm", "--stroke"),
        si(displacement, "m^3/rev", "cm^3/rev", "--displacement"),
    )
    path = output or Path(f"{name}.toml")
    if path.suffix != ".toml":
        raise InputError(f"a rig's file must end in .toml, got {path}")
    check_folder(path)
    if path.exists():
        raise InputError(f"a rig's file must be new, got {path}, which exists")
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    loaded = load_rig(path)
    typer.echo(f"{path}: {loaded.title}")
    typer.echo(f"replace what is assumed (grep 'assumed:' {path}), then: sealscope simulate --rig {path} -o run.nc")
