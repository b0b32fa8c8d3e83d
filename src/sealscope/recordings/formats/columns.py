"""Which columns of a table are which channels: headings, the units in them, and the user's map."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal

from sealscope.calls import nearest
from sealscope.errors import InputError, UnreadableFile
from sealscope.recordings.channels import CHANNEL_UNITS, COUNTS, UNUSED
from sealscope.recordings.formats.headings.formula import Formula
from sealscope.recordings.formats.headings.labels import Label, square_brackets
from sealscope.recordings.formats.headings.proposal import (
    ends_in,
    is_recorded,
    is_time,
    map_options,
    proposed_map,
    split_unit,
    unit_of_time,
)
from sealscope.recordings.formats.headings.split_time import below_seconds, parts_of_time
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import same_dimension, to_si

_PARTS = re.compile(r"[./\\\\:<>]")
#: Channel (or `t`) -> column, as a caller gives it; or the word for what the columns' names tell. In a mapping the
#: key `REST` with that word asks for the channels that it does not name.
ChannelMap = Mapping[str, str] | Literal["auto"]
REST = "*"


@dataclass(frozen=True)
class ColumnMap:
    """What to load of a table: the number of the time column and its label, name -> formula of each channel.

    `notes`: lines for the history; `date`: the column of the date, where the time column may hold the time of a day, or
    the time column itself where a date is taken for it; `names`: channel -> label of its column, where the file calls
    it otherwise; `rate`: of the samples [Hz], as the caller or the file says, or None; `parts`: part of the time -> its
    column, where several columns hold the time; `unused`: recorded pressures, positions and speeds that no channel is
    made of.
    """

    time: int | None
    time_label: Label | None
    channels: Mapping[str, Formula[int]]
    notes: tuple[str, ...] = ()
    date: int | None = None
    names: Mapping[str, str] = field(default_factory=dict)
    rate: float | None = None
    parts: Mapping[str, int] = field(default_factory=dict)
    unused: tuple[str, ...] = ()

    @property
    def channel_of(self) -> dict[int, str]:
        """Column -> a channel that is made of it."""
        return {column: name for name, made in self.channels.items() for column in made.factors}

    @property
    def columns(self) -> list[tuple[int, bool]]:
        """(column, whether it is read as time): those of channels and parts of the time in the table's order, the time.

        A column of hours is the time and a part of it.
        """
        read = {*self.channel_of} | (set(self.parts.values()) - {self.time})
        channels = [(column, False) for column in sorted(read)]
        return channels if self.time is None else [*channels, (self.time, True)]


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
    """Whether a map takes channels by what the columns' names tell."""
    return isinstance(channel_map, str) or REST in channel_map


def stated_columns(channel_map: ChannelMap) -> dict[str, str]:
    """Return the part of a map that names channels and their columns."""
    return {} if isinstance(channel_map, str) else {name: own for name, own in channel_map.items() if name != REST}


def counted(count: int, noun: str) -> str:
    """Return the count and the noun, in the plural unless the count is 1: ``1 gap``, ``2 gaps``, ``3 stretches``."""
    ending = "" if count == 1 else "es" if noun.endswith(("s", "ch")) else "s"
    return f"{count} {noun}{ending}"


def listed(names: Iterable[str], most: int = 12) -> str:
    """Join names for a message, at most so many of them, each cut to 40 characters."""
    names = list(names)
    shown = ", ".join(name[:40] for name in names[:most])
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


@dataclass
class _Choice:
    """What is taken of a table so far, as in `ColumnMap`; `formulas`: channel -> text of a map that is no column."""

    labels: Sequence[Label]
    place: str
    time: int | None = None
    time_label: Label | None = None
    channels: dict[str, Formula[int]] = field(default_factory=dict)
    formulas: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def columns(self) -> set[int]:
        """Columns that channels are made of."""
        return {column for made in self.channels.values() for column in made.factors}

    @property
    def have(self) -> str:
        """The names of the columns, for messages."""
        return listed(label.whole for label in self.labels)

    def find(self, name: str, what: str, mapped: bool = False) -> int | None:
        """Return the column called `name`: as written, else whatever its case, else by its number as in `#4`, from 1.

        A `mapped` one may also be called by the last words of its name: `ch2`, `Pa`.
        """
        folded, columns = name.casefold(), list(enumerate(self.labels))
        for matches in (
            [i for i, label in columns if label.whole == name],
            [i for i, label in columns if label.name == name],
            [i for i, label in columns if label.called and label.called == name],
            [i for i, label in columns if folded in (label.whole.casefold(), label.name.casefold())],
            [i for i, label in columns if mapped and ends_in(label.name, name)],
        ):
            if len(matches) > 1:
                numbers = " and ".join(str(i + 1) for i in matches)
                raise UnreadableFile(
                    f"{what} must be one column, got columns {numbers}: map its number, #{matches[0] + 1} "
                    f"({self.place})"
                )
            if matches:
                return matches[0]
        number = name[1:] if name.startswith("#") else ""
        if number.isascii() and number.isdigit() and 1 <= int(number[:9]) <= len(self.labels):
            return int(number) - 1
        return None

    def mapped(self, channel: str, foreign: str) -> Formula[int]:
        """Return what a map's text stands for: a column, a column and its unit, or a formula.

        A unit of the text goes before that of the column's heading, and this before the ending of the column's name.
        """
        what = f"{foreign}, mapped to {channel},"
        blank = foreign.rpartition(" ")
        for name, unit in ((foreign, None), square_brackets(foreign), (blank[0], blank[2])):
            column = self.find(name, what) if name else None
            if column is not None:
                return Formula({column: 1.0}, 0.0, _unit_of(self.labels[column], channel) if unit is None else unit)
        try:
            formula = Formula.parse(foreign)
        except InputError as error:
            if any(sign in foreign for sign in "*+"):
                raise UnreadableFile(f"{error} ({self.place})") from None
            formula = Formula({foreign: 1.0})
        factors: dict[int, float] = {}
        for name, factor in formula.factors.items():
            own = what if name == foreign else f"{name} of {what}"
            column = self.find(name, own, mapped=True)
            if column is None:
                raise UnreadableFile(f"{own} must be a column, got columns {self.have} ({self.place})")
            factors[column] = factors.get(column, 0.0) + factor
        units = {_unit_of(self.labels[column], channel) for column in factors}
        if formula.unit is None and len(units) > 1:
            raise UnreadableFile(f"{what} must state its unit, got columns in different ones ({self.place})")
        return Formula(factors, formula.constant, units.pop() if formula.unit is None else formula.unit)

    def checked_unit(self, channel: str, unit: str | None, what: str) -> tuple[str, str | None]:
        """Return (unit, note): raw counts where no unit is given."""
        if unit is None:
            return COUNTS, f"{what} has no unit: taken as raw counts"
        if same_dimension(unit, COUNTS):
            return COUNTS, None
        if channel == "omega" and unit in WORDS["turns"]:
            return "rpm", None
        to_si(0.0, unit, CHANNEL_UNITS[channel], name=channel, place=self.place)
        return unit, None

    def by_map(self, columns: Mapping[str, str]) -> None:
        """Take what a map says."""
        for channel, foreign in columns.items():
            made = self.mapped(channel, foreign)
            whole = self.labels[made.column].whole if made.is_column else foreign
            if channel == "t":
                if not made.is_column:
                    raise UnreadableFile(
                        f"t must be a column and its unit, such as t=time ms, got {foreign} ({self.place})"
                    )
                self.time, self.time_label = made.column, Label(whole, whole, made.unit)
                continue
            kind = "column" if made.is_column else "formula"
            unit, note = self.checked_unit(channel, made.unit, f"{kind} {whole}, read as {channel},")
            self.channels[channel] = replace(made, unit=unit)
            if not made.is_column:
                self.formulas[channel] = whole
            self.notes.append(note or f"{kind} {whole} read as {channel} in {unit}")

    def by_own_names(self) -> None:
        """Take the other channels from the columns that bear their names, and the time where no map names it."""
        for channel in CHANNEL_UNITS:
            if channel in self.channels:
                continue
            own = self.find(channel, f"channel {channel}")
            own = self._inside(channel) if own is None else own
            if own is not None and own != self.time and own not in self.columns:
                label = self.labels[own]
                unit, note = self.checked_unit(channel, _unit_of(label, channel), f"column {label.whole}")
                self.channels[channel] = Formula({own: 1.0}, 0.0, unit)
                self.notes += [note] if note else []
        if self.time is None and (time := self._find_time()) is not None:
            label = self.labels[time]
            unit_of_name = label.unit or WORDS["time"].get(label.name.casefold()) or unit_of_time(label)
            self.time, self.time_label = time, Label(label.whole, label.name, unit_of_name)

    def _inside(self, channel: str) -> int | None:
        """Return the only column that bears a channel's name between points, strokes or brackets, or before a unit.

        `Rig.Cyl.p_A [bar]`, `p_A_bar`.
        """
        unit = CHANNEL_UNITS[channel]
        matches = [
            i
            for i, label in enumerate(self.labels)
            if (channel in _PARTS.split(label.name) and label.unit is not None and same_dimension(label.unit, unit))
            or (split_unit(label.name)[0] == channel and _unit_of(label, channel) is not None)
        ]
        return matches[0] if len(matches) == 1 else None

    def _find_time(self) -> int | None:
        labels = self.labels
        if (exact := next((i for i, label in enumerate(labels) if label.name == "t"), None)) is not None:
            self.find("t", "t")
            return exact
        for name in WORDS["time"]:
            matches = [i for i, label in enumerate(labels) if name in (label.whole.casefold(), label.name.casefold())]
            if matches:
                return next((i for i in matches if labels[i].unit is not None), matches[0])
        named = [i for i, label in enumerate(labels) if is_time(label) and label.name.casefold() not in WORDS["date"]]
        return next((i for i in named if labels[i].unit is not None), named[0] if named else None)

    def split_time(self, rated: bool) -> dict[str, int]:
        """Return the parts of the time, where several columns hold it together, and set the time column.

        Hours, minutes and seconds stand beside a date or alone; then the column of seconds or of hours is the time.
        Where nothing else tells it, a date is the time, or the only column in a unit of time; `rated`: the file states
        a rate.
        """
        labels, used = self.labels, self.columns
        parts = parts_of_time(labels, [*used])
        if parts and self.time is not None and self.time not in parts.values():
            parts = {}
        dates = [i for i in self.dates() if i not in parts.values()]
        if parts:
            column = dates[0] if dates and "year" not in parts else parts["hour"] if self.time is None else self.time
            whole = ", ".join(labels[i].whole for i in dict.fromkeys((column, *parts.values())))
            self.time_label = Label(whole, whole, "s" if self.time is not None else None)
            self.time = column
            return parts
        if self.time is None and not rated:
            timed = [i for i, own in enumerate(labels) if i not in used and own.unit and same_dimension(own.unit, "s")]
            if dates or len(timed) == 1:  # `x-axis` over `second`, as oscilloscopes write
                self.time = (dates or timed)[0]
                self.time_label = labels[self.time]
        return {} if self.time is None else below_seconds(labels, [*used, self.time])

    def dates(self) -> list[int]:
        """Return the columns called dates that no channel is made of."""
        named = [i for i, label in enumerate(self.labels) if label.name.casefold() in WORDS["date"]]
        return [i for i in named if i not in self.columns]

    def check(self, rate: float | None, stated_rate: float | None) -> None:
        """Raise UnreadableFile where there is no channel, or neither a time nor a rate [Hz]."""
        if not self.channels:
            guess = map_options(proposed_map(self.labels))
            raise UnreadableFile(
                f"a recording must have a channel ({', '.join(CHANNEL_UNITS)}) or be given a map such as p_A=COLUMN, "
                f"got columns {self.have} ({self.place})" + (f"; map auto would read {guess}" if guess else "")
            )
        if rate is None and self.time is None:
            if stated_rate is None:
                raise UnreadableFile(
                    "a recording must have a time column such as t [s] or be given a rate, "
                    f"got columns {self.have} ({self.place})"
                )
            self.notes.append(f"no time column: sampled at {stated_rate:g} Hz, as the file says")


def choose_columns(
    labels: Sequence[Label],
    stated_rate: float | None = None,
    *,
    channel_map: ChannelMap,
    rate: float | None,
    place: str,
) -> ColumnMap:
    """Decide which columns are read, and as what.

    Without a time column the samples have the `rate` given, else the `stated_rate` of the file itself [Hz]. A map
    `auto` is what `proposed_map` makes of the labels, for the channels and columns that the map does not name. A mapped
    channel comes before a column that bears the channel's own name. Raises UnreadableFile where a mapped column is
    missing, where no column is a channel, and where there is neither time nor rate; InputError for a unit of another
    dimension.
    """
    choice, columns = _Choice(labels, place), stated_columns(channel_map)
    if by_names(channel_map):
        taken: set[int] = set()
        for channel, foreign in columns.items():
            with suppress(UnreadableFile):  # said where the map is gone through
                taken.update(choice.mapped(channel, foreign).factors)
        free = [Label("", "") if column in taken else label for column, label in enumerate(labels)]
        columns = {**proposed_map(free), **columns}
    choice.by_map(columns)
    choice.by_own_names()
    parts = choice.split_time(stated_rate is not None) if rate is None else {}
    choice.check(rate, stated_rate)
    time, time_label, channels, notes = choice.time, choice.time_label, choice.channels, choice.notes
    used = choice.columns | {time} | set(parts.values())
    date = next((i for i in choice.dates() if i not in used), None) if time is not None else None
    left = [label for i, label in enumerate(labels) if i not in used and i != date and label.whole]
    if rate is not None and time_label is not None:
        notes.append(f"time column {time_label.whole} not used: the rate was given as {rate:g} Hz")
        time = time_label = None
    if left:
        guesses = {name: column for name, column in proposed_map(labels).items() if name not in {*channels, "t"}}
        hint = f"; map auto would also read {map_options(guesses)}" if guesses else ""
        notes.append(f"{UNUSED}: {listed((label.whole for label in left), 40)}{hint}")
    if time is None:
        date = None
    elif "t" not in columns and not parts and labels[time].name.casefold() in WORDS["date"]:
        date = time
    own = {channel: labels[made.column] for channel, made in channels.items()}
    return ColumnMap(
        time,
        time_label,
        dict(sorted(channels.items(), key=lambda item: item[1].column)),
        tuple(notes),
        date,
        {channel: label.whole for channel, label in own.items() if label.name != channel} | choice.formulas,
        stated_rate if rate is None else rate,
        parts,
        tuple(label.whole for label in left if is_recorded(label)),
    )
