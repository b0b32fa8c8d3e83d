"""All corrections of a recording's samples in their order, as the inspection and the folder monitor apply them.

- *Spikes* are single samples that a transmission error sets to zero or full scale: the value leaps and returns at once.
  The leap is several times larger than any other one nearby, than the channel's slope there, and than its usual
  changes. A pressure that rises within one sample is kept, because it does not return. Spikes are bridged as gaps.
- *Stale samples* of a slow channel, or of a logger that got no new value, repeat the previous sample. They are
  interpolated between fresh ones; otherwise a channel that repeats each sample for 0.1 s would be 0.05 s late on
  average. A quantised channel at rest also repeats its value. The time of repetition is therefore estimated from runs
  that begin and end with a large jump.
- *Wrapped angles* of a motor, which begin anew after a turn, are unwrapped, or left out where nothing tells the turns.
- Gaps, clocks and speeds without a sign have modules of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.paragraphs import format_count
from sealscope.recordings.channels import CHAMBERS, COUNTS, SLOW, Array, chambers_of, estimate_quantum
from sealscope.recordings.corrections.gaps import (
    bridge,
    flag_holes,
    interpolate_short_gaps,
    order_recording,
    remove_dropouts,
    remove_impossible,
    remove_unsupplied,
    resample_evenly,
    set_missing,
)
from sealscope.recordings.corrections.unsigned import restore_signs
from sealscope.recordings.formats.wrapped_angle import continue_resets, unwrap_angle
from sealscope.recordings.motion import find_holds, find_runs, find_stuck
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding, locate_rows, weigh_defects
from sealscope.recordings.recording import Recording

_SPIKE = RECORDINGS.spike
#: Number of leaps on either side with which a spike is compared, and fewest samples of a channel.
_NEIGHBOURS, _MIN_SAMPLES = 10, 50
_MIN_QUANTA = 10.0  # smallest spike, in quantisation steps
#: More changes are thinned to this many, or up to twice as many, to estimate the usual size of a change.
_N_CHANGES = 2**15


def remove_spikes(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Replace spikes by NaN in all channels but slow ones and the command u, which may jump.

    Returns the recording, and a finding for each channel with spikes.
    """
    channels, findings = dict(recording.channels), list[Finding]()
    for name, values in recording.channels.items():
        spikes = find_spikes(values) if name not in SLOW and name != "u" else np.empty(0, dtype=np.intp)
        if not spikes.size:
            continue
        channels[name] = values.copy()
        channels[name][spikes] = np.nan
        phrase = "sample leaps and returns" if spikes.size == 1 else "samples leap and return"
        first = recording.format_value(name, values[spikes[0]])
        text = f"{name}: {spikes.size} {phrase} at once, first to {first}: left out"
        places = locate_rows(recording.t, spikes)
        findings.append(Finding("spike", "note", name, spikes.size, float(recording.t[spikes[0]]), text, places))
    return (replace(recording, channels=channels) if findings else recording), findings


def find_spikes(values: Array) -> NDArray[np.intp]:
    """Find the indices of the samples at which a channel (n,) leaps and returns at once.

    Such a sample lies above both neighbours, or below both. With m = `spike.times` (`priors.toml`), the smaller of its
    two steps must exceed m times the usual step (the 0.9 quantile) plus 10 quantisation steps, and also m times the
    local slope and any other leap nearby. The number of a logger's errors has a Poisson distribution with the mean
    `spike.share` times the number of samples. If the probability of at least as many errors as spikes is below
    `spike.tail`, the signal itself leaps, and the result is empty; also for fewer than 50 finite samples.
    """
    from scipy.special import pdtrc

    known = np.flatnonzero(np.isfinite(values))
    if known.size < _MIN_SAMPLES:
        return np.empty(0, dtype=np.intp)
    steps = np.diff(values[known])
    step_sizes = np.abs(steps)
    # jumps[k]: if sample k + 1 leaps and returns, the smaller of its two changes, else 0
    jumps = np.where(steps[:-1] * steps[1:] < 0.0, np.minimum(step_sizes[:-1], step_sizes[1:]), 0.0)
    thinned_sizes = step_sizes[:: max(1, step_sizes.size // _N_CHANGES)]  # enough for a quantile
    usual_step = float(np.quantile(thinned_sizes, 0.9))
    if not (jumps > _SPIKE.times * usual_step).any():  # as in most channels: no need to sort the values
        return np.empty(0, dtype=np.intp)
    threshold = _SPIKE.times * usual_step + _MIN_QUANTA * estimate_quantum(values[known])
    # larger change just before or after the leap; the slope is the larger of this and the mean change across the leap
    outer_steps = np.maximum(np.append(0.0, step_sizes[:-2]), np.append(step_sizes[2:], 0.0))
    slopes = np.maximum(0.5 * np.abs(steps[:-1] + steps[1:]), outer_steps)
    rows = []
    for k in np.flatnonzero(jumps > threshold).tolist():
        nearby_jumps = np.r_[jumps[max(k - _NEIGHBOURS, 0) : k], jumps[k + 1 : k + 1 + _NEIGHBOURS]]
        if jumps[k] > _SPIKE.times * max(slopes[k], nearby_jumps.max(initial=0.0)):
            rows.append(known[k + 1])
    # more leaps than the errors of a logger explain; pdtrc: Poisson probability of more events than its first argument
    is_signal = bool(rows) and pdtrc(len(rows) - 1, _SPIKE.share * known.size) < _SPIKE.tail
    return np.array([] if is_signal else rows, dtype=np.intp)


_STALE = RECORDINGS.stale
#: Largest fraction of stuck samples of a pressure: up to it they are missing, beyond it the channel is not used.
MAX_STUCK_FRACTION: float = _STALE.stuck
_MIN_JUMP = 1.5  # smallest jump, in quantisation steps; a smaller one may be a slow change
_N_ESTIMATE = 2**18  # samples from the beginning from which the holding period is estimated
#: Largest number of equal rows in succession, i.e. a reading and its repeats, for the repeats to be left out; also the
#: tolerance [rows] of the ends of a long repeat (`flag_frozen_rows`).
_MAX_REPEAT = 3


def interpolate_stale_samples(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Replace samples that repeat the previous one by linear interpolation between new readings; also return findings.

    A channel may hold each reading for a fixed time (`estimate_holding_period`), and the logger may repeat whole rows.
    Slow channels and the command u stay as they are.
    """
    names = [name for name in recording.channels if name not in SLOW and name != "u"]
    channels, findings = dict(recording.channels), list[Finding]()
    repeated = _flag_repeated_rows([recording[name] for name in names])
    # rows later than all rows before, which alone the resampling keeps
    latest = np.fmax.accumulate(recording.t)
    is_ordered = np.append(True, recording.t[1:] > latest[:-1]) & np.isfinite(recording.t)
    rows = np.flatnonzero(repeated)
    if rows.size:
        text = f"{rows.size} rows repeat the row before: interpolated"
        places = locate_rows(recording.t, rows)
        findings.append(Finding("repeated_rows", "note", None, rows.size, float(recording.t[rows[0]]), text, places))
    for name in names:
        values = recording[name]
        stale = repeated & np.isfinite(values)
        if (period := estimate_holding_period(recording.t, values)) is not None:
            stale |= _flag_held(recording.t, values, period)
            text = f"{name}: repeats each sample for {period:.2g} s: interpolated between new ones"
            count = int(np.count_nonzero(stale))
            findings.append(Finding("held_samples", "note", name, count, float(recording.t[0]), text))
        fresh = np.isfinite(values) & ~stale & is_ordered
        if stale.any() and fresh.any():
            channels[name] = np.where(stale, np.interp(recording.t, recording.t[fresh], values[fresh]), values)
    return (replace(recording, channels=channels) if findings else recording), findings


def flag_stuck_rows(recording: Recording, name: str) -> NDArray[np.bool_]:
    """Flag the rows (n,) in which the chamber pressure `name` repeats one value for too long while the machine moves.

    Motion is seen in the position, else in the pump's angle, else in the other chamber pressure; without these it is
    assumed. Rows at the smallest or largest value of the channel are clipped, and not flagged.
    """
    values, flags = recording[name], np.zeros(len(recording), dtype=bool)
    known = np.flatnonzero(np.isfinite(values))
    motion_channels = next(((channel,) for channel in ("x", "theta") if channel in recording), CHAMBERS)
    references = [recording[other] for other in motion_channels if other != name and other in recording]
    for first, length in find_stuck(values[known]).tolist():
        stuck_run = known[first : first + length]
        is_clipped = values[stuck_run[0]] in (np.nanmin(values), np.nanmax(values))
        if not is_clipped and (not references or any(_moves_in(other, stuck_run) for other in references)):
            flags[stuck_run] = True
    return flags


def flag_frozen_rows(recording: Recording) -> NDArray[np.bool_]:
    """Flag the rows (n,) in which a logger repeats its last row for a long time.

    All channels are constant or missing there, and both chamber pressures for longer than their noise allows
    (`find_holds`). No channel jumps at the first of these rows, but one does after the last, as the machine moved on.
    Nothing is flagged without both chamber pressures.
    """
    flags = np.zeros(len(recording), dtype=bool)
    if not all(name in recording for name in CHAMBERS):
        return flags
    holds_a, holds_b = (find_runs(find_holds(recording[name], recording.rate)) for name in CHAMBERS)
    begins_b, ends_b = holds_b[:, 0], holds_b.sum(axis=1)
    channels = list(recording.channels.values())
    for first, length in holds_a.tolist():
        stop = first + length
        # p_B is held in the same rows as p_A, to within a few at the ends
        coincide = np.any((np.abs(begins_b - first) <= _MAX_REPEAT) & (np.abs(ends_b - stop) <= _MAX_REPEAT))
        inner = slice(first + _MAX_REPEAT, stop - _MAX_REPEAT)
        if (
            coincide
            and first > 1  # a row before the repeated one shows if a channel jumps
            and stop < len(recording)
            and all(np.isnan(values[inner]).all() or np.ptp(values[inner]) == 0.0 for values in channels)
            and not any(_jumps_at(values, first) for values in channels)
            and any(_jumps_at(values, stop) for values in channels)
        ):
            flags[first:stop] = True
    return flags


def _jumps_at(values: Array, row: int) -> bool:
    """Test whether a channel (n,) changes around `row` by more than the quantile `stale.leap` of its usual changes.

    Changes are those over 7 sampling steps, here from 4 rows before `row` to 3 rows after it, as the holds of p_A and
    p_B may begin or end up to 3 rows apart. False if either sample is missing.
    """
    change = np.abs(values[min(row + _MAX_REPEAT, len(values) - 1)] - values[max(row - _MAX_REPEAT - 1, 0)])
    usual_change = np.nanquantile(np.abs(values[2 * _MAX_REPEAT + 1 :] - values[: -2 * _MAX_REPEAT - 1]), _STALE.leap)
    return bool(change > usual_change)


def _moves_in(values: Array, rows: NDArray[np.intp]) -> bool:
    """Test whether a channel (n,) changes by more than the fraction `stale.moves` of its range within `rows` (k,)."""
    all_values, values_in_rows = values[np.isfinite(values)], values[rows][np.isfinite(values[rows])]
    return bool(values_in_rows.size and np.ptp(values_in_rows) > _STALE.moves * np.ptp(all_values))


def _find_equal_runs(values: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Divide finite values (n > 0,) into k runs of equal ones; return the first index (k,) and a flag (k,) of each.

    A run is flagged if it both begins and ends with a jump of more than `_MIN_JUMP` quantisation steps.
    """
    starts = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    # flags of jumps at the starts of all runs but the first, which are also the ends of all runs but the last
    jumps = np.abs(np.diff(values)[starts[1:] - 1]) > _MIN_JUMP * estimate_quantum(values)
    return starts, np.r_[False, jumps] & np.r_[jumps, False]


def estimate_holding_period(t: Array, values: Array) -> float | None:
    """Estimate the time [s] for which a channel (n,) that is slower than its logger repeats each reading.

    It is the mean duration of the regular runs among the runs of equal values that begin and end with a jump
    (`_find_equal_runs`), in the first `_N_ESTIMATE` samples. A run is regular if its duration is within the fraction
    `stale.spread` (`priors.toml`) of the median. Returns None for fewer than `stale.runs` runs, if less than the
    fraction `stale.share` of them is regular, if their median length is below two samples, or if the mean is below
    `stale.shortest` [s]. `t` (n,): times [s].
    """
    t, values = t[:_N_ESTIMATE], values[:_N_ESTIMATE]
    known = np.isfinite(values) & np.isfinite(t)
    if np.count_nonzero(known) < _STALE.runs:
        return None
    t, values = t[known], values[known]
    # so few repeats cannot make the median of `stale.runs` lengths two samples
    if 2 * np.count_nonzero(values[1:] == values[:-1]) < _STALE.runs:
        return None
    starts, is_bounded = _find_equal_runs(values)
    ends = np.r_[starts[1:], values.size]
    lengths = (ends - starts)[is_bounded]
    durations = (t[np.minimum(ends, t.size - 1)] - t[starts])[is_bounded]  # the last run, which has no end, is not
    if lengths.size < _STALE.runs or np.median(lengths) < 2:
        return None
    median_duration = float(np.median(durations))
    is_regular = np.abs(durations - median_duration) <= _STALE.spread * median_duration
    if np.mean(is_regular) < _STALE.share:
        return None
    period = float(durations[is_regular].mean())
    return period if period >= _STALE.shortest else None


def _flag_held(t: Array, values: Array, period: float) -> NDArray[np.bool_]:
    """Flag the samples (n,) that repeat the previous one, in a channel with a new reading every `period` [s].

    Each run of equal values is divided into periods from its first sample on. All samples but the first of each period
    are flagged. `t` (n,): times [s].
    """
    known = np.flatnonzero(np.isfinite(values))
    starts, _ = _find_equal_runs(values[known])
    times = t[known]
    # time of the first sample of each sample's run
    run_start = times[starts][np.searchsorted(starts, np.arange(known.size), side="right") - 1]
    period_index = np.floor((times - run_start) / period + 1e-6)  # 1e-6: rounding of the times
    is_held = np.zeros(t.size, dtype=bool)
    is_held[known[1:]] = (period_index[1:] == period_index[:-1]) & (run_start[1:] == run_start[:-1])
    return is_held


def _flag_repeated_rows(channels: list[Array]) -> NDArray[np.bool_]:
    """Flag the rows (n,) in which a logger got no new readings and repeated the previous row.

    At such a place, one or two rows repeat the samples of all `channels`, each (n,), that vary, and one channel jumps
    by more than `_MIN_JUMP` quantisation steps both before and after these rows. Nothing is flagged unless there are at
    least `stale.repeats` (`priors.toml`) times as many places as rows that are expected to repeat by chance. The
    expected fraction of rows is that for channels that repeat independently of each other, but at least `stale.fewest`.
    Nothing is flagged in fewer than `stale.runs` rows.
    """
    moving = [values for values in channels if np.isfinite(values).any() and np.nanmax(values) > np.nanmin(values)]
    if not moving or moving[0].size < _STALE.runs:
        return np.zeros(channels[0].size if channels else 0, dtype=bool)
    equal = [values[1:] == values[:-1] for values in moving]
    is_same = np.r_[False, np.all(equal, axis=0)]
    p_equal = float(np.prod([np.mean(flags) for flags in equal]))  # if channels repeat independently
    runs = find_runs(is_same)
    first, stop = runs[:, 0], runs.sum(axis=1)
    # the jumps below need the rows first - 2 and stop
    is_short = (stop - first < _MAX_REPEAT) & (first > 1) & (stop < is_same.size)
    first, stop = first[is_short], stop[is_short]
    is_candidate, repeated = np.zeros(first.size, dtype=bool), np.zeros(is_same.size, dtype=bool)
    # the product of the last two factors is the number of repeated rows expected by chance
    fewest = _STALE.repeats * max(p_equal, _STALE.fewest) * is_same.size
    for values in moving if first.size >= fewest else ():
        min_jump = _MIN_JUMP * estimate_quantum(values[np.isfinite(values)])
        jumps_before = np.abs(values[first - 1] - values[first - 2]) > min_jump
        jumps_after = np.abs(values[stop] - values[stop - 1]) > min_jump
        is_candidate |= jumps_before & jumps_after
    if np.count_nonzero(is_candidate) >= fewest:
        for begin, end in zip(first[is_candidate].tolist(), stop[is_candidate].tolist(), strict=True):
            repeated[begin:end] = True
    return repeated


#: Channels that tell how far the shaft turns from sample to sample.
_SIGNALS = ("omega", "x", "u")


def unwrap_angles(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Unwrap the motor angle theta of a recording; leave it out if its turns are ambiguous. Also return a finding."""
    if "theta" not in recording:
        return recording, []
    signals = {
        name: recording[name]
        for name in _SIGNALS
        if name in recording and not (name == "omega" and recording.units[name] == COUNTS)
    }
    angle = unwrap_angle(recording["theta"], recording.units["theta"], recording.t, signals)
    if angle is None:
        values, resets = continue_resets(recording["theta"], recording.channels.get("x"))
        if not resets.size:
            return recording, []
        text = f"theta: begins again from its first value, {format_count(resets.size, 'time')}: taken as continuing"
        places = locate_rows(recording.t, resets)
        finding = Finding("angle_reset", "note", "theta", int(resets.size), float(recording.t[resets[0]]), text, places)
        return replace(recording, channels={**recording.channels, "theta": values}), [finding]
    period = recording.format_value("theta", angle.period, is_span=True)
    leaps, places = format_count(angle.leaps.size, "time"), locate_rows(recording.t, angle.leaps)
    if angle.values is None:
        text = f"theta: begins anew after {period} and turns by half of this or more from sample to sample, "
        text += "as no other channel tells how far: left out; record the speed, or sample faster"
        finding = Finding("angle_ambiguous", "warning", "theta", angle.leaps.size, places[0], text, places)
        return recording.only(name for name in recording.channels if name != "theta"), [finding]
    text = f"theta: begins anew after {period}, {leaps}: unwrapped"
    finding = Finding("angle_unwrapped", "note", "theta", angle.leaps.size, places[0], text, places)
    return replace(recording, channels={**recording.channels, "theta": angle.values}), [finding]


class CorrectedSamples(NamedTuple):
    """A recording after the correction of its samples."""

    recording: Recording  # evenly spaced, from the first to the last row with all chamber pressures and the command
    findings: tuple[Finding, ...]  # the corrections that `correct_samples` reports
    stuck: tuple[str, ...]  # names of chamber pressures that repeat one value for too long to be used
    # fractions of the original samples: those within the time span of `recording`, those before it, those after it
    used_fraction: float
    before_fraction: float
    after_fraction: float


def correct_samples(recording: Recording) -> CorrectedSamples:
    """Correct the samples of a recording for the defects of loggers, in this order.

    0. rows out of the order of time, and an angle that begins anew after a turn;
    1. impossible values, dropouts, i.e. rows with zeros in both chamber pressures, and sensors without a supply;
    2. rows, and then single pressures, that repeat one value for a long time;
    3. spikes, and samples that repeat the previous one;
    4. uneven sampling times;
    5. speeds and flows without a sign;
    6. gaps, which are interpolated or bridged, and incomplete rows at the ends, which are cut off.

    Steps 0, 3 and 5, bridged gaps, and rows outside of the time span that is left are reported as findings. Channels
    without any value are left out, except chamber pressures. A chamber pressure that is stuck in more than
    `MAX_STUCK_FRACTION` of the rows keeps these rows, and is named as unusable.
    """
    ordered = order_recording(recording)
    part, unwrapped_angles = unwrap_angles(remove_dropouts(remove_impossible(ordered.recording)))
    part = remove_unsupplied(part)
    part = set_missing(part, dict.fromkeys(part.channels, flag_frozen_rows(part)))
    chambers = chambers_of(part)
    # empty channels are left out, except chamber pressures
    names = [name for name in part.channels if name in chambers or np.any(np.isfinite(part[name]))]
    part = part.only(names) if len(names) < len(part.channels) else part
    needed = (*chambers, "u") if "u" in part else chambers
    stuck = {name: rows for name in chambers if (rows := flag_stuck_rows(part, name)).any()}
    unusable = tuple(name for name, rows in stuck.items() if np.mean(rows) > MAX_STUCK_FRACTION)
    part = set_missing(part, {name: rows for name, rows in stuck.items() if name not in unusable})
    part, spikes = remove_spikes(part)
    part, stale_samples = interpolate_stale_samples(part)
    part, restored_signs = restore_signs(resample_evenly(part))
    findings = [*ordered.findings, *unwrapped_angles, *spikes, *stale_samples, *restored_signs]
    part = interpolate_short_gaps(bridge(part, needed), needed)
    if part.bridged is not None:
        bridged = np.flatnonzero(part.bridged)
        gaps = format_count(len(find_runs(part.bridged)), "gap")
        text = f"{format_count(bridged.size, 'missing sample')} in {gaps} bridged: blocks with a long gap count less"
        findings.append(Finding("gaps_bridged", "note", None, bridged.size, float(part.t[bridged[0]]), text))
    part = _cut_to_complete(part, needed)
    times, n_total = ordered.recording.t, len(ordered.recording) + ordered.n_before + ordered.n_after
    n_before, n_after = ordered.n_before, n_total - ordered.n_before
    if len(part):
        n_before += int(np.count_nonzero(times < part.t[0]))
        n_after = ordered.n_after + int(np.count_nonzero(times > part.t[-1]))
    n_outside = len(times) - int(np.count_nonzero((times >= part.t[0]) & (times <= part.t[-1]))) if len(part) else 0
    n_outside += ordered.n_before + ordered.n_after
    if len(part) and n_outside:
        n_within = n_total - n_outside
        text = f"analysed from {part.t[0]:.4g} s to {part.t[-1]:.4g} s: {n_within} of {n_total} samples"
        severity = weigh_defects(n_outside, n_total)
        findings.append(Finding("part_analysed", severity, None, n_outside, float(part.t[0]), text))
    count = max(n_total, 1)
    used = 1.0 - n_outside / count if len(part) else 0.0
    return CorrectedSamples(part, tuple(findings), unusable, used, n_before / count, n_after / count)


def _cut_to_complete(recording: Recording, needed: Sequence[str]) -> Recording:
    """Cut a recording to the rows from the first to the last one that has values in all `needed` channels.

    Without such a row the result is empty. Without `needed` channels, nothing is cut.
    """
    is_complete = np.all([np.isfinite(recording[name]) for name in needed], axis=0) if needed else np.array([True])
    if is_complete.all():
        return recording
    rows = np.flatnonzero(is_complete)
    return recording.samples(slice(int(rows[0]), int(rows[-1]) + 1) if rows.size else slice(0, 0))


def remove_holes(recording: Recording) -> Recording:
    """Replace the filled samples of long gaps by NaN, for detectors that cannot give filled samples a lower weight.

    Short gaps stay filled, but are no longer marked as `bridged`. A recording without long gaps keeps these marks.
    """
    is_hole = flag_holes(recording)
    if not is_hole.any():
        return recording
    return replace(set_missing(recording, dict.fromkeys(recording.channels, is_hole)), bridged=None)
