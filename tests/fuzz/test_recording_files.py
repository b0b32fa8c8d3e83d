"""Mutated recordings of every format: a recording, or one line of an error of our own, soon; nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from .recordings import RECORDINGS
from .runs import attack


@pytest.mark.parametrize("kind", RECORDINGS)
def test_mutated_recordings(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    count = attack(kind, tmp_path, range(8))
    assert count.taken + count.refused == 8
    output = capfd.readouterr()
    assert output.out == output.err == ""


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("kind", RECORDINGS)
def test_many_mutated_recordings(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    count = attack(kind, tmp_path, range(10**6, 10**6 + 600))
    assert count.refused > 0
    output = capfd.readouterr()
    assert output.out == output.err == ""
