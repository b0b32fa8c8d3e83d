"""Structured Text under a parser of IEC 61131-3 that is not of this project: blark."""

from __future__ import annotations

import re

import pytest

from sealscope.emit.st_export import pieces, render_st

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


#: Of TIA Portal: marks that other tools do not know, and what stands there instead.
_MARKS = (
    *((r'"(\w+)"', r"\1"), (r"#(?=[A-Za-z_])", ""), (r"\{ S7_Optimized_Access := 'TRUE' \}\n", ""), (r"^BEGIN\n", "")),
    *((r"^VAR_TEMP$", "VAR"), (r"^VAR CONSTANT$", "VAR"), (r"^TYPE (\w+)$", r"TYPE \1 :")),
)


def without_marks(text):
    for pattern, replacement in _MARKS:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    return text


def test_a_source_of_tia_is_the_same_text_with_its_marks():
    unit = unit_at(16.0)
    learned = [1e-9 * (-1) ** k * k for k in range(unit.n_learned + 2)]
    files = render_st(unit, prefix="leak", title="A machine", origin="a test", alarm_rate=1.0, learned=learned)
    source = files["leak.scl"]
    assert (
        without_marks(source).split() == re.sub("^VAR CONSTANT$", "VAR", files["leak.st"], flags=re.MULTILINE).split()
    )
    parts = list(pieces(unit, "leak", learned))
    names = {part.name for part in parts}
    blocks = re.findall(r'^(FUNCTION(?:_BLOCK)?) "(\w+)".*?^END_\1$', source, re.MULTILINE | re.DOTALL)
    assert {name for _, name in blocks} | {part.name for part in parts if part.kind == "dataType"} == names
    text = re.sub(r"\(\*.*?\*\)", "", source, flags=re.DOTALL)
    assert not re.search(r"^\(\*(?:(?!\*\)).)*^BEGIN", source, re.MULTILINE | re.DOTALL)
    for kind, head, body in re.findall(r'^(FUNCTION(?:_BLOCK)?) "\w+"(.*?)^BEGIN\n(.*?)^END_\1$', text, re.M | re.S):
        declared = {name.lower() for name in re.findall(r"^    (\w+) :", head, re.MULTILINE)}
        types = set(re.findall(r'^    \w+ : (?:ARRAY .* OF )?("?\w+"?)', head, re.MULTILINE))
        assert types <= {"LREAL", "DINT", "BOOL"} | {f'"{name}"' for name in names}
        assert "CONSTANT" not in head and ("VAR_TEMP" in head or kind == "FUNCTION_BLOCK")
        arguments = re.sub(r"(?<=[(,])\s*(\w+) :=", "", body)  # formal names of calls
        bare = {word.lower() for word in re.findall(r'(?<![\w.#"])[A-Za-z]\w*', arguments)}
        assert not bare & declared, bare & declared
        assert {name.lower() for name in re.findall(r"#([A-Za-z]\w*)", body)} - {"0"} <= declared | {
            name.lower() for name in names
        }
