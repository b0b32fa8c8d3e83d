"""The site: `sphinx-build -W docs site`; what can be taken from the program is taken from it."""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
from importlib import import_module
from importlib.metadata import version as version_of
from pathlib import Path
from types import ModuleType

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
exclude_patterns = ["reference/generated/speed.md", "examples", "_build", "**.ipynb_checkpoints"]

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
napoleon_preprocess_types = True

# every type that a docstring names is a link, or one of these
nitpicky = True
_OUTSIDE = "array_like|callable|iterable|iterator|mapping|ndarray|path|path-like|sequence|JSON value"
_OUTSIDE += "|pair|floats|two floats"  # `pair of floats`
_OUTSIDE += r"|shape .*|(?:pandas|xarray|pathlib|matplotlib)\..*"
nitpick_ignore_regex = [("py:class", f"(?:{_OUTSIDE})"), ("py:obj", "True|False")]

os.environ.setdefault("COLUMNS", "80")  # of what commands print in the tutorials
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
        kind = "automodule" if isinstance(value, ModuleType) else kind
        members = [] if kind == "autofunction" else ["   :members:"]
        home = value.__name__ if kind == "automodule" else f"{value.__module__}.{value.__qualname__}"
        lines += [f"## {name}", "", "```{eval-rst}", f".. {kind}:: {home}", *members, "```", ""]
    return "\n".join(lines)


def _classes() -> dict[str, str]:
    """Return the home of every public class of the package by its name."""
    root = Path(sealscope.__file__).parent
    homes = {}
    for path in sorted(root.rglob("*.py")):
        module = ".".join(("sealscope", *path.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name] = f"{module}.{node.name}"
    return homes


def _docstrings(value: object) -> list[str]:
    """Return the docstring of a public name, and those of the members of a class or a module."""
    members = vars(value).values() if isinstance(value, type | ModuleType) else ()
    inner = [getattr(member, "__func__", member) for member in members]
    return [inspect.getdoc(own) or "" for own in (value, *(own for own in inner if callable(own)))]


def types() -> list[str]:
    """Return the homes of the classes that are no public names, and that parameters, results or errors are of."""
    homes = _classes()
    shown = {name: getattr(sealscope, name) for name in sealscope.__all__}
    modules = {name for name, value in shown.items() if isinstance(value, ModuleType)}  # show their own classes
    waiting, linked = list(shown.values()), {}
    while waiting:
        for text in _docstrings(waiting.pop()):
            stated = re.findall(r"^[\w*, ]+ : (.*)|^(\w[\w ,.]*)$(?=\n {4}\S)", text, re.MULTILINE)
            names = set(re.findall(r"(?<![.\w])[A-Z]\w+", " ".join(map(" ".join, stated)))) & homes.keys()
            for name in sorted(names - shown.keys() - linked.keys()):
                module, _, own = homes[name].rpartition(".")
                linked[name] = homes[name]
                waiting.append(getattr(import_module(module), own))
    return [linked[name] for name in sorted(linked) if linked[name].split(".")[1] not in modules]


napoleon_type_aliases = {name: f"~{home}" for name, home in _classes().items()}


def type_reference() -> str:
    """Return the reference of the types that public names take, return or raise."""
    lines = ["# Types", "", "What public names take, return and raise, beside one another.", ""]
    for home in types():
        lines += [f"## {home.rpartition('.')[2]}", "", "```{eval-rst}", f".. autoclass:: {home}", "```", ""]
    return "\n".join(lines)


def parameters() -> str:
    """Return the reference of a rig's parameters, from their declarations; the transducers have the same ones."""
    lines = ["# Parameters", "", "`sealscope parameters RIG` prints their values, each with its source.", ""]
    lines += ["`sensors.p_1`, `sensors.p_2` and `sensors.p_B` have the parameters of `sensors.p_A`.", ""]
    part = ""
    for row in sealscope.load_rig("thesis").table():
        head, _, symbol = row.name.rpartition(".")
        if head in ("sensors.p_1", "sensors.p_2", "sensors.p_B"):
            continue
        if head != part:
            lines += ["", f"## {head}", "", "| name | unit | meaning |", "| --- | --- | --- |"]
        part = head
        lines.append(f"| `{symbol}` | {row.unit} | {row.meaning} |")
    return "\n".join(lines) + "\n"


def speed() -> str:
    """Return the times of the simulator beside programs in C++, and those of verdicts, as last measured.

    They are from `benchmarks/run.py` and `benchmarks/speed.py`.
    """
    results = Path(__file__).parents[1] / "benchmarks" / "results"
    solvers, verdicts = (
        json.loads((results / f"{name}.json").read_text(encoding="utf-8")) for name in ("solvers", "speed")
    )
    lines = ["| 180 s of | milliseconds a run | of the time of C++ |", "| --- | --- | --- |"]
    for case, figures in solvers["figures"].items():
        for peer, (ratio, *_) in figures["promised"].items():
            seconds = figures["solvers"]["ours, step chosen by error"]["seconds"][0]
            lines.append(f"| one run, {case} | {1e3 * seconds:.0f} | {100 * ratio:.0f} % of {peer} |")
    lines += ["", f"Measured {solvers['measured']} on {solvers['machine']}.", ""]
    lines += [
        "| work | seconds of processor (asked) | over those of 30 November | peak MiB (asked) | most of the time |",
        "| --- | --- | --- | --- | --- |",
    ]
    for work, row in verdicts["rows"].items():
        shares = ", ".join(f"{area} {100 * share:.0f} %" for area, share in row.get("shares", {}).items())
        asked, memory = (f" ({row[name]:g})" if row.get(name) else "" for name in ("asked", "asked MiB"))
        ratio = f"{row['ratio']:.2f}" if "ratio" in row else f"that took > {row['limit']} s" if "limit" in row else ""
        lines.append(f"| {work} | {row['seconds']:.2g}{asked} | {ratio} | {row['MiB']:.0f}{memory} | {shares} |")
    if verdicts["growth"]:
        growth = ", ".join(f"{power:.1f} of the {name}" for name, power in verdicts["growth"].items())
        lines += ["", f"The time, or where stated the memory, grows as the power {growth}."]
    lines += ["", *(f"- {work}: {text}" for work, text in verdicts.get("others", {}).items())]
    lines += ["", f"Measured {verdicts['measured']} on {verdicts['machine']}, busy with other work."]
    return "\n".join(lines) + "\n"


def _write(_app: object) -> None:
    _GENERATED.mkdir(exist_ok=True)
    pages = {"cli": command_line(), "api": public_names(), "types": type_reference(), "parameters": parameters()}
    pages["speed"] = speed()
    for name, text in pages.items():
        (_GENERATED / f"{name}.md").write_text(text, encoding="utf-8")


def setup(app: object) -> None:
    """Write the generated pages before the others are read."""
    app.connect("builder-inited", _write)  # type: ignore[attr-defined]
