"""Blocks from an MQTT 5 broker, acknowledged when they are stored; alarms to it, retained.

The session outlives the connection (QoS 1, no clean start), so the broker keeps what comes while the monitor is away.
A message is acknowledged after its block is in the database: what was in flight at a crash comes again, and is known by
its identity.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from typing import Any

from sealscope.errors import InputError, MissingExtra
from sealscope.monitor.settings import BrokerSettings, secret_of
from sealscope.monitor.sources.source_block import BlockReceiver, decoded

_log = logging.getLogger(__name__)
#: How long the broker keeps the session [s], messages in flight at most, and the largest one [bytes].
_SESSION_S, _IN_FLIGHT, _LARGEST = 30 * 86_400, 64, 16_000_000
_NAME = "mqtt"


def broker_of(settings: BrokerSettings) -> Callable[[BlockReceiver], None]:
    """Return the source of a broker's messages; raises InputError for a secret that cannot be read."""
    password = secret_of(settings.password_file, "mqtt.password_file")
    try:
        import paho.mqtt.client  # noqa: F401 (asked for before the service starts)
    except ImportError:
        raise MissingExtra("MQTT needs paho-mqtt: pip install 'sealscope[mqtt]'") from None
    return lambda service: _Connection(settings, password, service).run()


class _Connection:
    """The connection of a service to its broker."""

    def __init__(self, settings: BrokerSettings, password: str | None, service: BlockReceiver) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

        self._settings, self._service = settings, service
        self._names = {actuator.topic: actuator.name for actuator in service.settings.actuator if actuator.topic}
        self._client = Client(
            CallbackAPIVersion.VERSION2, settings.client_id, protocol=MQTTProtocolVersion.MQTTv5, manual_ack=True
        )
        if settings.user is not None:
            self._client.username_pw_set(settings.user, password)
        if settings.tls:
            self._client.tls_set(ca_certs=None if settings.ca_file is None else str(settings.ca_file))
        self._connection = 0
        self._client.on_connect = self._connected
        self._client.on_message = self._message
        self._client.on_disconnect = self._lost
        self._client.reconnect_delay_set(1, 30)

    def run(self) -> None:
        """Hand messages over and pass alarms on until the service stops."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = _SESSION_S
        properties.ReceiveMaximum = _IN_FLIGHT
        properties.MaximumPacketSize = _LARGEST
        self._client.connect_async(self._settings.host, self._settings.port, clean_start=False, properties=properties)
        self._client.loop_start()
        try:
            while not self._service.stopping.wait(0.2):
                self._pass_on()
            self._pass_on()
        finally:
            self._client.disconnect()
            self._client.loop_stop()

    def _connected(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        self._connection += 1
        if reason.is_failure:
            _log.error("the broker %s refuses the connection: %s", self._settings.host, reason)
            return
        for topic in self._names:
            client.subscribe(topic, qos=1)

    def _lost(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        if not self._service.stopping.is_set():
            _log.warning("the connection to the broker %s is lost: %s", self._settings.host, reason)

    def _message(self, client: Any, userdata: Any, message: Any) -> None:
        number, qos, connection = message.mid, message.qos, self._connection

        def done() -> None:
            # after a lost connection the number may be another message's, and the broker sends this one again
            if connection == self._connection:
                client.ack(number, qos)

        try:
            self._service.hand(decoded(message.payload, self._names.get(message.topic), done))
        except InputError as error:
            self._service.hand(InputError(f"{message.topic[:100]}: {error}"))
            done()  # it would be no better a second time

    def _pass_on(self) -> None:
        """Publish the alarms of new events, each retained."""
        from sqlalchemy.exc import DBAPIError

        topic, store = self._settings.alarms_topic, self._service.store
        if topic is None or not store.sends or not self._client.is_connected():
            return
        try:
            for number, event in store.events_since(store.position(_NAME)):
                alarm = event["alarm"]
                name = "".join("_" if letter in "+#/\0" else letter for letter in alarm["actuator"])
                sent = self._client.publish(f"{topic}/{name}/alarm", json.dumps(alarm), qos=1, retain=True)
                sent.wait_for_publish(timeout=5.0)
                if not sent.is_published():
                    return
                store.keep_position(_NAME, number)
        except (DBAPIError, RuntimeError, ValueError) as error:
            _log.warning("alarms wait for the broker or the database: %s", str(error).splitlines()[0])
