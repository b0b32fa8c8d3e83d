"""Series with clocks of their own, as measurement files hold them, brought to the table of a recording.

A file may hold several groups of series, sampled at different rates. A name that occurs in several groups stands for
the series in the group that holds most channels. Channels of different clocks are brought to the clock of the chamber
pressures: a slower one is interpolated linearly, a faster one is averaged over the base's intervals, and nothing is
put into a gap of a series or before its first and after its last sample.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, Array
from sealscope.recordings.formats.columns import ColumnMap, listed
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.proposal import is_time
from sealscope.recordings.formats.table import Choose, RawTable, check_size, from_text
from sealscope.recordings.timebase import nominal_rate
from sealscope.units import to_si

#: The clock of a file among the columns: what stands for it where no column is mapped to `t`.
CLOCK_LABEL = Label("t [s]", "t", "s")
#: Channels whose clock is the base, most telling first.
_BASE = ("p_A", "p_B", "p_1", "p_2")
#: A slower series is not interpolated between samples that are this many of its usual intervals apart.
_GAP = 3.0
#: Clocks that differ by less than this share of an interval are one.
_SAME = 1e-2
#: Names that say nothing: the group's stands for them.
_GENERIC = ("data", "value", "values", "wert", "werte", "signal", "y", "samples")


@dataclass(frozen=True)
class Clock:
    """When samples were taken.

    `key`: equal for series that were sampled together; `seconds`: reads the times (n,) [s] from `start`; `start`: the
    moment 0, where it is known.
    """

    key: Hashable
    seconds: Callable[[], Array]
    start: np.datetime64 | None = None


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
    return Clock((key, count, step, first, start), partial(_uniform, count, step, first), start)


def _uniform(count: int, step: float, first: float) -> Array:
    return first + step * np.arange(count, dtype=np.float64)


def table_of(
    series: Sequence[Series],
    choose: Choose,
    kind: str,
    place: str,
    about: Mapping[str, str] | None = None,
    rate: float | None = None,
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
    """
    series, notes = _distinct(_timed(series))
    labels = [member.label for member in series]
    clocked = any(member.clock is not None for member in series) and not any(label.name == "t" for label in labels)
    choice = choose([*labels, CLOCK_LABEL] if clocked else labels, rate)
    chosen = {column: series[column] for column, time in choice.columns if not time}
    check_size(max(member.count for member in chosen.values()), len(choice.columns), place)
    if choice.time == len(series):
        columns, more = _on_one_clock(choice, chosen, place)
        return RawTable(kind, choice, columns, notes=(*notes, *more), about=about or {})
    if choice.time is not None:
        chosen[choice.time] = series[choice.time]
    last = next(reversed(chosen.values()))
    for member in chosen.values():
        if member.count != last.count:
            raise UnreadableFile(
                f"{member.path} must have as many samples as {last.path} ({last.count}), got {member.count} ({place})"
            )
    columns = [_samples(chosen[column], time, place) for column, time in choice.columns]
    return RawTable(kind, choice, columns, notes=notes, about=about or {})


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
        if label.name.casefold() in _GENERIC and group and held[group] == 1:
            last = group.rpartition("/")[2]
            named = Label.parse(last, label.unit)
            label = Label(label.whole, named.name, named.unit)
        time = times.get(group) if len(times) > 1 else None
        if time is not None and member.clock is None and time.count == member.count:
            clock = Clock(("times of", group), partial(_seconds, time))
        result.append(replace(member, label=label, clock=clock))
    return result


def _seconds(time: Series) -> Array:
    values = time.values()
    if values.dtype.kind == "M":
        return np.asarray((values - values[0]) / np.timedelta64(1, "ns")) / 1e9
    if values.dtype.kind == "m":
        return np.asarray(values / np.timedelta64(1, "ns"), dtype=np.float64) / 1e9
    return to_si(np.asarray(values, dtype=np.float64), time.label.unit or "s", "s", name=time.path)


def _distinct(series: Sequence[Series]) -> tuple[list[Series], tuple[str, ...]]:
    """Name each series: by its own name where this is clear, by its path where another group's has the name."""
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
        return values
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
    if base is None:
        names = ", ".join(chosen[column].path for column in ranked)
        raise UnreadableFile(f"a channel must have a clock or be given a rate, got none for {names} ({place})")
    assert base.clock is not None
    t = np.asarray(base.clock.seconds(), dtype=np.float64)
    columns: list[NDArray[Any]] = []
    notes: list[str] = []
    for column in (column for column, time in choice.columns if not time):
        member = chosen[column]
        values = _samples(member, False, place)
        if member.clock is None:
            if member.count != base.count:
                raise UnreadableFile(
                    f"{member.path} must have a clock or as many samples as {base.path} ({base.count}), "
                    f"got {member.count} ({place})"
                )
        elif member.clock.key != base.clock.key:
            values, how = _brought(values, member, t, base, place)
            notes += [f"{channel_of[column]} {how}"] if how else []
        columns.append(values)
    if base.clock.start is not None:
        known = np.isfinite(t)
        stamps = np.full(t.shape, np.datetime64("NaT"), dtype="datetime64[ns]")
        offset = np.round(np.where(known, t, 0.0) * 1e9).astype("timedelta64[ns]")
        stamps[known] = (base.clock.start.astype("datetime64[ns]") + offset)[known]
        return [*columns, stamps], tuple(notes)
    return [*columns, t], tuple(notes)


def _rank(channel: str) -> int:
    return _BASE.index(channel) if channel in _BASE else len(_BASE)


def _brought(values: Array, member: Series, t: Array, base: Series, place: str) -> tuple[Array, str]:
    """Return the samples of `member` at the base's times `t` (n,), and what was done, empty where nothing had to be."""
    assert member.clock is not None and base.clock is not None
    own = np.asarray(member.clock.seconds(), dtype=np.float64)
    if member.clock.start is not None and base.clock.start is not None:
        own = own + float((member.clock.start - base.clock.start) / np.timedelta64(1, "ns")) / 1e9
    if own.shape == t.shape and (np.array_equal(own, t) or _nearly(own, t)):
        return values, ""
    order = np.isfinite(own) & np.isfinite(values)
    own, values = own[order], values[order]
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


def _nearly(own: Array, t: Array) -> bool:
    """Return whether two clocks (n,) differ by less than can matter to a sample."""
    steps = np.diff(t)
    usual = float(np.median(steps)) if steps.size else 0.0
    return usual > 0.0 and bool(np.all(np.abs(own - t) <= _SAME * usual))


def _averaged(values: Array, own: Array, t: Array, step: float) -> Array:
    """Return means (n,) of `values` (m,), taken at `own` (m,), over the interval of length `step` around each time."""
    begin, end = np.searchsorted(own, t - 0.5 * step), np.searchsorted(own, t + 0.5 * step)
    total = np.concatenate(([0.0], np.cumsum(values)))
    with np.errstate(invalid="ignore"):
        return np.asarray((total[end] - total[begin]) / np.where(end > begin, end - begin, np.nan))
