"""When a recording was made: its date stamps, else date and time in its file's name."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.recordings.joining import start_seconds
from sealscope.recordings.recording import Recording


def named(name: str, t0: float = 0.0, start: str | None = None) -> Recording:
    provenance = {"file": name} if start is None else {"file": name, "start": start}
    return Recording(t0 + np.arange(10) / 10.0, {"p_A": np.zeros(10)}, {"p_A": "Pa"}, 10.0, provenance)


@pytest.mark.parametrize(
    ("name", "start", "stamp"),
    [
        ("Base_000_2_410_9-11-2019-8-30-23_AM.txt", None, "2019-09-11T08:30:23"),
        ("Leak_000_0_303_9-10-2019-4-37-01_PM.txt", None, "2019-09-10T16:37:01"),
        ("x_9-10-2019-12-00-01_AM.txt", None, "2019-09-10T00:00:01"),
        ("rig-2026-07-01T14-05-09.csv", None, "2026-07-01T14:05:09"),
        ("20260701_140509.csv", None, "2026-07-01T14:05:09"),
        ("20260701-1405 run.csv", None, "2026-07-01T14:05:00"),
        ("20260701_140509.csv", "2026-07-02T00:00:00.5", "2026-07-02T00:00:00.500"),
        ("rig-2026-07-01.csv", None, "2026-07-01T00:00:00"),
        ("20261301_140509.csv", None, None),
        ("strokes_2019.csv", None, None),
        ("plain.csv", "5 s", None),
    ],
)
def test_start_of_a_recording(name: str, start: str | None, stamp: str | None) -> None:
    result = start_seconds(named(name, start=start))
    if stamp is None:
        assert result is None
    else:
        assert result == np.datetime64(stamp, "ms").astype(np.int64) / 1e3
        assert start_seconds(named(name, 2.0, start)) == result + 2.0
