"""A controller around the rig: it samples, and its voltage is held until its next output."""

from __future__ import annotations

import math

import numpy as np

from sealscope.control.controller import Controller, Measured, law_of, raise_within
from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import Rig
from sealscope.physics.solvers.loop import ASKED, REPORTED, TAKEN, Loop
from sealscope.recordings.recording import Array
from sealscope.simulation.courses import Position
from sealscope.units import P_ATM

#: Most outputs of the solver to a sample of the recording that a controller's rate may ask for.
_MOST_OUTPUTS = 64


def outputs_per_sample(rate: float, controller_rate: float, least: int) -> int:
    """Find the outputs per sample, `least` or more, at which a controller can sample a recording at `rate` [Hz].

    Raises InputError where no whole number does.
    """
    for outputs in range(least, _MOST_OUTPUTS + 1):
        spacing = rate * outputs / controller_rate
        if spacing >= 1.0 - 1e-9 and abs(spacing - round(spacing)) < 1e-9 * spacing:
            return outputs
    raise InputError(
        f"rate of the controller must be a whole multiple or a whole fraction of the sampling rate, {rate:g} Hz, got "
        f"{controller_rate:g} Hz"
    )


class Feedback:
    """The voltage of a controller over a run, sample by sample; the solver calls the controller through a `Loop`.

    Position, angle and pressures are read as the rig's encoders and transducers do: whole counts, and the transducer's
    own noise, from `seed`. A controller in machine code (`compiled`) is called as it is, one in Python through C.
    """

    def __init__(
        self, rig: Rig, target: Position, controller: Controller, outputs: tuple[float, float], seed: int
    ) -> None:
        """Begin a run; `outputs`: duration [s] of it, and rate [Hz] of the solver's outputs."""
        duration, rate = outputs
        self._controller = controller
        self._spacing = round(rate / controller.rate)
        samples = round(duration * rate) // self._spacing + 1
        t = np.arange(samples + 1) / controller.rate
        inputs = np.zeros((samples + 1, 5))
        inputs[:, 0], inputs[:, 1] = t, target.value_at(t)
        # the voltage of a sample acts from `delay` to `delay + 1` samples later
        ahead = target.value_at(t + controller.delay / controller.rate)
        inputs[:-1, 2] = np.diff(np.broadcast_to(ahead, t.shape)) * controller.rate
        random = np.random.default_rng([seed, 2])
        sensors = rig.sensors
        inputs[:-1, 3:] = random.standard_normal((samples, 2)) * (sensors.p_A.noise, sensors.p_B.noise)
        self._inputs = inputs
        floor = rig.fluid.p_vap - P_ATM if rig.fluid.p_vap > 0 else -math.inf
        self._numbers = sensors.x.resolution, 2.0 * math.pi / sensors.theta.counts, floor, rig.daq.u_max, 0.0
        self.loop: Loop
        self.restart()

    def restart(self) -> None:
        """Begin the run anew."""
        controller, samples = self._controller, len(self._inputs)
        measured = np.empty(len(Measured._fields))
        self._law = law_of(controller)
        memory = self._law.memory
        self.loop = Loop(
            self._inputs,
            np.zeros(samples + controller.delay),
            np.zeros(samples),
            measured,
            memory,
            np.array([self._law.address, memory.ctypes.data, measured.ctypes.data]),
            np.array(self._numbers),
            np.array([self._spacing, controller.delay, 0, 0]),
        )

    def refuse(self) -> None:
        """Raise the exception of a controller in Python, or else SimulationFailed for a voltage that is not finite."""
        raise_within(self._law)
        t = self._inputs[self.loop.whole[TAKEN], 0]
        raise SimulationFailed(
            f"the controller must give a finite voltage, got {self.loop.numbers[ASKED]} at t = {t:.4g} s"
        )

    def volts(self, outputs: int) -> Array:
        """Return the voltages [V], (n,), at the first outputs of the solver."""
        return np.asarray(self.loop.volts[np.arange(outputs) // self._spacing])

    def compensated(self, outputs: int) -> Array | None:
        """Return the compensated leakage flow [m^3/s] at the first outputs; None where none is reported."""
        if not self.loop.whole[REPORTED]:
            return None
        return np.asarray(self.loop.compensated[np.arange(outputs) // self._spacing])
