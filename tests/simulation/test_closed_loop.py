"""The loop closed over the piston's position, and loads that change with time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from sealscope.control import Measured, PositionPI
from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import load_rig
from sealscope.physics.rig import pack_numbers, rig_numbers
from sealscope.physics.solvers.advance import EXPLICIT, advance
from sealscope.physics.standstill import initial_state
from sealscope.simulation.closed_loop import outputs_per_sample
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run
from sealscope.simulation.simulate import simulate_experiment
from sealscope.simulation.targets_and_loads import parse_force, parse_position

from ..refusals import refusal

#: Friction up and stiffness down by 20 %, and the other way round: what the controller does not know.
_STIFFER = {"F_pr": 20.0, "F_cfr": 0.8e-6, "F_v": 240.0, "K_oil": 827e6}
OFF = {
    "thesis-closed-loop": ({"F_pr": 30.0, "F_cfr": 1.2e-6, "F_v": 360.0, "K_oil": 551e6}, _STIFFER),
    "single-rod-eha": ({"F_pr": 120.0, "F_cfr": 6e-5, "F_v": 2400.0, "K_oil": 800e6},),
}

PI = PositionPI.from_rig(load_rig("thesis"))


def followed(rig: str, target: str, duration: float, **options):
    """Run under the controller that assumes the rig as it is shipped; return the run and its error [m]."""
    experiment = Experiment.of(
        rig=rig, command=target, duration=duration, controller=PositionPI.from_rig(load_rig(rig)), **options
    )
    run = integrate_run(experiment, ())
    return run, np.broadcast_to(experiment.target.value_at(run.t), run.t.shape) - run["x"]


@pytest.mark.parametrize(
    ("rig", "force"),
    [
        pytest.param("thesis-closed-loop", 0.0, marks=pytest.mark.slow),
        pytest.param("thesis-closed-loop", 2000.0, marks=pytest.mark.slow),
        pytest.param("single-rod-eha", 0.0, marks=pytest.mark.slow),
        pytest.param("single-rod-eha", 2000.0, marks=pytest.mark.slow),
    ],
)
def test_a_sine_of_50_mm_is_followed_within_1_percent_and_a_step_is_held(rig, force):
    for off in OFF[rig]:
        run, error = followed(rig, f"position 50 mm sin({0.5 * math.pi}t)", 12.0, set={**off, "F_l": force})
        assert np.sqrt(np.mean(error[run.t > 4.0] ** 2)) < 0.01 * 50e-3
        run, error = followed(rig, "position step 100 mm at 1 s", 30.0, set={**off, "F_l": force})
        late = run.t > 15.0
        assert np.sqrt(np.mean(error[late] ** 2)) < 0.01 * 100e-3
        assert np.abs(error[late]).max() < 60e-6  # three counts of the encoder
        assert np.ptp(run["x"][run.t > 25.0]) < 5e-6  # a quarter of a count: no limit cycle
        assert run["x"].max() < 0.103


@pytest.mark.long
@pytest.mark.slow
def test_without_feed_forward_and_integral_it_lags():
    """The check above sees what the controller is for."""
    experiment = Experiment.of(
        rig="thesis-closed-loop", command="position 50 mm sin(1.57t)", duration=6.0,
        controller=replace(PI, k_i=0.0, drive=replace(PI.drive, shortfall=0.0)),
    )  # fmt: skip
    run = integrate_run(experiment, ())
    error = experiment.target.value_at(run.t) - run["x"]
    assert np.sqrt(np.mean(error[run.t > 2.0] ** 2)) > 0.01 * 50e-3


@dataclass(frozen=True)
class Ladder:
    """Gives 0.1 V more at each sample, and notes what it measured."""

    observed: list
    rate: float = 250.0
    delay: int = 2

    def start(self):
        self.observed.clear()

        def voltage(measured: Measured) -> float:
            self.observed.append(measured)
            return 0.1 * len(self.observed)

        return voltage


def test_a_voltage_acts_after_its_delay_until_the_next_and_the_encoder_counts():
    ladder = Ladder([])
    options = {"rig": "thesis-closed-loop", "command": "position 10 mm sin(10t)", "duration": 0.4}
    run = simulate_experiment(Experiment.of(controller=ladder, **options))
    steps = np.maximum(np.arange(200) // 2 - 1, 0)  # samples at 500 Hz, two a sample of the controller, late by two
    np.testing.assert_allclose(run.recording["u"], np.minimum(0.1 * steps, 10.0), atol=1e-12)
    x = np.array([measured.x for measured in ladder.observed])
    counts = x / 20e-6
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    behind = run.truth.outputs["x"][::2][:100] - x[:100]
    assert behind.min() > -1e-12
    assert behind.max() < 20e-6 + 1e-12
    t = np.array([measured.t for measured in ladder.observed])
    np.testing.assert_allclose([measured.target for measured in ladder.observed], 0.01 * np.sin(10.0 * t), atol=1e-12)
    speed = 0.01 * (np.sin(10.0 * (t + 0.012)) - np.sin(10.0 * (t + 0.008))) / 0.004  # while the voltage acts
    np.testing.assert_allclose([measured.target_speed for measured in ladder.observed], speed, atol=1e-9)
    noise = np.array([measured.p_A for measured in ladder.observed])[:100] - run.truth.outputs["p_A"][::2][:100]
    assert 0.5 < noise.std() / load_rig("thesis").sensors.p_A.noise < 1.5


def step_by_step(experiment, path):
    """Return the rows of a run whose voltages are known, one call of the solver from output to output."""
    p, y, rows = (
        pack_numbers(rig_numbers(experiment.rig)),
        initial_state(experiment.rig, 0.0, 0.0),
        np.empty_like(path.rows),
    )
    every = round((path.t[1] - path.t[0]) / path.step)
    u, none = np.empty((every, 3)), np.zeros((every, 3))
    for k, volts in enumerate(path.volts):
        u.fill(volts)
        advance(EXPLICIT, y, path.step, u, none, none, np.zeros((0, 0)), p, False, every, rows[k : k + 1])
    return rows


def test_a_closed_loop_is_the_same_again_whatever_the_steps():
    options = {"rig": "thesis-closed-loop", "command": "position 20 mm sin(3t)", "duration": 3.0, "seed": 3}
    first, again = (simulate_experiment(Experiment.of(**options)) for _ in range(2))
    np.testing.assert_array_equal(first.recording["p_A"], again.recording["p_A"])
    fine = integrate_run(Experiment.of(**options), (), step=2.5e-5)
    coarse = integrate_run(Experiment.of(**options), ())
    assert np.abs(fine["x"] - coarse["x"]).max() < 20e-6  # a count that falls to the other side
    np.testing.assert_array_equal(coarse.rows, step_by_step(Experiment.of(**options), coarse))
    assert first.recording.provenance["experiment"]["controller"].startswith("PositionPI(")


def test_a_load_moves_the_piston_by_the_give_of_oil_and_drive(check_rig):
    """Linear at standstill: dx = (D dtheta - V dp/(2 K))/A with dp = F/A and K_i dtheta = -R D dp/C_m."""
    values = {"F_pr": 0.0, "F_cfr": 0.0, "F_v": 4000.0, "p_charge": "3 MPa", "K_i": 10.0, "K_brk": 1.0}
    rig = check_rig(**values)
    experiment = Experiment.of(rig=rig, command="0 sin(t)", load="ramp 1 kN from 0.5 s to 0.6 s", duration=3.0)
    run = integrate_run(experiment, ())
    D, A = rig.pump.q_b / (2 * math.pi), rig.cylinder.A_A
    dp = 1000.0 / A
    turned = -rig.motor.R_c * D * dp / (rig.motor.C_m * rig.motor.K_i)
    assert run["theta"][-1] == pytest.approx(turned, rel=1e-4)
    moved = (D * turned - rig.cylinder.V * dp / (2.0 * rig.fluid.K_oil)) / A
    assert run["x"][-1] == pytest.approx(moved, rel=1e-4)
    assert run["p_A"][-1] - run["p_B"][-1] == pytest.approx(dp, rel=1e-4)
    assert np.abs(run["x"][run.t < 0.5]).max() < 1e-12


def test_a_load_that_is_there_from_the_start_is_carried_from_the_start(check_rig):
    run = integrate_run(Experiment.of(rig=check_rig(), command="0 sin(t)", load="300 N", duration=1.0), ())
    A = check_rig().cylinder.A_A
    assert run["p_A"][0] - run["p_B"][0] == pytest.approx(300.0 / A)
    assert np.abs(run["x"]).max() < 1e-12


def test_faults_and_leaks_meet_a_closed_loop():
    """A changed duty changes the target, a leak is sized under the controller."""
    words = {"rig": "thesis-closed-loop", "command": "position 20 mm sin(2t)", "duration": 4.0}
    run = simulate_experiment(Experiment.of(**words, fault="duty amplitude x1.5 from 2 s", leak="0.05 L/min from 1 s"))
    assert run.truth.mean_leak_lpm == pytest.approx(0.05, rel=2e-3)
    assert run.truth.outputs["x"][run.truth.t < 2.0].max() == pytest.approx(0.02, rel=0.02)
    assert run.truth.outputs["x"].max() == pytest.approx(0.03, rel=0.02)


def test_a_recorded_force_is_taken_as_it_was(tmp_path):
    path = tmp_path / "force  of a press.csv"
    path.write_text("t [min],F [kN],note\n1,0.5,a\n1.01,1.5,b\n1.03,-0.5,c\n")
    force = Experiment.of(load=f"file {path}", duration=1.0).load
    np.testing.assert_allclose(
        force.value_at(np.array([0.0, 0.3, 0.6, 1.2, 9.0])), [500.0, 1000.0, 1500.0, 500.0, -500.0]
    )
    for words, rule in (
        ("t [s],p [Pa]\n0,1\n", "columns t [s] and F [N], or F [N] with one of x [m] and v [m/s]"),
        ("t [s],F [bar]\n0,1\n1,1\n", "bar"),
    ):
        path.write_text(words)
        with pytest.raises(InputError) as refused:
            parse_force(f"file {path}")
        assert rule in str(refused.value)
        assert "\n" not in str(refused.value)


def test_words_of_targets_and_loads():
    t = np.array([0.0, 0.5, 2.0])
    np.testing.assert_allclose(parse_position("position 50 mm sin(2t) + 1 cm").value_at(t), 0.05 * np.sin(2 * t) + 0.01)
    np.testing.assert_allclose(parse_position("position step 0.1 m at 1 s").value_at(t), [0.0, 0.0, 0.1])
    np.testing.assert_allclose(parse_force("2 kN").value_at(t), 2000.0)
    np.testing.assert_allclose(parse_force("step 500[N] at 0.01 min").value_at(t), [0.0, 0.0, 500.0])
    two = parse_position("position 50 mm sin(2t) + 5 mm sin(9t)").value_at(t)
    np.testing.assert_allclose(two, 0.05 * np.sin(2 * t) + 0.005 * np.sin(9 * t))
    trapezoid = parse_position("position trapezoid 40 mm within 1 s every 8 s")
    np.testing.assert_allclose(
        trapezoid.value_at(np.array([0.0, 0.5, 3.0, 4.25, 6.0, 8.5])), [0, 0.02, 0.04, 0.03, 0, 0.02]
    )
    assert parse_position("3 sin(4t)") is None
    for text in ("position 50 mm sin(2t)", "position ramp 100 mm from 1 s to 3 s"):
        assert str(parse_position(str(parse_position(text)))) == text


def test_a_recorded_position_is_a_target(tmp_path):
    t = np.arange(200) / 50.0
    path = tmp_path / "moved  twice.csv"
    np.savetxt(path, np.c_[t, 10.0 * np.sin(t)], delimiter=",", header="t [s],x [mm]", comments="")
    target = parse_position(f"position  file {path}")
    np.testing.assert_allclose(target.value_at(t), 0.01 * np.sin(t), atol=1e-9)
    assert str(target) == f"position file {path}"
    path.write_text("t [s],p_A [Pa]\n0,1\n0.1,2\n0.2,3\n")
    with refusal("x"):
        parse_position(f"position file {path}")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"command": "position 3 sin(2t)"}, "position, '3 sin(2t)'"),
        ({"command": "position 50 mm wave"}, "position, '50 mm wave'"),
        ({"command": "position 400 mm sin(2t)"}, "position, +-300 mm"),
        ({"load": "500"}, "load, 'step 100 N', '500'"),
        ({"load": 500.0}, "load, 500.0"),
        ({"controller": PositionPI.from_rig(load_rig("thesis"))}, "controller, target"),
    ],
)
def test_a_wrong_target_or_load_is_one_line(options, words):
    with refusal(*words.split(", ")):
        Experiment.of(**{"rig": "thesis-closed-loop", "duration": 2.0, **options})


def test_rates_and_voltages_that_cannot_be():
    assert outputs_per_sample(500.0, 1000.0, 4) == 4
    assert outputs_per_sample(500.0, 3000.0, 4) == 6
    assert outputs_per_sample(500.0, 100.0, 3) == 3
    with refusal("rate"):
        outputs_per_sample(500.0, 333.3, 4)
    with refusal("k_v", "-1.0"):
        PositionPI.from_rig(load_rig("thesis"), k_v=-1.0)
    target = Experiment.of(rig="thesis-closed-loop", command="position 10 mm sin(t)", duration=1.0)

    @dataclass(frozen=True)
    class Broken:
        rate: float = 500.0
        delay: int = 0

        def start(self):
            return lambda measured: math.nan

    with refusal("nan", "0 s", error=SimulationFailed):
        integrate_run(replace(target, controller=Broken()), ())

    @dataclass(frozen=True)
    class Raising(Broken):
        def start(self):
            return lambda measured: 1.0 if measured.t < 0.1 else 1.0 / 0.0

    with pytest.raises(ZeroDivisionError):
        integrate_run(replace(target, controller=Raising()), ())
