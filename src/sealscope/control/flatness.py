"""Flatness-based position control: forces and flows are computed from the target and its derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import entry, make_record, record_dtype, record_view
from sealscope.control.controller import CompiledLaw, Measured, Started, measured_at
from sealscope.control.drive import DRIVE, Drive, ValveDrive, check_numbers, drive_of, drive_voltage
from sealscope.control.position import FOLLOWING, PositionPI, following_voltage
from sealscope.physics.friction import coulomb_friction

if TYPE_CHECKING:
    from sealscope.parameters import Rig

_LOAD_LAG = 0.1  # time constant [s] of the average of the load
#: Change of the target's speed within a sample, relative to `v_max`, from which on it is a jump and no acceleration.
_MAX_SPEED_CHANGE = 0.1
#: State and parameters of the control law; `v`, `dp`: values of the last sample; `load`: averaged load [N].
_MEMORY = record_dtype(
    *("compensated", "v_max", "M", "F_C", "v_th", "F_v", "G", "C", "T", "load_gain", "is_first", "v", "dp", "load"),
    drive=DRIVE,
    feedback=FOLLOWING,
)
_memory_at = record_view(_MEMORY)


@entry
def _flatness_law(memory: Any, sample: Any) -> Any:
    """Compute the voltage [V] of a sample: feedback plus feed-forward by the equations of `Flatness`, within +-u_max.

    The feed-forward is the voltage for the flow G dp + C d(dp)/dt against the pressure difference dp that the load and
    the target's speed v and acceleration a require. `memory`, `sample`: addresses of a record `_MEMORY`, which is
    updated, and of the numbers of a `Measured`.
    """
    m, measured = _memory_at(memory), measured_at(sample)
    feedback, is_first = m.feedback, m.is_first > 0.0
    v = measured.target_speed if abs(measured.target_speed) <= m.v_max else 0.0  # else a jump
    a = 0.0 if is_first else (v - m.v) / m.T
    a = a if abs(a) * m.T < _MAX_SPEED_CHANGE * m.v_max else 0.0  # a jump of the speed is no acceleration
    force = m.M * a + m.F_C * math.tanh(v / m.v_th) + m.F_v * v
    pressure_force = feedback.area_A * measured.p_A - feedback.area_B * measured.p_B
    m.load += (1.0 if is_first else m.load_gain) * (pressure_force - force - m.load)
    area = feedback.area_A if m.load >= 0.0 else feedback.area_B
    dp = (force + m.load) / area
    dp_rate = 0.0 if is_first else (dp - m.dp) / m.T
    flow = m.G * dp + m.C * dp_rate
    m.v, m.dp, m.is_first = v, dp, 0.0
    u = following_voltage(feedback, measured) + drive_voltage(m.drive, flow, dp)
    return min(max(u, -feedback.u_max), feedback.u_max)


@dataclass(frozen=True)
class Flatness:
    """A position controller that feeds forward the flow the target requires, and corrects errors by PI control.

    The position is a flat output of the machine: the target, its speed v and its acceleration a determine

    - the force on the piston, F = M a + F_f(v) + F_load;
    - the pressure difference dp = F/A, with A the piston area on the side that carries the load, and the flow Q = A v +
      G dp + C d(dp)/dt;
    - the voltage for this flow against dp, by the model `drive`.

    The PI controller `feedback` provides the voltage for A v and for the correction of the error. The feed-forward adds
    the pump's leakage G dp, the compression C d(dp)/dt of the oil, and the speed that the drive loses under dp.

    The friction is F_f(v) = F_C tanh(v/v_th) + F_v v. F_load is the force of the measured pressures minus (M a + F_f),
    averaged over time. A speed of the target above `v_max` is taken as a jump, to which only `feedback` responds. A
    change of the speed by a tenth of `v_max` or more within a sample is a jump, too, with a = 0.

    Source: J. Levine, Analysis and Control of Nonlinear Systems: A Flatness-based Approach, Springer 2009, chapter 6.
    """

    feedback: PositionPI
    drive: Drive | ValveDrive
    M: float  # [kg]
    F_C: float  # [N]
    F_v: float  # [N s/m]
    v_th: float  # [m/s]
    G: float  # [m^3/(s Pa)]
    C: float  # [m^3/Pa] V/(2 K): the volume V of a chamber takes half of a change of dp; K: bulk modulus of the oil
    v_max: float  # [m/s]

    def __post_init__(self) -> None:
        not_negative = ("M", "F_C", "F_v", "G", "C")
        check_numbers("the controller", self, positive=("v_th", "v_max"), not_negative=not_negative)

    @classmethod
    def from_rig(cls, rig: Rig) -> Self:
        """Build the controller from a rig's parameters, for its pump or servo valve."""
        cylinder, friction, drive = rig.cylinder, rig.friction, drive_of(rig)
        pressure, of_difference = drive.mean_pressure(rig), friction.coulomb_pressure == "difference"
        return cls(
            feedback=PositionPI.from_rig(rig),
            drive=drive,
            M=cylinder.M_eq,
            F_C=coulomb_friction(pressure, pressure, friction.F_pr, friction.F_cfr, of_difference),  # with p_A = p_B
            F_v=friction.F_v,
            v_th=friction.v_th,
            # behind a valve the pump's leakage does not connect the chambers
            G=rig.pump.G_pump if rig.circuit.pump_feeds_chambers else 0.0,
            C=cylinder.V / (2.0 * rig.fluid.K_oil),
            v_max=drive.flow_per_volt * rig.daq.u_max / min(cylinder.A_A, cylinder.A_B),
        )

    @property
    def rate(self) -> float:
        """Sampling rate of the controller [Hz]."""
        return self.feedback.rate

    @property
    def delay(self) -> int:
        """Number of samples from a measurement to the voltage computed from it."""
        return self.feedback.delay

    def start(self) -> Callable[[Measured], float]:
        """Start a run; return the function that computes the voltage [V] from each `Measured`."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Make the control law of a new run as machine code."""
        T = 1.0 / self.rate
        memory = make_record(
            _MEMORY,
            self,
            compensated=math.nan,  # this controller compensates no leakage
            T=T,
            load_gain=1.0 - math.exp(-T / _LOAD_LAG),
            is_first=1.0,
            drive=self.drive.coefficients(self.rate),
            feedback=self.feedback.make_memory(),
        )
        return CompiledLaw(_flatness_law.address, memory.view(np.float64))
