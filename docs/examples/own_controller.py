"""A controller of one's own: `sealscope simulate --controller own_controller.py:Proportional ...`.

Its law is machine code, which a controller's need not be: `start` may as well return a function of `Measured`.
"""

from dataclasses import dataclass

import numba
import numpy as np

from sealscope.control import CompiledLaw, Started


@numba.cfunc("float64(CPointer(float64), CPointer(float64))")
def law(memory, measured):
    """Velocity of the target and k_v times the averaged error, as a voltage."""
    target, target_speed, x = measured[1], measured[2], measured[3]
    memory[3] += 0.5 * (target - x - memory[3])
    return memory[1] * (target_speed + memory[2] * memory[3])


@dataclass(frozen=True)
class Proportional:
    volts_per_speed: float  # [V s/m], by the controller's own idea of the machine
    k_v: float = 8.0  # [1/s]
    rate: float = 500.0  # [Hz]
    delay: int = 1  # samples

    @classmethod
    def from_rig(cls, rig):
        return cls(rig.cylinder.A_A / (rig.pump.q_b / (2 * np.pi)) / rig.motor.omega_per_volt)

    def compiled(self):
        return CompiledLaw(law.address, np.array([np.nan, self.volts_per_speed, self.k_v, 0.0]))

    def start(self):
        return Started(self.compiled())
