"""Stale samples: a slow channel, or a logger that found nothing new, repeats the sample before.

A repeated sample is no reading. It is replaced by the straight line between the fresh ones, so that a channel that
repeats its samples for 0.1 s is not 0.05 s late on average. A quantised channel at rest repeats its value as well: only
runs that begin and end with more than a quantisation step tell how long a channel repeats. The inspection calls it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sealscope.recordings.chambers import CHAMBERS
from sealscope.recordings.channels import SLOW, Array
from sealscope.recordings.motion import find_holds, quantum, runs_of, stuck
from sealscope.recordings.quality import Finding
from sealscope.recordings.recording import Recording
from sealscope.storage.toml_file import priors_of

_PRIORS = priors_of("sealscope.recordings")["stale"]
#: Largest share of a recording in which a pressure may be stuck, and is taken as missing there.
MOST_STUCK: float = _PRIORS["stuck"]
#: A jump of fewer quantisation steps may be a slow change.
_JUMP = 1.5
#: Samples at the beginning that tell how long a channel repeats its own.
_TOLD = 2**18
#: Longest run of repeated rows.
_LONGEST_REPEAT = 3


def without_stale_samples(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Replace repeated samples by lines between fresh ones; return the recording and what was found.

    A channel repeats its samples where most runs of equal values, among those that jumps begin and end, last alike. A
    row is repeated where all channels stay the same for up to three rows and one of them jumps before and after.
    """
    names = [name for name in recording.channels if name not in SLOW and name != "u"]
    channels, findings = dict(recording.channels), list[Finding]()
    repeated = _repeated_rows([recording[name] for name in names])
    rows = np.flatnonzero(repeated)
    if rows.size:
        text = f"{rows.size} rows repeat the one before: left out"
        findings.append(Finding("repeated_rows", "note", None, rows.size, float(recording.t[rows[0]]), text))
    for name in names:
        values = recording[name]
        stale = repeated & np.isfinite(values)
        if (period := holding_period(recording.t, values)) is not None:
            stale = stale | _held_samples(recording.t, values, period)
            text = f"{name}: repeats each sample for {period:.2g} s: lines between the fresh ones"
            findings.append(
                Finding("held_samples", "note", name, int(np.count_nonzero(stale)), float(recording.t[0]), text)
            )
        if stale.any():
            fresh = np.isfinite(values) & ~stale
            channels[name] = np.where(stale, np.interp(recording.t, recording.t[fresh], values[fresh]), values)
    return (replace(recording, channels=channels) if findings else recording), findings


def stuck_rows(recording: Recording, name: str) -> NDArray[np.bool_]:
    """Return the rows (n,) in which a pressure stays the same while something else moves; one at rest is no defect."""
    values, rows = recording[name], np.zeros(len(recording), dtype=bool)
    known = np.flatnonzero(np.isfinite(values))
    references = [recording[other] for other in (*CHAMBERS, "x", "theta") if other != name and other in recording]
    for first, length in stuck(values[known]).tolist():
        held = known[first : first + length]
        at_an_end = values[held[0]] in (np.nanmin(values), np.nanmax(values))  # there it is cut off
        if not at_an_end and (not references or any(_moves_in(other, held) for other in references)):
            rows[held] = True
    return rows


def frozen_rows(recording: Recording) -> NDArray[np.bool_]:
    """Return the rows (n,) in which a logger repeats its last row: all channels stay the same for long.

    Both chamber pressures stop together and go on together, for longer than a reading may be held
    (`motion.find_holds`), at what they were, and something leaps at the end. A machine at rest goes on from there.
    """
    rows = np.zeros(len(recording), dtype=bool)
    pressures = [recording[name] for name in CHAMBERS if name in recording]
    if len(pressures) < len(CHAMBERS) or len(recording) < _PRIORS["runs"]:
        return rows
    holds = [runs_of(find_holds(values, recording.rate).flags) for values in pressures]
    channels = list(recording.channels.values())
    for first, length in holds[0].tolist():
        stop = first + length
        begins, ends = holds[1][:, 0], holds[1].sum(axis=1)
        together = np.any((np.abs(begins - first) <= _LONGEST_REPEAT) & (np.abs(ends - stop) <= _LONGEST_REPEAT))
        inner = slice(first + _LONGEST_REPEAT, stop - _LONGEST_REPEAT)
        if (
            together
            and first > 1
            and stop < len(recording)
            and all(_is_constant(values[inner]) for values in channels)
            and not any(_leaps(values, first) for values in channels)
            and any(_leaps(values, stop) for values in channels)
        ):
            rows[first:stop] = True
    return rows


def _is_constant(values: Array) -> bool:
    return bool(np.isnan(values).all() or np.ptp(values) == 0.0)


def _leaps(values: Array, row: int) -> bool:
    """Test whether a channel changes about a sample by more than it does elsewhere between samples."""
    change = np.abs(values[min(row + _LONGEST_REPEAT, len(values) - 1)] - values[max(row - _LONGEST_REPEAT - 1, 0)])
    usual = np.nanquantile(
        np.abs(values[2 * _LONGEST_REPEAT + 1 :] - values[: -2 * _LONGEST_REPEAT - 1]), _PRIORS["leap"]
    )
    return bool(change > usual)


def _moves_in(values: Array, rows: NDArray[np.intp]) -> bool:
    """Test whether a channel moves in the given rows by more than a share of its range."""
    whole, part = values[np.isfinite(values)], values[rows][np.isfinite(values[rows])]
    least: float = _PRIORS["moves"]
    return bool(part.size and np.ptp(part) > least * np.ptp(whole))


def _runs(values: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the first index of each run of equal values (n,), and which runs jump at both ends."""
    starts = np.flatnonzero(np.r_[True, values[1:] != values[:-1]])
    jumps = np.abs(np.diff(values)[starts[1:] - 1]) > _JUMP * quantum(values)
    return starts, np.r_[False, jumps] & np.r_[jumps, False]


def holding_period(t: Array, values: Array) -> float | None:
    """Estimate how long [s] a channel (n,) repeats each sample; None where it is nothing to mend."""
    t, values = t[:_TOLD], values[:_TOLD]
    known = np.isfinite(values) & np.isfinite(t)
    if np.count_nonzero(known) < _PRIORS["runs"]:
        return None
    t, values = t[known], values[known]
    starts, jumps = _runs(values)
    ends = np.r_[starts[1:], values.size]
    lengths, durations = (ends - starts)[jumps], (t[np.minimum(ends, t.size - 1)] - t[starts])[jumps]
    if lengths.size < _PRIORS["runs"] or np.median(lengths) < 2:
        return None
    usual = float(np.median(durations))
    regular = np.abs(durations / usual - 1.0) <= _PRIORS["spread"]
    period = float(durations[regular].mean())
    return period if period >= _PRIORS["shortest"] and np.mean(regular) >= _PRIORS["share"] else None


def _held_samples(t: Array, values: Array, period: float) -> NDArray[np.bool_]:
    """Flag the samples (n,) that repeat an older one, for a channel sampled every `period` [s]."""
    known = np.flatnonzero(np.isfinite(values))
    starts, _ = _runs(values[known])
    times = t[known]
    begun = times[starts][np.searchsorted(starts, np.arange(known.size), side="right") - 1]
    turn = np.floor((times - begun) / period + 1e-6)
    stale = np.zeros(t.size, dtype=bool)
    stale[known[1:]] = (turn[1:] == turn[:-1]) & (begun[1:] == begun[:-1])
    return stale


def _repeated_rows(channels: list[Array]) -> NDArray[np.bool_]:
    """Flag the rows (n,) that repeat the row before in all moving channels."""
    moving = [values for values in channels if np.isfinite(values).any() and np.nanmax(values) > np.nanmin(values)]
    if not moving or moving[0].size < _PRIORS["runs"]:
        return np.zeros(channels[0].size if channels else 0, dtype=bool)
    equal = [values[1:] == values[:-1] for values in moving]
    same = np.r_[False, np.all(equal, axis=0)]
    chance = float(np.prod([np.mean(flags) for flags in equal]))
    edges = np.flatnonzero(np.diff(np.r_[False, same, False].astype(np.int8)))
    first, stop = edges[::2], edges[1::2]
    inner = (stop - first < _LONGEST_REPEAT) & (first > 1) & (stop < same.size)
    first, stop = first[inner], stop[inner]
    jumps = np.zeros(first.size, dtype=bool)
    for values in moving:
        least = _JUMP * quantum(values[np.isfinite(values)])
        jumps |= (np.abs(values[first - 1] - values[first - 2]) > least) & (
            np.abs(values[stop] - values[stop - 1]) > least
        )
    repeated = np.zeros(same.size, dtype=bool)
    if np.count_nonzero(jumps) < _PRIORS["repeats"] * max(chance, _PRIORS["fewest"]) * same.size:
        return repeated
    for begin, end in zip(first[jumps].tolist(), stop[jumps].tolist(), strict=True):
        repeated[begin:end] = True
    return repeated
