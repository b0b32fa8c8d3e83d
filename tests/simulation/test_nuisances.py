"""Drifts within a run, and instruments that change."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sealscope.parameters import load_rig
from sealscope.simulation.changes import (
    ParameterDrift,
    Wander,
    linear_path,
)
from sealscope.simulation.commands import polyline_from_table
from sealscope.simulation.experiment import FILTER_REACH, Experiment
from sealscope.simulation.instruments import decimate
from sealscope.simulation.simulate import simulate, simulate_experiment

from ..refusals import refusal

PRESSURES = ("p_1", "p_2", "p_A", "p_B")
QUIET = {"sensors.common_noise": 0.0, "bits": 24} | {
    f"sensors.{name}.{what}": 0.0 for name in PRESSURES for what in ("noise", "drift")
}
LINEAR = {"F_pr": 0.0, "F_cfr": 0.0, "G_pump": 3e-13}


# -- drifts of the machine ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_drifting_viscous_friction_follows_the_equation_with_time_in_it():
    """The linear rig with F_v(t) = F_v (1 + 0.3 t/20), against an independent program that has F_v in its equations."""
    rig = load_rig().with_overrides(LINEAR)
    drift = ParameterDrift("friction.F_v", linear_path(0.3, 20.0))
    common = {"rig": rig, "duration": 20.0, "set": {"sample_rate": "100[Hz]"}}
    drifting, constant = (simulate_experiment(Experiment.of(**common, drifts=d)).truth for d in ((drift,), ()))
    m, c, d = rig.motor, rig.cylinder, rig.pump.q_b / (2 * np.pi)
    k = rig.fluid.K_oil / c.V

    def rates(t: float, y: np.ndarray) -> list[float]:
        integral, i, w, v, p_A, p_B = y
        error = m.omega_per_volt * 3.0 * np.sin(4.0 * t) - w
        flow = d * w - rig.pump.G_pump * (p_A - p_B)
        return [
            error,
            (m.k_p * error + m.K_i * integral - m.R_c * i - m.C_e * w) / m.L_c,
            (m.C_m * i - m.B_M * w - d * (p_A - p_B)) / m.J_M,
            (c.A_A * (p_A - p_B) - rig.friction.F_v * (1 + 0.3 * t / 20.0) * v) / c.M_eq,
            k * (flow - c.A_A * v),
            k * (c.A_A * v - flow),
        ]

    start = [0.0, 0.0, 0.0, 0.0, rig.fluid.p_charge, rig.fluid.p_charge]
    t = drifting.t
    truth = solve_ivp(rates, (0.0, 20.0), start, method="LSODA", t_eval=t, rtol=1e-9, atol=[1e-9] * 4 + [1e-4] * 2)
    effect = np.sqrt(np.mean((constant.outputs["p_A"] - drifting.outputs["p_A"]) ** 2))
    assert effect > 500.0
    # held over blocks of half a second and less, the number is right at their middles
    assert np.sqrt(np.mean((drifting.outputs["p_A"] - truth.y[4]) ** 2)) < 0.005 * effect
    late = t > 15.0
    amplitude = [np.ptp(o.outputs["p_A"][late]) for o in (constant, drifting)]
    assert amplitude[1] > 1.15 * amplitude[0]


def test_a_drift_of_nothing_changes_no_byte():
    plain = simulate(duration=3.0, seed=4)
    still = simulate(
        duration=3.0,
        seed=4,
        drifts=(ParameterDrift("K_oil", linear_path(0.0, 3.0)), ParameterDrift("friction", linear_path(0, 3))),
    )
    for name in plain.channels:
        assert plain[name].tobytes() == still[name].tobytes()


@pytest.mark.parametrize("throttled", [False, True], ids=["free", "throttled"])
def test_a_number_that_steps_in_the_table_is_the_rig_with_that_number(throttled):
    """Pump leakage of three times from the start on is the rig with three times the pump leakage, to the last bit."""
    values = {"G_pump": 1e-13} | ({"orifices": "present", "closed_A": 0.5, "closed_B": 0.5} if throttled else {})
    changed = simulate_experiment(Experiment.of(duration=3.0, set=values, fault="pump leak x3")).truth.outputs
    built = simulate_experiment(Experiment.of(duration=3.0, set={**values, "G_pump": 3.0 * 1e-13})).truth.outputs
    for name in ("x", "p_A", "p_B", "p_1"):
        np.testing.assert_array_equal(changed[name], built[name])


def test_the_oil_s_modulus_may_drift_without_making_oil():
    values = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
    drifts = (ParameterDrift("K_oil", Wander((0.1, -0.05), 5.0)), ParameterDrift("line.C_d", linear_path(-0.2, 5.0)))
    o = simulate_experiment(Experiment.of(duration=5.0, set=values, drifts=drifts)).truth.outputs
    rig = load_rig().with_overrides(values)
    held = rig.cylinder.V * (o["p_A"] + o["p_B"]) + rig.line.V_1 * (o["p_1"] + o["p_2"])
    np.testing.assert_allclose(held, held[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ParameterDrift("V_9", linear_path(0.1, 1.0)), "'V_9'"),
        (lambda: ParameterDrift("cylinder.L", linear_path(0.1, 1.0)), "cylinder.L"),
        (lambda: ParameterDrift("daq.bits", linear_path(0.1, 1.0)), "daq.bits"),
        (lambda: ParameterDrift("volumes", linear_path(0.1, 1.0)), "cylinder.volumes"),
        (lambda: ParameterDrift("p_A.offset", linear_path(0.1, 1.0)), "absolute"),
        (lambda: ParameterDrift("K_oil", linear_path(0.1, 1.0), absolute=True), "relative"),
        (lambda: linear_path(0.1, 0.0), "0 s"),
        (lambda: Wander((float("nan"),), 1.0), "weights"),
        (lambda: polyline_from_table(np.array([1.0, 0.0]), np.zeros(2)), "times"),
        (
            lambda: Experiment.of(duration=9.0, drifts=(ParameterDrift("F_v", linear_path(-1.2, 9.0)),)),
            "-120 %, -100",
        ),
    ],
)
def test_an_impossible_drift_is_refused(make, words):
    with refusal(*words.split(", ")):
        make()


def test_a_wander_is_the_sum_it_says_and_starts_at_nothing():
    t = np.linspace(0.0, 12.0, 700)
    wander = Wander((0.3, -0.2, 0.1), 10.0, 0.05)
    expected = 0.05 * t / 10 + sum(w * np.sin((k + 0.5) * np.pi * t / 10) for k, w in enumerate(wander.weights))
    np.testing.assert_allclose(wander.value_at(t), expected, atol=1e-14)
    assert wander.value_at(np.zeros(1))[0] == 0.0
    assert np.ptp(wander.scale_to_range(0.08).value_at(np.linspace(0, 10, 1001))) == pytest.approx(0.08)
    assert polyline_from_table(np.array([0.0, 4.0]), np.array([0.0, 0.2])).value_at(
        np.array([2.0, 9.0])
    ) == pytest.approx([0.1, 0.2])


# -- instruments ----------------------------------------------------------------------------------------------------


def test_noise_bias_and_hum_drift_at_the_instruments_alone():
    values = {**QUIET, "sensors.p_A.noise": 5e3, "sensors.p_B.hum": 5e3}
    drifts = (
        ParameterDrift("sensors.p_A.noise", linear_path(0.5, 60.0)),
        ParameterDrift("sensors.p_1.offset", linear_path(3000.0, 60.0), absolute=True),
        ParameterDrift("sensors.p_B.hum", linear_path(1.0, 60.0)),
    )
    common = {"command": "step 0", "duration": 60.0, "set": values}
    plain, drifting = (simulate_experiment(Experiment.of(**common, drifts=d)) for d in ((), drifts))
    for name in plain.truth.outputs:
        np.testing.assert_array_equal(plain.truth.outputs[name], drifting.truth.outputs[name])
    read, t = drifting.recording, drifting.recording.t
    rest = load_rig().fluid.p_charge
    np.testing.assert_allclose(read["p_1"] - rest, 50.0 * t, atol=2.0)
    ratio = (read["p_A"] - rest)[1:] / (plain.recording["p_A"] - rest)[1:]
    np.testing.assert_allclose(np.median(ratio[-3000:]), 1.475, atol=0.02)
    assert np.ptp(read["p_B"][-2000:]) / np.ptp(read["p_B"][:2000]) == pytest.approx(2.0 / (1.0 + 4.0 / 60.0), rel=0.02)
    for name in ("p_2", "x", "theta", "q_leak"):
        np.testing.assert_array_equal(read[name], plain.recording[name])


@pytest.mark.parametrize("factor", [1, 4])
@pytest.mark.parametrize("delay", [0.25, 1.0, 1.7, 6.0])
def test_a_delayed_channel_shows_the_past(factor, delay):
    rate, n = 500.0 * factor, 600
    t = np.arange((n + FILTER_REACH) * factor) / rate
    observed = decimate(np.sin(2 * np.pi * 40.0 * t), factor, n, delay)
    expected = np.sin(2 * np.pi * 40.0 * (np.arange(n) / 500.0 - delay / rate))
    np.testing.assert_allclose(observed[60:], expected[60:], atol=2e-4)


def test_skew_and_scale_are_seen_in_the_channel_that_has_them():
    plain = simulate(duration=4.0, set=QUIET)
    skewed = simulate(duration=4.0, set={**QUIET, "sensors.p_A.delay": "2[ms]", "sensors.x.scale_error": "1 %"})
    np.testing.assert_allclose(skewed["p_A"][1:], plain["p_A"][:-1], atol=5.0)  # one sample at 500 Hz
    np.testing.assert_array_equal(skewed["p_B"], plain["p_B"])
    np.testing.assert_allclose(skewed["x"], 1.01 * plain["x"], atol=41e-6)
