"""The index of a folder of pages."""

from __future__ import annotations

import re

from sealscope.reporting.index import write_index

from ..wording import says

EVIL = 'a"><script>alert(1)</script>.nc'


def test_the_most_severe_stand_first_and_every_name_leads_to_its_page(tmp_path, make_diagnosis):
    result = [
        make_diagnosis(file="healthy.nc", verdict="no leak", leak_lpm=0.0001),
        make_diagnosis(file="small.nc", verdict="leak", leak_lpm=0.002),
        make_diagnosis(file="open.nc", verdict="cannot tell", leak_lpm=None),
        make_diagnosis(file=EVIL, verdict="leak", leak_lpm=0.2),
    ]
    pages = [(tmp_path / f"page {number} #1.html", diagnosis) for number, diagnosis in enumerate(result)]
    page = write_index(tmp_path / "index.html", pages).read_text(encoding="utf-8")
    assert "<title>4 recordings: 2 leak, 1 cannot tell, 1 no leak</title>" in page
    assert re.findall(r'href="page%20(\d)%20%231\.html"', page) == ["3", "1", "2", "0"]
    assert "<script" not in page
    assert "default-src 'none'" in page
    assert says(page, "next.rule_out", faults="clipped (p_1)")  # what to do stands beside the verdict
    assert page.count("<strong>leak</strong>") == 2
