"""What drives the model of the rig through a record, and the model run under it for many sets of parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.pressure_model.laws import LONGEST_STEP, RUNS, STATES, Machine, pressure_differences
from sealscope.recordings.recording import Array

#: The slow part: a Gaussian of this width [s] takes the ringing (60 to 80 Hz) out.
SLOW_WIDTH = 0.008


@dataclass(frozen=True, eq=False)
class Duty:
    """What drives the model, as the solver takes it: `inputs` (m, 4) at every half step (`pressure_differences`),
    `every` steps of h [s] to a sample."""

    inputs: Array
    h: float
    every: int

    @property
    def u(self) -> Array:
        """The command (m,) [V]."""
        return self.inputs[:, 0]

    @property
    def slope(self) -> Array:
        """Its derivative (m,) [V/s]."""
        return self.inputs[:, 1]

    @property
    def travel(self) -> Array:
        """The piston's place (m,), A x / V."""
        return self.inputs[:, 2]

    def part(self, first: int, n: int) -> Duty:
        """What drives the model in n samples from `first` on."""
        return Duty(self.inputs[2 * self.every * first : 2 * self.every * (first + n) + 1], self.h, self.every)


def duty_of(u: Array, rate: float, pressures: Array | None = None) -> Duty:
    """A recorded command (n,) [V] between its samples, and its slope; what jumps from one sample to the next ramps.

    `pressures` (n,): p_A + p_B [Pa]; none: they stand still. The piston stands in the middle until `moving` says more.
    """
    every = int(np.ceil(1.0 / rate / LONGEST_STEP))
    n = u.size
    at = np.arange(2 * every * n + 1) / (2.0 * every)
    fine = np.interp(at, np.arange(n), u)
    h = 1.0 / rate / every
    lift = np.zeros(at.size) if pressures is None else np.interp(at, np.arange(n), smoothed(pressures, rate))
    return Duty(
        np.column_stack([fine, np.gradient(fine, 0.5 * h), np.zeros(at.size), lift - lift.mean()]),
        h,
        every,
    )


def moving(duty: Duty, theta: Array, machine: Machine) -> Duty:
    """The duty with the piston's place as a model with parameters `theta` (12,) has it.

    Its mean and trend are taken out: what moves mid-stroke is not known, and a piston that stays in its cylinder has
    no trend for long.
    """
    n = (len(duty.inputs) - 1) // (2 * duty.every)
    v = differences(duty, theta[None], machine, speeds=True)[0]
    place = np.cumsum(v) * duty.h * duty.every * machine.A / machine.V
    middle = np.arange(n) - 0.5 * (n - 1)
    place -= place.mean() + middle * (middle @ place) / (middle @ middle)
    inputs = duty.inputs.copy()
    inputs[:, 2] = np.interp(np.arange(len(inputs)) / (2.0 * duty.every), np.arange(n), place)
    return Duty(inputs, duty.h, duty.every)


def gaussian(width: float) -> Array:
    """A Gaussian of that width in samples, to three widths either way."""
    reach = int(3.0 * width)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    return np.asarray(taps / taps.sum())


def smoothed(values: Array, rate: float) -> Array:
    """The slow part of a signal (n,): the ringing taken out, its ends held."""
    taps = gaussian(SLOW_WIDTH * rate)
    return np.convolve(np.pad(values, taps.size // 2, mode="edge"), taps, "valid")


def differences(
    duty: Duty,
    thetas: Array,
    machine: Machine,
    segment: NDArray[np.int64] | None = None,
    start: Array | None = None,
    speeds: bool = False,
) -> Array:
    """dp [Pa], or v [m/s] if `speeds`, (runs, n) of parameter sets `thetas` (runs, 12), or (runs, segments, 12) with
    `segment` (n,) telling which holds at a sample; `start` (runs, 5) is the state at the first sample, at rest by
    default, and becomes the last."""
    sets = thetas[:, None, :] if thetas.ndim == 2 else thetas
    runs = len(sets)
    n = (len(duty.inputs) - 1) // (2 * duty.every)
    which = np.zeros(n, dtype=np.int64) if segment is None else segment
    found = np.empty((runs, n))
    for first in range(0, runs, RUNS):
        lanes = np.minimum(np.arange(first, first + RUNS), runs - 1)
        table = np.ascontiguousarray(np.moveaxis(sets[lanes], 0, -1))
        state = np.zeros((STATES, RUNS))
        if start is not None:
            state[:] = start[lanes].T
        out = np.empty((n, RUNS))
        pressure_differences(duty.inputs, duty.h, duty.every, table, which, machine, state, out, speeds)
        here = lanes[: min(RUNS, runs - first)]
        found[here] = out.T[: here.size]
        if start is not None:
            start[here] = state.T[: here.size]
    return found
