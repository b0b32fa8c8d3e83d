"""The verdict from pressures and command: leaks, what else may step, a baseline, and what is not read."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

import sealscope as ss
from sealscope.diagnosis.inference.pressures.response_detector import PressureResponse
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.parameters import load_rig

from .judging import judge

DETECTOR = PressureResponse(load_rig("thesis"))


def examined(*baseline: ss.Recording, seed: int = 6, **values: object) -> Evidence:
    return judge(DETECTOR, recorded(seed=seed, **values), baseline)


@cache
def recorded(**values: object) -> ss.Recording:
    """Simulate a recording; equal ones are the same object, whose response is fitted once."""
    return ss.simulate(rig="thesis", command="3 sin(4t)", duration=80.0, **values).only(("u", "p_A", "p_B"))


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        pytest.param("friction +20 %", "friction change", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("air 1 %", "air in the oil", marks=pytest.mark.slow),
        ("sensor p_A offset 5 psi", "sensor fault"),
        pytest.param("sensor p_B gain 2 %", "sensor fault", marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_what_else_steps_is_named_and_is_no_leak(fault: str, cause: str) -> None:
    evidence = examined(fault=f"{fault} from 40 s")
    assert evidence.verdict != "leak"
    assert evidence.cause == cause


@pytest.mark.long
@pytest.mark.slow
def test_the_score_grows_with_the_leak_and_without_one_there_is_a_bound() -> None:
    healthy_run = examined()
    assert healthy_run.verdict == "no leak"
    leaks = [examined(leak=f"{lpm} L/min from 40 s") for lpm in (0.01, 0.1)]
    assert [leak.verdict for leak in leaks] == ["leak"] * 2
    scores = [healthy_run.score, *(leak.score for leak in leaks)]
    assert scores == sorted(scores)
    assert healthy_run.bound_lpm < 0.02


@pytest.mark.slow
def test_a_leak_from_the_first_sample_is_above_the_baseline_only() -> None:
    healthy = [recorded(seed=seed) for seed in (11, 12, 13)]
    assert examined(leak="0.05 L/min").verdict == "no leak"  # no change within the recording
    above = examined(*healthy, leak="0.05 L/min")
    assert (above.verdict, above.onset_s) == ("leak", None)
    low, high = above.leak_interval_lpm
    assert low <= 0.05 <= high
    assert examined(*healthy).verdict == "no leak"


def test_other_circuits_and_counts_are_refused_in_words() -> None:
    recording = recorded(seed=1)
    for rig in ("servo-valve", "single-rod-eha"):
        other = PressureResponse(load_rig(rig))
        assert "position" in other.usable(recording)
        assert other.reading(recording) is None
    assert "u" in DETECTOR.usable(recording.only(("p_A", "p_B")))
    for name in ("u", "p_A"):
        assert "counts" in DETECTOR.usable(replace(recording, units={**recording.units, name: "count"}))
