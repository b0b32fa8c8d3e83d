"""The fit of pressures in motion: its solution, standard errors, and what the motion does not determine."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inference.changes.motion_fit import (
    GROUPS,
    equal_parts,
    fit_difference,
    jackknife_errors,
    select_motion,
    solve_weighted,
    stack_equations,
)
from sealscope.recordings.recording import Recording

RATE = 50.0


@pytest.mark.parametrize("rank", ["full", "too low"])
def test_the_factor_solves_as_all_rows_do(rank: str) -> None:
    """The bins of the position add up to the sign of a motion in one direction: the shortest solution is taken."""
    rng = np.random.default_rng(0)
    speed = rng.normal(size=500) if rank == "full" else rng.uniform(0.5, 1.0, 500)
    bins = np.eye(6)[rng.integers(0, 6, 500)]
    design = np.column_stack([np.sign(speed), np.linspace(-0.5, 0.5, 500), speed, bins])
    assert (np.linalg.matrix_rank(design) == design.shape[1]) == (rank == "full")
    values, weight = 1e5 * rng.normal(size=500), rng.uniform(0.0, 1.0, 500)
    expected = np.linalg.lstsq(design * weight[:, None], values * weight, rcond=None)[0]
    found = solve_weighted(stack_equations(design, values), weight)
    assert found == pytest.approx(expected, rel=1e-11, abs=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("n_groups", [3, GROUPS, 3 * GROUPS])
def test_errors_are_those_of_fits_without_one_group_each(n_groups: int) -> None:
    rng = np.random.default_rng(1)
    design, values = rng.normal(size=(600, 4)), rng.normal(size=600)
    groups = np.sort(np.concatenate([np.arange(n_groups), rng.integers(0, n_groups, 600 - n_groups)]))
    merged = groups * min(n_groups, GROUPS) // n_groups
    whole = np.linalg.lstsq(design, values, rcond=None)[0]
    others = [np.linalg.lstsq(design[merged != k], values[merged != k], rcond=None)[0] for k in range(merged[-1] + 1)]
    expected = np.sqrt((1.0 - 1.0 / len(others)) * ((np.array(others) - whole) ** 2).sum(axis=0))
    found = jackknife_errors(stack_equations(design, values), np.ones(600), [2, 0], groups)
    assert found == pytest.approx(expected[[2, 0]])


def test_a_coefficient_that_one_group_alone_determines_has_no_error() -> None:
    design, values = np.random.default_rng(2).normal(size=(2, 200, 3))
    parts = equal_parts(200)
    design[parts > 0, 2] = 0.0
    equations, weight = stack_equations(design, values[:, 0]), np.ones(200)
    assert np.isfinite(jackknife_errors(equations, weight, [0, 1, 2], parts)).tolist() == [True, True, False]
    assert np.isinf(jackknife_errors(equations, weight, [0], np.zeros(200, dtype=int))).all()


def record(position: np.ndarray, drift_A: float = 0.0, way: np.ndarray | None = None) -> Recording:
    """Record a lift with a friction of 2 bar that a position-dependent load pushes down; `drift_A` [Pa].

    `way`: sign of the friction, by default that of the speed.
    """
    rng, t = np.random.default_rng(0), np.arange(len(position)) / RATE
    way = np.sign(np.gradient(position)) if way is None else way
    p_A = 80e5 + 2e6 * np.cos(3.0 * position) + 2e5 * way + drift_A * t / t[-1]
    noise = 3e3 * rng.standard_normal((2, len(t)))
    x = position + 1e-4 * rng.standard_normal(len(t))
    channels = {"p_A": p_A + noise[0], "p_B": 6e5 + noise[1], "x": x}
    return Recording(t, channels, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, RATE)


def strokes(*ends: float, hold: float = 8.0, stroke: float = 6.0) -> np.ndarray:
    """Move from 0 m to each of the positions `ends` [m] in turn, in smooth strokes, and hold each [s]."""
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.arange(round(stroke * RATE)) / (stroke * RATE))
    pieces, last = list[np.ndarray](), 0.0
    for end in ends:
        pieces += [last + (end - last) * ramp, np.full(round(hold * RATE), end)]
        last = end
    return np.concatenate(pieces)


def test_a_piston_that_a_servo_holds_does_not_move() -> None:
    """While it is held, the seals bear any part of the load: such pressures would halve the friction."""
    position = strokes(0.3, 0.1, 0.4, 0.0, 0.2)
    held = np.gradient(position) == 0.0
    way = np.where(held, np.random.default_rng(1).uniform(-1.0, 1.0), np.sign(np.gradient(position)))
    recording = record(position, way=way)
    motion, fit = select_motion(recording), fit_difference(recording)
    assert motion is not None and fit is not None
    assert not held[motion.rows].any()
    assert fit.friction == pytest.approx(2e5, abs=max(3.0 * fit.friction_error, 2e3))
    assert fit.friction_error < 1e4


def test_one_stroke_up_tells_neither_friction_nor_a_drift() -> None:
    learnt = HealthyLevels().learn(record(strokes(0.4), drift_A=4e5))
    assert learnt is None or (learnt.friction is None and not learnt.drifts)


def test_one_stroke_each_way_tells_friction_and_hardly_a_drift() -> None:
    learnt = HealthyLevels().learn(record(strokes(0.4, 0.0)))
    assert learnt is not None
    assert learnt.friction_pressure == pytest.approx(2e5, rel=0.02)
    assert learnt.drift_A_error is None or learnt.drift_A_error > 1e5


def test_strokes_that_pass_the_same_places_tell_a_drift() -> None:
    learnt = HealthyLevels().learn(record(strokes(0.4, 0.0, 0.3, 0.1, 0.4, 0.0), drift_A=4e5))
    assert learnt is not None
    drift = learnt.drifts["A"]
    assert drift.value == pytest.approx(4e5, abs=3.0 * drift.deviation)
    assert drift.deviation < 2e4


@pytest.mark.parametrize("seed", range(5))
def test_weighted_least_squares_are_those_of_a_general_solver(seed: int) -> None:
    """With columns that depend on each other the shortest solution counts, as that of the pseudo-inverse."""
    random = np.random.default_rng(seed)
    design = random.standard_normal((300, 12)) * 10.0 ** random.uniform(-2.0, 2.0, 12)
    values, weight = design @ random.standard_normal(12) + random.standard_normal(300), random.random(300)
    for matrix in (design, np.column_stack([design, design[:, 0] + design[:, 1]]), np.pad(design, ((0, 0), (0, 1)))):
        expected = np.linalg.lstsq(matrix * weight[:, None], values * weight, rcond=1e-12)[0]
        found = solve_weighted(stack_equations(matrix, values), weight)
        assert found == pytest.approx(expected, rel=1e-7, abs=1e-9 * np.abs(expected).max())
