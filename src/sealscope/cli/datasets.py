"""The command that lists the public data sets and checks a copy of one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sealscope.errors import InputError


def complete_datasets(incomplete: str) -> list[str]:
    """Return the names of data sets that begin with `incomplete`, for the shell's completion."""
    from sealscope.datasets import known

    return [dataset.name for dataset in known() if dataset.name.startswith(incomplete)]


def datasets(
    name: Annotated[
        str | None,
        typer.Argument(help="Tell licence, source and files of this data set.", autocompletion=complete_datasets),
    ] = None,
    folder: Annotated[Path | None, typer.Argument(help="Check the files in this folder by their checksums.")] = None,
) -> None:
    """List the public data sets that are read from a folder that you downloaded (`ss.datasets`)."""
    from sealscope.datasets import check, known, named

    if name is None:
        width = max(len(dataset.name) for dataset in known())
        for dataset in known():
            typer.echo(f"{dataset.name:<{width}}  {dataset.title} ({dataset.licence}; {dataset.source})")
        return
    dataset = named(name)
    if folder is None:
        typer.echo(f"{dataset.title}\n\n{dataset.about}\n")
        typer.echo(f"licence   {dataset.licence}\nsource    {dataset.source}\ncitation  {dataset.citation}")
        typer.echo(f"files     {len(dataset.checksums)} with a checksum")
        return
    found = check(dataset, folder)
    typer.echo(
        f"{dataset.name}: {len(found.right)} files with their checksum, {len(found.wrong)} with another, "
        f"{len(found.missing)} not there, {len(found.unknown)} without a known one ({folder})"
    )
    if found.wrong:
        raise InputError(f"files must have their checksums, got another of {', '.join(map(str, found.wrong.values()))}")
    if not found.right:
        raise InputError(f"the folder must hold files of {dataset.name}, got none: they are at {dataset.source}")
