"""Build a recording from the series in a file: choose channels, bring them to one clock, convert them to SI units.

A reader of a format lists the series in a file, i.e. its named columns of samples; `build_fields` turns them into the
fields of a recording. Series are in groups, which may have different sampling rates. If several groups have series of
the same name, that in the group with most channels is used. Channels are brought to the clock of the chamber pressures:
slower ones by linear interpolation, faster ones by averages over its intervals. Gaps and ends of a series stay empty.
In a long table, each row has one sample of a named channel, and each name is a series.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.paragraphs import format_count, join_names
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, Array
from sealscope.recordings.formats.cells import MAX_WORD_FRACTION, parse_numbers
from sealscope.recordings.formats.columns import CLOCK_LABEL, ColumnMap, Request, choose_columns
from sealscope.recordings.formats.headings.labels import WORDS, Label, is_time, unit_of_time
from sealscope.recordings.formats.times.row_order import COUNTERS, order_rows
from sealscope.recordings.formats.times.timebase import (
    TimeBase,
    TimeState,
    combine_time_parts,
    find_order,
    interpolate_samples,
    is_falling,
    nominal_rate,
    parse_stamps,
    stated_start,
    time_base,
    timedelta_seconds,
)
from sealscope.recordings.formats.wrapped_angle import unwrap_angle
from sealscope.units import same_dimension, to_si

MAX_VALUES = 2**28  # most values in the used columns of a file: 2 GiB of doubles, 16 hours of 9 channels at 500 Hz
#: Most bytes of a table: the larger of _MIN_LIMIT and _MAX_EXPANSION times its file's size, as fill values expand.
_MIN_LIMIT, _MAX_EXPANSION = 2**26, 4096
#: Most texts in a column, most bytes of each text, and most bytes of all texts together.
_MAX_TEXTS, _MAX_TEXT_WIDTH, _MAX_TEXT_BYTES = 2**22, 400, 2**29
FORMAT_VERSION = 1
#: Channels whose clock all others are brought to, in order of preference.
_BASE_CHANNELS = ("p_A", "p_B", "p_1", "p_2")
_MAX_INTERVAL = 3.0  # longest interval of a slower series that is interpolated, in median intervals
_SAME_CLOCK = 1e-2  # largest difference of equal clocks, as a fraction of an interval
#: Relative difference up to which the written rate of a recording takes precedence over the rate of its time stamps.
_SAME_RATE = 0.01
_MAX_NAMES = 4096  # most names in a long table
_HALF_DAY = np.timedelta64(12, "h")
#: Function that reads columns before their values are used, and returns lines for the history. Arguments: column ->
#: kind of its values, as for `text._Log`; and the column of the date that belongs to the time, or None.
Prepare = Callable[[Mapping[int, str], int | None], Sequence[str]]


@dataclass(frozen=True)
class Clock:
    """Sampling times that one or more series of samples have in common."""

    key: Hashable  # equal for series that are sampled together
    read: Callable[[], tuple[Array, np.datetime64 | None]]  # times (n,) [s], and the time stamp of 0 s, None if unknown

    @classmethod
    def of_times(cls, key: Hashable, t: Array, start: np.datetime64 | None = None) -> Clock:
        """Make a clock from known times `t` (n,) [s], which count from the time stamp `start`, if it is known."""
        return cls(key, lambda: (t, start))


@dataclass(frozen=True)
class Series:
    """A named column of samples in a file, which are read when they are needed."""

    group: str  # name of the series' group, or ""
    label: Label
    count: int  # number of samples
    values: Callable[[], NDArray[Any]]  # reads the samples (n,) as doubles, texts, datetime64 or timedelta64
    clock: Clock | None = None  # sampling times, None if the file does not state them

    @property
    def path(self) -> str:
        """Full name, `group/name` or the name alone without a group, by which a user's column map may refer to it."""
        return f"{self.group}/{self.label.whole}" if self.group else self.label.whole


def uniform_clock(
    key: Hashable, count: int, step: float, first: float = 0.0, start: np.datetime64 | None = None
) -> Clock:
    """Build the clock of `count` samples every `step` [s], the first one `first` [s] after the time stamp `start`.

    `start`: None if unknown. Clocks are equal if `key`, `start` and all numbers are equal.
    """
    return Clock((key, count, step, first, start), lambda: (first + step * np.arange(count, dtype=np.float64), start))


class RecordingFields(NamedTuple):
    """The arguments of `Recording` in their order, without `bridged`; then `kind`, the format of the file in words."""

    t: Array
    channels: dict[str, Array]
    units: dict[str, str]
    rate: float
    provenance: dict[str, Any]
    history: tuple[str, ...]
    kind: str

    def with_note(self, line: str) -> RecordingFields:
        """Return the same fields with a line added at the beginning of the history."""
        return self._replace(history=(line, *self.history))


def build_fields(
    series: Sequence[Series],
    request: Request,
    kind: str,
    remarks: Mapping[str, str] | None = None,
    rate: float | None = None,
    *,
    description: Mapping[str, Any] | None = None,
    prepare: Prepare | None = None,
    size: int | None = None,
) -> RecordingFields:
    """Build the fields of a recording from the series in a file; raise InputError if they do not fit together.

    If no columns can be chosen, the series may form a long table, in which each row is one sample of a named channel.

    - `kind`: format of the file in words; `remarks`: entries in its header.
    - `rate` [Hz]: sampling rate stated by the file, for series without sampling times (`Series.clock`).
    - `description`: rate, provenance and history in a file that Sealscope has written.
    - `prepare`: function that reads all used columns together before their values are needed.
    - `size` [bytes]: size of a file that may be compressed, from which `check_size` limits the number of values.
    """
    candidates, notes = _make_names_unique(_assign_clocks(series))
    labels = [member.label for member in candidates]
    # sampling times of series count as one more column, unless a series is called t
    uses_clock = any(member.clock is not None for member in candidates) and all(label.name != "t" for label in labels)
    try:
        choice = choose_columns([*labels, CLOCK_LABEL] if uses_clock else labels, request, rate)
    except InputError:
        if (long_columns := _find_long_columns([member.label for member in series])) is None:
            raise
        clock_findings: list[dict[str, Any]] = []
        channel_series, more_notes = _pivot_long_table(series, long_columns, prepare, clock_findings)
        table = build_fields(channel_series, request, kind, remarks)  # their values are read already
        findings = {finding["code"]: finding for finding in clock_findings}  # alike for all channels
        provenance = table.provenance | ({"reading": [*findings.values()]} if findings else {})
        return table._replace(history=(*more_notes, *table.history), provenance=provenance)
    # the series to read; `CLOCK_LABEL`, which may come after all series, is not one
    kinds = {column: kind_read for column, kind_read in choice.columns.items() if column < len(candidates)}
    members = {column: candidates[column] for column in kinds}
    if prepare is not None:
        notes += prepare(kinds, choice.date)
    check_size(max(member.count for member in members.values()), len(choice.columns), size)
    clock = dict[str, Any]()
    if choice.time == len(candidates):  # `CLOCK_LABEL`: sampling times of the series, not a column
        columns, more_notes, clock = _align_clocks(choice, members)
        notes = [*notes, *more_notes]
    else:
        last = members[[*kinds][-1]]  # the time, if there is one
        for member in members.values():
            if member.count != last.count:
                required = f"{last.path} ({last.count})"
                raise InputError(f"{member.path} must have as many samples as {required}, got {member.count}")
        columns = {
            column: _read_column(members[column], choice, column, as_time=kinds[column] == "time") for column in kinds
        }
    table = convert_columns(choice, columns, kind, request, notes, remarks=remarks, description=description)
    return table._replace(provenance=table.provenance | clock) if clock else table


def convert_columns(
    choice: ColumnMap,
    columns: dict[int, NDArray[Any]],
    kind: str,
    request: Request,
    notes: Sequence[str] = (),
    *,
    remarks: Mapping[str, str] | None = None,
    description: Mapping[str, Any] | None = None,
    state: TimeState | None = None,
) -> RecordingFields:
    """Convert the columns that were read from a table to the fields of a recording.

    - `columns`: column -> values (n,), doubles or, for the time, datetime64; it loses the columns that are converted,
      so that a long log is not held twice. `notes`: lines for the history.
    - `kind`, `remarks`, `description`: as for `build_fields`.
    - `state`: state of the time column after the previous part of a text log, which is updated; None for a whole log.

    Rows that begin with the last sample are reversed. Raises InputError without rows, and for dates in place of times.
    """
    label, start, clock = choice.time_label, dict[str, Any](), dict[str, Any]()
    remarks = remarks or {}
    count = len(next(iter(columns.values())))
    if count == 0:
        raise InputError("a recording must have samples, got a header and no rows")
    notes = [*notes, *choice.notes]
    time = np.empty(0)
    if choice.time is not None and label is not None:
        time = columns[choice.time]
        if choice.parts:
            time = _join_time(choice, columns, label, notes)
        if choice.time == choice.date and not _has_time_of_day(time):
            raise InputError(
                "a recording must have a time column such as t [s] or be given a rate, "
                f"got dates alone in column {label.whole}"
            )
        if description is None and is_falling(time):  # what Sealscope has written is read back unchanged
            time, columns = time[::-1], {column: cells[::-1] for column, cells in columns.items()}
            notes.append("rows begin with the last sample: taken in the order of time")
    channels, units, log_units = _convert_channels(choice, columns)
    if label is None:
        assert choice.rate is not None
        t, rate = np.arange(count) / choice.rate, choice.rate
    elif description is not None and request.file and not request.map:
        # a map may choose another time column; in a data frame, i.e. without a file, rows may have been removed
        t, rate = time, description["rate"]
    else:
        base = time_base(time, label.unit, label.whole, choice.rate, state, list(channels.values()))
        t, rate, start = base.t, base.rate, base.start
        notes += base.notes
        clock = _describe_clock(base, label.whole)
        if base.rows is not None:
            time, channels = time[base.rows], {name: values[base.rows] for name, values in channels.items()}
        if description is not None and abs(rate / description["rate"] - 1.0) <= _SAME_RATE:
            rate = description["rate"]
    if description is not None:  # a recording that Sealscope has written states its provenance itself
        provenance = description["provenance"] | clock
        return RecordingFields(t, channels, units, rate, provenance, (*description["history"], *notes), kind)
    path = request.path or Path(request.file)
    order = find_order(path)
    if not start:
        start, start_notes = stated_start(remarks, path, order, _find_time_of_day(time, t))
        notes += start_notes
    details = {"file": request.file, "name_order": order, "format": kind, **start, "about": dict(remarks)}
    details |= {"columns": choice.names}
    details |= {"unused": list(choice.unused), "unused_temperatures": list(choice.unused_temperatures)}
    details |= {"log_units": log_units, **clock}
    # no empty ones, but a start of 0
    provenance = {key: value for key, value in details.items() if value or key in start}
    return RecordingFields(t, channels, units, rate, provenance, tuple(notes), kind)


def _describe_clock(base: TimeBase, name: str) -> dict[str, Any]:
    """Describe the events and breaks of the clock in column `name` for the provenance, where `quality` finds them."""
    if not base.events:
        return {}
    findings = [
        {
            "code": event.code,
            "severity": event.severity,
            "count": event.number,
            "first_t": float(base.t[min(event.row, base.t.size - 1)]),
            "text": f"column {name} {event.text}",
        }
        for event in base.events
    ]
    return {"reading": findings, "clock_breaks": [float(base.t[row]) for row in base.breaks]}


def _convert_channels(
    choice: ColumnMap, columns: dict[int, NDArray[Any]]
) -> tuple[dict[str, Array], dict[str, str], dict[str, str]]:
    """Convert the chosen channels of a table, column -> values (n,), to SI units or counts; drop columns after use.

    Returns channel -> values (n,), channel -> unit, and channel -> unit in the log where this differs.
    """
    channels, units, log_units = {}, {}, {}
    n_uses = Counter(column for formula in choice.channels.values() for column in formula.columns)
    for name, formula in choice.channels.items():
        unit = formula.unit or COUNTS
        units[name] = COUNTS if unit == COUNTS else CHANNEL_UNITS[name]
        if unit != units[name]:
            log_units[name] = unit
        channels[name] = to_si(formula.values(columns), unit, units[name], name=name)
        if not any(channels[name] is cells for cells in columns.values()):  # not an array of the caller
            channels[name].setflags(write=False)  # so that the recording does not copy it
        for column in formula.columns:
            n_uses[column] -= 1
            if not n_uses[column]:
                del columns[column]
    return channels, units, log_units


def _join_time(choice: ColumnMap, columns: Mapping[int, NDArray[Any]], label: Label, notes: list[str]) -> NDArray[Any]:
    """Combine the columns that form the time, such as date and hours, and add a line for the history to `notes`.

    If their values cannot be parts of one time, the time column is returned unchanged, or InputError is raised if it is
    the column of hours. `columns`: column -> values (n,); `label`: heading of the time column.
    """
    assert choice.time is not None
    parts = {part: np.asarray(columns[column], dtype=np.float64) for part, column in choice.parts.items()}
    time = combine_time_parts(columns[choice.time], parts, label.unit)
    if time is not None:
        notes.append(f"time joined from {label.whole} and its parts: {', '.join(parts)}")
        return time
    if choice.time == choice.parts.get("hour"):
        raise InputError(
            f"a time must have whole hours below 24, and whole minutes and seconds below 60, got others in columns "
            f"{label.whole}"
        )
    notes.append(f"{', '.join(parts)} not used: not parts of the seconds in column {label.whole}")
    return columns[choice.time]


def _find_time_of_day(time: NDArray[Any], t: Array) -> np.timedelta64 | None:
    """Find the time of the day at 0 s from time stamps (n,) and the times `t` (n,) [s]; None without stamps."""
    if time.dtype.kind != "M" or not (known := np.flatnonzero(~np.isnat(time))).size:
        return None
    stamp = time[known[0]].astype("datetime64[ns]")
    zero = stamp - np.timedelta64(round(float(t[known[0]]) * 1e9), "ns")
    return np.timedelta64(zero - zero.astype("datetime64[D]").astype("datetime64[ns]"), "ns")


def _has_time_of_day(time: NDArray[Any]) -> bool:
    """Test whether `time` (n,) has a date stamp with a time of day other than midnight; False for numbers."""
    known = time[~np.isnat(time)] if time.dtype.kind == "M" else time[:0]  # numbers: no stamps
    return not (known == known.astype("datetime64[D]").astype(known.dtype)).all()


def _assign_clocks(series: Sequence[Series]) -> list[Series]:
    """Assign sampling times to the series that have none, from the column of times in the same group of the file.

    Only series with as many samples as this column get its times. The columns of times are then left out. If only one
    group has such a column, it stays, as the time of all groups. A series that is alone in its group gets the group's
    name if its own name says nothing, such as `data` or `value`.
    """
    time_of_group: dict[str, Series] = {}
    for member in series:
        if member.clock is None and is_time(member.label):
            time_of_group.setdefault(member.group, member)
    time_of_group = time_of_group if len(time_of_group) > 1 else {}
    members = [member for member in series if member is not time_of_group.get(member.group)]
    group_sizes = Counter(member.group for member in members)
    result = []
    for member in members:
        group, label, time = member.group, member.label, time_of_group.get(member.group)
        if label.name.casefold() in WORDS["generic"] and group and group_sizes[group] == 1:
            group_label = Label.parse(group.rpartition("/")[2], label.unit)
            member = replace(member, label=replace(group_label, whole=label.whole))  # noqa: PLW2901
        if time is not None and member.clock is None and time.count == member.count:
            clock = Clock(("times of", group), partial(read_times, time))
            member = replace(member, clock=clock)  # noqa: PLW2901
        result.append(member)
    return result


def read_times(time: Series, start: np.datetime64 | None = None) -> tuple[Array, np.datetime64 | None]:
    """Read the series `time`, a column of times; return the times (n,) [s] and the time stamp of 0 s.

    Date stamps are converted to seconds from the first one, which is then the time stamp of 0 s. For numbers and
    timedelta64 it is `start`, None if unknown. Raises InputError if no row has a time.
    """
    values = time.values()
    if values.dtype.kind == "m":
        return timedelta_seconds(values), start
    if values.dtype.kind in "OSU":
        values = _read_samples(time, as_time=True)
    known = values[~np.isnat(values) if values.dtype.kind == "M" else np.isfinite(values)]
    if not known.size:
        expected = "a stamp" if values.dtype.kind == "M" else "a number"
        raise InputError(f"time must have {expected} in some row, got none in column {time.label.whole}")
    if values.dtype.kind == "M":
        return timedelta_seconds(values - known[0]), known[0]
    unit = time.label.unit or unit_of_time(time.label) or "s"
    return to_si(np.asarray(values, dtype=np.float64), unit, "s", name="time"), start


def _make_names_unique(series: Sequence[Series]) -> tuple[list[Series], list[str]]:
    """Give each series of a file a unique name; return the series, and lines for the history.

    Of series with one name, that in the group with most channels or, among equal groups, with most samples keeps it;
    the others are called by their paths, `group/name`. If no series has a group, all stay as they are.
    """
    if all(member.group == "" for member in series):
        return list(series), []
    channel_names = {name.casefold() for name in CHANNEL_UNITS}
    n_channels = Counter(member.group for member in series if member.label.name.casefold() in channel_names)
    n_samples = Counter[str]()
    for member in series:
        n_samples[member.group] += member.count
    names = [member.label.name.casefold() for member in series]
    preferred: dict[str, Series] = {}  # name -> the series that keeps it
    for member in sorted(series, key=lambda member: (-n_channels[member.group], -n_samples[member.group])):
        preferred.setdefault(member.label.name.casefold(), member)
    ambiguous = {name for name, count in Counter(names).items() if count > 1} & channel_names
    notes = []
    if ambiguous:
        group = preferred[min(ambiguous)].group  # of one of these channels, as it often has all
        other_groups = join_names(dict.fromkeys(member.group for member in series if member.group != group), 4)
        notes.append(f"channels of group {group} read, not those of the same name of {other_groups}")
    members = []
    for name, member in zip(names, series, strict=True):
        unique_name = member.label.name if preferred[name] is member else member.path
        members.append(replace(member, group="", label=Label(member.path, unique_name, member.label.unit)))
    return members, notes


def _read_column(series: Series, choice: ColumnMap, column: int, *, as_time: bool = False) -> NDArray[Any]:
    """Read the samples (n,) of a chosen column as `_read_samples`; NaN if it may hold words, and does."""
    try:
        return _read_samples(series, as_time=as_time, any_cell=choice.cells == "any" and not as_time)
    except InputError:
        if column not in choice.wordy:
            raise
        return np.full(series.count, np.nan)


def _read_samples(series: Series, *, as_time: bool = False, any_cell: bool = False) -> NDArray[Any]:
    """Read the samples (n,) of a series as doubles; with `as_time`, read date stamps as datetime64.

    Durations become seconds. In a column of texts, words become NaN if they are at most the fraction
    `MAX_WORD_FRACTION` of the cells. Raises InputError for more words, and for other types; with `any_cell`, the
    samples of such a column are missing.
    """
    if any_cell:
        try:
            return _read_samples(series)
        except InputError:
            return np.full(series.count, np.nan)
    values = series.values()
    if values.dtype.kind in "OSU":
        cells = [str(cell) for cell in values.tolist()]
        with suppress(ValueError):
            if as_time:
                return parse_stamps(cells)
        values, words = parse_numbers(cells, ".", lambda index: f"(row {index + 1}, {series.path})")
        if len(words) > MAX_WORD_FRACTION * len(cells):
            raise InputError(f"{series.path} must hold numbers, got text")
        return values
    if values.dtype.kind == "M" and as_time:
        return values.astype("datetime64[ns]")
    if values.dtype.kind == "m":
        return timedelta_seconds(values)
    if values.dtype.kind not in "fiub":
        raise InputError(f"{series.path} must hold numbers, got the type {values.dtype}")
    return np.asarray(values, dtype=np.float64)


def _align_clocks(
    choice: ColumnMap, used: dict[int, Series]
) -> tuple[dict[int, NDArray[Any]], list[str], dict[str, Any]]:
    """Resample the columns to read, column -> series in `used`, to the sampling times of the chamber pressures.

    Without chamber pressures, the times are those of the pressures at the pump, or of the longest series. Rows without
    a time are left out. Returns column -> values (n,), including the time, lines for the history, and entries for the
    provenance on a clock that wraps. Raises InputError if no series has sampling times, or one without them has another
    number of samples.
    """
    channel_of = choice.channel_of
    rank = {channel: number for number, channel in enumerate(_BASE_CHANNELS)}
    # the chamber pressures first, then the longest series
    ranked = sorted(used, key=lambda column: (rank.get(channel_of[column], len(rank)), -used[column].count))
    base = next((used[column] for column in ranked if used[column].clock is not None), None)
    if base is None or base.clock is None:
        names = ", ".join(used[column].path for column in ranked)
        raise InputError(f"a channel must have a clock or be given a rate, got none for {names}")
    t, start = base.clock.read()
    clock: dict[str, Any] = {}
    findings: list[dict[str, Any]] = []
    if any(member.clock is not None and member.clock.key != base.clock.key for member in used.values()):
        t, clock = _unwrap_clock(t, base.path)
    known = np.isfinite(t)
    columns: dict[int, NDArray[Any]] = {}
    notes: list[str] = []
    for column, member in used.items():
        values = _read_column(member, choice, column)
        if member.clock is None and member.count != base.count:
            raise InputError(
                f"{member.path} must have a clock or as many samples as {base.path} ({base.count}), got {member.count}"
            )
        if member.clock is not None and member.clock.key != base.clock.key:
            if channel_of[column] == "theta":
                values, finding = _unwrap_angle(values, member, choice.channels["theta"].unit or COUNTS)
                findings += finding
            if np.isnan(values).all():
                columns[column] = np.full(np.count_nonzero(known), np.nan)
                continue
            values, note = _resample(values, member, t[known], start)
            notes += [f"{channel_of[column]} {note}"] if note else []
        # resampled values are already at the known times only
        columns[column] = values if len(values) == np.count_nonzero(known) else values[known]
    t = t[known]
    assert choice.time is not None
    columns[choice.time] = (
        t if start is None else start.astype("datetime64[ns]") + np.round(t * 1e9).astype("timedelta64[ns]")
    )
    entries = [*clock.get("reading", []), *findings]
    return columns, notes, {"reading": entries} if entries else {}


def _unwrap_angle(values: Array, member: Series, unit: str) -> tuple[Array, list[dict[str, Any]]]:
    """Unwrap the angle (n,) in `unit` of the series `member` before it is resampled; also return findings on it.

    An angle whose turns are ambiguous becomes missing.
    """
    assert member.clock is not None
    t, _ = member.clock.read()
    scale = 1.0 if same_dimension(unit, COUNTS) else to_si(1.0, unit, "rad")
    angle = unwrap_angle(values * scale, COUNTS if same_dimension(unit, COUNTS) else "rad", t)
    if angle is None:
        return values, []
    is_known = angle.values is not None
    text = f"theta: begins anew after {angle.period / scale:.6g} {unit}, {format_count(angle.leaps.size, 'time')}: "
    text += "unwrapped" if is_known else "turns of half of it or more from sample to sample are ambiguous, left out"
    finding: dict[str, Any] = {
        "code": "angle_unwrapped" if is_known else "angle_ambiguous",
        "text": text,
        "channel": "theta",
    }
    count, first_t = int(angle.leaps.size), float(t[angle.leaps[0]])
    finding |= {"severity": "note" if is_known else "warning", "count": count, "first_t": first_t}
    return np.full(values.size, np.nan) if angle.values is None else angle.values / scale, [finding]


def _unwrap_clock(t: Array, name: str) -> tuple[Array, dict[str, Any]]:
    """Undo the wraps of the times `t` (n,) [s] of the series `name`; also return entries on them for the provenance.

    Raises InputError if the times step back otherwise, as the clocks of several series then cannot be compared.
    """
    ordered = order_rows(t, (), COUNTERS)
    if ordered.rows is not None or ordered.breaks:
        raise InputError(f"the times of {name} must increase, as others have a clock of their own, got steps back")
    base = TimeBase(ordered.t, 1.0, {}, [], None, ordered.events, ())
    return ordered.t, _describe_clock(base, name)


def _resample(values: Array, member: Series, t: Array, start: np.datetime64 | None) -> tuple[Array, str]:
    """Resample the samples `values` of the series `member` to the times `t` (n,) [s] after the time stamp `start`.

    Samples that are slower than `t` or equally fast are interpolated linearly, with NaN within long intervals and
    beyond the ends; faster ones are averaged around the times. Samples that have the times `t` already are returned
    unchanged. If the start of either clock is unknown, both are assumed to count from one moment. Also returns a note
    for the history, or "". Raises InputError unless the series has two values or more, at increasing times.
    """
    assert member.clock is not None
    times, member_start = member.clock.read()
    times, _ = _unwrap_clock(times, member.path)
    if member_start is not None and start is not None:
        times = times + timedelta_seconds(member_start - start)
    timed = np.isfinite(times)
    times, values = times[timed], values[timed]
    tolerance = _SAME_CLOCK * (np.median(np.diff(t)) if t.size > 1 else 0.0)
    if times.shape == t.shape and np.all(np.abs(times - t) <= tolerance):
        return values, ""
    present = np.isfinite(values)
    times, values = times[present], values[present]
    if times.size < 2 or not np.all(np.diff(times) > 0):
        raise InputError(f"the times of {member.path} must increase, got times that do not")
    rate, base_rate = nominal_rate(times), nominal_rate(t)
    if rate > base_rate:
        note = f"at {rate:g} Hz: averaged over each interval of {base_rate:g} Hz"
        return _average(values, times, t, 1.0 / base_rate), note
    note = f"at {rate:g} Hz: interpolated linearly to {base_rate:g} Hz"
    return interpolate_samples(t, times, values, _MAX_INTERVAL), note


def _average(values: Array, times: Array, t: Array, step: float) -> Array:
    """Average `values` (m,) at `times` (m,) over intervals of length `step` [s] centred at `t` (n,); NaN if empty."""
    begin, end = np.searchsorted(times, t - 0.5 * step), np.searchsorted(times, t + 0.5 * step)
    sum_before = np.concatenate(([0.0], np.cumsum(values)))  # sum of the values before each index
    with np.errstate(invalid="ignore"):
        return np.asarray((sum_before[end] - sum_before[begin]) / np.where(end > begin, end - begin, np.nan))


def _find_long_columns(labels: Sequence[Label]) -> dict[str, int] | None:
    """Find the columns of a long table, in which each row is one sample of a named channel; None for other tables.

    Returns "name", "value" and, if they exist, "unit" and "valid" -> index of the column.
    """
    names = [label.name.strip().casefold() for label in labels]
    columns_of_kind = {
        kind: [column for column, name in enumerate(names) if name in words] for kind, words in WORDS["long"].items()
    }
    first_columns = {kind: columns[0] for kind, columns in columns_of_kind.items() if columns}
    if "_field" in names:  # of InfluxDB, which may also have a column called name
        first_columns["name"] = names.index("_field")
    return first_columns if {"name", "value"} <= set(first_columns) else None


def _read_long_channel(
    choice: ColumnMap,
    table: Mapping[int, NDArray[Any]],
    value_column: int,
    label: Label,
    clock_findings: list[dict[str, Any]],
    rows: NDArray[np.intp],
) -> tuple[Array, Array, np.datetime64 | None]:
    """Read a channel of a long table, in which each row is one sample of a named channel; `rows` (k,) are its rows.

    Returns its values (n,), times (n,) [s] and the time stamp of 0 s, None if unknown. Times of day without a date
    count from the first of the table. `choice`: the time column, and the values as the only channel `u`, in counts
    (`_count_request`); `table`: column -> cells; `value_column`: column of the values. Rows without a time are left
    out. What is found about the clock is added to `clock_findings`. Raises InputError for too many words, and if the
    logger restarted: the channels, each with times of its own, would then not fit together.
    """
    assert choice.time is not None
    times = table[choice.time]
    is_known = ~np.isnat(times) if times.dtype.kind == "M" else np.isfinite(times)
    timed_rows = rows[is_known[rows]]
    columns = {column: cells[timed_rows] for column, cells in table.items()}
    is_word = np.isinf(columns[value_column])  # a column of the kind "any" has inf in place of words
    if np.count_nonzero(is_word) > MAX_WORD_FRACTION * is_word.size:
        raise InputError(f"{label.whole[:40]} must hold numbers, got text")
    columns[value_column][is_word] = np.nan
    fields = convert_columns(choice, columns, "", _count_request(value_column))
    t, start = fields.t, None
    clock_findings += fields.provenance.get("reading", [])
    if breaks := fields.provenance.get("clock_breaks"):
        raise InputError(
            f"the times of a long table must not step back, got a break of the clock at {breaks[0]:g} s of "
            f"{label.whole[:40]}: cut the table there"
        )
    if "start_epoch_s" in fields.provenance:
        start = np.datetime64(round(fields.provenance["start_epoch_s"] * 1e9), "ns")
    elif "start" in fields.provenance:
        start = np.datetime64(fields.provenance["start"]).astype("datetime64[ns]")
    elif times.dtype.kind == "M":  # times of day without a date
        first = -1 if is_falling(times[timed_rows]) else 0  # falling times are read in reverse
        delay = times[timed_rows][first] - times[is_known][first]  # from the first time in the table
        t = t + timedelta_seconds((delay + _HALF_DAY) % (2 * _HALF_DAY) - _HALF_DAY)  # across midnight, if nearer
    return fields.channels["u"], t, start


def _count_request(value_column: int) -> Request:
    """Request the column of values of a long table as a channel `u` in counts, so that the values are not converted."""
    return Request({"u": f"#{value_column + 1} count"})


def _pivot_long_table(
    series: Sequence[Series],
    column_by_kind: Mapping[str, int],
    prepare: Prepare | None,
    clock_findings: list[dict[str, Any]],
) -> tuple[list[Series], list[str]]:
    """Make a series for each channel of a table in which each row is one sample of a named channel.

    `column_by_kind`: as from `_find_long_columns`; `prepare`: as for `build_fields`; `clock_findings`: list to which
    the findings on the clock are added when a channel is read. Values with a 0 in the column
    "valid" become NaN. Also returns lines for the history. Raises InputError without a time, or for too many names.
    """
    value_column, validity_column = column_by_kind["value"], column_by_kind.get("valid")
    text_columns = [column_by_kind[kind] for kind in ("name", "unit") if kind in column_by_kind]
    # names and units are not to be chosen as channels or times
    labels = [Label("", "") if column in text_columns else member.label for column, member in enumerate(series)]
    if "timestring" in {label.name.casefold() for label in labels}:  # WinCC's exact times, in 1e-6 days
        days = Label("Time_ms", "t", "microday since 1899-12-30")
        labels = [days if label.name.casefold() == "time_ms" else label for label in labels]
    choice = choose_columns(labels, _count_request(value_column))
    assert choice.time is not None  # `choose_columns` raises InputError without a time
    choice.notes.clear()  # they are about `u`, which stands for each channel in turn
    kinds = dict.fromkeys(text_columns, "texts") | ({} if validity_column is None else {validity_column: "any"})
    kinds |= choice.columns | {value_column: "any"}  # "any": numbers, with inf in place of words
    kinds[choice.time] = kinds.pop(choice.time)  # the time comes last
    notes = [*prepare(kinds, choice.date)] if prepare else []
    columns = {column: _read_samples(series[column], as_time=kind == "time") for column, kind in choice.columns.items()}
    if validity_column is not None:
        invalid = _read_samples(series[validity_column]) == 0.0
        columns[value_column] = np.where(invalid, np.nan, columns[value_column])
        note = f"{format_count(int(np.count_nonzero(invalid)), 'value')} that the file calls invalid read as missing"
        notes += [note] if invalid.any() else []
    texts = [np.array([str(cell).strip() for cell in series[column].values().tolist()]) for column in text_columns]
    # a name with different units is several channels: join name and unit
    row_keys = np.char.add(np.char.add(texts[0], "\n"), texts[1]) if len(texts) > 1 else texts[0]
    keys, first_rows, key_of_row = np.unique(row_keys, return_index=True, return_inverse=True)
    if len(keys) > _MAX_NAMES:
        raise InputError(f"a long table must have at most {_MAX_NAMES} names, got more")
    # the rows of the first key, then of the second, ...
    rows_by_key = np.split(np.argsort(key_of_row, kind="stable"), np.cumsum(np.bincount(key_of_row))[:-1])

    def make_series(number: int, label: Label) -> Series:
        """Make the series of the channel with this number, which is read when it is needed."""
        rows = rows_by_key[number]
        read_channel = cache(partial(_read_long_channel, choice, columns, value_column, label, clock_findings, rows))
        return Series("", label, rows.size, lambda: read_channel()[0], Clock(number, lambda: read_channel()[1:]))

    result = []
    for number in np.argsort(first_rows).tolist():  # in the order of their first rows
        name, _, unit = str(keys[number]).partition("\n")
        if name or unit:
            result.append(make_series(number, Label.parse(name[:200], unit[:40] or None)))
    n_rows, n_names = format_count(len(key_of_row), "row"), format_count(len(result), "name")
    return result, [*notes, f"long table: {n_rows} of {n_names}"]


def check_size(n_rows: int, n_columns: int, file_size: int | None = None) -> None:
    """Raise InputError if a table has more than `MAX_VALUES` values, or more than its file can hold.

    A file, which may be compressed, can hold doubles of up to `_MAX_EXPANSION` times its size [bytes], or of
    `_MIN_LIMIT` [bytes] if this is more. Without `file_size`, only the first limit applies.
    """
    if n_rows * n_columns > MAX_VALUES:
        raise InputError(
            f"a recording must have at most {MAX_VALUES} values in the columns used (2 GiB), got {n_rows} rows of "
            f"{n_columns}: cut it into parts"
        )
    if file_size is not None and 8 * n_rows * n_columns > max(_MIN_LIMIT, _MAX_EXPANSION * file_size):
        raise InputError(
            f"a recording must hold its samples, got {n_rows} rows of {n_columns} in a file of {file_size} bytes"
        )


def check_texts(count: int, width: int, name: str) -> None:
    """Raise InputError if `count` texts of up to `width` [bytes] in the column `name` are too many or too long."""
    if count > _MAX_TEXTS or width > _MAX_TEXT_WIDTH or count * width > _MAX_TEXT_BYTES:
        raise InputError(
            f"{name} must hold numbers, or at most {_MAX_TEXTS} texts of {_MAX_TEXT_WIDTH} bytes, "
            f"got {count} of {width}"
        )


def make_description(rate: float, provenance: Mapping[str, Any], history: Sequence[str]) -> dict[str, Any]:
    """Collect the rate, provenance and history of a recording as JSON values; raise InputError for other types."""
    description = {"format": FORMAT_VERSION, "rate": rate, "provenance": dict(provenance), "history": list(history)}
    try:
        return json.loads(json.dumps(description, default=_convert_numpy))  # type: ignore[no-any-return]
    except (TypeError, ValueError) as error:
        raise InputError(f"provenance must hold JSON values only: {error}") from None


def _convert_numpy(value: Any) -> Any:
    """Convert a numpy number or array to a JSON value; raise TypeError for other values."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"got a {type(value).__name__}")


def parse_description(source: str | bytes | Mapping[str, Any]) -> dict[str, Any]:
    """Parse a description from `make_description` to "rate" [Hz], "provenance" and "history".

    Raises InputError if it is damaged, or of a newer version.
    """
    try:
        parsed = source if isinstance(source, Mapping) else json.loads(source)
        version, rate = int(parsed["format"]), float(parsed["rate"])
        provenance, history = dict(parsed["provenance"]), [str(line) for line in parsed["history"]]
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError) as error:
        raise InputError("the recording's description must be whole, got damaged JSON") from error
    if version > FORMAT_VERSION:
        raise InputError(f"format must be at most {FORMAT_VERSION}, got {version}: it was written by newer software")
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"rate must be > 0 Hz, got {rate}")
    return {"rate": rate, "provenance": provenance, "history": history}
