"""Measure what Appendix C's classifiers reach over random inner splits, and on commands and throttles never seen.

    python benchmarks/held_out.py FOLDER [--splits 20] [--swaps 40]

FOLDER holds the thesis's data sheet (`sealscope campaign run appendix-c --sheet FOLDER`). The classifier that chooses
its features and ridge does so on five parts of the training tests; which tests make a part is arbitrary, and the plan
takes one split. Here the tests are dealt anew for every run. Held out are whole tests, conditions, commands or throttle
settings. `chance`: the area that 5 % of the runs reach in which the labels of each test are swapped by a fair coin.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from sealscope.campaigns.held_out.classifiers import MeasuredSamples, held_out_scores
from sealscope.campaigns.plans.model import ChosenClassifier, HeldOutPlan
from sealscope.campaigns.plans.reader import load_plan
from sealscope.cli.campaign import _sheet_samples
from sealscope.evaluation.roc import auc


def of_level(samples: MeasuredSamples, name: str) -> MeasuredSamples:
    """Return the samples with one level as their condition."""
    return replace(samples, levels=[{name: level[name]} for level in samples.levels])


def dealt(samples: MeasuredSamples, random: np.random.Generator) -> MeasuredSamples:
    """Return the samples in another order of their tests, which the inner parts follow."""
    tests = list(dict.fromkeys(samples.tests))
    place = dict(zip(tests, random.permutation(len(tests)), strict=True))
    order = np.argsort([place[test] for test in samples.tests], kind="stable")
    return MeasuredSamples(
        {name: values[order] for name, values in samples.features.items()},
        samples.leak_lpm[order],
        [samples.tests[k] for k in order],
        [samples.levels[k] for k in order],
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splits", type=int, default=20)
    parser.add_argument("--swaps", type=int, default=40)
    chosen = parser.parse_args()
    plan, samples = load_plan("appendix-c"), _sheet_samples(chosen.folder)
    assert isinstance(plan, HeldOutPlan)
    random = np.random.default_rng(plan.seed)
    held_out = {
        "tests": (samples, "test"),
        "conditions": (samples, "condition"),
        "commands": (of_level(samples, "command"), "condition"),
        "throttles": (of_level(samples, "closed"), "condition"),
    }
    for classifier in plan.detectors:
        for what, (chosen_samples, leave_out) in held_out.items():
            areas, swapped = [], []
            for run in range(chosen.splits if isinstance(classifier, ChosenClassifier) else 1):
                own = dealt(chosen_samples, random) if run else chosen_samples
                scores = held_out_scores(own, classifier, leave_out)
                areas.append(auc(scores[own.leak_lpm <= 0], scores[own.leak_lpm > 0]).value)
            for _ in range(chosen.swaps):
                own = dealt(chosen_samples, random)
                numbers = {test: k for k, test in enumerate(dict.fromkeys(own.tests))}
                coin = random.random(len(numbers)) < 0.5
                leaks = (own.leak_lpm > 0) ^ coin[[numbers[test] for test in own.tests]]
                scores = held_out_scores(own, classifier, leave_out, leaks)
                swapped.append(auc(scores[~leaks], scores[leaks]).value)
            spread = f"{np.median(areas):.3f} ({min(areas):.3f} to {max(areas):.3f})" if len(areas) > 1 else areas[0]
            chance = np.quantile(swapped, 0.95)
            spread = spread if isinstance(spread, str) else f"{spread:.3f}"
            print(f"{classifier.name:58s} {what:11s} {spread:26s} chance {chance:.3f}", flush=True)


if __name__ == "__main__":
    main()
