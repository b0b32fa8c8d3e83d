"""Leak detector that needs only both chamber pressures and the command, by the response of the pressures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from sealscope.diagnosis.estimate.change import Information, step_tests
from sealscope.diagnosis.healthy import Healthy, healthy_summaries
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.inference.pressures.leak import ResponseLeak
from sealscope.diagnosis.inference.pressures.response import measure_leak
from sealscope.diagnosis.inference.pressures.samples import ResponseSummary, find_unmet_requirement
from sealscope.diagnosis.verdict.evidence import PRESSURE_RESPONSE
from sealscope.recordings.recording import Recording

if TYPE_CHECKING:
    from sealscope.parameters import Rig

#: Name of the data that these observables describe.
RESPONSE = "response"


class PressureResponse:
    """Leak detector for recordings without a position: it fits the response of p_A - p_B to the command u."""

    name, summary_type = PRESSURE_RESPONSE, ResponseSummary

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def usable(self, recording: Recording) -> str | None:
        """Return the reason why this detector cannot use a recording; None means that it can."""
        return find_unmet_requirement(recording, self.rig)

    def reading(self, recording: Recording) -> ResponseLeak | None:
        """Measure the leakage of a recording by the response of its pressures; None if that fails."""
        return measure_leak(recording, self.rig)

    def learn(self, recording: Recording) -> ResponseSummary | None:
        """Summarise a healthy recording by what it tells of the machine; None if its response cannot be fitted."""
        leak = measure_leak(recording, self.rig, is_healthy=True)
        return None if leak is None else leak.conditions

    def observe(self, recording: Recording, baseline: Sequence[Healthy] = ()) -> Observed:
        """Test each parameter of a recording's pressure response for a step, measure the leakage, and report both.

        The leakage is compared with that of the healthy recordings in `baseline`. If it cannot be measured or a leak
        would not show, the report states only the reason (`lack`).
        """
        leak = measure_leak(recording, self.rig, healthy_summaries(self, baseline))
        if leak is None:
            return Observed(
                self.name, lack="the pressures do not respond to the command as those of a pump-driven piston do"
            )
        if leak.step is None and leak.rise is None:
            return Observed(self.name, lack="too little motion: no leak would show")
        is_known = np.ones(len(recording), bool) if recording.bridged is None else ~recording.bridged
        judged_until = (np.flatnonzero(is_known)[-1] + 1.0) / len(is_known) if is_known.any() else 0.0
        observables = score_response_steps(leak.parameters)
        return Observed(self.name, observables, leak, share=float(is_known.mean()), judged_until=float(judged_until))


def score_response_steps(information: Mapping[str, Information]) -> tuple[Observable, ...]:
    """Test each parameter of the pressure response for a step, a sudden lasting change, up or down.

    `information`: likelihood of each parameter, by its name. The conductance "G" is tested for a step up only, since
    leaks do not heal. The highest score comes first; parameters that cannot be tested are left out.
    """
    observables = []
    for name, likelihood in information.items():
        signs = (1.0,) if name == "G" else (1.0, -1.0)
        tests = step_tests(likelihood, signs)
        if tests:
            test = max(tests, key=lambda test: test.score)
            observables.append(Observable.from_test(name, RESPONSE, test, n_tests=float(len(signs))))
    return tuple(sorted(observables, key=lambda observable: -observable.score))
