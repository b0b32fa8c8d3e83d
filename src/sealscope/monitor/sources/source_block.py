"""A block of samples of one actuator with its identity, and its form as a message of JSON or CBOR.

A message that holds no block is a RefusedMessage, whose reason is one of few: messages from outside are counted by it.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sealscope.diagnosis.live.joining import CHANNELS
from sealscope.errors import InputError, MissingExtra
from sealscope.monitor.sources.message_limits import (
    FLOAT_ARRAYS,
    MOST_SAMPLES,
    MessageLimit,
    check_cbor,
    check_json,
    check_json_keys,
    check_keys,
)
from sealscope.monitor.supervisor import place_of
from sealscope.recordings.channels import CHANNEL_UNITS, SLOW
from sealscope.recordings.recording import Recording
from sealscope.units import to_si

if TYPE_CHECKING:
    from sealscope.monitor.settings import MonitorSettings
    from sealscope.monitor.supervisor import Supervisor
    from sealscope.monitor.verdicts import RecordingVerdict

#: Largest message [bytes].
LARGEST = 16_000_000
#: Tags of CBOR for arrays of numbers -> how their bytes are to be read.
_TYPED = dict(zip(FLOAT_ARRAYS, (">f4", ">f8", "<f4", "<f8"), strict=True))
#: Bytes of a refused message that are kept.
_BEGINNING = 4000
_KNOWN = {"actuator", "t", "rate", "units", "id", *CHANNELS}


class BlockReceiver(Protocol):
    """The receiver of a source's blocks, usually a service; `store` is its MonitorStore."""

    stopping: threading.Event
    store: Any
    settings: MonitorSettings
    supervisor: Supervisor

    def hand(self, block: SourceBlock | RefusedMessage) -> None:
        """Take a block, or the error of a message that holds none; may wait."""

    def count(self, reason: str, number: int = 1) -> None:
        """Count something that was dropped."""

    def plain(self) -> dict[str, dict[str, Any]]:
        """Return the present summary of each actuator."""


def nothing() -> None:
    """Do nothing."""


class RefusedMessage(InputError):  # noqa: N818 (says what happened)
    """A message or a file holds no block.

    `reason`: one of `REASONS`; `size` of its `contents`, of which the `beginning` of so many `bytes` is kept; `done`:
    called when that is stored.
    """

    def __init__(self, reason: str, message: object, contents: bytes = b"", done: Callable[[], None] = nothing) -> None:
        super().__init__(message)
        self.reason, self.done = reason, done
        self.size, self.beginning = len(contents), contents[:_BEGINNING]
        self.bytes = len(self.beginning)

    def row(self) -> dict[str, Any]:
        """Return the row for the table of refused messages, with texts for any database."""
        message = str(self).encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")
        values = {"reason": self.reason, "message": message, "size": self.size, "beginning": self.beginning}
        return {"at": time.time(), **values}


#: Why a message holds no block: what it is counted under.
REASONS = (
    OVERSIZED := "oversized messages",
    UNREADABLE := "messages that are no JSON or CBOR",
    NO_MAPPING := "messages that are no mapping of known names",
    NO_CLOCK := "messages without a clock, a rate or a valid identity",
    NO_SAMPLES := "messages whose channels are no lists of numbers of one length",
    WRONG_UNITS := "messages with units of another dimension",
    WRONG_ACTUATOR := "messages without an actuator, or with another one than their topic",
    UNBORN := "Sparkplug messages without a birth",
    OUT_OF_SEQUENCE := "Sparkplug messages out of sequence",
    STALE_DEATH := "Sparkplug deaths of an earlier connection",
    UNFORESEEN := "messages whose decoding raised an error",
    UNENDED := "messages whose decoding was begun twice and did not end",
    UNREADABLE_FILE := "files that could not be read",
)


@contextmanager
def refusing() -> Iterator[None]:
    """Make a RefusedMessage of whatever else decoding raises: a message must end no decoder."""
    try:
        yield
    except (RefusedMessage, MissingExtra):
        raise
    except Exception as error:
        raise RefusedMessage(UNFORESEEN, f"a message must raise no error, got {place_of(error)}") from error


@dataclass(frozen=True, eq=False)
class SourceBlock:
    """Samples of one actuator.

    `identity`: what tells the block from every other of the actuator, also after a restart; `samples`: None where there
    are none to take, only the identity to keep; `follows`: False where the clock begins anew; `done`: called when the
    block is stored; `verdict`: on the whole recording that the samples are, None where it is not judged as such.
    """

    actuator: str
    identity: str
    samples: Recording | None
    follows: bool = True
    done: Callable[[], None] = nothing
    verdict: RecordingVerdict | None = None

    @property
    def bytes(self) -> int:
        """About how many bytes its samples take."""
        return 0 if self.samples is None else bytes_of(self.samples)


@refusing()
def decoded(
    payload: bytes, actuator: str | None = None, units_of: Mapping[str, Mapping[str, str]] = MappingProxyType({})
) -> SourceBlock:
    """Decode the block of a message: JSON if it begins with ``{``, else CBOR.

    Its mapping has ``t``, the clock of the first sample [s], ``rate`` [Hz], and for each channel a list of numbers,
    null where one is missing, or in CBOR a typed array of floats (RFC 8746), NaN where one is missing; a channel that
    changes slowly (``T_oil``) may be a single number; ``units`` names those that are not SI; ``actuator`` where the
    source does not say; ``id`` where the contents are not the identity. `units_of`: units by actuator where a message
    names none.
    Raises RefusedMessage for anything else.
    """
    if len(payload) > LARGEST:
        raise RefusedMessage(OVERSIZED, f"a message must have at most {LARGEST} bytes, got {len(payload)}")
    values = _mapping(payload)
    unknown = sorted(_brief(name) for name in values if name not in _KNOWN)
    if unknown:
        raise RefusedMessage(NO_MAPPING, f"a message must hold {', '.join(sorted(_KNOWN))}, got {unknown[0]!r}")
    name, units = values.get("actuator", actuator), values.get("units", {})
    if not isinstance(name, str) or (actuator is not None and name != actuator):
        raise RefusedMessage(WRONG_ACTUATOR, f"a message must name its actuator, got {_brief(name)!r}")
    if not isinstance(units, Mapping):
        raise RefusedMessage(WRONG_UNITS, "a message's units must be a mapping")
    t, rate = _number(values, "t"), _number(values, "rate")
    if not rate > 0.0:
        raise RefusedMessage(NO_CLOCK, f"rate must be > 0 Hz, got {rate:g}")
    units = {**units_of.get(name, {}), **units}
    channels = {channel: _channel(values[channel], channel, units) for channel in CHANNELS if channel in values}
    sizes = {values.size for channel, values in channels.items() if channel not in SLOW}
    if sizes and max(sizes) > MOST_SAMPLES:
        raise RefusedMessage(OVERSIZED, f"a channel must have at most {MOST_SAMPLES} samples, got {max(sizes)}")
    if len(sizes) != 1 or not min(sizes):
        raise RefusedMessage(NO_SAMPLES, f"channels must have equally many samples, 1 to {MOST_SAMPLES}")
    count = sizes.pop()
    for channel in SLOW & channels.keys():
        if channels[channel].size not in (1, count):
            raise RefusedMessage(NO_SAMPLES, f"channel {channel} must have 1 or {count} samples")
        channels[channel] = np.broadcast_to(channels[channel], count)
    with np.errstate(over="ignore"):  # times beyond floating point are dropped by the stream
        clock = t + np.arange(count) / rate
    for array in (clock, *channels.values()):  # a Recording takes what is read-only without a copy
        array.setflags(write=False)
    samples = Recording(clock, channels, {channel: CHANNEL_UNITS[channel] for channel in channels}, rate)
    return SourceBlock(name, _identity(values.get("id")) or digest_of(payload), samples)


def bytes_of(samples: Recording) -> int:
    """Return about how many bytes samples take."""
    return 8 * len(samples) * (1 + len(samples.channels))


def digest_of(payload: bytes) -> str:
    """Return the digest that identifies contents."""
    return blake2b(payload, digest_size=16).hexdigest()


def _identity(value: Any) -> str:
    """Return the stated identity of a message, "" without one. Refuse one that a database cannot hold."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        raise RefusedMessage(NO_CLOCK, f"id must be a text or a whole number, got {type(value).__name__}")
    if isinstance(value, int) and value.bit_length() > 64:
        raise RefusedMessage(NO_CLOCK, "a whole number as id must have at most 64 bits")
    identity = str(value)
    if len(identity) > 100 or not identity.isprintable():
        raise RefusedMessage(NO_CLOCK, f"id must have at most 100 letters that can be printed, got {identity[:40]!r}")
    return identity


def _brief(value: Any) -> str:
    """Return the beginning of a text or a number as text, of anything else its kind: it may be deep, or endless."""
    try:
        return str(value)[:40] if isinstance(value, (str, int, float, type(None))) else type(value).__name__
    except ValueError:  # CBOR has whole numbers of more digits than Python writes
        return type(value).__name__


def _mapping(payload: bytes) -> Mapping[str, Any]:
    try:
        if payload.lstrip()[:1] == b"{":
            import orjson

            colons = check_json(payload)
            values = orjson.loads(payload)
            check_json_keys(values, payload, colons)
        else:
            import cbor2

            pairs = check_cbor(payload)
            values = cbor2.loads(payload)
            check_keys(values, pairs)
    except ImportError as error:
        needed = f"a message needs {error.name}: pip install 'sealscope[serve,mqtt]'"
        raise RefusedMessage(UNREADABLE, needed) from None
    except MessageLimit as error:
        raise RefusedMessage(
            OVERSIZED if error.oversized else UNREADABLE, f"a message must keep its limits: {error}"
        ) from None
    except Exception as error:  # a damaged message makes the libraries raise whatever they like
        reason = " ".join(str(error).split())[:80]
        raise RefusedMessage(UNREADABLE, f"a message must be JSON or CBOR: {reason}") from None
    if not isinstance(values, Mapping):
        raise RefusedMessage(NO_MAPPING, f"a message must be a mapping, got {type(values).__name__}")
    return values


def _number(values: Mapping[str, Any], name: str) -> float:
    value = values.get(name)
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
    except OverflowError:  # CBOR has whole numbers of any size
        number = math.inf
    if not math.isfinite(number):
        raise RefusedMessage(NO_CLOCK, f"{name} must be a number, got {_brief(value)!r}")
    return number


def _channel(values: Any, name: str, units: Mapping[str, Any]) -> np.ndarray[Any, Any]:
    if name in SLOW and isinstance(values, (int, float)) and not isinstance(values, bool):
        values = [values]
    kind = _TYPED.get(getattr(values, "tag", None) or 0)
    try:
        if kind is not None:
            values = np.frombuffer(values.value, dtype=kind)
        elif not isinstance(values, (list, tuple)):
            raise TypeError
        array = np.array(values, dtype=np.float64)  # None becomes NaN
        if array.ndim != 1 or np.isinf(array).any():
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        rule = f"channel {name} must be a list of finite numbers"
        raise RefusedMessage(NO_SAMPLES, f"{rule}, or an array of whole numbers of its type") from None
    return np.asarray(in_si(array, units.get(name), name))


def in_si(values: Any, unit: object, channel: str) -> Any:
    """Return values of a channel in SI, in which they are without a unit; raises RefusedMessage for a wrong one."""
    try:
        return values if unit is None else to_si(values, _brief(unit), CHANNEL_UNITS[channel], name=channel)
    except InputError as error:
        raise RefusedMessage(WRONG_UNITS, error) from None
