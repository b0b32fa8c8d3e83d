"""Drift of the charge pressure: oil that leaves a circuit, beside sensors whose offset drifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.decision.explanations import load_events
from sealscope.diagnosis.inference.changes.charge_pressure import (
    FALL,
    ChargeTrend,
    compare_low_drifts,
    estimate_charge_trend,
    estimate_low_drifts,
)
from sealscope.recordings.recording import Recording

RATE, SECONDS = 100.0, 100.0
T = np.arange(round(RATE * SECONDS)) / RATE


def record(
    *, fall: float = 0.0, zero_A: float = 0.0, zero_B: float = 0.0, held: float = 0.0, load: float = 30e5, seed: int = 0
) -> Recording:
    """Record a single rod whose accumulator feeds the unloaded chamber.

    `fall` of the charge pressure and drifts of the sensors' zeros [Pa/s]; `load` [Pa] at one end of the stroke and
    minus that at the other; `held`: pressure by which a shut-off chamber B lies above the charge pressure [Pa].
    """
    rng = np.random.default_rng(seed)
    x = 0.1 * np.sin(2.0 * np.pi * 0.2 * T)
    speed = np.cos(2.0 * np.pi * 0.2 * T)
    charge = 8e5 - fall * T - 4e5 * x  # the rod's volume comes from the accumulator
    force = load * np.sin(2.0 * np.pi * 0.2 * T + rng.uniform(0.0, 1.0))
    p_A = charge + np.maximum(force, 0.0) - 3e4 * np.minimum(speed, 0.0)
    p_B = (
        charge + np.maximum(-force, 0.0) + 3e4 * np.maximum(speed, 0.0) + held * (np.sin(2.0 * np.pi * 0.05 * T) > 0.0)
    )
    noise = 5e3 * rng.standard_normal((2, len(T)))
    return Recording(
        T,
        {"p_A": p_A + zero_A * T + noise[0], "p_B": p_B + zero_B * T + noise[1], "x": x, "omega": 100.0 * speed},
        {"p_A": "Pa", "p_B": "Pa", "x": "m", "omega": "rad/s"},
        RATE,
    )


HEALTHY = [estimate_low_drifts(record(seed=seed)) for seed in range(1, 7)]


def rarest(recording: Recording) -> str:
    changes = list(compare_low_drifts(estimate_low_drifts(recording), HEALTHY))
    return min(changes, key=lambda change: change.chance).name


@pytest.mark.parametrize("fall", [0.0, 200.0, 1000.0])
@pytest.mark.parametrize("held", [0.0, 2e5])
def test_the_fall_is_that_of_the_accumulator_whatever_shut_valves_hold(fall: float, held: float) -> None:
    estimated = estimate_low_drifts(record(fall=fall, held=held, seed=20))
    assert set(estimated) == {"A", "B"}
    for drift in estimated.values():
        assert drift.value == pytest.approx(-fall, abs=0.03 * fall + 30.0)


def test_a_fall_of_both_pressures_is_one_of_the_charge_pressure() -> None:
    assert rarest(record(fall=300.0, seed=21)) == FALL


@pytest.mark.parametrize("side", "AB")
def test_a_drift_of_one_pressure_is_one_of_its_sensor(side: str) -> None:
    zero = {f"zero_{side}": -1000.0}
    assert rarest(record(**zero, seed=22)) == f"drift of low p_{side}"


def test_a_chamber_that_is_low_on_no_healthy_day_does_not_hide_a_fall() -> None:
    """The drive is switched off and the load comes to rest, where the accumulator is empty already."""
    healthy = [{"B": other["B"]} for other in HEALTHY]
    judged = estimate_low_drifts(record(fall=1000.0, seed=27))
    alone = {change.name: change for change in compare_low_drifts({"B": judged["B"]}, healthy)}
    slow = {**judged, "A": judged["A"]._replace(value=-50.0)}
    both = {change.name: change for change in compare_low_drifts(slow, healthy)}
    assert both[FALL].chance == alone[FALL].chance < 1e-3
    assert "drift of low p_A" not in both


def test_a_healthy_recording_shows_no_drift_and_a_rise_is_no_loss_of_oil() -> None:
    healthy = compare_low_drifts(estimate_low_drifts(record(seed=23)), HEALTHY)
    assert min(change.chance for change in healthy) > 0.01
    rising = {
        change.name: change for change in compare_low_drifts(estimate_low_drifts(record(fall=-500.0, seed=24)), HEALTHY)
    }
    assert rising[FALL].chance > 0.5
    assert rising["drift of low p_A"].chance < 1e-4


@pytest.mark.parametrize("enclosed", [-1e5, 2e5])
def test_a_pressure_enclosed_before_the_pump_first_turns_is_no_drift(enclosed: float) -> None:
    """A logger that starts early records what shut valves hold, which is not the charge pressure."""
    recording = record()
    rests = recording.t < 20.0
    channels = dict(recording.channels)
    channels["omega"] = np.where(rests, 0.0, channels["omega"])
    channels["x"] = np.where(rests, 0.0, channels["x"])
    early = {**channels, "p_A": np.where(rests, 8e5 + enclosed, channels["p_A"])}
    expected, estimated = (
        estimate_low_drifts(replace(recording, channels=values)).get("A") for values in (channels, early)
    )
    assert expected is not None and estimated is not None
    assert estimated.value == pytest.approx(expected.value, abs=1.0)


def test_missing_samples_cost_nothing_but_themselves() -> None:
    recording = record(fall=300.0, seed=26)
    p_B = recording["p_B"].copy()
    p_B[500:520] = np.nan
    gap = Recording(T, {**recording.channels, "p_B": p_B}, dict(recording.units), recording.rate)
    whole, broken = estimate_low_drifts(recording).get("B"), estimate_low_drifts(gap).get("B")
    assert whole is not None and broken is not None
    assert broken.value == pytest.approx(whole.value, rel=0.05)


def test_a_chamber_that_always_carries_the_load_is_left_out() -> None:
    recording = record(fall=300.0, seed=25)
    loaded = Recording(T, {**recording.channels, "p_A": recording["p_A"] + 50e5}, dict(recording.units), recording.rate)
    estimated = estimate_low_drifts(loaded)
    assert estimated.get("A") is None
    drift = estimated.get("B")
    assert drift is not None and drift.value == pytest.approx(-300.0, rel=0.05)


def test_a_recording_without_both_pressures_or_the_pump_has_no_estimate_low_drifts() -> None:
    recording = record()
    assert estimate_low_drifts(recording.only(["p_A", "x", "omega"])) == {}
    assert estimate_low_drifts(recording.only(["p_A", "p_B", "x"])) == {}


def test_only_external_leaks_make_the_charge_pressure_fall() -> None:
    change = next(
        change for change in compare_low_drifts(estimate_low_drifts(record(fall=300.0)), HEALTHY) if change.name == FALL
    )
    assert {event.cause for event in load_events() if event.changes(change, "moves")} == {"external leak"}


def lose_oil(flow: float, onset: float, volume: float = 2e-3) -> ChargeTrend:
    """Trend of the charge pressure of 8 bar of an accumulator that loses a flow [m^3/s] since an onset [s]."""
    recording = record(seed=3)
    lost = flow * np.maximum(T - onset, 0.0)
    pressures = {name: recording[name] - 9e5 * lost / volume for name in ("p_A", "p_B")}
    trend = estimate_charge_trend(Recording(T, {**recording.channels, **pressures}, recording.units, RATE))
    assert trend is not None
    return trend


@pytest.mark.parametrize("onset", [0.0, 50.0])
def test_the_fall_of_a_ramp_is_the_one_that_a_loss_since_its_onset_makes(onset: float) -> None:
    """The slope that a fit over the whole recording has where the pressure falls from f T on, times (1-f)^2 (1+2f)."""
    flow, before = 1e-6, onset / SECONDS
    expected = 9e5 * flow / 2e-3 * (1.0 - before) ** 2 * (1.0 + 2.0 * before)
    assert lose_oil(flow, onset).fall == pytest.approx(expected, rel=0.1)


def test_a_loss_of_oil_is_supported_where_the_charge_pressure_falls_and_refuted_where_it_does_not() -> None:
    flow, onset = 1e-6, 50.0  # 0.06 L/min
    assert lose_oil(flow, onset).loss_support(flow, onset) > 2.0
    assert lose_oil(0.0, onset).loss_support(flow, onset) < -2.0
    # a loss that empties nothing within the recording is neither
    assert lose_oil(0.0, onset).loss_support(1e-9, onset) == pytest.approx(0.0, abs=0.2)
    assert lose_oil(0.0, onset).loss_support(flow, 0.98 * SECONDS) == pytest.approx(0.0, abs=0.2)


def test_the_refutation_grows_with_the_flow_and_is_never_certain() -> None:
    tight = lose_oil(0.0, 0.0)
    supports = [tight.loss_support(flow, 20.0) for flow in np.geomspace(1e-8, 1e-2, 13)]
    assert all(np.diff(supports) < 1e-9)
    assert supports[-1] > -20.0
