"""Oil of the closed circuit: nothing appears, nothing is lost (energy: `test_variants.py`)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson


def oil(rig, run) -> np.ndarray:
    """Compressed oil in the closed circuit, sum of V_i p_i / K [m^3], (n,)."""
    held = rig.cylinder.V * (run["p_A"] + run["p_B"])
    if rig.line.orifices == "present":
        held = held + rig.line.V_1 * run["p_1"] + rig.line.V_2 * run["p_2"]
    return held / rig.fluid.K_oil


def turned_over(run) -> float:
    """Oil that the pump moved [m^3]."""
    return float(simpson(np.abs(run["Q_1"]), x=run.t))


@pytest.mark.parametrize("throttled", [False, True], ids=["free", "throttled"])
@settings(max_examples=12, deadline=None)
@given(
    amplitude=st.floats(0.5, 6.0),
    G=st.floats(0.0, 1e-11),
    C=st.floats(0.0, 2e-9),
    G_pump=st.floats(0.0, 1e-12),
    closed=st.sampled_from([0.0, 0.25, 0.75]),
    metering=st.sampled_from(["meter-out", "literal"]),
)
def test_the_closed_circuit_keeps_its_oil(check_rig, drive, throttled, amplitude, G, C, G_pump, closed, metering):
    rig = check_rig(throttled, G_pump=G_pump, closed_A=closed, closed_B=closed, metering=metering)
    run = drive(rig, 5.0, u=amplitude, G=G, C=C)
    held = oil(rig, run)
    assert np.abs(held - held[0]).max() <= 1e-9 * held[0]
    # and the charge is not merely large beside what moves
    assert np.abs(held - held[0]).max() <= 1e-9 * turned_over(run)


def test_the_balance_would_see_a_slip(check_rig, drive, monkeypatch):
    """A cylinder with two areas, fixed volumes and nothing to make good the difference does not keep its oil."""
    monkeypatch.setattr("sealscope.simulation.experiment.check_circuit", lambda rig: None)  # it is refused
    rig = check_rig(A_B="600[mm^2]")
    run = drive(rig, 5.0, u=0.2)
    held = oil(rig, run)
    moved = (rig.cylinder.A_A - rig.cylinder.A_B) * (run["x"] - run["x"][0])
    assert np.abs(held - held[0]).max() > 1e-4 * held[0]
    np.testing.assert_allclose(held - held[0], -moved, atol=1e-6 * np.abs(moved).max())


def test_position_dependent_volumes_keep_the_mass_to_first_order_in_pressure_over_bulk_modulus(check_rig, drive):
    """With volumes balanced, dp/dt = K/V (Q - A v), the oil held grows by the piston's work over K, by nothing else."""
    rig = check_rig(volumes="position", balance="volume", p_charge="2[MPa]")
    run = drive(rig, 10.0, u=8.0, rate=2000.0)
    c, K = rig.cylinder, rig.fluid.K_oil
    V_A, V_B = c.V + c.A_A * run["x"], c.V - c.A_B * run["x"]
    assert np.ptp(V_A) > 0.2 * c.V  # it moves far enough to matter
    held = (V_A * run["p_A"] + V_B * run["p_B"]) / K
    work = (run["p_A"] - run["p_B"]) * run["v"] * c.A_A
    gained = np.concatenate([[0.0], np.cumsum(0.5 * (work[1:] + work[:-1])) / 2000.0]) / K
    np.testing.assert_allclose(held - held[0], gained, atol=2e-4 * np.abs(gained).max())
    # the error in mass, relative: the work done over K V, below p/K
    assert np.abs(held - held[0]).max() < 2e-3 * turned_over(run)


def mass(rig, run) -> np.ndarray:
    """Mass of the oil over its density at 0 Pa [m^3], sum of V_i exp(p_i/K), (n,)."""
    c, K = rig.cylinder, rig.fluid.K_oil
    held = (c.V + c.V_hose_A + c.A_A * run["x"]) * np.exp(run["p_A"] / K)
    held = held + (c.V + c.V_hose_B - c.A_B * run["x"]) * np.exp(run["p_B"] / K)
    if rig.line.orifices == "present":
        held = held + rig.line.V_1 * np.exp(run["p_1"] / K) + rig.line.V_2 * np.exp(run["p_2"] / K)
    return held


@pytest.mark.slow
@pytest.mark.parametrize("throttled", [False, True], ids=["free", "throttled"])
@settings(max_examples=4, deadline=None)
@given(
    amplitude=st.floats(0.5, 6.0),
    G=st.floats(0.0, 1e-11),
    C=st.floats(0.0, 2e-9),
    G_pump=st.floats(0.0, 1e-12),
    hose=st.floats(0.0, 1e-4),
)
def test_where_volumes_move_the_mass_is_kept(check_rig, drive, throttled, amplitude, G, C, G_pump, hose):
    rig = check_rig(throttled, volumes="position", G_pump=G_pump, V_hose_B=hose)
    run = drive(rig, 5.0, u=amplitude, G=G, C=C)
    held = mass(rig, run)
    assert np.ptp(run["x"]) > 1e-3
    assert np.abs(held - held[0]).max() <= 1e-8 * held[0]  # the solver's: a quarter at half the step


@pytest.mark.slow
def test_the_mean_pressure_of_a_sealed_circuit_stays_and_only_balanced_volumes_pump_it_up(check_rig, drive):
    """180 s of long strokes; printed as volume flows, the balances make oil out of nothing."""
    ends = {}
    for balance in ("mass", "volume"):
        rig = check_rig(volumes="position", balance=balance, p_charge="0.3[MPa]", omega_per_volt="100[rpm/V]")
        run = drive(rig, 180.0, u=lambda t: 8.0 * np.sin(t), x_0=-0.2, rate=100.0)
        mean = 0.5 * (run["p_A"] + run["p_B"])
        stroke = round(2 * np.pi * 100)
        ends[balance] = mean[-stroke:].mean() - mean[:stroke].mean()
    assert abs(ends["mass"]) < 20e3
    assert ends["volume"] > 500e3


@pytest.mark.slow
def test_the_mass_of_oil_with_air_is_kept(check_rig, drive):
    """rho V with the density whose modulus is that of oil and air, from a table of its integral."""
    from scipy.integrate import cumulative_simpson

    from sealscope.physics.fluid import effective_bulk_modulus

    rig = check_rig(True, volumes="position", air=0.005, p_charge="0.4[MPa]")
    run = drive(rig, 10.0, u=5.0, G=1e-12)
    f = rig.fluid
    p = np.linspace(-0.05e6, 1.5e6, 200_001)
    compliance = 1.0 / np.array([effective_bulk_modulus(one, f.K_oil, f.air, f.n_air) for one in p.tolist()])
    log_density = cumulative_simpson(compliance, x=p, initial=0.0)
    c = rig.cylinder
    volumes = {"p_A": c.V + c.A_A * run["x"], "p_B": c.V - c.A_B * run["x"], "p_1": rig.line.V_1, "p_2": rig.line.V_2}
    held = sum(volume * np.exp(np.interp(run[name], p, log_density)) for name, volume in volumes.items())
    assert np.abs(held - held[0]).max() <= 1e-6 * held[0]
