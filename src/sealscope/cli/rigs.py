"""The commands on rigs: list the packaged ones, write a file for another machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sealscope.cli.options import check_folder
from sealscope.errors import InputError

rigs = typer.Typer(
    name="rigs", help="List the packaged rigs; `rigs new` writes another machine's file, `rigs margins` rates a loop."
)


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


@rigs.command("margins")
def print_margins(
    rig: Annotated[str, typer.Argument(help="Rig by name, or the path of a rig's TOML file.")] = "thesis-closed-loop",
    controller: Annotated[
        str, typer.Option("--controller", help="Controller by name, or your own as FILE.py:NAME or MODULE:NAME.")
    ] = "pi",
    load: Annotated[str, typer.Option("--load", help="Force against +x beside the rig's own [N].")] = "0",
) -> None:
    """Print gain, phase and delay margin of a position loop, at rest and at three speeds of the piston."""
    import math

    from sealscope.control import controller_named, margins
    from sealscope.parameters import load_rig
    from sealscope.units import parse_quantity

    loaded, force = load_rig(rig), parse_quantity(load, "N", name="--load")
    made = controller_named(controller, loaded)
    typer.echo(f"{loaded.name}, {controller}, {made.rate:g} Hz, late by {made.delay} samples, load {force:g} N")
    typer.echo("speed [m/s]  gain [dB]  phase [deg]  crossover [Hz]  delay [ms]  largest 1/|1+L|")
    for speed in (0.0, 0.01, 0.02, 0.05):
        m = margins(loaded, made, speed, force)
        gain = "inf" if math.isinf(m.gain) else f"{20 * math.log10(m.gain):.1f}"
        note = "" if m.damped else "  the rig alone is not damped here"
        typer.echo(
            f"{speed:11g}  {gain:>9}  {math.degrees(m.phase):11.0f}  {m.crossover:14.2f}  {1e3 * m.delay:10.1f}  "
            f"{m.peak:15.2f}{note}"
        )
