"""Check limits of JSON and CBOR messages before they are decoded; decoding then takes time linear in their length.

One pass over the bytes of a CBOR message (RFC 8949) counts its depth, lists, pairs, texts and samples, and finds keys
that are not texts and tags that are not typed arrays of floats (RFC 8746). In JSON the quotation marks and brackets
are counted. `source_block.decode_message` calls both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sealscope.compiled import kernel, law

#: Most samples of a channel.
MAX_SAMPLES = 1_000_000
#: Largest depth of nested containers; largest numbers of containers, of pairs, and of pieces of text or bytes;
#: longest key [bytes].
MAX_DEPTH, MAX_CONTAINERS, MAX_PAIRS, MAX_TEXTS, MAX_KEY_BYTES = 4, 64, 64, 1000, 200
#: Quotation marks and brackets of JSON, at most, including those in texts.
_MAX_QUOTES, _MAX_BRACKETS = 1000, 500
#: Major types of CBOR, and the additional information of an item of unknown length, or of its end (RFC 8949, 3.1).
_BYTES, _TEXT, _LIST, _MAPPING, _TAG, _SIMPLE, _UNKNOWN_LENGTH = 2, 3, 4, 5, 6, 7, 31
#: Tags of arrays of floats: big endian of 4 and 8 bytes, little endian of 4 and 8 bytes.
FLOAT_ARRAYS = (81, 82, 85, 86)
#: Codes that `_scan_items` returns for a broken rule, and the rules in the order of the codes.
(
    _NO_FAULT, _LONG_LIST, _DEPTH, _CONTAINERS, _PAIRS, _TEXTS, _KEY, _TAG_FAULT, _VALUE, _INCOMPLETE, _TRAILING,
) = range(11)  # fmt: skip
_RULES = (
    "",
    f"lists must have at most {MAX_SAMPLES} items",
    f"containers must lie at most {MAX_DEPTH} deep",
    f"there must be at most {MAX_CONTAINERS} containers",
    f"there must be at most {MAX_PAIRS} pairs",
    f"there must be at most {MAX_TEXTS} texts",
    f"keys must be texts of at most {MAX_KEY_BYTES} bytes",
    f"tags must be {', '.join(map(str, FLOAT_ARRAYS))}, each of bytes",
    "values must be numbers, texts, bytes, true, false or null",
    "items must be complete",
    "nothing must follow its mapping",
)


class MessageLimit(ValueError):  # noqa: N818 (names what is exceeded)
    """Raised if a message breaks a `rule` on number, size or depth of items; `oversized`: True for too many samples."""

    def __init__(self, rule: str, *, oversized: bool = False) -> None:
        super().__init__(rule)
        self.oversized = oversized


def check_cbor(payload: bytes) -> int:
    """Check the items of a CBOR message; return the number of key-value pairs, or raise MessageLimit."""
    code, position, n_pairs = _scan_items(np.frombuffer(payload, dtype=np.uint8), *_make_containers())
    if code != _NO_FAULT:
        raise MessageLimit(f"{_RULES[code]} (byte {position})", oversized=code == _LONG_LIST)
    return int(n_pairs)


def check_json(payload: bytes) -> int:
    """Check that a JSON message does not have too many quotation marks or brackets; return the number of colons."""
    n_quotes, n_brackets, n_colons = _count_marks(np.frombuffer(payload, dtype=np.uint8))
    if n_quotes > _MAX_QUOTES:
        raise MessageLimit(f"there must be at most {_MAX_QUOTES} quotation marks, got {n_quotes}")
    if n_brackets > _MAX_BRACKETS:
        raise MessageLimit(f"there must be at most {_MAX_BRACKETS} brackets, got {n_brackets}")
    return int(n_colons)


def check_json_keys(values: Any, payload: bytes, n_colons: int) -> None:
    """Check that no mapping of a JSON message repeats a key; raise MessageLimit otherwise.

    `values`: the decoded message; `payload`: its bytes; `n_colons`: number of colons in the payload, also within texts.
    """
    if _count_shallow_pairs(values) != n_colons:  # a quick test, which a colon within a text also fails
        unquoted = payload.replace(b"\\\\", b"").replace(b'\\"', b"").split(b'"')[::2]  # the parts outside texts
        check_keys(values, sum(part.count(b":") for part in unquoted))


def check_keys(values: Any, n_pairs: int) -> None:
    """Check that a decoded message has the `n_pairs` key-value pairs of its bytes; raise MessageLimit otherwise.

    It has fewer if a key is repeated, as a decoder keeps only the last value of the key.
    """
    if _count_shallow_pairs(values) == n_pairs:  # a quick test
        return
    n_decoded = _count_pairs(values)
    if n_decoded != n_pairs:
        raise MessageLimit(f"keys must differ, got {n_pairs - n_decoded} repeated")


def _count_shallow_pairs(values: Any) -> int:
    """Count the pairs of a mapping and of the mappings that are its values; lists are not searched."""
    if not isinstance(values, dict):
        return 0
    return len(values) + sum(len(value) for value in values.values() if isinstance(value, dict))


def _count_pairs(values: Any) -> int:
    """Count the pairs of all mappings in a decoded message, at any depth."""
    if isinstance(values, dict):
        return len(values) + sum(map(_count_pairs, values.values()))
    return sum(map(_count_pairs, values)) if isinstance(values, list) else 0


@kernel
def _count_marks(data: Any) -> tuple[int, int, int]:
    """Count the quotation marks, the opening brackets and braces, and the colons among bytes (n,)."""
    n_quotes, n_brackets, n_colons = 0, 0, 0
    for byte in data:
        n_quotes += byte == 34  # "
        n_brackets += (byte == 91) | (byte == 123)  # [ {
        n_colons += byte == 58  # :
    return n_quotes, n_brackets, n_colons


@law
def _read_argument(data: Any, position: int, info: int) -> tuple[int, int]:
    """Read the argument of a CBOR item, a number; return it and the position after it, -1 if the data end before.

    `position`: index in `data` (n,) after the item's initial byte; `info`: low 5 bits of that byte. An `info` below 24
    is the argument itself; 24 to 27 mean that the next 1, 2, 4 or 8 bytes contain the argument.
    """
    if info < 24:
        return info, position
    width = 1 << (info - 24)
    if len(data) - position < width:
        return 0, -1
    number = 0
    for k in range(position, position + width):
        number = (number << 8) | int(data[k])  # a number from 2^63 on becomes negative
    return number, position + width


@law
def _skip_pieces(data: Any, start: int, position: int, major: int, n_texts: int) -> tuple[int, int, int]:
    """Skip a CBOR text or byte string of unknown length, which consists of pieces with the same major type `major`.

    `start`, `position`: index in `data` (n,) of the item's first byte, and of its first piece; `n_texts`: number of
    texts, byte strings, and their pieces and ends in the message so far. Returns the code of the broken rule (0 for
    none), the position of the fault or, without a fault, after the item, and the new `n_texts`.
    """
    while True:
        n_texts += 1
        if n_texts > MAX_TEXTS or position >= len(data):
            return (_TEXTS if n_texts > MAX_TEXTS else _INCOMPLETE), start, n_texts
        if data[position] == 255:  # the end
            return _NO_FAULT, position + 1, n_texts
        # a piece must have the same type, and a length, given by additional information up to 27
        if int(data[position]) >> 5 != major or int(data[position]) & 31 > 27:
            return _INCOMPLETE, position, n_texts
        number, position = _read_argument(data, position + 1, int(data[position]) & 31)
        if position < 0 or not 0 <= number <= len(data) - position:
            return _INCOMPLETE, start, n_texts
        position += number


def _make_containers() -> Any:
    """Make the arrays of `_scan_items` for the container at each depth.

    They are the number of items still to come, negative if unknown; 0 in a list, 1 before a key and 2 before a value of
    a mapping; and the number of items so far.
    """
    return np.zeros((3, MAX_DEPTH + 1), dtype=np.int64)


@kernel
def _scan_items(data: Any, n_left: Any, role: Any, n_items: Any) -> tuple[int, int, int]:
    """Check the number, depth and types of the items of a CBOR message, given as bytes (n,), in one pass.

    `n_left`, `role`, `n_items`: of the container at each depth (`_make_containers`).
    Returns the index in `_RULES` of the first broken rule (0 for none), the index of the byte at which the fault or the
    end of the message lies, and the number of key-value pairs before it.
    """
    size, position, depth = len(data), 0, 0
    n_containers, n_pairs, n_texts, is_tagged = 0, 0, 0, False
    while True:
        while depth > 0 and n_left[depth] == 0:
            depth -= 1
        if depth == 0 and position > 0 and not is_tagged:
            return (_NO_FAULT if position == size else _TRAILING), position, n_pairs
        if position >= size:
            return _INCOMPLETE, position, n_pairs
        # the initial byte of an item: major type in the upper 3 bits, additional information in the lower 5
        start, major, info = position, int(data[position]) >> 5, int(data[position]) & 31
        position += 1
        if major == _SIMPLE and info == _UNKNOWN_LENGTH:  # the end of a container of unknown length
            if depth == 0 or n_left[depth] > 0 or role[depth] == 2 or is_tagged:
                return _INCOMPLETE, start, n_pairs
            depth -= 1
            continue
        is_sized = _BYTES <= major <= _MAPPING  # the argument of the item is a length
        number = -1  # the argument; stays negative if the length is unknown
        has_unknown_length = is_sized and info == _UNKNOWN_LENGTH
        if info > 27 and not has_unknown_length:  # reserved
            return _INCOMPLETE, start, n_pairs
        if not has_unknown_length:
            number, position = _read_argument(data, position, info)
            if position < 0 or (is_sized and not 0 <= number <= size - position):  # an item takes a byte or more
                return _INCOMPLETE, start, n_pairs
        if is_tagged and major != _BYTES:
            return _TAG_FAULT, start, n_pairs
        if role[depth] == 1 and (major != _TEXT or has_unknown_length or number > MAX_KEY_BYTES):
            return _KEY, start, n_pairs
        if major == _TAG:
            if number not in FLOAT_ARRAYS:
                return _TAG_FAULT, start, n_pairs
            is_tagged = True
            continue
        is_tagged = False
        if depth > 0:
            n_left[depth] -= 1
            n_items[depth] += 1
            if role[depth] == 0 and n_items[depth] > MAX_SAMPLES:
                return _LONG_LIST, start, n_pairs
            n_pairs += role[depth] == 1
            if n_pairs > MAX_PAIRS:
                return _PAIRS, start, n_pairs
            role[depth] = 3 - role[depth] if role[depth] else 0  # a key and a value take turns
        if major in (_BYTES, _TEXT):
            n_texts += 1
            if has_unknown_length:
                code, position, n_texts = _skip_pieces(data, start, position, major, n_texts)
                if code != _NO_FAULT:
                    return code, position, n_pairs
            else:
                position += number
            if n_texts > MAX_TEXTS:
                return _TEXTS, start, n_pairs
        elif major in (_LIST, _MAPPING):
            n_containers += 1
            if depth == MAX_DEPTH:
                return _DEPTH, start, n_pairs
            if n_containers > MAX_CONTAINERS:
                return _CONTAINERS, start, n_pairs
            if number > (MAX_SAMPLES if major == _LIST else MAX_PAIRS):
                return (_LONG_LIST if major == _LIST else _PAIRS), start, n_pairs
            depth += 1
            n_left[depth] = number if major == _LIST or has_unknown_length else 2 * number  # a pair is two items
            role[depth], n_items[depth] = major - _LIST, 0  # 0 in a list, 1 at the first key of a mapping
        elif major == _SIMPLE and not (20 <= info <= 22 or 25 <= info <= 27):  # false, true, null, floats
            return _VALUE, start, n_pairs
