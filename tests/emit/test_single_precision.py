"""Single precision on controllers: its error beside double precision, its alarms, and where it is refused."""

from __future__ import annotations

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.live.kernel.stream import RESULTS
from sealscope.emit.c_export import parts_a_sample, render_c
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.single_precision import convert_learned, learn_basis, measure_error
from sealscope.emit.stream_program import stream_program
from sealscope.errors import InputError

from ..diagnosis.balance_machine import machine, step
from .test_stream import WORDS, has_compiler, samples_of, unit_at

pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C compiler")


def drawn_machine(seed, rate, **options):
    """A machine of drawn wear, duty, load and sensors."""
    random = np.random.default_rng(seed)
    size, pace, load = random.uniform(6.0, 20.0), random.uniform(1.5, 7.0), random.uniform(-1e5, 1e5)
    drawn = {
        "G_pump": random.uniform(1e-13, 8e-13),
        "ratio": random.uniform(0.97, 1.03),
        "speed": lambda t: size * np.sin(pace * t) + 0.3 * size * np.sin(2.7 * pace * t),
        "load": load,
        "drop": random.uniform(0.0, 0.1),
        "p_noise": 10.0 ** random.uniform(3.0, 4.3),
        "bias": random.uniform(0.0, 2e4),
        "x_step": 10.0 ** random.uniform(-6.0, -4.5),
    }
    return machine(seed, rate=rate, **{**drawn, **options})


def streams(unit, samples):
    """Streams in both precisions that know the machine of the samples."""
    double = CompiledStream(unit, render_c(unit, **WORDS), "leak")
    list(double.feed(samples, parts_a_sample(unit.settings)))
    program = stream_program(unit.settings._replace(basis=learn_basis(double)))
    single = CompiledStream(program, render_c(program, **WORDS), "leak")
    convert_learned(double, single)
    for stream in (double, single):
        stream.resume()
    return double, single


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 11))])
def test_single_precision_errs_by_less_than_a_tenth_of_a_deviation(seed):
    """In every block of ten machines, also of a day after the one that its columns were learned from."""
    rate = float(np.random.default_rng(seed).choice([20.0, 50.0, 100.0])) if seed > 1 else 20.0
    samples = samples_of(drawn_machine(seed, rate, duration=75.0))
    other = samples_of(drawn_machine(seed, rate, duration=110.0, load=3e4, bias=-1e4))
    unit = unit_at(rate)
    double, single = streams(unit, samples)
    assert single.unit.state_bytes <= 48000
    assert measure_error(double, single, [samples, other]) < 0.1
    assert int(single.state.n_estimated) > 10


def test_rests_and_a_rare_motion_err_as_little():
    """The machine stands still, without load, for half of each minute; side B carries only the last motion's load."""
    unit, moves = unit_at(20.0), lambda t: t % 60.0 < 30.0
    recording = drawn_machine(
        2,
        20.0,
        duration=240.0,
        speed=lambda t: moves(t) * 12.0 * np.sin(3.0 * t),
        load=lambda t: moves(t) * 4e5 * np.sign(180.0 - t),
    )
    samples = samples_of(recording)
    double, single = streams(unit, samples)
    assert measure_error(double, single, [samples[:3600], samples[3600:], samples]) < 0.1
    # only blocks in motion count, as many in both
    assert 40 < int(single.state.n_estimated) == int(double.state.n_estimated) < 70


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_alarms_of_single_precision_are_those_of_double(seed):
    """At the same block, with lost readings."""
    rate = 25.0
    unit, random = unit_at(rate), np.random.default_rng(seed)
    sensors = {"p_noise": 8e3, "x_step": 5e-6}
    healthy = samples_of(drawn_machine(seed, rate, duration=75.0, **sensors))
    leaking = samples_of(drawn_machine(seed, rate, duration=150.0, G=step(0.0, 5e-13, at=100.0), **sensors))
    for first in random.integers(200, 3500, 5):
        leaking[first : first + 20, int(random.integers(4))] = np.nan
    double, single = (
        np.array(list(stream.feed(leaking, parts_a_sample(unit.settings)))) for stream in streams(unit, healthy)
    )
    alarm = RESULTS.index("alarm")
    assert double[-1, alarm] == 1.0
    assert np.array_equal(single[:, alarm], double[:, alarm])
    leak = slice(RESULTS.index("q_leak"), RESULTS.index("q_leak_high") + 1)
    assert single[-1, leak] == pytest.approx(double[-1, leak], abs=0.05 * np.ptp(double[-1, leak]))


def test_single_precision_is_refused_without_proof(tmp_path, monkeypatch):
    recording = drawn_machine(1, 20.0, duration=75.0)
    with pytest.raises(InputError, match="healthy recordings"):
        ss.export_controller(tmp_path, rate=20.0, precision="single")
    with pytest.raises(InputError, match="language c"):
        ss.export_controller(tmp_path, language="st", rate=20.0, precision="single", learn=[recording])
    monkeypatch.setattr("sealscope.emit.single_precision.MOST_ERROR", 1e-9)
    with pytest.raises(InputError, match="at most 1e-09 standard deviations"):
        ss.export_controller(tmp_path, rate=20.0, precision="single", learn=[recording])
    assert not list(tmp_path.iterdir())
