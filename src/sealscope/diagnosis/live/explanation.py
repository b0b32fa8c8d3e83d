"""Explain an increase of the leakage of a running machine by a leak or by another event.

The e-detector (`sequential`) detects the increase at its rate of false alarms. The probability that a leak, a sensor or
the duty (motion and load) caused it is computed as for a recording, from the same observables and events.
`SignalWindow` stores the features of the last blocks for these tests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.diagnosis.decision.explanations import LEAK_EVENTS, explain, load_events, probability_of
from sealscope.diagnosis.estimate.interval import Interval
from sealscope.diagnosis.inference.changes.features import (
    SENSOR_FEATURES,
    duty_observables,
    log_amplitudes,
    run_tests,
    sensor_features,
    sensor_observables,
)
from sealscope.diagnosis.inference.changes.level_changes import (
    fit_pressure_levels,
    motion_speed,
    pattern_tests,
    pressure_level_rows,
    top_speed,
)
from sealscope.diagnosis.inference.machine_states import is_in_motion, time_in_motion
from sealscope.diagnosis.inference.observable import Observable
from sealscope.diagnosis.priors.changes import CHANGES
from sealscope.diagnosis.priors.decision import DECISION
from sealscope.diagnosis.priors.live import LIVE
from sealscope.diagnosis.verdict.evidence import Cause
from sealscope.recordings.recording import Array
from sealscope.storage.plain_state import SavedAttributes

#: Probabilities from which a leak (`leak`) and its cause (`named`) explain a rise.
_MIN_PROBABILITY = DECISION.explanation
#: Largest p-value of a change that the blocks show clearly enough.
_MAX_CHANCE: float = LIVE.explanation.rare
#: Cause of leaks to the outside. A part of their flow appears in the estimated leakage of pump and piston.
OUTSIDE: Cause = "external leak"
#: Events for which a watched machine raises an alarm.
ALARMING = (*LEAK_EVENTS, *(event.name for event in load_events() if event.cause == OUTSIDE))


class RiseExplanation(NamedTuple):
    """Explanation of an increase of the leakage."""

    is_leak: bool
    is_outside: bool = False  # True if oil leaks almost surely to the outside
    other_events: str = ""  # the events that explain the increase instead of a leak, in words


#: The blocks do not explain the rise yet.
UNKNOWN = RiseExplanation(is_leak=False)


def explain_rise(observables: Sequence[Observable], data: str, onset: Interval, is_settled: bool) -> RiseExplanation:
    """Find the cause of an increase of the leakage among the changes observed in the blocks around it.

    `observables` are results of tests for changes, and `onset` is the interval in which the increase began [s]. `data`
    is the kind of data from which the leakage is estimated, "volumes" or "response". Changes of this kind count only if
    they may have begun in the same interval. `is_settled` is True if enough blocks have followed to distinguish a leak
    to the outside from a sensor fault; until then, only a leak past piston or pump counts as a leak.

    The result is a leak if leaks are more probable than all other events together, else the most probable explanation
    without a leak, inside or outside. It is `UNKNOWN` if there is no such explanation, if no change of the kind `data`
    is significant (p-value below `_MAX_CHANCE`), or if a leak, although more probable, affects none of the significant
    changes.
    """
    leak_names = ALARMING if is_settled else LEAK_EVENTS
    leak_events = [event for event in load_events() if event.name in leak_names]
    at_onset = [observable for observable in observables if observable.data != data or _coincides(observable, onset)]
    significant_changes = [
        observable for observable in at_onset if observable.data == data and observable.chance < _MAX_CHANCE
    ]
    # only sets of events that explain a change of the leakage
    explanations = [explanation for explanation in explain(at_onset) if data in explanation.data]
    if probability_of(explanations, *leak_names) > _MIN_PROBABILITY.leak:
        if not any(event.changes(change, "moves") for event in leak_events for change in significant_changes):
            return UNKNOWN
        is_outside = probability_of(explanations, causes=[OUTSIDE]) > _MIN_PROBABILITY.named
        return RiseExplanation(is_leak=True, is_outside=is_outside)
    without_leak = [explanation for explanation in explanations if not explanation.has(ALARMING)]
    if not without_leak or not significant_changes:
        return UNKNOWN
    most_probable, *_ = without_leak  # sorted by probability
    other_events = " and ".join(event.description for event in most_probable.events)
    return RiseExplanation(is_leak=False, other_events=other_events)


def _coincides(observable: Observable, onset: Interval) -> bool:
    """Return True if the 95 % interval of a change's onset is known and overlaps the interval `onset` [s]."""
    change = observable.onset
    return change is not None and change.low <= onset.high and change.high >= onset.low


#: Number of blocks in the window.
WINDOW: int = LIVE.explanation.window
#: Smallest number of blocks that are tested for a step.
MIN_BLOCKS: int = CHANGES.levels.blocks[-1]
#: Features of a block.
DUTY = ("command", "motion")
FEATURES = (*DUTY, *SENSOR_FEATURES)
#: Columns of a stored block: begin and end [s], number of samples, top speed, fraction of its time in motion, features,
#: Gram matrix for the levels.
_BEGIN, _END, _SAMPLES, _SPEED, _MOVING = range(5)
_FEATURES = slice(_MOVING + 1, _MOVING + 1 + len(FEATURES))
_GRAM = slice(_FEATURES.stop, None)
#: Numbers of blocks in a group whose mean pressures are tested; the smallest possible number is used.
_GROUP_SIZES = (1, 2, 4)


class SignalWindow(SavedAttributes):
    """Features (duty, noise, mains hum, mean pressures) of the last blocks of a machine, and tests for changes."""

    SAVED = ("_rows", "_means")

    def __init__(self) -> None:
        self._rows = np.empty((0, 0))  # features of the last blocks, one block in a row
        self._means = np.empty(0)  # mean p_A and p_B in the first block [Pa], to which pressure levels are relative

    @np.errstate(all="ignore")
    def take(self, begin: float, channels: Mapping[str, Array], rate: float) -> None:
        """Store the features of a block that begins at `begin` [s], unless samples are missing; `rate` is in Hz."""
        if not all(np.isfinite(values).all() for values in channels.values()):
            return
        if not self._means.size:
            # subtracted from all blocks, against rounding
            self._means = np.array([channels["p_A"].mean(), channels["p_B"].mean()])
        speeds = motion_speed(channels, rate)  # None if no motion is recorded
        speed = 0.0 if speeds is None else top_speed(speeds)
        max_speed = max(speed, float(self._rows[:, _SPEED].max(initial=0.0)) if self._rows.size else 0.0)
        fraction_moving = 1.0 if speeds is None else float(time_in_motion(speeds[None], max_speed, rate)[0])
        # design matrix of the regression of the mean pressures on the motion
        design = pressure_level_rows(channels, rate, self._means, max_speed)
        single_block = {name: values[None] for name, values in channels.items()}  # arrays (1, n) of one block
        values = dict([*log_amplitudes(single_block), *sensor_features(single_block, rate)])
        features = [float(values[name][0]) if name in values else np.nan for name in FEATURES]
        n_samples, gram = len(channels["p_A"]), design.T @ design
        row = np.array([begin, begin + n_samples / rate, n_samples, speed, fraction_moving, *features, *gram.ravel()])
        # rows of another length are of other channels: they are dropped
        rows = self._rows if self._rows.shape[1:] == row.shape else np.empty((0, len(row)))
        self._rows = append_row(rows, row, WINDOW)

    @np.errstate(all="ignore")
    def observables(self, since: float) -> tuple[Observable, ...]:
        """Test the features for steps in the blocks that begin at `since` [s] or later, if these are enough.

        Duty (command and motion) and sensors (noise, hum, sense of p_A - p_B) are tested in the blocks in motion only,
        the mean pressures in all blocks.
        """
        rows = self._rows[self._rows[:, _BEGIN] >= since] if self._rows.size else self._rows
        if len(rows) < MIN_BLOCKS:
            return ()
        time = rows[:, [_BEGIN, _END]].mean(axis=1)
        is_moving = is_in_motion(rows[:, _MOVING])
        moving_time, columns = time[is_moving], zip(FEATURES, rows[is_moving, _FEATURES].T, strict=True)
        features = {name: values for name, values in columns if np.isfinite(values).any()}
        duty = {name: features.pop(name) for name in DUTY if name in features}
        return run_tests(  # if numbers overflow in one test, the other tests still run
            lambda: duty_observables(moving_time, duty),
            lambda: sensor_observables(moving_time, features),
            lambda: self._test_levels(rows, time),
        )

    def _test_levels(self, rows: Array, time: Array) -> tuple[Observable, ...]:
        """Test the mean pressures in each direction of motion for steps, in stored blocks with the centres `time` [s].

        The blocks are averaged in groups of the smallest size with which the machine moves in both directions in every
        group. Nothing is tested if that leaves fewer than `MIN_BLOCKS` groups.
        """
        n_columns = round((rows.shape[1] - _GRAM.start) ** 0.5)  # a row ends with a flattened square Gram matrix
        for size in _GROUP_SIZES:
            n_groups = len(rows) // size
            if n_groups < MIN_BLOCKS:
                break
            groups = rows[-n_groups * size :].reshape(n_groups, size, -1)
            gram = groups[:, :, _GRAM].sum(axis=1).reshape(n_groups, n_columns, n_columns)
            max_samples = float(groups[:, :, _SAMPLES].sum(axis=1).max())  # largest number in a group
            values = fit_pressure_levels(gram, max_samples, self._means)
            if values is not None:  # None if a group moves in one direction only
                return pattern_tests(time[-n_groups * size :].reshape(n_groups, size).mean(axis=1), values)
        return ()


def append_row(rows: NDArray[Any], row: NDArray[Any], most: int) -> NDArray[Any]:
    """Append the `row` of a block to the last `most` - 1 of the `rows`, of the same type and shape."""
    stored = rows[1 - most :]
    appended = np.empty((len(stored) + 1, *rows.shape[1:]), rows.dtype)
    appended[:-1], appended[-1] = stored, row
    return appended
