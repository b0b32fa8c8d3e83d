"""The pressure model led by its readings, one sample ahead: for machines that ring without regard to the command."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.pressure_model.detector import UNRULY, PressureModel, _makes_good, is_followed
from sealscope.diagnosis.pressure_model.follow import Followed, follow
from sealscope.diagnosis.pressure_model.model import STATES, DrivenModel, assumed_numbers, nominal
from sealscope.parameters import load_rig
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_with_truth

RIG = load_rig("thesis-closed-loop")
#: Between two places, at each of which the piston rests; while it moves, friction makes it ring.
RESTING = "position trapezoid 45 mm within 0.9 s every 6.6 s"
RATE = 500.0


@cache
def recorded(leak: str = "", load: str = "0 N") -> Recording:
    experiment = Experiment.of(
        rig=RIG, command=RESTING, controller="pi", load=load, leak=leak or (), duration=120.0, seed=4
    )
    return simulate_with_truth(experiment).recording.only(("u", "p_A", "p_B"))


def followed(recording: Recording, unruly: float = UNRULY) -> Followed:
    seen = follow(RIG, recording, find_cycle(recording), unruly)
    assert isinstance(seen, Followed)
    return seen


def driven(n: int = 1500) -> tuple[DrivenModel, np.ndarray]:
    u = 3.0 * np.sin(4.0 * np.arange(n) / RATE)
    return DrivenModel.of(u, RATE, assumed_numbers(RIG)), nominal(RIG)


def test_a_led_run_is_that_of_single_samples_each_corrected_by_its_reading() -> None:
    """Against runs of one sample under the command alone, whose state is corrected between them."""
    model, theta = driven()
    alone = model.run(theta[None])[0]
    readings = alone + 2e4 * np.random.default_rng(1).standard_normal(alone.size)
    led = model.led(readings, theta)
    assert led.readings.mean() == pytest.approx(alone.mean(), abs=1e-6 * np.abs(alone).max())
    state, slowly = np.zeros((1, STATES)), np.empty(alone.size)
    for sample in range(alone.size):
        slowly[sample] = state[0, 0]
        state[0, 0] += led.correction * (led.readings[sample] - state[0, 0])
        model.part(sample, 1).run(theta[None], start=state)
    shown = led.run(theta[None])[0]
    np.testing.assert_allclose(shown, slowly, atol=1.0)
    assert np.abs(shown - alone).max() > 1e3
    np.testing.assert_array_equal(led.part(700, 300).readings, led.readings[700:1000])


@pytest.mark.parametrize("share", [0.7, 1.4])
def test_a_led_model_forgets_a_wrong_start_within_some_periods(share: float) -> None:
    """exp(-t/tau) in the mean of a ringing that is not damped; the machine damps it besides."""
    model, theta = driven()
    led = model.led(model.run(theta[None])[0], theta)
    start = np.zeros((1, STATES))
    start[0, 0] = share * 1e5
    off = led.run(theta[None], start=start)[0] - led.run(theta[None])[0]
    assert np.abs(off[: int(0.01 * RATE)]).max() > 0.3 * share * 1e5
    assert np.abs(off[int(0.15 * RATE) : int(0.3 * RATE)]).max() < 0.01 * share * 1e5


@pytest.mark.slow
@pytest.mark.long
def test_a_leak_of_a_machine_that_rests_is_found_from_pressures() -> None:
    """Under the command alone the parameters wander 5 times as much as those of a healthy machine may."""
    leak = recorded("0.0042 L/min from 60 s")
    alone, led = followed(leak, np.inf), followed(leak)
    assert alone.predicted is None
    assert alone.excess > UNRULY
    assert led.predicted is not None
    assert led.excess < 1.2
    assert np.std(led.predicted - (leak["p_A"] - leak["p_B"])) < 0.35 * np.std(leak["p_A"] - leak["p_B"])
    diagnosis = diagnose(leak, rig=RIG, quick=True)
    assert diagnosis.verdict == "leak"
    assert "predicted from sample to sample" in diagnosis.reason
    assert diagnosis.onset_s == pytest.approx(60.0, abs=7.0)
    low, high = diagnosis.leak_interval_lpm or (np.nan, np.nan)
    assert low < 0.0042 < high < 5.0 * 0.0042


@pytest.mark.slow
def test_a_large_leak_of_a_machine_that_rests_is_dated_and_sized() -> None:
    diagnosis = diagnose(recorded("0.05 L/min from 60 s"), rig=RIG, quick=True)
    assert diagnosis.verdict == "leak"
    assert diagnosis.onset_s == pytest.approx(60.0, abs=2.0)
    low, high = diagnosis.leak_interval_lpm or (np.nan, np.nan)
    assert low < 0.05 < high < 0.15


@pytest.mark.slow
def test_a_sound_machine_that_rests_is_followed_and_has_no_leak() -> None:
    sound = recorded()
    assert followed(sound).excess < UNRULY
    assert diagnose(sound, rig=RIG, quick=True).verdict == "no leak"


@pytest.mark.slow
def test_a_machine_that_rings_by_itself_as_its_oil_warms_is_followed_and_its_leak_sized() -> None:
    """Friction then falls with speed; of the ringing the model explained 55 % under the command alone."""
    experiment = Experiment.of(
        rig="thesis",
        command="6 sin(1.5t)",
        fault="oil +25 K growing from 0 s to 60 s",
        leak="0.01 L/min from 60 s",
        duration=120.0,
        seed=5,
    )
    record = simulate_with_truth(experiment).recording.only(("u", "p_A", "p_B"))
    evidence = PressureModel(load_rig("thesis")).examine(record, [], 0.01)
    assert evidence.verdict == "leak", evidence.reason
    assert "predicted from sample to sample" in evidence.reason
    assert evidence.onset_s == pytest.approx(60.0, abs=5.0)
    low, high = evidence.leak_interval_lpm or (np.nan, np.nan)
    assert low < 0.01 < high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("leak", "verdict"),
    [("", "no leak"), pytest.param("0.01 L/min from 60 s", "leak", marks=pytest.mark.long)],
)
def test_oil_that_warms_makes_parameters_drift_and_neither_a_leak_nor_a_record_that_cannot_be_followed(
    leak: str, verdict: str
) -> None:
    """Friction and stiffness fall by a tenth and more: the leak ended as a friction change, `cannot tell`."""
    experiment = Experiment.of(
        rig="thesis",
        command="7 sin(4t)",
        fault="oil +30 K growing from 0 s to 120 s",
        leak=leak or (),
        duration=120.0,
        seed=5,
    )
    simulated = simulate_with_truth(experiment)
    record = simulated.recording.only(("u", "p_A", "p_B"))
    model = PressureModel(load_rig("thesis"))
    followed = model.follow(record)
    assert not isinstance(followed, str)
    assert followed.warming
    assert followed.friction_change < -0.1
    assert followed.stiffness_change < -0.04
    evidence = model.examine(record, [], 0.01)
    assert evidence.verdict == verdict, evidence.reason
    if leak:
        low, high = evidence.leak_interval_lpm or (np.nan, np.nan)
        assert low < simulated.truth.mean_leak_lpm < high


@pytest.mark.slow
@pytest.mark.long
def test_the_level_of_a_led_model_is_not_compared() -> None:
    """Its G depends on how far it is led."""
    leak = recorded("0.0042 L/min from 60 s")
    assert not is_followed(followed(leak))
    evidence = PressureModel(RIG).examine(leak, (recorded(),), 0.01)
    assert evidence.verdict == "leak"
    assert "led by the readings" in evidence.reason


@pytest.mark.parametrize(
    ("growth", "share", "good"),
    [(0.03, 0.05, True), (0.05, 0.05, True), (0.1, 0.02, False), (-0.03, 0.05, False)],
    ids=["by part of the leak", "by all of it", "by another duty", "it falls"],
)
def test_a_command_that_grows_by_what_leaks_is_a_controllers(growth: float, share: float, good: bool) -> None:
    """Of 30 leaks of 0.05 L/min under flatness (development) two, at +3 %, were `changed duty`."""
    t = np.arange(60000) / RATE
    u = 3.0 * np.sin(0.4 * np.pi * t) * np.where(t < 60.0, 1.0, 1.0 + growth * (1.0 - 1e-9))
    recording = Recording(t, {"u": u}, {"u": "V"}, RATE)
    assert _makes_good(recording, 60.0, share) is good
