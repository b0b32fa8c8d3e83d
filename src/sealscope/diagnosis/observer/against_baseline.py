"""The observer with leak-free recordings beside the one that is judged: levels of the conductance are compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.baseline.operating_point import difference, operating_point
from sealscope.diagnosis.observer.evidence import ConductanceSeries, course, within
from sealscope.diagnosis.observer.model import G_UNIT
from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.diagnosis.changepoint.step_in_walk import WalkStep

#: Least scatter of the level from one recording to the next, as a share of the pump's own leakage (8 %: two kelvin of
#: oil) and, by the ringing, in units of `G_UNIT`: what friction alone may seem to change.
_SHARE, _BY_RINGING = 0.08, 0.25
#: Fewest baselines whose own scatter counts.
_FEWEST = 3


def compare(
    recording: Recording,
    series: ConductanceSeries,
    baseline: Sequence[Recording],
    others: Sequence[ConductanceSeries],
    step: WalkStep,
    probability: float,
) -> Evidence:
    """Evidence from the mean conductance against that of the baselines that can be compared.

    With b baselines of mean m and deviation s the score is (g - m)/(s sqrt(1 + 1/b)), Student's t with b - 1 degrees of
    freedom; s is at least what two kelvin of oil make. Fewer than three baselines say nothing of s: then it is that
    least scatter alone, and the normal law.
    """
    from scipy.special import ndtri, stdtrit

    here = operating_point(recording)
    reasons = [difference(here, operating_point(one)) for one in baseline]
    usable = [one for one, why in zip(others, reasons, strict=False) if why is None and one.G.size]
    if len(others) != len(baseline) or not usable:
        why = next((reason for reason in reasons if reason is not None), "its channels are not the same")
        return Evidence("cannot tell", f"no baseline recording can be compared: {why}")
    levels = np.array([np.mean(one.G) for one in usable])
    inner = within(series, step)
    late = series.t > inner.onset_s if inner.onset_s is not None else np.ones(series.t.size, dtype=bool)
    level, expected, b = float(np.mean(series.G[late])), float(np.mean(levels)), levels.size
    least = _SHARE * abs(expected) if series.formulation == "volume" else _BY_RINGING
    enough = b >= _FEWEST
    scatter = max(least, float(np.std(levels, ddof=1)) if enough else 0.0)
    spread = scatter * float(np.sqrt(1.0 + 1.0 / b))
    score = (level - expected) / spread
    threshold = float(-stdtrit(b - 1, probability) if enough else -ndtri(probability))
    lpm = (level - expected) * G_UNIT * float(np.mean(series.dp[late])) / LITRE_PER_MINUTE
    half = float(stdtrit(b - 1, 0.975) if enough else ndtri(0.975)) * spread * lpm / (level - expected)
    told = f"score {score:.2f}, threshold {threshold:.2f}; {b} baseline recordings" + (
        "" if enough else ", too few to tell their own scatter"
    )
    followed = course(series, step, expected)
    if score <= threshold:
        return Evidence(
            "no leak",
            f"no more passes between the chambers than in the baseline ({told})",
            score,
            threshold,
            course=followed,
        )
    return Evidence(
        "leak",
        f"{lpm:.4f} L/min more passes between the chambers than in the baseline ({told}), past the piston or in the "
        "pump",
        score,
        threshold,
        inner.onset_s,
        inner.onset_interval_s,
        lpm,
        (max(0.0, lpm - half), lpm + half),
        cause="piston or pump leak",
        course=followed,
    )
