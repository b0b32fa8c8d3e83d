"""The verdict where no test found a leak, by the bound of an undetected one."""

from __future__ import annotations

import math

from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, NO_LEAK, Verdict


def decide_without_leak(bound: float, max_bound: float) -> Verdict:
    """Decide `no leak` if the 95 % upper bound of a leak is at most `max_bound`, else `cannot tell`."""
    verdict: Verdict = NO_LEAK if math.isfinite(bound) and bound <= max_bound else CANNOT_TELL
    return verdict


def bound_worth_stating(flow: float) -> float:
    """Compute the largest bound of a leak that allows the verdict `no leak`.

    It is a fraction of the pump's `flow`, in the same unit, and is 0 if `flow` is not positive.
    """
    return float(DECISION.worth.share) * flow if flow > 0.0 else 0.0
