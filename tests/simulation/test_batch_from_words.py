"""Batches from the package's front door: experiments from words, and what is left of them."""

from __future__ import annotations

import numpy as np
import pytest

import sealscope as ss
from sealscope.errors import InputError
from sealscope.signals.details import details

QUIET = {f"sensors.{name}.{what}": 0.0 for name in ("p_A", "p_B") for what in ("noise", "drift")}
QUIET["sensors.common_noise"] = 0.0


def test_a_batch_of_words_is_what_each_recording_is():
    words = [
        {"command": "3 sin(4t)", "duration": 8.0, "set": QUIET, "step": 5e-4, "leak": leak}
        for leak in (None, "G = 3e-12 from 4 s")
    ]
    batch = ss.simulate_batch([ss.Experiment.of(**one) for one in words], bounds=[1.0, 3.5, 7.5])
    for k, one in enumerate(words):
        found = details(ss.simulate(**one)["p_A"])
        for part, (start, stop) in enumerate([(500, 1750), (1750, 3750)]):
            expected = np.sqrt(np.mean(found.values[:, start:stop] ** 2, axis=1))
            np.testing.assert_allclose(batch.rms[k, 0, part, :4], expected, rtol=1e-6)
    changes = batch.changes()[:, 0, 2]  # d3 of p_A, per cent
    assert changes[1] < changes[0] - 5.0
    assert np.all(batch.steps == 5e-4)


def test_seeds_are_noise_and_nothing_else():
    made = [ss.Experiment.of(duration=4.0, seed=seed, leak="0.05 L/min from 1 s") for seed in range(3)]
    batch = ss.simulate_batch(made)
    assert np.ptp(batch.mean_leak_lpm) == 0.0
    assert np.unique(batch.rms[:, 0, 0, 0]).size == 3
    with pytest.raises(InputError, match="must have experiments"):
        ss.simulate_batch([])
