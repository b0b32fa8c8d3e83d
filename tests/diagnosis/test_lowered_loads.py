"""A piston that moves past its pump, which stands still: a lift that gravity lowers, a damped flight actuator."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sealscope.diagnosis.inference.changes.healthy_levels import estimate_connected_difference
from sealscope.diagnosis.inference.machine_states import LoweringLimits, flag_lowering
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.live.joining import SampleRun
from sealscope.diagnosis.live.live_balance import LiveBalance
from sealscope.parameters import load_rig
from sealscope.recordings import Recording
from sealscope.recordings.channels import CHANNEL_UNITS

RATE, CYCLE, SPEED = 100.0, 40.0, 0.04
AREA_A, AREA_B, DISPLACEMENT = 5.03e-3, 3.77e-3, 1e-5 / (2.0 * np.pi)
RIG = load_rig("single-rod-eha").with_overrides(
    {"cylinder.A_A": AREA_A, "cylinder.A_B": AREA_B, "cylinder.V": 1.5e-3, "pump.q_b": DISPLACEMENT * 2.0 * np.pi}
)


@cache
def lift(seed: int, leak: float = 0.0, load: float = 50e5) -> Recording:
    """Record three cycles of a lift: up within 6 s, held for 18 s, lowered within 6 s, at rest for 10 s.

    Check valves hold the load, which a leak of side A [m^3/(s Pa)] to the rod side, open to the tank, lets sink.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(3.0 * CYCLE * RATE)) / RATE
    phase = t % CYCLE
    rising, lowered = phase < 6.0, (phase >= 24.0) & (phase < 30.0)
    speed = np.where(rising, SPEED, np.where(lowered, -SPEED, 0.0))
    p_A = load * (1.0 + 0.1 * random.uniform(-1.0, 1.0, 3))[(t / CYCLE).astype(int)]
    p_A = p_A + np.where(rising, 8e5, np.where(lowered, -3e5, 0.0))
    sinks = np.where(rising | lowered, 0.0, leak * p_A / AREA_A)
    x = 0.05 + np.cumsum(speed - sinks) / RATE
    omega = np.where(rising, (AREA_A * SPEED + (leak + 2e-13) * p_A) / DISPLACEMENT, 0.0)
    noise = random.standard_normal((4, t.size))
    channels = {
        "p_A": p_A + 1e4 * noise[0],
        "p_B": np.where(rising, 4e5, 0.0) + 1e4 * noise[1],
        "x": x + 1e-5 * noise[2],
        "omega": omega + 0.05 * noise[3],
    }
    return Recording(t, channels, CHANNEL_UNITS, RATE)


def test_only_the_piston_that_moves_while_the_pump_rests_is_lowered() -> None:
    recording = lift(0, leak=2e-12)
    pumped = DISPLACEMENT * recording["omega"][1:] / RATE
    load = recording["p_A"] - recording["p_B"]
    is_lowering = flag_lowering(pumped, recording["x"], load[1:], RATE)
    phase = (recording.t % CYCLE)[1:]
    assert is_lowering[(phase > 24.5) & (phase < 29.5)].all()
    assert not is_lowering[phase < 23.5].any()  # neither the stroke up nor the sinking of the load in a hold
    assert not is_lowering[phase > 30.5].any()


@pytest.mark.parametrize("rest", [1.0, 1.5, 4.0])
def test_steps_with_rests_at_a_small_load_are_no_lowering(rest: float) -> None:
    """Averages over time that reach into a rest contain some of the motion before and after it."""
    rate, cycle = 500.0, 1.0 + rest
    t = np.arange(round(12.0 * cycle * rate)) / rate
    phase, way = t % cycle, np.where((t / cycle).astype(int) % 2 == 0, 1.0, -1.0)
    speed = np.where(phase < 1.0, way * SPEED * np.sin(np.pi * phase), 0.0)
    x = np.cumsum(speed) / rate
    p_A = 5e5 + np.where(phase < 1.0, 1e5 * way, 1e3)
    assert not flag_lowering(AREA_A * np.diff(x), np.round(x, 6), p_A[1:] - 5e5, rate).any()


def test_lowering_changes_nothing_that_the_pump_shows() -> None:
    """The balance of a lift is that of its strokes up: as fast or slow as the load may come down."""
    recording = lift(1)
    phase = recording.t % CYCLE
    lowered = (phase >= 24.0) & (phase < 30.0)
    # another way down, to the same end
    weights = np.where(lowered, np.sin(np.pi * (phase - 24.0) / 6.0) ** 2, 0.0)
    way = recording["x"].copy()
    for first in range(3):
        rows = np.flatnonzero(lowered & (recording.t // CYCLE == first))
        share = np.cumsum(weights[rows]) / weights[rows].sum()
        way[rows] = way[rows[0]] + share * (way[rows[-1]] - way[rows[0]])
    other = replace(recording, channels={**recording.channels, "x": way})
    conductances = []
    for record in (recording, other):
        leak = VolumeBalance(rig=RIG).observe(record).leak
        assert leak is not None
        conductances.append(leak.balance.conductance)  # type: ignore[attr-defined]
    widths = [conductance.high - conductance.low for conductance in conductances]
    assert abs(conductances[1].value - conductances[0].value) < 0.5 * max(widths)
    assert widths[1] == pytest.approx(widths[0], rel=0.5)


def flight(seed: int, leak: float = 0.0) -> Recording:
    """Record an actuator that moves under a load, then is damped for 30 s, and a leak [m^3/(s Pa)] from 60 s on.

    While it is damped, its pump rests, a valve connects the chambers, and another actuator moves the piston.
    """
    random = np.random.default_rng(seed)
    t = np.arange(round(120.0 * RATE)) / RATE
    is_damped = (t >= 40.0) & (t < 70.0)
    fast, slow, load = (
        sum(np.sin(2.0 * np.pi * (f * t + random.uniform())) for f in frequencies)
        for frequencies in ((1.1, 1.7, 2.3), (0.2, 0.31, 0.47), (0.07, 0.19, 0.53))
    )
    x = 0.05 + np.where(is_damped, 3e-4 * fast, 5e-3 * slow)
    v = np.gradient(x) * RATE
    v[np.abs(np.gradient(is_damped.astype(float))) > 0.0] = 0.0
    x = 0.05 + np.cumsum(v) / RATE
    dp = np.where(is_damped, 2e9 * v * np.abs(v), 3e6 * load + 5e5 * np.sign(v))
    omega = np.where(is_damped, 0.0, (AREA_A * v + (2e-13 + leak * (t >= 60.0)) * dp) / DISPLACEMENT)
    noise = random.standard_normal((4, t.size))
    channels = {
        "p_A": 8e6 + 0.5 * dp + 1e4 * noise[0],
        "p_B": 8e6 - 0.5 * dp + 1e4 * noise[1],
        "x": x + 1e-6 * noise[2],
        "omega": omega + 0.05 * noise[3],
    }
    return Recording(t, channels, CHANNEL_UNITS, RATE)


def test_an_actuator_that_is_damped_on_every_flight_shows_its_leak() -> None:
    """What passes a valve between the chambers, a thousand times a leak, is no drift of the leakage."""
    rig = RIG.with_overrides({"cylinder.A_B": AREA_A})
    chances = []
    for leak in (0.0, 2e-13):
        measured = VolumeBalance(rig=rig).observe(flight(2, leak)).leak
        assert measured is not None and measured.step is not None
        chances.append(measured.step.chance)
    assert chances[0] > 0.05
    assert chances[1] < 1e-4


def test_connected_chambers_show_the_zeros_of_their_sensors_and_a_lowered_load_none() -> None:
    recording, lowered = flight(3), lift(0)
    off = replace(recording, channels={**recording.channels, "p_A": recording["p_A"] + 7e5})
    zeros = [estimate_connected_difference(record, record["omega"][1:] / RATE) for record in (recording, off)]
    assert zeros[0] is not None and zeros[1] is not None
    assert abs(zeros[0].value) < 3.0 * zeros[0].deviation < 1e5
    assert zeros[1].value - zeros[0].value == pytest.approx(7e5, rel=0.05)
    assert estimate_connected_difference(lowered, lowered["omega"][1:] / RATE) is None


def test_a_stream_leaves_a_damped_phase_out_in_whatever_pieces_it_comes() -> None:
    rig, leak, recording = RIG.with_overrides({"cylinder.A_B": AREA_A}), 2e-13, flight(2, 2e-13)
    streams = []
    for size in (len(recording), 777):
        live = LiveBalance(rig, tuple(recording.channels))
        pieces = [recording.samples(slice(first, first + size)) for first in range(0, len(recording), size)]
        runs = [SampleRun(piece.t, piece.channels, RATE, follows=piece is not pieces[0]) for piece in pieces]
        results = [result for run in runs for result in live.take(run)]
        streams.append([block for result in results if isinstance(result, list) for block in result])
    blocks = streams[0]
    assert streams[1] == blocks
    assert not [block for block in blocks if block.begin > 43.0 and block.end < 69.0]  # damped
    before, after = (
        np.array([block.total for block in blocks if first < block.end < end]) for first, end in ((0, 40), (73, 120))
    )
    assert np.concatenate([before - before.mean(), after - after.mean()]).std() < 0.05 * leak
    assert after.mean() - before.mean() == pytest.approx(leak, rel=0.05)


def test_a_first_minute_without_load_sets_no_limits_of_a_stream_for_good() -> None:
    rests, strokes, flights = (
        LoweringLimits(pump=1e-7, creep=creep, load=load, noise=1e-4, time=time)
        for creep, load, time in ((1e-3, 0.0, 0.0), (2e-2, 3e5, 20.0), (5e-3, 3e6, 180.0))
    )
    assert rests.average_with(strokes) == strokes
    limits = strokes.average_with(flights)
    assert limits.load == pytest.approx(0.1 * strokes.load + 0.9 * flights.load)
    assert (limits.time, limits.pump) == (200.0, pytest.approx(1e-7))
