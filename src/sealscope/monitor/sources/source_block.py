"""A block of samples of one actuator with its identity, and its form as a message of JSON or CBOR."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sealscope.errors import InputError
from sealscope.monitor.stream.joining import CHANNELS
from sealscope.recordings.recording import CHANNEL_UNITS, Recording
from sealscope.storage.plain_values import parse_json
from sealscope.units import to_si

if TYPE_CHECKING:
    from sealscope.monitor.memory.store import MonitorStore
    from sealscope.monitor.settings import MonitorSettings

#: Largest message [bytes], and most samples of a channel in it.
LARGEST, MOST_SAMPLES = 16_000_000, 1_000_000
_KNOWN = {"actuator", "t", "rate", "units", "id", *CHANNELS}


class BlockReceiver(Protocol):
    """What a source hands its blocks to, as a service is."""

    stopping: threading.Event
    store: MonitorStore
    settings: MonitorSettings

    def hand(self, block: SourceBlock | InputError) -> None:
        """Take a block, or the error of a message that holds none."""


def nothing() -> None:
    """Do nothing."""


@dataclass(frozen=True, eq=False)
class SourceBlock:
    """Samples of one actuator.

    `identity`: what tells the block from every other of the actuator, also after a restart; `samples`: None where there
    are none to take, only the identity to keep; `follows`: False where the clock begins anew; `done`: called when the
    block is stored.
    """

    actuator: str
    identity: str
    samples: Recording | None
    follows: bool = True
    done: Callable[[], None] = nothing


def decoded(payload: bytes, actuator: str | None = None, done: Callable[[], None] = nothing) -> SourceBlock:
    """Return the block of a message, JSON where it begins with ``{``, else CBOR.

    Its mapping has ``t``, the clock of the first sample [s], ``rate`` [Hz], and a list of numbers for each channel,
    null where one is missing; ``units`` names those that are not SI; ``actuator`` where the source does not say; ``id``
    where the contents are not the identity. Raises InputError for anything else.
    """
    if len(payload) > LARGEST:
        raise InputError(f"a message must have at most {LARGEST} bytes, got {len(payload)}")
    values = _mapping(payload)
    unknown = sorted(str(name)[:40] for name in values if name not in _KNOWN)
    if unknown:
        raise InputError(f"a message must hold {', '.join(sorted(_KNOWN))}, got {unknown[0]!r}")
    name = values.get("actuator", actuator)
    if not isinstance(name, str) or (actuator is not None and name != actuator):
        raise InputError(f"a message must name its actuator, got {str(name)[:40]!r}")
    units = values.get("units", {})
    if not isinstance(units, Mapping):
        raise InputError("a message's units must be a mapping")
    t, rate = _number(values, "t"), _number(values, "rate")
    channels = {channel: _channel(values[channel], channel, units) for channel in CHANNELS if channel in values}
    sizes = {values.size for values in channels.values()}
    if len(sizes) != 1 or not 0 < min(sizes) <= MOST_SAMPLES or not rate > 0:
        raise InputError(f"channels must have equally many samples, 1 to {MOST_SAMPLES}, and a rate > 0 Hz")
    samples = Recording(
        t + np.arange(sizes.pop()) / rate, channels, {channel: CHANNEL_UNITS[channel] for channel in channels}, rate
    )
    identity = values.get("id") or blake2b(payload, digest_size=16).hexdigest()
    return SourceBlock(name, str(identity)[:100], samples, done=done)


def _mapping(payload: bytes) -> Mapping[str, Any]:
    try:
        if payload.lstrip()[:1] == b"{":
            values = parse_json(payload)
        else:
            import cbor2

            values = cbor2.loads(payload)
    except ImportError:
        raise InputError("a message must be JSON, or cbor2 installed: pip install 'sealscope[mqtt]'") from None
    except Exception as error:  # a damaged message makes the libraries raise whatever they like
        raise InputError(f"a message must be JSON or CBOR: {' '.join(str(error).split())[:80]}") from None
    if not isinstance(values, Mapping):
        raise InputError(f"a message must be a mapping, got {type(values).__name__}")
    return values


def _number(values: Mapping[str, Any], name: str) -> float:
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise InputError(f"{name} must be a number, got {str(value)[:40]!r}")
    return float(value)


def _channel(values: Any, name: str, units: Mapping[str, Any]) -> np.ndarray[Any, Any]:
    if not isinstance(values, (list, tuple)):
        raise InputError(f"channel {name} must be a list of numbers, got {type(values).__name__}")
    try:
        array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"channel {name} must be a list of numbers") from None
    if array.ndim != 1:
        raise InputError(f"channel {name} must be a list of numbers, got a list of lists")
    unit = units.get(name)
    return array if unit is None else np.asarray(to_si(array, str(unit)[:40], CHANNEL_UNITS[name], name=name))
