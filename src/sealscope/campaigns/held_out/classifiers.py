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


def fold_log_odds(x: Array, leaks: npt.NDArray[np.bool_], folds: npt.NDArray[np.bool_], ridge: float) -> Array:
    """Return the log odds of a leak for all samples from one logistic regression for each fold, (k, n).

    `x` (n, f); `folds` (k, n): the samples that each is fitted to. A fit maximises ``sum ln P(y|x) - ridge/2
    |weights|^2`` by Newton's method, each feature standardised over its samples, the intercept not penalised; `ridge` >
    0. Raises InputError for a fold with a single class or a constant feature. Source: le Cessie and van Houwelingen,
    Appl. Stat. 41 (1992) 191-201, doi 10.2307/2347628.
    """
    from scipy.special import expit

    if not (np.any(folds & leaks, axis=1) & np.any(folds & ~leaks, axis=1)).all():
        raise InputError("a classifier needs both classes, got leaks alone or none in a part of the samples")
    weight = folds.astype(np.float64)
    count = weight.sum(axis=1)
    off = x[None] - (weight @ x / count[:, None])[:, None, :]
    scale = np.sqrt(np.einsum("kn,knf->kf", weight, off**2) / count[:, None])
    if not np.all(scale > 0):
        raise InputError(f"a feature must vary, got a constant one (number {int(scale.min(axis=0).argmin()) + 1})")
    design = np.concatenate([np.ones((*folds.shape, 1)), off / scale[:, None, :]], axis=2)
    penalty = np.concatenate([[0.0], np.full(x.shape[1], ridge)])
    against = np.where(leaks, -1.0, 1.0)

    def objective(at: Array) -> Array:
        losses = np.logaddexp(0.0, against * np.einsum("knf,kf->kn", design, at))
        return np.asarray((weight * losses).sum(axis=1) + 0.5 * (penalty * at * at).sum(axis=1))

    beta = np.zeros((len(folds), design.shape[2]))
    value, going = objective(beta), np.ones(len(folds), dtype=bool)
    for _ in range(_MOST_STEPS):
        p = expit(np.einsum("knf,kf->kn", design, beta))
        slope = np.einsum("kn,knf->kf", weight * (p - leaks), design) + penalty * beta
        inner = (design * (weight * p * (1.0 - p))[:, :, None]).transpose(0, 2, 1) @ design + np.diag(penalty)
        step = np.linalg.solve(inner, slope[:, :, None])[:, :, 0]
        share = going.astype(np.float64)  # a fold that is done waits: no other changes its last bits
        while (worse := (tried := objective(beta - share[:, None] * step)) > value * (1.0 + 1e-12)).any():
            share[worse] = np.where(share[worse] > _LEAST_SHARE, share[worse] / 2.0, 0.0)
        beta -= share[:, None] * step
        value = tried
        going &= np.abs(np.sum(slope * step, axis=1)) > _SMALL * (1.0 + value)  # twice what a further step would gain
        if not going.any():
            break
    return np.asarray(np.einsum("knf,kf->kn", design, beta))


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
    of, folds = _folds(samples, leave_out)
    candidates = detector.candidates()
    best, odds = _choices(samples, candidates, of, leaks, folds), np.empty(folds.shape)
    for number in dict.fromkeys(best):
        mine, candidate = best == number, candidates[number]
        odds[mine] = fold_log_odds(samples.matrix(candidate.features), leaks, folds[mine], candidate.ridge)
    return np.asarray(odds[of, np.arange(of.size)])


def chosen_candidates(samples: MeasuredSamples, detector: ChosenClassifier, leave_out: str) -> list[LogisticClassifier]:
    """Return what the training samples of each fold chose, one for each test or condition held out."""
    of, folds = _folds(samples, leave_out)
    candidates = detector.candidates()
    return [candidates[number] for number in _choices(samples, candidates, of, samples.leak_lpm > 0, folds)]


def _folds(samples: MeasuredSamples, leave_out: str) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """Return the group of each sample, (n,), and the samples that are left when each group is held out, (k, n)."""
    of = group_numbers(samples, leave_out)
    if of.max() < 1:
        raise InputError(f"tests to leave out in turn must be at least 2, got {of.max() + 1}")
    return of, of[None, :] != np.arange(of.max() + 1)[:, None]


def _choices(
    samples: MeasuredSamples,
    candidates: Sequence[LogisticClassifier],
    of: npt.NDArray[np.intp],
    leaks: npt.NDArray[np.bool_],
    folds: npt.NDArray[np.bool_],
) -> npt.NDArray[np.intp]:
    """Return the number of the candidate that loses least within each fold's training samples, (k,).

    The loss is the mean of -ln P(label) over `_INNER` parts of the places (tests or conditions) that the fold trains
    on, each held out once; what the fold leaves out takes no part.
    """
    if len(candidates) == 1:
        return np.zeros(len(folds), dtype=np.intp)
    inner = of % _INNER
    parts = [part for part in range(_INNER) if np.any(inner == part)]
    masks = np.stack([fold & (inner != part) for fold in folds for part in parts])
    judged = np.stack([fold & (inner == part) for fold in folds for part in parts])
    sign = np.where(leaks, 1.0, -1.0)
    losses = []
    for candidate in candidates:
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
            levels=samples.levels[k],
            flow_lpm=float(leak),
            scores={name: (float(odds[k]), None) for name, odds in scores.items()},
        )
        for k, leak in enumerate(samples.leak_lpm)
    ]
    return sorted(rows, key=lambda row: row.id)
