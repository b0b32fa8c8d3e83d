"""The thesis's rules as scorers: closed forms on white noise, and no sample of one side seen from the other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sealscope.campaigns.plans.scorers import SCORERS, split_log_rms
from sealscope.recordings.recording import Recording


def noise_record(seed, n):
    """White noise in both chambers."""
    random = np.random.default_rng(seed)
    channels = {name: random.standard_normal(n) for name in ("p_A", "p_B")}
    return Recording(np.arange(n) / 500.0, channels, {"p_A": "Pa", "p_B": "Pa"}, 500.0)


def middle(recording):
    return split_log_rms(recording, float(recording.t[0]) + recording.duration / 2)


def score(name, recording):
    return SCORERS[name].score(middle(recording), recording.channels)


def test_every_scorer_is_finite_or_none():
    long, short = middle(noise_record(1, 4000)), middle(noise_record(2, 100))
    for name, scorer in SCORERS.items():
        assert scorer.name == name and scorer.description
        assert math.isfinite(scorer.score(long, ("p_A", "p_B")))
        assert scorer.score(short, ("p_A", "p_B")) is None
        assert (scorer.threshold == 0.0) == name.startswith("sign rule")


def test_changes_follow_the_closed_form():
    """White noise whose standard deviation falls to 0.8 at the split: every log RMS falls by ln 0.8, d3d4 by twice."""
    plain = noise_record(3, 60000)
    scale = np.where(np.arange(60000) < 30000, 1.0, 0.8)
    changed = replace(plain, channels={name: plain[name] * scale for name in plain.channels})
    for quantity, power in (("d1", 1), ("d2", 1), ("d3", 1), ("d4", 1), ("d3d4", 2)):
        fell = [score(f"{quantity} of p_A fell", one) for one in (changed, plain)]
        assert fell[0] - fell[1] == pytest.approx(-power * math.log(0.8), abs=1e-9)
        assert score(f"{quantity} of p_A rose", changed) == -fell[0]
        assert score(f"{quantity} of p_A changed", changed) == abs(fell[0])
    louder = replace(plain, channels={name: plain[name] * 3.0 for name in plain.channels})
    low = [score("d3 of p_B low", one) for one in (louder, plain)]
    assert low[0] - low[1] == pytest.approx(-math.log(3.0), abs=1e-12)


def test_the_thesiss_cumulative_rule_is_the_lesser_of_both():
    record = noise_record(5, 8000)
    parts = score("d3d4 of p_A fell", record), score("d3d4 of p_B rose", record)
    assert score("d3d4 of both chambers as the thesis says", record) == min(parts)
    assert score("sign rule: d3d4 of both chambers as the thesis says", record.only(["p_A"])) is None


def test_nothing_beyond_the_split_is_seen_before_it():
    """A burst right after the split moves the second part only."""
    plain = noise_record(4, 8000)

    def with_burst(at):
        burst = plain["p_A"].copy()
        burst[at : at + 100] += 50.0 * (-1.0) ** np.arange(100)
        return middle(replace(plain, channels={**plain.channels, "p_A": burst}))["p_A"]

    before = middle(plain)["p_A"]
    assert np.array_equal(before[0], with_burst(4000)[0])
    assert with_burst(4400)[1][0] > before[1][0] + 0.5
