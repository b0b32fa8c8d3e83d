"""Blocks of samples of an actuator, and how they are decoded from JSON or CBOR messages.

If a message has no valid block, RefusedMessage is raised. It is counted by its reason, one of `REASONS`.
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
    MAX_SAMPLES,
    MessageLimit,
    check_cbor,
    check_json,
    check_json_keys,
    check_keys,
)
from sealscope.monitor.supervisor import describe_error
from sealscope.recordings.channels import CHANNEL_UNITS, SLOW
from sealscope.recordings.recording import Recording
from sealscope.units import to_si

if TYPE_CHECKING:
    from sealscope.monitor.settings import MonitorSettings
    from sealscope.monitor.supervisor import Supervisor
    from sealscope.monitor.verdicts import RecordingVerdict

#: Largest message [bytes].
MAX_MESSAGE_BYTES = 16_000_000
#: NumPy data types of arrays of numbers, by their CBOR tag.
_ARRAY_DTYPES = dict(zip(FLOAT_ARRAYS, (">f4", ">f8", "<f4", "<f8"), strict=True))
#: Types of the samples in a list, of which None is a missing one; texts and bool would become numbers, too.
_SAMPLE_TYPES = {int, float, type(None)}
#: Number of leading bytes of a refused message that are stored.
_N_KEPT_BYTES = 4000
#: Times from here on are no seconds, as no clock counts from so long ago [s]; units of time that may be meant, in parts
#: of a second.
_MAX_TIME_S, TIME_UNITS = 1e11, {"ms": 1e3, "us": 1e6, "ns": 1e9}
_KNOWN_NAMES = {"actuator", "t", "rate", "units", "id", *CHANNELS}


class BlockReceiver(Protocol):
    """The receiver of a source's blocks, usually the service of a monitor.

    `stopping`: event that is set when sources must end; `store`: its database, a MonitorStore.
    """

    stopping: threading.Event
    store: Any
    settings: MonitorSettings
    supervisor: Supervisor

    def submit(self, block: SourceBlock | RefusedMessage) -> None:
        """Queue a block or a refused message for storage; wait while the queue is full."""

    def count(self, reason: str, number: int = 1) -> None:
        """Add `number` to the counter called `reason`, usually the reason why messages or blocks are dropped."""

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Return the last summary of each actuator, by name (`WatchedActuators.summaries`)."""


class RefusedMessage(InputError):  # noqa: N818 (says what happened)
    """Raised if a message or a file does not contain a valid block.

    `reason`: one of `REASONS`; `message`: text of the error; `size`: length of its `contents` [bytes]; `beginning`: its
    first bytes, which are stored; `bytes`: number of these; `done`: function called when they are stored.
    """

    def __init__(
        self, reason: str, message: object, contents: bytes = b"", done: Callable[[], None] = lambda: None
    ) -> None:
        super().__init__(message)
        self.reason, self.done = reason, done
        self.size, self.beginning = len(contents), contents[:_N_KEPT_BYTES]
        self.bytes = len(self.beginning)

    def row(self) -> dict[str, Any]:
        """Build the row for the table of refused messages; characters that a database may refuse are escaped."""
        message = str(self).encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")
        values = {"reason": self.reason, "message": message, "size": self.size, "beginning": self.beginning}
        return {"at": time.time(), **values}


#: Reasons to refuse a message, under which it is counted.
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
def raising_refused_message() -> Iterator[None]:
    """Convert an unexpected error within the context to RefusedMessage: a damaged message must not end the decoder."""
    try:
        yield
    except (RefusedMessage, MissingExtra):
        raise
    except Exception as error:
        raise RefusedMessage(UNFORESEEN, f"a message must raise no error, got {describe_error(error)}") from error


@dataclass(frozen=True, eq=False)
class SourceBlock:
    """A block of samples of one actuator."""

    actuator: str
    identity: str  # text that no other block of the actuator has, even after a restart
    samples: Recording | None  # None if only the identity is to be stored
    follows: bool = True  # False if there is a gap before these samples
    done: Callable[[], None] = lambda: None  # called when the block is stored
    verdict: RecordingVerdict | None = None  # on the samples as a whole recording

    @property
    def bytes(self) -> int:
        """Approximate number of bytes of the samples, 0 if there are none."""
        return 0 if self.samples is None else count_bytes(self.samples)


@raising_refused_message()
def decode_message(
    payload: bytes, actuator: str | None = None, units_of: Mapping[str, Mapping[str, str]] = MappingProxyType({})
) -> SourceBlock:
    """Decode the block of samples in a message, which is JSON if it begins with ``{``, else CBOR.

    The message is a mapping with these entries:

    - ``t``: time of the first sample [s]; ``rate``: sampling rate [Hz];
    - for each channel a list of numbers, with null for a missing sample, or in CBOR a typed array of floats (RFC 8746),
      with NaN for a missing sample. A slow channel (``T_oil``) may be a single number;
    - ``units``: by channel, unless the values are in SI units; ``actuator``: its name, needed if the source does not
      state it; ``id``: identity of the block, by default a digest of the message.

    `actuator`: name that the source states, or None; `units_of`: default units by actuator and channel. Raises
    RefusedMessage if a rule is broken.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        raise RefusedMessage(OVERSIZED, f"a message must have at most {MAX_MESSAGE_BYTES} bytes, got {len(payload)}")
    values = _parse_mapping(payload)
    unknown = sorted(_abbreviate(name) for name in values if name not in _KNOWN_NAMES)
    if unknown:
        raise RefusedMessage(NO_MAPPING, f"entries must be {', '.join(sorted(_KNOWN_NAMES))}, got {unknown[0]!r}")
    name, units = values.get("actuator", actuator), values.get("units", {})
    if not isinstance(name, str) or (actuator is not None and name != actuator):
        raise RefusedMessage(WRONG_ACTUATOR, f"a message must name its actuator, got {_abbreviate(name)!r}")
    if not isinstance(units, Mapping):
        raise RefusedMessage(WRONG_UNITS, "a message's units must be a mapping")
    t, rate = _parse_number(values, "t"), _parse_number(values, "rate")
    if not rate > 0.0:
        raise RefusedMessage(NO_CLOCK, f"rate must be > 0 Hz, got {rate:g}")
    if abs(t) >= _MAX_TIME_S:
        units_of_time = (f": is t in {unit}?" for unit, parts in TIME_UNITS.items() if abs(t) / parts < _MAX_TIME_S)
        raise RefusedMessage(NO_CLOCK, f"t must be a time in seconds, got {t:.6g}{next(units_of_time, '')}")
    units = {**units_of.get(name, {}), **units}
    channels = {channel: _parse_channel(values[channel], channel, units) for channel in CHANNELS if channel in values}
    sizes = {array.size for channel, array in channels.items() if channel not in SLOW}
    if sizes and max(sizes) > MAX_SAMPLES:
        raise RefusedMessage(OVERSIZED, f"a channel must have at most {MAX_SAMPLES} samples, got {max(sizes)}")
    if len(sizes) != 1 or not min(sizes):
        raise RefusedMessage(NO_SAMPLES, f"channels must have equally many samples, 1 to {MAX_SAMPLES}")
    n_samples = sizes.pop()
    for channel in SLOW & channels.keys():
        if channels[channel].size not in (1, n_samples):
            raise RefusedMessage(NO_SAMPLES, f"channel {channel} must have 1 or {n_samples} samples")
        channels[channel] = np.broadcast_to(channels[channel], n_samples)
    with np.errstate(over="ignore"):  # the stream drops samples with infinite times
        times = t + np.arange(n_samples) / rate
    for array in (times, *channels.values()):  # a Recording does not copy read-only arrays
        array.setflags(write=False)
    samples = Recording(times, channels, {channel: CHANNEL_UNITS[channel] for channel in channels}, rate)
    return SourceBlock(name, _parse_identity(values.get("id")) or compute_digest(payload), samples)


def count_bytes(samples: Recording) -> int:
    """Compute the approximate number of bytes of a recording's samples and times."""
    return 8 * len(samples) * (1 + len(samples.channels))


def compute_digest(payload: bytes) -> str:
    """Compute the hash (hex) of the contents of a message, which serves as its identity."""
    return blake2b(payload, digest_size=16).hexdigest()


def _parse_identity(value: Any) -> str:
    """Convert the `id` of a message to text, "" for None; raise RefusedMessage if a database cannot store it."""
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        # NO_CLOCK also stands for an invalid identity
        raise RefusedMessage(NO_CLOCK, f"id must be a text or a whole number, got {type(value).__name__}")
    if isinstance(value, int) and value.bit_length() > 64:
        raise RefusedMessage(NO_CLOCK, "a whole number as id must have at most 64 bits")
    identity = str(value)
    if len(identity) > 100 or not identity.isprintable():
        raise RefusedMessage(NO_CLOCK, f"id must have at most 100 letters that can be printed, got {identity[:40]!r}")
    return identity


def _abbreviate(value: Any) -> str:
    """Format a value for an error message: a text or number in at most 40 characters, else the name of its type."""
    try:
        return str(value)[:40] if isinstance(value, (str, int, float, type(None))) else type(value).__name__
    except ValueError:  # CBOR integers may exceed Python's limit of digits
        return type(value).__name__


def _parse_mapping(payload: bytes) -> Mapping[str, Any]:
    """Parse a JSON or CBOR message to a mapping; raise RefusedMessage if it is invalid or exceeds `message_limits`."""
    try:
        if payload.lstrip()[:1] == b"{":
            import orjson

            n_colons = check_json(payload)  # a decoder drops repeated keys: the count reveals them
            values = orjson.loads(payload)
            check_json_keys(values, payload, n_colons)
        else:
            import cbor2

            n_pairs = check_cbor(payload)  # as `n_colons`
            values = cbor2.loads(payload)
            check_keys(values, n_pairs)
    except ImportError as error:
        needed = f"a message needs {error.name}: pip install 'sealscope[serve,mqtt]'"
        raise RefusedMessage(UNREADABLE, needed) from None
    except MessageLimit as error:
        kind = OVERSIZED if error.oversized else UNREADABLE
        raise RefusedMessage(kind, f"a message must keep its limits: {error}") from None
    except Exception as error:  # damaged messages make the libraries raise errors of any type
        reason = " ".join(str(error).split())[:80]  # one short line
        raise RefusedMessage(UNREADABLE, f"a message must be JSON or CBOR: {reason}") from None
    if not isinstance(values, Mapping):
        raise RefusedMessage(NO_MAPPING, f"a message must be a mapping, got {type(values).__name__}")
    return values


def _parse_number(values: Mapping[str, Any], name: str) -> float:
    """Read the time "t" or the sampling rate "rate" of a message as a finite number, or raise RefusedMessage."""
    value = values.get(name)
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
    except OverflowError:  # CBOR has integers of any size
        number = math.inf
    if not math.isfinite(number):
        raise RefusedMessage(NO_CLOCK, f"{name} must be a number, got {_abbreviate(value)!r}")
    return number


def _parse_channel(values: Any, name: str, units: Mapping[str, Any]) -> np.ndarray[Any, Any]:
    """Convert the list or typed array of a channel to an array (n,) in SI units; raise RefusedMessage if it is neither.

    A slow channel may be a single number. None in a list, a missing sample, becomes NaN; infinite values are refused.
    `units`: unit by channel.
    """
    if name in SLOW and isinstance(values, (int, float)) and not isinstance(values, bool):
        values = [values]
    dtype = _ARRAY_DTYPES.get(getattr(values, "tag", None) or 0)  # None unless `values` is a typed array of CBOR
    try:
        if dtype is not None:
            values = np.frombuffer(values.value, dtype=dtype)
        elif not isinstance(values, (list, tuple)) or not {*map(type, values)} <= _SAMPLE_TYPES:
            raise TypeError
        array = np.array(values, dtype=np.float64)  # None becomes NaN
        if array.ndim != 1 or np.isinf(array).any():
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        rule = f"channel {name} must be a list of finite numbers"
        raise RefusedMessage(NO_SAMPLES, f"{rule}, or a typed array whose bytes divide into its numbers") from None
    return np.asarray(convert_to_si(array, units.get(name), name))


def convert_to_si(values: Any, unit: object, channel: str) -> Any:
    """Convert values of a channel from `unit` (None for SI) to SI; raise RefusedMessage if the unit does not fit."""
    try:
        return values if unit is None else to_si(values, _abbreviate(unit), CHANNEL_UNITS[channel], name=channel)
    except InputError as error:
        raise RefusedMessage(WRONG_UNITS, error) from None
