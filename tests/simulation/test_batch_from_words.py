"""Batches from the package's front door: experiments from words, and what is left of them."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import sealscope as ss
from sealscope.errors import InputError, MissingExtra
from sealscope.signals.details import details

QUIET = {f"sensors.{name}.{what}": 0.0 for name in ("p_A", "p_B") for what in ("noise", "drift")}
QUIET["sensors.common_noise"] = 0.0


def test_a_batch_of_words_is_what_each_recording_is():
    words = [
        {"command": "3 sin(4t)", "duration": 8.0, "set": QUIET, "step": 5e-4, "leak": leak, "allow_unresolved": True}
        for leak in (None, "G = 3e-12 from 4 s")
    ]
    batch = ss.simulate_batch([ss.Experiment.of(**one) for one in words], bounds=[1.0, 3.5, 7.5])
    for k, one in enumerate(words):
        result = details(ss.simulate(**one)["p_A"])
        for part, (start, stop) in enumerate([(500, 1750), (1750, 3750)]):
            expected = np.sqrt(np.mean(result.values[:, start:stop] ** 2, axis=1))
            np.testing.assert_allclose(batch.rms[k, 0, part, :4], expected, rtol=1e-6)
    changes = batch.changes("p_A", "d3")
    np.testing.assert_array_equal(changes, 100.0 * (batch.rms[:, 0, -1, 2] / batch.rms[:, 0, 0, 2] - 1.0))
    assert changes[1] < changes[0] - 5.0
    assert np.all(batch.steps == 5e-4)


def test_seeds_are_noise_and_nothing_else():
    made = [ss.Experiment.of(duration=4.0, seed=seed, leak="0.05 L/min from 1 s") for seed in range(3)]
    batch = ss.simulate_batch(made)
    assert np.ptp(batch.mean_leak_lpm) == 0.0
    assert np.unique(batch.rms[:, 0, 0, 0]).size == 3
    with pytest.raises(InputError, match="must have experiments"):
        ss.simulate_batch([])


def test_a_batch_tells_its_numbers_by_name(monkeypatch):
    runs = [ss.Experiment.of(duration=4.0, seed=seed) for seed in range(2)]
    batch = ss.simulate_batch(runs, bounds=[0.0, 1.5, 2.5, 4.0])
    assert (len(batch), repr(batch)) == (2, "<Batch: 2 runs, segments between 0, 1.5, 2.5, 4 s>")
    np.testing.assert_array_equal(batch.rms_of("p_B", "d3d4"), batch.rms[:, 1, :, 4])
    with pytest.raises(InputError, match="channel must be one of p_A, p_B, got 'p_C'"):
        batch.changes("p_C", "d3")
    with pytest.raises(InputError, match="detail must be one of d1, d2, d3, d4, d3d4, got 'd5'"):
        batch.rms_of("p_A", "d5")
    pytest.importorskip("pandas")
    table = batch.to_pandas()
    assert list(table["run"]) == [0, 0, 0, 1, 1, 1]
    assert list(table["stop [s]"]) == [1.5, 2.5, 4.0] * 2
    np.testing.assert_array_equal(table["d3 of p_A [Pa]"], batch.rms_of("p_A", "d3").ravel())
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtra, match="a table needs pandas"):
        batch.to_pandas()


@pytest.mark.parametrize(
    ("parts", "rule"),
    [
        ({"experiments": ["3 sin(4t)"]}, r"a batch must have experiments .*, got '3 sin\(4t\)'"),
        ({"error": "20[m]"}, "error must have a unit of pressure"),
        ({"thread": 1}, "simulate_batch has no argument 'thread'; did you mean 'threads'"),
    ],
)
def test_a_wrong_batch_is_refused_by_name(parts, rule):
    with pytest.raises(InputError, match=rule):
        ss.simulate_batch(**{"experiments": [ss.Experiment.of(duration=1.0)], **parts})
