"""A controller of one's own: `sealscope simulate --controller own_controller.py:Proportional ...`.

The law is compiled, which a controller need not be; what it remembers between samples is an array of its own.
"""

from dataclasses import dataclass

import numba
import numpy as np


@numba.njit
def law(memory, measured, k_v, volts_per_speed):
    """Velocity of the target and k_v times the averaged error, as a voltage."""
    memory[0] += 0.5 * (measured.target - measured.x - memory[0])
    return volts_per_speed * (measured.target_speed + k_v * memory[0])


@dataclass(frozen=True)
class Proportional:
    volts_per_speed: float  # [V s/m], by the controller's own idea of the machine
    k_v: float = 8.0  # [1/s]
    rate: float = 500.0  # [Hz]
    delay: int = 1  # samples

    @classmethod
    def of(cls, rig):
        return cls(rig.cylinder.A_A / (rig.pump.q_b / (2 * np.pi)) / rig.motor.omega_per_volt)

    def start(self):
        memory = np.zeros(1)
        return lambda measured: law(memory, measured, self.k_v, self.volts_per_speed)
