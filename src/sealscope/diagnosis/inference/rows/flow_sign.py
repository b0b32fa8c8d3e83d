"""The sign of a recorded flow, from sums over the rows of a volume balance; compiled, for files and streams alike.

The flow l is that into chamber A in a row. Three symptoms of correct wiring are tested, and their log odds
(`sign_log_odds`) are added:

- Oil leaks from high to low pressure: the leak's coefficient is positive.
- The force of the pressures on the piston correlates with l, since friction dissipates energy. The mean force, weighted
  by abs(l), is subtracted first, since a constant load also correlates with a motion in one direction. The same test is
  made with p_A - p_B instead of the force, and the two log odds are averaged: a load disturbs p_A - p_B less than the
  force, throttling on the rod side disturbs it more.
- The position grows with l. A negative correlation does not count, since the position may be reversed.

No function allocates memory, as controllers run the same functions in C (`emit`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sealscope.compiled import kernel, law
from sealscope.diagnosis.estimate.linear import RIDGE
from sealscope.diagnosis.estimate.special import normal_probability
from sealscope.diagnosis.inference.rows.weak_form import OVERLAP
from sealscope.diagnosis.priors.inference import INFERENCE

_PRIORS = INFERENCE.sense
#: Probabilities that something else than the flow's sign causes each symptom: of the leak, the load and the motion.
OTHER_LEAK, OTHER_LOAD, OTHER_MOTION = float(_PRIORS.leak), float(_PRIORS.driving_load), float(_PRIORS.sides)
#: Standard errors by which flow and motion correlate where a piston moves.
MOTION_SCORE = float(_PRIORS.motion_score)
#: Numbers of the sums over rows of a motion, and of a load.
N_MOTION_SUMS, N_LOAD_SUMS = 2, 7
TINY = float(np.finfo(float).tiny)


@law
def add_motion(sums: Any, motion: float, flow: float) -> None:
    """Add a row to the sums of m l and (m l)^2 with the `motion` m and the `flow` l."""
    product = motion * flow
    sums[0] += product
    sums[1] += product * product


@law
def add_load(sums: Any, load: float, flow: float) -> None:
    """Add a row to the sums of l, |l|, l^2, p l, p |l|, p l^2 and (p l)^2 with the `load` p and the `flow` l."""
    magnitude, square, work = abs(flow), flow * flow, load * flow
    sums[0] += flow
    sums[1] += magnitude
    sums[2] += square
    sums[3] += work
    sums[4] += load * magnitude
    sums[5] += load * square
    sums[6] += work * work


@kernel
def add_rows(motion_sums: Any, load_sums: Any, motions: Any, loads: Any, flow: Any) -> None:
    """Add r rows to the sums of g motions (g, 2) and k loads (k, 7): `motions` (g, r), `loads` (k, r), `flow` (r,)."""
    for r in range(len(flow)):
        for g in range(len(motions)):
            add_motion(motion_sums[g], motions[g, r], flow[r])
        for k in range(len(loads)):
            add_load(load_sums[k], loads[k, r], flow[r])


@law
def z_score(total: float, square: float) -> float:
    """Compute the z score of a sum of products, each of the flow and another quantity in one row.

    `total`, `square`: sums of the products, and of their squares.
    """
    return total / max(math.sqrt(max(square, 0.0) * OVERLAP), TINY)  # rows overlap


@law
def work_score(sums: Any) -> float:
    """Compute the z score of the products (p - c) l of load and flow, with the mean load c weighted by the flow.

    `sums` (7,): those of `add_load`.
    """
    if not sums[1] > 0.0:
        return 0.0
    mean = sums[4] / sums[1]
    return z_score(sums[3] - mean * sums[0], sums[6] - 2.0 * mean * sums[5] + mean * mean * sums[2])


@law
def leak_score(energy: float, moment: float, square: float, whole_energy: float, freedom: float) -> float:
    """Compute the z score of the leak's coefficient by least squares: positive for oil from high to low pressure.

    `energy`, `moment` and `square` are the products of the leak's column with itself, with the left side, and of the
    left side with itself, all other columns eliminated; `whole_energy` is the first without that. `freedom`: degrees of
    freedom of the residual. The result is 0 if the rows do not determine the coefficient.
    """
    if not energy > RIDGE * whole_energy or not freedom > 0.0:
        return 0.0
    variance = OVERLAP * max(square - moment * (moment / energy), 0.0) / freedom
    return moment / max(math.sqrt(variance * energy), TINY)


@law
def sign_log_odds(z: float, other_cause: float) -> float:
    """Compute the log odds that a flow has the correct sign, from the z score `z` of one symptom of correct wiring.

    c = `other_cause` is the probability that something else causes the score; both signs are then equally probable.
    With the standard normal distribution Phi, log odds = log((Phi(z) + c/2) / (Phi(-z) + c/2)).
    """
    return math.log((normal_probability(z) + 0.5 * other_cause) / (normal_probability(-z) + 0.5 * other_cause))


@law
def sum_log_odds(leak_z: float, difference_sums: Any, force_sums: Any, motion_z: float) -> float:
    """Compute the log odds that a flow has the right sign, from all symptoms.

    `leak_z`, `motion_z`: z scores of the leak and the motion; `difference_sums`, `force_sums`: those of `add_load` for
    p_A - p_B and for the force.
    """
    load_odds = sign_log_odds(work_score(difference_sums), OTHER_LOAD) + sign_log_odds(
        work_score(force_sums), OTHER_LOAD
    )
    log_odds = sign_log_odds(leak_z, OTHER_LEAK) + 0.5 * load_odds
    if motion_z > 0.0:  # else either the position or the flow may be reversed
        log_odds += sign_log_odds(motion_z, OTHER_MOTION)
    return log_odds
