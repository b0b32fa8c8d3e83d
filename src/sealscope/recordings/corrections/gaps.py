"""Gaps in a recording: short ones are bridged and marked, so that what lies on both sides of them can be analysed.

A gap is a run of rows without a value of a needed channel, or rows that a logger has lost: its clock shows them
(`corrections.clock`), or both chamber pressures are zero (`remove_dropouts`, which a running machine's samples pass as
well). How it is bridged depends on its length: up to `SPLINE` samples by a cubic spline; where the duty repeats, by the
channel's own values whole cycles before or after, shifted evenly so that both ends meet; else by a straight line. What
is bridged is no reading: `Recording.bridged` marks it. The balance gives less weight to what a hole touches (`holes`);
other detectors leave out the blocks that are `touched`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import chambers_of
from sealscope.recordings.channels import Array
from sealscope.recordings.corrections.clock import NEAR
from sealscope.recordings.cycle import find_cycle
from sealscope.recordings.motion import runs_of
from sealscope.recordings.quality import flag_impossible, uniform_segments
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

Flags = NDArray[np.bool_]

#: Longest gaps that are bridged by a spline [samples] and by other cycles (share of the recording).
SPLINE, LONGEST_SHARE = 3, 0.1
_GAPS = priors_of("sealscope.recordings")["gaps"]
#: A block may hold this share of bridged samples: they move its sums by less than its own scatter.
MOST_BRIDGED = 0.01
#: Samples whose mean on either side of a gap sets the shift of another cycle.
_END = 8
#: Most that another cycle may differ from this one after the gap, as a share of the rms about the mean.
_UNLIKE = 0.4
#: Samples by which the cycle's length may be off.
_SLACK = 2


def remove_dropouts(recording: Recording) -> Recording:
    """Mark the samples of all channels as missing where both chamber pressures are exactly zero.

    A converter that is off writes zeros; two transducers with noise never read them at once. Returns the recording
    itself where there are none.
    """
    chambers = chambers_of(recording)
    if len(chambers) < 2:
        return recording
    lost = np.logical_not(recording["p_A"]) & np.logical_not(recording["p_B"])
    if not lost.any():
        return recording
    channels = {name: np.where(lost, np.nan, values) for name, values in recording.channels.items()}
    return replace(recording, channels=channels)


def remove_impossible(recording: Recording) -> Recording:
    """Mark samples beyond the range of any sensor as missing (`quality.flag_impossible`).

    Where a channel has many of them its unit is wrong: it stays. Returns the recording itself where there are none.
    """
    flags = {name: flag_impossible(values, recording.units[name]) for name, values in recording.channels.items()}
    wrong = {name: mask & (np.mean(mask) <= LONGEST_SHARE) for name, mask in flags.items() if len(mask)}
    if not any(mask.any() for mask in wrong.values()):
        return recording
    channels = {name: np.where(wrong[name], np.nan, values) for name, values in recording.channels.items()}
    return replace(recording, channels=channels)


def bridge(recording: Recording, needed: Sequence[str]) -> Recording:
    """Return the recording with gaps of the `needed` channels bridged but for those at its ends; the same without any.

    In bridged rows every other channel is bridged as well. Values that were recorded stay as they are. The clock is
    even (`corrections.clock.even_clock`).
    """
    known = np.all([np.isfinite(recording[name]) for name in needed], axis=0)
    if not len(recording) or known.all() or not known.any():
        return recording
    channels = {name: np.where(np.isfinite(values), values, np.nan) for name, values in recording.channels.items()}
    stretches = uniform_segments(recording, needed)
    longest = max(stretches, key=lambda stretch: stretch.stop - stretch.start, default=None)
    cycle = None if longest is None else find_cycle(recording.samples(longest).only(needed))
    bridged, by_spline, by_line = np.zeros((3, len(recording)), dtype=bool)
    for first, length in runs_of(~known).tolist():
        stop = first + length
        if first == 0 or stop == len(recording):
            continue
        bridged[first:stop] = True
        if length <= SPLINE:
            by_spline[first:stop] = True
            continue
        repeats = 0.0 if cycle is None or length > LONGEST_SHARE * len(recording) else cycle * recording.rate
        if not (repeats and _from_other_cycle(channels, needed, first, stop, repeats)):
            by_line[first:stop] = True
    for values in channels.values():
        _spline(values, by_spline)
        _line(values, by_line)
    if not bridged.any():
        return recording
    note = f"{np.count_nonzero(bridged)} samples in {len(runs_of(bridged))} gaps bridged"
    return replace(recording, channels=channels, bridged=bridged, history=(*recording.history, note))


def filled(recording: Recording, needed: Sequence[str]) -> Recording:
    """Return the recording with short gaps filled by a line where a channel is none of the `needed`; the same for none.

    Those of positions, angles, speeds and flows while a mass moves on evenly, as a slower sensor leaves between its
    samples; those of pressures up to `SPLINE` samples.
    """
    motion = _GAPS["motion"] * recording.rate
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
    """Flag the blocks (n,) between sample `bounds` (n + 1,) with a share of bridged samples above `MOST_BRIDGED`."""
    bounds = np.asarray(bounds)
    if recording.bridged is None:
        return np.zeros(max(bounds.size - 1, 0), dtype=bool)
    counts = np.diff(np.concatenate([[0], np.cumsum(recording.bridged)])[bounds])
    return np.asarray(counts > MOST_BRIDGED * np.diff(bounds))


def holes(recording: Recording) -> Flags:
    """Flag the rows (n,) in bridged gaps longer than a tenth of a test function."""
    flags = np.zeros(len(recording), dtype=bool)
    if recording.bridged is not None:
        seconds = max(_GAPS["hole"], NEAR / recording.rate)
        for first, length in runs_of(recording.bridged).tolist():
            flags[first : first + length] = length + 1 > seconds * recording.rate
    return flags


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
    """Compute the relative rms difference of the duty beside a gap from that `shift` samples away; inf for unknown."""
    count = next(iter(channels.values())).size
    window = slice(max(first - half, -shift, 0), min(stop + half, count - shift, count))
    if window.start > first - _END or window.stop < stop + _END:
        return math.inf
    if not all(np.isfinite(channels[name][first + shift : stop + shift]).all() for name in needed):
        return math.inf
    signals = [channels[name] for name in (("u",) if "u" in needed else chambers_of(needed))]
    signal = signals[0] - signals[1] if len(signals) == 2 else signals[0]
    here, there = signal[window], signal[window.start + shift : window.stop + shift]
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
    target = values[first:stop]
    target[np.isnan(target)] = other[np.isnan(target)]


def _line(values: Array, rows: Flags) -> None:
    """Set the missing values of these rows to straight lines between the known ones."""
    known = np.flatnonzero(np.isfinite(values))
    missing = np.flatnonzero(rows & np.isnan(values))
    if missing.size and known.size:
        missing = missing[(missing > known[0]) & (missing < known[-1])]
        values[missing] = np.interp(missing, known, values[known])


def _spline(values: Array, rows: Flags) -> None:
    """Set the missing values of these rows to a cubic spline through all others."""
    from scipy.interpolate import CubicSpline

    known = np.flatnonzero(np.isfinite(values))
    missing = np.flatnonzero(rows & np.isnan(values))
    if missing.size and known.size > _END:
        values[missing] = CubicSpline(known, values[known])(missing)
