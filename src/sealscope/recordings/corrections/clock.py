"""An even clock for samples whose times step back, or that were polled at uneven times.

The diagnosis integrates over an even clock. Uneven samples are interpolated linearly to the recording's rate;
integrated, that is about the trapezoidal rule over the recorded times. Between samples that are far apart, values are
missing; `corrections.gaps` bridges and marks them. Called by the inspection.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.paragraphs import format_count
from sealscope.recordings.channels import SLOW, Array
from sealscope.recordings.formats.times.row_order import COUNTERS, order_rows
from sealscope.recordings.formats.times.timebase import interpolate_samples
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.recordings.stretches import summarize_intervals

_PRIORS = RECORDINGS.clock
#: Longest interval that is interpolated, in median intervals.
MAX_INTERVAL: float = _PRIORS.near


class OrderedRecording(NamedTuple):
    """A recording whose times do not step back."""

    recording: Recording
    findings: tuple[Finding, ...]
    n_before: int = 0  # number of rows left out before the first row
    n_after: int = 0  # number of rows left out after the last row


def order_recording(recording: Recording) -> OrderedRecording:
    """Bring the rows of a recording into the order of time (`row_order.order_rows`).

    Where no order is found, all rows are left out but the longest run of rows whose times do not step back.
    """
    ordered = order_rows(recording.t, list(recording.channels.values()), COUNTERS)
    if ordered.events:
        order = np.arange(len(recording)) if ordered.rows is None else ordered.rows
        channels = {name: values[order] for name, values in recording.channels.items()}
        recording = replace(recording, t=ordered.t, channels=channels)
    findings = [
        Finding(event.code, event.severity, None, event.number, float(ordered.t[event.row]), f"time {event.text}")
        for event in ordered.events
    ]
    if summarize_intervals(recording.t).shortest >= 0.0:
        return OrderedRecording(recording, tuple(findings))
    timed = np.flatnonzero(np.isfinite(recording.t))
    starts = np.flatnonzero(np.diff(recording.t[timed]) < 0.0) + 1
    if not starts.size:
        return OrderedRecording(recording, tuple(findings))
    run = max(np.split(timed, starts), key=len)
    n_left_out = len(recording) - run.size
    text = f"time steps back {format_count(starts.size, 'time')} and shows no order: "
    text += f"{format_count(n_left_out, 'row')} of {len(recording)} left out"
    first = float(recording.t[timed[starts[0]]])
    findings.append(Finding("rows_left_out", "warning", None, n_left_out, first, text))
    rows = slice(int(run[0]), int(run[-1]) + 1)
    return OrderedRecording(recording.samples(rows), tuple(findings), rows.start, len(recording) - rows.stop)


def resample_evenly(recording: Recording) -> Recording:
    """Resample a recording to evenly spaced times, with NaN in rows that the logger has lost.

    Rows without a time, or not later than all rows before, are dropped (`order_recording` comes first). If long breaks
    divide the recording, only its longest stretch is used. If the intervals are then whole numbers of sampling steps,
    to within `clock.scatter` of `priors.toml` (rms), rows of NaN are inserted for lost samples; else the samples are
    interpolated linearly. A recording that needs none of this is returned as it is.
    """
    intervals = summarize_intervals(recording.t)
    steps = np.array([intervals.shortest, intervals.longest]) * recording.rate
    if intervals.number and np.abs(steps - 1.0).max() <= _PRIORS.scatter:
        return recording
    timed = np.flatnonzero(np.isfinite(recording.t))
    latest_time = np.maximum.accumulate(recording.t[timed])
    rows = timed[np.diff(latest_time, prepend=-np.inf) > 0.0]
    rows = rows[_longest_dense_stretch(recording.t[rows], recording.rate)]
    if rows.size < 2:  # too few for a clock
        return recording.samples(slice(rows[0], rows[0] + 1) if rows.size else slice(0))
    t = recording.t[rows]
    steps = np.diff(t) * recording.rate
    n_steps = np.round(steps)
    if np.sqrt(np.mean((steps - n_steps) ** 2)) <= _PRIORS.scatter and n_steps.min() >= 1.0:
        if rows.size == len(recording) and n_steps.max() == 1.0:
            return recording
        return _insert_lost_rows(recording, rows, n_steps.astype(np.int64))
    return _interpolate_rows(recording, rows)


def _longest_dense_stretch(t: Array, rate: float) -> slice:
    """Find the longest stretch of rows that lacks at most the fraction `clock.lost` (`priors.toml`) of the samples.

    `t` (n,): increasing times [s]; `rate` [Hz]: number of samples that a complete recording has per second.
    """
    # surplus of a row: number of rows before it, less the number that a dense stretch must have up to its time. A
    # stretch is dense enough if the surplus of its last row is not below that of its first row
    first_time = t[:1].sum()  # 0 if there are no rows
    surplus = np.arange(t.size) - (1.0 - _PRIORS.lost) * rate * (t - first_time)
    max_later_surplus = np.maximum.accumulate(surplus[::-1])[::-1]
    # for each first row, the last row whose surplus is not below its own (minus: `searchsorted` needs rising values)
    last = np.searchsorted(-max_later_surplus, -surplus, side="right") - 1
    first = int(np.argmax(last - np.arange(t.size))) if t.size else 0
    return slice(first, int(last[first]) + 1 if t.size else 0)


def _insert_lost_rows(recording: Recording, rows: NDArray[np.intp], steps: NDArray[np.int64]) -> Recording:
    """Insert rows of NaN for the samples that were lost between recorded ones.

    `rows` (k,): indices of the recorded rows; `steps` (k - 1,): number of sampling steps from each of them to the next.
    """
    row_index = np.concatenate([[0], np.cumsum(steps)])
    n = int(row_index[-1]) + 1
    channels = {name: np.full(n, np.nan) for name in recording.channels}
    for name, values in channels.items():
        values[row_index] = recording[name][rows]
    return replace(recording, t=np.interp(np.arange(n), row_index, recording.t[rows]), channels=channels)


def _interpolate_rows(recording: Recording, rows: NDArray[np.intp]) -> Recording:
    """Interpolate the rows with the indices `rows` linearly to evenly spaced times at the sampling rate.

    A channel, unless it is slow, is NaN between known samples over `MAX_INTERVAL` of its median intervals apart.
    """
    t = recording.t[rows]
    even_times = t[0] + np.arange(int((t[-1] - t[0]) * recording.rate) + 1) / recording.rate
    channels = {}
    for name, values in recording.channels.items():
        known = np.isfinite(values[rows])
        max_interval = np.inf if name in SLOW else MAX_INTERVAL
        channels[name] = interpolate_samples(even_times, t[known], values[rows][known], max_interval)
    note = f"uneven sampling brought to {recording.rate:g} Hz by straight lines"
    return replace(recording, t=even_times, channels=channels, history=(*recording.history, note))
