"""Sparkplug B: payloads against bytes by hand and two decoders of third parties, a host's rules, a node's messages.

The decoders are the packages pysparkplug and mqtt-spb-wrapper (`pip install --no-deps`: they pin an older paho-mqtt).
"""

from __future__ import annotations

import io
import struct
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sealscope.monitor import sparkplug
from sealscope.monitor.service import Service
from sealscope.monitor.settings import ActuatorSettings
from sealscope.monitor.sources import sparkplug_host
from sealscope.monitor.sources.source_block import (
    NO_CLOCK,
    NO_SAMPLES,
    OUT_OF_SEQUENCE,
    REASONS,
    STALE_DEATH,
    UNBORN,
    UNREADABLE,
    WRONG_ACTUATOR,
    WRONG_UNITS,
    BlockReceiver,
    RefusedMessage,
)
from sealscope.monitor.sources.sparkplug_host import GAPS, SparkplugHost
from sealscope.monitor.sparkplug import SparkplugMetric, SparkplugPayload, decode_payload, encode_payload
from sealscope.recordings.recording import Recording

from ..representatives import few
from .plant import CHANNELS, HEALTHY, WORN, message, rows_of, settings_in

DOUBLES = 31
UNITS = {"p_A": "Pa", "p_B": "Pa", "x": "m", "theta": "rad"}


def test_bytes_by_hand():
    """The wire format of protobuf, written down: field number << 3 | kind, then a value or a length and its bytes."""
    metric = b"\x0a\x05bdSeq" + b"\x18\x05" + b"\x20\x04" + b"\x58\x03"  # name, time, type Int64, long_value
    null = b"\x0a\x01n" + b"\x20\x0a" + b"\x38\x01"  # a double that is null
    minus = b"\x0a\x01m" + b"\x10\x07" + b"\x20\x03" + b"\x50\xfb\xff\xff\xff\x0f"  # alias 7, Int32, -5 in 32 bits
    unit = b"\x0a\x07engUnit" + b"\x12\x06" + b"\x08\x0c" + b"\x42\x02mm"
    array = b"\x0a\x01x" + b"\x20\x1f" + b"\x4a" + bytes([len(unit)]) + unit
    array += b"\x82\x01\x10" + struct.pack("<2d", 1.5, -2.0)  # field 16, bytes_value
    parts = [metric, null, minus, array]
    wire = b"\x08\x7b" + b"".join(b"\x12" + bytes([len(part)]) + part for part in parts) + b"\x18\xff\x01"
    payload = decode_payload(wire)
    assert (payload.timestamp, payload.seq) == (123, 255)
    sequence, empty, below, samples = payload.metrics
    assert sequence == SparkplugMetric("bdSeq", 3, sparkplug.INT64, timestamp=5)
    assert (empty.name, empty.value, below.name, below.alias, below.value) == ("n", None, "m", 7, -5)
    assert (samples.unit, samples.value.tolist()) == ("mm", [1.5, -2.0])
    assert encode_payload(payload) == wire


def test_the_schema_is_the_published_one():
    """Every field has number, type and label of the descriptor that a third party compiled."""
    theirs = pytest.importorskip("pysparkplug._protobuf").Payload.DESCRIPTOR
    ours = sparkplug.payload_class().DESCRIPTOR
    names = ("Metric", "PropertySet", "PropertyValue")
    parts = [(ours.file.message_types_by_name[name], theirs.nested_types_by_name[name]) for name in names]
    count = 0
    for mine, published in [(ours, theirs), *parts]:
        for field in mine.fields:
            other = published.fields_by_name[field.name]
            assert (field.number, field.type) == (other.number, other.type), field.full_name
            assert (field.containing_oneof is None) == (other.containing_oneof is None)
            count += 1
    assert count == 3 + 15 + 2 + 8


EVERY_TYPE = [
    SparkplugMetric("c", -70_000, 3),
    SparkplugMetric("d", -(2**40), 4),
    SparkplugMetric("e", 2**32 - 1, 7),
    SparkplugMetric("f", 2**63, 8),
    SparkplugMetric("g", 0.5, 9, timestamp=1_700_000_000_001),
    SparkplugMetric("h", 0.1, 10, alias=3, unit="L/min"),
    SparkplugMetric("i", True, 11),
    SparkplugMetric("j", "höher", 12),
    SparkplugMetric("k", None, 10),
]


def test_third_parties_read_what_is_written():
    spb = pytest.importorskip("pysparkplug")
    wire = encode_payload(SparkplugPayload(1_700_000_000_000, tuple(EVERY_TYPE), 9))
    theirs = spb.DData.decode(wire)
    assert (theirs.timestamp, theirs.seq) == (1_700_000_000_000, 9)
    for ours, metric in zip(EVERY_TYPE, theirs.metrics, strict=True):
        assert (metric.name, metric.value, int(metric.datatype)) == (ours.name, ours.value, ours.datatype)
        assert (metric.alias, metric.timestamp, metric.is_null) == (ours.alias, ours.timestamp, ours.value is None)
    parser = pytest.importorskip("mqtt_spb_wrapper").SpbPayloadParser(wire).as_dict()
    assert {metric["name"]: metric.get("value") for metric in parser["metrics"] if metric["name"] != "k"} == {
        metric.name: metric.value for metric in EVERY_TYPE if metric.name != "k"
    }


def test_what_third_parties_write_is_read():
    spb = pytest.importorskip("pysparkplug")
    values = {
        spb.DataType.INT8: -7,
        spb.DataType.INT16: -7,
        spb.DataType.INT64: -7,
        spb.DataType.UINT64: 7,
        spb.DataType.FLOAT: 0.25,
        spb.DataType.DOUBLE: 0.1,
        spb.DataType.BOOLEAN: False,
        spb.DataType.STRING: "ü",
        spb.DataType.INT16_ARRAY: (-3, 2),
        spb.DataType.FLOAT_ARRAY: (0.5, 1.5),
        spb.DataType.DOUBLE_ARRAY: (0.1, 1e300),
    }
    metrics = tuple(spb.Metric(timestamp=5, name=kind.name, datatype=kind, value=of) for kind, of in values.items())
    payload = decode_payload(spb.DBirth(timestamp=6, seq=0, metrics=metrics).encode())
    for metric, (kind, value) in zip(payload.metrics, values.items(), strict=True):
        given = metric.value.tolist() if isinstance(metric.value, np.ndarray) else metric.value
        assert (metric.name, metric.datatype, given) == (
            kind.name,
            int(kind),
            list(value) if isinstance(value, tuple) else value,
        )


class Plant:
    """A host of one actuator, the device "press" of plant/edge, and what its node sends."""

    def __init__(self, device: str | None = "press", **settings: Any) -> None:
        path = f"plant/edge/{device}" if device else "plant/edge"
        actuator = ActuatorSettings(name="press 1", sparkplug=path, **{"rate": 50.0, **settings})
        self.asked: list[str] = []
        self.counted: Counter[str] = Counter()
        self.host = SparkplugHost([actuator], self._publish, lambda reason: self.counted.update([reason]))
        self.device, self.seq = device, 255

    def _publish(self, topic: str, payload: bytes) -> None:
        (command,) = decode_payload(payload).metrics
        assert (topic, command.name, command.value) == ("spBv1.0/plant/NCMD/edge", "Node Control/Rebirth", True)
        self.asked.append(topic)

    def send(self, kind: str, *metrics: SparkplugMetric, at: int | None = 1_700_000_000_000, skip: int = 0) -> Any:
        if kind != "NDEATH":
            self.seq = 0 if kind == "NBIRTH" else (self.seq + 1 + skip) % 256
        device = self.device if kind.startswith("D") else None
        topic = sparkplug.topic_of("plant", kind, "edge", device)
        return self.host.receive(
            topic, encode_payload(SparkplugPayload(at, metrics, None if kind == "NDEATH" else self.seq))
        )

    def born(self, *metrics: SparkplugMetric, number: int = 1) -> None:
        assert self.send("NBIRTH", SparkplugMetric("bdSeq", number, sparkplug.INT64)) is None
        if self.device:
            assert self.send("DBIRTH", *metrics) is None

    def refused(self, *arguments: Any, **options: Any) -> str:
        with pytest.raises(RefusedMessage) as raised:
            self.send(*arguments, **options)
        assert "\n" not in str(raised.value)
        assert raised.value.reason in REASONS
        return raised.value.reason


def arrays(samples: Recording, at: int, **changed: Any) -> list[SparkplugMetric]:
    return [
        SparkplugMetric(name, samples[name], DOUBLES, timestamp=at, **changed) for name in CHANNELS if name in samples
    ]


def births(**changed: Any) -> list[SparkplugMetric]:
    oil = SparkplugMetric("T_oil", None, sparkplug.DOUBLE, alias=len(CHANNELS), unit="degC")
    return [
        *(
            SparkplugMetric(name, None, DOUBLES, alias=k, unit=UNITS[name], **changed)
            for k, name in enumerate(CHANNELS)
        ),
        oil,
    ]


def as_source(samples: dict[str, Recording], size: int) -> Callable[[BlockReceiver], None]:
    """The samples of actuators as a node whose devices they are."""

    def submit(service: BlockReceiver) -> None:
        host = SparkplugHost(service.settings.actuator, lambda *_: None, service.count)
        number = [SparkplugMetric("bdSeq", 0, sparkplug.INT64)]
        messages: list[tuple[str, str | None, list[SparkplugMetric]]] = [("NBIRTH", None, number)]
        messages += [("DBIRTH", device, births()) for device in samples]
        for start in range(0, max(map(len, samples.values())), size):
            for device, recording in samples.items():
                part = recording.samples(slice(start, start + size))
                if len(part):
                    metrics = arrays(part, round(1000.0 * float(part.t[0])))
                    readings = message(device, part)
                    if "T_oil" in readings:  # of a time of its own
                        metrics.append(SparkplugMetric("T_oil", readings["T_oil"], sparkplug.DOUBLE, timestamp=1))
                    messages.append(("DDATA", device, metrics))
        for seq, (kind, device, metrics) in enumerate(messages):
            wire = encode_payload(SparkplugPayload(1, tuple(metrics), seq % 256))
            block = host.receive(sparkplug.topic_of("plant", kind, "edge", device), wire)
            if block is not None:
                service.submit(block)

    return submit


def test_samples_by_sparkplug_are_samples(undisturbed, tmp_path):
    """The same estimates and the same alarm as from JSON lines; times in whole milliseconds do no harm."""
    settings = settings_in(tmp_path)
    actuators = [
        actuator.model_copy(update={"sparkplug": f"plant/edge/{actuator.name}", "rate": 50.0})
        for actuator in settings.actuator
    ]
    settings = settings.model_copy(update={"actuator": actuators})
    source = as_source({"press 1": WORN, "press 2": HEALTHY}, 150)
    service = Service(settings, once=True, stdin=io.BytesIO(), stdout=io.StringIO(), sources=[source])
    service.run()
    assert service.actuators.counters == {}
    ours, theirs = rows_of(settings.database), undisturbed
    assert len(ours["blocks"]) == len(theirs["blocks"])
    for mine, other in zip(ours["estimates"], theirs["estimates"], strict=True):  # of 9 digits in the lines
        assert (mine[0], mine[1], mine[3]) == (other[0], other[1], other[3])
        assert np.array(mine[2:3] + mine[4:], float) == pytest.approx(
            np.array(other[2:3] + other[4:], float), rel=1e-3, nan_ok=True
        )
    assert [row[:3] for row in ours["alarms"]] == [row[:3] for row in theirs["alarms"]]


def test_aliases_units_and_names_are_those_of_the_birth():
    plant = Plant(map={"p_A": "Hydraulics/A", "rate": "fs"}, rate=None)
    plant.born(
        SparkplugMetric("Hydraulics/A", None, DOUBLES, alias=1, unit="bar"),
        SparkplugMetric("p_B [MPa]", None, DOUBLES, alias=2),
        SparkplugMetric("x", None, 22, alias=3),  # an array of Int8
        SparkplugMetric("theta", None, DOUBLES, alias=4, unit="rad"),
        SparkplugMetric("fs", 100.0, 10, alias=5),
        SparkplugMetric("Temperature", 20.0, 10, alias=6),
    )
    values = np.array([1.0, 2.0, 3.0])
    block = plant.send(
        "DDATA",
        SparkplugMetric(None, values, DOUBLES, alias=1, timestamp=2000),
        SparkplugMetric(None, values, DOUBLES, alias=2, timestamp=2000),
        SparkplugMetric(None, values, 22, alias=3, timestamp=2000),
        SparkplugMetric("theta", values, DOUBLES, timestamp=2000),
        SparkplugMetric(None, 30.0, 10, alias=6),
        SparkplugMetric(None, 30.0, 10, alias=77),
    )
    assert block.actuator == "press 1"
    assert block.samples.t.tolist() == [2.0, 2.01, 2.02]
    assert block.samples["p_A"].tolist() == pytest.approx([1e5, 2e5, 3e5])
    assert block.samples["p_B"].tolist() == pytest.approx([1e6, 2e6, 3e6])
    assert block.samples["x"].tolist() == [1.0, 2.0, 3.0]
    assert plant.send("DDATA", SparkplugMetric(None, 30.0, 10, alias=6)) is None  # no channel, no block
    assert plant.asked == []
    assert not plant.counted


@pytest.mark.parametrize("value", [2.0, np.array([2.0, 2.0])], ids=["single", "array"])
def test_a_unit_stated_with_samples_holds_until_another_is_stated(value):
    plant, kind = Plant(), DOUBLES if isinstance(value, np.ndarray) else sparkplug.DOUBLE
    plant.born(*births())

    def sent(at: int, unit: str | None) -> float:
        block = plant.send("DDATA", SparkplugMetric("p_A", value, kind, timestamp=at, unit=unit))
        return float(block.samples["p_A"][0])

    read = [sent(1000 * k, unit) for k, unit in enumerate([None, "bar", None, "MPa"])]
    assert read == pytest.approx([2.0, 2e5, 2e5, 2e6])
    plant.born(*births())
    assert sent(5000, None) == pytest.approx(2.0)


def test_single_samples_by_exception_keep_what_did_not_change():
    plant = Plant()
    plant.born(*[SparkplugMetric(name, float(k), 10, unit=UNITS[name]) for k, name in enumerate(CHANNELS)])
    block = plant.send(
        "DDATA",
        SparkplugMetric("x", 5.0, 10, timestamp=1000),
        SparkplugMetric("p_A", 7.0, 10, timestamp=1020),
        SparkplugMetric("x", None, 10, timestamp=1040),
    )
    assert block.samples.t.tolist() == pytest.approx([1.0, 1.02, 1.04])
    assert block.samples["x"].tolist() == pytest.approx([5.0, 5.0, np.nan], nan_ok=True)
    assert block.samples["p_A"].tolist() == [0.0, 7.0, 7.0]
    assert block.samples["p_B"].tolist() == [1.0, 1.0, 1.0]
    assert plant.send("DDATA", SparkplugMetric("p_B", 9.0, 10), at=1060).samples["p_A"].tolist() == [7.0]


def test_arrays_of_a_slow_channel_are_no_samples():
    plant = Plant()
    plant.born(*births())

    def sent(*values: float, at: int, size: int = 3) -> Any:
        x = [SparkplugMetric("x", np.ones(size), DOUBLES, timestamp=1000)] if size else []
        oil = [SparkplugMetric("T_oil", np.array(values), DOUBLES, timestamp=at, unit="K")] if values else []
        block = plant.send("DDATA", *x, *oil)
        return block and (len(block.samples), block.samples["T_oil"].tolist())

    assert sent(20.0, 21.0, 22.0, at=1000) == (3, [20.0, 21.0, 22.0])
    assert sent(at=1000) == (3, [22.0] * 3)  # the last value holds
    assert sent(23.0, at=1000) == (3, [23.0] * 3)
    assert sent(24.0, 25.0, at=1000, size=0) is None
    assert sent(at=1000) == (3, [25.0] * 3)
    assert sent(26.0, 27.0, at=990) == (3, [27.0] * 3)


def test_a_node_may_be_the_actuator_itself():
    plant = Plant(device=None)
    number = SparkplugMetric("bdSeq", 1, sparkplug.INT64)
    assert plant.send("NBIRTH", number, *births()) is None
    block = plant.send("NDATA", *arrays(HEALTHY.samples(slice(0, 5)), 40))
    assert (block.actuator, len(block.samples)) == ("press 1", 5)


def test_a_missing_number_asks_for_a_birth_and_aliases_wait_for_it(monkeypatch):
    part = arrays(HEALTHY.samples(slice(0, 5)), 40)
    by_alias = [SparkplugMetric(None, metric.value, DOUBLES, alias=k, timestamp=40) for k, metric in enumerate(part)]
    plant = Plant()
    assert plant.refused("DDATA", *part) == UNBORN  # the host has just begun
    assert len(plant.asked) == 1
    plant.born(*births())
    for _ in range(300):  # the numbers go round
        assert plant.send("DDATA", *by_alias) is not None
    assert plant.send("DDATA", *part, skip=1) is not None  # names are what they are
    assert plant.refused("DDATA", *by_alias) == OUT_OF_SEQUENCE
    assert len(plant.asked) == 1  # it was asked a moment ago
    now = time.monotonic()
    monkeypatch.setattr(sparkplug_host.time, "monotonic", lambda: now + 60.0)
    assert plant.refused("DDATA", *by_alias, skip=3) == OUT_OF_SEQUENCE
    assert len(plant.asked) == 2
    assert plant.counted == {GAPS: 2}
    plant.born(*births(), number=2)
    assert plant.send("DDATA", *by_alias) is not None
    assert plant.refused("NDEATH", SparkplugMetric("bdSeq", 1, sparkplug.INT64)) == STALE_DEATH
    assert plant.send("DDATA", *by_alias) is not None
    assert plant.send("NDEATH", SparkplugMetric("bdSeq", 2, sparkplug.INT64)) is None
    assert plant.refused("DDATA", *part) == UNBORN
    plant.born(*births())
    assert plant.send("DDEATH") is None
    assert plant.refused("DDATA", *part) == UNBORN


X3 = SparkplugMetric("x", np.ones(3), DOUBLES, timestamp=1)
X1 = SparkplugMetric("x", 1.0, 10, timestamp=1)


@pytest.mark.parametrize(
    ("metrics", "reason"),
    [
        ([SparkplugMetric("x", np.ones(3), DOUBLES)], NO_CLOCK),
        ([X3, SparkplugMetric("p_A", np.ones(2), DOUBLES, timestamp=1)], NO_SAMPLES),
        ([SparkplugMetric("x", np.ones(0), DOUBLES, timestamp=1)], NO_SAMPLES),
        ([X3, SparkplugMetric("p_A", "a", 12, timestamp=1)], NO_SAMPLES),
        ([SparkplugMetric("x", "1, 2", 12, timestamp=1)], NO_SAMPLES),
        ([SparkplugMetric("x", True, sparkplug.BOOLEAN, timestamp=1)], NO_SAMPLES),
        ([X3, SparkplugMetric("T_oil", np.ones(0), DOUBLES, timestamp=1)], NO_SAMPLES),
        ([SparkplugMetric("x", 1.0, 10, timestamp=1, unit="bar")], WRONG_UNITS),
        ([SparkplugMetric("x", np.ones(3), DOUBLES, timestamp=1, unit="bar")], WRONG_UNITS),
        ([SparkplugMetric("rate", -1.0, 10), X1], NO_CLOCK),
        ([SparkplugMetric("rate", "a", 12), X1], NO_CLOCK),
        ([SparkplugMetric("rate", True, sparkplug.BOOLEAN), X1], NO_CLOCK),
    ],
)
def test_data_without_sound_samples_are_refused(metrics, reason):
    plant = Plant(rate=None)
    plant.born(*births(), SparkplugMetric("rate", 50.0, 10))
    assert plant.refused("DDATA", *metrics, at=None) == reason


def test_topics_of_others_are_refused():
    plant = Plant()
    wire = encode_payload(SparkplugPayload(1, (), 0))
    for topic in ("spBv1.0/plant/NBIRTH/other", "spBv1.0/plant/DDATA/edge", "spBv1.0/plant/STATE", "spBv1.0/a/b/c/d/e"):
        with pytest.raises(RefusedMessage) as raised:
            plant.host.receive(topic, wire)
        assert raised.value.reason == WRONG_ACTUATOR
    assert plant.host.receive("spBv1.0/plant/NCMD/edge", wire) is None
    assert plant.host.topics == ["spBv1.0/plant/+/edge/#"]
    plant.host.request_all_births()
    assert len(plant.asked) == 1


@pytest.mark.parametrize("rate", few([123.0, 1000.0, 400.0, 500.0, 2000.0]))
@pytest.mark.parametrize("rounded", [np.floor, np.round])
def test_times_in_whole_milliseconds_make_no_gap(rate, rounded):
    """The node's clock is 20 ppm faster than its rate says, and its blocks have any length."""
    plant, random = Plant(rate=rate), np.random.default_rng(int(rate))
    plant.born(*births())
    start, steps = 1.7e9 + 0.0004, []
    last = None
    for _ in range(150):
        size = int(random.integers(1, 700))
        metrics = [SparkplugMetric(name, np.ones(size), DOUBLES) for name in CHANNELS]
        t = plant.send("DDATA", *metrics, at=int(rounded(1000.0 * start))).samples.t
        assert abs(t[0] - start) < 0.0035
        if last is not None:
            steps.append((t[0] - last) * rate)
        start, last = start + size / rate / 1.00002, t[-1]
    assert 0.5 < min(steps) <= max(steps) < 1.5  # what the stream takes for the next sample


@pytest.mark.parametrize("count", [300, pytest.param(20_000, marks=pytest.mark.slow)])
def test_mutated_payloads_are_blocks_or_refused(count):
    random, plant = np.random.default_rng(count), Plant()
    plant.born(*births())
    valid = encode_payload(SparkplugPayload(1, tuple(arrays(HEALTHY.samples(slice(0, 20)), 40)), 2))
    birth = encode_payload(SparkplugPayload(1, tuple(births()), 1))
    outcomes: Counter[str] = Counter()
    for _ in range(count):
        kind = ("DDATA", "DDATA", "DBIRTH", "NBIRTH", "NDEATH")[random.integers(5)]
        data = bytearray(birth if kind.endswith("BIRTH") else valid)
        for _ in range(random.integers(0, 4)):
            at = int(random.integers(len(data)))
            if random.integers(2):
                data[at] = int(random.integers(256))
            else:
                data[at : at + int(random.integers(20))] = random.bytes(int(random.integers(20)))
        topic = sparkplug.topic_of("plant", kind, "edge", "press" if kind[0] == "D" else None)
        try:
            block = plant.host.receive(topic, bytes(data))
            outcomes["nothing" if block is None else "block"] += 1
        except RefusedMessage as error:
            assert len(str(error)) < 400
            outcomes[error.reason] += 1
    assert outcomes[UNREADABLE] > count // 20
    assert outcomes["block"] > count // 200
    assert sum(len(node.births) for node in plant.host._nodes.values()) <= 1
