"""Hostile options, settings and folders: taken, or refused by one line; soon, in little memory, and nothing else."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from .messages import MESSAGES
from .runs import MOST_MEMORY, attack, peak_memory
from .targets import TARGETS

FEW = {
    "options": 150,
    "rigs": 20,
    "machines": 20,
    "profiles": 30,
    "plans": 60,
    "campaign folders": 8,
    "kept files": 30,
}
FEW |= {"machines": 6, "monitor messages": 100, "CBOR messages": 300, "Sparkplug messages": 150}
#: Kinds of which even a few take seconds.
LONG = ("campaign folders", "machines")
MANY = {
    "options": 6000,
    "rigs": 2000,
    "machines": 2000,
    "profiles": 1500,
    "plans": 1000,
    "campaign folders": 500,
    "kept files": 1500,
}
MANY |= {"machines": 3000, "monitor messages": 50_000, "CBOR messages": 500_000, "Sparkplug messages": 50_000}


def some(kind: str, folder: Path, seeds: range, capfd: pytest.CaptureFixture[str]) -> None:
    before = peak_memory()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        count = attack(kind, folder, seeds)
    assert count.taken > 0
    assert count.refused > 0
    assert peak_memory() - before < MOST_MEMORY
    output = capfd.readouterr()
    assert output.out == output.err == ""


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=[pytest.mark.slow] * (kind in LONG)) for kind in (*TARGETS, *MESSAGES)],
)
def test_hostile_inputs(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    some(kind, tmp_path, range(FEW[kind]), capfd)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("kind", [*TARGETS, *MESSAGES])
def test_many_hostile_inputs(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    some(kind, tmp_path, range(10**6, 10**6 + MANY[kind]), capfd)
