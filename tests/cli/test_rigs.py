"""`sealscope rigs` and `sealscope rigs new`."""

from __future__ import annotations

import math

import pytest

from sealscope.parameters import load_rig, rig_names
from sealscope.physics.rig import rig_numbers
from sealscope.physics.solvers.limits import longest_step
from sealscope.physics.standstill import initial_state
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import LONGEST_STEP, integrate_run

SIZES = ("--stroke", "400", "--displacement", "6")


def test_the_packaged_rigs_are_listed_with_their_titles(call):
    done = call("rigs")
    assert (done.status, done.err) == (0, "")
    assert [line.split()[0] for line in done.out.splitlines() if line[0] != " "] == list(rig_names())
    assert all(load_rig(name).title in " ".join(done.out.split()) for name in rig_names())


@pytest.mark.parametrize("areas", [("500", "500"), ("12.5 cm^2", "9.4[cm^2]"), ("700", "900")], ids="{0[0]}".format)
def test_a_new_rig_loads_rests_and_can_be_resolved(call, tmp_path, areas):
    path = tmp_path / "press.toml"
    done = call("rigs", "new", "press", "--area-A", areas[0], "--area-B", areas[1], *SIZES, "-o", path)
    assert (done.status, done.err) == (0, "")
    rig = load_rig(path)
    assert (rig.name, rig.cylinder.L, rig.pump.q_b) == ("press", pytest.approx(0.4), pytest.approx(6e-6))
    sizes = {"500": (5e-4, 5e-4), "12.5 cm^2": (1.25e-3, 9.4e-4), "700": (7e-4, 9e-4)}[areas[0]]
    assert pytest.approx(sizes) == (rig.cylinder.A_A, rig.cylinder.A_B)
    assert rig.makeup.check_valves == ("absent" if sizes[0] == sizes[1] else "pilot-operated")
    sources = {row.name: row.source for row in rig.table()}
    assert sources["cylinder.A_A"].startswith("stated when")
    assert sources["friction.F_v"].startswith("assumed: that of")
    initial_state(rig, 0.0)
    assert longest_step(rig_numbers(rig)) > 0.06 * LONGEST_STEP
    Experiment.of(rig=rig, duration=1.0)


def test_a_valve_rig_from_a_data_sheet_loads_and_rests(call, tmp_path):
    path = tmp_path / "crane.toml"
    words = ("--kind", "valve", "--bore", "63", "--rod", "36", "--stroke", "400", "--valve", "40 L/min")
    done = call("rigs", "new", "crane", *words, "--drop", "5 bar", "--supply", "160", "-o", path)
    assert (done.status, done.err) == (0, "")
    rig = load_rig(path)
    assert pytest.approx((3117.25e-6, 2099.37e-6), rel=1e-5) == (rig.cylinder.A_A, rig.cylinder.A_B)
    assert pytest.approx((40e-3 / 60, 5e5, 160e5)) == (rig.valve.Q_N, rig.valve.dp_N, rig.supply.p_set)
    assert rig.states("cylinder.A_A", "valve.Q_N", "supply.p_set")
    assert not rig.states("cylinder.V")
    initial_state(rig, 0.0)
    assert longest_step(rig_numbers(rig)) > 0.06 * LONGEST_STEP
    Experiment.of(rig=rig, duration=1.0)


def test_bore_and_rod_are_as_good_as_areas(call, tmp_path):
    path = tmp_path / "press.toml"
    words = ("--bore", "100 mm", "--rod", "70", "--double-rod", "--stroke", "300", "--displacement", "8")
    assert call("rigs", "new", "press", *words, "-o", path).status == 0
    ring = math.pi / 4 * (0.1**2 - 0.07**2)
    assert pytest.approx((ring, ring), rel=1e-5) == (load_rig(path).cylinder.A_A, load_rig(path).cylinder.A_B)


def test_a_rod_on_both_sides_needs_one_area(call, tmp_path):
    path = tmp_path / "hip.toml"
    words = ("--area-A", "620", "--double-rod", "--stroke", "100", "--displacement", "0.9")
    assert call("rigs", "new", "hip", *words, "-o", path).status == 0
    cylinder = load_rig(path).cylinder
    assert cylinder.A_A == cylinder.A_B == pytest.approx(620e-6)


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (("--bore", "50", "--rod", "50"), "rod must be >= 0 mm and below the bore, 50 mm, got 50 mm"),
        (("--bore", "50", "--valve", "9"), "--valve needs --kind valve, got --kind pump"),
        (("--kind", "valve", "--bore", "50"), "--displacement needs --kind pump, got --kind valve"),
        (("--rod", "30", "--area-A", "500", "--area-B", "400"), "--rod needs --bore, got --rod 30"),
        (("--rod", "30"), "--rod needs --bore, got --rod 30"),
        (("--bore", "50", "--area-A", "500"), "--area-A must stand in place of --bore, got both"),
        (("--bore", "50", "--rod", "30", "--area-B", "500"), "--area-B must stand in place of --bore, got both"),
    ],
)
def test_sizes_that_do_not_go_together_are_one_line(call, words, rule):
    assert call("rigs", "new", "press", *words, *SIZES).refused().startswith(rule)


def test_areas_go_with_any_packaged_rig():
    """`--rig servo-valve --area` ended in "cylinder.V must be > A_A L/2"."""
    for name in rig_names():
        own = load_rig(name).with_areas(7854e-6, 4006e-6, source="the call")
        assert own.states("cylinder.A_A", "cylinder.A_B")
        assert own.cylinder.volumes == "fixed" or not own.states("cylinder.V")
        assert pytest.approx(7854e-6) == own.cylinder.A_A


@pytest.mark.slow
def test_a_new_single_rod_runs(call, tmp_path):
    path = tmp_path / "small.toml"
    call("rigs", "new", "small", "--area-A", "700", "--area-B", "500", *SIZES, "-o", path)
    run = integrate_run(Experiment.of(rig=path, command="5 sin(2t)", duration=4.0), ())
    assert run.error < 100.0
    assert run["x"].max() - run["x"].min() > 0.01


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (("--area-A", "0", "--area-B", "500"), "area-A must be > 0, got 0"),
        (("--area-A", "500 kg", "--area-B", "500"), "--area-A must have a unit of area, such as m^2, got kg"),
        (("--area-A", "500", "--area-B", "500", "-o", "press.txt"), "a rig's file must end in .toml, got press.txt"),
    ],
)
def test_a_wrong_size_is_one_line_and_writes_nothing(call, tmp_path, monkeypatch, words, rule):
    monkeypatch.chdir(tmp_path)
    assert call("rigs", "new", "press", *words, *SIZES).refused().startswith(rule)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_exists_is_kept(call, tmp_path):
    path = tmp_path / "press.toml"
    path.write_text("mine")
    words = ("--area-A", "500", "--area-B", "500", *SIZES, "-o", path)
    assert call("rigs", "new", "press", *words).refused().endswith("which exists")
    assert path.read_text() == "mine"
    assert "name of a rig must consist of letters" in call("rigs", "new", 'a"b', *words).refused()


def test_margins_of_an_unknown_controller_are_refused(call):
    assert "controller must be one of pi" in call("rigs", "margins", "--controller", "pid").refused()


@pytest.mark.slow
def test_margins_of_a_loop_are_printed(call):
    done = call("rigs", "margins", "thesis-closed-loop", "--controller", "pi")
    assert (done.status, done.err) == (0, "")
    rows = [line.split() for line in done.out.splitlines()[2:] if "damped" not in line]
    assert [float(row[0]) for row in rows] == [0.0, 0.01, 0.02, 0.05]
    assert all(float(row[1]) > 6.0 for row in rows)
    for phase, peak in ((math.radians(float(row[2])), float(row[5])) for row in rows):
        assert peak > 0.9 / (2.0 * math.sin(0.5 * phase))  # |1 + L| where |L| = 1
        assert peak < 1.2 or phase < math.radians(20.0)  # the resonance of piston and oil
    assert max(map(len, done.out.splitlines())) <= 80
