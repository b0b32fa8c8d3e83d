"""Section 6.2: the studies' measures against closed forms, and the claims against tables made up for them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sealscope.thesis.chapters import chapter6
from sealscope.thesis.claims.chapter6 import ITEMS, claims
from sealscope.thesis.engine.products import Figure, ThesisTable


def test_an_amplitude_is_found_beside_a_drift():
    t = np.arange(4000) / 500.0
    values = 3.0 * np.sin(2 * math.pi * 0.5 * t + 0.4) + 7.0 - 2.0 * t
    found = chapter6.amplitude_at(t, values, 0.5)
    assert abs(found) == pytest.approx(3.0, rel=1e-9)


def test_a_leak_has_its_size_under_the_load():
    rig = chapter6._rig()
    G = chapter6.conductance(0.5, rig)
    assert pytest.approx(0.5) == G * chapter6.LOAD / rig.cylinder.A_A * 6e4


def test_stiffness_falls_with_a_leak_and_comes_back():
    healthy, fixed, tolerant = (
        chapter6.stiffness(name, lpm) for name, lpm in (("pi", 0.0), ("pi", 0.5), ("fault-tolerant", 0.5))
    )
    assert fixed < 0.5 * healthy
    assert tolerant > 0.9 * healthy


class Given:
    """A context that holds tables made up."""

    quick = True

    def __init__(self, **changed: float) -> None:
        size = {"fixed": 0.05, "tolerant": 0.05, "stiff": 6000.0, "unharmed": 0.05, "drift": 0.01} | changed
        rows = [
            ("pi", 0.0, 0.05, 20.0, 50.0, 6000.0, 0.0),
            ("pi", 0.5, size["fixed"], 20.0, 50.0, 1500.0, 0.0),
            ("fault-tolerant", 0.0, size["unharmed"], 20.0, 50.0, 6000.0, 0.0),
            ("fault-tolerant", 0.5, size["tolerant"], 20.0, 50.0, size["stiff"], 0.5),
        ]
        self.tables = {
            "sec-6.2-controllers": ThesisTable("c", "", chapter6.COLUMNS, tuple(rows)),
            "sec-6.2-open-loop": ThesisTable(
                "o", "", ("",) * 6, ((0.0, 38.0, -8.0, 0.0, 0.0, 0.0), (0.5, 37.0, -800.0, -790.0, size["drift"], 0.0))
            ),
            "sec-6.2-load": ThesisTable("l", "", ("",) * 13, ((0.0, *[0.02] * 12), (2000.0, *[0.05] * 12))),
        }

    def product(self, item: str):
        return (Figure(f"{item}-figure", "", ()), self.tables[item])


@pytest.mark.parametrize(
    ("changed", "verdicts"),
    [
        ({}, ("holds", "holds", "does not hold", "cannot be tested")),
        ({"drift": 5.0}, ("does not hold", "holds", "does not hold", "cannot be tested")),
        ({"tolerant": 0.08}, ("holds", "holds in part", "does not hold", "cannot be tested")),
        ({"stiff": 2000.0}, ("holds", "holds in part", "does not hold", "cannot be tested")),
        ({"unharmed": 0.051}, ("holds", "holds in part", "does not hold", "cannot be tested")),
    ],
)
def test_claims_follow_their_tables(changed, verdicts):
    judged = claims(Given(**changed), ITEMS[0])
    assert tuple(claim.verdict for claim in judged) == verdicts


@pytest.mark.slow
def test_the_tables_are_made():
    class Quick:
        quick = True

    by_id = {item.id: item for item in chapter6.ITEMS}
    table, figure = chapter6.controllers_table(Quick(), by_id["sec-6.2-controllers"])
    assert len(table.rows) == 2 * len(chapter6.CONTROLLERS)
    assert len(figure.panels) == 2
    (opened,) = chapter6.open_loop_table(Quick(), by_id["sec-6.2-open-loop"])
    assert abs(opened.rows[1][3]) > 600.0
    assert abs(opened.rows[1][4]) < 0.1
