"""A dashboard of Grafana for the metrics of `/metrics`, as the JSON that it imports; the panels: `grafana.toml`."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any


def dashboard() -> dict[str, Any]:
    """Return the dashboard; it asks for the Prometheus at its import, and for the actuators on top."""
    tables: dict[str, Any] = tomllib.loads((files("sealscope.monitor.outputs") / "grafana.toml").read_text("utf-8"))
    panels, x, y, row = [], 0, 0, 0
    for number, (title, kind, query, legend, unit, width, height) in enumerate(tables["panels"], 1):
        if x + width > 24:
            x, y, row = 0, y + row, 0
        expression = query.replace("%s", 'actuator=~"$actuator"')
        panels.append(
            {
                "id": number,
                "title": title,
                "type": kind,
                "datasource": {"type": "prometheus", "uid": "${source}"},
                "gridPos": {"x": x, "y": y, "w": width, "h": height},
                "targets": [{"refId": "A", "expr": expression, "legendFormat": legend, "instant": kind == "table"}],
                "fieldConfig": {"defaults": {"unit": f"suffix: {unit}" if unit else "short"}, "overrides": []},
            }
        )
        x, row = x + width, max(row, height)
    return {**tables["dashboard"], "panels": panels}
