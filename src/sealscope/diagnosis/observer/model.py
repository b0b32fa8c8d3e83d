"""What the observer assumes of a machine: the numbers of its model, how sure it is of them, and how they drift.

All of it comes from the rig that it is told and from this page, nothing from the machine that is recorded. The states
of the machine are joined by slow parameters, so that what drifts in a healthy machine need not pass for a leak:

    G                 conductance of what passes the piston and the pump, in units of `G_UNIT`
    coulomb, viscous  factors on the Coulomb and the viscous friction
    stiffness         factor on K_oil/V
    gain              factor on the flow that the pump is asked for
    bias_force        force that a zero error of a pressure looks like [N]
    volume_slope      factor on A x/V, the change of the chambers' volumes with the position
    breakaway         factor on K_brk - 1

Within a block they are constant; from block to block each walks as far as the physics allows (`WALKS`), but for G,
which starts anew in every block: its estimates are those of the blocks, not of a filter's memory.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Unit of the conductance among the states [m^3/(s Pa)]: 0.0042 L/min under the 0.115 MPa that friction asks for.
G_UNIT = 6.1e-13

PARAMETERS = ("G", "coulomb", "viscous", "stiffness", "gain", "bias_force", "volume_slope", "breakaway")
#: What the parameters are before anything is recorded. The pump may leak a little.
_START = (0.5, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0)
#: How far from it they may be (standard deviations): seals differ by 15 %, transducers of 3000 psi by 2 psi in zero
#: (20 N on the piston); the stiffness is searched for (`STIFFNESS`), so that this is its step.
_DEVIATIONS = (1.0, 0.15, 0.2, 0.03, 0.02, 15.0, 0.02, 0.15)
#: How far they walk in a minute (standard deviations): friction 3 %, as oil and seals warm up by a kelvin or two; the
#: form of the Stribeck curve and the geometry hardly; stiffness 1 % (0.5 % a kelvin); a transducer's zero 0.2 psi.
WALKS = (0.0, 0.03, 0.03, 0.012, 3e-4, 1.5, 3e-3, 6e-3)
#: Deviation of G at the start of every block: leaks up to a few times `G_UNIT`, larger ones after a block or two.
G_PRIOR = 1.5
#: Stiffness over the rig's that is searched at the start. Air, hoses and lines that the rig does not name make it low.
STIFFNESS = (0.58, 1.32, 17)
#: Amplitude densities of what no state explains: flow [m^3/s per root hertz], force on the piston and, near reversals,
#: where friction is least certain, more of it [N per root hertz].
FLOW_NOISE, FORCE_NOISE, REVERSAL_NOISE = 3e-10, 3e-3, 3e-2
#: Velocity [m/s] up to which a reversal reaches.
REVERSAL_SPEED = 0.01


class Assumed(NamedTuple):
    """The numbers of the observer's model, SI floats."""

    D: float  # displacement per radian [m^3/rad]
    A_A: float
    A_B: float
    M_eq: float
    V: float
    K_oil: float
    slope: float  # change of a chamber's volume with the position [m^2], 0 where volumes are fixed
    F_pr: float
    F_cfr: float
    K_brk: float
    C_c: float
    F_v: float
    v_th: float
    omega_per_volt: float
    k_p: float
    K_i: float
    V_max: float
    R_c: float
    L_c: float
    C_e: float
    C_m: float
    J_M: float
    B_M: float
    i_max: float

    @property
    def area(self) -> float:
        """Mean area of the piston [m^2]."""
        return 0.5 * (self.A_A + self.A_B)

    @property
    def compliance(self) -> float:
        """Oil taken up per pascal of pressure difference, V/(2 K_oil) [m^3/Pa]."""
        return self.V / (2.0 * self.K_oil)


def assume(rig: Rig) -> Assumed:
    """The observer's model of a rig. Throttles are left out: free, they are open ends of the line, and what they and
    the line volumes add to stiffness and damping goes into the slow parameters."""
    motor, cylinder, friction = rig.motor, rig.cylinder, rig.friction
    return Assumed(
        D=rig.pump.q_b / (2.0 * math.pi),
        A_A=cylinder.A_A,
        A_B=cylinder.A_B,
        M_eq=cylinder.M_eq,
        V=cylinder.V,
        K_oil=rig.fluid.K_oil,
        slope=0.5 * (cylinder.A_A + cylinder.A_B),
        F_pr=friction.F_pr,
        F_cfr=friction.F_cfr,
        K_brk=friction.K_brk,
        C_c=friction.C_c,
        F_v=friction.F_v,
        v_th=friction.v_th,
        omega_per_volt=motor.omega_per_volt,
        k_p=motor.k_p,
        K_i=motor.K_i,
        V_max=motor.V_max,
        R_c=motor.R_c,
        L_c=motor.L_c,
        C_e=motor.C_e,
        C_m=motor.C_m,
        J_M=motor.J_M,
        B_M=motor.B_M,
        i_max=motor.i_max,
    )


def start_parameters(rig: Rig) -> tuple[Array, Array]:
    """Parameters (8,) at the start and their deviations (8,); volumes that depend on the position where the rig says
    so."""
    start, deviations = np.array(_START), np.array(_DEVIATIONS)
    start[PARAMETERS.index("volume_slope")] = 1.0 if rig.cylinder.volumes == "position" else 0.0
    return start, deviations


def walks(block_s: float) -> Array:
    """Variances (8,) that the parameters gain from one block of `block_s` [s] to the next."""
    return np.array(WALKS) ** 2 * block_s / 60.0
