"""A dashboard of Grafana for the metrics of `/metrics`, as the JSON that Grafana imports."""

from __future__ import annotations

from typing import Any

_SOURCE = {"type": "prometheus", "uid": "${source}"}
#: Title, kind of panel, query, legend, unit, and how many columns of 24 by rows it takes.
_PANELS = (
    ("Leak beyond the healthy machine", "timeseries", "sealscope_leak_lpm{%s}", "{{actuator}}", "L/min", 16, 9),
    ("Severity of what is not good (NE 107)", "table", "sealscope_severity{%s} > 0", "{{actuator}}", "", 8, 9),
    ("Flow past pump and piston", "timeseries", "sealscope_total_lpm{%s}", "{{actuator}}", "L/min", 16, 8),
    ("Blocks a minute", "timeseries", "60 * rate(sealscope_blocks_total{%s}[5m])", "{{actuator}}", "", 8, 8),
    (
        *("Passed over, by reason", "timeseries"),
        *("rate(sealscope_passed_over_total{%s}[5m])", "{{actuator}}: {{reason}}", "", 12, 7),
    ),
    ("Messages dropped", "timeseries", "rate(sealscope_dropped_blocks_total[5m])", "{{reason}}", "", 12, 7),
    ("Database, broker, webhook: 1 reached", "timeseries", "sealscope_reached", "{{part}}", "", 12, 6),
    ("Blocks that wait to be stored", "timeseries", "sealscope_waiting_blocks", "", "", 12, 6),
)
_CHOSEN = 'actuator=~"$actuator"'


def dashboard() -> dict[str, Any]:
    """Return the dashboard; it asks for the Prometheus at its import, and for the actuators on top."""
    panels, x, y, row = [], 0, 0, 0
    for number, (title, kind, query, legend, unit, width, height) in enumerate(_PANELS, 1):
        if x + width > 24:
            x, y, row = 0, y + row, 0
        expression = query % _CHOSEN if "%s" in query else query
        panels.append(
            {
                "id": number,
                "title": title,
                "type": kind,
                "datasource": _SOURCE,
                "gridPos": {"x": x, "y": y, "w": width, "h": height},
                "targets": [{"refId": "A", "expr": expression, "legendFormat": legend, "instant": kind == "table"}],
                "fieldConfig": {"defaults": {"unit": f"suffix: {unit}" if unit else "short"}, "overrides": []},
            }
        )
        x, row = x + width, max(row, height)
    return {
        "title": "Sealscope: leakage of actuators",
        "uid": "sealscope",
        "schemaVersion": 39,
        "editable": True,
        "refresh": "10s",
        "time": {"from": "now-24h", "to": "now"},
        "templating": {
            "list": [
                {"name": "source", "type": "datasource", "query": "prometheus", "label": "Prometheus"},
                {
                    "name": "actuator",
                    "type": "query",
                    "datasource": _SOURCE,
                    "query": "label_values(sealscope_blocks_total, actuator)",
                    "multi": True,
                    "includeAll": True,
                    "refresh": 2,
                },
            ]
        },
        "panels": panels,
    }
