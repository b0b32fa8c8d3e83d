"""The reduced rig against the whole one, and the fit: parameters found from wrong starts."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.diagnosis.pressure_model.fit import steps_of
from sealscope.diagnosis.pressure_model.follow import Followed, follow
from sealscope.diagnosis.pressure_model.model import (
    F_C,
    F_CFR,
    F_V,
    GAIN,
    OFFSET,
    PARAMETERS,
    RUNS,
    SIDE,
    STATES,
    STROKE,
    DrivenModel,
    G,
    K,
    assumed_numbers,
    nominal,
    pressure_differences,
    stiffening,
)
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.recording import Recording

from .pressure_machine import G_PUMP, P_CHARGE, recorded, true_difference, true_states

P = 0.01
TRUE_LPM = 0.0042
FRICTION = ("friction.F_pr", "friction.F_cfr", "friction.F_v")


@pytest.fixture(scope="module")
def thesis() -> Rig:
    return load_rig("thesis")


def truth_of(rig: Rig) -> np.ndarray:
    """The parameters (14,) of the machine of `recorded`, where nothing else is said."""
    theta = nominal(rig.with_overrides({"fluid.p_charge": P_CHARGE}))
    theta[G] = G_PUMP
    return theta


def driven(rig: Rig, u: np.ndarray, slope: np.ndarray, h: float, every: int) -> DrivenModel:
    """The model in mid-stroke under a command and its slope at every half step."""
    return DrivenModel(np.column_stack([u, slope, np.zeros((u.size, 3))]), h, every, assumed_numbers(rig))


def followed(rig: Rig, recording: Recording) -> Followed:
    found = follow(rig, recording, find_cycle(recording))
    assert isinstance(found, Followed)
    return found


# ---- the reduced rig -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["7 sin(4t)", "3 sin(4t)"])
def test_the_reduced_rig_shows_what_the_whole_rig_shows(command: str, thesis: Rig) -> None:
    """p_A - p_B of five states against the full simulation: within 200 Pa rms at steps of 1 ms (the noise has 12 kPa),
    and within 2 Pa at half of that, the simulation's own step: the error is the step's and not the reduction's."""
    u, true = true_difference(command=command)
    theta = truth_of(thesis)[None]
    coarse = DrivenModel.of(u, 500.0, assumed_numbers(thesis)).run(theta)[0]
    assert np.sqrt(np.mean((coarse - true) ** 2)) < 200.0
    at = np.arange(8 * u.size + 1) / 8.0
    fine = np.interp(at, np.arange(u.size), u)
    model = driven(thesis, fine, np.gradient(fine, 0.25e-3), 0.5e-3, 4)
    assert np.sqrt(np.mean((model.run(theta)[0] - true) ** 2)) < 2.0
    theta[0, F_V] *= 1.001
    assert np.sqrt(np.mean((model.run(theta)[0] - true) ** 2)) > 4.0


def test_stiffness_follows_the_volumes_of_both_chambers() -> None:
    """K (1/V_A + 1/V_B) over 2 K / V, with V_A = V + A x and V_B = V - A x; none of it where the share is nought."""
    theta = [0.0] * len(PARAMETERS)
    theta[OFFSET] = 0.1
    for place in (-0.6, -0.3, 0.0, 0.25, 0.5):
        theta[STROKE] = 0.0
        assert stiffening(place, tuple(theta)) == 1.0
        theta[STROKE] = 1.0
        V_A, V_B = 1.1 + place, 0.9 - place
        assert stiffening(place, tuple(theta)) == pytest.approx(0.5 * (1.0 / V_A + 1.0 / V_B), rel=3e-3)


LONG_STROKES = {"command": "8 sin(t)", "cylinder__volumes": "position", "motor__omega_per_volt": 14.0}


def test_long_strokes_show_what_the_whole_rig_shows(thesis: Rig) -> None:
    """Volumes by position: the place from the model itself, the pressures' sum as recorded. What either adds to the
    difference is in the true one, whole (a share of 1). The sum adds 0.14 kPa rms, since a rig that keeps its mass has
    no drift of it. (What is left is mid-stroke's drift, which blocks of the record follow.)"""
    u, states = true_states(**LONG_STROKES)
    p_A, p_B, x = (states[name] for name in ("p_A", "p_B", "x"))
    theta, numbers = truth_of(thesis), assumed_numbers(thesis)
    theta[GAIN], theta[STROKE] = 14.0, 1.0
    level = float(np.mean(p_A + p_B)) - 2.0 * P_CHARGE
    theta[F_C] += theta[F_CFR] * level
    model = DrivenModel.of(u, 500.0, numbers, p_A + p_B).with_travel(theta)
    place = numbers.A_A * x / numbers.V
    centred = place - np.polynomial.Polynomial.fit(np.arange(x.size), place, 1)(np.arange(x.size))
    assert np.sqrt(np.mean((model.travel[:-1:4] - centred) ** 2)) < 0.01 * np.std(place)
    theta[OFFSET] = float(np.mean(place - model.travel[:-1:4]))
    sets = np.tile(theta, (3, 1))
    sets[1, STROKE] = sets[2, F_CFR] = 0.0
    shown, true = model.run(sets)[:, 500:], (p_A - p_B)[500:]
    misfits = np.sqrt(np.mean((shown - true) ** 2, axis=1))
    assert misfits[0] < 700.0
    assert misfits[1] > 1.8 * misfits[0]
    added = shown[0] - shown[1:]
    shares = np.sum(added * (true - shown[1:]), axis=1) / np.sum(added**2, axis=1)
    assert shares == pytest.approx([1.0, 1.0], abs=0.1)
    assert np.sqrt(np.mean(added[1] ** 2)) > 100.0


def test_one_sided_friction_shows_what_the_whole_rig_shows(thesis: Rig) -> None:
    """Friction of the way back 0.7 times that of the way out: within what both sides alike come to (see above)."""
    backward = 0.7
    u, true = true_difference(friction__backward=backward)
    theta = truth_of(thesis)
    theta[SIDE] = (1.0 - backward) / (1.0 + backward)
    theta[[F_C, F_V, F_CFR]] *= 0.5 * (1.0 + backward)
    model = DrivenModel.of(u, 500.0, assumed_numbers(thesis))
    sets = np.tile(theta, (2, 1))
    sets[1, SIDE] = 0.0
    shown = model.run(sets)
    misfits = np.sqrt(np.mean((shown - true) ** 2, axis=1))
    assert misfits[0] < 200.0
    assert misfits[1] > 20.0 * misfits[0]


def _steady(thesis: Rig, every: int, seconds: float = 1.0) -> np.ndarray:
    """dp at 100 Hz under 5 + sin(4t) V, on its way from the start: no reversal, so that every law is smooth."""
    h = 0.01 / every
    t = np.arange(round(2 * seconds / h) + 1) * 0.5 * h
    n = round(seconds * 100)
    model = driven(thesis, 5.0 + np.sin(4.0 * t), 4.0 * np.cos(4.0 * t), h, every)
    theta = truth_of(thesis)
    omega = theta[GAIN] * 5.0
    v = model.piston_speed(omega)
    return model.run(theta[None], start=np.array([[1e5, v, omega, 0.5, 30.0]]))[0][:n]


def test_the_solver_is_of_fourth_order(thesis: Rig) -> None:
    finest = _steady(thesis, 320)
    errors = [np.sqrt(np.mean((_steady(thesis, every) - finest) ** 2)) for every in (10, 20, 40)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx(4.0, abs=0.3)


def test_lanes_are_runs_of_their_own(thesis: Rig) -> None:
    """Sets in two calls of all lanes are what each gives alone, whatever stands in the lanes beside it."""
    u, _ = true_difference()
    model = DrivenModel.of(u[:3000], 500.0, assumed_numbers(thesis))
    random = np.random.default_rng(4)
    sets = truth_of(thesis) * random.uniform(0.8, 1.2, (RUNS + 3, len(PARAMETERS)))
    together = model.run(sets)
    for one, theta in zip(together, sets, strict=True):
        np.testing.assert_array_equal(one, model.run(theta[None])[0])
    assert np.ptp(together, axis=0).max() > 1e4


@pytest.mark.slow
def test_single_precision_is_within_a_pascal_of_doubles(thesis: Rig) -> None:
    """What the model shows, and its slopes: the transducers' noise is 12 kPa, a step of G moves dp by 60 Pa rms."""
    u, _ = true_difference()
    theta = truth_of(thesis)
    model = DrivenModel.of(u[:10000], 500.0, assumed_numbers(thesis)).with_travel(theta)
    sets = np.tile(theta, (RUNS // 2, 1))
    stepped = [GAIN, K, G, F_C, F_V]
    sets[range(1, 6), stepped] += steps_of(theta)[stepped]
    table = np.ascontiguousarray(sets.T[None])
    shown, state = np.empty((model.samples, RUNS // 2)), np.zeros((STATES, RUNS // 2))
    segment = np.zeros(model.samples, dtype=np.int64)
    pressure_differences(
        model.inputs,
        model.h,
        model.every,
        table,
        segment,
        model.numbers,
        state,
        shown,
        False,
        model.readings,
        model.correction,
    )
    apart = model.run(sets) - shown.T
    assert 0.0 < np.sqrt(np.mean(apart**2)) < 0.3
    assert np.abs(apart).max() < 2.0
    slopes = np.sqrt(np.mean((shown.T[1:6] - shown.T[0]) ** 2, axis=1))
    assert np.all(np.sqrt(np.mean((apart[1:6] - apart[0]) ** 2, axis=1)) < 0.01 * slopes)


def test_a_run_goes_on_where_it_stopped(thesis: Rig) -> None:
    """Two parts with the state handed on, and segments of equal parameters, are the whole run."""
    u, _ = true_difference()
    model, theta = DrivenModel.of(u[:4000], 500.0, assumed_numbers(thesis)), truth_of(thesis)[None]
    whole = model.run(theta)[0]
    state = np.zeros((1, STATES))
    parts = [model.part(first, n).run(theta, start=state)[0] for first, n in ((0, 1700), (1700, 2300))]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    segment = (np.arange(4000) > 2500).astype(np.int64)
    np.testing.assert_array_equal(model.run(np.stack([theta, theta], axis=1), segment)[0], whole)
    other = np.stack([theta, 1.05 * theta], axis=1)
    shown = model.run(other, segment)[0]
    np.testing.assert_array_equal(shown[:2502], whole[:2502])
    assert np.abs(shown[2600:] - whole[2600:]).max() > 1e3


# ---- the fit -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stiffness, friction, gain", [(1.2, 0.9, 2.5), (0.8, 1.1, 0.5), (1.2, 1.1, 1.0)])
def test_the_fit_finds_a_machine_far_from_the_rig_that_is_assumed(
    stiffness: float, friction: float, gain: float, thesis: Rig
) -> None:
    truth = {"fluid.K_oil": stiffness, "motor.omega_per_volt": gain, **dict.fromkeys(FRICTION, friction)}
    values = {name.replace(".", "__"): factor * float(thesis[name]) for name, factor in truth.items()}
    command = "3 sin(4t)" if gain > 1.0 else "7 sin(4t)"
    theta = followed(thesis, recorded(3, command=command, **values)).path.mean(axis=0)
    numbers = assumed_numbers(thesis)
    v = numbers.q_b / (2.0 * np.pi) / numbers.A_A * theta[GAIN] * 4.0
    assert theta[GAIN] == pytest.approx(values["motor__omega_per_volt"], rel=0.01)
    assert theta[K] == pytest.approx(values["fluid__K_oil"], rel=0.01)
    coulomb = values["friction__F_pr"] + 2.0 * P_CHARGE * values["friction__F_cfr"]
    assert theta[F_C] + theta[F_V] * v == pytest.approx(coulomb + values["friction__F_v"] * v, rel=0.04)
    assert theta[G] == pytest.approx(G_PUMP, abs=3e-13)


def test_friction_that_is_larger_one_way_is_found(thesis: Rig) -> None:
    theta = followed(thesis, recorded(4, friction__backward=0.7)).path.mean(axis=0)
    assert theta[SIDE] == pytest.approx(0.3 / 1.7, abs=0.02)
    assert theta[G] == pytest.approx(G_PUMP, abs=3e-13)
