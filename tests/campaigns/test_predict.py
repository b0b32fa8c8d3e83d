"""Predictions against records made afresh, the closed forms of the rules, the words and the contract."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import typer
from scipy.special import ndtr, ndtri
from typer.testing import CliRunner

from sealscope.campaigns.prediction import predict as module
from sealscope.campaigns.prediction.predict import closing_text, experiment_for, predict, with_closing
from sealscope.campaigns.prediction.report import BoundFigures, PredictionReport
from sealscope.campaigns.prediction.rules import THESIS_RULES, DetectionTarget, smallest_leaks
from sealscope.cli import prediction
from sealscope.diagnosis.registry import detectors
from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import Array
from sealscope.simulation.faults import From, Leak
from sealscope.simulation.simulate import simulate_with_truth
from sealscope.units import LITRE_PER_MINUTE


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The thesis's rig with a faster drive, half-closed throttles and quieter sensors, so that short records do."""
    values = {
        "omega_per_volt": 26.7, "G_pump": 2.4e-13, "orifices": "present", "closed_A": 0.5, "closed_B": 0.5,
        "sensors.p_A.noise": 3e3, "sensors.p_B.noise": 3e3, "common_noise": 1e3,
    }  # fmt: skip
    return load_rig("thesis").with_overrides(values)


def test_start_keeps_the_widest_sweep_off_the_caps(rig: Rig) -> None:
    experiment = experiment_for(with_closing(rig, None), "8 sin(t)", 20.0)
    assert -0.3 < experiment.x_0 < -0.15
    assert np.abs(simulate_with_truth(experiment).truth.outputs["x"]).max() < 0.28
    assert experiment_for(rig, "8 sin(t)", 20.0, 0.01).x_0 == 0.01
    with pytest.raises(InputError, match="pump-controlled rig"):
        experiment_for(load_rig("servo-valve"), "8 sin(t)", 20.0)
    with pytest.raises(InputError, match="command in volts"):
        experiment_for(rig, "position 20 mm sin(2t)", 20.0)


def test_throttles_are_told_in_words(rig: Rig) -> None:
    assert closing_text(with_closing(rig, None)) == "none"
    assert closing_text(with_closing(rig, 0.25)) == "25 %"
    assert closing_text(rig.with_overrides({"closed_A": 0.25})) == "25 % at A, 50 % at B"


@pytest.fixture(autouse=True, scope="module")
def few() -> Iterator[None]:
    """Fewer records and sizes than a prediction has, for the sake of time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SIZES", (0.004, 0.032))
        patch.setattr(module, "RULE_RECORDS", 8)
        yield


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the bound and the response of the pressures, which take longer than all else."""
    monkeypatch.setattr(module, "_bound", lambda *given: BoundFigures(0.0, 0.0, ()))
    monkeypatch.delitem(module._JUDGES, "pressure response")


@pytest.fixture(scope="module")
def made(rig: Rig) -> PredictionReport:
    return predict(
        experiment_for(rig, "7 sin(4t)", 20.0), commands=("7 sin(4t)", "11 sin(4t)"), closings=(None,)
    )  # fmt: skip


def test_what_is_predicted_is_found(rig: Rig, quick: None) -> None:
    """1.3 times the size is found in most records made afresh, and a third of it in none."""
    experiment = experiment_for(rig, "7 sin(4t)", 60.0)
    made = predict(experiment, DetectionTarget(rules=()), commands=())
    best = made.best
    assert best is not None and best.detector == "volume balance"
    found = []
    for size in (1.3, 1 / 3):
        flow = size * best.smallest * LITRE_PER_MINUTE / made.pressure_difference
        leak = Leak("laminar", coefficient=flow, opening=From(30.0))
        records = [simulate_with_truth(replace(experiment, leaks=(leak,), seed=seed)).recording for seed in range(4)]
        balance = detectors()["volume balance"](rig)
        found.append(sum(balance.examine(record, [], 0.01).verdict == "leak" for record in records))
    assert found[0] >= 3 and found[1] == 0


def test_the_rules_are_given_less_and_find_less(made: PredictionReport) -> None:
    assert [own.rule for own in made.rules] == list(THESIS_RULES)
    sizes = [own.smallest for own in made.rules if own.smallest is not None]
    assert sizes and made.best is not None
    assert made.best.smallest < made.bound.smallest_known_lpm < min(sizes)  # no rule beats the bound of the pressures
    assert made.bound.smallest_known_lpm < made.bound.smallest_unknown_lpm
    reasons = [own.reason for own in made.leaks if own.smallest is None]
    assert all(reasons)


def test_the_answer_comes_first_and_fits_a_terminal(made: PredictionReport) -> None:
    lines = made.text().splitlines()
    assert float(lines[0].split()[0]) == pytest.approx(made.best.smallest, rel=0.06)
    assert len(lines) <= 20
    good, bad = made.duties
    assert good.note == "" and good.leaks[0].smallest is not None
    assert "must stay within +-10 V" in bad.note and bad.note in made.text()


def test_the_seed_makes_the_records(rig: Rig, quick: None) -> None:
    experiment = experiment_for(rig, "3 sin(4t)", 20.0)
    one, other, third = (
        predict(experiment, DetectionTarget(rules=("d3 of p_A fell",), seed=seed), commands=()).as_dict()
        for seed in (1, 1, 2)
    )
    assert one == other
    assert one["rules"] != third["rules"] and one["smallest_leak_lpm"] != third["smallest_leak_lpm"]


def test_a_bench_draws_machines_that_drift(rig: Rig, quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BENCH_SIZES", (0.008, 0.1))
    experiment, target = experiment_for(rig, "7 sin(4t)", 20.0), DetectionTarget(rules=("d3 of p_A fell",))
    still = predict(experiment, target, commands=())
    bench = predict(experiment, target, commands=(), bench="bench", draws=8)
    assert bench.records == 8
    assert bench.rules[0].scatter > 1.5 * still.rules[0].scatter
    assert bench.best is not None and bench.best.smallest > still.best.smallest
    with pytest.raises(InputError, match="draws must be"):
        predict(experiment, target, commands=(), bench="bench", draws=10**12)
    levels = module.fixed_levels(experiment)
    assert levels["motor.omega_per_volt"] == 26.7 and levels["line.closed_A"] == 0.5

    def fails(experiment: object) -> object:
        raise SimulationFailed("it fell below vacuum")

    monkeypatch.setattr(module, "simulate_with_truth", fails)
    with pytest.raises(SimulationFailed, match="8 of 8 machines of the bench"):
        predict(experiment, target, commands=(), bench="bench", draws=8)


def records(shift: float, scatter: float = 1.0) -> Array:
    """Return changes (n, 1) of exactly this mean and standard deviation."""
    values = np.linspace(-1.0, 1.0, 41)
    return shift + scatter * (values / values.std(ddof=1))[:, None]


@pytest.mark.parametrize(("rule", "tails"), [("d3 of p_A fell", 1.0), ("d3 of p_A changed", 2.0)])
def test_a_shift_in_proportion_has_the_closed_form(rule: str, tails: float) -> None:
    """mean = k a: POD = Phi(k a - z), so that the smallest leak is (z + z_detection)/k."""
    sizes, k = np.array([0.01, 0.02, 0.04]), 200.0
    (found,) = smallest_leaks(sizes, [records(k * a) for a in (0.0, *sizes)], DetectionTarget(rules=(rule,)))
    z = ndtri(1 - 0.01 / tails)
    assert found.smallest == pytest.approx((z + ndtri(0.9)) / k, rel=0.01)
    assert found.found == pytest.approx(ndtr(0.0042 * k - z), rel=0.02)
    assert found.scatter == pytest.approx(1.0)


def test_what_never_moves_is_not_found_and_what_cannot_be_computed_says_so() -> None:
    sizes = np.array([0.01, 0.1])
    changes = [np.column_stack([records(0.0), records(-5.0 * k), records(math.nan)]) for k in range(3)]
    still, away, unknown = smallest_leaks(sizes, changes, DetectionTarget(rules=THESIS_RULES[:3]))
    assert still.smallest is None and still.found == pytest.approx(0.01)
    assert away.smallest is None and away.found < 0.01
    assert unknown.smallest is unknown.scatter is unknown.found is None


runner = CliRunner()
application = typer.Typer()
application.command()(prediction.predict)


def test_json_is_one_object_with_the_stated_fields() -> None:
    words = ["--duration", "20", "--no-compare", "--format", "json", "--false-alarm", "0.02", "--command", "7 sin(4t)"]
    done = runner.invoke(application, [*words, "--set", "sensors.p_A.noise=0.5[psi]", "--detector", "d3 of p_A fell"])
    assert done.exit_code == 0, done.output
    tree = json.loads(done.stdout)
    assert (tree["rig"], tree["duration_s"], tree["onset_s"], tree["commands"]) == ("thesis", 20.0, 10.0, [])
    assert (tree["false_alarm_probability"], tree["detection_probability"]) == (0.02, 0.9)
    assert "sensors.p_A.noise" in tree["overrides"]
    assert tree["smallest_leak_lpm"] == tree["detectors"][0]["smallest_leak_lpm"] > 0.0
    (rule,) = tree["rules"]
    assert rule["given"] == {"onset": True, "rig": False}
    assert set(tree["bound"]) == {"smallest_known_lpm", "smallest_unknown_lpm", "unknown_parameters"}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--duration", "5"], "duration must be >= 20 s for a prediction, got 5 s"),
        (["--duration", "nan"], "duration must be"),
        (["--false-alarm", "1"], "the false-alarm probability must be between 0 and 1, got 1.0"),
        (["--false-alarm", "0.5"], "false-alarm probability must be 0.0001 to 0.2, got 0.5"),
        (["--detection", "0"], "the probability of detection must be between 0 and 1"),
        (["--detector", "rms change"], "a rule to predict must be like"),
        (["--command", "12 sin(t)"], "command must stay within"),
        (["--seed", "-1"], "seed must be >= 0"),
        (["--start-position", "2[m]"], "x_0 must be within the stroke"),
        (["--bench", "nowhere"], "nowhere"),
    ],
)
def test_a_wrong_call_is_one_clear_line(words: list[str], complaint: str) -> None:
    done = runner.invoke(application, ["--no-compare", *words])
    assert done.exit_code != 0
    assert isinstance(done.exception, InputError)
    assert complaint in str(done.exception)
