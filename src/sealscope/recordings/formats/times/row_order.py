"""Bring the rows of a log into the order of time, where its clock wraps, is set, or begins again.

A logger writes its rows in the order of time, and its clock says otherwise for one of these causes, which are tried in
this order:

1. The clock is of 12 or 24 hours, or a counter of so many bits, and wraps (`Wrap`).
2. Single time stamps are wrong, and are replaced.
3. Rows are written twice, as by a buffer that is written before it is cleared. The copies are dropped.
4. Rows are late, or a ring buffer is written from its first cell on: sorted by their times they follow each other.
5. The clock is set while the signals go on: the rows continue at the usual step.
6. The logger restarts: the parts follow each other in the order of the file, after a pause of unknown length, for which
   `clock.pause` of `priors.toml` is assumed.

Called where files are read (`timebase.time_base`, `table`), and by `corrections.gaps` for other recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.paragraphs import format_count
from sealscope.recordings.channels import Array, summarize_intervals
from sealscope.recordings.priors import RECORDINGS

_PRIORS = RECORDINGS.clock
_HOUR, _DAY = 3600.0, 86400.0  # [s]
#: A wrap is passed within so many median intervals or, if the clock shows that it begins anew, this fraction of it.
_MAX_STEPS, _MAX_FRACTION = 4.0, 0.01
_MIN_WRAP_STEPS = 30.0  # shortest wrap, in median intervals: ordinary intervals look like shorter ones
_MAX_REPAIRS = 10_000  # most steps back that are looked into one by one
_NEIGHBOURS = 200  # samples on either side of a step with which its size is compared
_CONTINUES = 1.5  # largest change of a channel that goes on, over the largest change between these samples
_MAX_CANDIDATES = 4096  # most rows with one time stamp that may be the first of a repeated block
_MAX_WRONG = 3  # most wrong time stamps in succession


class Wrap(NamedTuple):
    """A step by which a clock or counter jumps [s], negative if it jumps back."""

    step: float
    words: str  # predicate of a sentence on the clock
    is_single: bool = False  # True if the clock may jump only once, as to daylight saving time
    begin: float = 0.0  # reading at which the clock begins anew [s]


class ClockEvent(NamedTuple):
    """A defect of the clock, and the correction made for it."""

    code: str
    severity: Literal["note", "warning"]
    number: int  # of rows or of steps of the clock
    row: int  # index, among the ordered rows, of the first row concerned
    text: str  # predicate of a sentence on the time


class OrderedRows(NamedTuple):
    """Rows of a log in the order of time."""

    t: Array  # (m,): times [s], NaN where missing
    rows: NDArray[np.intp] | None  # (m,): index of each row in the log; None if all rows stay where they are
    breaks: tuple[int, ...]  # indices in `t` of the rows before which the clock was set or the logger restarted
    events: tuple[ClockEvent, ...]


def _list_counters() -> tuple[Wrap, ...]:
    """List the wraps of times that are numbers: counters of ticks, and clocks of the day and of the week."""
    ticks = {1e-9: "ns", 1e-7: "100 ns", 1e-6: "us", 1e-5: "10 us", 1e-4: "100 us", 1e-3: "ms", 1e-2: "10 ms"}
    counters = [
        Wrap(-(2.0**bits) * tick, f"counts {words} in {bits} bits: unwrapped", begin=begin * 2.0**bits * tick)
        for tick, words in ticks.items()
        for bits in (16, 24, 31, 32)
        for begin in ((0.0, -0.5) if bits in (16, 32) else (0.0,))  # signed numbers begin anew below zero
        if 2.0**bits * tick > 0.5
    ]
    return (*counters, HALF_DAY, NEXT_DAY, Wrap(-7 * _DAY, "begins again with the week: unwrapped"))


NEXT_HOUR = Wrap(-_HOUR, "has no date: begins again with the next hour")
NEXT_DAY = Wrap(-_DAY, "has no date: begins again with the next day")
LATE_DATE = Wrap(-_DAY, "passes midnight under one date: unwrapped")
#: A clock without AM and PM shows 1:00 after 12:59.
HALF_DAY = Wrap(-_DAY / 2, "is on a clock of 12 hours without AM and PM: unwrapped", begin=_HOUR)
#: With dates, such a clock leaps by a day at midnight, from 11:59 to 12:00 of the next date.
HALF_DAY_MIDNIGHT = Wrap(_DAY, HALF_DAY.words)
SUMMER_TIME = tuple(
    Wrap(step, "steps by an hour: taken for daylight saving time, the hour left out", is_single=True)
    for step in (-_HOUR, _HOUR)
)
COUNTERS = _list_counters()


def order_rows(
    t: Array,
    channels: Sequence[Array],
    wraps: Sequence[Wrap] = (),
    first_reading: float = 0.0,
    space: Callable[[Array], Array] | None = None,
) -> OrderedRows:
    """Bring the rows of a log into the order of time.

    Parameters
    ----------
    t : ndarray of float, shape (n,)
        Times in the order of the file [s], NaN where missing.
    channels : sequence of ndarray, shape (n,)
        Samples of all channels, which show rows that are written twice and signals that go on.
    wraps : sequence of Wrap
        Steps by which the clock may jump.
    first_reading : float
        What the clock shows at t = 0 [s].
    space : callable, optional
        Function that spaces the times of samples that share each reading of a coarse clock. It is applied to each part
        of a log with breaks of the clock, before the parts are put one after the other.

    Returns
    -------
    OrderedRows
        The times do not step back, unless more than the fraction `clock.late` (`priors.toml`) of the rows step back and
        cannot be sorted; then only the wraps are undone.
    """
    may_leap = any(wrap.step > 0.0 for wrap in wraps)
    intervals = summarize_intervals(t)
    if intervals.shortest >= 0.0 and intervals.longest < _PRIORS.leap and not may_leap:
        return OrderedRows(t, None, (), ())
    timed = np.flatnonzero(np.isfinite(t))
    times = t[timed]
    steps = np.diff(times)
    if not steps.size or (steps.min() >= 0.0 and steps.max() < _PRIORS.leap and not may_leap):
        return OrderedRows(t, None, (), ())
    rising = steps[steps > 0.0]
    if not rising.size:
        return OrderedRows(t, None, (), ())
    interval = float(np.median(rising))
    events: list[ClockEvent] = []
    times = _undo_wraps(times, interval, wraps, first_reading, events)
    times = _replace_wrong_times(times, interval, events)
    rows = timed
    if (np.diff(times) < 0.0).any():
        is_copy = _flag_copies(times, [values[timed] for values in channels])
        if is_copy.any():
            n_copies, first = int(np.count_nonzero(is_copy)), int(np.argmax(is_copy))
            text = f"has {format_count(n_copies, 'row')} written twice: the copies are dropped"
            events.append(ClockEvent("rows_written_twice", "note", n_copies, first, text))
            times, rows = times[~is_copy], rows[~is_copy]
        if (order := _find_order(times, interval)) is not None:
            n_back, first = int(np.count_nonzero(np.diff(times) < 0.0)), int(np.argmax(order != np.arange(order.size)))
            text = f"steps back {format_count(n_back, 'time')}: late rows are sorted into the order of time"
            events.append(ClockEvent("rows_sorted", "note", n_back, first, text))
            times, rows = times[order], rows[order]
    steps = np.diff(times)
    starts = _find_breaks(steps, interval) + 1
    space = space if timed.size == t.size else None
    if starts.size > min(_MAX_REPAIRS, _PRIORS.late * times.size):
        starts = starts[:0]  # no order is found
    elif starts.size:
        times, goes_on = _lay_out_parts(times, rows, channels, starts, interval, space)
        events += _describe_breaks(steps[starts - 1], starts, goes_on)
    if rows.size == timed.size and (rows == timed).all():  # rows without a time stay where they are
        result = np.full(t.size, np.nan)
        result[timed] = times
        events = [event._replace(row=int(timed[event.row])) for event in events]
        return OrderedRows(result, None, tuple(timed[starts].tolist()), tuple(events))
    return OrderedRows(times, rows, tuple(starts.tolist()), tuple(events))


def _undo_wraps(
    times: Array, interval: float, wraps: Sequence[Wrap], first_reading: float, events: list[ClockEvent]
) -> Array:
    """Undo the jumps of a clock by the steps in `wraps`, the most frequent first, and add an event for each of these.

    Jumps by the opposite step are undone, too: a date may change some rows too early or too late. `times` (n,) [s] have
    the median `interval` [s].
    """
    counts = [_find_jumps(times, interval, wrap, first_reading).size for wrap in wraps]
    for number in sorted(np.flatnonzero(counts).tolist(), key=lambda number: -counts[number]):
        wrap = wraps[number]
        jumps = _find_jumps(times, interval, wrap, first_reading)
        if not jumps.size or (wrap.is_single and jumps.size > 1):
            continue
        directions = np.zeros(times.size)
        directions[jumps + 1] = 1.0
        if wrap.step < 0.0 and not wrap.is_single:
            directions[_find_jumps(times, interval, wrap._replace(step=-wrap.step), np.nan) + 1] = -1.0
        times = times - wrap.step * np.cumsum(directions)
        events.append(ClockEvent("clock_wrapped", "note", int(jumps.size), int(jumps[0]) + 1, wrap.words))
    return times


def _replace_wrong_times(times: Array, interval: float, events: list[ClockEvent]) -> Array:
    """Replace up to `_MAX_WRONG` successive times by even ones if they are not between their neighbours, which are.

    The times on either side must be as far apart as so many median intervals, to within half of one.
    """
    result, is_wrong = times.copy(), np.zeros(times.size, dtype=bool)
    for length in range(1, _MAX_WRONG + 1):
        before, after = result[: -length - 1], result[length + 1 :]
        fits = np.abs(after - before - (length + 1) * interval) <= 0.5 * interval
        for place in range(1, length + 1):
            inner = result[place : place + before.size]
            fits &= (inner < before) | (inner > after)
        for first in np.flatnonzero(fits).tolist():
            inside = slice(first + 1, first + 1 + length)
            result[inside] = np.linspace(result[first], result[first + length + 1], length + 2)[1:-1]
            is_wrong[inside] = True
    if not is_wrong.any() or np.count_nonzero(is_wrong) > _PRIORS.late * times.size:
        return times
    n_wrong = int(np.count_nonzero(is_wrong))
    text = f"has {format_count(n_wrong, 'wrong time stamp')} among right ones: replaced"
    events.append(ClockEvent("wrong_times", "note", n_wrong, int(np.argmax(is_wrong)), text))
    return result


def _find_jumps(times: Array, interval: float, wrap: Wrap, first_reading: float) -> NDArray[np.intp]:
    """Find the indices of the samples after which a clock jumps by `wrap.step`, to a few usual intervals.

    If the readings before and after the jump are at the two ends of the clock's range, it may also have stood for the
    fraction `_MAX_FRACTION` of the wrap. `first_reading`: reading at t = 0 [s], NaN if unknown.
    """
    size = abs(wrap.step)
    if size < _MIN_WRAP_STEPS * interval:
        return np.empty(0, dtype=np.intp)
    steps = np.diff(times)
    elapsed = steps - wrap.step
    # times are rounded, and samples that share a stamp pass a wrap in no time
    is_jump = (elapsed > -0.5 * interval) & (elapsed <= _MAX_STEPS * interval)
    if wrap.step < 0.0 and np.isfinite(first_reading):
        end = wrap.begin + size - first_reading
        slack = _MAX_FRACTION * size
        is_jump |= (elapsed >= 0.0) & (elapsed <= slack) & (times[:-1] > end - slack) & (times[:-1] < end + interval)
    return np.flatnonzero(is_jump)


def _flag_copies(times: Array, channels: Sequence[Array]) -> NDArray[np.bool_]:
    """Flag the rows (n,) of blocks that repeat the rows just before them: equal times, and equal samples."""
    is_copy = np.zeros(times.size, dtype=bool)
    ends = np.flatnonzero(np.diff(times) < 0.0)  # last rows before the steps back
    if not channels or ends.size > _MAX_REPAIRS:
        return is_copy
    run_starts = np.concatenate([[0], ends + 1])
    for number, end in enumerate(ends.tolist()):
        first, start = end + 1, int(run_starts[number])
        run = times[start:first]
        begin, stop = (start + int(np.searchsorted(run, times[first], side)) for side in ("left", "right"))
        candidates = np.arange(begin, min(stop, begin + _MAX_CANDIDATES))
        for values in channels:
            candidates = candidates[_are_equal(values[candidates], values[first])]
        for candidate in candidates.tolist():
            length = min(first - candidate, times.size - first)
            source, copy = slice(candidate, candidate + length), slice(first, first + length)
            if np.array_equal(times[source], times[copy]) and all(
                _are_equal(values[source], values[copy]).all() for values in channels
            ):
                is_copy[copy] = True
                break
    return is_copy


def _are_equal(values: Array, references: Any) -> NDArray[np.bool_]:
    """Compare samples with reference values one by one; missing ones are equal."""
    return np.asarray((values == references) | (np.isnan(values) & np.isnan(references)))


def _find_order(times: Array, interval: float) -> NDArray[np.intp] | None:
    """Find the order of rows whose sorted times follow each other as in an ordered log; None if they do not.

    Where rows that were apart in the log meet, the mean step must be about the median `interval` [s], and all but the
    fraction `clock.late` (`priors.toml`) of the steps half of it or more, and no gaps: rows of two parts at the same
    time of the clock would be closer, and parts at different times farther apart.
    """
    if not (np.diff(times) < 0.0).any():
        return None
    order = np.argsort(times, kind="stable")
    meets = np.flatnonzero(np.diff(order) != 1)
    steps = np.diff(times[order])[meets] / interval
    lowest, highest = _PRIORS.meet
    is_usual = (steps >= 0.5) & (steps <= highest)
    return order if lowest <= steps.mean() <= highest and np.mean(is_usual) >= 1.0 - _PRIORS.late else None


def _find_breaks(steps: Array, interval: float) -> NDArray[np.intp]:
    """Find the steps (n,) [s] at which a clock was set or begins anew.

    These are steps back, steps over `clock.leap` (`priors.toml`), and steps forward by as much as another step back, as
    of a clock that is wrong for a while. `interval`: median interval [s].
    """
    back = np.flatnonzero(steps < 0.0)
    is_break = (steps < 0.0) | (steps > _PRIORS.leap)
    if back.size:
        sizes = np.sort(interval - steps[back])
        forward = np.flatnonzero(steps > _PRIORS.near * interval)
        excess = steps[forward] - interval
        place = np.clip(np.searchsorted(sizes, excess), 1, max(1, sizes.size - 1))
        nearest = np.minimum(np.abs(excess - sizes[place - 1]), np.abs(excess - sizes[place % sizes.size]))
        is_break[forward] |= nearest <= _MAX_STEPS * interval
    return np.flatnonzero(is_break)


def _lay_out_parts(
    times: Array,
    rows: NDArray[np.intp],
    channels: Sequence[Array],
    starts: NDArray[np.intp],
    interval: float,
    space: Callable[[Array], Array] | None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Put the parts of a log that begin at `starts` one after the other; also flag those in which the signals go on.

    These begin one step after the part before them, the others `clock.pause` [s] (`priors.toml`) later.
    """
    steps = np.diff(times)
    usual_step = interval * np.count_nonzero(steps > 0.0) / steps.size  # from sample to sample, which may share stamps
    parts = np.split(times, starts)
    is_set = np.array([_goes_on(rows, channels, int(start)) for start in starts])
    result = [parts[0] if space is None else space(parts[0])]
    for part, goes_on in zip(parts[1:], is_set.tolist(), strict=True):
        spaced = part if space is None else space(part)
        pause = usual_step if goes_on else max(_PRIORS.pause, _PRIORS.near * 2.0 * usual_step)
        result.append(spaced - spaced[0] + (result[-1][-1] + pause))
    return np.concatenate(result), is_set


def _goes_on(rows: NDArray[np.intp], channels: Sequence[Array], start: int) -> bool:
    """Test whether all channels change from the row before `start` to this row by no more than between other rows."""
    before, after = rows[max(0, start - _NEIGHBOURS) : start], rows[start : start + _NEIGHBOURS]
    n_known = 0
    for values in channels:
        jump = abs(float(values[after[0]] - values[before[-1]]))
        changes = np.abs(np.concatenate([np.diff(values[before]), np.diff(values[after])]))
        changes = changes[np.isfinite(changes)]
        if not np.isfinite(jump) or not changes.size:
            continue
        if jump > _CONTINUES * float(changes.max()):
            return False
        n_known += 1
    return n_known > 1


def _describe_breaks(steps: Array, starts: NDArray[np.intp], is_set: NDArray[np.bool_]) -> list[ClockEvent]:
    """Describe the breaks of a clock by the `steps` (k,) [s] at them, and whether the signals go on there."""
    events = []
    for kind, code in ((True, "clock_set"), (False, "clock_restarted")):
        sizes, firsts = steps[is_set == kind], starts[is_set == kind]
        if not sizes.size:
            continue
        largest = float(sizes[np.argmax(np.abs(sizes))])
        times = format_count(int(sizes.size), "time")
        if kind:
            text = f"is set {times} while the signals go on, by up to {largest:g} s: taken as continuing"
            events.append(ClockEvent(code, "note", int(sizes.size), int(firsts[0]), text))
        else:
            text = (
                f"begins anew {times}, by up to {largest:g} s: the parts follow each other as in the file, "
                f"the pause between them is unknown ({_PRIORS.pause:g} s assumed)"
            )
            events.append(ClockEvent(code, "warning", int(sizes.size), int(firsts[0]), text))
    return events
