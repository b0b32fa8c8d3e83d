"""Load, speed and oil temperature of a recording outside of the range of the healthy recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.comparison.recording_sums import RecordingSums
from sealscope.diagnosis.priors.inference import INFERENCE


class UnusualCondition(NamedTuple):
    """Operating condition of a recording that lies outside of the range `low` to `high` of the healthy recordings.

    `name`: "load" [Pa], "speed" (of the pump, as mean flow [m^3/s]) or "oil" (temperature [degC]), with its `value` in
    the recording; `log_excess`: magnitude of the log ratio of load or speed to the nearer end of the range. It is 0 for
    oil, whose effect has an uncertain slope in temperature (`oil`), which already covers it.
    """

    name: str
    value: float
    low: float
    high: float
    log_excess: float = 0.0


def find_unusual_conditions(judged: RecordingSums, baseline: Sequence[RecordingSums]) -> list[UnusualCondition]:
    """List the conditions (load, speed, oil temperature) of a recording outside of the range of healthy recordings.

    The load is the mean pressure difference, the speed the mean flow. They may exceed the range by the factor
    exp(`ratio`), and the temperature by `oil` [K] (`conditions` in `priors.toml`). Unknown temperatures are not
    compared, and loads (or speeds) are not compared if any of them is 0.
    """
    allowed = INFERENCE.conditions
    unusual: list[UnusualCondition] = []
    loads_and_speeds = (
        ("load", judged.pressure, [healthy.pressure for healthy in baseline]),
        ("speed", judged.flow, [healthy.flow for healthy in baseline]),
    )
    for name, value, healthy_values in loads_and_speeds:
        if not healthy_values or not min(value, *healthy_values) > 0.0:
            continue
        low, high = min(healthy_values), max(healthy_values)
        log_excess = float(max(np.log(value / high), np.log(low / value)))
        if log_excess > allowed.ratio:
            unusual.append(UnusualCondition(name, value, low, high, log_excess))
    oil_temperatures = [healthy.oil_degC for healthy in baseline if healthy.oil_degC is not None]
    if judged.oil_degC is not None and oil_temperatures:
        low, high = min(oil_temperatures), max(oil_temperatures)
        if max(judged.oil_degC - high, low - judged.oil_degC) > allowed.oil:
            unusual.append(UnusualCondition("oil", judged.oil_degC, low, high))
    return unusual
