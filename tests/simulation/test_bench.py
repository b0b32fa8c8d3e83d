"""Machines drawn from a profile: the packaged bench, and profiles of one's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.parameters import load_rig
from sealscope.physics.rig import rig_numbers
from sealscope.simulation.bench.machines import centred_start, draw
from sealscope.simulation.bench.profile import Profile, load_profile
from sealscope.simulation.changes import LONGEST_BLOCK, MAX_RELATIVE_CHANGE, Schedule
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

from ..refusals import refusal

PSI = 6894.757293168361


# -- the bench ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench() -> Profile:
    return load_profile("bench")


@pytest.fixture(scope="module")
def machines(bench):
    return [draw(bench, seed) for seed in range(400)]


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("fluid.K_oil", 550e6, 800e6),
        ("pump.G_pump", 1.2e-13, 3.6e-13),
        ("fluid.p_charge", 0.22e6, 0.34e6),
        ("sensors.p_A.noise", 1.125 * PSI, 1.375 * PSI),
        ("sensors.p_B.offset", -2 * PSI, 2 * PSI),
        ("sensors.p_1.hum", 0.0, 0.5 * PSI),
        ("sensors.p_2.delay", 0.0, 0.2e-3),
        ("sensors.x.scale_error", -1e-3, 1e-3),
    ],
)
def test_what_differs_between_machines_fills_its_range_evenly(machines, name, low, high):
    drawn = (np.array([machine.overrides[name] for machine in machines]) - low) / (high - low)
    assert drawn.min() >= -1e-12
    assert drawn.max() <= 1 + 1e-12
    counts, _ = np.histogram(drawn, 5, (0, 1))
    assert counts.min() > 50  # 80 expected, deviation 8
    assert counts.max() < 112


def test_what_does_not_differ_is_the_same_on_every_machine(machines):
    for machine in machines[:20]:
        assert machine.overrides["daq.bits"] == 14
        assert machine.overrides["sensors.x.resolution"] == pytest.approx(20e-6)
        assert machine.overrides["sensors.theta.counts"] == 20_000
        assert machine.overrides["sensors.common_noise"] == 0.0


def test_friction_differs_and_drifts_as_one(machines):
    rig, names = load_rig(), ("friction.F_pr", "friction.F_cfr", "friction.F_v")
    factors = np.array([[m.overrides[name] / rig[name] for name in names] for m in machines])
    np.testing.assert_allclose(factors, np.broadcast_to(factors[:, :1], factors.shape), rtol=1e-12)
    assert factors.min() >= 0.9 - 1e-12
    assert factors.max() <= 1.1 + 1e-12
    assert factors.max() - factors.min() > 0.19
    for machine in machines[:20]:
        shapes = {drift.parameter: drift.shape for drift in machine.drifts}
        assert shapes["friction.F_pr"] == shapes["friction.F_v"] == shapes["friction.F_cfr"]


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("friction.F_v", 0.04, 0.08),
        ("fluid.K_oil", 0.03, 0.03),
        ("pump.G_pump", 0.08, 0.08),
        ("sensors.p_A.noise", 0.04, 0.04),
        ("sensors.p_A.offset", 0.0, 0.5 * PSI),
    ],
)
def test_what_drifts_within_a_record_stays_within_its_size(machines, name, low, high):
    t = np.linspace(0.0, 180.0, 1001)
    spans = [np.ptp(d.shape.value_at(t)) for m in machines for d in m.drifts if d.parameter == name]
    assert len(spans) == len(machines)
    assert min(spans) >= low * (1 - 1e-9)
    assert max(spans) <= high * (1 + 1e-9)
    assert max(spans) - min(spans) >= 0.9 * (high - low)


def test_warmer_oil_moves_friction_and_modulus_down_and_pump_leakage_up(machines):
    t = np.linspace(0.0, 180.0, 200)
    names = ("friction.F_v", "fluid.K_oil", "pump.G_pump", "sensors.p_A.noise")
    paths = np.array([[d.shape.value_at(t) for n in names for d in m.drifts if d.parameter == n] for m in machines])
    ends = paths[:, :, -1] / np.ptp(paths, axis=2)
    together = ends.T @ ends / len(machines)  # warming is the rule, so the mean belongs to it
    assert together[0, 1] > 0.2
    assert together[0, 2] < -0.2
    assert together[1, 2] < -0.2
    assert np.abs(together[3, :3]).max() < 0.1
    assert np.mean(ends, axis=0)[2] > 0.25 > -0.25 > np.mean(ends, axis=0)[0]


def test_every_duty_is_drawn(machines):
    duties = {(str(machine.command), machine.closed) for machine in machines}
    assert len(duties) == 16
    assert {str(machine.command) for machine in machines} == {"3 sin(4t)", "5 sin(2t)", "7 sin(4t)", "8 sin(1t)"}


def test_a_drift_of_the_bench_moves_less_than_its_resolution_from_block_to_block(machines):
    for machine in machines[:12]:
        experiment = machine.experiment()
        result = Schedule(experiment.effects(), rig_numbers(experiment.rig), 360_000, 2000.0)
        assert np.diff(result.bounds).max() <= LONGEST_BLOCK * 2000
        for field in ("K_oil", "F_v", "G_pump"):
            values = np.array([getattr(one, field) for one in result.numbers])
            assert np.ptp(values) > 0.02 * values[0]
            assert np.abs(np.diff(values) / values[1:]).max() <= 1.05 * MAX_RELATIVE_CHANGE


def test_the_same_seed_is_the_same_machine_and_the_same_bytes(bench):
    assert draw(bench, 7) == draw("bench", 7)
    assert draw(bench, 7) != draw(bench, 8)
    one, again = (
        simulate_experiment(draw("bench", 7, duration=4.0).experiment(leak="G = 6e-13 from 2 s")) for _ in range(2)
    )
    for name in one.recording.channels:
        assert one.recording[name].tobytes() == again.recording[name].tobytes()
    other = simulate_experiment(draw("bench", 8, duration=4.0).experiment()).recording
    assert not np.array_equal(one.recording["p_A"], other["p_A"])
    assert "drift" not in str(dict(one.recording.provenance)["experiment"]).replace(".drift", "")
    assert len(one.truth.drifts) == len(draw("bench", 7).drifts)


def test_one_nuisance_less_leaves_the_others_as_they_were(bench):
    fewer = replace(bench, nuisances=tuple(n for n in bench.nuisances if n.name not in ("bulk modulus", "bias")))
    whole, part = draw(bench, 5), draw(fewer, 5)
    assert "fluid.K_oil" not in part.overrides
    assert all(whole.overrides[name] == value for name, value in part.overrides.items())
    assert set(part.drifts) < set(whole.drifts)
    assert (part.command, part.closed) == (whole.command, whole.closed)


def test_a_machine_applies_to_another_rig_and_duty():
    rig = load_rig().with_overrides({"F_v": "400[N s/m]"})
    built = draw("bench", 3, rig=rig, duration=2.0).experiment(command="2 sin(3t)", seed=99)
    assert built.rig["F_v"] == pytest.approx(draw("bench", 3).overrides["friction.F_v"] * 400.0 / 300.0)
    assert built.rig["fluid.K_oil"] == draw("bench", 3).overrides["fluid.K_oil"]
    assert str(built.command) == "2 sin(3t)"
    assert built.seed == 99
    assert built.rig.entry("K_oil").source == "drawn from profile bench, seed 3"


@pytest.mark.parametrize("command", ["8 sin(t)", "5 sin(2t)", "ramp 3 from 1 s to 2 s"])
def test_strokes_lie_about_the_middle(command):
    rig = load_rig().with_overrides({"omega_per_volt": 26.7})
    duration = 6.0 if "ramp" in command else 40.0
    x_0 = centred_start(rig, command, duration)
    x = simulate_experiment(Experiment.of(rig=rig, command=command, duration=duration, x_0=x_0)).truth.outputs["x"]
    assert abs(x.max() + x.min()) < 0.02 * np.ptp(x) + 1e-3
    assert np.ptp(x) > 0.05


@pytest.mark.long
@pytest.mark.slow
def test_strokes_behind_a_valve_lie_about_the_middle():
    rig, command = load_rig("servo-valve"), "8 sin(t)"
    x_0 = centred_start(rig, command, 14.0)
    x = simulate_experiment(Experiment.of(rig=rig, command=command, duration=14.0, x_0=x_0)).truth.outputs["x"]
    assert abs(x.max() + x.min()) < 0.05 * np.ptp(x)  # friction and the supply take a little
    assert 0.3 < np.ptp(x) < 0.55


def test_a_machine_behind_a_valve_differs_in_its_supply_and_its_edges():
    built = draw("valve", 4, rig="servo-valve", duration=2.0, family="servo valve").experiment(command="2 sin(3t)")
    assert 0.97 * 7e6 <= built.rig["supply.p_set"] <= 1.03 * 7e6
    assert built.rig["supply.p_set"] != 7e6
    overlaps = {built.rig[f"valve.{name}"] for name in ("o_PA", "o_AT", "o_PB", "o_BT")}
    assert len(overlaps) == 4
    assert max(map(abs, overlaps)) <= 5e-6
    assert any(drift.parameter == "supply.p_set" for drift in built.drifts)


# -- profiles of one's own ------------------------------------------------------------------------------------------

SMALL = """
[profile]
name = "mine"
title = "two nuisances"
[duty]
commands = ["2 sin(3t)"]
closed = [50]
amplitude = [0.5, 1.0]
why = "ours"
[[nuisance]]
name = "oil"
parameters = ["K_oil"]
range = [6000, 7000]
unit = "bar"
drift = { size = [1, 2], unit = "%" }
why = "measured"
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_a_profile_of_one_s_own(tmp_path):
    machine = draw(load_profile(write(tmp_path, SMALL)), 1, duration=30.0)
    assert 6e8 <= machine.overrides["fluid.K_oil"] <= 7e8
    assert machine.closed == 0.5
    assert 1.0 <= machine.command.amplitude <= 2.0
    assert [drift.parameter for drift in machine.drifts] == ["fluid.K_oil"]
    assert draw(str(write(tmp_path, SMALL)), 1, duration=30.0) == machine


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('unit = "bar"', 'unit = "mm"', "mm"),
        ('unit = "bar"', "", "oil, range, scale"),
        ("range = [6000, 7000]", "range = [7000, 6000]", "low, high"),
        ("range = [6000, 7000]", "", "range, scale"),
        ("range = [6000, 7000]", "scale = [0.5, 2]", "range, scale"),
        ('parameters = ["K_oil"]', 'parameters = ["K_ol"]', "'K_ol', K_oil"),
        ('parameters = ["K_oil"]', 'parameters = ["volumes"]', "volumes"),
        ('parameters = ["K_oil"]', 'parameters = ["K_oil", "F_v"]', "unit"),
        ('parameters = ["K_oil"]\nrange = [6000, 7000]\nunit = "bar"\ndrift = { size = [1, 2], unit = "%" }',
         'parameters = ["sensors.p_A.offset", "sensors.p_A.gain_error"]\nscale = [1, 2]\n'
         'drift = { size = [1, 2], unit = "bar" }', "oil, 1, Pa"),
        ('parameters = ["K_oil"]', 'parameters = ["p_charge"]', "p_charge"),
        ('parameters = ["K_oil"]', "parameters = []", "nuisance[1].parameters"),
        ('why = "measured"', "", "nuisance[1].why"),
        ("size = [1, 2]", "size = [-1, 2]", "size"),
        ("size = [1, 2]", "size = [1, 100]", "oil, size, 1 % to 100 %"),
        ('size = [1, 2], unit = "%"', 'size = [1, 120], unit = "%", oil = 1', "oil, size, 120 %"),
        ('unit = "%" }', 'unit = "%", oil = 2 }', "drift.oil, 2, 1"),
        ('unit = "%" }', 'unit = "%", shapes = ["zigzag"] }', "'linear', 'wander', 'zigzag'"),
        ('unit = "%" }', 'unit = "%", shapes = ["linear"], oil = 1 }', "shapes, oil"),
        ('unit = "%" }', 'unit = "%", speed = 1 }', "drift.speed"),
        ('["2 sin(3t)"]', '["2 cos(3t)"]', "command"),
        ('["2 sin(3t)"]', '["step 2"]', "'step 2'"),
        ("closed = [50]", "closed = [100]", "100, 99"),
        ('title = "two nuisances"', "", "profile.title"),
        ("[profile]", "[profile", "TOML"),
    ],
)  # fmt: skip
def test_a_profile_with_a_slip_is_refused_in_one_line_with_its_place(tmp_path, old, new, words):
    assert SMALL.count(old) == 1
    path = write(tmp_path, SMALL.replace(old, new))
    with refusal(*words.split(", "), "mine.toml"):
        load_profile(path)


def test_an_unknown_or_unreadable_profile_is_refused(tmp_path):
    with refusal("'banch'", "bench", "single-rod"):
        load_profile("banch")
    with refusal("profile"):
        load_profile(tmp_path / "none.toml")
    twice = SMALL + SMALL[SMALL.index("[[nuisance]]") :].replace('name = "oil"', 'name = "oil again"')
    with refusal("fluid.K_oil", "oil", "oil again"):
        load_profile(write(tmp_path, twice))
    with refusal("seed", "-1"):
        draw("bench", -1)
