"""The thesis's own tests in simulation, by its own method: small leaks found at their onset, and what looks like one
not called so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.rms_change.rms_detector import RmsChange
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.recording import Recording

from ..wording import says
from .judging import judge

pytestmark = pytest.mark.usefixtures("rms_change_alone")


def few_and_all(few: int, count: int) -> pytest.MarkDecorator:
    """The first `few` of `count` seeds by default, all of them among the slow tests."""
    return pytest.mark.parametrize("count", [few, pytest.param(count, marks=[pytest.mark.slow, pytest.mark.long])])


def judge_ringing(recording: Recording) -> Evidence:
    """Decide by the thesis's own rule, whatever else changed."""
    return judge(RmsChange(), recording)


def altered(recording: Recording, p_A: np.ndarray, p_B: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, "p_A": p_A, "p_B": p_B})


@few_and_all(2, 10)
def test_smallest_leak_with_throttles_half_closed(count: int, records) -> None:  # type: ignore[no-untyped-def]
    """0.0042 L/min, the thesis's smallest, from second 90: found in ten of ten, nine within 10 s."""
    result = [judge_ringing(records(seed, leak="0.0042 L/min from 90 s", throttled=True)) for seed in range(count)]
    assert [one.verdict for one in result] == ["leak"] * count
    assert sum(abs(one.onset_s - 90.0) <= 10.0 for one in result) >= count - 1
    for one in result:
        assert one.onset_interval_s is not None
        assert one.onset_interval_s[0] <= one.onset_s <= one.onset_interval_s[1]
        assert one.onset_interval_s[0] <= 90.0 <= one.onset_interval_s[1]
        assert one.leak_lpm is None
    assert all(says(one.reason, "alarm.details") for one in result)  # leakage damps the ringing


@pytest.mark.slow
def test_larger_leak_without_throttles(records) -> None:  # type: ignore[no-untyped-def]
    """0.015 L/min; of these eight at most three are missed."""
    result = [judge_ringing(records(seed, leak="0.015 L/min from 90 s")) for seed in range(8)]
    alarms = [one for one in result if one.verdict == "leak"]
    assert len(alarms) >= 5
    assert sum(one.onset_interval_s[0] <= 90.0 <= one.onset_interval_s[1] for one in alarms) >= len(alarms) - 1


@few_and_all(3, 8)
@pytest.mark.parametrize("throttled", [pytest.param(False, marks=[pytest.mark.slow, pytest.mark.long]), True])
@pytest.mark.slow
def test_without_a_leak_there_is_none(throttled: bool, count: int, records) -> None:  # type: ignore[no-untyped-def]
    result = [diagnose(records(seed, throttled=throttled)) for seed in range(count)]
    assert "leak" not in [one.verdict for one in result]
    assert sum(says(one.reason, "bound.ringing") for one in result) >= count - 1
    assert all(one.onset_s is None and one.onset_interval_s is None for one in result)


@few_and_all(2, 6)
@pytest.mark.parametrize("kind", ["both", "p_A alone", "common", "quieter"])
@pytest.mark.slow
def test_a_step_of_the_noise_is_no_leak(kind: str, count: int, records) -> None:  # type: ignore[no-untyped-def]
    for seed in range(count):
        recording = records(seed, duration=120.0, throttled=True)
        random = np.random.default_rng(seed)
        noise = 16e3 * random.standard_normal((2, len(recording)))
        late = (recording.t < 60.0) if kind == "quieter" else (recording.t >= 60.0)
        other = {"p_A alone": 0.0 * noise[1], "common": noise[0]}.get(kind, noise[1])
        result = diagnose(altered(recording, recording["p_A"] + late * noise[0], recording["p_B"] + late * other))
        assert result.verdict != "leak"
        assert result.cause == "sensor fault"


@pytest.mark.slow
def test_a_leak_is_found_beyond_a_step_of_the_noise(records) -> None:  # type: ignore[no-untyped-def]
    result = []
    for seed in range(6):
        recording = records(seed, leak="0.0042 L/min from 60 s", duration=120.0, throttled=True)
        random = np.random.default_rng(seed)
        noise = (recording.t >= 30.0) * 4e3 * random.standard_normal((2, len(recording)))
        result.append(judge_ringing(altered(recording, recording["p_A"] + noise[0], recording["p_B"] + noise[1])))
    alarms = [one for one in result if one.verdict == "leak"]
    assert len(alarms) >= 4
    for one in alarms:
        assert one.onset_s == pytest.approx(60.0, abs=15.0)
        assert one.onset_interval_s[0] <= one.onset_s <= one.onset_interval_s[1]


@few_and_all(4, 10)
@pytest.mark.parametrize("end", [0.9, 0.8, 0.6])
@pytest.mark.slow
def test_a_slow_drift_is_no_leak(end: float, count: int, records) -> None:  # type: ignore[no-untyped-def]
    """Gain falling evenly over the recording: the details shrink with it, and nothing says when."""
    alarms = 0
    for seed in range(count):
        recording = records(seed, duration=120.0, throttled=True)
        gain = np.linspace(1.0, end, len(recording))
        alarms += diagnose(altered(recording, gain * recording["p_A"], gain * recording["p_B"])).verdict == "leak"
    assert alarms <= (end < 0.8)


@pytest.mark.slow
def test_a_duty_without_cycle_is_judged_too(records) -> None:  # type: ignore[no-untyped-def]
    result = diagnose(records(1, command="prbs 0.8 every 0.5 s seed 1", duration=120.0, throttled=True))
    assert result.verdict != "leak" and says(result.reason, "bound.ringing")


@pytest.mark.slow
@pytest.mark.parametrize(
    "rate, samples",
    [
        (10.0, 6000),
        *(pytest.param(*each, marks=pytest.mark.long) for each in ((20.0, 8000), (50.0, 9000))),
        (500.0, 45000),
    ],
)
def test_white_noise_alarms_as_seldom_as_stated_at_any_rate(rate: float, samples: int, noise_record) -> None:  # type: ignore[no-untyped-def]
    alarms = sum(
        diagnose(noise_record(seed, samples, rate), false_alarm_probability=0.05).verdict == "leak"
        for seed in range(100)
    )
    assert alarms <= 12  # of 100 at 5 %: more has a probability of 0.1 %


@pytest.mark.slow
def test_white_noise_at_a_low_rate(noise_record) -> None:  # type: ignore[no-untyped-def]
    """The filters' memory must not pass for a change where a second has few samples."""
    result = [diagnose(noise_record(seed, 6000, 10.0), false_alarm_probability=0.05).verdict for seed in range(30)]
    assert result.count("leak") <= 5
