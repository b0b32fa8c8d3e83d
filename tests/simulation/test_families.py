"""Families of machines that depart from the bench, and what their departures do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sealscope.campaigns.plans.reader import load_plan
from sealscope.parameters import load_rig
from sealscope.parameters.rig import Rig
from sealscope.physics.rig import rig_numbers
from sealscope.signals.recursion import filter_recursively
from sealscope.simulation.bench.machines import draw
from sealscope.simulation.bench.profile import load_profile
from sealscope.simulation.changes import ParameterDrift, linear_path
from sealscope.simulation.commands import Alternating, Sine, parse_command
from sealscope.simulation.instruments import filter_first_order, sample_with_jitter
from sealscope.simulation.simulate import simulate

from ..refusals import refusal


@pytest.fixture(scope="module")
def unmodelled():
    return load_profile("unmodelled")


def test_each_family_is_either_for_development_or_held_out(unmodelled):
    """What is judged was not developed on, and nothing is left out."""
    halves = [load_plan(name).factors["family"] for name in ("bench-unmodelled-development", "bench-unmodelled")]
    assert not set(halves[0]) & set(halves[1])
    assert {*halves[0], *halves[1]} == {family.name for family in unmodelled.families}
    assert abs(len(halves[0]) - len(halves[1])) <= 2


def test_a_family_departs_in_what_it_says_and_in_nothing_else(unmodelled):
    base, heavy = draw(unmodelled, 5), draw(unmodelled, 5, family="moving mass")
    assert base == replace(draw("bench", 5), profile="unmodelled")
    assert {**heavy.overrides, **base.overrides} == heavy.overrides
    assert set(heavy.overrides) - set(base.overrides) == {"cylinder.M_eq"}
    assert (heavy.command, heavy.drifts) == (base.command, base.drifts)
    mass = load_rig("thesis").cylinder.M_eq
    drawn = [draw(unmodelled, seed, family="moving mass").overrides["cylinder.M_eq"] / mass for seed in range(60)]
    assert 0.7 <= min(drawn) < 0.75
    assert 1.25 < max(drawn) <= 1.3


def test_values_are_drawn_from_a_list_and_replace_the_profiles(unmodelled):
    machines = [draw(unmodelled, seed, family="clock and converter") for seed in range(60)]
    assert {machine.overrides["daq.bits"] for machine in machines} == {12, 13, 14, 16}
    assert max(machine.overrides["sensors.p_A.delay"] for machine in machines) > 1e-3


def test_warming_oil_warms(unmodelled):
    for seed in range(10):
        machine = draw(unmodelled, seed, family="warming oil")
        at_end = {drift.parameter: float(drift.shape.value_at(np.array(180.0))) for drift in machine.drifts}
        assert at_end["friction.F_v"] < -0.3
        assert at_end["pump.G_pump"] > 0.9
        machine.experiment()  # every drift stays within what its parameter may be


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[family]]\nname = "a"\n', "family[1].why"),
        ('[[family]]\nname = "a"\nwhy = "b"\nwarm = true\n', "family[1].warm"),
        ('[[family]]\nname = "a"\nwhy = "b"\n[[family]]\nname = "a"\nwhy = "b"\n', "names"),
        (
            '[[family]]\nname = "a"\nwhy = "b"\n[[family.nuisance]]\nname = "c"\nwhy = "d"\n'
            'parameters = ["daq.bits"]\nvalues = ["x"]\nunit = "bit"\n',
            "values, 'x'",
        ),
        (
            '[[family]]\nname = "a"\nwhy = "b"\n[[family.nuisance]]\nname = "c"\nwhy = "d"\n'
            'parameters = ["cylinder.volumes"]\nvalues = ["moving"]\n',
            "values, fixed, position, 'moving'",
        ),
        (  # with oil that may cool, a drift along it may fall
            '[[family]]\nname = "a"\nwhy = "b"\n[[family.nuisance]]\nname = "c"\nwhy = "d"\nparameters = ["G_pump"]\n'
            'scale = [1, 2]\ndrift = { size = [100, 230], unit = "%", oil = 1 }\n',
            "family[1], c, size, warms, 100 % to 230 %",
        ),
    ],
)
def test_a_family_that_breaks_a_rule_is_one_line(tmp_path, text, words):
    path = tmp_path / "odd.toml"
    path.write_text('[profile]\nname = "odd"\ntitle = "Odd"\nextends = "bench"\n' + text, encoding="utf-8")
    with refusal("odd.toml", *words.split(", ")):
        load_profile(path)


def test_an_unknown_family_is_named(unmodelled):
    with refusal("hoses", "'pipes'"):
        draw(unmodelled, 1, family="pipes")


def test_a_rig_written_down_before_a_parameter_was_known_loads():
    rig = load_rig("thesis")
    tree = rig.as_dict()
    del tree["cylinder"]["k_load"], tree["daq"]["jitter"], tree["sensors"]["p_A"]["lag"]
    again = Rig.from_dict(tree, place="log.nc")
    assert again == rig
    assert "cylinder.k_load" not in rig.present_values()
    assert rig.with_overrides({"k_load": 5.0}).present_values()["cylinder.k_load"] == 5.0


def test_equal_hoses_are_larger_chambers():
    piped = simulate(duration=3.0, set={"V_hose_A": "100[cm^3]", "V_hose_B": "100[cm^3]"}, seed=1)
    large = simulate(duration=3.0, set={"V": "334[cm^3]"}, seed=1)
    for name in ("p_A", "p_B", "x"):
        assert np.array_equal(piped[name], large[name])


def test_unequal_hoses_are_unequal_volumes():
    numbers = rig_numbers(load_rig("thesis").with_overrides({"V_hose_B": "117[cm^3]"}))
    assert pytest.approx(1.5, rel=1e-12) == numbers.V_B / numbers.V_A


def test_the_springs_force_is_that_of_its_deflection():
    """What the spring adds to the pressure difference over a stroke is k x/A."""
    sprung, free = (
        simulate(command="8 sin(t)", x_0=-0.2, duration=6.3, set=set, seed=2) for set in ({"k_load": 300.0}, {})
    )
    change = (sprung["p_A"] - sprung["p_B"]) - (free["p_A"] - free["p_B"])
    force = change * load_rig("thesis").cylinder.A_A
    assert np.ptp(sprung["x"]) > 0.1
    assert np.polyfit(sprung["x"], force, 1)[0] == pytest.approx(300.0, rel=0.05)


def test_a_load_that_drifts_moves_the_pressures_by_its_force():
    """Between a run with a growing force and one without, the mean pressure difference grows by force over area."""
    size, duration = 60.0, 12.0
    drift = ParameterDrift("F_l", linear_path(size, duration), absolute=True)
    loaded, free = (simulate(duration=duration, seed=2, drifts=drifts) for drifts in ((drift,), ()))
    change = (loaded["p_A"] - loaded["p_B"]) - (free["p_A"] - free["p_B"])
    whole = round(2 * math.pi / 4.0 * 500)  # one stroke back and forth
    area = load_rig("thesis").cylinder.A_A
    early, late = change[:whole].mean(), change[-whole:].mean()
    assert late - early == pytest.approx(size * (duration - whole / 500) / duration / area, rel=0.1)
    with refusal("F_l"):
        ParameterDrift("F_l", linear_path(0.1, 1.0))


@pytest.mark.parametrize("lag", [0.0005, 0.004, 0.03])
def test_a_slow_transducer_answers_a_ramp_as_the_closed_form(lag):
    """lag y' + y = r t from rest: y = r (t - lag (1 - exp(-t/lag)))."""
    t = np.arange(400) / 2000.0
    expected = t - lag * (1.0 - np.exp(-t / lag))
    assert filter_first_order(t, lag, 2000.0) == pytest.approx(expected, abs=1e-12)
    assert filter_first_order(np.full(5, 3.0), lag, 2000.0) == pytest.approx(np.full(5, 3.0), rel=1e-12)
    assert filter_first_order(t, 0.0, 2000.0) is t


def test_a_recursive_filter_equals_that_of_scipy():
    random = np.random.default_rng(89)
    for _ in range(20):
        values = random.normal(3.0, 1.0, random.integers(1, 400))
        decay, b_0, b_1, carried = random.uniform(-1.0, 1.0, 4)
        expected, _ = lfilter([b_0, b_1], [1.0, -decay], values, zi=[carried])
        np.testing.assert_allclose(filter_recursively(values, decay, b_0, b_1, carried), expected, rtol=0, atol=1e-12)


def test_a_jittering_clock_samples_where_it_says():
    f, interval = 60.0, 1.0 / 2000.0
    t = np.arange(4000) * interval
    late = np.clip(0.4 * np.random.default_rng(1).standard_normal(1000), -1.0, 1.0)
    result = sample_with_jitter(lambda values: values[::4], np.sin(2 * np.pi * f * t), late)
    exact = np.sin(2 * np.pi * f * (t[::4] + late * interval))
    punctual = np.sin(2 * np.pi * f * t[::4])
    assert np.abs(result - exact)[1:].max() < 0.01 * np.abs(punctual - exact).max()


def test_harmonics_stand_beside_the_hum():
    quiet = {f"sensors.p_A.{name}": 0.0 for name in ("noise", "drift")} | {"sensors.common_noise": 0.0}
    loud = quiet | {"p_A.hum": "20[psi]", "p_A.hum_frequency": 20.0, "p_A.hum_harmonics": 0.5}
    still = simulate(command="0 sin(4t)", duration=10.0, set=loud, seed=4)
    amplitude = 2.0 * np.abs(np.fft.rfft(still["p_A"] - still["p_A"].mean())) / len(still)
    psi = 6894.757293168361
    for order in range(1, 6):
        assert amplitude[200 * order] / psi == pytest.approx(20.0 * 0.5 ** (order - 1), abs=0.05)
    assert amplitude[1200] / psi < 0.05


def test_a_duty_in_turn_is_its_sines_one_after_the_other():
    text = "2 periods of 5 sin(2t), 3 periods of 3 sin(4t)"
    duty = parse_command(text)
    assert isinstance(duty, Alternating)
    assert str(duty) == text
    first, second = 2 * np.pi, 3 * np.pi / 2
    t = np.linspace(0.0, first, 50, endpoint=False)
    assert duty.volts(t) == pytest.approx(5 * np.sin(2 * t), abs=1e-12)
    t = np.linspace(0.0, second, 50, endpoint=False)
    for turn in (first, 2 * first + second):
        assert duty.volts(turn + t) == pytest.approx(3 * np.sin(4 * t), abs=1e-12)
    with refusal("sines"):
        Alternating(((2, Sine(1.0, 2.0, 0.5)),))
    with refusal("command"):
        parse_command("2 periods of step 5")
