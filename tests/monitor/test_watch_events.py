"""Sensors and duties that change on a watched machine are no leak, and beside a leak take none away."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.live.estimates import HealthyLevel, WatchBaseline, find_level_rise
from sealscope.diagnosis.live.watch import Watch
from sealscope.recordings.recording import Recording

from ..diagnosis.balance_machine import machine, step
from ..representatives import OTHERS

#: When something else changes, and when a leak opens [s]; its conductance [m^3/(s Pa)].
CHANGES, OPENS, END, LEAK = 130.0, 190.0, 250.0, 1.0e-12
LEARN = 0.02
Array = np.ndarray


@cache
def recorded(leaks: bool, envelope: Callable[[Array], Array] | None = None) -> Recording:
    """Record a machine under its duty times an envelope."""
    G = step(0.0, LEAK, at=OPENS) if leaks else 0.0
    size = envelope or np.ones_like
    return machine(3, G=G, speed=lambda t: 12.0 * size(t) * np.sin(4.0 * t), duration=END, rate=50.0)


def scale(name: str, factor: float) -> Callable[[Recording], Recording]:
    def changed(recording: Recording) -> Recording:
        values = recording[name]
        steps = np.diff(values, prepend=values[0]) * np.where(recording.t >= CHANGES, factor, 1.0)
        return replace(recording, channels={**recording.channels, name: values[0] + np.cumsum(steps)})

    return changed


def shift(name: str, pascal: float) -> Callable[[Recording], Recording]:
    return lambda recording: replace(
        recording,
        channels={**recording.channels, name: recording[name] + np.where(recording.t >= CHANGES, pascal, 0.0)},
    )


def add_noise(recording: Recording) -> Recording:
    noise = np.where(recording.t >= CHANGES, 2e4, 0.0) * np.random.default_rng(7).standard_normal(len(recording))
    return replace(recording, channels={**recording.channels, "p_A": recording["p_A"] + noise})


def pause(t: Array) -> Array:
    """Rest for twenty seconds."""
    return 1.0 - np.clip(np.minimum(t - CHANGES, CHANGES + 20.0 - t) / 0.2, 0.0, 1.0)


def ramp(t: Array) -> Array:
    """Rest for ten seconds, then ramp in over fifteen."""
    return 1.0 - np.clip(np.minimum((t - CHANGES) / 0.2, (CHANGES + 25.0 - t) / 15.0), 0.0, 1.0)


def larger(t: Array) -> Array:
    return np.where(t >= CHANGES, 1.15, 1.0)


SENSORS = {
    "scale of the position, smaller": scale("x", 0.98),
    "scale of the position, larger": scale("x", 1.02),
    "scale of the angle": scale("theta", 1.02),
    "zero of p_A": shift("p_A", 5e4),
    "zero of p_B": shift("p_B", 5e4),
    "noise of p_A": add_noise,
}
DUTIES = {"pause": pause, "ramp": ramp, "larger duty": larger}
EVENTS = (*SENSORS, *DUTIES)


@cache
def watched(kind: str, leaks: bool) -> Watch:
    recording = recorded(leaks, DUTIES.get(kind))
    watch = ss.watch("thesis", learn_hours=LEARN)
    watch.update(SENSORS.get(kind, lambda plain: plain)(recording))
    return watch


#: Kinds that differ from another one by their sign, chamber or shape alone.
ALIKE = ("scale of the position, larger", "zero of p_B", "ramp", "larger duty", "zero of p_A")


def some_of(*quick: str) -> list[Any]:
    """All kinds, of which a sensor and a duty are quick."""
    marks = {kind: OTHERS if kind in ALIKE else pytest.mark.slow for kind in EVENTS} | dict.fromkeys(quick, ())
    return [pytest.param(kind, marks=marks[kind]) for kind in EVENTS]


@pytest.mark.parametrize("kind", some_of("scale of the position, smaller"))
def test_what_is_no_leak_raises_no_alarm(kind: str):
    assert watched(kind, leaks=False).leak is None


@pytest.mark.parametrize("kind", some_of("larger duty"))
def test_beside_it_a_leak_is_found(kind: str):
    leak = watched(kind, leaks=True).leak
    plain = watched("", leaks=True).leak
    assert leak is not None and plain is not None
    assert leak.onset_s == pytest.approx(OPENS, abs=3.0)
    if not kind.startswith("zero"):
        assert leak.leak_lpm == pytest.approx(plain.leak_lpm, rel=0.1)


def test_what_explains_a_change_is_counted():
    counters = watched("scale of the position, smaller", leaks=False).counters
    assert any(reason.startswith("changes that are no leak") and "scale" in reason for reason in counters)


@pytest.mark.long
@pytest.mark.slow
def test_restarts_while_a_change_is_weighed_continue_with_the_same_bits():
    recording = SENSORS["scale of the position, smaller"](recorded(leaks=True))
    watch, start = ss.watch("thesis", learn_hours=LEARN), 0
    for stop in (6600, 7100, 8300, len(recording)):
        for first in range(start, stop, 733):
            watch.update(recording.samples(slice(first, min(first + 733, stop))))
        watch, start = Watch.from_state(json.loads(json.dumps(watch.state(), allow_nan=False))), stop
    uninterrupted = watched("scale of the position, smaller", leaks=True)
    assert json.dumps(watch.state()) == json.dumps(uninterrupted.state())


def test_a_level_is_beyond_what_the_healthy_recordings_scatter_by():
    """Five that agree show a sixth of four times as much; two, or five that scatter, do not."""
    level = {"level": 2e-13, "low": 1e-13, "high": 3e-13, "known_s": 0.0}

    def rises(deviation: float, count: int) -> bool:
        healthy = HealthyLevel(**level, deviation=deviation, count=count)
        return find_level_rise(healthy, Interval(0.0, 0.0, 0.0), 1e-12, 1e-15, 1e-6) is not None

    assert rises(1e-14, 5)
    assert not rises(1e-14, 2)
    assert not rises(2e-13, 5)
    assert WatchBaseline.__dataclass_fields__.keys() >= {"deviation", "count"}
