"""The files of a stream in C99: header, source, a program for samples on standard input, Makefile, README, vectors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from sealscope.diagnosis.inference.rows import MAX_ITERATIONS, SUPPORT
from sealscope.diagnosis.live.kernel.step import MAX_ONSETS
from sealscope.diagnosis.live.kernel.stream import ADDED_A_CALL, HALVINGS, REASONS, WEIGHED_A_CALL, StreamSettings
from sealscope.diagnosis.live.live_balance import BLOCK_SECONDS, LEARNED
from sealscope.emit.c99 import CText
from sealscope.emit.run_program import CompiledStream
from sealscope.emit.stream_program import StreamProgram, result_rows
from sealscope.recordings.channels import CHANNEL_UNITS, LONG_NAMES
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    import jinja2

#: Functions of a program that C calls under their own names; the others are static.
_PUBLIC = ("results", "acknowledge")
#: Functions that the source needs before their definition.
_DECLARED = ("start", "add_sample", "advance", "resume")
#: Share of a block's samples within which its work is done.
_MARGIN = 0.8


@cache
def templates() -> jinja2.Environment:
    """Return the jinja2 environment with the templates of this package."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("sealscope.emit"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )


def most_parts() -> int:
    """Compute the most parts of the work at the end of a block."""
    weighting = (MAX_ITERATIONS + 1) * (2 * SUPPORT + 2)
    using = SUPPORT + 4 * LEARNED + 3
    testing = math.ceil(MAX_ONSETS / WEIGHED_A_CALL) + math.ceil(MAX_ONSETS / ADDED_A_CALL) * (HALVINGS + 1)
    return weighting + using + testing + 3


def parts_a_sample(settings: StreamSettings) -> int:
    """Compute how many parts of the work a sample must do, so that a block's work ends before the next block."""
    n_stride, block_strides, _ = settings.counts
    return math.ceil(most_parts() / (_MARGIN * n_stride * block_strides))


def sample_headings(settings: StreamSettings) -> list[str]:
    """Return the headings of the columns of samples, as recordings are written."""
    return [f"{name} [{CHANNEL_UNITS[name]}]" for name in settings.channels]


def result_headings() -> list[str]:
    """Return the headings of the columns of results."""
    return [f"{name} [{unit}]" for name, unit, _ in result_rows()]


def render_c(
    unit: StreamProgram,
    *,
    prefix: str,
    title: str,
    origin: str,
    alarm_rate: float,
    learned: Sequence[float] = (),
) -> dict[str, str]:
    """Render the C files of a stream by name.

    `title`, `origin`: the machine, and its file, in words; `alarm_rate`: false alarms in 1000 h; `learned`: numbers
    that `CompiledStream.saved` returned after healthy recordings.
    """
    text = CText(unit.program, prefix, unit.precision)
    flow = unit.settings.channels[2]
    values: dict[str, Any] = {
        "unit": unit,
        "prefix": prefix,
        "title": title,
        "origin": origin,
        "version": version("sealscope"),
        "results": result_rows(),
        "state": text.declare_state(),
        "state_bytes": unit.state_bytes,
        "source": text.render_source(_PUBLIC),
        "declarations": [text.declare_function(unit.program.function(name)) for name in _DECLARED],
        "types": {"real": text.real_type, "whole": "int32_t"},
        "learned": [repr(float(number)) for number in learned],
        "flow_name": flow,
        "flow_unit": CHANNEL_UNITS[flow],
        "flow_meaning": f"{LONG_NAMES[flow]} {flow} [{CHANNEL_UNITS[flow]}]",
        "block_seconds": f"{BLOCK_SECONDS:g}",
        "first_seconds": f"{LEARNED * BLOCK_SECONDS:g}",
        "columns": sample_headings(unit.settings),
        "headings": result_headings(),
        "reasons": list(REASONS.values()),
        "most_parts": most_parts(),
        "parts_a_sample": parts_a_sample(unit.settings),
        "alarm_rate": alarm_rate,
    }
    names = {f"{prefix}.h": "leak.h.j2", f"{prefix}.c": "leak.c.j2", "main.c": "main.c.j2"}
    names |= {"Makefile": "Makefile.j2", "README.md": "README.md.j2"}
    return {name: templates().get_template(template).render(values) for name, template in names.items()}


def render_vectors(stream: CompiledStream, samples: Array) -> Mapping[str, str]:
    """Render samples (n, 4) and the results of each block, as files by name, with headings."""
    lines = (",".join("" if math.isnan(v) else repr(float(v)) for v in reading) for reading in samples)
    results = stream.feed(samples, parts_a_sample(stream.unit.settings))
    expected = (",".join(f"{value:.17g}" for value in row) for row in results)
    headings = ",".join(sample_headings(stream.unit.settings)), ",".join(result_headings())
    return {
        "vectors.csv": "\n".join([headings[0], *lines, ""]),
        "expected.csv": "\n".join([headings[1], *expected, ""]),
    }
