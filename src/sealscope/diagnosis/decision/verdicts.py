"""The verdict if no test found a leak, from the upper bound of an undetected leak."""

from __future__ import annotations

import math

from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, NO_LEAK, Verdict


def decide_without_leak(bound: float, max_bound: float) -> Verdict:
    """Return the verdict on a recording in which no test found a leak: `no leak` or `cannot tell`.

    It is `no leak` if `bound`, the 95 % upper bound of an undetected leak, is finite and at most `max_bound`. Both are
    in the same unit.
    """
    is_small = math.isfinite(bound) and bound <= max_bound
    verdict: Verdict = NO_LEAK if is_small else CANNOT_TELL
    return verdict


def bound_worth_stating(flow: float) -> float:
    """Compute the largest upper bound of an undetected leak that still allows the verdict `no leak`.

    `flow`: mean flow of the pump while it delivers. The result is a fraction of this flow (`worth.share` in
    `priors.toml`), or 0 if `flow` is not positive.
    """
    return float(DECISION.worth.share) * flow if flow > 0.0 else 0.0
