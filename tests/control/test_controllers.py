"""Controllers: the drive's inverse, flatness, the observer of the leak, tolerance of it, and names."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import sealscope as ss
from sealscope.control import CONTROLLERS, Drive, FaultTolerant, Flatness, PositionPI, controller_named
from sealscope.control.drive import drive_voltage
from sealscope.control.leak_observer import make_observer, update_observer
from sealscope.control.registry import find_controller_source
from sealscope.parameters import load_rig
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run

from ..refusals import refusal

RIG = load_rig("thesis-closed-loop")
#: What the controllers do not know: friction up and stiffness down by 20 %; and a load of 2 kN.
OFF = {"F_pr": 30.0, "F_cfr": 1.2e-6, "F_v": 360.0, "K_oil": 551e6, "F_l": 2000.0}
#: 0.25 Hz within the drive's range of 10 V even with a leak of 0.5 L/min.
SINE = f"position 40 mm sin({0.5 * math.pi}t)"
OWN = Path(__file__).parents[2] / "docs" / "examples" / "own_controller.py"


def conductance(lpm: float) -> float:
    """Of a leak [L/min] under 2 kN."""
    return lpm / 6e4 / (2000.0 / RIG.cylinder.A_A)


def followed(controller, command: str, duration: float, lpm: float = 0.0, **options):
    leak = f"G = {conductance(lpm)}" if lpm else None
    experiment = Experiment.of(
        rig=RIG, command=command, duration=duration, controller=controller, leak=leak, set=OFF, **options
    )
    run = integrate_run(experiment, experiment.leaks)
    return run, np.broadcast_to(experiment.target.value_at(run.t), run.t.shape) - run["x"]


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_friction_by_the_difference_of_the_pressures_is_the_preload_where_they_are_equal():
    by_sum, by_difference = (
        Flatness.from_rig(RIG.with_overrides({"coulomb_pressure": name})).F_C for name in ("sum", "difference")
    )
    assert by_sum == pytest.approx(RIG.friction.F_pr + 2.0 * RIG.friction.F_cfr * RIG.fluid.p_charge)
    assert by_difference == RIG.friction.F_pr


def test_the_inverse_of_a_drive_gives_the_flow_against_the_pressure():
    """Closed form: k_p (omega_d - omega) + K_i I = C_e omega + R i at constant speed and current."""
    drive, m = Drive.from_rig(RIG), RIG.motor
    omega, dp, rate = 30.0, 2e6, 500.0
    (coefficients,) = drive.coefficients(rate)
    volts = np.array([drive_voltage(coefficients, omega * drive.displacement, dp) for _ in range(5000)])
    omega_d = volts * drive.omega_per_volt
    integral = np.cumsum(omega_d - omega) / rate
    needed = m.C_e * omega + m.R_c * drive.displacement * dp / m.C_m
    np.testing.assert_allclose(m.k_p * (omega_d - omega) + m.K_i * integral, needed, rtol=2e-3)


@pytest.mark.parametrize("sign", [pytest.param(1.0, marks=[pytest.mark.slow, pytest.mark.long]), -1.0])
def test_the_observer_returns_the_conductance_of_a_balance_that_holds(sign):
    balance = FaultTolerant.from_rig(RIG).balance
    (observer,), rate, G = make_observer(balance, 500.0), 500.0, 3e-13
    t = np.arange(10_000) / rate
    x, p = 0.05 * np.sin(1.5 * t), 1e6 + sign * 0.3e6 * np.sin(0.7 * t)
    high, low = np.maximum(2.5e6 + 0.0 * p, p), p
    p_A, p_B = (high, low) if sign > 0 else (low, high)
    area = balance.area_A if sign > 0 else balance.area_B
    theta = (area * x + G * np.cumsum(p_A - p_B) / rate) / balance.D
    for sample in zip(theta, x, p_A, p_B, strict=True):
        update_observer(observer, *sample)
    estimate, sd = observer.state[0], np.sqrt(observer.P[0, 0])
    # left out above: oil is drawn at the low side's pressure, a share of dp/K of what the pump turns
    assert abs(estimate - G) < max(4.0 * sd, 0.02 * G)
    assert observer.n_blocks > 30


@pytest.mark.slow
def test_a_leak_that_opens_at_once_is_followed_within_three_blocks_and_an_outlier_is_not():
    balance = FaultTolerant.from_rig(RIG).balance
    (observer,), rate = make_observer(balance, 500.0), 500.0
    G = np.repeat([0.0, 2.6e-12], 5000)
    theta = np.cumsum(G * 3e6) / rate / balance.D
    theta[2500:2600] += 1.0  # a slip of the encoder across the end of a block
    estimates = []
    for angle in theta:
        update_observer(observer, angle, 0.0, 4e6, 1e6)
        estimates.append(observer.state[0])
    assert np.abs(estimates[:5000]).max() < 1e-14
    assert estimates[5000 + 3 * 250] == pytest.approx(2.6e-12, rel=0.1)


@dataclass(frozen=True)
class Written:
    """The PI law with feed-forward written out in Python, or another controller without its machine code."""

    pi: PositionPI
    other: object = None
    rate: float = 500.0
    delay: int = 1

    def start(self):
        if self.other is not None:
            return self.other.start()
        c, T = self.pi, 1 / self.rate
        integral = dp = quick = before = 0.0

        def voltage(measured):
            nonlocal integral, dp, quick, before
            dp += (1 - math.exp(-T / 0.02)) * (measured.p_A - measured.p_B - dp)
            error = measured.target - measured.x
            omega = (measured.target_speed + c.k_v * error + integral) * (c.area_A if dp > 0 else c.area_B)
            omega /= c.drive.displacement
            quick = math.exp(-c.drive.corner * T) * (quick + omega - before)
            before = omega
            u = (omega + c.drive.shortfall * quick) / c.drive.omega_per_volt
            if abs(error) > c.dead_band and (abs(u) < c.u_max or u * error < 0):
                integral += c.k_i * T * error
            return min(max(u, -c.u_max), c.u_max)

        return voltage


def test_laws_in_machine_code_are_those_in_python():
    """PI against one written out; the laws through Python, and tolerance around a controller in Python."""
    words = {"command": "position step 30 mm at 0.3 s", "duration": 6.0, "lpm": 0.5, "seed": 3}
    pi, tolerant = PositionPI.from_rig(RIG), FaultTolerant.from_rig(RIG)
    run, _ = followed(pi, **words)
    written, _ = followed(Written(pi), **words)
    np.testing.assert_allclose(written.volts, run.volts, rtol=0, atol=1e-12)
    np.testing.assert_allclose(written.rows, run.rows, rtol=1e-12, atol=1e-9)
    for controller in (tolerant, Flatness.from_rig(RIG)):
        run, _ = followed(controller, **words)
        called, _ = followed(Written(pi, controller), **words)
        np.testing.assert_array_equal(called.rows, run.rows)
    beside, _ = followed(replace(tolerant, inner=Written(pi)), **words)
    run, _ = followed(tolerant, **words)
    assert run.compensated[-1] > 0.0
    np.testing.assert_allclose(beside.compensated, run.compensated, rtol=1e-9)
    np.testing.assert_allclose(beside.volts, run.volts, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_without_a_leak_tolerance_costs_nothing_to_the_last_bit():
    plain, _ = followed(PositionPI.from_rig(RIG), SINE, 12.0, seed=4)
    tolerant, _ = followed(FaultTolerant.from_rig(RIG), SINE, 12.0, seed=4)
    np.testing.assert_array_equal(plain.rows, tolerant.rows)
    assert not tolerant.compensated.any()


@pytest.mark.parametrize("lpm", [0.5, *(pytest.param(lpm, marks=pytest.mark.slow) for lpm in (0.0042, 0.05))])
def test_a_leak_under_2_kN_is_tracked_held_and_reported(lpm):
    _, healthy = followed(PositionPI.from_rig(RIG), SINE, 16.0)
    run, error = followed(FaultTolerant.from_rig(RIG), SINE, 16.0, lpm)
    late = run.t > 8.0
    assert rms(error[late]) < 1.1 * rms(healthy[late])
    assert rms(error[late]) < 0.01 * 40e-3
    flow = conductance(lpm) * (run["p_A"] - run["p_B"])
    assert np.mean(run.compensated[late]) == pytest.approx(np.mean(flow[late]), rel=0.1)
    held, error = followed(FaultTolerant.from_rig(RIG), "position 0 mm sin(t)", 20.0, lpm)
    still = held.t > 10.0
    drift = np.polyfit(held.t[still], held["x"][still], 1)[0]
    assert abs(drift) * 60e3 < 0.1  # mm/min
    assert np.abs(error[still]).max() < 60e-6


@pytest.mark.parametrize(
    ("lpm", "load"),
    [
        *(pytest.param(lpm, F, marks=pytest.mark.slow) for lpm, F in product((0.0, 0.5), (0.0, 2000.0))),
    ],
)
def test_a_single_rod_is_served_as_well(lpm, load):
    rig = load_rig("single-rod-eha")
    G = lpm / 6e4 / (2000.0 / rig.cylinder.A_A)
    runs = {}
    for name in ("pi", "fault-tolerant"):
        experiment = Experiment.of(
            rig=rig, command=SINE, duration=12.0, controller=controller_named(name, rig),
            leak=f"G = {G}" if lpm else None,
            set={"F_pr": 120.0, "F_cfr": 6e-5, "F_v": 2400.0, "K_oil": 800e6, "F_l": load},
        )  # fmt: skip
        run = integrate_run(experiment, experiment.leaks)
        runs[name] = run, rms((experiment.target.value_at(run.t) - run["x"])[run.t > 8.0])
    (fixed, missed), (tolerant, left) = runs.values()
    if lpm == 0.0:
        np.testing.assert_array_equal(fixed.rows, tolerant.rows)
        return
    assert left < (0.6 if load else 0.9) * missed
    late = tolerant.t > 8.0
    flow = G * (tolerant["p_A"] - tolerant["p_B"])[late]
    assert np.mean(tolerant.compensated[late]) == pytest.approx(np.mean(flow), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("lpm", [0.0042, 0.5])
def test_a_step_of_100_mm_under_2_kN_is_held_with_a_leak(lpm):
    run, error = followed(FaultTolerant.from_rig(RIG), "position step 100 mm at 1 s", 24.0, lpm)
    assert np.abs(error[run.t > 12.0]).max() < 60e-6
    assert abs(np.polyfit(run.t[run.t > 16.0], run["x"][run.t > 16.0], 1)[0]) * 60e3 < 0.1
    assert run["x"].max() < 0.104


@pytest.mark.slow
def test_stiffness_comes_back_to_that_of_a_machine_without_a_leak():
    """A load that ends, 0.5 L/min: the fixed controller needs its integral for the leak, and deviates twice as much."""
    deviation = {}
    for name, controller, lpm in (
        ("healthy", PositionPI.from_rig(RIG), 0.0),
        ("fixed", PositionPI.from_rig(RIG), 0.5),
        ("tolerant", FaultTolerant.from_rig(RIG), 0.5),
        ("ideal", FaultTolerant.from_rig(RIG, known=conductance(0.5)), 0.5),
    ):
        run, error = followed(controller, "position 0 mm sin(t)", 16.0, lpm, load="step -2 kN at 10 s")
        after = run.t > 10.0
        deviation[name] = float(np.trapezoid(np.abs(error[after]), run.t[after]))
    assert deviation["fixed"] > 1.5 * deviation["healthy"]
    assert deviation["tolerant"] < 1.1 * deviation["healthy"]
    assert deviation["tolerant"] == pytest.approx(deviation["ideal"], rel=0.05)


def test_what_is_made_good_is_a_channel_of_the_recording(tmp_path):
    recording = ss.simulate(
        rig="thesis-closed-loop", command="position 20 mm sin(2t)", controller="fault-tolerant", duration=9.0,
        load="2 kN", leak=f"G = {conductance(0.05)}",
    )  # fmt: skip
    assert recording.units["q_comp"] == "m^3/s"
    assert recording["q_comp"][-1] * 6e4 == pytest.approx(0.05, rel=0.1)
    ss.write(recording, tmp_path / "run.csv")
    again = ss.read(tmp_path / "run.csv")
    np.testing.assert_allclose(again["q_comp"], recording["q_comp"], atol=1e-12)
    assert "q_comp" not in ss.simulate(rig="thesis-closed-loop", command="position 5 mm sin(2t)", duration=0.2)


@pytest.mark.parametrize("force", [0.0, pytest.param(2000.0, marks=pytest.mark.slow)])
def test_flatness_follows_within_1_percent(force):
    run, error = followed(
        Flatness.from_rig(RIG), f"position 50 mm sin({0.5 * math.pi}t)", 10.0, load=f"{force - 2000} N"
    )
    assert rms(error[run.t > 4.0]) < 0.01 * 50e-3
    run, error = followed(Flatness.from_rig(RIG), "position step 100 mm at 1 s", 12.0, load=f"{force - 2000} N")
    assert np.abs(error[run.t > 9.0]).max() < 100e-6
    assert run["x"].max() < 0.103


def test_controllers_have_names_and_a_user_s_own_too():
    for name in CONTROLLERS:
        made = controller_named(name, RIG)
        assert (made.rate, made.delay) == (500.0, 1)
    own = f"{OWN}:Proportional"
    recording = ss.simulate(rig="thesis-closed-loop", command="position 10 mm sin(2t)", controller=own, duration=4.0)
    error = recording["x"] - 0.01 * np.sin(2.0 * recording.t)
    assert rms(error[recording.t > 2.0]) < 1e-3
    assert len(OWN.read_text().splitlines()) < 40


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("flatnes", "controller, 'flatnes'"),
        ("none.py:Own", "none.py"),
        ("json:dumps", "json:dumps"),
        ("no_such_module:Own", "no_such_module:Own, ModuleNotFoundError"),
    ],
)
def test_a_wrong_name_is_one_line(name, words):
    with refusal(*words.split(", ")):
        controller_named(name, RIG)


def test_the_source_of_an_unknown_name_is_refused_by_that_name():
    with refusal("controller", "'flatnes'"):
        find_controller_source("flatnes")


def test_a_module_that_is_no_package_has_no_modules_inside():
    """Another module of the same last name, here of the standard library, is not taken in its place."""
    with refusal("file must exist", "tokenize.json"):
        find_controller_source("tokenize.json:Own")


def test_numbers_that_cannot_be():
    with refusal("displacement", "0"):
        replace(Drive.from_rig(RIG), displacement=0.0)
    with refusal("v_max", "0"):
        replace(Flatness.from_rig(RIG), v_max=0.0)
    with refusal("known", "-1.0"):
        FaultTolerant.from_rig(RIG, known=-1.0)
