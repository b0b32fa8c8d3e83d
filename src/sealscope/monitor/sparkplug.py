"""Payloads and topics of Sparkplug B; a payload is a protobuf message of named values with types and times.

The field numbers are those of Eclipse Sparkplug 3.0, chapter 6. Data sets, templates, files and metadata are ignored.
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
#: Names of metrics that Sparkplug reserves.
BIRTH_SEQUENCE, REBIRTH = "bdSeq", "Node Control/Rebirth"
#: Data types of the values that are written.
INT64, UINT32, UINT64, DOUBLE, BOOLEAN, STRING = 4, 7, 8, 10, 11, 12
#: Number of bits of the signed integer data types; they are transmitted in two's complement.
_SIGNED = {1: 8, 2: 16, 3: 32, 4: 64}
#: NumPy data types of the data types that are arrays of numbers.
_ARRAYS = {22: "<i1", 23: "<i2", 24: "<i4", 25: "<i8", 26: "<u1", 27: "<u2", 28: "<u4", 29: "<u8", 30: "<f4", 31: "<f8"}
#: Field of the protobuf message that holds a value, by data type.
_FIELD_OF_TYPE = {
    **dict.fromkeys((1, 2, 3, 5, 6, 7), "int_value"),
    **dict.fromkeys((4, 8, 13), "long_value"),
    **{9: "float_value", 10: "double_value", 11: "boolean_value"},
    **dict.fromkeys((12, 14, 15), "string_value"),
}
#: Metrics of a message, at most.
_MAX_METRICS = 100_000
#: Properties that state the unit of a metric, and the quality of its value.
_UNIT, _QUALITY = "engUnit", "Quality"
#: Data type and good values of the quality: 192, or 193 to 255 as in OPC; 0 is bad, 500 is stale.
_INT32, _GOOD = 3, range(192, 256)


@dataclass(frozen=True)
class SparkplugMetric:
    """A metric of Sparkplug B, a named value."""

    name: str | None  # None if the message has the number `alias` instead
    value: Any  # a number, text or bool, an array (n,) of numbers, or None for null
    datatype: int = 0  # number of its Sparkplug type, 0 if only the birth message of its sender states it
    alias: int | None = None
    timestamp: int | None = None  # [ms since 1970]
    unit: str | None = None  # its property `engUnit`
    is_historical: bool = False  # True if the value was stored for a while, and is not the present one
    quality: int | None = None  # its property `Quality`, None if it states none, which is good

    @property
    def is_good(self) -> bool:
        """True unless the sender states that the quality of the value is not good."""
        return self.quality is None or self.quality in _GOOD

    def as_missing(self) -> SparkplugMetric:
        """Replace the value by a missing one: NaN for each number of an array, else None."""
        value = np.full(self.value.shape, np.nan) if isinstance(self.value, np.ndarray) else None
        return replace(self, value=value)

    def with_datatype(self, datatype: int) -> SparkplugMetric:
        """Convert the value from its transmitted form to a Sparkplug data type; return the changed metric.

        The bytes of an array become numbers (n,), or None if the type is not supported. Raises ValueError if the bytes
        are not a whole number of values.
        """
        value = self.value
        if isinstance(value, bytes):
            dtype = _ARRAYS.get(datatype)
            if dtype is not None and len(value) % np.dtype(dtype).itemsize:
                raise ValueError(f"an array of type {datatype} must have whole values, got {len(value)} bytes")
            value = None if dtype is None else np.frombuffer(value, dtype=dtype).astype(np.float64)
        elif datatype in _SIGNED and isinstance(value, int):
            half = 1 << (_SIGNED[datatype] - 1)
            value = (value + half) % (2 * half) - half  # from two's complement
        return replace(self, value=value, datatype=datatype)


@dataclass(frozen=True)
class SparkplugPayload:
    """A message of Sparkplug B, sent at `timestamp` [ms since 1970], with sequence number `seq`, 0 to 255, or None."""

    timestamp: int | None
    metrics: tuple[SparkplugMetric, ...]
    seq: int | None = None

    def find_metric(self, name: str) -> SparkplugMetric | None:
        """Find the first metric called `name`; return None if there is none."""
        return next((metric for metric in self.metrics if metric.name == name), None)


@cache
def payload_class() -> Any:
    """Build the protobuf class of payloads from `sparkplug.toml`; raise MissingExtra if protobuf is not installed.

    In this file each field has a number, a name, a type, and perhaps roles: ``R`` (repeated), ``V`` (holds the value).
    """
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise MissingExtra("Sparkplug B needs protobuf: pip install 'sealscope[sparkplug]'") from None
    schema = tomllib.loads((files("sealscope.monitor") / "sparkplug.toml").read_text("utf-8"))
    file = descriptor_pb2.FileDescriptorProto(name="sealscope/sparkplug_b.proto", package="sparkplug", syntax="proto2")
    constants = descriptor_pb2.FieldDescriptorProto
    for message, fields in schema.items():
        message_type = file.message_type.add(name=message)
        for number, name, kind, *roles in map(str.split, fields.split(",")):
            label = constants.LABEL_REPEATED if "R" in roles else constants.LABEL_OPTIONAL
            field = message_type.field.add(name=name, number=int(number), label=label)
            if kind in schema:
                field.type, field.type_name = constants.TYPE_MESSAGE, f".sparkplug.{kind}"
            else:
                field.type = constants.Type.Value(f"TYPE_{kind}")
            if "V" in roles:
                if not message_type.oneof_decl:
                    message_type.oneof_decl.add(name="value")
                field.oneof_index = 0  # the only group of alternatives
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("sparkplug.Payload"))


def encode_payload(payload: SparkplugPayload) -> bytes:
    """Encode a payload as bytes; the data type of each metric must be in `_FIELD_OF_TYPE` or `_ARRAYS`."""
    message = payload_class()(timestamp=payload.timestamp, seq=payload.seq)  # protobuf omits fields that are None
    for metric in payload.metrics:
        fields: dict[str, Any] = {name: getattr(metric, name) for name in ("name", "alias", "timestamp", "datatype")}
        value, datatype = metric.value, metric.datatype
        if datatype in _SIGNED and value is not None:  # to two's complement, in the 32 or 64 bits of the field
            value %= 1 << max(32, _SIGNED[datatype])
        if value is None:
            fields["is_null"] = True
        elif datatype in _ARRAYS:
            fields["bytes_value"] = np.asarray(value, dtype=_ARRAYS[datatype]).tobytes()
        else:
            fields[_FIELD_OF_TYPE[datatype]] = value
        if metric.is_historical:
            fields["is_historical"] = True
        properties: dict[str, dict[str, Any]] = {}
        if metric.unit is not None:
            properties[_UNIT] = {"type": STRING, "string_value": metric.unit}
        if metric.quality is not None:
            properties[_QUALITY] = {"type": _INT32, "int_value": metric.quality}
        if properties:
            fields["properties"] = {"keys": [*properties], "values": [*properties.values()]}
        message.metrics.add(**fields)
    return bytes(message.SerializeToString())


def decode_payload(data: bytes) -> SparkplugPayload:
    """Decode a payload from bytes; raise ValueError, with a message of one line, if they are invalid.

    The value of a metric without a type is left as transmitted (`SparkplugMetric.with_datatype`).
    """
    from google.protobuf.message import DecodeError

    message = payload_class()()
    try:
        message.ParseFromString(data)
        if len(message.metrics) > _MAX_METRICS:
            raise ValueError(f"got {len(message.metrics)} metrics")
        timestamp, seq = _get_fields(message, "timestamp", "seq")
        if seq is not None and seq > 255:
            raise ValueError(f"seq must be 0 to 255, got {seq}")
        return SparkplugPayload(timestamp, tuple(map(_decode_metric, message.metrics)), seq)
    except (DecodeError, ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise ValueError(f"it must be a payload of Sparkplug B: {' '.join(str(error).split())[:80]}") from None


def _get_fields(message: Any, *names: str) -> list[Any]:
    """List the fields `names` of a protobuf message, None for one that is not set."""
    return [getattr(message, name) if message.HasField(name) else None for name in names]


def _decode_metric(entry: Any) -> SparkplugMetric:
    """Convert a metric from its protobuf message; raise ValueError if a text in it is damaged."""
    field = None if entry.is_null else entry.WhichOneof("value")
    value = None if field is None else getattr(entry, field)
    if not isinstance(entry.name, str) or (field == "string_value" and not isinstance(value, str)):
        raise ValueError("a text must be UTF-8")  # protobuf returns a damaged text as bytes
    # a sender may state fewer values than keys
    properties = [*zip(entry.properties.keys, entry.properties.values, strict=False)]
    unit = next((str(value.string_value)[:40] for key, value in properties if key == _UNIT), None)
    qualities = (_decode_quality(value) for key, value in properties if str(key).casefold() == _QUALITY.casefold())
    name, alias, timestamp = _get_fields(entry, "name", "alias", "timestamp")
    metric = SparkplugMetric(
        name,
        value,
        alias=alias,
        timestamp=timestamp,
        unit=unit or None,
        is_historical=bool(entry.is_historical),
        quality=next(qualities, None),
    )
    return metric.with_datatype(int(entry.datatype)) if entry.datatype else metric


def _decode_quality(value: Any) -> int | None:
    """Convert the property `Quality` to its number; None if it is null, 0, which is bad, if it is no number."""
    field = None if value.is_null else value.WhichOneof("value")
    quality = None if field is None else getattr(value, field)
    if quality is None:
        return None
    return int(quality) if isinstance(quality, (int, float)) and abs(quality) < np.inf else 0


def topic_of(group: str, kind: str, node: str, device: str | None = None) -> str:
    """Build the MQTT topic of a Sparkplug message of a `kind` such as ``NBIRTH``, of a node or one of its devices."""
    return "/".join([NAMESPACE, group, kind, node, *([] if device is None else [device])])
