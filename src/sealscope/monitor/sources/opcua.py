"""Blocks from an OPC UA server: values by subscription, gathered into blocks.

Each channel of an actuator is a variable of the server, whose value is a number, or an array of samples from its source
timestamp on. The server keeps what changes between two publications in a queue of each item; what it sends while
nobody is connected is lost, for OPC UA subscriptions end with their session.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from sealscope.errors import MissingExtra
from sealscope.monitor.settings import OpcUaSettings, secret_of
from sealscope.monitor.sources.gathering import ValueGatherer
from sealscope.monitor.sources.source_block import BlockReceiver, SourceBlock, bytes_of, digest_of
from sealscope.monitor.supervisor import OPCUA, PartAway
from sealscope.monitor.waiting import Waiting
from sealscope.recordings.recording import CHANNEL_UNITS
from sealscope.units import to_si

#: Publications in a block, and blocks that wait for the service and their bytes; more are dropped and counted.
_PUBLICATIONS, _ROOM, _ROOM_BYTES = 4, 256, 64_000_000
#: How often the connection is looked at [s].
_LOOK_S = 0.5
_NO_ROOM = "blocks of OPC UA that found no room"
_NO_NUMBER = "OPC UA values that are no number"


def opcua_of(settings: OpcUaSettings) -> Callable[[BlockReceiver], None]:
    """Return the source of a server's values; raises InputError for a secret that cannot be read."""
    if find_spec("asyncua") is None:  # asked for before the service starts
        raise MissingExtra("OPC UA needs asyncua: pip install 'sealscope[opcua]'")
    password = secret_of(settings.password_file, "opcua.password_file")
    return lambda service: _OpcUaSession(settings, password, service).run()


class _OpcUaSession:
    """The subscriptions of a service at its server; asyncua calls `datachange_notification`."""

    def __init__(self, settings: OpcUaSettings, password: str | None, service: BlockReceiver) -> None:
        self._settings, self._password, self._service = settings, password, service
        self._server = service.supervisor.part(OPCUA)
        self._gatherers: dict[str, ValueGatherer] = {}
        self._scales: dict[tuple[str, str], Callable[[Any], Any]] = {}
        self._actuators = [actuator for actuator in service.settings.actuator if actuator.nodes]
        for actuator in self._actuators:
            rate = float(actuator.rate or math.nan)  # the settings are checked
            self._gatherers[actuator.name] = ValueGatherer(tuple(actuator.nodes), rate, settings.block_s, service.count)
            for channel in actuator.nodes:
                si, unit = CHANNEL_UNITS[channel], actuator.units.get(channel)
                self._scales[actuator.name, channel] = partial(to_si, unit=unit or si, si_unit=si, name=channel)
        self._channels: dict[Any, tuple[str, str]] = {}
        self._waiting: Waiting[SourceBlock] = Waiting(_ROOM, _ROOM_BYTES)

    def run(self) -> None:
        """Hand blocks over until the service stops; after a lost connection a new one is made."""
        stopping, handing = self._service.stopping, self._service.supervisor.start("OPC UA blocks", self._hand)
        while not stopping.wait(self._server.pause_s):
            self._server.attempt(lambda: asyncio.run(self._connect()))
            for gatherer in self._gatherers.values():
                gatherer.interrupted()
        handing.join()

    async def _connect(self) -> None:
        """Stay connected until the service ends; raises PartAway where the server is not reached any more."""
        try:
            await self._run_connection()
        except Exception as error:  # whatever the library and the server make of a lost connection
            reason = " ".join(str(error).split()) or type(error).__name__
            raise PartAway(f"{self._settings.url}: {reason}") from None

    async def _run_connection(self) -> None:
        """Connect, subscribe, and stay until the connection is lost, which raises, or the service ends."""
        from asyncua import Client

        client = Client(self._settings.url, timeout=self._settings.timeout_s)
        if self._settings.security is not None:
            await client.set_security_string(self._settings.security)
        if self._settings.user is not None:
            client.set_user(self._settings.user)
            client.set_password(self._password or "")
        async with client:
            period = 1000.0 * self._settings.block_s / _PUBLICATIONS
            subscription = await client.create_subscription(period, self)
            for actuator in self._actuators:
                nodes = {client.get_node(node): channel for channel, node in actuator.nodes.items()}
                self._channels.update({node.nodeid: (actuator.name, channel) for node, channel in nodes.items()})
                rate = float(actuator.rate or 1.0)
                answers = await subscription.subscribe_data_change(
                    [*nodes], queuesize=math.ceil(2.0 * rate * self._settings.block_s), sampling_interval=1e3 / rate
                )
                for (node, channel), answer in zip(nodes.items(), answers, strict=True):
                    if not isinstance(answer, int):
                        raise ConnectionError(f"{actuator.name}: {channel} is no node, got {node.nodeid} ({answer})")
            self._server.end_outage()
            while not self._service.stopping.is_set():
                await client.check_connection()
                await asyncio.sleep(_LOOK_S)

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """Take a value of a subscription."""
        name, channel = self._channels[node.nodeid]
        stamped = data.monitored_item.Value
        moment = stamped.SourceTimestamp or stamped.ServerTimestamp or datetime.now(UTC)
        t = (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()
        known = stamped.StatusCode is None or stamped.StatusCode.is_good()
        try:
            samples = np.atleast_1d(np.asarray(value if known else math.nan, dtype=np.float64))
            samples = np.where(np.isfinite(samples), samples, math.nan)
        except (TypeError, ValueError):
            samples = np.empty((0, 0))
        if samples.ndim != 1 or not samples.size:
            self._service.count(_NO_NUMBER)
            return
        for block in self._gatherers[name].take(channel, t, self._scales[name, channel](samples).tolist()):
            identity = digest_of(np.concatenate([block.t, *block.channels.values()]).tobytes())  # twice is known
            if not self._waiting.put(SourceBlock(name, identity, block), bytes_of(block)):
                self._service.count(_NO_ROOM)

    def _hand(self) -> None:
        """Hand blocks to the service, which may wait, while the connection lives on."""
        while not self._service.stopping.is_set():
            for block in self._waiting.take(1, _LOOK_S):
                self._service.hand(block)
