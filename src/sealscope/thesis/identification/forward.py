"""What the simulated rig makes of the leak-free tests of Appendix C: the details' RMS without noise, and with it.

The trajectory carries no noise. White noise of standard deviation sigma is independent of it and has the RMS
`gain_j sigma` in d_j, so the RMS with noise needs no draw: ``sqrt(m_j + gain_j^2 sigma^2)`` with m_j the noise-free
mean square. For the product, with d_3 and d_4 of the noise uncorrelated (disjoint bands):
``sqrt(m_34 + s_4^2 m_3 + s_3^2 m_4 + s_3^2 s_4^2)``, s_j = gain_j sigma.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from sealscope.errors import InputError
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.conditions import APPENDIX_C, Condition, experiment_values

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.signals.details import Transform

QUANTITIES = ("d1", "d2", "d3", "d4", "d3d4")
#: One pound per square inch [Pa], the unit the sheet is taken to be in.
PSI = 6894.757293168361
#: Part of a run that is used [s]: after the start-up, two of the slowest command's cycles (2 pi seconds each).
SETTLING, USED = 7.2, 4.0 * np.pi
#: The same in a search, where every run is made some hundred times.
USED_IN_SEARCH = 2.0 * np.pi

Group = tuple[str, float]


def simulated(
    rig: Rig,
    condition: Condition,
    *,
    transform: Transform = "stationary",
    leak: str | None = None,
    x_0: float = 0.0,
    used: float = USED,
    values: Mapping[str, float | str] | None = None,
) -> Array:
    """Noise-free mean squares of d1..d4 [psi^2] and d3d4 [psi^4] of both chambers, (2, 5), in one condition.

    Sampled as the instruments do (the rig's rate, its anti-alias filter), over `used` seconds after the start-up;
    `leak` in words is sized by the rig itself; `values` are set after those of the condition. Raises what
    simulating raises.
    """
    from sealscope.signals.details import details
    from sealscope.simulation.experiment import Experiment
    from sealscope.simulation.instruments import decimate
    from sealscope.simulation.simulate import oversampling, sized_leaks, trajectory

    padded = used + SETTLING + 128.0 / rig.daq.sample_rate  # the deepest detail looks 120 samples ahead
    experiment = Experiment.of(
        rig=rig,
        command=condition.command,
        set={**experiment_values(condition), **(values or {})},
        leak=leak,
        duration=padded,
        x_0=x_0,
    )
    path = trajectory(experiment, sized_leaks(experiment))
    factor, rate = oversampling(experiment), experiment.rate
    kept = slice(round(SETTLING * rate), round((SETTLING + used) * rate))
    found = np.empty((len(CHAMBERS), len(QUANTITIES)))
    for row, chamber in enumerate(CHAMBERS):
        sampled = decimate(path[chamber], factor, round(padded * rate)) / PSI
        squares = np.square(details(sampled, transform=transform).values[:, kept])
        found[row, :4] = squares.mean(axis=1)
        found[row, 4] = np.mean(squares[2] * squares[3])
    return found


def noise_free(
    rig: Rig, wanted: Iterable[Group], *, transform: Transform = "stationary", used: float = USED
) -> dict[Group, Array]:
    """`simulated` without a leak for each operating condition (command, closed [%])."""
    return {
        group: simulated(rig, Condition(0, *group, 0.0, "extra-small"), transform=transform, used=used)
        for group in wanted
    }


def noise_gain(transform: Transform) -> Array:
    """RMS of d1..d4 for white noise of unit deviation, (4,)."""
    level = np.arange(1, 5)
    return np.asarray(2.0 ** (-level / 2.0)) if transform == "reconstructed" else np.ones(4)


def log_rms(mean_squares: Array, sigma: float, transform: Transform = "stationary") -> Array:
    """log RMS of d1..d4 and d3d4 with white noise of deviation `sigma` [psi], (..., 5), from the mean squares
    without."""
    s = np.square(noise_gain(transform) * sigma)
    m = mean_squares
    product = m[..., 4] + s[3] * m[..., 2] + s[2] * m[..., 3] + s[2] * s[3]
    return np.asarray(0.5 * np.log(np.concatenate([m[..., :4] + s, product[..., None]], axis=-1)))


def best_noise(mean_squares: Array, measured: Array, transform: Transform = "stationary") -> float:
    """The sigma [psi] of one chamber that fits the measured log RMS best, least squares over all tests and details.

    `mean_squares`, `measured`: (tests, 5).
    """
    from scipy.optimize import minimize_scalar

    def misfit(log_sigma: float) -> float:
        return float(np.sum(np.square(log_rms(mean_squares, np.exp(log_sigma), transform) - measured)))

    return float(np.exp(minimize_scalar(misfit, bounds=(np.log(0.05), np.log(20.0)), method="bounded").x))


def noise_of(rig: Rig, chamber: str) -> float:
    """Deviation of a sample [psi] that the rig's own noise, common noise and conversion make in a chamber's channel."""
    sensor, daq = getattr(rig.sensors, chamber), rig.daq
    step = daq.step / (daq.sensor_volts_hi - daq.sensor_volts_lo) * (sensor.range_hi - sensor.range_lo)
    return float(np.sqrt(sensor.noise**2 + rig.sensors.common_noise**2 + step**2 / 12.0)) / PSI


def own_noise(rig: Rig, chamber: str, sigma: float) -> float:
    """The channel's own noise [Pa] that makes `sigma` [psi] with the rig's common noise and conversion; else
    InputError."""
    others = noise_of(rig, chamber) ** 2 - (getattr(rig.sensors, chamber).noise / PSI) ** 2
    if sigma**2 <= others:
        raise InputError(f"noise must be > {np.sqrt(others):.3g} psi (common noise and conversion), got {sigma:.3g}")
    return float(np.sqrt(sigma**2 - others)) * PSI


def by_test(of_group: Mapping[Group, Array], conditions: tuple[Condition, ...] = APPENDIX_C) -> Array:
    """A group's values repeated for each of its tests, (tests, ...)."""
    return np.array([of_group[condition.group] for condition in conditions])
