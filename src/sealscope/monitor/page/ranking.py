"""The fleet in the order in which a person should look at it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from sealscope.monitor.alarms import NEW_BIT


def ranked(summaries: Mapping[str, Mapping[str, Any]], alarms: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the actuators with their open alarm: by severity of their state, new alarms first, then by evidence.

    The alarm that healthy actuators raise least often comes first, so that all compete for one budget of false alarms;
    among equals the one whose leak is larger for sure (the lower end of its interval), then the larger leak, then the
    name. `alarms`: those that are not over.
    """
    by_actuator = {alarm["actuator"]: alarm for alarm in alarms}
    rows = [{"name": name, **summary, "alarm": by_actuator.get(name)} for name, summary in summaries.items()]
    return sorted(rows, key=_order)


def _order(row: Mapping[str, Any]) -> tuple[Any, ...]:
    low, chance = (row["leak_interval_lpm"] or (0.0,))[0], (row["alarm"] or {}).get("by_chance_per_1000_h")
    evidence = math.inf if chance is None else chance, -low, -(row["leak_lpm"] or 0.0)
    return -row["state"]["severity"], -(row["status_word"] & NEW_BIT), *evidence, row["name"]
