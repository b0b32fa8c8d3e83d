"""The files of a stream in Structured Text: function blocks as plain text, as PLCopen XML, and for TIA Portal."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

from sealscope.emit import function_blocks
from sealscope.emit.c_export import most_parts, parts_a_sample, templates
from sealscope.emit.program import Program
from sealscope.emit.specialise import specialise
from sealscope.emit.stream_program import StreamProgram, result_rows
from sealscope.emit.structured_text import StText, format_initial

#: A reading beyond `MAX_READING` of the kernels, which counts as missing, as a product that each compiler reads.
_MISSING = "LREAL#1.0E37 * LREAL#1.0E37 * LREAL#1.0E37"


class Piece(NamedTuple):
    """A part of an export: name of a data type, function or function block, and its text."""

    name: str
    text: str

    @property
    def kind(self) -> str:
        """Kind of the part: "dataType", "function" or "functionBlock"."""
        words = {"TYPE": "dataType", "FUNCTION": "function", "FUNCTION_BLOCK": "functionBlock"}
        first = re.search(r"^(TYPE|FUNCTION_BLOCK|FUNCTION)\b", self.text, flags=re.MULTILINE)
        assert first is not None
        return words[first[1]]

    @property
    def fields(self) -> list[tuple[str, str, str]]:
        """Name, type and initial value of the fields of a data type."""
        return _declarations(self.text)

    @property
    def sections(self) -> list[tuple[str, list[tuple[str, str, str]]]]:
        """Sections of variables: XML's tag with its attributes; name, type and initial value of each variable."""
        found = re.findall(r"^(VAR\w*)( CONSTANT| RETAIN)?\n(.*?)^END_VAR$", self.text, flags=re.MULTILINE | re.DOTALL)
        attributes = {" CONSTANT": ' constant="true"', " RETAIN": ' retain="true"', "": ""}
        return [(_SECTIONS[word] + attributes[more], _declarations(lines)) for word, more, lines in found]

    @property
    def body(self) -> str:
        """Statements of a function or function block."""
        return re.split(r"^END_FUNCTION", self.text.rpartition("END_VAR\n")[2], flags=re.MULTILINE)[0]


#: XML's tag for each section of variables.
_SECTIONS = {"VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars", "VAR_IN_OUT": "inOutVars", "VAR": "localVars"}
_DECLARATION = re.compile(r"^ +(\w+) : ([^;:]+?)(?: := ([^;]*))?;", flags=re.MULTILINE)


def _declarations(text: str) -> list[tuple[str, str, str]]:
    """List name, type and initial value of declared variables."""
    return [(match[1], match[2], match[3] or "") for match in _DECLARATION.finditer(text)]


def _xml_type(kind: str) -> str:
    """Write a type as PLCopen's XML."""
    array = re.fullmatch(r"ARRAY \[(\d+)\.\.(\d+)\] OF (\w+)", kind)
    if array:
        inner = _xml_type(array[3])
        return f'<array><dimension lower="{array[1]}" upper="{array[2]}"/><baseType>{inner}</baseType></array>'
    return f"<{kind}/>" if kind in ("LREAL", "REAL", "DINT", "BOOL") else f'<derived name="{kind}"/>'


def _xml_initial(text: str) -> str:
    """Write an initial value, a number or an array of numbers, as PLCopen's XML."""
    if not text:
        return ""
    if not text.startswith("["):
        return f'<initialValue><simpleValue value="{text}"/></initialValue>'
    values = (f'<value><simpleValue value="{value.strip()}"/></value>' for value in text[1:-1].split(","))
    return f"<initialValue><arrayValue>{''.join(values)}</arrayValue></initialValue>"


def auxiliary_programs() -> Mapping[str, Program]:
    """Specialise the kernels of the function blocks beside the estimator, by the name of the block."""
    real, truth = "real", "truth"
    hold = {"m": "state", "x": real, "rate": real, "area": real, "most_creep": real}
    alarm = {"m": "state", "leak": real, "valid": truth, "acknowledge": truth, "warning": real, "alarm": real}
    recorded = {"m": "state", "p_A": real, "p_B": real, "flow": real, "x": real, "trigger": truth, "release": truth}
    return {
        "HOLD": specialise(
            function_blocks.HOLD_LAYOUT,
            {
                "start": (function_blocks.start_hold, {"m": "state"}),
                "add": (function_blocks.add_hold_sample, hold),
            },
        ),
        "ALARM": specialise(
            function_blocks.ALARM_LAYOUT,
            {
                "start": (function_blocks.start_alarm, {"m": "state"}),
                "add": (function_blocks.add_alarm_sample, {**alarm, "hysteresis": real, "delay": "whole"}),
            },
        ),
        "RECORDER": specialise(
            function_blocks.RECORDER_LAYOUT,
            {
                "start": (function_blocks.start_recorder, {"m": "state"}),
                "add": (function_blocks.add_recorded_sample, recorded),
            },
        ),
    }


def pieces(unit: StreamProgram, prefix: str, learned: Sequence[float] = ()) -> Iterator[Piece]:
    """Yield the parts of an export, each after those that it needs."""
    upper = prefix.upper()
    text = StText(unit.program, upper)
    yield Piece(text.state_type, text.render_state())
    for name, block in text.render_blocks():
        yield Piece(name, block)
    values: dict[str, Any] = {
        "unit": unit,
        "prefix": upper,
        "text": text,
        "missing": _MISSING,
        "results": result_rows(),
        "learned": [format_initial(number) for number in learned[1:-1]],
        "parts_a_sample": parts_a_sample(unit.settings),
        "most_parts": most_parts(),
        "n_recorded": function_blocks.N_RECORDED,
    }
    for name in (*(["LEARNED"] if learned else []), "MONITOR"):
        yield Piece(f"{upper}_{name}", templates().get_template(f"{name.lower()}.st.j2").render(values))
    for name, program in auxiliary_programs().items():
        part = StText(program, f"{upper}_{name}")
        yield Piece(part.state_type, part.render_state())
        for block, block_text in part.render_blocks():
            yield Piece(block, block_text)
        rendered = templates().get_template(f"{name.lower()}.st.j2").render({**values, "text": part})
        yield Piece({"HOLD": "FB_HoldTest", "ALARM": "FB_LeakAlarm", "RECORDER": "FB_Recorder"}[name], rendered)


def render_st(
    unit: StreamProgram,
    *,
    prefix: str,
    title: str,
    origin: str,
    alarm_rate: float,
    learned: Sequence[float] = (),
) -> dict[str, str]:
    """Render the Structured Text of a stream as files by name; the arguments are those of `c_export.render_c`."""
    parts = list(pieces(unit, prefix, learned))
    functions = [part.name for part in parts if part.kind == "function"]
    head = f"(* {title}\n   Written by Sealscope {version('sealscope')} from {origin}, checksum {unit.checksum}. *)\n"
    values = {
        **{"unit": unit, "prefix": prefix.upper(), "title": title, "origin": origin, "version": version("sealscope")},
        **{"results": result_rows(), "parts": parts, "alarm_rate": alarm_rate, "learned": bool(learned)},
        **{"parts_a_sample": parts_a_sample(unit.settings), "most_parts": most_parts()},
        **{"flow": unit.settings.channels[2], "xml_type": _xml_type, "xml_initial": _xml_initial},
    }
    return {
        f"{prefix}.st": "\n".join([head, *(part.text for part in parts)]),
        f"{prefix}.scl": "\n".join([head, *(_as_scl(part, functions) for part in parts)]),
        f"{prefix}.xml": templates().get_template("plcopen.xml.j2").render(values),
        "README.md": templates().get_template("st_readme.md.j2").render(values),
    }


def _as_scl(part: Piece, functions: Sequence[str]) -> str:
    """Write a part as a source of TIA Portal: its own names in quotation marks, local ones behind a number sign.

    `functions`: names of the export's functions. A function's variables are temporary there, and constants are no
    arrays.
    """
    if part.kind == "dataType":
        return part.text.replace(f"TYPE {part.name} :", f'TYPE "{part.name}"')
    head = re.search(r"^(FUNCTION(?:_BLOCK)?) (\w+)(.*)\n", part.text, flags=re.MULTILINE)
    assert head is not None
    declarations = part.text[head.end() : part.text.rindex("END_VAR\n")] + "END_VAR\n"
    variables = "VAR_TEMP" if part.kind == "function" else "VAR"
    declarations = re.sub(r"^VAR( CONSTANT)?$", variables, declarations, flags=re.MULTILINE)
    declarations = re.sub(r": (\w+);", _quote_type, declarations)
    names = {name.lower() for _, found in part.sections for name, _, _ in found}
    names |= {part.name.lower()} if part.kind == "function" else set()
    heading = f'{part.text[: head.start()]}{head[1]} "{head[2]}"{head[3]}'
    attribute, body = "{ S7_Optimized_Access := 'TRUE' }", _mark_names(part.body, names, functions)
    return f"{heading}\n{attribute}\n{declarations}BEGIN\n{body}END_{head[1]}\n"


#: A comment, a bracket, or a name that is no field; then, before what a call's argument is assigned to, ":=".
_WORD = re.compile(r"\(\*.*?\*\)|[()]|(?<![\w.#])[A-Za-z]\w*(?P<assigned>\s*:=)?", flags=re.DOTALL)


def _mark_names(body: str, names: Container[str], functions: Sequence[str]) -> str:
    """Mark local names by a number sign, but not those of a call's arguments, and quote the export's functions."""
    depth = 0

    def mark(match: re.Match[str]) -> str:
        nonlocal depth
        word = match[0]
        depth += (word == "(") - (word == ")")
        if word[0] in "()":
            return word
        name = word.partition(":")[0].strip()
        if name in functions and name.lower() not in names:
            return word.replace(name, f'"{name}"', 1)
        is_argument = depth > 0 and match["assigned"]
        return f"#{word}" if name.lower() in names and not is_argument else word

    return _WORD.sub(mark, body)


def _quote_type(match: re.Match[str]) -> str:
    """Quote a data type or function block of the export in a declaration."""
    name = match[1]
    return f': "{name}";' if not re.fullmatch(r"L?REAL|D?INT|BOOL", name) else match[0]
