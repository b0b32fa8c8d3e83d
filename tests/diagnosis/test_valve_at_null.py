"""Valves at their null: what passes them while the piston rests is no leak past the piston.

The machine is made of nothing but the balance of volumes, with known truth: a piston that moves and rests, and a valve
whose supply line has a flow meter without a sign.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.inference.block_stream import BlockStream
from sealscope.diagnosis.inference.blocks import ColumnRoles
from sealscope.diagnosis.inference.comparison import estimate_leak_excess
from sealscope.diagnosis.inference.equations.balances import bridged_samples, equations, is_separate_at_rest
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.parameters import Rig, load_rig
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.units import LITRE_PER_MINUTE

AREA, COMPLIANCE, RATE = 2.0e-3, 2.0e-13, 100.0
SERVO = frozenset({"x", "u", "p_1", "p_2", "p_A", "p_B"})


@cache
def rig() -> Rig:
    return load_rig("thesis").with_areas(AREA, AREA, source="test")


def supplied(seed: int, *, G: float = 0.0, null: float = 0.5, duration: float = 90.0) -> Recording:
    """Record a piston on a spring that moves and rests; `G` [m^3/(s Pa)] past the piston, `null` [L/min] at rest.

    The meter reads the flow into the chamber that the valve feeds. While the piston rests it reads `null` alone: a leak
    then moves the spool, not the flow.
    """
    random, n = np.random.default_rng(seed), round(duration * RATE)
    t, speed, at = np.arange(n) / RATE, np.zeros(n), int(random.uniform(100, 200))
    side = 1.0
    while at < n:
        moved, rested = (int(RATE * random.uniform(*span)) for span in ((0.7, 1.6), (0.8, 2.5)))
        speed[at : at + moved] = side * random.uniform(0.05, 0.15)
        at, side = at + moved + rested, -side
    speed = np.convolve(speed, np.hanning(21) / np.hanning(21).sum(), "same")
    x = np.cumsum(speed) / RATE
    dp = 4e6 + 2e7 * x + 3e5 * np.tanh(speed / 0.01)
    p_A, p_B = 8e6 + 0.5 * dp, 8e6 - 0.5 * dp
    rate_of = {"p_A": np.gradient(p_A) * RATE, "p_B": np.gradient(p_B) * RATE}
    into_A = AREA * speed + COMPLIANCE * rate_of["p_A"] + G * dp
    from_B = AREA * speed - COMPLIANCE * rate_of["p_B"] + G * dp
    flow = np.where(speed > 0.0, into_A, -from_B)
    flow = np.where(np.abs(speed) < 1e-4, null * LITRE_PER_MINUTE, flow)
    channels = {
        "u": 50.0 * speed + 0.002 * random.standard_normal(n),
        "x": np.round(x + 2e-6 * random.standard_normal(n), 5),
        "p_A": p_A + 5e3 * random.standard_normal(n),
        "p_B": p_B + 5e3 * random.standard_normal(n),
        "q_pump": np.abs(flow + 1e-7 * random.standard_normal(n)),
    }
    return Recording(t, channels, {name: CHANNEL_UNITS[name] for name in channels}, RATE)


def test_a_meter_without_a_sign_beside_a_command_is_in_the_supply_line() -> None:
    part = inspect_recording(supplied(0)).part
    assert "q_supply" in part and "q_pump" not in part
    (balance,) = equations(rig(), frozenset(part.channels))
    assert is_separate_at_rest(balance)
    in_line = inspect_recording(supplied(0, null=0.0)).part
    assert "q_pump" in in_line  # a valve that shuts, and one area: the meter may as well be in a line of the cylinder
    one_way = replace(supplied(0), channels={**supplied(0).channels, "u": np.abs(supplied(0)["u"])})
    assert "q_pump" in inspect_recording(one_way).part  # such a command chooses no chamber


@pytest.mark.parametrize("null", [0.0, 0.3, 2.0])
def test_the_flow_at_rest_does_not_matter(null: float) -> None:
    """The estimated conductance is that of the piston, with whatever the valve passes at its null."""
    G = 4e-12
    balance = VolumeBalance(rig()).balance(inspect_recording(supplied(3, G=G, null=null)).part)
    assert balance is not None
    value, low, high = balance.conductance
    assert low < G < high and value == pytest.approx(G, rel=0.15)


def test_a_leak_shows_beside_days_with_other_flows_at_rest() -> None:
    """Of 0.5 % of the mean flow in motion; the null of the valve differs by a quarter from day to day."""
    healthy = [supplied(seed, null=0.5 + 0.05 * seed) for seed in range(5)]
    G = 1.2e-12
    leaking, another_day = supplied(11, G=G, null=0.42), supplied(12, null=0.8)
    found = ss.diagnose(leaking, baseline=healthy, rig=rig())
    true_flow = G * float(np.abs(leaking["p_A"] - leaking["p_B"]).mean()) / LITRE_PER_MINUTE
    assert found.verdict == "leak" and found.leak_interval_lpm is not None
    assert found.leak_interval_lpm[0] <= true_flow <= found.leak_interval_lpm[1]
    assert ss.diagnose(another_day, baseline=healthy, rig=rig()).verdict == "no leak"


@pytest.mark.parametrize("size", [50, 777])
def test_a_stream_drops_the_same_rests(size: int) -> None:
    """In pieces of any size the blocks are those of the whole recording."""
    part = inspect_recording(supplied(5, duration=40.0)).part
    balances = equations(rig(), frozenset(part.channels))
    samples = bridged_samples(part, part.channels)
    whole = BlockStream(balances, RATE).push(samples, last=True)
    assert whole is not None
    stream, pieces = BlockStream(balances, RATE), []
    for first in range(0, len(part), size):
        pushed = stream.push({name: values[first : first + size] for name, values in samples.items()})
        pieces += [] if pushed is None else [pushed]
    pieces += [] if (rest := stream.push({}, last=True)) is None else [rest]
    joined = type(whole).join(pieces)
    assert joined.rows == pytest.approx(whole.rows)
    assert joined.gram == pytest.approx(whole.gram, rel=1e-6, abs=1e-9 * float(np.abs(whole.gram).max()))


def test_a_return_that_nobody_logs_has_the_pressure_of_the_rig() -> None:
    """A servo valve whose p_2 is not recorded is balanced as with it."""
    recording = ss.simulate(
        rig="servo-valve", command="position 30 mm sin(3t)", duration="60 s", leak="0.3 L/min", seed=4
    )
    without_return = recording.only([name for name in recording.channels if name != "p_2"])
    balances = [VolumeBalance(load_rig("servo-valve")).balance(each) for each in (recording, without_return)]
    values = [balance.conductance[0] for balance in balances if balance is not None]
    assert len(values) == 2 and values[1] == pytest.approx(values[0], rel=0.1)


def test_an_overlap_of_a_healthy_valve_is_no_leak_of_its_piston() -> None:
    """Where friction makes p_A - p_B, both look alike: the healthy leak is that of a seal, so that friction may change.

    Each row of the balance is a stroke. What the valve passes by its underlap varies a little, as friction does.
    """
    roles = ColumnRoles(equations(load_rig("servo-valve"), SERVO)[0])
    leak, overlap, left = roles.leak, roles.names.index("overlap P to A"), roles.left
    random = np.random.default_rng(0)

    def record(friction: float) -> np.ndarray:
        """Compute the Gram matrix of strokes under a `friction` [Pa], with an underlap of the valve and no leak."""
        sense, varied = random.choice([-1.0, 1.0], 400), 1.0 + 0.02 * random.standard_normal(400)
        rows = np.zeros((400, left + 1))
        rows[:, leak], rows[:, overlap] = friction * sense * varied, 3e3 * sense
        rows[:, left] = -6e-6 * sense * varied + 1e-8 * random.standard_normal(400)
        return rows.T @ rows / 1e-14

    healthy = np.sum([record(1e5) for _ in range(5)], axis=0)
    (excess,), _ = estimate_leak_excess(record(3e5)[None], healthy[None], [roles], np.ones(1))
    assert excess * 3e5 < 0.1 * 6e-6  # a free leak would be the underlap's, and fall short of friction's growth
