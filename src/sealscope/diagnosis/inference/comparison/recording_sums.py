"""Summary of one recording, for the comparison with other recordings of the same machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sealscope.diagnosis.inference.blocks import Blocks, ColumnRoles, sum_blocks
from sealscope.diagnosis.inference.comparison.excess import eliminate_unshared
from sealscope.recordings.recording import Array


class Resistance(NamedTuple):
    """Pressure difference p_A - p_B that resists the motion: friction sign(v) + drop v at the speed v.

    `friction`: half the difference between the directions of motion [Pa]; `drop`: viscous pressure drop per speed, in
    Pa per unit of the speed; `friction_error`, `drop_error`: standard errors of both; `top_speed`: 99 % quantile of the
    magnitude of the speed, in m/s where the position is recorded, else in the unit of the channel that replaces it.
    """

    friction: float
    friction_error: float
    drop: float
    drop_error: float
    top_speed: float


class RecordingSums(NamedTuple):
    """Summary of one recording, for the comparison with other recordings of the same machine.

    - `sums` (E, m, m): Gram matrix of the m columns of each of E equations, divided by the residual variance of a row,
      with the coefficients eliminated that recordings do not share (`eliminate_unshared`);
    - `flow`, `pressure`: mean magnitudes of the pump's flow [m^3/s] and of p_A - p_B [Pa];
    - `start_s`, `oil_degC`: date [s since 1970] and temperature of the oil, None if unknown;
    - `held` (6,): leaks while shut valves hold the load, in the order of `holds.leaks.HeldLeaks`, or None;
    - `held_pump` (2,): leakage of the pump [m^3/(s Pa)] just before such holds, with standard deviation, or None;
    - `resistance` (5,): what resists the motion (`Resistance`), or None.
    """

    sums: Array
    flow: float
    pressure: float
    start_s: float | None = None
    oil_degC: float | None = None
    held: Array | None = None
    held_pump: Array | None = None
    resistance: Array | None = None

    @classmethod
    def from_blocks(
        cls, blocks: Blocks, columns: Sequence[ColumnRoles], start_s: float | None = None, oil_degC: float | None = None
    ) -> RecordingSums:
        """Summarise a recording by the sum of its Gram matrices, its mean flow and its mean pressure difference.

        Columns that recordings do not share are eliminated. The flow is weighted by the numbers of rows, `Blocks.rows`.
        """
        flow = float(np.average(blocks.flow, weights=np.maximum(blocks.rows, 1e-9)))  # positive, so that a mean exists
        pressure = float(np.average(blocks.mean_pressure(), weights=blocks.pressure_weights))
        return cls(eliminate_unshared(sum_blocks(blocks, columns), columns), flow, pressure, start_s, oil_degC)

    @property
    def conductance_of_flow(self) -> float:
        """Conductance [m^3/(s Pa)] of a leak as large as the pump's mean flow; 0 if the mean pressure is 0."""
        return self.flow / self.pressure if self.pressure > 0.0 else 0.0
