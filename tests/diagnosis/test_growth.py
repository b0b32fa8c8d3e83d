"""Slow wear within a recording: found where it is more than warm oil explains, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.verdict.fusion import fuse
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.growth import viscous_loss
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate

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


@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("lost", [0.0, 150.0, -80.0])
def test_lost_viscous_friction_beside_all_else_that_moves_the_pressures(lost: float, sense: float) -> None:
    """F = F_C sign(v) + F_v(t) v + M dv/dt + k x + noise, F_v falling evenly; either sense of the signals."""
    rate, t = 500.0, np.arange(90_000) / 500.0
    v = 0.2 * np.sin(2.0 * t) + 0.05 * np.sin(6.0 * t)
    force = 40.0 * np.sign(v) + (300.0 - lost * t / t[-1]) * v + 12.0 * np.gradient(v) * rate
    force += 200.0 * np.cumsum(v) / rate + np.random.default_rng(1).normal(0.0, 5.0, t.size)
    measured = viscous_loss(sense * force, v, rate, round(2.0 * np.pi * rate))
    assert measured is not None
    loss, deviation = measured
    # the means of the first and the last eighth are seven eighths of the record apart
    assert loss == pytest.approx(lost * 7.0 / 8.0, abs=4.0 * deviation + 0.03 * abs(lost))
    assert deviation < 10.0
    assert viscous_loss(force[:20_000], v[:20_000], rate, round(2.0 * np.pi * rate)) is None


def drifting(**what: str) -> Recording:
    cold = {"fluid.T_oil": "293.15 K", "makeup.check_valves": "present", "pump.G_pump": "2e-13"}
    return simulate(command="5 sin(2t)", duration=150.0, set=cold, seed=4, **what)


def test_oil_that_warms_is_no_leak_where_friction_shows_it_and_a_leak_that_grows_is_not_overruled() -> None:
    """Both make the conductance some three times what it was. All channels, rig given, drift not."""
    warm = drifting(fault="oil +25 K growing from 0 s to 150 s")
    found = diagnose(warm, rig="thesis", quick=True)
    assert (found.verdict, found.detector) == ("no leak", "volume balance")
    assert "as the oil becomes thinner" in found.reason

    grown = drifting(leak="0.004 L/min growing from 0 s to 150 s")
    balance = VolumeBalance(load_rig("thesis")).examine(grown, [], P)
    assert balance.verdict == "cannot tell"
    assert "friction shows that the oil keeps its viscosity" in balance.reason
    assert diagnose(grown, rig="thesis", quick=True).verdict != "no leak"

    # of a machine whose friction nobody states it shows nothing
    unknown = load_rig("thesis").as_assumed("nobody stated the rig")
    assert VolumeBalance(unknown).examine(warm, [], P).verdict == "cannot tell"


def test_a_growth_without_a_name_doubts_a_less_specific_no_leak_only() -> None:
    part = Evidence("cannot tell", "", 9.0, 6.0, detector="growth of the conductance")
    balance = Evidence("cannot tell", "it grows", 1.0, 6.0, detector="volume balance", parts=(part,))
    model = Evidence("no leak", "no rise", 1.0, 3.0, detector="pressure model")
    assert fuse([balance, model]).verdict == "cannot tell"
    assert fuse([replace(balance, parts=()), model]).verdict == "no leak"
    assert fuse([replace(balance, detector="cycle balance"), model]).verdict == "no leak"
