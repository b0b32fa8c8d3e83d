"""The example of docs/streams.md, as a user copies it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "streams.md"


EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_the_watched_machine_is_saved_and_continued(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code = EXAMPLES[0]
    assert "ss.watch(" in code
    assert len(code.splitlines()) <= 15
    exec(compile(code, PAGE.name, "exec"), {"__name__": "page"})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    when, onset = (float(re.findall(r"[\d.]+ s", line)[0][:-2]) for line in lines)
    assert 90 < when < 110
    assert onset == pytest.approx(90.0, abs=0.5)
    low, high = map(float, re.findall(r"\((\d\.\d+) to (\d\.\d+)\)", lines[1])[0])
    assert low <= 0.0042 <= high
