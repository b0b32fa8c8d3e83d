"""Each detector looks once, through the channels it was given, and only where it can."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sealscope.diagnosis.commissioned import machine
from sealscope.diagnosis.detectors import registry
from sealscope.diagnosis.detectors.registry import make_observable
from sealscope.diagnosis.diagnose import Examination, diagnose
from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inference.observable import Observable, Observed, Ringing
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Recording

module = import_module("sealscope.diagnosis.diagnose")

observed: list[tuple[tuple[str, ...], int]] = []
rigs: list[Rig] = []


class Looker:
    """Notes what it was given; divides by zero, as detectors on strange data do."""

    name = "looker"

    def __init__(self, rig: Rig) -> None:
        rigs.append(rig)

    def usable(self, recording: Recording) -> str | None:
        return None if "p_A" in recording else "needs p_A"

    def observe(self, recording: Recording, baseline: object = ()) -> Observed | Observable:
        observed.append((tuple(recording.channels), len(list(baseline))))  # type: ignore[call-overload]
        assert np.isinf(np.array([1.0]) / 0.0).all()
        return make_observable("what it looks at", 0.25)


@pytest.fixture
def recording(monkeypatch: pytest.MonkeyPatch) -> Recording:
    monkeypatch.setattr(registry, "DETECTORS", {"looker": Looker})
    observed.clear()
    channels = {name: np.sin(np.arange(100.0)) for name in ("u", "x", "p_A", "p_B", "q_leak")}
    return Recording(np.arange(100.0), channels, dict.fromkeys(channels, "count"), 1.0)


def test_once_for_each_set_of_channels(recording: Recording) -> None:
    whole = Examination(recording, false_alarm_probability=0.05)
    for _ in range(3):
        assert whole.evidence("looker").chance == 0.25
    assert len(observed) == 1
    few = whole.with_channels(["u", "p_A", "p_B", "omega"])
    assert few.evidence("looker") == few.evidence("looker")
    assert [channels for channels, _ in observed] == [("u", "x", "p_A", "p_B", "q_leak"), ("u", "p_A", "p_B")]


def test_with_a_baseline_every_view_is_another(recording: Recording) -> None:
    whole = Examination(recording, [recording, recording.only(["u"])], false_alarm_probability=0.05)
    whole.evidence("looker")
    whole.with_channels(["u", "p_A", "p_B"]).evidence("looker")
    assert observed == [(("u", "x", "p_A", "p_B", "q_leak"), 1), (("u", "p_A", "p_B"), 1)]


def test_who_cannot_look_does_not(recording: Recording) -> None:
    def said(examination: Examination) -> tuple[str, bool]:
        result = examination.evidence("looker")
        return result.reason, result.usable

    assert said(Examination(recording.only(["u"]), false_alarm_probability=0.05)) == ("needs p_A", False)
    assert said(Examination(recording, false_alarm_probability=0.05, distrust="stuck")) == ("stuck", False)
    alone = Examination(recording, [recording.only(["u"])], false_alarm_probability=0.05)
    assert said(alone) == ("no baseline recording can be used: needs p_A", False)
    assert observed == []


def test_it_is_made_for_the_rig_given_or_the_thesis_s(recording: Recording) -> None:
    thesis = load_rig("thesis")
    other = thesis.with_overrides({"q_b": 1e-6})
    for rig, expected in ((other, other), ("thesis", thesis)):
        examination = Examination(recording, false_alarm_probability=0.05, rig=rig)
        examination.evidence("looker")
        assert rigs.pop() is expected


def test_what_stands_in_for_a_judge_is_not_asked(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """The most specific judges; where it abstains the next does; a user's own detectors are asked in any case."""

    class Volumes(Looker):
        name = "volume balance"

        def observe(self, recording: Recording, baseline: object = ()) -> Observed:
            return Observed(self.name, ringing=Ringing(0.01, 500.0, 0, True))

    class Abstains(Volumes):
        def observe(self, recording: Recording, baseline: object = ()) -> Observed:
            return Observed(self.name, lack="too little")

    class Pressures(Volumes):
        name = "pressure response"

    for volumes, asked in (
        (Volumes, ["volume balance", "looker"]),
        (Abstains, ["pressure response", "volume balance", "looker"]),
    ):
        known = {"looker": Looker, "pressure response": Pressures, "volume balance": volumes}
        monkeypatch.setattr(registry, "DETECTORS", known)
        fused = Examination(recording, false_alarm_probability=0.05).decide_by_all()
        assert [part.detector for part in fused.parts] == asked
        assert fused.detector == asked[0]


def count_threads(patch: pytest.MonkeyPatch, owner: object, *names: str) -> dict[str, set[int]]:
    """Return, filled in by the calls, the numbers of threads of linear algebra when functions of `owner` are called."""
    threads: dict[str, set[int]] = {}

    def counted(name: str, whole: Callable[..., object]) -> Callable[..., object]:
        def call(*inputs: object, **options: object) -> object:  # a function, which binds as a method where it is one
            threads[name] = {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}
            return whole(*inputs, **options)

        return call

    for name in names:
        patch.setattr(owner, name, counted(name, getattr(owner, name)))
    return threads


def test_no_part_of_a_diagnosis_spreads_small_matrices_over_threads(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = count_threads(monkeypatch, module, "inspect_recording", "decide")
    with threadpool_limits(limits=2):
        diagnose(recording)
    assert threads == {name: {1} for name in ("inspect_recording", "decide")}


@pytest.mark.slow
def test_no_part_of_a_summary_spreads_small_matrices_over_threads(
    healthy: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = count_threads(monkeypatch, machine, "inspect_recording", "stored_surprisals")
    levels = count_threads(monkeypatch, HealthyLevels, "learn")
    with threadpool_limits(limits=2):
        machine.summarise_healthy(healthy, load_rig("thesis"), "run.nc")
    assert threads | levels == {name: {1} for name in ("inspect_recording", "stored_surprisals", "learn")}
