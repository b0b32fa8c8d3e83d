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
    ("oil_celsius", "sealscope_oil_temperature_celsius", "gauge", "Oil temperature as recorded [deg C]"),
    ("status_word", "sealscope_status_word", "gauge", "Bits: 1 warning, 2 error, 4 not acknowledged"),
    ("blocks", "sealscope_blocks_total", "counter", "Blocks since the beginning"),
    ("t", "sealscope_block_time_seconds", "gauge", "Clock at the end of the last block"),
)
#: Place in the values of a part -> name, kind and help of its metric.
_REACHED = (
    (0, "sealscope_reached", "gauge", "1 while a part of the monitor or what it needs is reached, 0 during an outage"),
    (1, "sealscope_outages_total", "counter", "Outages since the start"),
    (2, "sealscope_outage_seconds_total", "counter", "How long outages lasted since the start"),
)
_WAITING = (
    ("sealscope_waiting_blocks", "gauge", "Blocks that wait to be stored"),
    ("sealscope_waiting_bytes", "gauge", "Bytes of the blocks that wait to be stored"),
    ("sealscope_source_waits_total", "counter", "How often a source had to wait because too many blocks waited"),
)
_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n"}


def metrics_text(
    summaries: Mapping[str, Mapping[str, Any]],
    counters: Mapping[str, int],
    parts: Mapping[str, tuple[bool, int, float]] | None = None,
    waiting: tuple[int, int, int] = (0, 0, 0),
) -> str:
    """Return the metrics of all actuators, and of the monitor itself.

    `counters`: what it dropped, by reason; `parts`: of what it needs, such as its database, whether it is reached, how
    many outages it had, and how long they lasted [s]; `waiting`: blocks that are to be stored, their bytes, and how
    often a source had to wait for them.
    """
    lines: list[str] = []
    for key, name, kind, text in _METRICS:
        rows = [((("actuator", actuator),), summary.get(key)) for actuator, summary in summaries.items()]
        lines += _family(name, kind, text, rows)
    ways = [
        ((("actuator", actuator), ("by", summary["by"])), 1)
        for actuator, summary in summaries.items()
        if "by" in summary
    ]
    lines += _family("sealscope_watched", "gauge", "What an actuator is watched by: volumes, or pressures", ways)
    dropped = [
        ((("actuator", actuator), ("reason", reason)), count)
        for actuator, summary in summaries.items()
        for reason, count in summary.get("counters", {}).items()
    ]
    lines += _family("sealscope_passed_over_total", "counter", "Samples, blocks or events by reason", dropped)
    whole = [((("reason", reason),), count) for reason, count in counters.items()]
    lines += _family("sealscope_dropped_blocks_total", "counter", "Messages dropped by reason", whole)
    for place, name, kind, text in _REACHED:
        state = [((("part", part),), float(values[place])) for part, values in (parts or {}).items()]
        lines += _family(name, kind, text, state)
    for (name, kind, text), number in zip(_WAITING, waiting, strict=True):
        lines += _family(name, kind, text, [((), number)])
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
        lines.append(f"{name}{{{inner}}} {float(value)!r}" if inner else f"{name} {float(value)!r}")
    return lines


def _escaped(text: str) -> str:
    return re.sub(r'[\\"\n]', lambda match: _ESCAPES[match[0]], text)
