"""Slow wear within a recording: found where it is more than warm oil explains, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.parameters import load_rig

from .balance_machine import Profile, machine

P = 0.01
PUMP = 2.4e-13


def ramp(end: float, start_s: float, stop_s: float) -> Profile:
    return lambda t: end * np.clip((t - start_s) / (stop_s - start_s), 0.0, 1.0)


@pytest.mark.parametrize("start_s, stop_s", [(0.0, 120.0), (40.0, 120.0), (40.0, 90.0)])
def test_slow_wear_is_found_and_sized(start_s: float, stop_s: float) -> None:
    """It was `cannot tell`, whatever its size."""
    worn = machine(1, G=ramp(3.0e-12, start_s, stop_s))
    evidence = VolumeBalance(load_rig("thesis")).examine(worn, [], P)
    assert evidence.verdict == "leak"
    assert evidence.alarmed
    assert evidence.onset_s == pytest.approx(start_s, abs=6.0)
    opened = worn.t >= max(start_s, 0.1)
    dp = np.abs(worn["p_A"] - worn["p_B"])
    lost = float(np.mean((ramp(3.0e-12, start_s, stop_s)(worn.t) * dp)[opened])) * 6.0e4
    assert evidence.leak_lpm == pytest.approx(lost, rel=0.08)


@pytest.mark.parametrize("factor", [1.3, 2.0, 3.5])
def test_a_pump_that_warms_up_is_no_wear(factor: float) -> None:
    for seed in (1, 2, 3):
        warm = machine(seed, G_pump=lambda t: PUMP * factor ** (t / 120.0))
        assert VolumeBalance(load_rig("thesis")).examine(warm, [], P).verdict != "leak"


def test_a_step_within_a_growth_does_not_take_its_place() -> None:
    """A bend of the growth was an alarm of its own, with a hundredth of the flow."""
    worn = machine(2, G_pump=0.0, G=ramp(3.0e-12, 40.0, 120.0))
    evidence = VolumeBalance(load_rig("thesis")).examine(worn, [], P)
    assert evidence.verdict == "leak"
    assert evidence.leak_lpm is not None
    assert evidence.leak_lpm > 0.008
