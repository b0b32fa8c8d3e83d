"""Messages and samples from a hostile wire: an error of one line or a block, never anything else."""

from __future__ import annotations

import io
import json
import tracemalloc
import warnings
from codecs import BOM_UTF8
from collections import Counter
from dataclasses import replace
from threading import Event
from types import SimpleNamespace

import cbor2
import numpy as np
import orjson
import pytest

import sealscope as ss
from sealscope.diagnosis.live.live_balance import BlockConductance
from sealscope.errors import InputError
from sealscope.monitor.actuators import _Actuator
from sealscope.monitor.alarms import AlarmJudge
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources.lines import line_source
from sealscope.monitor.sources.source_block import SourceBlock, decode_message
from sealscope.recordings.recording import Recording

from ..diagnosis.balance_machine import machine
from .plant import message

GOOD = message("press 1", machine(1, duration=0.4, rate=50.0))
TEXTS = (json.dumps(GOOD).encode(), cbor2.dumps(GOOD))
ODD = (
    b"{" * 100_000,
    b"[" * 100_000,
    b'{"t": 1e999, "rate": 50, "x": [1]}',
    b'{"t": 1, "rate": 1e308, "x": [1], "actuator": "a"}',
    b'{"t": 9007199254740993, "rate": 50, "x": [1]}',
    b'{"t": 1' + b"0" * 320 + b', "rate": 50, "x": [1], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [1, [2]], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [1, 1e999], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [1, -Infinity], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [' + b"9" * 400 + b'], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [' + b"9" * 5000 + b'], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": {"0": 1}, "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": ["1e5"], "actuator": ["a"]}',
    b'{"t": 0, "rate": 50, "x": ["1e5"], "actuator": "a"}',
    b'{"t": 0, "rate": 50, "x": [2.0, true], "actuator": "a"}',
    b'{"t": true, "rate": 50, "x": [1], "actuator": "a"}',
    b"\x9b\xff\xff\xff\xff\xff\xff\xff\xff",  # CBOR: an array of 2^64 - 1
    b"\x5b\x7f\xff\xff\xff\xff\xff\xff\xff",  # CBOR: 2^63 - 1 bytes
    b"\xd8\x1c\x81\xd8\x1d\x00",  # CBOR: a list that holds itself
    b"\xc2" + b"\x59\x27\x10" + b"\xff" * 10_000,  # CBOR: a number of 10 000 bytes
    b"\x81" * 50_000,
    *(cbor2.dumps({**GOOD, name: 7**6000}) for name in ("t", "rate", "id", "actuator", "x")),
    cbor2.dumps({**GOOD, 7**6000: 0}),
    b"",
    b"\x00",
)


def taken(payload: bytes) -> str:
    """What a message is, in a word."""
    try:
        block = decode_message(payload, None)
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) < 400
        return "refused"
    assert isinstance(block, SourceBlock)
    return "block"


@pytest.mark.parametrize("payload", ODD, ids=range(len(ODD)))
def test_an_odd_message_is_refused_in_one_line(payload: bytes):
    # samples at 1e308 Hz are a block, which the stream counts and drops
    assert taken(payload) == ("block" if b"1e308" in payload else "refused")


def test_lines_may_begin_with_the_mark_of_utf_8():
    taken_in: list[object] = []
    receiver = SimpleNamespace(settings=SimpleNamespace(actuator=[]), stopping=Event(), submit=taken_in.append)
    line_source(io.BytesIO(BOM_UTF8 + TEXTS[0]))(receiver)
    (block,) = taken_in
    assert isinstance(block, SourceBlock)


@pytest.mark.parametrize(("tag", "kind"), [(81, ">f4"), (82, ">f8"), (85, "<f4"), (86, "<f8")])
def test_typed_arrays_are_lists_of_numbers(tag: int, kind: str):
    arrays = {name: np.array(GOOD[name], dtype=kind) for name in ("p_A", "p_B", "x", "theta")}
    arrays["x"][3] = np.nan
    tagged = {name: cbor2.CBORTag(tag, values.tobytes()) for name, values in arrays.items()}
    samples = decode_message(cbor2.dumps({**GOOD, **tagged})).samples
    assert samples is not None
    for name, values in arrays.items():
        np.testing.assert_array_equal(samples[name], values.astype(float))
    damaged = (b"abc", "abcdefgh", np.full(20, np.inf, kind).tobytes(), b"")
    for value in damaged:
        assert taken(cbor2.dumps({**GOOD, "x": cbor2.CBORTag(tag, value)})) == "refused"
    assert taken(cbor2.dumps({**GOOD, "x": cbor2.CBORTag(64, b"abcd")})) == "refused"  # of bytes: no samples


def test_a_slow_channel_may_be_a_single_number():
    for given in (41.5, [41.5], [41.5] * len(GOOD["p_A"])):
        samples = decode_message(json.dumps({**GOOD, "T_oil": given, "units": {"T_oil": "degC"}}).encode()).samples
        assert samples is not None
        assert samples["T_oil"] == pytest.approx(np.full(len(GOOD["p_A"]), 314.65))
    for wrong in ([41.5, 42.0], "warm", True, {}, [None, "x"]):
        assert taken(json.dumps({**GOOD, "T_oil": wrong}).encode()) == "refused"
    assert taken(json.dumps({"actuator": "a", "t": 0.0, "rate": 1.0, "T_oil": 300.0}).encode()) == "refused"


def mutated(random: np.random.Generator) -> bytes:
    data = bytearray(TEXTS[random.integers(2)])
    for _ in range(random.integers(1, 6)):
        at = int(random.integers(len(data)))
        kind = random.integers(4)
        if kind == 0:
            data[at] = int(random.integers(256))
        elif kind == 1:
            del data[at : at + int(random.integers(1, 40))]
        elif kind == 2:
            data[at:at] = bytes(random.integers(0, 256, int(random.integers(1, 20)), dtype=np.uint8))
        else:
            data[at:at] = data[at : at + int(random.integers(1, 60))]
    return bytes(data)


@pytest.mark.parametrize("count", [700, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.long])])
def test_mutated_messages_are_blocks_or_refused(count: int):
    random = np.random.default_rng(count)
    outcomes = Counter[str]()
    tracemalloc.start()
    outcomes.update(taken(mutated(random)) for _ in range(count // 10))
    memory = tracemalloc.get_traced_memory()[0]
    outcomes.update(taken(mutated(random)) for _ in range(count - count // 10))
    growth = tracemalloc.get_traced_memory()[0] - memory
    tracemalloc.stop()
    assert outcomes.keys() == {"block", "refused"}
    assert min(outcomes.values()) > count // 100
    assert growth < 2_000_000  # bytes


@pytest.fixture(scope="module")
def learned() -> str:
    """The state of a watch that has learned."""
    watch = ss.watch("thesis", learn_hours=0.02)
    watch.update(machine(1, duration=120.0, rate=50.0))
    return json.dumps(watch.state())


@pytest.mark.parametrize("wrong", [{"sd": 1e200}, {"g": 1e200}, {"sd": 1e-200}, {"pressure": 1e308}, {"total": np.nan}])
def test_a_block_beyond_floating_point_says_nothing(wrong: dict[str, float], learned: str):
    """The squares of such a block's numbers, in units of the first one, raised an OverflowError, or stayed as nan."""
    watch = ss.Watch.from_state(json.loads(learned))
    block = BlockConductance(120.0, 123.0, 3e-13, 1e-15, 3e-13, 1e-15, 6e4, 2e-5)
    before = json.dumps(watch._detector.state())
    estimate = watch.judge([block._replace(**wrong)])
    assert (estimate.status, watch.counters["blocks: beyond floating point"]) == ("beyond floating point", 1)
    assert json.dumps(watch._detector.state(), allow_nan=False) == before
    assert watch.judge([block]).status in ("watched", "another duty")


@pytest.mark.parametrize(
    "factor",
    [
        pytest.param(0.0, marks=pytest.mark.slow),
        *(pytest.param(factor, marks=[pytest.mark.slow, pytest.mark.long]) for factor in (1e-308, 1e150)),
        1e300,
    ],
)
@pytest.mark.parametrize("names", [("p_A", "p_B", "x", "theta"), ("p_A", "p_B", "u")], ids=["volumes", "pressures"])
def test_what_is_shown_of_any_samples_can_be_stored(factor: float, names: tuple[str, ...]):
    """A pressure difference of zero was a number of numpy in the summary; a sense of nan stood in the state."""
    whole = machine(1, duration=80.0, rate=200.0).only(names)
    with np.errstate(all="ignore"):
        p_B = whole["p_A"] if factor == 0.0 else whole["p_B"] * factor
        p_A = whole["p_A"] if factor == 0.0 else whole["p_A"] * factor
    odd = replace(whole, channels={**whole.channels, "p_A": p_A, "p_B": p_B})
    for first, then in ((whole, odd), (odd, odd), (odd, whole)):
        settings = ActuatorSettings(name="press 1", learn_hours=0.01)
        actuator = _Actuator(settings, ss.watch("thesis", learn_hours=0.01), AlarmJudge("press 1"))
        for start, part in ((0.0, first), (40.0, then)):
            estimates, _ = actuator.judge_samples(part.between(start, start + 40.0), follows=True, settings=settings)
            for own in estimates:
                orjson.dumps(vars(own))
        orjson.dumps(actuator.summary())
        json.dumps(actuator.state(), allow_nan=False)


def test_no_samples_raise_or_warn(learned: str):
    """Infinite, huge and missing values, times out of order, rates of any size, between valid samples."""
    random, healthy = np.random.default_rng(5), machine(1, duration=8.0, rate=50.0)
    watch = ss.Watch.from_state(json.loads(learned))
    blocks = watch.blocks
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(70):
            part = healthy.samples(slice(0, 400))
            channels = {name: values.copy() for name, values in part.channels.items()}
            t, rate = part.t + 120.0 + 8.0 * number, 50.0
            name = list(channels)[random.integers(len(channels))]
            odd = (np.nan, np.inf, -np.inf, 1e308, -1e200, 1e-308, 0.0)[random.integers(7)]
            kind = random.integers(6)
            if kind == 0:
                channels[name][random.integers(0, 400, 5)] = odd
            elif kind == 1:
                channels[name][:] = odd
            elif kind == 2:
                t = random.permutation(t)
            elif kind == 3:
                t = t + random.choice([1e300, -1e300, np.nan, np.inf, 1e9, -1e9])
            elif kind == 4:
                rate = float(random.choice([1e-300, 9.0, 50.2, 500.0, 1e300]))
            watch.update(Recording(t, channels, part.units, rate))
    assert watch.blocks > blocks
    assert all(number > 0 for number in watch.counters.values())
    assert len(json.dumps(watch.state(), allow_nan=False)) < 300_000
    assert len(watch.counters) < 40
