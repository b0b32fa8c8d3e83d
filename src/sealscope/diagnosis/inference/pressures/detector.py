"""Leakage from both chamber pressures and the command, without a position: the whole response, as observables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.onset import step_tests
from sealscope.diagnosis.inference.pressures import response
from sealscope.diagnosis.inference.pressures.evidence import PressureEvidence, unusable
from sealscope.diagnosis.inference.pressures.leak import ResponseLeak
from sealscope.diagnosis.learnt import Healthy, Lesson, lessons_of
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Name of the data that these observables describe.
RESPONSE = "response"


class PressureResponse:
    """Leakage from both chamber pressures and the command, by how p_A - p_B responds to the command."""

    name = "pressure response"

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return None where the recording has what the response needs, else the reason why not."""
        return unusable(recording, self.rig)

    def reading(self, recording: Recording) -> PressureEvidence | None:
        """Estimate the conductance in a recording; None where the recording says nothing of it."""
        return response.evidence(recording, self.rig)

    def learn(self, recording: Recording) -> Lesson | None:
        """Return the lesson of a healthy recording: the level of the conductance."""
        reading = self.reading(recording)
        return None if reading is None else {"level": reading.level[0]}

    def observe(self, recording: Recording, baseline: Sequence[Healthy] = ()) -> Observed:
        """Return the steps of the response's parameters, and the leak against healthy recordings."""
        reading = self.reading(recording)
        if reading is None:
            return Observed(self.name, lack="no response to the command that a pump-driven piston would give")
        levels = [lesson["level"] for lesson in lessons_of(self, baseline)]
        share = 1.0 if recording.bridged is None else float(np.mean(~recording.bridged))
        leak = ResponseLeak(self.name, reading, levels)
        if leak.step is None and leak.rise is None:
            return Observed(self.name, lack="too little moves: no leak would show")
        return Observed(self.name, response_observables(reading), leak, share=share)


def response_observables(reading: PressureEvidence) -> tuple[Observable, ...]:
    """Test the response's parameters for a step, up or down; the conductance only grows."""
    if reading.test is None:
        return ()
    observables = [Observable.of_test("G", RESPONSE, reading.test)]
    for name, information in reading.others.items():
        steps = step_tests(information, (1.0, -1.0))
        if steps:
            best = max(range(len(steps)), key=lambda k: steps[k].score)
            sign = (1.0, -1.0)[best]
            observables.append(Observable.of_test(name, RESPONSE, steps[best], looks=2.0, sign=sign))
    return tuple(sorted(observables, key=lambda observable: -observable.score))
