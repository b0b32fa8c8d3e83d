"""The actuators as metrics that Prometheus reads (text exposition format 0.0.4)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

#: Content type of the text.
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
#: Metric -> help, labels. A name that ends in `_total` is a counter.
_METRICS = {
    "sealscope_leak_lpm": ("Leak beyond the healthy machine [L/min]", ("actuator",)),
    "sealscope_total_lpm": ("Flow past pump and piston together [L/min]", ("actuator",)),
    "sealscope_oil_temperature_celsius": ("Oil temperature as recorded [deg C]", ("actuator",)),
    "sealscope_status_word": ("Bits: 1 warning, 2 error, 4 new", ("actuator",)),
    "sealscope_health": ("State of NE 107: 0 good, 1 failure, 2 check, 3 off spec, 4 maintenance", ("actuator",)),
    "sealscope_severity": ("Severity of the state, 0 to 1000", ("actuator",)),
    "sealscope_blocks_total": ("Blocks since the beginning", ("actuator",)),
    "sealscope_block_time_seconds": ("Clock at the end of the last block", ("actuator",)),
    "sealscope_watched": ("What an actuator is watched by: volumes, or pressures", ("actuator", "by")),
    "sealscope_passed_over_total": ("Samples, blocks or events by reason", ("actuator", "reason")),
    "sealscope_dropped_blocks_total": ("Messages dropped by reason", ("reason",)),
    "sealscope_reached": ("1 while a part of the monitor or what it needs is reached, 0 in an outage", ("part",)),
    "sealscope_outages_total": ("Outages since the start", ("part",)),
    "sealscope_outage_seconds_total": ("How long outages lasted since the start", ("part",)),
    "sealscope_waiting_blocks": ("Blocks that wait to be stored", ()),
    "sealscope_waiting_bytes": ("Bytes of the blocks that wait to be stored", ()),
    "sealscope_source_waits_total": ("How often a source had to wait because too many blocks waited", ()),
}
_Rows = Iterator[tuple[str, tuple[str, ...], float | None]]


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
    families: dict[str, Any] = {}
    for name, labels, value in _rows(summaries, counters, parts or {}, waiting):
        if value is None:
            continue
        if name not in families:
            kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
            families[name] = kind(name, _METRICS[name][0], labels=_METRICS[name][1])
        families[name].add_metric(labels, float(value))
    registry = CollectorRegistry(auto_describe=False)
    registry.register(type("Families", (), {"collect": lambda self: families.values()})())
    return generate_latest(registry).decode()


def _rows(
    summaries: Mapping[str, Mapping[str, Any]],
    counters: Mapping[str, int],
    parts: Mapping[str, tuple[bool, int, float]],
    waiting: tuple[int, int, int],
) -> _Rows:
    """Yield metric, values of its labels, and its own value, None where it is not known."""
    for name, summary in summaries.items():
        own, state = (name,), summary.get("state", {})
        yield "sealscope_leak_lpm", own, summary.get("leak_lpm")
        yield "sealscope_total_lpm", own, summary.get("total_lpm")
        yield "sealscope_oil_temperature_celsius", own, summary.get("oil_celsius")
        yield "sealscope_status_word", own, summary.get("status_word")
        yield "sealscope_health", own, state.get("health")
        yield "sealscope_severity", own, state.get("severity")
        yield "sealscope_blocks_total", own, summary.get("blocks")
        yield "sealscope_block_time_seconds", own, summary.get("t")
        if "by" in summary:
            yield "sealscope_watched", (name, summary["by"]), 1
        for reason, count in summary.get("counters", {}).items():
            yield "sealscope_passed_over_total", (name, reason), count
    for reason, count in counters.items():
        yield "sealscope_dropped_blocks_total", (reason,), count
    for part, (reached, outages, seconds) in parts.items():
        yield "sealscope_reached", (part,), reached
        yield "sealscope_outages_total", (part,), outages
        yield "sealscope_outage_seconds_total", (part,), seconds
    names = ("sealscope_waiting_blocks", "sealscope_waiting_bytes", "sealscope_source_waits_total")
    yield from ((name, (), value) for name, value in zip(names, waiting, strict=True))
