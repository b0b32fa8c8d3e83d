"""Results that are kept on disk are those that were computed, of the same content and rig only."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sealscope as ss
from sealscope.diagnosis import inspection
from sealscope.diagnosis.healthy import learn_once
from sealscope.diagnosis.inference.changes.healthy_levels import HealthyLevels
from sealscope.diagnosis.inference.volumes.volume_detector import VolumeBalance
from sealscope.storage.kept_results import MISSING, SUFFIX, keep_result, remove_oldest, restore_result


def draw_value(random: np.random.Generator, depth: int = 3) -> Any:
    """Draw a nested value of the types that results have."""
    kinds: list[Any] = [
        lambda: None,
        lambda: bool(random.integers(2)),
        lambda: int(random.integers(-(10**12), 10**12)),
        lambda: float(random.choice([random.normal() * 1e-300, np.pi, -0.0, np.inf])),
        lambda: "ä" * int(random.integers(4)),
        lambda: random.normal(size=tuple(random.integers(0, 4, int(random.integers(0, 4))))),
        lambda: random.integers(0, 9, 5),
        lambda: random.random(6) < 0.5,
    ]
    if depth:
        kinds += [
            lambda: [draw_value(random, depth - 1) for _ in range(3)],
            lambda: tuple(draw_value(random, depth - 1) for _ in range(2)),
            lambda: {name: draw_value(random, depth - 1) for name in ("array", "type", "table")},
        ]
    return kinds[int(random.integers(len(kinds)))]()


def assert_same(found: Any, expected: Any) -> None:
    """Check that two nested values have equal types and contents, to the last bit."""
    assert type(found) is type(expected)
    if isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        assert found.tobytes() == expected.tobytes()
    elif isinstance(expected, dict):
        assert list(found) == list(expected)
        for name in expected:
            assert_same(found[name], expected[name])
    elif isinstance(expected, list | tuple):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    else:
        assert repr(found) == repr(expected)


@pytest.mark.parametrize("seed", range(20))
def test_a_value_is_restored_to_the_last_bit(seed: int, tmp_path: Path) -> None:
    value, file = [draw_value(np.random.default_rng(seed)) for _ in range(5)], tmp_path / "value"
    keep_result(file, value)
    assert_same(restore_result(file), value)
    assert [path.name for path in tmp_path.iterdir()] == ["value"]


def test_a_damaged_file_and_a_value_of_another_type_count_as_missing(tmp_path: Path) -> None:
    file = tmp_path / "value"
    assert restore_result(file) is MISSING
    keep_result(file, {"leak": np.arange(50.0)})
    content = file.read_bytes()
    for damaged in (content[:-3], content.replace(b"leak", b"lead"), b"", content[70:]):
        file.write_bytes(damaged)
        assert restore_result(file) is MISSING
    keep_result(tmp_path / "other", {"leak": object()})
    assert not (tmp_path / "other").exists()


def test_the_oldest_results_are_removed(tmp_path: Path) -> None:
    for k in range(5):
        file = tmp_path / f"{k}{SUFFIX}"
        keep_result(file, k)
        os.utime(file, (1e9 + k, 1e9 + k))
    remove_oldest(tmp_path, 2)
    assert sorted(restore_result(file) for file in tmp_path.iterdir()) == [3, 4]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep results in a temporary folder."""
    monkeypatch.setattr("sealscope.diagnosis.healthy.results_folder", lambda: tmp_path)
    return tmp_path


def test_a_result_is_that_of_the_same_content_key_and_rig(folder: Path) -> None:
    t = np.arange(1000) / 100.0
    recording = ss.Recording(t, {"p_A": np.sin(t), "p_B": np.cos(t)}, {"p_A": "Pa", "p_B": "Pa"}, 100.0)
    calls = list[str]()

    def mean(samples: ss.Recording) -> float:
        """Compute a mean, and count the call."""
        calls.append("mean")
        return float(samples["p_A"].mean())

    rig = ss.load_rig("thesis")
    assert learn_once(recording, ("mean",), mean) == learn_once(replace(recording), ("mean",), mean)
    assert len(calls) == 1
    others = [
        replace(recording, channels={**recording.channels, "p_B": np.sin(t + 1e-9)}),
        replace(recording, provenance={"file": "other.csv"}),
        replace(recording, rate=100.5),
        replace(recording, bridged=t < 1.0),
    ]
    for count, other in enumerate(others, start=2):
        learn_once(other, ("mean",), mean)
        assert len(calls) == count
    learn_once(replace(recording), ("another mean",), mean)
    learn_once(replace(recording), ("mean",), mean, rig)
    learn_once(replace(recording), ("mean",), mean, rig.as_assumed("for a test"))  # an equal rig, but not stated
    assert len(calls) == len(others) + 4


def test_a_verdict_beside_recordings_that_were_learnt_before_is_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged, *healthy = (
        ss.simulate(command="3 sin(4t)", duration="20 s", seed=seed, **({} if seed else {"leak": "0.02 L/min"}))
        for seed in range(4)
    )
    first = ss.diagnose(judged, baseline=healthy).as_dict()
    assert len(list(folder.iterdir())) > len(healthy)

    def fail(*arguments: object) -> None:
        """Fail, as nothing is to be computed again."""
        raise AssertionError("what was learnt before is computed again")

    for detector in (VolumeBalance, HealthyLevels):
        monkeypatch.setattr(detector, "learn", fail)
    monkeypatch.setattr("sealscope.diagnosis.detectors.registry._compute_surprisals", fail)
    inspect, inspected = inspection._inspect, list[ss.Recording]()
    monkeypatch.setattr(
        inspection, "_inspect", lambda *arguments: inspected.append(arguments[0]) or inspect(*arguments)
    )
    assert ss.diagnose(replace(judged), baseline=[replace(entry) for entry in healthy]).as_dict() == first
    assert len(inspected) == 1  # the judged one


@pytest.mark.parametrize("fault", ["none", "spikes and gaps", "late samples"])
def test_the_inspection_of_a_healthy_recording_is_restored_with_its_corrections(
    fault: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = ss.simulate(command="3 sin(4t)", duration="20 s", seed=1)
    t, x, p_A = recording.t.copy(), recording["x"].copy(), recording["p_A"].copy()
    if fault == "spikes and gaps":
        x[[1000, 3000]] += 1.0
        p_A[5000:5003] = np.nan
    if fault == "late samples":
        t[::3] += 0.0009
    recording = replace(recording, t=t, channels={**recording.channels, "x": x, "p_A": p_A})
    expected = inspection.inspect_recording(replace(recording))
    assert_inspections_equal(inspection.inspect_healthy(replace(recording)), expected)
    assert (expected.part.t == t).all() == (fault != "late samples")
    if fault != "late samples":  # samples that move in time are corrected anew
        monkeypatch.setattr(inspection, "_inspect", None)
    assert_inspections_equal(inspection.inspect_healthy(replace(recording)), expected)
    assert (expected.part["x"] == x).all() == (fault == "none")


def assert_inspections_equal(found: inspection.Inspection, expected: inspection.Inspection) -> None:
    """Check that two inspections have the same samples, bit by bit, findings and numbers."""
    for name in ("t", *expected.part.channels):
        parts = [entry.part.t if name == "t" else entry.part[name] for entry in (found, expected)]
        assert parts[0].tobytes() == parts[1].tobytes()
    assert list(found.part.channels) == list(expected.part.channels)
    assert (found.part.history, found.part.bridged is None) == (expected.part.history, expected.part.bridged is None)
    assert np.array_equal(found.part.bridged, expected.part.bridged)
    assert found.findings == expected.findings
    assert [finding.places for finding in found.findings] == [finding.places for finding in expected.findings]
    for name in ("distrust", "share", "judged_from", "judged_until", "digest"):
        assert getattr(found, name) == getattr(expected, name)
