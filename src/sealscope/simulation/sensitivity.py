"""How the noise-free channels of a run answer to a small leak, and to a small change of a parameter.

Derivatives are differences of converged runs. A leak cannot be negative, so its derivative at no leak is a forward
difference at h and h/2, extrapolated to h = 0 (Richardson); a parameter's is a central difference. Either is taken at
two steps, and the step is halved until the two agree: what is returned is the slope, not a chord.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.signals.windows import rms
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.instruments import decimate, lagging
from sealscope.simulation.integrate import oversampling, trajectory
from sealscope.simulation.leaks import Leak
from sealscope.units import LITRE_PER_MINUTE

#: The first step of a leak's derivative: this mean flow [m^3/s] ...
FIRST_LEAK = 1e-4 * LITRE_PER_MINUTE
#: ... at this pressure difference [Pa], which friction alone makes in the thesis's rig.
REFERENCE_DP = 0.115e6
#: The first step of a parameter's derivative, as a share of its value.
FIRST_SHARE = 1e-3
#: Largest rms difference between the derivatives at h and h/2, as a share of the derivative's rms.
LINEARITY = 0.02
_MOST_HALVINGS = 8


def clean_channels(experiment: Experiment, leaks: Sequence[Leak] = ()) -> Array:
    """Return p_A and p_B (2, n) without noise, at the recording's samples, behind transducers and anti-alias filter.

    `leaks` take the place of the experiment's and have coefficients. Raises SimulationFailed as
    `sealscope.simulation.simulate.simulate_with_truth` does.
    """
    n = round(experiment.duration * experiment.rate)
    path = trajectory(experiment, tuple(leaks))
    factor, sensors = oversampling(experiment), experiment.rig.sensors
    behind = [lagging(path[name], getattr(sensors, name).lag, experiment.rate * factor) for name in CHAMBERS]
    return np.stack([decimate(values, factor, n) for values in behind])


def _settled(name: str, first: float, quotient: Callable[[float], Array]) -> tuple[Array, float]:
    """Return the quotient at h/2, and the step h, over which the answer is a straight line."""
    step, coarse = first, quotient(first)
    for _ in range(_MOST_HALVINGS):
        fine = quotient(step / 2.0)
        size = rms(fine.ravel())
        nonlinearity = rms((coarse - fine).ravel()) / size if size > 0.0 else 0.0
        if nonlinearity <= LINEARITY:
            return fine, step
        step, coarse = step / 2.0, fine
    raise SimulationFailed(
        f"the channels must answer in proportion to a small change of {name}, got {100 * nonlinearity:.2g} % apart "
        f"between steps of {step:.3g} and its half; the run may meet a stop or a limit of the drive"
    )


def leak_sensitivity(experiment: Experiment) -> Array:
    """Return d channel / d G at G = 0 of a laminar leak open over the whole run: (2, n) [Pa per m^3/(s Pa)].

    ``D(h) = (y(h) - y(0)) / h``; returned is ``2 D(h/2) - D(h)``, whose error is O(h^2). h begins at `FIRST_LEAK`
    over `REFERENCE_DP` and is halved until D(h) and D(h/2) are within `LINEARITY`. Leaks of the experiment are left
    out. Raises SimulationFailed where no step is small enough.
    """
    none = clean_channels(experiment)

    def quotient(h: float) -> Array:
        return np.asarray((clean_channels(experiment, (Leak("laminar", coefficient=h),)) - none) / h)

    fine, step = _settled("G", FIRST_LEAK / REFERENCE_DP, quotient)
    return np.asarray(2.0 * fine - quotient(step))


def parameter_sensitivity(experiment: Experiment, name: str) -> Array:
    """Return d channel / d ln(parameter), no leak: (2, n) [Pa]; central difference from `FIRST_SHARE` on.

    Raises InputError for a parameter that is a choice or zero (its logarithm has no derivative), SimulationFailed
    where no step is small enough.
    """
    value = experiment.rig[name]
    if isinstance(value, str) or not (math.isfinite(value) and value != 0.0):
        raise InputError(f"a sensitivity needs a parameter whose value is a number other than 0, got {name} = {value}")

    def at(share: float) -> Array:
        rig = experiment.rig.with_overrides({name: value * (1.0 + share)}, source="varied for a sensitivity")
        return clean_channels(replace(experiment, rig=rig))

    return _settled(name, FIRST_SHARE, lambda h: np.asarray((at(h) - at(-h)) / (2.0 * h)))[0]
