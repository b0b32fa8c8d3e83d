"""The volume balance under a load that stands: whole cycles however long, blocks between, what rings on the oil."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.volume_balance.blocks import STORED_A
from sealscope.diagnosis.volume_balance.detector import VolumeBalance
from sealscope.diagnosis.volume_balance.fit import BalanceFit
from sealscope.diagnosis.stream import SequentialBalance
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.changes import ParameterDrift, Wander

#: A pump's own leakage that drifts by some 8 % while a leak of 0.0005 L/min opens.
WANDERS = (ParameterDrift("pump.G_pump", Wander((0.02, 0.02, -0.02, 0.006, 0.006, -0.003), 120.0)),)
RESTING = "position trapezoid 45 mm within 1.6 s every 8 s"
PULLING = "position trapezoid 60 mm within 1 s every 7 s"


@cache
def recorded(rig: str, leak: str | None = None) -> Recording:
    """A weight that is moved and held, or a rod that is pulled; cycles of 8 and 7 s."""
    duty, load = (PULLING, "-4 kN") if rig == "single-rod-eha" else (RESTING, "1.4 kN")
    own = {} if rig == "single-rod-eha" else {"pump.G_pump": 2.4e-13}  # of the thesis's pump, which has none there
    return ss.simulate(rig=rig, command=duty, load=load, leak=leak, set=own, duration="120 s", drifts=WANDERS, seed=3)


def fitted(rig: str) -> BalanceFit:
    fit, reason = VolumeBalance(load_rig(rig)).fit(recorded(rig))
    assert fit is not None, reason
    return fit


@pytest.mark.parametrize(("rig", "cycle"), [("thesis-closed-loop", 8.0), ("single-rod-eha", 7.0)])
def test_blocks_are_whole_cycles_and_those_between_tell_the_same(rig: str, cycle: float) -> None:
    fit = fitted(rig)
    assert fit.keeps_slopes and fit.blocks.seconds == pytest.approx(cycle, rel=1e-3)
    assert fit.between is not None
    assert np.allclose(np.diff(fit.between.t), fit.blocks.seconds)
    assert fit.between.t[0] == pytest.approx(fit.blocks.t[0] + 0.5 * fit.blocks.seconds, abs=0.01)
    np.testing.assert_allclose(np.interp(fit.blocks.t[2:-1], fit.between.t, fit.between.g), fit.g[2:-1], rtol=0.02)


def test_oil_is_stored_as_the_rig_says_though_the_piston_rings() -> None:
    fit, rig = fitted("thesis-closed-loop"), load_rig("thesis-closed-loop")
    stored = (rig.cylinder.V + rig.line.V_1) / rig.fluid.K_oil
    assert fit.beta[fit.columns.index(STORED_A)] == pytest.approx(-stored, rel=0.2)
    assert abs(fit.lag) < 1e-3


@pytest.mark.parametrize(("rig", "leak"), [("thesis-closed-loop", 0.0005), ("single-rod-eha", 0.002)])
def test_a_leak_far_below_the_drift_of_the_pump_is_found(rig: str, leak: float) -> None:
    balance = VolumeBalance(load_rig(rig))
    sound = balance.examine(recorded(rig), (), 0.01)
    assert sound.verdict == "no leak"
    worn = balance.examine(recorded(rig, f"{leak} L/min from 60 s"), (), 0.01)
    assert worn.verdict == "leak" and worn.leak_interval_lpm is not None
    assert worn.leak_interval_lpm[0] < leak < worn.leak_interval_lpm[1]
    assert worn.onset_s == pytest.approx(60.0, abs=2.0)


@pytest.mark.parametrize(("rig", "leak"), [("thesis-closed-loop", 0.002), ("single-rod-eha", 0.01)])
def test_a_stream_finds_it_as_well(rig: str, leak: float) -> None:
    stream = SequentialBalance(rig, alarms_per_hour=0.3)
    worn = recorded(rig, f"{leak} L/min from 60 s")
    for start in range(0, 120, 5):
        state = stream.update(worn.between(start, start + 5))
    assert state.alarm is not None and state.alarm.onset_s == pytest.approx(60.0, abs=9.0)
