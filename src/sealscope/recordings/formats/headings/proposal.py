"""Which channel a foreign column probably is, by the words of its name in several languages and by its unit."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.formats.headings.labels import Label
from sealscope.recordings.formats.headings.words import WORDS
from sealscope.units import is_familiar, same_dimension

_MEASURED = {name: frozenset(words) for name, words in WORDS["measured"].items()}
_SIDE = {name: frozenset(words) for name, words in WORDS["side"].items()}
_KIND = {name: frozenset(words) for name, words in WORDS["kind"].items()}
#: Words of a script that writes no blanks between words.
_UNSPACED = frozenset(
    word for words in (*_MEASURED.values(), *_SIDE.values()) for word in words if ord(word[0]) > 0x2E7F
)
#: What a column measures -> the unit, and the channel, that it has; a pressure's channel follows from its side.
_UNITS = {"oil": "K", "position": "m", "command": "V", "speed": "rad/s", "angle": "rad", "leak": "m^3/s", "time": "s"}
_CHANNELS = {
    "oil": "T_oil", "position": "x", "command": "u", "spool": "u", "speed": "omega", "angle": "theta", "leak": "q_leak",
    "time": "t"
}  # fmt: skip
_SHARES = frozenset(("%", "percent", "pct", "Prozent", "prozent"))
_PRESSURES = {"A": "p_A", "B": "p_B", "1": "p_1", "2": "p_2", "pump 1": "p_1", "pump 2": "p_2"}
_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+")
#: The last word of `MainPaBar`; in `MainPa` it is the pressure A, and no pascal.
_HUMPED = re.compile(r"(?<=[a-z\d])[A-Z]+[a-z]*$")
_LONGEST_NAME = 80


class _Guess(NamedTuple):
    """`kind`: what a column measures; `side`: "A", "B", "pump" or a number as text; `unit`: of its name's ending."""

    kind: str
    side: str
    unit: str | None

    @property
    def channel(self) -> str | None:
        if self.kind == "flow":
            return "q_pump" if self.side == "A" else None
        return _PRESSURES.get(self.side) if self.kind == "pressure" else _CHANNELS[self.kind]


def proposed_map(labels: Sequence[Label]) -> dict[str, str]:
    """Return channel (or ``t``) -> column, as a map gives them, for the columns whose meaning their names tell.

    A column that bears a channel's own name is left out, and a channel that several columns could be. A unit at the end
    of a name (``PA_bar``) becomes the column's unit.
    """
    channel_names = {label.name.casefold() for label in labels} & {name.casefold() for name in CHANNEL_UNITS}
    head = _side_of_head(labels)
    candidates: dict[str, list[tuple[Label, _Guess]]] = {}
    for label in labels:
        guess = None if label.name.casefold() in channel_names else _guess(label, head)
        if guess is not None and guess.channel is not None:
            candidates.setdefault(guess.channel, []).append((label, guess))
    if "p_A" not in candidates and "p_B" not in candidates and not {"p_a", "p_b"} & channel_names:
        for channel, pumped in (("p_A", "p_1"), ("p_B", "p_2")):  # pressures 1 and 2 alone are those of the chambers
            if pumped in candidates:
                candidates[channel] = candidates.pop(pumped)
    driven = ({*candidates} | channel_names) & {"omega", "theta"}
    if (
        ("u" in candidates or "u" in channel_names)
        and not driven
        and not {"p_1", "p_2"} & ({*candidates} | channel_names)
    ):
        for channel, kind in (("p_1", "before"), ("p_2", "behind")):  # of a valve, whose command is recorded
            candidates[channel] = [(label, guess) for label in labels if (guess := _guess_at_valve(label, kind))]
    result = {}
    for channel in (*CHANNEL_UNITS, "t"):
        columns = candidates.get(channel, [])
        if channel == "u" and any(guess.kind == "command" for _, guess in columns):  # the spool follows it
            columns = [column for column in columns if column[1].kind == "command"]
        if len(columns) > 1:  # what is made of another column gives way to it
            columns = [column for column in columns if not _words_of(column[0].name) & _KIND["made"]]
        if len(columns) == 1 and channel.casefold() not in channel_names:
            label, guess = columns[0]
            result[channel] = label.whole + (f"[{guess.unit}]" if guess.unit not in (None, label.unit) else "")
    return {} if set(result) <= {"t"} else result


def map_options(channel_map: Mapping[str, str]) -> str:
    """Return a map in words."""
    return ", ".join(f"{channel}={column}" for channel, column in channel_map.items())


def is_time(label: Label) -> bool:
    """Test whether a column holds the time, by its name."""
    guess = _guess(label)
    return guess is not None and guess.kind == "time"


def unit_of_time(label: Label) -> str | None:
    """Return the unit that a time column states, in its heading or at the end of its name."""
    guess = _guess(label)
    return guess.unit if guess is not None and guess.kind == "time" else None


def knows(text: str) -> bool:
    """Test whether a text holds a known word of a script without blanks between words."""
    return any(word in text for word in _UNSPACED)


def measures(text: str) -> bool:
    """Test whether a heading names a measured quantity, in one of the languages known here."""
    return _guess(Label.parse(text)) is not None


#: Endings that are units behind words of their kind alone: a set point x_s, a demand p_d, a least pressure p_min.
_AMBIGUOUS = {**dict.fromkeys(("s", "min", "h", "d"), "time"), "m": "position"}


def split_unit(name: str) -> tuple[str, str | None]:
    """Split `PA_bar`, `flow_l_min` or `MainPaBar` into name and unit; (name, None) without a channel's unit."""
    parts = name.replace(" ", "_").split("_")
    endings = [("_".join(parts[:-2]), "/".join(parts[-2:])), ("_".join(parts[:-1]), parts[-1])]
    humped = _HUMPED.search(name)
    if humped and len(humped[0]) > 2:
        endings.append((name[: humped.start()], humped[0]))
    for before, unit in endings:
        if not before or not unit or unit in ("A", "B", "a", "b"):
            continue
        kind = _AMBIGUOUS.get(unit)
        if kind is not None and not _words_of(before) & _MEASURED[kind]:  # x_s may as well be a set point
            continue
        known = (*CHANNEL_UNITS.values(), "s", "m/s")
        if is_familiar(unit) and (is_scaled(unit) or any(same_dimension(unit, known_unit) for known_unit in known)):
            return before, unit
    return name, None


def ends_in(name: str, words: str) -> bool:
    """Test whether a column's name ends in these words: `ch2` of `ADC1_Channel_2`, `Pa` of `Main_Pa`."""
    tokens = ([token.casefold() for token in _TOKEN.findall(_plain(text))] for text in (name, words))
    name_tokens, ending = (["channel" if token in WORDS["input"] else token for token in text] for text in tokens)
    return words[:1].isalpha() and 0 < len(ending) <= len(name_tokens) and name_tokens[-len(ending) :] == ending


def is_temperature(label: Label) -> bool:
    """Test whether a column is in a unit of temperature."""
    unit = split_unit(label.name)[1] if label.unit is None else label.unit
    return unit is not None and same_dimension(unit, "K")


def is_recorded(label: Label) -> bool:
    """Test whether a column is a measured pressure, position or speed, by its name or its unit."""
    if len(label.name) > _LONGEST_NAME:
        return False
    name, ending = split_unit(label.name)
    unit = ending if label.unit is None else label.unit
    words = _words_of(name)
    if words & (_KIND["wanted"] | _KIND["made"]):
        return False
    if unit is not None:
        recorded = ("Pa", "m", "rad/s", "m/s", "m^3/s")
        return unit in WORDS["turns"] or any(same_dimension(unit, recorded_unit) for recorded_unit in recorded)
    kinds = (*(_MEASURED[kind] for kind in ("pressure", "position", "speed")), _KIND["supply"], _KIND["velocity"])
    return len(name) > 1 and any(words & known for known in kinds)


def _plain(text: str) -> str:
    """Return a name without accents, the umlauts as two letters."""
    for umlaut, letters in zip("äöüßÄÖÜłŁ", ("ae", "oe", "ue", "ss", "Ae", "Oe", "Ue", "l", "L"), strict=True):
        text = text.replace(umlaut, letters)
    return "".join(sign for sign in unicodedata.normalize("NFKD", text) if not unicodedata.combining(sign))


def _words_of(name: str) -> set[str]:
    """Return the words of a name, the ends of compounds, and `p` and the side of `pa`."""
    words = {word for word in _UNSPACED if word in name}
    for token in (token.casefold() for token in _TOKEN.findall(_plain(name))):
        words |= {token, "p", token[1:]} if token in ("pa", "pb") else {token}
        words |= {ending for ending in WORDS["endings"] if token.endswith(ending)}
    return words


def _side_of_head(labels: Sequence[Label]) -> str:
    """Return the chamber of the columns called head: A beside a rod, B beside a cap; empty where unknown."""
    words = {word for label in labels if len(label.name) <= _LONGEST_NAME for word in _words_of(label.name)}
    if not words & _SIDE["head"]:
        return ""
    return "A" if words & (_SIDE["B"] - {"b"}) else "B" if words & (_SIDE["A"] - {"a"}) else ""


def _guess(label: Label, head: str = "") -> _Guess | None:
    """Guess the meaning of a column from its name; `head`: the chamber that the word head stands for."""
    if len(label.name) > _LONGEST_NAME:
        return None
    name, unit = split_unit(label.name)
    words = _words_of(name if label.unit is None and unit is not None else label.name)
    unit = label.unit if label.unit is not None else unit
    side = head if words & _SIDE["head"] and head else _side(words)
    if unit is not None and same_dimension(unit, "Pa"):
        return None if words & (_KIND["other"] | _KIND["wanted"]) else _Guess("pressure", side, unit)
    if unit is not None and words & _KIND["oil"] and same_dimension(unit, "K"):
        return _Guess("oil", "", unit)
    if words & _MEASURED["spool"]:
        return _Guess("spool", "", unit) if unit is None or _commands(unit) else None
    if unit is not None and same_dimension(unit, "m^3/s"):
        kind = "leak" if words & _MEASURED["leak"] else "flow"
        return _Guess(kind, side, unit) if words & _MEASURED[kind] else None
    measured = any(words & _MEASURED[kind] for kind in ("pressure", "position", "speed", "angle"))
    if words & _KIND["other"] or (words & _KIND["wanted"] and measured):
        return None
    turns = unit is not None and (unit in WORDS["turns"] or same_dimension(unit, "rad/s"))
    if turns and words & (_MEASURED["speed"] | _KIND["motor"]):
        return _Guess("speed", side, "rpm" if unit in WORDS["turns"] else unit)
    if unit is not None and "s" in words and same_dimension(unit, "m"):  # the path in German books
        return _Guess("position", side, unit)
    if unit is not None and words & _MEASURED["command"] and _commands(unit):
        return _Guess("command", side, unit)
    for kind, known in _MEASURED.items():
        fits = unit is None or (kind in _UNITS and same_dimension(unit, _UNITS[kind]))
        if words & known and fits and kind != "flow":
            return _Guess(kind, side, unit)
    return None


def _commands(unit: str) -> bool:
    """Test whether a command may have this unit."""
    return is_scaled(unit) or same_dimension(unit, "V")


def is_scaled(unit: str) -> bool:
    """Test whether a unit is a share of full scale, or the current of a valve or of a controller's output."""
    return unit in _SHARES or same_dimension(unit, "A")


def _guess_at_valve(label: Label, kind: str) -> _Guess | None:
    """Guess a pressure `before` or `behind` a valve from a column's name; None for any other column."""
    name, ending = split_unit(label.name)
    unit = ending if label.unit is None else label.unit
    words = _words_of(name if label.unit is None else label.name)
    if unit is None or not same_dimension(unit, "Pa") or not words & _KIND[kind] or words & _KIND["wanted"]:
        return None
    return _Guess("pressure", "", unit)


def suggested_map(label: Label) -> str:
    """Return the channel that a column may be, as a map writes it: `q_pump=Flow [l/min]`."""
    guess = _guess(label)
    channel = "q_pump" if guess is not None and guess.kind == "flow" else None if guess is None else guess.channel
    for valved, kind in (("p_1", "before"), ("p_2", "behind")):
        channel = valved if channel is None and _guess_at_valve(label, kind) else channel
    return f"{channel or 'CHANNEL'}={label.whole}"


def _side(words: set[str]) -> str:
    cap, rod = bool(words & _SIDE["A"]), bool(words & _SIDE["B"])
    number = next((digit for digit in ("1", "2") if digit in words), "")
    if words & _SIDE["pump"] or (words & _SIDE["port"] and cap == rod):
        return f"pump {number}".strip()
    if cap != rod:
        return "A" if cap else "B"
    return "" if cap else number
