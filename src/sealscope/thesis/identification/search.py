"""The search behind the calibration: the misfit of a rig to leak-free log RMS, and how its least is found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.conditions import Condition, groups
from sealscope.thesis.identification.forward import (
    QUANTITIES,
    USED_IN_SEARCH,
    Group,
    best_noise,
    by_test,
    log_rms,
    noise_free,
)

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.signals.details import Transform

#: Squared misfit of settings that the rig cannot be simulated with.
_IMPOSSIBLE = 1e6


@dataclass(frozen=True)
class Free:
    """A parameter to fit: `names` take the same value; `start` and the bounds `lo` .. `hi` in SI."""

    names: tuple[str, ...]
    start: float
    lo: float
    hi: float


@dataclass(frozen=True)
class Budget:
    """How long to search: settings drawn over the whole box, then steps of the simplex, for each rate and transform."""

    drawn: int = 32
    steps: int = 110


@dataclass(frozen=True)
class Trial:
    """The best fit at one sampling rate and transform: settings by name [SI], noise [psi] by chamber, and the
    root-mean-square log residual."""

    rate: float
    transform: Transform
    settings: Mapping[str, float]
    noise: Mapping[str, float]
    misfit: float


class Problem:
    """The misfit as a function of the logarithms of the free parameters, at one rate and transform.

    `measured`: (tests, 2, 5) log RMS; `common`: settings all trials share.
    """

    def __init__(
        self,
        measured: Array,
        conditions: tuple[Condition, ...],
        free: Sequence[Free],
        base: Rig,
        rate: float,
        transform: Transform = "stationary",
    ) -> None:
        """Raises InputError where measured and conditions disagree in number."""
        if measured.shape != (len(conditions), len(CHAMBERS), len(QUANTITIES)):
            raise InputError(f"the sheet must have {len(conditions)} rows, got {measured.shape[0]}")
        self.measured, self.conditions, self.free = measured, conditions, tuple(free)
        self.rate, self.transform = rate, transform
        self.base = base.with_overrides({"daq.sample_rate": rate})
        self.bounds = [(float(np.log(one.lo)), float(np.log(one.hi))) for one in free]

    def settings(self, z: Array) -> dict[str, float]:
        """Parameters by name [SI] at the point `z`, (free,), of logarithms."""
        return {name: float(np.exp(value)) for one, value in zip(self.free, z, strict=True) for name in one.names}

    def squares(self, z: Array) -> Array:
        """Noise-free mean squares of each test at `z`, (tests, 2, 5)."""
        rig = self.base.with_overrides(self.settings(z))
        made = noise_free(rig, groups(self.conditions), transform=self.transform, used=USED_IN_SEARCH)
        return by_test(made, self.conditions)

    def residuals(self, squares: Array, log_noise: Array | None = None) -> tuple[Array, Array]:
        """log(simulated/measured), (tests, 2, 5), and log noise [psi] of each chamber, fitted where not given."""
        if log_noise is None:
            fitted = [best_noise(squares[:, k], self.measured[:, k], self.transform) for k in range(len(CHAMBERS))]
            log_noise = np.log(fitted)
        simulated = [log_rms(squares[:, k], float(np.exp(n)), self.transform) for k, n in enumerate(log_noise)]
        return np.stack(simulated, axis=1) - self.measured, log_noise

    def misfit(self, z: Array) -> float:
        """Root-mean-square log residual at `z`; large where the rig cannot be simulated."""
        if any(not low <= value <= high for value, (low, high) in zip(z, self.bounds, strict=True)):
            return _IMPOSSIBLE
        try:
            return root_mean_square(self.residuals(self.squares(z))[0])
        except (InputError, SimulationFailed):
            return _IMPOSSIBLE

    def without(self, group: Group) -> Problem:
        """The same problem with one operating condition left out."""
        return self._part(np.array([condition.group != group for condition in self.conditions]))

    def only(self, group: Group) -> Problem:
        """The same problem for one operating condition alone."""
        return self._part(np.array([condition.group == group for condition in self.conditions]))

    def _part(self, kept: Array) -> Problem:
        conditions = tuple(one for one, stays in zip(self.conditions, kept, strict=True) if stays)
        return Problem(self.measured[kept], conditions, self.free, self.base, self.rate, self.transform)

    def trial(self, z: Array) -> Trial:
        """The trial at `z`."""
        residual, log_noise = self.residuals(self.squares(z))
        noise = {chamber: float(np.exp(value)) for chamber, value in zip(CHAMBERS, log_noise, strict=True)}
        return Trial(self.rate, self.transform, self.settings(z), noise, root_mean_square(residual))


def root_mean_square(values: Array) -> float:
    """Root mean square of residuals; not finite where one of them is not (`signals.windows.rms` refuses those)."""
    return float(np.sqrt(np.mean(np.square(values))))


def search(problem: Problem, budget: Budget, seed: int = 0, progress: Callable[[float], None] | None = None) -> Array:
    """The point of least misfit, (free,): the start and Sobol points over the box, then a simplex from the best.

    Raises SimulationFailed where no point of the box could be simulated.
    """
    from scipy.optimize import minimize
    from scipy.stats import qmc

    low, high = np.array(problem.bounds).T
    start = np.log([one.start for one in problem.free])
    # the sequence is balanced for powers of two: draw one, keep its beginning
    sobol = qmc.Sobol(len(low), seed=seed).random_base2(max(1, budget.drawn).bit_length())[: budget.drawn]
    drawn = low + (high - low) * sobol
    points = [start, *drawn]
    done = 0

    def told(z: Array) -> float:
        nonlocal done
        done += 1
        if progress is not None:
            progress(min(1.0, done / (len(points) + budget.steps)))
        return problem.misfit(np.asarray(z))

    values = [told(point) for point in points]
    if min(values) >= _IMPOSSIBLE:
        raise SimulationFailed("no settings within the bounds can be simulated in every condition")
    best = points[int(np.argmin(values))]
    if budget.steps == 0:
        return np.asarray(best)
    inward = np.where(best < 0.5 * (low + high), 1.0, -1.0)
    simplex = np.vstack([best, best + np.diag(inward * np.minimum(0.15, 0.25 * (high - low)))])
    options: Any = {"maxfev": budget.steps, "xatol": 3e-3, "fatol": 1e-4, "initial_simplex": simplex, "adaptive": True}
    found = minimize(told, best, method="Nelder-Mead", options=options)
    return np.asarray(found.x)


def slopes(problem: Problem, z: Array, step: float = 0.06) -> tuple[Array, Array]:
    """Residuals at `z`, (tests, 2, 5), and their derivatives to the free parameters' and the noises' logarithms,
    (tests, 2, 5, free + 2), by central differences over +-`step`, one-sided where the rig fails on the other side."""
    here = problem.squares(z)
    residual, log_noise = problem.residuals(here)

    def nudged(k: int, by: float) -> tuple[Array, float]:
        try:
            return problem.residuals(problem.squares(z + by * np.eye(len(z))[k]), log_noise)[0], by
        except (InputError, SimulationFailed):
            return residual, 0.0

    columns = []
    for k in range(len(z)):
        (up, above), (down, below) = nudged(k, step), nudged(k, -step)
        columns.append((up - down) / max(above - below, 1e-9))
    for k in range(len(CHAMBERS)):
        nudge = 1e-3 * np.eye(len(CHAMBERS))[k]
        up, down = (problem.residuals(here, log_noise + sign * nudge)[0] for sign in (1.0, -1.0))
        columns.append((up - down) / 2e-3)
    return residual, np.stack(columns, axis=-1)


def stepped(problem: Problem, z: Array, residual: Array, slope: Array) -> Array:
    """`z` after one Gauss-Newton step for `problem`, halved until it fits better, else `z` itself.

    Directions that the data do not determine are held by a quarter of the box as their deviation.
    """
    low, high = np.array(problem.bounds).T
    hold = np.zeros((len(z), slope.shape[-1]))
    hold[:, : len(z)] = np.diag(root_mean_square(residual) * 4.0 / (high - low))
    A = np.vstack([slope.reshape(-1, slope.shape[-1]), hold])
    move = np.linalg.lstsq(A, np.concatenate([-residual.ravel(), np.zeros(len(z))]), rcond=None)[0][: len(z)]
    before = problem.misfit(z)
    for share in (1.0, 0.5, 0.25):
        moved = np.clip(z + share * move, low, high)
        if problem.misfit(moved) < before:
            return np.asarray(moved)
    return z
