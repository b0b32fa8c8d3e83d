"""Mutated calibration files: a calibration that can be asked, or one line; never another error."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from sealscope.diagnosis.baseline.operating_point import OperatingPoint
from sealscope.diagnosis.calibration.thresholds import Place, calibrate, load, save
from sealscope.errors import UnreadableFile

from .mutations import change_tree

PLACE = Place(OperatingPoint(0, 11.0, 500.0, ("Pa", "Pa"), ("p_A", "p_B"), 2.12, 1.57), 180.0)


def mutated(text: bytes, draw: random.Random) -> bytes:
    if draw.random() < 0.3:  # bytes
        data = bytearray(text)
        for _ in range(draw.randint(1, 8)):
            data[draw.randrange(len(data))] = draw.randrange(256)
        return bytes(data[: draw.randint(1, len(data))]) if draw.random() < 0.2 else bytes(data)
    tree = json.loads(text)
    change_tree(tree, draw)
    return json.dumps(tree).encode()


@pytest.mark.parametrize("count", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_mutated_calibrations(count: int, tmp_path: Path) -> None:
    draw = random.Random(13)
    scores = [float(k) for k in range(40)]
    path = tmp_path / "calibration.json"
    save(calibrate([PLACE] * 40, {"d3 of p_A changed": scores}, false_alarm_probability=0.1), path)
    whole, loaded = path.read_bytes(), 0
    for _ in range(count):
        path.write_bytes(mutated(whole, draw))
        try:
            calibration = load(path)
        except UnreadableFile as error:
            assert "\n" not in str(error)
            assert str(path) in str(error)
            continue
        calibration.find(PLACE)
        loaded += 1
    assert 0 < loaded < count
