"""The actuators as metrics that Prometheus reads (text exposition format 0.0.4)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

#: Content type of the text.
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
#: Key of a summary -> name, kind and help of its metric.
_METRICS = (
    ("leak_lpm", "sealscope_leak_lpm", "gauge", "Leak beyond the healthy machine [L/min]"),
    ("total_lpm", "sealscope_total_lpm", "gauge", "Flow past pump and piston together [L/min]"),
    ("status_word", "sealscope_status_word", "gauge", "Bits: 1 warning, 2 error, 4 not acknowledged"),
    ("blocks", "sealscope_blocks_total", "counter", "Blocks since the beginning"),
    ("t", "sealscope_block_time_seconds", "gauge", "Clock at the end of the last block"),
)
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n"}


def metrics_text(summaries: Mapping[str, Mapping[str, Any]], counters: Mapping[str, int]) -> str:
    """Return the metrics of all actuators, and of blocks that the monitor dropped by reason."""
    lines: list[str] = []
    for key, name, kind, text in _METRICS:
        rows = [((("actuator", actuator),), summary.get(key)) for actuator, summary in summaries.items()]
        lines += _family(name, kind, text, rows)
    dropped = [
        ((("actuator", actuator), ("reason", reason)), count)
        for actuator, summary in summaries.items()
        for reason, count in summary.get("counters", {}).items()
    ]
    lines += _family("sealscope_passed_over_total", "counter", "Samples, blocks or events by reason", dropped)
    whole = [((("reason", reason),), count) for reason, count in counters.items()]
    lines += _family("sealscope_dropped_blocks_total", "counter", "Messages dropped by reason", whole)
    return "\n".join(lines) + "\n"


def _family(
    name: str, kind: str, text: str, rows: Iterable[tuple[tuple[tuple[str, str], ...], float | None]]
) -> list[str]:
    known = [(labels, value) for labels, value in rows if value is not None]
    if not known:
        return []
    lines = [f"# HELP {name} {text}", f"# TYPE {name} {kind}"]
    for labels, value in known:
        inner = ",".join(f'{label}="{_escaped(of)}"' for label, of in labels)
        lines.append(f"{name}{{{inner}}} {float(value)!r}")
    return lines


def _escaped(text: str) -> str:
    return re.sub(r'[\\"\n]', lambda match: _ESCAPES[match[0]], text)
