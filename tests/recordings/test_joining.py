"""Files of one run joined by their clocks."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.recordings import Recording, inspect, join, read
from sealscope.recordings.header import start_seconds

from ..refusals import refusal

N, RATE = 1200, 500.0
T = np.arange(N) / RATE
WHOLE = Recording(T, {"p_A": 3e5 + np.sin(9 * T), "x": T**2}, {"p_A": "Pa", "x": "m"}, RATE)


@settings(deadline=None, max_examples=30)
@given(cuts=st.lists(st.integers(1, N - 1), min_size=1, max_size=6, unique=True), data=st.data())
def test_parts_in_any_order_give_the_whole(cuts: list[int], data: st.DataObject) -> None:
    edges = [0, *sorted(cuts), N]
    parts = [WHOLE.samples(slice(a, b)) for a, b in pairwise(edges)]
    joined = join(data.draw(st.permutations(parts)))
    assert np.array_equal(joined.t, WHOLE.t)
    for name in WHOLE.channels:
        assert np.array_equal(joined[name], WHOLE[name])


def logged(folder: Path, name: str, start: str, part: slice) -> Path:
    rows = "".join(
        f"{np.datetime64(start, 'us') + np.timedelta64(round(1e6 * t), 'us')},{p!r}\n"
        for t, p in zip(T[part] - T[part][0], WHOLE["p_A"][part].tolist(), strict=True)
    )
    (folder / name).write_text("timestamp,p_A [Pa]\n" + rows)
    return folder / name


def test_stamps_order_the_files_and_a_pause_is_a_gap(tmp_path: Path) -> None:
    later = read(logged(tmp_path, "2.csv", "2024-06-01T00:00:10", slice(600, N)))
    early = read(logged(tmp_path, "1.csv", "2024-05-31T23:59:59", slice(0, 600)))
    joined = join([later, early])
    assert joined.provenance["files"] == ["1.csv", "2.csv"]
    assert joined.provenance["start"].startswith("2024-05-31T23:59:59")
    assert joined.t[600] == pytest.approx(11.0, abs=1e-9)
    assert [finding.code for finding in inspect(joined)] == ["gap"]


def test_every_sample_keeps_its_date_whichever_file_has_the_earliest_zero() -> None:
    """Each file counts its times from a zero of its own, be it long before its first sample."""
    first = replace(WHOLE.samples(slice(0, 600)), provenance={"start": "2024-06-01T12:00:10"})
    last = WHOLE.samples(slice(600, N))
    last = replace(last, t=last.t - last.t[0] + 20.0, provenance={"start": "2024-06-01T12:00:00"})
    joined = join([first, last])
    start, start_first, start_last = (start_seconds(recording) for recording in (joined, first, last))
    assert start is not None and start_first is not None and start_last is not None
    dates = start + joined.t - joined.t[0]
    assert dates[[0, 600]] == pytest.approx([start_first, start_last], abs=1e-6)


def test_what_does_not_fit_is_refused() -> None:
    half = WHOLE.samples(slice(0, N // 2))
    with refusal("1.198 s", "0 s"):
        join([half, half])
    with refusal("500", "250 Hz"):
        join([half, Recording(T, dict(WHOLE.channels), WHOLE.units, 250.0)])
    with refusal("p_A", "x"):
        join([half, Recording(T + 9, {"x": T}, {"x": "m"}, RATE)])
    with refusal("1"):
        join([half])
