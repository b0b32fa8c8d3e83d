"""What a message must keep before anything is built of it, and a message during which the monitor dies."""

from __future__ import annotations

import json
import os
import signal
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cbor2
import numpy as np
import pytest

from sealscope.monitor.database import tables
from sealscope.monitor.database.store import MonitorStore
from sealscope.monitor.service import Service
from sealscope.monitor.settings import BrokerSettings
from sealscope.monitor.sources import broker as broker_module
from sealscope.monitor.sources import message_limits
from sealscope.monitor.sources.message_limits import (
    MAX_CONTAINERS,
    MAX_DEPTH,
    MAX_KEY_BYTES,
    MAX_PAIRS,
    MAX_SAMPLES,
    MAX_TEXTS,
    MessageLimit,
    check_cbor,
)
from sealscope.monitor.sources.source_block import (
    NO_CLOCK,
    NO_SAMPLES,
    OVERSIZED,
    UNENDED,
    UNREADABLE,
    RefusedMessage,
    decode_message,
)

from ..diagnosis.balance_machine import machine
from ..refusals import refusal
from .plant import HEALTHY, Running, by_broker, message, rows_of, until
from .servers import MOSQUITTO, Broker
from .test_broker import send

GOOD = message("press 1", machine(1, duration=0.4, rate=50.0))
_HASH = 2**61 - 1  # of whole numbers: multiples of it have one hash


def head(major: int, number: int) -> bytes:
    """The head of an item of CBOR."""
    return bytes([major << 5 | 27]) + number.to_bytes(8, "big")


def colliding(count: int) -> bytes:
    """A mapping whose keys are big numbers of one hash: building it compares each key with all before."""
    keys = (b"\xc2\x4a" + (_HASH * (k + 1024)).to_bytes(10, "big") for k in range(count))
    return head(5, count) + b"".join(key + b"\x00" for key in keys)


HOSTILE = {
    "big numbers of one hash as keys": colliding(40_000),
    "... and few": colliding(8),
    "... in a mapping within": b"\xa1\x65units" + colliding(8),
    "a pattern": b"\xa1\x61t\xd8\x23" + head(3, 500_000) + b"(" * 500_000,
    "mail": cbor2.dumps({"t": cbor2.CBORTag(36, "From: a\n\nb")}),
    "a list as a key": b"\xa1\x81\x01\x01",
    "bytes as a key": b"\xa1\x41t\x01",
    "a number as a key": b"\xa1\x01\x01",
    "a tag as a key": b"\xa1\xd8\x56\x44abcd\x01",
    "a text in pieces as a key": b"\xa1\x7f\x61t\xff\x01",
    "a long key": cbor2.dumps({"t" * (MAX_KEY_BYTES + 1): 1}),
    "many pairs": cbor2.dumps({str(k): k for k in range(MAX_PAIRS + 1)}),
    "many pairs without a length": b"\xbf" + b"\x61t\x01" * (MAX_PAIRS + 1) + b"\xff",
    "pairs of all mappings": cbor2.dumps({str(k): {"a": 1} for k in range(MAX_PAIRS // 2 + 1)}),
    "depth": cbor2.dumps({"t": [[[[1]]]]}),
    "depth without lengths": b"\x9f" * (MAX_DEPTH + 1) + b"\xff" * (MAX_DEPTH + 1),
    "many lists": cbor2.dumps({"t": [[] for _ in range(MAX_CONTAINERS)]}),
    "many texts": cbor2.dumps({"t": [""] * MAX_TEXTS}),
    "many pieces": b"\xa1\x61t\x5f" + b"\x40" * MAX_TEXTS + b"\xff",
    "a list of 2^64 - 1": b"\xa1\x61t\x9b" + b"\xff" * 8,
    "2^63 bytes": b"\xa1\x61t\x5b\x80" + bytes(7),
    "undefined": cbor2.dumps({"t": cbor2.undefined}),
    "a simple value": b"\xa1\x61t\xf8\xff",
    "a tag of no bytes": b"\xa1\x61t\xd8\x56\x01",
    "a tag of a tag": b"\xa1\x61t\xd8\x56\xd8\x56\x44abcd",
    "a tag and nothing": b"\xa1\x61t\xd8\x56",
    "an end in place of a value": b"\xbf\x61t\xff",
    "an end of a known length": b"\xa1\x61t\x81\xff",
    "pieces of another kind": b"\xa1\x61t\x7f\x41t\xff",
    "a reserved length": b"\xa1\x61t\x1c",
    "something behind": cbor2.dumps(GOOD) + b"\x00",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_nothing_is_built_of_a_message_that_breaks_a_rule(kind: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cbor2, "loads", lambda payload: pytest.fail("the decoder was called"))
    with refusal("byte", error=RefusedMessage) as refused:
        decode_message(HOSTILE[kind], "press 1")
    assert refused.value.reason == UNREADABLE


def test_all_tags_but_those_of_arrays_of_floats_are_refused():
    tags = [*range(81), 83, 84, *range(87, 120), 258, 260, 1000, 55799, 2**32, 2**64 - 1]
    for tag, value in product(tags, (b"12345678", "text", 1, [1, 2], {"a": 1})):
        with refusal("81", "82", "85", "86", error=MessageLimit):
            check_cbor(b"\xa1\x61t" + head(6, tag) + cbor2.dumps(value))


class CountedBytes:
    """Bytes that count how often one is looked at."""

    def __init__(self, payload: bytes) -> None:
        self._payload, self.looks = payload, 0

    def __len__(self) -> int:
        return len(self._payload)

    def __getitem__(self, place: int) -> int:
        self.looks += 1
        return self._payload[place]


@pytest.mark.parametrize("payload", [*HOSTILE.values(), cbor2.dumps(GOOD)], ids=[*HOSTILE, "valid"])
def test_the_walk_looks_at_each_byte_a_few_times_at_most(payload: bytes):
    counted = CountedBytes(payload)
    outcome = message_limits._scan_items.py_func(counted, *message_limits._make_containers())  # type: ignore[attr-defined]
    assert outcome == message_limits._scan_items(np.frombuffer(payload, np.uint8), *message_limits._make_containers())
    assert counted.looks <= 5 * len(payload)


def endless(value: Any) -> bytes:
    """A value as CBOR whose lists, mappings, texts and bytes have no length."""
    if isinstance(value, dict):
        return b"\xbf" + b"".join(cbor2.dumps(key) + endless(own) for key, own in value.items()) + b"\xff"
    if isinstance(value, list):
        return b"\x9f" + b"".join(map(endless, value)) + b"\xff"
    if isinstance(value, str):
        return b"\x7f" + b"".join(cbor2.dumps(letter) for letter in value) + b"\xff"
    return cbor2.dumps(value)


def test_lengths_may_be_left_out():
    whole = decode_message(cbor2.dumps({**GOOD, "units": {"T_oil": "degC"}, "T_oil": 40.0})).samples
    other = decode_message(endless({**GOOD, "units": {"T_oil": "degC"}, "T_oil": 40.0})).samples
    assert whole is not None and other is not None
    assert whole.channels.keys() == other.channels.keys()
    for name in whole.channels:
        np.testing.assert_array_equal(whole[name], other[name])


def test_the_largest_lists_are_taken_and_larger_ones_refused():
    floats = b"\xf9\x3c\x00"
    for count in (MAX_SAMPLES, MAX_SAMPLES + 1):
        known = b"\x9a" + count.to_bytes(4, "big") + floats * count
        for values in (known, b"\x9f" + floats * count + b"\xff"):
            payload = b"\xa3\x61t\x00\x64rate\x18\x32\x61x" + values
            if count == MAX_SAMPLES:
                assert len(decode_message(payload, "press 1").samples or ()) == MAX_SAMPLES
                continue
            with pytest.raises(RefusedMessage) as refused:
                decode_message(payload, "press 1")
            assert refused.value.reason == OVERSIZED


def test_a_key_that_stands_twice_is_refused():
    x = b'"x": [1, 2], "actuator": "a:b"'
    twice = (
        b'{"t": 0, "t": 1, "rate": 50, ' + x + b"}",
        b'{"t": 0, "\\u0074": 1, "rate": 50, ' + x + b"}",
        b'{"t": 0, "rate": 50, "id": "\\\\\\":{", "units": {"x": "m", "x": "mm"}, ' + x + b"}",
        b'{"units": {"a": 1, "b": 2}, "units": {}, "t": 0, "rate": 50, ' + x + b"}",
        b"\xa4\x61t\x00\x61t\x01\x64rate\x18\x32\x61x\x81\x01",
        b"\xbf\x61t\x00\x64rate\x18\x32\x61x\x81\x01\x65units\xa2\x61x\x61m\x61x\x61m\xff",
    )
    for payload in twice:
        with refusal("keys", error=RefusedMessage) as refused:
            decode_message(payload)
        assert refused.value.reason == UNREADABLE
    colons = b'{"t": 0, "rate": 50, "id": "\\\\\\":{:,", "units": {"x": "m"}, ' + x + b"}"
    assert decode_message(colons).actuator == "a:b"


def test_whole_numbers_and_brackets_of_json_are_limited():
    beginning = b'{"rate": 50, "x": [1, 2], "actuator": "a", "t": '
    for digits in (400, 100_000, 5_000_000):
        with pytest.raises(RefusedMessage) as refused:
            decode_message(beginning + b"7" * digits + b"}")
        assert refused.value.reason in (UNREADABLE, NO_CLOCK)
    for hostile in (b'"' * 100_000, b"[" * 100_000, b'{"a":' * 50_000, b'["a",' * 50_000):
        with pytest.raises(RefusedMessage, match="at most") as refused:
            decode_message(beginning + hostile)
        assert refused.value.reason == UNREADABLE
    with pytest.raises(RefusedMessage) as refused:
        decode_message(b'{"rate": 50, "t": 0, "x": [' + b"9" * 309 + b'], "actuator": "a"}')
    assert refused.value.reason in (UNREADABLE, NO_SAMPLES)


def wire(payload: bytes, *, dup: bool = True, qos: int = 1) -> SimpleNamespace:
    """A message as the client of MQTT gives it."""
    return SimpleNamespace(payload=payload, dup=dup, qos=qos, mid=1, topic="plant/press 1")


@pytest.fixture
def connection(tmp_path: Path) -> Any:
    service = Service(by_broker(tmp_path, 1), once=True)
    yield broker_module._Connection(BrokerSettings(), None, service)
    service.close()
    service.store.engine.dispose()


def test_a_decoding_that_was_begun_twice_is_not_begun_again(connection: Any, monkeypatch: pytest.MonkeyPatch):
    """It ends the process: the note of it is there after the restart."""
    handed: list[RefusedMessage] = []
    monkeypatch.setattr(connection._service, "submit", handed.append)

    def deadly(*arguments: object) -> None:
        os._exit(3)

    poison, good = b"poison" * 100_000, json.dumps(GOOD).encode()
    for _ in range(2):
        child = os.fork()
        if child == 0:
            connection._service.store.engine.dispose(close=False)  # no connection of SQLite outlives a fork
            monkeypatch.setattr(broker_module, "decode_message", deadly)
            connection._submit(0, wire(poison, dup=False))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    monkeypatch.setattr(broker_module, "decode_message", lambda *arguments: pytest.fail("it was read"))
    connection._submit(0, wire(poison))
    (refused,) = handed
    assert (refused.reason, refused.size) == (UNENDED, len(poison))
    monkeypatch.undo()
    monkeypatch.setattr(connection._service, "submit", handed.append)
    for _ in range(4):  # one whose decoding ends may come as often as it likes
        connection._submit(0, wire(good))
    assert [getattr(each, "actuator", None) for each in handed[1:]] == ["press 1"] * 4


def test_only_large_and_repeated_messages_are_noted(connection: Any, monkeypatch: pytest.MonkeyPatch):
    noted: list[str] = []
    begin = MonitorStore.begin_decoding
    monkeypatch.setattr(MonitorStore, "begin_decoding", lambda *of: noted.append(of[2]) or begin(*of))
    monkeypatch.setattr(connection._service, "submit", lambda block: None)
    good = json.dumps(GOOD).encode()
    for each, count in (
        (wire(good, dup=False), 0),
        (wire(good), 1),
        (wire(good, qos=0), 1),
        (wire(b" " * 300_000 + good, dup=False), 2),
    ):
        connection._submit(0, each)
        assert len(noted) == count
    assert connection._service.store._rows(tables.decodings.select()) == []


@pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")
def test_a_message_that_kills_the_monitor_does_so_twice_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """By a real broker, which sends it again after each restart; what came after it is stored."""
    broker = Broker(tmp_path)
    settings = by_broker(tmp_path, broker.port)
    broker.open_session("sealscope-monitor", ("plant/press 1", "plant/press 2"))
    poison = {**GOOD, "x": "poison" * 100_000}
    good = json.dumps(message("press 1", HEALTHY.samples(slice(0, 50)))).encode()
    try:
        send(broker.port, [json.dumps(poison).encode(), good])
        for _ in range(2):
            child = os.fork()
            if child == 0:
                monkeypatch.setattr(broker_module, "decode_message", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
                Running(settings).thread.join()
                os._exit(0)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        running = Running(settings)
        running.until(1)
        until(lambda: running.service.actuators.counters.get(UNENDED) == 1)
        running.end()
        assert [reason for reason in running.service.actuators.counters if reason != UNENDED] == []
        assert len(rows_of(settings.database)["blocks"]) == 1
    finally:
        broker.stop()
