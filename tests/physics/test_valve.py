"""A servo valve and its supply: spool, edges and accumulator against closed forms, oil, another program."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson

from sealscope.parameters import load_rig
from sealscope.physics.external import accumulator_compliance, gas_volume, polytropic_pressure
from sealscope.physics.standstill import initial_state
from sealscope.physics.valve import edge_flow
from sealscope.simulation.experiment import Experiment
from sealscope.units import P_ATM

from ..refusals import refusal
from ..representatives import few

EDGES = ("o_PA", "o_AT", "o_PB", "o_BT")


def valve_rig(**values):
    return load_rig("servo-valve").with_overrides(values)


def spool_step(t, target, omega, zeta, v_max):
    """Position of a spool from standstill towards `target` > 0: a lag of order 2, straight at v_max, a lag again."""
    damped = omega * math.sqrt(1.0 - zeta**2)

    def free(t, e, v):  # from a distance e short of the target, at speed v
        a, b = -e, (v - zeta * omega * e) / damped
        wave = np.exp(-zeta * omega * t)
        x = wave * (a * np.cos(damped * t) + b * np.sin(damped * t))
        speed = wave * ((b * damped - zeta * omega * a) * np.cos(damped * t))
        return x, speed - wave * ((a * damped + zeta * omega * b) * np.sin(damped * t))

    grid = np.linspace(0.0, math.pi / damped, 2_000_001)
    speeds = free(grid, target, 0.0)[1]
    if speeds.max() <= v_max:
        return target + free(t, target, 0.0)[0]
    begins = float(np.interp(v_max, speeds[: speeds.argmax()], grid[: speeds.argmax()]))
    at = target + float(free(np.array(begins), target, 0.0)[0])
    leaves = target - 2.0 * zeta * v_max / omega  # from here on the lag asks for less than v_max
    ends = begins + (leaves - at) / v_max
    late = target + free(np.maximum(t - ends, 0.0), target - leaves, v_max)[0]
    early = target + free(np.minimum(t, begins), target, 0.0)[0]
    return np.where(t < begins, early, np.where(t < ends, at + v_max * (t - begins), late))


@pytest.mark.parametrize(("volts", "limited"), few([(6.0, False), (10.0, True), (0.5, False), (9.0, True)]))
def test_the_spool_answers_a_step_as_its_lag_and_its_rate_limit_say(drive, volts, limited):
    rig = valve_rig()
    run = drive(rig, 0.02, u=lambda t: np.full_like(t, volts), rate=1e5, step=1e-5)
    v = rig.valve
    target = v.x_max * volts / v.u_N
    expected = spool_step(run.t, target, v.omega_s, v.zeta_s, v.v_max)
    expected = np.minimum(expected, v.x_max)  # the stop
    before = slice(0, int(np.argmax(expected >= v.x_max)) or None)  # at its stop the spool stands
    assert np.abs(run["x_s"] - expected)[before].max() < (1e-5 if limited else 1e-9) * target
    assert (np.diff(run["x_s"]).max() * 1e5 > 0.99 * v.v_max) == limited
    assert np.abs(run["v_s"]).max() <= v.v_max
    assert run["x_s"].max() <= v.x_max


def whole_picometres(length: float) -> float:
    """An opening of 1e-310 m is a subnormal number, whose flow has few digits."""
    return round(length, 12)


@given(
    dp=st.floats(1e3, 2e7),
    way=st.floats(-5e-4, 5e-4).map(whole_picometres),
    overlap=st.floats(-1e-4, 1e-4).map(whole_picometres),
    dp_N=st.floats(1e5, 1e7),
)
def test_an_edge_passes_its_rated_flow_by_the_root_of_pressure_and_evenly_with_its_opening(dp, way, overlap, dp_N):
    Q_N, x_max, dp_lam = 1.5e-4, 5e-4, 5e4
    share = max(way - overlap, 0.0) / x_max
    root = Q_N * math.sqrt(dp / dp_N) * share
    flow = edge_flow(dp, way, overlap, Q_N, dp_N, x_max, dp_lam)
    assert flow == pytest.approx(root / (1.0 + (dp_lam / dp) ** 2) ** 0.25, rel=1e-12)
    assert edge_flow(-dp, way, overlap, Q_N, dp_N, x_max, dp_lam) == -flow


@pytest.mark.parametrize("force", few([2000.0, -2000.0, 0.0]))
@pytest.mark.parametrize("volts", [1.0, -4.0])
def test_the_load_s_pressure_and_the_opening_set_the_flow(drive, volts, force):
    """Q_L = Q_N u/u_N sqrt((p_P - p_T - sign(u) p_L)/(2 dp_N)), Merritt eq. (5-37), of a valve without overlap."""
    rig = valve_rig(F_l=force)
    run = drive(rig, 0.6, u=lambda t: np.full_like(t, volts), rate=1e4)
    v = rig.valve
    p_L, flow = run["p_A"] - run["p_B"], 0.5 * (run["Q_A"] + run["Q_B"])
    across = run["p_1"] - run["p_2"] - math.copysign(1.0, volts) * p_L
    expected = v.Q_N * volts / v.u_N * np.sqrt(across / (2.0 * v.dp_N))
    np.testing.assert_allclose(flow[-1000:], expected[-1000:], rtol=2e-4)  # laminar below 50 kPa: 1e-4 here
    np.testing.assert_allclose(run["p_A"] + run["p_B"], run["p_1"] + run["p_2"], rtol=0.03)
    assert np.mean(flow[-3000:]) / rig.cylinder.A_A == pytest.approx(np.mean(run["v"][-3000:]), rel=0.02)


def test_an_overlap_is_a_dead_band_and_an_underlap_leaks_at_null(drive):
    closed = valve_rig(**dict.fromkeys(EDGES, "25[um]"))
    still = drive(closed, 0.3, u=lambda t: np.full_like(t, 0.49))
    moves = drive(closed, 0.3, u=lambda t: np.full_like(t, 0.6))
    assert np.abs(still["x"]).max() < 1e-9
    assert moves["x"][-1] > 1e-4
    # both chambers halve the supply's pressure, and the edges pass what the root says
    rig = valve_rig(**dict.fromkeys(EDGES, "-25[um]"))
    standstill = drive(rig, 0.3, u=0.0)
    v, s, p_1 = rig.valve, rig.supply, standstill["p_1"][0]
    half = 0.5 * (p_1 - s.p_return)
    null = 2.0 * v.Q_N * 25e-6 / v.x_max * math.sqrt(half / v.dp_N)
    relief = s.G_set * (p_1 - s.p_return - s.p_set)
    assert null > 1e-5
    assert standstill["Q_1"][0] == pytest.approx(null + relief, rel=0.02)  # the oil expands by a hundredth
    assert np.ptp(standstill["p_1"]) < 1e-4 * p_1  # the chambers are not quite at standstill: they expand the oil, too


@pytest.mark.parametrize("force", [0.0, 1500.0, -2500.0])
def test_a_run_starts_in_equilibrium(drive, force):
    rig = valve_rig(F_l=force)
    run = drive(rig, 1.0, u=0.0, x_0=0.1)
    s, c = rig.supply, rig.cylinder
    assert run["p_A"][0] * c.A_A - run["p_B"][0] * c.A_B == pytest.approx(force, abs=1e-6)
    assert np.ptp(run["p_1"]) < 1e-3
    assert np.abs(run["x"] - 0.1).max() < 1e-12
    assert np.abs(run["omega"] - s.omega_P).max() < 1e-9
    given = run["Q_1"][0] * math.exp((s.p_return - run["p_1"][0]) / rig.fluid.K_oil)
    assert run["p_1"][0] - s.p_return == pytest.approx(s.p_set + given / s.G_set, rel=1e-9)


@given(p=st.floats(-5e4, 3e7), p_pre=st.floats(0.0, 1e7), n=st.floats(1.0, 1.7))
def test_the_accumulator_s_gas_is_a_polytropic_s_and_its_compliance_that_of_its_slope(p, p_pre, n):
    V = 3e-4
    gas = gas_volume(p, p_pre, V, n)
    if p <= p_pre:
        assert (gas, accumulator_compliance(p, p_pre, gas, n)) == (V, 0.0)
        return
    assert polytropic_pressure(gas - V, p_pre, V, n) == pytest.approx(p, rel=1e-9, abs=1e-3)
    if p > p_pre + 1e3:
        slope = (gas_volume(p - 50.0, p_pre, V, n) - gas_volume(p + 50.0, p_pre, V, n)) / 100.0
        assert accumulator_compliance(p, p_pre, gas, n) == pytest.approx(slope, rel=1e-5)


def flows_of(rig, run):
    """Flows [m^3/s] of the edges and of the relief valve, written from the states."""
    v, s = rig.valve, rig.supply
    p_1, p_2, x = run["p_1"], run["p_2"], run["x_s"]

    def edge(dp, way, overlap):
        c = v.Q_N / math.sqrt(v.dp_N) * np.maximum(way - overlap, 0.0) / v.x_max
        return c * dp / (dp**2 + v.dp_lam**2) ** 0.25

    return {
        "PA": edge(p_1 - run["p_A"], x, v.o_PA),
        "AT": edge(run["p_A"] - p_2, -x, v.o_AT),
        "PB": edge(p_1 - run["p_B"], -x, v.o_PB),
        "BT": edge(run["p_B"] - p_2, x, v.o_BT),
        "relief": s.G_set * np.maximum(p_1 - p_2 - s.p_set, 0.0),
    }


def supply_oil(rig, p):
    """Oil in the supply's accumulator [m^3] at p [Pa]."""
    s = rig.supply
    return s.V_acc * (1.0 - ((s.p_pre + P_ATM) / (np.maximum(p, s.p_pre) + P_ATM)) ** (1.0 / s.n_acc))


@pytest.mark.parametrize("G_ext", [0.0, pytest.param(5e-13, marks=pytest.mark.slow)])
@settings(max_examples=4, deadline=None)
@given(amplitude=st.floats(1.0, 8.0), G=st.floats(0.0, 1e-11), lap=st.floats(-2e-5, 2e-5))
def test_where_volumes_move_the_mass_is_kept(drive, amplitude, G, lap, G_ext):
    """Of chambers, line and accumulator: the pump's less the edges', each at the pressure that it comes from."""
    rig = valve_rig(**dict.fromkeys(EDGES, lap), G_ext_A=G_ext)
    run = drive(rig, 1.0, u=lambda t: amplitude * np.sin(9.0 * t), G=G, rate=2e4, step=5e-5)
    c, K = rig.cylinder, rig.fluid.K_oil
    p_A, p_B, p_1, p_2 = (run[name] for name in ("p_A", "p_B", "p_1", "p_2"))
    held = (c.V + c.A_A * run["x"]) * np.exp(p_A / K) + (c.V - c.A_B * run["x"]) * np.exp(p_B / K)
    held = held + (rig.line.V_1 + supply_oil(rig, p_1)) * np.exp(p_1 / K)
    Q = flows_of(rig, run)
    Q_A = Q["AT"] + G_ext * p_A
    out = Q_A * np.exp(p_A / K) + Q["BT"] * np.exp(p_B / K) + Q["relief"] * np.exp(p_1 / K)
    missing = held[-1] - held[0] - simpson(run["Q_1"] * np.exp(p_2 / K) - out, x=run.t)
    assert abs(missing) <= 1e-8 * held[0]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"supply.drive": "absent"},
            "supply.drive, absent",
        ),
        (
            {"valve.spool": "absent"},
            "valve.spool, absent, constant-speed",
        ),
        (
            {"o_PA": "-0.6[mm]"},
            "valve.o_PA, valve.x_max, +-0.0005 m, -0.0006 m",
        ),
        ({"x_max": "0.02[mm]", "o_BT": "0.02[mm]"}, "valve.o_BT"),
        ({"orifices": "present"}, "present, line.orifices"),
        ({"check_valves": "present"}, "present, makeup.check_valves"),
        ({"K_i": 0.0}, "motor.K_i, 0 V/rad"),
        ({"p_pre": "8[MPa]"}, "supply.p_pre, p_set, p_return, 7.3e+06 Pa, 8e+06 Pa"),
    ],
)
def test_an_impossible_valve_is_one_line(values, words):
    with refusal(*words.split(", ")):
        Experiment.of(rig="servo-valve", set=values, duration=1.0)


def test_what_the_supply_cannot_hold_is_one_line():
    with refusal("6000 N", "supply.p_set"):
        initial_state(valve_rig(F_l=6000.0), 0.0)
    with refusal("23 A", "260 V"):
        initial_state(valve_rig(omega_P="4000[rpm]"), 0.0)


def test_a_valve_needs_no_make_up_for_a_rod():
    """Supply and return take what a single rod displaces."""
    rig = valve_rig(A_B="400[mm^2]", V_rod="40[cm^3]")
    experiment = Experiment.of(rig=rig, duration=1.0)
    y = initial_state(experiment.rig, 0.0)
    assert y[6] * 633e-6 == pytest.approx(y[7] * 400e-6)
