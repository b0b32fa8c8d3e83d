"""Mutated calibration files: a calibration that can be asked, or one line; never another error."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

from sealscope.diagnosis.baseline.operating_point import OperatingPoint
from sealscope.diagnosis.calibration.thresholds import Place, calibrate, load, save
from sealscope.errors import UnreadableFile

PLACE = Place(OperatingPoint(0, 11.0, 500.0, ("Pa", "Pa"), ("p_A", "p_B"), 2.12, 1.57), 180.0)
VALUES = (None, True, -1, 0, 1e308, -1e308, 2**60, float("nan"), float("inf"), "", "x" * 500, [], {}, [[]], {"a": 1})
COUNT = 1000


def nodes(tree: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree of JSON values."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [place for key, value in items for place in [(tree, key), *nodes(value)]]


def mutated(text: bytes, draw: random.Random) -> bytes:
    if draw.random() < 0.3:  # bytes
        data = bytearray(text)
        for _ in range(draw.randint(1, 8)):
            data[draw.randrange(len(data))] = draw.randrange(256)
        return bytes(data[: draw.randint(1, len(data))]) if draw.random() < 0.2 else bytes(data)
    tree = json.loads(text)
    for _ in range(draw.randint(1, 3)):
        container, key = draw.choice(nodes(tree))
        if draw.random() < 0.3:
            del container[key]
        else:
            container[key] = draw.choice(VALUES)
        if not nodes(tree):
            break
    return json.dumps(tree).encode()


def test_mutated_calibrations(tmp_path: Path) -> None:
    draw = random.Random(13)
    scores = [float(k) for k in range(40)]
    path = tmp_path / "calibration.json"
    save(calibrate([PLACE] * 40, {"d3 of p_A changed": scores}, false_alarm_probability=0.1), path)
    whole, loaded = path.read_bytes(), 0
    for _ in range(COUNT):
        path.write_bytes(mutated(whole, draw))
        try:
            calibration = load(path)
        except UnreadableFile as error:
            assert "\n" not in str(error)
            assert str(path) in str(error)
            continue
        calibration.find(PLACE)
        loaded += 1
    assert 0 < loaded < COUNT
