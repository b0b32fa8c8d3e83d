"""The duty of a machine in a recording: oil temperature, load, speed, share of the time in motion, duration.

Healthy recordings that cover the duty of later ones show what is usual under it. Called by the workbench, which shows
which duty no healthy recording has.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.balance import max_rest_rate
from sealscope.diagnosis.inference.equations.signals import Signals, find_rests
from sealscope.recordings.oil import oil_temperature
from sealscope.recordings.recording import Array, Recording
from sealscope.units import BAR


class MachineDuty(NamedTuple):
    """Figures of a recording's duty, None where they are not known.

    `oil_degC`: oil temperature; `load_bar`: mean of abs(p_A - p_B); `speed`: root mean square speed of the piston
    [mm/s] or, without a position, of the motor [rpm], by `speed_unit`; `moving`: fraction of the time in which it
    moves; `minutes`: duration.
    """

    oil_degC: float | None
    load_bar: float | None
    speed: float | None
    speed_unit: str
    moving: float | None
    minutes: float


def measure_duty(recording: Recording) -> MachineDuty:
    """Measure the duty of a machine in a recording."""
    load = speed = moving = None
    unit = "mm/s"
    with np.errstate(all="ignore"):
        if {"p_A", "p_B"} <= recording.channels.keys() and recording.units["p_A"] == recording.units["p_B"] == "Pa":
            load = _mean(np.abs(recording["p_A"] - recording["p_B"]))
            load = None if load is None else load / BAR
        increments: Array | None = None
        if "x" in recording and recording.units["x"] == "m":
            increments, scale = np.diff(recording["x"]), 1e3
            values: Array | None = Signals({"x": recording["x"]}, recording.rate).speed
        elif "omega" in recording and recording.units["omega"] == "rad/s":
            values, scale, unit = recording["omega"], 30.0 / np.pi, "rpm"
            increments = values[1:] / recording.rate
        else:
            values = None
        if values is not None and increments is not None and len(values) > 2:
            mean_square = _mean(values**2)
            speed = None if mean_square is None else scale * float(np.sqrt(mean_square))
            rests = find_rests(increments, recording.rate, max_rest_rate(increments, recording.rate))
            moving = float(1.0 - rests.mean())
    return MachineDuty(oil_temperature(recording), load, speed, unit, moving, recording.duration / 60.0)


def _mean(values: Array) -> float | None:
    """Compute the mean of the finite values, None if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else None
