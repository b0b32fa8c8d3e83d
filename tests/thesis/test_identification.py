"""The calibration: its forward model against sampled noise, recovery of known parameters, and the figures it must reach
against the thesis's own sheet where that is present."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.chambers import CHAMBERS
from sealscope.signals.details import Transform, details
from sealscope.thesis.conditions import APPENDIX_C, Condition, experiment_values, groups
from sealscope.thesis.engine.context import RunSpec, SimulatedRun
from sealscope.thesis.engine.products import Claim, Product
from sealscope.thesis.identification.fit import ITEMS, Calibration, fit, leak_free, predict_leaks, residuals
from sealscope.thesis.identification.forward import (
    QUANTITIES,
    best_noise,
    by_test,
    log_rms,
    noise_free,
    noise_of,
    own_noise,
)
from sealscope.thesis.identification.hypotheses import Hypothesis, outcome
from sealscope.thesis.identification.rig_file import rig_toml, write_rig
from sealscope.thesis.identification.search import Budget, Free
from sealscope.thesis.identification.tables import fit_table, parameters
from sealscope.thesis.sheet import Sheet, read_sheet

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
needs_sheet = pytest.mark.skipif(not (DATA / "appendix_c_pa.csv").is_file(), reason="the thesis's data sheet is absent")

#: A small bench to recover: three conditions, one of them twice.
BENCH = tuple(
    Condition(k, command, closed, 0.01, "small")
    for k, (command, closed) in enumerate(
        [("3 sin(4t)", 0.0), ("7 sin(4t)", 50.0), ("5 sin(2t)", 0.0), ("3 sin(4t)", 0.0)], start=1
    )
)
TRUTH = {"K_oil": 150e6, "omega_per_volt": 12.0, "V_1": 30e-6, "V_2": 30e-6, "orifices": "present"}
FREE = (Free(("fluid.K_oil",), 230e6, 60e6, 600e6), Free(("motor.omega_per_volt",), 9.0, 5.0, 20.0))
COMMON: dict[str, float | str] = {"line.orifices": "present", "line.V_1": 30e-6, "line.V_2": 30e-6}
NOISE = {"p_A": 1.2, "p_B": 1.6}


@dataclass(frozen=True)
class Asked:
    """A context of the reproduction with a sheet, or none, and nothing simulated."""

    sheet: Sheet | None
    quick: bool = True

    def run(self, spec: RunSpec) -> SimulatedRun:
        raise AssertionError(spec)

    def product(self, item: str) -> tuple[Product | Claim, ...]:
        raise AssertionError(item)


def bench_rig(rate: float = 500.0) -> Rig:
    rig = load_rig("thesis").with_overrides({**TRUTH, "daq.sample_rate": rate})
    return rig.with_overrides({f"sensors.{c}.noise": own_noise(rig, c, sigma) for c, sigma in NOISE.items()})


def sheet_from(rig: Rig, conditions: tuple[Condition, ...] = BENCH) -> Sheet:
    """The leak-free columns that the rig makes; the leak columns are not numbers, so that reading them would show."""
    squares = by_test(noise_free(rig, groups(conditions)), conditions)
    rms = {c: np.exp(log_rms(squares[:, k], noise_of(rig, c))) for k, c in enumerate(CHAMBERS)}
    gone = np.full(len(conditions), np.nan)
    return Sheet({c: {q: np.stack([rms[c][:, j], gone], axis=1) for j, q in enumerate(QUANTITIES)} for c in CHAMBERS})


@cache
def recovered() -> Calibration:
    """The bench fitted from a wrong start."""
    return fit(
        sheet_from(bench_rig()), free=FREE, rates=(500.0,), common=COMMON, conditions=BENCH, budget=Budget(8, 40)
    )


def test_conditions_are_the_tests_of_the_appendix() -> None:
    assert len(APPENDIX_C) == 41
    assert [one.number for one in APPENDIX_C] == list(range(1, 42))
    assert len(groups()) == 15
    assert min(one.mean_leak_lpm for one in APPENDIX_C) == 0.0042
    assert max(one.mean_leak_lpm for one in APPENDIX_C) == 0.0185


@pytest.mark.parametrize("closed", [0.0, 25.0, 50.0, 75.0])
def test_a_condition_sets_both_throttles_alike_and_leaves_an_open_line_to_the_rig(closed: float) -> None:
    values = experiment_values(Condition(1, "3 sin(4t)", closed, 0.01, "small"))
    for orifices in ("absent", "present"):
        rig = load_rig("thesis").with_overrides({"orifices": orifices}).with_overrides(values)
        assert rig.line.closed_A == rig.line.closed_B == pytest.approx(closed / 100)
        assert rig.line.orifices == ("present" if closed else orifices)


@pytest.mark.parametrize("transform", ["stationary", "decimated", "reconstructed"])
def test_noise_added_by_its_mean_square_is_what_sampled_noise_gives(transform: Transform) -> None:
    n, sigma = 80_000, 1.3
    t = np.arange(n) / 500.0
    ringing = 6.0 * np.sin(2 * np.pi * 28.0 * t) * (1.0 + 0.8 * np.sin(2 * np.pi * 0.5 * t))

    def squares(signal: np.ndarray) -> np.ndarray:
        d = np.square(details(signal, transform=transform).values[:, 300:-300])
        return np.array([*d.mean(axis=1), np.mean(d[2] * d[3])])

    noisy = ringing + sigma * np.random.default_rng(4).standard_normal(n)
    drawn = 0.5 * np.log(squares(noisy))
    np.testing.assert_allclose(log_rms(squares(ringing), sigma, transform), drawn, atol=0.02)


def test_best_noise_finds_the_noise_put_in() -> None:
    squares = np.random.default_rng(1).uniform(0.0, 9.0, (20, 5))
    assert best_noise(squares, log_rms(squares, 1.37)) == pytest.approx(1.37, rel=1e-4)


def test_a_channels_own_noise_and_its_total_are_inverse() -> None:
    rig = bench_rig()
    assert {c: noise_of(rig, c) for c in CHAMBERS} == pytest.approx(NOISE)
    with pytest.raises(InputError, match=r"noise must be > 0\.8\d* psi .*got 0.5"):
        own_noise(rig, "p_A", 0.5)


def test_fit_recovers_parameters_and_noise_without_the_leak_columns() -> None:
    best = recovered().best
    assert best.settings["fluid.K_oil"] == pytest.approx(150e6, rel=0.02)
    assert best.settings["motor.omega_per_volt"] == pytest.approx(12.0, rel=0.03)
    assert best.noise == pytest.approx(NOISE, rel=0.02)
    assert best.misfit < 0.03


def test_intervals_hold_the_truth_and_left_out_conditions_fit() -> None:
    found = recovered()
    low, high = found.intervals["fluid.K_oil"]
    assert low < found.best.settings["fluid.K_oil"] < high
    assert high / low < 1.5
    assert low / 1.02 < 150e6 < high * 1.02
    assert found.held_out < 0.15


def test_intervals_widen_with_a_condition_that_disagrees() -> None:
    sheet = sheet_from(bench_rig())
    for chamber in CHAMBERS:
        sheet.rms[chamber]["d4"][1] *= 2.0
    spoilt = fit(sheet, free=FREE, rates=(500.0,), common=COMMON, conditions=BENCH, budget=Budget(4, 25))
    width = {
        key: [np.log(of.intervals[key][1] / of.intervals[key][0]) for of in (recovered(), spoilt)]
        for key in ("motor.omega_per_volt", "noise.p_A")
    }
    assert width["motor.omega_per_volt"][1] > 2 * width["motor.omega_per_volt"][0]
    assert spoilt.best.misfit > recovered().best.misfit


def test_the_sampling_rate_is_told_by_the_leak_free_columns() -> None:
    found = fit(
        sheet_from(bench_rig(1000.0)),
        free=(replace(FREE[0], start=150e6, lo=100e6), replace(FREE[1], start=12.0)),
        rates=(500.0, 1000.0),
        common=COMMON,
        conditions=BENCH,
        budget=Budget(4, 12),
    )
    assert found.best.rate == 1000.0
    assert found.trials[1].misfit > 2 * found.best.misfit


def test_a_calibration_as_a_file_is_the_same_rig(tmp_path: Path) -> None:
    found, base = recovered(), load_rig("thesis")
    path = tmp_path / "fitted.toml"
    write_rig(found, base, path)
    loaded, wanted = load_rig(path), found.rig(base)
    for row in wanted.table():
        if row.name not in ("sensors.p_1.noise", "sensors.p_2.noise"):
            assert loaded[row.name] == (
                pytest.approx(row.value, rel=1e-3) if isinstance(row.value, float) else row.value
            )
    assert loaded["sensors.p_1.noise"] == loaded["sensors.p_A.noise"]
    assert "95 %" in loaded.entry("fluid.K_oil").source
    tree = tomllib.loads(rig_toml(found, base))
    assert tree.pop("rig")["extends"] == "thesis"
    assert set(tree) == {"motor", "line", "fluid", "sensors", "daq"}


def test_a_sheet_of_other_tests_and_a_box_without_a_rig_are_refused() -> None:
    sheet = sheet_from(bench_rig())
    with pytest.raises(InputError, match="the sheet must have 41 rows, got 4"):
        fit(sheet, free=FREE, rates=(500.0,), common=COMMON)
    beyond = (Free(("motor.omega_per_volt",), 300.0, 250.0, 400.0),)
    with pytest.raises(SimulationFailed, match="no settings within the bounds"):
        fit(sheet, free=beyond, rates=(500.0,), common=COMMON, conditions=BENCH, budget=Budget(1, 2))


def test_a_sensor_that_reads_less_lowers_its_own_chamber_only() -> None:
    one = BENCH[:1]
    rig = bench_rig()
    plain, less = (outcome(rig, Hypothesis("", gain_B=gain), one).sheet for gain in (1.0, 0.5))
    assert np.array_equal(plain.rms["p_A"]["d4"], less.rms["p_A"]["d4"])
    sigma = NOISE["p_B"]
    without = [np.sqrt(of.rms["p_B"]["d4"][0, 0] ** 2 - sigma**2) for of in (plain, less)]
    assert without[1] == pytest.approx(0.5 * without[0], rel=1e-6)


@needs_sheet
def test_the_calibrated_rig_meets_the_leak_free_columns_within_a_quarter() -> None:
    """Geometric mean of simulated/measured for each of d1..d4 in both chambers within 25 %."""
    sheet, _ = read_sheet(DATA)
    ratio = np.exp(residuals(load_rig("thesis-calibrated"), sheet).mean(axis=0))
    assert ratio.shape == (2, 5)
    assert np.all(np.abs(ratio[:, :4] - 1.0) <= 0.25), ratio
    printed = np.exp(residuals(load_rig("thesis"), sheet).mean(axis=0))
    assert np.any(np.abs(printed[:, :4] - 1.0) > 0.25), "the rig as printed does not fit, so the check can fail"


@needs_sheet
@pytest.mark.slow
def test_the_sign_of_d3_on_p_A_is_predicted_from_leak_free_data() -> None:
    """At least 39 of 41, with leak columns that the fit never saw."""
    sheet, _ = read_sheet(DATA)
    made = predict_leaks(load_rig("thesis-calibrated"))
    change, real = (np.log(of.rms["p_A"]["d3"][:, 1] / of.rms["p_A"]["d3"][:, 0]) for of in (made, sheet))
    assert np.sum(np.sign(change) == np.sign(real)) >= 39
    assert np.corrcoef(change, real)[0, 1] > 0.6
    # the size is predicted too small, about half (docs/decisions/0006-calibration.md)
    assert 0.35 < np.mean(change) / np.mean(real) < 0.65


@needs_sheet
def test_only_the_leak_free_columns_are_read() -> None:
    sheet, _ = read_sheet(DATA)
    blind = Sheet(
        {c: {q: np.stack([v[:, 0], np.full(41, np.nan)], axis=1) for q, v in of.items()} for c, of in sheet.rms.items()}
    )
    assert np.array_equal(leak_free(sheet), leak_free(blind))


def test_the_tables_of_the_calibration_show_every_fitted_value_with_its_interval() -> None:
    table = parameters(Asked(None), ITEMS[0])[0]
    values = {row[0]: row for row in table.rows}
    assert {"fluid.K_oil", "motor.omega_per_volt", "line.V_1", "line.V_2", "sensors.p_A.noise"} <= set(values)
    assert all(
        "95 %" in str(row[-1])
        for name, row in values.items()
        if str(row[-1]).startswith("fitted") and name != "daq.sample_rate"
    )


@needs_sheet
def test_the_table_of_the_fit_has_every_condition_once() -> None:
    summary, by_condition = fit_table(Asked(read_sheet(DATA)[0]), ITEMS[1])
    assert [row[:2] for row in summary.rows] == [(c, q) for c in CHAMBERS for q in QUANTITIES]
    assert sum(int(str(row[2])) for row in by_condition.rows) == 41
    weights = np.array([float(str(row[2])) for row in by_condition.rows])
    logs = np.log(np.array([row[3:] for row in by_condition.rows], dtype=float))
    np.testing.assert_allclose(np.exp(weights @ logs / 41), [row[2] for row in summary.rows], rtol=1e-9)  # type: ignore[arg-type]
