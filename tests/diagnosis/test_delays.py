"""A delay that changes within a recording is named and taken out: it is no leak, and hides none."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.inference.regimes import recorded_blocks
from sealscope.diagnosis.inference.sensor_errors import DelayChange, SampleClock, shift_back
from sealscope.diagnosis.priors.inference import INFERENCE
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from .balance_machine import irregular, machine, step

THESIS = load_rig("thesis")
#: Leak beside the delays: 0.02 L/min at 1 bar [m^3/(s Pa)].
LEAK = 0.02 / 60e3 / 1e5


def delayed(recording: Recording, name: str, seconds: float, since: float, until: float | None = None) -> Recording:
    """Let a channel arrive later, at once or growing until a time."""
    t = recording.t
    share = (t >= since).astype(float) if until is None else np.clip((t - since) / (until - since), 0.0, 1.0)
    late = np.interp(t - seconds * share, t, recording[name])
    return replace(recording, channels={**recording.channels, name: late})


def drawn_machine(seed: int, leak_at: float | None = None) -> Recording:
    """Draw a machine's duty, load and sampling rate; it leaks from a time on."""
    random = np.random.default_rng(seed)
    amplitude, pace = random.uniform(8.0, 20.0), random.uniform(1.5, 5.0)
    speed = irregular(seed) if seed % 3 == 0 else lambda t: amplitude * np.sin(pace * t)
    leak = 0.0 if leak_at is None else step(0.0, LEAK, at=leak_at)
    load, rate = float(random.uniform(-2e4, 2e4)), float(random.choice([50.0, 100.0, 200.0]))
    return machine(seed, G=leak, speed=speed, load=load, rate=rate, duration=90.0).only(
        ("u", "theta", "x", "p_A", "p_B")
    )


def found_changes(recording: Recording) -> tuple[DelayChange, ...]:
    blocks = recorded_blocks(recording, THESIS)
    assert blocks is not None
    return blocks.open.delay_changes


@pytest.mark.parametrize("seed", [pytest.param(k, marks=[pytest.mark.slow] if k > 2 else []) for k in range(8)])
def test_a_drawn_change_of_a_delay_is_found_at_its_size_and_is_no_leak(seed: int) -> None:
    random = np.random.default_rng(100 + seed)
    recording = drawn_machine(seed)
    seconds = float(random.choice([-1.0, 1.0]) * random.uniform(0.008, 0.04))
    since, channel = float(random.uniform(20.0, 70.0)), str(random.choice(["x", "theta"]))
    late = delayed(recording, channel, seconds, since)
    (change,) = found_changes(late)
    sign = 1.0 if change.channel == channel else -1.0  # position and flow are told apart where compliance allows
    assert channel in {change.channel, change.rival_channel}
    assert sign * change.seconds == pytest.approx(seconds, abs=1e-3)
    assert change.onset.low <= since <= change.onset.high
    diagnosis = diagnose(late, rig=THESIS)
    assert diagnosis.verdict == "no leak"
    assert f"{change.channel} arrives" in diagnosis.reason


@pytest.mark.parametrize("seed", range(2))
def test_without_a_change_none_is_found(seed: int) -> None:
    assert found_changes(drawn_machine(seed)) == ()
    assert found_changes(drawn_machine(seed, leak_at=45.0)) == ()  # whatever the leakage does


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)])
def test_a_leak_keeps_its_size_beside_a_change_of_a_delay(seed: int) -> None:
    random = np.random.default_rng(200 + seed)
    leaking = drawn_machine(seed, leak_at=45.0)
    late = delayed(leaking, "x", float(random.uniform(0.01, 0.03)), float(random.uniform(25.0, 65.0)))
    sizes = []
    for recording in (leaking, late):
        diagnosis = diagnose(recording, rig=THESIS)
        assert diagnosis.verdict == "leak"
        assert diagnosis.leak_lpm is not None
        sizes.append(diagnosis.leak_lpm)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)


@pytest.mark.parametrize("milliseconds", [-30.0, pytest.param(10.0, marks=pytest.mark.slow), 30.0])
def test_a_delay_that_grows_by_the_clocks_of_two_recorders_is_no_leak(milliseconds: float) -> None:
    recording = delayed(drawn_machine(1), "x", 1e-3 * milliseconds, 0.0, until=90.0)
    assert diagnose(recording, rig=THESIS).verdict == "no leak"


def test_shifting_back_undoes_a_delay() -> None:
    clock = SampleClock(rate=50.0, begin=10.0, flow_channel="")
    t = clock.begin + np.arange(500) / clock.rate
    onset = Interval(14.0, 13.5, 14.5)
    for seconds in np.random.default_rng(3).uniform(-0.1, 0.1, 8):
        recorded = np.where(t >= 14.0, np.sin(2.0 * (t - seconds)), np.sin(2.0 * t))
        aligned = shift_back(recorded, float(seconds), onset, clock)
        is_hidden = (t >= onset.low) & (t <= onset.high)
        assert np.isnan(aligned[is_hidden]).all()
        known = ~is_hidden & np.isfinite(aligned)
        assert known.sum() > 0.85 * len(t)
        assert aligned[known] == pytest.approx(np.sin(2.0 * t[known]), abs=1e-4)


def test_the_odds_of_a_change_are_those_of_its_events() -> None:
    rows = tomllib.loads((files("sealscope.diagnosis.decision") / "events.toml").read_text("utf-8"))
    rates = {row["probability"]["value"] for name, row in rows.items() if name.startswith("delay of")}
    assert rates == {INFERENCE.delay.odds}
