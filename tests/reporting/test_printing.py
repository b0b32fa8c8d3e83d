"""A page printed as a PDF."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from sealscope.errors import InputError, MissingExtra
from sealscope.reporting import printing, write_page

PAGE = "<!DOCTYPE html><title>t</title><h1>Leak</h1>"
BROWSER = next(filter(None, map(shutil.which, printing.BROWSERS)), None)


@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
def test_a_browser_prints(tmp_path: Path) -> None:
    assert printing.print_page(PAGE, tmp_path / "page.pdf") == Path(str(BROWSER)).name
    data = (tmp_path / "page.pdf").read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.rstrip().endswith(b"%%EOF")
    assert [path.name for path in tmp_path.iterdir()] == ["page.pdf"]


@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
def test_the_page_of_a_leak_fits_a_sheet(tmp_path: Path, recording, make_diagnosis) -> None:
    """What is not folded stands on a single sheet of A4, the schematic and the rig's values included."""
    page = write_page(tmp_path / "page.pdf", recording, make_diagnosis(quality=()), rig="thesis-calibrated")
    assert len(re.findall(rb"/Type */Page\b", page.read_bytes())) == 1


def test_without_a_printer_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(printing, "BROWSERS", ())
    monkeypatch.setitem(__import__("sys").modules, "weasyprint", None)
    with pytest.raises(MissingExtra, match=r"a PDF needs Chromium or WeasyPrint, got neither.*page\.pdf"):
        printing.print_page(PAGE, tmp_path / "page.pdf")
    assert list(tmp_path.iterdir()) == []


def test_a_browser_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "browser"
    broken.write_text("#!/bin/sh\necho no display >&2\nexit 3\n")
    broken.chmod(0o755)
    monkeypatch.setattr(printing, "BROWSERS", (str(broken),))
    with pytest.raises(InputError, match=r"must print a PDF, got status 3: no display"):
        printing.print_page(PAGE, tmp_path / "page.pdf")
    assert [path.name for path in tmp_path.iterdir()] == ["browser"]
