"""Hostile messages of the monitor: JSON, CBOR, and Sparkplug B, each decoder as the monitor has it for days.

A message is refused for one of the reasons that are foreseen: the guard against all others must have nothing to do.
"""

from __future__ import annotations

import json
import random
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import cbor2
import numpy as np

from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.message_limits import FLOAT_ARRAYS, MAX_DEPTH, MessageLimit, check_cbor
from sealscope.monitor.sources.source_block import UNFORESEEN, RefusedMessage, decode_message
from sealscope.monitor.sources.sparkplug_host import SparkplugHost
from sealscope.monitor.sparkplug import (
    BIRTH_SEQUENCE,
    BOOLEAN,
    DOUBLE,
    INT64,
    STRING,
    UINT64,
    SparkplugMetric,
    SparkplugPayload,
    encode_payload,
)

from .mutations import change_tree, changed_bytes
from .targets import Use, taken

SAMPLES = [0.001 * k for k in range(20)]
VALID: dict[str, Any] = {
    "actuator": "press 1",
    "t": 1.0,
    "rate": 50.0,
    "id": "block 7",
    "units": {"p_A": "bar", "T_oil": "degC"},
    "T_oil": 41.5,
    **dict.fromkeys(("p_A", "p_B", "x", "theta"), SAMPLES),
}
KINDS = ("NBIRTH", "DBIRTH", "NDATA", "DDATA", "NDEATH", "DDEATH", "NCMD", "STATE")


def deep(draw: random.Random) -> Any:
    """A value that is deep, huge or of a kind that JSON has not."""
    kind, value = draw.randrange(6), 1
    if kind < 3:
        nested: Any = value
        for _ in range(draw.choice((2, 30, 100, 250))):
            nested = [nested] if kind == 0 else {"p_A": nested} if kind == 1 else [0, nested]
        return nested
    if kind == 3:
        return draw.choice((7**600, -(2**70), 1e308, float("nan"), float("-inf")))
    if kind == 4:
        return cbor2.CBORTag(draw.choice((2, 4, 30, 64, 81, 82, 85, 86, 258)), draw.choice((b"\x00" * 12, [1, 2], "a")))
    return draw.choice((b"bytes", None, True, "\ud800", "\0", cbor2.undefined, [[1.0], [2.0]], ["nan"] * 20))


def _refused(error: RefusedMessage) -> None:
    assert error.reason != UNFORESEEN, str(error)
    raise error


def messages(folder: Path) -> Use:
    """JSON and CBOR."""

    def use(draw: random.Random) -> bool:
        tree = deepcopy(VALID)
        change_tree(tree, draw)
        if draw.random() < 0.5:
            tree[draw.choice([*VALID, "no such"])] = deep(draw)
        try:
            whole = cbor2.dumps(tree) if draw.random() < 0.5 else json.dumps(tree, default=str).encode()
        except Exception:  # what cannot be written is no message
            whole = cbor2.dumps(VALID)
        message = changed_bytes(whole, draw) if whole and draw.random() < 0.3 else whole

        def work() -> None:
            try:
                decode_message(message, draw.choice((None, "press 1")))
            except RefusedMessage as error:
                _refused(error)

        return taken(work)

    return use


def _head(major: int, number: int, draw: random.Random) -> bytes:
    """The head of an item of CBOR, its number in any of the widths that hold it, seldom wrong or without a length."""
    if draw.random() < 0.02:
        number = draw.choice((min(number + 1, 2**64 - 1), 2**32 - 1, 2**63 - 1, 2**64 - 1, 1_000_001))
    if draw.random() < 0.02:
        return bytes([major << 5 | draw.randrange(24, 32)])
    widths = [width for width in range(4) if number < 256 ** (1 << width)]
    if number < 24 and draw.random() < 0.7:
        return bytes([major << 5 | number])
    width = widths[0] if draw.random() < 0.8 else draw.choice(widths)
    return bytes([major << 5 | 24 + width]) + number.to_bytes(1 << width, "big")


def _pieces(major: int, value: bytes, draw: random.Random) -> bytes:
    """Bytes or a text, whole or in pieces."""
    if draw.random() < 0.9:
        return _head(major, len(value), draw) + value
    pieces = [value[k : k + 3] for k in range(0, len(value), 3)]
    return bytes([major << 5 | 31]) + b"".join(_head(major, len(own), draw) + own for own in pieces) + b"\xff"


def item(draw: random.Random, depth: int = 0) -> bytes:
    """An item of CBOR of any kind: numbers, texts, tags of all kinds, containers with and without a length."""
    kind = draw.randrange(14 if depth < 6 else 8)
    if kind < 2:
        return _head(kind, draw.choice((0, 1, 50, 255, 2**32, 2**64 - 1)), draw)
    if kind == 2:
        return draw.choice((b"\xf4", b"\xf6", b"\xf7", b"\xf8\x20", b"\xf9\x3c\x00", b"\xfb" + bytes(8), b"\xff"))
    if kind in (3, 4):
        return _pieces(kind - 1, draw.choice((b"", b"p_A", b"bar", "\u00fc".encode(), b"\xff", b"12345678")), draw)
    if kind in (5, 6):
        return _head(6, draw.choice((81, 82, 85, 86)), draw) + _pieces(2, draw.randbytes(8 * draw.randrange(4)), draw)
    if kind == 7:  # a big number, a pattern, mail, a set, a reference, or what a library makes of another tag
        tag = draw.choice((0, 1, 2, 3, 4, 5, 25, 28, 29, 30, 35, 36, 37, 43000, 55799, 100, 258, 260, 1004))
        return _head(6, tag, draw) + _pieces(draw.choice((2, 3)), draw.choice((b"((a+)+)+$", b"\x02" * 10)), draw)
    count = draw.choice((0, 1, 2, 3)) if draw.random() < 0.97 or depth > 2 else 70
    if kind < 11:
        parts = [item(draw, depth + 1) for _ in range(count)]
    else:
        keys = [_pieces(3, draw.choice((b"t", b"x", b"units", b"%d" % k)), draw) for k in range(count)]
        if draw.random() < 0.2 and count:  # numbers of one hash, and anything
            keys = [
                _head(6, 2, draw) + _pieces(2, ((2**61 - 1) * (k + 9)).to_bytes(9, "big"), draw) for k in range(count)
            ]
            keys[0] = item(draw, 6)
        parts = [key + item(draw, depth + 1) for key in keys]
    major = 4 if kind < 11 else 5
    if draw.random() < 0.3:
        return bytes([major << 5 | 31]) + b"".join(parts) + b"\xff" * (draw.random() < 0.95)
    return _head(major, count, draw) + b"".join(parts)


def _check_plain(value: Any, depth: int = 0) -> None:
    """Assert that a decoder made of a message nothing but what a message may hold."""
    assert depth <= MAX_DEPTH
    if isinstance(value, dict):
        assert all(type(key) is str for key in value)
        for own in value.values():
            _check_plain(own, depth + 1)
    elif isinstance(value, list):
        for own in value:
            _check_plain(own, depth + 1)
    elif isinstance(value, cbor2.CBORTag):
        assert value.tag in FLOAT_ARRAYS and type(value.value) is bytes
    else:
        assert value is None or type(value) in (bool, int, float, str, bytes)
        assert not isinstance(value, int) or -(2**64) <= value < 2**64


def cbor(folder: Path) -> Use:
    """Items of CBOR of any kind, alone or in the place of a value; what passes the limits is plain for the library."""

    def use(draw: random.Random) -> bool:
        pairs = {name: cbor2.dumps(value) for name, value in VALID.items()}
        for _ in range(draw.choice((0, 1, 1, 2))):
            pairs[draw.choice([*VALID, "no such"])] = item(draw, 1)
        whole = _head(5, len(pairs), draw) + b"".join(cbor2.dumps(name) + value for name, value in pairs.items())
        message = draw.choice((whole, whole, item(draw)))
        message = changed_bytes(message, draw) if draw.random() < 0.2 else message
        try:
            check_cbor(message)
        except MessageLimit as error:
            assert "\n" not in str(error)
        else:
            with suppress(cbor2.CBORDecodeError, UnicodeDecodeError):  # a text that is no UTF-8
                _check_plain(cbor2.loads(message))

        def work() -> None:
            try:
                decode_message(message, draw.choice((None, "press 1")))
            except RefusedMessage as error:
                _refused(error)

        return taken(work)

    return use


def metric(draw: random.Random) -> SparkplugMetric:
    """A metric of a known name whose value is of any type."""
    name = draw.choice((BIRTH_SEQUENCE, "p_A", "p_B [bar]", "rate", "T_oil", "x", None, "", "no such"))
    kind, value = draw.choice(
        (
            (DOUBLE, draw.choice((1.0, float("nan"), float("inf"), -1e308))),
            (INT64, draw.choice((0, 1, 3, -(2**40)))),
            (UINT64, 2**64 - 1),
            (STRING, draw.choice(("", "3", "a" * 1000))),
            (BOOLEAN, True),
            (31, np.arange(float(draw.choice((0, 1, 20))))),
            (25, np.arange(20)),
            (DOUBLE, None),
        )
    )
    at = draw.choice((None, 0, 1_700_000_000_000, 2**63, 2**64 - 1))
    unit = draw.choice((None, "bar", "furlong", "degC", ""))
    return SparkplugMetric(name, value, kind, draw.choice((None, 0, 1, 2**64 - 1)), at, unit)


def sparkplug(folder: Path) -> Use:
    """Sparkplug B, by a host that keeps what it has heard: births, data and deaths in any order."""
    edges = [("g/n", "edge"), ("g/n/d", "device"), ("g/m", "other")]
    heard = [
        ActuatorSettings(name=name, sparkplug=path, rate=50.0 if name != "other" else None) for path, name in edges
    ]
    host = SparkplugHost(heard, lambda *_: None, lambda _: None)

    def use(draw: random.Random) -> bool:
        metrics = tuple(metric(draw) for _ in range(draw.choice((0, 1, 1, 2, 5))))
        payload = SparkplugPayload(draw.choice((None, 1, 2**63)), metrics, draw.choice((None, 0, 1, 255, 256, 2**40)))
        whole = encode_payload(payload)
        message = changed_bytes(whole, draw) if whole and draw.random() < 0.3 else whole
        kind = draw.choice(KINDS)
        place = draw.choice(
            (f"g/{kind}/n", f"g/{kind}/n/d", f"g/{kind}/m", f"{kind}", f"g/{kind}/n/d/e", f"g/{kind}/z")
        )

        def work() -> None:
            try:
                host.receive(f"spBv1.0/{place}", message)
            except RefusedMessage as error:
                _refused(error)

        return taken(work)

    return use


MESSAGES = {"monitor messages": messages, "CBOR messages": cbor, "Sparkplug messages": sparkplug}
