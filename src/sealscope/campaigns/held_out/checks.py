"""Whether a classifier's held-out figure can be believed: other folds, labels swapped by chance, tests as clusters."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sealscope.campaigns.held_out.classifiers import (
    Array,
    MeasuredSamples,
    chosen_candidates,
    group_numbers,
    held_out_scores,
)
from sealscope.campaigns.plans.model import ChosenClassifier, Classifier, HeldOutPlan
from sealscope.evaluation.roc import auc, placements


@dataclass(frozen=True)
class HeldOutCheck:
    """One classifier's area under the ROC.

    `tests`, `conditions`: value and interval (value, low, high) with whole tests and with whole operating conditions
    held out, the tests being clusters of dependent samples; `chance`: what 5 % of the swaps of labels reach, `reached`
    by how many of `swaps` the area itself was (chance is None and swaps 0 where they were not tried); `picks`: how
    often which features were chosen, most often first, empty where they were not chosen.
    """

    detector: str
    tests: tuple[float, float, float]
    conditions: tuple[float, float, float]
    chance: float | None = None
    reached: int = 0
    swaps: int = 0
    picks: tuple[tuple[str, int], ...] = ()

    def sentence(self) -> str:
        """Return the check in one sentence."""
        value, low, high = self.conditions
        text = (
            f"{self.detector}: AUC {self.tests[0]:.3f} ({self.tests[1]:.3f}–{self.tests[2]:.3f}) with whole tests held "
            f"out, {value:.3f} ({low:.3f}–{high:.3f}) with whole conditions"
        )
        if self.chance is not None:
            text += (
                f"; with the labels of each test swapped by chance 5 % of {self.swaps} swaps reach {self.chance:.3f}, "
                f"{self.reached} reach what the true labels do"
            )
        if self.picks:
            text += "; chosen: " + ", ".join(f"{features} ({times} times)" for features, times in self.picks[:3])
        return text + "."


def clustered_area(
    scores: Array, leaks: npt.NDArray[np.bool_], clusters: npt.NDArray[np.intp], confidence: float = 0.95
) -> tuple[float, float, float]:
    """Return the area under the ROC and its interval where samples of one cluster depend on each other.

    ``var A = I/(I - 1) sum_i (U_i/m + W_i/n - (m_i/m + n_i/n) A)^2`` with U_i, W_i the sums of the placements of the
    m_i leaky and n_i leak-free samples of cluster i, of I clusters; equal to Obuchowski's estimate where every cluster
    holds both. `scores`, `leaks`, `clusters` (k,). Source: Obuchowski, Biometrics 53 (1997) 567-578, doi
    10.2307/2533958.
    """
    from scipy.special import ndtri

    free, leaky = scores[~leaks], scores[leaks]
    placed = np.empty(scores.size)
    placed[~leaks], placed[leaks] = placements(free, leaky)
    value = float(placed[leaks].mean())
    share = np.where(leaks, 1.0 / leaky.size, 1.0 / free.size)
    number = int(clusters.max()) + 1
    each = np.bincount(clusters, weights=share * (placed - value), minlength=number)
    error = float(np.sqrt(number / (number - 1.0) * np.sum(each**2)))
    reach = float(ndtri(0.5 + confidence / 2.0)) * error
    return value, max(0.0, value - reach), min(1.0, value + reach)


def swapped_areas(samples: MeasuredSamples, detector: Classifier, leave_out: str, times: int, seed: int) -> Array:
    """Return held-out areas with the labels of each test swapped, or not, by a fair coin, (times,).

    It is what a classifier reaches that knows its test, its condition and nothing of the leak.
    """
    random = np.random.default_rng(seed)
    leaks, tests = samples.leak_lpm > 0, group_numbers(samples, "test")
    areas = np.empty(times)
    for k in range(times):
        swapped = leaks ^ (random.random(int(tests.max()) + 1) < 0.5)[tests]
        scores = held_out_scores(samples, detector, leave_out, swapped)
        areas[k] = auc(scores[~swapped], scores[swapped]).value
    return areas


def checks_of(plan: HeldOutPlan, samples: MeasuredSamples) -> list[HeldOutCheck]:
    """Return the checks of a plan's classifiers, in its order; none where the plan asks for no permutations.

    Labels are not swapped where features are chosen anew each time.
    """
    return [_check(plan, samples, classifier) for classifier in plan.detectors] if plan.permutations else []


def _check(plan: HeldOutPlan, samples: MeasuredSamples, classifier: Classifier) -> HeldOutCheck:
    name, leaks, tests = classifier.name, samples.leak_lpm > 0, group_numbers(samples, "test")
    by_test, by_condition = (
        clustered_area(held_out_scores(samples, classifier, leave_out), leaks, tests, plan.confidence)
        for leave_out in ("test", "condition")
    )
    if isinstance(classifier, ChosenClassifier):
        chosen = chosen_candidates(samples, classifier, plan.leave_out)
        picks = Counter(f"{_short(pick.features)}, ridge {pick.ridge:g}" for pick in chosen).most_common()
        return HeldOutCheck(name, by_test, by_condition, picks=tuple(picks))
    swapped = swapped_areas(samples, classifier, plan.leave_out, plan.permutations, plan.seed)
    own = (by_test if plan.leave_out == "test" else by_condition)[0]
    reached = int(np.count_nonzero(swapped >= own))
    return HeldOutCheck(name, by_test, by_condition, float(np.quantile(swapped, 0.95)), reached, plan.permutations)


def _short(features: tuple[str, ...]) -> str:
    """Return features by quantity alone where both chambers have them."""
    quantities = list(dict.fromkeys(name.split(" of ")[0] for name in features))
    chambers = list(dict.fromkeys(name.split(" of ")[-1] for name in features))
    whole = len(features) == len(quantities) * len(chambers)
    return " ".join(quantities) if whole else " and ".join(features)
