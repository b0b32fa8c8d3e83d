"""A Grafana dashboard for the metrics of `/metrics`; its panels are in `grafana.toml`."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import Any


def dashboard() -> dict[str, Any]:
    """Build the Grafana dashboard, on which the actuator can be chosen, as plain values for Grafana's JSON."""
    tables: dict[str, Any] = tomllib.loads((files("sealscope.monitor.outputs") / "grafana.toml").read_text("utf-8"))
    panels = []
    x = y = row_height = 0  # in columns and rows of Grafana's grid, which has 24 columns
    for number, (title, kind, query, legend, unit, width, height) in enumerate(tables["panels"], 1):
        if x + width > 24:  # the panel begins a new row
            x, y, row_height = 0, y + row_height, 0
        expression = query.replace("%s", 'actuator=~"$actuator"')  # the filter by the chosen actuator
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
        x, row_height = x + width, max(row_height, height)
    return {**tables["dashboard"], "panels": panels}
