"""Limits of a message that hold before anything is built of it: what a decoder of JSON or CBOR may be given.

One pass over the bytes of a message of CBOR (RFC 8949) counts its depth, lists, pairs, texts and samples, and finds
keys that are no texts and tags that are no typed arrays of floats (RFC 8746). A message that passes costs its decoder a
time that goes with its length. Of JSON the quotation marks and brackets are counted. `source_block.decoded` calls both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.compiled import kernel, law

#: Most samples of a channel.
MOST_SAMPLES = 1_000_000
#: How deep containers lie in one another, and how many containers, pairs and pieces of text and bytes there are, at
#: most; longest key [bytes].
DEEPEST, MOST_CONTAINERS, MOST_PAIRS, MOST_TEXTS, LONGEST_KEY = 4, 64, 64, 1000, 200
#: Quotation marks and brackets of JSON, at most: those in texts count as well.
_MOST_QUOTES, _MOST_BRACKETS = 1000, 500
#: Tags of arrays of floats: big endian of 4 and 8 bytes, little endian of 4 and 8 bytes.
FLOAT_ARRAYS = (81, 82, 85, 86)
_TOO_LONG = 1
#: What breaks a rule, by the code that `_walk` returns.
_RULES = (
    "",
    f"lists must have at most {MOST_SAMPLES} items",
    f"containers must lie at most {DEEPEST} deep",
    f"there must be at most {MOST_CONTAINERS} containers",
    f"there must be at most {MOST_PAIRS} pairs",
    f"there must be at most {MOST_TEXTS} texts",
    f"keys must be texts of at most {LONGEST_KEY} bytes",
    f"tags must be {', '.join(map(str, FLOAT_ARRAYS))}, each of bytes",
    "values must be numbers, texts, bytes, true, false or null",
    "items must be complete",
    "nothing must follow its mapping",
)


class MessageLimit(ValueError):  # noqa: N818 (names what is exceeded)
    """A message breaks a rule; `oversized`: by the length of a list."""

    def __init__(self, rule: str, *, oversized: bool = False) -> None:
        super().__init__(rule)
        self.oversized = oversized


def check_cbor(payload: bytes) -> int:
    """Count the pairs of a CBOR message. Raise MessageLimit if it breaks a rule."""
    code, place, pairs = _walk(np.frombuffer(payload, dtype=np.uint8))
    if code:
        raise MessageLimit(f"{_RULES[code]} (byte {place})", oversized=code == _TOO_LONG)
    return int(pairs)


def check_json(payload: bytes) -> int:
    """Return the number of colons of a message of JSON, in texts and outside.

    Raises MessageLimit where it has more quotation marks or brackets than a decoder may be given.
    """
    quotes, brackets, colons = _count_marks(np.frombuffer(payload, dtype=np.uint8))
    if quotes > _MOST_QUOTES:
        raise MessageLimit(f"there must be at most {_MOST_QUOTES} quotation marks, got {quotes}")
    if brackets > _MOST_BRACKETS:
        raise MessageLimit(f"there must be at most {_MOST_BRACKETS} brackets, got {brackets}")
    return int(colons)


def check_json_keys(values: Any, payload: bytes, colons: int) -> None:
    """Raise MessageLimit where a key of JSON stood twice in one mapping; `values`: what the JSON was decoded to."""
    if _shallow_pairs(values) != colons:
        outside = payload.replace(b"\\\\", b"").replace(b'\\"', b"").split(b'"')[::2]  # of texts
        check_keys(values, sum(part.count(b":") for part in outside))


def check_keys(values: Any, pairs: int) -> None:
    """Raise MessageLimit where a message of so many pairs was decoded to fewer: a key stood twice in one mapping."""
    if _shallow_pairs(values) != pairs and (known := _pairs(values)) != pairs:
        raise MessageLimit(f"keys must differ, got {pairs - known} again")


def _shallow_pairs(values: Any) -> int:
    """Return the number of pairs of a mapping and of the mappings that are its values; no list is gone through."""
    if not isinstance(values, dict):
        return 0
    return len(values) + sum(len(value) for value in values.values() if isinstance(value, dict))


def _pairs(values: Any) -> int:
    """Return the number of pairs of all mappings."""
    if isinstance(values, dict):
        return len(values) + sum(map(_pairs, values.values()))
    return sum(map(_pairs, values)) if isinstance(values, list) else 0


@kernel
def _count_marks(data: Any) -> tuple[int, int, int]:
    """Count the quotation marks, the opening brackets and braces, and the colons among bytes."""
    quotes, brackets, colons = 0, 0, 0
    for byte in data:
        quotes += byte == 34
        brackets += (byte == 91) | (byte == 123)
        colons += byte == 58
    return quotes, brackets, colons


@law
def _argument(data: Any, position: int, info: int) -> tuple[int, int]:
    """Return the argument of an item whose head ends before byte `position`, and the next byte, -1 if it is cut off."""
    if info < 24:
        return info, position
    width = 1 << (info - 24)
    if len(data) - position < width:
        return 0, -1
    number = 0
    for k in range(position, position + width):
        number = (number << 8) | int(data[k])  # one over 2^63 becomes negative
    return number, position + width


@kernel
def _walk(data: Any) -> tuple[int, int, int]:
    """Walk through the items; return the number of the broken rule (0: none), its byte, and the count of pairs.

    Each byte is looked at once. Of each container `left` holds how many items it still has, below 0 for an unknown
    number; `turn` is 0 in a list, in a mapping 1 before a key and 2 before its value; `counts`: items so far.
    """
    size, position, depth = len(data), 0, 0
    left, turn = np.zeros(DEEPEST + 1, dtype=np.int64), np.zeros(DEEPEST + 1, dtype=np.int64)
    counts = np.zeros(DEEPEST + 1, dtype=np.int64)
    containers, pairs, texts, tagged = 0, 0, 0, False
    while True:
        while depth > 0 and left[depth] == 0:
            depth -= 1
        if depth == 0 and position > 0 and not tagged:
            return (0 if position == size else 10), position, pairs
        if position >= size:
            return 9, position, pairs
        place, major, info = position, int(data[position]) >> 5, int(data[position]) & 31
        position += 1
        if major == 7 and info == 31:  # the end of a container of unknown length
            if depth == 0 or left[depth] > 0 or turn[depth] == 2 or tagged:
                return 9, place, pairs
            depth -= 1
            continue
        endless, number = info == 31 and 2 <= major <= 5, -1
        if info > 27 and not endless:
            return 9, place, pairs
        if not endless:
            number, position = _argument(data, position, info)
            if position < 0 or (2 <= major <= 5 and not 0 <= number <= size - position):  # an item takes a byte or more
                return 9, place, pairs
        if tagged and major != 2:
            return 7, place, pairs
        if turn[depth] == 1 and (major != 3 or endless or number > LONGEST_KEY):
            return 6, place, pairs
        if major == 6:
            if not (81 <= number <= 82 or 85 <= number <= 86):
                return 7, place, pairs
            tagged = True
            continue
        tagged = False
        if depth > 0:
            left[depth] -= 1
            counts[depth] += 1
            if turn[depth] == 0 and counts[depth] > MOST_SAMPLES:
                return 1, place, pairs
            pairs += turn[depth] == 1
            if pairs > MOST_PAIRS:
                return 4, place, pairs
            turn[depth] = 3 - turn[depth] if turn[depth] else 0
        if 2 <= major <= 3:
            texts += 1
            if not endless:
                position += number
            while endless:  # pieces of the same kind up to an end
                texts += 1
                if texts > MOST_TEXTS or position >= size:
                    return (5 if texts > MOST_TEXTS else 9), place, pairs
                if data[position] == 255:
                    position += 1
                    break
                if int(data[position]) >> 5 != major or int(data[position]) & 31 > 27:
                    return 9, position, pairs
                number, position = _argument(data, position + 1, int(data[position]) & 31)
                if position < 0 or not 0 <= number <= size - position:
                    return 9, place, pairs
                position += number
            if texts > MOST_TEXTS:
                return 5, place, pairs
        elif 4 <= major <= 5:
            containers += 1
            if depth == DEEPEST:
                return 2, place, pairs
            if containers > MOST_CONTAINERS:
                return 3, place, pairs
            if number > (MOST_SAMPLES if major == 4 else MOST_PAIRS):
                return (1 if major == 4 else 4), place, pairs
            depth += 1
            left[depth] = number if major == 4 or endless else 2 * number
            turn[depth], counts[depth] = major - 4, 0
        elif major == 7 and not (20 <= info <= 22 or 25 <= info <= 27):
            return 8, place, pairs
