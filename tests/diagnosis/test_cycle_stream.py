"""The cycle balance as a stream: the same as whole windows, whatever the portions; gaps, bounded memory, alarms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.campaigns.cases.online import online
from sealscope.diagnosis.volume_balance.over_cycles.detector import CycleBalance
from sealscope.diagnosis.volume_balance.over_cycles.stream import SequentialCycles
from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from .test_cycle_balance import DOUBLE, RATE, SECONDS, SEEN, SINGLE, run

#: A false alarm in a hundred records of two minutes.
HOURLY = 0.01 * 3600.0 / SECONDS


def streamed(recording: Recording, portions: list[int], **options: float) -> SequentialCycles:
    stream = SequentialCycles(DOUBLE, alarms_per_hour=HOURLY, **options)  # type: ignore[arg-type]
    first = 0
    while first < len(recording):
        size = portions[first % len(portions)]
        stream.update(recording.samples(slice(first, first + size)))
        first += size
    return stream


def test_a_leak_is_an_alarm_soon_after_its_onset() -> None:
    made = run(DOUBLE, leak="0.0042 L/min from 60 s")
    recording, stream = made.recording.only(SEEN), SequentialCycles(DOUBLE, alarms_per_hour=HOURLY)
    raised = None
    for second in range(int(SECONDS)):
        stream.update(recording.between(second, second + 1.0))
        if stream.state.alarm is not None and raised is None:
            raised = second + 1.0
    assert raised is not None
    assert 60.0 < raised < 85.0
    alarm = stream.state.alarm
    assert alarm.onset_s == pytest.approx(60.0, abs=3.0)
    assert alarm.leak_interval_lpm[0] <= made.truth.mean_leak_lpm <= alarm.leak_interval_lpm[1]
    stream.acknowledge()
    assert stream.state.alarm is None


@pytest.mark.parametrize("rig", [DOUBLE, SINGLE])
def test_a_sound_machine_raises_no_alarm(rig: str) -> None:
    said = online("cycle balance", run(rig).recording.only(SEEN), rig, 0.01)
    assert said.verdict == "no leak"


def test_oil_that_leaves_is_named() -> None:
    said = online(
        "cycle balance", run(DOUBLE, fault="rod seal A 0.01 L/min from 60 s").recording.only(SEEN), DOUBLE, 0.01
    )
    assert (said.verdict, said.cause) == ("cannot tell", "external leak")


@settings(max_examples=4, deadline=None)
@given(st.lists(st.integers(1, 9000), min_size=1, max_size=5))
def test_portions_do_not_matter(portions: list[int]) -> None:
    portions = [max(size, 400) for size in portions]
    recording = run(DOUBLE, leak="0.0042 L/min from 60 s").recording.only(SEEN)
    here, whole = streamed(recording, portions).state, streamed(recording, [len(recording)]).state
    assert (here.t, here.blocks, here.evidence, here.alarm) == (whole.t, whole.blocks, whole.evidence, whole.alarm)


def test_the_last_word_is_the_detectors_own_on_the_window() -> None:
    recording = run(DOUBLE).recording.only(SEEN)
    stream = streamed(recording, [5000])
    seconds = 2.0 * np.pi / 1.6
    probability = HOURLY * round(seconds * RATE) / RATE / 3600.0
    own = CycleBalance(load_rig(DOUBLE)).examine(recording.between(0.0, stream.state.t), (), probability)
    assert stream.state.evidence.score == own.score
    assert stream.state.evidence.threshold == own.threshold


def test_memory_is_bounded_and_a_gap_begins_anew() -> None:
    recording = run(DOUBLE).recording.only(SEEN)
    stream = streamed(recording, [500], window=16)
    assert len(stream._samples.joined(recording.samples(slice(0, 0)))) <= 19 * 4.0 * RATE
    later = Recording(recording.t + 500.0, recording.channels, recording.units, recording.rate)
    blocks = stream.state.blocks
    stream.update(later.between(500.0, 530.0))
    assert stream.state.blocks == blocks
    stream.update(later.between(530.0, 590.0))
    assert stream.state.blocks > blocks
    assert stream.state.evidence.score is not None


def test_the_streams_beginning_binds() -> None:
    recording = run(DOUBLE).recording.only(SEEN)
    stream = streamed(recording.between(0.0, 5.0), [500])
    slower = Recording(recording.t, recording.channels, recording.units, 250.0)
    with pytest.raises(InputError, match="stream's beginning"):
        stream.update(slower)
    with pytest.raises(InputError, match="alarms_per_hour must be"):
        SequentialCycles(DOUBLE, alarms_per_hour=1e9)
    with pytest.raises(InputError, match="window must be 16 blocks"):
        SequentialCycles(DOUBLE, window=8)
