"""What the actuator runs into: caps, current and voltage, vacuum; and what a solver cannot resolve."""

from __future__ import annotations

import numpy as np
import pytest

from sealscope.errors import SimulationFailed
from sealscope.physics.rig import rig_numbers
from sealscope.physics.solvers.limits import DECAY_LIMIT, longest_step, stiffest_rate
from sealscope.simulation.experiment import choose_method

from ..refusals import refusal

FULL_CHARGE = {"p_charge": "40[MPa]"}  # so that the emptied chamber stays above vacuum


def hold(volts: float):
    return lambda t: np.full_like(t, volts)


@pytest.mark.parametrize(
    ("volumes", "throttled"),
    [
        pytest.param("fixed", False, id="fixed-free"),
        pytest.param("position", True, id="position-throttled", marks=pytest.mark.slow),
        *(
            pytest.param(volumes, throttled, marks=[pytest.mark.slow, pytest.mark.long])
            for volumes, throttled in (("fixed", True), ("position", False))
        ),
    ],
)
@pytest.mark.parametrize(
    "side",
    [
        pytest.param(1.0, id="cap A-side out"),
        pytest.param(-1.0, id="cap B-side out", marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_both_caps_hold_the_piston(check_rig, drive, throttled, volumes, side):
    rig = check_rig(throttled, volumes=volumes, **FULL_CHARGE)
    run = drive(rig, 3.0, u=hold(10.0 * side), x_0=0.27 * side)
    half, c = rig.cylinder.L / 2, rig.cylinder
    assert np.abs(run["x"]).max() > half  # it got there
    # the pump pushes with C_m i_max 2 pi / q_b: 20.5 MPa on 633 mm^2, 13 kN, 1.3 mm; as much again for the impact
    push = rig.motor.C_m * rig.motor.i_max * 2 * np.pi / rig.pump.q_b * c.A_A
    assert np.abs(run["x"]).max() - half < 2.0 * push / c.k_stop
    assert side * run["x"][-1] - half == pytest.approx(push / c.k_stop, rel=0.1)
    assert np.abs(run["v"][-500:]).max() < 0.02  # and it came to a standstill


def test_current_and_voltage_stay_within_the_drive_s_limits(check_rig, drive):
    rig = check_rig(**FULL_CHARGE, V_max=60.0, i_max=8.0)
    run = drive(rig, 2.0, u=lambda t: 10.0 * np.sign(np.sin(8.0 * t)), rate=2000.0)
    assert np.abs(run["i"]).max() == pytest.approx(8.0, rel=1e-12)  # reached, never passed
    assert np.abs(run["V"]).max() == pytest.approx(60.0, rel=1e-12)
    assert np.count_nonzero(np.abs(run["i"]) == 8.0) > 20


def test_the_drive_s_own_gains_cannot_be_resolved(check_rig, drive):
    for throttled in (False, True):
        with refusal("step", "9.4e-06 s", "speed loop", error=SimulationFailed):
            drive(check_rig(throttled, k_p=50_000.0, K_i=100.0), 1.0)
    # with the step that the message asks for the loop is as stiff as it is meant to be
    run = drive(check_rig(k_p=50_000.0, K_i=100.0), 1.0, step=9e-6)
    np.testing.assert_allclose(run["omega"][100:], 26.7 * 3 * np.sin(4 * run.t[100:]), atol=2e-3)


def test_rk4_with_throttles_at_the_thesis_s_step_is_refused(check_rig, drive):
    rig = check_rig(throttled=True)
    with refusal("step", "rk4", "throttles", "0.0001 s", "imex", error=SimulationFailed):
        drive(rig, 5.0, method="rk4", step=1e-4)
    chatter = drive(rig, 5.0, method="rk4", step=1e-4, allow_unresolved=True)
    truth = drive(rig, 5.0)
    error = np.sqrt(np.mean((chatter["p_A"] - truth["p_A"]) ** 2))
    assert 6e4 < error < 1e5  # 79 500 Pa over a long run: as large as the signal
    fine = drive(rig, 0.5, method="rk4", step=4e-6)  # within the limit it runs
    np.testing.assert_allclose(fine["p_A"], truth["p_A"][:250], atol=60.0)


def test_a_step_too_long_for_the_rig_is_refused_and_a_default_step_adapts(check_rig, drive):
    with refusal("step", "0.0015 s", "0.005 s", error=SimulationFailed):
        drive(check_rig(), 1.0, step=5e-3, rate=100.0)
    stiff = check_rig(K_oil="20000[MPa]", M_eq="1[kg]")  # the oil column rings at 8 300 rad/s
    assert drive(stiff, 0.1).step <= 1 / 8000
    assert drive(check_rig(), 2.0).step == pytest.approx(1 / 1500)
    assert drive(check_rig(throttled=True), 0.1).step == 1e-3


def test_a_leak_that_the_step_cannot_resolve_is_refused(check_rig, drive):
    C = 2e-7
    truth = drive(check_rig(), 1.0, C=C, step=2e-5)
    with refusal("leak", "0.0005 s", error=SimulationFailed):
        drive(check_rig(), 1.0, C=C, step=5e-4)
    wrong = drive(check_rig(), 1.0, C=C, step=5e-4, allow_unresolved=True)
    assert np.mean(np.abs(wrong["q_leak"])) > 1.2 * np.mean(np.abs(truth["q_leak"]))  # why it is refused
    default = drive(check_rig(), 1.0, C=C)
    np.testing.assert_allclose(default["p_A"], truth["p_A"], atol=20.0)


def test_a_cap_too_stiff_for_the_step_is_refused_only_once_it_is_hit(check_rig, drive):
    rig = check_rig(k_stop=1e10, d_stop=3.5e5, **FULL_CHARGE)
    drive(rig, 1.0, u=hold(5.0))
    with refusal("hard stop", error=SimulationFailed):
        drive(rig, 1.0, u=hold(5.0), x_0=0.28)


def test_vacuum_is_refused_with_place_and_time(check_rig, drive):
    def push(t: np.ndarray) -> np.ndarray:
        return 5.0 * np.minimum(t / 0.5, 1.0)

    with refusal("p_B", "vacuum", "-101325 Pa", "t", "x", error=SimulationFailed):
        drive(check_rig(), 3.0, u=push, x_0=0.28)
    run = drive(check_rig(), 3.0, u=push, x_0=0.28, allow_unresolved=True)
    assert run["p_B"].min() < -101325


def test_a_run_that_diverges_is_refused_even_when_all_is_allowed(check_rig, drive):
    with refusal("finite", error=SimulationFailed):
        drive(check_rig(), 5.0, step=1e-2, rate=100.0, allow_unresolved=True)


def test_the_literal_integral_tends_to_the_state_as_the_step_goes_to_zero(check_rig, drive):
    rig = check_rig(integrator="euler")
    truth = drive(check_rig(), 1.0, rate=100.0, step=1e-5)
    errors = []
    for h in (4e-4, 2e-4, 1e-4):
        run = drive(rig, 1.0, rate=100.0, step=h)
        assert run.method == "rk4"
        errors.append(np.abs(run["I"] - truth["I"]).max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 1.0, atol=0.1)


@pytest.mark.parametrize(
    ("values", "method", "words"),
    [
        ({}, "imex", "imex, throttles"),
        ({}, "euler", "method, 'euler', rk4"),
        ({"orifices": "present", "integrator": "euler"}, "auto", "rk4"),
        ({"orifices": "present", "integrator": "euler"}, "imex", "rk4"),
    ],
)
def test_a_method_that_does_not_suit_the_rig_is_refused(check_rig, values, method, words):
    with refusal(*words.split(", ")):
        choose_method(check_rig(**values), method)


@pytest.mark.parametrize("step", [0.0, -1e-4, float("nan"), float("inf")])
def test_a_step_must_be_a_time(check_rig, drive, step):
    with refusal("step", "0 s"):
        drive(check_rig(), 1.0, step=step)


def test_inputs_that_jump_at_a_step_keep_the_order(check_rig, drive):
    """A command that steps at a step's boundary is seen from inside each step, so RK4 keeps its order."""

    def late(t: np.ndarray) -> np.ndarray:
        return np.where(t >= 0.1, 2.0, 0.0)

    rig = check_rig(F_pr=0.0, F_cfr=0.0)
    truth = drive(rig, 0.4, u=late, rate=100.0, step=1e-5)
    errors = [np.abs(drive(rig, 0.4, u=late, rate=100.0, step=h)["p_A"] - truth["p_A"]).max() for h in (5e-4, 2.5e-4)]
    assert errors[0] < 100.0
    assert np.log2(errors[0] / errors[1]) > 3.7


def test_the_throttles_answer_fastest_at_the_end_of_the_stroke(check_rig):
    """A chamber at the end of its stroke holds 50 cm^3 instead of 240: the throttle between it and the line is as much
    quicker, and a step that mid-stroke allows is refused."""
    p = rig_numbers(check_rig(throttled=True, volumes="position"))
    c, end = p.c_A_in, p.V - p.A_A * p.L / 2
    fastest = p.K_oil * (1 / p.V_1 + 1 / end) * c / np.sqrt(p.dp_0)
    assert fastest > 1.3 * p.K_oil * (1 / p.V_1 + 1 / p.V) * c / np.sqrt(p.dp_0)
    assert stiffest_rate(p) == pytest.approx(fastest)
    fixed = p._replace(position_dependent=False)
    assert stiffest_rate(fixed) == pytest.approx(p.K_oil * (1 / p.V_1 + 1 / p.V) * c / np.sqrt(p.dp_0))


def test_a_step_between_the_two_limits_is_refused(check_rig, drive):
    rig = check_rig(throttled=True, volumes="position")
    p = rig_numbers(rig)
    mid = DECAY_LIMIT / (p.K_oil * (1 / p.V_1 + 1 / p.V) * p.c_A_in / np.sqrt(p.dp_0))
    with refusal("rk4", "throttles", error=SimulationFailed):
        drive(rig, 0.2, method="rk4", step=0.98 * mid, x_0=-0.29)


def test_the_unequal_sides_of_a_cylinder_are_taken_where_the_oil_is_stiffer(check_rig):
    equal = rig_numbers(check_rig(volumes="position"))
    unequal = equal._replace(A_B=1.2 * equal.A_B)
    stiffer = (equal.V + equal.A_A * equal.L / 2, equal.V - 1.2 * equal.A_B * equal.L / 2)
    column = equal.K_oil * (unequal.A_A**2 / stiffer[0] + unequal.A_B**2 / stiffer[1]) / equal.M_eq
    assert longest_step(unequal) <= 1 / np.sqrt(column) * (1 + 1e-9)


def test_the_pressure_in_the_friction_shortens_the_step(check_rig, drive):
    """F_C = F_pr + F_cfr (p_A + p_B): 825 N at the charge pressure of 40 MPa, not the 25 N of the seals' preload."""
    rig = check_rig(F_cfr=1e-5, **FULL_CHARGE)
    p = rig_numbers(rig)
    slope = (p.F_pr + p.F_cfr * 2 * p.p_charge) * p.K_brk / p.v_th + p.F_v
    assert longest_step(p) == pytest.approx(DECAY_LIMIT / (slope / p.M_eq), rel=0.02)
    assert longest_step(p._replace(coulomb_of_difference=True)) > 5 * longest_step(p)
    with refusal("step", "friction", error=SimulationFailed):
        drive(rig, 1.0, step=5e-4)
    chosen = drive(rig, 4.0)
    truth = drive(rig, 4.0, step=chosen.step / 8)
    every = round((chosen.t[1] - chosen.t[0]) / (truth.t[1] - truth.t[0]))
    assert np.sqrt(np.mean((chosen["p_A"] - truth["p_A"][::every]) ** 2)) < 100.0
