"""Appendix C simulated: with the leak, with nothing, and with drift alone (on two conditions and short records)."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sealscope.recordings.channels import CHAMBERS
from sealscope.signals.details import QUANTITIES
from sealscope.thesis.chapters import appendix_c
from sealscope.thesis.chapters import appendix_c_runs as simulation
from sealscope.thesis.chapters.appendix_c_runs import draw_drifts, parse_sheet
from sealscope.thesis.engine.products import Claim, Product, ThesisTable
from sealscope.thesis.sheet import APPENDIX_C, DataSheet

from .conftest import ITEMS, Kept, made_sheet, table_with

RUNS = ("appendix-c-leak", "appendix-c-no-leak", "appendix-c-drift")
TWO = (APPENDIX_C[10], APPENDIX_C[11], APPENDIX_C[39])


@pytest.fixture(scope="module")
def tables() -> dict[str, tuple[ThesisTable, ...]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "APPENDIX_C", TWO)
        patch.setattr(simulation, "QUICK_HALF", 15.0)
        context = Kept()
        return {name: simulation.runs_table(context, ITEMS[name]) for name in RUNS}  # type: ignore[arg-type]


def test_a_table_reads_back_as_the_sheet_it_holds(tables: dict[str, tuple[ThesisTable, ...]]) -> None:
    (table,) = tables["appendix-c-leak"]
    sheet = parse_sheet(table)
    row = dict(zip(table.columns, table.rows[2], strict=True))
    assert row["test"] == 40
    assert row["mean leak [L/min]"] == pytest.approx(0.0163, rel=0.01)
    assert sheet.rms["p_B"]["d4"][2].tolist() == [row["p_B d4 no leak [psi]"], row["p_B d4 leak [psi]"]]
    assert sheet.rms["p_A"]["d3d4"][2, 1] == row["p_A d3d4 leak [psi^2]"]


def test_the_same_condition_gives_the_same_truth_and_other_noise(tables: dict[str, tuple[ThesisTable, ...]]) -> None:
    sheet = parse_sheet(tables["appendix-c-no-leak"][0])
    first, second = (sheet.rms["p_A"]["d1"][k] for k in (0, 1))
    assert np.all(first != second)
    np.testing.assert_allclose(first, second, rtol=0.05)
    ranges = simulation.column(tables["appendix-c-no-leak"][0], "p_A range [MPa]")
    assert ranges[0] == ranges[1] != ranges[2]


def test_nothing_moves_without_a_leak_beyond_the_noise_of_the_estimate(
    tables: dict[str, tuple[ThesisTable, ...]],
) -> None:
    sheet = parse_sheet(tables["appendix-c-no-leak"][0])
    for chamber in CHAMBERS:
        assert np.abs(sheet.log_change(chamber, "d1")).max() < 0.05  # 7500 samples: deviation about 1 % a difference
        assert np.abs(sheet.log_change(chamber, "d3")).max() < 0.25


def test_a_drift_moves_the_noise_as_drawn(tables: dict[str, tuple[ThesisTable, ...]]) -> None:
    sheet = parse_sheet(tables["appendix-c-drift"][0])
    drawn = [np.log1p(moved(condition.number)["sensors.common_noise"]) for condition in TWO]
    found = np.mean([sheet.log_change(chamber, "d1") for chamber in CHAMBERS], axis=0)
    np.testing.assert_allclose(found, drawn, atol=0.03)  # deviation under 1 % where both chambers are averaged
    assert all("friction x" in str(row[3]) for row in tables["appendix-c-drift"][0].rows)


def moved(number: int, draw: int = 0) -> dict[str, float]:
    """By what share each parameter of a test that drifts at 9 s has moved after it; before, none has."""
    drifts = draw_drifts(number, 9.0, draw)
    assert [drift.shape.value_at(np.array(8.999)) for drift in drifts] == [0.0] * len(drifts)
    return {drift.parameter: float(drift.shape.value_at(np.array(9.0))) for drift in drifts}


def test_drifts_keep_within_their_bounds_and_go_both_ways() -> None:
    drifts = [moved(number, draw) for number in range(1, 42) for draw in range(3)]
    friction, bulk, *noises = np.array([list(shares.values()) for shares in drifts]).T
    assert list(drifts[0]) == [
        "friction", "fluid.K_oil", "sensors.common_noise", "sensors.p_A.noise", "sensors.p_B.noise",
    ]  # fmt: skip
    assert np.all((np.abs(friction) >= 0.04) & (np.abs(friction) <= 0.08))
    assert np.allclose(np.abs(bulk), 0.03)
    assert np.allclose(np.abs(noises[0]), 0.04)
    assert np.array_equal(noises[0], noises[1])
    assert np.array_equal(noises[0], noises[2])
    assert 0.35 < np.mean(friction > 0) < 0.65
    assert moved(7, 1) == moved(7, 1) != moved(7, 2)


def full_table(sheet: DataSheet, item: str) -> ThesisTable:
    return table_with(sheet, item, lambda condition: 0.1)


@pytest.mark.parametrize("given", [True, False], ids=["with sheet", "without sheet"])
def test_the_appendix_stands_beside_the_sheet_where_there_is_one(given: bool) -> None:
    everywhere = dict.fromkeys(itertools.product(CHAMBERS, QUANTITIES), -0.2)
    measured = made_sheet(1, everywhere, 0.01)
    twice = DataSheet({c: {q: 2.0 * pairs for q, pairs in of.items()} for c, of in measured.rms.items()})
    leak = full_table(twice, "appendix-c-leak")
    still = full_table(made_sheet(2, scatter=0.01), "appendix-c-no-leak")
    products: dict[str, tuple[Product | Claim, ...]] = {"appendix-c-leak": (leak,), "appendix-c-no-leak": (still,)}
    context = Kept(products, measured if given else None)
    summary, of_a, of_b = appendix_c.agreement_tables(context, ITEMS["appendix-c"])  # type: ignore[arg-type]
    assert (summary.id, of_a.id, of_b.id) == ("appendix-c", "appendix-c-pa", "appendix-c-pb")
    assert (len(summary.rows), len(of_a.rows), len(of_b.rows)) == (10, 41, 41)
    first = dict(zip(summary.columns, summary.rows[0], strict=True))
    assert first["leak-free RMS, simulated / measured"] == (pytest.approx(2.0) if given else None)
    assert first["tests with the same sign of change [of 41]"] == (41 if given else None)
    row = dict(zip(of_b.columns, of_b.rows[4], strict=True))
    pair = twice.rms["p_B"]["d3"][4]
    assert row["d3 diff, simulated [%]"] == pytest.approx(100 * (pair[1] / pair[0] - 1))
    assert row["d3 no leak, measured [psi]"] == (pytest.approx(pair[0] / 2) if given else None)

    (figure,) = appendix_c.difference_figure(context, ITEMS["fig-5.90"])  # type: ignore[arg-type]
    roles = [curve.role for curve in figure.panels[0].curves]
    assert roles == [*(["measured"] if given else []), "simulated", "no leak", "reference"]
    counts = {number.name: number.value for number in figure.numbers}
    assert counts["simulated: tests that go down"] == "41 of 41"
    assert figure.resolved is True


@pytest.mark.slow
@pytest.mark.long
def test_the_thesis_s_rule_fires_like_a_coin_where_nothing_leaks() -> None:
    context = Kept()
    still = parse_sheet(simulation.runs_table(context, ITEMS["appendix-c-no-leak"])[0])  # type: ignore[arg-type]
    drift = parse_sheet(simulation.runs_table(context, ITEMS["appendix-c-drift"])[0])  # type: ignore[arg-type]
    leak = parse_sheet(simulation.runs_table(context, ITEMS["appendix-c-leak"])[0])  # type: ignore[arg-type]
    for sheet in (still, drift):  # beyond 9 to 32 one column in 4000 of coins
        for chamber in CHAMBERS:
            assert 9 <= np.sum(sheet.log_change(chamber, "d1") < 0) <= 32, chamber
        assert 9 <= np.sum(sheet.log_change("p_A", "d3") < 0) <= 32
    assert np.sum(leak.log_change("p_A", "d3") < 0) >= 35
    assert leak.log_change("p_A", "d3").mean() < -5 * abs(still.log_change("p_A", "d3").mean())
