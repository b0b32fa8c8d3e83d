"""Real strokes of two rotary actuators, one with a defective inner seal (public data set vtnsi/actuator_dataset).

One specimen leaks and the two were recorded on different days: that its strokes differ from the healthy ones says
nothing of why.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
from scipy.stats import binom

from sealscope.diagnosis.diagnose import diagnose
from sealscope.recordings import read
from sealscope.recordings.recording import Recording

from ..wording import says

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "real" / "vtnsi_actuator"
MAP = {"p_A": "PG_1", "p_B": "PG_2"}
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="../shared/data/real/vtnsi_actuator is absent")


def files(name: str) -> list[Path]:
    """The strokes in the order in which they were recorded."""
    return sorted((FOLDER / name).glob("*.txt"), key=lambda path: int(re.findall(r"_000_(\d+)_", path.name)[0]))


@pytest.fixture(scope="module")
def healthy() -> list[Recording]:
    return [read(path, map=MAP, rate=1000) for path in files("act_1_healthy")]


@pytest.fixture(scope="module")
def defective() -> list[Recording]:
    return [read(path, map=MAP, rate=1000) for path in files("act_4_seal_defect")]


def within(stroke: Recording, baseline: list[Recording]) -> str:
    """The verdict of the details' RMS against the baseline."""
    return next(own.verdict for own in diagnose(stroke, baseline).parts if own.detector == "rms change")


@pytest.mark.slow
@pytest.mark.parametrize("every", [30, pytest.param(1, marks=pytest.mark.long)])
def test_defective_against_healthy(healthy: list[Recording], defective: list[Recording], every: int) -> None:
    """One specimen with a defect, recorded on another day: a change of the ringing or its bound is stated, no L/min."""
    for stroke in defective[::every]:
        result = diagnose(stroke, healthy)
        assert result.verdict == "leak" or any(
            says(result.reason, f"bound.{key}") for key in ("ringing", "ringing_hidden")
        )
        assert says(result.reason, "bound.against", count=len(healthy))
        assert result.leak_lpm is None  # counts allow no L/min
        json.dumps(result.as_dict(), allow_nan=False)


@pytest.fixture(scope="module")
def strokes() -> ModuleType:
    """`benchmarks/strokes.py`, which measures what is tested here."""
    spec = spec_from_file_location("strokes", Path(__file__).resolve().parents[2] / "benchmarks" / "strokes.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SESSIONS = ("session_act_1_healthy", "session_act_2_healthy")


@pytest.fixture(scope="module")
def sessions() -> dict[str, list[Recording]]:
    missing = [name for name in SESSIONS if not (FOLDER / name).is_dir()]
    if missing:
        pytest.skip(f"{missing} not in {FOLDER}")
    return {name: [read(path, map=MAP, rate=1000) for path in files(name)] for name in SESSIONS}


@pytest.mark.slow
@pytest.mark.parametrize("name", [SESSIONS[0], pytest.param(SESSIONS[1], marks=pytest.mark.long)])
def test_later_strokes_of_a_session_are_no_leak(name: str, sessions: dict[str, list[Recording]]) -> None:
    """The first 20 strokes as baseline; at most 3 % of all later ones."""
    verdicts = Counter(within(stroke, sessions[name][:20]) for stroke in sessions[name][20::6])
    assert verdicts["leak"] <= 1  # of 14 or 15
    assert verdicts["no leak"] >= 13


@pytest.mark.slow
@pytest.mark.parametrize("every", [80, pytest.param(12, marks=pytest.mark.long)])
def test_another_healthy_specimen_is_no_leak(sessions: dict[str, list[Recording]], every: int) -> None:
    """75 % of the strokes of one specimen were `leak` against the other while their scatter alone counted."""
    for name, other in (SESSIONS, SESSIONS[::-1]):
        verdicts = Counter(diagnose(stroke, sessions[name]).verdict for stroke in sessions[other][::every])
        assert verdicts["leak"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.6, *(pytest.param(gain, marks=pytest.mark.long) for gain in (1.0, 1.5))])
def test_a_change_within_a_session_is_named(
    gain: float, sessions: dict[str, list[Recording]], strokes: ModuleType
) -> None:
    """Pairs in turn as baseline; what is faster than d5 is scaled in the others of the session's second half.

    A fall of the ringing is stated beside what else makes it, without a position never as a leak; a rise is no leak.
    """
    session = sessions["session_act_1_healthy"]
    baseline = [stroke for k, stroke in enumerate(session) if (k // 2) % 2 == 0]
    later = [stroke for k, stroke in enumerate(session) if (k // 2) % 2 and k > len(session) // 2][::6]
    verdicts = Counter(diagnose(strokes.louder(stroke, gain), baseline).verdict for stroke in later)
    assert verdicts["cannot tell" if gain < 1.0 else "no leak"] >= 0.9 * len(later)
    assert verdicts["leak"] == 0


@pytest.mark.slow
@pytest.mark.long
def test_healthy_against_its_own_other_half(healthy: list[Recording]) -> None:
    """Pairs of strokes (one of each direction) in turn: none of 30 alarms at 1 %."""
    halves = [[one for k, one in enumerate(healthy) if (k // 2) % 2 == half] for half in (0, 1)]
    verdicts = Counter(within(stroke, other) for half, other in (halves, halves[::-1]) for stroke in half)
    assert verdicts["leak"] == 0
    assert verdicts["no leak"] == 30


@pytest.mark.slow
@pytest.mark.parametrize("every", [30, pytest.param(1, marks=pytest.mark.long)])
def test_healthy_with_one_left_out(healthy: list[Recording], every: int) -> None:
    chosen = range(0, 30, every)
    verdicts = Counter(diagnose(healthy[k], healthy[:k] + healthy[k + 1 :]).verdict for k in chosen)
    assert verdicts["leak"] <= binom.ppf(0.99, len(chosen), 0.01)
    assert sum(verdicts.values()) == len(chosen)


def test_a_single_stroke_is_too_short_to_be_its_own_baseline(defective: list[Recording]) -> None:
    for stroke in defective[::4]:
        result = diagnose(stroke)
        assert result.verdict == "cannot tell"
