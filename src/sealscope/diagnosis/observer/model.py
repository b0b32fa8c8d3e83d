"""The observer's model of a machine: its numbers, their uncertainty, and how they drift.

All of it comes from the assumed rig and from this file, nothing from the recorded machine. Slow parameters stand beside
the states of the machine, so that drift of a healthy machine is not taken for a leak:

    G                 conductance of what passes the piston and the pump, in units of `G_UNIT`
    coulomb, viscous  factors on the Coulomb and the viscous friction
    stiffness         factor on K_oil/V
    gain              factor on the flow that the pump is asked for
    bias_force        force that a zero error of a pressure looks like [N]
    volume_slope      factor on A x/V, the change of the chambers' volumes with the position
    breakaway         factor on K_brk - 1

They are constant within a block; from block to block each walks as far as the physics allows (`WALKS`), except G,
which starts anew in every block: its estimates are those of the blocks, not of a filter's memory.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sealscope.physics.rig import RigNumbers, rig_numbers
from sealscope.recordings.recording import Array

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Unit of the conductance among the states [m^3/(s Pa)]: 0.0042 L/min under the 0.115 MPa that friction asks for.
G_UNIT = 6.1e-13

PARAMETERS = ("G", "coulomb", "viscous", "stiffness", "gain", "bias_force", "volume_slope", "breakaway")
#: Parameters at the start. The pump may leak a little.
_START = (0.5, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 1.0)
#: Their standard deviations: seals differ by 15 %, transducers of 3000 psi by 2 psi in zero
#: (20 N on the piston); the stiffness is searched for (`STIFFNESS`), this is its step.
_DEVIATIONS = (1.0, 0.15, 0.2, 0.03, 0.02, 15.0, 0.02, 0.15)
#: Their walks in a minute (standard deviations): friction 3 %, as oil and seals warm up by a kelvin or two; the
#: form of the Stribeck curve and the geometry hardly; stiffness 1 % (0.5 % a kelvin); a transducer's zero 0.2 psi.
WALKS = (0.0, 0.03, 0.03, 0.012, 3e-4, 1.5, 3e-3, 6e-3)
#: Deviation of G at the start of every block: leaks up to a few times `G_UNIT`, larger ones after a block or two.
G_PRIOR = 1.5
#: Stiffness over the rig's that is searched at the start. Air, hoses and lines that the rig does not name make it low.
STIFFNESS = (0.58, 1.32, 17)
#: Amplitude densities of the process noise: flow [m^3/s per root hertz], force on the piston and, near reversals,
#: where friction is least certain, more of it [N per root hertz].
FLOW_NOISE, FORCE_NOISE, REVERSAL_NOISE = 3e-10, 3e-3, 3e-2
#: Velocity [m/s] up to which a reversal reaches.
REVERSAL_SPEED = 0.01


def assume(rig: Rig) -> RigNumbers:
    """Return the numbers of the observer's model of a rig.

    Throttles, air and make-up valves are left out: free throttles are open ends of the line, and what they and the line
    volumes add to stiffness and damping goes into the slow parameters.
    """
    return rig_numbers(rig)._replace(aerated=(), open_circuit=())


def displacement(a: RigNumbers) -> float:
    """Return the pump's displacement per radian [m^3/rad]."""
    return a.q_b / (2.0 * math.pi)


def mean_area(a: RigNumbers) -> float:
    """Return the mean area of the piston [m^2]."""
    return 0.5 * (a.A_A + a.A_B)


def compliance(a: RigNumbers) -> float:
    """Return the oil taken up per pascal of pressure difference, V/(2 K_oil) [m^3/Pa]."""
    return a.V / (2.0 * a.K_oil)


def start_parameters(a: RigNumbers) -> tuple[Array, Array]:
    """Return the parameters (8,) at the start and their deviations (8,).

    `volume_slope` starts at 1 where the rig's volumes depend on the position, else at 0.
    """
    start, deviations = np.array(_START), np.array(_DEVIATIONS)
    start[PARAMETERS.index("volume_slope")] = 1.0 if a.position_dependent else 0.0
    return start, deviations


def walks(block_s: float) -> Array:
    """Return the variances (8,) that the parameters gain from one block of `block_s` [s] to the next."""
    return np.array(WALKS) ** 2 * block_s / 60.0
