"""The instruments of runs side by side, as rows of numbers that `batch_signals` takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.simulation.batch.layout import Member

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.simulation.changes import Readings


def instrument_rows(members: Sequence[Member], first: int, last: int) -> Array:
    """Return (runs, 2, INSTRUMENT_ROWS) of p_A and p_B for samples first .. last, even between these."""
    from sealscope.simulation.batch.signals import HUM, HUM_PHASE, INSTRUMENT_ROWS
    from sealscope.simulation.changes import Readings

    rows = np.zeros((len(members), len(CHAMBERS), INSTRUMENT_ROWS))
    ends = np.array([first, last]) / members[0].experiment.rate
    steady: dict[int, Array] = {}  # by rig, of runs whose instruments do not drift
    for run, member in enumerate(members):
        one = member.experiment
        if one.drifts:
            rows[run] = _channels(one.rig, one.readings(), ends, last - first)
        else:
            if id(one.rig) not in steady:
                steady[id(one.rig)] = _channels(one.rig, Readings(), ends, last - first)
            rows[run] = steady[id(one.rig)]
        if rows[run, :, HUM].any():
            rows[run, :, HUM_PHASE] = np.random.default_rng([one.seed, 1]).random(len(CHAMBERS))
    return rows


def _channels(rig: Rig, readings: Readings, ends: Array, samples: int) -> Array:
    return np.array([_row(rig, name, readings, ends, samples) for name in CHAMBERS])


def _row(rig: Rig, name: str, readings: Readings, ends: Array, samples: int) -> Array:
    """Return (INSTRUMENT_ROWS,) of one pressure channel, even between the two times `ends` [s], `samples` apart.

    The hum's phase is the run's own and left 0.
    """
    from sealscope.simulation.batch import signals as rows

    sensor, daq = getattr(rig.sensors, name), rig.daq
    row = np.zeros(rows.INSTRUMENT_ROWS)

    def set_even(own: str, value: float, at: int, rise: int, plus: float = 0.0) -> None:
        found = np.broadcast_to(readings.value(own, value, ends), (2,))
        row[at] = found[0] + plus
        row[rise] = (found[1] - found[0]) / samples

    set_even(f"sensors.{name}.gain_error", sensor.gain_error, rows.GAIN, rows.GAIN_RISE, 1.0)
    set_even(f"sensors.{name}.offset", sensor.offset, rows.OFFSET, rows.OFFSET_RISE)
    set_even(f"sensors.{name}.noise", sensor.noise, rows.NOISE, rows.NOISE_RISE)
    set_even("sensors.common_noise", rig.sensors.common_noise, rows.COMMON, rows.COMMON_RISE)
    row[rows.WALK] = sensor.drift / np.sqrt(daq.sample_rate)
    row[rows.HUM], row[rows.HUM_TURNS] = sensor.hum, sensor.hum_frequency / daq.sample_rate
    row[rows.LEAST], row[rows.LARGEST] = sensor.range_lo, sensor.range_hi
    row[rows.VOLTS] = daq.sensor_volts_lo
    row[rows.PER_PASCAL] = (daq.sensor_volts_hi - daq.sensor_volts_lo) / (sensor.range_hi - sensor.range_lo)
    row[rows.COUNT], row[rows.TOP] = daq.step, 2.0 ** (daq.bits - 1)
    return row
