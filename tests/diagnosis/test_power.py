"""Power grows with the leak: the score of a larger leak is not below that of a smaller one on the same machine."""

from __future__ import annotations

import pytest

from sealscope.diagnosis.detectors.registry import detectors
from sealscope.diagnosis.diagnose import Examination
from sealscope.recordings.recording import Recording
from sealscope.simulation.experiment import Experiment
from sealscope.simulation.simulate import simulate_experiment

#: The larger sizes need a duty whose pump delivers as much; in that one the details hardly show a leak.
FAST, SLOW = "3 sin(4t)", "8 sin(t)"
SIZES = {FAST: (0.0005, 0.0042, 0.02, 0.1, 0.2, 0.4), SLOW: (0.0005, 0.0042, 0.02, 0.1, 0.4, 1.0)}
DUTY = {"volume balance": SLOW, "pressure response": SLOW}
#: A score may be below the highest of all smaller leaks by this share: noise, and the saturation of a likelihood ratio.
TOLERANCE = 0.2
THROTTLES = {"line.orifices": "present", "line.closed_A": "50[%]", "line.closed_B": "50[%]"}


def leaking(lpm: float, command: str) -> Recording:
    leak = f"{lpm} L/min from 30 s"
    experiment = Experiment.of(command=command, duration=60.0, leak=leak, set=THROTTLES, seed=3)
    return simulate_experiment(experiment).recording


#: Marks of a detector's turn, where it is not just slow.
MARKS = {"pressure response": (pytest.mark.slow, pytest.mark.long)}


@pytest.mark.parametrize(
    "detector", [pytest.param(name, marks=MARKS.get(name, pytest.mark.slow)) for name in detectors()]
)
def test_score_does_not_fall_as_the_leak_grows(detector: str) -> None:
    command = DUTY.get(detector, FAST)
    highest, threshold_passed = 0.0, False
    for lpm in SIZES[command]:
        evidence = Examination(leaking(lpm, command), false_alarm_probability=0.01).evidence(detector)
        assert evidence.score is not None
        assert evidence.score >= (1.0 - TOLERANCE) * highest
        assert evidence.alarmed or not threshold_passed
        highest, threshold_passed = max(highest, evidence.score), threshold_passed or evidence.alarmed
    assert threshold_passed
