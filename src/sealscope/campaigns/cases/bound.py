"""The Cramer-Rao bound: how small a leak the channels of a run can tell at all, whatever the detector.

For samples y_t = m_t(theta) + e_t with e_t white over time and normal with covariance R over the channels, the Fisher
information is ``F = sum_t J_t' R^-1 J_t``, J_t = d m_t / d theta, and no unbiased estimate of theta_k has a variance
below ``(F^-1)_kk`` (Rao, Bull. Calcutta Math. Soc. 37 (1945) 81-91; Kay, Fundamentals of Statistical Signal
Processing I, 1993, eq. 3.31). What is left out of R (drift, hum, a leak's own scatter) can only raise the true limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.evaluation.checks import share
from sealscope.parameters import Rig
from sealscope.recordings.chambers import CHAMBERS, PRESSURES
from sealscope.recordings.recording import Array
from sealscope.simulation.commands import recorded
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.integrate import trajectory
from sealscope.simulation.sensitivity import REFERENCE_DP, leak_sensitivity, parameter_sensitivity
from sealscope.units import LITRE_PER_MINUTE

#: Parameters that are not known of a pump-controlled machine: the friction law (level, viscous slope, breakaway, its
#: decay), the oil's stiffness and the gain of the speed loop.
UNKNOWN = (
    "friction.F_pr",
    "friction.F_v",
    "friction.K_brk",
    "friction.C_c",
    "fluid.K_oil",
    "motor.omega_per_volt",
)
#: Length [s] of the run whose bound stands for a record's: four periods of the slowest of the bench's commands.
BOUND_SECONDS = 25.2
#: Reciprocal condition of the scaled information below which a parameter cannot be told from the others.
_SINGULAR = 1e-12


def unknown_of(rig: Rig) -> tuple[str, ...]:
    """Return the parameters that are not known of a machine of this rig's kind.

    Behind a servo valve the rated flow of the edges stands for the speed loop's gain. Overlaps are taken as known: they
    do not change within a record.
    """
    return (*UNKNOWN[:-1], "valve.Q_N") if rig.valve.spool == "present" else UNKNOWN


def in_lpm(conductance: float, dp: float = REFERENCE_DP) -> float:
    """Return the mean flow [L/min] of a laminar leak G [m^3/(s Pa)] under a mean pressure difference `dp` [Pa]."""
    return conductance * dp / LITRE_PER_MINUTE


def noise_covariance(rig: Rig, channels: Sequence[str] = CHAMBERS) -> Array:
    """Return the covariance (c, c) [Pa^2] of one sample of the pressure channels.

    It is that of own and common white noise, and of the conversion's step as white noise of variance step^2/12.
    Raises InputError where a channel is not a pressure or has no noise at all, for then no bound exists.
    """
    sensors, daq = rig.sensors, rig.daq
    covariance = np.full((len(channels), len(channels)), sensors.common_noise**2)
    for k, name in enumerate(channels):
        if name not in PRESSURES:
            raise InputError(f"the bound is made from pressure channels (p_A, p_B, p_1, p_2), got {name}")
        sensor = getattr(sensors, name)
        step = daq.step * (sensor.range_hi - sensor.range_lo) / (daq.sensor_volts_hi - daq.sensor_volts_lo)
        covariance[k, k] += sensor.noise**2 + step**2 / 12.0
    return covariance


def information(slopes: Array, covariance: Array) -> Array:
    """Return the Fisher information (k, k) from derivatives `slopes` (k, c, n) and the covariance (c, c) of one sample.

    Raises InputError where the covariance is not positive definite.
    """
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise InputError("the covariance of the noise must be positive definite, got one that is not") from None
    white = np.linalg.solve(root, slopes).reshape(len(slopes), -1)
    return np.asarray(white @ white.T)


def cramer_rao(fisher: Array) -> Array:
    """Return the bound (k, k) on the covariance of unbiased estimates, F^-1.

    Raises InputError where F is singular: some parameter cannot be told from the others.
    """
    size = np.sqrt(np.diag(fisher))
    if np.all(size > 0.0):
        scaled = fisher / np.outer(size, size)
        if np.linalg.eigvalsh(scaled)[0] > _SINGULAR * len(scaled):
            return np.asarray(np.linalg.inv(scaled) / np.outer(size, size))
    raise InputError("the parameters must be told apart by the channels, got a singular information matrix")


def leak_bound(experiment: Experiment, unknown: Sequence[str] = (), covariance: Array | None = None) -> float:
    """Return the standard deviation of the best unbiased estimate of a small leak, as conductance G [m^3/(s Pa)].

    The leak is open over the whole experiment and is estimated from the chambers' pressures; `unknown`: parameters that
    the estimate must find beside it, command and all else are taken as known. `covariance` (c, c) of one sample,
    default that of the rig's sensors.

    Raises InputError for a parameter that cannot vary and where the leak cannot be told from the unknown ones,
    SimulationFailed where a derivative cannot be had.
    """
    R = noise_covariance(experiment.rig) if covariance is None else covariance
    sensitivities = [leak_sensitivity(experiment), *(parameter_sensitivity(experiment, name) for name in unknown)]
    fisher = information(np.stack(sensitivities), R)
    return math.sqrt(cramer_rao(fisher)[0, 0])


def change_bound(experiment: Experiment, before: float, after: float, dp: float) -> float | None:
    """Return the standard deviation [L/min] of the best unbiased estimate of a leak's onset at a known time.

    The leak's change from `before` [s] without to `after` [s] with it, under a mean pressure difference `dp` [Pa], from
    pressures and command of a machine whose parameters `unknown_of` are found from either part alone:
    ``s sqrt(T/before + T/after)``, s the bound over a run of T = `BOUND_SECONDS` without leak, fault or drift. None
    where that run has no bound. Drift, hum, skew, an unknown load and an unknown onset can only raise the true limit.

    Of a closed loop it is that of the voltages which the controller gave, put in again: the bound of whoever takes the
    command as an input. What it says of the position to one who knows target and controller is left out.
    """
    run = replace(
        experiment, leaks=(), faults=(), drifts=(), duration=min(BOUND_SECONDS, experiment.duration), step=None
    )
    try:
        bound = leak_bound(_opened(run), unknown_of(run.rig))
    except (InputError, SimulationFailed):
        return None
    return in_lpm(bound * math.sqrt(run.duration / before + run.duration / after), dp)


def _opened(run: Experiment) -> Experiment:
    """Return the run with the voltages that its controller gave as its command, the loop open."""
    if run.controlled is None:
        return run
    path = trajectory(run, ())
    assert path.volts is not None
    return replace(run, command=recorded(path.t, path.volts, str(run.command)), controller=None)


def smallest_detectable(deviation: float, false_alarm: float, detection: float = 0.9) -> float:
    """Return the leak that the best one-sided test finds with probability `detection`.

    The leak's estimate is normal with this standard deviation s: ``(z_{1-alpha} + z_detection) s``, in the unit of s.
    Raises InputError for probabilities outside 0..1 (Neyman and Pearson, doi 10.1098/rsta.1933.0009).
    """
    from scipy.special import ndtri

    share(false_alarm, "the false-alarm probability")
    share(detection, "the probability of detection")
    return float(ndtri(1.0 - false_alarm) + ndtri(detection)) * deviation
