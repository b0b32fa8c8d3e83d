"""The volume balance against leak-free recordings of the same machine, and over a long recording."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.balance_detector import VolumeBalance
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from .balance_machine import machine, step

P = 0.01
LPM = 6.0e4


@pytest.fixture(scope="module")
def detector() -> VolumeBalance:
    return VolumeBalance(load_rig("thesis"))


def flow_of(recording: Recording, G: float, start: float = 60.0) -> float:
    after = recording.t >= start
    return G * float(np.mean(np.abs(recording["p_A"] - recording["p_B"])[after])) * LPM


class TestBaseline:
    """Against leak-free recordings of the same machine."""

    @staticmethod
    def record(seed: int, extra: float = 0.0) -> Recording:
        level = 2.4e-13 + 5e-15 * np.random.default_rng(seed).standard_normal()
        return machine(100 + seed, G_pump=level, G=extra)

    def examine(self, detector: VolumeBalance, recording: Recording, count: int) -> Evidence:
        return detector.examine(recording, [self.record(seed) for seed in range(count)], P)

    @pytest.mark.parametrize("count", [1, 4])
    def test_a_leak_from_the_start_is_found(self, detector: VolumeBalance, count: int) -> None:
        leaky = self.record(20, extra=4.0e-13)
        found = self.examine(detector, leaky, count)
        assert found.verdict == "leak"
        assert found.onset_s is None
        assert found.leak_interval_lpm is not None
        assert found.leak_interval_lpm[0] <= flow_of(leaky, 4.0e-13, 0.0) <= found.leak_interval_lpm[1]
        assert [one.detector for one in found.parts] == ["step of the conductance", "conductance against the baseline"]

    def test_a_sound_one_is_sound(self, detector: VolumeBalance) -> None:
        assert all(self.examine(detector, self.record(seed), 3).verdict == "no leak" for seed in range(30, 36))

    def test_another_machine_is_not_compared(self, detector: VolumeBalance) -> None:
        found = detector.examine(self.record(40), [machine(1, ratio=1.1)], P)
        assert "no baseline recording can be compared" in found.reason


def test_a_long_recording_is_searched_in_parts(detector: VolumeBalance) -> None:
    hour = machine(9, G=step(0.0, 5.0e-14, at=1000.0), duration=1500.0, rate=50.0)
    found = detector.examine(hour, [], P)
    assert found.verdict == "leak"
    assert found.onset_s == pytest.approx(1000.0, abs=15.0)
    assert found.course is not None
    assert found.course.t.size > 400
