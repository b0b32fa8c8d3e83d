"""Convert a page to a PDF or a picture with an installed program: a browser of Chromium's family, or WeasyPrint."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import tempfile
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path

from sealscope.errors import InputError, MissingExtra
from sealscope.storage.atomic import atomic_write

_TABLE = tomllib.loads(Path(__file__).with_name("browsers.toml").read_text(encoding="utf-8"))
BROWSERS, _PLACES, _OPTIONS = (tuple(_TABLE[name]) for name in ("names", "places", "options"))
#: A browser is ended after this time [s].
_BROWSER_TIMEOUT = 120.0


def print_page(page: str, path: str | os.PathLike[str]) -> None:
    """Write a page (HTML) as a PDF, atomically, by a browser or, if none is installed, by WeasyPrint.

    Raises MissingExtra if neither is installed, and InputError if printing fails.
    """
    browser = _find_browser()
    with atomic_write(path) as temporary:
        if browser is not None:
            options = ["--no-pdf-header-footer", f"--print-to-pdf={temporary}"]
            _write_by_browser(browser, page, temporary, options, "PDF", _is_complete_pdf)
            return
        try:
            from weasyprint import HTML
        except (ImportError, OSError) as error:  # OSError: the C libraries of WeasyPrint are not installed
            raise MissingExtra(
                "a PDF needs Chromium or WeasyPrint, got neither: install one of them (pip install weasyprint), or "
                f"write .html ({path})"
            ) from error
        HTML(string=_inline_styles(page)).write_pdf(temporary)  # runs no scripts: the page shows its still charts
        if not _is_complete_pdf(temporary.read_bytes()):
            raise InputError(f"a PDF must be complete, got one without its end: is the disk full? ({path})")


def draw_page(page: str, path: str | os.PathLike[str], width: int, height: int) -> None:
    """Write a page (HTML) as a PNG of `width` x `height` pixels, atomically, by a browser.

    Raises MissingExtra if no browser is installed, and InputError if drawing fails.
    """
    browser = _find_browser()
    if browser is None:
        raise MissingExtra(f"a picture needs Chromium, got none: install it, or write .html ({path})")
    with atomic_write(path) as temporary:
        picture = temporary.with_name(f"{temporary.name}.png")  # browsers require this suffix
        options = ["--hide-scrollbars", "--force-device-scale-factor=1", f"--window-size={width},{height}"]
        try:
            kind = f"picture of {width} x {height} pixels"
            is_complete = partial(_is_complete_png, width=width, height=height)
            _write_by_browser(browser, page, picture, [*options, f"--screenshot={picture}"], kind, is_complete)
            picture.replace(temporary)
        finally:
            picture.unlink(missing_ok=True)


def _inline_styles(page: str) -> str:
    """Copy the style sheet of a page (HTML) into each drawing, with each CSS variable replaced by its value for print.

    WeasyPrint neither applies the page's style sheet to drawings nor knows CSS variables there.
    """
    sheet = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
    if sheet is None:
        return page
    values: dict[str, str] = {}  # value of each variable; values for print come later and replace the others
    for block in re.findall(r"(?:^|@media print\{)\s*:root\{([^}]*)\}", sheet[1], re.MULTILINE):
        values |= dict(re.findall(r"(--[\w-]+):([^;]+)", block))
    resolved_sheet = re.sub(r"var\((--[\w-]+)\)", lambda match: values.get(match[1], match[0]), sheet[1])
    page = page.replace(sheet[1], resolved_sheet, 1)
    return re.sub(r"<svg\b[^>]*>", lambda match: f"{match[0]}<style>{resolved_sheet}</style>", page)


def _find_browser() -> str | None:
    """Find the path of an installed browser of Chromium's family; return None if there is none."""
    return next(filter(None, map(shutil.which, (*BROWSERS, *_PLACES))), None)


def _is_complete_pdf(data: bytes) -> bool:
    """Return True if the offset at the end of a PDF leads to a cross-reference table (ISO 32000-1, 7.5.5)."""
    end = re.search(rb"startxref\s+(\d+)\s+%%EOF\s*$", data[-1024:])
    if end is None:
        return False
    offset = int(end[1])
    table_head = data[offset : offset + 20]  # "xref", or the object of a compressed table such as "12 0 obj"
    # the pattern covers the start of the file, "%PDF", and the start of the table
    return re.match(rb"%PDF.*(xref|\d+ \d+ obj)", data[:4] + table_head) is not None


def _is_complete_png(data: bytes, width: int, height: int) -> bool:
    """Return True if a PNG has `width` x `height` pixels, and its bytes end with the chunk IEND and its checksum."""
    # signature, then the chunk IHDR: length 13, name, width and height
    head = struct.pack(">8sL4sLL", b"\x89PNG\r\n\x1a\n", 13, b"IHDR", width, height)
    return data.startswith(head) and data.endswith(b"\0\0\0\0IEND\xaeB`\x82")


def _write_by_browser(
    browser: str, page: str, target: Path, options: list[str], kind: str, is_complete: Callable[[bytes], bool]
) -> None:
    """Let a browser convert a page (HTML) to the file `target`; raise InputError if this fails.

    `options`: of the browser's command line, which name the target; `kind`: description of the file for the error
    message; `is_complete`: tests the bytes of the file.
    """
    with tempfile.TemporaryDirectory(prefix="sealscope-", ignore_cleanup_errors=True) as folder:
        source = Path(folder) / "page.html"
        source.write_text(page, encoding="utf-8", errors="backslashreplace")
        command = [browser, *_OPTIONS, *options, f"--user-data-dir={folder}/profile", source.as_uri()]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.insert(1, "--no-sandbox")  # the sandbox does not start for the user root
        try:
            result = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_BROWSER_TIMEOUT, check=False
            )
        except OSError as error:
            raise InputError(f"a browser must be a program that starts, got: {error.strerror} ({browser})") from None
        except subprocess.TimeoutExpired:
            raise InputError(f"a browser must end within {_BROWSER_TIMEOUT:g} s, got no end ({browser})") from None
    data = target.read_bytes() if target.is_file() else b""
    if not is_complete(data):
        # the last line of the messages, as a list of one line
        last_line = result.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        got = f"status {result.returncode}: {last_line[0][:160]}"
        got += f", and {len(data)} bytes: is the disk full?" if data else ""
        raise InputError(f"a browser must make a {kind}, got {got} ({browser})")
