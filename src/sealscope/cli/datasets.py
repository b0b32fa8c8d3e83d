"""The command that lists the public data sets and checks a copy of one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, echo

from sealscope.cli.options import completing
from sealscope.errors import InputError


def _names() -> list[str]:
    from sealscope.datasets import known

    return [dataset.name for dataset in known()]


_NAME = "Print licence, source and files of this data set."


def datasets(
    name: Annotated[str | None, Argument(help=_NAME, autocompletion=completing(_names))] = None,
    folder: Annotated[Path | None, Argument(help="Check the files in this folder by their checksums.")] = None,
) -> None:
    """List the public data sets that are read from a folder that you downloaded (`ss.datasets`)."""
    from sealscope.datasets import check, known, named
    from sealscope.recordings.formats.columns import counted

    if name is None:
        for dataset in known():
            echo(f"{dataset.name}\n  {dataset.title}\n  {dataset.licence}; {dataset.source}")
        return
    dataset = named(name)
    if folder is None:
        echo(f"{dataset.title}\n\n{dataset.about}\n")
        echo(f"licence   {dataset.licence}\nsource    {dataset.source}\ncitation  {dataset.citation}")
        echo(f"files     {len(dataset.checksums)} with a checksum")
        return
    files = check(dataset, folder)
    echo(
        f"{dataset.name}: {counted(len(files.right), 'file')} with the right checksum, {len(files.wrong)} with a wrong "
        f"one,\n{len(files.missing)} missing, {len(files.unknown)} unknown ({folder})"
    )
    if files.wrong:
        raise InputError(
            f"files must have their checksums, got a wrong one of {', '.join(map(str, files.wrong.values()))}"
        )
    if not files.right:
        raise InputError(f"the folder must hold files of {dataset.name}, got none: they are at {dataset.source}")
