"""The page of a commissioned machine: its recordings over time, their bounds and limit, and hostile names."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest

from sealscope.diagnosis.verdict.severity import RepairLimit
from sealscope.reporting.printing import BROWSERS
from sealscope.reporting.trend.history import Judged, history_pictures, render_history_page, write_history_page

from ..refusals import refusal
from ..wording import says
from .pages import places

DAY = 86400.0
HOSTILE = "<!--<script><img src=x onerror=alert(2)>.csv"
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)


@pytest.fixture
def history(make_diagnosis, make_recording):
    """Four recordings of four days: a bound of 2 mL/min, nothing stated, a leak, and the newest with a hostile name."""
    limit = RepairLimit.parse("6 mL/min")
    quiet = {"leak_lpm": None, "leak_interval_lpm": None, "onset_s": None, "onset_interval_s": None}
    diagnoses = [
        make_diagnosis(file="a.csv", verdict="no leak", bound_lpm=0.002, limit=limit, **quiet),
        make_diagnosis(file="b.csv", verdict="cannot tell", reason="no <theta>", limit=limit, **quiet),
        make_diagnosis(file="c.csv", limit=limit),
        make_diagnosis(file=HOSTILE, limit=limit, leak_lpm=0.008, leak_interval_lpm=(0.007, 0.009)),
    ]
    return [
        Judged(diagnosis, 1.7e9 + DAY * k, lambda k=k: make_recording(4.0 + k, seed=k))
        for k, diagnosis in enumerate(diagnoses)
    ]


def test_the_newest_leads_whatever_the_order(history):
    page = render_history_page(history[::-1], "press 4", left_out=2)
    heading = page[page.index('<h2 id="verdict">') : page.index("</section>")]
    assert says(heading, "headline.leak")
    assert "0.008 L/min" in heading
    assert f"({history[-1].diagnosis.state.symbol} of NE 107" in heading
    assert "2 files" in heading
    table = page[page.index("<tbody>") : page.index("</tbody>")]
    assert [name for name in re.findall(r"[abc]\.csv", table)] == ["c.csv", "b.csv", "a.csv"]
    assert "none above 0.002 L/min" in table
    assert "2023-11-14" in table


def test_a_hostile_name_is_text(history):
    page = render_history_page(history, "</script><script>alert(1)</script>")
    assert "<script>alert" not in page
    assert "<img" not in page
    assert "<!--" not in page
    assert "&lt;img src=x" in page
    assert "no &lt;theta&gt;" in page
    assert page.count("<script") == 3  # data, uPlot, charts
    assert "://" not in re.sub(r"<script>.*?</script>|<details>.*?</details>", "", page, flags=re.DOTALL)


def test_figures_stand_at_their_levels_and_days(history):
    picture = history_pictures(history)["wide"]
    (bound,), (early, late), (absent,), (limit,) = (
        places(picture, style) for style in ("bound", "point", "absent", "limit")
    )
    assert [bound[1], early[1], late[1], limit[1]] == pytest.approx([2e-3, 4.21e-3, 8e-3, 6e-3], abs=3e-6)
    whiskers = [level for _, level in places(picture, "whisker")]
    assert whiskers == pytest.approx([3.1e-3, 5.7e-3, 7e-3, 9e-3], abs=3e-6)
    assert [day - bound[0] for day, _ in (absent, early, late)] == pytest.approx([1.0, 2.0, 3.0], abs=1e-3)


def test_without_dates_recordings_stand_in_order(history):
    undated = [own._replace(start_s=None) for own in history]
    days = [label.text for label in history_pictures(undated)["wide"].labels if label.x >= 0.0]
    assert [text for text in days if text] == ["1", "2", "3", "4"]
    assert "4 of 4 recordings state no date" in render_history_page(undated, "press 4")


def test_a_single_huge_bound_presses_no_other_flat(history, make_diagnosis):
    wide = make_diagnosis(verdict="cannot tell", bound_lpm=40.0, leak_lpm=None, leak_interval_lpm=None)
    picture = history_pictures([*history, Judged(wide, 1.7e9 + 9 * DAY, history[0].read)])["wide"]
    assert len(places(picture, "beyond")) == 1
    low, high, *_ = (float(picture.y(level)) for _, level in places(picture, "whisker"))
    assert low - high > 20.0


@pytest.mark.parametrize("seed", range(3))
def test_the_axis_shows_a_leak_however_much_it_grows(history, make_diagnosis, seed):
    """Days of small bounds made eight times their median the end of the axis, and all growth a symbol above it."""
    growth = 0.5 * np.cumprod(np.random.default_rng(seed).uniform(1.2, 2.0, 6))
    bounds = [make_diagnosis(verdict="no leak", bound_lpm=0.01, leak_lpm=None, leak_interval_lpm=None)] * 12
    leaks = [make_diagnosis(verdict="leak", leak_lpm=lpm, leak_interval_lpm=(0.8 * lpm, 1.2 * lpm)) for lpm in growth]
    days = [Judged(each, 1.7e9 + k * DAY, history[0].read) for k, each in enumerate([*bounds, *leaks])]
    picture = history_pictures(days)["wide"]
    assert not places(picture, "beyond")
    assert [level for _, level in places(picture, "point")] == pytest.approx(list(growth), abs=1e-3 * growth[-1])


def test_wrong_calls_are_refused(history, tmp_path):
    with refusal("1 recording"):
        render_history_page([], "press 4")
    with refusal(".html", ".htm", ".pdf", "page.png"):
        write_history_page(tmp_path / "page.png", history, title="press 4")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "dark")])
def test_in_a_browser(history, tmp_path, width, scheme):
    playwright = pytest.importorskip("playwright.sync_api", reason="the extra `browser` is not installed")
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="the extra `browser` is not installed")
    if BROWSER is None:
        pytest.skip("no browser of Chromium's family on this machine")
    page = write_history_page(tmp_path / "page.html", history, title="press 4")
    with playwright.sync_playwright() as steering:
        browser = steering.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        shown, errors = context.new_page(), []
        shown.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        shown.on("pageerror", lambda error: errors.append(str(error)))
        shown.on("dialog", lambda dialog: errors.append(dialog.message))
        shown.goto(page.as_uri())
        shown.locator('[data-chart="over-p_A"] .u-over').hover()
        assert shown.locator('figure:has([data-chart="over-p_A"]) output').all_inner_texts()[1].endswith("bar")
        assert errors == []
        shown.evaluate("scrollTo(0, 0)")
        for text in ("Leak: oil bypasses the piston", "0.008 L/min", "repair limit", "What to do"):
            box = shown.get_by_text(text).locator("visible=true").first.bounding_box()
            assert box is not None and box["y"] >= 0.0 and box["y"] + box["height"] <= 900.0, text
        assert shown.evaluate("document.documentElement.scrollWidth") <= width
        assert (
            shown.evaluate(
                "(() => {const t = document.querySelector('.rows'); return t.scrollWidth - t.clientWidth})()"
            )
            <= 0
        )
        assert shown.locator("svg.trend:visible").count() == 1
        context.close()
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=True)
        shown = context.new_page()
        shown.goto(page.as_uri())
        faults = axe.Axe().run(shown).response["violations"]
        assert [fault["id"] for fault in faults if fault["impact"] in ("serious", "critical")] == []
        browser.close()
