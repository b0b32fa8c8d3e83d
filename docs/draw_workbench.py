"""Draw the pictures of the workbench anew, on simulated logs of a press: python docs/draw_workbench.py [FOLDER].

It needs the extras `serve` and `browser`, and Chromium. FOLDER keeps the logs and the session; without it they are
temporary.
"""

import shutil
import sys
import time
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

import sealscope as ss
from sealscope.app.server import AppServer
from sealscope.reporting.printing import BROWSERS

HERE = Path(__file__).parent
HEADING = "Zeit [s];Druck Kolbenseite [bar];Druck Stangenseite [bar];Weg [mm];Drehzahl [1/min];Öltemperatur [°C]"
#: Day, load and leak of each log.
DAYS = (
    ("2026-01-08", 1500, None), ("2026-01-22", 2400, None), ("2026-02-05", 1900, None), ("2026-02-19", 2100, None),
    ("2026-03-05", 1700, None), ("2026-03-19", 2000, None), ("2026-05-07", 2000, "0.01 L/min"),
    ("2026-05-28", 1900, "0.035 L/min from 30 s"),
)  # fmt: skip
SCREENS = {"logs": 900, "channels": 900, "healthy": 1000, "verdict": 1700, "trend": 700, "hold": 1150}


def write_logs(folder: Path) -> None:
    """Write the logs as a German logger does, and one of a held load."""
    folder.mkdir()
    for number, (day, load, leak) in enumerate(DAYS):
        run = ss.simulate(
            rig="single-rod-eha", command="position 50 mm sin(1.2t)", load=f"{load} N", duration="60 s", seed=number,
            leak=leak,
        )  # fmt: skip
        oil = 38.0 + 2.5 * (number * 3 % 5) + run.t / 60.0
        values = (run.t, run["p_A"] / 1e5, run["p_B"] / 1e5, run["x"] * 1e3, run["omega"] * 30 / np.pi, oil)
        rows = zip(*(column[::2] for column in values), strict=True)
        lines = [";".join(f"{value:.4f}".replace(".", ",") for value in row) for row in rows]
        head = ["Prüfstand;Presse 7", "Bediener;M. Keller", f"Start;{day}T07:30:00", HEADING]
        (folder / f"presse7_{day}.csv").write_text("\n".join([*head, *lines]) + "\n", encoding="utf-8")
    t = np.arange(0.0, 600.0, 0.5)
    noise = np.random.default_rng(1)
    x = 200.0 - 0.04 * t / 60.0 * 10 - 1.5 * np.exp(-t / 25.0) + noise.normal(0, 0.01, len(t))
    rows = [f"{a:.1f};{b:.4f};{c:.2f}".replace(".", ",") for a, b, c in zip(t, x, 96.0 - 0.002 * t, strict=True)]
    head = ["Start;2026-06-01T10:00:00", "Zeit [s];Weg [mm];Druck Kolbenseite [bar]"]
    (folder / "hold 2026-06-01.csv").write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def until(view: Page, condition: str, seconds: float = 600.0) -> None:
    """Wait until an expression holds in the page, which forbids evaluated text."""
    end = time.monotonic() + seconds
    while not view.evaluate(condition):
        if time.monotonic() > end:
            raise SystemExit(f"the page never fulfils {condition}: {view.text_content('#problem')}")
        view.wait_for_timeout(100)


def fill(view: Page, values: dict[str, str]) -> None:
    for name, value in values.items():
        view.fill(f"#sizes [name={name}]", value)
        view.press(f"#sizes [name={name}]", "Tab")
        view.wait_for_timeout(1500)


def work(view: Page, logs: Path) -> None:
    """Go the way from an empty folder to the verdicts."""
    view.fill("#open-path", str(logs))
    view.press("#open-path", "Enter")
    until(view, "document.querySelectorAll('#log-table .mini').length === 9")
    view.click("[data-screen=channels]")
    view.select_option("#channel-file", label="presse7_2026-03-19.csv")
    until(view, "document.querySelector('#map-table th')")
    fill(view, {"name": "press 7"})
    until(view, "document.getElementById('machine').value === 'press 7'")
    fill(view, {"bore": "63 mm", "rod": "35 mm", "displacement": "16 cm^3/rev", "limit": "25 mL/min"})
    view.click("[data-screen=healthy]")
    until(view, "document.querySelectorAll('#day-table tbody tr').length === 9")
    for number in range(6):
        view.locator("#day-table input").nth(number + 1).check()
        until(view, f"document.getElementById('day-count').textContent.includes('{number + 1} ticked')")
    view.locator("#day-table button").first.click()  # the held load is no day of this kind
    view.click("#commission")
    until(view, "!document.getElementById('learnt').hidden")
    view.click("[data-screen=verdict]")
    until(view, "document.getElementById('judge').textContent.includes('2 other')")
    view.click("#judge")
    until(view, "document.querySelectorAll('#by-date li').length === 2")
    until(view, "!document.querySelector('#jobs progress')")
    view.click("[data-screen=trend]")
    view.click("#trend-form button")
    until(view, "document.querySelectorAll('#trend-charts .dot').length >= 7")
    view.click("[data-screen=hold]")
    view.select_option("#hold-file", label="hold 2026-06-01.csv")
    view.fill("#hold-form [name=limit]", "5 mm in 10 min")
    view.click("#hold-form button[type=submit]")
    until(view, "document.querySelector('#hold-results canvas')")


def show(view: Page, screen: str) -> None:
    """Show a screen as it is drawn: the last day's log, and all charts."""
    view.click(f"[data-screen={screen}]")
    if screen == "channels":
        view.select_option("#channel-file", label="presse7_2026-03-19.csv")
        until(view, "document.querySelectorAll('#check-charts canvas').length >= 5")
    if screen == "verdict":
        option = view.locator("#verdict-file option", has_text="2026-05-28").get_attribute("value")
        view.select_option("#verdict-file", value=option)
        until(view, "document.getElementById('verdict-head').textContent.includes('Confirm')")
        until(view, "document.querySelectorAll('#evidence-charts canvas').length >= 5")
    if screen == "trend" and not view.locator("#trend-charts .dot").count():
        view.click("#trend-form button")
        until(view, "document.querySelectorAll('#trend-charts .dot').length >= 7")
    if screen == "hold":
        view.select_option("#hold-file", label="hold 2026-06-01.csv")
        view.click("#hold-form button[type=submit]")
        until(view, "document.querySelector('#hold-results canvas')")
    view.wait_for_timeout(1500)
    view.evaluate("scrollTo(0, 0)")


def draw(folder: Path) -> None:
    """Make logs and session in a folder where they are missing, and draw every screen, wide and narrow."""
    logs = folder / "logs"
    if not logs.exists():
        write_logs(logs)
    is_new = not (folder / "session").exists()
    server = AppServer(folder / "session")
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    with sync_playwright() as steering:
        browser = steering.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        context = browser.new_context(viewport={"width": 1280, "height": 900})
        view = context.new_page()
        view.goto(server.address)
        until(view, "document.getElementById('folder').textContent")
        if is_new:
            work(view, logs)
        narrow = []
        for width in (1280, 400):
            for screen, height in SCREENS.items():
                view.set_viewport_size({"width": width, "height": height if width == 1280 else 1000})
                show(view, screen)
                picture = Image.open(BytesIO(view.screenshot()))
                if width == 400:
                    narrow.append(picture)
                else:
                    picture.quantize(256).save(HERE / f"workbench-{screen}.png", optimize=True)
                if screen == "channels" and width == 1280:
                    view.set_viewport_size({"width": 1280, "height": 1150})
                    view.locator("#checks").evaluate("(list) => list.previousElementSibling.scrollIntoView()")
                    view.wait_for_timeout(500)
                    picture = Image.open(BytesIO(view.screenshot()))
                    picture.quantize(256).save(HERE / "workbench-checks.png", optimize=True)
        strip = Image.new("RGB", (420 * len(narrow) - 20, 1000), "white")
        for number, picture in enumerate(narrow):
            strip.paste(picture, (420 * number, 0))
        strip.quantize(256).save(HERE / "workbench-narrow.png", optimize=True)
        browser.close()
    server.close()


if len(sys.argv) > 1:
    Path(sys.argv[1]).mkdir(exist_ok=True)
    draw(Path(sys.argv[1]))
else:
    with TemporaryDirectory() as temporary:
        draw(Path(temporary))
