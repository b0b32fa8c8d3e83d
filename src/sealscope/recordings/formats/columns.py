"""Which columns of a table are which channels: headings, the units in them, and the user's map."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal

from sealscope.calls import nearest
from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, UNUSED
from sealscope.recordings.formats.headings.formula import Formula, parse_formula
from sealscope.recordings.formats.headings.labels import Label, square_brackets
from sealscope.recordings.formats.headings.proposal import (
    ends_in,
    is_recorded,
    is_scaled,
    is_temperature,
    is_time,
    map_options,
    proposed_map,
    split_unit,
    unit_of_time,
)
from sealscope.recordings.formats.headings.split_time import parts_of_time
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import same_dimension, to_si

_PARTS = re.compile(r"[./\\:<>]")
#: Channel (or `t`) -> column, as a caller gives it; or the word for what the columns' names tell. In a mapping the
#: key `REST` with that word asks for the channels that it does not name.
ChannelMap = Mapping[str, str] | Literal["auto"]
REST = "*"


@dataclass(frozen=True)
class Wanted:
    """A caller's request to a table, checked: a map and a rate [Hz]; `file`: its name in the provenance."""

    map: ChannelMap
    rate: float | None = None
    file: str = ""

    def __post_init__(self) -> None:
        check_call(self.map, self.rate)

    @property
    def infers_rate(self) -> bool:
        """True if the rate is inferred from the time and not from the table: a data frame may have lost rows since."""
        return bool(self.map) or not self.file


@dataclass
class ColumnMap:
    """The choice of columns to read, by their numbers, of a table with these `labels`.

    `time`, `time_label`: its column, and the name and unit that hold for it; `channels`: name -> what it is made of;
    `parts`: part of the time -> its column, where several columns hold the time; `date`: the column of the date, where
    the time column may hold the time of a day, or the time column itself where a date is taken for it; `rate`: of the
    samples [Hz], as the caller or the file says, or None; `names`: channel -> what the file calls it, where this is
    another name; `unused`: recorded pressures, positions, speeds and flows without a channel; `notes`: lines for the
    history.
    """

    labels: Sequence[Label]
    rate: float | None = None
    time: int | None = None
    time_label: Label | None = None
    channels: dict[str, Formula[int]] = field(default_factory=dict)
    parts: dict[str, int] = field(default_factory=dict)
    date: int | None = None
    names: dict[str, str] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)

    @property
    def channel_of(self) -> dict[int, str]:
        """Column -> a channel that is made of it."""
        return {column: name for name, formula in self.channels.items() for column in formula.factors}

    @property
    def columns(self) -> dict[int, str]:
        """Column -> "numbers", or "time" for the last one, the time; a column of hours is the time and a part of it."""
        read = {*self.channel_of, *self.parts.values()} - {self.time}
        columns = dict.fromkeys(sorted(read), "numbers")
        if self.time is not None:
            columns[self.time] = "numbers" if self.time in self.channel_of else "time"
        return columns


def split_map_option(text: str) -> tuple[str, str]:
    """Split ``p_A=PG_1`` or ``p_A=PG_1[psi]`` into channel and column of the file; raise InputError for other text."""
    channel, equals, foreign = (part.strip() for part in text.partition("="))
    if not equals or not channel or not foreign:
        raise InputError(f"a map must read CHANNEL=COLUMN, such as p_A=PG_1 or p_A=PG_1[psi], got {text!r}")
    _check_channel(channel)
    return channel, foreign


def _check_channel(channel: str) -> None:
    known = [*CHANNEL_UNITS, "t"]
    if channel not in known:
        near = nearest(channel, known)
        hint = f" (did you mean {near[0]}?)" if near else ""
        raise InputError(f"a mapped channel must be one of {', '.join(known)}, got {channel}{hint}")


def check_call(channel_map: ChannelMap, rate: float | None) -> None:
    """Raise InputError for a map of what is no channel, and for a rate that is not positive."""
    if isinstance(channel_map, str) and channel_map != "auto":
        raise InputError(f"map must be a mapping or the word auto, got {channel_map!r}")
    for channel in stated_columns(channel_map):
        _check_channel(channel)
    if not isinstance(channel_map, str) and channel_map.get(REST, "auto") != "auto":
        raise InputError(f"map must map {REST} to the word auto, got {channel_map[REST]!r}")
    if rate is not None and not (isfinite(rate) and rate > 0):
        raise InputError(f"rate must be > 0 Hz, got {rate}")


def by_names(channel_map: ChannelMap) -> bool:
    """Test whether a map takes channels by the meaning of the columns' names."""
    return isinstance(channel_map, str) or REST in channel_map


def stated_columns(channel_map: ChannelMap) -> dict[str, str]:
    """Return the part of a map that names channels and their columns."""
    return (
        {} if isinstance(channel_map, str) else {name: column for name, column in channel_map.items() if name != REST}
    )


def counted(count: int, noun: str) -> str:
    """Return the count and the noun, in the plural unless the count is 1: ``1 gap``, ``2 gaps``, ``3 stretches``."""
    ending = "" if count == 1 else "es" if noun.endswith(("s", "ch")) else "s"
    return f"{count} {noun}{ending}"


def listed(names: Iterable[str], most: int = 12) -> str:
    """Join names for a message, at most so many of them; one of over 80 characters ends in three points."""
    names = list(names)
    shown = ", ".join(name if len(name) <= 80 else f"{name[:77]}..." for name in names[:most])
    return f"{shown} and {len(names) - most} more" if len(names) > most else shown or "none"


def map_taken(provenance: Mapping[str, object]) -> dict[str, str]:
    """Return channel -> column of a recording read by the names of its columns, as its provenance keeps them."""
    names = provenance.get("columns")
    columns = {str(channel): str(whole) for channel, whole in names.items()} if isinstance(names, Mapping) else {}
    proposed = proposed_map([Label.parse(whole) for whole in columns.values()])
    return {channel: proposed.get(channel, whole) for channel, whole in columns.items()}


def _unit_of(label: Label, channel: str) -> str | None:
    """Return a column's unit, by its heading or by the ending of its name where the channel may have it."""
    ending = split_unit(label.name)[1] if label.unit is None else None
    fits = ending is not None and same_dimension(ending, "s" if channel == "t" else CHANNEL_UNITS[channel])
    return ending if fits else label.unit


def _columns_of(labels: Sequence[Label]) -> str:
    """Return the names of the columns, for messages."""
    return listed(label.whole for label in labels)


def _find(labels: Sequence[Label], name: str, what: str, mapped: bool = False) -> int | None:
    """Return the column of a name, of a number as in `#4` from 1, or, `mapped`, of a name's last words: `ch2`."""
    folded = name.casefold()
    for is_called in (
        lambda label: label.whole == name,
        lambda label: label.name == name,
        lambda label: label.called and label.called == name,
        lambda label: folded in (label.whole.casefold(), label.name.casefold()),
        lambda label: mapped and ends_in(label.name, name),
    ):
        matches = [i for i, label in enumerate(labels) if is_called(label)]
        if len(matches) > 1:
            numbers = " and ".join(str(i + 1) for i in matches)
            raise InputError(f"{what} must be one column, got columns {numbers}: map its number, #{matches[0] + 1}")
        if matches:
            return matches[0]
    number = name[1:] if name.startswith("#") else ""
    return int(number) - 1 if number.isascii() and number.isdigit() and 1 <= int(number[:9]) <= len(labels) else None


def _mapped(labels: Sequence[Label], channel: str, foreign: str) -> Formula[int]:
    """Parse a map's text to a formula; its unit overrides the heading's unit, and this the unit in the name."""
    what = f"{foreign}, mapped to {channel},"
    blank = foreign.rpartition(" ")
    for name, unit in ((foreign, None), square_brackets(foreign), (blank[0], blank[2])):
        column = _find(labels, name, what) if name else None
        if column is not None:
            return Formula({column: 1.0}, 0.0, _unit_of(labels[column], channel) if unit is None else unit)
    try:
        formula = parse_formula(foreign)
    except InputError:
        if any(sign in foreign for sign in "*+"):
            raise
        formula = Formula({foreign: 1.0})
    factors: dict[int, float] = {}
    for name, factor in formula.factors.items():
        phrase = what if name == foreign else f"{name} of {what}"
        column = _find(labels, name, phrase, mapped=True)
        if column is None:
            raise InputError(f"{phrase} must be a column, got columns {_columns_of(labels)}")
        factors[column] = factors.get(column, 0.0) + factor
    units = {_unit_of(labels[column], channel) for column in factors}
    if formula.unit is None and len(units) > 1:
        raise InputError(f"{what} must state its unit, got columns in different ones")
    return Formula(factors, formula.constant, units.pop() if formula.unit is None else formula.unit)


def _checked_unit(channel: str, unit: str | None, what: str) -> tuple[str, str | None]:
    """Return (unit, note): raw counts where no unit is given."""
    if unit is None:
        return COUNTS, f"{what} has no unit: taken as raw counts"
    if same_dimension(unit, COUNTS):
        return COUNTS, None
    if channel == "omega" and unit in WORDS["turns"]:
        return "rpm", None
    if channel == "u" and is_scaled(unit):
        return COUNTS, f"{what} is a command in {unit}: what it is in V is not known, its changes count"
    to_si(0.0, unit, CHANNEL_UNITS[channel], name=channel)
    return unit, None


def _by_map(choice: ColumnMap, columns: Mapping[str, str]) -> None:
    """Add the channels and the time named by a map to the choice."""
    for channel, foreign in columns.items():
        formula = _mapped(choice.labels, channel, foreign)
        whole = foreign if formula.column is None else choice.labels[formula.column].whole
        if channel == "t":
            if formula.column is None:
                raise InputError(f"t must be a column and its unit, such as t=time ms, got {foreign}")
            choice.time, choice.time_label = formula.column, Label(whole, whole, formula.unit)
            continue
        kind = "formula" if formula.column is None else "column"
        unit, note = _checked_unit(channel, formula.unit, f"{kind} {whole}, read as {channel},")
        choice.channels[channel] = replace(formula, unit=unit)
        if formula.column is None or choice.labels[formula.column].name != channel:
            choice.names[channel] = whole
        choice.notes.append(note or f"{kind} {whole} read as {channel} in {unit}")


def _by_own_names(choice: ColumnMap) -> None:
    """Take the other channels from the columns that bear their names, and the time where no map names it."""
    labels = choice.labels
    for channel in CHANNEL_UNITS:
        if channel in choice.channels:
            continue
        column = _find(labels, channel, f"channel {channel}")
        column = _inside(labels, channel) if column is None else column
        if column is not None and column != choice.time and column not in choice.channel_of:
            unit, note = _checked_unit(channel, _unit_of(labels[column], channel), f"column {labels[column].whole}")
            choice.channels[channel] = Formula({column: 1.0}, 0.0, unit)
            choice.names |= {} if labels[column].name == channel else {channel: labels[column].whole}
            choice.notes += [note] if note else []
    if choice.time is None and (time := _find_time(labels)) is not None:
        label = labels[time]
        unit_of_name = label.unit or WORDS["time"].get(label.name.casefold()) or unit_of_time(label)
        choice.time, choice.time_label = time, replace(label, unit=unit_of_name)


def _inside(labels: Sequence[Label], channel: str) -> int | None:
    """Return the only column with a channel's name between points or before a unit: `Rig.Cyl.p_A [bar]`, `p_A_bar`."""
    matches = [
        i
        for i, label in enumerate(labels)
        if (
            channel in _PARTS.split(label.name)
            and label.unit is not None
            and same_dimension(label.unit, CHANNEL_UNITS[channel])
        )
        or (split_unit(label.name)[0] == channel and _unit_of(label, channel) is not None)
    ]
    return matches[0] if len(matches) == 1 else None


def _find_time(labels: Sequence[Label]) -> int | None:
    if (exact := next((i for i, label in enumerate(labels) if label.name == "t"), None)) is not None:
        _find(labels, "t", "t")  # which must be one column
        return exact
    known = [
        [i for i, label in enumerate(labels) if name in (label.whole.casefold(), label.name.casefold())]
        for name in WORDS["time"]
    ]
    known.append([i for i, label in enumerate(labels) if is_time(label) and label.name.casefold() not in WORDS["date"]])
    matches = next(filter(None, known), [])
    return next((i for i in matches if labels[i].unit is not None), matches[0] if matches else None)


def _split_time(choice: ColumnMap) -> None:
    """Take the parts of the time, where several columns hold it together, and the time column where none has its name.

    Hours, minutes and seconds stand beside a date or alone; then the column of seconds or of hours is the time. Where
    nothing else tells it, and the file states no rate, a date is the time, or the only column in a unit of time.
    """
    labels, used = choice.labels, choice.channel_of
    parts = parts_of_time(labels, used)
    if "hour" in parts and choice.time in (None, *parts.values()):
        dates = [i for i in _dates(choice) if i not in parts.values()]
        time = parts["hour"] if choice.time is None else choice.time
        time = dates[0] if dates and "year" not in parts else time
        whole = ", ".join(labels[i].whole for i in dict.fromkeys((time, *parts.values())))
        choice.time_label = Label(whole, whole, "s" if choice.time is not None else None)
        choice.time, choice.parts = time, parts
        return
    if choice.time is None and choice.rate is None:
        timed = [
            i for i, label in enumerate(labels) if i not in used and label.unit and same_dimension(label.unit, "s")
        ]
        dates = _dates(choice)
        if dates or len(timed) == 1:  # `x-axis` over `second`, as oscilloscopes write
            choice.time = (dates or timed)[0]
            choice.time_label = labels[choice.time]
    if choice.time is not None:
        choice.parts = parts_of_time(labels, {*used, choice.time}, below=True)


def _dates(choice: ColumnMap) -> list[int]:
    """Return the columns called dates that no channel is made of."""
    named = [i for i, label in enumerate(choice.labels) if label.name.casefold() in WORDS["date"]]
    return [i for i in named if i not in choice.channel_of]


def choose_columns(labels: Sequence[Label], request: Wanted, stated_rate: float | None = None) -> ColumnMap:
    """Choose the columns to read, and the channel of each.

    Without a time column the samples have the rate that is wanted, else the `stated_rate` of the file itself [Hz]. A
    map `auto` is what `proposed_map` makes of the labels, for the channels and columns that the map does not name. A
    mapped channel comes before a column that bears the channel's own name. Raises InputError where a mapped column is
    missing, where no column is a channel, where there is neither time nor rate, and for a unit of another dimension.
    """
    choice, columns, rate = ColumnMap(labels, stated_rate), stated_columns(request.map), request.rate
    if by_names(request.map):
        mapped: set[int] = set()
        for channel, foreign in columns.items():
            with suppress(InputError):  # said where the map is gone through
                mapped.update(_mapped(labels, channel, foreign).factors)
        free = [Label("", "") if column in mapped else label for column, label in enumerate(labels)]
        columns = {**proposed_map(free), **columns}
    _by_map(choice, columns)
    _by_own_names(choice)
    if rate is None:
        _split_time(choice)
    if not choice.channels:
        guess = map_options(proposed_map(labels))
        raise InputError(
            f"a recording must have a channel ({', '.join(CHANNEL_UNITS)}) or be given a map such as p_A=COLUMN, "
            f"got columns {_columns_of(labels)}" + (f"; map auto would read {guess}" if guess else "")
        )
    used = {*choice.channel_of, choice.time, *choice.parts.values()}
    if rate is not None:
        choice.rate = rate
        if choice.time_label is not None:
            choice.notes.append(f"time column {choice.time_label.whole} not used: the rate was given as {rate:g} Hz")
    elif choice.time is None:
        if stated_rate is None:
            raise InputError(
                "a recording must have a time column such as t [s] or be given a rate, "
                f"got columns {_columns_of(labels)}"
            )
        choice.notes.append(f"no time column: sampled at {stated_rate:g} Hz, as the file says")
    if choice.time is not None:
        choice.date = next((i for i in _dates(choice) if i not in used), None)
    left = [label for i, label in enumerate(labels) if i not in used and i != choice.date and label.whole]
    if left:
        channel_names = {*choice.channels, "t"}
        guess = map_options(
            {name: column for name, column in proposed_map(labels).items() if name not in channel_names}
        )
        hint = f"; map auto would also read {guess}" if guess else ""
        warmth = [label.whole for label in left if is_temperature(label)]
        if warmth and "T_oil" not in channel_names:
            hint += f"; if it is the oil's temperature: --map 'T_oil={warmth[0]}'"
        choice.notes.append(f"{UNUSED}: {listed((label.whole for label in left), 40)}{hint}")
    if rate is not None:
        choice.time = choice.time_label = choice.date = None
    elif "t" not in columns and not choice.parts and choice.time is not None:
        is_date = labels[choice.time].name.casefold() in WORDS["date"]
        choice.date = choice.time if is_date else choice.date
    choice.unused = tuple(label.whole for label in left if is_recorded(label))
    choice.channels = dict(sorted(choice.channels.items(), key=lambda item: next(iter(item[1].factors))))
    return choice
