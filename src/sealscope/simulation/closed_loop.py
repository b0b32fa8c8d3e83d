"""A controller around the rig: it samples, and the voltage that it gives is held until its next output."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from sealscope.control.controller import Controller, Measured
from sealscope.errors import InputError, SimulationFailed
from sealscope.parameters import Rig
from sealscope.physics.fluid import P_ATM
from sealscope.physics.state import P_A, P_B, POSITION, THETA
from sealscope.recordings.recording import Array
from sealscope.simulation.courses import Position

#: Most outputs of the solver to a sample of the recording that a controller's rate may ask for.
_MOST_OUTPUTS = 64


def outputs_per_sample(rate: float, controller_rate: float, least: int) -> int:
    """Return the outputs per sample of a recording at `rate` [Hz], `least` or more, that a controller can sample.

    Raises InputError where no whole number does.
    """
    for outputs in range(least, _MOST_OUTPUTS + 1):
        apart = rate * outputs / controller_rate
        if apart >= 1.0 - 1e-9 and abs(apart - round(apart)) < 1e-9 * apart:
            return outputs
    raise InputError(
        f"rate of the controller must be a whole multiple or a whole fraction of the sampling rate, {rate:g} Hz, got "
        f"{controller_rate:g} Hz"
    )


class Feedback:
    """The voltage of a controller over a run, sample after sample.

    Position, angle and pressures are read as the rig's encoders and transducers do: whole counts, and the transducer's
    own noise, from `seed`. `apart`: outputs of the solver between two samples of the controller.
    """

    def __init__(
        self, rig: Rig, target: Position, controller: Controller, outputs: tuple[float, float], seed: int
    ) -> None:
        """Begin a run; `outputs`: duration [s] of it, and rate [Hz] of the solver's outputs."""
        duration, rate = outputs
        self._controller = controller
        self.apart = round(rate / controller.rate)
        samples = round(duration * rate) // self.apart + 1
        t = np.arange(samples + 1) / controller.rate
        # plain numbers: a run asks for them one by one, and from lists that takes a tenth of the time
        self._t = t.tolist()
        self._target = np.broadcast_to(target.at(t), t.shape).tolist()
        # the voltage of a sample acts from `delay` to `delay + 1` samples later
        ahead = target.at(t + controller.delay / controller.rate)
        self._speed = (np.diff(np.broadcast_to(ahead, t.shape)) * controller.rate).tolist()
        random = np.random.default_rng([seed, 2])
        sensors = rig.sensors
        self._noise = (random.standard_normal((samples, 2)) * (sensors.p_A.noise, sensors.p_B.noise)).tolist()
        self._counts = sensors.x.resolution, 2.0 * math.pi / sensors.theta.counts
        self._limit = rig.daq.u_max
        self._floor = rig.fluid.p_vap - P_ATM if rig.fluid.p_vap > 0 else -math.inf
        self._voltage: Callable[[Measured], float]
        self.restart()

    def restart(self) -> None:
        """Begin the run anew."""
        self._voltage = self._controller.start()
        self._volts = [0.0] * (len(self._t) + self._controller.delay)
        self._compensated: Array | None = None
        self._sampled = 0

    def sample(self, output: int, y: Array) -> None:
        """Let the controller see the state `y` at an output of the solver, unless it has."""
        k = output // self.apart
        if k < self._sampled:
            return
        (noise_A, noise_B), (x_count, angle_count) = self._noise[k], self._counts
        volts = float(
            self._voltage(
                Measured(
                    self._t[k],
                    self._target[k],
                    self._speed[k],
                    _counted(y.item(POSITION), x_count),
                    max(y.item(P_A), self._floor) + noise_A,
                    max(y.item(P_B), self._floor) + noise_B,
                    _counted(y.item(THETA), angle_count),
                )
            )
        )
        flow = getattr(self._voltage, "compensated", None)
        if flow is not None:
            if self._compensated is None:
                self._compensated = np.zeros(len(self._t))
            self._compensated[k] = flow
        if not math.isfinite(volts):
            raise SimulationFailed(f"the controller must give a finite voltage, got {volts} at t = {self._t[k]:.4g} s")
        self._volts[k + self._controller.delay] = min(max(volts, -self._limit), self._limit)
        self._sampled = k + 1

    def held(self, output: int) -> float:
        """Return the voltage [V] that acts from an output of the solver to the controller's next sample."""
        return self._volts[output // self.apart]

    def volts(self, outputs: int) -> Array:
        """Return the voltages [V], (n,), at the first outputs of the solver."""
        return np.asarray(self._volts)[np.arange(outputs) // self.apart]

    def compensated(self, outputs: int) -> Array | None:
        """Return the leakage flow [m^3/s] that is made good, at the first outputs; None where none is reported."""
        if self._compensated is None:
            return None
        return np.asarray(self._compensated[np.arange(outputs) // self.apart])


def _counted(value: float, count: float) -> float:
    return math.floor(value / count) * count if count > 0 else value
