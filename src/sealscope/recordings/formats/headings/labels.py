"""The heading of a column: its name, its unit, and the channel that it may mean.

The channel of a foreign column is guessed from its unit and the words of its name, in several languages.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import repeat
from typing import Any, NamedTuple

from sealscope.errors import InputError
from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.units import is_familiar, parse_unit, same_dimension


def _split_lists(tree: Any) -> Any:
    """Convert the comma-separated texts in nested tables, at any depth, to tuples of words."""
    if isinstance(tree, str):
        return tuple(tree.replace("\n", "").split(", "))
    return {key: _split_lists(value) for key, value in tree.items()}


_tree = tomllib.loads(files(__package__).joinpath("words.toml").read_text(encoding="utf-8"))
#: Meaning, or table of meanings -> words; the entries of `time`, `channel` and `stated` stay texts.
WORDS: dict[str, Any] = {**_split_lists(_tree), **{name: _tree[name] for name in ("time", "channel", "stated")}}


#: Full-width brackets of Chinese and Japanese text -> brackets.
_WIDE_BRACKETS = str.maketrans("\uff08\uff09\uff3b\uff3d\u3010\u3011", "()[][]")
#: `Druck in bar`, `p_A/bar`, `p_A, bar`: the last word is the unit if a channel can have it.
_TRAILING_UNIT = re.compile(r"(?P<name>.{1,80}?)(?:\s+in\s+|\s*/|\s*,\s+)(?P<unit>\S{1,20})")

#: `Drehzahl_U/min`, `Flow l/min`: a unit that contains a slash itself.
_JOINED_UNIT = re.compile(r"(?P<name>.{1,80}?)[_\s]+(?P<unit>[^\s_/]{1,10}/[^\s_/]{1,10})")

#: `in bar`, `Einheit: bar`: a unit and a word before it.
_UNIT_AFTER_WORD = re.compile(
    rf"(?:{'|'.join(WORDS['before']['unit'])})(?:\s*[:=]\s*|\s+)(?P<unit>\S.{{0,20}})", re.IGNORECASE
)


@dataclass(frozen=True)
class Label:
    """Heading of a column of a table."""

    whole: str  # the heading as written
    name: str  # the heading without the unit, or a remark in brackets at its end
    unit: str | None = None
    called: str = ""  # the logger's name of the column if `name` is the description that the user has entered

    @classmethod
    def parse(cls, text: str, unit: str | None = None) -> Label:
        """Parse a heading such as `p_A [psi]`, `p_A / psi` or `p_A in psi`; `unit` overrides that in the heading."""
        whole = text.strip().translate(_WIDE_BRACKETS)
        name, bracket_text = split_square_brackets(whole)
        if bracket_text is not None:
            return cls(whole, name, strip_word_before(bracket_text) if unit is None else unit)
        name, remark = _split_brackets_or_slash(whole)
        if unit is None and remark is None:
            usual_units = (*CHANNEL_UNITS.values(), "s", "m/s", "1/s")
            for pattern in (_JOINED_UNIT, _TRAILING_UNIT):
                match = pattern.fullmatch(whole)
                if match and any(same_dimension(match["unit"], usual) for usual in usual_units):
                    return cls(whole, match["name"].rstrip(), match["unit"])
        if unit is None and remark and is_unit(remark):  # round brackets may hold a remark: `pressure (port A)`
            unit = remark
        return cls(whole, name, unit)


def is_unit(text: str) -> bool:
    """Test whether a text is a known unit."""
    try:
        parse_unit(text)
    except InputError:
        return False
    return True


def strip_word_before(text: str) -> str:
    """Remove the word before a unit, as in `in bar` or `Einheit: bar`; return any other text as it is."""
    match = _UNIT_AFTER_WORD.fullmatch(text.strip())
    return match["unit"] if match is not None and is_unit(match["unit"]) else text


def split_square_brackets(text: str) -> tuple[str, str | None]:
    """Split `name [unit]` into name and unit; return (text, None) for any other text."""
    begin = text.rfind("[")
    if begin < 0 or not text.endswith("]") or "]" in text[begin:-1]:
        return text, None
    return text[:begin].rstrip(), text[begin + 1 : -1].strip()


def _split_brackets_or_slash(text: str) -> tuple[str, str | None]:
    """Split `name (unit)` or `name / unit` into name and unit; return (text, None) for any other text.

    Of several possible splits, one with a known unit is preferred, and of these that with the shortest name.
    """
    splits: list[tuple[str, str]] = []  # name and unit
    parts = text.split("/")
    for count in (2, 1):  # `name / m/s`, `name / s`
        unit = "/".join(parts[-count:])
        end = len(text) - len(unit) - 1  # position of the slash, which must have blanks on both sides
        if end > 1 and text[end - 1].isspace() and unit[:1].isspace() and all(unit[1:].split("/")):
            splits.append((text[: end - 1].rstrip(), unit.strip()))
    depth = n_opened = 0
    for index in range(len(text) - 1, -1, -1) if text.endswith(")") else ():
        depth += {")": 1, "(": -1}.get(text[index], 0)
        n_opened += text[index] == "("
        if depth == 0:
            if n_opened <= 2:  # `name (m/(s V))`; deeper brackets do not contain a unit
                splits.append((text[:index].rstrip(), text[index + 1 : -1].strip()))
            break
    splits = [(name, strip_word_before(unit)) for name, unit in splits if name]
    return min(splits, key=lambda split: (not is_unit(split[1]), len(split[0])), default=(text, None))


#: Words of a heading by the quantity, the side of the machine or another kind that they mean, from `words.toml`.
_MEASURED = {name: frozenset(words) for name, words in WORDS["measured"].items()}
_SIDE = {name: frozenset(words) for name, words in WORDS["side"].items()}
_KIND = {name: frozenset(words) for name, words in WORDS["kind"].items()}
#: Words of scripts without spaces between words (code points above U+2E7F, the beginning of CJK).
_UNSPACED = frozenset(
    word for words in (*_MEASURED.values(), *_SIDE.values()) for word in words if ord(word[0]) > 0x2E7F
)
#: Words of the temperature of oil, longest first, and a word that joins some in any order, such as `toil` or `oeltemp`;
#: `ol`, in `tol`, is none of them.
_OIL_WORD = re.compile(
    "|".join(sorted((_KIND["oil"] | _KIND["oil_place"] | _KIND["temperature"]) - {"ol"}, key=len, reverse=True))
)
_OIL_COMPOUND = re.compile(rf"(?:{_OIL_WORD.pattern}){{2,6}}")
#: The unit at the end of the name of a temperature, as in `OilTempC` or `T_oil_F`, by its letter.
_TEMPERATURE_LETTER = re.compile(r"(?:[ _.]{1,3}(?:deg[ _]?|°)?|(?<=[a-z]))(?P<unit>[CFK]|(?<=[ _.])[cfk])$")
_TEMPERATURE_UNITS = {"c": "degC", "f": "degF", "k": "K"}
#: Measured quantity -> channel, and -> unit; a pressure's channel depends on its side, and a spool may have any unit of
#: a command (`_is_command_unit`).
_CHANNELS: dict[str, str] = WORDS["channel"]
_UNITS = {
    kind: {**CHANNEL_UNITS, "t": "s"}[channel]
    for kind, channel in _CHANNELS.items()
    if kind not in ("spool", "direction")
}
_FRACTION_UNITS = frozenset(("%", "percent", "pct", "Prozent", "prozent"))
#: Kinds of opposite words of sides: that of chamber A, and that of chamber B. A spring is opposite to the pressure.
_OPPOSITE = (("opening", "closing"), ("opening", "spring"), ("closing", "spring"), ("push", "pull"))
_PRESSURES = {"A": "p_A", "B": "p_B", "1": "p_1", "2": "p_2", "pump 1": "p_1", "pump 2": "p_2"}
_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+")
#: The last capitalised word of a name: `Bar` of `MainPaBar`; two letters are not a unit, as `MainPa` is pressure A.
_LAST_WORD = re.compile(r"(?<=[a-z\d])[A-Z]+[a-z]*$")
#: The number at the end of repeated names of columns, as in `X_Value.1`.
_COUNTED = re.compile(r"[. _]?\d{1,3}$")
_MAX_NAME = 80
_UMLAUTS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ł": "l", "Ł": "L"}
)
#: A capital umlaut within capital letters, which become two capital letters: `LÖFFEL`.
_CAPITAL_UMLAUT = re.compile(r"[ÄÖÜ](?=[A-ZÄÖÜ])")


class _Guess(NamedTuple):
    """Guessed meaning of a column, from its name and its unit."""

    kind: str  # the quantity, such as "pressure"
    side: str  # of the machine, as from `_find_side`
    unit: str | None

    @property
    def channel(self) -> str | None:
        """Name of the channel that a column with this meaning contains; None if there is none."""
        if self.kind == "flow":  # q_pump is the flow into chamber A
            return "q_pump" if self.side == "A" else None
        return _PRESSURES.get(self.side) if self.kind == "pressure" else _CHANNELS[self.kind]


def proposed_map(labels: Sequence[Label], company: Sequence[Label] = ()) -> dict[str, str]:
    """Propose a map, channel (or ``t``) -> column, for the columns whose names reveal their meaning.

    `company`: all columns of the file, if `labels` are only those of one actuator; the meaning of some words depends on
    the others (`find_sides`).

    Left out are columns that already have a channel's name, and channels for which several columns are equally likely.
    A unit at the end of a name (``PA_bar``) becomes the unit of the column. A map of the time alone is left out, too.
    """
    channel_names = {label.name.casefold() for label in labels} & {name.casefold() for name in CHANNEL_UNITS}
    sides = find_sides(company or labels)
    candidates: dict[str, list[tuple[Label, _Guess]]] = {}
    for label in labels:
        guess = None if label.name.casefold() in channel_names else _guess_meaning(label, sides)
        if guess is None or (_is_named_time(label) and guess.kind != "time"):  # X_Value is a time, not a position
            continue
        if guess.channel is not None:
            candidates.setdefault(guess.channel, []).append((label, guess))
    if "p_A" not in candidates and "p_B" not in candidates and not {"p_a", "p_b"} & channel_names:
        # without pressures A and B, pressures 1 and 2 are those of the chambers
        for channel, pump_port in (("p_A", "p_1"), ("p_B", "p_2")):
            if pump_port in candidates:
                candidates[channel] = candidates.pop(pump_port)
    known = {*candidates} | channel_names
    if "u" in known and not known & {"omega", "theta", "p_1", "p_2"}:
        # the command is that of a valve: find the pressures before and behind it
        for channel, kind in (("p_1", "before"), ("p_2", "behind")):
            candidates[channel] = [(label, guess) for label in labels if (guess := _guess_at_valve(label, kind))]
    if not known & {"omega", "q_pump"}:  # without a flow to direct, a valve's value is none of a direction
        candidates.pop("valve", None)
    result = {}
    for channel in (*CHANNEL_UNITS, "t"):
        columns = candidates.get(channel, [])
        # prefer the command to the spool, which follows it
        if channel == "u" and any(guess.kind == "command" for _, guess in columns):
            columns = [column for column in columns if column[1].kind == "command"]
        if channel == "T_oil":  # prefer the temperature that names the oil
            columns = [column for column in columns if names_oil(column[0].name)] or columns
        if len(columns) > 1:  # prefer measured columns to computed ones, and to a speed that is only set
            unmeasured = _KIND["made"] | _KIND["wanted"] if channel == "omega" else _KIND["made"]
            columns = [column for column in columns if not _split_words(column[0].name) & unmeasured]
        if len(columns) == 1 and channel.casefold() not in channel_names:
            label, guess = columns[0]
            result[channel] = label.whole + (f"[{guess.unit}]" if guess.unit not in (None, label.unit) else "")
    return {} if set(result) <= {"t"} else result


def format_map(channel_map: Mapping[str, str]) -> str:
    """Format a map from channels to columns as text, such as `p_A=PG_1, p_B=PG_2`."""
    return ", ".join(f"{channel}={column}" for channel, column in channel_map.items())


def is_time(label: Label) -> bool:
    """Test whether the name of a column means a time, possibly with a number at its end."""
    guess = _guess_meaning(label)
    return _is_named_time(label) or (guess is not None and guess.kind == "time")


def _is_named_time(label: Label) -> bool:
    """Test whether a column has one of the usual names of a time, possibly with a number after it: `X_Value.1`."""
    return _COUNTED.sub("", label.name.casefold()) in WORDS["time"]


def unit_of_time(label: Label) -> str | None:
    """Find the unit of a time column, in its heading or name; None if it has no unit, or is not a time."""
    guess = _guess_meaning(label)
    return guess.unit if guess is not None and guess.kind == "time" else None


def has_known_word(text: str) -> bool:
    """Test whether a text contains a known word of a script that has no spaces between words, such as Chinese."""
    return any(word in text for word in _UNSPACED)


def is_quantity(text: str) -> bool:
    """Test whether a heading names a measured quantity in a known language."""
    return _guess_meaning(Label.parse(text)) is not None


#: Endings that are units only after a word for their quantity: x_s may be a set point, p_d a demand, p_min a minimum.
_AMBIGUOUS_UNITS = {**dict.fromkeys(("s", "min", "h", "d"), "time"), "m": "position"}


def split_unit(name: str) -> tuple[str, str | None]:
    """Split `PA_bar`, `flow_l_min` or `MainPaBar` into name and unit; (name, None) if there is no such unit at the end.

    The unit must be familiar (`is_familiar`), and one of a channel, a time, a velocity, or of a spool or command, such
    as mA or %. One in `_AMBIGUOUS_UNITS` counts only after a word for its quantity, and the letter of a temperature's
    only after words for that of oil.
    """
    parts = name.replace(" ", "_").split("_")
    # the last two words, such as l/min, and the last one
    endings = [("_".join(parts[:-2]), "/".join(parts[-2:])), ("_".join(parts[:-1]), parts[-1])]
    last_word = _LAST_WORD.search(name)
    if last_word and len(last_word[0]) > 2:
        endings.append((name[: last_word.start()], last_word[0]))
    for stem, unit in endings:
        if not stem or not unit or unit in ("A", "B", "a", "b"):  # a chamber, not a unit
            continue
        quantity = _AMBIGUOUS_UNITS.get(unit)
        if quantity is not None and not _split_words(stem) & _MEASURED[quantity]:
            continue
        channel_units = (*CHANNEL_UNITS.values(), "s", "m/s")
        if is_familiar(unit) and (
            is_current_or_fraction(unit) or any(same_dimension(unit, channel_unit) for channel_unit in channel_units)
        ):
            return stem, unit
    if (letter := _TEMPERATURE_LETTER.search(name)) and _is_named_oil_temperature(name[: letter.start()]):
        return name[: letter.start()], _TEMPERATURE_UNITS[letter["unit"].casefold()]
    return name, None


def find_name_and_unit(label: Label) -> tuple[str, str | None]:
    """Find the name and unit of a column; if its heading has no unit, a unit at the end of the name is split off."""
    return split_unit(label.name) if label.unit is None else (label.name, label.unit)


def ends_in(name: str, words: str) -> bool:
    """Test whether the name of a column ends in `words` that begin with a letter, as `ADC1_Channel_2` ends in `ch2`."""
    token_lists = ([token.casefold() for token in _TOKEN.findall(strip_accents(text))] for text in (name, words))
    # `ch`, `channel` and the like are equal
    name_tokens, ending = (["channel" if word in WORDS["input"] else word for word in tokens] for tokens in token_lists)
    return words[:1].isalpha() and 0 < len(ending) <= len(name_tokens) and name_tokens[-len(ending) :] == ending


def _split_temperature_words(name: str) -> set[str]:
    """Split the name of a temperature into its words; `toil` or `oiltemp` is replaced by its parts."""
    words = set[str]()
    for word in _split_words(name):
        is_compound = _OIL_COMPOUND.fullmatch(word)
        words |= set(_OIL_WORD.findall(word)) if is_compound else {word}
    return words


def names_oil(name: str) -> bool:
    """Test whether a name has a word for oil, possibly joined to one for a temperature: `Toil`."""
    return not _split_temperature_words(name).isdisjoint(_KIND["oil"])


def is_oil_temperature(name: str) -> bool:
    """Test whether the name of a temperature has a word for oil, or only words for its place or for a temperature."""
    words = {word for word in _split_temperature_words(name) if not word.isdigit()}
    return bool(words & _KIND["oil"]) or words <= _KIND["temperature"] | _KIND["oil_place"]


def _is_named_oil_temperature(name: str) -> bool:
    """Test whether a name means the temperature of oil even without a unit, such as `Toil` or `Temp`, but not `T`."""
    words = _split_temperature_words(name) & _KIND["temperature"]
    return is_oil_temperature(name) and (bool(words) if names_oil(name) else any(len(word) > 3 for word in words))


def is_temperature(label: Label) -> bool:
    """Test whether a column has a unit of temperature, in its heading or at the end of its name."""
    _name, unit = find_name_and_unit(label)
    return unit is not None and same_dimension(unit, "K")


def is_pressure(label: Label) -> bool:
    """Test whether a column has a unit of pressure, in its heading or at the end of its name."""
    _name, unit = find_name_and_unit(label)
    return unit is not None and same_dimension(unit, "Pa")


def is_measured(label: Label) -> bool:
    """Test whether a column is a measured pressure, position, speed or flow, and neither a set point nor computed."""
    if len(label.name) > _MAX_NAME:
        return False
    name, unit_of_name = split_unit(label.name)
    unit = unit_of_name if label.unit is None else label.unit
    words = _split_words(name)
    if words & (_KIND["wanted"] | _KIND["made"]):
        return False
    if unit is not None:
        measured_units = ("Pa", "m", "rad/s", "m/s", "m^3/s")
        return unit in WORDS["rotation_units"] or any(map(same_dimension, repeat(unit), measured_units))
    kinds = (*(_MEASURED[kind] for kind in ("pressure", "position", "speed")), _KIND["supply"], _KIND["velocity"])
    # a letter alone, such as n, may count the rows
    return len(name) > 1 and any(words & known for known in kinds)


def strip_accents(text: str) -> str:
    """Remove accents from a text, and write umlauts as two letters: `ä` becomes `ae`."""
    text = _CAPITAL_UMLAUT.sub(lambda match: match[0].translate(_UMLAUTS).upper(), text)
    decomposed = unicodedata.normalize("NFKD", text.translate(_UMLAUTS))
    return "".join(character for character in decomposed if not unicodedata.combining(character))


def iter_tokens(text: str) -> Iterator[tuple[str, tuple[int, int]]]:
    """Yield the words and numbers of a text in lower case, each with the positions where it begins and ends.

    Accents must have been removed (`strip_accents`). `pa` and `pb` are two words, p and the chamber.
    """
    for match in _TOKEN.finditer(text):
        token, (begin, end) = match[0].casefold(), match.span()
        if token in ("pa", "pb"):
            yield from (("p", (begin, begin + 1)), (token[1], (begin + 1, end)))
        else:
            yield token, (begin, end)


def _split_words(name: str) -> set[str]:
    """Split a name into its words, in lower case, and parts of words.

    Parts are both words of a German compound with a known ending, such as `kolbenseite` and `druck`, the first one also
    without a linking n or s; both letters of `pa` and `pb`; and known words of languages without spaces.
    """
    words = {word for word in _UNSPACED if word in name}
    for token in (token.casefold() for token in _TOKEN.findall(strip_accents(name))):
        words |= {token, "p", token[1:]} if token in ("pa", "pb") else {token}
        for ending in (ending for ending in WORDS["endings"] if token.endswith(ending)):
            first = token.removesuffix(ending)
            words |= {ending, first, first.removesuffix("n"), first.removesuffix("s")} - {""}
    return words


def find_sides(labels: Sequence[Label]) -> dict[str, str]:
    """Find the chamber, "A" or "B", of words that mean one only in the company of others: word -> chamber.

    - "head" is the chamber opposite to that of the rod (B) or the cap (A), if a heading names these by a word.
    - A word of `_OPPOSITE`, such as "opening", counts if one pressure of a side has it, and one the opposite word. A
      pressure that a word of `side` assigns to a chamber does not count.
    """
    names = [(label, _split_words(label.name)) for label in labels if len(label.name) <= _MAX_NAME]
    words = set[str]().union(*(words for _, words in names))
    sides = {}
    if words & (_SIDE["B"] - {"b"}):
        sides = dict.fromkeys(_SIDE["head"], "A")
    elif words & (_SIDE["A"] - {"a"}):
        sides = dict.fromkeys(_SIDE["head"], "B")
    pressures = [
        words
        for label, words in names
        if words & _SIDE["place"] and not words & (_SIDE["A"] | _SIDE["B"]) and is_pressure(label)
    ]
    for pair in _OPPOSITE:
        if all(sum(bool(words & _SIDE[kind]) for words in pressures) == 1 for kind in pair):
            for kind, side in zip(pair, "AB", strict=True):
                sides |= dict.fromkeys(_SIDE[kind], side)
            break
    return sides


def guess_channel(label: Label, sides: Mapping[str, str] | None = None) -> str | None:
    """Guess the channel of a column from its name and unit; None if they do not tell, and for a time.

    `sides`: chamber of the words that mean one only in the company of others, as from `find_sides`.
    """
    guess = None if _is_named_time(label) else _guess_meaning(label, sides)
    return None if guess is None else guess.channel


def _guess_meaning(label: Label, sides: Mapping[str, str] | None = None) -> _Guess | None:
    """Guess the meaning of a column from its name and unit; None if they do not tell.

    `sides`: chamber of the words that mean one only in the company of others, as from `find_sides`.
    """
    if len(label.name) > _MAX_NAME:
        return None
    name, unit = find_name_and_unit(label)
    words = _split_words(name)
    found_sides = {side for word, side in (sides or {}).items() if word in words}
    side = found_sides.pop() if len(found_sides) == 1 else _find_side(words)
    if unit is not None and same_dimension(unit, "Pa"):
        return None if words & (_KIND["other"] | _KIND["wanted"]) else _Guess("pressure", side, unit)
    if unit is not None and same_dimension(unit, "K"):  # before `other`, whose words include oil
        return _Guess("oil", "", unit) if is_oil_temperature(name) else None
    if unit is None and _is_named_oil_temperature(name):
        return _Guess("oil", "", None)
    if words & _MEASURED["spool"]:
        return _Guess("spool", "", unit) if unit is None or _is_command_unit(unit) else None
    if unit is not None and same_dimension(unit, "m^3/s"):
        kind = "leak" if words & _MEASURED["leak"] else "flow"
        return _Guess(kind, side, unit) if words & _MEASURED[kind] else None
    is_rotation = unit is not None and (unit in WORDS["rotation_units"] or same_dimension(unit, "rad/s"))
    # a command may be called `setpoint`, a measured quantity may not; a drive follows the speed that is set
    is_measured_quantity = any(words & _MEASURED[kind] for kind in ("pressure", "position", "speed", "angle"))
    if words & _KIND["other"] or (words & _KIND["wanted"] and is_measured_quantity and not is_rotation):
        return None
    if is_rotation and words & (_MEASURED["speed"] | _KIND["motor"]):
        return _Guess("speed", side, "rpm" if unit in WORDS["rotation_units"] else unit)
    if unit is not None and "s" in words and same_dimension(unit, "m"):  # the path in German books
        return _Guess("position", side, unit)
    if unit is not None and words & _MEASURED["command"] and _is_command_unit(unit):
        return _Guess("command", side, unit)
    if (
        unit is not None
        and words & _MEASURED["direction"]
        and (_is_command_unit(unit) or same_dimension(unit, "count"))
    ):
        return _Guess("direction", side, unit)
    for kind, words_of_kind in _MEASURED.items():
        fits_unit = unit is None or (kind in _UNITS and same_dimension(unit, _UNITS[kind]))
        if words & words_of_kind and fits_unit and kind != "flow":  # a flow must have its unit (above)
            return _Guess(kind, side, unit)
    return None


def _is_command_unit(unit: str) -> bool:
    """Test whether a command can have this unit: a voltage, a current or a fraction of full scale."""
    return is_current_or_fraction(unit) or same_dimension(unit, "V")


def is_current_or_fraction(unit: str) -> bool:
    """Test whether a unit is that of a current or of a fraction of full scale, such as %; commands may have both."""
    return unit in _FRACTION_UNITS or same_dimension(unit, "A")


def _guess_at_valve(label: Label, kind: str) -> _Guess | None:
    """Guess from the name if a column is the pressure upstream ("before") or downstream ("behind") of a valve.

    Returns None if the name has no such word, the unit is not one of pressure, or the name means a set point.
    """
    name, unit = find_name_and_unit(label)
    words = _split_words(name)
    if unit is None or not same_dimension(unit, "Pa") or not words & _KIND[kind] or words & _KIND["wanted"]:
        return None
    return _Guess("pressure", "", unit)


def suggest_map_entry(label: Label) -> str:
    """Suggest the entry of a map for a column, such as `q_pump=Flow [l/min]`, or `CHANNEL=...` for unknown channels."""
    guess = _guess_meaning(label)
    channel = None if guess is None else guess.channel
    if guess is not None and guess.kind == "flow":  # to either side of the cylinder
        channel = "q_pump"
    if channel is None:
        at_valve = {"p_1": "before", "p_2": "behind"}
        channel = next((name for name, kind in at_valve.items() if _guess_at_valve(label, kind)), None)
    return f"{channel or 'CHANNEL'}={label.whole}"


def _find_side(words: set[str]) -> str:
    """Find the side of the machine that the words of a name mean; "" if it is not known.

    The result is "A" or "B" for a chamber, "pump", "pump 1" or "pump 2" for a port, or "1" or "2" for only a number.
    """
    is_a, is_b = bool(words & _SIDE["A"]), bool(words & _SIDE["B"])
    number = next((digit for digit in ("1", "2") if digit in words), "")
    if words & _SIDE["pump"] or (words & _SIDE["port"] and is_a == is_b):
        return f"pump {number}".strip()
    if is_a != is_b:
        return "A" if is_a else "B"
    return "" if is_a else number  # if both sides are named, the side is not known
