"""Which channel a foreign column probably is, by the words of its name in several languages and by its unit."""

from __future__ import annotations

import re
import shlex
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sealscope.recordings.channels import CHANNEL_UNITS
from sealscope.recordings.formats.headings.labels import Label
from sealscope.units import is_familiar, same_dimension


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


#: What a column may measure -> words of its name: English, German, French, Spanish, Italian, Portuguese, Dutch, Polish,
#: Czech, Swedish, Turkish, Russian, Chinese, Japanese and Korean.
_WORDS: Mapping[str, frozenset[str]] = {
    "pressure": _words(
        "p pr pres press pressure druck kammerdruck zylinderdruck pression presion pressione pressao druk cisnienie "
        "pg pt tlak tryck basinc basınc давление 压力 压强 壓力 圧力 압력"
    ),
    "position": _words(
        "x pos xpos position weg hub stroke displ displacement travel kolbenweg kolbenposition lvdt deplacement course "
        "posicion carrera posizione corsa posicao curso positie slag polozenie skok "
        "poloha lage laege konum положение ход 位移 行程 位置 変位 ストローク 변위 위치"
    ),
    "command": _words(
        "u cmd command soll sollwert setpoint ref reference demand spannung voltage stellgroesse "
        "stellsignal stellwert steuersignal steuerspannung ansteuerung ansteuersignal ventilsignal ventilspannung "
        "consigne tension comando mando tensione 指令 电压 電圧"
    ),
    "speed": _words(
        "omega n speed spd rpm drehzahl motordrehzahl vitesse velocidad velocidade velocita giri toerental 转速 回転数"
    ),
    "angle": _words("theta phi angle winkel motorwinkel encoder drehwinkel angulo angolo hoek kat 角度 转角"),
    "leak": _words("leak leakage leck leckage leckstrom fuite fuga trafilamento 泄漏 漏れ"),
    "time": _words(
        "t time tout timestamp timestamps datetime zeit messzeit uhrzeit zeitstempel temps horodatage heure tiempo "
        "hora tempo ora tijd tijdstip czas cas tid zaman время "
        "时间 时刻 時間 時刻 시간"
    ),
}
#: Last words of German compounds (Zylinderweg, Messzeit), where a whole word is not known.
_ENDINGS = ("druck", "weg", "hub", "position", "winkel", "drehzahl", "zeit", "druk")
_A = _words(
    "a cap bore bottom base blind extend extension piston kolben kolbenseite kolbenseitig kolbenraum kolbenkammer "
    "bodenseite boden bodem fond fondo fondello embolo zuiger tlok 无杆腔 無桿腔 ヘッド側 "
    "ボトム側 キャップ側"
)
_B = _words(
    "b rod ring annulus annular retract retraction stange stangenseite stangenseitig stangenraum stangenkammer "
    "ringseite ringraum ringkammer kolbenstange tige vastago stelo haste stang tloczysko 有杆腔 有桿腔 ロッド側"
)
#: The end of a cylinder that its rod leaves where the other is the cap; where the other is the rod end, the cap.
_HEAD = "head"
_PUMP = _words("pump pumpe pompe bomba pompa pomp 泵 ポンプ")
#: A port is the pump's where it has a number, and the cylinder's where it is A or B.
_PORT = "port"
_OTHERS = _words(
    "tank supply versorgung system charge speisedruck speise accumulator speicher oil oel temp temperature temperatur "
    "force kraft current strom flow"
)
_OIL = _words(
    "oil oel ol huile aceite olio oleo olie olej olja yag oiltemp oiltemperature oeltemp oeltemperatur масло масла "
    "油 油温 油溫 オイル"
)
#: Of what is wanted and not measured, unless it is a command; and of what is made from other columns.
_WANTED = _words("soll sollwert setpoint set target demand reference ref cmd command consigne")
_MADE = _words("filtered filt gefiltert filtre smoothed mean mittel avg average min max rms error fehler")
#: Words of a script that writes no blanks between words.
_UNSPACED = frozenset(word for words in (*_WORDS.values(), _A, _B, _PUMP) for word in words if ord(word[0]) > 0x2E7F)
#: A velocity has no channel of its own; like a speed it is named where nothing took it.
_VELOCITY = _words("velocity vel geschwindigkeit vitesse velocidad velocita snelheid \u901f\u5ea6")
#: Pressure of the supply, which is no channel.
_SUPPLY = _words("ps")
#: What turns, where the unit alone says that it is a speed.
_MOTOR = _words("motor mot pump pumpe drive shaft servo engine \u7535\u673a")
#: How loggers write revolutions a minute, which as a unit of its own is a frequency.
TURNS = ("1/min", "min-1", "min^-1", "min\u207b\u00b9", "/min", "U/min")
_MEASURED = ("pressure", "position", "speed", "angle")
_UNITS = {"oil": "K", "position": "m", "command": "V", "speed": "rad/s", "angle": "rad", "leak": "m^3/s", "time": "s"}
_CHANNELS = {
    "oil": "T_oil",
    "position": "x",
    "command": "u",
    "speed": "omega",
    "angle": "theta",
    "leak": "q_leak",
    "time": "t",
}
#: How loggers call their inputs, as one word.
_CHANNEL_WORDS = dict.fromkeys(("ch", "chan", "kanal", "voie", "canal", "canale"), "channel")
_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+")
#: The last word of `MainPaBar`; in `MainPa` it is the pressure A, and no pascal.
_HUMPED = re.compile(r"(?<=[a-z\d])[A-Z]+[a-z]*$")
_LONGEST_NAME = 80


@dataclass(frozen=True)
class _Guess:
    """`kind`: what a column measures; `side`: "A", "B", "pump" or a number as text; `unit`: of its name's ending."""

    kind: str
    side: str
    unit: str | None


def proposed_map(labels: Sequence[Label]) -> dict[str, str]:
    """Return channel (or ``t``) -> column, as a map gives them, for the columns whose meaning their names tell.

    A column that bears a channel's own name is left out, and a channel that several columns could be. A unit at the end
    of a name (``PA_bar``) becomes the column's unit.
    """
    own = {label.name.casefold() for label in labels} & {name.casefold() for name in CHANNEL_UNITS}
    head = _side_of_head(labels)
    guesses = [None if label.name.casefold() in own else _guess(label, head) for label in labels]
    candidates: dict[str, list[int]] = {}
    for column, guess in enumerate(guesses):
        for channel in () if guess is None else _channels(guess):
            candidates.setdefault(channel, []).append(column)
    if "p_A" not in candidates and "p_B" not in candidates and not {"p_a", "p_b"} & own:
        for channel, pumped in (("p_A", "p_1"), ("p_B", "p_2")):  # pressures 1 and 2 alone are those of the chambers
            if pumped in candidates:
                candidates[channel] = candidates.pop(pumped)
    result = {}
    for channel in (*CHANNEL_UNITS, "t"):
        columns = candidates.get(channel, [])
        if len(columns) > 1:  # what is made of another column gives way to it
            columns = [column for column in columns if not _words_of(labels[column].name) & _MADE]
        if len(columns) == 1 and channel.casefold() not in own:
            guess, label = guesses[columns[0]], labels[columns[0]]
            assert guess is not None
            ending = f"[{guess.unit}]" if guess.unit not in (None, label.unit) else ""
            result[channel] = label.whole + ending
    return {} if set(result) <= {"t"} else result


def map_options(channel_map: Mapping[str, str]) -> str:
    """Return the `--map` options of a map, ready for a shell."""
    return " ".join(f"--map {shlex.quote(f'{channel}={column}')}" for channel, column in channel_map.items())


def _plain(text: str) -> str:
    """Return a name without accents, the umlauts as two letters."""
    for umlaut, letters in zip("äöüßÄÖÜłŁ", ("ae", "oe", "ue", "ss", "Ae", "Oe", "Ue", "l", "L"), strict=True):
        text = text.replace(umlaut, letters)
    return "".join(sign for sign in unicodedata.normalize("NFKD", text) if not unicodedata.combining(sign))


def is_time(label: Label) -> bool:
    """Return whether a column's name says that it holds the time."""
    guess = _guess(label, "")
    return guess is not None and guess.kind == "time"


def unit_of_time(label: Label) -> str | None:
    """Return the unit that a time column states, in its heading or at the end of its name."""
    guess = _guess(label, "")
    return guess.unit if guess is not None and guess.kind == "time" else None


def knows(text: str) -> bool:
    """Return whether a text holds a known word of a script that writes no blanks between words."""
    return any(word in text for word in _UNSPACED)


def measures(text: str) -> bool:
    """Return whether a heading says what is measured, in one of the languages known here."""
    return _guess(Label.parse(text), "") is not None


def _words_of(name: str) -> set[str]:
    tokens = [token.casefold() for token in _TOKEN.findall(_plain(name))]
    return {part for token in tokens for part in _parts(token)} | {word for word in _UNSPACED if word in name}


def _side_of_head(labels: Sequence[Label]) -> str:
    """Return which chamber the columns called head are of: A beside a rod, B beside a cap; empty where unknown."""
    words = {word for label in labels if len(label.name) <= _LONGEST_NAME for word in _words_of(label.name)}
    return "" if _HEAD not in words else "A" if words & (_B - {"b"}) else "B" if words & (_A - {"a"}) else ""


def _guess(label: Label, head: str) -> _Guess | None:
    """Return what a column's name tells; `head`: the chamber that the word head stands for."""
    if len(label.name) > _LONGEST_NAME:
        return None
    name, unit = split_unit(label.name)
    words = _words_of(name if label.unit is None and unit is not None else label.name)
    unit = label.unit if label.unit is not None else unit
    side = head if _HEAD in words and head else _side(words)
    if unit is not None and same_dimension(unit, "Pa"):
        return None if words & (_OTHERS | _WANTED) else _Guess("pressure", side, unit)
    if unit is not None and words & _OIL and same_dimension(unit, "K"):
        return _Guess("oil", "", unit)
    if words & _OTHERS or (words & _WANTED and any(words & _WORDS[kind] for kind in _MEASURED)):
        return None
    turns = unit is not None and (unit in TURNS or same_dimension(unit, "rad/s"))
    if turns and words & (_WORDS["speed"] | _MOTOR):
        return _Guess("speed", side, "rpm" if unit in TURNS else unit)
    if unit is not None and "s" in words and same_dimension(unit, "m"):  # the path in German books
        return _Guess("position", side, unit)
    for kind, known in _WORDS.items():
        fits = unit is None or (kind in _UNITS and same_dimension(unit, _UNITS[kind]))
        if words & known and fits:
            return _Guess(kind, side, unit)
    return None


def _parts(token: str) -> set[str]:
    """Return a token, what is left of it after a leading p (`pa`), and the end of a compound (`zylinderweg`)."""
    if token in ("pa", "pb"):
        return {token, "p", token[1:]}
    return {token, *(ending for ending in _ENDINGS if token.endswith(ending))}


def _side(words: set[str]) -> str:
    cap, rod = bool(words & _A), bool(words & _B)
    if words & _PUMP or (_PORT in words and cap == rod):
        return next((f"pump {digit}" for digit in ("1", "2") if digit in words), "pump")
    if cap != rod:
        return "A" if cap else "B"
    return next((digit for digit in ("1", "2") if digit in words), "") if not cap else ""


def _channels(guess: _Guess) -> tuple[str, ...]:
    if guess.kind == "pressure":
        names = {"A": "p_A", "B": "p_B", "1": "p_1", "2": "p_2", "pump 1": "p_1", "pump 2": "p_2"}
        return (names[guess.side],) if guess.side in names else ()
    return (_CHANNELS[guess.kind],)


def split_unit(name: str) -> tuple[str, str | None]:
    """Split `PA_bar`, `flow_l_min` or `MainPaBar` into name and unit.

    (name, None) where the last words are no unit of what a channel measures.
    """
    parts = name.replace(" ", "_").split("_")
    endings = [("_".join(parts[:-2]), "/".join(parts[-2:])), ("_".join(parts[:-1]), parts[-1])]
    humped = _HUMPED.search(name)
    if humped and len(humped[0]) > 2:
        endings.append((name[: humped.start()], humped[0]))
    for before, unit in endings:
        if not before or not unit or unit in ("A", "B", "a", "b"):
            continue
        kind = {"s": "time", "m": "position"}.get(unit)
        if kind is not None and not _words_of(before) & _WORDS[kind]:  # x_s may as well be a set point
            continue
        if is_familiar(unit) and any(same_dimension(unit, known) for known in (*CHANNEL_UNITS.values(), "s", "m/s")):
            return before, unit
    return name, None


def ends_in(name: str, words: str) -> bool:
    """Return whether the last words of a column's name are these: `ch2` of `ADC1_Channel_2`, `Pa` of `Main_Pa`."""
    tokens = ([token.casefold() for token in _TOKEN.findall(_plain(text))] for text in (name, words))
    own, wanted = ([_CHANNEL_WORDS.get(token, token) for token in text] for text in tokens)
    return words[:1].isalpha() and 0 < len(wanted) <= len(own) and own[-len(wanted) :] == wanted


def is_recorded(label: Label) -> bool:
    """Return whether a column is a measured pressure, position or speed, by its name or its unit."""
    if len(label.name) > _LONGEST_NAME:
        return False
    name, ending = split_unit(label.name)
    unit = ending if label.unit is None else label.unit
    words = _words_of(name)
    if words & (_WANTED | _MADE):
        return False
    if unit is not None:
        return unit in TURNS or any(same_dimension(unit, own) for own in ("Pa", "m", "rad/s", "m/s"))
    kinds = (_SUPPLY, *(_WORDS[kind] for kind in ("pressure", "position", "speed")), _VELOCITY)
    return len(name) > 1 and any(words & known for known in kinds)
