"""The command that finds a machine's parameters in its recordings: identify."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sealscope.cli.options import MapOption, RateOption, channel_map_of, check_folder, say
from sealscope.errors import InputError


def identify(
    files: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Recordings of one machine.")],
    rig: Annotated[str, typer.Option("--rig", help="The kind of machine: a rig by name or a rig's TOML file.")],
    channel_map: MapOption = None,
    rate: RateOption = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Write a rig's file (.toml).")] = None,
) -> None:
    """Fit what recordings tell of a machine's parameters, with intervals of 95 %, and say what they cannot."""
    from sealscope.control.identification import identified_rig_text
    from sealscope.control.identification import identify as identified
    from sealscope.parameters import load_rig, rig_names
    from sealscope.parameters.fields import leaves, unit_of
    from sealscope.parameters.rig import Rig
    from sealscope.recordings import read
    from sealscope.storage.atomic import atomic_write

    if output is not None:
        if output.suffix != ".toml":
            raise InputError(f"a rig's file must end in .toml, got {output}")
        check_folder(output)
        if output.exists():
            raise InputError(f"a rig's file must be new, got {output}, which exists")
    columns = channel_map_of(channel_map) or None
    recordings = [read(file, map=columns, rate=rate) for file in files]
    found = identified(recordings, rig)
    if found.mismatch is not None:
        raise InputError(f"the recordings must be of a machine like {load_rig(rig).name}: {found.mismatch}")
    units = {dotted: unit_of(field) for dotted, field in leaves(Rig)}
    say(f"{len(files)} recordings, a machine like {found.rig.name}")
    for estimate in found.estimates:
        low, high = estimate.interval
        say(f"{estimate.name:<22} {estimate.value:<12.6g} {low:.6g} to {high:.6g} {units[estimate.name]} (95 %)")
    say("not told:")
    for what, why in found.untold:
        say(f"  {what}: {why}")
    if output is not None:
        extends = rig if rig in rig_names() else os.path.relpath(rig, output.parent)
        with atomic_write(output) as temporary:
            temporary.write_text(identified_rig_text(found, output.stem, extends, len(files)), encoding="utf-8")
        load_rig(output)
        say(f"{output}: written")
