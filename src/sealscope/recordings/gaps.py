"""Gaps in a recording: short ones are bridged and marked, so that what lies on both sides of them can be analysed.

A gap is a run of rows without a value of a needed channel, or rows that a logger has lost (its time stamps show them).
How it is bridged depends on its length: up to `SPLINE` samples by a cubic spline; where the duty repeats, by the
channel's own values whole cycles before or after, shifted evenly so that both ends meet; up to `LINE_SECONDS` by a
straight line. A longer gap stays. What is bridged is no reading: `Recording.bridged` marks it, and a detector leaves
out the blocks that are `touched`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.channels import Array
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import runs_of
from sealscope.recordings.quality import even_steps, flag_impossible, uniform_segments
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

Flags = NDArray[np.bool_]

#: Longest gaps that are bridged: by a spline [samples], by a line [s], by other cycles (share of the recording); and
#: largest share of a recording that all gaps together may be.
SPLINE, LINE_SECONDS, LONGEST_SHARE = 3, 0.02, 0.1
#: A block may hold this share of bridged samples: they move its sums by less than its own scatter.
MOST_BRIDGED = 0.01
#: Samples whose mean on either side of a gap sets the shift of another cycle.
_END = 8
#: Most that another cycle may differ from this one after the gap, as a share of the rms about the mean.
_UNLIKE = 0.4
#: Samples by which the cycle's length may be off.
_SLACK = 2


def remove_impossible(recording: Recording) -> Recording:
    """Mark samples as missing that are beyond what any sensor reads (`quality.flag_impossible`).

    Where a channel has many of them its unit is wrong: it stays. Returns the recording itself where there are none.
    """
    flags = {name: flag_impossible(values, recording.units[name]) for name, values in recording.channels.items()}
    wrong = {name: own & (np.mean(own) <= LONGEST_SHARE) for name, own in flags.items() if len(own)}
    if not any(own.any() for own in wrong.values()):
        return recording
    channels = {name: np.where(wrong[name], np.nan, values) for name, values in recording.channels.items()}
    return replace(recording, channels=channels)


def bridge(recording: Recording, needed: Sequence[str]) -> Recording:
    """Return the recording with gaps of the `needed` channels bridged where they can be; the same where none is.

    Rows that were lost come back; in bridged rows every other channel is bridged as well. Values that were recorded
    stay as they are.
    """
    whole = _with_lost_rows(recording)
    known = np.all([np.isfinite(whole[name]) for name in needed], axis=0)
    if not len(whole) or known.all() or not known.any():
        return recording
    joined = even_steps(whole)
    channels = {name: np.where(np.isfinite(values), values, np.nan) for name, values in whole.channels.items()}
    stretches = uniform_segments(whole, needed)
    longest = max(stretches, key=lambda stretch: stretch.stop - stretch.start, default=None)
    cycle = None if longest is None else find_cycle(whole.samples(longest).only(needed))
    bridged, by_spline = np.zeros(len(whole), dtype=bool), np.zeros(len(whole), dtype=bool)
    for first, length in runs_of(~known).tolist():
        stop = first + length
        if first == 0 or stop == len(whole) or not joined[first - 1 : stop].all():
            continue
        if length <= SPLINE:
            by_spline[first:stop] = True
        elif length > LONGEST_SHARE * len(whole):
            continue
        elif cycle is not None and _from_other_cycle(channels, needed, first, stop, cycle * whole.rate):
            bridged[first:stop] = True
        elif length <= LINE_SECONDS * whole.rate:
            for values in channels.values():
                _line(values, first, stop)
            bridged[first:stop] = True
    if by_spline.any():
        for values in channels.values():
            _spline(values, by_spline)
    bridged |= by_spline
    if not bridged.any() or np.mean(bridged) > LONGEST_SHARE:
        return recording
    note = f"{np.count_nonzero(bridged)} samples in {len(runs_of(bridged))} gaps bridged"
    return replace(whole, channels=channels, bridged=bridged, history=(*whole.history, note))


def filled(recording: Recording, needed: Sequence[str]) -> Recording:
    """Return the recording with short gaps filled by a line where a channel is none of the `needed`; the same for none.

    Those of positions, angles, speeds and flows while a mass moves on evenly, as a slower sensor leaves between its
    samples; those of pressures up to `SPLINE` samples.
    """
    motion = priors_of("sealscope.recordings")["gaps"]["motion"] * recording.rate
    channels: dict[str, Array] = {}
    for name, values in recording.channels.items():
        missing = ~np.isfinite(values)
        if name in needed or not missing.any() or missing.all():
            continue
        most = SPLINE if name.startswith("p_") else motion
        short = np.zeros(len(values), dtype=bool)
        for first, length in runs_of(missing).tolist():
            short[first : first + length] = first > 0 and first + length < len(values) and length <= most
        channels[name] = values.copy()
        channels[name][short] = np.interp(np.flatnonzero(short), np.flatnonzero(~missing), values[~missing])
    return replace(recording, channels={**recording.channels, **channels}) if channels else recording


def touched(recording: Recording, bounds: Array | NDArray[np.integer]) -> Flags:
    """Return which blocks between sample `bounds` (n + 1,) hold more bridged samples than `MOST_BRIDGED`, (n,)."""
    bounds = np.asarray(bounds)
    if recording.bridged is None:
        return np.zeros(max(bounds.size - 1, 0), dtype=bool)
    counts = np.diff(np.concatenate([[0], np.cumsum(recording.bridged)])[bounds])
    return np.asarray(counts > MOST_BRIDGED * np.diff(bounds))


def long_gaps(recording: Recording) -> Flags:
    """Return which rows (n,) lie in bridged gaps of more than `SPLINE` samples; a spline errs by no more than noise."""
    flags = np.zeros(len(recording), dtype=bool)
    if recording.bridged is not None:
        for first, length in runs_of(recording.bridged).tolist():
            flags[first : first + length] = length > SPLINE
    return flags


def _with_lost_rows(recording: Recording) -> Recording:
    """Return the recording without untimed rows, with rows of NaN where the time stamps show that some were lost."""
    if not np.isfinite(recording.t).all():
        recording = recording.between(-math.inf, math.inf)
    steps = np.round(np.diff(recording.t) * recording.rate)
    lost = np.where((steps > 1) & (steps <= LONGEST_SHARE * len(recording)), steps - 1, 0).astype(np.int64)
    if not lost.any():
        return recording
    at = np.arange(len(recording)) + np.concatenate([[0], np.cumsum(lost)])
    count = int(at[-1]) + 1
    t = np.interp(np.arange(count), at, recording.t)
    channels = {}
    for name, values in recording.channels.items():
        channels[name] = np.full(count, np.nan)
        channels[name][at] = values
    return replace(recording, t=t, channels=channels)


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _from_other_cycle(channels: dict[str, Array], needed: Sequence[str], first: int, stop: int, cycle: float) -> bool:
    """Bridge a gap of all channels by the nearest cycle in which the duty beside it repeats, to within `_SLACK`."""
    half = round(0.5 * cycle)
    least = math.ceil((stop - first + half) / cycle)
    for shift in (sign * round(times * cycle) for times in (least, least + 1) for sign in (-1, 1)):
        near = range(shift - _SLACK, shift + _SLACK + 1)
        unlike = [_unlike(channels, needed, first, stop, other, half) for other in near]
        best = int(np.argmin(unlike))
        if unlike[best] <= _UNLIKE:
            for values in channels.values():
                _copy(values, first, stop, near[best])
            return True
    return False


def _unlike(channels: dict[str, Array], needed: Sequence[str], first: int, stop: int, shift: int, half: int) -> float:
    """Return by what share of its rms the duty beside a gap differs from that `shift` samples away; inf for unknown."""
    count = next(iter(channels.values())).size
    own = slice(max(first - half, -shift, 0), min(stop + half, count - shift, count))
    if own.start > first - _END or own.stop < stop + _END:
        return math.inf
    if not all(np.isfinite(channels[name][first + shift : stop + shift]).all() for name in needed):
        return math.inf
    signals = [channels[name] for name in (("u",) if "u" in needed else chambers_of(needed))]
    signal = signals[0] - signals[1] if len(signals) == 2 else signals[0]
    here, there = signal[own], signal[own.start + shift : own.stop + shift]
    known = np.isfinite(here) & np.isfinite(there)
    if np.count_nonzero(known) < _END:
        return math.inf
    here, there = here[known] - here[known].mean(), there[known] - there[known].mean()
    return float(np.sqrt(np.mean((here - there) ** 2))) / max(float(np.std(there)), np.finfo(float).tiny)


def _copy(values: Array, first: int, stop: int, shift: int) -> None:
    """Set missing values from `first` to `stop` to those `shift` samples away, shifted so that both ends meet."""
    ends = (slice(first - _END, first), slice(stop, stop + _END))
    before, after = (_mean(values[end]) - _mean(values[end.start + shift : end.stop + shift]) for end in ends)
    other = values[first + shift : stop + shift] + np.linspace(before, after, stop - first)
    own = values[first:stop]
    own[np.isnan(own)] = other[np.isnan(own)]


def _line(values: Array, first: int, stop: int) -> None:
    own = values[first - 1 : stop + 1]
    known = np.isfinite(own)
    if known[0] and known[-1]:
        own[~known] = np.interp(np.flatnonzero(~known), np.flatnonzero(known), own[known])


def _spline(values: Array, rows: Flags) -> None:
    """Set the missing values of these rows to a cubic spline through all others."""
    from scipy.interpolate import CubicSpline

    known = np.flatnonzero(np.isfinite(values))
    missing = np.flatnonzero(rows & np.isnan(values))
    if missing.size and known.size > _END:
        values[missing] = CubicSpline(known, values[known])(missing)
