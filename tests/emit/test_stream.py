"""The estimator of a stream as C99 and as Structured Text: both compute what the kernels compute, block by block."""

from __future__ import annotations

import re

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.commissioned.machine import summarise_healthy
from sealscope.diagnosis.commissioned.watched import measured_rig
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.kernel.stream import RESULTS, StreamSettings
from sealscope.diagnosis.live.live_balance import LiveBalance, NotJudged
from sealscope.diagnosis.live.sequential import StepDetector
from sealscope.diagnosis.verdict.machine_sizes import unstated_rig
from sealscope.emit.c_export import parts_a_sample, render_c
from sealscope.emit.compiler import find_compiler
from sealscope.emit.export import absolute_offsets, controller_inputs
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.single_precision import iter_blocks
from sealscope.emit.st_export import render_st
from sealscope.emit.stream_program import stream_program
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.units import P_ATM

from ..diagnosis import test_lowered_loads as lowered_loads
from ..diagnosis.balance_machine import machine, step
from .st_evaluator import Program

RIG = ss.load_rig("thesis")
ASYMMETRIC = ss.load_rig("single-rod-eha").with_overrides({"pump.circuit": "asymmetric"})
WORDS = {"prefix": "leak", "title": "a machine", "origin": "a test", "alarm_rate": 1000.0}


def has_compiler() -> bool:
    try:
        return bool(find_compiler())
    except InputError:
        return False


pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C compiler")


def unit_at(rate, flow="theta"):
    return stream_program(StreamSettings.from_rig(RIG, rate, flow, 1000.0))


def samples_of(recording, flow="theta"):
    return np.stack([recording[name] for name in ("p_A", "p_B", flow, "x")], axis=1)


def lose(samples, random):
    """Lose readings of single channels, or read numbers that no sensor reads, at any time after the first second."""
    samples = samples.copy()
    for _ in range(5):
        first, channel = int(random.integers(25, len(samples) - 40)), int(random.integers(4))
        samples[first : first + int(random.integers(1, 30)), channel] = random.choice([np.nan, np.inf, -np.inf, 1e120])
    return samples


def c_stream(unit):
    return CompiledStream(unit, render_c(unit, **WORDS), "leak")


def run_st(unit, samples, learned=()):
    """Results of the monitor's function block after each block of the stream, and the block."""
    program = Program(render_st(unit, **WORDS, learned=learned)["leak.st"])
    monitor = program.make("LEAK_MONITOR")
    results, ended = [], 0
    for p_A, p_B, flow, x in samples.tolist():
        is_valid = bool(np.isfinite([p_A, p_B, flow, x]).all())
        monitor(enable=True, valid=is_valid, **{"p_a": p_A, "p_b": p_B, "flow": flow, "x": x})  # names have no case
        if monitor.state.phase == 0 and monitor.state.n_ended != ended:
            ended = monitor.state.n_ended
            results.append([monitor.alarm if name == "alarm" else getattr(monitor, name) for name in RESULTS])
    return np.array(results, dtype=float), monitor


def test_structured_text_computes_what_c_computes():
    """Through the first fit; lost readings among the samples."""
    unit, random = unit_at(16.0), np.random.default_rng(1)
    recording = machine(1, duration=66.0, rate=16.0)
    samples = samples_of(recording)
    samples[300:310] = np.nan
    samples[600 + int(random.integers(40))] = np.nan
    expected = np.array(list(c_stream(unit).feed(samples, parts_a_sample(unit.settings))))
    results, _ = run_st(unit, samples)
    assert len(results) >= 4 and np.count_nonzero(expected[:, 0]) >= 2
    assert results == pytest.approx(expected[-len(results) :], rel=1e-9, abs=1e-25)


@pytest.mark.parametrize(
    ("rig", "flow", "rate", "low"),
    [
        ("thesis", "theta", 16.0, 0.0),
        pytest.param("thesis", "theta", 20.0, 12e5, marks=pytest.mark.slow, id="sensor-reads-too-low"),
        pytest.param("thesis", "omega", 22.0, 0.0, marks=pytest.mark.slow),
        pytest.param("thesis", "q_pump", 25.0, 0.0, marks=pytest.mark.slow),
        pytest.param("single-rod-eha", "theta", 25.0, 0.0, marks=pytest.mark.slow),
        pytest.param("asymmetric pump", "omega", 20.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_watch_and_a_controller_state_the_same_bits(rig, flow, rate, low):
    """Conductance, deviation and score of each block, with lost readings and an encoder the other way round.

    Also where p_B reads `low` [Pa] too low, below a vacuum.
    """
    rig = ASYMMETRIC if rig == "asymmetric pump" else ss.load_rig(rig)
    recording = machine(3, G=step(0.0, 4e-13, at=75.0), duration=100.0, rate=rate)
    speed = np.gradient(recording["theta"], 1.0 / rate)
    flows = {"theta": -recording["theta"], "omega": speed, "q_pump": speed * rig.pump.q_b / (2.0 * np.pi)}
    names = ("p_A", "p_B", flow, "x")
    samples = np.stack([{**recording.channels, **flows}[name] for name in names], axis=1)
    samples[:, 1] -= low
    samples = lose(samples, np.random.default_rng(round(rate)))
    settings = StreamSettings.from_rig(rig, rate, flow, 1000.0)
    settings = settings._replace(to_absolute=absolute_offsets(samples, settings))
    assert (settings.to_absolute[1] > P_ATM) == (low > 0.0)
    unit = stream_program(settings)
    stream, scores = c_stream(unit), {}
    blocks = dict(iter_blocks(stream, samples))
    stream.initialise()
    for results in stream.feed(samples, parts_a_sample(unit.settings)):
        scores[int(stream.state.block_end) - 1] = results[RESULTS.index("score")]
    live, detector, n = LiveBalance(rig, names), StepDetector(), 0
    channels = dict(zip(names, samples.T, strict=True))
    length = unit.settings.counts[0] * unit.settings.counts[1]
    for part in live.take(SampleRun(recording.t, channels, rate, follows=False)):
        for block in () if isinstance(part, NotJudged) else part:
            number = round(block.begin * rate / length)
            detector.take(block.begin, block.end, block.g, block.sd)
            assert (block.total, block.sd) == tuple(blocks[number])
            assert number not in scores or max(detector.log_e(), 0.0) == scores[number]
            n += 1
    assert n >= 30 and max(scores.values()) > 5.0


@pytest.mark.parametrize("wired", [1.0, -1.0])
def test_a_start_that_misleads_of_the_flows_sign_mixes_no_signs(wired):
    """At first a load creeps against the pump, so that the wrong sign seems right; then motion shows it."""
    random = np.random.default_rng(5)
    recording = machine(4, duration=130.0, rate=16.0)
    samples, n = samples_of(recording), 16 * 40
    rest = np.repeat(samples[:1], n, axis=0)
    creep = np.sin(0.3 * np.arange(n) / 16.0)
    rest[:, 2] += 1e-3 * np.ptp(samples[:, 2]) * creep
    rest[:, 3] += 1e-6 * random.standard_normal(n)
    rest[:, 0] -= 1e5 * np.tanh(9.0 * np.gradient(creep) * 16.0)
    samples = np.concatenate([rest, samples + rest[-1] - samples[0]])
    samples[:, 2] *= wired
    unit = unit_at(16.0)
    stream = c_stream(unit)
    blocks = dict(iter_blocks(stream, samples))
    assert stream.state.angle_sign == wired
    live = LiveBalance(RIG, unit.settings.channels)
    channels = dict(zip(unit.settings.channels, samples.T, strict=True))
    parts = live.take(SampleRun(np.arange(len(samples)) / 16.0, channels, 16.0, follows=False))
    results = [block for part in parts if not isinstance(part, NotJudged) for block in part]
    assert len(results) > 20
    length = unit.settings.counts[0] * unit.settings.counts[1]
    for block in results:
        assert (block.total, block.sd) == tuple(blocks[round(block.begin * 16.0 / length)])


@pytest.mark.slow
def test_recordings_that_a_controller_would_misread_are_refused(tmp_path):
    """A load that is lowered past the resting pump, and a speed without a sign."""
    rig = RIG.with_overrides({"cylinder.A_B": lowered_loads.AREA_A})
    damped, two_way = lowered_loads.flight(2), machine(1, duration=120.0, rate=100.0)
    speed = np.abs(np.gradient(two_way["theta"], 0.01))
    unsigned = Recording(two_way.t, {**two_way.channels, "omega": speed}, {**two_way.units, "omega": "rad/s"}, 100.0)
    short = unsigned.between(0.0, 66.0)  # too short for the monitor, which begins anew when it sees that signs lack
    no_sign = "a flow with a sign, got omega in number 1"
    cases = (rig, damped, "blocks that differ in number 1: its load is lowered"), (RIG, unsigned, no_sign)
    for machine_rig, recording, reason in (*cases, (RIG, short, no_sign)):
        with pytest.raises(InputError, match=reason):
            ss.export_controller(
                tmp_path, rig=machine_rig, rate=recording.rate, flow="omega", learn=[recording],
                false_alarms_per_1000_h=1e-3,
            )  # fmt: skip
    signed = unsigned.channels | {"omega": np.gradient(two_way["theta"], 0.01)}
    healthy = Recording(two_way.t, signed, unsigned.units, 100.0)
    assert ss.export_controller(tmp_path, rate=100.0, flow="omega", learn=[healthy]).learned_blocks > 30


def test_a_state_of_a_controller_is_small():
    """Of every kind of machine that a stream runs for, at usual rates: 64 kB in double, 48 kB in single precision."""
    for rig, rate in (("thesis", 100.0), ("thesis", 500.0), ("single-rod-eha", 100.0)):
        fields = stream_program(StreamSettings.from_rig(ss.load_rig(rig), rate)).program.fields
        doubles = sum((8 if field.kind == "real" else 4) * (field.size or 1) for field in fields)
        assert doubles <= 64000
        assert sum(4 * (field.size or 1) for field in fields) <= 48000


def test_no_index_is_beyond_its_array():
    """Not even in a loop without a round: clang and PLCs refuse it."""
    unit = unit_at(16.0)
    sizes = {field.name: field.size for field in unit.program.fields}
    indices = re.findall(r"record->(\w+)\[(\d+)\]", render_c(unit, **WORDS)["leak.c"])
    assert len(indices) > 20 and all(int(k) < sizes[name] for name, k in indices)


@pytest.mark.slow
@pytest.mark.parametrize("flow", ["theta", "omega"])
def test_structured_text_raises_the_alarm_of_c(flow):
    unit = unit_at(20.0, flow)
    recording = machine(1, G=step(0.0, 4e-13, at=80.0), duration=110.0, rate=20.0)
    if flow == "omega":
        channels = {**recording.channels, "omega": np.gradient(recording["theta"], 1.0 / recording.rate)}
        samples = np.stack([channels[name] for name in ("p_A", "p_B", "omega", "x")], axis=1)
    else:
        samples = samples_of(recording)
    expected = np.array(list(c_stream(unit).feed(samples, parts_a_sample(unit.settings))))
    results, monitor = run_st(unit, samples)
    assert monitor.alarm and expected[-1, RESULTS.index("alarm")] == 1.0
    assert results == pytest.approx(expected[-len(results) :], rel=1e-9, abs=1e-25)


def test_a_leak_raises_an_alarm_with_its_size_and_onset():
    unit = unit_at(25.0)
    recording = machine(1, G=step(0.0, 4e-13, at=80.0), duration=110.0, rate=25.0)
    results = np.array(list(c_stream(unit).feed(samples_of(recording), parts_a_sample(unit.settings))))
    alarms = results[:, RESULTS.index("alarm")]
    first = int(np.argmax(alarms))
    assert alarms[-1] == 1.0 and not alarms[: first - 1].any()
    row = dict(zip(RESULTS, results[-1], strict=True))
    pressure = np.mean(np.abs(recording["p_A"] - recording["p_B"]))
    assert row["q_leak_low"] < 4e-13 * pressure < row["q_leak_high"]
    assert row["since"] == pytest.approx(30.0, abs=4.0)


def test_hostile_samples_lead_nowhere(tmp_path):
    """Any numbers: the state recovers, and estimates what it did before."""
    unit, random = unit_at(16.0), np.random.default_rng(3)
    recording = machine(2, duration=80.0, rate=16.0)
    stream, parts = c_stream(unit), parts_a_sample(unit_at(16.0).settings)
    before = list(stream.feed(samples_of(recording), parts))[-1]
    hostile = random.standard_normal((2000, 4)) * 10.0 ** random.uniform(-300, 300, (2000, 4))
    hostile[random.random((2000, 4)) < 0.2] = np.nan
    for _ in stream.feed(hostile, parts):
        pass
    stream.resume()
    after = list(stream.feed(samples_of(recording), parts))[-1]
    assert np.isfinite(after).all()
    q = RESULTS.index("q")
    assert after[q] == pytest.approx(before[q], rel=0.5)


def test_what_was_learned_outlasts_a_power_cut_and_damage_is_refused():
    unit = unit_at(16.0)
    recording, parts = machine(2, duration=70.0, rate=16.0), parts_a_sample(unit_at(16.0).settings)
    stream = c_stream(unit)
    list(stream.feed(samples_of(recording), parts))
    saved = stream.saved()
    again = CompiledStream(unit, render_c(unit, **WORDS, learned=saved), "leak")
    first = next(iter(again.feed(samples_of(recording), parts)))
    assert again.state.usual_precision == stream.state.usual_precision > 0.0
    assert np.isfinite(first).all()
    import ctypes

    damaged = list(saved)
    damaged[7] += 1.0
    for numbers, restores in ((saved, True), (damaged, False), ([1.0, *saved[1:]], False)):
        assert again._call("restore", (ctypes.c_double * len(numbers))(*numbers)) is restores


def test_machines_without_such_a_balance_are_refused():
    cases = (
        (ss.load_rig("servo-valve"), 100.0, "theta", "q_pump.*valve-controlled"),
        (RIG.with_overrides({"pump.circuit": "open"}), 100.0, "q_pump", "open circuit.*rests"),
        (RIG, 5.0, "theta", "rate"),
        (RIG, 100.0, "x", "theta, omega, q_pump, got 'x'"),
        (RIG.as_assumed("no rig was stated"), 100.0, "omega", "displacement.*stated"),
    )
    for rig, rate, flow, reason in cases:
        with pytest.raises(InputError, match=reason):
            StreamSettings.from_rig(rig, rate, flow)
    assert StreamSettings.from_rig(RIG.as_assumed("no rig was stated"), 100.0, "q_pump").displacement == 1.0


def test_a_controller_takes_inputs_and_displacement_from_the_machines_file(tmp_path):
    """The displacement is that which the healthy recordings show by the piston's stated areas."""
    recording = machine(1, duration=60.0, rate=50.0)
    rig = unstated_rig().with_areas(RIG.cylinder.A_A, RIG.cylinder.A_B, source="nameplate")
    rig = rig.with_overrides({"pump.q_b": 2.0 * RIG.pump.q_b}, source=rig.entry("pump.q_b").source)
    known = ss.CommissionedMachine("m", (summarise_healthy(recording, rig, "a"),), rig)
    assert measured_rig(known).pump.q_b == pytest.approx(RIG.pump.q_b, rel=0.02)
    assert measured_rig(known).states("pump.q_b") and not rig.states("pump.q_b")
    assert controller_inputs(recording) == controller_inputs(known.healthy[0]) == (50.0, "theta")
    in_counts = Recording(recording.t, recording.channels, {**recording.units, "p_B": "count"}, 50.0)
    with pytest.raises(InputError, match="raw counts of p_B"):
        ss.export_controller(tmp_path, rate=50.0, learn=[in_counts])


def test_a_long_loss_of_readings_is_no_standstill():
    """Whatever is lost, and in whatever way, for seconds: rows with it are left out, and no block is of zeros."""
    unit = unit_at(16.0)
    samples, parts = samples_of(machine(3, duration=100.0, rate=16.0)), parts_a_sample(unit.settings)
    stream, expected = c_stream(unit), None
    for channels, value in ((slice(None), np.nan), (2, np.nan), (2, 1e14), (3, 1e5), (slice(0, 2), np.inf)):
        lost = samples.copy()
        lost[1200:1350, channels] = value
        stream._call("init")
        results = np.array(list(stream.feed(lost, parts)))
        expected = results if expected is None else expected
        assert np.array_equal(results, expected)
    assert RESULTS.index("reason") == len(RESULTS) - 1 and 3.0 in expected[-8:, -1]


def test_each_result_stands_on_a_line_of_its_own():
    """In the header, where it names an index; in both READMEs; and as an output in PLCopen's XML."""
    unit = unit_at(16.0)
    c, st = render_c(unit, **WORDS), render_st(unit, **WORDS)
    interface = (
        st["leak.xml"].partition('name="LEAK_MONITOR"')[2].partition("<outputVars>")[2].partition("</outputVars")[0]
    )
    for k, name in enumerate(RESULTS):
        assert f"\n#define LEAK_{name.upper()} {k} /*" in c["leak.h"]
        assert f"\n| `LEAK_{name.upper()}` |" in c["README.md"]
        assert f'<variable name="{name}">' in interface
