"""Drifts within a run, instruments that change, and machines drawn from a profile."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sealscope.errors import InputError
from sealscope.parameters import load_rig
from sealscope.physics.rig import rig_numbers
from sealscope.simulation.bench import centred_start, draw
from sealscope.simulation.changes import LONGEST_BLOCK, Effect, Schedule
from sealscope.simulation.drifts import RESOLUTION, Drift, Linear, Table, Wander
from sealscope.simulation.experiment import make_experiment
from sealscope.simulation.instruments import FILTER_REACH, decimate
from sealscope.simulation.profile import Profile, load_profile
from sealscope.simulation.rig_faults import FrictionChange, PumpLeakage
from sealscope.simulation.simulate import run, simulate

PSI = 6894.757293168361
PRESSURES = ("p_1", "p_2", "p_A", "p_B")
QUIET = {"sensors.common_noise": 0.0, "bits": 24} | {
    f"sensors.{name}.{what}": 0.0 for name in PRESSURES for what in ("noise", "drift")
}
LINEAR = {"F_pr": 0.0, "F_cfr": 0.0, "G_pump": 3e-13}


# -- drifts of the machine ------------------------------------------------------------------------------------------


def test_a_drifting_viscous_friction_follows_the_equation_with_time_in_it():
    """The linear rig with F_v(t) = F_v (1 + 0.3 t/20), against an independent program that has F_v in its equations."""
    rig = load_rig().with_values(LINEAR)
    drift = Drift("friction.F_v", Linear(0.3, 20.0))
    common = {"rig": rig, "duration": 20.0, "values": {"sample_rate": "100[Hz]"}}
    drifting, constant = (run(make_experiment(**common, drifts=d)).truth for d in ((drift,), ()))
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
    still = simulate(duration=3.0, seed=4, drifts=(Drift("K_oil", Linear(0.0, 3.0)), Drift("friction", Linear(0, 3))))
    for name in plain.channels:
        assert plain[name].tobytes() == still[name].tobytes()


@pytest.mark.parametrize("throttled", [False, True], ids=["free", "throttled"])
def test_a_number_that_steps_in_the_table_is_the_rig_with_that_number(throttled):
    """Pump leakage of three times from the start on is the rig with three times the pump leakage, to the last bit."""
    values = {"G_pump": 1e-13} | ({"orifices": "present", "closed_A": 0.5, "closed_B": 0.5} if throttled else {})
    changed = run(make_experiment(duration=3.0, values=values, fault=PumpLeakage(3.0))).truth.outputs
    built = run(make_experiment(duration=3.0, values={**values, "G_pump": 3.0 * 1e-13})).truth.outputs
    for name in ("x", "p_A", "p_B", "p_1"):
        np.testing.assert_array_equal(changed[name], built[name])


def test_the_oil_s_modulus_may_drift_without_making_oil():
    values = {"orifices": "present", "closed_A": 0.5, "closed_B": 0.5}
    drifts = (Drift("K_oil", Wander((0.1, -0.05), 5.0)), Drift("line.C_d", Linear(-0.2, 5.0)))
    o = run(make_experiment(duration=5.0, values=values, drifts=drifts)).truth.outputs
    rig = load_rig().with_values(values)
    held = rig.cylinder.V * (o["p_A"] + o["p_B"]) + rig.line.V_1 * (o["p_1"] + o["p_2"])
    np.testing.assert_allclose(held, held[0], rtol=1e-9)


def test_blocks_are_short_where_it_changes_fast_and_long_where_nothing_changes():
    base, rate = rig_numbers(load_rig()), 2000.0
    assert len(Schedule([], base, 10_000, rate).numbers) == 1
    fault = FrictionChange(1.5)
    step = [
        replace(e, jumps=(2.2001,), change=lambda t: np.where(t >= 2.2001, 1.5, 1.0)) for e in fault.effects(load_rig())
    ]
    found = Schedule(step, base, 10_000, rate)
    np.testing.assert_array_equal(found.bounds, [0, 4401, 10_000])  # the next output instant
    assert [one.F_v for one in found.numbers] == [300.0, 450.0]
    slow = Effect("F_v", lambda t: 1.0 + 1e-4 * t, RESOLUTION)
    quick = Effect("K_oil", lambda t: 1.0 + np.where(t > 3.0, 1e-2 * (t - 3.0), 0.0), RESOLUTION, jumps=(3.0,))
    found = Schedule([slow, quick], base, 10_000, rate)
    lengths = np.diff(found.bounds) / rate
    assert lengths.max() == LONGEST_BLOCK
    assert lengths[found.bounds[:-1] / rate >= 3.0].max() <= 0.05 + 1e-9
    moved = np.abs(np.diff([one.K_oil for one in found.numbers])) / base.K_oil
    assert moved.max() <= RESOLUTION * 1.001
    covered = [part for first in range(0, 10_000, 700) for part in found.within(first, min(first + 700, 10_000))]
    assert covered[0][0] == 0
    assert covered[-1][1] == 10_000
    assert all(one[1] == other[0] for one, other in pairwise(covered))


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: Drift("V_9", Linear(0.1, 1.0)), "'V_9' is not a parameter"),
        (lambda: Drift("cylinder.L", Linear(0.1, 1.0)), "cylinder.L cannot drift"),
        (lambda: Drift("daq.bits", Linear(0.1, 1.0)), "daq.bits cannot drift"),
        (lambda: Drift("volumes", Linear(0.1, 1.0)), "cylinder.volumes cannot drift"),
        (lambda: Drift("p_A.offset", Linear(0.1, 1.0)), "must be absolute"),
        (lambda: Drift("K_oil", Linear(0.1, 1.0), absolute=True), "must be relative"),
        (lambda: Linear(0.1, 0.0), "last > 0 s"),
        (lambda: Wander((float("nan"),), 1.0), "finite weights"),
        (lambda: Table(np.array([1.0, 0.0]), np.zeros(2)), "times must rise"),
        (lambda: make_experiment(duration=9.0, drifts=(Drift("F_v", Linear(-1.2, 9.0)),)), "above -100 %, got -120 %"),
    ],
)
def test_an_impossible_drift_is_refused(make, rule):
    with pytest.raises(InputError, match=rule) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_wander_is_the_sum_it_says_and_starts_at_nothing():
    t = np.linspace(0.0, 12.0, 700)
    wander = Wander((0.3, -0.2, 0.1), 10.0, 0.05)
    expected = 0.05 * t / 10 + sum(w * np.sin((k + 0.5) * np.pi * t / 10) for k, w in enumerate(wander.weights))
    np.testing.assert_allclose(wander.at(t), expected, atol=1e-14)
    assert wander.at(np.zeros(1))[0] == 0.0
    assert np.ptp(wander.scaled(0.08).at(np.linspace(0, 10, 1001))) == pytest.approx(0.08)
    assert Table(np.array([0.0, 4.0]), np.array([0.0, 0.2])).at(np.array([2.0, 9.0])) == pytest.approx([0.1, 0.2])


# -- instruments ----------------------------------------------------------------------------------------------------


def test_noise_bias_and_hum_drift_at_the_instruments_alone():
    values = {**QUIET, "sensors.p_A.noise": 5e3, "sensors.p_B.hum": 5e3}
    drifts = (
        Drift("sensors.p_A.noise", Linear(0.5, 60.0)),
        Drift("sensors.p_1.offset", Linear(3000.0, 60.0), absolute=True),
        Drift("sensors.p_B.hum", Linear(1.0, 60.0)),
    )
    common = {"command": "step 0", "duration": 60.0, "values": values}
    plain, drifting = (run(make_experiment(**common, drifts=d)) for d in ((), drifts))
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
    seen = decimate(np.sin(2 * np.pi * 40.0 * t), factor, n, delay)
    expected = np.sin(2 * np.pi * 40.0 * (np.arange(n) / 500.0 - delay / rate))
    np.testing.assert_allclose(seen[60:], expected[60:], atol=2e-4)


def test_skew_and_scale_are_seen_in_the_channel_that_has_them():
    plain = simulate(duration=4.0, values=QUIET)
    skewed = simulate(duration=4.0, values={**QUIET, "sensors.p_A.delay": "2[ms]", "sensors.x.scale_error": "1 %"})
    np.testing.assert_allclose(skewed["p_A"][1:], plain["p_A"][:-1], atol=5.0)  # one sample at 500 Hz
    np.testing.assert_array_equal(skewed["p_B"], plain["p_B"])
    np.testing.assert_allclose(skewed["x"], 1.01 * plain["x"], atol=41e-6)


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
    drawn = (np.array([machine.values[name] for machine in machines]) - low) / (high - low)
    assert drawn.min() >= -1e-12
    assert drawn.max() <= 1 + 1e-12
    counts, _ = np.histogram(drawn, 5, (0, 1))
    assert counts.min() > 50  # 80 expected, deviation 8
    assert counts.max() < 112


def test_what_does_not_differ_is_the_same_on_every_machine(machines):
    for machine in machines[:20]:
        assert machine.values["daq.bits"] == 14
        assert machine.values["sensors.x.resolution"] == pytest.approx(20e-6)
        assert machine.values["sensors.theta.counts"] == 20_000
        assert machine.values["sensors.common_noise"] == 0.0


def test_friction_differs_and_drifts_as_one(machines):
    rig, names = load_rig(), ("friction.F_pr", "friction.F_cfr", "friction.F_v")
    factors = np.array([[m.values[name] / rig[name] for name in names] for m in machines])
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
    spans = [np.ptp(d.shape.at(t)) for m in machines for d in m.drifts if d.parameter == name]
    assert len(spans) == len(machines)
    assert min(spans) >= low * (1 - 1e-9)
    assert max(spans) <= high * (1 + 1e-9)
    assert max(spans) - min(spans) >= 0.9 * (high - low)


def test_warmer_oil_moves_friction_and_modulus_down_and_pump_leakage_up(machines):
    t = np.linspace(0.0, 180.0, 200)
    names = ("friction.F_v", "fluid.K_oil", "pump.G_pump", "sensors.p_A.noise")
    paths = np.array([[d.shape.at(t) for n in names for d in m.drifts if d.parameter == n] for m in machines])
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
        found = Schedule(experiment.effects(), rig_numbers(experiment.rig), 360_000, 2000.0)
        assert np.diff(found.bounds).max() <= LONGEST_BLOCK * 2000
        for field in ("K_oil", "F_v", "G_pump"):
            values = np.array([getattr(one, field) for one in found.numbers])
            assert np.ptp(values) > 0.02 * values[0]
            assert np.abs(np.diff(values) / values[1:]).max() <= 1.05 * RESOLUTION


def test_the_same_seed_is_the_same_machine_and_the_same_bytes(bench):
    assert draw(bench, 7) == draw("bench", 7)
    assert draw(bench, 7) != draw(bench, 8)
    one, again = (run(draw("bench", 7, duration=4.0).experiment(leak="G = 6e-13 from 2 s")) for _ in range(2))
    for name in one.recording.channels:
        assert one.recording[name].tobytes() == again.recording[name].tobytes()
    other = run(draw("bench", 8, duration=4.0).experiment()).recording
    assert not np.array_equal(one.recording["p_A"], other["p_A"])
    assert "drift" not in str(dict(one.recording.provenance)["experiment"]).replace(".drift", "")
    assert len(one.truth.drifts) == len(draw("bench", 7).drifts)


def test_one_nuisance_less_leaves_the_others_as_they_were(bench):
    fewer = replace(bench, nuisances=tuple(n for n in bench.nuisances if n.name not in ("bulk modulus", "bias")))
    whole, part = draw(bench, 5), draw(fewer, 5)
    assert "fluid.K_oil" not in part.values
    assert all(whole.values[name] == value for name, value in part.values.items())
    assert set(part.drifts) < set(whole.drifts)
    assert (part.command, part.closed) == (whole.command, whole.closed)


def test_a_machine_applies_to_another_rig_and_duty():
    rig = load_rig().with_values({"F_v": "400[N s/m]"})
    built = draw("bench", 3, rig=rig, duration=2.0).experiment(command="2 sin(3t)", seed=99)
    assert built.rig["F_v"] == pytest.approx(draw("bench", 3).values["friction.F_v"] * 400.0 / 300.0)
    assert built.rig["fluid.K_oil"] == draw("bench", 3).values["fluid.K_oil"]
    assert str(built.command) == "2 sin(3t)"
    assert built.seed == 99
    assert built.rig.entry("K_oil").source == "drawn from profile bench, seed 3"


@pytest.mark.parametrize("command", ["8 sin(t)", "5 sin(2t)", "ramp 3 from 1 s to 2 s"])
def test_strokes_lie_about_the_middle(command):
    rig = load_rig().with_values({"omega_per_volt": 26.7})
    duration = 6.0 if "ramp" in command else 40.0
    x_0 = centred_start(rig, command, duration)
    x = run(make_experiment(rig=rig, command=command, duration=duration, x_0=x_0)).truth.outputs["x"]
    assert abs(x.max() + x.min()) < 0.02 * np.ptp(x) + 1e-3
    assert np.ptp(x) > 0.05


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
    assert 6e8 <= machine.values["fluid.K_oil"] <= 7e8
    assert machine.closed == 0.5
    assert 1.0 <= machine.command.amplitude <= 2.0
    assert [drift.parameter for drift in machine.drifts] == ["fluid.K_oil"]
    assert draw(str(write(tmp_path, SMALL)), 1, duration=30.0) == machine


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ('unit = "bar"', 'unit = "mm"', "mm"),
        ('unit = "bar"', "", "unit of oil must be a text, got None"),
        ("range = [6000, 7000]", "range = [7000, 6000]", "must be .low, high. with low <= high"),
        ("range = [6000, 7000]", "", "must have a range with its unit or a scale without one"),
        ("range = [6000, 7000]", "scale = [0.5, 2]", "must have a range with its unit or a scale without one"),
        ('parameters = ["K_oil"]', 'parameters = ["K_ol"]', "'K_ol' is not a parameter; did you mean K_oil"),
        ('parameters = ["K_oil"]', 'parameters = ["volumes"]', "is a choice"),
        ('parameters = ["K_oil"]', 'parameters = ["K_oil", "F_v"]', "must have one unit"),
        ('parameters = ["K_oil"]', 'parameters = ["p_charge"]', "p_charge cannot drift"),
        ('parameters = ["K_oil"]', "parameters = []", "must be a list of names"),
        ('why = "measured"', "", "why of oil must be a text, got None"),
        ("size = [1, 2]", "size = [-1, 2]", "must be >= 0"),
        ('unit = "%" }', 'unit = "%", oil = 2 }', "weight in -1..1, got 2"),
        ('unit = "%" }', 'unit = "%", shapes = ["zigzag"] }', "must be of linear, wander"),
        ('unit = "%" }', 'unit = "%", shapes = ["linear"], oil = 1 }', "must have shapes or oil, got both"),
        ('unit = "%" }', 'unit = "%", speed = 1 }', "speed is not known in the drift of oil"),
        ('["2 sin(3t)"]', '["2 cos(3t)"]', "command must be like"),
        ('["2 sin(3t)"]', '["step 2"]', "'step 2' has no amplitude"),
        ("closed = [50]", "closed = [100]", "per cent, 0 to 99"),
        ('title = "two nuisances"', "", "title of .profile. must be a text"),
        ("[profile]", "[profile", "a profile must be TOML"),
    ],
)
def test_a_profile_with_a_slip_is_refused_in_one_line_with_its_place(tmp_path, old, new, rule):
    assert SMALL.count(old) == 1
    path = write(tmp_path, SMALL.replace(old, new))
    with pytest.raises(InputError, match=rule) as caught:
        load_profile(path)
    assert "\n" not in str(caught.value)
    assert "mine.toml" in str(caught.value)


def test_an_unknown_or_unreadable_profile_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"'banch' is no packaged profile \(bench\)"):
        load_profile("banch")
    with pytest.raises(InputError, match="profile must be readable, got: No such file"):
        load_profile(tmp_path / "none.toml")
    twice = SMALL + SMALL[SMALL.index("[[nuisance]]") :].replace('name = "oil"', 'name = "oil again"')
    with pytest.raises(InputError, match=r"fluid.K_oil must be in one nuisance, got oil and oil again"):
        load_profile(write(tmp_path, twice))
    with pytest.raises(InputError, match="seed must be >= 0, got -1"):
        draw("bench", -1)
