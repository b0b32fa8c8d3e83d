"""Predictions: against closed forms, against normal scores, and from a campaign's rows."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.prediction.detection import (
    THESIS_DETECTORS,
    ChangeDetector,
    DetectorPrediction,
    Responses,
    change_detector,
    probability,
    smallest_leaks,
)
from sealscope.campaigns.prediction.predict import DetectionTarget, with_closing
from sealscope.campaigns.prediction.responses import measured_responses
from sealscope.diagnosis.baseline.operating_point import OperatingPoint
from sealscope.diagnosis.calibration.scorers import SCORERS
from sealscope.diagnosis.calibration.thresholds import Place
from sealscope.errors import InputError
from sealscope.parameters import load_rig

FELL, ROSE, CHANGED = (ChangeDetector("d3", "p_A", side) for side in ("fell", "rose", "changed"))


def falling(slope: float, scatter: float, top: float = 0.1, records: int = 1000) -> Responses:
    """A change that falls in proportion to the leak: -slope per L/min."""
    sizes = np.array([0.001, top])
    mean = np.concatenate([[0.0], -slope * sizes])[:, None]
    return Responses(sizes, mean + 0.3, np.full_like(mean, scatter), records, records - 1)


def test_smallest_leak_of_a_straight_line_is_the_closed_form() -> None:
    """a_p = (z_{1-alpha} + z_p) s / k."""
    for alpha, p, z in ((0.01, 0.9, 2.3263 + 1.2816), (0.05, 0.5, 1.6449)):
        (found,) = smallest_leaks(falling(2.0, 0.01), [FELL], alpha, p)
        assert found.smallest == pytest.approx(z * 0.01 / 2.0, rel=0.02)
        assert found.scatter == 0.01
        assert found.lost_above is None


def test_a_side_that_does_not_move_finds_nothing_and_two_sides_cost_a_little() -> None:
    one, none, both = smallest_leaks(
        Responses(
            np.array([0.001, 0.1]),
            np.array([[0.0] * 3, [-0.002] * 3, [-0.2] * 3]),
            np.full((3, 3), 0.01),
            100,
            99,
        ),
        [FELL, ROSE, CHANGED],
        0.01,
    )
    assert none.smallest is None
    assert none.largest_detection < 0.01
    assert one.smallest is not None and both.smallest is not None
    assert both.smallest == pytest.approx((2.5758 + 1.2816) * 0.01 / 2.0, rel=0.02)
    assert one.smallest < both.smallest


def test_probability_is_that_of_normal_scores() -> None:
    random = np.random.default_rng(3)
    free, leaky = 0.02 * random.standard_normal(400_000), -0.05 + 0.03 * random.standard_normal(400_000)
    for side, scores in (("fell", lambda s: -s), ("changed", np.abs)):
        threshold = np.quantile(scores(free), 0.99)
        found, limit = probability(np.array([-0.05]), np.array([0.03]), 0.02, side, 0.01)  # type: ignore[arg-type]
        assert limit == pytest.approx(threshold, rel=0.02)
        assert found[0] == pytest.approx(np.mean(scores(leaky) > threshold), abs=0.01)


def test_what_a_larger_leak_hides_again_is_told() -> None:
    sizes = np.array([0.001, 0.01, 0.1])
    table = np.array([[0.0], [-0.05], [-0.1], [0.0]])
    (found,) = smallest_leaks(Responses(sizes, table, np.full((4, 1), 0.01), 50, 49), [FELL], 0.01)
    assert found.smallest is not None and found.lost_above is not None
    assert found.smallest < 0.01 < found.lost_above < 0.1


def test_interval_comes_from_the_scatters_own_uncertainty() -> None:
    few, many = (smallest_leaks(falling(2.0, 0.01, records=n), [FELL], 0.01)[0] for n in (10, 1000))
    for one in (few, many):
        assert one.low is not None and one.smallest is not None and one.high is not None
        assert one.low < one.smallest < one.high

    def width(one: DetectorPrediction) -> float:
        assert one.low is not None and one.high is not None
        return math.log(one.high / one.low)

    assert width(few) > 5 * width(many)
    (beyond,) = smallest_leaks(falling(2.0, 0.01, top=0.019, records=10), [FELL], 0.01)
    assert beyond.smallest is not None
    assert beyond.high is None


def test_the_size_scales_with_the_scatter_and_falls_with_more_false_alarms() -> None:
    sizes = [smallest_leaks(falling(2.0, s), [FELL], 0.01)[0].smallest for s in (0.005, 0.01, 0.02)]
    assert all(one is not None for one in sizes)
    assert sizes[1] / sizes[0] == pytest.approx(2.0, rel=0.03)  # type: ignore[operator]
    rates = [smallest_leaks(falling(2.0, 0.01), [FELL], alpha)[0].smallest for alpha in (0.001, 0.01, 0.1)]
    assert rates[0] > rates[1] > rates[2]  # type: ignore[operator]


def test_detectors_are_those_that_campaigns_know() -> None:
    assert all(one.name in SCORERS for one in THESIS_DETECTORS)
    assert change_detector("d3d4 of p_B rose") == ChangeDetector("d3d4", "p_B", "rose")
    for name in ("rms change", "d3 of p_A low", "d9 of p_A fell", "d3 of x fell", ""):
        with pytest.raises(InputError, match="a detector to predict must be like 'd3 of p_A fell'"):
            change_detector(name)


def test_bad_wishes_are_refused() -> None:
    for values in ({"false_alarm": 0.0}, {"false_alarm": 1.5}, {"detection": 1.0}, {"detectors": ()}, {"seed": -1}):
        with pytest.raises(InputError):
            DetectionTarget(**values)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="must be one or more, rise and be > 0"):
        Responses(np.array([0.2, 0.1]), np.zeros((3, 1)), np.ones((3, 1)), 9, 8)


def rows_of(folder: Path, command: str, closed: str, seed: int) -> list[str]:
    """Rows as a campaign keeps them: the change of d3 of p_A falls by 2 per L/min, with scatter 0.01."""
    random = np.random.default_rng(seed)
    point = OperatingPoint(0, 12.0, 500.0, ("Pa", "Pa"), ("p_A", "p_B"), 2.1, 1.57)
    lines = []
    for size in (0.0, 0.001, 0.1):
        for k in range(60):
            change = -2.0 * size + 0.01 * random.standard_normal()
            row = CaseRow(
                id=f"{command}{closed}{size}{k}",
                use="judge",
                leak_lpm=size,
                fault="",
                levels={"command": command, "closed": closed},
                replicate=k,
                flow_lpm=size * 1.1 if size else 0.0,
                place=asdict(Place(point, 180.0)),
                scores={"d3 of p_A fell": (-change, None)},
            )
            lines.append(json.dumps(row.as_dict()))
    return lines


def test_a_campaigns_rows_take_the_place_of_a_simulation(tmp_path: Path) -> None:
    rig = with_closing(load_rig("thesis"), 0.5)
    text = "\n".join([*rows_of(tmp_path, "3 sin(4t)", "50 %", 1), *rows_of(tmp_path, "5 sin(2t)", "25 %", 2)]) + "\n"
    (tmp_path / "rows.jsonl").write_text(text)
    other = ChangeDetector("d4", "p_A", "fell")
    found = measured_responses(tmp_path, "3 sin(4t)", rig, 180.0, (FELL, CHANGED, other))
    assert found.records == 60
    assert found.sizes == pytest.approx([0.0011, 0.11])
    predicted = smallest_leaks(found, (FELL, CHANGED, other), 0.01)
    expected = (2.3263 + 1.2816) * 0.01 / 2.0 * 1.1
    assert predicted[0].smallest == pytest.approx(expected, rel=0.25)
    assert predicted[1].smallest is not None and predicted[2].smallest is None
    assert math.isnan(predicted[2].scatter)
    for command, duration, machine in (
        ("7 sin(4t)", 180.0, rig),
        ("3 sin(4t)", 60.0, rig),
        ("3 sin(4t)", 180.0, with_closing(rig, 0.75)),
    ):
        with pytest.raises(InputError, match="must hold 8 leak-free rows"):
            measured_responses(tmp_path, command, machine, duration, (FELL,))
