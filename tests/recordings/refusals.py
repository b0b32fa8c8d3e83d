"""What a refused file costs: one line that names it, soon."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from sealscope.errors import UnreadableFile
from sealscope.recordings import read


def refused(path: Path, seconds: float = 10.0, **options: object) -> str:
    """Return the one line, in which the file is called FILE."""
    start = time.perf_counter()
    with pytest.raises(UnreadableFile) as caught:
        read(path, **options)  # type: ignore[arg-type]
    assert time.perf_counter() - start < seconds
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    return text.replace(str(path), "FILE")
