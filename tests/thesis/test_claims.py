"""Claims are judged by numbers: the same claim on other data gets another verdict, and the sheet's own get theirs."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from sealscope.recordings.channels import CHAMBERS
from sealscope.signals.details import QUANTITIES
from sealscope.thesis.chapters.chapter5 import TESTS, LeakTestMeasures
from sealscope.thesis.claims import detection as claims
from sealscope.thesis.claims import rig as claims_rig
from sealscope.thesis.claims import sheet as claims_sheet
from sealscope.thesis.claims.evidence import NO_SHEET, ClaimEvidence, is_correlated
from sealscope.thesis.engine.products import Claim, Product
from sealscope.thesis.sheet import DataSheet

from .conftest import ITEMS, Kept, made_sheet, needs_sheet, table_with

#: Log changes of a rig on which everything the thesis says of its columns is true.
AS_SAID = {("p_A", "d3"): -0.3, ("p_A", "d4"): -0.3, ("p_A", "d3d4"): -0.6}
AS_SAID |= {("p_B", "d3"): 0.3, ("p_B", "d4"): 0.3, ("p_B", "d3d4"): 0.6}


def made(seed: int, shifts: dict[tuple[str, str], float] | None = None) -> DataSheet:
    return made_sheet(seed, shifts, 0.03)


def one_shown(section: str, step_s: float | None = None) -> LeakTestMeasures:
    test = TESTS[section]
    rms = {chamber: {name: (2.0, 1.5) for name in QUANTITIES} for chamber in CHAMBERS}
    pairs = {chamber: (0.12, 0.118) for chamber in CHAMBERS}
    steps = {chamber: test.half + 1.0 if step_s is None else step_s for chamber in CHAMBERS}
    return LeakTestMeasures(rms, (14.0, 14.01), (0.04, 0.002), (17.0, 16.5), pairs, steps)


def evidence(measured: DataSheet | None, leak: DataSheet | None = None) -> ClaimEvidence:
    leak = leak or made(11, AS_SAID)
    return ClaimEvidence(
        measured,
        leak,
        made(12),
        made(13),
        table_with(leak, "appendix-c-leak", lambda row: 0.12 * (1 + row.closed_pct / 1000 * float(row.command[0]))),
        {section: one_shown(section) for section in TESTS},
        one_shown("5.2a"),
    )


def every_claim(of: ClaimEvidence) -> dict[str, Claim]:
    result = (
        *claims_sheet.claims(of),
        *claims_sheet.curve_claims(of),
        *claims_rig.claims(of),
    )
    return {claim.id: claim for claim in result}


@pytest.fixture(scope="module")
def said() -> dict[str, Claim]:
    return every_claim(evidence(made(14, AS_SAID)))


@pytest.fixture(scope="module")
def nothing() -> dict[str, Claim]:
    return every_claim(evidence(made(15)))


@pytest.fixture
def measured(measured_sheet: DataSheet) -> dict[str, Claim]:
    return every_claim(evidence(measured_sheet))


def test_ids_are_unique_and_every_part_is_told(said: dict[str, Claim]) -> None:
    of = evidence(made(14, AS_SAID))
    listed = [*claims_sheet.claims(of), *claims_sheet.curve_claims(of), *claims_rig.claims(of)]
    assert len({claim.id for claim in listed}) == len(listed)
    for claim in said.values():
        assert re.fullmatch(r"claim-[a1-6](\.\d+)+", claim.id)
        assert all((claim.where, claim.claim, claim.sheet, claim.simulation, claim.why)), claim.id


def test_the_same_rules_hold_on_a_sheet_that_does_as_said(said: dict[str, Claim]) -> None:
    holding = ["claim-5.5.1", "claim-5.5.5", "claim-5.3.1", "claim-5.4.1", "claim-5.6.1", "claim-5.6.2"]
    assert {name: said[name].verdict for name in holding} == dict.fromkeys(holding, "holds")
    assert {said[f"claim-5.2.{k}"].verdict for k in range(1, 21)} == {"holds"}


@pytest.mark.slow
def test_and_do_not_on_a_sheet_of_noise(nothing: dict[str, Claim]) -> None:
    assert nothing["claim-5.5.1"].verdict == "holds in part"  # that d1 and d2 do not move is true of it
    for name in ("claim-a.1", "claim-5.5.5", "claim-5.6.2", "claim-5.4.1", "claim-5.4.3", "claim-6.1.1"):
        assert nothing[name].verdict == "does not hold", name
    assert sum(nothing[f"claim-5.2.{k}"].verdict == "holds" for k in range(1, 21)) <= 3


@pytest.mark.slow
def test_without_the_sheet_its_claims_cannot_be_tested() -> None:
    of = every_claim(evidence(None))
    for name in ("claim-a.1", "claim-a.2", "claim-5.2.4", "claim-5.3.1", "claim-5.4.2", "claim-5.5.3", "claim-6.1.4"):
        assert (of[name].verdict, of[name].sheet) == ("cannot be tested", NO_SHEET), name
    assert of["claim-5.7.1"].verdict == "holds"


@needs_sheet
def test_verdicts_on_the_thesis_s_own_sheet(measured: dict[str, Claim]) -> None:
    verdicts = {
        "claim-a.2": "does not hold",  # 0.0042 L/min 85 % of the time
        "claim-5.4.1": "holds", "claim-5.4.2": "holds in part", "claim-5.4.3": "holds", "claim-5.4.4": "does not hold",
        "claim-5.4.5": "holds", "claim-5.4.6": "holds in part", "claim-5.4.7": "holds in part",
        "claim-5.5.1": "holds in part",  # d2 of P_A moves too, d4 of P_A no more than chance
        "claim-5.5.2": "does not hold",  # d3d4 is no surer than d3 or d4
        "claim-5.5.5": "holds in part", "claim-5.5.7": "does not hold",
        "claim-6.1.1": "does not hold",
    }  # fmt: skip
    assert {name: measured[name].verdict for name in verdicts} == verdicts
    assert "35/41" in measured["claim-5.5.1"].why
    assert "0.0047" in measured["claim-6.1.1"].sheet
    assert "+8.4 %" in measured["claim-a.2"].sheet
    assert "3/4" in measured["claim-a.2"].sheet


def test_leak_sizes_are_judged_by_the_conditions() -> None:

    result = {claim.id: claim for claim in claims_sheet.leak_level_claims()}
    assert result["claim-5.1.2"].verdict == "does not hold"
    assert result["claim-5.1.3"].verdict == "does not hold"
    assert "0.0163" in result["claim-5.1.3"].sheet
    assert "row 19" in result["claim-5.1.3"].why


@pytest.mark.long
@pytest.mark.slow
def test_the_drift_of_the_piston_is_laid_to_the_leak_only_where_the_control_drifts_on() -> None:
    of = evidence(None)
    assert every_claim(of)["claim-5.7.2"].verdict == "does not hold"
    drifting_on = replace(of, no_leak_measures=replace(one_shown("5.2a"), drift=(0.04, 0.04)))
    assert every_claim(drifting_on)["claim-5.7.2"].verdict == "holds"


@pytest.mark.slow
def test_the_onset_must_be_near_in_every_test() -> None:
    of = evidence(None)
    assert every_claim(of)["claim-5.7.4"].verdict == "holds"
    one_late = replace(of, test_measures={**of.test_measures, "5.5d": one_shown("5.5d", step_s=20.0)})
    late = every_claim(one_late)["claim-5.7.4"]
    assert late.verdict == "does not hold"
    assert "9/10" in late.simulation


@pytest.mark.long
@pytest.mark.slow
def test_throttles_raise_the_range_where_they_do() -> None:
    assert every_claim(evidence(None))["claim-6.1.3"].verdict == "holds"
    flat = evidence(None)
    rows = tuple((*row[:5], 0.12, 0.12, *row[7:]) for row in flat.leak_table.rows)
    weakened = every_claim(replace(flat, leak_table=replace(flat.leak_table, rows=rows)))["claim-6.1.3"]
    assert weakened.verdict != "holds"


def test_correlations_of_41_points_differ_from_zero_above_0_31() -> None:
    assert not is_correlated(0.30, 41)
    assert is_correlated(-0.32, 41)
    assert not is_correlated(0.32, 41, controls=5)


def test_the_table_of_claims_gathers_all_chapters_in_order() -> None:
    def claim(name: str, verdict: str) -> Claim:
        return Claim(name, "there", "so it is", "a", "b", verdict, "because")  # type: ignore[arg-type]

    products: dict[str, tuple[Product | Claim, ...]] = {
        "chapter-3-claims": (claim("claim-3.2", "holds"),),
        "chapter-4-claims": (claim("claim-4.10", "holds"), claim("claim-4.2", "does not hold")),
        "detection-claims": (claim("claim-5.1.1", "holds in part"), claim("claim-a.1", "holds")),
        "chapter-6-claims": (),
    }

    table, verdicts = claims.claims_tables(Kept(products), ITEMS["claims"])  # type: ignore[arg-type]
    assert [row[0] for row in table.rows] == ["claim-a.1", "claim-3.2", "claim-4.2", "claim-4.10", "claim-5.1.1"]
    assert dict(verdicts.rows) == {"holds": 3, "holds in part": 1, "does not hold": 1, "cannot be tested": 0}
    assert "not given" in table.notes
