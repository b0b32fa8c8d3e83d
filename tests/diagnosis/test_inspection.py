"""Baselines are inspected, compared and freed of copies before any detector; a failing detector is left out."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sealscope.diagnosis.detectors import registry
from sealscope.diagnosis.diagnose import diagnose
from sealscope.diagnosis.inspection import inspect_recording, select_comparable
from sealscope.diagnosis.verdict.diagnosis import Diagnosis
from sealscope.recordings.recording import Recording

from ..refusals import refusal
from .balance_machine import machine, step


def copied(recording: Recording) -> Recording:
    """The same samples as another object, as from a copied file."""
    return replace(recording, provenance={"file": "copy.nc"})


@pytest.fixture(scope="module")
def healthy(records) -> list[Recording]:  # type: ignore[no-untyped-def]
    return [records(seed, duration=60.0, throttled=True) for seed in range(10, 13)]


def verdicts(diagnosis: Diagnosis) -> list[tuple[str, str, str, float | None, float | None]]:
    return [(own.detector, own.verdict, own.reason, own.score, own.threshold) for own in diagnosis.methods]


@pytest.mark.usefixtures("two_methods")
def test_a_baseline_equal_to_the_recording_is_refused(healthy: list[Recording]) -> None:
    recording = healthy[0]
    for baseline in (recording, [copied(recording)]):
        result = diagnose(recording, baseline)
        assert result.verdict == "cannot tell"
        assert "no baseline recording can be used: the same samples as the recording itself" in result.reason
        assert result.quality[-1].severity == "warning"
    beside = diagnose(recording, [copied(recording), healthy[1]])
    assert verdicts(beside) == verdicts(diagnose(recording, healthy[1]))
    assert beside.quality[-1].text == (
        "1 of 2 baseline recordings is left out: the same samples as the recording itself (copy.nc)"
    )


def test_a_defect_that_all_healthy_recordings_have_is_a_note(healthy: list[Recording]) -> None:
    def without_some(recording: Recording, share: float) -> Recording:
        values = recording["p_B"].copy()
        values[100 : 100 + int(share * values.size)] = np.nan
        return replace(recording, channels={**recording.channels, "p_B": values})

    def severity(share: float, *shares: float) -> str:
        baseline = [without_some(recording, part) for recording, part in zip(healthy[1:], shares, strict=False)]
        judged = inspect_recording(without_some(healthy[0], share))
        (finding,) = [finding for finding in select_comparable(judged, baseline).findings if finding.code == "missing"]
        return finding.severity

    assert severity(0.03) == "warning"
    assert severity(0.03, 0.03, 0.04) == severity(0.03, 0.002, 0.02) == "note"
    assert severity(0.03, 0.03, 0.0) == severity(0.03, 0.005, 0.01) == "warning"


@pytest.mark.slow
def test_a_leak_within_the_recording_is_stated_whatever_the_baseline(leaky: Recording) -> None:
    result = diagnose(leaky, leaky)
    assert (result.verdict, result.onset_s) == ("leak", diagnose(leaky).onset_s)


@pytest.mark.slow
def test_copies_count_once_for_every_detector(healthy: list[Recording]) -> None:
    """Three copies have no scatter of their own: they were three baselines."""
    recording, leak_free = healthy[:2]
    result = diagnose(recording, [leak_free, copied(leak_free), leak_free])
    assert verdicts(result) == verdicts(diagnose(recording, [leak_free]))
    assert result.quality[-1].code == "baseline_left_out"
    assert result.quality[-1].count == 2


def test_of_copies_the_one_with_the_most_channels_is_kept(healthy: list[Recording]) -> None:
    whole = healthy[1]
    few = whole.only(["u", "p_A", "p_B"])
    for baseline in ([few, whole], [whole, few]):
        assert select_comparable(inspect_recording(healthy[0]), baseline).parts == (whole,)


PUMP_LINES = ("p_1", "p_2")


def without_pump_lines(recording: Recording) -> Recording:
    return recording.only(name for name in recording.channels if name not in PUMP_LINES)


def test_a_recording_is_judged_by_the_channels_of_its_healthy_recordings() -> None:
    """Pressures in the pump's lines add terms to the balance: compared with none, a leak from the start was hidden."""
    healthy = [without_pump_lines(machine(seed, rate=100.0, duration=60.0)) for seed in range(1, 6)]
    leaky = machine(9, G=step(0.0, 3.0e-12, at=0.0), rate=100.0, duration=60.0)
    fewer, result = diagnose(without_pump_lines(leaky), healthy), diagnose(leaky, healthy)
    assert (result.verdict, result.leak_lpm) == (fewer.verdict, fewer.leak_lpm)
    assert result.verdict == "leak"
    (finding,) = [finding for finding in result.quality if finding.code == "channels_left_out"]
    assert finding.text.endswith("p_1, p_2")


@pytest.mark.parametrize("seed", range(3))
def test_what_most_healthy_recordings_have_and_the_judged_one_lacks_is_a_finding(seed: int) -> None:
    """Any channel, of any share of the healthy recordings; an oil temperature in the header replaces T_oil."""
    generator = np.random.default_rng(seed)
    days = [machine(k, rate=50.0, duration=20.0) for k in range(int(generator.integers(2, 6)))]
    name = str(generator.choice(["p_1", "x", "T_oil"]))
    values = {"T_oil": np.full(len(days[0]), 313.15)}
    having = int(generator.integers(0, len(days) + 1))
    healthy = [
        replace(day, channels=day.channels | values, units=day.units | {"T_oil": "K"})
        if k < having
        else day.only(channel for channel in day.channels if channel != name)
        for k, day in enumerate(days)
    ]
    judged = machine(9, rate=50.0, duration=20.0)
    judged = judged.only(channel for channel in judged.channels if channel != name)
    for remarks in ({}, {"Oil temperature": "40 °C"}):
        stated = replace(judged, provenance=judged.provenance | {"about": remarks})
        findings = select_comparable(inspect_recording(stated), healthy).findings
        missing = {finding.channel for finding in findings if finding.code == "missing_channel"}
        assert (name in missing) == (2 * having > len(days) and not (name == "T_oil" and remarks))


def test_no_leak_is_not_stated_where_the_healthy_recordings_give_another_balance() -> None:
    healthy = [machine(seed, rate=100.0, duration=60.0) for seed in range(1, 6)]
    leaky = without_pump_lines(machine(9, G=step(0.0, 3.0e-12, at=0.0), rate=100.0, duration=60.0))
    result = diagnose(leaky, healthy)
    assert result.verdict == "cannot tell"
    assert "another balance of volumes" in result.reason


@pytest.mark.usefixtures("two_methods")
@pytest.mark.parametrize(
    "fault",
    [
        "stuck",
        *(
            pytest.param(fault, marks=[pytest.mark.slow, pytest.mark.long])
            for fault in ("clipped", "constant", "too short")
        ),
    ],
)
def test_a_baseline_with_a_fault_is_left_out_for_every_detector(fault: str, healthy: list[Recording]) -> None:
    recording, leak_free, other = healthy
    p_A, p_B = np.array(other["p_A"]), np.array(other["p_B"])
    if fault == "stuck":
        p_A[20000:28000] = p_A[20000]
    elif fault == "clipped":
        p_A, p_B = (np.minimum(p, np.quantile(p, 0.4)) for p in (p_A, p_B))
    elif fault == "constant":
        p_A[:] = 3e5
    faulty = replace(other, channels={**other.channels, "p_A": p_A, "p_B": p_B})
    if fault == "too short":
        faulty = faulty.samples(slice(0, 200))
    result = diagnose(recording, [faulty, leak_free])
    plain = diagnose(recording, [leak_free])
    assert verdicts(result) == verdicts(plain)
    assert result.quality[-1].text.startswith("1 of 2 baseline recordings is left out: ")
    alone = diagnose(recording, faulty)
    assert alone.verdict == "cannot tell"
    assert "no baseline recording can be used: " in alone.reason


def test_of_a_baseline_with_a_long_gap_both_sides_are_used(healthy: list[Recording]) -> None:
    recording, leak_free = healthy[:2]
    p_A = np.array(leak_free["p_A"])
    p_A[1000:9000] = np.nan
    holed = replace(leak_free, channels={**leak_free.channels, "p_A": p_A})
    (part,) = select_comparable(inspect_recording(recording), [holed]).parts
    assert len(part) == len(leak_free)
    assert part.bridged is not None
    assert np.count_nonzero(part.bridged) == 8000


class Failing:
    """Raises `error` where it observes."""

    name = "pressure response"
    error: Exception

    def __init__(self, rig: object) -> None:
        pass

    def usable(self, recording: Recording) -> None:
        return None

    def observe(self, recording: Recording, baseline: object = ()) -> None:
        raise self.error


@pytest.mark.parametrize(
    ("error", "reason", "level"),
    [
        (RuntimeError("no\nway"), "detector 'pressure response' is left out: RuntimeError: no way", logging.ERROR),
        (ValueError("wrong shape"), "detector 'pressure response' is left out: ValueError: wrong shape", logging.ERROR),
        # numbers that nothing can be computed with are no defect of the detector
        (
            ZeroDivisionError("division by zero"),
            "pressure response cannot be computed on this recording: division by zero",
            None,
        ),
        (
            np.linalg.LinAlgError("Singular matrix"),
            "pressure response cannot be computed on this recording: singular matrix",
            None,
        ),
    ],
)
def test_where_a_main_detector_fails_nobody_says_no_leak(
    error: Exception,
    reason: str,
    level: int | None,
    healthy: list[Recording],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    rms_change = registry.DETECTORS["rms change"]
    monkeypatch.setattr(registry, "DETECTORS", {"rms change": rms_change})
    expected = diagnose(healthy[0])
    monkeypatch.setattr(registry, "DETECTORS", {"pressure response": Failing, "rms change": rms_change})
    monkeypatch.setattr(Failing, "error", error, raising=False)
    registry._log_once.cache_clear()
    with caplog.at_level(logging.DEBUG, "sealscope.diagnosis.detectors.registry"):
        result = diagnose(healthy[0])
    assert (expected.verdict, result.verdict) == ("no leak", "cannot tell")
    assert (result.score, result.reason) == (expected.score, f"{expected.reason}; {reason}")
    own = next(own for own in result.parts if own.detector == "pressure response")
    assert own.verdict == "cannot tell"
    assert own.reason == reason
    (record,) = caplog.records
    assert record.exc_info is not None  # the traceback
    assert record.levelno == (level or logging.DEBUG)
    if level is not None:
        assert record.getMessage() == own.reason


def test_wrong_arguments_are_named(healthy: list[Recording], tmp_path: Path) -> None:
    recording = healthy[0].samples(slice(0, 300))
    wrong = (
        (("log.csv",), {}, ("recording", "sealscope.read")),
        ((None,), {}, ("recording",)),
        ((recording, tmp_path), {}, ("baseline",)),
        ((recording, 3), {}, ("baseline", "int")),
        ((recording, [recording, "b.csv"]), {}, ("baseline[1]",)),
        ((recording,), {"rig": "thesi"}, ("'thesi'", "thesis")),
        ((recording,), {"rig": 3}, ("rig", "3")),
        ((recording,), {"false_alarm_probability": "0.01"}, ("probability", "'0.01'")),
        ((recording,), {"baselines": []}, ("'baselines'", "'baseline'")),
    )
    for args, keywords, names in wrong:
        with refusal(*names):
            diagnose(*args, **keywords)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.usefixtures("two_methods")
def test_rig_is_a_rig_a_name_or_a_path(healthy: list[Recording], tmp_path: Path) -> None:
    from sealscope.parameters import load_rig

    path = tmp_path / "own.toml"
    path.write_text('[rig]\nextends = "thesis"\n', encoding="utf-8")
    first, *others = (diagnose(healthy[0], rig=rig) for rig in ("thesis", load_rig("thesis"), path, str(path)))
    for other, name in zip(others, ("thesis", "own", "own"), strict=True):
        assert other.as_dict() == first.as_dict() | {"rig": first.as_dict()["rig"] | {"name": name}}
