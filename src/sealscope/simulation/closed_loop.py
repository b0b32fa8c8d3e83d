"""A controller in feedback with the rig: it samples measurements, and holds its voltage until its next sample."""

from __future__ import annotations

import math

import numpy as np

from sealscope.control.controller import Controller, Measured, reraise_python_error, start_law
from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import Rig
from sealscope.physics.solvers.loop import LAST_VOLTAGE, REPORTED, SAMPLED, Loop
from sealscope.recordings.recording import Array
from sealscope.simulation.targets_and_loads import Position
from sealscope.units import P_ATM

#: Most solver outputs per sample of the recording that a controller's rate may require.
_MAX_OUTPUTS_PER_SAMPLE = 64


def outputs_per_sample(rate: float, controller_rate: float, min_outputs: int) -> int:
    """Find the fewest solver outputs per recorded sample for which every sample of the controller is at an output.

    `rate`, `controller_rate` [Hz]: sampling rates of the recording and of the controller; `min_outputs`: lower limit of
    the result. Raises InputError if no number up to `_MAX_OUTPUTS_PER_SAMPLE` fits.
    """
    for outputs in range(min_outputs, _MAX_OUTPUTS_PER_SAMPLE + 1):
        spacing = rate * outputs / controller_rate  # outputs per controller sample: must be a whole number >= 1
        if spacing >= 1.0 - 1e-9 and abs(spacing - round(spacing)) < 1e-9 * spacing:
            return outputs
    raise InputError(
        f"rate of the controller must be the sampling rate, {rate:g} Hz, times n/m with whole numbers m and n <= "
        f"{_MAX_OUTPUTS_PER_SAMPLE}, got {controller_rate:g} Hz"
    )


class Feedback:
    """A controller in feedback with the rig over a run of `duration` [s], which the solver calls through its `loop`.

    The controller measures position and angle in whole counts of the rig's encoders, and pressures with each
    transducer's own noise. Other errors of the sensors, also those by faults and drifts, change the recording but not
    the control. `rate` [Hz]: rate of the solver's outputs; `seed`: seed of the noise.
    """

    def __init__(
        self, rig: Rig, target: Position, controller: Controller, *, duration: float, rate: float, seed: int
    ) -> None:
        self._controller = controller
        self._spacing = round(rate / controller.rate)  # solver outputs per sample of the controller
        samples = round(duration * rate) // self._spacing + 1
        t = np.arange(samples + 1) / controller.rate  # one more, which only ends the last sample's interval
        inputs = np.zeros((samples + 1, 5))  # time, target, its speed, noise of p_A and p_B (`Loop.inputs`)
        inputs[:, 0], inputs[:, 1] = t, target.value_at(t)
        # a sample's voltage acts from `delay` to `delay + 1` samples later: the target's mean speed in this interval
        target_ahead = target.value_at(t + controller.delay / controller.rate)
        inputs[:-1, 2] = np.diff(np.broadcast_to(target_ahead, t.shape)) * controller.rate
        random = np.random.default_rng([seed, 2])  # 2: a stream independent of the instruments' noise
        sensors = rig.sensors
        inputs[:-1, 3:] = random.standard_normal((samples, 2)) * (sensors.p_A.noise, sensors.p_B.noise)
        self._inputs = inputs
        min_pressure = rig.fluid.p_vap - P_ATM if rig.fluid.p_vap > 0 else -math.inf
        theta_count = 2.0 * math.pi / sensors.theta.counts  # [rad]
        # `Loop.numbers`; the last is the controller's last voltage, 0 at the start
        self._loop_numbers = sensors.x.resolution, theta_count, min_pressure, rig.daq.u_max, 0.0

    def restart(self) -> None:
        """Set the controller, its memory and its outputs (`loop`) to the start of the run."""
        controller, samples = self._controller, len(self._inputs)
        measured = np.empty(len(Measured._fields))
        self._law = start_law(controller)
        memory = self._law.memory
        self.loop = Loop(
            inputs=self._inputs,
            volts=np.zeros(samples + controller.delay),
            compensated=np.zeros(samples),
            measured=measured,
            memory=memory,
            addresses=np.array([self._law.address, memory.ctypes.data, measured.ctypes.data]),
            numbers=np.array(self._loop_numbers),
            counters=np.array([self._spacing, controller.delay, 0, 0]),  # no sample taken, no flow reported yet
        )

    def raise_failure(self) -> None:
        """Raise the error of a controller written in Python, or SimulationFailed if its voltage is not finite."""
        reraise_python_error(self._law)
        t = self._inputs[self.loop.counters[SAMPLED], 0]
        raise SimulationFailed(
            f"the controller must give a finite voltage, got {self.loop.numbers[LAST_VOLTAGE]} at t = {t:.4g} s"
        )

    def volts(self, outputs: int) -> Array:
        """Return the controller's voltage [V] at the first `outputs` outputs of the solver, (outputs,)."""
        return np.asarray(self.loop.volts[np.arange(outputs) // self._spacing])

    def compensated_flow(self, outputs: int) -> Array | None:
        """Return the compensated flow [m^3/s] at the first `outputs` solver outputs, or None if none was reported."""
        if not self.loop.counters[REPORTED]:
            return None
        return np.asarray(self.loop.compensated[np.arange(outputs) // self._spacing])
