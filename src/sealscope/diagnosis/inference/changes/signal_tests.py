"""Observables that no volume balance contains and that a leak does not change.

They are the amplitudes of command and motion (duty), noise, hum, sign and levels of the pressures. Called for each
recording, whichever detector measures the leak.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress

import numpy as np

from sealscope.diagnosis.inference.changes.features import BLOCKS, ORDER, observe_duty, observe_sensors
from sealscope.diagnosis.inference.changes.level_changes import level_tests
from sealscope.diagnosis.inference.observable import Observable, Observed
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.recordings.recording import Recording, compute_once

SIGNALS = "signals"


def observe_signals(recording: Recording) -> Observed:
    """Test command, sensors and mean pressures of a recording for sudden lasting changes that no leak causes."""
    return compute_once(recording, (SIGNALS,), _test_signals)


@np.errstate(all="ignore")
def _test_signals(recording: Recording) -> Observed:
    """Test a recording's signals for changes (`observe_signals`); report only a reason if it is too short."""
    shortest = CHANGES.features.shortest  # length of a block [s]
    if len(recording) < BLOCKS * max(ORDER + 2, shortest * recording.rate):  # differences of `ORDER` need samples
        return Observed(SIGNALS, lack="too short to test its signals for changes")
    observables = run_tests(
        lambda: observe_duty(recording),
        lambda: observe_sensors(recording),
        lambda: level_tests(recording),
    )
    return Observed(SIGNALS, observables)


def run_tests(*tests: Callable[[], Iterable[Observable]]) -> tuple[Observable, ...]:
    """Collect what all `tests` yield; a test in which numbers overflow or a matrix is singular ends early."""
    observables: list[Observable] = []
    for test in tests:
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            observables += test()
    return tuple(observables)
