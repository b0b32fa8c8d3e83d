"""The verdict of a test that has run, by its alarm and its bound: of a recording, a stream and a trend alike."""

from __future__ import annotations

import math

from sealscope.diagnosis.priors import priors
from sealscope.diagnosis.verdict.evidence import CANNOT_TELL, LEAK, NO_LEAK, Verdict


def decide_verdict(is_leak: bool, bound: float, worth: float) -> Verdict:
    """Decide on a leak by whether one is shown, and else by how large one may be that is not.

    Parameters
    ----------
    is_leak : bool
        Whether a leak is shown at the stated false-alarm probability, and explains what changed.
    bound, worth : float
        95 % upper bound of a leak that does not show, and the largest bound that is worth stating, in one unit; not
        finite where nothing bounds a leak.

    Returns
    -------
    str
        One of the three verdicts.
    """
    verdict: Verdict = CANNOT_TELL
    if is_leak:
        verdict = LEAK
    elif math.isfinite(bound) and bound <= worth:
        verdict = NO_LEAK
    return verdict


def bound_worth_stating(flow: float) -> float:
    """Return the largest bound worth stating for a pump's flow, in the flow's unit."""
    share: float = priors("decision")["worth"]["share"]
    return share * flow if flow > 0.0 else 0.0
