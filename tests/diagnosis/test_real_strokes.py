"""Real strokes of two rotary actuators, one with a defective inner seal (public data set vtnsi/actuator_dataset).

One specimen leaks and the two were recorded on different days: a verdict of `leak` here says that the strokes differ
from the healthy ones, and no more.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.baseline.operating_point import operating_point
from sealscope.diagnosis.diagnose import diagnose
from sealscope.recordings import read
from sealscope.recordings.recording import Recording

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "vtnsi_actuator"
MAP = {"p_A": "PG_1", "p_B": "PG_2"}
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="../shared/data/real/vtnsi_actuator is absent")


def files(name: str) -> list[Path]:
    """The strokes in the order in which they were recorded."""
    return sorted((FOLDER / name).glob("*.txt"), key=lambda path: int(re.findall(r"_000_(\d+)_", path.name)[0]))


@pytest.fixture(scope="module")
def healthy() -> list[Recording]:
    return [read(path, channel_map=MAP, rate=1000) for path in files("act_1_healthy")]


@pytest.fixture(scope="module")
def defective() -> list[Recording]:
    return [read(path, channel_map=MAP, rate=1000) for path in files("act_4_seal_defect")]


def test_direction_is_that_of_the_angle(healthy: list[Recording], defective: list[Recording]) -> None:
    for name, strokes in (("act_1_healthy", healthy), ("act_4_seal_defect", defective)):
        for path, stroke in zip(files(name), strokes, strict=True):
            angle = np.genfromtxt(path, delimiter="\t", skip_header=1, usecols=4)
            turned = angle[-100:].mean() - angle[:100].mean()
            assert abs(turned) > 100
            assert operating_point(stroke).direction == np.sign(turned)


def test_defective_against_healthy(healthy: list[Recording], defective: list[Recording]) -> None:
    """30 of 30 are told from the healthy ones, each against those of its own direction alone."""
    directions = Counter(operating_point(one).direction for one in healthy)
    for stroke in defective:
        found = diagnose(stroke, healthy)
        assert found.verdict == "leak"
        assert f"against {directions[operating_point(stroke).direction]} comparable leak-free" in found.reason
        assert found.leak_lpm is None  # counts allow no L/min
        json.dumps(found.as_dict(), allow_nan=False)


def test_healthy_against_its_own_other_half(healthy: list[Recording]) -> None:
    """Pairs of strokes (one of each direction) in turn: none of 30 alarms at 1 %."""
    halves = [[one for k, one in enumerate(healthy) if (k // 2) % 2 == half] for half in (0, 1)]
    verdicts = Counter(diagnose(stroke, other).verdict for half, other in (halves, halves[::-1]) for stroke in half)
    assert verdicts["leak"] == 0
    assert verdicts["no leak"] == 30


def test_healthy_with_one_left_out(healthy: list[Recording]) -> None:
    verdicts = Counter(diagnose(one, healthy[:k] + healthy[k + 1 :]).verdict for k, one in enumerate(healthy))
    assert verdicts["leak"] <= 2  # of 30 at 1 %: more has a probability of 0.3 %
    assert sum(verdicts.values()) == 30


def test_opposite_directions_are_never_compared(healthy: list[Recording], defective: list[Recording]) -> None:
    for direction in (-1, 1):
        opposite = [one for one in healthy if operating_point(one).direction == -direction]
        strokes = [one for one in (*healthy, *defective) if operating_point(one).direction == direction]
        assert len(strokes) > 20
        for stroke in strokes:
            found = diagnose(stroke, opposite)
            assert found.verdict == "cannot tell"
            assert "another direction of the stroke" in found.reason


def test_a_single_stroke_is_too_short_to_be_its_own_baseline(defective: list[Recording]) -> None:
    for stroke in defective:
        found = diagnose(stroke)
        assert found.verdict == "cannot tell"
        assert "--baseline" in found.reason
