"""The metrics of a monitor for Prometheus (text exposition format 0.0.4)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from sealscope.monitor.bounded_queue import QueueLoad

#: Content type of the text.
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
#: By metric of an actuator: its help text, and its key in the summary. A name that ends in `_total` is a counter.
_ACTUATOR_METRICS = {
    "sealscope_leak_lpm": ("Leak beyond the healthy machine over the cycles seen [L/min]", "leak_lpm"),
    "sealscope_leak_low_lpm": ("Lower end of its 95 % interval [L/min]", "leak_low"),
    "sealscope_leak_high_lpm": ("Upper end of its 95 % interval [L/min]", "leak_high"),
    "sealscope_bound_lpm": ("95 % bound of a leak where a recording shows none [L/min]", "bound_lpm"),
    "sealscope_total_lpm": ("Flow past pump and piston together over the cycles seen [L/min]", "total_lpm"),
    "sealscope_oil_temperature_celsius": ("Oil temperature as recorded [deg C]", "oil_celsius"),
    "sealscope_status_word": ("Bits: 1 warning, 2 error, 4 new", "status_word"),
    "sealscope_health": ("State of NE 107: 0 good, 1 failure, 2 check, 3 off spec, 4 maintenance", "state.health"),
    "sealscope_severity": ("Severity of the state, 0 to 1000", "state.severity"),
    "sealscope_blocks_total": ("Blocks since the beginning", "blocks"),
    "sealscope_block_time_seconds": ("Clock at the end of the last block", "t"),
}
#: Help texts of the metrics of each part of the monitor, and of its queue.
_PART_METRICS = {
    "sealscope_reached": "1 while a part of the monitor or what it needs is reached, 0 in an outage",
    "sealscope_outages_total": "Outages since the start",
    "sealscope_outage_seconds_total": "How long outages lasted since the start",
}
_QUEUE_METRICS = {
    "sealscope_waiting_blocks": "Blocks that wait to be stored",
    "sealscope_waiting_bytes": "Bytes of the blocks that wait to be stored",
    "sealscope_source_waits_total": "How often a source had to wait because too many blocks waited",
}


def format_metrics(
    summaries: Mapping[str, Mapping[str, Any]],
    counters: Mapping[str, int],
    parts: Mapping[str, tuple[bool, int, float]] | None = None,
    queue_load: QueueLoad | None = None,
) -> str:
    """Format the metrics of all actuators and of the monitor in the text format of Prometheus.

    `summaries`: summary of each actuator; `counters`: numbers of dropped messages and blocks, by reason; `parts`:
    outages of each part (`Supervisor.outage_totals`); `queue_load`: load of the queue of blocks, None for an empty one.
    """
    families: dict[str, Any] = {}

    def add(name: str, text: str, value: float | None, **labels: str) -> None:  # `text`: help
        if value is not None:
            kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
            families.setdefault(name, kind(name, text, labels=[*labels])).add_metric([*labels.values()], float(value))

    for actuator, summary in summaries.items():
        # the entries of the inner mapping `state` get dotted names, by which `_ACTUATOR_METRICS` finds them
        values = {**summary, **{f"state.{name}": value for name, value in summary.get("state", {}).items()}}
        values["leak_low"], values["leak_high"] = summary.get("leak_interval_lpm") or (None, None)
        for name, (text, key) in _ACTUATOR_METRICS.items():
            add(name, text, values.get(key), actuator=actuator)
        if "by" in summary:
            text = "What an actuator is watched by: volumes, or pressures"
            add("sealscope_watched", text, 1, actuator=actuator, by=summary["by"])
        for reason, count in summary.get("counters", {}).items():
            text = "Samples, blocks or events by reason"
            add("sealscope_passed_over_total", text, count, actuator=actuator, reason=reason)
    for reason, count in counters.items():
        add("sealscope_dropped_blocks_total", "Messages dropped by reason", count, reason=reason)
    for part, part_values in (parts or {}).items():
        for (name, text), value in zip(_PART_METRICS.items(), part_values, strict=True):
            add(name, text, value, part=part)
    for (name, text), value in zip(_QUEUE_METRICS.items(), queue_load or QueueLoad(), strict=True):
        add(name, text, value)
    registry = CollectorRegistry(auto_describe=False)
    # the registry asks an object with a method `collect` for the metrics
    registry.register(type("Families", (), {"collect": lambda self: families.values()})())
    return generate_latest(registry).decode()
