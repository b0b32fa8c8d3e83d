"""The page of a campaign: what came out in a sentence, one size of leak, causes that no channel tells apart."""

from __future__ import annotations

import re
from dataclasses import replace

from sealscope.reporting.campaign.page import render_campaign_page, result_text


def test_the_result_stands_on_top_in_words(campaign_result):
    words = result_text(campaign_result)
    assert words == (
        "volume balance finds 100 % (69.2–100) of leaks of 0.0042 L/min at 10 % (0.25–44.5) false alarms. "
        "26 records were judged."
    )
    page = render_campaign_page(campaign_result)
    assert page.index(words) < page.index("What each detector finds")


def test_piston_or_pump_counts_as_what_it_is(campaign_result):
    """No channel tells the two apart: named together they are named, though not alone; a pump leak's alarm is right."""
    (causes,) = campaign_result.judgement.causes
    assert (causes.confusion.accuracy.count, causes.covered.count, causes.covered.n) == (9, 9 + 10 + 4, 26)
    faults = {fault.detector: fault for fault in campaign_result.judgement.faults if fault.fault.startswith("pump")}
    assert (faults["volume balance"].alarms.count, faults["volume balance"].named.count) == (5, 4)
    assert faults["always fire"].named is None
    page = render_campaign_page(campaign_result)
    assert "The true cause is named in 88.5 % (69.8–97.6) of the records, alone in 34.6 % (17.2–55.7)" in page
    assert re.search(r"pump leak x3</td><td class=\"n\">83.3 %[^<]*</td><td class=\"n\">66.7 %", page)


def test_a_single_size_has_a_curve_no_wider_than_two_in_a_row(campaign_result):
    """One curve in a row that is filled up to its end would be drawn over the whole width."""
    page = render_campaign_page(campaign_result)
    assert page.count('<svg class="curve"') == 1
    assert "repeat(auto-fill,minmax(min(100%,400px),1fr))" in page


def test_the_score_of_each_curve_is_described(campaign_result):
    judgement = campaign_result.judgement
    pods = [replace(pod, detector="watch") for pod in judgement.pods]
    rocs = [replace(roc, detector="watch") for roc in judgement.rocs]
    page = render_campaign_page(replace(campaign_result, judgement=replace(judgement, pods=pods, rocs=rocs)))
    assert "Score: the score of the detector &#39;watch&#39;." in page


def test_the_links_to_the_tables_can_break(campaign_result):
    page = render_campaign_page(campaign_result, ["a.csv", "b.csv"])
    assert '<a href="a.csv">a.csv</a> <a href="b.csv">b.csv</a>' in page
