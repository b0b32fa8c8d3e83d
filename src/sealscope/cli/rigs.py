"""The commands on rigs: list the packaged ones, write a file for another machine, print margins of a position loop."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Context, Option, Typer, echo, prompt

from sealscope.cli.options import RigArgument, check_folder, declared_option, say_wrapped, write_text
from sealscope.errors import InputError

rigs = Typer(
    name="rigs", help="List the packaged rigs; `rigs new` writes another machine's file, `rigs margins` rates a loop."
)


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
    kind: Annotated[Literal["pump", "valve"], Option(help="What moves the cylinder.")] = "pump",
    bore: Annotated[str | None, Option(help="Bore of the cylinder.")] = None,
    rod: Annotated[str | None, Option(help="Diameter of the rod, with --bore.")] = None,
    double_rod: Annotated[bool, Option("--double-rod", help="The rod leaves both sides.")] = False,
    area_A: Annotated[str | None, Option("--area-A", help="Piston area on side A, in place of the bore.")] = None,
    area_B: Annotated[str | None, Option("--area-B", help="Piston area on side B: with the rod, if any.")] = None,
    stroke: Annotated[str | None, Option(help="Stroke.")] = None,
    displacement: Annotated[str | None, Option(help="Displacement of the pump.")] = None,
    valve: Annotated[str | None, Option(metavar="FLOW", help="Rated flow of the valve, '40 L/min'.")] = None,
    drop: Annotated[str | None, Option(help="Pressure drop of one edge at that flow, '5 bar'.")] = None,
    supply: Annotated[str | None, Option(help="Pressure of the valve's supply, '160 bar'.")] = None,
    output: Annotated[Path | None, Option("--output", "-o", help="File to write (.toml).")] = None,
) -> None:
    """Write a commented rig file from a data sheet: bore and rod (or areas), stroke, and pump or valve.

    A number without a unit is in mm, mm^2, cm^3/rev, L/min or bar. Missing values are asked for.
    """
    from sealscope.parameters import load_rig
    from sealscope.parameters.new_rig import piston_areas, rig_text, valve_rig_text

    for option, value, required_kind in (
        ("--displacement", displacement, "pump"), ("--valve", valve, "valve"), ("--drop", drop, "valve"),
        ("--supply", supply, "valve"),
    ):  # fmt: skip
        if value is not None and kind != required_kind:
            raise InputError(f"{option} needs --kind {required_kind}, got --kind {kind}")
    if bore is None and rod is not None:
        raise InputError(f"--rod needs --bore, got --rod {rod} without it")
    for option, value in (("--area-A", area_A), ("--area-B", area_B)):
        if bore is not None and value is not None:
            raise InputError(f"{option} must stand in place of --bore, got both: {option} {value} --bore {bore}")
    if bore is not None:
        bore_m = _parse_size(bore, "m", "mm", "--bore")
        rod_m = _parse_size(rod or "0", "m", "mm", "--rod")  # without the option no rod is subtracted
        areas = piston_areas(bore_m, rod_m, double_rod=double_rod)
    else:
        m2_A = _parse_size(area_A, "m^2", "mm^2", "--area-A", "Piston area on side A")
        is_same = double_rod and area_B is None  # both sides have the rod
        areas = m2_A, m2_A if is_same else _parse_size(area_B, "m^2", "mm^2", "--area-B", "... on side B")
    length = _parse_size(stroke, "m", "mm", "--stroke", "Stroke")
    if kind == "pump":
        volume = _parse_size(displacement, "m^3/rev", "cm^3/rev", "--displacement", "Displacement of the pump")
        text = rig_text(name, *areas, length, volume)
    else:
        flow = _parse_size(valve, "m^3/s", "L/min", "--valve", "Rated flow of the valve")
        edge_drop = None if drop is None else _parse_size(drop, "Pa", "bar", "--drop")
        supply_pressure = None if supply is None else _parse_size(supply, "Pa", "bar", "--supply")
        text = valve_rig_text(name, *areas, length, flow, edge_drop, supply_pressure)
    path = output or Path(f"{name}.toml")
    if path.suffix != ".toml":
        raise InputError(f"a rig's file must end in .toml, got {path}")
    check_folder(path)
    if path.exists():
        raise InputError(f"a rig's file must be new, got {path}, which exists")
    write_text(path, text)
    echo(f"{path}: {load_rig(path).title}")
    echo(f"replace what is assumed (grep 'assumed:' {path}), then:\nsealscope simulate --rig {path} -o run.nc")


def _parse_size(text: str | None, si_unit: str, default_unit: str, option: str, label: str = "") -> float:
    """Parse the text of an option to a number in `si_unit`; a text without a unit is in `default_unit`.

    If `text` is missing, the user is asked for it at the terminal with the `label`; without one it raises InputError.
    """
    from sealscope.units import parse_quantity

    if not text:
        text = str(prompt(f"{label} [{default_unit}]")) if label else ""
    with suppress(ValueError):  # a text with a unit, which `float` refuses, stays unchanged
        text = f"{float(text)}[{default_unit}]"
    return parse_quantity(text, si_unit, name=option)


@rigs.command("margins")
def print_margins(
    rig: RigArgument = "thesis-closed-loop",
    controller: Annotated[str, declared_option("controller")] = "pi",
    load: Annotated[str, Option(help="Force against +x beside the rig's own [N].")] = "0",
) -> None:
    """Print gain, phase and delay margin of a position loop, at standstill and at three speeds of the piston."""
    import math

    from sealscope.control import controller_named, margins
    from sealscope.parameters import load_rig
    from sealscope.units import parse_quantity

    loaded_rig, force = load_rig(rig), parse_quantity(load, "N", name="--load")
    control = controller_named(controller, loaded_rig)
    echo(f"{loaded_rig.name}, {controller}, {control.rate:g} Hz, late by {control.delay} samples, load {force:g} N")
    echo("speed [m/s]  gain [dB]  phase [deg]  crossover [Hz]  delay [ms]  peak 1/|1+L|")
    for speed in (0.0, 0.01, 0.02, 0.05):
        loop = margins(loaded_rig, control, speed, force)
        gain = "inf" if math.isinf(loop.gain) else f"{20 * math.log10(loop.gain):.1f}"
        figures = (
            f"{math.degrees(loop.phase):11.0f}  {loop.crossover:14.2f}  {1e3 * loop.delay:10.1f}  {loop.peak:12.2f}"
        )
        echo(f"{speed:11g}  {gain:>9}  {figures}" + ("" if loop.damped else "\n  the rig alone is not damped here"))
