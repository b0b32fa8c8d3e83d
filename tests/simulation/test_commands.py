"""Commands: what they are in time, and that their words say exactly what they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sealscope.errors import InputError
from sealscope.simulation.commands import (
    Chirp,
    MultiSine,
    PseudoRandom,
    Sine,
    Trapezoid,
    check_command,
    parse_command,
    ramp,
    sampled_signal,
    step,
)
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate, simulate_experiment

from ..refusals import refusal

number = st.floats(-1e6, 1e6, allow_subnormal=False)
positive = st.floats(1e-6, 1e6)
commands = st.one_of(
    st.builds(Sine, number, number, number, number),
    st.builds(step, number, number),
    st.tuples(number, number, positive).map(lambda n: ramp(n[0], n[1], np.nextafter(n[1] + n[2], np.inf))),
    st.builds(Chirp, number, st.floats(0, 1e4), st.floats(0, 1e4), positive),
    st.lists(st.builds(Sine, number, number, number), min_size=1, max_size=3).flatmap(
        lambda sines: st.builds(Sine, number, number, number, number).map(lambda last: MultiSine((*sines, last)))
    ),
    st.tuples(number, positive, st.floats(4.0, 9.0)).map(
        lambda n: Trapezoid(n[0], n[1], np.nextafter(n[1] * n[2], np.inf))
    ),
    st.builds(PseudoRandom, number, positive, st.integers(0, 2**40)),
)


@given(commands)
def test_a_command_s_words_read_back_as_the_same_command(command):
    assert parse_command(str(command)) == command


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("3 sin(4t)", Sine(3.0, 4.0)),
        ("3*sin(4*t)", Sine(3.0, 4.0)),
        ("SIN(t)", Sine(1.0, 1.0)),
        ("2.5 sin(4t + 0.5) - 1 V", Sine(2.5, 4.0, 0.5, -1.0)),
        ("2 sin(4t -1e-05)+1e-05", Sine(2.0, 4.0, -1e-5, 1e-5)),
        ("2 sin(3t) - sin(7t+1) + 0.5 V", MultiSine((Sine(2.0, 3.0), Sine(-1.0, 7.0, 1.0, 0.5)))),
        ("trapezoid 5 within 1 s every 8 s", Trapezoid(5.0, 1.0, 8.0)),
        ("step 5", step(5.0, 0.0)),
        ("step -5 V at 1 s", step(-5.0, 1.0)),
        ("ramp 5 from 1 s to 3 s", ramp(5.0, 1.0, 3.0)),
        ("ramp 5 over 3", ramp(5.0, 0.0, 3.0)),
        ("chirp 3 from 0.1 Hz to 5 Hz over 60 s", Chirp(3.0, 0.1, 5.0, 60.0)),
        ("prbs 2 every 0.5 s seed 7", PseudoRandom(2.0, 0.5, 7)),
    ],
)
def test_commands_are_read_from_words(text, command):
    assert parse_command(text) == command


@pytest.mark.parametrize(
    "text",
    [
        "",
        "sine",
        "3 cos(4t)",
        "step",
        "ramp 5",
        "ramp 5 from 3 s to 1 s",
        "chirp 3 from -1 to 5 over 60",
        "prbs 2 every 0 s",
        "1e999 sin(t)",
        "3 sin(4t); 4",
    ],
)
def test_other_words_are_refused_in_one_line(text):
    with pytest.raises(InputError) as caught:
        parse_command(text)
    assert "\n" not in str(caught.value)


def test_each_form_in_time():
    t = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(Sine(2.0, 3.0, 0.1, 1.0).volts(t), 1 + 2 * np.sin(3 * t + 0.1))
    np.testing.assert_array_equal(step(5.0, 1.0).volts(t), [0, 0, 5, 5, 5, 5])
    np.testing.assert_allclose(ramp(6.0, 1.0, 3.0).volts(t), [0, 0, 0, 3, 6, 6])
    np.testing.assert_allclose(
        sampled_signal(t[:3], np.array([1.0, 3.0, 2.0])).volts(np.array([0.25, 0.75, 9.0])), [2, 2.5, 2]
    )


def test_a_chirp_sweeps_evenly_and_then_holds_its_frequency():
    chirp = Chirp(1.0, 1.0, 5.0, 10.0)
    t = np.arange(0.0, 20.0, 1e-4)
    crossings = t[1:][np.diff(np.signbit(chirp.volts(t)).astype(int)) != 0]
    middles, frequency = (crossings[1:] + crossings[:-1]) / 2, 0.5 / np.diff(crossings)
    np.testing.assert_allclose(frequency, np.minimum(1.0 + 0.4 * middles, 5.0), atol=0.06)


def test_a_pseudo_random_command_is_binary_even_and_known_at_any_time():
    command = PseudoRandom(2.0, 0.1, seed=4)
    t = np.arange(0.05, 2000.0, 0.1)  # 20 000 slots
    u = command.volts(t)
    assert set(u) == {-2.0, 2.0}
    assert abs(np.mean(u)) < 0.06  # four standard deviations
    for lag in (1, 2, 5):
        assert abs(np.mean(u[lag:] * u[:-lag])) < 0.12
    late = np.array([123.45])
    assert command.volts(late) == u[np.argmin(np.abs(t - late))]  # asked alone or among others
    assert not np.array_equal(PseudoRandom(2.0, 0.1, seed=5).volts(t), u)
    assert np.isfinite(PseudoRandom(1.0, 1e-9).volts(np.array([180.0]))).all()  # no table of 1.8e11 draws
    assert command.volts(np.array([-1.0])) == 0.0


def test_a_command_beyond_the_converter_is_refused_with_value_and_time():
    with refusal("command", "+-10 V", "10.5 sin(4t)"):
        Experiment.of(command="10.5 sin(4t)", duration=5.0)
    Experiment.of(command="10 sin(4t)", duration=5.0)
    for bad in (step(float("nan")), step(float("inf"))):
        with pytest.raises(InputError):
            check_command(bad, np.array([0.0, 1.0]), 10.0)


def test_a_command_beyond_the_converter_between_samples_is_refused_too():
    # 12 V at 500 Hz, sampled at 500 Hz: zero at every sample
    with refusal("+-10 V", "12 V"):
        simulate_experiment(Experiment.of(command=Sine(12.0, 1000.0 * np.pi), duration=1.0))
    # and what it would be after the end is nobody's business
    simulate(command="ramp 20 from 0 s to 2 s", duration=1.0)


def test_a_recorded_command_drives_the_rig_like_the_original():
    first = simulate(command="2 sin(3t)", duration=4.0)
    again = simulate(command=sampled_signal(first.t, first["u"], "first.csv"), duration=4.0)
    np.testing.assert_allclose(again["x"], first["x"], atol=21e-6)  # linear between samples; a count of 20 um
    assert np.ptp(first["x"]) > 0.01
    shifted = sampled_signal(first.t + 100.0, first["u"])
    np.testing.assert_allclose(shifted.volts(first.t), first["u"], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("t", "u"), [([0.0], [1.0]), ([0.0, 0.0], [1.0, 1.0]), ([0.0, 1.0], [1.0, np.nan]), ([0.0, 1.0], [1.0])]
)
def test_an_impossible_recorded_command_is_refused(t, u):
    with pytest.raises(InputError):
        sampled_signal(np.array(t), np.array(u), "log.csv")


@pytest.mark.parametrize("blank", ["\t", "\n", "\u00a0", " \t "])
def test_white_space_of_any_kind(blank):
    assert parse_command("3 sin(4t) + 1".replace(" ", blank)) == parse_command("3 sin(4t) + 1")


def test_a_text_without_end_is_refused():
    with refusal("1000", "13008"):
        parse_command("1 period of " * 1084)
