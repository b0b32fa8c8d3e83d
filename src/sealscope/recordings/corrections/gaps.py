"""An even clock for samples that were lost, step back or came unevenly, and gaps, which are bridged and marked.

The diagnosis integrates over an even clock. Uneven samples are interpolated linearly to the recording's rate;
integrated, that is about the trapezoidal rule over the recorded times. Between samples that are far apart, values are
missing: a gap. Called by the inspection.

A gap is a run of rows in which a needed channel has no value. The logger may have lost these rows, as the clock shows
(`resample_evenly`), or may have written zeros for both chamber pressures (`remove_dropouts`). Up to `SPLINE` samples
are bridged by a cubic spline. A longer gap is bridged by the channel's values whole duty cycles before or after, with
an offset so that both ends meet, or by a straight line if the motion does not repeat. `Recording.bridged` marks these
rows, as they are not readings. The flow balance gives less weight to blocks of samples with long gaps (`flag_holes`);
other detectors omit the blocks that `flag_bridged` marks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.paragraphs import format_count
from sealscope.recordings.channels import SLOW, Array, chambers_of, largest_steps, summarize_intervals, take_finite
from sealscope.recordings.formats.times.row_order import COUNTERS, order_rows
from sealscope.recordings.formats.times.timebase import interpolate_samples
from sealscope.recordings.motion import duty_signal, find_cycle, find_runs
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding, flag_impossible, uniform_segments
from sealscope.recordings.recording import Recording
from sealscope.units import P_ATM

_CLOCK = RECORDINGS.clock
#: Longest interval that is interpolated, in median intervals.
MAX_INTERVAL: float = _CLOCK.near


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
    if intervals.number and np.abs(steps - 1.0).max() <= _CLOCK.scatter:
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
    if np.sqrt(np.mean((steps - n_steps) ** 2)) <= _CLOCK.scatter and n_steps.min() >= 1.0:
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
    surplus = np.arange(t.size) - (1.0 - _CLOCK.lost) * rate * (t - first_time)
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


Flags = NDArray[np.bool_]

SPLINE = 3  # longest gap bridged by a spline [samples]
MAX_CYCLE_GAP = 0.1  # longest gap bridged by another cycle, as a fraction of the recording
_MAX_IMPOSSIBLE_FRACTION = 0.1  # largest fraction of impossible samples in a channel with the right unit
_MIN_POSITIONS = 10  # number of different positions of a sensor that works; an encoder at rest shows one or two
_GAPS = RECORDINGS.gaps
#: Largest fraction of bridged samples in a block: so few change the sums over the block less than its noise does.
MAX_BRIDGED_FRACTION = 0.01
#: Samples on either side of a gap whose means set the offset of a copied cycle. A cycle is compared only if so many
#: samples beside the gap are in the recording, and so many in total are known; a spline needs more known values.
_N_END = 8
_MAX_MISMATCH = 0.4  # largest rms difference of a copied cycle around the gap, relative to its rms about the mean
_SLACK = 2  # uncertainty of the cycle's length [samples]


def set_missing(recording: Recording, flags: Mapping[str, Flags]) -> Recording:
    """Set flagged samples to NaN; return the recording itself if there are none. `flags`: channel -> flags (n,)."""
    channels = {name: np.where(mask, np.nan, recording[name]) for name, mask in flags.items() if mask.any()}
    return replace(recording, channels={**recording.channels, **channels}) if channels else recording


def remove_dropouts(recording: Recording) -> Recording:
    """Set all channels to NaN in rows where both chamber pressures are exactly zero.

    A converter that is off writes zeros; two noisy transducers never read zero together.
    """
    if len(chambers_of(recording)) < 2:
        return recording
    is_dropout = (recording["p_A"] == 0.0) & (recording["p_B"] == 0.0)
    return set_missing(recording, dict.fromkeys(recording.channels, is_dropout)) if is_dropout.any() else recording


def remove_unsupplied(recording: Recording) -> Recording:
    """Set to NaN the samples of a recording during which the sensors had no supply.

    A sensor of 4 to 20 mA then reads a quarter of its range below zero; the fraction `gaps.live_zero` (`priors.toml`),
    a little less, is enough. These samples are

    - all channels, where both chamber pressures are below vacuum by more than this fraction of their own maxima;
    - the position alone, where it is constant from the first sample or up to the last one, and outside of all its other
      values by more than this fraction of their range, if these are at least `_MIN_POSITIONS` different ones. It may be
      so at both ends.

    The recording must be whole, as its beginning, its end and the largest values decide.
    """
    is_off = np.zeros(len(recording), dtype=bool)
    if len(chambers_of(recording)) == 2:
        is_off = _is_below_live_zero(recording["p_A"]) & _is_below_live_zero(recording["p_B"])
    unsupplied = dict.fromkeys(recording.channels, is_off)
    if "x" in recording:
        x = recording["x"]
        unsupplied["x"] = is_off | _flag_dead_ends(np.where(is_off, np.nan, x) if is_off.any() else x)
    return set_missing(recording, unsupplied)


def _is_below_live_zero(pressure: Array) -> Flags:
    """Flag the samples (n,) of a sensor without a supply: p [Pa] < -P_ATM - `gaps.live_zero` max(0, all p)."""
    return np.asarray(pressure < -P_ATM - _GAPS.live_zero * np.nanmax(pressure, initial=0.0))


def _flag_dead_ends(position: Array) -> Flags:
    """Flag the first samples of a `position` (n,), the last ones or both if its sensor was off (`remove_unsupplied`).

    The sensor was on before the largest step, after it, or between the two largest ones. The samples at an end are
    flagged if they are outside of all positions in that time by a distance of more than `gaps.live_zero` times the
    range of these, and vary by less than `gaps.dead` times this distance.
    """
    values = take_finite(position)
    is_dead = np.zeros(values.size, dtype=bool)
    if values.size < 2:
        return np.zeros(len(position), dtype=bool)
    # first samples after the two largest steps; 0 if there is only one step
    *_, second, largest = 0, *(index + 1 for index in largest_steps(values, 2))
    for start, stop in ((largest, values.size), (0, largest), (min(second, largest), max(second, largest))):
        live, ends = values[start:stop], [end for end in (values[:start], values[stop:]) if end.size]
        if all(_is_dead_end(end, live) for end in ends) and np.unique(live).size >= _MIN_POSITIONS:
            is_dead[:start] = is_dead[stop:] = True
    flags = np.zeros(len(position), dtype=bool)
    flags[np.isfinite(position)] = is_dead
    return flags


def _is_dead_end(end: Array, live: Array) -> bool:
    """Test whether the positions at an `end` (k,) are constant, far from all `live` ones (m,) (`_flag_dead_ends`)."""
    low, high = live.min(), live.max()
    distance = max(low - end.max(), end.min() - high)
    return bool(distance > _GAPS.live_zero * (high - low) and np.ptp(end) < _GAPS.dead * distance)


def remove_impossible(recording: Recording) -> Recording:
    """Set samples to NaN whose magnitude no sensor can read, such as over 1e10 Pa (`quality.flag_impossible`).

    A channel stays as it is if over a tenth of its samples are impossible, because its unit is then wrong.
    """
    flags = {name: flag_impossible(values, recording.units[name]) for name, values in recording.channels.items()}
    max_count = _MAX_IMPOSSIBLE_FRACTION * len(recording)
    return set_missing(recording, {name: mask for name, mask in flags.items() if np.count_nonzero(mask) <= max_count})


def bridge(recording: Recording, needed: Sequence[str]) -> Recording:
    """Fill the gaps of the `needed` channels, except at the ends, and mark them in `Recording.bridged`.

    A gap of up to `SPLINE` samples is filled by a spline. A longer one is filled from another cycle of the motion, or
    by a straight line if no cycle is similar enough or the gap exceeds the fraction `MAX_CYCLE_GAP` of the recording.
    Values that other channels miss in the same rows are filled in the same way. The times must be evenly spaced.
    """
    is_complete = np.all([np.isfinite(recording[name]) for name in needed], axis=0)
    if not len(recording) or is_complete.all() or not is_complete.any():  # no gaps, or no readings beside them
        return recording
    # copies of the channels, in which infinite values are missing, too
    channels = {name: np.where(np.isfinite(values), values, np.nan) for name, values in recording.channels.items()}
    stretches = uniform_segments(recording, needed)
    longest_stretch = max(stretches, key=lambda stretch: stretch.stop - stretch.start, default=None)
    # its period [s], by the longest stretch without gaps
    cycle = None if longest_stretch is None else find_cycle(recording.samples(longest_stretch).only(needed))
    bridged, spline_rows, line_rows = np.zeros((3, len(recording)), dtype=bool)
    for first, length in find_runs(~is_complete).tolist():
        stop = first + length
        if first == 0 or stop == len(recording):
            continue
        bridged[first:stop] = True
        if length <= SPLINE:
            spline_rows[first:stop] = True
        elif (
            cycle is None
            or length > MAX_CYCLE_GAP * len(recording)
            or not _copy_other_cycle(channels, needed, first, stop, cycle * recording.rate)
        ):
            line_rows[first:stop] = True
    for values in channels.values():
        _fill_rows(values, spline_rows, by_spline=True)
        _fill_rows(values, line_rows, by_spline=False)
    if not bridged.any():
        return recording
    note = f"{np.count_nonzero(bridged)} samples in {len(find_runs(bridged))} gaps bridged"
    return replace(recording, channels=channels, bridged=bridged, history=(*recording.history, note))


def interpolate_short_gaps(recording: Recording, needed: Sequence[str]) -> Recording:
    """Interpolate short gaps linearly, except at the ends, in all channels but the `needed` ones, which `bridge` fills.

    A sensor that is slower than the logger leaves such gaps. A gap is short up to `SPLINE` samples in a pressure, and
    up to `gaps.motion` [s] of `priors.toml` in other channels, as moving masses hardly change their speed in that time.
    """
    max_motion_gap = _GAPS.motion * recording.rate
    channels: dict[str, Array] = {}
    for name, values in recording.channels.items():
        is_missing = ~np.isfinite(values)
        if name in needed or not is_missing.any() or is_missing.all():
            continue
        max_length = SPLINE if name.startswith("p_") else max_motion_gap
        is_short = np.zeros(len(values), dtype=bool)
        for first, length in find_runs(is_missing).tolist():
            is_short[first : first + length] = first > 0 and first + length < len(values) and length <= max_length
        channels[name] = values.copy()
        channels[name][is_short] = np.interp(np.flatnonzero(is_short), np.flatnonzero(~is_missing), values[~is_missing])
    return replace(recording, channels={**recording.channels, **channels}) if channels else recording


def flag_bridged(recording: Recording, bounds: Array | NDArray[np.integer]) -> Flags:
    """Flag the blocks (n,) of samples in which more than the fraction `MAX_BRIDGED_FRACTION` of the samples are filled.

    `bounds` (n + 1,): index of the first sample of each block, and the end of the last block.
    """
    bounds = np.asarray(bounds)
    if recording.bridged is None:
        return np.zeros(max(bounds.size - 1, 0), dtype=bool)
    counts = np.diff(np.concatenate([[0], np.cumsum(recording.bridged)])[bounds])
    return np.asarray(counts > MAX_BRIDGED_FRACTION * np.diff(bounds))


def flag_holes(recording: Recording) -> Flags:
    """Flag the rows (n,) of filled gaps longer than both `gaps.hole` [s] (`priors.toml`) and `MAX_INTERVAL` steps."""
    flags = np.zeros(len(recording), dtype=bool)
    if recording.bridged is not None:
        max_gap = max(_GAPS.hole, MAX_INTERVAL / recording.rate)
        for first, length in find_runs(recording.bridged).tolist():
            n_steps = length + 1  # sampling steps from the reading before the gap to that after it
            flags[first : first + length] = n_steps > max_gap * recording.rate
    return flags


def _finite_mean(values: Array) -> float:
    """Compute the mean of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _copy_other_cycle(channels: dict[str, Array], needed: Sequence[str], first: int, stop: int, period: float) -> bool:
    """Fill a gap in all channels, in place, from a nearby cycle of motion; return False if no cycle is similar enough.

    The two nearest cycles on either side are tried, the nearer ones first, each with up to `_SLACK` samples more or
    less. `channels`: name -> values (n,); `first`, `stop`: the gap's first sample, and the first one after it;
    `needed`: channels that must be complete in the copied cycle; `period`: length of a cycle [samples].
    """
    half_cycle = round(0.5 * period)
    # the copied samples must not overlap the gap, nor the half cycle next to it
    min_cycles = math.ceil((stop - first + half_cycle) / period)
    for shift in (sign * round(n_cycles * period) for n_cycles in (min_cycles, min_cycles + 1) for sign in (-1, 1)):
        shifts = range(shift - _SLACK, shift + _SLACK + 1)
        mismatches = [_cycle_mismatch(channels, needed, first, stop, candidate, half_cycle) for candidate in shifts]
        best = int(np.argmin(mismatches))
        if mismatches[best] <= _MAX_MISMATCH:
            for values in channels.values():
                _copy_shifted(values, first, stop, shifts[best])
            return True
    return False


def _cycle_mismatch(
    channels: dict[str, Array], needed: Sequence[str], first: int, stop: int, shift: int, half_cycle: int
) -> float:
    """Compute how much the machine's motion around a gap differs from its motion `shift` samples later.

    The motion is seen in the command u if this is `needed`, else in p_A - p_B or the only chamber pressure
    (`duty_signal`). The gap and up to `half_cycle` samples on either side are compared with the stretch `shift` samples
    later, or earlier if `shift` is negative. The result is the rms difference of the two stretches, after their means
    are subtracted, over the standard deviation of the shifted stretch. It is infinite if too few samples are known, or
    if one of the `needed` channels lacks samples to copy into the gap.
    """
    n = next(iter(channels.values())).size
    # half a cycle on either side of the gap, as far as both stretches lie within the recording
    window = slice(max(first - half_cycle, -shift, 0), min(stop + half_cycle, n - shift, n))
    if window.start > first - _N_END or window.stop < stop + _N_END:
        return math.inf
    if not all(np.isfinite(channels[name][first + shift : stop + shift]).all() for name in needed):
        return math.inf
    names = ("u",) if "u" in needed else chambers_of(needed)
    signal = duty_signal([channels[name] for name in names])
    around_gap, shifted = signal[window], signal[window.start + shift : window.stop + shift]
    known = np.isfinite(around_gap) & np.isfinite(shifted)
    if np.count_nonzero(known) < _N_END:
        return math.inf
    around_gap, shifted = around_gap[known] - around_gap[known].mean(), shifted[known] - shifted[known].mean()
    return float(np.sqrt(np.mean((around_gap - shifted) ** 2))) / max(float(np.std(shifted)), np.finfo(float).tiny)


def _copy_shifted(values: Array, first: int, stop: int, shift: int) -> None:
    """Fill a gap in place with the values `shift` samples later, plus a linear offset by which they join its ends.

    `_cycle_mismatch` has found that the recording contains both, with `_N_END` samples beside each. A channel with no
    value in one of these groups of samples gets the offset NaN: its gap stays.
    """
    ends = (slice(first - _N_END, first), slice(stop, stop + _N_END))
    offset_before, offset_after = (
        _finite_mean(values[end]) - _finite_mean(values[end.start + shift : end.stop + shift]) for end in ends
    )
    copied = values[first + shift : stop + shift] + np.linspace(offset_before, offset_after, stop - first)
    target = values[first:stop]
    target[np.isnan(target)] = copied[np.isnan(target)]


def _fill_rows(values: Array, rows: Flags, by_spline: bool) -> None:
    """Fill missing values (n,) in the flagged `rows` (n,), in place, by a cubic spline or by linear interpolation.

    Values before the first known one and after the last one stay missing, and for a spline all if too few are known.
    """
    from scipy.interpolate import CubicSpline

    known = np.flatnonzero(np.isfinite(values))
    missing = np.flatnonzero(rows & np.isnan(values))
    if missing.size and known.size > (_N_END if by_spline else 0):
        missing = missing[(missing > known[0]) & (missing < known[-1])]
        if by_spline:
            values[missing] = CubicSpline(known, values[known])(missing)
        else:
            values[missing] = np.interp(missing, known, values[known])
