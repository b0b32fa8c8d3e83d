"""Blocks from an MQTT 5 broker, acknowledged when they are stored; alarms to it, retained.

The session outlives the connection (QoS 1, no clean start): what was in flight at a crash comes again, and is known by
its identity. The thread of the connection only takes messages in; another one decodes them and waits where the service
does. That the decoding of a large or repeated message begins is stored until it ends: one during which the process has
died twice is refused unread. Of QoS 0 those are dropped and counted for which there is no room. Where a broker sends
more of QoS 1 than agreed (as mosquitto 2.0.11 does), that one and all after it are left to it, and come again in order
over a new connection.
"""

from __future__ import annotations

import json
import logging
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from sealscope.monitor.mqtt_client import MqttLink, check_mqtt
from sealscope.monitor.settings import BrokerSettings, secret_of, topic_part
from sealscope.monitor.sources.source_block import (
    UNENDED,
    BlockReceiver,
    RefusedMessage,
    SourceBlock,
    decoded,
    digest_of,
)
from sealscope.monitor.sources.sparkplug_host import SparkplugHost
from sealscope.monitor.sparkplug import NAMESPACE
from sealscope.monitor.supervisor import BROKER
from sealscope.monitor.waiting import Waiting

_log = logging.getLogger(__name__)
#: How long the broker keeps the session [s], messages in flight at most, and the largest one [bytes].
_SESSION_S, _IN_FLIGHT, _LARGEST = 30 * 86_400, 256, 16_000_000
#: Messages that wait to be decoded and their bytes, at most, as one more of QoS 0 is taken in, and as one of QoS 1 is.
_ROOM, _ROOM_BYTES = 256, 64_000_000
_ASSURED_ROOM, _ASSURED_BYTES = 2048, 192_000_000
#: Messages whose decoding is noted: larger ones [bytes], and those that come again; how often it is begun at most.
_LARGE, _ATTEMPTS = 256_000, 2
_NAME = "mqtt"
#: How long the decoder is waited for at the end [s].
_END_S = 2.0
#: How often events are looked for [s].
_LOOK_S = 0.05
#: How often the states of the actuators are looked at [s].
_STATES_S = 2.0
#: What messages are counted under that find no room.
_NO_ROOM = "messages of QoS 0 that found no room"
_ASKED_AGAIN = "messages of QoS 1 that found no room and were asked for again"


def broker_of(settings: BrokerSettings) -> Callable[[BlockReceiver], None]:
    """Return the source of a broker's messages; raises InputError for a secret that cannot be read."""
    password = secret_of(settings.password_file, "mqtt.password_file")
    check_mqtt()
    return lambda service: _Connection(settings, password, service).run()


class _Connection:
    """The connection of a service to its broker."""

    def __init__(self, settings: BrokerSettings, password: str | None, service: BlockReceiver) -> None:
        self._settings, self._service = settings, service
        self._broker = service.supervisor.part(BROKER)
        self._names = {actuator.topic: actuator.name for actuator in service.settings.actuator if actuator.topic}
        self._units_of = {actuator.name: actuator.units for actuator in service.settings.actuator}
        self._name = settings.client_id
        will = None if settings.host_id is None else self._offline
        self._link = MqttLink(settings, self._name, password, will, retain=True)
        self._client = self._link.client
        self._host: SparkplugHost | None = None
        if any(actuator.sparkplug is not None for actuator in service.settings.actuator):
            self._host = SparkplugHost(service.settings.actuator, self._client.publish, service.count)
        self._online = self._connection = 0  # when the connection was made [ms], and its number
        self._refusing = -1  # the connection whose further messages are left to the broker
        self._to_close: Any = None  # the line of that connection
        self._ended = threading.Event()
        self._states: dict[str, str] = {}  # as they were published
        self._states_due = 0.0
        self._arrived: Waiting[Any] = Waiting(_ROOM, _ROOM_BYTES)
        self._client.on_connect_fail = self._on_connect_fail
        self._client.on_connect = self._on_connect
        self._client.on_message = self._message
        self._client.on_disconnect = self._on_disconnect

    def run(self) -> None:
        """Hand messages over and pass alarms on until the service stops."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = _SESSION_S
        properties.ReceiveMaximum = _IN_FLIGHT
        properties.MaximumPacketSize = _LARGEST
        decoding = self._service.supervisor.start("MQTT decoder", self._decode)
        alarms = self._service.supervisor.part("MQTT alarms")
        self._link.open(clean_start=False, properties=properties)
        try:
            while not self._service.stopping.wait(_LOOK_S):
                self._link.check()
                alarms.attempt(self._pass_on)
            self._states_due = 0.0
            alarms.attempt(self._pass_on)
        finally:
            self._ended.set()
            decoding.join(_END_S)
            self._link.close()

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        self._connection += 1
        if reason.is_failure:
            self._broker.begin_outage(f"{self._settings.host} refuses the connection: {reason}")
            return
        self._broker.end_outage()
        self._states.clear()
        if self._settings.host_id is not None:
            client.publish(*self._state(online=True), qos=1, retain=True)
        for topic in (*self._names, *(self._host.topics if self._host is not None else ())):
            client.subscribe(topic, qos=1)
        self._arrived.put((self._connection, None), 0, always=True)

    def _offline(self) -> tuple[str, str]:
        """Return the will of a primary host of Sparkplug; it has the time of the connection to come."""
        self._online = round(1000.0 * time.time())
        return self._state(online=False)

    def _state(self, *, online: bool) -> tuple[str, str]:
        """Return topic and payload of the state of a primary host."""
        state = json.dumps({"online": online, "timestamp": self._online})
        return f"{NAMESPACE}/STATE/{self._settings.host_id}", state

    def _on_disconnect(self, client: Any, userdata: Any, flags: Any, reason: Any, properties: Any) -> None:
        if not self._service.stopping.is_set() and self._refusing != self._connection:
            self._broker.begin_outage(f"the connection to {self._settings.host} is lost: {reason}")

    def _on_connect_fail(self, client: Any, userdata: Any) -> None:
        error = sys.exc_info()[1]  # paho calls while it handles the error
        reason = " ".join(str(getattr(error, "strerror", None) or error or "").split())[:120]
        if isinstance(error, ssl.SSLCertVerificationError):
            reason = f"its certificate is not trusted ({error.verify_message})"
        self._broker.begin_outage(
            f"no connection to {self._settings.host}:{self._settings.port}: {reason}".removesuffix(": ")
        )

    def _message(self, client: Any, userdata: Any, message: Any) -> None:
        """Take a message in; must not wait, for the connection would be lost meanwhile."""
        arrived, size = (self._connection, message), len(message.payload)
        if message.qos == 0:
            if not self._arrived.put(arrived, size):
                self._service.count(_NO_ROOM)
            return
        messages, held = self._arrived.waiting()
        full = messages >= _ASSURED_ROOM or held + size > _ASSURED_BYTES
        if full and self._refusing != self._connection:
            self._refusing, self._to_close = self._connection, self._client.socket()
        if self._refusing == self._connection:
            self._service.count(_ASKED_AGAIN)
        else:
            self._arrived.put(arrived, size, always=True)

    def _decode(self) -> None:
        """Hand the messages over that were taken in, in their order."""
        while not (self._service.stopping.is_set() or self._ended.is_set()):
            arrived = self._arrived.take(1, 0.5)
            for connection, message in arrived:
                if message is not None:
                    self._hand(connection, message)
                elif self._host is not None:  # a connection was made
                    self._host.ask_all()
            if not arrived and (line := self._to_close) is not None:
                self._to_close = None
                with suppress(OSError):
                    line.shutdown(socket.SHUT_RDWR)  # paho connects again, and the broker sends what it was left

    def _hand(self, connection: int, message: Any) -> None:
        number, qos = message.mid, message.qos

        def done() -> None:
            # after a lost connection the number may be another message's, and the broker sends this one again
            if qos and connection == self._connection:
                self._client.ack(number, qos)

        topic, block = "", None
        try:
            with suppress(UnicodeDecodeError):
                topic = message.topic
            with self._note_decoding(message):
                block = self._decoded(topic, message.payload)
        except RefusedMessage as error:  # it would be no better a second time: it is kept, and acknowledged
            self._service.hand(RefusedMessage(error.reason, f"{topic[:100]}: {error}", message.payload, done))
        else:
            done() if block is None else self._service.hand(replace(block, done=done))

    def _decoded(self, topic: str, payload: bytes) -> SourceBlock | None:
        """Return the block of a message, None for one of Sparkplug without; raises RefusedMessage."""
        if self._host is not None and topic.startswith(f"{NAMESPACE}/"):
            return self._host.receive(topic, payload)
        return decoded(payload, self._names.get(topic), self._units_of)

    @contextmanager
    def _note_decoding(self, message: Any) -> Iterator[None]:
        """Store, while a message is decoded that is large or comes again, that this was begun.

        Raises RefusedMessage where it was begun twice before and never ended: the process died meanwhile.
        """
        if not message.qos or not (message.dup or len(message.payload) > _LARGE):
            yield
            return
        store, digest, before = self._service.store, digest_of(message.payload), 0
        with suppress(SQLAlchemyError):  # it is away: storing waits for it, and says so
            before = store.begin_decoding(self._name, digest)
        try:
            if before >= _ATTEMPTS:
                raise RefusedMessage(UNENDED, f"a message must be decoded in {_ATTEMPTS} attempts, got no end of them")
            yield
        finally:
            with suppress(SQLAlchemyError):
                store.end_decoding(self._name, digest)

    def _pass_on(self) -> None:
        """Publish the alarms of new events, and the states that have changed, each retained."""
        store = self._service.store
        if self._settings.alarms_topic is None or not self._client.is_connected():
            return
        store.pass_on(
            _NAME, lambda event: self._publish(event["alarm"]["actuator"], "alarm", json.dumps(event["alarm"]))
        )
        if time.monotonic() >= self._states_due:
            self._states_due = time.monotonic() + _STATES_S
            for name, summary in self._service.plain().items():
                state = json.dumps(summary["state"])
                if self._states.get(name) != state and self._publish(name, "state", state):
                    self._states[name] = state

    def _publish(self, actuator: str, what: str, message: str) -> bool:
        """Publish a retained message of an actuator; return whether the broker has it."""
        topic = f"{self._settings.alarms_topic}/{topic_part(actuator)}/{what}"
        return self._link.published(topic, message, qos=1, retain=True)
