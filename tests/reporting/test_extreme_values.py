"""Values at the ends of what a double holds: a page without a warning, a number or a path that is none."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.reporting.charts import Chart, ChartLine, draw
from sealscope.reporting.page import render_page
from sealscope.reporting.picture import ticks

from ..representatives import SLOW, few

T = np.arange(4500) / 500
S = np.sin(4 * T)
SERIES = {
    "1e300": 1e300 * S,
    "1e-300": 1e-300 * S,
    "denormal": 5e-324 * np.round(3 * S),
    "constant": np.full(T.size, 3e5),
    "the largest, to and fro": 1.7e308 * np.sign(S + 0.1),
    "a large offset": 1e300 + 3e5 * S,
    "missing throughout": np.full(T.size, np.nan),
    "infinite at times": np.where(S > 0.9, -np.inf, 3e5 * S),
    "a spike": np.where(np.arange(T.size) == 3000, 1e300, 3e5 * S),
}
PRESSURES = {"p_A": 3e5 + 1e5 * S, "p_B": 3e5 - 1e5 * S}


@pytest.mark.parametrize("name", SERIES)
@pytest.mark.parametrize("where", few(["pressures", "command"], 1, SLOW))
def test_a_page_of_extreme_values(name: str, where: str) -> None:
    series = SERIES[name]
    channels = {"u": series, **PRESSURES} if where == "command" else {"p_A": series, "p_B": -series}
    recording = ss.Recording(T, channels, {"u": "V", "p_A": "Pa", "p_B": "Pa"}, 500.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        page = render_page(recording, ss.diagnose(recording))
    paths = re.findall(r' d="([^"]*)"', page)
    assert paths
    assert not [path for path in paths if re.search("nan|inf", path, re.IGNORECASE)]
    assert not re.search(r"[:\[,]\s*-?(NaN|Infinity)\b", page)


@pytest.mark.parametrize("name", SERIES)
def test_a_still_chart_of_extreme_values(name: str) -> None:
    values = SERIES[name][:2000]
    chart = Chart("x", "channels", "x", "m", (ChartLine("x", "a", values),))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording = ss.Recording(T[:2000], {"x": values}, {"x": "m"}, 500.0)
        still = draw(recording, [], [chart], Diagnosis("cannot tell", "", false_alarm_probability=0.01), ()).still["x"]
    (path,) = (shape.path for shape in still.shapes if shape.style == "line a")
    heights = [float(y) for y in re.findall(r"[ML]-?\d+ (-?\d+)", path)]
    assert all(0 <= y <= chart.height for y in heights)
    assert bool(heights) == bool(np.isfinite(values).any())
    assert 1 <= sum(label.anchor == "end" for label in still.labels) <= 12


def test_ticks_are_round_and_few() -> None:
    assert ticks(0.0, 1.0, 4) == [0.0, 0.5, 1.0]
    assert len(ticks(-1e100, 1e100, 4)) in range(3, 12)
