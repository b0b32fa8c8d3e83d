"""What leaves a circuit empties its accumulator: oil that is lost outside is told from a leak past the piston."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.circuit.without_position import oil_loss_tests
from sealscope.diagnosis.inference.equations.terms import Signals
from sealscope.parameters import Rig, load_rig
from sealscope.units import P_ATM

RATE, SECONDS, CYCLE = 100.0, 120.0, 3.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("single-rod-eha")


def signals(rig: Rig, lost: float) -> Signals:
    """A holds a load; B is the accumulator's, which gives what the rod leaves and, from 60 s on, `lost` [m^3/s]."""
    t = np.arange(int(RATE * SECONDS)) / RATE
    noise = np.random.default_rng(4)
    x = 0.05 * np.sin(2.0 * np.pi * t / CYCLE)
    makeup, cylinder = rig.makeup, rig.cylinder
    given = (cylinder.A_A - cylinder.A_B) * x + lost * np.maximum(t - 60.0, 0.0)
    charge = rig.fluid.p_charge + P_ATM
    p_B = charge * (1.0 + given / makeup.V_gas) ** -makeup.n_gas - P_ATM
    p_A = np.full_like(t, 2e6)
    own = {"x": x, "p_A": p_A + noise.normal(0.0, 1e3, t.size), "p_B": p_B + noise.normal(0.0, 1e3, t.size)}
    return Signals(own, RATE, {})


def test_what_is_lost_is_known_to_some_thousandths_of_a_litre(rig: Rig) -> None:
    """The size of a step at its onset is what was lost, over the pressure that drove it."""
    lost = 0.01 / 6e4
    test = oil_loss_tests(signals(rig, lost), rig, CYCLE, 0.0)["external leak A"]
    assert test.chance < 0.01
    assert abs(test.onset().value - 60.0) < 8.0
    at = int(np.abs(test.onsets - 60.0).argmin())
    assert test.size[at] * 2e6 == pytest.approx(lost, rel=0.1)
    assert test.deviation[at] * 2e6 * 6e4 < 5e-3


def test_what_stays_in_the_circuit_is_not_lost(rig: Rig) -> None:
    for test in oil_loss_tests(signals(rig, 0.0), rig, CYCLE, 0.0).values():
        assert test.chance > 0.01


def test_without_an_accumulator_nothing_is_told(rig: Rig) -> None:
    assert oil_loss_tests(signals(rig, 1e-7), load_rig("thesis"), CYCLE, 0.0) == {}
