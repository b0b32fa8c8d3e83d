"""Killed at random instants, each of the long calls ends with the same bytes as if it had never been."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from .kills import CALLS, attack


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills as POSIX does")
@pytest.mark.parametrize("call", CALLS)
def test_killed_at_random_instants(call: str, tmp_path: Path) -> None:
    count = attack(call, tmp_path, 3, 13)
    assert (count.kills, count.differences) == (3, [])
    assert count.ends >= 1
    assert count.files >= 1
