"""Flatness-based control of the piston's position: the target alone says what every state of the machine must be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sealscope.compiled import entry, pointer_at
from sealscope.control.controller import P_A, P_B, TARGET_SPEED, CompiledLaw, Measured, Started
from sealscope.control.drive import DRIVE_BLOCK, Drive, ValveDrive, check_numbers, drive_of, drive_voltage
from sealscope.control.position import PositionPI, followed

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Time [s] over which the load that the pressures carry is averaged.
_LOAD_LAG = 0.1
#: Places of the law's numbers in its block; the last are those of the drive's inverse and of the feedback.
_V_MAX, _MASS, _F_C, _V_TH, _F_V, _G, _C, _T, _AVERAGED, _FIRST, _V, _DP, _LOAD, _AREA_A, _AREA_B, _U_MAX = range(1, 17)
_DRIVE = 17
_FEEDBACK = _DRIVE + DRIVE_BLOCK


@entry
def _flatness_law(m: Any, measured: Any) -> Any:
    T, v_max, first = m[_T], m[_V_MAX], m[_FIRST] > 0.0
    v = measured[TARGET_SPEED] if abs(measured[TARGET_SPEED]) <= v_max else 0.0
    a = 0.0 if first else (v - m[_V]) / T
    a = a if abs(a) * T < 0.1 * v_max else 0.0
    force = m[_MASS] * a + m[_F_C] * math.tanh(v / m[_V_TH]) + m[_F_V] * v
    pushed = m[_AREA_A] * measured[P_A] - m[_AREA_B] * measured[P_B]
    m[_LOAD] += (1.0 if first else m[_AVERAGED]) * (pushed - force - m[_LOAD])
    area = m[_AREA_A] if m[_LOAD] >= 0.0 else m[_AREA_B]
    dp = (force + m[_LOAD]) / area
    rate = 0.0 if first else (dp - m[_DP]) / T
    flow = m[_G] * dp + m[_C] * rate
    m[_V], m[_DP], m[_FIRST] = v, dp, 0.0
    u = followed(pointer_at(m, _FEEDBACK), measured) + drive_voltage(pointer_at(m, _DRIVE), flow, dp)
    return min(max(u, -m[_U_MAX]), m[_U_MAX])


@dataclass(frozen=True)
class Flatness:
    """Feed-forward of all that the target asks of the machine, beside the feedback of a PI controller.

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
        rest = {"M": self.M, "F_C": self.F_C, "F_v": self.F_v, "G": self.G, "C": self.C}
        check_numbers("the controller", {"v_th": self.v_th, "v_max": self.v_max}, rest)

    @classmethod
    def of(cls, rig: Rig) -> Self:
        """Return the controller for what a rig is said to be."""
        cylinder, friction, drive = rig.cylinder, rig.friction, drive_of(rig)
        greatest = drive.largest(rig.daq.u_max) / min(cylinder.A_A, cylinder.A_B)
        by_valve = rig.valve.spool == "present"
        charge = 0.5 * (drive.p_s + 2.0 * rig.supply.p_return) if isinstance(drive, ValveDrive) else rig.fluid.p_charge
        return cls(
            PositionPI.of(rig),
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
        """Return a function from what is measured to the voltage [V], for one run from its beginning."""
        return Started(self.compiled())

    def compiled(self) -> CompiledLaw:
        """Return the law in machine code, for one run from its beginning."""
        T, f = 1.0 / self.rate, self.feedback
        own = (self.v_max, self.M, self.F_C, self.v_th, self.F_v, self.G, self.C, T, 1.0 - math.exp(-T / _LOAD_LAG))
        states, outer = (1.0, 0.0, 0.0, 0.0), (f.area_A, f.area_B, f.u_max)
        memory = np.array([math.nan, *own, *states, *outer, *self.drive.block(self.rate), *f.block()])
        return CompiledLaw(_flatness_law.address, memory)
