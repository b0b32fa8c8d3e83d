"""Oil that leaves at the rod seals, the make-up that replaces it, and air in the oil."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad, simpson

from sealscope.errors import SimulationFailed
from sealscope.physics.external import accumulator_pressure, check_valve_flow, external_leakage
from sealscope.physics.fluid import effective_bulk_modulus
from sealscope.units import P_ATM

from ..refusals import refusal

MADE_UP = {"check_valves": "present"}


def test_a_rod_seal_leaks_outwards_only():
    assert external_leakage(2e5, 3e-13) == pytest.approx(6e-8)
    assert external_leakage(-5e4, 3e-13) == 0.0


def test_an_accumulator_keeps_to_boyle_s_law_and_a_check_valve_to_its_direction():
    # 0.3 L at 0.3 MPa gauge; half as much oil again given off: (0.3 + 0.101325)/1.5 - 0.101325
    assert accumulator_pressure(0.0, 3e5, 3e-4) == pytest.approx(3e5)
    assert accumulator_pressure(1.5e-4, 3e5, 3e-4) == pytest.approx(166_225.0, abs=1.0)
    assert check_valve_flow(4e3, 5e3, 1e-10) == 0.0
    assert check_valve_flow(-1e6, 5e3, 1e-10) == 0.0
    assert check_valve_flow(1.05e5, 5e3, 1e-10) == pytest.approx(1e-5)


@given(p=st.floats(-5e4, 1e7), air=st.floats(0.0, 0.1), n=st.floats(1.0, 1.4))
def test_the_bulk_modulus_is_the_slope_of_the_mixture_s_volume(p, air, n):
    K = 1.5e9

    def volume(pressure: float) -> float:  # of a litre of oil and its air; the oil's own share linear in p
        return 1.0 - (pressure - p) / K + air * (P_ATM / (pressure + P_ATM)) ** (1.0 / n)

    step = 1e-4 * (p + P_ATM)
    slope = (volume(p + step) - volume(p - step)) / (2 * step)
    assert effective_bulk_modulus(p, K, air, n) == pytest.approx(-volume(p) / slope, rel=1e-5)


def test_air_softens_the_oil_at_low_pressure_and_not_at_high():
    assert effective_bulk_modulus(3e5, 6.89e8, 0.0, 1.4) == 6.89e8
    # 0.5 % of air, adiabatic, at atmospheric pressure: 1.005 / (1/1.4e9 + 0.005/(1.4 * 101325))
    assert effective_bulk_modulus(0.0, 1.4e9, 0.005, 1.4) == pytest.approx(2.794e7, rel=1e-3)
    moduli = [effective_bulk_modulus(p, 1.4e9, 0.005, 1.4) for p in (0.0, 1e5, 1e6, 1e7, 1e8)]
    assert moduli == sorted(moduli)
    assert moduli[-1] == pytest.approx(1.4e9, rel=1e-3)


@pytest.mark.slow
def test_two_leaking_rod_seals_empty_the_circuit_exponentially(check_rig, drive):
    """Equal leakage on both sides: p_A + p_B = 2 p_charge exp(-K G t/V), whatever the piston does."""
    G = 4e-14
    rig = check_rig(G_ext_A=G, G_ext_B=G)
    run = drive(rig, 5.0)
    decay = np.exp(-rig.fluid.K_oil * G / rig.cylinder.V * run.t)
    assert decay[-1] < 0.6
    assert run["p_A"].min() > 0.0
    np.testing.assert_allclose(run["p_A"] + run["p_B"], 2 * rig.fluid.p_charge * decay, rtol=1e-6)


@pytest.mark.parametrize("throttled", [False, True], ids=["free", "throttled"])
@pytest.mark.slow
def test_what_leaks_out_and_what_is_made_up_account_for_the_oil(check_rig, drive, throttled):
    rig = check_rig(throttled, G_ext_A=5e-13, G_ext_B=2e-13, **MADE_UP)
    run = drive(rig, 5.0, rate=2000.0)
    held = rig.cylinder.V * (run["p_A"] + run["p_B"])
    if throttled:
        held = held + rig.line.V_1 * run["p_1"] + rig.line.V_2 * run["p_2"]
    gained = (held[-1] - held[0]) / rig.fluid.K_oil
    lost, made_up = simpson(run["q_ext"], x=run.t), run["V_up"][-1] - run["V_up"][0]
    assert lost > 1e-7
    assert made_up > 0.5 * lost
    assert gained == pytest.approx(made_up - lost, abs=1e-5 * lost)
    assert simpson(run["q_up"], x=run.t) == pytest.approx(made_up, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "throttled",
    [pytest.param(False, id="free", marks=[pytest.mark.slow, pytest.mark.long]), pytest.param(True, id="throttled")],
)
def test_the_make_up_holds_the_low_side_and_gives_off_its_own_pressure(check_rig, drive, throttled):
    rig = check_rig(throttled, G_ext_A=4e-13, **MADE_UP)
    run = drive(rig, 20.0)
    late = run.t > 5.0
    supply = np.array([accumulator_pressure(V, rig.fluid.p_charge, rig.makeup.V_gas) for V in run["V_up"]])
    low = np.minimum(run["p_1"], run["p_2"])
    # the flow that a stroke asks for takes up to 0.01 MPa across the check valve
    opens = supply[late] - rig.makeup.p_crack
    assert np.min(low[late] - opens) < 0.0
    assert np.min(low[late] - opens) > -1.2e4
    assert np.mean(run["q_up"][late]) == pytest.approx(np.mean(run["q_ext"][late]), rel=0.01)
    assert supply[-1] < supply[0] - 500.0  # it empties
    assert np.all(np.diff(run["V_up"]) >= 0)


def test_without_a_make_up_a_leaking_rod_seal_empties_the_circuit_and_the_refusal_names_the_remedy(check_rig, drive):
    with refusal("fluid.p_vap", "check_valves", error=SimulationFailed):
        drive(check_rig(G_ext_A=2e-12, volumes="position"), 20.0)


def test_a_tight_circuit_needs_no_make_up_once_it_is_filled(check_rig, drive):
    run = drive(check_rig(**MADE_UP), 20.0)
    assert run["V_up"][-1] > 2e-8  # the first strokes draw
    assert run["V_up"][-1] - run["V_up"][run.t > 10.0][0] < 5e-3 * run["V_up"][-1]
    plain = drive(check_rig(), 20.0)
    # the level rises by about what friction takes; the difference stays
    assert np.mean(run["p_A"] + run["p_B"]) > np.mean(plain["p_A"] + plain["p_B"]) + 2e4
    np.testing.assert_allclose((run["p_A"] - run["p_B"])[-1000:], (plain["p_A"] - plain["p_B"])[-1000:], atol=3e3)


def test_air_keeps_the_oil_in_the_circuit(check_rig, drive):
    """V dp/dt = K(p) Q: the sum of V F(p), dF/dp = 1/K(p), stays."""
    rig = check_rig(air="1 %")
    run = drive(rig, 3.0, step=5e-4)

    def compressed(p: float) -> float:
        return 1.0 / effective_bulk_modulus(p, rig.fluid.K_oil, rig.fluid.air, rig.fluid.n_air)

    def between(a: float, b: float) -> float:
        return quad(compressed, a, b)[0]

    start = rig.fluid.p_charge
    for k in range(0, run.t.size, 150):
        a, b = between(start, run["p_A"][k]), between(start, run["p_B"][k])
        assert a + b == pytest.approx(0.0, abs=1e-6 * max(abs(a), 1e-6))
    assert np.ptp(run["p_A"]) > 5e4


@pytest.mark.slow
def test_the_implicit_method_follows_the_air_too(check_rig, drive):
    rig = check_rig(True, air="1 %", d_line=2e-3, dp_0="0.1[MPa]")  # mild throttles: RK4 can be the judge
    truth = drive(rig, 2.0, method="rk4", step=2e-5)["p_A"]
    errors = [np.sqrt(np.mean((drive(rig, 2.0, step=h)["p_A"] - truth) ** 2)) for h in (1e-3, 5e-4)]
    assert errors[0] < 5.0, errors
    assert errors[1] < 0.8 * errors[0], errors


def test_air_lowers_the_note_of_the_oil_columns(check_rig, drive):
    def note(air: str) -> float:
        rig = check_rig(F_pr=0.0, F_cfr=0.0, F_v=20.0, air=air, p_charge="0.3[MPa]")
        run = drive(rig, 4.0, u=lambda t: np.where((t > 0.1) & (t < 0.2), 1.0, 0.0), rate=1000.0)
        ring = run["v"][500:] - np.mean(run["v"][500:])
        spectrum = np.abs(np.fft.rfft(ring * np.hanning(ring.size)))
        return float(np.argmax(spectrum[20:]) + 20) * 1000.0 / ring.size

    clean, foamy = note("0 %"), note("1 %")
    K = effective_bulk_modulus(3e5, 6.89e8, 0.01, 1.4)
    assert clean == pytest.approx(np.sqrt(2 * 633e-6**2 * 6.89e8 / (234e-6 * 12.3)) / (2 * np.pi), rel=0.03)
    assert foamy == pytest.approx(clean * np.sqrt(K / 6.89e8), rel=0.05)
