"""Render pages from templates and write them; each page is one HTML file that loads nothing from outside."""

from __future__ import annotations

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
#: Invisible characters that a terminal or browser interprets: control codes, and changes of the writing direction.
_CONTROL_CHARACTERS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
PAGE_SUFFIXES = (".html", ".htm", ".pdf", ".png")


@cache
def _environment(package: str) -> jinja2.Environment:
    """Build the jinja2 environment for the templates of a package; they may include those of `sealscope.reporting`."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(name) for name in dict.fromkeys((package, _PACKAGE))]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    read_file = partial(read_package_file, package=package)
    environment.globals |= {"packaged": read_file, "symbols": SYMBOLS, "version": _installed_version()}
    environment.filters["script_hash"] = _script_hash
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}  # of the filter `tojson`
    return environment


def render(
    template: str, *, package: str = _PACKAGE, chart_data: Any = None, scripts: Sequence[str] = (), **context: Any
) -> str:
    """Render the template called `template` as the text of a page, with the values `context`.

    `package`: package of the template; `scripts`: names of script files in it that the page runs; `chart_data`: plain
    JSON values, which adds the scripts that draw charts, or None. Control characters in the text are replaced.
    """
    names = scripts if chart_data is None else ("vendor/uPlot.iife.min.js", "templates/charts.js", *scripts)
    page = _environment(package).get_template(template)
    text = page.render(context, chart_data=chart_data, scripts=[read_package_file(name, package) for name in names])
    return _CONTROL_CHARACTERS.sub("\N{REPLACEMENT CHARACTER}", text)


def read_package_file(name: str, package: str = _PACKAGE) -> Markup:
    """Read a text file that templates do not escape, by its path in `package` or else in `sealscope.reporting`."""
    from markupsafe import Markup

    file = resources.files(package) / name
    return Markup((file if file.is_file() else resources.files(_PACKAGE) / name).read_text(encoding="utf-8"))


def _script_hash(code: str) -> Markup:
    """Compute the hash of a script, by which the content security policy of a page allows the script."""
    from markupsafe import Markup

    return Markup(f"'sha256-{b64encode(sha256(code.encode()).digest()).decode()}'")


def parse_page_path(path: str | os.PathLike[str], *, card: bool = True) -> Path:
    """Check that a path ends in .html, .htm or .pdf, or in .png if `card`; return it as a Path, or raise InputError."""
    suffixes = PAGE_SUFFIXES if card else PAGE_SUFFIXES[:-1]  # the last one is .png
    if Path(path).suffix.lower() not in suffixes:
        raise InputError(f"a page's name must end in {', '.join(suffixes)}, got {os.fspath(path)}")
    return Path(path)


def write(path: str | os.PathLike[str], page: str) -> Path:
    """Write a page (HTML) atomically, as UTF-8, or as a PDF if the name ends in .pdf; return the path.

    Raises InputError if the file cannot be written, MissingExtra if no program for printing a PDF is installed.
    """
    if Path(path).suffix.lower() == ".pdf":
        print_page(page, path)
        return Path(path)
    with atomic_write(path) as temporary:
        # the name of a file may contain bytes that are not UTF-8
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace", newline="\n")
    return Path(path)


def _installed_version() -> str:
    """Return the version of the installed package for the foot of a page, or "(not installed)"."""
    try:
        return metadata.version("sealscope")
    except metadata.PackageNotFoundError:
        return "(not installed)"
