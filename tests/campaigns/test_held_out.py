"""The logistic classifier against closed forms, and whole tests held out on the thesis's own sheet."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.optimize import minimize

from sealscope.campaigns.held_out.checks import checks_of, clustered_area, swapped_areas
from sealscope.campaigns.held_out.classifiers import (
    MeasuredSamples,
    chosen_candidates,
    fold_log_odds,
    held_out_scores,
)
from sealscope.campaigns.plans.model import ChosenClassifier, HeldOutPlan, LogisticClassifier
from sealscope.campaigns.plans.reader import load_plan
from sealscope.cli import campaign as words
from sealscope.errors import InputError
from sealscope.evaluation.roc import auc


def cloud(seed, n=200, f=3):
    random = np.random.default_rng(seed)
    x = random.normal(size=(n, f)) * [1.0, 20.0, 0.1][:f]
    eta = 0.4 + x @ np.array([1.2, -0.05, 3.0][:f])
    return x, random.random(n) < 1.0 / (1.0 + np.exp(-eta))


def test_one_binary_feature_has_the_log_odds_ratio():
    """With hardly a ridge the fit is saturated: log odds of each half are those counted."""
    x = np.array([0.0] * 10 + [1.0] * 20)[:, None]
    y = np.array([True] * 3 + [False] * 7 + [True] * 15 + [False] * 5)
    odds = whole(x, y, 1e-12)
    assert odds[[0, -1]] == pytest.approx([np.log(3 / 7), np.log(15 / 5)], abs=1e-9)


def whole(x, y, ridge):
    """Log odds of all samples from a fit to all of them."""
    return fold_log_odds(x, y, np.ones((1, len(x)), dtype=bool), ridge)[0]


@pytest.mark.parametrize("ridge", [0.01, 1.0, 30.0])
def test_it_is_the_minimum_that_a_general_optimiser_finds(ridge):
    x, y = cloud(1)
    odds = whole(x, y, ridge)
    z = (x - x.mean(axis=0)) / x.std(axis=0)

    def loss(w):
        eta = w[0] + z @ w[1:]
        return np.logaddexp(0.0, np.where(y, -eta, eta)).sum() + 0.5 * ridge * (w[1:] ** 2).sum()

    best = minimize(loss, np.zeros(4), method="BFGS", options={"gtol": 1e-9})
    assert odds == pytest.approx(best.x[0] + z @ best.x[1:], abs=1e-4)


def test_units_of_the_features_do_not_matter():
    x, y = cloud(2)
    assert whole(x * [1e5, 1e-3, 7.0] + [3.0, -2.0, 1e3], y, 1.0) == pytest.approx(whole(x, y, 1.0), abs=1e-7)


def test_what_cannot_be_fitted_is_one_line():
    x, y = cloud(3)
    with pytest.raises(InputError, match="both classes"):
        whole(x, np.ones(len(x), dtype=bool), 1.0)
    with pytest.raises(InputError, match="must vary"):
        whole(np.ones((len(x), 1)), y, 1.0)


def test_a_held_out_test_is_not_seen():
    """A feature that tells only which test a sample belongs to is worth nothing on a test held out, and everything
    otherwise."""
    random = np.random.default_rng(4)
    tests = np.repeat(np.arange(20), 2)
    leaks = np.tile([0.0, 1.0], 20)
    noise = random.normal(size=40)
    samples = MeasuredSamples({"noise": noise}, leaks, list(tests), [{"condition": int(k % 4)} for k in tests])
    plan = LogisticClassifier("noise", ("noise",), 1.0)
    scores = held_out_scores(samples, plan, "test")
    moved = noise.copy()
    moved[0] += 100.0  # the first sample's own feature moves its own score and, through the fit, the other tests' ...
    other = held_out_scores(MeasuredSamples({"noise": moved}, leaks, list(tests), samples.levels), plan, "test")
    assert other[1] == scores[1]  # ... but not that of the sample held out with it
    assert np.all(other[2:] != scores[2:])
    condition = held_out_scores(
        MeasuredSamples({"noise": moved}, leaks, list(tests), samples.levels), plan, "condition"
    )
    same = held_out_scores(samples, plan, "condition")
    together = [k for k in range(1, 40) if tests[k] % 4 == 0]
    assert np.array_equal(condition[together], same[together])


def test_an_unknown_feature_is_named():
    samples = MeasuredSamples({"a": np.zeros(4)}, np.array([0.0, 1.0, 0.0, 1.0]), [1, 1, 2, 2], [{}] * 4)
    with pytest.raises(InputError, match="a feature must be one of a, got 'b'"):
        held_out_scores(samples, LogisticClassifier("x", ("b",), 1.0), "test")


@pytest.mark.parametrize("ridge", [0.01, 1.0])
def test_all_folds_at_once_are_the_fits_one_by_one(ridge):
    x, y = cloud(5)
    folds = np.random.default_rng(1).random((6, len(x))) < 0.7
    together = fold_log_odds(x, y, folds, ridge)
    alone = np.concatenate([fold_log_odds(x, y, fold[None], ridge) for fold in folds])
    assert together == pytest.approx(alone, abs=1e-9)
    apart = x[:, :1] * 1e3 + 1e4 * y[:, None]  # separable: whole steps alone may not reach it
    odds = fold_log_odds(apart, y, folds, ridge)
    assert np.all((odds > 0) == y) and np.all(np.isfinite(odds))
    with pytest.raises(InputError, match="both classes"):
        fold_log_odds(x, y, np.stack([y, ~y]), ridge)


def paired(seed, tests=24, effect=1.5):
    """Tests of two halves, the second with a leak: `good` moves with it, `self` tells the test, `noise` nothing."""
    random = np.random.default_rng(seed)
    number = np.repeat(np.arange(tests), 2)
    leaks = np.tile([0.0, 0.005], tests)
    own = random.normal(size=tests)[number]
    features = {
        "good": random.normal(size=2 * tests) + effect * (leaks > 0),
        "self": own,
        "noise": random.normal(size=2 * tests),
    }
    return MeasuredSamples(features, leaks, list(number), [{"condition": int(k % 6)} for k in number])


CHOSEN = ChosenClassifier("chosen", (("good",), ("self",), ("noise",)), (0.1, 1.0))


def test_what_is_held_out_takes_no_part_in_the_choice():
    """The first test's own values do not change what its fold chooses, nor its other sample's score."""
    samples = paired(1)
    picks = chosen_candidates(samples, CHOSEN, "test")
    assert len(picks) == 24
    assert all("good" in pick.features for pick in picks)
    scores = held_out_scores(samples, CHOSEN, "test")
    wild = {name: values + 1e3 * (np.arange(48) == 0) for name, values in samples.features.items()}
    other = MeasuredSamples(wild, samples.leak_lpm, samples.tests, samples.levels)
    assert chosen_candidates(other, CHOSEN, "test")[0] == picks[0]
    assert held_out_scores(other, CHOSEN, "test")[1] == pytest.approx(scores[1], abs=1e-12)
    assert {one.ridge for one in CHOSEN.candidates()} == {0.1, 1.0}
    assert len(CHOSEN.candidates()) == 14


def test_choosing_from_noise_alone_finds_nothing():
    """Choosing the best of many on the scores themselves would find something; choosing within the training samples
    does not, on average over data without a leak's effect."""
    areas = []
    for seed in range(30):
        samples = paired(seed, effect=0.0)
        scores = held_out_scores(samples, CHOSEN, "condition")
        leaks = samples.leak_lpm > 0
        areas.append(auc(scores[~leaks], scores[leaks]).value)
    assert np.mean(areas) < 0.5 + 3.0 * np.std(areas) / np.sqrt(len(areas))


def test_swapped_labels_show_what_chance_reaches():
    samples, detector = paired(2), LogisticClassifier("good", ("good", "self"), 1.0)
    swapped = swapped_areas(samples, detector, "test", 60, seed=5)
    assert np.array_equal(swapped, swapped_areas(samples, detector, "test", 60, seed=5))
    assert 0.3 < np.mean(swapped) < 0.55  # held out, what is not there is found less often than by guessing
    plan = HeldOutPlan(name="x", data="appendix-c", detectors=(detector, CHOSEN), permutations=60, seed=5)
    first, second = checks_of(plan, samples)
    assert (first.reached, first.swaps) == (0, 60)
    assert first.chance == pytest.approx(np.quantile(swapped, 0.95))
    assert first.tests[0] > 0.75
    assert sum(times for _, times in second.picks) == 24
    assert "0 reach" in first.sentence()
    assert "good" in second.sentence()
    useless = checks_of(HeldOutPlan(name="x", data="appendix-c", detectors=(LogisticClassifier("n", ("noise",), 1.0),),
                                    permutations=60), paired(3))  # fmt: skip
    assert useless[0].reached > 1
    assert checks_of(HeldOutPlan(name="x", data="appendix-c", detectors=(detector,)), samples) == []


def test_the_interval_of_clustered_samples():
    """Clusters of one sample: DeLong's. Every sample twice: the same as once each, which DeLong does not see. Coverage
    over many draws with dependent halves."""
    random = np.random.default_rng(6)
    scores, leaks = random.normal(size=80), np.tile([False, True], 40)
    scores += leaks
    alone = clustered_area(scores, leaks, np.arange(80))
    plain = auc(scores[~leaks], scores[leaks])
    assert alone[0] == plain.value
    assert alone[1:] == pytest.approx((plain.low, plain.high), abs=0.004)
    twice = clustered_area(np.tile(scores, 2), np.tile(leaks, 2), np.tile(np.arange(80), 2))
    assert twice == pytest.approx(alone, abs=1e-12)

    truth, held = 0.7602, 0  # Phi(1/sqrt 2): halves of unit variance, 1 apart
    for _ in range(400):
        shared = random.normal(size=40)[:, None] * np.sqrt(0.6)
        halves = (shared + random.normal(size=(40, 2)) * np.sqrt(0.4) + [0.0, 1.0]).ravel()
        _, low, high = clustered_area(halves, leaks, np.repeat(np.arange(40), 2))
        held += low <= truth <= high
    assert 0.91 <= held / 400 <= 0.98


@pytest.mark.slow
def test_appendix_c_with_whole_tests_held_out(sheet_folder, tmp_path, monkeypatch, capsys):
    """The plain logistic baseline without a baseline of the test's own: AUC 0.955, accuracy 0.87, true positives 0.83,
    false positives 0.10."""
    words.run("appendix-c", tmp_path, sheet=sheet_folder)
    with (tmp_path / "roc.csv").open(encoding="utf-8") as file:
        areas = {row["detector"]: row for row in csv.DictReader(file) if row["leak [L/min]"] == "any"}
    with (tmp_path / "table.csv").open(encoding="utf-8") as file:
        rates = {row["detector"]: row for row in csv.DictReader(file) if row["leak [L/min]"] == "any"}
    name = "logistic on d3, d4, d3d4 of both chambers"
    assert float(areas[name]["AUC"]) == pytest.approx(0.955, abs=0.001)
    assert float(rates[name]["detected: fraction"]) == pytest.approx(34 / 41)
    assert float(rates[name]["false alarms: fraction"]) == pytest.approx(4 / 41)
    assert {"always fire", "never fire"} <= set(rates)
    message = capsys.readouterr().out
    assert "0.955" in message
    assert "chosen: d2 d3 d4" in message
    better = ("logistic on d2, d3, d4 of both chambers", "logistic, details and ridge chosen in the training tests")
    for other in better:
        assert float(areas[other]["low"]) > 0.955  # the whole interval lies over the plain baseline's figure
    with (tmp_path / "held_out.csv").open(encoding="utf-8") as file:
        checks = {row["detector"]: row for row in csv.DictReader(file)}
    for other in better:
        assert float(checks[other]["conditions: low"]) > 0.955
    assert checks["logistic on d2, d3, d4 of both chambers"]["swaps that reach the true labels' AUC"] == "0"
    noise = checks["logistic on d1 of both chambers"]
    assert float(noise["tests: low"]) < 0.5 < float(noise["tests: high"])
    assert int(noise["swaps that reach the true labels' AUC"]) > 10
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("<figure>") >= 3


def test_without_the_sheet_it_says_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SEALSCOPE_SHEET", raising=False)
    with pytest.raises(InputError, match="needs the data sheet"):
        words.run("appendix-c", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('data = "other"', "held_out.data must be 'appendix-c'"),
        ('leave_out = "half"', "held_out.leave_out must be 'test'"),
        ("ridge = -1.0", "ridge must be greater than 0"),
        ('features = "d3"', "features must be"),
        ("permutations = -1", "permutations must be"),
        ("permutations = 1000000000000", "permutations must be less than or equal to 100000"),
        ("choose = []", "choose must have at least 1 item"),
        ('choose = ["d3"]', "choose.1. must be"),
        ('choose = [["d3"]]\nridges = [0.0]', "ridges.1. must be greater than 0"),
        (f"choose = {[['d3']] * 9}\nridges = [1.0]", "choose must have at most 8 items"),
        ('colour = "red"', "colour is not known"),
    ],
)
def test_a_wrong_plan_is_one_line(tmp_path, entry, message):
    lines = {
        "data": 'data = "appendix-c"',
        "leave_out": 'leave_out = "test"',
        "features": 'features = ["d3 of p_A"]',
        "ridge": "ridge = 1.0",
    }
    key = entry.split(" ")[0]
    lines[key] = entry
    if key == "choose":
        del lines["features"], lines["ridge"]
    plan = ("data", "leave_out", "permutations")
    table = [line for name, line in lines.items() if name in plan]
    detector = ['name = "x"', *(line for name, line in lines.items() if name not in plan)]
    text = "\n".join(['[campaign]\nname = "mine"\n[held_out]', *table, "[[held_out.detectors]]", *detector])
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load_plan(path)
