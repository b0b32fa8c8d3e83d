"""The reduced cylinder behind a servo valve against the whole rig, and leaks found there from pressures and command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.isolation import other_cause, signatures
from sealscope.diagnosis.pressure_model.behind_valve import stalled
from sealscope.diagnosis.pressure_model.detector import PressureModel
from sealscope.diagnosis.pressure_model.model import (
    F_C,
    F_CFR,
    OFFSET,
    STROKE,
    DrivenModel,
    G,
    assumed_numbers,
    nominal,
)
from sealscope.diagnosis.volume_balance import behind_valve as balance
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import oversampling, trajectory
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.simulation.sizing import sized_leaks

RIG = load_rig("servo-valve")
RATE = 500.0


@pytest.mark.parametrize("command", ["5 sin(2t)", "7 sin(4t)"])
def test_the_reduced_cylinder_shows_what_the_whole_rig_shows(command: str) -> None:
    """p_A - p_B under a leak within 400 Pa rms of the whole simulation, the supply taken from p_A + p_B; without the
    leak in the model it is farther off (the transducers' noise has 12 kPa)."""
    experiment = Experiment.of(rig=RIG, command=command, leak="0.05 L/min", duration=20.0, rate=RATE)
    (leak,) = sized_leaks(experiment)
    path = trajectory(experiment, (leak,))
    u = experiment.command.volts(experiment.sample_times())
    at = slice(0, u.size * oversampling(experiment), oversampling(experiment))
    p_A, p_B, x, p_1, p_2 = (path[name][at] for name in ("p_A", "p_B", "x", "p_1", "p_2"))
    theta = nominal(RIG)
    theta[STROKE], theta[G] = 1.0, leak.coefficient
    theta[F_C] += theta[F_CFR] * (float(np.mean(p_A + p_B)) - 2.0 * RIG.fluid.p_charge)
    model = DrivenModel.of(u, RATE, assumed_numbers(RIG), p_A + p_B).with_travel(theta)
    travel = model.travel[: -1 : 2 * model.every]
    place = model.numbers.A_A * x / model.numbers.V
    theta[OFFSET] = float(np.mean(place - travel))
    assert np.std(place - travel) < 0.01 * np.std(place)
    settled = slice(1000, -200)
    assert np.mean(np.abs(model.supply - (p_1 - p_2))[settled]) < 0.01 * RIG.supply.p_set
    sets = np.array([theta, theta * (np.arange(theta.size) != G)])
    misfits = np.std((model.run(sets) - (p_A - p_B))[:, settled], axis=1)
    assert misfits[0] < 400.0
    assert misfits[1] > 2.0 * misfits[0]


def test_a_piston_at_its_end_is_seen_in_the_pressures() -> None:
    supply, dp = np.full(2000, 7e6), 1.5e5 * np.sign(np.sin(np.arange(2000) / 50.0))
    assert stalled(dp, supply, RATE) is None
    dp[1200:1205] = 6e6  # a spike of 10 ms
    assert stalled(dp, supply, RATE) is None
    dp[1500:1520] = -6e6
    assert stalled(dp, supply, RATE) == 1500


def recorded(duration: float, command: str = "5 sin(2t)", leak: str | None = None) -> Recording:
    leaks = {} if leak is None else {"leak": leak}
    return simulate_with_truth(
        Experiment.of(rig=RIG, command=command, duration=duration, rate=RATE, seed=11, **leaks)
    ).recording.only(("u", "p_A", "p_B"))


def test_a_record_with_the_piston_at_its_end_is_not_judged() -> None:
    """Nor by the change of RMS, which sees no change and would not see a leak either."""
    diagnosis = diagnose(recorded(60.0, "9 sin(t)"), rig=RIG)
    assert diagnosis.verdict == "cannot tell"
    parts = {part.detector: part for part in diagnosis.parts}
    assert "takes nearly all of the supply's pressure at " in parts["pressure model"].reason
    assert "the piston is at an end of its stroke" in parts["pressure model"].reason
    assert "tells no leak from a sound machine" in parts["rms change"].reason


@pytest.mark.parametrize("leak", [None, "0.05 L/min from 30 s"])
def test_under_a_load_pressures_alone_judge_no_valve(leak: str | None) -> None:
    """A third of the sound machines under 2 kN were called leaks, by the model or by the change of RMS."""
    leaks = {} if leak is None else {"leak": leak}
    experiment = Experiment.of(
        rig=RIG, command="position 40 mm sin(1.57t)", controller="pi", load="2 kN", duration=60.0, seed=3, **leaks
    )
    diagnosis = diagnose(simulate_with_truth(experiment).recording.only(("u", "p_A", "p_B")), rig=RIG)
    assert diagnosis.verdict == "cannot tell"
    reasons = {part.detector: part.reason for part in diagnosis.parts}
    assert reasons["pressure model"].startswith("a load stands on the piston: the mean of p_A - p_B is ")
    assert reasons["rms change"].endswith("that tells no leak from a sound machine")


def test_a_supply_that_drifts_is_no_other_cause() -> None:
    """Both chambers' means fall with the supply, by a fifth of the strokes' pressure difference: behind a pump oil is
    lost, behind a valve it is the hundredth part of the supply."""
    record = recorded(60.0)
    falls = np.where(record.t > 30.0, -6e4, 0.0)
    channels = {**record.channels, **{name: record[name] + falls for name in ("p_A", "p_B")}}
    other = replace(record, channels=channels)
    behind_pump = other_cause(signatures(other), 30.0)
    assert behind_pump is not None
    assert behind_pump.cause == "external leak"
    assert other_cause(signatures(other, behind_valve=True), 30.0) is None


#: A machine of another rated flow, with edges ground unevenly and a spool that is slower than the rig says.
OTHER = {"Q_N": "10.6 L/min", "o_PA": "4 um", "o_BT": "-3 um", "o_AT": "2 um", "omega_s": 880.0}


def balanced(duration: float = 60.0, **options: str) -> Recording:
    return simulate_with_truth(
        Experiment.of(rig=RIG, command="5 sin(2t)", duration=duration, rate=RATE, seed=5, set=OTHER, **options)
    ).recording


def test_the_balance_behind_a_valve_finds_leaks_from_position_and_supply() -> None:
    """On a machine whose valve differs from the rig's: its edges are found beside the leak, in the same fit."""
    sound, leaking = balanced(), balanced(leak="0.02 L/min from 30 s")
    healthy = diagnose(sound, rig=RIG, quick=True)
    assert (healthy.verdict, healthy.methods[0].detector) == ("no leak", "volume balance")
    found = diagnose(leaking, rig=RIG, quick=True)
    assert (found.verdict, found.cause, found.methods[0].detector) == ("leak", "piston leak", "volume balance")
    assert found.onset_s == pytest.approx(30.0, abs=3.2)  # a window of one cycle
    low, high = found.leak_interval_lpm
    assert 0.015 < low < 0.02 < high < 0.025
    stopped = dict(sound.channels)
    stopped["p_A"] = np.where(np.abs(sound.t - 24.05) < 0.04, stopped["p_1"], stopped["p_A"])
    stopped["p_B"] = np.where(np.abs(sound.t - 24.05) < 0.04, stopped["p_2"], stopped["p_B"])
    evidence = balance.examined(replace(sound, channels=stopped), RIG, 0.01)
    assert evidence.verdict == "no leak"
    assert "the piston is at an end of its stroke, or a load holds it, at 24.0 s" in evidence.reason
    few = sound.only([name for name in sound.channels if name != "p_1"])
    assert "p_1" in diagnose(few, rig=RIG).methods[0].reason


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param("rod seal A 0.003 L/min from 30 s", marks=pytest.mark.slow),  # compiles a solver of its own
        "sensor p_A offset 2 psi from 30 s",
    ],
)
def test_what_else_changes_is_no_leak_to_the_balance_behind_a_valve(fault: str) -> None:
    """Oil that leaves one chamber alone, and the zero of a transducer, which makes the edges' gains step."""
    assert balance.examined(balanced(fault=fault), RIG, 0.01).verdict != "leak"



@pytest.mark.slow
def test_leaks_behind_a_valve_are_found_dated_and_sized() -> None:
    """The rig itself, from pressures and command: its own friction and edges, nothing drifts."""
    model = PressureModel(RIG)
    assert model.examine(recorded(120.0), (), 0.01).verdict == "no leak"
    for lpm in (0.0042, 0.05):
        evidence = model.examine(recorded(120.0, leak=f"{lpm} L/min from 60 s"), (), 0.01)
        assert evidence.verdict == "leak"
        assert evidence.onset_s == pytest.approx(60.0, abs=7.0)
        assert evidence.leak_interval_lpm is not None
        low, high = evidence.leak_interval_lpm
        assert low < lpm < high
        assert high - low < 0.016 + 0.8 * lpm  # what edges and spool give way, and the scale of flows
