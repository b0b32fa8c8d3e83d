"""Flatness-based control of the piston's position: the target determines every state of the machine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import entry, layout_of, record_at, record_of
from sealscope.control.controller import CompiledLaw, Measured, Started, measured_at
from sealscope.control.drive import DRIVE, Drive, ValveDrive, check_numbers, drive_of, drive_voltage
from sealscope.control.position import FOLLOWING, PositionPI, following_voltage

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Time [s] over which the load that the pressures carry is averaged.
_LOAD_LAG = 0.1
#: What the law remembers, and its numbers.
_MEMORY = layout_of(
    *("compensated", "v_max", "M", "F_C", "v_th", "F_v", "G", "C", "T", "averaged", "first", "v", "dp", "load"),
    drive=DRIVE,
    feedback=FOLLOWING,
)
_memory_at = record_at(_MEMORY)


@entry
def _flatness_law(memory: Any, sample: Any) -> Any:
    m, measured = _memory_at(memory), measured_at(sample)
    f, first = m.feedback, m.first > 0.0
    v = measured.target_speed if abs(measured.target_speed) <= m.v_max else 0.0
    a = 0.0 if first else (v - m.v) / m.T
    a = a if abs(a) * m.T < 0.1 * m.v_max else 0.0
    force = m.M * a + m.F_C * math.tanh(v / m.v_th) + m.F_v * v
    pushed = f.area_A * measured.p_A - f.area_B * measured.p_B
    m.load += (1.0 if first else m.averaged) * (pushed - force - m.load)
    area = f.area_A if m.load >= 0.0 else f.area_B
    dp = (force + m.load) / area
    rate = 0.0 if first else (dp - m.dp) / m.T
    flow = m.G * dp + m.C * rate
    m.v, m.dp, m.first = v, dp, 0.0
    u = following_voltage(f, measured) + drive_voltage(m.drive, flow, dp)
    return min(max(u, -f.u_max), f.u_max)


@dataclass(frozen=True)
class Flatness:
    """Feed-forward of the forces and flows that the target requires, and the feedback of a PI controller.

    The position is a flat output of the machine: with x = target, v and a its derivatives,
    F = M a + F_f(v) + F_load, dp = F/A, Q = A v + G dp + dp'/(1/C), u = the drive's inverse of (Q, dp).
    `feedback` gives the part A v and the correction; this adds the leakage of the pump `G` [m^3/(s Pa)], the compliance
    `C` = V/(2 K) [m^3/Pa], and the speed that the drive loses under the torque of dp. F_f(v) = (`F_C` + `F_v` |v|)
    sign(v), smooth within `v_th` [m/s]; F_load is averaged from the pressures. All numbers are the controller's own
    assumptions: `M` [kg], `F_C` [N], `F_v` [N s/m].

    A jump of the target has no derivative: at a speed above `v_max` [m/s] nothing is fed forward.

    Source: J. Levine, Analysis and Control of Nonlinear Systems: A Flatness-based Approach, Springer 2009, chapter 6.
    """

    feedback: PositionPI
    drive: Drive | ValveDrive
    M: float
    F_C: float
    F_v: float
    v_th: float
    G: float
    C: float
    v_max: float

    def __post_init__(self) -> None:
        check_numbers("the controller", self, ("v_th", "v_max"), ("M", "F_C", "F_v", "G", "C"))

    @classmethod
    def from_rig(cls, rig: Rig) -> Self:
        """Build the controller from a rig's parameters."""
        cylinder, friction, drive = rig.cylinder, rig.friction, drive_of(rig)
        greatest = drive.largest(rig.daq.u_max) / min(cylinder.A_A, cylinder.A_B)
        by_valve = rig.valve.spool == "present"
        charge = 0.5 * (drive.p_s + 2.0 * rig.supply.p_return) if isinstance(drive, ValveDrive) else rig.fluid.p_charge
        return cls(
            PositionPI.from_rig(rig),
            drive,
            cylinder.M_eq,
            friction.F_pr + 2.0 * friction.F_cfr * charge,
            friction.F_v,
            friction.v_th,
            0.0 if by_valve else rig.pump.G_pump,
            cylinder.V / (2.0 * rig.fluid.K_oil),
            greatest,
        )

    @property
    def rate(self) -> float:
        """Samples of the controller a second [Hz]."""
        return self.feedback.rate

    @property
    def delay(self) -> int:
        """Whole samples from a measurement to its voltage."""
        return self.feedback.delay

    def start(self) -> Callable[[Measured], float]:
        """Start a run: return the function from a `Measured` to the voltage [V]."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Start a run: return the law in machine code."""
        T = 1.0 / self.rate
        memory = record_of(
            _MEMORY,
            self,
            compensated=math.nan,
            T=T,
            averaged=1.0 - math.exp(-T / _LOAD_LAG),
            first=1.0,
            drive=self.drive.numbers(self.rate),
            feedback=self.feedback.memory(),
        )
        return CompiledLaw(_flatness_law.address, memory.view(np.float64))
