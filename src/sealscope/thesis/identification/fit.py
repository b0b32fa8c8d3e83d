"""Fit what the thesis leaves unknown to the leak-free columns of its Appendix C, and predict the leak columns.

The free parameters and each chamber's noise minimise the squares of log(simulated/measured RMS) over all tests,
chambers and d1..d4, d3d4, at each sampling rate and transform tried. Nothing measured with a leak enters. The result
that ships is the rig `thesis-calibrated`; `docs/decisions/0006-calibration.md` tells method, figures and limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from sealscope.errors import SimulationFailed
from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.recording import Array
from sealscope.thesis.conditions import APPENDIX_C, Condition, groups
from sealscope.thesis.engine.items import Item
from sealscope.thesis.identification.forward import QUANTITIES, by_test, log_rms, noise_free, noise_of, own_noise
from sealscope.thesis.identification.search import (
    Budget,
    Free,
    Problem,
    Trial,
    root_mean_square,
    search,
    slopes,
    stepped,
)
from sealscope.thesis.sheet import Sheet

if TYPE_CHECKING:
    from sealscope.parameters import Rig
    from sealscope.signals.details import Transform

Progress = Callable[[str, float], None]


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
        rig = base.with_overrides(values, source=source)
        own = {f"sensors.{chamber}.noise": own_noise(rig, chamber, sigma) for chamber, sigma in self.best.noise.items()}
        return rig.with_overrides(own, source=source)


def leak_free(sheet: Sheet) -> Array:
    """The log RMS of the sheet's leak-free columns, (tests, 2, 5); nothing else of the sheet is read."""
    columns = [[sheet.rms[chamber][name][:, 0] for name in QUANTITIES] for chamber in CHAMBERS]
    return np.asarray(np.log(np.moveaxis(np.array(columns), -1, 0)))


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
        others, alone = problem.without(group), problem.only(group)
        moved = stepped(others, z, residual[~out], slope[~out])
        try:
            unseen = alone.squares(moved)
        except SimulationFailed:  # the step suits the others and is impossible here: it is refused
            moved, unseen = z, alone.squares(z)
        log_noise = others.residuals(others.squares(moved))[1]
        refits.append([*moved, *log_noise])
        left[out] = alone.residuals(unseen, log_noise)[0]
    n = len(parts)
    spread = np.array(refits) - np.mean(refits, axis=0)
    deviation = np.sqrt((n - 1) / n * np.sum(np.square(spread), axis=0))
    return np.asarray(student.ppf(0.975, n - 1) * deviation), root_mean_square(left)


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
    from sealscope.thesis.identification.choice import COMMON, FREE, RATES

    free = FREE if free is None else tuple(free)
    shared = dict(COMMON if common is None else common)
    rig = (load_rig(base) if isinstance(base, str) else base).with_overrides({"line.orifices": "present", **shared})
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

    The noise is the rig's own and drawn from nowhere (see `forward`).
    """
    from sealscope.thesis.identification.hypotheses import Hypothesis, outcome

    return outcome(rig, Hypothesis("the rig as it is", law=law), conditions).sheet


_MAKERS = "sealscope.thesis.identification.tables"
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
