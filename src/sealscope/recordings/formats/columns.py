"""Which columns of a foreign table are which channels: names, units in names, and the user's map."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.recording import CHANNEL_UNITS, COUNTS
from sealscope.units import parse_unit, same_dimension

_BRACKETS = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]\s*")
_SOFT_UNIT = re.compile(
    r"(?P<name>.*?)(?:\s*\((?P<unit>[^()]*(?:\([^()]*\))?[^()]*)\)|\s/\s(?P<over>[^/]+(?:/[^/]+)?))\s*"
)
#: Names of a time column, most telling first, and the unit that the name itself tells.
_TIME_NAMES = {
    "t": None,
    "time": None,
    "zeit": None,
    "elapsed time": None,
    "elapsed": None,
    "time since start": None,
    "x_value": "s",
    "timestamp": None,
    "time stamp": None,
    "time_stamp": None,
    "datetime": None,
    "date_time": None,
    "date/time": None,
    "date time": None,
    "time_s": "s",
    "t_s": "s",
    "seconds": "s",
    "time_ms": "ms",
    "t_ms": "ms",
    "milliseconds": "ms",
}


@dataclass(frozen=True)
class Label:
    """A column's heading: `whole` as it stands, `name` without the unit, `unit` where one is told."""

    whole: str
    name: str
    unit: str | None = None

    @classmethod
    def parse(cls, text: str, unit: str | None = None) -> Label:
        """`p_A [psi]`, `p_A (psi)` and `p_A / psi`; a unit told elsewhere (a row or an attribute) is `unit`."""
        whole = text.strip()
        match = _BRACKETS.fullmatch(whole)
        if match:
            return cls(whole, match["name"], match["unit"].strip() if unit is None else unit)
        match = _SOFT_UNIT.fullmatch(whole)
        if match and match["name"]:
            told = (match["unit"] or match["over"]).strip()
            return cls(whole, match["name"], _unit_or_none(told) if unit is None else unit)
        return cls(whole, whole, unit)

    def is_called(self, name: str) -> bool:
        return name in (self.whole, self.name)


def _unit_or_none(text: str) -> str | None:
    """Round brackets may hold a remark (`pressure (port A)`) as well as a unit."""
    try:
        parse_unit(text)
    except InputError:
        return None
    return text


@dataclass(frozen=True)
class Plan:
    """What to load: `time` column and its unit, `channels`: name -> (column, unit); `notes` for the history."""

    time: int | None
    time_unit: str | None
    channels: Mapping[str, tuple[int, str]]
    notes: tuple[str, ...] = field(default=())

    @property
    def columns(self) -> list[int]:
        """The columns of the channels, each once, in the table's order."""
        return sorted({column for column, _ in self.channels.values()})


def split_map_option(text: str) -> tuple[str, str]:
    """``p_A=PG_1`` or ``p_A=PG_1[psi]`` as (channel, column of the file); raises InputError."""
    channel, equals, foreign = (part.strip() for part in text.partition("="))
    if not equals or not channel or not foreign:
        raise InputError(f"a map must read CHANNEL=COLUMN, such as p_A=PG_1 or p_A=PG_1[psi], got {text!r}")
    check_channel(channel)
    return channel, foreign


def check_channel(channel: str) -> None:
    """Raises InputError, with the nearest name, where `channel` is neither a channel nor `t`."""
    known = [*CHANNEL_UNITS, "t"]
    if channel not in known:
        near = difflib.get_close_matches(channel, known, 1, 0.5)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise InputError(f"a mapped channel must be one of {', '.join(known)}, got {channel}{hint}")


def _find(labels: Sequence[Label], name: str, what: str, place: str) -> int | None:
    """The one column called `name`: as written, else whatever its case."""
    folded = name.casefold()
    for matches in (
        [i for i, label in enumerate(labels) if label.whole == name],
        [i for i, label in enumerate(labels) if label.name == name],
        [i for i, label in enumerate(labels) if folded in (label.whole.casefold(), label.name.casefold())],
    ):
        if len(matches) > 1:
            found = " and ".join(str(i + 1) for i in matches)
            raise UnreadableFile(f"{what} must be one column, got columns {found} ({place})")
        if matches:
            return matches[0]
    return None


def listed(names: Iterable[str], most: int = 12) -> str:
    """Names for a message, not too many of them."""
    names = list(names)
    shown = ", ".join(name[:40] for name in names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown or "none"


def _mapped(labels: Sequence[Label], channel: str, foreign: str, place: str) -> tuple[int, str | None]:
    what = f"{foreign}, mapped to {channel},"
    column = _find(labels, foreign, what, place)
    if column is not None:
        return column, labels[column].unit
    match = _BRACKETS.fullmatch(foreign)
    if match:
        column = _find(labels, match["name"], what, place)
        if column is not None:
            return column, match["unit"].strip()
    raise UnreadableFile(f"{what} must be a column, got columns {listed(label.whole for label in labels)} ({place})")


def _checked_unit(channel: str, unit: str | None, what: str, place: str) -> tuple[str, str | None]:
    """(unit, note): raw counts where no unit is told."""
    if unit is None:
        return COUNTS, f"{what} has no unit: taken as raw counts"
    if same_dimension(unit, COUNTS):
        return COUNTS, None
    si_unit = CHANNEL_UNITS[channel]
    if not same_dimension(unit, si_unit):
        from sealscope.units import to_si

        try:
            to_si(0.0, unit, si_unit, name=channel, place=place)
        except InputError as error:
            raise UnreadableFile(str(error)) from None
    return unit, None


def _find_time(labels: Sequence[Label], place: str) -> int | None:
    if (exact := next((i for i, label in enumerate(labels) if label.name == "t"), None)) is not None:
        _find(labels, "t", "t", place)
        return exact
    for name in _TIME_NAMES:
        matches = [i for i, label in enumerate(labels) if name in (label.whole.casefold(), label.name.casefold())]
        if matches:
            with_unit = [i for i in matches if labels[i].unit is not None]
            return (with_unit or matches)[0]
    return None


def plan(labels: Sequence[Label], channel_map: Mapping[str, str], rate: float | None, place: str) -> Plan:
    """Decide which columns are read, and as what.

    A mapped channel comes before a column that bears the channel's own name. Raises UnreadableFile where a mapped
    column is missing or its unit is of another dimension, where no column is a channel, and where there is neither time
    nor rate.
    """
    notes: list[str] = []
    channels: dict[str, tuple[int, str]] = {}
    time: int | None = None
    time_unit: str | None = None
    for channel, foreign in channel_map.items():
        column, unit = _mapped(labels, channel, foreign, place)
        if channel == "t":
            time, time_unit = column, unit
            continue
        told, note = _checked_unit(channel, unit, f"column {labels[column].whole}, read as {channel},", place)
        channels[channel] = column, told
        notes += [note] if note else [f"column {labels[column].whole} read as {channel} in {told}"]
    for channel in CHANNEL_UNITS:
        if channel in channels:
            continue
        found = _find(labels, channel, f"channel {channel}", place)
        if found is not None and found != time and found not in {column for column, _ in channels.values()}:
            told, note = _checked_unit(channel, labels[found].unit, f"column {labels[found].whole}", place)
            channels[channel] = found, told
            notes += [note] if note else []
    if time is None:
        time = _find_time(labels, place)
        if time is not None:
            time_unit = labels[time].unit or _TIME_NAMES.get(labels[time].name.casefold())
    if not channels:
        raise UnreadableFile(
            f"a recording must have a channel ({', '.join(CHANNEL_UNITS)}) or be given a map such as p_A=COLUMN, "
            f"got columns {listed(label.whole for label in labels)} ({place})"
        )
    seen_time = time
    if rate is not None and time is not None:
        notes.append(f"time column {labels[time].whole} not used: the rate was given as {rate:g} Hz")
        time = None
    elif rate is None and time is None:
        raise UnreadableFile(
            f"a recording must have a time column such as t [s] or be given a rate, "
            f"got columns {listed(label.whole for label in labels)} ({place})"
        )
    order = {channel: channels[channel] for channel in sorted(channels, key=lambda c: channels[c][0])}
    used = {column for column, _ in order.values()} | {seen_time}
    ignored = [label.whole for i, label in enumerate(labels) if i not in used and label.whole]
    if ignored:
        notes.append(f"columns not used: {listed(ignored, 40)}")
    return Plan(time, time_unit, order, tuple(notes))
