"""Curves of each detector: probability of detection over the size of the leak, and ROC over all thresholds."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

from sealscope.campaigns.judging.verdicts import Verdicts
from sealscope.errors import InputError
from sealscope.evaluation.pod import HitMiss, SizeDetection, detection_by_size, fit_hit_miss, proven_size
from sealscope.evaluation.roc import Area, Roc, auc, roc_curve


@dataclass(frozen=True)
class DetectorPod:
    """One detector's probability of detection (POD) over the size of the leak, i.e. over its planned mean flow.

    `sizes`: detected fraction at each tested size; `curve`: logistic curve fitted to hits and misses, None if it cannot
    be fitted; `description`: method of the fit, or the reason why there is no curve; `proven`: smallest size from which
    on detection is proven (`proven_size`), inf if there is none.
    """

    detector: str
    sizes: tuple[SizeDetection, ...]
    curve: HitMiss | None
    description: str
    proven: float


@dataclass(frozen=True)
class SizeRoc:
    """One detector's ROC (receiver operating characteristic): detections over false alarms, for all thresholds.

    `leak_lpm`: size of the leak, nan for all sizes together; `area`: area under the curve.
    """

    detector: str
    leak_lpm: float
    curve: Roc
    area: Area


def iter_pods(verdicts: Verdicts, confidence: float) -> Iterator[DetectorPod]:
    """Yield the probability of detection over the planned mean leak flow, for each detector with records of leaks."""
    for name, records in verdicts.items():
        leaky = [record for record in records if record.size > 0]
        if not leaky:
            continue
        sizes = [record.size for record in leaky]
        hits = [record.alarm for record in leaky]
        detections = detection_by_size(sizes, hits, confidence)
        try:
            curve = fit_hit_miss(sizes, hits)
            description: str = curve.estimator
        except InputError as error:
            curve, description = None, str(error)
        yield DetectorPod(name, tuple(detections), curve, description, proven_size(detections))


def iter_rocs(verdicts: Verdicts, confidence: float) -> Iterator[SizeRoc]:
    """Yield ROC curves of each detector that has scores: for all leaks together, and for each planned mean flow.

    A record without a score is ranked below all others. A curve needs at least two records with a leak and two without.
    """
    for name, records in verdicts.items():
        scores = [record.row.score(name) if record.row.error is None else None for record in records]
        min_score = min((score for score in scores if score is not None), default=None)
        if min_score is None:
            continue
        by_leak: dict[float, list[float]] = defaultdict(list)
        for record, score in zip(records, scores, strict=True):
            by_leak[record.size].append(min_score - 1.0 if score is None else score)
        leak_free = by_leak.pop(0.0, [])
        all_scores = [score for leaky in by_leak.values() for score in leaky]
        for size, leaky in ((math.nan, all_scores), *sorted(by_leak.items())):  # nan: all sizes
            if min(len(leak_free), len(leaky)) > 1:
                yield SizeRoc(name, size, roc_curve(leak_free, leaky, confidence), auc(leak_free, leaky, confidence))
