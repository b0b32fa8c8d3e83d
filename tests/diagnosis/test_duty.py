"""Duties compared within and between recordings: made motion of which each part is known, then the verdicts."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest

from sealscope.diagnosis.baseline.duty import duty_changes
from sealscope.diagnosis.baseline.operating_point import OperatingPoint, difference, operating_point
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.registry import detectors
from sealscope.parameters import load_rig
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.recordings.strokes import strokes_of
from sealscope.simulation.simulate import simulate

RATE, CHANGE = 200.0, 60.0
MOTION = ("x", "theta")


def made(
    before: tuple[float, float, float],
    after: tuple[float, float, float],
    *,
    loss: float = 0.0,
    random: float = 0.0,
    duration: float = 120.0,
) -> Recording:
    """Strokes of the length [mm], speed [mm/s] and dwell [s] that are given, before and after `CHANGE`.

    `loss`: share of the pump's flow that bypasses the piston after it, `random`: scatter of the strokes' length."""
    rng = np.random.default_rng(3)
    t, x, theta = [0.0], [0.0], [0.0]
    direction = 1.0
    while t[-1] < duration:
        length, speed, dwell = before if t[-1] < CHANGE else after
        length *= np.exp(random * rng.standard_normal())
        kept = 1.0 - loss * (t[-1] >= CHANGE)
        for seconds, moved in ((length / speed, direction * length), (dwell, 0.0)):
            t.append(t[-1] + seconds)
            x.append(x[-1] + kept * moved)
            theta.append(theta[-1] + 0.8 * moved)
        direction = -direction
    at = np.arange(round(duration * RATE)) / RATE
    dp = 6e4 * np.sign(np.interp(at + 0.02, t, x) - np.interp(at, t, x))
    noise = rng.normal(0.0, 4e3, (2, at.size))
    channels = {
        "u": 2.0 * np.sign(np.sin(4.0 * at)),
        "x": 1e-3 * (np.interp(at, t, x) + rng.normal(0.0, 0.02, at.size)),
        "theta": np.interp(at, t, theta),
        "p_A": 3e5 + 0.5 * dp + noise[0],
        "p_B": 3e5 - 0.5 * dp + noise[1],
    }
    return Recording(at, channels, CHANNEL_UNITS, RATE)


PLAIN = (40.0, 50.0, 0.5)


def test_strokes_are_measured() -> None:
    strokes = strokes_of(made(PLAIN, PLAIN))
    assert strokes is not None
    assert strokes.travel is not None and strokes.pump is not None and strokes.moving is not None
    assert len(strokes) == pytest.approx(120.0 / 1.3, abs=4)
    np.testing.assert_allclose(strokes.travel, 0.04, rtol=0.01)
    np.testing.assert_allclose(strokes.pump, 32.0, rtol=0.01)
    np.testing.assert_allclose(strokes.moving, 0.8, rtol=0.02)
    np.testing.assert_allclose(strokes.time, 1.3, rtol=0.01)
    assert np.all(strokes.direction[1:] == -strokes.direction[:-1])


@pytest.mark.parametrize(
    ("after", "text"),
    [
        ((55.0, 50.0, 0.5), "stroke changed from 40 to 55 mm at 60 s"),
        ((36.0, 50.0, 0.5), "stroke changed from 40 to 36 mm at 60 s"),
        ((40.0, 60.0, 0.5), "speed changed from 50 to 60 mm/s at 60 s"),
        ((40.0, 50.0, 0.9), "dwell changed from 0.5 to 0.9 s at 60 s"),
    ],
)
def test_a_changed_duty_is_named(after: tuple[float, float, float], text: str) -> None:
    changes = duty_changes(made(PLAIN, after))
    assert [change.certain for change in changes] == [True]
    words, wanted = changes[0].text.split(), text.split()
    assert changes[0].t == pytest.approx(CHANGE, abs=2.0)
    for own, other in zip(words[:-2], wanted[:-2], strict=True):
        if other[0].isdigit():
            assert float(own) == pytest.approx(float(other), rel=0.02)
        else:
            assert own == other


def test_by_pressures_alone_the_time_of_a_stroke_is_compared() -> None:
    changes = duty_changes(made(PLAIN, (40.0, 50.0, 0.9)).only(["u", "p_A", "p_B"]))
    assert [change.certain for change in changes] == [True]
    assert changes[0].text.startswith("time from stroke to stroke changed from 1.3 to 1.7 s")


def test_strokes_that_scatter_do_not_change() -> None:
    assert duty_changes(made(PLAIN, PLAIN, random=0.2)) == ()
    assert duty_changes(made(PLAIN, PLAIN)) == ()


def test_a_leak_is_no_changed_duty() -> None:
    """It shortens the piston's stroke, and not the pump's; without the pump's angle the two cannot be told apart."""
    recording = made(PLAIN, PLAIN, loss=0.3)
    assert duty_changes(recording) == ()
    assert duty_changes(recording.only(["theta", "p_A", "p_B"])) == ()
    short = duty_changes(recording.only(["x", "p_A", "p_B"]))
    assert [change.certain for change in short] == [False]
    assert short[0].text.startswith("stroke changed from 40 to 28")
    # a loop that holds the position turns the pump further instead
    held = made((40.0, 50.0, 0.5), (40.0 / 0.7, 50.0, 0.5), loss=0.3)
    assert duty_changes(held) == ()


def test_operating_points_compare_what_they_have_in_common() -> None:
    plain, longer, leaking = (made(PLAIN, PLAIN), made((55.0, 50.0, 0.5), (55.0, 50.0, 0.5)),
                              made(PLAIN, PLAIN, loss=0.3))  # fmt: skip
    points = [operating_point(recording.between(61.0, 120.0)) for recording in (plain, longer, leaking)]
    points = [replace(point, cycle=None) for point in points]
    assert difference(points[0], points[0]) is None
    assert (difference(points[1], points[0]) or "").startswith("another stroke (55 mm and 40")
    assert difference(points[2], points[0]) is None
    bare = operating_point(plain.only(["u", "p_A", "p_B"]))
    assert "stroke (" not in (difference(replace(bare, cycle=None), points[0]) or "")
    assert OperatingPoint.of_dict(json.loads(json.dumps(asdict(points[0])))) == points[0]


@cache
def joined(second: str, leak: str | None = None, *, throttled: bool = False) -> Recording:
    """Two runs of a machine, joined: what the command says of them is hidden, as where it only switches the drive."""
    rig = {"line.orifices": "present", "line.closed_A": "50[%]", "line.closed_B": "50[%]"} if throttled else {}
    runs = [
        simulate(command="3 sin(4t)", duration="60 s", seed=1, set=rig),
        simulate(command=second, duration="60 s", seed=2, leak=leak or (), set=rig),
    ]
    offset = {name: runs[0][name][-1] - runs[1][name][0] if name in MOTION else 0.0 for name in runs[0].channels}
    channels = {
        name: np.concatenate([runs[0][name], runs[1][name] + offset[name]]) for name in runs[0].channels if name != "u"
    }
    t = np.arange(len(channels["x"])) / runs[0].rate
    channels["u"] = 2.1 * np.sign(np.sin(4.0 * t))
    return Recording(t, channels, CHANNEL_UNITS, runs[0].rate)


@pytest.mark.slow
def test_joined_runs_of_other_strokes_are_not_a_leak() -> None:
    healthy = joined("2 sin(4t)", throttled=True)
    own = detectors()["rms change"](load_rig("thesis")).examine(healthy, [], 0.01)
    assert own.score is not None and own.threshold is not None
    assert own.score > own.threshold  # the details follow the duty
    assert (own.verdict, own.cause) == ("cannot tell", "changed duty")
    assert own.reason.startswith("stroke changed from 12.2 to 8.12 mm at 6")
    assert diagnose(healthy.only(["u", "theta", "x", "p_A", "p_B"])).verdict != "leak"


def test_a_large_leak_is_still_a_leak_where_the_pump_is_seen() -> None:
    leaking = joined("3 sin(4t)", "0.2 L/min from 0 s")
    examine = detectors()["rms change"](load_rig("thesis")).examine
    assert examine(leaking, [], 0.01).verdict == "leak"
    own = examine(leaking.only(["u", "x", "p_A", "p_B"]), [], 0.01)
    assert (own.verdict, own.cause) == ("cannot tell", None)
    assert "or by a leak that takes as much" in own.reason


PROGRAM = "6 periods of 5 sin(2t), 12 periods of 3 sin(4t)"


@pytest.mark.slow
def test_a_program_of_duties_is_one_machine_s_and_hides_no_leak() -> None:
    """Each duty comes again: the pressures' phase is no other recording's, and no duty changed with the leak.

    Seen are command and pressures, and all channels; rig given, onset not given.
    """
    sound, leaking = (
        simulate(command=PROGRAM, duration=150.0, leak=leak, seed=5) for leak in (None, "0.01 L/min from 75 s")
    )
    for recording in (sound, leaking):
        near = [change.recurs for change in duty_changes(recording) if 60.0 < change.t < 100.0]
        assert near and all(near)
        for view in (recording, recording.only(["u", "p_A", "p_B"])):
            found = diagnose(view, quick=True)
            assert found.verdict == ("leak" if recording is leaking else "no leak")


def test_a_duty_that_comes_once_does_not_recur() -> None:
    for after in ((55.0, 50.0, 0.5), (40.0, 50.0, 0.9)):
        assert [change.recurs for change in duty_changes(made(PLAIN, after))] == [False]
    once = simulate(command="36 periods of 5 sin(3t), 72 periods of 3 sin(4t)", duration=150.0, seed=5)
    changes = duty_changes(once.only(["u", "p_A", "p_B"]))
    assert changes and not any(change.recurs for change in changes)
