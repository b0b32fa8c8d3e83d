"""The smallest leak that a rule of the thesis finds, from how its score moves and scatters in simulated records.

The score is taken as normal, without a leak of mean m_0 and scatter s_0, with a leak `a` of mean m(a) and scatter s(a),
interpolated between the sizes that were simulated. At a false-alarm probability alpha

    POD(a) = Phi((m(a) - m_0 - z s_0) / s(a)),   z = Phi^-1(1 - alpha)

for "fell" and "rose", and both tails with alpha/2 each for "changed" (A. P. Berens, ASM Handbook 17 (1989) 689: the
signal-response model, with the scatter at its own value at each size).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sealscope.campaigns.cases.bound import smallest_found
from sealscope.campaigns.plans.scorers import SCORERS, Sides
from sealscope.diagnosis.diagnose import check_probability
from sealscope.errors import InputError
from sealscope.recordings.recording import Array

#: The thesis's rules: d3, d4 and d3d4 fall in p_A and rise in p_B; in p_B also either way, for in a simulated rig they
#: fall there too.
THESIS_RULES = tuple(
    f"{quantity} of {change}" for change in ("p_A fell", "p_B rose", "p_B changed") for quantity in ("d3", "d4", "d3d4")
)
#: Size [L/min] whose probability of detection is stated: the thesis's smallest leak.
STATED = 0.0042
_FINE = 1000


@dataclass(frozen=True)
class RulePrediction:
    """What one rule finds: the smallest leak [L/min], None where it finds none of the sizes that were simulated.

    `scatter` of the leak-free change of the log RMS, `found`: probability that a leak of `STATED` is found, both None
    where the change cannot be computed or does not scatter.
    """

    rule: str
    smallest: float | None
    scatter: float | None
    found: float | None


def check_rule(name: str) -> str:
    """Return the name of a rule on a change over the split; raise InputError where it is none."""
    rule = SCORERS.get(name.strip())
    if rule is None or rule.threshold is not None or not rule.split or len(rule.parts) > 1:
        raise InputError(
            f"a rule to predict must be like 'd3 of p_A fell', 'd3d4 of p_B rose' or 'd2 of p_A changed', got {name!r}"
        )
    return rule.name


@dataclass(frozen=True)
class DetectionTarget:
    """What a prediction is made for: false-alarm and detection probability, the thesis's rules, the noise's seed.

    Raises InputError for probabilities that no detector can be set for, a name that is no rule or a negative seed.
    """

    false_alarm: float = 0.01
    detection: float = 0.9
    rules: tuple[str, ...] = THESIS_RULES
    seed: int = 0

    def __post_init__(self) -> None:
        smallest_found(1.0, self.false_alarm, self.detection)
        check_probability(self.false_alarm)
        for name in self.rules:
            check_rule(name)
        if self.seed < 0:
            raise InputError(f"seed must be >= 0, got {self.seed}")


def change_of(rule: str, sides: Sides) -> float:
    """Return the change of the log RMS, positive in the direction of the rule; NaN where it cannot be computed."""
    (quantity, chamber, word), *_ = SCORERS[rule].parts
    change = sides.value(chamber, quantity, "change")
    return np.nan if change is None else -change if word == "fell" else change


def detection_of(shift: Array, scatter: Array, leak_free: float, false_alarm: float, both: bool) -> Array:
    """Return the POD (m,) for shifts of the mean (m,) with scatters (m,) > 0; `both`: in either direction."""
    from scipy.special import ndtr, ndtri

    limit = -float(ndtri(false_alarm / (2.0 if both else 1.0))) * leak_free
    detection = ndtr((shift - limit) / scatter)
    return np.asarray(detection + ndtr((-shift - limit) / scatter) if both else detection)


def smallest_leaks(
    sizes: Array, changes: Sequence[Array], target: DetectionTarget, *, alike: bool = False
) -> tuple[RulePrediction, ...]:
    """Return the smallest leak that each of the target's rules finds.

    `sizes` (m,) rising [L/min]; `changes`: `change_of` each rule in records (n, d), without a leak and with each size;
    `alike`: whether the scatter is the same at every size, so that all records tell it.
    """
    from scipy.interpolate import PchipInterpolator

    if not target.rules:
        return ()
    knots = np.concatenate([[0.0], sizes])
    mean = np.stack([own.mean(axis=0) for own in changes])
    scatter = np.stack([own.std(axis=0, ddof=1) for own in changes])
    if alike:
        scatter = np.tile(np.sqrt(np.mean(scatter**2, axis=0)), (len(changes), 1))
    fine = np.append(np.geomspace(sizes[0] / 100.0, sizes[-1], _FINE), STATED)
    predictions = []
    for k, rule in enumerate(target.rules):
        if not (np.isfinite(mean[:, k]).all() and (scatter[:, k] > 0.0).all()):
            predictions.append(RulePrediction(rule, None, None, None))
            continue
        shift = PchipInterpolator(knots, mean[:, k] - mean[0, k])(fine)
        spread = np.interp(fine, knots, scatter[:, k])
        pod = detection_of(shift, spread, float(scatter[0, k]), target.false_alarm, rule.endswith("changed"))
        enough = np.flatnonzero(pod[:-1] >= target.detection)
        smallest = float(fine[enough[0]]) if enough.size else None
        predictions.append(RulePrediction(rule, smallest, float(scatter[0, k]), float(pod[-1])))
    return tuple(predictions)
