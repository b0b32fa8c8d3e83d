"""The level of G against that of leak-free records of the same machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sealscope.diagnosis.verdict.evidence import LITRE_PER_MINUTE, Evidence
from sealscope.recordings.recording import Array

#: Commands are alike within this ratio of their rms.
_ALIKE = 1.1
#: From day to day the level moves by this much [m^3/(s Pa)] at least: fits of one machine differ with its friction.
_LEAST_SCATTER = 3e-13


@dataclass(frozen=True)
class Level:
    """Mean conductance of a record [m^3/(s Pa)], its standard deviation, and the rms of the command [V]."""

    value: float
    deviation: float
    command_rms: float


def against_levels(
    own: Level, baseline: Sequence[Level], within: Evidence, probability: float, mean_drop: float
) -> Evidence:
    """Evidence from the level against leak-free ones, or from the rise `within` the record where that found a leak.

    Student's t of the difference, with the baseline's own scatter where there are several records.
    """
    if within.verdict == "leak" or within.cause is not None:
        return within
    alike = [one for one in baseline if 1.0 / _ALIKE < one.command_rms / own.command_rms < _ALIKE]
    if not alike:
        return replace(
            within,
            verdict="cannot tell",
            reason=f"{within.reason}; no baseline recording has the same command and follows the model",
        )
    from scipy.stats import norm, t

    values: Array = np.array([one.value for one in alike])
    stated = float(np.mean([one.deviation**2 for one in alike]))
    k = values.size
    seen = float(np.var(values, ddof=1)) if k > 1 else 0.0
    scatter = max(seen - stated, _LEAST_SCATTER**2)
    variance = own.deviation**2 + stated / k + scatter * (1.0 + 1.0 / k)
    size = own.value - float(values.mean())
    score = size / np.sqrt(variance)
    threshold = float(t.ppf(1.0 - probability, k - 1) if k > 2 else norm.ppf(1.0 - probability))
    part = Evidence("leak" if score > threshold else "no leak", "", float(score), threshold, detector="level of G")
    figures = f"z {score:.2f}, threshold {threshold:.2f}, {k} baseline record{'s' if k > 1 else ''}"
    parts = (*within.parts, part)
    if score <= threshold:
        reason = f"the leakage conductance is not above the baseline's ({figures}), and does not rise within the record"
        return Evidence("no leak", reason, float(score), threshold, parts=parts)
    per = mean_drop / LITRE_PER_MINUTE
    reach = 1.96 * float(np.sqrt(variance))
    return Evidence(
        "leak",
        f"the leakage conductance past piston or pump is above the baseline's ({figures})",
        float(score),
        threshold,
        leak_lpm=size * per,
        leak_interval_lpm=(max(0.0, (size - reach) * per), (size + reach) * per),
        parts=parts,
        cause="piston or pump leak",
    )
