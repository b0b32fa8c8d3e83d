"""The pressure model under a force that swings: told apart from friction, followed, or said to be in the way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.pressure_model.detector import PressureModel
from sealscope.diagnosis.pressure_model.load import FED, SWINGS, carried_by_load, swing
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_with_truth

RATE, SECONDS = 500.0, 120.0
SEEN = ("u", "p_A", "p_B")
RIG = load_rig("thesis-closed-loop")


def strokes(stroke: float, force: float, size: float, slip: float = 0.0) -> tuple[np.ndarray, ...]:
    """Return command, friction and force over strokes of `stroke` [rad/s] under a force of `force` [rad/s]."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    u = np.cos(stroke * t)
    friction = 1e5 * np.tanh(20.0 * u) + 2e4 * u
    return u, friction, size * np.sin(force * t + 0.3) + slip


@settings(max_examples=40, deadline=None)
@given(st.floats(1.5, 4.0), st.floats(0.1, 0.55), st.floats(1e5, 2e6), st.floats(-1e6, 1e6))
def test_a_force_that_swings_is_told_from_friction(stroke: float, share: float, size: float, slip: float) -> None:
    """Whatever its size, rate and mean are; the duty's cycle need be known to half a per cent only."""
    u, friction, force = strokes(stroke, share * stroke, size, slip)
    dp = friction + force + 12e3 * np.random.default_rng(3).standard_normal(u.size)
    carried = carried_by_load(u, dp, RATE, 1.004 * 2.0 * np.pi / stroke)
    assert carried is not None
    inner = slice(int(4 * RATE), int(-4 * RATE))
    assert np.sqrt(np.mean((carried - force)[inner] ** 2)) < 0.015 * size + 4e3


@pytest.mark.parametrize("stroke", [1.5, 2.7, 4.0])
def test_without_a_force_and_under_a_steady_one_nothing_is_taken(stroke: float) -> None:
    u, friction, steady = strokes(stroke, 1.0, 0.0, 8e5)
    for dp in (friction, friction + steady):
        assert swing(dp, RATE, 2.0 * np.pi / stroke) < 0.5 * FED
        assert carried_by_load(u, dp, RATE, 2.0 * np.pi / stroke) is None
    assert carried_by_load(u, friction + strokes(stroke, 0.3, 1e6)[2], RATE, None) is None


@settings(max_examples=40, deadline=None)
@given(st.floats(1.5, 4.0), st.floats(0.02, 0.08), st.floats(6e4, 2e5))
def test_of_a_slow_force_nothing_of_the_strokes_is_taken_with_it(stroke: float, rate: float, size: float) -> None:
    """What friction does at single reversals shakes the ringing there: sound machines had a z of 3.6 to 6.7."""
    u, friction, force = strokes(stroke, rate, size)
    knocks = np.random.default_rng(5).standard_normal(200).repeat(int(0.1 * RATE))[: u.size]
    knocks = 2e4 * np.pad(knocks, (0, u.size - knocks.size)) * (np.abs(u) < 0.2)
    carried = carried_by_load(u, friction + force + knocks, RATE, 2.0 * np.pi / stroke)
    assert carried is not None
    assert np.std(np.diff(carried)) * RATE < 1.5 * rate * size


def recorded(command: str, load: str, leak: str = "") -> Recording:
    experiment = Experiment.of(
        rig=RIG, command=command, controller="pi", load=load, leak=leak or (), duration=SECONDS, seed=4
    )
    return simulate_with_truth(experiment).recording.only(SEEN)


def test_under_a_force_that_swings_a_leak_is_found_from_pressures() -> None:
    """8 % of dp were explained, and the record was not followed."""
    model = PressureModel(RIG)
    sound = model.examine(recorded("position 25 mm sin(2.5t)", "500 N sin(0.9t)"), [], 0.01)
    assert sound.verdict == "no leak", sound.reason
    found = model.examine(recorded("position 25 mm sin(2.5t)", "500 N sin(0.9t)", "0.0042 L/min from 60 s"), [], 0.01)
    assert (found.verdict, found.cause) == ("leak", "piston or pump leak")
    assert found.leak_interval_lpm is not None
    assert found.leak_interval_lpm[0] < 0.0042 < found.leak_interval_lpm[1]


@pytest.mark.parametrize(
    ("command", "load", "leak", "verdict"),
    [
        ("7 sin(4t)", "12 N sin(0.15t)", "", "no leak"),
        ("7 sin(4t)", "12 N sin(0.15t)", "0.0042 L/min from 60 s", "leak"),
        pytest.param("5 sin(2t)", "6 N sin(0.2t)", "0.0042 L/min from 60 s", "leak", marks=pytest.mark.slow),
        pytest.param("7 sin(4t)", "12 N sin(0.15t)", "0.05 L/min from 60 s", "leak", marks=pytest.mark.slow),
    ],
)
def test_a_weak_force_in_an_open_loop_is_followed_and_a_leak_under_it_sized(
    command: str, load: str, leak: str, verdict: str
) -> None:
    """A force of a fifth of the friction made its parameters wander 1.8 to 8 times: `cannot tell`, with a leak or not.

    With the force alone 0.05 L/min comes out as 0.028 (0.017 to 0.043); without it, it holds.
    """
    experiment = Experiment.of(rig="thesis", command=command, load=load, leak=leak or (), duration=SECONDS, seed=5)
    simulated = simulate_with_truth(experiment)
    record = simulated.recording.only(SEEN)
    cycle = 2.0 * np.pi / float(command.split("(")[1][:-2])
    assert FED < swing(record["p_A"] - record["p_B"], RATE, cycle) < SWINGS
    judged = PressureModel(load_rig("thesis")).examine(record, [], 0.01)
    assert judged.verdict == verdict, judged.reason
    if leak:
        assert judged.leak_interval_lpm is not None
        assert judged.leak_interval_lpm[0] < simulated.truth.mean_leak_lpm < judged.leak_interval_lpm[1]


def test_in_an_open_loop_a_leak_under_a_force_that_swings_is_not_sized() -> None:
    """Leaks of 0.05 L/min were stated as 0.006 to 0.02, none of eight intervals held."""
    experiment = Experiment.of(
        rig=RIG, command="6 sin(2.5t)", load="900 N sin(0.7t)", leak="0.05 L/min from 60 s", duration=SECONDS, seed=4
    )
    found = PressureModel(RIG).examine(simulate_with_truth(experiment).recording.only(SEEN), [], 0.01)
    assert (found.verdict, found.leak_lpm, found.leak_interval_lpm) == ("leak", None, None)
    assert "no controller works against it" in found.reason
    assert "leak_lpm" in found.refuses


@pytest.mark.parametrize(
    "command, why",
    [
        ("6 sin(2.5t)", "would not show"),
        # the force is 98 % of p_A - p_B: of the ringing too little is left to count its periods
        ("3 sin(4t)", "the fit has a ring too many in each reversal"),
    ],
)
def test_in_an_open_loop_under_a_force_that_swings_no_machine_is_called_sound_where_a_leak_would_not_show(
    command: str, why: str
) -> None:
    """What leaks moves the strokes: leaks of 0.05 L/min were `no leak` in 7 of 32 records of `bench-load`."""
    experiment = Experiment.of(rig=RIG, command=command, load="1.2 kN sin(0.5t)", duration=SECONDS, seed=4)
    evidence = PressureModel(RIG).examine(simulate_with_truth(experiment).recording.only(SEEN), [], 0.01)
    assert evidence.verdict == "cannot tell"
    assert why in evidence.reason
    if why == "would not show":
        assert evidence.passage is not None and evidence.passage.findable_share > 0.02
        assert evidence.passage.findable_lpm is None


def test_a_large_force_is_followed() -> None:
    """Friction was fitted beside a force that leaked into its harmonics, and the record was not followed."""
    judged = PressureModel(RIG).examine(recorded("position 40 mm sin(1.57t)", "1 kN sin(0.3t)"), [], 0.01)
    assert judged.verdict == "no leak", judged.reason


@pytest.mark.slow
def test_a_force_too_quick_to_follow_is_named_and_no_smaller_method_calls_the_machine_sound() -> None:
    judged = diagnose(recorded("position 40 mm sin(1.57t)", "1 kN sin(1.1t)"), rig=RIG)
    assert judged.verdict == "cannot tell"
    assert "a force swings: the mean of p_A - p_B over a cycle deviates by 36% of it" in judged.reason


def test_cycles_of_five_seconds_are_whole_blocks_each() -> None:
    """In pairs they were 11 blocks of 10.9 s, one too few."""
    followed = PressureModel(RIG).follow(recorded("position 45 mm sin(1.15t)", "0 N"))
    assert not isinstance(followed, str), followed
    assert np.median(np.diff(followed.edges)) / 500.0 == pytest.approx(2.0 * np.pi / 1.15, rel=0.01)
    assert followed.blocks >= 20
