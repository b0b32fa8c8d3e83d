"""The command `plugin new`, which writes a distribution with a new detector, ready to be installed and judged."""

from __future__ import annotations

import keyword
import re
from importlib import resources
from pathlib import Path
from string import Template
from typing import Annotated

from typer import Argument, Option, Typer, echo

from sealscope.cli.options import write_text
from sealscope.errors import InputError

_FOLDER = "New folder for the package; by default the name with dashes."
_HELP = "Detectors of your own; `plugin new NAME` writes a distribution to begin with."
plugin = Typer(name="plugin", help=_HELP, callback=lambda: None)


@plugin.command()
def new(
    name: Annotated[str, Argument(help="Name of the detector in plain words, e.g. 'stroke time'.")],
    folder: Annotated[Path | None, Option("--output", "-o", help=_FOLDER)] = None,
) -> None:
    """Write a package with a detector of your own: code that runs, its tests, and a campaign plan to evaluate it."""
    from sealscope.storage.folders import make_folder

    if not re.fullmatch(r"[a-z][a-z0-9]*( [a-z0-9]+){0,5}", name) or len(name) > 60:
        raise InputError(
            f"a detector's name must be 1 to 6 words of a-z and 0-9, such as 'stroke time', got {name[:60]!r}"
        )
    module = name.replace(" ", "_")
    if keyword.iskeyword(module):
        raise InputError(f"a detector's name must not be a Python keyword, got {name!r}")
    # text for each placeholder in the templates
    values = {"words": name, "dashed": name.replace(" ", "-"), "module": module, "cls": name.title().replace(" ", "")}
    target_folder = folder or Path(values["dashed"])
    if target_folder.exists():
        raise InputError(f"a plug-in's folder must be new, got {target_folder}, which exists")
    make_folder(target_folder)
    for file in (resources.files("sealscope.cli") / "plugin_files").iterdir():
        target = file.name.removesuffix(".txt").replace("detector.py", f"{module}.py")
        write_text(target_folder / target, Template(file.read_text(encoding="utf-8")).substitute(values))
    echo(f"{target_folder}: written; pip install -e {target_folder}")
    echo("then its name is among the methods of sealscope diagnose")
