"""The workbench in Chromium, from an empty folder to verdicts, with axe on every screen, at both widths."""

from __future__ import annotations

import base64
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.app.server import AppServer
from sealscope.monitor.settings import read_settings
from sealscope.reporting.printing import BROWSERS

from .conftest import HEADING, write_log

pytestmark = pytest.mark.slow
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
UNDATED = re.compile(r'^written = "[^"]*"$', re.MULTILINE)
SCREENS = ("logs", "channels", "healthy", "verdict", "trend", "hold")


@pytest.fixture(scope="module")
def browser():
    """A browser that is steered from outside."""
    playwright = pytest.importorskip("playwright.sync_api", reason="the extra `browser` is not installed")
    pytest.importorskip("axe_playwright_python.sync_playwright", reason="the extra `browser` is not installed")
    if BROWSER is None:
        pytest.skip("no browser of Chromium's family on this machine")
    with playwright.sync_playwright() as steering:
        running = steering.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture(scope="module")
def material(tmp_path_factory) -> Path:
    """Logs of five loggers: German CSV, tabs with stamps of no known form, NetCDF, a packed log, and a held load."""
    folder = tmp_path_factory.mktemp("material")
    days = folder / "press 7"
    days.mkdir()
    heading = HEADING.replace("Druck Kolbenseite [bar]", "PG_1 [bar]").replace("Druck Stangenseite [bar]", "PG_2 [bar]")
    for day in range(1, 6):
        write_log(days / f"day {day}.csv", day, heading=heading)
    write_log(days / "suspect <b>.csv", 6, "0.05 L/min from 20 s", heading=heading)
    rows = [f"05.06.2026 12h{k // 600:02d}m{k / 10 % 60:04.1f}\t{100 + k % 7}\t{50 + k % 5}" for k in range(900)]
    (folder / "odd.txt").write_text("\n".join(["rig 7", "", "Zeit\tp_A [bar]\tp_B [bar]", *rows]), encoding="utf-8")
    ss.write(ss.simulate(duration="20 s", seed=9), folder / "run.nc")
    write_log(folder / "inner.csv", 7, seconds=20.0)
    with zipfile.ZipFile(folder / "packed.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(folder / "inner.csv", "inner.csv")
    (folder / "inner.csv").unlink()
    t = np.arange(0.0, 420.0, 0.2)
    x = 200.0 - 0.05 * t - 2.0 * np.exp(-t / 20.0) + np.random.default_rng(1).normal(0, 0.01, len(t))
    held = [f"{a:.1f},{b:.4f},120" for a, b in zip(t, x, strict=True)]
    (folder / "hold.csv").write_text("\n".join(["t [s],x [mm],p_A [bar]", *held]) + "\n", encoding="utf-8")
    return folder


class Page:
    """A page of the workbench: waits by looking, since the page forbids evaluated text; collects its errors."""

    def __init__(self, browser, server: AppServer, width: int = 1280, scheme: str = "light", address: str = "") -> None:
        self.context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        self.view, self.errors, self.width = self.context.new_page(), list[str](), width
        self.view.on("pageerror", lambda error: self.errors.append(str(error)))
        self.view.on("console", self.note)
        self.view.on("response", lambda answer: self.errors.append(answer.url) if answer.status >= 500 else None)
        self.view.goto(address or server.address)

    def note(self, line) -> None:
        """Keep an error of the console, but that of an answer 400, as of a name that has just been changed."""
        if line.type == "error" and "status of 400" not in line.text:
            self.errors.append(line.text)

    def until(self, condition: str, seconds: float = 120.0) -> None:
        """Wait until an expression holds in the page."""
        end = time.monotonic() + seconds
        while not self.view.evaluate(condition):
            assert time.monotonic() < end, (condition, self.errors, self.view.text_content("#problem"))
            self.view.wait_for_timeout(100)

    def open(self, screen: str) -> None:
        self.view.click(f"[data-screen={screen}]")
        self.until(f"!document.getElementById('{screen}').hidden")

    def programs(self, screen: str, command: str) -> list[list[str]]:
        """Return the programs that run the command, and the lines of Python, of a screen as they stand in its text.

        `command`: the word after `sealscope`, by which the text is known to be that of the screen.
        """
        self.open(screen)
        if self.view.locator("#script[open]").count() == 0:
            self.view.click("#script summary")
        self.until(f"document.getElementById('script-command').textContent.startsWith('sealscope {command} ')")
        self.folder = self.view.text_content("#script-folder")
        command, lines = (self.view.text_content(f"#script-{name}") for name in ("command", "python"))
        return [["sh", "-c", command], [sys.executable, "-c", lines]]

    def run(self, program: list[str]) -> str:
        """Run a program of `programs` in the folder that the page names, and return what it prints."""
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            program, check=False, cwd=self.folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
        )
        assert done.returncode == 0, (program, done.stderr)
        return done.stdout.strip()

    def drop(self, files: list[Path]) -> None:
        """Drop files on the page, as from a file manager."""
        contents = [[file.name, base64.b64encode(file.read_bytes()).decode()] for file in files]
        transfer = self.view.evaluate_handle(
            """(files) => {
                const transfer = new DataTransfer();
                for (const [name, text] of files)
                    transfer.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
                return transfer;
            }""",
            contents,
        )
        self.view.dispatch_event("#drop", "drop", {"dataTransfer": transfer})

    def settle(self) -> None:
        self.until("!document.querySelector('#jobs progress')")

    def faults(self) -> list[str]:
        """Return what axe finds on the screen, and whether it is wider than its window."""
        from axe_playwright_python.sync_playwright import Axe

        wide = self.view.evaluate("document.documentElement.scrollWidth") > self.width
        response = Axe().run(self.view).response
        assert len(response["passes"]) > 10
        found = response["violations"]
        return [f"{fault['id']}: {fault['nodes'][0]['html'][:200]}" for fault in found] + (["too wide"] if wide else [])


def test_from_an_empty_folder_to_the_verdict(browser, material: Path, tmp_path: Path) -> None:
    server = AppServer(tmp_path / "session")
    try:
        page = Page(browser, server)
        view = page.view
        # logs: a folder by its path, others dropped, one with a wrong first row mended
        view.fill("#open-path", str(material / "press 7"))
        view.press("#open-path", "Enter")
        page.until("document.querySelectorAll('#log-table tbody tr').length === 6")
        page.drop([material / name for name in ("odd.txt", "run.nc", "packed.zip")])
        view.set_input_files("#drop-files", [material / "hold.csv"])
        page.until("document.querySelectorAll('#log-table tbody tr').length === 10")
        page.settle()
        page.until("document.getElementById('log-count').textContent.includes('1 cannot be read')")
        assert view.locator("#log-table b").count() == 0  # the name with markup stays text
        view.get_by_role("button", name="Read odd.txt differently").click()
        view.fill("[name=first_row]", "4")
        view.select_option("[name=delimiter]", "tab")
        view.fill("[name=time_format]", "%d.%m.%Y %Hh%Mm%S.%f")
        page.until(
            "document.getElementById('mend-problem').textContent === '' && document.querySelector('#mend-rows td')"
        )
        page.until("document.querySelector('#mend-rows td').textContent.startsWith('2026-06-05T12')")
        view.click("#mend-form button[type=submit]")
        page.until("!document.getElementById('log-count').textContent.includes('cannot')")
        page.settle()
        # channels: two columns by hand, one by dragging, one by its list
        page.open("channels")
        view.select_option("#channel-file", label="day 1.csv")
        page.until("document.querySelectorAll('.column-card').length === 4")
        page.until("document.querySelector('#drawing [data-channel=p_A]')")
        view.fill("#sizes [name=name]", "press 7")
        view.press("#sizes [name=name]", "Tab")
        page.until("document.getElementById('machine').value === 'press 7'")
        page.until("document.querySelectorAll('.column-card').length === 4")
        view.drag_and_drop(".column-card:has-text('PG_1')", "#drawing [data-channel=p_A] circle")
        page.until("/p_A.*by hand/.test(document.getElementById('map-table').textContent)")
        view.get_by_label("PG_2 [bar] is").select_option("p_B")
        page.until("(document.getElementById('map-table').textContent.match(/by hand/g) || []).length === 2")
        page.until("document.getElementById('checks').textContent.includes('p_B [bar]')")
        view.fill("#sizes [name=displacement]", "1,02 cm^3/rev")
        view.press("#sizes [name=displacement]", "Tab")
        view.fill("#sizes [name=limit]", "15 mL/min")
        view.press("#sizes [name=limit]", "Tab")
        page.until("document.getElementById('limit-words').textContent.includes('15 mL/min')")
        page.until("document.querySelectorAll('.checks-drawn svg').length === 3")  # the piston never rests
        page.until("/close; they do within [0-4][.]?[0-9]* %/.test(document.getElementById('compared').textContent)")
        view.locator(".checks-drawn svg").first.focus()
        view.keyboard.press("ArrowRight")
        page.until("document.querySelector('.checks-drawn .reading').textContent.includes('mean out')")
        # healthy days, by the keyboard
        page.open("healthy")
        page.until("document.querySelectorAll('#day-table tbody tr').length >= 9")
        for day in range(1, 6):
            view.get_by_label(f"day {day}.csv is healthy", exact=True).focus()
            view.keyboard.press("Space")
            page.until(f"document.getElementById('day-count').textContent.includes('{day} ticked')")
        view.click("#commission")
        page.until("!document.getElementById('learnt').hidden", 300)
        machine = tmp_path / "session" / "press 7.toml"
        with view.expect_download() as download:
            view.get_by_role("link", name="press 7.toml", exact=True).click()
        assert download.value.path().read_bytes() == machine.read_bytes()
        # verdict, its evidence, cursor and zoom by the keyboard
        page.open("verdict")
        view.select_option("#verdict-file", label="suspect <b>.csv")
        page.until("document.getElementById('verdict-head').textContent.includes('suspect <b>.csv is not judged')")
        view.get_by_role("button", name="Judge this log").click()
        page.until("document.getElementById('verdict-head').textContent.includes('suspect <b>.csv: leak')", 300)
        page.until("document.querySelectorAll('#evidence-charts canvas').length >= 4")
        chart = view.locator(".plot[aria-label^='Where the oil goes']")
        chart.focus()
        view.keyboard.press("ArrowRight")
        view.keyboard.press("ArrowRight")
        page.until(
            "[...document.querySelectorAll('.reading')].some((line) => /piston .* leakage/.test(line.textContent))"
        )
        view.keyboard.press("+")
        view.get_by_role("button", name="Confirm").click()
        page.until("document.querySelector('[aria-pressed=true]')")
        view.get_by_role("button", name="Write the report’s page").click()
        page.until("document.querySelector('#verdict-head a')")
        assert (tmp_path / "session" / "reports" / "suspect <b>.html").exists()
        # trend and hold test
        page.open("trend")
        view.get_by_role("button", name="Estimate").click()
        page.until("document.querySelectorAll('#trend-charts .dot').length >= 6", 300)
        page.open("hold")
        view.select_option("#hold-file", label="hold.csv")
        view.fill("#hold-form [name=limit]", "24 mm in 3 min")
        view.get_by_role("button", name="Judge the hold").click()
        page.until("document.getElementById('hold-results').textContent.includes('passes, limit 24 mm in 3 min')")
        check_commands(page, server)
        # the folder is watched from now on
        page.open("trend")
        view.fill("#watch-folder", str(material / "press 7"))
        view.get_by_role("button", name="Write the monitor's settings").click()
        page.until("document.getElementById('watch-answer').textContent.includes('monitor press 7.toml')")
        (watched,) = read_settings(tmp_path / "session" / "monitor press 7.toml").actuator
        assert watched.name == "press 7" and "limit" in machine.read_text(encoding="utf-8")
        assert page.errors == [], page.errors
        page.context.close()
        check_screens(browser, server)
    finally:
        server.close()
    replayed = subprocess.run(
        [sys.executable, "-m", "sealscope", "app", str(tmp_path / "session"), "--replay"],
        check=True, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert replayed.stdout.strip().endswith("1 verdicts, equal to those of the session")


def check_commands(page: Page, server: AppServer) -> None:
    """What the page offers to be copied gives the same machine's file but its date, and the same verdicts."""
    folder = server.workbench.folder.folder
    names = ("press 7.toml", "press 7.healthy")
    of_the_page = [UNDATED.sub("", (folder / name).read_text("utf-8")) for name in names]
    page.open("verdict")
    page.view.select_option("#verdict-file", label="suspect <b>.csv: leak")
    page.until("document.getElementById('verdict-head').textContent.includes('suspect <b>.csv: leak')", 300)
    (key,) = [log for log in server.workbench.folder.list_keys()[0] if log.endswith("suspect <b>.csv")]
    kept = server.workbench.verdict("press 7", key)
    assert kept is not None
    shell, python = map(page.run, page.programs("verdict", "diagnose"))
    assert shell == kept["text"].strip()
    assert python == f"{key}: leak since {kept['onset_s']:.1f} s ({kept['reason']})"
    shell, python = map(page.run, page.programs("trend", "trend"))
    words = server.workbench.trend("press 7")["words"].split("means: ")[-1]
    assert shell == python and " ".join(shell.split()).startswith(words.split(".")[0])
    page.open("hold")
    page.view.select_option("#hold-file", label="run.nc")
    page.view.select_option("#hold-file", label="hold.csv")  # the command follows the choice
    page.until("document.getElementById('script-command').textContent.includes('hold dropped/hold.csv')")
    shell, python = map(page.run, page.programs("hold", "hold"))
    result = page.view.locator("#hold-results pre").first.text_content()
    assert shell == python == result.strip().replace(f"{folder}/", "")
    for program in page.programs("channels", "inspect"):
        assert "p_A" in page.run(program)
    for program in page.programs("healthy", "commission"):
        for name in names:
            (folder / name).unlink()
        page.run(program)
        assert [UNDATED.sub("", (folder / name).read_text("utf-8")) for name in names] == of_the_page, program


def check_screens(browser, server: AppServer) -> None:
    """Look at every screen with axe, wide and light, narrow and dark."""
    for width, scheme in ((1280, "light"), (400, "dark")):
        server.guard.token = "again"
        page = Page(browser, server, width, scheme, f"{server.page}start?token=again")
        for screen in SCREENS:
            page.open(screen)
            page.settle()
            page.view.wait_for_timeout(1500)
            assert page.faults() == [], (screen, width)
            primary = page.view.locator("button.main:visible")
            assert primary.count() == 1, (screen, width, primary.all_text_contents())
            legends = "[...document.querySelectorAll('figure.trace')].filter((f) => f.checkVisibility())"
            assert page.view.evaluate(f"{legends}.every((f) => f.querySelector('.keys').childElementCount)"), screen
        assert page.errors == []
        page.context.close()
