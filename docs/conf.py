"""The site: `sphinx-build -W docs site`; what can be taken from the program is taken from it."""

from __future__ import annotations

import os
from importlib.metadata import version as version_of
from pathlib import Path

import typer.main
from myst_nb.core import render
from nbformat import NotebookNode
from typer.cli import get_docs_for_click

import sealscope
from sealscope.cli.app import app

project, author = "Sealscope", "the authors of Sealscope"
release = version_of("sealscope")
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"Sealscope {release}"
html_static_path: list[str] = []
exclude_patterns = ["examples", "_build", "**.ipynb_checkpoints"]

# no page needs a network: formulas are text, and the search is a file
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3

# tutorials run when the site is built, and an error fails the build
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_show_tb = True
nb_merge_streams = True

autodoc_typehints = "none"
napoleon_google_docstring = False
napoleon_use_rtype = False

os.environ.setdefault("COLUMNS", "84")  # of what commands print in the tutorials
_GENERATED = Path(__file__).parent / "reference" / "generated"


def joined(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Return the outputs of a cell with what it printed in a single piece; myst-nb ends a line where a piece ends."""
    printed: dict[str, NotebookNode] = {}
    kept = []
    for output in outputs:
        if output["output_type"] == "stream" and output["name"] in printed:
            printed[output["name"]]["text"] += output["text"]
            continue
        if output["output_type"] == "stream":
            printed[output["name"]] = output
        kept.append(output)
    return kept


render.coalesce_streams = joined


def command_line() -> str:
    """Return the reference of the command line, from the commands themselves."""
    command = typer.main.get_command(app)
    context = command.make_context("sealscope", [], resilient_parsing=True)
    text = get_docs_for_click(obj=command, ctx=context, name="sealscope", title="Command line")
    return text.replace("&#x27;", "'")


def public_names() -> str:
    """Return the reference of the public names, from their docstrings."""
    lines = ["# Python", "", "`import sealscope as ss`; every name loads when it is first used.", ""]
    for name in sorted(set(sealscope.__all__) - {"__version__"}, key=str.lower):
        value = getattr(sealscope, name)
        kind = "autoclass" if isinstance(value, type) else "autofunction"
        members = ["   :members:"] if kind == "autoclass" else []
        home = f"{value.__module__}.{value.__qualname__}"
        lines += [f"## {name}", "", "```{eval-rst}", f".. {kind}:: {home}", *members, "```", ""]
    return "\n".join(lines)


def _write(_app: object) -> None:
    _GENERATED.mkdir(exist_ok=True)
    for name, text in (("cli.md", command_line()), ("api.md", public_names())):
        (_GENERATED / name).write_text(text, encoding="utf-8")


def setup(app: object) -> None:
    """Write the generated pages before the others are read."""
    app.connect("builder-inited", _write)  # type: ignore[attr-defined]
