"""Comparison with leak-free recordings: what is found, and what may be compared with what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.rms_change.rms_detector import RmsChange
from sealscope.recordings.recording import Recording

from ..representatives import SLOW, other
from ..wording import says
from .judging import judge

pytestmark = pytest.mark.usefixtures("rms_change_alone")


@pytest.fixture(scope="module")
def sound_ones(records) -> list[Recording]:  # type: ignore[no-untyped-def]
    return [records(seed, duration=60.0, throttled=True) for seed in range(100, 108)]


def test_a_leak_from_the_start_needs_a_baseline(records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    """0.05 L/min; what few recordings say of the scatter from day to day does not tell it yet: 1.3 % of four."""
    recording = records(1, leak="0.05 L/min", duration=60.0, throttled=True)
    assert judge(RmsChange(), recording).verdict != "leak"
    for count in (1, 8):
        result = judge(RmsChange(), recording, sound_ones[:count])
        assert result.verdict == "leak" or count < 8, result.reason
        assert result.onset_s is None
        assert says(result.reason, "bound.against", count=count)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "seeds"), [(2, 2), *(pytest.param(n, 4, marks=pytest.mark.slow) for n in (2, 7))])
def test_a_sound_one_is_no_leak_beside_sound_ones(count: int, seeds: int, records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    result = [diagnose(records(seed, duration=60.0, throttled=True), sound_ones[:count]) for seed in range(seeds)]
    assert "leak" not in [one.verdict for one in result]
    assert all(says(one.reason, "bound.ringing") for one in result)


@pytest.mark.slow
@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.long), 4])
def test_more_noise_than_in_the_baseline_is_no_leak(count: int, records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    alarms = 0
    for seed in range(6):
        recording = records(seed, duration=60.0, throttled=True)
        random = np.random.default_rng(seed)
        noisy = {name: recording[name] + 16e3 * random.standard_normal(len(recording)) for name in ("p_A", "p_B")}
        result = diagnose(replace(recording, channels={**recording.channels, **noisy}), sound_ones[:count])
        alarms += result.verdict == "leak"
    assert alarms <= 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        other(("half the rate", "no baseline recording has the same chambers at 250 Hz"), SLOW),
        ("one chamber", None),
        ("counts", "other channels or units"),
    ],
)
def test_what_may_not_be_compared_is_not(
    change: str,
    reason: str | None,
    records,  # type: ignore[no-untyped-def]
    sound_ones: list[Recording],
) -> None:
    one = sound_ones[0]
    other = {
        "half the rate": lambda: replace(one, t=one.t * 2, rate=one.rate / 2),
        "one chamber": lambda: one.only(["p_A", "u"]),
        "counts": lambda: replace(one, units={**one.units, "p_A": "count", "p_B": "count"}),
    }[change]()
    result = diagnose(other, sound_ones)
    assert result.verdict == "cannot tell"
    assert reason is None or reason in result.reason


def test_a_baseline_refused_for_clipping_is_not_called_one_of_other_channels() -> None:
    random = np.random.default_rng(1)
    t = np.arange(2000) / 500.0
    pressures = {name: 2e6 + 1e5 * random.standard_normal(len(t)) for name in ("p_A", "p_B")}
    recording = Recording(t, pressures, dict.fromkeys(pressures, "Pa"), rate=500.0)
    clipped = replace(recording, channels={**pressures, "p_B": np.minimum(pressures["p_B"], 1.95e6)})
    slower = replace(recording, t=t * 2, rate=250.0)
    lacks = [RmsChange().observe(recording, [other]).lack for other in (clipped, slower)]
    assert "p_B" in lacks[0]
    assert "clipped" in lacks[0]
    assert "clipped" not in lacks[1]
    assert not RmsChange().observe(clipped, [recording]).lack  # p_A alone is judged


@pytest.mark.slow
@pytest.mark.parametrize("change", ["other duty", "other level"])
def test_another_duty_or_load_is_no_leak(change: str, records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    """What it does to the details is not known from recordings of a single duty, and counts as uncertain."""
    one = records(1, duration=60.0, throttled=True)
    other = {
        "other duty": lambda: records(1, command="5 sin(2t)", duration=60.0, throttled=True),
        "other level": lambda: replace(one, channels={**one.channels, "p_A": one["p_A"] * 2, "p_B": one["p_B"] * 2}),
    }[change]()
    assert diagnose(other, sound_ones).verdict != "leak"


@pytest.mark.slow
def test_a_baseline_given_twice_counts_once(records, sound_ones: list[Recording]) -> None:  # type: ignore[no-untyped-def]
    recording = records(1, duration=60.0, throttled=True)
    for many, single in ((sound_ones[:1] * 3, sound_ones[:1]), ([*sound_ones[:4], sound_ones[2]], sound_ones[:4])):
        result, expected = diagnose(recording, many), diagnose(recording, single)
        assert replace(result, quality=expected.quality) == expected
        assert "the same samples as another baseline recording" in result.quality[-1].text


def test_no_usable_baseline_is_said(sound_ones: list[Recording]) -> None:
    result = diagnose(sound_ones[0], [sound_ones[1].samples(slice(0, 100))])
    assert result.verdict == "cannot tell"
    assert "no baseline recording can be used: needs 226 samples" in result.reason
