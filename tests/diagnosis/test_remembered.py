"""What is found of a baseline once serves every file that is compared with it."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

from sealscope.diagnosis.baseline import memo as module
from sealscope.diagnosis.baseline.memo import remembered
from sealscope.diagnosis.observer.detector import Observer
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate


def _recording() -> Recording:
    return Recording(np.arange(4.0), {"p_A": np.zeros(4)}, {"p_A": "Pa"}, 1.0)


def test_asked_once_for_a_recording_a_detector_and_a_rig() -> None:
    asked: list[Recording] = []

    def find(recording: Recording) -> int:
        asked.append(recording)
        return len(asked)

    first, second, rig, other = (
        _recording(),
        _recording(),
        load_rig("thesis"),
        load_rig("thesis").with_values({"pump.q_b": 5e-6}),
    )
    assert [remembered(first, "one", rig, find) for _ in range(3)] == [1, 1, 1]
    assert remembered(second, "one", rig, find) == 2
    assert remembered(first, "another", rig, find) == 3
    assert other is not rig
    assert remembered(first, "one", other, find) == 4
    assert asked[:3] == [first, second, first]


def test_nothing_is_kept_of_a_recording_that_is_gone() -> None:
    recording, rig = _recording(), load_rig("thesis")
    held = weakref.ref(recording)
    remembered(recording, "one", rig, len)
    before = len(module._found)
    del recording
    gc.collect()
    assert held() is None
    assert len(module._found) == before - 1


def test_a_baseline_is_followed_once_for_many_files(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig("thesis")
    baseline = [simulate(command="7 sin(4t)", duration=120.0, seed=seed) for seed in (1, 2)]
    files = [simulate(command="7 sin(4t)", duration=120.0, seed=seed) for seed in (3, 4)]
    followed: list[Recording] = []
    plain = Observer.follow

    def follow(self: Observer, recording: Recording) -> object:
        followed.append(recording)
        return plain(self, recording)

    fresh = [Observer(rig).examine(one, [replace_of(b) for b in baseline], 0.01) for one in files]
    monkeypatch.setattr(Observer, "follow", follow)
    found = [Observer(rig).examine(one, baseline, 0.01) for one in files]
    assert all(one.score is not None for one in fresh), [one.reason for one in fresh]
    assert [one.score for one in found] == [one.score for one in fresh]
    assert sum(one is b for one in followed for b in baseline) == 2


def replace_of(recording: Recording) -> Recording:
    """The same recording as another object."""
    return recording.only(recording.channels)
