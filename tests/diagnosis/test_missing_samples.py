"""Missing samples hide no leak: blocks on both sides of a gap are judged, and a verdict names the share it rests on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inference.volumes.recorded import RecordedBalance
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.diagnosis.inspection import inspect_recording
from sealscope.diagnosis.rms_change.rms_detector import RmsChange
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.parameters import load_rig
from sealscope.recordings.recording import Recording

from ..representatives import SLOW, few
from ..wording import says
from .judging import judge

VIEWS = {"all": None, "command": ("u", "p_A", "p_B"), "pressures": ("p_A", "p_B")}


def holed(recording: Recording, rows: np.ndarray, *names: str) -> Recording:
    own = {name: np.where(rows, np.nan, recording[name]) for name in names or recording.channels}
    return replace(recording, channels={**recording.channels, **own})


def observed(recording: Recording, view: str) -> Recording:
    names = VIEWS[view]
    return recording if names is None else recording.only(names)


@pytest.fixture(scope="module")
def late_leak(records) -> Recording:  # type: ignore[no-untyped-def]
    return records(1, leak="0.05 L/min from 61 s", duration=120.0, throttled=True)


@pytest.fixture(scope="module")
def of_late_leak(late_leak: Recording) -> Diagnosis:
    """The diagnosis of it as it is."""
    return diagnose(late_leak)


GAPS: dict[str, Callable[[Recording], Recording]] = {
    "one sample before the onset": lambda r: holed(r, np.arange(len(r)) == 30_250, "p_A"),
    "samples here and there after the onset": lambda r: holed(
        r, (np.random.default_rng(0).random(len(r)) < 0.005) & (r.t > 61.0), "p_A"
    ),
    "2 s of all channels": lambda r: holed(r, (r.t > 58.0) & (r.t < 60.0)),
    "rows lost": lambda r: replace(
        r, t=np.delete(r.t, slice(29_500, 30_400)),
        channels={name: np.delete(values, slice(29_500, 30_400)) for name, values in r.channels.items()},
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("gap", "view"),
    [
        *((gap, "pressures") for gap in GAPS),
        pytest.param("one sample before the onset", "command", marks=pytest.mark.slow),
        *(pytest.param(gap, "all", marks=pytest.mark.slow) for gap in GAPS),
    ],
)
def test_a_leak_after_a_gap_is_found(gap: str, view: str, late_leak: Recording) -> None:
    """The ringing alone by its own rule: weighed against all else that makes it fall it is no verdict."""
    recording = observed(GAPS[gap](late_leak), view)
    diagnosis = judge(RmsChange(), inspect_recording(recording).part) if view == "pressures" else diagnose(recording)
    assert diagnosis.verdict == "leak", diagnosis.reason
    assert diagnosis.onset_s == pytest.approx(61.0, abs=5.0)  # within the blocks that the gap takes


@pytest.mark.parametrize("view", few(VIEWS, 1, SLOW))
def test_a_few_missing_samples_change_no_verdict_of_a_sound_machine(view: str, healthy: Recording) -> None:
    diagnosis = diagnose(observed(GAPS["2 s of all channels"](healthy), view))
    assert diagnosis.verdict == "no leak"
    assert says(diagnosis.reason, "doubt.share", percent=100 * diagnosis.share)
    assert 0.95 <= diagnosis.share < 1.0


MOTIONS = {
    "a slower encoder": lambda r: holed(r, np.arange(len(r)) % 5 > 0, "x"),
    "samples here and there": lambda r: holed(
        r, np.random.default_rng(0).random(len(r)) < 0.001, "x", "theta", "omega"
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("gaps", ["samples here and there", pytest.param("a slower encoder", marks=pytest.mark.slow)])
def test_a_motion_with_short_gaps_is_that_of_a_mass(
    gaps: str, late_leak: Recording, of_late_leak: Diagnosis, healthy: Recording
) -> None:
    """A position on every fifth row ended in an error of linear algebra, single samples in `cannot tell`."""
    whole, missing = of_late_leak, diagnose(MOTIONS[gaps](late_leak))
    assert (missing.verdict, missing.share) == ("leak", 1.0)
    assert missing.methods[0].detector == "volume balance"
    assert missing.relative.pump_share == pytest.approx(whole.relative.pump_share, rel=0.1)
    assert diagnose(MOTIONS[gaps](healthy)).verdict == "no leak"


def test_without_a_balance_no_leak_needs_nearly_all_of_the_recording(healthy: Recording) -> None:
    """A tenth of a second in every four after half: hardly a sample is missing, and few blocks are left."""
    diagnosis = diagnose(observed(dotted(healthy), "pressures"))
    assert diagnosis.verdict == "cannot tell"
    assert says(diagnosis.reason, "doubt.rest")


@pytest.mark.parametrize(
    ("seconds", "verdict"), few([((100.0, 120.0), "cannot tell"), ((20.0, 35.0), "no leak")], 1, SLOW)
)
def test_only_a_missing_end_hides_a_leak(seconds: tuple[float, float], verdict: str, healthy: Recording) -> None:
    """A leak stays once it began: what comes after a gap shows it, whatever the gap is long."""
    start, end = seconds
    diagnosis = diagnose(holed(healthy, (healthy.t >= start) & (healthy.t < end)))
    assert (diagnosis.verdict, diagnosis.share < 0.95) == (verdict, True)


def test_a_missing_start_makes_a_missing_end_no_longer(healthy: Recording) -> None:
    """The position lacks in the last 5 s: 4.2 % of the recording, but 8.3 % of the part with pressures."""
    without_start = holed(healthy, healthy.t < 60.0, "p_A", "p_B")
    diagnosis = diagnose(holed(without_start, healthy.t >= 115.0, "x"))
    assert not says(diagnosis.reason, "doubt.rest"), diagnosis.reason
    assert 0.4 < diagnosis.share < 0.5


def test_a_missing_beginning_hides_a_leak_without_healthy_recordings(healthy: Recording) -> None:
    """A leak that began in the part that is missing is there in all that is judged."""
    without_start = holed(healthy, healthy.t < 60.0, "p_A", "p_B")
    diagnosis = diagnose(without_start)
    assert diagnosis.verdict == "cannot tell"
    assert says(diagnosis.reason, "doubt.beginning", percent=50.0)
    assert diagnose(without_start, [healthy]).verdict == "no leak"


@pytest.mark.slow
def test_what_a_hole_touches_weighs_less_and_is_not_lost(
    late_leak: Recording, of_late_leak: Diagnosis, healthy: Recording
) -> None:
    """The balance loses as much as the holes last, not the test functions that they touch."""
    whole, holes = of_late_leak, diagnose(dotted(late_leak))
    assert holes.verdict == "leak"
    assert holes.relative.pump_share == pytest.approx(whole.relative.pump_share, rel=0.05)
    sound = diagnose(dotted(healthy))
    assert sound.verdict == "no leak"
    assert sound.share > 0.98


def dotted(recording: Recording) -> Recording:
    return holed(recording, (recording.t % 4.0 < 0.1) & (recording.t > 60.0))


@pytest.fixture(scope="module")
def polled_leak(late_leak: Recording) -> Recording:
    """The recording as a poll of 10 to 20 ms with holes of 0.2 s in each 4 s takes it."""
    random = np.random.default_rng(7)
    steps = random.integers(10, 21, 9000) * 1e-3
    steps[::267] = 0.2
    t = np.cumsum(steps)
    t = t[t < late_leak.t[-1]]
    channels = {name: np.interp(t, late_leak.t, values) for name, values in late_leak.channels.items()}
    return replace(late_leak, t=t, channels=channels, rate=1.0 / 0.015)


def balance_of(recording: Recording) -> RecordedBalance:
    balance = VolumeBalance(load_rig("thesis")).balance(inspect_recording(recording).part)
    assert balance is not None
    return balance


def step_of(recording: Recording) -> tuple[float, float, float]:
    """Estimate a step of the leak as a share of the flow, and its score and onset [s]."""
    balance = balance_of(recording)
    assert balance.test is not None
    onset = balance.test.onset().value
    return balance.test.fitted[0] * balance.mean_pressure() / balance.mean_flow, balance.test.score, onset


def test_a_poll_with_holes_gives_the_same_leak(late_leak: Recording, polled_leak: Recording) -> None:
    """It was judged by its longest stretch without a hole, 4 s of 120 s."""
    (share, score, onset), (polled_share, polled_score, polled_onset) = step_of(late_leak), step_of(polled_leak)
    assert polled_share == pytest.approx(share, rel=0.06)
    assert polled_score > 0.8 * score
    assert polled_onset == pytest.approx(onset, abs=1.0)
    rows = balance_of(polled_leak).blocks.rows
    assert rows.mean() > 0.94 * rows.max()


@pytest.mark.parametrize(
    ("name", "every"),
    [
        ("x", 50),
        pytest.param("p_A", 15, marks=[pytest.mark.slow, pytest.mark.long]),
        pytest.param("p_B", 50, marks=[pytest.mark.slow, pytest.mark.long]),
    ],
)
def test_a_channel_that_repeats_its_samples_gives_the_same_leak(
    late_leak: Recording, of_late_leak: Diagnosis, name: str, every: int
) -> None:
    """Samples held for 0.03 or 0.1 s: the mean delay of x was 50 ms."""
    held = late_leak[name][np.arange(len(late_leak)) // every * every]
    whole, diagnosis = of_late_leak, diagnose(replace(late_leak, channels={**late_leak.channels, name: held}))
    assert diagnosis.verdict == "leak"
    assert diagnosis.relative.pump_share == pytest.approx(whole.relative.pump_share, rel=0.1)
    (finding,) = (own for own in diagnosis.quality if own.code == "held_samples")
    assert finding.channel == name
    assert f"repeats each sample for {every / 500:.2g} s" in finding.text


@pytest.mark.slow
def test_rows_that_repeat_the_one_before_are_left_out(late_leak: Recording, of_late_leak: Diagnosis) -> None:
    rows = np.arange(len(late_leak)) - (np.random.default_rng(3).random(len(late_leak)) < 0.07)
    rows[0] = 0
    repeated = replace(late_leak, channels={name: values[rows] for name, values in late_leak.channels.items()})
    whole, diagnosis = of_late_leak, diagnose(repeated)
    assert diagnosis.relative.pump_share == pytest.approx(whole.relative.pump_share, rel=0.05)
    assert any(own.code == "repeated_rows" for own in diagnosis.quality)


@pytest.mark.slow
def test_single_samples_that_leap_are_left_out(late_leak: Recording, of_late_leak: Diagnosis) -> None:
    p_A = np.array(late_leak["p_A"])
    p_A[[9000, 31_000]] = 0.0, 4e7
    whole, diagnosis = of_late_leak, diagnose(replace(late_leak, channels={**late_leak.channels, "p_A": p_A}))
    assert diagnosis.relative.pump_share == pytest.approx(whole.relative.pump_share, rel=0.02)
    assert next(own.count for own in diagnosis.quality if own.code == "spike") == 2


@pytest.mark.parametrize("flow", few(["omega", "q_pump"], 1, SLOW))
def test_a_speed_without_a_sign_gets_it_from_the_motion(late_leak: Recording, flow: str) -> None:
    """Displacement over area read several times the assumed one, and no leak was found."""
    speed = late_leak["omega"] if flow == "omega" else late_leak["omega"] * load_rig("thesis").pump.q_b / (2 * np.pi)
    channels = {name: late_leak[name] for name in ("x", "p_A", "p_B")} | {flow: speed}
    signed = replace(late_leak, channels=channels, units=dict(late_leak.units) | {"q_pump": "m^3/s"})
    unsigned = replace(signed, channels={**channels, flow: np.abs(speed)})
    assert step_of(unsigned)[:2] == pytest.approx(step_of(signed)[:2], rel=0.05)
    (finding,) = (own for own in inspect_recording(unsigned).findings if own.code == "unsigned_speed")
    assert (
        "never changes its sign and the piston does" in finding.text and finding.severity == "note"
    )  # mended: no fault to rule out first
    assert not any(own.code == "unsigned_speed" for own in inspect_recording(signed).findings)


def test_without_a_position_the_command_gives_the_sign(late_leak: Recording) -> None:
    unsigned = late_leak.only(("u", "omega", "p_A", "p_B"))
    unsigned = replace(unsigned, channels={**unsigned.channels, "omega": np.abs(unsigned["omega"])})
    part = inspect_recording(unsigned).part
    assert np.mean(np.sign(part["omega"]) == np.sign(late_leak["omega"])) > 0.95


def test_a_pressure_that_is_stuck_for_a_moment_is_missing_there(late_leak: Recording) -> None:
    """The whole recording was refused."""
    p_A = np.array(late_leak["p_A"])
    p_A[20_000:20_400] = p_A[20_000]
    part = inspect_recording(replace(late_leak, channels={**late_leak.channels, "p_A": p_A}))
    assert part.distrust is None
    assert part.part.bridged is not None
    assert np.flatnonzero(part.part.bridged)[[0, -1]] == pytest.approx([20_000, 20_399], abs=2)


def test_a_pressure_that_rests_with_the_machine_is_not_stuck() -> None:
    """A clamp at rest: a quiet sensor of 0.1 bar steps reads one value, and jumps as the clamp moves."""
    t = np.arange(12_000) / 100.0
    moving = np.sin(2 * np.pi * t / 20.0) > 0.0
    random = np.random.default_rng(0)
    p_A = np.where(moving, 4e6 + 1e6 * np.sin(3 * t) + 3e4 * random.standard_normal(t.size), 2e5)
    p_B = np.where(moving, 1e6 + 3e4 * random.standard_normal(t.size), 1e5)
    p_A[:100] = 1e5  # another value is the least
    x = 0.1 * np.cumsum(moving * np.sin(3 * t)) / 100.0
    channels = {"p_A": np.round(p_A, -4), "p_B": np.round(p_B, -4), "x": x}
    recording = Recording(t, channels, {"p_A": "Pa", "p_B": "Pa", "x": "m"}, 100.0)
    assert any(own.code == "stuck" for own in inspect_recording(recording).findings)
    assert inspect_recording(recording).distrust is None
    assert inspect_recording(recording).part.bridged is None


def test_a_folder_is_watched_by_the_samples_that_a_recording_is_judged_by(polled_leak: Recording) -> None:
    """A poll of 10 to 20 ms ended in a gap every few seconds and a rate that changed."""
    from sealscope.diagnosis.live.watch import watch
    from sealscope.recordings.corrections.samples import correct_samples, remove_holes

    samples = remove_holes(correct_samples(polled_leak).recording)
    part = inspect_recording(polled_leak).part
    assert len(samples) == len(part)
    known = np.isfinite(samples["p_A"])
    assert np.array_equal(samples["p_A"][known], part["p_A"][known])
    assert np.mean(known) > 0.94
    own = watch("thesis")
    estimates = own.update(samples)
    assert "gap" not in own.counters
    assert sum(estimate.total_lpm is not None for estimate in estimates) > 10


@pytest.mark.slow
def test_a_joystick_in_percent_beside_the_speed_takes_no_size_away(late_leak: Recording) -> None:
    in_percent = replace(late_leak, units={**late_leak.units, "u": "count"})
    own, other = diagnose(late_leak, rig="thesis"), diagnose(in_percent, rig="thesis")
    assert own.leak_lpm is not None
    assert other.leak_lpm == pytest.approx(own.leak_lpm)
