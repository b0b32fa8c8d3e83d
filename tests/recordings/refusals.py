"""What a refused file costs: one line that names it, and little work."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import read


def refused(path: Path, **options: object) -> str:
    """Return the one line, in which the file is called FILE."""
    with pytest.raises(UnreadableFile) as caught:
        read(path, **options)  # type: ignore[arg-type]
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text.replace(str(path), "FILE")


def count_calls(work: Callable[[], object]) -> int:
    """Count the calls of functions, Python's and C's, that some work makes in this thread."""
    count = 0

    def note(_: FrameType, event: str, __: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(before)
    return count


def count_bytes(work: Callable[[], object]) -> int:
    """Count the bytes that this process reads during some work; 0 where the system does not tell."""
    counters = Path("/proc/self/io")

    def so_far() -> int:
        return int(counters.read_text().split()[1]) if counters.exists() else 0

    before = so_far()
    work()
    return so_far() - before
