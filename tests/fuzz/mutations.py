"""Mutations of files and texts, drawn from a seeded generator: bytes, lines of TOML, words of options, JSON trees."""

from __future__ import annotations

import random
import re
from copy import deepcopy
from typing import Any

#: Awkward bytes for a binary file or a table.
WORDS = (
    b"\0",
    b"\xff" * 8,
    b"nan",
    b"inf",
    b"1e999",
    b'"',
    b";" * 40,
    b"\n" * 9,
    b"-",
    b"9" * 30,
    b"\x7f" * 4,
    b"t [s]",
)
#: Values of every JSON kind, most of them of a wrong kind or size wherever they stand.
VALUES = (None, True, -1, 0, 1e308, -1e308, 2**60, float("nan"), float("inf"), "", "x" * 500, [], {}, [[]], {"a": 1})
#: Values of TOML, as they are written.
SETTINGS = (
    "true", "-1", "0", "1e308", "-1e308", "1e-320", "nan", "inf", "-inf", "99999999999999999999", '""', '"x"', '" "',
    '"0"', '"1e999 s"', '"5 %"', '"nan"', '"12 parsec"', '"../../etc/passwd"', '"a.toml"', '"\\u0000"', '"\\u001b[31m"',
    "[]", "[[]]", "[1, 2]", '["x"]', '[["p_A"]]', "[{}]", "{}", "{ a = 1 }", "{ value = [] }", "2020-01-01",
    "12:30:00", '"' + "7" * 3000 + '"', "[" * 60 + "]" * 60, "1" * 4400, "0x" + "f" * 60, '"3 sin(4t)"',
    '"pump leak x3"', '"thesis"', '"bench"', "[0.5, 0.1]", "[nan, nan]", "[-1, -1]", "1e-12", '"1e-12 s"', "1000000",
)  # fmt: skip
#: Parts of options.
PARTS = (
    "", " ", "\t", "\n", "\0", "-", "+", "+\t", "- ", "0", "-0", "1", "1e308", "1e-320", "1e999", "nan", "inf", ".",
    "9" * 400, "1" * 2000 + "x", " " * 3000, "(", ")", "(" * 500, "[", "]", "[]", "[s]", "[" * 300, "%", " %", "=",
    "==", "#", "#0", "#99999", "\u00b2", "\u0663", "\u00b5", "°", "µ", "\u2212", "\x1b[31m", "\udcff", "e", "sin", "t",
    "from ", " to ", "growing ", " laminar", " orifice", " seed ", "x", "x-1", "G = ", "C = ", "L/min", "L/h", "psi",
    "m^9", "^", "^9" * 80, "/", "//", "Pa s", "rev", "dB", "kelvin", "degF", "min", "h", "none", ", 3 sin(4t)",
    "periods of ", "p_A", "auto", "table ", "file ", "/dev/zero", "1 e5", "1,5", "0x10", "1_000", "٣", "Ⅷ",
)  # fmt: skip
_ENTRY = re.compile(r"^(\s*[\w.\"-]+\s*=\s*)(.*)$", re.MULTILINE)
_WORD = re.compile(r"\w+|\s+|.", re.DOTALL)


def changed_bytes(whole: bytes, draw: random.Random) -> bytes:
    """Bytes changed, cut, doubled, moved, or replaced by awkward ones, mostly in the head, where lengths stand."""
    data = bytearray(whole)
    for _ in range(draw.choice((1, 1, 2, 4, 16))):
        head = draw.random() < 0.5
        at = draw.randrange(min(len(data), 600) if head else len(data))
        match draw.randrange(6):
            case 0:
                data[at] = draw.randrange(256)
            case 1:
                data[at] ^= 1 << draw.randrange(8)
            case 2:
                data[at:at] = draw.choice(WORDS)
            case 3:
                word = draw.choice(WORDS)
                data[at : at + len(word)] = word
            case 4:
                data[at : at + draw.randint(1, 200)] = b""
            case 5:
                data = (
                    data[: max(1, at)] if draw.random() < 0.3 else data[:at] + data[: draw.randint(1, 400)] + data[at:]
                )
        data = data or bytearray(b"\0")
    return bytes(data)


def changed_toml(whole: str, draw: random.Random) -> bytes:
    """A TOML file with values, entries or lines changed, or a few bytes."""
    if draw.random() < 0.1:
        return changed_bytes(whole.encode(), draw)
    text = whole
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        entries = list(_ENTRY.finditer(text))
        if not entries:
            break
        entry, other = draw.choice(entries), draw.choice(entries)
        match draw.randrange(6):
            case 0 | 1:  # another value
                text = text[: entry.start(2)] + draw.choice(SETTINGS) + text[entry.end(2) :]
            case 2:  # the value of another entry
                text = text[: entry.start(2)] + other[2] + text[entry.end(2) :]
            case 3:  # left out
                text = text[: entry.start()] + text[entry.end() :]
            case 4:  # part of a value
                text = text[: entry.start(2)] + changed_option(entry[2], draw) + text[entry.end(2) :]
            case 5:  # moved to another table
                text = text[: other.end()] + "\n" + entry[0] + text[other.end() :]
    return text.encode("utf-8", "surrogatepass")


def changed_option(whole: str, draw: random.Random) -> str:
    """An option's text with words replaced, left out, doubled or mixed with awkward parts."""
    words = _WORD.findall(whole) or [""]
    for _ in range(draw.choice((1, 1, 2, 3, 6))):
        at = draw.randrange(len(words))
        match draw.randrange(5):
            case 0:
                words[at] = draw.choice(PARTS)
            case 1:
                words.insert(at, draw.choice(PARTS))
            case 2:
                words[at] = ""
            case 3:
                words.insert(draw.randrange(len(words)), words[at])
            case 4:
                words[at] = (words[at] * draw.choice((2, 40, 400)))[:20_000]
    return "".join(words)[:100_000]


def nodes(tree: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a tree of JSON values."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [place for key, value in items for place in [(tree, key), *nodes(value)]]


def change_tree(tree: Any, draw: random.Random) -> None:
    """Change, leave out or swap up to three nodes of a tree of JSON values, in place."""
    for _ in range(draw.randint(1, 3)):
        places = nodes(tree)
        if not places:
            return
        container, key = draw.choice(places)
        if draw.random() < 0.3:
            del container[key]
        elif draw.random() < 0.3:
            other, name = draw.choice(places)
            if name in other if isinstance(other, dict) else name < len(other):
                value = other[name]
                container[key] = [] if isinstance(value, dict | list) else value
        else:
            container[key] = deepcopy(draw.choice(VALUES))
