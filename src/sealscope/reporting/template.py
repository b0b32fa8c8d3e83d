"""Rendering and writing of the pages: each is one HTML file with nothing outside it."""

from __future__ import annotations

import json
import os
import re
from base64 import b64encode
from collections.abc import Sequence
from functools import cache, partial
from hashlib import sha256
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sealscope.errors import InputError
from sealscope.reporting.picture import SYMBOLS
from sealscope.reporting.printing import print_page
from sealscope.storage.atomic import atomic_write

if TYPE_CHECKING:
    import jinja2
    from markupsafe import Markup

_PACKAGE = "sealscope.reporting"
#: Signs that a terminal or a browser obeys and nobody sees: controls, and what turns the direction of writing.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_SUFFIXES = (".html", ".htm", ".pdf", ".png")


@cache
def _environment(package: str) -> jinja2.Environment:
    """Set up the templates of a package, which may extend and include those of this one."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in dict.fromkeys((package, _PACKAGE))]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    environment.globals |= {"packaged": partial(packaged, package=package), "symbols": SYMBOLS, "version": _version()}
    environment.filters |= {"script_hash": _script_hash, "script_json": _script_json}
    return environment


def render(
    template: str, *, package: str = _PACKAGE, chart_data: Any = None, scripts: Sequence[str] = (), **context: Any
) -> str:
    """Fill in a template of a package.

    `scripts`: files of the package that the page runs; with `chart_data`, plain JSON values, those of the charts.
    Control characters that a file's name or description brought are replaced.
    """
    names = scripts if chart_data is None else ("vendor/uPlot.iife.min.js", "templates/charts.js", *scripts)
    page = _environment(package).get_template(template)
    text = page.render(context, chart_data=chart_data, scripts=[packaged(name, package) for name in names])
    return _CONTROLS.sub("\N{REPLACEMENT CHARACTER}", text)


def packaged(name: str, package: str = _PACKAGE) -> Markup:
    """Read a file to include unchanged in a page, from a package or else from this one."""
    from markupsafe import Markup

    file = resources.files(package) / name
    return Markup((file if file.is_file() else resources.files(_PACKAGE) / name).read_text(encoding="utf-8"))


def _script_hash(code: str) -> Markup:
    """Compute the hash of a script for a content security policy."""
    from markupsafe import Markup

    return Markup(f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'")


def _script_json(value: Any) -> Markup:
    """Format plain JSON values for an element `script`, escaped so that none ends it."""
    from markupsafe import Markup

    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def check_page(path: str | os.PathLike[str], *, card: bool = True) -> Path:
    """Return the path of a page to write, `card`: or of its picture; raises InputError for a wrong kind of file."""
    suffixes = _SUFFIXES if card else _SUFFIXES[:-1]
    if Path(path).suffix.lower() not in suffixes:
        raise InputError(f"a page must be a file {', '.join(suffixes)}, got {os.fspath(path)}")
    return Path(path)


def write(path: str | os.PathLike[str], page: str) -> Path:
    """Write a page as UTF-8, or as a PDF if the name ends in .pdf; whole or not at all.

    Raises InputError where it cannot be written, MissingExtra where nothing on the machine prints a PDF.
    """
    if Path(path).suffix.lower() == ".pdf":
        print_page(page, path)
        return Path(path)
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace", newline="\n")  # a file's name
    return Path(path)


def _version() -> str:
    try:
        return metadata.version("sealscope")
    except metadata.PackageNotFoundError:
        return "(not installed)"
