"""The page of a trend: what it shows of a life with an alarm, a repair, another sensor and a recording left out."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.trend.machine_trend import Trend
from sealscope.diagnosis.trend.machine_trend import trend as trend_of
from sealscope.diagnosis.trend.reading import LeakReading
from sealscope.reporting.trend.page import (
    _cut_line,
    find_pauses,
    render_trend_page,
    trend_pictures,
    write_trend_page,
)
from sealscope.reporting.trend.text import figures, healthy_end, trend_text

from ..diagnosis.test_trend import life
from ..refusals import refusal
from .pages import Reader, places


def test_the_page_is_whole_and_shows_what_happened(trend: Trend) -> None:
    page = render_trend_page(trend, title="press 4")
    Reader(page)
    assert page.count("<script") == 0 and "http" not in page.split("</style>")[1]
    assert "<day>" not in page and "&lt;day&gt; 5.csv" in page
    for words in (
        "press 4",
        "the level fell",
        "a sensor exchanged",
        "needs theta",
        "The leakage does not grow",
        "95 %",
    ):
        assert words in page, words
    key = page[page.index('class="key"') : page.index('class="card"')]
    assert "alarm" in key and "fell back" in key and "not before" in page  # nothing grows since the repair
    wide = page[page.index('class="trend wide"') : page.index('class="trend narrow"')]
    assert wide.count('class="point other"') == 3 and wide.count('class="absent"') == 1
    assert wide.count('class="point') == 39 and wide.count('class="course"') == len(trend.episodes) == 2


def test_the_oil_is_taken_out_where_every_recording_states_it() -> None:
    for temperatures, words in (
        ([40.0] * 3, "taken out"),
        ([40.0, None, 40.0], "not taken out"),
        ([None] * 3, "not known"),
    ):
        days = [replace(own, temperature=known) for own, known in zip(life(3), temperatures, strict=True)]
        text = " ".join(trend_text(trend_of(days), whole=True).split())
        assert f"The oil's temperature is {words}." in text


def test_relative_levels_name_the_recordings_they_are_relative_to() -> None:
    days = [replace(own, states_flow=False) for own in life(6)]
    for healthy, reference in ((1, "of the first;"), (4, "of the mean of the first 4;")):
        trend = trend_of(days, healthy=healthy)
        mean = np.mean([point.value for point in trend.points[:healthy]])
        assert mean == pytest.approx(100.0)
        assert reference in figures(trend)["healthy"]
    trend = trend_of([replace(day, level=-day.level) for day in days])  # errors may exceed the leakage
    assert trend.points[0].value == pytest.approx(-100.0)
    assert "% of the size of the first;" in figures(trend)["healthy"]


@pytest.mark.parametrize("left_out", [0, 10])
def test_the_limit_is_reached_on_the_same_date_in_words_and_in_json(left_out: int) -> None:
    """The time until then counts from the last recording that is compared, whether or not others follow it."""
    days = life(40, wears=0.03, since=10.0)
    last = len(days) - left_out
    days[last:] = [replace(day, basis=None, problem="needs theta") for day in days[last:]]
    result = trend_of(days, healthy=8, limit="60 mL/min")
    assert (result.verdict, len(result.points), len(result.rows)) == ("leak", 40, last)
    dates = result.as_dict()["limit_reached"]
    told = [dates[name][:10] for name in ("value", "low", "high")]
    assert re.findall(r"\d{4}-\d\d-\d\d", figures(result)["limit"]) == told


def test_the_chart_stands_within_its_frame(trend: Trend) -> None:
    pictures = trend_pictures(trend)
    assert pictures is not None and list(pictures) == ["wide", "narrow"]
    for picture in pictures.values():
        for style in ("point", "point other", "point apart", "whisker", "course"):
            days, levels = np.transpose(places(picture, style))
            assert np.all((days >= trend.points[0].day - 0.1) & (days <= trend.points[-1].day + 0.1))
            assert np.all((levels >= picture.y_ends[0]) & (levels <= picture.y_ends[1]))
        lows, highs = (np.array(places(picture, "whisker"))[k::2, 1] for k in (0, 1))
        assert lows.size == 39 and np.all(lows < highs)


def test_without_a_level_there_is_a_page_without_a_chart(tmp_path: Path) -> None:
    only = LeakReading(
        file="a.csv",
        start=1.7e9,
        duration=1.0,
        pressure=np.nan,
        temperature=None,
        machine=None,
        digest="",
        problem="no x",
    )
    trend = trend_of([only])
    page = write_trend_page(tmp_path / "page.html", trend).read_text()
    assert "Cannot tell" in page and 'class="point' not in page and "no x" in trend_text(trend)


def test_another_kind_of_file_is_refused(trend: Trend, tmp_path: Path) -> None:
    with refusal(".html", ".htm", ".pdf", "page.png"):
        write_trend_page(tmp_path / "page.png", trend)
    assert list(tmp_path.iterdir()) == []


def test_a_session_has_ticks_of_minutes(trend: Trend) -> None:
    points = tuple(replace(own, day=own.day / 1440.0) for own in trend.points)
    pictures = trend_pictures(replace(trend, points=points))
    assert pictures is not None
    times = [label.text for label in pictures["wide"].labels if ":" in label.text]
    assert len(times) >= 3


def test_total_leak_and_limit_have_one_meaning_each() -> None:
    """The leak is the rise over the healthy total; what is called healthy ends at the limit."""
    days = life(40, wears=0.03, since=10.0)
    result = trend_of(days, healthy=8, limit="0.01 mL/min")
    assert result.verdict == "leak" and result.wear is not None and result.limit is not None
    shown = figures(result)
    rise = result.wear.total.value - result.wear.healthy.value
    assert float(shown["leak"].split()[0]) == pytest.approx(rise, rel=0.2)
    assert result.limit < result.wear.healthy.high
    assert healthy_end(result.wear) == max(result.limit, result.wear.healthy.value)
    assert "95 of 100" not in shown["healthy"] and "above" in shown["healthy"]
    page = render_trend_page(result)
    assert "healthy recordings of this machine scatter as far" in page
    assert ">Total<" in page and ">Now<" not in page
    assert result.state.name in page and f"state-{result.state.symbol}" in page


@pytest.mark.parametrize("seed", range(4))
def test_a_line_stops_at_a_pause_and_goes_on_after_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    days = np.cumsum(rng.uniform(0.7, 1.3, 12))
    days[5:] += rng.uniform(10.0, 20.0)
    pauses = find_pauses(days.tolist())
    assert pauses == [(days[4], days[5])]
    vertices = [(float(days[0]), 1.0), (float(days[8]), 1.0), (float(days[8]), 2.0), (float(days[-1]), 3.0)]
    first, last = _cut_line(vertices, pauses)
    assert first == [(days[0], 1.0), (days[4], 1.0)]
    assert last == [(days[5], 1.0), *vertices[1:]]
    assert list(_cut_line(vertices, [])) == [vertices]
    assert find_pauses([0.0, 1.0, 2.0]) == find_pauses([1.0]) == find_pauses([2.0, 2.0]) == []
