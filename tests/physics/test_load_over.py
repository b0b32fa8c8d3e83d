"""Loads over position and velocity against springs and dampers, statics and the work that they do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import simpson

from sealscope.errors import SimulationFailed
from sealscope.physics.rig import rig_numbers
from sealscope.physics.solvers.limits import longest_step
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import integrate_run
from sealscope.simulation.targets_and_loads import parse_force

from ..refusals import refusal

CHARGED = {"p_charge": "3 MPa"}


def table(path, head, *rows):
    path.write_text("\n".join([head, *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return f"file {path}"


@pytest.mark.slow
def test_a_linear_table_is_a_spring_and_words_are_a_damper(check_rig, drive, tmp_path):
    known = drive(check_rig(k_load=2e5, **CHARGED), 1.0, u=2.0, step=2e-4)
    straight = parse_force(table(tmp_path / "x.csv", "x [mm],F [kN]", (-300.0, -60.0), (50.0, 10.0), (300.0, 60.0)))
    damped = drive(check_rig(d_load=3e3, **CHARGED), 1.0, u=2.0, step=2e-4)
    words = parse_force("4 kN s/m over v - 1[N s/mm] over v")
    for expected, load in ((known, straight), (damped, words)):
        run = drive(check_rig(**CHARGED), 1.0, u=2.0, step=2e-4, load=load)
        assert np.ptp(run["x"]) > 2e-4
        for name in ("x", "v", "p_A", "p_B", "omega"):
            np.testing.assert_allclose(run[name], expected[name], rtol=0, atol=1e-11 * np.abs(expected[name]).max())


@pytest.mark.slow
def test_a_run_starts_in_equilibrium_with_a_preloaded_spring(check_rig):
    experiment = Experiment.of(
        rig=check_rig(**CHARGED),
        command="0 sin(t)",
        load="200 N + 30 N/mm over x from 10 mm",
        x_0="20 mm",
        duration=0.5,
    )
    run, A = integrate_run(experiment, ()), experiment.rig.cylinder.A_A
    assert run["p_A"][0] - run["p_B"][0] == pytest.approx(500.0 / A, rel=1e-12)
    assert np.abs(run["x"] - 0.02).max() < 1e-12
    assert (
        experiment.key()
        != Experiment.of(rig=check_rig(**CHARGED), command="0 sin(t)", load="200 N", duration=0.5).key()
    )


def test_a_press_stops_where_its_work_piece_carries_what_the_drive_gives(check_rig):
    """At a stall i = V_max/R: dp = 2 pi C_m i/q_b, and k (x - x_s) = A dp; the way there is free."""
    rig = check_rig(F_pr=0.0, F_cfr=0.0, V_max=3.0, K_i=50.0, p_charge="6 MPa")
    run = integrate_run(
        Experiment.of(rig=rig, command="3 sin(0t + 1.5707963)", load="1 kN/mm over x from 2 mm", duration=10.0), ()
    )
    m = rig.motor
    dp = 2 * np.pi * m.C_m * (m.V_max / m.R_c) / rig.pump.q_b
    assert run["p_A"][-1] - run["p_B"][-1] == pytest.approx(dp, rel=1e-4)
    assert run["x"][-1] - 2e-3 == pytest.approx(rig.cylinder.A_A * dp / 1e6, rel=1e-4)
    free = run["x"] < 1.9e-3
    assert np.abs(run["p_A"] - run["p_B"])[free].max() < 0.5 * dp
    with refusal("step", "load", error=SimulationFailed):
        integrate_run(Experiment.of(rig=rig, load="100000 kN/mm over x from 2 mm", duration=1.0), ())
    stiff = rig_numbers(rig)._replace(pushed=parse_force("1 kN/mm over x from 2 mm").tables())
    spring = rig_numbers(check_rig(F_pr=0.0, F_cfr=0.0, V_max=3.0, K_i=50.0, k_load=1e6))
    assert longest_step(stiff) == longest_step(spring)


@settings(max_examples=3, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    F=st.lists(st.floats(-400.0, 400.0), min_size=5, max_size=5),
    dampers=st.tuples(st.floats(0.0, 2e3), st.floats(0.0, 2e3)),
    volts=st.floats(2.0, 5.0),
)
def test_the_work_of_the_pressures_is_in_piston_friction_and_load(check_rig, drive, tmp_path, F, dampers, volts):
    """The load's share is its potential, the integral of a broken line, and what its damper takes."""
    knots, step = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3]), 2e-5
    load = parse_force(table(tmp_path / "x.csv", "F [N],x [m]", *zip(F, knots.tolist(), strict=True)))
    over_v = parse_force(f"{dampers[0]!r} N s/m over v + {dampers[1]!r} N s/m over v from 0 mm/s").over_v
    rig = check_rig(F_pr=0.0, F_cfr=0.0, K_brk=1.0, p_charge="6 MPa")  # the strongest dampers draw 1 MPa
    both = type(load)(load.signal, load.words, load.over_x, over_v)
    run = drive(rig, 0.5 + step, u=volts, rate=1 / step, step=step, load=both)
    c, x, v = rig.cylinder, run["x"], run["v"]
    given_by_oil = simpson(((run["p_A"] - run["p_B"]) * c.A_A) * v, x=run.t)
    line = np.linspace(x[0], x[-1], 20001)
    stored = np.sum(0.5 * np.diff(line) * (np.interp(line[1:], knots, F) + np.interp(line[:-1], knots, F)))
    lost = simpson((rig.friction.F_v + dampers[0] + dampers[1] * (v > 0)) * v**2, x=run.t)
    moving = 0.5 * c.M_eq * (v[-1] ** 2 - v[0] ** 2)
    assert given_by_oil == pytest.approx(stored + lost + moving, abs=1e-6 * simpson(np.abs(v), x=run.t) * 400.0)
    assert np.abs(x).max() > 1e-3


@pytest.mark.parametrize("force", ["500 N", "500 N sin(2t + 1)"])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_load_is_a_sum_in_any_order(force, sign):
    t, spring = np.linspace(0.0, 3.0, 7), "20 N/mm over x"
    alone = parse_force(force)
    first = parse_force(f"{'' if sign > 0 else '-'}{force} + {spring}")
    last = parse_force(f"{spring} {'+' if sign > 0 else '-'} {force}")
    assert first.over_x == last.over_x == parse_force(spring).over_x
    for load in (first, last):
        np.testing.assert_allclose(load.value_at(t), sign * alone.value_at(t))


def test_words_and_tables_that_cannot_be(tmp_path):
    force = parse_force("500 N sin(2t) + 100 N - 20 N/m over x from -1 cm + 2 kN s/m over v")
    assert (force.over_x, force.over_v) == (((0.0, 0.0), (-0.01, -20.0)), ((0.0, 2000.0),))
    assert force.value_at(np.array([0.0])) == 100.0
    falling = parse_force(table(tmp_path / "v.csv", "v [mm/s],F [N]", (10, 5.0), (0, 1.0)))
    assert falling.over_v == ((1.0, 0.0), (0.0, 400.0), (0.01, -400.0))
    for text in ("20 N/mm over y", "500 N + 20 N/mm over x +", "20 N/mm over x +", "20 N/mm over x + 500 N -"):
        with refusal("load"):
            parse_force(text)
    with refusal("200", "2"):
        parse_force(table(tmp_path / "x.csv", "x [mm],F [N]", (1, 5.0), (1, 7.0)))
    with refusal("F", "x"):
        parse_force(table(tmp_path / "x.csv", "x [mm],v [m/s],F [N]", (1, 5.0, 1.0), (1, 7.0, 2.0)))
