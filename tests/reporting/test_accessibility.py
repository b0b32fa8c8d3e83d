"""Every kind of page in a real browser under axe-core: no fault that it calls serious or critical."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sealscope.reporting.campaign.page import render_campaign_page
from sealscope.reporting.charts import Mark
from sealscope.reporting.index import write_index
from sealscope.reporting.page import render_page
from sealscope.reporting.printing import BROWSERS
from sealscope.reporting.trend.page import render_trend_page
from sealscope.thesis.engine.build import ItemStatus
from sealscope.thesis.engine.items import Item
from sealscope.thesis.engine.products import Claim, ThesisTable
from sealscope.thesis.pages.files import publish
from sealscope.thesis.pages.page import VERDICTS, write_thesis_page

pytestmark = pytest.mark.slow
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)


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
def pages(tmp_path_factory, recording, make_diagnosis, no_verdict, campaign_result, trend):
    """Each kind of page: name -> file."""
    folder = tmp_path_factory.mktemp("pages")
    marks = [Mark(5, "cold")]
    texts = {
        "leak": render_page(recording, make_diagnosis(), rig="thesis-calibrated", truth_onset_s=20.0, marks=marks),
        "cannot tell": render_page(recording.only(["p_A", "x"]), no_verdict),
        "trend": render_trend_page(trend),
        "campaign": render_campaign_page(campaign_result, ["table.csv", "rows.csv"]),
        "thesis": write_thesis_page(folder, _thesis(folder)).read_text(encoding="utf-8"),
    }
    files = {name: folder / f"{name}.html" for name in (*texts, "index")}
    for name, text in texts.items():
        files[name].write_text(text, encoding="utf-8")
    listed = [(files["leak"], make_diagnosis()), (files["cannot tell"], no_verdict)]
    write_index(files["index"], listed)
    return files


def _thesis(folder: Path):
    table = ThesisTable("table-4.2-a", "Cases", ("name", "p_A [MPa]"), tuple((f"row {k}", k * 1e-7) for k in range(60)))
    claims = tuple(
        Claim(f"claim-4.{k}", "section 4", f"Claim {k}", "sheet", "simulation", verdict, "why")
        for k, verdict in enumerate(VERDICTS)
    )
    made = []
    for item, products in (
        (Item("table-4.2-a", 4, "case", "T", print), (table,)),
        (Item("chapter-4-claims", 4, "claims", "C", print), claims),
    ):
        made.append(ItemStatus(item, "made", products=products, files=publish(item, products, folder)))
    return [*made, ItemStatus(Item("fig-1.1", 4, "figure", "F", print), "not made")]


#: Tables of sentences that must be scrolled sideways to be read.
WIDE_TABLES = """() => [...document.querySelectorAll(".table.rows")]
  .filter((table) => table.scrollWidth > table.clientWidth).map((table) => table.ariaLabel)"""


def faults(browser, page: Path, width: int, scheme: str) -> list[str]:
    """Return what axe-core calls serious or critical on a page whose folds are all open."""
    from axe_playwright_python.sync_playwright import Axe

    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=True)
    try:
        shown = context.new_page()
        shown.goto(page.as_uri())
        shown.evaluate("document.querySelectorAll('details').forEach((fold) => { fold.open = true; })")
        shown.wait_for_timeout(200)  # charts in the folds are drawn
        assert shown.evaluate("document.documentElement.scrollWidth") <= width, "the page is wider than its window"
        assert shown.evaluate(WIDE_TABLES) == []
        violations = Axe().run(shown).response["violations"]
    finally:
        context.close()
    return [
        f"{fault['impact']} {fault['id']}: {fault['nodes'][0]['html'][:200]}"
        for fault in violations
        if fault["impact"] in ("serious", "critical")
    ]


@pytest.mark.parametrize(("width", "scheme"), [(1300, "light"), (400, "dark")])
@pytest.mark.parametrize("name", ["leak", "cannot tell", "index", "trend", "campaign", "thesis"])
def test_no_serious_fault(browser, pages, name: str, width: int, scheme: str) -> None:
    assert faults(browser, pages[name], width, scheme) == []


def test_a_fault_would_be_seen(browser, tmp_path: Path) -> None:
    bad = tmp_path / "bad.html"
    bad.write_text("<!DOCTYPE html><html lang=en><title>t</title><p style='color:#ccc;background:#ddd'>pale</p>")
    assert any("color-contrast" in fault for fault in faults(browser, bad, 400, "light"))
