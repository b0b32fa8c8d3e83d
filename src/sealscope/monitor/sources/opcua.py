"""Read samples from an OPC UA server by subscription, and gather them into blocks.

Each channel of an actuator is a variable of the server. Its value is a number, or an array of samples that
begins at the source timestamp. The server queues the changes of each variable between two publications. Changes are
lost while there is no connection, because OPC UA subscriptions end with their session.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import Any

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.monitor.bounded_queue import BoundedQueue
from sealscope.monitor.settings import ActuatorSettings, OpcUaSettings, read_secret
from sealscope.monitor.sources.gathering import ValueGatherer
from sealscope.monitor.sources.source_block import (
    BlockReceiver,
    SourceBlock,
    compute_digest,
    convert_to_si,
    count_bytes,
)
from sealscope.monitor.supervisor import OPCUA, PartAway

#: Publications per block.
_PUBLICATIONS = 4
#: Most blocks in the queue, and most bytes of them; further blocks are dropped and counted.
_MAX_QUEUE, _MAX_QUEUE_BYTES = 256, 64_000_000
#: How often the connection is checked [s].
_POLL_S = 0.5
_NO_ROOM = "blocks of OPC UA that found no room"
_NO_NUMBER = "OPC UA values that are no number"


def opcua_source(settings: OpcUaSettings) -> Callable[[BlockReceiver], None]:
    """Build a source that submits the values of an OPC UA server as blocks.

    Raises MissingExtra if asyncua is not installed, and InputError if the password cannot be read.
    """
    if find_spec("asyncua") is None:  # before the service starts
        raise MissingExtra("OPC UA needs asyncua: pip install 'sealscope[opcua]'")
    password = read_secret(settings.password_file, "opcua.password_file")
    return lambda service: _OpcUaSession(settings, password, service).run()


class _OpcUaSession:
    """The connection of a service to an OPC UA server, with its subscriptions."""

    def __init__(self, settings: OpcUaSettings, password: str | None, service: BlockReceiver) -> None:
        self._settings, self._password, self._service = settings, password, service
        self._server = service.supervisor.part(OPCUA)
        self._gatherers: dict[str, ValueGatherer] = {}
        self._actuators = [actuator for actuator in service.settings.actuator if actuator.nodes]
        for actuator in self._actuators:
            rate = float(actuator.rate or math.nan)  # never None: the settings are checked
            self._gatherers[actuator.name] = ValueGatherer(tuple(actuator.nodes), rate, settings.block_s, service.count)
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
                await asyncio.sleep(_POLL_S)

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """Add a new value of the variable `node`, and queue the blocks that are then complete; called by asyncua.

        `value`: number or array of samples. True, False and texts such as "3.5" count as numbers. None and numbers that
        are not finite become NaN; a value that is not of good quality becomes a single NaN, even if it is an array.
        Other texts and types, and empty or nested arrays, are dropped and counted. `data`: time and quality of the
        value.
        """
        actuator, channel = self._channels[node.nodeid]
        data_value = data.monitored_item.Value
        timestamp = data_value.SourceTimestamp or data_value.ServerTimestamp or datetime.now(UTC)
        t = (timestamp if timestamp.tzinfo is not None else timestamp.replace(tzinfo=UTC)).timestamp()
        is_good = data_value.StatusCode is None or data_value.StatusCode.is_good()
        try:
            samples = np.atleast_1d(np.asarray(value if is_good else math.nan, dtype=np.float64))
            samples = np.where(np.isfinite(samples), samples, math.nan)
        except (TypeError, ValueError):
            samples = np.empty(0)
        if samples.ndim != 1 or not samples.size:
            self._service.count(_NO_NUMBER)
            return
        si_samples = convert_to_si(samples, actuator.units.get(channel), channel)
        for block in self._gatherers[actuator.name].push(channel, t, si_samples.tolist()):
            # a digest of the contents: a block sent again is recognised
            identity = compute_digest(np.concatenate([block.t, *block.channels.values()]).tobytes())
            if not self._waiting.put(SourceBlock(actuator.name, identity, block), count_bytes(block)):
                self._service.count(_NO_ROOM)

    def _submit(self) -> None:
        """Submit the queued blocks; in a thread, as `submit` of the service waits while its queue is full."""
        while not self._service.stopping.is_set():
            for block in self._waiting.pop(max_items=1, timeout=_POLL_S):
                self._service.submit(block)
