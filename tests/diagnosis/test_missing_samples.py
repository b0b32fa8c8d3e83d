"""Missing samples hide no leak: blocks on both sides of a gap are judged, and a verdict names the share it rests on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inspection import inspected
from sealscope.diagnosis.rms_change.detector import RmsChange
from sealscope.recordings.recording import Recording

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
    diagnosis = judge(RmsChange(), inspected(recording).part) if view == "pressures" else diagnose(recording)
    assert diagnosis.verdict == "leak", diagnosis.reason
    assert diagnosis.onset_s == pytest.approx(61.0, abs=5.0)  # within the blocks that the gap takes


@pytest.mark.parametrize("view", VIEWS)
def test_a_few_missing_samples_change_no_verdict_of_a_sound_machine(view: str, healthy: Recording) -> None:
    diagnosis = diagnose(observed(GAPS["2 s of all channels"](healthy), view))
    assert diagnosis.verdict == "no leak"
    assert f"this rests on {100 * diagnosis.share:.3g} % of the recording" in diagnosis.reason
    assert 0.95 <= diagnosis.share < 1.0


MOTIONS = {
    "a slower encoder": lambda r: holed(r, np.arange(len(r)) % 5 > 0, "x"),
    "samples here and there": lambda r: holed(
        r, np.random.default_rng(0).random(len(r)) < 0.001, "x", "theta", "omega"
    ),
}


@pytest.mark.parametrize("gaps", MOTIONS)
def test_a_motion_with_short_gaps_is_that_of_a_mass(gaps: str, late_leak: Recording, healthy: Recording) -> None:
    """A position on every fifth row ended in an error of linear algebra, single samples in `cannot tell`."""
    whole, missing = diagnose(late_leak), diagnose(MOTIONS[gaps](late_leak))
    assert (missing.verdict, missing.share) == ("leak", 1.0)
    assert missing.methods[0].detector == "volume balance"
    assert missing.relative.pump_share == pytest.approx(whole.relative.pump_share, rel=0.1)
    assert diagnose(MOTIONS[gaps](healthy)).verdict == "no leak"


@pytest.mark.parametrize("view", ["all", "pressures"])
def test_no_leak_needs_nearly_all_of_the_recording(view: str, healthy: Recording) -> None:
    """A tenth of a second in every four after half: hardly a sample is missing, and few blocks are left."""
    diagnosis = diagnose(observed(holed(healthy, (healthy.t % 4.0 < 0.1) & (healthy.t > 60.0)), view))
    assert diagnosis.verdict == "cannot tell"
    assert "the rest may hide a leak" in diagnosis.reason
