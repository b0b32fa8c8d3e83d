"""Structured Text under a parser of IEC 61131-3 that is not of this project: blark."""

from __future__ import annotations

import pytest

from sealscope.emit.st_export import pieces

from .test_stream import unit_at

#: Parts that people call; the others are written by the same emitter, and take minutes to parse.
CALLED = ("LEAK_STATE", "LEAK_MONITOR", "FB_HoldTest", "FB_LeakAlarm", "FB_Recorder")


@pytest.mark.slow
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_parser_reads_each_part(every):
    pytest.importorskip("blark", reason="blark parses Structured Text: pip install blark")
    from blark.parse import parse_source_code

    unit = unit_at(16.0)
    parts = list(pieces(unit, "leak", [float(k) for k in range(unit.n_learned + 2)]))
    assert set(CALLED) <= {part.name for part in parts}
    for part in parts:
        if every or part.name in CALLED:
            result = parse_source_code(part.text)
            assert result.exception is None, (part.name, result.exception)
