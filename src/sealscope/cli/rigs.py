"""The commands on rigs: list the packaged ones, write a file for another machine, rate a loop."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

from typer import Argument, Context, Option, Typer, echo

from sealscope.cli.options import RigArgument, check_folder, declared, say_wrapped, write_text
from sealscope.errors import InputError

rigs = Typer(
    name="rigs", help="List the packaged rigs; `rigs new` writes another machine's file, `rigs margins` rates a loop."
)
AreaA = Annotated[str, Option("--area-A", help="Piston area on side A.", prompt="Piston area on side A [mm^2]")]
AreaB = Annotated[
    str, Option("--area-B", help="Piston area on side B: with the rod, if there is one.", prompt="... on side B [mm^2]")
]
Displacement = Annotated[str, Option(help="Displacement of the pump.", prompt="Displacement of the pump [cm^3/rev]")]


@rigs.callback(invoke_without_command=True)
def list_rigs(context: Context) -> None:
    """List the packaged rigs; `rigs new` writes a file for another machine."""
    if context.invoked_subcommand is not None:
        return
    from sealscope.parameters import load_rig, rig_names

    width = max(map(len, rig_names())) + 2
    for name in rig_names():
        say_wrapped(load_rig(name).title, f"{name:<{width}}")


@rigs.command()
def new(
    name: Annotated[str, Argument(help="Name of the rig; the file is NAME.toml unless `-o` says otherwise.")],
    area_A: AreaA,
    area_B: AreaB,
    stroke: Annotated[str, Option(help="Stroke.", prompt="Stroke [mm]")],
    displacement: Displacement,
    output: Annotated[Path | None, Option("--output", "-o", help="File to write (.toml).")] = None,
) -> None:
    """Write a commented rig file from areas, stroke and displacement.

    A number without a unit is in mm^2, mm or cm^3/rev.
    """
    from sealscope.parameters import load_rig
    from sealscope.parameters.new_rig import rig_text
    from sealscope.units import parse_quantity

    def si(text: str, si_unit: str, usual: str, option: str) -> float:
        with suppress(ValueError):
            text = f"{float(text)}[{usual}]"
        return parse_quantity(text, si_unit, name=option)

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
    write_text(path, text)
    echo(f"{path}: {load_rig(path).title}")
    echo(f"replace what is assumed (grep 'assumed:' {path}), then:\nsealscope simulate --rig {path} -o run.nc")


@rigs.command("margins")
def print_margins(
    rig: RigArgument = "thesis-closed-loop",
    controller: Annotated[str, declared("controller")] = "pi",
    load: Annotated[str, Option(help="Force against +x beside the rig's own [N].")] = "0",
) -> None:
    """Print gain, phase and delay margin of a position loop, at standstill and at three speeds of the piston."""
    import math

    from sealscope.control import controller_named, margins
    from sealscope.parameters import load_rig
    from sealscope.units import parse_quantity

    loaded, force = load_rig(rig), parse_quantity(load, "N", name="--load")
    made = controller_named(controller, loaded)
    echo(f"{loaded.name}, {controller}, {made.rate:g} Hz, late by {made.delay} samples, load {force:g} N")
    echo("speed [m/s]  gain [dB]  phase [deg]  crossover [Hz]  delay [ms]  peak 1/|1+L|")
    for speed in (0.0, 0.01, 0.02, 0.05):
        m = margins(loaded, made, speed, force)
        gain = "inf" if math.isinf(m.gain) else f"{20 * math.log10(m.gain):.1f}"
        figures = f"{math.degrees(m.phase):11.0f}  {m.crossover:14.2f}  {1e3 * m.delay:10.1f}  {m.peak:12.2f}"
        echo(f"{speed:11g}  {gain:>9}  {figures}" + ("" if m.damped else "\n  the rig alone is not damped here"))
