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
from sealscope.diagnosis.pressure_model.detector import PressureModel
from sealscope.errors import InputError
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment

#: Leak-free records that each detector looks at.
RECORDS = 3
#: Judge -> channels that it looks at.
_CHANNELS = {"volume balance": ("theta", "x", "p_A", "p_B", "p_1", "p_2"), "pressure model": ("u", "p_A", "p_B")}


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
    """Return what volume balance and pressure model find in a leak-free `experiment` with `RECORDS` seeds from `seed`.

    The volume balance has steps of rising size added to its blocks, at three places of the middle; a step counts where
    it and every larger one is found at all of them. The pressure model states the deviation s of a step in the middle,
    and finds ``(threshold + z_detection) s``. The largest of the records is taken.
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
    balance, model = VolumeBalance(experiment.rig), PressureModel(experiment.rig)

    def by_balance(record: Recording) -> float | str:
        if (missing := balance.usable(record)) is not None:
            return missing
        evidence = balance.examine(record, [], false_alarm)
        step = None if evidence.passage is None else evidence.passage.findable_lpm
        return evidence.reason if step is None else step

    def by_model(record: Recording) -> float | str:
        missing = model.usable(record)
        return missing if missing is not None else model.findable(record, false_alarm, detection)

    predictions = []
    for name, find in (("volume balance", by_balance), ("pressure model", by_model)):
        steps = [find(record) for record in records]
        refusals = [step for step in steps if isinstance(step, str)]
        sizes = [step for step in steps if not isinstance(step, str)]
        worst = max(sizes, default=math.inf)
        known = not refusals and math.isfinite(worst)
        reason = refusals[0] if refusals else "" if known else "no step is found"
        predictions.append(JudgePrediction(name, _CHANNELS[name], worst if known else None, reason))
        progress(0.5 + 0.5 * len(predictions) / len(_CHANNELS))
    return tuple(predictions)
