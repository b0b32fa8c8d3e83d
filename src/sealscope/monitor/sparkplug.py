"""Sparkplug B payloads: named values with types and times, as protobuf messages; topics and sequence numbers.

Field numbers: Eclipse Sparkplug 3.0, chapter 6. Data sets, templates, files and metadata are passed over.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
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
}
#: Metrics of a message, at most.
_MOST_METRICS = 100_000
#: Property that names the unit of a metric.
_UNIT = "engUnit"


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

    def typed(self, datatype: int) -> SparkplugMetric:
        """Return the metric with its value converted from a data type; None for types without use here."""
        value = self.value
        if isinstance(value, bytes):
            kind = _ARRAYS.get(datatype)
            if kind is not None and len(value) % np.dtype(kind).itemsize:
                raise ValueError(f"an array of type {datatype} must have whole values, got {len(value)} bytes")
            value = None if kind is None else np.frombuffer(value, dtype=kind).astype(np.float64)
        elif datatype in _SIGNED and isinstance(value, int):
            half = 1 << (_SIGNED[datatype] - 1)
            value = (value + half) % (2 * half) - half
        return replace(self, value=value, datatype=datatype)


@dataclass(frozen=True)
class SparkplugPayload:
    """A message: when it was sent [ms since 1970], its metrics, and its sequence number of 0 to 255."""

    timestamp: int | None
    metrics: tuple[SparkplugMetric, ...]
    seq: int | None = None

    def find_metric(self, name: str) -> SparkplugMetric | None:
        """Return the first metric of a name, None where there is none."""
        return next((metric for metric in self.metrics if metric.name == name), None)


@cache
def payload_class() -> Any:
    """Return the class of payloads in protobuf; raises MissingExtra where that library is not installed."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise MissingExtra("Sparkplug B needs protobuf: pip install 'sealscope[sparkplug]'") from None
    schema = tomllib.loads((files("sealscope.monitor") / "sparkplug.toml").read_text("utf-8"))
    file = descriptor_pb2.FileDescriptorProto(name="sealscope/sparkplug_b.proto", package="sparkplug", syntax="proto2")
    kinds = descriptor_pb2.FieldDescriptorProto
    for message, fields in schema.items():
        entry = file.message_type.add(name=message)
        for number, name, kind, *roles in map(str.split, fields.split(",")):
            label = kinds.LABEL_REPEATED if "R" in roles else kinds.LABEL_OPTIONAL
            field = entry.field.add(name=name, number=int(number), label=label)
            if kind in schema:
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


def encoded(payload: SparkplugPayload) -> bytes:
    """Return the bytes of a payload; each metric has one of the types named above, or an array of doubles (31)."""
    message = payload_class()(timestamp=payload.timestamp, seq=payload.seq)  # protobuf leaves out what is None
    for metric in payload.metrics:
        fields: dict[str, Any] = {name: getattr(metric, name) for name in ("name", "alias", "timestamp", "datatype")}
        value, kind = metric.value, metric.datatype
        if value is None:
            fields["is_null"] = True
        elif kind in _ARRAYS:
            fields["bytes_value"] = np.asarray(value, dtype=_ARRAYS[kind]).tobytes()
        else:
            fields[_FIELD_OF_TYPE[kind]] = value % (1 << max(32, _SIGNED[kind])) if kind in _SIGNED else value
        if metric.unit is not None:
            fields["properties"] = {"keys": [_UNIT], "values": [{"type": STRING, "string_value": metric.unit}]}
        message.metrics.add(**fields)
    return bytes(message.SerializeToString())


def decoded_payload(data: bytes) -> SparkplugPayload:
    """Decode a payload from bytes. Raise ValueError of one line if they hold none.

    A value stays as its field has it where the metric states no type: `SparkplugMetric.typed` gives it its meaning.
    """
    from google.protobuf.message import DecodeError

    message = payload_class()()
    try:
        message.ParseFromString(data)
        if len(message.metrics) > _MOST_METRICS:
            raise ValueError(f"got {len(message.metrics)} metrics")
        timestamp, seq = _get_fields(message, "timestamp", "seq")
        if seq is not None and seq > 255:
            raise ValueError(f"seq must be 0 to 255, got {seq}")
        return SparkplugPayload(timestamp, tuple(map(_metric, message.metrics)), seq)
    except (DecodeError, ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise ValueError(f"it must be a payload of Sparkplug B: {' '.join(str(error).split())[:80]}") from None


def _get_fields(message: Any, *names: str) -> list[Any]:
    return [getattr(message, name) if message.HasField(name) else None for name in names]


def _metric(entry: Any) -> SparkplugMetric:
    field = None if entry.is_null else entry.WhichOneof("value")
    value = None if field is None else getattr(entry, field)
    if not isinstance(entry.name, str) or (field == "string_value" and not isinstance(value, str)):
        raise ValueError("a text must be UTF-8")  # damaged text is returned as bytes
    properties = zip(entry.properties.keys, entry.properties.values, strict=False)
    unit = next((str(value.string_value)[:40] for key, value in properties if key == _UNIT), None)
    name, alias, timestamp = _get_fields(entry, "name", "alias", "timestamp")
    metric = SparkplugMetric(name, value, 0, alias, timestamp, unit or None)
    return metric.typed(int(entry.datatype)) if entry.datatype else metric


def topic_of(group: str, kind: str, node: str, device: str | None = None) -> str:
    """Return the topic of a message of a kind, such as ``NBIRTH``."""
    return "/".join([NAMESPACE, group, kind, node, *([] if device is None else [device])])
