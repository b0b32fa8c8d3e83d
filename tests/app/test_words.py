"""Dates, lengths and the duty that healthy days cover, in words and bins."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.app.words import cover_duty, format_date, format_duty, format_length


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ({"start_s": 1_772_350_200.0, "zone": ""}, "2026-03-01 07:30:00 (logger’s clock)"),
        ({"start_s": 1_772_350_200.0, "zone": "Z"}, "2026-03-01 07:30:00 (UTC)"),
        ({"start_s": 1_772_350_200.0, "zone": "+02:00"}, "2026-03-01 09:30:00 (+02:00)"),
        ({"start_s": 1_772_350_200.0, "zone": "-0530"}, "2026-03-01 02:00:00 (-0530)"),
        ({"start_s": None, "changed_s": None}, "no date"),
    ],
)
def test_a_date_has_the_zone_of_its_log(row, text: str) -> None:
    assert format_date(row) == text


@pytest.mark.parametrize(("seconds", "text"), [(9.5, "9.5 s"), (119.0, "119 s"), (600.0, "10 min"), (9000.0, "2.5 h")])
def test_a_length_has_three_digits(seconds: float, text: str) -> None:
    assert format_length(seconds) == text


@pytest.mark.parametrize("seed", range(5))
def test_every_log_is_counted_once_in_the_bin_that_holds_it(seed: int) -> None:
    draw = np.random.default_rng(seed)
    names = ("oil_degC", "load_bar", "speed", "moving", "minutes")
    rows = []
    for key in range(int(draw.integers(1, 30))):
        duty = {name: None if draw.random() < 0.2 else float(draw.normal()) for name in names[:-1]}
        rows.append({"key": str(key), "duty": duty | {"minutes": float(draw.uniform(1, 99)), "speed_unit": "mm/s"}})
        assert format_duty(rows[-1]).count("–") == sum(value is None for value in duty.values())
    healthy = {row["key"] for row in rows if draw.random() < 0.5}
    for name, cover in zip(names, cover_duty(rows, healthy), strict=True):
        known = [row for row in rows if row["duty"][name] is not None]
        counts = np.array(cover["counts"]).reshape(-1, 2)
        ticked = sum(row["key"] in healthy for row in known)
        assert counts.sum(axis=0).tolist() == [ticked, len(known) - ticked]
        if known:
            values = np.array([row["duty"][name] for row in known]) * (100.0 if name == "moving" else 1.0)
            span = 1.02 * (cover["edges"][-1] - cover["edges"][0])
            assert np.all(np.diff(cover["edges"]) > 0.0) and np.ptp(values) <= span
            assert cover["unit"] == {"speed": "mm/s", "moving": "%"}.get(name, cover["unit"])
