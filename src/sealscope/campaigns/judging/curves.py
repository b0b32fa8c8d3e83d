"""Curves of each detector: probability of detection over the size of the leak, and ROC over all thresholds."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from sealscope.campaigns.judging.verdicts import Verdicts
from sealscope.errors import InputError
from sealscope.evaluation.pod import HitMiss, SizeDetection, by_size, fit_hit_miss, proven_size
from sealscope.evaluation.roc import Area, Roc, auc, roc_curve


@dataclass(frozen=True)
class DetectorPod:
    """One detector's probability of detection over the size of the leak.

    `sizes`: the detection at each size; `curve`: the logistic curve through hits and misses, None where there is none,
    for the reason `why`; `proven`: the smallest size found nine times in ten without a curve.
    """

    detector: str
    sizes: tuple[SizeDetection, ...]
    curve: HitMiss | None
    why: str
    proven: float

    @property
    def description(self) -> str:
        """Method of the curve's fit, or the reason why there is none."""
        return self.curve.estimator if self.curve else self.why


@dataclass(frozen=True)
class SizeRoc:
    """One detector's ROC at one size of leak (nan: all sizes), against the leak-free records to judge."""

    detector: str
    leak_lpm: float
    curve: Roc
    area: Area


def pods_of(verdicts: Verdicts, confidence: float) -> Iterator[DetectorPod]:
    """Yield the probability of detection over the size, where there are leaks."""
    for name, records in verdicts.items():
        leaky = [record for record in records if record.size > 0]
        if not leaky:
            continue
        sizes, hits = [record.size for record in leaky], [record.alarm for record in leaky]
        detections = by_size(sizes, hits, confidence)
        curve, why = None, ""
        try:
            curve = fit_hit_miss(sizes, hits)
        except InputError as error:
            why = str(error)
        yield DetectorPod(name, tuple(detections), curve, why, proven_size(detections))


def rocs_of(verdicts: Verdicts, confidence: float) -> Iterator[SizeRoc]:
    """Yield curves over the scores, with no threshold; a record that cannot be judged counts as the lowest."""
    for name, records in verdicts.items():
        scores = [record.row.scores[name][0] if record.row.error is None else None for record in records]
        lowest = min((score for score in scores if score is not None), default=None)
        if lowest is None:
            continue
        by_leak: dict[float, list[float]] = {}
        for record, score in zip(records, scores, strict=True):
            by_leak.setdefault(record.size, []).append(lowest - 1.0 if score is None else score)
        free = by_leak.pop(0.0, [])
        all_scores = [score for leaky in by_leak.values() for score in leaky]
        for size, leaky in ((math.nan, all_scores), *sorted(by_leak.items())):
            if min(len(free), len(leaky)) > 1:
                yield SizeRoc(name, size, roc_curve(free, leaky, confidence), auc(free, leaky, confidence))
