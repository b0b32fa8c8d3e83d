"""A large log is read in blocks: beside its samples, nothing that grows with the file is held."""

from __future__ import annotations

import tracemalloc

import numpy as np

from sealscope.recordings import read
from sealscope.recordings.formats import text

#: Most bytes for each value of the file while it is read: a double, and its share of a column that is converted.
MOST_BYTES = 13.0


def test_reading_a_text_log_holds_little_more_than_its_samples(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "_CHUNK", 16 * 1024)
    log, rows, columns = tmp_path / "log.csv", 40_000, 9
    t = np.arange(rows) / 500
    values = np.column_stack([t, *(3 + np.sin(t + k) for k in range(columns - 1))])
    names = "t [s],p_A [bar],p_B [bar],p_1 [bar],p_2 [bar],x [mm],theta [deg],omega [rpm],u [mV]"
    np.savetxt(log, values, delimiter=",", fmt="%.6f", header=names, comments="")
    read(log)  # modules and caches
    tracemalloc.start()
    try:
        recording = read(log)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(recording) == rows
    assert peak / (rows * columns) < MOST_BYTES, peak / (rows * columns)
