"""A page printed as a PDF."""

from __future__ import annotations

import contextlib
import re
import shutil
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sealscope.diagnosis.verdict.evidence import LeakCourse
from sealscope.errors import InputError, MissingExtra
from sealscope.reporting import printing
from sealscope.reporting.page import render_card, report

from ..refusals import refusal

PAGE = "<!DOCTYPE html><title>t</title><h1>Leak</h1>"
BROWSER = next(filter(None, map(shutil.which, printing.BROWSERS)), None)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
def test_a_browser_prints(tmp_path: Path) -> None:
    printing.print_page(PAGE, tmp_path / "page.pdf")
    data = (tmp_path / "page.pdf").read_bytes()
    assert data.startswith(b"%PDF-")
    assert data.rstrip().endswith(b"%%EOF")
    assert [path.name for path in tmp_path.iterdir()] == ["page.pdf"]


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
def test_the_page_of_a_leak_fits_a_sheet(tmp_path: Path, recording, make_diagnosis) -> None:
    """What is not folded stands on a single sheet of A4, the schematic and the rig's values included."""
    page = report(recording, tmp_path / "page.pdf", make_diagnosis(quality=()), rig="thesis-calibrated")
    assert len(re.findall(rb"/Type */Page\b", page.read_bytes())) == 1


@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
def test_a_card_is_a_picture_of_its_stated_size(tmp_path: Path, recording, make_diagnosis) -> None:
    leak = report(recording, tmp_path / "leak.PNG", make_diagnosis()).read_bytes()
    head = b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + b"IHDR"
    assert leak.startswith(head + (1200).to_bytes(4, "big") + (630).to_bytes(4, "big"))
    assert len(leak) > 5_000
    assert [path.name for path in tmp_path.iterdir()] == ["leak.PNG"]


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
def test_a_card_shows_the_verdict(tmp_path: Path, recording, make_diagnosis) -> None:
    leak = report(recording, tmp_path / "leak.png", make_diagnosis()).read_bytes()
    assert leak != report(recording, tmp_path / "other.png", make_diagnosis(verdict="no leak")).read_bytes()


def test_a_card_says_what_a_reader_must_know(recording, make_diagnosis) -> None:
    about = {"Machine": "Press <7>", "Date": "2026-05-31", "Oil temperature": "41 degC"}
    course = LeakCourse(*(np.linspace(0, end, 9) for end in (40.0, 0.004, 0.003, 0.005)))
    card = render_card(replace(recording, provenance={"about": about}), make_diagnosis(course=course))
    flow = "0.00421 L/min, between 0.0031 and 0.0057 L/min"
    for text in (
        "Press &lt;7&gt;",
        "2026-05-31",
        "41 degC",
        "Leak: oil bypasses",
        flow,
        "Since 20.4 s",
        "95 % interval",
    ):
        assert text in card
    assert "<script" not in card and 'class="interval"' in card
    unsure = render_card(recording, make_diagnosis(verdict="cannot tell", course=None))
    assert "d3 fell in both chambers" in unsure and 'class="still"' not in unsure


def test_weasyprint_gets_drawings_with_styles_of_their_own(tmp_path, monkeypatch, recording, make_diagnosis) -> None:
    """It applies no sheet of the page within a drawing, and knows no variables there: all would be black."""
    pages: list[str] = []

    class HTML:
        def __init__(self, string: str) -> None:
            pages.append(string)

        def write_pdf(self, target: Path) -> None:
            target.write_bytes(b"")

    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setitem(sys.modules, "weasyprint", SimpleNamespace(HTML=HTML))
    with refusal("end"):
        report(recording, tmp_path / "page.pdf", make_diagnosis())
    (page,) = pages
    drawings = re.findall(r"<svg\b.*?</svg>", page, re.DOTALL)
    assert drawings
    for drawing in drawings:
        (sheet,) = re.findall(r"<style>(.*?)</style>", drawing, re.DOTALL)
        assert ".chamber-a{fill:#dbe8f4}" in sheet and ".line.a{stroke:#0d4f8b}" in sheet
    assert "body{margin:0;background:#fff;" in page  # the printed value comes before the light one


@pytest.mark.slow
def test_weasyprint_prints_a_page_in_colour(tmp_path: Path, monkeypatch, recording, make_diagnosis) -> None:
    pytest.importorskip("weasyprint", reason="the extra `pdf` is not installed")
    monkeypatch.setattr("shutil.which", lambda name: None)
    streams: list[bytes] = []
    for rig in (None, "thesis"):
        page = report(recording, tmp_path / "page.pdf", make_diagnosis(), rig=rig)
        assert page.read_bytes().startswith(b"%PDF-")
        for stream in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", page.read_bytes(), re.DOTALL):
            with contextlib.suppress(zlib.error):
                streams.append(zlib.decompress(stream))
    blue = b"0.05098 0.309804 0.545098"  # #0d4f8b, the pen of the curves
    assert any(blue in stream for stream in streams)


def test_without_a_browser_no_card_is_drawn(tmp_path: Path, monkeypatch, recording, make_diagnosis) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    with refusal("Chromium", ".png", error=MissingExtra):
        report(recording, tmp_path / "card.png", make_diagnosis())
    assert list(tmp_path.iterdir()) == []


def test_a_picture_of_another_size_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = tmp_path / "browser"
    small.write_text(
        '#!/bin/sh\nfor a in "$@"; do case $a in --screenshot=*) printf \'\\211PNG\' > "${a#*=}";; esac; done\n'
    )
    small.chmod(0o755)
    monkeypatch.setattr(printing, "BROWSERS", (str(small),))
    with refusal("status 0"):
        printing.draw_page(PAGE, tmp_path / "card.png", 1200, 630)
    assert [path.name for path in tmp_path.iterdir()] == ["browser"]


def _browser_that_copies(path: Path, name: str, content: bytes) -> str:
    """Write a program that is called as a browser, and makes a file of this content."""
    (path / "content").write_bytes(content)
    program = path / "browser"
    program.write_text(
        f'#!/bin/sh\nfor a in "$@"; do case $a in --{name}=*) cat {path / "content"} > "${{a#*=}}";; esac; done\n'
    )
    program.chmod(0o755)
    return str(program)


def _png(width: int, height: int) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">L", len(data)) + name + data + struct.pack(">L", zlib.crc32(name + data))

    head = struct.pack(">LL5B", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(height * (width + 1)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


PDF = b"%PDF-1.4\n1 0 obj\n<<>>\nendobj\nxref\n0 1\n0000000000 65535 f \ntrailer\n<<>>\nstartxref\n29\n%%EOF\n"


@pytest.mark.parametrize("kind", ["pdf", "png"])
def test_what_a_full_disk_cuts_off_replaces_nothing(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A browser ends with status 0 all the same; whatever it cuts off, the file of before is there."""
    whole, target, tools = (PDF if kind == "pdf" else _png(40, 30)), tmp_path / f"out.{kind}", tmp_path / "tools"
    tools.mkdir()
    for length in range(0, len(whole) - 1, 7 if kind == "pdf" else 5):
        cut = whole[:length]
        name = "print-to-pdf" if kind == "pdf" else "screenshot"
        monkeypatch.setattr(printing, "BROWSERS", (_browser_that_copies(tools, name, cut),))
        target.write_text("what was there before")
        with refusal("browser"):
            printing.print_page(PAGE, target) if kind == "pdf" else printing.draw_page(PAGE, target, 40, 30)
        assert target.read_text() == "what was there before"
        assert sorted(path.name for path in tmp_path.iterdir()) == [target.name, "tools"]
    _browser_that_copies(tools, name, whole)
    printing.print_page(PAGE, target) if kind == "pdf" else printing.draw_page(PAGE, target, 40, 30)
    assert target.read_bytes() == whole


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser of Chromium's family on this machine")
@pytest.mark.parametrize(("kind", "sizes"), [("pdf", (4_000, 12_000, 20_000)), ("png", (12_000,))])
def test_a_browser_on_a_full_disk(
    kind: str, sizes: tuple[int, ...], tmp_path: Path, recording, make_diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No file may become longer than `size` bytes, here or in the browser."""
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # compiled code of a module would be cut, and loaded later
    target, before = tmp_path / f"page.{kind}", resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in sizes:
        target.write_text("what was there before")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            with pytest.raises(InputError):
                report(recording, target, make_diagnosis())
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert target.read_text() == "what was there before"
        assert [path.name for path in tmp_path.iterdir()] == [target.name]
    report(recording, target, make_diagnosis())
    assert target.stat().st_size > 20_000


def test_without_a_printer_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    with refusal("Chromium", "WeasyPrint", "page.pdf", error=MissingExtra):
        printing.print_page(PAGE, tmp_path / "page.pdf")
    assert list(tmp_path.iterdir()) == []


def test_a_browser_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "browser"
    broken.write_text("#!/bin/sh\necho no display >&2\nexit 3\n")
    broken.chmod(0o755)
    monkeypatch.setattr(printing, "BROWSERS", (str(broken),))
    with refusal("PDF", "status 3", "no display"):
        printing.print_page(PAGE, tmp_path / "page.pdf")
    assert [path.name for path in tmp_path.iterdir()] == ["browser"]


def test_a_browser_that_cannot_be_started_is_not_said_to_be_slow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, slow = tmp_path / "gone", tmp_path / "slow"
    gone.write_text("#!/no/such/interpreter\n")
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    monkeypatch.setattr(printing, "_BROWSER_TIMEOUT", 0.25)
    for browser, words, other in ((gone, ("starts", "No such file"), "0.25 s"), (slow, ("0.25 s",), "starts")):
        browser.chmod(0o755)
        monkeypatch.setattr(printing, "BROWSERS", (str(browser),))
        with pytest.raises(InputError) as error:
            printing.print_page(PAGE, tmp_path / "page.pdf")
        assert all(word in str(error.value) for word in (*words, str(browser)))
        assert other not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["gone", "slow"]
