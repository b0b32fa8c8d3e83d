"""A page as a PDF, printed by a program that is on the machine: a browser of Chromium's family, or WeasyPrint."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from sealscope.errors import InputError, MissingExtra
from sealscope.storage.atomic import atomic_write

#: Browsers that print without a window, the first that is there prints.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
_OPTIONS = (
    "--headless",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-pdf-header-footer",
)
#: Longest time that printing may take [s].
_LONGEST = 120.0


def print_page(page: str, path: str | os.PathLike[str]) -> str:
    """Write a page (HTML) as a PDF, whole or not at all, and return what printed it.

    Raises MissingExtra where neither a browser nor WeasyPrint is installed, and InputError where printing fails.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    with atomic_write(path) as temporary:
        if browser is not None:
            _by_browser(browser, page, temporary)
            return Path(browser).name
        try:
            from weasyprint import HTML
        except (ImportError, OSError) as error:  # OSError: its C libraries are not there
            raise MissingExtra(
                f"a PDF needs Chromium or WeasyPrint, got neither: install one of them, or write .html ({path})"
            ) from error
        HTML(string=page).write_pdf(temporary)  # without scripts: charts stand as on paper
        return "WeasyPrint"


def _by_browser(browser: str, page: str, target: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="sealscope-", ignore_cleanup_errors=True) as folder:
        source = Path(folder) / "page.html"
        source.write_text(page, encoding="utf-8")
        options = [*_OPTIONS, f"--user-data-dir={folder}/profile", f"--print-to-pdf={target}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            options.append("--no-sandbox")  # a browser's sandbox does not start for this user
        try:
            done = subprocess.run(
                [browser, *options, source.as_uri()],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_LONGEST,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"printing must end within {_LONGEST:g} s, got: {error} ({browser})") from None
    if not target.read_bytes().startswith(b"%PDF"):
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:] or ["no message"]
        raise InputError(f"a browser must print a PDF, got status {done.returncode}: {last[0][:160]} ({browser})")
