"""One way from a file to a recording: series with units, of which a map chooses, on one clock, in SI units.

A reader of a format lists the series of a file; `table_of` makes the fields of a recording of them. A file may hold
groups of series that are sampled at different rates. A name that occurs in several groups stands for the series in the
group that holds most channels. Channels of different clocks are brought to the clock of the chamber pressures: a slower
one is interpolated linearly, a faster one is averaged over the base's intervals, and nothing is put into a gap of a
series or before its first and after its last sample. In a long table, where a row is a sample of one channel, each name
is a series.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, Array
from sealscope.recordings.formats.cells import MOST_WORDS, numbers
from sealscope.recordings.formats.columns import ColumnMap, Wanted, choose_columns, counted, listed
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.preamble import exported_from
from sealscope.recordings.formats.headings.proposal import is_time, unit_of_time
from sealscope.recordings.formats.headings.split_time import joined_time
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.recordings.formats.timebase import LogTime, falling, iso_moment, nominal_rate, stamps, time_base
from sealscope.units import to_si

#: Most values that one file may hold in the columns used: 2 GiB of doubles, 16 hours of 9 channels at 500 Hz.
MAX_VALUES = 2**28
#: A table up to this many bytes may be a fill value alone; a larger one at most this many times its file.
_SMALL, _EXPANSION = 2**26, 4096
_MOST_TEXTS, _WIDEST_TEXT, _MOST_TEXT = 2**22, 400, 2**29
FORMAT_VERSION = 1
#: The clock of a file among the columns: what stands for it where no column is mapped to `t`.
_CLOCK_LABEL = Label("t [s]", "t", "s")
#: Channels whose clock is the base, most telling first.
_BASE = ("p_A", "p_B", "p_1", "p_2")
#: A slower series is not interpolated between samples that are this many of its usual intervals apart.
_GAP = 3.0
#: Clocks that differ by less than this share of an interval are one.
_SAME = 1e-2
#: The rate that a recording had when it was written is kept where the time stamps agree with it to this share.
_SAME_RATE = 0.01
_MOST_NAMES = 4096
#: Reads columns, each as "numbers", "any" numbers with words among them, which are infinite, a "time" or "texts",
#: before their values are asked for, with the column of the date beside the time; returns lines for the history.
Prepare = Callable[[Mapping[int, str], int | None], Sequence[str]]


@dataclass(frozen=True)
class Clock:
    """When samples were taken: `key` is equal for series sampled together; `read` gives times (n,) [s] and moment 0."""

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
    """The arguments of a recording, in their order, and the `kind` of the table, in words."""

    t: Array
    channels: dict[str, Array]
    units: dict[str, str]
    rate: float
    provenance: dict[str, Any]
    history: tuple[str, ...]
    kind: str

    def with_note(self, line: str) -> RecordingFields:
        """Return the fields with a line at the beginning of the history."""
        return self._replace(history=(line, *self.history))


def table_of(
    series: Sequence[Series],
    request: Wanted,
    kind: str,
    remarks: Mapping[str, str] | None = None,
    rate: float | None = None,
    *,
    description: Mapping[str, Any] | None = None,
    prepare: Prepare | None = None,
    size: int | None = None,
) -> RecordingFields:
    """Build the fields of a recording from the requested series; raise InputError where they do not fit together.

    `kind`: the format, in words; `remarks`: the file's entries about the recording; `rate` [Hz]: the rate it states,
    for series without a clock; `description`: what Sealscope wrote beside the samples; `prepare`: reads all columns
    that are used together; `size`: bytes of a file that may be compressed.
    """
    members, notes = _distinct(_timed(series))
    labels = [member.label for member in members]
    clocked = any(member.clock is not None for member in members) and not any(label.name == "t" for label in labels)
    try:
        choice = choose_columns([*labels, _CLOCK_LABEL] if clocked else labels, request, rate)
    except InputError:
        if (long := _long_columns([member.label for member in series])) is None:
            raise
        pivoted, more = _pivoted(series, long, prepare)
        table = table_of(pivoted, request, kind, remarks)
        return table._replace(history=(*more, *table.history))
    kinds = {column: how for column, how in choice.columns.items() if column < len(members)}
    chosen = {column: members[column] for column in kinds}
    if prepare is not None:
        notes += prepare(kinds, choice.date)
    check_size(max(member.count for member in chosen.values()), len(choice.columns), size)
    if choice.time == len(members):
        columns, more = _on_one_clock(choice, chosen)
        return converted(choice, columns, kind, request, [*notes, *more], remarks, description)
    last = chosen[[*kinds][-1]]
    for member in chosen.values():
        if member.count != last.count:
            raise InputError(
                f"{member.path} must have as many samples as {last.path} ({last.count}), got {member.count}"
            )
    columns = {column: _samples(chosen[column], how == "time") for column, how in kinds.items()}
    return converted(choice, columns, kind, request, notes, remarks, description)


def converted(
    choice: ColumnMap,
    columns: Mapping[int, NDArray[Any]],
    kind: str,
    request: Wanted,
    notes: Sequence[str] = (),
    remarks: Mapping[str, str] | None = None,
    description: Mapping[str, Any] | None = None,
    log: LogTime | None = None,
) -> RecordingFields:
    """Convert the columns (n,) of a table, doubles or the time as datetime64, to the fields of a recording.

    `log`: what the parts before this one tell of the time, where it is one of a log.
    """
    label, start, remarks = choice.time_label, dict[str, Any](), remarks or {}
    count = len(next(iter(columns.values())))
    if count == 0:
        raise InputError("a recording must have samples, got a header and no rows")
    notes = [*notes, *choice.notes]
    time = np.empty(0)
    if choice.time is not None and label is not None:
        time = columns[choice.time]
        if choice.parts:
            time = _join_time(choice, columns, label, notes)
        if choice.time == choice.date and not _has_clock(time):
            raise InputError(
                "a recording must have a time column such as t [s] or be given a rate, "
                f"got dates alone in column {label.whole}"
            )
        if description is None and falling(time):
            time, columns = time[::-1], {column: cells[::-1] for column, cells in columns.items()}
            notes.append("rows begin with the last sample: taken in the order of time")
    channels, units, in_log = {}, {}, {}
    for name, formula in choice.channels.items():
        unit = formula.unit or COUNTS
        in_log[name] = "" if unit in (COUNTS, CHANNEL_UNITS[name]) else unit
        units[name] = COUNTS if unit == COUNTS else CHANNEL_UNITS[name]
        channels[name] = to_si(formula.values(columns), unit, units[name], name=name)
        if not any(channels[name] is cells for cells in columns.values()):
            channels[name].setflags(write=False)  # made here: a recording takes it as it is
    if label is None:
        assert choice.rate is not None
        t, rate = np.arange(count) / choice.rate, choice.rate
    elif description is not None and not request.infers_rate:
        t, rate = time, description["rate"]
    else:
        t, rate, start, more = time_base(time, label.unit, label.whole, choice.rate, log)
        notes += more
        if not start and (begin := exported_from(remarks)) is not None:
            start = {"start": iso_moment(begin)}
        if description is not None and abs(rate / description["rate"] - 1.0) <= _SAME_RATE:
            rate = description["rate"]
    if description is not None:
        return RecordingFields(
            t, channels, units, rate, description["provenance"], (*description["history"], *notes), kind
        )
    details = {"file": request.file, "format": kind, **start, "about": dict(remarks), "columns": choice.names}
    details |= {"unused": list(choice.unused), "log_units": {name: unit for name, unit in in_log.items() if unit}}
    provenance = {key: value for key, value in details.items() if value or key in start}
    return RecordingFields(t, channels, units, rate, provenance, tuple(notes), kind)


def _join_time(choice: ColumnMap, columns: Mapping[int, NDArray[Any]], label: Label, notes: list[str]) -> NDArray[Any]:
    """Return the time that several columns hold, and add a line to the notes."""
    assert choice.time is not None
    parts = {part: np.asarray(columns[column], dtype=np.float64) for part, column in choice.parts.items()}
    time = joined_time(columns[choice.time], parts, label.unit)
    if time is not None:
        notes.append(f"time joined from {label.whole} and its parts: {', '.join(parts)}")
        return time
    if choice.time == choice.parts.get("hour"):
        raise InputError(
            f"time must be whole hours below 24, whole minutes and seconds below 60, got others in columns "
            f"{label.whole}"
        )
    notes.append(f"{', '.join(parts)} beside column {label.whole} not used: no parts of its seconds")
    return columns[choice.time]


def _has_clock(time: NDArray[Any]) -> bool:
    """Test whether a column of dates, taken for the time, holds any with a time of the day."""
    known = time[~np.isnat(time)] if time.dtype.kind == "M" else time[:0]
    return not (known == known.astype("datetime64[D]").astype(known.dtype)).all()


def _timed(series: Sequence[Series]) -> list[Series]:
    """Give series without a clock that of their group's times, and one called `data` or `value` the group's name."""
    times: dict[str, Series] = {}
    for member in series:
        if member.clock is None and is_time(member.label):
            times.setdefault(member.group, member)
    times = times if len(times) > 1 else {}
    members = [member for member in series if member is not times.get(member.group)]
    held = Counter(member.group for member in members)
    result = []
    for member in members:
        group, label, time = member.group, member.label, times.get(member.group)
        if label.name.casefold() in WORDS["generic"] and group and held[group] == 1:
            named = Label.parse(group.rpartition("/")[2], label.unit)
            member = replace(member, label=replace(named, whole=label.whole))  # noqa: PLW2901
        if time is not None and member.clock is None and time.count == member.count:
            clock = Clock(("times of", group), partial(seconds_of_series, time))
            member = replace(member, clock=clock)  # noqa: PLW2901
        result.append(member)
    return result


def seconds_of_series(time: Series, start: np.datetime64 | None = None) -> tuple[Array, np.datetime64 | None]:
    """Return the times (n,) [s] of a series of times and their moment 0: that of stamps, else `start`."""
    values = time.values()
    if values.dtype.kind == "m":
        return _in_seconds(values), start
    known = values[~np.isnat(values) if values.dtype.kind == "M" else np.isfinite(values)]
    if not known.size:
        what = "a stamp" if values.dtype.kind == "M" else "a number"
        raise InputError(f"time must have {what} in some row, got none in column {time.label.whole}")
    if values.dtype.kind == "M":
        return _in_seconds(values - known[0]), known[0] if time.group == "" else None
    unit = time.label.unit or unit_of_time(time.label) or "s"
    return to_si(np.asarray(values, dtype=np.float64), unit, "s", name="time"), start


def _in_seconds(times: NDArray[Any]) -> Array:
    return np.asarray(times / np.timedelta64(1, "ns"), dtype=np.float64) / 1e9


def _distinct(series: Sequence[Series]) -> tuple[list[Series], list[str]]:
    """Name each series: by its own name where this is clear, by its path where another group's has the name."""
    if all(member.group == "" for member in series):
        return list(series), []
    known = {name.casefold() for name in CHANNEL_UNITS}
    held = Counter(member.group for member in series if member.label.name.casefold() in known)
    size = Counter[str]()
    for member in series:
        size[member.group] += member.count
    names = [member.label.name.casefold() for member in series]
    first: dict[str, Series] = {}
    for member in sorted(series, key=lambda member: (-held[member.group], -size[member.group])):
        first.setdefault(member.label.name.casefold(), member)
    repeated, notes = {name for name, times in Counter(names).items() if times > 1} & known, []
    if repeated:
        group = first[min(repeated)].group
        other_groups = listed(dict.fromkeys(member.group for member in series if member.group != group), 4)
        notes.append(f"channels of group {group} read, not those of the same name of {other_groups}")
    named = []
    for name, member in zip(names, series, strict=True):
        shown = member.label.name if first[name] is member else member.path
        named.append(replace(member, group="", label=Label(member.path, shown, member.label.unit)))
    return named, notes


def _samples(series: Series, time: bool = False) -> NDArray[Any]:
    """Return a series' samples (n,) as doubles, or its `time` as datetime64; in texts, a few words are missing."""
    values = series.values()
    if values.dtype.kind in "OSU":
        cells = [str(cell) for cell in values.tolist()]
        with suppress(ValueError):
            if time:
                return stamps(cells)
        values, words = numbers(cells, ".", lambda index: f"(row {index + 1}, {series.path})")
        if len(words) > MOST_WORDS * len(cells):
            raise InputError(f"{series.path} must hold numbers, got text")
        return values
    if values.dtype.kind == "M" and time:
        return values.astype("datetime64[ns]")
    if values.dtype.kind == "m":
        return _in_seconds(values)
    if values.dtype.kind not in "fiub":
        raise InputError(f"{series.path} must hold numbers, got the type {values.dtype}")
    return np.asarray(values, dtype=np.float64)


def _on_one_clock(choice: ColumnMap, chosen: dict[int, Series]) -> tuple[dict[int, NDArray[Any]], list[str]]:
    """Return the chosen columns and the time, all on the clock of the chamber pressures, and lines for the history."""
    channel_of = choice.channel_of
    rank = {channel: number for number, channel in enumerate(_BASE)}
    ranked = sorted(chosen, key=lambda column: (rank.get(channel_of[column], len(rank)), -chosen[column].count))
    base = next((chosen[column] for column in ranked if chosen[column].clock is not None), None)
    if base is None or base.clock is None:
        names = ", ".join(chosen[column].path for column in ranked)
        raise InputError(f"a channel must have a clock or be given a rate, got none for {names}")
    t, start = base.clock.read()
    known = np.isfinite(t)
    columns: dict[int, NDArray[Any]] = {}
    notes: list[str] = []
    for column, member in chosen.items():
        values = _samples(member)
        if member.clock is None and member.count != base.count:
            raise InputError(
                f"{member.path} must have a clock or as many samples as {base.path} ({base.count}), got {member.count}"
            )
        if member.clock is not None and member.clock.key != base.clock.key:
            values, how = _brought(values, member, t[known], start)
            notes += [f"{channel_of[column]} {how}"] if how else []
        columns[column] = values if len(values) == np.count_nonzero(known) else values[known]
    t = t[known]
    assert choice.time is not None
    columns[choice.time] = (
        t if start is None else start.astype("datetime64[ns]") + np.round(t * 1e9).astype("timedelta64[ns]")
    )
    return columns, notes


def _brought(values: Array, member: Series, t: Array, start: np.datetime64 | None) -> tuple[Array, str]:
    """Return the samples of `member` at the times `t` (n,) after `start`, and what was done to them, if anything."""
    assert member.clock is not None
    times, begin = member.clock.read()
    if begin is not None and start is not None:
        times = times + float((begin - start) / np.timedelta64(1, "ns")) / 1e9
    timed = np.isfinite(times)
    times, values = times[timed], values[timed]
    steps = np.diff(t)
    if times.shape == t.shape and np.all(np.abs(times - t) <= _SAME * (np.median(steps) if steps.size else 0.0)):
        return values, ""
    present = np.isfinite(values)
    times, values = times[present], values[present]
    if times.size < 2 or not np.all(np.diff(times) > 0):
        raise InputError(f"the times of {member.path} must increase, got times that do not")
    rate, base_rate = nominal_rate(times), nominal_rate(t)
    if rate > base_rate:
        how = f"at {rate:g} Hz: averaged over each interval of {base_rate:g} Hz"
        return _averaged(values, times, t, 1.0 / base_rate), how
    result = np.interp(t, times, values, left=np.nan, right=np.nan)
    after = np.clip(np.searchsorted(times, t), 1, times.size - 1)
    result[(times[after] - times[after - 1] > _GAP * float(np.median(np.diff(times)))) & (times[after] != t)] = np.nan
    return result, f"at {rate:g} Hz: interpolated linearly to {base_rate:g} Hz"


def _averaged(values: Array, times: Array, t: Array, step: float) -> Array:
    """Average `values` (m,), taken at `times` (m,), over the interval of length `step` around each time of `t` (n,)."""
    begin, end = np.searchsorted(times, t - 0.5 * step), np.searchsorted(times, t + 0.5 * step)
    total = np.concatenate(([0.0], np.cumsum(values)))
    with np.errstate(invalid="ignore"):
        return np.asarray((total[end] - total[begin]) / np.where(end > begin, end - begin, np.nan))


def _long_columns(labels: Sequence[Label]) -> dict[str, int] | None:
    """Return the columns of names, values, units and validity of a long table; None for any other table."""
    names = [label.name.strip().casefold() for label in labels]
    known = {
        kind: [column for column, name in enumerate(names) if name in words] for kind, words in WORDS["long"].items()
    }
    long = {kind: columns[0] for kind, columns in known.items() if columns}
    if "_field" in names:  # of InfluxDB, beside columns that may be called name
        long["name"] = names.index("_field")
    return long if {"name", "value"} <= set(long) else None


def _pivoted(
    series: Sequence[Series], long: Mapping[str, int], prepare: Prepare | None
) -> tuple[list[Series], list[str]]:
    """Return a series for each name, its rows read as a table of one channel, and lines for the history."""
    value, texts = long["value"], [long[kind] for kind in ("name", "unit") if kind in long]
    labels = [Label("", "") if column in texts else member.label for column, member in enumerate(series)]
    if "timestring" in {label.name.casefold() for label in labels}:  # WinCC's moments have their fraction beside them
        days = Label("Time_ms", "t", "microday since 1899-12-30")
        labels = [days if label.name.casefold() == "time_ms" else label for label in labels]
    request = Wanted({"u": f"#{value + 1} count"})
    choice = choose_columns(labels, request)
    choice.notes.clear()
    kinds = dict.fromkeys(texts, "texts") | ({long["valid"]: "any"} if "valid" in long else {})
    kinds |= choice.columns | {value: "any"}
    if choice.time is not None:
        kinds[choice.time] = kinds.pop(choice.time)  # the last
    notes = [*prepare(kinds, choice.date)] if prepare else []
    columns = {column: _samples(series[column], kind == "time") for column, kind in choice.columns.items()}
    if "valid" in long:
        invalid = _samples(series[long["valid"]]) == 0.0
        columns[value] = np.where(invalid, np.nan, columns[value])
        note = f"{counted(int(np.count_nonzero(invalid)), 'value')} that the file calls invalid read as missing"
        notes += [note] if invalid.any() else []
    times = columns[[*choice.columns][-1]]
    cells = [np.array([str(cell).strip() for cell in series[column].values().tolist()]) for column in texts]
    keys = np.char.add(np.char.add(cells[0], "\n"), cells[1]) if len(cells) > 1 else cells[0]
    names, first, rows = np.unique(keys, return_index=True, return_inverse=True)
    if len(names) > _MOST_NAMES:
        raise InputError(f"a long table must have at most {_MOST_NAMES} names, got more")
    order = np.argsort(rows, kind="stable")
    ends = np.cumsum(np.bincount(rows, minlength=len(names)))

    def member(number: int) -> Series:
        selected = order[ends[number - 1] if number else 0 : ends[number]]

        @cache
        def fields() -> RecordingFields:
            timed = selected[~np.isnat(times[selected]) if times.dtype.kind == "M" else np.isfinite(times[selected])]
            held = {column: cells[timed] for column, cells in columns.items()}
            words = np.isinf(held[value])
            if np.count_nonzero(words) > MOST_WORDS * words.size:
                raise InputError(f"{label.whole[:40]} must hold numbers, got text")
            held[value][words] = np.nan
            return converted(choice, held, "", request)

        def clock() -> tuple[Array, np.datetime64 | None]:
            begin = fields().provenance
            if "start_epoch_s" in begin:
                return fields().t, np.datetime64(round(begin["start_epoch_s"] * 1e9), "ns")
            if "start" in begin:
                return fields().t, np.datetime64(begin["start"]).astype("datetime64[ns]")
            known = times[selected] if times.dtype.kind == "M" else times[:0]  # times of the day
            return fields().t, np.nanmin(known) if known.size else None

        own_name, _, own_unit = str(names[number]).partition("\n")
        label = Label.parse(own_name[:200], own_unit[:40] or None)
        return Series("", label, selected.size, lambda: fields().channels["u"], Clock(number, clock))

    ordered = [member(int(number)) for number in np.argsort(first) if str(names[number]).strip()]
    return ordered, [*notes, f"long table: {counted(len(rows), 'row')} of {counted(len(ordered), 'name')}"]


def check_size(rows: int, columns: int, size: int | None = None) -> None:
    """Refuse more than `MAX_VALUES`, and than `_EXPANSION` times the file's `size` [bytes]: fill values expand so."""
    if rows * columns > MAX_VALUES:
        raise InputError(
            f"a recording must have at most {MAX_VALUES} values in the columns used (2 GiB), got {rows} rows of "
            f"{columns}: cut it into parts"
        )
    if size is not None and 8 * rows * columns > max(_SMALL, _EXPANSION * size):
        raise InputError(f"a recording must hold its samples, got {rows} rows of {columns} in a file of {size} bytes")


def check_texts(cells: int, width: int, name: str) -> None:
    """Raise InputError for too many texts, or texts wider than a number, in a column."""
    if cells > _MOST_TEXTS or width > _WIDEST_TEXT or cells * width > _MOST_TEXT:
        raise InputError(
            f"{name} must hold numbers, or at most {_MOST_TEXTS} texts of {_WIDEST_TEXT} bytes, got {cells} of {width}"
        )


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


def parse_description(source: str | bytes | Mapping[str, Any]) -> dict[str, Any]:
    """Parse the description made by `description_of`, a JSON text or its values; raise InputError if it is damaged."""
    try:
        parsed = source if isinstance(source, Mapping) else json.loads(source)
        version, rate = int(parsed["format"]), float(parsed["rate"])
        provenance, history = dict(parsed["provenance"]), [str(line) for line in parsed["history"]]
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError) as error:
        raise InputError("the recording's description must be whole, got damaged JSON") from error
    if version > FORMAT_VERSION:
        raise InputError(f"format must be at most {FORMAT_VERSION}, got {version}: newer software")
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"rate must be > 0 Hz, got {rate}")
    return {"rate": rate, "provenance": provenance, "history": history}
