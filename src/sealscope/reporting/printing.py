"""A page as a PDF or a picture, made by a program on the machine: a browser of Chromium's family, or WeasyPrint."""

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
#: Longest time that a browser may take [s].
_LONGEST = 120.0


def print_page(page: str, path: str | os.PathLike[str]) -> str:
    """Write a page (HTML) as a PDF, whole or not at all, and return the program's name.

    Raises MissingExtra where neither a browser nor WeasyPrint is installed, and InputError where printing fails.
    """
    browser = _browser()
    with atomic_write(path) as temporary:
        if browser is not None:
            options = ["--no-pdf-header-footer", f"--print-to-pdf={temporary}"]
            _by_browser(browser, page, temporary, options, "PDF", _is_whole_pdf)
            return Path(browser).name
        try:
            from weasyprint import HTML
        except (ImportError, OSError) as error:  # OSError: its C libraries are not there
            raise MissingExtra(
                "a PDF needs Chromium or WeasyPrint, got neither: install one of them (pip install weasyprint), or "
                f"write .html ({path})"
            ) from error
        HTML(string=_styles_in_place(page)).write_pdf(temporary)  # without scripts: charts stand as on paper
        if not _is_whole_pdf(temporary.read_bytes()):
            raise InputError(f"a PDF must be written to its end, got less: is the disk full? ({path})")
        return "WeasyPrint"


def draw_page(page: str, path: str | os.PathLike[str], width: int, height: int) -> str:
    """Write a page (HTML) as a PNG of `width` x `height` pixels, whole or not at all, and return the program's name.

    Raises MissingExtra where no browser is installed, and InputError where drawing fails.
    """
    browser = _browser()
    if browser is None:
        raise MissingExtra(f"a picture needs Chromium, got none: install it, or write .html ({path})")
    with atomic_write(path) as temporary:
        picture = temporary.with_name(f"{temporary.name}.png")  # a browser draws only into a name that ends so
        options = ["--hide-scrollbars", "--force-device-scale-factor=1", f"--window-size={width},{height}"]
        try:
            kind, is_whole = "picture of the size asked for", partial(_is_whole_png, width=width, height=height)
            _by_browser(browser, page, picture, [*options, f"--screenshot={picture}"], kind, is_whole)
            picture.replace(temporary)
        finally:
            picture.unlink(missing_ok=True)
        return Path(browser).name


def _styles_in_place(page: str) -> str:
    """Return a page for WeasyPrint, which styles no drawing by the page's sheet and knows no variables in one.

    Variables become their printed values, and each drawing gets the sheet.
    """
    sheet = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
    if sheet is None:
        return page
    values: dict[str, str] = {}
    for block in re.findall(r"(?:^|@media print\{)\s*:root\{([^}]*)\}", sheet[1], re.MULTILINE):
        values |= dict(re.findall(r"(--[\w-]+):([^;]+)", block))
    plain = re.sub(r"var\((--[\w-]+)\)", lambda match: values.get(match[1], match[0]), sheet[1])
    page = page.replace(sheet[1], plain, 1)
    return re.sub(r"<svg\b[^>]*>", lambda match: f"{match[0]}<style>{plain}</style>", page)


def _browser() -> str | None:
    return next(filter(None, map(shutil.which, (*BROWSERS, *_PLACES))), None)


def _is_whole_pdf(data: bytes) -> bool:
    """Test whether a PDF is complete, with its cross-reference table where the end says (ISO 32000-1, 7.5.5)."""
    end = re.search(rb"startxref\s+(\d+)\s+%%EOF\s*$", data[-1024:])
    return end is not None and re.match(rb"%PDF.*(xref|\d+ \d+ obj)", data[:4] + data[int(end[1]) :][:20]) is not None


def _is_whole_png(data: bytes, width: int, height: int) -> bool:
    """Test whether a PNG of this size is complete, up to the chunk IEND with its checksum."""
    head = struct.pack(">8sL4sLL", b"\x89PNG\r\n\x1a\n", 13, b"IHDR", width, height)
    return data.startswith(head) and data.endswith(b"\0\0\0\0IEND\xaeB`\x82")


def _by_browser(
    browser: str, page: str, target: Path, options: list[str], kind: str, is_whole: Callable[[bytes], bool]
) -> None:
    """Let a browser write `target`, a file of this kind. Raise InputError if the file is incomplete."""
    with tempfile.TemporaryDirectory(prefix="sealscope-", ignore_cleanup_errors=True) as folder:
        source = Path(folder) / "page.html"
        source.write_text(page, encoding="utf-8", errors="backslashreplace")
        command = [browser, *_OPTIONS, *options, f"--user-data-dir={folder}/profile"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # a browser's sandbox does not start for this user
        try:
            done = subprocess.run(
                [*command, source.as_uri()],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_LONGEST,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"a browser must end within {_LONGEST:g} s, got: {error} ({browser})") from None
    data = target.read_bytes() if target.is_file() else b""
    if not is_whole(data):
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        got = f"status {done.returncode}: {last[0][:160]}"
        got += f", and {len(data)} bytes: is the disk full?" if data else ""
        raise InputError(f"a browser must make a {kind}, got {got} ({browser})")
