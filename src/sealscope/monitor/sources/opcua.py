"""Read samples from an OPC UA server by subscription, and gather them into blocks.

Each channel of an actuator is a variable of the server. Its value is a number, or an array of samples that
begins at the source timestamp. The server queues the changes of each variable between two publications. Changes are
lost while there is no connection, because OPC UA subscriptions end with their session.

Values without a time stamp are spread over the publication that brought them, if they are as many as were sampled since
the one before. Otherwise, and where the server's queue overflowed or several values have one time stamp, the samples
between are missing. All of this is counted.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import Any

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.monitor.bounded_queue import BoundedQueue
from sealscope.monitor.logged_counts import LoggedCounts
from sealscope.monitor.settings import ActuatorSettings, OpcUaSettings, read_secret
from sealscope.monitor.sources.gathering import ValueGatherer
from sealscope.monitor.sources.message_limits import MAX_SAMPLES
from sealscope.monitor.sources.source_block import (
    BlockReceiver,
    SourceBlock,
    compute_digest,
    convert_to_si,
    count_bytes,
)
from sealscope.monitor.supervisor import OPCUA, PartAway
from sealscope.recordings.channels import SLOW

#: Publications per block.
_PUBLICATIONS = 4
#: Most blocks in the queue, and most bytes of them; further blocks are dropped and counted.
_MAX_QUEUE, _MAX_QUEUE_BYTES = 256, 64_000_000
#: How often the connection is checked [s].
_POLL_S = 0.5
#: Parts of the monitor whose outages tell that values or blocks are dropped.
_VALUES_PART, _QUEUE_PART = "OPC UA values", "OPC UA queue"
#: Least fraction of the samples of a publication that must come without a time stamp to be spread over it.
_WHOLE_PUBLICATION = 0.9
#: Bits of a status code that tell that values were lost in the server's queue: type "data value", and "overflow"
#: (OPC 10000-4, 7.39.1).
_STATUS_TYPE, _DATA_VALUE, _OVERFLOW = 0x0C00, 0x0400, 0x0080
#: Counters.
_NO_ROOM = "blocks of OPC UA that found no room"
_NO_NUMBER = "OPC UA values that are no number"
TOO_MANY = f"OPC UA values of more than {MAX_SAMPLES} samples"
OVERFLOW = "OPC UA values after an overflow of the server's queue"
UNSTAMPED = "OPC UA values without a time stamp"
SAME_STAMP = "OPC UA values with the time stamp of the value before"


def opcua_source(settings: OpcUaSettings) -> Callable[[BlockReceiver], None]:
    """Build a source that submits the values of an OPC UA server as blocks.

    Raises MissingExtra if asyncua is not installed, and InputError if the password cannot be read.
    """
    if find_spec("asyncua") is None:  # before the service starts
        raise MissingExtra("OPC UA needs asyncua: pip install 'sealscope[opcua]'")
    password = read_secret(settings.password_file, "opcua.password_file")
    return lambda service: _OpcUaSession(settings, password, service).run()


@dataclass
class _Unstamped:
    """The values of one channel that a publication brought without a time stamp."""

    values: list[Any] = field(default_factory=list)  # arrays of samples
    arrival: float = -math.inf  # time at which the first one arrived [s since 1970]
    next_start: float = -math.inf  # time of the sample that follows the samples of earlier publications [s since 1970]


@dataclass
class _Stamped:
    """The time stamps of one channel [s since 1970]."""

    t: float = math.nan  # time stamp of the last value
    next_start: float | None = None  # time of the sample that follows it, None before the first value
    lost_since: float | None = None  # time of the sample that follows the last value with another time stamp


class _OpcUaSession:
    """The connection of a service to an OPC UA server, with its subscriptions."""

    def __init__(self, settings: OpcUaSettings, password: str | None, service: BlockReceiver) -> None:
        self._settings, self._password, self._service = settings, password, service
        self._server = service.supervisor.part(OPCUA)
        self._counts = LoggedCounts(service.count)
        self._gatherers: dict[str, ValueGatherer] = {}
        # by actuator and channel
        self._unstamped: dict[tuple[str, str], _Unstamped] = {}
        self._stamped: dict[tuple[str, str], _Stamped] = {}
        self._too_long: set[tuple[str, str]] = set()  # channels whose last value had too many samples
        self._actuators = [actuator for actuator in service.settings.actuator if actuator.nodes]
        for actuator in self._actuators:
            rate = float(actuator.rate or math.nan)  # never None: the settings are checked
            self._gatherers[actuator.name] = ValueGatherer(
                tuple(actuator.nodes), rate, settings.block_s, service.count, name=actuator.name
            )
        self._channels: dict[Any, tuple[ActuatorSettings, str]] = {}  # actuator and channel by node
        self._waiting: BoundedQueue[SourceBlock] = BoundedQueue(_MAX_QUEUE, _MAX_QUEUE_BYTES)

    def run(self) -> None:
        """Connect, again after each loss of the connection, and submit blocks until the service stops."""
        stopping = self._service.stopping
        submitting = self._service.supervisor.start("OPC UA blocks", self._submit)
        while not stopping.wait(self._server.pause_s):
            self._server.attempt(self._connect)
            for gatherer in self._gatherers.values():  # values were lost with the connection
                gatherer.discard_values()
            self._unstamped.clear()
            self._stamped.clear()
        submitting.join()

    def _connect(self) -> None:
        """Connect, and stay connected until the service ends; raise PartAway if the connection fails or is lost."""
        try:
            asyncio.run(self._run_connection())
        except Exception as error:  # a lost connection raises errors of many types
            reason = " ".join(str(error).split()) or type(error).__name__
            raise PartAway(f"{self._settings.url}: {reason}") from None

    async def _run_connection(self) -> None:
        """Connect, subscribe to all nodes, and wait until the service ends, or an error of any type is raised."""
        from asyncua import Client

        client = Client(self._settings.url, timeout=self._settings.timeout_s)
        if self._settings.security is not None:
            await client.set_security_string(self._settings.security)
        if self._settings.user is not None:
            client.set_user(self._settings.user)
            client.set_password(self._password or "")
        async with client:
            period_ms = 1000.0 * self._settings.block_s / _PUBLICATIONS
            subscription = await client.create_subscription(period_ms, self)
            for actuator in self._actuators:
                nodes = {client.get_node(node): channel for channel, node in actuator.nodes.items()}
                self._channels.update({node.nodeid: (actuator, channel) for node, channel in nodes.items()})
                rate = self._gatherers[actuator.name].rate
                queue_size = math.ceil(2.0 * rate * self._settings.block_s)  # the samples of two blocks
                results = await subscription.subscribe_data_change(
                    [*nodes],
                    queuesize=queue_size,
                    sampling_interval=1000.0 / rate,  # [ms]
                )
                for (node, channel), result in zip(nodes.items(), results, strict=True):
                    if not isinstance(result, int):
                        raise ConnectionError(f"{actuator.name}: no node {node.nodeid} for {channel} ({result})")
            self._server.end_outage()
            while not self._service.stopping.is_set():
                await client.check_connection()
                for actuator in self._actuators:
                    self._push_unstamped(actuator, self._arrival_time())
                await asyncio.sleep(_POLL_S)

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """Add a new value of the variable `node`, and queue the blocks that are then complete; called by asyncua.

        `value`: number or array of samples. True, False and texts such as "3.5" count as numbers. None and numbers that
        are not finite become NaN; a value that is not of good quality becomes a single NaN, even if it is an array.
        Other texts and types, and empty, nested or too long arrays, are dropped and counted. `data`: time and quality
        of the value.
        """
        actuator, channel = self._channels[node.nodeid]
        key, place = (actuator.name, channel), f"{actuator.name}, {channel}"
        data_value = data.monitored_item.Value
        status = data_value.StatusCode
        try:
            samples = np.atleast_1d(np.asarray(value if status is None or status.is_good() else math.nan, np.float64))
            samples = np.where(np.isfinite(samples), samples, math.nan)
        except (TypeError, ValueError):
            samples = np.empty(0)
        if samples.ndim != 1 or not samples.size:
            self._counts.add(_NO_NUMBER, place)
            return
        if samples.size > MAX_SAMPLES:
            self._counts.add(TOO_MANY, place, detail=f"got {samples.size}")
            self._too_long.add(key)
            self._service.supervisor.part(_VALUES_PART).begin_outage(
                f"a value must have at most {MAX_SAMPLES} samples, got {samples.size} ({place})"
            )
            return
        if key in self._too_long:
            self._too_long.remove(key)
            if not self._too_long:  # all channels have values that can be used again
                self._service.supervisor.part(_VALUES_PART).end_outage()
        samples = convert_to_si(samples, actuator.units.get(channel), channel)
        timestamp = data_value.SourceTimestamp or data_value.ServerTimestamp
        arrival = self._arrival_time()
        self._push_unstamped(actuator, arrival)
        if timestamp is None:
            self._counts.add(UNSTAMPED, place, detail="they get the time of their arrival")
            unstamped = self._unstamped.setdefault(key, _Unstamped())
            if not unstamped.values:
                unstamped.arrival = arrival
            unstamped.values.append(samples)
            return
        t = (timestamp if timestamp.tzinfo is not None else timestamp.replace(tzinfo=UTC)).timestamp()
        stamped, reason = self._stamped.setdefault(key, _Stamped()), None
        if t != stamped.t:
            stamped.lost_since, stamped.t = stamped.next_start, t
        elif samples.size == 1:
            reason = SAME_STAMP
        stamped.next_start = t + samples.size / self._gatherers[actuator.name].rate
        if status is not None and status.value & _STATUS_TYPE == _DATA_VALUE and status.value & _OVERFLOW:
            reason = OVERFLOW
        if reason is not None:
            self._counts.add(reason, place, detail="the samples before are missing")
        self._push(actuator, channel, t, samples, None if reason is None else stamped.lost_since)

    @staticmethod
    def _arrival_time() -> float:
        return datetime.now(UTC).timestamp()

    def _push_unstamped(self, actuator: ActuatorSettings, arrival: float) -> None:
        """Add the values without a time stamp that came with publications before the time `arrival` [s since 1970].

        The server samples at the stated rate: the values of a publication end at its arrival. A channel of which fewer
        have come has changed at unknown times since the publication before, so that only its last value is known.
        """
        gatherer, period = self._gatherers[actuator.name], self._settings.block_s / _PUBLICATIONS
        for channel in actuator.nodes if self._unstamped else ():
            unstamped = self._unstamped.get((actuator.name, channel))
            if unstamped is None or not unstamped.values or arrival - unstamped.arrival < 0.5 * period:
                continue
            samples, end = np.concatenate(unstamped.values), unstamped.arrival
            unstamped.values = []
            is_whole = channel in SLOW or samples.size >= _WHOLE_PUBLICATION * (math.floor(period * gatherer.rate) or 1)
            if not is_whole:
                samples = samples[-1:]
            start = end - (samples.size - 1) / gatherer.rate
            if is_whole and abs(start - unstamped.next_start) < period:  # the delay of a publication varies
                start = unstamped.next_start
            lost_since = max(unstamped.next_start, end - period)
            unstamped.next_start = start + samples.size / gatherer.rate
            self._push(actuator, channel, start, samples, None if is_whole else lost_since)

    def _push(self, actuator: ActuatorSettings, channel: str, t: float, samples: Any, lost_since: float | None) -> None:
        """Add samples in SI units to the actuator's gatherer (`ValueGatherer.push`), and queue the complete blocks."""
        for block in self._gatherers[actuator.name].push(channel, t, samples, lost_since):
            # a digest of the contents: a block sent again is recognised
            identity = compute_digest(np.concatenate([block.t, *block.channels.values()]).tobytes())
            if not self._waiting.put(SourceBlock(actuator.name, identity, block), count_bytes(block)):
                self._counts.add(_NO_ROOM, actuator.name)
                self._service.supervisor.part(_QUEUE_PART).begin_outage("blocks come faster than they are stored")

    def _submit(self) -> None:
        """Submit the queued blocks; in a thread, as `submit` of the service waits while its queue is full."""
        queue = self._service.supervisor.part(_QUEUE_PART)
        while not self._service.stopping.is_set():
            blocks = self._waiting.pop(max_items=1, timeout=_POLL_S)
            for block in blocks:
                self._service.submit(block)
            if not blocks:
                queue.end_outage()
