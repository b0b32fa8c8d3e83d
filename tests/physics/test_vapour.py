"""Oil that boils: a cavity at the vapour pressure, which takes and gives back what the balance of oil says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sealscope.parameters import load_rig
from sealscope.physics.fluid import mixture_density_ratio
from sealscope.simulation.faults import parse_fault
from sealscope.units import P_ATM

P_VAP = 2e3
LEAST = P_VAP - P_ATM


def boiling(**values):
    return load_rig("thesis").with_overrides({"p_vap": P_VAP, "u_max": 12.0, **values})


@pytest.fixture(scope="module")
def separated(drive):
    """The piston moves at a constant speed, without friction; both lines shut at once, and the column behind parts."""
    values = {"p_charge": "0.2 MPa", "F_pr": 0.1, "F_cfr": 0.0, "F_v": 0.1, "G_circ": 1e-9, "orifices": "present"}
    rig = boiling(**values)
    words = [*(f"shut-off {side} to 0 % from 0.6 s" for side in "AB"), "circulation from 0.6 s"]
    u = {"u": lambda t: 6.0 - 6.0 * np.cos(np.pi * np.minimum(t / 0.5, 1.0))}
    return rig, drive(rig, 0.7, **u, rate=2e4, step=2e-5, faults=tuple(map(parse_fault, words)))


def test_a_column_that_parts_surges_by_its_energy(separated):
    """p_v + sqrt(2 (p - p_v)^2 + v^2 M K/V): both columns down to the vapour pressure behind, then the one in front."""
    rig, run = separated
    before = np.flatnonzero(run.t < 0.6)[-1]
    v, level = run["v"][before], 0.5 * (run["p_A"] + run["p_B"])[before]
    after = run.t >= 0.6
    stiffness = rig.cylinder.M_eq * rig.fluid.K_oil / rig.cylinder.V
    expected = LEAST + math.sqrt(2.0 * (level - LEAST) ** 2 + v**2 * stiffness)
    assert run["p_A"][after].min() == LEAST
    assert run["p_B"][after].max() == pytest.approx(expected, rel=0.01)
    assert v * math.sqrt(0.5 * stiffness) > 1.2 * (level - LEAST)  # no column would have held it


def test_what_boiled_is_oil_again(separated):
    """The oil of both shut-in chambers is what it was, whenever neither has a cavity."""
    _, run = separated
    shut = (run.t >= 0.6) & (run["p_A"] > LEAST) & (run["p_B"] > LEAST)
    first = np.flatnonzero(shut)[0]
    total = run["p_A"] + run["p_B"]
    assert np.count_nonzero(run["p_A"][run.t >= 0.6] == LEAST) > 20
    assert np.count_nonzero(shut[first + 200 :]) > 20
    np.testing.assert_allclose(total[shut], total[first], atol=1e-3)
    cavity = (total - total[first])[run.t >= 0.6]  # over K/V
    assert cavity.min() > -1e-3


@pytest.mark.slow
@pytest.mark.parametrize("air", [0.0, pytest.param(2e-5, marks=[pytest.mark.slow, pytest.mark.long])])
@settings(max_examples=4, deadline=None)
@given(amplitude=st.floats(8.0, 11.0), G=st.floats(0.0, 1e-11))
def test_the_mass_is_kept_through_cavities(drive, air, amplitude, G):
    """Where volumes move: rho V of both chambers is that of the beginning whenever neither has a cavity."""
    rig = boiling(volumes="position", p_charge="0 Pa", F_v=6000.0, air=air)
    run = drive(rig, 3.0, u=amplitude, G=G, rate=4000.0, step=1.25e-4)
    c, f = rig.cylinder, rig.fluid
    p_A, p_B = run["p_A"], run["p_B"]
    assert min(p_A.min(), p_B.min()) == LEAST
    rho_A, rho_B = ([mixture_density_ratio(p, 0.0, f.K_oil, air, f.n_air) for p in side] for side in (p_A, p_B))
    held = (c.V + c.A_A * run["x"]) * rho_A + (c.V - c.A_B * run["x"]) * rho_B
    whole = (p_A > LEAST) & (p_B > LEAST)
    assert np.count_nonzero(whole[6000:]) > 100
    assert np.abs(held - held[0])[whole].max() <= 1e-7 * held[0]
    assert (held - held[0])[~whole].max() > 1e-5 * held[0]  # the cavity
