"""Pressures and command alone: the whole response, against closed forms and records whose parameters are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sealscope as ss
from sealscope.diagnosis.inference.blocks import Information
from sealscope.diagnosis.inference.onset import step_test
from sealscope.diagnosis.inference.pressures.evidence import eliminated
from sealscope.diagnosis.inference.pressures.response import (
    C_C,
    F_C,
    F_V,
    GAIN,
    K_BRK,
    K_OIL,
    SIDE,
    G,
    Path,
    Simulator,
    beliefs_of,
    evidence,
)
from sealscope.parameters import load_rig

from .ringing import step_of

THESIS = load_rig("thesis")
BELIEFS = beliefs_of(THESIS, 6e5)
RATE = 500.0


@settings(max_examples=8)
@given(st.floats(1.0, 8.0), st.booleans(), st.floats(0.0, 2e-12), st.floats(-0.2, 0.2))
def test_steady_sliding_balances_friction_pressure_and_flow(
    volts: float, backward: bool, conductance: float, side: float
) -> None:
    theta, sense = BELIEFS.centre.copy(), -1.0 if backward else 1.0
    theta[[G, SIDE, F_V]] = conductance, side, 2e3  # so much that nothing rings by itself
    simulator = Simulator.of(np.full(60_000, sense * volts), RATE, THESIS)  # the speed loop settles within 100 s
    dp = float(np.mean(simulator.run(theta[None, None], np.zeros(60_000, dtype=np.int64))[-200:, 0]))
    m = simulator.numbers
    v = (m.q_b / (2.0 * math.pi) * sense * theta[GAIN] * volts - conductance * dp) / m.A_A
    friction = sense * theta[F_C] * (1.0 + (theta[K_BRK] - 1.0) * math.exp(-theta[C_C] * abs(v))) + theta[F_V] * v
    assert m.A_A * dp == pytest.approx(friction * (1.0 + sense * side), rel=0.02)


@given(st.integers(0, 100), st.integers(1, 4), st.integers(1, 5))
def test_elimination_is_marginalisation(seed: int, kept: int, others: int) -> None:
    random, n = np.random.default_rng(seed), kept + others
    root = random.normal(size=(n, n + 2))
    H, right = root @ root.T, random.normal(size=n)
    own = random.permutation(n)[:kept]
    precision, vector = eliminated(H, right, own)
    covariance = np.linalg.inv(H)
    np.testing.assert_allclose(np.linalg.inv(precision), covariance[np.ix_(own, own)], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(precision, vector), (covariance @ right)[own], rtol=1e-5, atol=1e-7)


def test_a_path_that_made_the_record_is_found_again() -> None:
    blocks, length, step = 6, 2000, 1e-12
    edges = length * np.arange(blocks + 1)
    t = np.arange(edges[-1]) / RATE
    simulator = Simulator.of(3.0 * np.sin(4.0 * t), RATE, THESIS)
    true = np.tile(BELIEFS.centre, (blocks, 1))
    true[:, F_C] *= 1.0 + 0.02 * np.linspace(-1.0, 1.0, blocks)
    true[blocks // 2 :, G] += step
    block = np.repeat(np.arange(blocks), length)
    dp = simulator.run(true[None], block)[:, 0] + np.random.default_rng(3).normal(0.0, 4e3, t.size)
    path = Path(simulator, dp, edges, length / RATE, BELIEFS)
    start = true * 1.0
    start[:, G] = BELIEFS.centre[G]
    start[:, F_V] *= 1.05
    found, left, _ = path.descend(start, 12)
    assert np.std(left) == pytest.approx(4e3, rel=0.03)
    rises = found[blocks // 2 :, G].mean() - found[: blocks // 2, G].mean()
    assert rises == pytest.approx(step, rel=0.5)
    np.testing.assert_allclose(found[:, K_OIL], true[:, K_OIL], rtol=0.01)


@pytest.fixture(scope="module")
def leaking() -> tuple[ss.Recording, float]:
    """A record of the thesis's rig, 0.02 L/min from mid-record on."""
    recording = ss.simulate(rig="thesis", command="3 sin(4t)", duration=80.0, leak="0.02 L/min from 40 s", seed=5)
    return recording.only(("u", "p_A", "p_B")), 0.02


def test_a_leak_of_a_simulated_rig_is_found_where_it_began_and_its_interval_holds(
    leaking: tuple[ss.Recording, float],
) -> None:
    recording, lpm = leaking
    found = evidence(recording, THESIS)
    scaled = Information(found.information.time, found.information.precision * 1e-24, found.information.vector * 1e-12)
    test = step_test(scaled)
    assert test.chance < 1e-3
    assert test.onset().low <= 40.0 <= test.onset().high
    low, high = found.flow(*(1e-12 * value for value in test.fitted))[1]
    assert low <= lpm <= high


def test_information_is_symmetric_and_no_less_than_none(leaking: tuple[ss.Recording, float]) -> None:
    information = evidence(leaking[0], THESIS).information
    precision = information.precision
    np.testing.assert_allclose(precision, precision.T)
    assert np.linalg.eigvalsh(precision)[0] > -1e-6 * np.linalg.eigvalsh(precision)[-1]
    step, deviation = step_of(information, 40.0)
    assert step > 4.0 * deviation > 0.0


@pytest.mark.parametrize("rig", ["servo-valve", "single-rod-eha"])
def test_other_circuits_are_left_to_other_providers(rig: str, leaking: tuple[ss.Recording, float]) -> None:
    assert evidence(leaking[0].between(0.0, 20.0), load_rig(rig)) is None
