"""Samples that no sensor reads, and channels without a value, are missing: they hide no leak and print nothing."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.recordings import Recording

from ..representatives import few


@pytest.fixture(scope="module")
def leaking() -> Recording:
    return ss.simulate(command="3 sin(4t)", leak="0.05 L/min from 10 s", duration="20 s", seed=1)


@pytest.mark.parametrize(
    ("name", "value"),
    few(
        [("p_A", 1e308), ("x", -1e150), ("u", 1e30), ("x", 1e308), ("p_A", -1e150), ("omega", -1e150), ("theta", 1e30)],
        1,
    ),
)
def test_a_sample_that_no_sensor_reads_is_missing(leaking, name, value, capfd):
    channels = {key: values.copy() for key, values in leaking.channels.items()}
    channels[name][3000] = value
    result = ss.diagnose(replace(leaking, channels=channels))
    assert result.verdict == "leak"
    texts = [finding.text for finding in result.quality if finding.code == "impossible"]
    assert texts == [f"{name}: 1 sample beyond what any sensor reads, first {value:g} {leaking.units[name]}"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize("name", few(["x", "omega", "theta"], 1))
def test_a_channel_without_values_is_none(leaking, name, capfd):
    channels = {**leaking.channels, name: np.full(len(leaking), np.nan)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = ss.diagnose(replace(leaking, channels=channels))
    assert result.verdict == ss.diagnose(leaking.only(set(channels) - {name})).verdict == "leak"
    assert capfd.readouterr() == ("", "")
