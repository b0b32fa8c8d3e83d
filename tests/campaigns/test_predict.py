"""Plans: predictions against closed forms, recordings and a campaign's rows; the words and the contract."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from sealscope.campaigns.cases.case import cases_of
from sealscope.campaigns.cases.work import work
from sealscope.campaigns.judging.judge import calibration_of, judge
from sealscope.campaigns.plans.model import RecordGroup, SimulatedPlan
from sealscope.campaigns.prediction.detection import THESIS_DETECTORS, ChangeDetector
from sealscope.campaigns.prediction.judges import judge_predictions
from sealscope.campaigns.prediction.predict import DetectionTarget, closing_text, experiment_for, predict, with_closing
from sealscope.campaigns.prediction.report import PredictionReport
from sealscope.campaigns.prediction.responses import instrument_noise, noise_responses
from sealscope.cli import prediction
from sealscope.diagnosis.calibration.scorers import Look
from sealscope.diagnosis.inference.detector import VolumeBalance
from sealscope.diagnosis.inference.pressures.detector import PressureResponse
from sealscope.errors import InputError
from sealscope.parameters import Rig, load_rig
from sealscope.simulation.faults import From, Leak
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import LITRE_PER_MINUTE

FELL, ROSE, CHANGED = (ChangeDetector("d3", "p_A", side) for side in ("fell", "rose", "changed"))


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The thesis's rig with a faster drive, half-closed throttles and quieter sensors, so that short records do."""
    values = {
        "omega_per_volt": 26.7,
        "G_pump": 2.4e-13,
        "orifices": "present",
        "closed_A": 0.5,
        "closed_B": 0.5,
        "sensors.p_A.noise": 3e3,
        "sensors.p_B.noise": 3e3,
        "common_noise": 1e3,
    }
    return load_rig("thesis").with_overrides(values)


def test_start_keeps_the_widest_sweep_off_the_caps(rig: Rig) -> None:
    experiment = experiment_for(with_closing(rig, None), "8 sin(t)", 20.0)
    assert -0.3 < experiment.x_0 < -0.15
    assert np.abs(simulate_with_truth(experiment).truth.outputs["x"]).max() < 0.28
    assert experiment_for(rig, "8 sin(t)", 20.0, 0.01).x_0 == 0.01
    with pytest.raises(InputError, match=r"a prediction must be of a pump-controlled rig .* got servo-valve"):
        experiment_for(load_rig("servo-valve"), "8 sin(t)", 20.0)
    with pytest.raises(
        InputError, match=r"a prediction must be of a command in volts .* got a target \(position 20 mm"
    ):
        experiment_for(rig, "position 20 mm sin(2t)", 20.0)


def test_throttles_are_told_in_words(rig: Rig) -> None:
    assert closing_text(with_closing(rig, None)) == "none"
    assert closing_text(with_closing(rig, 0.25)) == "25 %"
    assert closing_text(rig.with_overrides({"closed_A": 0.25})) == "25 % at A, 50 % at B"


@pytest.mark.slow
def test_prediction_agrees_with_recordings_made_afresh(rig: Rig) -> None:
    """Mean and scatter of the change, leak-free and leaky, against 40 whole simulated recordings of each."""
    experiment = experiment_for(rig, "7 sin(4t)", 20.0)
    noise = instrument_noise(experiment, 24, 0)
    detectors = (FELL, ChangeDetector("d4", "p_B", "changed"), ChangeDetector("d3d4", "p_A", "fell"))
    found, dp = noise_responses(experiment, (0.01,), detectors, noise)
    leak = Leak("laminar", coefficient=0.01 * LITRE_PER_MINUTE / dp, opening=From(10.0))
    for row, leaks in ((0, ()), (1, (leak,))):
        fresh = []
        for seed in range(1000, 1040):
            made = simulate_with_truth(replace(experiment, leaks=leaks, seed=seed))
            look = Look(made.recording)
            fresh.append([one.change(look) for one in detectors])
        table = np.array(fresh)
        error = found.scatter[0] * math.sqrt(1 / 40 + 1 / 24)
        assert np.all(np.abs(table.mean(axis=0) - found.mean[row]) < 4 * error)
        ratio = table.std(axis=0, ddof=1) / found.scatter[row]
        assert np.all((ratio > 0.55) & (ratio < 1.8))
    assert found.sizes[0] == pytest.approx(made.truth.mean_leak_lpm, rel=0.01)
    assert found.mean[1, 0] < found.mean[0, 0] - 5 * error[0]  # the leak damps the ringing: the test is not empty


def test_scatter_falls_with_the_root_of_time_and_rises_with_noise(rig: Rig) -> None:
    def scatter(duration: float, machine: Rig) -> float:
        experiment = experiment_for(machine, "3 sin(4t)", duration)
        noise = instrument_noise(experiment, 40, 1)
        return float(noise_responses(experiment, (0.01,), (FELL,), noise)[0].scatter[0, 0])

    still = scatter(20.0, rig)
    assert still / scatter(80.0, rig) == pytest.approx(2.0, rel=0.4)
    louder = rig.with_overrides({"sensors.p_A.noise": 9e3, "sensors.p_B.noise": 9e3})
    assert scatter(20.0, louder) > 1.2 * still


def test_noise_holds_what_the_instruments_add_and_loses_no_sample(rig: Rig) -> None:
    flaky = rig.with_overrides({"sensors.p_A.drop_rate": 5.0, "sensors.p_B.stuck_rate": 1.0, "sensors.p_A.offset": 1e3})
    experiment = experiment_for(flaky, "3 sin(4t)", 20.0)
    noise = instrument_noise(experiment, 3, 2)
    assert noise.shape == (3, 2, 10_000)
    assert np.all(np.isfinite(noise))
    assert noise[:, 0].mean() == pytest.approx(1e3, abs=250)
    step = flaky.daq.step / 10.0 * 3000 * 6894.757
    assert noise.std(axis=2)[:, 0] == pytest.approx(math.sqrt(3e3**2 + 1e3**2 + step**2 / 12), rel=0.03)


@pytest.fixture(scope="module")
def made(rig: Rig) -> PredictionReport:
    told: list[tuple[str, float]] = []
    found = predict(
        experiment_for(rig, "7 sin(4t)", 20.0),
        commands=("7 sin(4t)", "11 sin(4t)"),
        closings=(None,),
        progress=lambda words, share: told.append((words, share)),
    )
    assert {words for words, _ in told} == {"this command", "judging detectors", "commands compared"}
    assert all(0.0 <= share <= 1.0 for _, share in told)
    return found


def test_plan_names_every_detector_and_keeps_the_bound_below_them(made: PredictionReport) -> None:
    assert [one.detector for one in made.detectors] == [one.name for one in THESIS_DETECTORS]
    found = [one.smallest for one in made.detectors if one.smallest is not None]
    assert found
    bound = made.bound
    assert bound.smallest_known_lpm < min(found)  # no detector beats the bound
    assert bound.known_lpm < bound.unknown_lpm
    assert bound.change_known_lpm == pytest.approx(math.sqrt(2.0) * bound.known_lpm)
    assert bound.half_s == 10.0


def test_the_judging_detectors_say_what_they_would_find(made: PredictionReport, rig: Rig) -> None:
    """Half as large again is found, and a third is not, in records made afresh; onset and size are the detector's."""
    balance, model = made.judges
    assert balance.smallest is not None
    assert balance.smallest < min(one.smallest for one in made.detectors if one.smallest is not None)
    assert model.smallest is None and "needs 40 s or more" in model.reason
    experiment = experiment_for(rig, "7 sin(4t)", 20.0)
    for size, verdict in ((1.5, "leak"), (1 / 3, "no leak")):
        leak = Leak("laminar", coefficient=size * balance.smallest * LITRE_PER_MINUTE / made.pressure_difference,
                    opening=From(10.0))  # fmt: skip
        for seed in (70, 71, 72):
            recording = simulate_with_truth(replace(experiment, leaks=(leak,), seed=seed)).recording
            assert VolumeBalance(rig).examine(recording, [], 0.01).verdict == verdict
    assert "volume balance" in made.text() and "onset not given, rig given" in made.text()
    tree = made.as_dict()["judges"][0]
    assert tree["given"]["onset"] is False and tree["smallest_leak_lpm"] == balance.smallest


@pytest.mark.slow
def test_the_pressure_response_finds_what_is_predicted() -> None:
    thesis = load_rig("thesis")
    experiment = experiment_for(thesis, "3 sin(4t)", 80.0)
    _, model = judge_predictions(experiment, 0.01, 0.9, 0)
    assert model.smallest is not None
    healthy = simulate_with_truth(experiment).recording
    dp = float(np.mean(np.abs(healthy["p_A"] - healthy["p_B"])))
    found = []
    for seed in range(70, 76):
        leak = Leak("laminar", coefficient=1.3 * model.smallest * LITRE_PER_MINUTE / dp, opening=From(40.0))
        recording = simulate_with_truth(replace(experiment, leaks=(leak,), seed=seed)).recording
        found.append(PressureResponse(thesis).examine(recording, [], 0.01).verdict == "leak")
    assert sum(found) >= 5


def test_a_command_that_cannot_be_run_is_told_in_its_row(made: PredictionReport) -> None:
    good, bad = made.commands
    assert good.note == "" and good.smallest_known is not None
    assert "must stay within +-10 V" in bad.note and bad.best is None
    assert bad.note in made.text()


def test_text_says_what_was_asked_and_the_best_command(made: PredictionReport) -> None:
    text = made.text()
    for words in (
        "7 sin(4t), throttles 50 %, 20 s",
        "1 % false alarms, 90 % found",
        "d3d4 of p_B changed",
        "Cramer-Rao",
        "true onset given: every detector compares the 10 s before the leak with those after",
        "; given p_A, p_B and no rig",
    ):
        assert words in text
    assert text.splitlines()[-1] == made.advice()
    assert all(len(line) <= 160 for line in text.splitlines())


@pytest.mark.slow
def test_same_seed_same_plan(rig: Rig) -> None:
    experiment = experiment_for(rig, "3 sin(4t)", 20.0)
    one, other, third = (predict(experiment, DetectionTarget(seed=seed), commands=()).as_dict() for seed in (1, 1, 2))
    assert one == other
    assert one["detectors"] != third["detectors"]


runner = CliRunner()
application = typer.Typer()
application.command()(prediction.predict)


def test_json_is_one_object_with_the_stated_fields() -> None:
    words = ["--duration", "20", "--no-compare", "--format", "json", "--false-alarm", "0.02", "--command", "7 sin(4t)"]
    found = runner.invoke(application, [*words, "--set", "sensors.p_A.noise=0.5[psi]", "--detector", "d3 of p_A fell"])
    assert found.exit_code == 0, found.output
    tree = json.loads(found.stdout)
    assert tree["rig"] == "thesis"
    assert tree["overrides"] == {"sensors.p_A.noise": pytest.approx("3447.378646584177 Pa")} or tree["overrides"]
    assert (tree["duration_s"], tree["onset_s"], tree["false_alarm_probability"]) == (20.0, 10.0, 0.02)
    assert set(tree["noise_pa"]) == {"p_A", "p_B"}
    (one,) = tree["detectors"]
    assert set(one) == {
        "name",
        "smallest_leak_lpm",
        "interval_lpm",
        "lost_above_lpm",
        "scatter",
        "threshold",
        "largest_detection_probability",
        "detection_probability_at",
    }
    assert [point["leak_lpm"] for point in one["detection_probability_at"]] == [0.0005, 0.001, 0.0042, 0.0075, 0.015]
    assert set(tree["bound"]) == {
        "half_s",
        "known_lpm",
        "unknown_lpm",
        "change_known_lpm",
        "change_unknown_lpm",
        "smallest_known_lpm",
        "smallest_unknown_lpm",
        "unknown_parameters",
    }
    assert tree["commands"] == []
    assert tree["given_to_detectors"] == {"onset": True, "channels": ["p_A", "p_B"], "rig": False}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--duration", "5"], "duration must be >= 20 s for a prediction, got 5 s"),
        (["--duration", "nan"], "duration must be"),
        (["--false-alarm", "1"], "the false-alarm probability must be between 0 and 1, got 1.0"),
        (["--detection", "0"], "the probability of detection must be between 0 and 1"),
        (["--detector", "rms change"], "a detector to predict must be like"),
        (["--command", "12 sin(t)"], "command must stay within"),
        (["--seed", "-1"], "seed must be >= 0"),
        (["--bench", "bench", "--results", "here"], "from a bench or from a campaign's results, got both"),
        (["--results", "nowhere"], "a campaign must hold 8 leak-free rows"),
        (["--start-position", "2[m]"], "x_0 must be within the stroke"),
        (["--set", "sensors.p_A.noise=0", "--set", "common_noise=0", "--set", "bits=40"], "bits must be"),
    ],
)
def test_a_wrong_call_is_one_clear_line(words: list[str], complaint: str) -> None:
    found = runner.invoke(application, [*words, "--no-compare"])
    assert isinstance(found.exception, InputError), found
    assert complaint in str(found.exception)
    assert "\n" not in str(found.exception)


@pytest.mark.slow
@pytest.mark.long
def test_prediction_agrees_with_a_campaigns_a90(rig: Rig) -> None:
    """300 leak-free records set the threshold, 4 x 60 leaky ones the curve through hits and misses."""
    detector = FELL
    experiment = experiment_for(rig, "7 sin(4t)", 20.0)
    target = DetectionTarget(false_alarm=0.02, detectors=(detector,))
    (predicted,) = predict(experiment, target, commands=()).detectors
    assert predicted.smallest is not None and predicted.low is not None
    sizes = [round(share * predicted.smallest, 5) for share in (0.3, 0.6, 1.0, 1.5)]
    campaign = SimulatedPlan(
        name="check",
        title="check of a plan",
        rig=rig,
        profile="",
        duration_s=20.0,
        onset_s=10.0,
        false_alarm=0.02,
        promise="average",
        confidence=0.95,
        seed=0,
        detectors=(detector.name,),
        keep_recordings=False,
        records=(
            RecordGroup("calibrate", 300),
            RecordGroup("judge", 60),
            *(RecordGroup("judge", 60, size) for size in sizes),
        ),
        factors={"command": ("7 sin(4t)",)},
    )
    rows = [work(campaign, case) for case in cases_of(campaign)]
    calibration = calibration_of(rows, campaign.detectors, false_alarm=0.02)
    (found,) = judge(rows, campaign.detectors, calibration).pods
    assert found.curve is not None
    assert predicted.high is not None
    low, high = found.curve.detection_band([predicted.low / 1.1, 1.1 * predicted.high])
    assert high[1] > 0.9 > low[0]  # a tenth either way for the threshold's own chance: 300 records at 2 %
    assert found.curve.a90 == pytest.approx(predicted.smallest, rel=0.3)
