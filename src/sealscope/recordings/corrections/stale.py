"""Stale samples: a slow channel, or a logger that got no new value, repeats the previous sample.

Repeated samples are not readings. They are interpolated between fresh ones; otherwise a channel that repeats each
sample for 0.1 s would be 0.05 s late on average. A quantised channel at rest also repeats its value. The time of
repetition is therefore estimated from runs that begin and end with a large jump. Called by the inspection.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.channels import SLOW, Array, estimate_quantum
from sealscope.recordings.motion import find_holds, find_runs, find_stuck
from sealscope.recordings.priors import RECORDINGS
from sealscope.recordings.quality import Finding, locate_rows
from sealscope.recordings.recording import Recording

_PRIORS = RECORDINGS.stale
#: Largest fraction of stuck samples of a pressure: up to it they are missing, beyond it the channel is not used.
MAX_STUCK_FRACTION: float = _PRIORS.stuck
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
    usual_change = np.nanquantile(np.abs(values[2 * _MAX_REPEAT + 1 :] - values[: -2 * _MAX_REPEAT - 1]), _PRIORS.leap)
    return bool(change > usual_change)


def _moves_in(values: Array, rows: NDArray[np.intp]) -> bool:
    """Test whether a channel (n,) changes by more than the fraction `stale.moves` of its range within `rows` (k,)."""
    all_values, values_in_rows = values[np.isfinite(values)], values[rows][np.isfinite(values[rows])]
    return bool(values_in_rows.size and np.ptp(values_in_rows) > _PRIORS.moves * np.ptp(all_values))


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
    if np.count_nonzero(known) < _PRIORS.runs:
        return None
    t, values = t[known], values[known]
    starts, is_bounded = _find_equal_runs(values)
    ends = np.r_[starts[1:], values.size]
    lengths = (ends - starts)[is_bounded]
    durations = (t[np.minimum(ends, t.size - 1)] - t[starts])[is_bounded]  # the last run, which has no end, is not
    if lengths.size < _PRIORS.runs or np.median(lengths) < 2:
        return None
    median_duration = float(np.median(durations))
    is_regular = np.abs(durations - median_duration) <= _PRIORS.spread * median_duration
    if np.mean(is_regular) < _PRIORS.share:
        return None
    period = float(durations[is_regular].mean())
    return period if period >= _PRIORS.shortest else None


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
    if not moving or moving[0].size < _PRIORS.runs:
        return np.zeros(channels[0].size if channels else 0, dtype=bool)
    equal = [values[1:] == values[:-1] for values in moving]
    is_same = np.r_[False, np.all(equal, axis=0)]
    p_equal = float(np.prod([np.mean(flags) for flags in equal]))  # if channels repeat independently
    runs = find_runs(is_same)
    first, stop = runs[:, 0], runs.sum(axis=1)
    # the jumps below need the rows first - 2 and stop
    is_short = (stop - first < _MAX_REPEAT) & (first > 1) & (stop < is_same.size)
    first, stop = first[is_short], stop[is_short]
    is_candidate = np.zeros(first.size, dtype=bool)
    for values in moving:
        min_jump = _MIN_JUMP * estimate_quantum(values[np.isfinite(values)])
        jumps_before = np.abs(values[first - 1] - values[first - 2]) > min_jump
        jumps_after = np.abs(values[stop] - values[stop - 1]) > min_jump
        is_candidate |= jumps_before & jumps_after
    repeated = np.zeros(is_same.size, dtype=bool)
    # the product of the last two factors is the number of repeated rows expected by chance
    if np.count_nonzero(is_candidate) >= _PRIORS.repeats * max(p_equal, _PRIORS.fewest) * is_same.size:
        for begin, end in zip(first[is_candidate].tolist(), stop[is_candidate].tolist(), strict=True):
            repeated[begin:end] = True
    return repeated
