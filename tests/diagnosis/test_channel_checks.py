"""Each fault of a channel changes the check that shows it, and only a healthy mapping gives no warning."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis.channel_checks import ChannelCheck, check_channels
from sealscope.diagnosis.flow_curves import compute_flow_curves
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.recordings import Recording

NAMES = ["p_A", "p_B", "x", "omega"]


@pytest.fixture(scope="module", params=[1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def run(request) -> Recording:
    """A run of a healthy machine, by its seed."""
    return ss.simulate(duration="16 s", seed=request.param).only(NAMES)


def change(recording: Recording, **changed: np.ndarray) -> Recording:
    return replace(recording, channels={**recording.channels, **changed})


def check(recording: Recording, rig: ss.Rig | None = None) -> dict[str, ChannelCheck]:
    return {entry.name: entry for entry in check_channels(recording, rig, compute_flow_curves(recording, rig))}


def test_right_channels_give_no_warning(run: Recording) -> None:
    checks = check(run)
    assert list(checks) == ["load", "speed", "rest", "delay"]
    assert all(entry.severity == "" for entry in checks.values())
    outward, inward = (next(c for c in checks["load"].curves if c.name == f"mean {way}") for way in ("out", "in"))
    known = np.isfinite(outward.y) & np.isfinite(inward.y)
    assert np.all(np.asarray(outward.y - inward.y)[known] > 0.0)
    assert abs(checks["delay"].mark or 0.0) < 1e3 / run.rate


@pytest.mark.parametrize("fault", ["swapped", "mirrored"])
def test_swapped_chambers_and_a_mirrored_position_turn_the_load_round(run: Recording, fault: str) -> None:
    faulty = change(run, p_A=run["p_B"], p_B=run["p_A"]) if fault == "swapped" else change(run, x=-run["x"])
    load = check(faulty)["load"]
    assert load.severity == "warning" and "swapped" in load.text


def test_a_zero_error_of_a_pressure_shifts_the_load(run: Recording) -> None:
    """By its force in the whole stroke, for the areas that are stated."""
    rig = ss.load_rig("thesis")
    before, after = (
        np.nanmean(check(recording, rig)["load"].curves[1].y) for recording in (run, change(run, p_A=run["p_A"] + 2e5))
    )
    assert after - before == pytest.approx(2e5 * rig.cylinder.A_A / 1e3, rel=1e-6)


def test_a_speed_without_a_sign_is_a_v(run: Recording) -> None:
    speed = check(change(run, omega=np.abs(run["omega"])))["speed"]
    assert speed.severity == "warning" and speed.text.startswith("Speed without a sign")
    cloud = speed.curves[0]
    assert np.min(cloud.x) >= 0.0 and np.min(cloud.y) < 0.0 < np.max(cloud.y)


def test_a_zero_error_of_the_speed_is_seen_in_motion_and_at_rest(run: Recording) -> None:
    draw = np.random.default_rng(5)
    offset = float(draw.uniform(20.0, 40.0))  # [rpm]
    shifted = run["omega"] + offset * np.pi / 30.0
    speed = check(change(run, omega=shifted))["speed"]
    stated = float(speed.text.split("which is ")[1].split(" rpm")[0])
    assert stated == pytest.approx(offset, abs=5.0)
    count = len(run) // 4
    pause = {name: np.r_[np.full(count, run[name][0]), run[name]] for name in ("x", "p_A", "p_B")}
    noise = {name: draw.normal(0.0, 1e-9 if name == "x" else 100.0, count) for name in pause}
    for name, values in noise.items():
        pause[name][:count] += values
    pause["omega"] = np.r_[draw.normal(0.0, 0.01, count), run["omega"]] + offset * np.pi / 30.0
    t = np.arange(count + len(run)) / run.rate
    rest = check(replace(run, t=t, channels=pause))["rest"]
    assert rest.curves and np.median(rest.curves[0].y) == pytest.approx(offset, abs=1.0)
    assert np.max(rest.curves[0].x) < 1.1 * count / run.rate + 0.5


@pytest.mark.parametrize("late", [-0.05, 0.03, 0.08])
def test_a_delay_moves_the_least_misfit(run: Recording, late: float) -> None:
    x = np.interp(run.t - late, run.t, run["x"])
    delay = check_channels(change(run, x=x))[-1]  # by the speeds alone
    assert delay.name == "delay" and delay.mark == pytest.approx(1e3 * late, abs=6.0)
    by_volumes = check(change(run, x=x))["delay"]
    assert by_volumes.mark == pytest.approx(1e3 * late, abs=6.0)


def test_a_wrong_bore_leaves_the_stated_line(run: Recording) -> None:
    rig = ss.load_rig("thesis")
    lines = {}
    for scale in (1.0, 1.5):
        stated = rig.with_areas(scale * rig.cylinder.A_A, scale * rig.cylinder.A_B, source="stated")
        curves = {curve.name: curve for curve in check(run, stated)["speed"].curves}
        lines[scale] = curves["by the stated area A"].y[-1] / curves["proportional"].y[-1]
    assert lines[1.0] == pytest.approx(1.0, abs=0.1) and lines[1.5] == pytest.approx(lines[1.0] / 1.5)


def test_glitches_and_wraps_are_found_where_they_are(run: Recording) -> None:
    draw = np.random.default_rng(8)
    rows = np.sort(draw.choice(np.arange(500, len(run) - 500, 400), 3, replace=False))
    p_A = run["p_A"].copy()
    p_A[rows] += 4e6
    theta = np.cumsum(run["omega"]) / run.rate
    wrapped = np.mod(theta, 2.0 * np.pi)
    faulty = replace(run, channels={**run.channels, "p_A": p_A, "theta": wrapped}, units={**run.units, "theta": "rad"})
    places: dict[str, tuple[float, ...]] = {
        finding.code: finding.places for finding in inspect_recording(faulty).findings
    }
    assert np.allclose(places["spike"], run.t[rows])
    leaps = np.flatnonzero(np.abs(np.diff(wrapped)) > np.pi) + 1
    assert np.allclose(places["angle_unwrapped"], run.t[leaps][:200])


def lose_rows(recording: Recording) -> Recording:
    kept = np.delete(np.arange(len(recording)), range(800, 900))
    channels = {name: values[kept] for name, values in recording.channels.items()}
    return replace(recording, t=recording.t[kept], channels=channels)


def lose_pressure(recording: Recording) -> Recording:
    return change(recording, p_B=np.where((recording.t > 4.0) & (recording.t < 4.5), np.nan, recording["p_B"]))


@pytest.mark.parametrize(("code", "spoil", "begin"), [("gap", lose_rows, 1.6), ("missing", lose_pressure, 4.0)])
def test_gaps_are_found_where_they_are_and_the_checks_stay(
    run: Recording, code: str, spoil: Callable[[Recording], Recording], begin: float
) -> None:
    faulty = spoil(run)
    place = next(finding.places for finding in ss.inspect(faulty) if finding.code == code)
    assert place[0] == pytest.approx(begin, abs=0.01)
    assert all(entry.severity == "" for entry in check_channels(faulty))


def test_without_pressures_or_flow_there_is_no_check(run: Recording) -> None:
    assert check_channels(run.only(["p_A"])) == ()
    assert [entry.name for entry in check_channels(run.only(["p_A", "p_B", "x"]))] == ["load"]
