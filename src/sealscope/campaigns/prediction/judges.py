"""What the detectors that judge will find: each looks at leak-free records, and says which step it would have found.

Unlike the thesis's detectors they look for the onset themselves, know the rig, and state L/min. The records hold the
instruments' own noise and no drift of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from sealscope.diagnosis.baseline.inspection import inspected
from sealscope.diagnosis.inference.detector import VolumeBalance
from sealscope.diagnosis.inference.pressures.detector import PressureResponse
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment

#: Leak-free records that each detector looks at.
RECORDS = 3
#: Judge -> channels that it looks at.
_CHANNELS = {"volume balance": ("theta", "x", "p_A", "p_B", "p_1", "p_2"), "pressure response": ("u", "p_A", "p_B")}


@dataclass(frozen=True)
class JudgePrediction:
    """The smallest step of the leak that a judging detector finds.

    Parameters
    ----------
    detector : str
    channels : tuple of str
        Those that it looks at.
    smallest : float or None
        Smallest step that it finds in every one of the records [L/min]; None where it finds none.
    reason : str
        Why there is none, "" where there is.
    """

    detector: str
    channels: tuple[str, ...]
    smallest: float | None
    reason: str = ""


def judge_predictions(
    experiment: Experiment,
    false_alarm: float,
    detection: float,
    seed: int,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[JudgePrediction, ...]:
    """Return what both judges find in a leak-free `experiment` with `RECORDS` seeds from `seed`.

    Each states the deviation s of a step at the median onset, and finds ``(sqrt(threshold) + z) s``, z that of 90 %.
    The largest of the records is taken.
    """
    from sealscope.diagnosis.diagnose import check_probability
    from sealscope.simulation.simulate import simulate_with_truth

    try:
        check_probability(false_alarm)
    except InputError as error:
        return tuple(JudgePrediction(name, channels, None, str(error)) for name, channels in _CHANNELS.items())
    records = []
    for number in range(RECORDS):
        made = simulate_with_truth(replace(experiment, seed=seed + number)).recording
        records.append(inspected(made).part)
        progress((number + 1) / (2 * RECORDS))

    def findable(detector: VolumeBalance | PressureResponse, record: Recording) -> float | str:
        if (missing := detector.usable(record)) is not None:
            return missing
        evidence = detector.examine(record, [], false_alarm)
        step = None if evidence.passage is None else evidence.passage.findable_lpm
        return evidence.reason if step is None else step

    predictions = []
    for detector in (VolumeBalance(experiment.rig), PressureResponse(experiment.rig)):
        name, steps = detector.name, [findable(detector, record) for record in records]
        refusals = [step for step in steps if isinstance(step, str)]
        sizes = [step for step in steps if not isinstance(step, str)]
        worst = max(sizes, default=math.inf)
        known = not refusals and math.isfinite(worst)
        reason = refusals[0] if refusals else "" if known else "no step is found"
        predictions.append(JudgePrediction(name, _CHANNELS[name], worst if known else None, reason))
        progress(0.5 + 0.5 * len(predictions) / len(_CHANNELS))
    return tuple(predictions)
