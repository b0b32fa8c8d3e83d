"""The observer with leak-free recordings beside the one that is judged: levels of the conductance are compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.baseline.level import DayToDay, Level, against_baseline, incomparable
from sealscope.diagnosis.observer.evidence import ConductanceSeries, course, misfit, no_flow, states_flow, within
from sealscope.diagnosis.observer.model import G_UNIT
from sealscope.diagnosis.observer.stream import Formulation, formulation_of
from sealscope.diagnosis.verdict.evidence import Evidence, without_flow
from sealscope.recordings.recording import Recording
from sealscope.units import LITRE_PER_MINUTE

if TYPE_CHECKING:
    from sealscope.diagnosis.changepoint.random_walk import WalkStep
    from sealscope.parameters import Rig

#: From day to day the level differs by this share of the pump's own leakage (two kelvin of oil, and its drift within a
#: recording) and, by the ringing, by so many `G_UNIT` (what friction and stiffness seem to change), known as from five
#: recordings.
_SHARE, _BY_RINGING, _FREEDOM = 0.1, 0.6, 4.0


def compare(
    series: ConductanceSeries,
    baseline: Sequence[Recording],
    follow: Callable[[Recording], ConductanceSeries],
    step: WalkStep,
    probability: float,
    rig: Rig,
) -> Evidence:
    """Return the evidence from the step within the recording and from its mean conductance against the baseline's.

    A baseline recording can be compared where it has the same formulation, and where the model describes it.
    """
    states = states_flow(series.formulation, rig)
    inner = within(series, step, states_flow=states)
    levels: list[Level] = []
    reasons: list[str] = []
    for other in baseline:
        reason: str | None = "its channels are not the same"
        if formulation_of(other) == series.formulation:
            followed = follow(other)
            reason = misfit(followed.estimates, followed.formulation, rig) if followed.G.size else "it is too short"
            if reason is None:
                levels.append(level(followed))
        if reason is not None:
            reasons.append(reason)
    if not levels:
        return incomparable(inner, reasons[0])
    expected = float(np.mean([known.value for known in levels]))
    evidence = against_baseline(
        inner,
        level(series),
        levels,
        day_to_day(series.formulation, levels),
        probability,
        part="conductance against the baseline",
        flows=(G_UNIT * float(np.mean(series.dp)) / LITRE_PER_MINUTE,) if states else (),
        cause="piston or pump leak",
        course=course(series, step, expected),
    )
    from_level = evidence.verdict == "leak" and inner.verdict != "leak"
    return without_flow(evidence, no_flow(series.formulation)) if from_level and not states else evidence


def day_to_day(formulation: Formulation, baseline: Sequence[Level]) -> DayToDay:
    """Return the prior on the scatter of the level from day to day, in `G_UNIT`."""
    usual = abs(float(np.mean([known.value for known in baseline])))
    return DayToDay(_SHARE * usual if formulation == "volume" else _BY_RINGING, _FREEDOM)


def level(series: ConductanceSeries) -> Level:
    """Return the mean conductance of a recording, in `G_UNIT`; the scatter of the blocks is its error."""
    scatter = float(np.std(series.G, ddof=1)) if series.G.size > 1 else float(series.sd.mean())
    return Level(float(np.mean(series.G)), scatter / float(np.sqrt(series.G.size)))
