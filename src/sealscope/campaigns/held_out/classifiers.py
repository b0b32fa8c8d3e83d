"""Classifiers judged on measured tests that they have not seen: each test held out whole, the others fitted to."""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.campaigns.cases.row import CaseRow
from sealscope.campaigns.plans.model import ChosenClassifier, Classifier, HeldOutPlan, LogisticClassifier
from sealscope.errors import InputError

Array = npt.NDArray[np.float64]
_MOST_STEPS = 100
_SMALL = 1e-15
_LEAST_SHARE = 1e-8
#: Newton steps of whole length before a fit is done with shorter ones.
_PLAIN_STEPS = 15
#: Parts of the training samples in which features and ridge are chosen.
_INNER = 5


@dataclass(frozen=True)
class MeasuredSamples:
    """Measured samples.

    `features`: name -> (n,) values; `leak_lpm` (n,), 0 where nothing leaks; `tests` (n,): which test each belongs to;
    `levels`: of each, its operating condition.
    """

    features: Mapping[str, Array]
    leak_lpm: Array
    tests: Sequence[Hashable]
    levels: Sequence[Mapping[str, str | float]]

    def matrix(self, names: Sequence[str]) -> Array:
        """Return the named features, (n, f); raise InputError for one that the data do not have."""
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
        """Return the log odds of a leak for samples (n, f)."""
        return np.asarray(self.intercept + ((x - self.centre) / self.scale) @ self.weights)


def fit_logistic(x: Array, leaks: npt.NDArray[np.bool_], ridge: float) -> LogisticFit:
    """Fit a logistic regression by Newton's method, maximising ``sum ln P(y|x) - ridge/2 |weights|^2``.

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


def fold_log_odds(x: Array, leaks: npt.NDArray[np.bool_], folds: npt.NDArray[np.bool_], ridge: float) -> Array:
    """Return the log odds of all samples from one fit for each fold, fitted to the samples of its mask alone, (k, n).

    `x` (n, f), `folds` (k, n). The same fits as `fit_logistic`'s, all folds in one Newton iteration; folds that plain
    steps do not bring to the maximum are fitted by it one by one, and it raises what it raises.
    """
    from scipy.special import expit

    odds = np.empty(folds.shape)
    single = np.ones(len(folds), dtype=bool)
    weight = folds.astype(np.float64)
    count = weight.sum(axis=1)
    centre = weight @ x / np.maximum(count, 1.0)[:, None]
    off = x[None] - centre[:, None, :]
    scale = np.sqrt(np.einsum("kn,knf->kf", weight, off**2) / np.maximum(count, 1.0)[:, None])
    both = np.any(folds & leaks, axis=1) & np.any(folds & ~leaks, axis=1)
    if ridge > 0 and np.all(scale > 0) and np.all(both):
        design = np.concatenate([np.ones((*folds.shape, 1)), off / scale[:, None, :]], axis=2)
        penalty = np.concatenate([[0.0], np.full(x.shape[1], ridge)])
        beta = np.zeros((len(folds), design.shape[2]))
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(_PLAIN_STEPS):
                p = expit(np.einsum("knf,kf->kn", design, beta))
                slope = np.einsum("kn,knf->kf", weight * (p - leaks), design) + penalty * beta
                inner = (design * (weight * p * (1.0 - p))[:, :, None]).transpose(0, 2, 1) @ design + np.diag(penalty)
                step = np.linalg.solve(inner, slope[:, :, None])[:, :, 0]
                beta[single] -= step[single]  # a fold that is done waits: no other changes its last bits
                single &= ~(np.abs(np.sum(slope * step, axis=1)) <= _SMALL)
                if not single.any() or not np.all(np.isfinite(beta)):
                    break
        odds = np.einsum("knf,kf->kn", design, beta)
    for k in np.flatnonzero(single):
        odds[k] = fit_logistic(x[folds[k]], leaks[folds[k]], ridge).log_odds(x)
    return odds


def group_numbers(samples: MeasuredSamples, leave_out: str) -> npt.NDArray[np.intp]:
    """Return the number of the test (`test`) or operating condition (`condition`) of each sample, from 0 on, (n,)."""
    groups: list[Hashable] = (
        list(samples.tests) if leave_out == "test" else [tuple(sorted(levels.items())) for levels in samples.levels]
    )
    places = {group: number for number, group in enumerate(dict.fromkeys(groups))}
    return np.array([places[group] for group in groups])


def held_out_scores(
    samples: MeasuredSamples, detector: Classifier, leave_out: str, leaks: npt.NDArray[np.bool_] | None = None
) -> Array:
    """Return the log odds of each sample from a fit that saw no sample of its test or condition, (n,).

    `leave_out`: `test` or `condition`; `leaks` (n,): other labels than the samples' own.
    """
    leaks = samples.leak_lpm > 0 if leaks is None else leaks
    of = group_numbers(samples, leave_out)
    if of.max() < 1:
        raise InputError(f"tests to leave out in turn must be at least 2, got {of.max() + 1}")
    folds = of[None, :] != np.arange(of.max() + 1)[:, None]
    if isinstance(detector, LogisticClassifier):
        odds = fold_log_odds(samples.matrix(detector.features), leaks, folds, detector.ridge)
    else:
        candidates = detector.candidates()
        best = _choices(samples, detector, of, leaks, folds)
        odds = np.empty(folds.shape)
        for number in dict.fromkeys(best):
            mine, candidate = best == number, candidates[number]
            odds[mine] = fold_log_odds(samples.matrix(candidate.features), leaks, folds[mine], candidate.ridge)
    return np.asarray(odds[of, np.arange(of.size)])


def chosen_candidates(samples: MeasuredSamples, detector: ChosenClassifier, leave_out: str) -> list[LogisticClassifier]:
    """Return what the training samples of each fold chose, one for each test or condition held out."""
    of = group_numbers(samples, leave_out)
    folds = of[None, :] != np.arange(of.max() + 1)[:, None]
    candidates = detector.candidates()
    return [candidates[number] for number in _choices(samples, detector, of, samples.leak_lpm > 0, folds)]


def _choices(
    samples: MeasuredSamples,
    detector: ChosenClassifier,
    of: npt.NDArray[np.intp],
    leaks: npt.NDArray[np.bool_],
    folds: npt.NDArray[np.bool_],
) -> npt.NDArray[np.intp]:
    """Return the number of the candidate that loses least within each fold's training samples, (k,).

    The loss is the mean of -ln P(label) over `_INNER` parts of the places (tests or conditions) that the fold trains
    on, each held out once; what the fold leaves out takes no part.
    """
    inner = of % _INNER
    parts = [part for part in range(_INNER) if np.any(inner == part)]
    masks = np.stack([fold & (inner != part) for fold in folds for part in parts])
    judged = np.stack([fold & (inner == part) for fold in folds for part in parts])
    sign = np.where(leaks, 1.0, -1.0)
    losses = []
    for candidate in detector.candidates():
        odds = fold_log_odds(samples.matrix(candidate.features), leaks, masks, candidate.ridge)
        losses.append((np.logaddexp(0.0, -sign * odds) * judged).reshape(len(folds), -1).sum(axis=1))
    return np.asarray(np.argmin(np.array(losses), axis=0))


def held_out_rows(plan: HeldOutPlan, samples: MeasuredSamples) -> list[CaseRow]:
    """Return a row for each sample, with the log odds that each detector gave it while held out, in order of ids."""
    scores = {detector.name: held_out_scores(samples, detector, plan.leave_out) for detector in plan.detectors}
    rows = [
        CaseRow(
            id=hashlib.sha256(f"{plan.data} {k}".encode()).hexdigest()[:16],
            use="judge",
            leak_lpm=float(leak),
            fault="",
            levels=samples.levels[k],
            replicate=0,
            flow_lpm=float(leak),
            scores={name: (float(odds[k]), None) for name, odds in scores.items()},
        )
        for k, leak in enumerate(samples.leak_lpm)
    ]
    return sorted(rows, key=lambda row: row.id)
