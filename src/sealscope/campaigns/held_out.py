"""Classifiers judged on measured tests that they have not seen: each test held out whole, the others fitted to."""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.campaigns.held_out_plan import HeldOutPlan, Logistic
from sealscope.campaigns.work import Row
from sealscope.errors import InputError

Array = npt.NDArray[np.float64]
_MOST_STEPS = 100
_SMALL = 1e-15
_LEAST_SHARE = 1e-8


@dataclass(frozen=True)
class Samples:
    """Measured samples: `features` name -> (n,) values; `leak_lpm` (n,), 0 where nothing leaks; `tests` (n,) which test
    each belongs to; `levels`: of each, its operating condition."""

    features: Mapping[str, Array]
    leak_lpm: Array
    tests: Sequence[Hashable]
    levels: Sequence[Mapping[str, str | float]]

    def matrix(self, names: Sequence[str]) -> Array:
        """The named features, (n, f); raises InputError for one that the data do not have."""
        for name in names:
            if name not in self.features:
                raise InputError(f"a feature must be one of {', '.join(self.features)}, got {name!r}")
        return np.column_stack([self.features[name] for name in names])


@dataclass(frozen=True)
class LogisticFit:
    """``ln(P/(1 - P)) = intercept + sum weights (x - centre)/scale``."""

    intercept: float
    weights: Array
    centre: Array
    scale: Array

    def log_odds(self, x: Array) -> Array:
        """Log odds of a leak for samples (n, f)."""
        return np.asarray(self.intercept + ((x - self.centre) / self.scale) @ self.weights)


def fit_logistic(x: Array, leaks: npt.NDArray[np.bool_], ridge: float) -> LogisticFit:
    """Logistic regression by Newton's method, maximising ``sum ln P(y|x) - ridge/2 |weights|^2``.

    `x` (n, f), each feature standardised to mean 0 and standard deviation 1 of these samples; the intercept is not
    penalised. Raises InputError for a single class, a constant feature, or where no finite maximum is reached (no
    ridge and separable classes). Source: le Cessie and van Houwelingen, Appl. Stat. 41 (1992) 191-201, doi
    10.2307/2347628.
    """
    from scipy.special import expit

    if leaks.all() or not leaks.any():
        raise InputError(f"a classifier needs both classes, got {int(leaks.sum())} leaks of {leaks.size}")
    centre, scale = x.mean(axis=0), x.std(axis=0)
    if not np.all(scale > 0):
        raise InputError(f"a feature must vary, got a constant one (number {int(np.argmin(scale > 0)) + 1})")
    design = np.column_stack([np.ones(len(x)), (x - centre) / scale])
    penalty = np.concatenate([[0.0], np.full(x.shape[1], ridge)])
    beta = np.zeros(design.shape[1])

    def objective(at: Array) -> float:
        eta = design @ at
        return float(np.logaddexp(0.0, np.where(leaks, -eta, eta)).sum() + 0.5 * (penalty * at * at).sum())

    value = objective(beta)
    for _ in range(_MOST_STEPS):
        p = expit(design @ beta)
        slope = design.T @ (p - leaks) + penalty * beta
        curvature = (design.T * (p * (1.0 - p))) @ design + np.diag(penalty)
        try:
            step = np.linalg.solve(curvature, slope)
        except np.linalg.LinAlgError:
            break
        share = 1.0
        while objective(beta - share * step) > value * (1.0 + 1e-12) and share > _LEAST_SHARE:
            share /= 2.0
        beta = beta - share * step
        value = objective(beta)
        if abs(float(slope @ step)) <= _SMALL * (1.0 + value):  # twice what a further step would gain
            if ridge == 0 and np.all(np.where(leaks, 1.0, -1.0) * (design @ beta) > 0):
                break  # separable: the further the weights grow the better
            return LogisticFit(float(beta[0]), beta[1:], centre, scale)
    raise InputError(f"a classifier must reach a maximum, got none with ridge {ridge:g}; give a larger ridge")


def held_out_scores(samples: Samples, detector: Logistic, leave_out: str) -> Array:
    """Log odds of each sample from a fit that saw no sample of its test (`test`) or of its condition (`condition`),
    (n,)."""
    x, leaks = samples.matrix(detector.features), samples.leak_lpm > 0
    groups: list[Hashable] = (
        list(samples.tests) if leave_out == "test" else [tuple(sorted(one.items())) for one in samples.levels]
    )
    places = {group: number for number, group in enumerate(dict.fromkeys(groups))}
    of = np.array([places[group] for group in groups])
    if len(places) < 2:
        raise InputError(f"tests to leave out in turn must be at least 2, got {len(places)}")
    found = np.empty(leaks.size)
    for number in range(len(places)):
        out = of == number
        found[out] = fit_logistic(x[~out], leaks[~out], detector.ridge).log_odds(x[out])
    return found


def held_out_rows(plan: HeldOutPlan, samples: Samples) -> list[Row]:
    """A row for each sample, with the log odds that each detector gave it while it was held out, in the order of their
    ids."""
    scores = {one.name: held_out_scores(samples, one, plan.leave_out) for one in plan.detectors}
    rows = []
    for k, leak in enumerate(samples.leak_lpm):
        name = hashlib.sha256(f"{plan.data} {k}".encode()).hexdigest()
        rows.append(
            Row(
                id=name[:16],
                use="judge",
                leak_lpm=float(leak),
                fault="",
                levels=samples.levels[k],
                replicate=0,
                flow_lpm=float(leak),
                scores={one.name: (float(scores[one.name][k]), None) for one in plan.detectors},
            )
        )
    return sorted(rows, key=lambda row: row.id)
