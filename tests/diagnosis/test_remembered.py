"""What is found of a baseline once serves every file that is compared with it."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inference.pressures.response import Follower
from sealscope.diagnosis.inference.pressures.response_detector import PressureResponse
from sealscope.parameters import Rig, load_rig
from sealscope.recordings import motion
from sealscope.recordings.motion import estimate_period
from sealscope.recordings.recording import Array, Recording, compute_once
from sealscope.simulation.simulate import simulate

from ..representatives import few
from .judging import judge


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
        load_rig("thesis").with_overrides({"pump.q_b": 5e-6}),
    )
    assert [compute_once(first, ("one", rig), find) for _ in range(3)] == [1, 1, 1]
    assert compute_once(second, ("one", rig), find) == 2
    assert compute_once(first, ("another", rig), find) == 3
    assert other is not rig
    assert compute_once(first, ("one", other), find) == 4
    assert asked[:3] == [first, second, first]


def test_views_share_what_depends_on_the_channels_they_keep() -> None:
    t = np.arange(4.0)
    recording = Recording(t, {"u": t, "p_A": t, "p_B": t}, {"u": "V", "p_A": "Pa", "p_B": "Pa"}, 1.0)
    asked: list[tuple[str, ...]] = []

    def find(recording: Recording) -> int:
        asked.append(tuple(recording.channels))
        return len(asked)

    view = recording.only(["p_A", "p_B"])
    views = (recording, view, view.only(["p_B", "p_A"]))
    assert [compute_once(one, "pair", find, ("p_A", "p_B")) for one in views] == [1, 1, 1]
    assert [compute_once(one, "all", find) for one in (recording, view, recording)] == [2, 3, 2]
    assert compute_once(recording.between(0.0, 9.0), "pair", find, ("p_A", "p_B")) == 4
    assert asked == [("u", "p_A", "p_B"), ("u", "p_A", "p_B"), ("p_A", "p_B"), ("u", "p_A", "p_B")]


def test_a_view_without_a_channel_does_not_share_what_depends_on_it() -> None:
    t = np.arange(4.0)
    recording = Recording(t, {"x": t, "p_A": t}, {"x": "m", "p_A": "Pa"}, 1.0)
    views = (recording, recording.only(["p_A"]))
    assert [compute_once(own, "balance", lambda of: tuple(of.channels), ("x", "p_A")) for own in views] == [
        ("x", "p_A"),
        ("p_A",),
    ]


@pytest.mark.parametrize("names", few([None, "p_A p_B", "p_A"], 1))
def test_the_cycle_is_computed_once_a_diagnosis(monkeypatch: pytest.MonkeyPatch, names: str | None) -> None:
    recording = simulate(command="3 sin(4t)", duration=30.0)
    recording = recording.only(recording.channels if names is None else names.split())
    lengths: list[float | None] = []

    def counted(signal: Array, rate: float) -> float | None:
        lengths.append(estimate_period(signal, rate))
        return lengths[-1]

    monkeypatch.setattr(motion, "estimate_period", counted)
    diagnose(recording)
    assert lengths == [pytest.approx(np.pi / 2, rel=2e-3)]


def test_nothing_is_kept_of_a_recording_that_is_gone() -> None:
    recording = _recording()
    held = weakref.ref(recording), weakref.ref(compute_once(recording, "itself", lambda one: one.only(one.channels)))
    assert held[1]() is not None
    del recording
    gc.collect()
    assert [reference() for reference in held] == [None, None]


@pytest.mark.slow
def test_a_baseline_is_followed_once_for_many_files(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = load_rig("thesis")
    baseline = [simulate(command="7 sin(4t)", duration=20.0, seed=seed) for seed in (1, 2)]
    files = [simulate(command="7 sin(4t)", duration=20.0, seed=seed) for seed in (3, 4)]
    followed: list[Recording] = []
    plain = Follower.fit_start

    def fit_start(recording: Recording, rig: Rig) -> Follower:
        followed.append(recording)
        return plain(recording, rig)

    fresh = judge(PressureResponse(rig), files[0], [replace_of(b) for b in baseline])
    monkeypatch.setattr(Follower, "fit_start", fit_start)
    again = [judge(PressureResponse(rig), own, baseline) for own in files]
    assert fresh.score is not None, fresh.reason
    assert again[0].score == fresh.score
    assert sum(own is b for own in followed for b in baseline) == 2


def replace_of(recording: Recording) -> Recording:
    """The same recording as another object."""
    return replace(recording)
