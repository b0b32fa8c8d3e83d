"""What no balance shows: each pattern by closed forms, each fault of the simulator by the event that is named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.decision.case import Case, HealthyNull, OtherEvent
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inference.changes.features import observe_signals
from sealscope.diagnosis.inference.changes.level_changes import estimate_levels, level_tests
from sealscope.recordings.recording import Recording
from sealscope.simulation.simulate import simulate

from ..representatives import few

RATE, SECONDS = 200.0, 120.0
CHANCE = 0.01
T = np.arange(round(RATE * SECONDS)) / RATE
LATE = T >= 60.0


def machine(**changed: np.ndarray) -> Recording:
    """A piston that moves to and fro: p_A is 5 bar +- 1 bar, p_B 5 bar -+ 1 bar, 1 kPa of noise, a slow drift."""
    noise = np.random.default_rng(3).standard_normal((2, T.size)) * 1e3
    way, drift = np.sign(np.cos(4.0 * T)), 20.0 * T
    channels = {
        "u": 3.0 * np.cos(4.0 * T),
        "x": 0.01 * np.sin(4.0 * T),
        "p_A": 5e5 + 1e5 * way + drift + noise[0],
        "p_B": 5e5 - 1e5 * way + drift + noise[1],
    }
    channels |= {name: channels[name] + step for name, step in changed.items()}
    return Recording(T, channels, {"u": "V", "x": "m", "p_A": "Pa", "p_B": "Pa"}, RATE)


def other_event(recording: Recording) -> OtherEvent | None:
    """Return the event that the signals alone name, as beside a detector that sees nothing."""
    report = observe_signals(recording)
    return Case(report, report.observables, HealthyNull(), CHANCE).other_event


def onset_of(event: OtherEvent) -> float:
    assert event.observable.onset is not None
    return event.observable.onset.value


def test_the_levels_of_both_directions() -> None:
    made = estimate_levels(machine())
    assert made is not None
    assert made[1].mean(axis=0) == pytest.approx([5.012e5, 5.012e5, 1e5, -1e5], rel=0.02)


WAY = np.sign(np.cos(4.0 * T))
STEPS: dict[str, tuple[dict[str, np.ndarray], str | None]] = {
    "nothing": ({}, None),
    "friction": ({"p_A": 5e3 * WAY * LATE, "p_B": -5e3 * WAY * LATE}, "friction change"),
    "zero of p_A": ({"p_A": 5.5e3 * LATE}, "sensor fault"),
    "scale of p_B": ({"p_B": 0.03 * (5e5 - 1e5 * WAY) * LATE}, "sensor fault"),
    "load": ({"p_A": 6e3 * LATE, "p_B": -6e3 * LATE}, "changed duty"),
    "oil is lost": ({"p_A": -6e3 * LATE, "p_B": -6e3 * LATE}, "external leak"),
    "charge rises": ({"p_A": 6e3 * LATE, "p_B": 6e3 * LATE}, None),
    "duty": ({"u": 0.3 * np.cos(4.0 * T) * LATE, "x": 1e-3 * np.sin(4.0 * T) * LATE}, "changed duty"),
    "command alone": ({"u": 0.3 * np.cos(4.0 * T) * LATE}, None),
    "hum": ({"p_A": 1e3 * np.sin(2.0 * np.pi * 50.0 * T) * LATE}, "sensor fault"),
}


@pytest.mark.parametrize("kind", STEPS)
def test_each_step_has_its_cause_and_its_time(kind: str) -> None:
    changed, cause = STEPS[kind]
    event = other_event(machine(**changed))
    assert (None if event is None else event.cause) == cause
    assert event is None or abs(onset_of(event) - 60.0) < 6.0


def resting(recording: Recording, seconds: float, noise: float) -> Recording:
    """Hold the piston for the last `seconds`, the drive off: no command, no ripple, p_A - p_B of a load."""
    rest = recording.t > recording.t[-1] - seconds
    noise_A, noise_B = np.random.default_rng(7).standard_normal((2, T.size)) * noise
    held = {"u": 0.0 * T, "x": 0.01 + 0.0 * T, "p_A": 6e5 + noise_A, "p_B": 4e5 + noise_B}
    channels = {name: np.where(rest, held[name], values) for name, values in recording.channels.items()}
    return replace(recording, channels=channels)


@pytest.mark.parametrize("seconds", [10.0, 60.0])
def test_a_rest_changes_neither_duty_nor_noise_nor_sense(seconds: float) -> None:
    """A drive that is off is another regime: quieter, without a size of the duty, friction or its sign."""
    at_rest = resting(machine(), seconds, 200.0)
    assert {observable.data for observable in observe_signals(at_rest).observables} >= {"noise", "hum"}
    assert other_event(at_rest) is None


def test_noise_that_changes_while_the_piston_moves_is_named_beside_a_rest() -> None:
    recording = machine()
    late = (T >= 40.0) * 3e3 * np.random.default_rng(5).standard_normal(T.size)
    noisier = replace(recording, channels={**recording.channels, "p_A": recording["p_A"] + late})
    event = other_event(resting(noisier, 30.0, 200.0))
    assert event is not None
    assert (event.cause, round(onset_of(event) / 10.0)) == ("sensor fault", 4)


def test_missing_positions_hide_nothing() -> None:
    changed, cause = STEPS["friction"]
    whole = machine(**changed)
    x = whole["x"].copy()
    x[1000], x[9000:9100] = np.nan, np.nan
    event = other_event(replace(whole, channels={**whole.channels, "x": x}))
    assert event is not None and event.cause == cause


def test_units_and_sides_do_not_matter() -> None:
    recording = machine(p_A=5e3 * WAY * LATE, p_B=-5e3 * WAY * LATE)
    scores = [test.score for test in level_tests(recording)]
    counts = replace(
        recording, channels={n: v * (1e-3 if n.startswith("p_") else 1.0) for n, v in recording.channels.items()}
    )
    swapped = replace(recording, channels={**recording.channels, "p_A": recording["p_B"], "p_B": recording["p_A"]})
    for other in (counts, swapped):
        assert sorted(test.score for test in level_tests(other)) == pytest.approx(sorted(scores), rel=0.05)


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "filter": lambda p: np.convolve(np.pad(p, 1, mode="edge"), [0.25, 0.5, 0.25], "valid"),
    "noise": lambda p: p + 3e3 * np.random.default_rng(5).standard_normal(p.size),
}


@pytest.mark.parametrize("kind", CHANGES)
@pytest.mark.parametrize("names", [("p_A",), ("p_A", "p_B")])
def test_another_reading_is_a_sensor_fault(kind: str, names: tuple[str, ...]) -> None:
    recording = machine()
    changed = {name: np.where(LATE, CHANGES[kind](recording[name]), recording[name]) for name in names}
    event = other_event(replace(recording, channels={**recording.channels, **changed}))
    assert event is not None
    assert event.cause == "sensor fault"


def test_swapped_sensors_are_a_sensor_fault() -> None:
    recording = machine()
    p_A, p_B = recording["p_A"], recording["p_B"]
    changed = {"p_A": np.where(LATE, p_B, p_A), "p_B": np.where(LATE, p_A, p_B)}
    event = other_event(replace(recording, channels={**recording.channels, **changed}))
    assert event is not None
    assert (event.cause, round(onset_of(event) / 10.0)) == ("sensor fault", 6)


@pytest.mark.parametrize(
    ("fault", "cause"),
    few(
        [
            ("friction +20 % from 60 s", "friction change"),
            ("sensor p_A offset 5 psi from 60 s", "sensor fault"),
            ("sensor p_A gain 2 % from 60 s", "sensor fault"),
            ("duty amplitude x1.1 from 60 s", "changed duty"),
        ],
        1,
    ),
)
def test_faults_of_the_simulated_rig(fault: str, cause: str) -> None:
    event = other_event(simulate(command="3 sin(4t)", fault=fault, duration="120 s", seed=1))
    assert event is not None
    assert (event.cause, round(onset_of(event) / 10.0)) == (cause, 6)


@pytest.mark.parametrize(
    "leak",
    few(["0.02 L/min from 60 s", "0.0042 L/min from 60 s", "none"], 1),
)
def test_a_leak_moves_none_of_them(leak: str) -> None:
    recording = simulate(command="3 sin(4t)", leak=leak, duration="120 s", seed=1)
    assert other_event(recording) is None


@pytest.mark.parametrize("leak", few(["0.02 L/min from 60 s", "0.2 L/min from 60 s"], 1))
def test_a_motion_without_a_command_that_falls_is_no_changed_duty(leak: str) -> None:
    """A leak of 3 % was a changed duty, 100 % sure; a motion that rises is none of a leak."""
    recording = simulate(command="3 sin(4t)", leak=leak, duration="120 s", seed=1).only(("p_A", "p_B", "x"))
    names = {observable.name: observable.chance for observable in observe_signals(recording).observables}
    assert names["fall of the motion"] < CHANCE
    assert diagnose(recording).cause is None
    larger = machine(x=1e-3 * np.sin(4.0 * T) * LATE).only(("p_A", "p_B", "x"))
    event = other_event(larger)
    assert event is not None and event.cause == "changed duty"


@pytest.mark.parametrize(
    "leak",
    [
        pytest.param("0.1 L/min from 60 s", marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("0.5 L/min from 60 s", marks=pytest.mark.slow),
    ],
)
def test_a_large_leak_slows_the_piston_and_is_a_leak(leak: str) -> None:
    recording = simulate(command="3 sin(4t)", leak=leak, duration="120 s", seed=1)
    assert min(observable.chance for observable in observe_signals(recording).observables) < CHANCE
    assert diagnose(recording).verdict == "leak"
