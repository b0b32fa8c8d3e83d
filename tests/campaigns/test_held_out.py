"""The logistic classifier against closed forms, and whole tests held out on the thesis's own sheet."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.optimize import minimize

from sealscope.campaigns.held_out import Samples, fit_logistic, held_out_scores
from sealscope.campaigns.held_out_plan import Logistic
from sealscope.campaigns.plan import load_plan
from sealscope.cli import campaign as words
from sealscope.errors import InputError


def cloud(seed, n=200, f=3):
    random = np.random.default_rng(seed)
    x = random.normal(size=(n, f)) * [1.0, 20.0, 0.1][:f]
    eta = 0.4 + x @ np.array([1.2, -0.05, 3.0][:f])
    return x, random.random(n) < 1.0 / (1.0 + np.exp(-eta))


def test_one_binary_feature_has_the_log_odds_ratio():
    """Without a ridge the fit is saturated: log odds of each half are those counted."""
    x = np.array([0.0] * 10 + [1.0] * 20)[:, None]
    y = np.array([True] * 3 + [False] * 7 + [True] * 15 + [False] * 5)
    fit = fit_logistic(x, y, 0.0)
    assert fit.log_odds(np.array([[0.0], [1.0]])) == pytest.approx([np.log(3 / 7), np.log(15 / 5)], abs=1e-9)


@pytest.mark.parametrize("ridge", [0.01, 1.0, 30.0])
def test_it_is_the_minimum_that_a_general_optimiser_finds(ridge):
    x, y = cloud(1)
    fit = fit_logistic(x, y, ridge)
    z = (x - x.mean(axis=0)) / x.std(axis=0)

    def loss(w):
        eta = w[0] + z @ w[1:]
        return np.logaddexp(0.0, np.where(y, -eta, eta)).sum() + 0.5 * ridge * (w[1:] ** 2).sum()

    best = minimize(loss, np.zeros(4), method="BFGS", options={"gtol": 1e-9})
    assert loss(np.r_[fit.intercept, fit.weights]) <= best.fun + 1e-9
    assert np.r_[fit.intercept, fit.weights] == pytest.approx(best.x, abs=1e-5)


def test_units_of_the_features_do_not_matter():
    x, y = cloud(2)
    plain = fit_logistic(x, y, 1.0).log_odds(x)
    assert fit_logistic(x * [1e5, 1e-3, 7.0] + [3.0, -2.0, 1e3], y, 1.0).log_odds(
        x * [1e5, 1e-3, 7.0] + [3.0, -2.0, 1e3]
    ) == pytest.approx(plain, abs=1e-7)


def test_what_cannot_be_fitted_is_one_line():
    x, y = cloud(3)
    with pytest.raises(InputError, match="both classes"):
        fit_logistic(x, np.ones(len(x), dtype=bool), 1.0)
    with pytest.raises(InputError, match="must vary"):
        fit_logistic(np.ones((len(x), 1)), y, 1.0)
    with pytest.raises(InputError, match="larger ridge"):
        fit_logistic(np.arange(10.0)[:, None], np.arange(10) > 4, 0.0)


def test_a_held_out_test_is_not_seen():
    """A feature that tells only which test a sample belongs to is worth nothing on a test held out, and everything
    otherwise."""
    random = np.random.default_rng(4)
    tests = np.repeat(np.arange(20), 2)
    leaks = np.tile([0.0, 1.0], 20)
    noise = random.normal(size=40)
    samples = Samples({"noise": noise}, leaks, list(tests), [{"condition": int(k % 4)} for k in tests])
    plan = Logistic("noise", ("noise",), 1.0)
    scores = held_out_scores(samples, plan, "test")
    moved = noise.copy()
    moved[0] += 100.0  # the first sample's own feature moves its own score and, through the fit, the other tests' ...
    other = held_out_scores(Samples({"noise": moved}, leaks, list(tests), samples.levels), plan, "test")
    assert other[1] == scores[1]  # ... but not that of the sample held out with it
    assert np.all(other[2:] != scores[2:])
    condition = held_out_scores(Samples({"noise": moved}, leaks, list(tests), samples.levels), plan, "condition")
    same = held_out_scores(samples, plan, "condition")
    together = [k for k in range(1, 40) if tests[k] % 4 == 0]
    assert np.array_equal(condition[together], same[together])


def test_an_unknown_feature_is_named():
    samples = Samples({"a": np.zeros(4)}, np.array([0.0, 1.0, 0.0, 1.0]), [1, 1, 2, 2], [{}] * 4)
    with pytest.raises(InputError, match="a feature must be one of a, got 'b'"):
        held_out_scores(samples, Logistic("x", ("b",), 1.0), "test")


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
    assert float(rates[name]["detected: rate"]) == pytest.approx(34 / 41)
    assert float(rates[name]["false alarms: rate"]) == pytest.approx(4 / 41)
    assert {"always fire", "never fire"} <= set(rates)
    assert "0.955" in capsys.readouterr().out
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("<figure>") >= 3


def test_without_the_sheet_it_says_what_it_needs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SEALSCOPE_SHEET", raising=False)
    with pytest.raises(InputError, match="needs the data sheet"):
        words.run("appendix-c", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ('data = "other"', "data must be one of appendix-c"),
        ('leave_out = "half"', "leave_out must be one of test, condition"),
        ("ridge = -1.0", "ridge must be >= 0, got -1"),
        ('features = "d3"', "features must be a list of names"),
        ('colour = "red"', "colour is not known"),
    ],
)
def test_a_wrong_plan_is_one_line(tmp_path, entry, told):
    lines = {
        "data": 'data = "appendix-c"',
        "leave_out": 'leave_out = "test"',
        "features": 'features = ["d3 of p_A"]',
        "ridge": "ridge = 1.0",
    }
    key = entry.split(" ")[0]
    lines[key] = entry
    table = [line for name, line in lines.items() if name in ("data", "leave_out")]
    detector = ['name = "x"', *(line for name, line in lines.items() if name not in ("data", "leave_out"))]
    text = "\n".join(['[campaign]\nname = "mine"\n[held_out]', *table, "[[held_out.detectors]]", *detector])
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told):
        load_plan(path)
