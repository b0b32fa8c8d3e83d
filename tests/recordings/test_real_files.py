"""Real strokes of a rotary actuator (public data set vtnsi/actuator_dataset), and what is found in them."""

from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sealscope.recordings import COUNTS, Recording, inspect, read

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "vtnsi_actuator"
FILES = sorted(FOLDER.glob("*/*.txt"))
SINGLE = [path for path in FILES if path.parent.name.startswith("act_")]
pytestmark = pytest.mark.skipif(not FILES, reason="../shared/data/real/vtnsi_actuator is absent")
MAP = {"p_A": "PG_1", "p_B": "PG_2"}


@cache
def stroke(path: Path) -> Recording:
    return read(path, map=MAP, rate=1000)


@pytest.mark.slow
def test_every_twelfth_stroke_reads_as_numpy_reads_it() -> None:
    for path in FILES[::12]:
        recording = stroke(path)
        assert recording.units["p_A"] == recording.units["p_B"] == COUNTS
        assert recording.rate == 1000
        assert len(recording) == 3000
        expected = np.genfromtxt(path, delimiter="\t", skip_header=1, usecols=(8, 9))
        assert np.array_equal(recording["p_A"], expected[:, 0])
        assert np.array_equal(recording["p_B"], expected[:, 1])


@pytest.mark.slow
def test_ports_are_clean_but_for_the_strokes_that_fall_below_zero() -> None:
    result = Counter()
    for path in FILES[::6]:
        recording = stroke(path)
        findings = inspect(recording)
        assert [finding.channel for finding in findings if finding.code == "raw_counts"] == ["p_A", "p_B"]
        for finding in (finding for finding in findings if finding.code != "raw_counts"):
            assert finding.code == "clipped"
            at_zero = np.flatnonzero(recording[finding.channel] == 0)
            assert finding.count == at_zero.size > 300
            result[finding.code] += 1
    assert 0 < result["clipped"] < len(FILES)


@pytest.mark.long
@pytest.mark.slow
def test_what_is_not_connected_is_seen_as_hum() -> None:
    hums = sum(
        any(f.code == "mains_hum" and "60 Hz" in f.text for f in inspect(read(path, map={"p_A": "PG_3"}, rate=1000)))
        for path in SINGLE
    )
    assert hums > len(SINGLE) // 2
