"""Columns of several actuators in one table: boom and stick, left and right, cylinder 1 and 2.

Words for a machine separate its columns from those of another. Some are such words in any heading, as `boom`; others
only in a context: `left` beside `cylinder`, but not beside `chamber`; the number of a cylinder, but not that of a
chamber; any word if it splits the pressures and the position of the table in two sets with the same quantities. A
column without such a word, as the oil temperature, belongs to every actuator. Called by the choice of columns.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from sealscope.errors import InputError
from sealscope.paragraphs import join_names
from sealscope.recordings.formats.headings.labels import (
    WORDS,
    Label,
    find_name_and_unit,
    find_sides,
    guess_channel,
    is_time,
    iter_tokens,
    strip_accents,
)

_MACHINE = {kind: frozenset(words) for kind, words in WORDS["machine"].items()}
#: Spelling of an adjective -> its usual form, as `l` -> `left`.
_ADJECTIVES = {word: words[0] for words in WORDS["adjective"].values() for word in words}
#: Words that say what a column measures, or which of several readings: never words for a machine.
_QUANTITIES = frozenset(
    word for table in ("measured", "side", "kind") for words in WORDS[table].values() for word in words
) | frozenset(WORDS["generic"])
#: Channels of the cylinder, of which each actuator has its own.
_CYLINDER = ("p_A", "p_B", "x")
#: Most actuators that are told apart in a table; more are no machine's, and would take quadratic time.
_MAX_ACTUATORS = 64
_SEPARATORS = re.compile(r"([ _.:/\\<>-])[ _.:/\\<>-]+")


class _Word(NamedTuple):
    """A word of a heading that may name a machine."""

    text: str  # its usual form, as "left" of "links", and the number alone of "cylinder 1"
    kind: str  # "part", "noun" (of a number or letter beside it), "adjective", "number" or "other"
    span: tuple[int, int]  # characters of the heading that it takes
    shown: str  # as the heading has it
    beside_noun: bool = False  # beside a word for a machine or its part


class _Column(NamedTuple):
    """A column with the words of its heading."""

    label: Label
    text: str  # path and name without the unit
    unit: str | None
    words: tuple[_Word, ...]

    def key(self, keywords: Iterable[str]) -> frozenset[str]:
        """Collect the words of the column that are among `keywords`."""
        return frozenset(word.text for word in self.words) & frozenset(keywords)

    def without(self, keywords: Iterable[str]) -> Label:
        """Return the label with a name that lacks the words among `keywords`."""
        text = self.text
        for word in sorted(self.words, key=lambda word: -word.span[0]):
            if word.text in keywords:
                text = text[: word.span[0]] + " " + text[word.span[1] :]
        text = _SEPARATORS.sub(r"\1", re.sub(r"(?<=[_.:/\\]) | (?=[_.:/\\])", "", text)).strip(" _.:/\\<>-")
        return self.label if text == self.text else replace(self.label, name=text, unit=self.unit)


@dataclass(frozen=True)
class Actuators:
    """The actuators of a table, and the columns of each.

    Parameters
    ----------
    names : tuple of str
        Name of each actuator, as in the headings, such as "boom"; empty if no heading has a word for a machine.
    keys : tuple of frozenset of str
        Usual forms of the words in each name.
    columns : tuple of tuple of str
        Headings of the columns that have words for this actuator, by actuator.
    labels : tuple of tuple of Label
        Labels of all columns without the words for this actuator, by actuator; empty where a column is another's.
    shared : tuple of Label
        Labels of all columns, empty where a column is not common to all actuators.
    default : int, optional
        Number of the actuator to read if nobody names one; None if this must be asked.
    """

    names: tuple[str, ...] = ()
    keys: tuple[frozenset[str], ...] = ()
    columns: tuple[tuple[str, ...], ...] = ()
    labels: tuple[tuple[Label, ...], ...] = ()
    shared: tuple[Label, ...] = ()
    default: int | None = None

    def find(self, group: str) -> int:
        """Find the number of the actuator that a user calls `group`; raise InputError if none or several are."""
        known_words = frozenset[str]().union(*self.keys)
        group_words = frozenset(word.text for word in _read_words(Label(group, group)).words) & known_words
        folded = group.strip().casefold()
        matches = [k for k, key in enumerate(self.keys) if group_words and group_words <= key]
        matches = [k for k in matches if group_words == self.keys[k]] or matches
        matches = matches or [k for k, name in enumerate(self.names) if folded in (name, *name.split())]
        if len(matches) != 1:
            known = join_names(self.names) if self.names else "none, as no heading has a word for one"
            raise InputError(f"group must be one actuator of the columns, got {group!r}; these have {known}")
        return matches[0]

    def find_containing(self, columns: Iterable[int]) -> list[int]:
        """List the actuators to which all of these columns (numbers) belong."""
        return [k for k, labels in enumerate(self.labels) if all(labels[column].whole for column in columns)]

    def question(self) -> str:
        """Return the question which of the actuators is meant, with the columns of each."""
        groups = "; ".join(
            f"{name}: {join_names(columns, 6)}" for name, columns in zip(self.names, self.columns, strict=True)
        )
        return (
            f"columns must be those of one actuator, got those of {len(self.names)} ({groups}): choose one, as by "
            f"--group '{self.names[0]}', or name its columns, as by --map p_A=COLUMN"
        )


def find_actuators(labels: Sequence[Label]) -> Actuators:
    """Find the actuators to which the columns of a table belong, by the words of their headings.

    The default is the only actuator, else that whose channels a file with groups of channels calls by bare names, else
    the only one with pressures.
    """
    columns = [_read_words(label) for label in labels]
    channels = _guess_channels([column.label for column in columns])
    keywords = _choose_keywords(columns, channels, find_sides(labels))
    keys = [column.key(keywords) for column in columns]
    # without the words for the machine a heading may show a channel that it hid before, as `Axis A pressure B`
    cleaned = [column.without(keywords) for column in columns]
    channels = [
        inner if key else channel for key, channel, inner in zip(keys, channels, _guess_channels(cleaned), strict=True)
    ]
    known = dict.fromkeys(key for key, channel in zip(keys, channels, strict=True) if channel in _CYLINDER and key)
    candidates = [*known][:_MAX_ACTUATORS]
    groups = [key for key in candidates if not any(key < other for other in candidates)]
    if not groups:
        return Actuators()
    is_clock = [is_time(label) for label in labels]
    shown = {word.text: word.shown for column in reversed(columns) for word in reversed(column.words)}
    words_of = {key: [word.text for word in column.words] for key, column in zip(keys, columns, strict=True)}

    def find_own(channel_names: Iterable[str], *, bare: bool = False) -> list[int]:
        """List the groups that have some of these channels, or those called by a bare name, to themselves."""
        group_keys = {
            key
            for key, channel, label in zip(keys, channels, labels, strict=True)
            if key and (channel or "") in channel_names and (not bare or label.whole.endswith(f"/{label.name}"))
        }
        return [k for k, group in enumerate(groups) if any(key <= group for key in group_keys)]

    choices = (range(len(groups)), find_own(_CYLINDER, bare=True), find_own(("p_A", "p_B")))
    return Actuators(
        tuple(" ".join(shown[word] for word in sorted(group, key=words_of[group].index)) for group in groups),
        tuple(groups),
        tuple(
            tuple(label.whole for label, key in zip(labels, keys, strict=True) if key and key <= group)
            for group in groups
        ),
        tuple(
            tuple(
                (clean if len(groups) > 1 else label) if key <= group or clock else Label("", "")
                for key, clean, label, clock in zip(keys, cleaned, labels, is_clock, strict=True)
            )
            for group in groups
        ),
        tuple(Label("", "") if key else label for key, label in zip(keys, labels, strict=True)),
        next((choice[0] for choice in choices if len(choice) == 1), None),
    )


def _read_words(label: Label) -> _Column:
    """Read the words of a heading that may name a machine."""
    stem, unit = find_name_and_unit(label)
    path = label.whole.removesuffix(label.name) if label.whole.endswith(f"/{label.name}") else ""
    text = strip_accents(path + stem)
    tokens = list(iter_tokens(text))
    words, position = [_Word(part, "part", span, part, True) for part, span in _find_unspaced_parts(text)], 0
    while position < len(tokens):
        token, span = tokens[position]
        before = tokens[position - 1][0] if position else ""
        after = tokens[position + 1][0] if position + 1 < len(tokens) else ""
        if token in _MACHINE["noun"] and _is_mark(after):  # `cylinder 1`, `Achse A`
            mark = (after.lstrip("0") or "0") if after.isdigit() else f"{token} {after}"
            words.append(_Word(mark, "noun", (span[0], tokens[position + 1][1][1]), f"{token} {after}", True))
            position += 2
            continue
        part = next((part for part in _MACHINE["part"] if token == part or _is_compound(token, part)), None)
        compound = next((noun for noun in _MACHINE["cylinder"] if token.endswith(noun) and token != noun), None)
        beside_noun = not {before, after}.isdisjoint(_MACHINE["noun"] | _MACHINE["part"])
        next_but_one = tokens[position + 2][0] if position + 2 < len(tokens) else ""
        is_of_chamber = {before, after} & _MACHINE["chamber"] or (
            next_but_one in _MACHINE["chamber"] and _ADJECTIVES.get(token) not in ("left", "right")
        )
        if part is not None:
            words.append(_Word(part, "part", (span[0], span[0] + len(part)), part, True))
        elif compound is not None and token.removesuffix(compound) not in _MACHINE["neutral"]:  # `Kippzylinder`
            stem_end = span[1] - len(compound)
            words.append(_Word(token.removesuffix(compound), "part", (span[0], stem_end), token, True))
        elif token in _ADJECTIVES and not is_of_chamber:
            words.append(_Word(_ADJECTIVES[token], "adjective", span, token, beside_noun))
        elif token.isdigit():
            is_mark = len(token) < 3 and (not before or before in _QUANTITIES)
            kind = "noun" if before in _MACHINE["part"] else "number" if is_mark else "other"
            words.append(_Word(token.lstrip("0") or "0", kind, span, token))
        elif token not in _QUANTITIES and token not in _MACHINE["noun"] | _MACHINE["neutral"]:
            words.append(_Word(token, "other", span, token, beside_noun))
        position += 1
    return _Column(label, text, unit, tuple(words))


def _find_unspaced_parts(text: str) -> list[tuple[str, tuple[int, int]]]:
    """Find the parts of machines in a text of a script without spaces between words, with their positions."""
    found = [(part, text.find(part)) for part in _MACHINE["part"] if ord(part[0]) > 0x2E7F]
    return [(part, (begin, begin + len(part))) for part, begin in found if begin >= 0]


def _is_mark(token: str) -> bool:
    """Test whether a word may number a machine: a number of one or two digits, or a single letter."""
    is_letter = len(token) == 1 and token.isalpha() and token not in "pxtnuqs"
    return is_letter or (token.isdigit() and len(token) < 3)


def _is_compound(token: str, part: str) -> bool:
    """Test whether a word is a German compound of the name of a part, such as `auslegerdruck`."""
    return len(part) > 3 and token.startswith(part) and token[len(part) :] in _MACHINE["ending"]


def _guess_channels(labels: Sequence[Label]) -> list[str | None]:
    """Guess the channel of each label, as the map "auto" does; pressures 1 and 2 alone are those of A and B."""
    sides = find_sides(labels)
    channels = [guess_channel(label, sides) if label.whole else None for label in labels]
    if not {"p_A", "p_B"} & set(channels):
        channels = [{"p_1": "p_A", "p_2": "p_B"}.get(channel or "", channel) for channel in channels]
    return channels


def _choose_keywords(columns: Sequence[_Column], channels: Sequence[str | None], sides: Mapping[str, str]) -> set[str]:
    """Choose the words of the headings that are names of machines.

    `channels`: guessed channel of each column; `sides`: as from `find_sides`, for all columns.
    """
    chambers: Mapping[str, set[str]] = defaultdict(set)  # word -> channels of the cylinder that have it
    kinds: Mapping[str, set[str]] = defaultdict(set)
    beside_noun = set[str]()
    for column, channel in zip(columns, channels, strict=True):
        for word in column.words:
            if word.kind == "noun":  # its letter or number may be that of a chamber, as in `Cylinder A [bar]`
                inner = guess_channel(column.without({word.text}), sides)
                is_axis = word.text.split()[0] in _MACHINE["axis"]  # a number has no noun
                if inner in (*_CYLINDER, "p_1", "p_2") or is_axis:
                    chambers[word.text].add(inner or "")
                    kinds[word.text].add("noun" if inner != "x" else "position")
            elif channel in _CYLINDER and not (word.kind == "number" and _is_side(column, word, channel, sides)):
                chambers[word.text].add(channel)
                kinds[word.text].add(word.kind)
                beside_noun |= {word.text} if word.beside_noun else set()
    keywords = {word for word, found in kinds.items() if found & {"part", "noun"}}
    positions = {word for word, found in kinds.items() if "position" in found}
    if len(positions) > 1:
        keywords |= positions
    adjectives = {word for word, found in kinds.items() if "adjective" in found}
    if adjectives & beside_noun and len(adjectives | keywords) > 1:  # `main boom` and `jib boom`
        keywords |= adjectives & beside_noun
    if len(adjectives) > 1 and (any(len(chambers[word]) > 1 for word in adjectives) or {"left", "right"} <= adjectives):
        keywords |= adjectives
    numbers = {word for word, found in kinds.items() if "number" in found}
    if _is_mixed(numbers, chambers):
        keywords |= numbers
    if keywords & numbers:  # `cylinder 1` and `x_2`
        keywords |= numbers
    splitting_words = {word for word, found in kinds.items() if found & {"other", "number", "adjective"}} - keywords
    if keywords:  # the motor of another part, such as the slewing gear's
        keywords |= {word.text for column in columns for word in column.words if word.kind == "part"}
    return keywords | _find_splitting(splitting_words, columns, channels)


def _is_side(column: _Column, number: _Word, channel: str, sides: Mapping[str, str]) -> bool:
    """Test whether the number in a heading is that of the chamber, so that without it the channel is not known."""
    return channel != "x" and guess_channel(column.without({number.text}), sides) != channel


def _is_mixed(numbers: Iterable[str], chambers: Mapping[str, set[str]]) -> bool:
    """Test whether p_A has one number and p_B another, of which one is that of a further column: p_A_1, p_B_2, x_1."""
    with_A = {number for number in numbers if "p_A" in chambers[number]}
    with_B = {number for number in numbers if "p_B" in chambers[number]}
    repeats = any(len(chambers[number]) > 1 for number in with_A | with_B)
    return bool(with_A and with_B) and with_A != with_B and repeats


def _find_splitting(words: set[str], columns: Sequence[_Column], channels: Sequence[str | None]) -> set[str]:
    """Find those `words` by which columns of the same channel differ, two channels or more by the same pair."""
    keys: dict[str, list[frozenset[str]]] = {name: [] for name in _CYLINDER}
    for column, channel in zip(columns, channels, strict=True):
        if channel in _CYLINDER:
            keys[channel].append(column.key(words))
    pairs = defaultdict[tuple[str, str], set[str]](set)  # words that tell two columns of a channel apart -> channels
    for channel, found in keys.items():
        distinct = [*dict.fromkeys(found)][:_MAX_ACTUATORS]
        for first in distinct:
            for second in distinct:
                pairs_of_words = ((a, b) for a in first - second for b in second - first)
                for pair in pairs_of_words:
                    pairs[pair].add(channel)
    return {word for pair, found in pairs.items() if len(found) > 1 for word in pair}
