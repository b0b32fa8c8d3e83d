"""Fit what the thesis leaves unknown to the leak-free columns of its Appendix C, and predict the leak columns.

The free parameters and each chamber's noise minimise the squares of log(simulated/measured RMS) over all tests,
chambers and d1..d4, d3d4, at each sampling rate and transform tried. Nothing measured with a leak enters. The result
that ships is the rig `thesis-calibrated`; `docs/decisions/0006-calibration.md` tells method, figures and limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sealscope.errors import InputError, SimulationFailed
from sealscope.recordings.recording import Array
from sealscope.thesis.calibration_forward import (
    CHAMBERS,
    QUANTITIES,
    USED_IN_SEARCH,
    Group,
    best_noise,
    by_test,
    log_rms,
    noise_free,
    noise_of,
    own_noise,
)
from sealscope.thesis.conditions import APPENDIX_C, Condition, groups
from sealscope.thesis.context import Sheet
from sealscope.thesis.items import Item

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.signals.details import Transform

Progress = Callable[[str, float], None]
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

    drawn: int = 24
    steps: int = 70


@dataclass(frozen=True)
class Trial:
    """The best fit at one sampling rate and transform: settings by name [SI], noise [psi] by chamber, and the
    root-mean-square log residual."""

    rate: float
    transform: Transform
    settings: Mapping[str, float]
    noise: Mapping[str, float]
    misfit: float


@dataclass(frozen=True)
class Calibration:
    """What a fit found.

    `best`: the trial kept; `trials`: all of them, best first; `intervals`: 95 % of each free parameter (by its first
    name, SI) and of the noise (`noise.p_A` [psi]), from leaving each operating condition out in turn; `held_out`: the
    root-mean-square log residual of conditions the settings had not seen.
    """

    best: Trial
    trials: tuple[Trial, ...]
    intervals: Mapping[str, tuple[float, float]]
    held_out: float
    common: Mapping[str, float | str] = field(default_factory=dict)

    def rig(self, base: Rig, source: str = "fitted to leak-free tests") -> Rig:
        """`base` with everything fitted put in: settings, sampling rate, and each channel's own noise."""
        values: dict[str, float | str] = {**self.common, **self.best.settings, "daq.sample_rate": self.best.rate}
        rig = base.with_values(values, source=source)
        own = {f"sensors.{chamber}.noise": own_noise(rig, chamber, sigma) for chamber, sigma in self.best.noise.items()}
        return rig.with_values(own, source=source)


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
        self.base = base.with_values({"daq.sample_rate": rate})
        self.bounds = [(float(np.log(one.lo)), float(np.log(one.hi))) for one in free]

    def settings(self, z: Array) -> dict[str, float]:
        """Parameters by name [SI] at the point `z`, (free,), of logarithms."""
        return {name: float(np.exp(value)) for one, value in zip(self.free, z, strict=True) for name in one.names}

    def squares(self, z: Array) -> Array:
        """Noise-free mean squares of each test at `z`, (tests, 2, 5)."""
        rig = self.base.with_values(self.settings(z))
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
            return _rms(self.residuals(self.squares(z))[0])
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
        return Trial(self.rate, self.transform, self.settings(z), noise, _rms(residual))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def leak_free(sheet: Sheet) -> Array:
    """The log RMS of the sheet's leak-free columns, (tests, 2, 5); nothing else of the sheet is read."""
    columns = [[sheet.rms[chamber][name][:, 0] for name in QUANTITIES] for chamber in CHAMBERS]
    return np.asarray(np.log(np.moveaxis(np.array(columns), -1, 0)))


def search(problem: Problem, budget: Budget, seed: int = 0, progress: Callable[[float], None] | None = None) -> Array:
    """The point of least misfit, (free,): the start and Sobol points over the box, then a simplex from the best.

    Raises SimulationFailed where no point of the box could be simulated.
    """
    from scipy.optimize import minimize
    from scipy.stats import qmc

    low, high = np.array(problem.bounds).T
    start = np.log([one.start for one in problem.free])
    drawn = low + (high - low) * qmc.Sobol(len(low), seed=seed).random(budget.drawn) if budget.drawn else low[None, :0]
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
    (tests, 2, 5, free + 2), by central differences over +-`step`."""
    here = problem.squares(z)
    residual, log_noise = problem.residuals(here)
    columns = []
    for k in range(len(z)):
        nudge = step * np.eye(len(z))[k]
        up, down = (problem.residuals(problem.squares(z + sign * nudge), log_noise)[0] for sign in (1.0, -1.0))
        columns.append((up - down) / (2.0 * step))
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
    hold[:, : len(z)] = np.diag(_rms(residual) * 4.0 / (high - low))
    A = np.vstack([slope.reshape(-1, slope.shape[-1]), hold])
    move = np.linalg.lstsq(A, np.concatenate([-residual.ravel(), np.zeros(len(z))]), rcond=None)[0][: len(z)]
    before = problem.misfit(z)
    for share in (1.0, 0.5, 0.25):
        moved = np.clip(z + share * move, low, high)
        if problem.misfit(moved) < before:
            return np.asarray(moved)
    return z


def leave_conditions_out(problem: Problem, z: Array) -> tuple[Array, float]:
    """Each operating condition left out in turn: 95 % half-widths of the logarithms of the free parameters and of the
    two noises, (free + 2,), and the root-mean-square log residual of the left-out conditions.

    Each refit is one step of `stepped`; the left-out condition is then simulated anew. Half-width: Student's t times
    the delete-one jackknife's deviation ``sqrt((n-1)/n sum (z_i - mean)^2)`` over n conditions (Efron and Stein, Annals
    of Statistics 9 (1981) 586).
    """
    from scipy.stats import t as student

    residual, slope = slopes(problem, z)
    parts = groups(problem.conditions)
    refits, left = [], np.empty_like(residual)
    for group in parts:
        out = np.array([condition.group == group for condition in problem.conditions])
        others = problem.without(group)
        moved = stepped(others, z, residual[~out], slope[~out])
        log_noise = others.residuals(others.squares(moved))[1]
        refits.append([*moved, *log_noise])
        left[out] = problem.only(group).residuals(problem.only(group).squares(moved), log_noise)[0]
    n = len(parts)
    spread = np.array(refits) - np.mean(refits, axis=0)
    deviation = np.sqrt((n - 1) / n * np.sum(np.square(spread), axis=0))
    return np.asarray(student.ppf(0.975, n - 1) * deviation), _rms(left)


def fit(
    sheet: Sheet,
    *,
    free: Sequence[Free] | None = None,
    rates: Sequence[float] | None = None,
    transforms: Sequence[Transform] = ("stationary",),
    base: Rig | str = "thesis",
    common: Mapping[str, float | str] | None = None,
    conditions: tuple[Condition, ...] = APPENDIX_C,
    budget: Budget | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Fit the free parameters to the sheet's leak-free columns.

    One search for each of `rates` [Hz] and `transforms`; `common` holds settings that differ from `base` but are not
    fitted. With the defaults and the thesis's sheet this makes the packaged rig `thesis-calibrated`.

    Raises InputError for a sheet of other tests than `conditions`, SimulationFailed where nothing can be simulated.
    """
    from sealscope.parameters import load_rig
    from sealscope.thesis.calibration_choice import COMMON, FREE, RATES

    free = FREE if free is None else tuple(free)
    shared = dict(COMMON if common is None else common)
    rig = (load_rig(base) if isinstance(base, str) else base).with_values({"line.orifices": "present", **shared})
    measured = leak_free(sheet)
    wanted = [(rate, transform) for transform in transforms for rate in (rates or RATES)]
    found: list[tuple[Trial, Problem, Array]] = []
    for k, (rate, transform) in enumerate(wanted):

        def told(share: float, k: int = k, rate: float = rate, transform: str = transform) -> None:
            if progress is not None:
                progress(f"fitting at {rate:g} Hz, {transform}", (k + share) / len(wanted))

        problem = Problem(measured, conditions, free, rig, rate, transform)
        z = search(problem, budget or Budget(), seed, told)
        z = stepped(problem, z, *slopes(problem, z))
        found.append((problem.trial(z), problem, z))
    found.sort(key=lambda one: one[0].misfit)
    best, problem, z = found[0]
    half, held_out = leave_conditions_out(problem, z)
    centre = np.concatenate([z, np.log([best.noise[chamber] for chamber in CHAMBERS])])
    names = [one.names[0] for one in free] + [f"noise.{chamber}" for chamber in CHAMBERS]
    intervals = {
        name: (float(np.exp(c - h)), float(np.exp(c + h))) for name, c, h in zip(names, centre, half, strict=True)
    }
    common_values: dict[str, float | str] = {"line.orifices": "present", **shared}
    return Calibration(best, tuple(one[0] for one in found), intervals, held_out, common_values)


def residuals(rig: Rig, sheet: Sheet, conditions: tuple[Condition, ...] = APPENDIX_C) -> Array:
    """log(simulated/measured) of the leak-free RMS of every test, (tests, 2, 5), chambers p_A, p_B and d1..d4, d3d4.

    The rig's own sampling rate and noise; the geometric-mean ratios are ``exp(mean over tests)``.
    """
    squares = by_test(noise_free(rig, groups(conditions)), conditions)
    made = [log_rms(squares[:, k], noise_of(rig, chamber)) for k, chamber in enumerate(CHAMBERS)]
    return np.stack(made, axis=1) - leak_free(sheet)


def predict_leaks(
    rig: Rig, conditions: tuple[Condition, ...] = APPENDIX_C, *, law: Literal["laminar", "orifice"] = "laminar"
) -> Sheet:
    """The sheet that the rig predicts: RMS [psi] of each test without and with its leak, which the rig sizes to the
    test's mean.

    The noise is the rig's own and drawn from nowhere (see `calibration_forward`).
    """
    from sealscope.thesis.calibration_hypotheses import Hypothesis, outcome

    return outcome(rig, Hypothesis("the rig as it is", law=law), conditions).sheet


_MAKERS = "calibration_items"
#: What the reproduction shows of the calibration.
ITEMS: tuple[Item, ...] = (
    Item("calibration", 5, "table", "What the thesis leaves unknown, fitted to Appendix C", f"{_MAKERS}:parameters"),
    Item(
        "calibration-fit",
        5,
        "table",
        "How the calibrated rig fits the leak-free columns of Appendix C",
        f"{_MAKERS}:fit_table",
        needs_sheet=True,
    ),
    Item(
        "calibration-hypotheses",
        5,
        "table",
        "What could explain the columns that the calibrated rig does not",
        f"{_MAKERS}:hypotheses",
        needs_sheet=True,
    ),
)
