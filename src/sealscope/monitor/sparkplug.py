"""Sparkplug B payloads: named values with types and times, as protobuf messages; topics and sequence numbers.

The field numbers are those of the published schema (Eclipse Sparkplug 3.0, chapter 6, payloads). What a monitor has no
use for (data sets, templates, files, metadata) is passed over when it is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from sealscope.errors import MissingExtra

#: First part of every topic.
NAMESPACE = "spBv1.0"
#: Metrics with a meaning of their own.
BIRTH_SEQUENCE, REBIRTH = "bdSeq", "Node Control/Rebirth"
#: Types of values that are written.
INT64, UINT32, UINT64, DOUBLE, BOOLEAN, STRING = 4, 7, 8, 10, 11, 12
#: Types that are whole numbers with a sign, by their bits; they are kept in two's complement.
_SIGNED = {1: 8, 2: 16, 3: 32, 4: 64}
#: Types of arrays that are numbers -> how they are kept in bytes.
_ARRAYS = {22: "<i1", 23: "<i2", 24: "<i4", 25: "<i8", 26: "<u1", 27: "<u2", 28: "<u4", 29: "<u8", 30: "<f4", 31: "<f8"}
_FIELD_OF_TYPE = {
    **dict.fromkeys((1, 2, 3, 5, 6, 7), "int_value"),
    **dict.fromkeys((4, 8, 13), "long_value"),
    **{9: "float_value", 10: "double_value", 11: "boolean_value"},
    **dict.fromkeys((12, 14, 15), "string_value"),
    **dict.fromkeys(_ARRAYS, "bytes_value"),
}
#: Metrics of a message, at most.
_MOST_METRICS = 100_000
#: Property that names the unit of a metric.
_UNIT = "engUnit"
#: Message -> its fields: number, name, type (of `FieldDescriptorProto`, or another message), R repeated or V a value.
_SCHEMA = {
    "PropertyValue": """1 type UINT32, 2 is_null BOOL, 3 int_value UINT32 V, 4 long_value UINT64 V,
        5 float_value FLOAT V, 6 double_value DOUBLE V, 7 boolean_value BOOL V, 8 string_value STRING V""",
    "PropertySet": "1 keys STRING R, 2 values PropertyValue R",
    "Metric": """1 name STRING, 2 alias UINT64, 3 timestamp UINT64, 4 datatype UINT32, 5 is_historical BOOL,
        6 is_transient BOOL, 7 is_null BOOL, 9 properties PropertySet, 10 int_value UINT32 V, 11 long_value UINT64 V,
        12 float_value FLOAT V, 13 double_value DOUBLE V, 14 boolean_value BOOL V, 15 string_value STRING V,
        16 bytes_value BYTES V""",
    "Payload": "1 timestamp UINT64, 2 metrics Metric R, 3 seq UINT64",
}


@dataclass(frozen=True)
class SparkplugMetric:
    """A named value.

    `name`: None where the birth's alias stands for it; `value`: a number, text or truth value, an array (n,) of
    numbers, None for null; `datatype`: number of the type, 0 where the birth states it; `timestamp`: [ms] since 1970;
    `unit`: property `engUnit`, None where there is none.
    """

    name: str | None
    value: Any
    datatype: int = 0
    alias: int | None = None
    timestamp: int | None = None
    unit: str | None = None


@dataclass(frozen=True)
class SparkplugPayload:
    """A message: when it was sent [ms since 1970], its metrics, and its sequence number of 0 to 255."""

    timestamp: int | None
    metrics: tuple[SparkplugMetric, ...]
    seq: int | None


@cache
def _payload_class() -> Any:
    """Return the class of payloads, made from the schema in a pool of its own."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise MissingExtra("Sparkplug B needs protobuf: pip install 'sealscope[sparkplug]'") from None
    file = descriptor_pb2.FileDescriptorProto(name="sealscope/sparkplug_b.proto", package="sparkplug", syntax="proto2")
    kinds = descriptor_pb2.FieldDescriptorProto
    for message, fields in _SCHEMA.items():
        entry = file.message_type.add(name=message)
        for number, name, kind, *roles in map(str.split, fields.split(",")):
            label = kinds.LABEL_REPEATED if "R" in roles else kinds.LABEL_OPTIONAL
            field = entry.field.add(name=name, number=int(number), label=label)
            if kind in _SCHEMA:
                field.type, field.type_name = kinds.TYPE_MESSAGE, f".sparkplug.{kind}"
            else:
                field.type = kinds.Type.Value(f"TYPE_{kind}")
            if "V" in roles:
                if not entry.oneof_decl:
                    entry.oneof_decl.add(name="value")
                field.oneof_index = 0
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("sparkplug.Payload"))


def check_sparkplug() -> None:
    """Raise MissingExtra where the library for Sparkplug B is not installed."""
    _payload_class()


def encoded(payload: SparkplugPayload) -> bytes:
    """Return the bytes of a payload; each metric has one of the types named above, or an array of doubles (31)."""
    message = _payload_class()()
    if payload.timestamp is not None:
        message.timestamp = payload.timestamp
    if payload.seq is not None:
        message.seq = payload.seq
    for metric in payload.metrics:
        entry = message.metrics.add()
        if metric.name is not None:
            entry.name = metric.name
        if metric.alias is not None:
            entry.alias = metric.alias
        if metric.timestamp is not None:
            entry.timestamp = metric.timestamp
        entry.datatype = metric.datatype
        if metric.unit is not None:
            entry.properties.keys.append(_UNIT)
            entry.properties.values.add(type=STRING, string_value=metric.unit)
        if metric.value is None:
            entry.is_null = True
            continue
        value = metric.value
        if metric.datatype in _ARRAYS:
            value = np.asarray(value, dtype=_ARRAYS[metric.datatype]).tobytes()
        elif metric.datatype in _SIGNED:
            bits = 64 if metric.datatype == INT64 else 32
            value %= 1 << bits
        setattr(entry, _FIELD_OF_TYPE[metric.datatype], value)
    return bytes(message.SerializeToString())


def decoded_payload(data: bytes) -> SparkplugPayload:
    """Return the payload that bytes hold; raises ValueError of one line where they hold none.

    A value stays as its field has it where the metric states no type: `typed` gives it its meaning.
    """
    from google.protobuf.message import DecodeError

    message = _payload_class()()
    try:
        message.ParseFromString(data)
        if len(message.metrics) > _MOST_METRICS:
            raise ValueError(f"got {len(message.metrics)} metrics")
        metrics = tuple(_metric(entry) for entry in message.metrics)
    except (DecodeError, ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise ValueError(f"it must be a payload of Sparkplug B: {' '.join(str(error).split())[:80]}") from None
    seq = int(message.seq) if message.HasField("seq") else None
    if seq is not None and seq > 255:
        raise ValueError(f"seq must be 0 to 255, got {seq}")
    return SparkplugPayload(int(message.timestamp) if message.HasField("timestamp") else None, metrics, seq)


def _metric(entry: Any) -> SparkplugMetric:
    field = None if entry.is_null else entry.WhichOneof("value")
    for text in (entry.name, entry.string_value):
        if not isinstance(text, str):  # as damaged text is returned
            raise ValueError("a text must be UTF-8")
    metric = SparkplugMetric(
        entry.name if entry.HasField("name") else None,
        None if field is None else getattr(entry, field),
        int(entry.datatype),
        int(entry.alias) if entry.HasField("alias") else None,
        int(entry.timestamp) if entry.HasField("timestamp") else None,
        _unit_of(entry.properties) if entry.HasField("properties") else None,
    )
    return typed(metric, metric.datatype) if metric.datatype else metric


def _unit_of(properties: Any) -> str | None:
    for key, value in zip(properties.keys, properties.values, strict=False):
        if key == _UNIT and isinstance(value.string_value, str) and value.HasField("string_value"):
            return value.string_value[:40]
    return None


def typed(metric: SparkplugMetric, datatype: int) -> SparkplugMetric:
    """Return a metric with the value that its field means as a value of a type; None for types that are passed over."""
    value = metric.value
    if isinstance(value, bytes):
        try:
            value = np.frombuffer(value, dtype=_ARRAYS[datatype]).astype(np.float64) if datatype in _ARRAYS else None
        except ValueError:
            raise ValueError(
                f"an array must have whole values of its type {datatype}, got {len(value)} bytes"
            ) from None
    elif datatype in _SIGNED and isinstance(value, int):
        bits = _SIGNED[datatype]
        value %= 1 << bits
        value -= (1 << bits) if value >> (bits - 1) else 0
    return SparkplugMetric(metric.name, value, datatype, metric.alias, metric.timestamp, metric.unit)


def number_of(value: Any) -> float:
    """Return a value as a number, NaN where it is null; raises ValueError for texts and arrays."""
    if value is None:
        return math.nan
    if isinstance(value, (int, float)):
        return float(value)
    raise ValueError(f"a number is needed, got {type(value).__name__}")


def topic_of(group: str, kind: str, node: str, device: str | None = None) -> str:
    """Return the topic of a message of a kind, such as ``NBIRTH``."""
    return "/".join([NAMESPACE, group, kind, node, *([] if device is None else [device])])


def after(seq: int) -> int:
    """Return the sequence number after another one."""
    return (seq + 1) % 256


def named(metrics: Iterable[SparkplugMetric], name: str) -> SparkplugMetric | None:
    """Return the first metric of a name, None where there is none."""
    return next((metric for metric in metrics if metric.name == name), None)
