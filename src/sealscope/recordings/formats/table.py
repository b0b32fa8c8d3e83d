"""One way from a file to a recording: series with units, of which a map chooses, on one clock, in SI units.

A reader of a format lists the series of a file; `table_of` makes their table. A file may hold groups of series that are
sampled at different rates. A name that occurs in several groups stands for the series in the group that holds most
channels. Channels of different clocks are brought to the clock of the chamber pressures: a slower one is interpolated
linearly, a faster one is averaged over the base's intervals, and nothing is put into a gap of a series or before its
first and after its last sample. In a long table, where a row is a sample of one channel, each name is a series.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, Array
from sealscope.recordings.formats.columns import ColumnMap, choose_columns, counted, listed
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import exported_from
from sealscope.recordings.formats.headings.proposal import is_time, unit_of_time
from sealscope.recordings.formats.headings.split_time import joined_time
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.recordings.formats.timebase import falling, nominal_rate, stamps, time_base
from sealscope.units import to_si

#: Most values that one file may hold in the columns used: 2 GiB of doubles, 16 hours of 9 channels at 500 Hz.
MAX_VALUES = 2**28
#: A table up to this many bytes may be a fill value alone; a larger one at most this many times its file.
_SMALL, _EXPANSION = 2**26, 4096
_MOST_TEXTS, _WIDEST_TEXT, _MOST_TEXT = 2**22, 400, 2**29
FORMAT_VERSION = 1
#: Share of a column's cells that may hold a word, as loggers write where the input overflows.
MOST_WORDS = 0.01
#: The clock of a file among the columns: what stands for it where no column is mapped to `t`.
CLOCK_LABEL = Label("t [s]", "t", "s")
#: Channels whose clock is the base, most telling first.
_BASE = ("p_A", "p_B", "p_1", "p_2")
#: A slower series is not interpolated between samples that are this many of its usual intervals apart.
_GAP = 3.0
#: Clocks that differ by less than this share of an interval are one.
_SAME = 1e-2
_MOST_NAMES = 4096
#: Decides from a table's labels, and the rate that the file states where it does, which columns are read.
Choose = Callable[..., ColumnMap]
#: Reads columns, each as "numbers", "any" numbers with words among them, which are infinite, a "time" or "texts",
#: before their values are asked for, with the column of the date beside the time; returns lines for the history.
Prepare = Callable[[Sequence[tuple[int, str]], int | None], Sequence[str]]


@dataclass(frozen=True)
class Clock:
    """When samples were taken: `key` is equal for series that were sampled together.

    `read`: returns the times (n,) [s] and the moment 0, or None where it is not known.
    """

    key: Hashable
    read: Callable[[], tuple[Array, np.datetime64 | None]]


@dataclass(frozen=True)
class Series:
    """A named series of a file.

    `group`: what the file calls its group, or an empty text; `count`: samples; `values`: reads the samples (n,):
    doubles, text or datetime64; `clock`: None where the file does not say when they were taken.
    """

    group: str
    label: Label
    count: int
    values: Callable[[], NDArray[Any]]
    clock: Clock | None = None

    @property
    def path(self) -> str:
        """Name with the group before it, as a map may call it."""
        return f"{self.group}/{self.label.whole}" if self.group else self.label.whole


def uniform(key: Hashable, count: int, step: float, first: float = 0.0, start: np.datetime64 | None = None) -> Clock:
    """Return the clock of `count` samples every `step` [s], the first at `first` [s] after `start`."""
    return Clock((key, count, step, first, start), lambda: (first + step * np.arange(count, dtype=np.float64), start))


class RecordingFields(NamedTuple):
    """What a recording is made of, in the order of its arguments."""

    t: Array
    channels: dict[str, Array]
    units: dict[str, str]
    rate: float
    provenance: dict[str, Any]
    history: tuple[str, ...]


@dataclass(frozen=True)
class RawTable:
    """The chosen columns of a table, in the units of the table.

    `kind`: the format, in words; `columns`: the columns of `choice.columns`, each (n,) doubles, the time doubles or
    datetime64; `description`: what Sealscope itself wrote beside the numbers, or None; `notes`: lines for the history;
    `about`: what the file says of the recording beside the samples.
    """

    kind: str
    choice: ColumnMap
    columns: Sequence[NDArray[Any]]
    description: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()
    about: Mapping[str, str] = field(default_factory=dict)

    def samples(self, source: Mapping[str, Any], *, rate: float | None, infer_rate: bool) -> RecordingFields:
        """Convert to SI. `source`: begins the provenance of a foreign table; `rate` [Hz]: where there is no time.

        `infer_rate`: from the time, although the description has one. Raises InputError.
        """
        choice, own, read = self.choice, self.description, self.columns
        count = len(read[0])
        if count == 0:
            raise InputError("a recording must have samples, got a header and no rows")
        notes = (*self.notes, *choice.notes)
        if choice.parts:
            read, more = self._joined()
            notes += more
        if choice.time is not None and choice.time == choice.date and not _has_clock(read[-1]):
            whole = "" if choice.time_label is None else choice.time_label.whole
            raise InputError(
                "a recording must have a time column such as t [s] or be given a rate, "
                f"got dates alone in column {whole}"
            )
        if choice.time_label is not None and own is None and falling(read[-1]):
            read = [cells[::-1] for cells in read]
            notes += ("rows begin with the last sample: taken in the order of time",)
        values = {column: cells for (column, time), cells in zip(choice.columns, read, strict=True) if not time}
        channels, units = {}, {}
        for name, made in choice.channels.items():
            unit = made.unit or COUNTS
            units[name] = COUNTS if unit == COUNTS else CHANNEL_UNITS[name]
            channels[name] = to_si(made.values(values), unit, units[name], name=name)
            if channels[name] is not values[made.column]:
                channels[name].setflags(write=False)  # made here: a recording takes it as it is
        start: dict[str, Any] = {}
        if choice.time_label is None:
            rate = choice.rate if rate is None else rate
            assert rate is not None
            t = np.arange(count) / rate
        elif own is not None and not infer_rate:
            t, rate = read[-1], own["rate"]
        else:
            label = choice.time_label
            t, rate, start, more = time_base(read[-1], label.unit, label.whole, choice.rate)
            notes += more
            if not start and (begin := exported_from(self.about)) is not None:
                start = {"start": str(begin)}
        if own is not None:
            return RecordingFields(t, channels, units, rate, own["provenance"], (*own["history"], *notes))
        about = {"about": dict(self.about), "columns": dict(choice.names), "unused": list(choice.unused)}
        said = {key: value for key, value in about.items() if value}
        return RecordingFields(t, channels, units, rate, {**source, "format": self.kind, **start, **said}, notes)

    def _joined(self) -> tuple[Sequence[NDArray[Any]], tuple[str, ...]]:
        """Return the columns with the time that several of them hold, and a line for the history."""
        choice = self.choice
        assert choice.time is not None and choice.time_label is not None
        read = dict(zip((column for column, _ in choice.columns), self.columns, strict=True))
        parts = {part: np.asarray(read[column], dtype=np.float64) for part, column in choice.parts.items()}
        time = joined_time(self.columns[-1], parts, choice.time_label.unit)
        whole = choice.time_label.whole
        if time is not None:
            return [*self.columns[:-1], time], (f"time joined from {whole} and its parts: {', '.join(parts)}",)
        if choice.time == choice.parts.get("hour"):
            raise InputError(
                f"time must be whole hours below 24, whole minutes and seconds below 60, got others in columns {whole}"
            )
        return self.columns, (f"{', '.join(parts)} beside column {whole} not used: no parts of its seconds",)


def _has_clock(time: NDArray[Any]) -> bool:
    """Return whether a column of dates, taken for the time, holds any with a time of the day."""
    known = time[~np.isnat(time)] if time.dtype.kind == "M" else time[:0]
    return not (known == known.astype("datetime64[D]").astype(known.dtype)).all()


def table_of(
    series: Sequence[Series],
    choose: Choose,
    kind: str,
    place: str,
    about: Mapping[str, str] | None = None,
    rate: float | None = None,
    *,
    own: Mapping[str, Any] | None = None,
    prepare: Prepare | None = None,
) -> RawTable:
    """Return the table of the series that `choose` picks; raise UnreadableFile where they cannot be brought together.

    Parameters
    ----------
    series : sequence of Series
        All series of the file.
    choose : callable
        Picks columns from labels.
    kind : str
        The file's format, in words.
    place : str
        The file, for messages.
    about : mapping of str to str, optional
        What the file says of the recording.
    rate : float, optional
        Sampling rate that the file states [Hz], for series without a clock.
    own : mapping, optional
        The description that Sealscope wrote beside the samples.
    prepare : callable, optional
        Reads the columns that are used, where this is better done for all together.
    """
    given = series
    series, notes = _distinct(_timed(series))
    labels = [member.label for member in series]
    clocked = any(member.clock is not None for member in series) and not any(label.name == "t" for label in labels)
    try:
        choice = choose([*labels, CLOCK_LABEL] if clocked else labels, rate)
    except InputError:
        if (long := _long_columns([member.label for member in given])) is None:
            raise
        pivoted, more = _pivoted(given, long, kind, place, prepare)
        table = table_of(pivoted, choose, kind, place, about)
        return replace(table, notes=(*more, *table.notes))
    wanted = [(column, time) for column, time in choice.columns if column < len(series)]
    chosen = {column: series[column] for column, _ in wanted}
    if prepare is not None:
        notes += tuple(prepare([(column, "time" if time else "numbers") for column, time in wanted], choice.date))
    check_size(max(member.count for member in chosen.values()), len(choice.columns), place)
    if choice.time == len(series):
        columns, more = _on_one_clock(choice, chosen, place)
        return RawTable(kind, choice, columns, own, (*notes, *more), about or {})
    last = chosen[wanted[-1][0]]
    for member in chosen.values():
        if member.count != last.count:
            raise UnreadableFile(
                f"{member.path} must have as many samples as {last.path} ({last.count}), got {member.count} ({place})"
            )
    columns = [_samples(chosen[column], time, place) for column, time in wanted]
    return RawTable(kind, choice, columns, own, notes, about or {})


def _timed(series: Sequence[Series]) -> list[Series]:
    """Return series of which those without a clock have that of their group, where the groups hold times of their own.

    A series called `data` or `value` beside them has its group's name.
    """
    times: dict[str, Series] = {}
    for member in series:
        if member.clock is None and is_time(member.label):
            times.setdefault(member.group, member)
    members = [member for member in series if not (len(times) > 1 and member is times.get(member.group))]
    held = Counter(member.group for member in members)
    result = []
    for member in members:
        group, label, clock = member.group, member.label, member.clock
        if label.name.casefold() in WORDS["generic"] and group and held[group] == 1:
            named = Label.parse(group.rpartition("/")[2], label.unit)
            label = Label(label.whole, named.name, named.unit)
        time = times.get(group) if len(times) > 1 else None
        if time is not None and member.clock is None and time.count == member.count:
            clock = Clock(("times of", group), partial(seconds_of_series, time))
        result.append(replace(member, label=label, clock=clock))
    return result


def seconds_of_series(time: Series, start: np.datetime64 | None = None) -> tuple[Array, np.datetime64 | None]:
    """Return the times (n,) [s] of a series of times and their moment 0: that of stamps, else `start`."""
    values = time.values()
    if values.dtype.kind == "M":
        known = values[~np.isnat(values)]
        if not known.size:
            raise UnreadableFile(f"time must have a stamp in some row, got none in column {time.label.whole}")
        seconds = (values - known[0]) / np.timedelta64(1, "ns") / 1e9
        return np.asarray(seconds), known[0] if time.group == "" else None
    if values.dtype.kind == "m":
        return np.asarray(values / np.timedelta64(1, "ns"), dtype=np.float64) / 1e9, start
    if not np.isfinite(values).any():
        raise UnreadableFile(f"time must have a number in some row, got none in column {time.label.whole}")
    unit = time.label.unit or unit_of_time(time.label) or "s"
    return to_si(np.asarray(values, dtype=np.float64), unit, "s", name="time"), start


def _distinct(series: Sequence[Series]) -> tuple[list[Series], tuple[str, ...]]:
    """Name each series: by its own name where this is clear, by its path where another group's has the name."""
    if all(member.group == "" for member in series):
        return list(series), ()
    known = {name.casefold() for name in CHANNEL_UNITS}
    held = Counter(member.group for member in series if member.label.name.casefold() in known)
    size = Counter[str]()
    for member in series:
        size[member.group] += member.count
    first: dict[str, Series] = {}
    for member in sorted(series, key=lambda member: (-held[member.group], -size[member.group])):
        first.setdefault(member.label.name.casefold(), member)
    notes = []
    repeated = {name for name, times in Counter(member.label.name.casefold() for member in series).items() if times > 1}
    if repeated & known:
        group = first[min(repeated & known)].group
        others = listed(dict.fromkeys(member.group for member in series if member.group != group), 4)
        notes.append(f"channels of group {group} read, not those of the same name of {others}")
    named = []
    for member in series:
        own = first[member.label.name.casefold()] is member
        label = Label(member.path, member.label.name if own else member.path, member.label.unit)
        named.append(replace(member, group="", label=label))
    return named, tuple(notes)


def _samples(series: Series, time: bool, place: str) -> NDArray[Any]:
    values = series.values()
    if values.dtype.kind in "OSU":
        return from_text([str(cell) for cell in values.tolist()], time, series.path, place)
    if values.dtype.kind == "M" and time:
        return values.astype("datetime64[ns]")
    if values.dtype.kind == "m":
        return np.asarray(values / np.timedelta64(1, "ns"), dtype=np.float64) / 1e9
    if values.dtype.kind not in "fiub":
        raise UnreadableFile(f"{series.path} must hold numbers, got the type {values.dtype} ({place})")
    return np.asarray(values, dtype=np.float64)


def _on_one_clock(
    choice: ColumnMap, chosen: dict[int, Series], place: str
) -> tuple[list[NDArray[Any]], tuple[str, ...]]:
    """Return the chosen columns and the time, all on the clock of the chamber pressures, and lines for the history."""
    channel_of = choice.channel_of
    ranked = sorted(chosen, key=lambda column: (_rank(channel_of[column]), -chosen[column].count))
    base = next((chosen[column] for column in ranked if chosen[column].clock is not None), None)
    if base is None or base.clock is None:
        names = ", ".join(chosen[column].path for column in ranked)
        raise UnreadableFile(f"a channel must have a clock or be given a rate, got none for {names} ({place})")
    t, start = base.clock.read()
    known = np.isfinite(t)
    columns: list[NDArray[Any]] = []
    notes: list[str] = []
    for column, member in chosen.items():
        values = _samples(member, False, place)
        if member.clock is None and member.count != base.count:
            raise UnreadableFile(
                f"{member.path} must have a clock or as many samples as {base.path} ({base.count}), "
                f"got {member.count} ({place})"
            )
        if member.clock is not None and member.clock.key != base.clock.key:
            values, how = _brought(values, member, t[known], start, place)
            notes += [f"{channel_of[column]} {how}"] if how else []
        columns.append(values if len(values) == np.count_nonzero(known) else values[known])
    t = t[known]
    if start is None:
        return [*columns, t], tuple(notes)
    return [*columns, start.astype("datetime64[ns]") + np.round(t * 1e9).astype("timedelta64[ns]")], tuple(notes)


def _rank(channel: str) -> int:
    return _BASE.index(channel) if channel in _BASE else len(_BASE)


def _brought(values: Array, member: Series, t: Array, start: np.datetime64 | None, place: str) -> tuple[Array, str]:
    """Return the samples of `member` at the times `t` (n,) after `start`, and what was done to them, if anything."""
    assert member.clock is not None
    own, begin = member.clock.read()
    if begin is not None and start is not None:
        own = own + float((begin - start) / np.timedelta64(1, "ns")) / 1e9
    timed = np.isfinite(own)
    own, values = own[timed], values[timed]
    steps = np.diff(t)
    if own.shape == t.shape and np.all(np.abs(own - t) <= _SAME * (np.median(steps) if steps.size else 0.0)):
        return values, ""
    present = np.isfinite(values)
    own, values = own[present], values[present]
    if own.size < 2 or not np.all(np.diff(own) > 0):
        raise UnreadableFile(f"the times of {member.path} must increase, got times that do not ({place})")
    try:
        rate, wanted = nominal_rate(own), nominal_rate(t)
    except InputError as error:
        raise UnreadableFile(f"{error} ({place})") from None
    if rate > wanted:
        return _averaged(values, own, t, 1.0 / wanted), f"at {rate:g} Hz: averaged over each interval of {wanted:g} Hz"
    result = np.interp(t, own, values, left=np.nan, right=np.nan)
    after = np.clip(np.searchsorted(own, t), 1, own.size - 1)
    result[(own[after] - own[after - 1] > _GAP * float(np.median(np.diff(own)))) & (own[after] != t)] = np.nan
    return result, f"at {rate:g} Hz: interpolated linearly to {wanted:g} Hz"


def _averaged(values: Array, own: Array, t: Array, step: float) -> Array:
    """Return means (n,) of `values` (m,), taken at `own` (m,), over the interval of length `step` around each time."""
    begin, end = np.searchsorted(own, t - 0.5 * step), np.searchsorted(own, t + 0.5 * step)
    total = np.concatenate(([0.0], np.cumsum(values)))
    with np.errstate(invalid="ignore"):
        return np.asarray((total[end] - total[begin]) / np.where(end > begin, end - begin, np.nan))


def _long_columns(labels: Sequence[Label]) -> dict[str, int] | None:
    """Return the columns of names, values, units and validity of a long table; None for any other table."""
    names = [label.name.strip().casefold() for label in labels]
    known = {
        kind: [column for column, own in enumerate(names) if own in words] for kind, words in WORDS["long"].items()
    }
    long = {kind: columns[0] for kind, columns in known.items() if columns}
    if "_field" in names:  # of InfluxDB, beside columns that may be called name
        long["name"] = names.index("_field")
    return long if {"name", "value"} <= set(long) else None


def _pivoted(
    series: Sequence[Series], long: Mapping[str, int], kind: str, place: str, prepare: Prepare | None
) -> tuple[list[Series], tuple[str, ...]]:
    """Return a series for each name, with its unit where a column gives it, and lines for the history.

    The rows of a name are read as a table of one channel: its time may be in any form that the time of a table has.
    """
    value, texts = long["value"], [long[kind] for kind in ("name", "unit") if kind in long]
    labels = [Label("", "") if column in texts else member.label for column, member in enumerate(series)]
    if "timestring" in {label.name.casefold() for label in labels}:  # WinCC's moments have their fraction beside them
        days = Label("Time_ms", "t", "microday since 1899-12-30")
        labels = [days if label.name.casefold() == "time_ms" else label for label in labels]
    choice = choose_columns(labels, channel_map={"u": f"#{value + 1} count"}, rate=None, place=place)
    kinds = {column: "texts" for column in texts} | ({long["valid"]: "any"} if "valid" in long else {})
    kinds |= {column: "time" if time else "any" if column == value else "numbers" for column, time in choice.columns}
    notes = list(prepare([*kinds.items()], choice.date)) if prepare else []
    columns = {column: _samples(series[column], time, place) for column, time in choice.columns}
    if "valid" in long:
        invalid = _samples(series[long["valid"]], False, place) == 0.0
        columns[value] = np.where(invalid, np.nan, columns[value])
        said = f"{counted(int(np.count_nonzero(invalid)), 'value')} that the file calls invalid read as missing"
        notes += [said] if invalid.any() else []
    times = columns[choice.columns[-1][0]]
    cells = [np.array([str(cell).strip() for cell in series[column].values().tolist()]) for column in texts]
    keys = np.char.add(np.char.add(cells[0], "\n"), cells[1]) if len(cells) > 1 else cells[0]
    names, first, rows = np.unique(keys, return_index=True, return_inverse=True)
    if len(names) > _MOST_NAMES:
        raise UnreadableFile(f"a long table must have at most {_MOST_NAMES} names, got more ({place})")
    order = np.argsort(rows, kind="stable")
    ends = np.cumsum(np.bincount(rows, minlength=len(names)))

    def member(number: int) -> Series:
        own = order[ends[number - 1] if number else 0 : ends[number]]

        @cache
        def fields() -> RecordingFields:
            timed = own[~np.isnat(times[own]) if times.dtype.kind == "M" else np.isfinite(times[own])]
            held = {column: cells[timed] for column, cells in columns.items()}
            words = np.isinf(held[value])
            if np.count_nonzero(words) > MOST_WORDS * words.size:
                raise UnreadableFile(f"{label.whole[:40]} must hold numbers, got text ({place})")
            held[value][words] = np.nan
            table = RawTable(kind, replace(choice, notes=()), [*held.values()])
            return table.samples({}, rate=None, infer_rate=True)

        def clock() -> tuple[Array, np.datetime64 | None]:
            begin = fields().provenance
            if "start_epoch_s" in begin:
                return fields().t, np.datetime64(round(begin["start_epoch_s"] * 1e9), "ns")
            if "start" in begin:
                return fields().t, np.datetime64(begin["start"]).astype("datetime64[ns]")
            known = times[own] if times.dtype.kind == "M" else times[:0]  # times of the day
            return fields().t, np.nanmin(known) if known.size else None

        own_name, _, own_unit = str(names[number]).partition("\n")
        label = Label.parse(own_name[:200], own_unit[:40] or None)
        return Series("", label, own.size, lambda: fields().channels["u"], Clock(number, clock))

    ordered = [member(int(number)) for number in np.argsort(first) if str(names[number]).strip()]
    return ordered, (*notes, f"long table: {counted(len(rows), 'row')} of {counted(len(ordered), 'name')}")


def check_size(rows: int, columns: int, place: str) -> None:
    """Raise UnreadableFile where a file holds more than `MAX_VALUES` in the columns used.

    Or more than `_EXPANSION` times its own size: no logger's samples compress so well, but a fill value can stand for
    any number of them. `place`: the file's path.
    """
    if rows * columns > MAX_VALUES:
        raise UnreadableFile(
            f"a recording must have at most {MAX_VALUES} values in the columns used (2 GiB), "
            f"got {rows} rows of {columns}: cut it into parts ({place})"
        )
    if 8 * rows * columns > _SMALL and 8 * rows * columns > _EXPANSION * Path(place).stat().st_size:
        raise UnreadableFile(
            f"a recording must hold its samples, got {rows} rows of {columns} in a file of "
            f"{Path(place).stat().st_size} bytes ({place})"
        )


def check_texts(cells: int, width: int, name: str, place: str) -> None:
    """Raise UnreadableFile for too many texts, or texts wider than a number, in a column."""
    if cells > _MOST_TEXTS or width > _WIDEST_TEXT or cells * width > _MOST_TEXT:
        raise UnreadableFile(
            f"{name} must hold numbers, or at most {_MOST_TEXTS} texts of {_WIDEST_TEXT} bytes, got {cells} of {width} "
            f"({place})"
        )


def from_text(cells: Sequence[str], time: bool, name: str, place: str) -> NDArray[Any]:
    """Convert cells of text to doubles, or to stamps for the `time`; an empty cell is missing, and a few words are."""
    with suppress(ValueError):
        if time:
            return stamps(cells)
    values = np.array([_number(cell) for cell in cells])
    words = sum(1 for cell, value in zip(cells, values, strict=True) if cell and np.isnan(value))
    if words > MOST_WORDS * len(cells):
        raise UnreadableFile(f"{name} must hold numbers, got text ({place})")
    return values


def _number(cell: str) -> float:
    try:
        return float(cell) if cell else np.nan
    except ValueError:
        return np.nan


def description_of(rate: float, provenance: Mapping[str, Any], history: Sequence[str]) -> dict[str, Any]:
    """Return rate, provenance and history as JSON values; raise InputError where a value is none of JSON's."""
    description = {"format": FORMAT_VERSION, "rate": rate, "provenance": dict(provenance), "history": list(history)}
    try:
        return json.loads(json.dumps(description, default=_plain))  # type: ignore[no-any-return]
    except (TypeError, ValueError) as error:
        raise InputError(f"provenance must hold JSON values only: {error}") from None


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"got a {type(value).__name__}")


def parse_description(text: str | bytes, place: str) -> dict[str, Any]:
    """Parse the JSON text of a `description_of`; raise UnreadableFile where it is damaged."""
    try:
        parsed = json.loads(text)
        description: dict[str, Any] = {
            "rate": float(parsed["rate"]),
            "provenance": dict(parsed["provenance"]),
            "history": [str(line) for line in parsed["history"]],
            "format": int(parsed["format"]),
        }
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise UnreadableFile(f"the recording's description must be whole, got damaged JSON ({place})") from error
    version, rate = description["format"], description["rate"]
    if version > FORMAT_VERSION:
        raise UnreadableFile(f"format must be at most {FORMAT_VERSION}, got {version}: newer software ({place})")
    if not (np.isfinite(rate) and rate > 0):
        raise UnreadableFile(f"rate must be > 0 Hz, got {rate} ({place})")
    return description
