"""Compare the leakage conductance of a recording with that of leak-free recordings of the same machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sealscope.diagnosis.verdict.evidence import Evidence
from sealscope.diagnosis.volume_balance.evidence import LPM, geometry_fits, level_interval, refused, t_quantile
from sealscope.diagnosis.volume_balance.fit import BalanceFit

BASELINE = "conductance against the baseline"
#: Recordings whose displacement over area differs by more are of another machine.
_SAME_MACHINE = 0.02


def against_baseline(
    fit: BalanceFit, others: Sequence[BalanceFit], within: Evidence, probability: float, *, metres: bool
) -> Evidence:
    """Evidence from both questions: does the conductance rise within the recording (`within`), and is it higher than
    in the leak-free recordings? Each is asked at `probability`.

    The second is Student's: the mean conductance against the baseline's mean, over the scatter between leak-free
    recordings. One leak-free recording has no such scatter; its halves and this recording's own first half stand in.
    """
    from scipy.special import stdtrit

    same = [one for one in others if abs(one.scale / fit.scale - 1.0) <= _SAME_MACHINE and one.sense == fit.sense]
    if not same:
        note = "; no baseline recording can be compared: none balances with this geometry"
        return replace(within, reason=within.reason + note)
    mean = level_interval(fit)[0]
    levels = np.array([level_interval(one)[0] for one in same])
    own = np.array([_deviation(one) for one in (fit, *same)])
    if len(same) > 1:
        freedom, between = len(same) - 1, float(np.var(levels, ddof=1))
    else:
        pairs = np.array([_halves(one) for one in (fit, *same)])
        freedom, between = len(pairs), float(np.mean(pairs**2)) / 2.0
    # scatter between recordings is never under what each one's own errors make of it
    variance = max(between, float(np.mean(own[1:] ** 2))) * (1.0 / len(same) + 1.0)
    score = float((mean - levels.mean()) / np.sqrt(variance))
    threshold = float(stdtrit(freedom, 1.0 - probability))
    part = Evidence("leak" if score > threshold else "no leak", "", score, threshold, detector=BASELINE)
    parts = (*within.parts, part)
    told = f"score {score:.1f}, threshold {threshold:.1f}"
    if within.verdict == "leak" or score <= threshold:
        more = "higher than" if score > threshold else "that of"
        reason = f"{within.reason}; on the whole the conductance is {more} the baseline's ({told})"
        return replace(within, reason=reason, parts=parts)
    lpm, interval, words = None, None, ""
    if metres and geometry_fits(fit):
        flow = float(fit.blocks.abs_dp.mean()) * LPM
        lpm = float(mean - levels.mean()) * flow
        wide = t_quantile(freedom) * float(np.sqrt(variance)) * flow
        interval = (max(0.0, lpm - wide), lpm + wide)
        words = f" by {lpm:.2g} L/min ({interval[0]:.2g} to {interval[1]:.2g})"
    reason = (
        f"the leakage conductance is higher than in {len(same)} leak-free recording{'s' * (len(same) > 1)}{words}, "
        f"from the start ({told}); within the recording: {within.reason}"
    )
    return Evidence("leak", reason, score, threshold, None, None, lpm, interval, parts, refuses=refused(fit, metres))


def _deviation(fit: BalanceFit) -> float:
    _, low, high = level_interval(fit)
    return (high - low) / (2.0 * 1.96)


def _halves(fit: BalanceFit) -> float:
    half = len(fit.g) // 2
    return float(fit.g[half:].mean() - fit.g[:half].mean())
